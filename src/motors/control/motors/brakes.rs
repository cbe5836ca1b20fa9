//! Holding brakes of joints: when each must be released, and what their states imply.
//!
//! Invariant: a brake is released only while its motor is on. It engages before the motor of a joint that stops by its
//! brake is turned off.
//! Invariant: no joint follows an action before its brake is released.

use std::time::Duration;

use rapid_registry::DamiaoSpec;

use super::motor::BrakeIs;

/// States of brakes, a bit for each motor, the first one the lowest; without any bit set a brake is engaged. Bits of
/// motors without a brake mean nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Brakes {
    /// Released.
    pub released: u16,
    /// Their lines are being set: the state is unknown.
    pub moving: u16,
    /// They can be neither engaged nor released: the state is unknown.
    pub broken: u16,
}

impl Brakes {
    /// Of a motor, by its position in the entry.
    pub(super) fn state(self, index: usize) -> BrakeIs {
        let [broken, moving, released] =
            [self.broken, self.moving, self.released].map(|bits| bits >> (index % 16) & 1 == 1);
        match (broken, moving, released) {
            (true, ..) => BrakeIs::Broken,
            (_, true, _) => BrakeIs::Moving,
            (_, _, true) => BrakeIs::Released,
            _ => BrakeIs::Engaged,
        }
    }
}

/// The longest time that a brake takes to be released.
pub(super) fn slowest(spec: &DamiaoSpec) -> Duration {
    let times = spec.motors.iter().filter_map(|motor| motor.brake.as_ref()).map(|brake| brake.releases_in);
    times.max().unwrap_or_default()
}
