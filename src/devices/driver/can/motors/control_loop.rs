//! Thread `control`: the cycles of a bus of motors.
//!
//! A cycle: receive frames until the deadline of the cycle, take orders and the newest action, let [`MotorBus`] decide,
//! send. [`Pace`] decides when a cycle begins. The thread waits for the bus, for orders and for the topic of actions at
//! once: an order that stops the motors begins a cycle at its arrival, a fresh action begins one as soon as the bus has
//! room for it, usually at its arrival too.
//!
//! Invariant: between two cycles nothing is allocated, locked or logged, with two exceptions: notices are formatted as
//! text, and a sample goes through tokio's channel, which allocates blocks for some dozens when none is free and wakes
//! its reader under a lock of the runtime.
//! Invariant: however the thread ends, a panic included, [`Powered`] orders every motor to turn off. Without a
//! panic it also waits until each that was on has confirmed that it is off, for a tenth of a second at most. A process
//! that is killed sends nothing: then its guard does it.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rapid_core::action::{ActionSource, ActuatorNotice, Arming, MAX_ACTION, Order, OrderSlot};
use rapid_core::permission::Attended;
use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::motors::{BusState, SAMPLE_VALUES};
use rapid_motors::control::pace::Pace;
use rapid_registry::{DamiaoSpec, MAX_MOTORS};
use rapid_system::fault;
use rapid_system::realtime::{CONTROL_PRIORITY, lock_memory, use_fifo};
use tokio::sync::mpsc;

use super::powered::Powered;
use super::statistics::{LoopStatistics, Punctuality};
use crate::driver::DriverError;
use crate::driver::can::outcome::LinkError;

/// Frames taken after the deadline of a cycle: a flooded bus must not keep the motors from their commands.
const LATE_FRAMES: usize = 64;
/// A problem of the bus is reported again after this long without one.
const QUIET: Duration = Duration::from_secs(1);
/// Problems that may wait to be reported.
const TROUBLES: usize = 4;

/// State of all motors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub(super) captured: Stamp,
    /// The kernel stamped all of its frames.
    pub(super) from_kernel: bool,
    /// Samples before this one for which there was no room.
    pub(super) lost: u64,
    pub(super) values: [f64; MAX_MOTORS * SAMPLE_VALUES],
}

/// Shared by the thread and its owner: its orders, and why it ended.
#[derive(Debug, Default)]
pub(super) struct Shared {
    asked: AtomicBool,
    pub(super) orders: OrderSlot,
    /// Orders that the thread takes directly from where they were given.
    pub(super) attended: OnceLock<Arc<Attended>>,
    pub(super) actions: OnceLock<Arc<dyn ActionSource>>,
    reason: OnceLock<LinkError>,
    pub(super) punctuality: OnceLock<Punctuality>,
}

impl Shared {
    /// Asks it to end.
    pub(super) fn ask(&self) {
        self.asked.store(true, Ordering::Release);
        self.orders.bell().ring();
    }

    /// It gave a reason to end.
    pub(super) fn has_ended(&self) -> bool {
        self.reason.get().is_some()
    }

    /// Why it ended: it gave a reason, or panicked.
    pub(super) fn reason(&self) -> DriverError {
        let panicked = || DriverError::Retry("thread `control` panicked; please report this".to_owned());
        self.reason.get().cloned().map_or_else(panicked, LinkError::into_driver)
    }
}

/// A condition that lasts, and is reported when it begins.
#[derive(Debug, Default)]
struct Spell(Option<Stamp>);

impl Spell {
    /// The condition holds at `now`. Returns whether it has just begun.
    fn continues(&mut self, now: Stamp) -> bool {
        self.0.replace(now).is_none_or(|last| now.since(last) >= QUIET)
    }
}

/// The thread.
#[derive(Debug)]
pub(super) struct ControlLoop {
    powered: Powered,
    cycle: Duration,
    samples: mpsc::Sender<Sample>,
    notices: mpsc::Sender<ActuatorNotice>,
    shared: Arc<Shared>,
    /// Samples for which there was no room, not reported yet.
    lost: u64,
    /// The kernel stamped all frames since the last sample.
    from_kernel: bool,
    is_bus_off: bool,
    full: Spell,
    losing: Spell,
    strange: Spell,
    /// Problems of the bus that are not reported yet.
    troubles: VecDeque<String>,
    /// An action after which no frame was sent yet.
    unsent: Option<Stamp>,
    statistics: LoopStatistics,
}

impl ControlLoop {
    pub(super) fn new(
        powered: Powered,
        spec: &DamiaoSpec,
        samples: mpsc::Sender<Sample>,
        notices: mpsc::Sender<ActuatorNotice>,
        shared: Arc<Shared>,
    ) -> Self {
        Self {
            powered,
            cycle: Duration::from_secs(1) / spec.hz.max(1),
            samples,
            notices,
            shared,
            lost: 0,
            from_kernel: true,
            is_bus_off: false,
            full: Spell::default(),
            losing: Spell::default(),
            strange: Spell::default(),
            troubles: VecDeque::with_capacity(TROUBLES),
            unsent: None,
            statistics: LoopStatistics::new(),
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
        if let Err(reason) = lock_memory() {
            tracing::info!(
                reason,
                "the motors' thread may have to wait for memory that is on the disk: run rapid as rapid.service does, or \
                 give the user `memlock unlimited` in /etc/security/limits.conf"
            );
        }
        let end = self.run_cycles();
        if let Err(error) = &end {
            let _ = self.shared.reason.set(error.clone());
        }
        // Notices of the last cycle.
        self.notify();
        let Self { powered, samples, notices, statistics, shared, .. } = self;
        let counts = powered.bus.counts();
        // Before the log, which may block, and before the channels close, after which the process may exit.
        drop(powered);
        let punctuality = statistics.punctuality();
        tracing::info!("{punctuality}");
        if let Some(mishaps) = statistics.mishaps(&counts) {
            tracing::info!("of thread `control`: {mishaps}");
        }
        let _ = shared.punctuality.set(punctuality);
        drop((samples, notices));
    }

    fn run_cycles(&mut self) -> Result<(), LinkError> {
        let mut pace = Pace::new(self.cycle, Stamp::now());
        // There is an action that no cycle has seen.
        let mut is_fresh = false;
        while !self.shared.asked.load(Ordering::Acquire) {
            fault::point("control");
            let until = if is_fresh { pace.earliest() } else { pace.due() };
            self.listen(until)?;
            // An order that came with the request to end is for the stream that follows.
            if self.shared.asked.load(Ordering::Acquire) {
                break;
            }
            let now = Stamp::now();
            let is_urgent = self.take_orders(now);
            is_fresh |= self.take_action(now);
            let is_early = now < pace.due();
            if is_early && !is_urgent && !(is_fresh && now >= pace.earliest()) {
                continue;
            }
            if is_early {
                self.statistics.early += 1;
            } else {
                self.statistics.late(now.since(pace.due()));
            }
            self.step(now)?;
            self.notify();
            pace.begin(now);
            is_fresh = false;
        }
        Ok(())
    }

    /// Receives frames until the cycle ends, an order is given or an action published.
    fn listen(&mut self, until: Stamp) -> Result<(), LinkError> {
        let mut frame = CanFrame::default();
        let mut late = 0;
        while late < LATE_FRAMES {
            let (attended, actions) = (self.shared.attended.get(), self.shared.actions.get());
            let bells = [
                self.shared.orders.bell().descriptor(),
                attended.and_then(|attended| attended.bell().descriptor()),
                actions.and_then(|actions| actions.bell()),
            ];
            match self.powered.link.recv_unless_rung(until, &mut frame, bells) {
                Ok(Some(arrival)) => {
                    self.is_bus_off = false;
                    self.from_kernel &= arrival.from_kernel;
                    self.powered.bus.look_for_stall(Stamp::now());
                    self.powered.bus.feed(&frame, arrival.at);
                    self.sample();
                }
                Ok(None) => break,
                Err(LinkError::BusOff) => self.bus_off()?,
                Err(error) => return Err(error),
            }
            if Stamp::now() >= until {
                late += 1;
            }
        }
        let link = &mut self.powered.link;
        self.statistics.unsent += link.take_refused();
        let lost = link.take_lost();
        self.statistics.lost_frames += lost;
        if lost > 0 && self.losing.continues(Stamp::now()) {
            self.complain("frames of the bus are lost before they can be read".to_owned());
        }
        Ok(())
    }

    /// Carries out orders. Returns whether one of them stops the motors, which is urgent.
    fn take_orders(&mut self, now: Stamp) -> bool {
        let bus = &mut self.powered.bus;
        let before = bus.state();
        let mut is_stop = false;
        let attended = self.shared.attended.get().map(|attended| attended.take_pending());
        for order in self.shared.orders.take_pending().chain(attended.into_iter().flatten()) {
            is_stop |= matches!(order, Order::Disarm | Order::Emergency(_));
            match order {
                Order::Arm => bus.arm(now),
                Order::ArmBack => bus.arm_back(now),
                Order::Disarm => bus.disarm(now),
                Order::Emergency(trip) => bus.emergency(trip, now),
            }
        }
        // Repeating it has no further effect.
        is_stop && bus.state() != before
    }

    /// Takes the newest action. Returns whether the motors follow it.
    fn take_action(&mut self, now: Stamp) -> bool {
        let Some(actions) = self.shared.actions.get() else { return false };
        let mut action = [0.0; MAX_ACTION];
        match actions.newest(&mut action) {
            Ok(None) => false,
            Ok(Some((target, tick))) => {
                let is_followed = self.powered.bus.target(target, tick, now);
                if is_followed {
                    self.unsent = Some(tick);
                }
                is_followed
            }
            Err(refused) => {
                if self.strange.continues(now) {
                    self.complain(refused.to_string());
                }
                false
            }
        }
    }

    fn step(&mut self, now: Stamp) -> Result<(), LinkError> {
        let Powered { link, bus, brakes, guard, .. } = &mut self.powered;
        if let Some(brakes) = brakes {
            bus.feed_brakes(brakes.state(now), now);
        }
        let mut end = None;
        let (mut sent, mut full) = (false, 0);
        bus.step(now, |frame| match link.send(&frame) {
            Ok(()) => sent = true,
            // The motor counts as not having answered, and is reported as silent if that lasts.
            Err(LinkError::Full | LinkError::BusOff) => full += 1,
            Err(error) => end = Some(error),
        });
        if let Some(brakes) = brakes {
            brakes.release(bus.releases());
        }
        let trouble = guard.as_mut().and_then(|guard| guard.cycle(bus));
        if sent && let Some(tick) = self.unsent.take() {
            self.statistics.on_the_wire(Stamp::now().0.saturating_sub(tick.0));
        }
        self.statistics.full += full;
        if full > 0 && self.full.continues(now) {
            self.complain(LinkError::Full.to_string());
        }
        if let Some(trouble) = trouble {
            self.complain(format!(
                "the guard of the motors {trouble}: if rapid is killed, they stop by their own time limit alone"
            ));
        }
        end.map_or(Ok(()), Err)
    }

    /// Passes on the state of all motors, once all have answered.
    fn sample(&mut self) {
        let bus = &mut self.powered.bus;
        let mut values = [0.0; MAX_MOTORS * SAMPLE_VALUES];
        let count = bus.names().len() * SAMPLE_VALUES;
        let Some(captured) = values.get_mut(..count).and_then(|values| bus.sample(values)) else { return };
        let from_kernel = std::mem::replace(&mut self.from_kernel, true);
        if self.samples.try_send(Sample { captured, from_kernel, lost: self.lost, values }).is_ok() {
            self.lost = 0;
        } else {
            self.lost += 1;
            self.statistics.lost_samples += 1;
        }
    }

    /// The adapter left the bus. If it does not return by itself it must be opened again.
    fn bus_off(&mut self) -> Result<(), LinkError> {
        if !std::mem::replace(&mut self.is_bus_off, true) {
            self.complain(LinkError::BusOff.to_string());
        }
        if self.powered.link.restarts() { Ok(()) } else { Err(LinkError::BusOff) }
    }

    fn complain(&mut self, text: String) {
        if self.troubles.len() < TROUBLES {
            self.troubles.push_back(text);
        }
    }

    /// Reports what happened, as far as there is room; the rest waits.
    fn notify(&mut self) {
        let bus = &mut self.powered.bus;
        while let Ok(place) = self.notices.try_reserve() {
            let (text, is_problem) = if let Some(text) = self.troubles.pop_front() {
                (text, true)
            } else if let Some(notice) = bus.take_notice() {
                let stops = self.shared.attended.get().map_or(&[][..], |attended| attended.stops());
                (notice.words(bus.names()).with_stops(stops).to_string(), notice.is_problem())
            } else {
                return;
            };
            place.send(ActuatorNotice { arming: arming(bus.state()), text, is_problem });
        }
    }
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
