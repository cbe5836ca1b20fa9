//! The entry of a bus of motors, which tests modify as needed.

use std::time::Duration;

use rapid_registry::{
    BrakeSpec, DamiaoSpec, MotionSpec, MotorKind, MotorMode, MotorSpec, Mounting, Stop, StopSpec, WatchSpec,
};

/// A motor in MIT mode with the slave id `slave` that answers with 0x10 more.
pub(crate) fn motor(slave: u16) -> MotorSpec {
    MotorSpec {
        name: format!("joint_{slave}"),
        slave,
        master: 0x10 + slave,
        kind: MotorKind::Dm4310,
        mode: MotorMode::Mit { kp: 10.0, kd: 1.0 },
        mounting: Mounting::default(),
        position: [-2.0, 2.0],
        velocity: 20.0,
        torque: 5.0,
        slew: 5.0,
        // Other tests cover how a joint starts.
        motion: MotionSpec { acceleration: f64::INFINITY, soft_start: Duration::ZERO, first_target: 100.0 },
        watch: WatchSpec::default(),
        stop: StopSpec { own_fault: Stop::Limp, other_fault: Stop::Limp, emergency: Stop::Limp, hold_for: None },
        brake: None,
        max_mos: 80.0,
        max_rotor: 100.0,
    }
}

/// A brake with engaging and releasing times.
#[allow(dead_code, reason = "not every test has one")]
pub(crate) fn brake(line: u16) -> BrakeSpec {
    let ms = Duration::from_millis;
    BrakeSpec {
        chip: "/dev/brakes".into(),
        line: line.into(),
        released_high: true,
        engages_in: ms(60),
        releases_in: ms(40),
    }
}

/// These motors, at 200 Hz.
pub(crate) fn bus(motors: Vec<MotorSpec>) -> DamiaoSpec {
    DamiaoSpec {
        motors,
        hz: 200,
        deadman: None,
        disable_after: Some(Duration::from_secs(1)),
        timeout: Duration::from_millis(400),
        silent_after: Duration::from_millis(40),
        effector: None,
    }
}
