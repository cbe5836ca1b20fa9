//! An actuator: simulated motors, which only an order arms.

use rapid_registry::{
    ActionSpec, CanAdapter, CanProtocol, CanSpec, DamiaoSpec, MOTOR_CHANNELS, MotionSpec, MotorKind, MotorMode,
    MotorSpec, Mounting, StopSpec, WatchSpec,
};

use super::*;

const NUMBERS: usize = MOTOR_CHANNELS;

/// Entry `a` is an arm of one motor.
fn arm() -> Registry {
    let motor = MotorSpec {
        name: "gripper".into(),
        slave: 1,
        master: 0x11,
        kind: MotorKind::Dm4310,
        mode: MotorMode::Mit { kp: 1.0, kd: 1.0 },
        mounting: Mounting::default(),
        position: [-1.0, 1.0],
        velocity: 1.0,
        torque: 1.0,
        slew: 1.0,
        motion: MotionSpec::of_slew(1.0),
        watch: WatchSpec::default(),
        stop: StopSpec::default(),
        brake: None,
        max_mos: 80.0,
        max_rotor: 80.0,
    };
    let damiao = DamiaoSpec {
        motors: vec![motor],
        hz: 200,
        deadman: None,
        disable_after: Some(Duration::from_secs(1)),
        timeout: Duration::from_millis(100),
        silent_after: Duration::from_millis(40),
        effector: None,
    };
    let mut registry = registry(Duration::from_millis(100), Duration::from_secs(10));
    registry.devices.truncate(1);
    let device = &mut registry.devices[0];
    device.node = NodeSpec::Can(CanSpec {
        adapter: CanAdapter::SocketCan,
        bitrate: 1_000_000,
        protocol: CanProtocol::Damiao(damiao),
    });
    device.action =
        Some(ActionSpec { names: vec!["gripper".into()], units: vec!["rad".into()], min: vec![-1.0], max: vec![1.0] });
    registry
}

const UP: [&str; 4] = ["a at 1", "a opening", "a armed", "a streaming"];
const UP_DISARMED: [&str; 3] = ["a at 1", "a opening", "a streaming"];

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_arm_at_the_start_is_given_once() {
    let again = ["a at 1", "a backoff", "a opening", "a streaming"];
    // A disarm order, to show that nothing armed it before.
    let end = [Give(Order::Disarm), Until("a disarmed")];
    let plug = || [Plug("1", NUMBERS), Until("a streaming")];
    let replugged = || [Removed("1", UnplugSource::Kernel), Until("a absent")].into_iter().chain(plug());
    let table: [(&str, bool, Vec<Step>, Vec<&str>); 7] = [
        ("at the first plug", true, plug().into(), [&UP[..], &["a disarmed"]].concat()),
        ("without it, never", false, plug().into(), [&UP_DISARMED[..], &["a disarmed"]].concat()),
        (
            "not after a replug, before which it is reported as disarmed",
            true,
            plug().into_iter().chain(replugged()).collect(),
            [&UP[..], &["a gone kernel", "a disarmed", "a absent"], &again, &["a disarmed"]].concat(),
        ),
        (
            "not after an unplug that its stream saw first",
            true,
            plug()
                .into_iter()
                .chain([Pull("1"), Until("a absent"), Removed("1", UnplugSource::Kernel)])
                .chain(plug())
                .collect(),
            [&UP[..], &["a gone stream", "a disarmed", "a absent"], &again, &["a disarmed"]].concat(),
        ),
        (
            "not after a disarm",
            true,
            plug().into_iter().chain([Give(Order::Disarm), Until("a disarmed")]).chain(replugged()).collect(),
            [&UP[..], &["a disarmed", "a gone kernel", "a absent"], &again, &["a disarmed"]].concat(),
        ),
        (
            "not after a disarm of before the plug",
            true,
            [Give(Order::Disarm)].into_iter().chain(plug()).collect(),
            [&UP_DISARMED[..], &["a disarmed"]].concat(),
        ),
        (
            "not after an arm of before the plug, for which there was no receiver",
            true,
            [Give(Order::Arm)].into_iter().chain(plug()).collect(),
            [&UP_DISARMED[..], &["a disarmed"]].concat(),
        ),
    ];
    for (name, at_start, steps, expected) in table {
        let steps: Vec<Step> = steps.into_iter().chain(end.clone()).collect();
        assert_eq!(reported_of(&arm(), at_start, &steps).await, expected, "{name}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_order_arms_and_the_end_of_a_run_disarms() {
    let steps = [Plug("1", NUMBERS), Until("a streaming"), Give(Order::Arm), Until("a armed")];
    let reported = reported_of(&arm(), false, &steps).await;
    assert_eq!(reported, [&UP_DISARMED[..], &["a armed", "a disarmed"]].concat());
}
