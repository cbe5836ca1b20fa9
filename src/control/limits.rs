//! What an axis may be commanded: a range, and how fast the command may change.
//!
//! Invariant: what is no finite number is refused; what lies beyond the range is its end, and counted.
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
    /// It, or the end of the range that is nearest to it.
    pub value: f64,
    /// It was beyond the range.
    pub is_beyond: bool,
}

impl Limits {
    /// A range, the lower end first, and the change a second. Ends that are the wrong way round, or no
    /// numbers, leave nothing but 0; a slew that is no number or negative leaves no change.
    #[must_use]
    pub fn new(low: f64, high: f64, slew: f64) -> Self {
        let mut limits = Self { low: 0.0, high: 0.0, slew: slew.max(0.0), clamped: 0 };
        limits.set_range(low, high);
        limits
    }

    /// Another range, as in [`Self::new`]; what was counted stays.
    pub fn set_range(&mut self, low: f64, high: f64) {
        (self.low, self.high) = if low <= high { (low, high) } else { (0.0, 0.0) };
    }

    /// The range.
    #[must_use]
    pub const fn range(&self) -> [f64; 2] {
        [self.low, self.high]
    }

    /// Targets that were beyond the range.
    #[must_use]
    pub const fn clamped(&self) -> u64 {
        self.clamped
    }

    /// A target, within the range; `None` if it is infinite or no number.
    pub fn clamp(&mut self, target: f64) -> Option<Clamped> {
        let value = target.is_finite().then(|| target.clamp(self.low, self.high))?;
        let is_beyond = !(self.low..=self.high).contains(&target);
        self.clamped += u64::from(is_beyond);
        Some(Clamped { value, is_beyond })
    }

    /// From the command before towards `wanted`, as far as the time that passed allows. Beyond the range
    /// it stays or comes back.
    #[must_use]
    pub fn slew(&self, before: f64, wanted: f64, passed: Duration) -> f64 {
        let most = self.slew * passed.as_secs_f64();
        let change = wanted - before;
        // `wanted` itself where it is in reach: no rounding keeps the command from arriving.
        let next = if change.abs() <= most { wanted } else { before + most.copysign(change) };
        next.clamp(self.low.min(before), self.high.max(before))
    }

    /// Of a commanded velocity, what lets the joint come to rest at the ends of `positions`, braking as
    /// the slew limit allows. Beyond an end it may only go back.
    #[must_use]
    pub fn brake(&self, velocity: f64, position: f64, positions: [f64; 2]) -> f64 {
        let [low, high] = positions;
        let speed = |distance: f64| (2.0 * self.slew * distance.max(0.0)).sqrt();
        velocity.min(speed(high - position)).max(-speed(position - low))
    }
}

/// The commanded position nearest to `command` at which a stiffness of `kp` (Nm/rad) asks for no more
/// than `torque` (Nm), with the joint at `measured`.
#[must_use]
pub fn within_torque(command: f64, measured: f64, torque: f64, kp: f64) -> f64 {
    let reach = torque / kp;
    // No stiffness asks for nothing.
    if !reach.is_finite() || reach < 0.0 || !measured.is_finite() {
        return command;
    }
    command.clamp(measured - reach, measured + reach)
}

/// The stiffness, `kp` (Nm/rad) at most, with which a position error (rad) asks for no more than `torque` (Nm), in a frame
/// too, which rounds it to 12 bits.
#[must_use]
pub fn stiffness(kp: f64, error: f64, torque: f64) -> f64 {
    // No error asks for nothing: the quotient is infinite.
    let most = torque / error.abs() - KP_MAX / 4095.0 / 2.0;
    kp.min(most.max(0.0))
}

#[cfg(test)]
mod tests;
