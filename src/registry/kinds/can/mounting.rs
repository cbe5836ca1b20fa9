//! How a motor sits on its joint: what a position, a velocity and a torque of the one are of the other.
//!
//! Owns that conversion, and is its only place: what encodes and decodes the frames of motors (`control::motors`) and what
//! judges the registry call it, and everything else has numbers of joints alone.
//!
//! Pure.
//!
//! Invariant: without a zero and not reversed, every number is the same, bit for bit.
//! Invariant: limits in order stay in order, and a position within them stays within them.

use crate::keys::{FLAG, Real, keys};

keys! {
    /// See the module's comment: joint = (motor - `zero`), of the other sign if `reversed`.
    #[derive(Debug, Clone, Copy, PartialEq, Default)]
    pub struct Mounting {
        /// What the motor reports at the zero of its joint, rad.
        zero: f64 = Real::ANY, or 0.0;
        /// The motor turns against its joint.
        reversed: bool = FLAG, or false;
    }
}

impl Mounting {
    /// The position of the joint at a position of the motor, rad.
    pub fn joint_position(self, motor: f64) -> f64 {
        self.turned(motor - self.zero)
    }

    /// The position of the motor at a position of the joint, rad.
    pub fn motor_position(self, joint: f64) -> f64 {
        // `+ zero` would make 0 of the number -0, whose bytes in a frame are others.
        self.turned(joint) - (0.0 - self.zero)
    }

    /// A velocity or a torque of the joint as the motor's, or the motor's as the joint's.
    pub fn turned(self, value: f64) -> f64 {
        // `-value` would make -0 of the number 0, which stops a motor too, and would be the only such number on the bus.
        if self.reversed { 0.0 - value } else { value }
    }

    /// The positions of the joint while the motor is within these, rad, the lowest first.
    pub fn joint_range(self, motor: [f64; 2]) -> [f64; 2] {
        self.ordered(motor.map(|end| self.joint_position(end)))
    }

    /// The positions of the motor while the joint is within these, rad, the lowest first.
    pub fn motor_range(self, joint: [f64; 2]) -> [f64; 2] {
        self.ordered(joint.map(|end| self.motor_position(end)))
    }

    fn ordered(self, [first, second]: [f64; 2]) -> [f64; 2] {
        if self.reversed { [second, first] } else { [first, second] }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// More than two roundings of a number below 128.
    const ROUNDED: f64 = 1e-13;

    fn mounting() -> impl Strategy<Value = Mounting> {
        (prop_oneof![Just(0.0_f64), -20.0_f64..20.0], any::<bool>())
            .prop_map(|(zero, reversed)| Mounting { zero, reversed })
    }

    #[test]
    fn a_motor_at_the_zero_of_its_joint_is_at_zero() {
        let ahead = Mounting { zero: 0.5, reversed: false };
        let against = Mounting { zero: 0.5, reversed: true };
        let both = [ahead, against];
        let joints = both.map(|mounting| [0.5, 2.0].map(|motor| mounting.joint_position(motor)));
        assert_eq!(joints, [[0.0, 1.5], [0.0, -1.5]]);
        let motors = both.map(|mounting| [mounting.motor_position(1.5), mounting.turned(3.0)]);
        assert_eq!(motors, [[2.0, 3.0], [-1.0, -3.0]]);
        assert_eq!(both.map(|mounting| mounting.motor_range([-1.0, 2.0])), [[-0.5, 2.5], [-1.5, 1.5]]);
        assert_eq!(both.map(|mounting| mounting.joint_range([-1.0, 2.0])), [[-1.5, 1.5], [-1.5, 1.5]]);
    }

    #[test]
    fn a_reversed_motor_that_rests_is_commanded_0_and_not_minus_0() {
        let against = Mounting { zero: 0.0, reversed: true };
        for number in [0.0, -0.0] {
            assert_eq!(against.turned(number).to_bits(), 0);
            assert_eq!(against.motor_position(number).to_bits(), 0);
        }
    }

    proptest! {
        #[test]
        fn without_the_keys_every_number_is_the_same(number in any::<f64>()) {
            for number in [number, 0.0, -0.0, f64::INFINITY] {
                let plain = Mounting::default();
                let same = [plain.joint_position(number), plain.motor_position(number), plain.turned(number)];
                prop_assert_eq!(same.map(f64::to_bits), [number.to_bits(); 3]);
                prop_assert_eq!(plain.joint_range([number, 1.0])[0].to_bits(), number.to_bits());
                prop_assert_eq!(plain.motor_range([number, 1.0])[0].to_bits(), number.to_bits());
            }
        }

        #[test]
        fn there_and_back_is_the_same(mounting in mounting(), number in -100.0_f64..100.0) {
            let [motor, joint] = [mounting.motor_position(number), mounting.joint_position(number)];
            prop_assert!((mounting.joint_position(motor) - number).abs() < ROUNDED);
            prop_assert!((mounting.motor_position(joint) - number).abs() < ROUNDED);
            prop_assert_eq!(mounting.turned(mounting.turned(number)).to_bits(), number.to_bits());
        }

        #[test]
        fn limits_stay_limits(
            mounting in mounting(), ends in (-100.0_f64..100.0, -100.0_f64..100.0), at in -100.0_f64..100.0,
        ) {
            let [low, high] = [ends.0.min(ends.1), ends.0.max(ends.1)];
            let [lowest, highest] = mounting.motor_range([low, high]);
            prop_assert!(lowest <= highest);
            prop_assert!((lowest..=highest).contains(&mounting.motor_position(at.clamp(low, high))));
            let back = mounting.joint_range([lowest, highest]);
            prop_assert!((back[0] - low).abs() < ROUNDED && (back[1] - high).abs() < ROUNDED, "{back:?}");
            prop_assert!(back[0] <= back[1]);
        }

        /// Towards the upper limit of the joint is towards the lower one of a reversed motor.
        #[test]
        fn a_velocity_has_the_sign_of_the_change(mounting in mounting(), at in -2.0_f64..2.0, by in -1.0_f64..1.0) {
            let moved = mounting.motor_position(at + by) - mounting.motor_position(at);
            prop_assert!((moved - mounting.turned(by)).abs() < ROUNDED);
        }
    }
}
