//! An attached device: the thread that answers the host, and the threads that send on the device's clock, one per endpoint.
//!
//! Invariant: one mutex per device guards function, transfers and socket; nothing waits for clock or host holding it.
//! Invariant: a tick that is late or finds no reader is skipped, not caught up: a camera does not deliver the past.

use std::collections::VecDeque;
use std::io::{Read, Write};
use std::net::Shutdown;
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::Duration;

use serde_json::json;

use super::descriptor::{Answer, Setup};
use super::function::Function;
use super::log::{Log, Moment};
use super::source::Live;
use super::wire::{self, HEADER_LEN, Request, Status, Submit};
use crate::clock;

/// A device as its threads and its owner see it.
pub(super) struct Shared {
    pub(super) index: usize,
    state: Mutex<State>,
    pub(super) changed: Condvar,
    pub(super) log: Arc<Log>,
}

/// What the mutex guards.
pub(super) struct State {
    pub(super) function: Function,
    pub(super) line: Option<UnixStream>,
    /// Counts attachments: a thread of an older one that wakes late sees another number and ends.
    pub(super) epoch: u32,
    /// Transfers to the host that wait for data, by endpoint.
    pub(super) waiting: [VecDeque<Waiting>; 16],
    pub(super) silent: bool,
    /// When a device with a protocol is due next, ns of CLOCK_MONOTONIC.
    pub(super) due_ns: u64,
    /// The emulator no longer needs it.
    pub(super) ended: bool,
    /// By endpoint, as `waiting`.
    pub(super) counts: [Counts; 16],
    pub(super) scratch: Vec<u8>,
}

/// What was sent through an endpoint since the emulator started, and what was not.
#[derive(Clone, Copy, Default)]
pub(super) struct Counts {
    /// Frames, lines, or transfers of a device with a protocol.
    pub(super) sent: u64,
    /// Ticks without a reader, or too late.
    skipped: u64,
}

/// A transfer to the host that waits for data.
pub(super) struct Waiting {
    pub(super) seq: u32,
    pub(super) room: usize,
}

impl Shared {
    pub(super) fn new(index: usize, function: Function, log: Arc<Log>) -> Self {
        let state = State {
            function,
            line: None,
            epoch: 0,
            waiting: Default::default(),
            silent: false,
            due_ns: 0,
            ended: false,
            counts: Default::default(),
            scratch: Vec::new(),
        };
        Self { index, state: Mutex::new(state), changed: Condvar::new(), log }
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// Drops this attachment, unless another has followed it, and lets its threads end.
    pub(super) fn hang_up(&self, epoch: u32) {
        let mut state = self.lock();
        if state.epoch != epoch {
            return;
        }
        if let Some(line) = state.line.take() {
            let _closed_already = line.shutdown(Shutdown::Both);
        }
        state.waiting = Default::default();
        state.function.reset();
        drop(state);
        self.changed.notify_all();
    }

    /// Answers the host until the connection ends.
    pub(super) fn serve(&self, mut line: UnixStream, epoch: u32) {
        let mut data = Vec::new();
        let mut header = [0; HEADER_LEN];
        while line.read_exact(&mut header).is_ok() {
            let request = match wire::decode(&header) {
                Ok(request) => request,
                Err(error) => {
                    let fields = json!({"device": self.index, "error": error.to_string()});
                    self.log.write("protocol_error", Moment::now(), fields);
                    break;
                }
            };
            data.clear();
            if let Request::Submit(Submit { is_in: false, length, .. }) = request {
                data.resize(length as usize, 0);
                if line.read_exact(&mut data).is_err() {
                    break;
                }
            }
            self.answer(request, &data);
        }
        self.hang_up(epoch);
        let counts = self.lock().counts;
        let total = |count: fn(&Counts) -> u64| counts.iter().map(count).sum::<u64>();
        let (sent, skipped) = (total(|counts| counts.sent), total(|counts| counts.skipped));
        self.log.write("gone", Moment::now(), json!({"device": self.index, "sent": sent, "skipped": skipped}));
    }

    fn answer(&self, request: Request, data: &[u8]) {
        let now = Moment::now();
        let mut state = self.lock();
        match request {
            Request::Unlink { seq, victim } => {
                let found = state.take_back(victim);
                state.write(&wire::unlink_reply(seq, if found { Status::Unlinked } else { Status::Ok }));
            }
            Request::Submit(submit) if submit.endpoint == 0 => {
                let before = state.streams();
                state.control(submit, data, now.mono_ns);
                self.log_streams(&mut state, &before);
            }
            Request::Submit(Submit { seq, is_in: true, endpoint, length, .. }) => {
                state.waiting[usize::from(endpoint)].push_back(Waiting { seq, room: length as usize });
            }
            Request::Submit(submit) => {
                state.write(&wire::submit_reply(submit.seq, Status::Ok, data.len()));
                if let Some(talker) = state.function.talker() {
                    talker.receive(data, now.mono_ns);
                }
            }
        }
        if state.function.talks() {
            return self.attend(&mut state, now);
        }
        drop(state);
        self.changed.notify_all();
    }

    /// Logs the streams that the host has started or stopped.
    fn log_streams(&self, state: &mut State, before: &[(u8, Option<Live>)]) {
        for (endpoint, before) in before {
            let after = state.function.live(*endpoint);
            if *before != after {
                let action = if after.is_some() { "stream_on" } else { "stream_off" };
                let Counts { sent, skipped } = state.counts[usize::from(*endpoint)];
                let fields = json!({"device": self.index, "endpoint": endpoint, "sent": sent, "skipped": skipped});
                self.log.write(action, Moment::now(), fields);
            }
        }
    }

    /// Sends a frame or line of an endpoint's source at every tick until the connection ends.
    pub(super) fn beat(&self, epoch: u32, endpoint: u8) {
        let mut whole = Vec::new();
        let mut due_ns = 0;
        let mut state = self.lock();
        while state.is_attached(epoch) {
            let Some(live) = state.function.live(endpoint).filter(|_| !state.silent) else {
                due_ns = 0;
                state = self.wait(state, Duration::from_secs(1));
                continue;
            };
            let period_ns = u64::try_from(live.period.as_nanos()).unwrap_or(u64::MAX);
            let now_ns = clock::mono_ns();
            if due_ns == 0 {
                due_ns = now_ns;
            }
            if now_ns < due_ns {
                state = self.wait(state, clock::until(due_ns));
                continue;
            }
            let late = (now_ns - due_ns) / period_ns;
            due_ns += (late + 1) * period_ns;
            let is_awaited = !state.waiting[usize::from(endpoint)].is_empty();
            state.counts[usize::from(endpoint)].skipped += if is_awaited { late } else { late + 1 };
            if is_awaited && let Some(source) = state.function.source(endpoint) {
                source.produce(now_ns, &mut whole);
                state = self.send(state, &whole, epoch, endpoint, live.stream);
            }
        }
    }

    /// Sends `whole` packet by packet as the host requests them; gives up when the stream or the connection ends.
    fn send<'a>(
        &'a self,
        mut state: MutexGuard<'a, State>,
        whole: &[u8],
        epoch: u32,
        endpoint: u8,
        stream: u32,
    ) -> MutexGuard<'a, State> {
        let mut at = 0;
        while at < whole.len() {
            let is_over = state.function.live(endpoint).is_none_or(|live| live.stream != stream);
            if is_over || !state.is_attached(epoch) {
                return state;
            }
            match state.waiting[usize::from(endpoint)].pop_front() {
                Some(transfer) => at = state.complete(endpoint, &transfer, whole, at),
                None => state = self.wait(state, Duration::from_secs(1)),
            }
        }
        if let Some(source) = state.function.source(endpoint) {
            source.sent();
        }
        state.counts[usize::from(endpoint)].sent += 1;
        state
    }

    pub(super) fn wait<'a>(&self, state: MutexGuard<'a, State>, limit: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, limit).unwrap_or_else(|poisoned| poisoned.into_inner()).0
    }
}

impl State {
    fn is_attached(&self, epoch: u32) -> bool {
        self.epoch == epoch && self.line.is_some()
    }

    /// The stream of each endpoint, if one runs.
    fn streams(&mut self) -> Vec<(u8, Option<Live>)> {
        self.function.endpoints().map(|endpoint| (endpoint, self.function.live(endpoint))).collect()
    }

    /// Answers a control request.
    fn control(&mut self, submit: Submit, data: &[u8], now_ns: u64) {
        let setup = Setup::parse(&submit.setup);
        match self.function.control(setup, data, now_ns) {
            Answer::Data(mut bytes) => {
                bytes.truncate(usize::from(setup.length).min(submit.length as usize));
                self.reply(submit.seq, &bytes);
            }
            Answer::Done => self.write(&wire::submit_reply(submit.seq, Status::Ok, data.len())),
            Answer::Stall => self.write(&wire::submit_reply(submit.seq, Status::Stall, 0)),
        }
    }

    /// Completes a transfer with the part of `whole` that begins at `at`; returns where the next one continues.
    fn complete(&mut self, endpoint: u8, transfer: &Waiting, whole: &[u8], at: usize) -> usize {
        let Some(source) = self.function.source(endpoint) else { return whole.len() };
        let mut packet = std::mem::take(&mut self.scratch);
        packet.clear();
        packet.resize(HEADER_LEN, 0);
        let next = source.packet(whole, at, transfer.room, &mut packet);
        let length = packet.len() - HEADER_LEN;
        packet[..HEADER_LEN].copy_from_slice(&wire::submit_reply(transfer.seq, Status::Ok, length));
        self.write(&packet);
        self.scratch = packet;
        next
    }

    fn take_back(&mut self, victim: u32) -> bool {
        self.waiting.iter_mut().any(|queue| {
            let place = queue.iter().position(|waiting| waiting.seq == victim);
            place.and_then(|place| queue.remove(place)).is_some()
        })
    }

    fn reply(&mut self, seq: u32, data: &[u8]) {
        let header = wire::submit_reply(seq, Status::Ok, data.len());
        self.write(&[&header[..], data].concat());
    }

    /// A failed write means that the connection has ended, which `serve` notices as well.
    pub(super) fn write(&mut self, bytes: &[u8]) {
        if let Some(line) = &mut self.line {
            let _ended = line.write_all(bytes);
        }
    }
}

#[cfg(test)]
#[path = "attachment_tests.rs"]
mod tests;
