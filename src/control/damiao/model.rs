//! What the maker ships: the ranges of each kind of motor.
//!
//! Invariant: nothing is computed with them. A motor is asked for its ranges, which anybody may have
//! changed; these are what its answer is compared with, so that a wrong `type` or a motor that was set
//! up otherwise is reported. Source: the tables of the public drivers `DM_CAN.py` and of `LeRobot`.

use super::codec::Ranges;
use crate::registry::MotorKind;

/// PMAX in rad, VMAX in rad/s and TMAX in Nm as they leave the factory.
#[must_use]
pub const fn shipped(kind: MotorKind) -> [f64; 3] {
    kind.shipped()
}

/// Does a motor of this kind usually count in these ranges?
#[must_use]
pub fn is_shipped(kind: MotorKind, ranges: &Ranges) -> bool {
    let read = [ranges.position(), ranges.velocity(), ranges.torque()];
    // A range is a 32-bit float in the motor.
    shipped(kind).iter().zip(read).all(|(shipped, read)| (shipped - read).abs() <= 1e-6 * shipped)
}
