//! The clock of a phone: which moment on our clock a time of the phone's is, and how far that may be wrong.
//!
//! A frame of the phone's time `d` arrives here at `a`. Its difference `a - d` is the zero, the difference of the clocks plus
//! the shortest delay on the way, plus what this frame took longer. Only the zero is needed:
//!
//! 1. A smaller difference than the zero predicts is the new zero. If it is smaller by more than the uncertainty, the
//!    samples before it were late by as much, and that is the uncertainty of this moment.
//! 2. A larger difference is delay, however long it lasts: the zero rises only as fast as two clocks may drift apart, and
//!    what it rose by remains in the uncertainty. The rate at which they do drift is learned, and with it the uncertainty
//!    of a zero that was not seen for a while.
//! 3. A time that goes back, or is further ahead than any delay explains, is a bad sample. The phone's clock has begun
//!    again once [`PERSISTS`] of them have come.
//! 4. A sample older than [`OLDEST`] is bad, as one of a program is. Up to that it is late.
//! 5. A new connection keeps the zero, unless it may have moved too far meanwhile.
//! 6. A clock that stood still, as it does while the phone sleeps, is a new one: its distance from the phone's wall clock
//!    grew, and the difference with it.
//!
//! A delay that all frames have in common, and one that rises slower than clocks drift, cannot be seen from one side.
//!
//! Invariant: pure, but for the clocks that are kept between connections.
//! Invariant: a stamp is never later than the arrival.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use rapid_core::capture::OLDEST;
use rapid_core::time::{Stamp, nanoseconds};

use super::packet::Frame;
use crate::driver::ClockOffset;

/// Two clocks drift apart by no more, as a share: crystals are good to 50 millionths each at any temperature.
const DRIFT: f64 = 100e-6;
/// How far a measured rate may change with the temperature.
const WANDER: f64 = 2e-6;
/// Frames that met no delay do so to about this.
const RESOLUTION_NS: f64 = 2e6;
/// The rate is measured over at least this long.
const BASELINE_NS: f64 = 60e9;
/// How long the least difference is looked for before the zero may rise.
const WINDOW: Duration = Duration::from_secs(5);
/// The zero is judged by what the differences vary for this long.
const START: Duration = Duration::from_secs(20);
/// A window has no longer pause.
const PAUSE: Duration = Duration::from_secs(1);
/// No zero is known better.
const FLOOR_NS: f64 = 1e6;
/// A capture time this far ahead of what the shortest delay permits is none.
const LEAP_NS: f64 = 1e9;
/// So many such frames, one after another, are another clock.
const PERSISTS: u32 = 10;
/// The phone's two clocks keep their distance to this, and the zero moves by less during an absence, or is forgotten.
const STEADY_NS: f64 = 10e6;

/// Clocks of phones that are not connected, by entry.
static KEPT: Mutex<BTreeMap<String, PhoneClock>> = Mutex::new(BTreeMap::new());

/// When a frame was captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Captured {
    pub(super) at: Stamp,
    /// Its time cannot be right: `at` is an estimate, by the delay of the one before.
    pub(super) is_damaged: bool,
}

#[derive(Debug, Clone, Default)]
pub(super) struct PhoneClock {
    zero: Option<Zero>,
    /// No good frame of this connection has come.
    is_new: bool,
    /// Bad samples, one after another.
    bad: u32,
    /// The phone's newest time, and its wall clock minus that, ns.
    newest: f64,
    wall: Option<f64>,
    /// When the newest good frame arrived, and how long it had taken.
    last: Stamp,
    delay: Duration,
}

/// The least difference, as it was when it was last seen.
#[derive(Debug, Clone)]
struct Zero {
    ns: i128,
    seen: Stamp,
    /// How fast it changes, and how far that may be wrong.
    rate: f64,
    rate_error: f64,
    /// What it rose by that was perhaps delay, ns.
    risen: f64,
    /// What it may have moved by while it was not seen for long, ns. These are independent, so their squares add up.
    unseen: f64,
    /// How far below it may be after it was seen to fall, in the window before and in this one, ns: a whole window then
    /// shows that it fell no further.
    loose: [f64; 2],
    /// Where its rate is measured from.
    first: (Stamp, i128),
    /// The frame of the window with the least difference: its arrival, difference, and excess over the zero.
    least: Option<(Stamp, i128, f64)>,
    window: Stamp,
    /// When the newest frame arrived.
    newest: Stamp,
    /// Differences so far, and the largest excess among them, while they are few.
    count: u32,
    spread: f64,
    /// What it fell by unexpectedly of late, ns, and when it last did.
    fallen: f64,
    fell: Stamp,
    /// Uncertainty of this moment, ns.
    uncertainty: f64,
}

impl PhoneClock {
    /// The clock of an entry's phone, as it was known when it was last kept.
    pub(super) fn recall(entry: &str) -> Self {
        KEPT.lock().unwrap_or_else(PoisonError::into_inner).remove(entry).unwrap_or_default()
    }

    /// Keeps it for the next connection.
    pub(super) fn keep(&mut self, entry: &str) {
        let clock = std::mem::take(self);
        KEPT.lock().unwrap_or_else(PoisonError::into_inner).insert(entry.to_owned(), clock);
    }

    /// The phone has connected.
    pub(super) fn connected(&mut self) {
        (self.is_new, self.bad) = (true, 0);
    }

    /// How the phone's clock is known, once it is.
    pub(super) fn offset(&self) -> Option<ClockOffset> {
        let zero = self.zero.as_ref()?;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
        let uncertainty_ns = zero.uncertainty as u64;
        Some(ClockOffset { offset_ns: i64::try_from(-zero.ns).unwrap_or(i64::MAX), uncertainty_ns })
    }

    /// When a frame that `arrived` was captured.
    pub(super) fn captured(&mut self, frame: &Frame, arrived: Stamp) -> Captured {
        let bad = Captured { at: arrived.before(self.delay), is_damaged: true };
        // Beyond 100 years it is not a clock.
        if !(0.0..3.2e9).contains(&frame.device_time) {
            return bad;
        }
        let device = frame.device_time * 1e9;
        let wall = Some(frame.wall_clock * 1e9 - device).filter(|wall| wall.is_finite());
        #[expect(clippy::cast_possible_truncation, reason = "within the range just checked")]
        let (device_ns, difference) = (device as i128, i128::from(arrived.0) - device as i128);
        if let Some(zero) = &self.zero {
            let excess = zero.excess(difference, arrived);
            let is_odd = device < self.newest || excess < -LEAP_NS;
            self.bad = if is_odd { self.bad + 1 } else { 0 };
            if is_odd && self.bad < PERSISTS {
                return bad;
            }
            let moved = wall.zip(self.wall).map(|(now, before)| now - before);
            // It stood still: all of that is in the difference too. Otherwise only the wall clock was set.
            let stood_still = moved.is_some_and(|moved| moved > STEADY_NS && excess > moved / 2.0);
            let away = zero.rate_error * nanoseconds(arrived.since(self.last)) as f64;
            let is_other = stood_still || self.is_new && (moved.is_none() || away > STEADY_NS);
            if is_odd || is_other {
                (self.zero, self.bad) = (None, 0);
            }
        }
        (self.newest, self.wall, self.last, self.is_new) = (device, wall, arrived, false);
        let zero = self.zero.get_or_insert_with(|| Zero::new(difference, arrived));
        zero.see(difference, arrived);
        let at = Stamp(u64::try_from(device_ns + zero.at(arrived)).unwrap_or(0)).min(arrived);
        let delay = arrived.since(at);
        if delay > OLDEST {
            return bad;
        }
        self.delay = delay;
        Captured { at, is_damaged: false }
    }
}

impl Zero {
    const fn new(ns: i128, now: Stamp) -> Self {
        Self {
            ns,
            seen: now,
            rate: 0.0,
            rate_error: DRIFT,
            risen: 0.0,
            unseen: 0.0,
            loose: [0.0; 2],
            first: (now, ns),
            least: None,
            window: now,
            newest: now,
            count: 0,
            spread: 0.0,
            fallen: 0.0,
            fell: now,
            uncertainty: FLOOR_NS,
        }
    }

    /// What it is at a later moment.
    fn at(&self, now: Stamp) -> i128 {
        #[expect(clippy::cast_possible_truncation, reason = "a small share of a time")]
        let change = (self.rate * nanoseconds(now.since(self.seen)) as f64) as i128;
        self.ns + change
    }

    fn excess(&self, difference: i128, now: Stamp) -> f64 {
        (difference - self.at(now)) as f64
    }

    /// How far it may have moved since it was seen.
    fn moved(&self, now: Stamp) -> f64 {
        self.rate_error * nanoseconds(now.since(self.seen)) as f64
    }

    fn uncertainty_at(&self, now: Stamp) -> f64 {
        FLOOR_NS + self.risen + self.unseen + self.loose.iter().sum::<f64>() + self.moved(now)
    }

    /// Takes the difference of a frame.
    fn see(&mut self, difference: i128, now: Stamp) {
        let excess = self.excess(difference, now);
        self.uncertainty = self.uncertainty_at(now);
        if now.since(self.first.0) < START {
            // The least of few is not the least of many.
            self.count = self.count.saturating_add(1);
            self.spread = self.spread.max(excess);
            self.uncertainty += 2.0 * self.spread / f64::from(self.count);
        }
        if now.since(std::mem::replace(&mut self.newest, now)) > PAUSE {
            (self.window, self.least) = (now, None);
        }
        if excess <= 0.0 {
            let fall = -excess;
            let is_known = fall <= self.uncertainty_at(now);
            self.touch(now, difference);
            let [before, within] = self.loose;
            self.loose = [(before - fall).max(0.0), (within - (fall - before).max(0.0)).max(0.0)];
            self.unseen = (self.unseen - (fall - self.risen).max(0.0)).max(0.0);
            self.risen = (self.risen - fall).max(0.0);
            if !is_known {
                // A queue on the way empties frame by frame.
                self.fallen = if now.since(self.fell) < WINDOW { self.fallen + fall } else { fall };
                self.fell = now;
                self.uncertainty = self.uncertainty.max(self.fallen);
                (self.first, self.rate, self.rate_error) = ((now, difference), 0.0, DRIFT);
                (self.count, self.spread) = (1, fall);
            }
        } else if self.least.is_none_or(|(.., least)| excess < least) {
            self.least = Some((now, difference, excess));
        }
        if now.since(self.window) >= WINDOW {
            self.rise();
            // Without a frame at the zero, it has shown nothing.
            let [before, within] = self.loose;
            self.loose = if self.seen >= self.window { [within, 0.0] } else { [before + within, 0.0] };
            self.window = now;
        }
    }

    /// Rises to the least difference of the window, if that may be the drift of the clocks.
    fn rise(&mut self) {
        let Some((at, difference, excess)) = self.least.take() else { return };
        if at > self.seen && excess <= self.moved(at) {
            self.touch(at, difference);
            self.risen += excess;
        }
    }

    /// It was seen. How far it had moved is still not known: soon, if it was seen shortly before, and never otherwise.
    fn touch(&mut self, now: Stamp, difference: i128) {
        let moved = self.moved(now);
        if now.since(self.seen) <= 2 * WINDOW {
            self.loose[1] += moved;
        } else {
            self.unseen = self.unseen.hypot(moved);
        }
        (self.ns, self.seen) = (difference, now);
        let baseline = nanoseconds(now.since(self.first.0)) as f64;
        if baseline >= BASELINE_NS {
            self.rate = ((difference - self.first.1) as f64 / baseline).clamp(-DRIFT, DRIFT);
            self.rate_error = (2.0 * RESOLUTION_NS / baseline + WANDER).min(DRIFT);
        }
    }
}

#[cfg(test)]
mod tests;
