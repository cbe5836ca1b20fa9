//! What an axis may be commanded: a range, and how fast the command may change.
//!
//! Invariant: a target that is not a finite number is refused; one beyond the range is clamped and counted.
//! Invariant: a commanded position changes by at most the slew limit times the time that passed, whatever a motor reports.

use std::time::Duration;

use super::damiao::codec::KP_MAX;

/// Limits of one axis, and what they did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    low: f64,
    high: f64,
    slew: f64,
    clamped: u64,
}

/// A target within the limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clamped {
    /// The target, clamped to the range.
    pub value: f64,
    /// The target was beyond the range.
    pub is_beyond: bool,
}

impl Limits {
    /// A range, the lower end first, and the change per second. Ends in the wrong order or NaN allow only 0; a negative
    /// or NaN slew allows no change.
    pub fn new(low: f64, high: f64, slew: f64) -> Self {
        let mut limits = Self { low: 0.0, high: 0.0, slew: slew.max(0.0), clamped: 0 };
        limits.set_range(low, high);
        limits
    }

    /// Sets another range, as in [`Self::new`]; counts are kept.
    pub fn set_range(&mut self, low: f64, high: f64) {
        (self.low, self.high) = if low <= high { (low, high) } else { (0.0, 0.0) };
    }

    /// The range.
    pub const fn range(&self) -> [f64; 2] {
        [self.low, self.high]
    }

    /// Targets that were beyond the range.
    pub const fn clamped(&self) -> u64 {
        self.clamped
    }

    /// A target, clamped to the range; `None` if it is infinite or NaN.
    pub fn clamp(&mut self, target: f64) -> Option<Clamped> {
        let value = target.is_finite().then(|| target.clamp(self.low, self.high))?;
        let is_beyond = !(self.low..=self.high).contains(&target);
        self.clamped += u64::from(is_beyond);
        Some(Clamped { value, is_beyond })
    }

    /// Moves the previous command towards `wanted` as far as the elapsed time allows. A command beyond the range stays
    /// or comes back.
    pub fn slew(&self, before: f64, wanted: f64, passed: Duration) -> f64 {
        let most = self.slew * passed.as_secs_f64();
        let change = wanted - before;
        // `wanted` itself where it is in reach: no rounding keeps the command from arriving.
        let next = if change.abs() <= most { wanted } else { before + most.copysign(change) };
        next.clamp(self.low.min(before), self.high.max(before))
    }

    /// Bounds a commanded velocity so that the joint can come to rest at the ends of `positions`, braking at the slew
    /// limit. Beyond an end it may only go back.
    pub fn brake(&self, velocity: f64, position: f64, positions: [f64; 2]) -> f64 {
        let [low, high] = positions;
        let speed = |distance: f64| (2.0 * self.slew * distance.max(0.0)).sqrt();
        velocity.min(speed(high - position)).max(-speed(position - low))
    }
}

/// The position nearest to `command` at which a stiffness of `kp` (Nm/rad) requests no more than `torque` (Nm), with
/// the joint at `measured`.
pub fn within_torque(command: f64, measured: f64, torque: f64, kp: f64) -> f64 {
    let reach = torque / kp;
    // Zero stiffness requests no torque.
    if !reach.is_finite() || reach < 0.0 || !measured.is_finite() {
        return command;
    }
    command.clamp(measured - reach, measured + reach)
}

/// The stiffness, `kp` (Nm/rad) at most, with which a position error (rad) requests no more than `torque` (Nm), even
/// after a frame rounds it to 12 bits.
pub fn stiffness(kp: f64, error: f64, torque: f64) -> f64 {
    // Zero error requests no torque: the quotient is infinite.
    let most = torque / error.abs() - KP_MAX / 4095.0 / 2.0;
    kp.min(most.max(0.0))
}

#[cfg(test)]
mod tests;
