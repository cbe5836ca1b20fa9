//! The frames sent on behalf of this program when it is killed, stopped or hangs: see `driver::can::guard`.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::DamiaoSpec;

use super::{BusState, Fault, Motor, MotorBus};
use crate::control::can::CanFrame;

/// A program that misses this many cycles has not stalled yet.
const SLOW_CYCLES: u32 = 3;

/// Without a cycle for this long the program that commands the motors of an entry counts as dead: some time before the
/// motors' own limit, so that they stop as configured.
pub fn stalled_after(spec: &DamiaoSpec) -> Duration {
    let cycle = Duration::from_secs(1) / spec.hz.max(1);
    (spec.timeout * 3 / 4).max(cycle * SLOW_CYCLES)
}

impl MotorBus {
    /// A frame per motor that stops it as configured for the fault of another motor, to be sent repeatedly by the
    /// process that outlives this one; `None` if no motor is on.
    pub fn last_will(&self) -> Option<impl Iterator<Item = CanFrame> + '_> {
        // Already before the first motor is ordered to turn on.
        let is_on = self.state == BusState::Arming || self.motors.iter().any(Motor::may_be_on);
        is_on.then(|| self.motors.iter().map(Motor::last_will))
    }

    /// To be called before feeding frames that waited while nothing ran; [`Self::step`] does so itself.
    ///
    /// After a pause longer than [`stalled_after`] the motors may have been stopped by their own limit or by the guard,
    /// and the positions of the joints are unknown. The pause is reported as the fault, not its consequences.
    pub fn look_for_stall(&mut self, now: Stamp) {
        let passed = self.stepped.map_or(Duration::ZERO, |last| now.since(last));
        if passed >= self.stalled_after && (self.is_armed() || self.state == BusState::Arming) {
            self.fail(Fault::Stalled { after: passed }, now);
        }
    }
}
