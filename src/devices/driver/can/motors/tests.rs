//! Thread `control` over a pair of UDP sockets that stands in for a bus, see `socket/tests.rs`, with motors
//! that answer at the other end.

use std::net::UdpSocket;
use std::os::fd::BorrowedFd;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread;
use std::time::Duration;

use rapid_core::action::{Arming, NoAction};
use rapid_core::interlock::{InputState, Interlocks, StopKind};
use rapid_core::permission::Permission;
use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::damiao::codec::{self, Feedback, MotorStatus, Ranges};
use rapid_motors::control::damiao::parameter::{Parameter, Reply, Value};
use rapid_registry::{
    EffectorSpec, MotionSpec, MotorKind, MotorMode, MotorSpec, Mounting, Stop, StopSpec, TipRotation, WatchSpec,
};
use tokio::time::{Instant, interval, timeout};

use super::*;
use crate::driver::can::link::tests::damiao_link;
use crate::driver::can::socket::tests::{bus, bytes};
use crate::patience::PATIENCE;

fn spec(count: u16, hz: u32) -> DamiaoSpec {
    let motor = |slave: u16| MotorSpec {
        name: format!("joint{slave}"),
        slave,
        master: 0x10 + slave,
        kind: MotorKind::Dm4310,
        mode: MotorMode::Mit { kp: 10.0, kd: 1.0 },
        mounting: Mounting::default(),
        position: [-1.0, 1.0],
        velocity: 5.0,
        torque: 5.0,
        slew: 5.0,
        motion: MotionSpec { first_target: 10.0, ..MotionSpec::of_slew(5.0) },
        watch: WatchSpec::default(),
        stop: StopSpec { own_fault: Stop::Limp, other_fault: Stop::Limp, emergency: Stop::Limp, hold_for: None },
        brake: None,
        max_mos: 80.0,
        max_rotor: 80.0,
    };
    DamiaoSpec {
        motors: (1..=count).map(motor).collect(),
        hz,
        deadman: None,
        disable_after: Some(Duration::from_mins(1)),
        timeout: Duration::from_millis(400),
        // A busy machine is slower than a bus.
        silent_after: Duration::from_secs(2),
        effector: None,
    }
}

/// What the simulated motors are to do.
#[derive(Debug, Default)]
struct Behaviour {
    /// Orders to turn off that are lost.
    ignores: AtomicU32,
    is_on: AtomicBool,
    ends: AtomicBool,
}

/// One motor that answers at `bus`; gives the bus back when it ends.
fn motor(bus: UdpSocket) -> (Arc<Behaviour>, thread::JoinHandle<UdpSocket>) {
    let behaviour = Arc::<Behaviour>::default();
    bus.set_read_timeout(Some(Duration::from_millis(5))).unwrap();
    let thread = thread::spawn({
        let behaviour = Arc::clone(&behaviour);
        move || {
            while !behaviour.ends.load(Ordering::Acquire) {
                let mut raw = [0; 17];
                if !matches!(bus.recv(&mut raw), Ok(16)) {
                    continue;
                }
                let id = u16::from_ne_bytes([raw[0], raw[1]]);
                let frame = CanFrame::standard(id, raw[8..16].try_into().unwrap());
                // The thread has ended and receives nothing.
                let _ = bus.send(&bytes(&answer(&frame, &behaviour)));
            }
            bus
        }
    });
    (behaviour, thread)
}

fn answer(frame: &CanFrame, behaviour: &Behaviour) -> CanFrame {
    const SLAVE: u16 = 1;
    if frame.id == 0x7ff && frame.data[2] != 0xcc {
        let parameter = Parameter::from_rid(frame.data[3]).unwrap();
        let value = match parameter {
            Parameter::PMax => Value::Float(12.5),
            Parameter::VMax => Value::Float(30.0),
            Parameter::TMax => Value::Float(10.0),
            Parameter::ControlMode => Value::Whole(1),
            _ => Value::Whole(8000),
        };
        return Reply { slave: SLAVE, written: frame.data[2] == 0x55, parameter, value }.encode(0x11);
    }
    if *frame == codec::StateCommand::Enable.frame(SLAVE) {
        behaviour.is_on.store(true, Ordering::Release);
    }
    if *frame == codec::StateCommand::Disable.frame(SLAVE)
        && behaviour.ignores.fetch_update(Ordering::AcqRel, Ordering::Acquire, |left| left.checked_sub(1)).is_err()
    {
        behaviour.is_on.store(false, Ordering::Release);
    }
    let status = if behaviour.is_on.load(Ordering::Acquire) { MotorStatus::Enabled } else { MotorStatus::Disabled };
    let feedback = Feedback { id: 1, status, q: 0.5, dq: 0.0, tau: 0.1, mos: 40, rotor: 41 };
    feedback.encode(0x11, &Ranges::new(12.5, 30.0, 10.0).unwrap()).unwrap()
}

/// Takes notices until one is as `wanted`.
async fn reported(motors: &mut Motors, wanted: impl Fn(&ActuatorNotice) -> bool) -> ActuatorNotice {
    let mut ticks = interval(Duration::from_millis(1));
    let mut all = Vec::new();
    let begun = Instant::now();
    loop {
        ticks.tick().await;
        while let Some(Ok(notice)) = motors.notices.as_mut().map(mpsc::Receiver::try_recv) {
            if wanted(&notice) {
                return notice;
            }
            all.push(notice);
        }
        assert!(begun.elapsed() < PATIENCE, "not reported; {all:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_emergency_stop_turns_the_motor_off_and_is_named() {
    let (link, bus) = bus();
    let (behaviour, thread) = motor(bus);
    let mut motors = Motors::start(link, &spec(1, 200)).unwrap();
    let stops = [("door", StopKind::Emergency), ("pendant", StopKind::Emergency)];
    let permission = Arc::new(Permission::new(false).with_interlocks(Interlocks::new(stops.into_iter())));
    motors.attend(&Arc::new(permission.attend()));
    for stop in 0..2 {
        permission.report(stop, InputState::Runs, Stamp::now());
    }
    permission.arm(Stamp::now(), Stamp::now()).unwrap();
    reported(&mut motors, |notice| notice.arming == Arming::Holding).await;
    // Nothing passes it on.
    permission.report(1, InputState::Lost, Stamp::now());
    let notice = reported(&mut motors, |notice| notice.arming == Arming::Faulted).await;
    assert_eq!(notice.text, "emergency stop pendant lost: all motors are stopped");
    assert!(notice.is_problem);
    let begun = Instant::now();
    while behaviour.is_on.load(Ordering::Acquire) {
        assert!(begun.elapsed() < PATIENCE);
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    motors.close().await;
    behaviour.ends.store(true, Ordering::Release);
    thread.join().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_permanent_bus_off_is_reported_and_ends_the_driver() {
    let (link, bus) = bus();
    let mut motors = Motors::start(link, &spec(1, 200)).unwrap();
    bus.send(&bytes(&CanFrame { id: 0x40, error: true, len: 8, ..CanFrame::default() })).unwrap();
    let ended = timeout(PATIENCE, motors.read()).await.expect("it ends");
    assert!(matches!(ended, Err(DriverError::Retry(text)) if text.contains("bus-off")));
    let notice = reported(&mut motors, |notice| notice.text.contains("bus-off")).await;
    assert!(notice.is_problem && notice.arming == Arming::Disarmed, "{notice:?}");
    assert!(motors.order(Order::Arm).is_err(), "nothing can take it");
}

/// An action above an arm that turns in a plane, once it is given.
#[derive(Debug, Default)]
struct Above(AtomicBool);

impl ActionSource for Above {
    fn bell(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Result<Option<(&'a [f64], Stamp)>, NoAction> {
        if !self.0.swap(false, Ordering::AcqRel) {
            return Ok(None);
        }
        action[..3].copy_from_slice(&[0.0, 0.0, 1.0]);
        Ok(Some((&action[..3], Stamp(1))))
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pose_out_of_reach_is_reported() {
    const URDF: &str = "<?xml version=\"1.0\"?><robot name=\"one\"><link name=\"base\"/>\
        <link name=\"beam\"/><link name=\"tool\"/>\
        <joint name=\"joint1\" type=\"revolute\"><parent link=\"base\"/><child link=\"beam\"/><axis xyz=\"0 0 1\"/>\
        <limit lower=\"-1\" upper=\"1\" effort=\"1\" velocity=\"1\"/></joint>\
        <joint name=\"end\" type=\"fixed\"><parent link=\"beam\"/><child link=\"tool\"/>\
        <origin xyz=\"0.5 0 0\" rpy=\"0 0 0\"/></joint></robot>";
    let folder = tempfile::tempdir().unwrap();
    let urdf = folder.path().join("arm.urdf");
    std::fs::write(&urdf, URDF).unwrap();
    let effector = EffectorSpec {
        urdf,
        frame: None,
        tip: "tool".to_owned(),
        rotation: TipRotation::Free,
        free_yaw: false,
        gripper: None,
        min: [-1.0; 3],
        max: [1.0; 3],
    };
    let with_arm = DamiaoSpec { effector: Some(Box::new(effector)), ..spec(1, 200) };
    let (link, bus) = bus();
    let (behaviour, thread) = motor(bus);
    let mut motors = Motors::start(link, &with_arm).unwrap();
    let above = Arc::<Above>::default();
    motors.follow(Arc::clone(&above) as Arc<dyn ActionSource>);
    // Before the first sample no action is followed, reachable or not.
    let sample = timeout(PATIENCE, motors.read()).await.expect("a sample").unwrap();
    assert_eq!(sample.bytes.len(), 8 * (SAMPLE_VALUES + 7), "the motor, and the pose of the tip");
    above.0.store(true, Ordering::Release);
    let notice = reported(&mut motors, |notice| notice.text.contains("the arm cannot reach the pose")).await;
    assert!(notice.is_problem, "{notice:?}");
    motors.close().await;
    behaviour.ends.store(true, Ordering::Release);
    thread.join().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_bus_is_reported() {
    // Nothing reads at the other end.
    let (link, _adapter) = damiao_link();
    let mut motors = Motors::start(link, &spec(10, 1000)).unwrap();
    let notice = reported(&mut motors, |notice| notice.text.contains("the queue to the bus is full")).await;
    assert!(notice.is_problem, "{notice:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_last_order_counts_and_a_disarm_is_always_carried_out() {
    let (link, bus) = bus();
    let (behaviour, thread) = motor(bus);
    let mut motors = Motors::start(link, &spec(1, 10)).unwrap();
    reported(&mut motors, |notice| notice.text.contains("all motors have answered")).await;
    motors.order(Order::Arm).unwrap();
    reported(&mut motors, |notice| notice.arming == Arming::Holding).await;
    // The last word counts, and a disarm is always one.
    motors.order(Order::Disarm).unwrap();
    motors.order(Order::Arm).unwrap();
    reported(&mut motors, |notice| notice.text == "motors are being armed").await;
    reported(&mut motors, |notice| notice.arming == Arming::Holding).await;
    motors.order(Order::Arm).unwrap();
    motors.order(Order::Disarm).unwrap();
    reported(&mut motors, |notice| notice.text == "motors are disabled").await;
    assert!(!behaviour.is_on.load(Ordering::Acquire));
    motors.close().await;
    behaviour.ends.store(true, Ordering::Release);
    thread.join().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn notices_wait_for_room() {
    const COUNT: usize = NOTICES + 30;
    let (link, bus) = bus();
    let mut motors = Motors::start(link, &spec(1, 1000)).unwrap();
    // Warm, and cool again: each time it is warm is a notice.
    for at in 0..2 * COUNT {
        let mos = if at % 2 == 0 { 75 } else { 30 };
        let feedback = Feedback { id: 1, status: MotorStatus::Disabled, q: 0.5, dq: 0.0, tau: 0.1, mos, rotor: 41 };
        bus.send(&bytes(&feedback.encode(0x11, &Ranges::new(12.5, 30.0, 10.0).unwrap()).unwrap())).unwrap();
        let begun = Instant::now();
        while at == NOTICES && motors.notices.as_ref().is_some_and(|notices| notices.len() < NOTICES / 2) {
            assert!(begun.elapsed() < PATIENCE, "the first half is not reported");
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }
    for _ in 0..COUNT {
        reported(&mut motors, |notice| notice.text.contains("(limit 80 °C)")).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_motor_that_misses_commands_is_disabled_until_it_confirms() {
    let (link, bus) = bus();
    let (behaviour, thread) = motor(bus);
    let mut motors = Motors::start(link, &spec(1, 200)).unwrap();
    motors.order(Order::Arm).unwrap();
    reported(&mut motors, |notice| notice.arming == Arming::Holding).await;
    assert!(behaviour.is_on.load(Ordering::Acquire));
    behaviour.ignores.store(6, Ordering::Release);
    motors.close().await;
    assert!(!behaviour.is_on.load(Ordering::Acquire));
    behaviour.ends.store(true, Ordering::Release);
    thread.join().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_sample_has_the_kernels_time_only_if_all_its_frames_have() {
    let (link, bus) = bus();
    let (behaviour, thread) = motor(bus);
    let mut motors = Motors::start(link, &spec(1, 200)).unwrap();
    // The kernel begins to stamp a moment after it is asked to.
    let begun = Instant::now();
    while timeout(PATIENCE, motors.read()).await.expect("a sample").unwrap().flags != FLAG_DEVICE_TIME {
        assert!(begun.elapsed() < PATIENCE, "no sample has the kernel's time");
    }
    motors.close().await;
    behaviour.ends.store(true, Ordering::Release);
    thread.join().unwrap();

    let (link, mut adapter) = damiao_link();
    let mut motors = Motors::start(link, &spec(1, 200)).unwrap();
    let behaviour = Arc::<Behaviour>::default();
    let thread = thread::spawn({
        let behaviour = Arc::clone(&behaviour);
        move || {
            use std::io::{Read as _, Write as _};
            let mut sent = [0; 30];
            // Until the line hangs up.
            while adapter.read_exact(&mut sent).is_ok() {
                let frame =
                    CanFrame::standard(u16::from_le_bytes([sent[13], sent[14]]), sent[21..29].try_into().unwrap());
                let reported = crate::driver::can::link::tests::received(&answer(&frame, &behaviour));
                if adapter.write_all(&reported).is_err() {
                    return;
                }
            }
        }
    });
    for _ in 0..5 {
        assert_eq!(timeout(PATIENCE, motors.read()).await.expect("a sample").unwrap().flags, 0);
    }
    motors.close().await;
    thread.join().unwrap();
}
