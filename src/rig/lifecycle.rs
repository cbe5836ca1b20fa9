//! The lifecycle of one modality's device, as a pure state machine.
//!
//! | state     | attached | running | bit | waits for                            |
//! |-----------|----------|---------|-----|--------------------------------------|
//! | Absent    | no (*)   | no      | 0   | an attachment                        |
//! | Opening   | yes      | yes     | 0   | the first sample                     |
//! | Streaming | yes      | yes     | 1   |                                      |
//! | Stalled   | yes      | yes     | 1   | a sample, or the end of the stream   |
//! | Backoff   | yes      | no      | 0   | the end of the cooldown or back-off  |
//! | Failed    | yes      | no      | 0   | a replug, or a restart by hand       |
//!
//! (*) When the stream notices an unplug first, the device becomes Absent at once, before hot-plug confirms it. If no
//! removal comes within the cooldown, the device never left and is started again, which counts as a restart: a driver
//! that keeps reporting this reaches the limit.
//!
//! Invariant: an input of an older epoch has no effect.
//! Invariant: a cooldown delays an attachment and never drops it.
//! Invariant: no clock, no I/O: time comes in as an argument.

use std::time::Duration;

use rapid_core::sample::Epoch;
use rapid_core::time::Stamp;
use rapid_status::DeviceState;

/// A stream that ends while its device is attached is restarted this many times...
const MAX_RESTARTS: usize = 5;
/// ...within this time; then the device is Failed.
const RESTART_WINDOW: Duration = Duration::from_mins(1);
/// Delay before the first restart; each further restart in the window waits twice as long.
const FIRST_BACKOFF: Duration = Duration::from_millis(500);

/// An input to a lifecycle. `A` is an attachment.
#[derive(Debug, Clone, PartialEq)]
pub enum Input<A> {
    /// A device of this modality was plugged in.
    Attached(A),
    /// It was unplugged.
    Detached,
    /// The stream delivered its first sample.
    Started(Epoch),
    /// Samples have stopped.
    Stalled(Epoch),
    /// Samples arrive again.
    Resumed(Epoch),
    /// The stream ended.
    Ended(Epoch, End),
    /// A user requests a restart of the device.
    Restart,
    /// Time passed; see [`Lifecycle::deadline`].
    Timer,
}

/// How a stream ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// The device is no longer present.
    Gone,
    /// It is present but unreachable until a link is up again; its next start waits for the link.
    LinkDown,
    /// Restarting may help.
    Retry,
    /// Restarting cannot help.
    Fatal,
}

/// Actions that follow an input.
#[derive(Debug, Clone, PartialEq)]
pub struct Effects<A> {
    /// Ask this stream to end; do not wait for it.
    pub stop: Option<Epoch>,
    /// Start a stream.
    pub start: Option<(Epoch, A)>,
}

impl<A> Effects<A> {
    const NONE: Self = Self { stop: None, start: None };
}

/// See the module's comment.
#[derive(Debug, Clone)]
pub struct Lifecycle<A> {
    state: DeviceState,
    epoch: Epoch,
    attached: Option<A>,
    /// When the last removal was first noticed.
    removed: Option<Stamp>,
    /// When [`Input::Timer`] is due.
    deadline: Option<Stamp>,
    /// Restarts within [`RESTART_WINDOW`], oldest first.
    restarts: Vec<Stamp>,
    cooldown: Duration,
}

impl<A: Clone> Lifecycle<A> {
    /// Before a device is attached.
    pub fn new(cooldown: Duration) -> Self {
        Self {
            state: DeviceState::Absent,
            epoch: Epoch(0),
            attached: None,
            removed: None,
            deadline: None,
            restarts: Vec::with_capacity(MAX_RESTARTS),
            cooldown,
        }
    }

    /// The state.
    pub const fn state(&self) -> DeviceState {
        self.state
    }

    /// Incarnation of the newest stream.
    pub const fn epoch(&self) -> Epoch {
        self.epoch
    }

    /// Its bit in the physical mask.
    pub const fn is_present(&self) -> bool {
        self.state.is_present()
    }

    /// What hot-plug reported as attached.
    pub const fn attached(&self) -> Option<&A> {
        self.attached.as_ref()
    }

    /// When [`Input::Timer`] is due, if no other input comes before.
    pub const fn deadline(&self) -> Option<Stamp> {
        self.deadline
    }

    /// Takes one input and returns the resulting actions.
    pub fn apply(&mut self, input: Input<A>, now: Stamp) -> Effects<A> {
        match input {
            Input::Attached(attachment) => self.attach(attachment, now),
            Input::Detached => self.detach(now),
            Input::Started(epoch) if self.is_current(epoch) => {
                self.enter_if(DeviceState::Opening, DeviceState::Streaming)
            }
            Input::Stalled(epoch) if self.is_current(epoch) => {
                self.enter_if(DeviceState::Streaming, DeviceState::Stalled)
            }
            Input::Resumed(epoch) if self.is_current(epoch) => {
                self.enter_if(DeviceState::Stalled, DeviceState::Streaming)
            }
            Input::Ended(epoch, end) if self.is_current(epoch) => self.end(end, now),
            Input::Started(_) | Input::Stalled(_) | Input::Resumed(_) | Input::Ended(..) => Effects::NONE,
            Input::Restart => self.restart_by_hand(now),
            Input::Timer => self.timer(now),
        }
    }

    /// Whether this stream runs now. Reports of any other have no effect.
    pub fn is_current(&self, epoch: Epoch) -> bool {
        self.is_running() && epoch == self.epoch
    }

    const fn is_running(&self) -> bool {
        self.is_present() || matches!(self.state, DeviceState::Opening)
    }

    fn attach(&mut self, attachment: A, now: Stamp) -> Effects<A> {
        // An attachment over one whose removal was never reported replaces it.
        let stop = self.is_running().then_some(self.epoch);
        self.attached = Some(attachment);
        self.restarts.clear();
        let ready = self.removed.map_or(now, |removed| removed.after(self.cooldown));
        if now < ready {
            self.wait_until(ready);
            return Effects { stop, start: None };
        }
        Effects { stop, ..self.start() }
    }

    fn detach(&mut self, now: Stamp) -> Effects<A> {
        let stop = self.is_running().then_some(self.epoch);
        // The stream may have noticed first: the cooldown starts at the first report.
        if self.attached.is_some() && self.state != DeviceState::Absent {
            self.removed = Some(now);
        }
        self.attached = None;
        self.restarts.clear();
        self.enter(DeviceState::Absent);
        Effects { stop, start: None }
    }

    fn end(&mut self, end: End, now: Stamp) -> Effects<A> {
        match end {
            End::Gone => {
                self.removed = Some(now);
                self.enter(DeviceState::Absent);
                let wait = self.backoff(now).map_or(self.cooldown, |backoff| backoff.max(self.cooldown));
                self.deadline = Some(now.after(wait));
            }
            End::Fatal => self.enter(DeviceState::Failed),
            // No restart limit: a cable may be pulled any number of times.
            End::LinkDown => {
                self.restarts.clear();
                self.wait_until(now.after(FIRST_BACKOFF));
            }
            End::Retry => match self.backoff(now) {
                Some(backoff) => {
                    self.restarts.push(now);
                    self.wait_until(now.after(backoff));
                }
                None => self.enter(DeviceState::Failed),
            },
        }
        Effects::NONE
    }

    /// Delay of the next restart; `None` when the restart budget is exhausted.
    fn backoff(&mut self, now: Stamp) -> Option<Duration> {
        self.restarts.retain(|restart| now.since(*restart) < RESTART_WINDOW);
        (self.restarts.len() < MAX_RESTARTS).then(|| FIRST_BACKOFF * (1 << self.restarts.len()))
    }

    fn restart_by_hand(&mut self, now: Stamp) -> Effects<A> {
        if !matches!(self.state, DeviceState::Failed | DeviceState::Backoff) {
            return Effects::NONE;
        }
        self.restarts.clear();
        // The cooldown protects the electronics; a user cannot skip it.
        let ready = self.removed.map_or(now, |removed| removed.after(self.cooldown));
        if now < ready {
            self.wait_until(ready);
            return Effects::NONE;
        }
        self.start()
    }

    fn timer(&mut self, now: Stamp) -> Effects<A> {
        if self.deadline.is_none_or(|deadline| now < deadline) {
            return Effects::NONE;
        }
        self.deadline = None;
        // Its driver reported it gone, yet it is attached.
        if self.state == DeviceState::Absent && self.attached.is_some() {
            if self.backoff(now).is_none() {
                self.enter(DeviceState::Failed);
                return Effects::NONE;
            }
            self.restarts.push(now);
        }
        self.start()
    }

    /// Starts what is attached, if anything is.
    fn start(&mut self) -> Effects<A> {
        let Some(attachment) = self.attached.clone() else { return Effects::NONE };
        self.epoch = self.epoch.next();
        self.enter(DeviceState::Opening);
        Effects { stop: None, start: Some((self.epoch, attachment)) }
    }

    fn wait_until(&mut self, deadline: Stamp) {
        self.enter(DeviceState::Backoff);
        self.deadline = Some(deadline);
    }

    fn enter_if(&mut self, from: DeviceState, to: DeviceState) -> Effects<A> {
        if self.state == from {
            self.enter(to);
        }
        Effects::NONE
    }

    const fn enter(&mut self, state: DeviceState) {
        self.state = state;
        self.deadline = None;
    }
}

#[cfg(test)]
mod tests;
