//! What is left to be sent when this program is killed, stopped or hangs: see `driver::can::guard`.

use std::time::Duration;

use super::{BusState, Fault, MotorBus};
use crate::control::can::CanFrame;
use crate::registry::DamiaoSpec;
use crate::time::Stamp;

/// A program that sends nothing for so many cycles has not stalled yet.
const SLOW_CYCLES: u32 = 3;

/// Without a cycle for this long the program that commands the motors of an entry counts as dead: some time before the
/// motors' own limit, so that their stop is the one that was chosen for them.
#[must_use]
pub fn stalled_after(spec: &DamiaoSpec) -> Duration {
    let cycle = Duration::from_secs(1) / spec.hz.max(1);
    (spec.timeout * 3 / 4).max(cycle * SLOW_CYCLES)
}

impl MotorBus {
    /// A frame for each motor that stops it as it is to stop at the fault of another, to be sent again and again by what
    /// outlives this program; `None` where none is on.
    #[must_use]
    pub fn last_will(&self) -> Option<impl Iterator<Item = CanFrame> + '_> {
        // From before the first is ordered to turn on.
        let is_on = self.state == BusState::Arming || self.motors.iter().any(|motor| motor.may_be_on);
        let axes = self.motors.iter().zip(&self.commands);
        is_on.then(|| axes.map(|(motor, command)| motor.last_will(*command)))
    }

    /// To be called before frames are fed that waited while nothing ran; [`Self::step`] does so itself.
    ///
    /// The cycles stood still for longer than [`stalled_after`]: the motors may have been stopped meanwhile, by their own
    /// limit or by what outlives this program, and where the joints are is not known. That is the fault, and not what it led to.
    pub fn look_for_stall(&mut self, now: Stamp) {
        let passed = self.stepped.map_or(Duration::ZERO, |last| now.since(last));
        if passed >= self.stalled_after && (self.is_armed() || self.state == BusState::Arming) {
            self.fail(Fault::Stalled { after: passed }, now);
        }
    }
}
