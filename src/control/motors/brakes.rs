//! Holding brakes of joints: when each is to be released, and what follows from what they are.
//!
//! Invariant: a brake is released only while its motor is on, and engaged before the motor of a joint that stops so is off.
//! Invariant: no joint follows an action before its brake is released.

use std::time::Duration;

use super::motor::BrakeIs;
use super::{BusState, Fault, Motor, MotorBus, Notice};
use crate::registry::{DamiaoSpec, Stop};
use crate::time::Stamp;

/// What brakes are, a bit for each motor, the first one the lowest; those without any are engaged. Bits of motors without
/// a brake mean nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Brakes {
    /// They are released.
    pub released: u16,
    /// Their lines are being set: what they are is not known.
    pub moving: u16,
    /// They can be neither engaged nor released: what they are is not known.
    pub broken: u16,
}

impl Brakes {
    /// Of a motor, by its position in the entry.
    fn of(self, index: usize) -> BrakeIs {
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

impl MotorBus {
    /// The brakes that are to be released after the last step, a bit for each motor; all others are to be engaged.
    #[must_use]
    pub fn releases(&self) -> u16 {
        self.bits(Motor::releases)
    }

    /// The brakes that are to be engaged at once where this program can command no more: those of joints that stop so, and
    /// of those that are not kept from falling.
    #[must_use]
    pub fn engages_at_death(&self) -> u16 {
        self.bits(|motor| matches!(motor.last_stop(), Stop::Limp | Stop::Brake))
    }

    /// Takes what the brakes are; to be called before each step where a motor has one. A brake of a joint that is armed, or
    /// being armed, and that cannot be driven is a fault.
    pub fn feed_brakes(&mut self, brakes: Brakes, now: Stamp) {
        for (index, motor) in self.motors.iter_mut().enumerate() {
            // One that is to be released may be on its way: its line counts as engaged from when that is wanted.
            let is = brakes.of(index);
            motor.take_brake(if is == BrakeIs::Engaged && motor.releases() { BrakeIs::Moving } else { is }, now);
            if motor.misses_brake() {
                self.notices.notify(Notice::NotBraked { motor: index });
            }
        }
        let is_needed = matches!(self.state, BusState::Arming | BusState::Following | BusState::Holding);
        let broken = self.motors.iter().position(Motor::has_broken_brake).filter(|_| is_needed);
        if let Some(motor) = broken {
            self.fail(Fault::Brake { motor }, now);
        }
    }

    pub(super) fn bits(&self, is_set: impl Fn(&Motor) -> bool) -> u16 {
        let set = self.motors.iter().enumerate().filter(|(_, motor)| is_set(motor));
        set.fold(0, |bits, (index, _)| bits | 1 << (index % 16))
    }
}
