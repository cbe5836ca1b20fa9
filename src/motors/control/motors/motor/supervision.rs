//! Are the reports of a motor possible, is it too hot, and does it follow its command?
//!
//! A problem is first a notice and, if it lasts, a fault: a frame may be damaged, a joint may be pushed for a moment.
//!
//! Invariant: a position that a motor cannot have reached is ignored.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::{MotorMode, MotorSpec};

use super::axis::Commanded;
use super::joint::Joint;
use crate::control::damiao::codec::{Feedback, Ranges};
use crate::control::motors::fault::{Fault, Part, Strange};
use crate::control::motors::notice::Notice;
use crate::control::motors::notices::Notices;

/// Consecutive frames with an impossible position that make a fault: a single one may be damaged.
const JUMPS: u32 = 3;
/// Additional tolerance of a position, in steps of its 16 bits.
const STEPS: f64 = 2.0;
/// The time between two frames may exceed that between their arrivals by this much: adapters deliver several at once.
const JITTER: Duration = Duration::from_millis(20);
/// A limit of speed or torque may be exceeded by this share: measurements are noisy, and motors overshoot.
const SHARE: f64 = 0.25;
/// Accuracy of a speed, a few steps of 12 bits, rad/s.
const SLOW: f64 = 0.5;
/// A joint below this speed stands still, rad/s.
const STILL: f64 = 0.05;
/// How long a joint may be outside its limits, three frames at least at 200 Hz...
const BEYOND_AFTER: Duration = Duration::from_millis(20);
/// ...or exceed its speed or torque...
const EXCEED_AFTER: Duration = Duration::from_millis(100);
/// ...or be driven away from its command against the full torque limit...
const DRIVEN_AFTER: Duration = Duration::from_millis(200);
/// ...or lag behind the command of its own loop...
const LAG_AFTER: Duration = Duration::from_millis(500);
/// ...or report a speed and stand still, before there is a notice: a position may be read twice...
const FROZEN_WORD: Duration = Duration::from_millis(30);
/// ...and until a fault after that.
const FROZEN_AFTER: Duration = Duration::from_millis(70);
/// How long a joint may stand still at the full torque limit before there is a notice: a joint that starts or reverses
/// is slow for a moment.
const BLOCKED_WORD: Duration = Duration::from_millis(40);
/// This many consecutive cycles without the condition end a spell: in the cycle of a new action, and with measurement
/// noise, a joint at its highest torque may seem to have less.
const ABSENT: u8 = 2;
/// A notice is not repeated within this, even if its condition ended and returned.
const AGAIN: Duration = Duration::from_secs(1);
/// A motor counts as warm from this many °C below its limit...
const WARM: f64 = 10.0;
/// ...until it has cooled by this much.
const COOLER: f64 = 5.0;

/// How long a condition has held.
#[derive(Debug, Clone, Copy, Default)]
struct Spell {
    since: Option<Stamp>,
    /// Consecutive cycles without the condition.
    absent: u8,
    /// When it was last reported.
    reported: Option<Stamp>,
}

impl Spell {
    /// The condition holds at `now`, or not. Reports it once it has lasted for `word`; returns it once it has lasted
    /// for `limit`.
    fn update(
        &mut self,
        strange: Option<Strange>,
        now: Stamp,
        [word, limit]: [Duration; 2],
        notify: &mut dyn FnMut(Strange),
    ) -> Option<Strange> {
        let Some(strange) = strange else {
            self.absent = self.absent.saturating_add(1);
            if self.absent >= ABSENT {
                self.since = None;
            }
            return None;
        };
        self.absent = 0;
        let since = *self.since.get_or_insert(now);
        let lasted = now.since(since);
        // Once for all the time that it lasts, too.
        let is_news = self.reported.is_none_or(|last| last < since && now.since(last) >= AGAIN);
        if lasted >= word && is_news {
            self.reported = Some(now);
            notify(strange);
        }
        (lasted >= limit).then_some(strange)
    }
}

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Supervision {
    /// When its newest frame arrived.
    received: Option<Stamp>,
    jumps: u32,
    still: Option<Still>,
    spells: [Spell; 7],
    /// That its transistors, and its winding, are close to their limits was reported.
    warm: [bool; 2],
}

/// Frames that all report a speed in one direction, and one position.
#[derive(Debug, Clone, Copy)]
struct Still {
    since: Stamp,
    newest: Stamp,
    position: f64,
    speed: f64,
}

impl Supervision {
    /// Forgets everything, when the motor is turned off.
    pub(super) fn reset(&mut self) {
        *self = Self { received: self.received, warm: self.warm, ..Self::default() };
    }

    /// A frame arrived at `now`, after one with the feedback `before` if the motor has been on since. Can the motor have
    /// reached its position?
    ///
    /// # Errors
    /// When it is the last of several impossible positions.
    pub(super) fn receive(
        &mut self,
        before: Option<&Feedback>,
        feedback: &Feedback,
        (joint, ranges): (&Joint, &Ranges),
        now: Stamp,
        notices: &mut Notices,
    ) -> Result<bool, Fault> {
        let motor = joint.index;
        let last = self.received.replace(now);
        let step = 2.0 * ranges.position() / f64::from(u16::MAX);
        self.compare_speed(feedback, step, now);
        let (Some(before), Some(last)) = (before, last) else { return Ok(true) };
        if is_near(before, feedback, (&joint.spec, ranges), now.since(last)) {
            self.jumps = 0;
            return Ok(true);
        }
        let what = Strange::Jump { from: before.q, to: feedback.q };
        self.jumps += 1;
        match self.jumps {
            1 => notices.notify(Notice::Strange { motor, what }),
            JUMPS.. => return Err(Fault::Strange { motor, what }),
            _ => {}
        }
        Ok(false)
    }

    /// Reports a motor that comes close to a limit of its temperature.
    pub(super) fn feel(&mut self, joint: &Joint, feedback: &Feedback, notices: &mut Notices) {
        for (warm, (part, celsius, limit)) in self.warm.iter_mut().zip(temperatures(&joint.spec, feedback)) {
            if celsius >= limit - WARM && !*warm {
                *warm = true;
                notices.notify(Notice::Warm { motor: joint.index, part, celsius, limit });
            } else if celsius < limit - WARM - COOLER {
                *warm = false;
            }
        }
    }

    /// Does the position change according to the speed?
    fn compare_speed(&mut self, feedback: &Feedback, step: f64, now: Stamp) {
        let Feedback { q, dq, .. } = *feedback;
        let is_still = |still: &Still| (q - still.position).abs() <= STEPS * step && still.speed * dq > 0.0;
        self.still = if dq.abs() <= SLOW {
            None
        } else {
            let begun = Still { since: now, newest: now, position: q, speed: dq };
            Some(self.still.filter(is_still).map_or(begun, |still| Still { newest: now, ..still }))
        };
    }

    /// Is its encoder frozen, by frames over this long?
    fn frozen(&self) -> Option<(Strange, Duration)> {
        let still = self.still?;
        let what = Strange::Frozen { position: still.position, velocity: still.speed };
        Some((what, still.newest.since(still.since)))
    }

    /// The problem of a motor that is on, once it has lasted long enough to be a fault.
    pub(super) fn check(
        &mut self,
        joint: &Joint,
        feedback: &Feedback,
        commanded: Commanded,
        now: Stamp,
        notices: &mut Notices,
    ) -> Option<Fault> {
        let (motor, spec) = (joint.index, &joint.spec);
        let mut notify = |what| notices.notify(Notice::Strange { motor, what });
        let at_once = Duration::ZERO;
        let never = Duration::MAX;
        // Time passes without a frame.
        let frozen = self.frozen().filter(|(_, lasted)| *lasted >= FROZEN_WORD).map(|(what, _)| what);
        let table = [
            (frozen, [at_once, FROZEN_AFTER]),
            (beyond(spec, feedback).filter(|_| !commanded.is_returning), [at_once, BEYOND_AFTER]),
            (fast(spec, feedback), [at_once, EXCEED_AFTER]),
            (strong(spec, feedback), [at_once, EXCEED_AFTER]),
            (driven(spec, feedback, commanded), [at_once, DRIVEN_AFTER]),
            (blocked(spec, feedback, commanded), [BLOCKED_WORD, spec.watch.blocked_after.unwrap_or(never)]),
            (lagging(spec, feedback, commanded), [at_once, LAG_AFTER]),
        ];
        let looks = self.spells.iter_mut().zip(table);
        let lasting = looks.map(|(spell, (strange, limits))| spell.update(strange, now, limits, &mut notify));
        // Every condition is updated, even after one that lasts.
        lasting.fold(None, Option::or).map(|what| Fault::Strange { motor, what })
    }
}

/// Is it hotter than it may be?
pub(super) fn hot(joint: &Joint, feedback: &Feedback) -> Option<Fault> {
    let motor = joint.index;
    let hot = |(part, celsius, limit)| (celsius >= limit).then_some(Fault::Hot { motor, part, celsius, limit });
    temperatures(&joint.spec, feedback).into_iter().find_map(hot)
}

fn temperatures(spec: &MotorSpec, feedback: &Feedback) -> [(Part, f64, f64); 2] {
    [(Part::Mos, f64::from(feedback.mos), spec.max_mos), (Part::Rotor, f64::from(feedback.rotor), spec.max_rotor)]
}

/// Is it too far outside its limits, or too fast, to be armed? One that is to return may be outside.
pub(super) fn unfit(joint: &Joint, feedback: &Feedback, is_returning: bool) -> Option<Fault> {
    let spec = &joint.spec;
    let what = beyond(spec, feedback).filter(|_| !is_returning).or_else(|| fast(spec, feedback))?;
    Some(Fault::Strange { motor: joint.index, what })
}

/// Is it outside its limits?
pub(super) fn beyond(spec: &MotorSpec, feedback: &Feedback) -> Option<Strange> {
    let [low, high] = spec.position;
    let outside = (low - feedback.q).max(feedback.q - high);
    (outside > spec.watch.margin).then_some(Strange::Beyond { position: feedback.q, range: spec.position })
}

/// Can it have moved from there to here in the elapsed time?
pub(super) fn is_near(
    before: &Feedback,
    feedback: &Feedback,
    (spec, ranges): (&MotorSpec, &Ranges),
    passed: Duration,
) -> bool {
    let step = 2.0 * ranges.position() / f64::from(u16::MAX);
    // At its last speed, or somewhat above its limit; exceeding the limit is a fault of its own.
    let fastest = (before.dq.abs() + too_fast(spec)).min(ranges.velocity());
    (feedback.q - before.q).abs() <= fastest * (passed + JITTER).as_secs_f64() + STEPS * step
}

fn too_fast(spec: &MotorSpec) -> f64 {
    spec.velocity * (1.0 + SHARE) + SLOW
}

fn fast(spec: &MotorSpec, feedback: &Feedback) -> Option<Strange> {
    let is_fast = feedback.dq.abs() > too_fast(spec);
    is_fast.then_some(Strange::Fast { velocity: feedback.dq, limit: spec.velocity })
}

/// The limit bounds the torque of the stiffness; damping adds as much as the highest speed causes. Frames of the
/// motor's own loops have no torque: the motor bounds it.
fn strong(spec: &MotorSpec, feedback: &Feedback) -> Option<Strange> {
    let MotorMode::Mit { kd, .. } = spec.mode else { return None };
    let limit = spec.torque;
    let is_strong = feedback.tau.abs() > limit * (1.0 + SHARE) + kd * too_fast(spec);
    is_strong.then_some(Strange::Strong { torque: feedback.tau, limit })
}

/// How fast a joint at its torque bound moves towards its command, rad/s.
fn approach(spec: &MotorSpec, feedback: &Feedback, commanded: Commanded) -> Option<f64> {
    let MotorMode::Mit { kp, .. } = spec.mode else { return None };
    let error = commanded.wanted - feedback.q;
    (error.abs() * kp > spec.torque).then_some(feedback.dq * error.signum())
}

fn driven(spec: &MotorSpec, feedback: &Feedback, commanded: Commanded) -> Option<Strange> {
    let speed = approach(spec, feedback, commanded)?;
    (speed < -STILL).then_some(Strange::Driven { torque: spec.torque })
}

fn blocked(spec: &MotorSpec, feedback: &Feedback, commanded: Commanded) -> Option<Strange> {
    let speed = approach(spec, feedback, commanded)?;
    (speed.abs() <= STILL).then_some(Strange::Blocked { torque: spec.torque })
}

fn lagging(spec: &MotorSpec, feedback: &Feedback, commanded: Commanded) -> Option<Strange> {
    let (is, limit) = match spec.mode {
        MotorMode::Mit { .. } => return None,
        MotorMode::PositionVelocity => (feedback.q, spec.watch.lag),
        MotorMode::Velocity => (feedback.dq, SHARE * spec.velocity + SLOW),
    };
    ((commanded.command - is).abs() > limit).then_some(Strange::Lagging { command: commanded.command, is })
}
