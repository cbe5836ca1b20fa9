//! What the maker ships: the ranges of each kind of motor.
//!
//! Invariant: nothing is computed with them. A motor is asked for its ranges, which anybody may have
//! changed; these are what its answer is compared with, so that a wrong `type` or a motor that was set
//! up otherwise is told. Source: the tables of the public drivers `DM_CAN.py` and of `LeRobot`.

use super::codec::Ranges;
use crate::registry::MotorKind;

/// PMAX in rad, VMAX in rad/s and TMAX in Nm as they leave the factory.
#[must_use]
pub const fn shipped(kind: MotorKind) -> [f64; 3] {
    match kind {
        MotorKind::Dm3507 | MotorKind::Dm4310 => [12.5, 30.0, 10.0],
        MotorKind::Dm4310V48 => [12.5, 50.0, 10.0],
        MotorKind::Dm4340 => [12.5, 8.0, 28.0],
        MotorKind::Dm4340V48 => [12.5, 10.0, 28.0],
        MotorKind::Dm6006 => [12.5, 45.0, 20.0],
        MotorKind::Dm8006 => [12.5, 45.0, 40.0],
        MotorKind::Dm8009 => [12.5, 45.0, 54.0],
        MotorKind::Dm10010L => [12.5, 25.0, 200.0],
        MotorKind::Dm10010 => [12.5, 20.0, 200.0],
        MotorKind::Dmh3510 => [12.5, 280.0, 1.0],
        MotorKind::Dmh6215 | MotorKind::Dmg6220 => [12.5, 45.0, 10.0],
    }
}

/// Does a motor of this kind usually count in these ranges?
#[must_use]
pub fn is_shipped(kind: MotorKind, ranges: &Ranges) -> bool {
    let read = [ranges.position(), ranges.velocity(), ranges.torque()];
    // A range is a 32-bit float in the motor.
    shipped(kind).iter().zip(read).all(|(shipped, read)| (shipped - read).abs() <= 1e-6 * shipped)
}
