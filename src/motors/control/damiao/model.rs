//! What the maker ships: the ranges of each kind of motor.
//!
//! Invariant: they are used only for comparison. A motor is queried for its ranges, which anybody may have changed; a
//! difference from these is reported: the `type` is wrong, or the motor was configured otherwise.
//! Source: the tables of the public drivers `DM_CAN.py` and of `LeRobot`.

use rapid_registry::MotorKind;

use super::codec::Ranges;

/// PMAX in rad, VMAX in rad/s and TMAX in Nm as they leave the factory.
pub const fn shipped(kind: MotorKind) -> [f64; 3] {
    kind.shipped()
}

/// Does a motor of this kind usually count in these ranges?
pub fn is_shipped(kind: MotorKind, ranges: &Ranges) -> bool {
    let read = [ranges.position(), ranges.velocity(), ranges.torque()];
    // A range is a 32-bit float in the motor.
    shipped(kind).iter().zip(read).all(|(shipped, read)| (shipped - read).abs() <= 1e-6 * shipped)
}
