//! Holding brakes of joints: when each must be released, and what their states imply.
//!
//! Invariant: a brake is released only while its motor is on. It engages before the motor of a joint that stops by its
//! brake is turned off.
//! Invariant: no joint follows an action before its brake is released.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::{DamiaoSpec, Stop};

use super::motor::BrakeIs;
use super::{BusState, Fault, Motor, MotorBus};

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
    /// The brakes that must be released after the last step, one bit per motor; all others must be engaged.
    pub fn releases(&self) -> u16 {
        self.bits(Motor::releases)
    }

    /// The brakes that are to engage at once when this program can no longer command: those of joints that stop by
    /// their brake, and of joints that nothing else keeps from falling.
    pub fn engages_at_death(&self) -> u16 {
        self.bits(|motor| matches!(motor.last_stop(), Stop::Limp | Stop::Brake))
    }

    /// Takes the states of the brakes; to be called before each step if a motor has one. It is a fault if the brake of
    /// a joint that is armed, or being armed, cannot be driven.
    pub fn feed_brakes(&mut self, brakes: Brakes, now: Stamp) {
        for (index, motor) in self.motors.iter_mut().enumerate() {
            motor.take_brake(brakes.of(index), now, &mut self.notices);
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
