//! Protocol devices: their output is sent as soon as the host requests it, and their own actions happen on time,
//! whether they are plugged in or not.
//!
//! Invariant: `attend` follows every change of such a device, so its output and events never wait for the next tick.

use std::time::Duration;

use super::attachment::{Shared, State};
use super::log::Moment;
use super::order::Order;
use super::wire::{self, HEADER_LEN, Status};
use crate::clock;

/// The thread checks at least this often.
const LONGEST: Duration = Duration::from_secs(1);

impl Shared {
    /// Runs the device's own clock until the emulator no longer needs it.
    pub(super) fn talk(&self) {
        let mut state = self.lock();
        while !state.ended {
            self.attend(&mut state, Moment::now());
            let rest = clock::until(state.due_ns).min(LONGEST);
            state = self.wait(state, rest);
        }
    }

    /// Applies an order to the device; false if it does not support it.
    pub(super) fn apply(&self, motor: Option<u16>, order: Order) -> bool {
        let now = Moment::now();
        let mut state = self.lock();
        let done = state.function.talker().is_some_and(|talker| talker.apply(motor, order, now.mono_ns));
        self.attend(&mut state, now);
        done
    }

    /// Lets the device do what is due, sends what the host has requested, logs its events.
    pub(super) fn attend(&self, state: &mut State, now: Moment) {
        let Some(talker) = state.function.talker() else { return };
        let due_ns = talker.tend(now.mono_ns).unwrap_or(u64::MAX);
        let mut reported = Vec::new();
        talker.reported(&mut reported);
        for reported in reported {
            let mut fields = reported.fields;
            fields["device"] = self.index.into();
            self.log.write(reported.action, now, fields);
        }
        state.deliver(now.mono_ns);
        let sooner = due_ns < state.due_ns;
        state.due_ns = due_ns;
        if sooner {
            self.changed.notify_all();
        }
    }
}

impl State {
    /// Completes waiting transfers as long as there is data for them, all at once.
    fn deliver(&mut self, now_ns: u64) {
        let Some(talker) = self.function.talker() else { return };
        if self.silent {
            talker.discard();
            return;
        }
        let mut replies = std::mem::take(&mut self.scratch);
        replies.clear();
        for (endpoint, queue) in (0..).zip(&mut self.waiting).skip(1) {
            while let Some(transfer) = queue.front() {
                let at = replies.len();
                replies.resize(at + HEADER_LEN, 0);
                if !talker.take(endpoint, transfer.room, now_ns, &mut replies) {
                    replies.truncate(at);
                    break;
                }
                let length = replies.len() - at - HEADER_LEN;
                replies[at..at + HEADER_LEN].copy_from_slice(&wire::submit_reply(transfer.seq, Status::Ok, length));
                queue.pop_front();
                self.counts[usize::from(endpoint)].sent += 1;
            }
        }
        if !replies.is_empty() {
            self.write(&replies);
        }
        self.scratch = replies;
    }
}
