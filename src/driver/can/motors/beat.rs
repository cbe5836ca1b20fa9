//! Thread `control`: the beat of a bus of motors.
//!
//! A cycle: take what the bus brings until the cycle's deadline, take what was asked for, let
//! [`MotorBus`] decide, send. Deadlines are absolute: a late cycle does not shift those after it, and
//! cycles that were missed are left out.
//!
//! Invariant: between two cycles nothing is allocated, locked or logged; a notice is made of text when
//! something happened.
//! Invariant: however the thread ends, a panic included, [`Powered`] tells every motor to turn off. A
//! process that is killed sends nothing: then the motors' own time limit does it.

use std::fmt;
use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::time::Duration;

use hdrhistogram::Histogram;
use tokio::sync::mpsc;

use crate::action::{ActuatorNotice, Arming, Order};
use crate::control::can::CanFrame;
use crate::control::motors::{BusState, MotorBus, SAMPLE_VALUES};
use crate::driver::DriverError;
use crate::driver::can::link::{Link, LinkError};
use crate::fault;
use crate::realtime::{CONTROL_PRIORITY, use_fifo};
use crate::registry::{DamiaoSpec, MAX_MOTORS};
use crate::time::Stamp;

/// Motors are told to turn off so often, at [`AGAIN`] from one another: a frame may be lost.
const TURN_OFF: usize = 3;
/// See [`TURN_OFF`].
const AGAIN: Duration = Duration::from_millis(5);
/// Frames taken after the deadline of a cycle: a flooded bus must not keep the motors from their commands.
const LATE_FRAMES: usize = 64;
/// Longest time the statistics tell apart, ns.
const LONGEST: u64 = 10_000_000_000;

/// State of all motors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub(super) captured: Stamp,
    /// Samples before this one for which there was no room, and frames the adapter lost.
    pub(super) lost: u64,
    pub(super) values: [f64; MAX_MOTORS * SAMPLE_VALUES],
}

/// An action.
#[derive(Debug, Clone, Copy)]
pub(super) struct Target {
    values: [f64; MAX_MOTORS],
    count: usize,
    tick: Stamp,
}

impl Target {
    /// Of at most [`MAX_MOTORS`] numbers.
    pub(super) fn new(target: &[f64], tick: Stamp) -> Self {
        let mut values = [0.0; MAX_MOTORS];
        for (place, value) in values.iter_mut().zip(target) {
            *place = *value;
        }
        Self { values, count: target.len().min(MAX_MOTORS), tick }
    }
}

/// What is asked of the thread.
#[derive(Debug, Clone, Copy)]
pub(super) enum Request {
    Target(Target),
    Order(Order),
}

/// How well the thread kept its beat.
#[derive(Debug, Clone, PartialEq)]
pub struct Punctuality {
    /// Cycles that were counted.
    pub cycles: u64,
    /// How late they began, ms: the median, all but one in a thousand, all.
    pub late_ms: [f64; 3],
    /// Actions that commands followed.
    pub actions: u64,
    /// From their tick to the first command after it, ms: the median, all but one in a hundred.
    pub wire_ms: [f64; 2],
}

impl fmt::Display for Punctuality {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [p50, p999, max] = self.late_ms;
        write!(f, "{} cycles of thread `control`: late by p50 {p50:.3} p99.9 {p999:.3} max {max:.3} ms", self.cycles)?;
        let [p50, p99] = self.wire_ms;
        match self.actions {
            0 => Ok(()),
            actions => write!(f, "; {actions} actions on the wire p50 {p50:.1} p99 {p99:.1} ms after their tick"),
        }
    }
}

/// How the thread is told to end, and why it ended.
#[derive(Debug, Default)]
pub(super) struct Ending {
    asked: AtomicBool,
    reason: OnceLock<LinkError>,
    pub(super) punctuality: OnceLock<Punctuality>,
}

impl Ending {
    pub(super) fn ask(&self) {
        self.asked.store(true, Ordering::Release);
    }

    /// Why it ended: it gave a reason, or panicked.
    pub(super) fn reason(&self) -> DriverError {
        let panicked = || DriverError::Retry("thread `control` panicked; please report this".to_owned());
        self.reason.get().cloned().map_or_else(panicked, LinkError::into_driver)
    }
}

/// An adapter with motors behind it that may be powered.
#[derive(Debug)]
struct Powered {
    link: Link,
    bus: MotorBus,
}

impl Drop for Powered {
    fn drop(&mut self) {
        let mut frame = CanFrame::default();
        for _ in 0..TURN_OFF {
            for off in self.bus.stop_frames() {
                // A bus that is gone has no motors to stop.
                let _ = self.link.send(&off);
            }
            // Waiting also lets out what the adapter had no room for.
            let until = Stamp::now().after(AGAIN);
            while let Ok(Some(_)) = self.link.recv_until(until, &mut frame) {
                if Stamp::now() >= until {
                    break;
                }
            }
        }
    }
}

/// The thread.
#[derive(Debug)]
pub(super) struct Beat {
    powered: Powered,
    cycle: Duration,
    requests: Receiver<Request>,
    samples: mpsc::Sender<Sample>,
    notices: mpsc::Sender<ActuatorNotice>,
    ending: Arc<Ending>,
    /// Not told yet.
    lost: u64,
    is_bus_off: bool,
    /// An action that no frame was sent after.
    unsent: Option<Stamp>,
    /// How late cycles began, ns.
    lateness: Histogram<u64>,
    /// From the tick of an action to the first command after it, ns.
    latency: Histogram<u64>,
}

impl Beat {
    pub(super) fn new(
        link: Link,
        spec: &DamiaoSpec,
        requests: Receiver<Request>,
        samples: mpsc::Sender<Sample>,
        notices: mpsc::Sender<ActuatorNotice>,
        ending: Arc<Ending>,
    ) -> Self {
        Self {
            powered: Powered { link, bus: MotorBus::new(spec, Stamp::now()) },
            cycle: Duration::from_secs(1) / spec.hz.max(1),
            requests,
            samples,
            notices,
            ending,
            lost: 0,
            is_bus_off: false,
            unsent: None,
            lateness: statistics(),
            latency: statistics(),
        }
    }

    pub(super) fn run(mut self) {
        if let Err(reason) = use_fifo(CONTROL_PRIORITY) {
            tracing::warn!(
                reason,
                "the motors' thread has no real-time priority, so that a busy machine may delay it: run rapid as \
                 rapid.service does, or give the user `rtprio {CONTROL_PRIORITY}` in /etc/security/limits.conf"
            );
        }
        let end = self.beat();
        if let Err(error) = &end {
            let _ = self.ending.reason.set(error.clone());
        }
        let punctuality = self.punctuality();
        tracing::info!("{punctuality}");
        let _ = self.ending.punctuality.set(punctuality);
        // Before the channels close: who sees that they did may exit.
        let Self { powered, samples, notices, .. } = self;
        drop(powered);
        drop((samples, notices));
    }

    fn beat(&mut self) -> Result<(), LinkError> {
        let mut due = Stamp::now().after(self.cycle);
        while !self.ending.asked.load(Ordering::Acquire) {
            fault::point("control");
            self.listen(due)?;
            let now = Stamp::now();
            self.lateness.saturating_record(now.0.saturating_sub(due.0));
            self.take_requests(now);
            self.step(now)?;
            self.tell();
            due = due.after(self.cycle);
            if due <= now {
                // Whole cycles were missed: the grid goes on where it is.
                let missed = now.since(due).as_nanos() / self.cycle.as_nanos().max(1);
                due = due.after(self.cycle * u32::try_from(missed + 1).unwrap_or(1));
            }
        }
        Ok(())
    }

    /// Takes what the bus brings until the cycle ends.
    fn listen(&mut self, due: Stamp) -> Result<(), LinkError> {
        let mut frame = CanFrame::default();
        let mut late = 0;
        while late < LATE_FRAMES {
            match self.powered.link.recv_until(due, &mut frame) {
                Ok(Some(at)) => {
                    self.is_bus_off = false;
                    self.powered.bus.feed(&frame, at);
                    self.sample();
                }
                Ok(None) => break,
                Err(LinkError::BusOff) => self.bus_off(),
                Err(error) => return Err(error),
            }
            if Stamp::now() >= due {
                late += 1;
            }
        }
        self.lost += self.powered.link.take_lost();
        Ok(())
    }

    fn take_requests(&mut self, now: Stamp) {
        let bus = &mut self.powered.bus;
        while let Ok(request) = self.requests.try_recv() {
            match request {
                Request::Order(Order::Arm) => bus.arm(now),
                Request::Order(Order::Disarm) => bus.disarm(now),
                Request::Target(target) => {
                    let values = target.values.get(..target.count).unwrap_or_default();
                    if bus.target(values, target.tick, now) {
                        self.unsent = Some(target.tick);
                    }
                }
            }
        }
    }

    fn step(&mut self, now: Stamp) -> Result<(), LinkError> {
        let Powered { link, bus } = &mut self.powered;
        let mut end = None;
        let mut sent = false;
        bus.step(now, |frame| match link.send(&frame) {
            Ok(()) => sent = true,
            // The motor is not answered for, and is said to be silent if that lasts.
            Err(LinkError::Full | LinkError::BusOff) => {}
            Err(error) => end = Some(error),
        });
        if sent && let Some(tick) = self.unsent.take() {
            self.latency.saturating_record(Stamp::now().0.saturating_sub(tick.0));
        }
        end.map_or(Ok(()), Err)
    }

    /// Passes on the state of all motors, once all have answered.
    fn sample(&mut self) {
        let bus = &mut self.powered.bus;
        let mut values = [0.0; MAX_MOTORS * SAMPLE_VALUES];
        let count = bus.names().len() * SAMPLE_VALUES;
        let Some(captured) = values.get_mut(..count).and_then(|values| bus.sample(values)) else { return };
        match self.samples.try_send(Sample { captured, lost: self.lost, values }) {
            Ok(()) => self.lost = 0,
            Err(_) => self.lost += 1,
        }
    }

    fn bus_off(&mut self) {
        if !std::mem::replace(&mut self.is_bus_off, true) {
            let arming = arming(self.powered.bus.state());
            let notice = ActuatorNotice { arming, text: LinkError::BusOff.to_string(), is_problem: true };
            let _ = self.notices.try_send(notice);
        }
    }

    fn tell(&mut self) {
        let bus = &mut self.powered.bus;
        while let Some(notice) = bus.take_notice() {
            let text = notice.words(bus.names()).to_string();
            let notice = ActuatorNotice { arming: arming(bus.state()), text, is_problem: notice.is_problem() };
            if self.notices.try_send(notice).is_err() {
                break;
            }
        }
    }

    fn punctuality(&self) -> Punctuality {
        let ms = |histogram: &Histogram<u64>, quantile| histogram.value_at_quantile(quantile) as f64 / 1e6;
        Punctuality {
            cycles: self.lateness.len(),
            late_ms: [0.5, 0.999, 1.0].map(|quantile| ms(&self.lateness, quantile)),
            actions: self.latency.len(),
            wire_ms: [0.5, 0.99].map(|quantile| ms(&self.latency, quantile)),
        }
    }
}

fn statistics() -> Histogram<u64> {
    // Its bounds are in range: the highest is more than twice the lowest, the digits at most 5.
    #[expect(clippy::expect_used, reason = "constants, checked by a test")]
    Histogram::new_with_bounds(1, LONGEST, 2).expect("bounds of a histogram")
}

const fn arming(state: BusState) -> Arming {
    match state {
        BusState::Probing | BusState::Disarmed | BusState::Disabling | BusState::Stopped => Arming::Disarmed,
        BusState::Arming => Arming::Arming,
        BusState::Following => Arming::Armed,
        BusState::Holding => Arming::Holding,
        BusState::Faulted(_) => Arming::Faulted,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bounds_of_the_statistics_are_ones() {
        let mut statistics = statistics();
        statistics.saturating_record(u64::MAX);
        assert_eq!(statistics.len(), 1);
    }
}
