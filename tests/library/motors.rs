//! Thread `control` with simulated motors behind it: what they are sent, and that they are turned off.

#![expect(clippy::expect_used, reason = "helpers of tests")]

use std::sync::Arc;
use std::time::Duration;

use rapid_core::action::{ActionSource, ActuatorNotice, Arming, Order as Asked};
use rapid_devices::driver::DriverError;
use rapid_devices::driver::can::link::Link;
use rapid_devices::driver::can::motors::Motors;
use rapid_registry::{DamiaoSpec, Mounting};

use crate::support::motors::{Adapter, Hand, PATIENCE, spec};
use tokio::sync::mpsc::Receiver;
use tokio::time::{Instant, interval, timeout};
use vbench::emu::order::Order;

const AXES: u16 = 2;

/// Motors that follow a hand.
struct Driven {
    motors: Motors,
    notices: Receiver<ActuatorNotice>,
    hand: Arc<Hand>,
}

fn open(adapter: &Adapter) -> Driven {
    open_as(adapter, &spec(AXES))
}

fn open_as(adapter: &Adapter, spec: &DamiaoSpec) -> Driven {
    let link = Link::open_damiao(&adapter.path).expect("the line");
    let mut motors = Motors::start(link, spec).expect("a thread");
    let hand = Arc::<Hand>::default();
    motors.follow(Arc::clone(&hand) as Arc<dyn ActionSource>);
    let notices = motors.notices().expect("the first call");
    Driven { motors, notices, hand }
}

/// Reads samples, and the notices between them, until `done` is content with both. Sends `target` ten times
/// a second meanwhile.
async fn until(driven: &mut Driven, target: Option<[f64; 2]>, mut done: impl FnMut(&[f64], Option<Arming>) -> bool) {
    let Driven { motors, notices, hand } = driven;
    let mut ticks = interval(Duration::from_millis(100));
    let mut arming = None;
    let mut values = Vec::new();
    let work = async {
        loop {
            tokio::select! {
                reading = motors.read() => {
                    let reading = reading.expect("the adapter is there");
                    values.clear();
                    let (numbers, rest) = reading.bytes.as_chunks::<8>();
                    assert!(rest.is_empty() && numbers.len() == 12, "{} bytes", reading.bytes.len());
                    values.extend(numbers.iter().map(|number| f64::from_le_bytes(*number)));
                }
                _ = ticks.tick() => if let Some(target) = target {
                    hand.point(&target);
                }
            }
            while let Ok(notice) = notices.try_recv() {
                arming = Some(notice.arming);
            }
            if !values.is_empty() && done(&values, arming) {
                return;
            }
        }
    };
    timeout(PATIENCE, work).await.expect("in time");
}

/// Shows `look` what comes of several actions: the samples of a hundred cycles, half a second at least.
async fn watch(driven: &mut Driven, target: [f64; 2], mut look: impl FnMut(&[f64])) {
    let begun = Instant::now();
    let mut samples = 0;
    until(driven, Some(target), |values, _| {
        look(values);
        samples += 1;
        samples >= 100 && begun.elapsed() >= Duration::from_millis(500)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn motors_move_after_an_arm_and_are_turned_off_at_the_end() {
    let adapter = Adapter::plug(AXES);
    let mut driven = open(&adapter);
    // Samples come without an arm, and actions move nothing.
    watch(&mut driven, [0.5, -0.5], |_| {}).await;
    assert_eq!((adapter.count("motor_enabled"), adapter.count("commands_begin")), (0, 0), "{:?}", adapter.reported());

    driven.motors.order(Asked::Arm).expect("it listens");
    until(&mut driven, Some([0.5, -0.5]), |values, arming| {
        arming == Some(Arming::Armed) && (values[0] - 0.5).abs() < 0.05 && (values[6] + 0.5).abs() < 0.05
    })
    .await;
    assert_eq!(adapter.count("motor_enabled"), 2);
    // Beyond the limits it goes to the limit.
    until(&mut driven, Some([3.0, -0.5]), |values, _| values[0] > 0.95).await;
    watch(&mut driven, [3.0, -0.5], |values| assert!(values[0] < 1.05, "beyond its limit: {values:?}")).await;

    driven.motors.close().await;
    adapter.wait_until_off(&[1, 2]);
    assert_eq!(adapter.count("motor_timeout"), 0, "they were disabled, and did not time out by themselves");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_motor_that_turns_against_its_joint_goes_where_the_joint_is_to_be() {
    let adapter = Adapter::plug(AXES);
    let mut mounted = spec(AXES);
    mounted.motors[0].mounting = Mounting { zero: -0.25, reversed: true };
    let mut driven = open_as(&adapter, &mounted);
    // Both motors are at their own zero.
    until(&mut driven, None, |values, _| (values[0] + 0.25).abs() < 0.01 && values[6].abs() < 0.01).await;
    driven.motors.order(Asked::Arm).expect("it listens");
    let mut rose = false;
    until(&mut driven, Some([0.5, 0.5]), |values, arming| {
        rose |= values[1] > 0.1;
        assert!(values[1] > -0.1, "the other way: {values:?}");
        arming == Some(Arming::Armed) && (values[0] - 0.5).abs() < 0.05 && (values[6] - 0.5).abs() < 0.05
    })
    .await;
    assert!(rose, "it moves in the direction of its action");
    until(&mut driven, Some([3.0, 0.5]), |values, _| values[0] > 0.95).await;
    watch(&mut driven, [3.0, 0.5], |values| assert!(values[0] < 1.05, "beyond the limit of its joint: {values:?}"))
        .await;
    driven.motors.close().await;
    adapter.wait_until_off(&[1, 2]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fresh_action_does_not_wait_for_the_next_cycle() {
    let adapter = Adapter::plug(AXES);
    let begun = Instant::now();
    // How many of them begin a cycle is a test of `control::pace`, on a clock of its own. Here the thread is woken by one: on
    // a busy machine that may be too late, and is tried again.
    loop {
        let mut driven = open(&adapter);
        driven.motors.order(Asked::Arm).expect("it listens");
        until(&mut driven, Some([0.2, 0.2]), |_, arming| arming == Some(Arming::Armed)).await;
        watch(&mut driven, [0.2, 0.2], |_| {}).await;
        let punctuality = driven.motors.finish().expect("it did not panic");
        assert!(punctuality.actions > 0, "{punctuality:?}");
        if punctuality.early > 0 {
            return;
        }
        assert!(begun.elapsed() < PATIENCE, "no action began a cycle: {punctuality:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_actions_they_hold_and_are_disabled_until_they_are_armed_again() {
    let adapter = Adapter::plug(AXES);
    let mut driven = open(&adapter);
    driven.motors.order(Asked::Arm).expect("it listens");
    until(&mut driven, Some([0.2, 0.2]), |_, arming| arming == Some(Arming::Armed)).await;
    until(&mut driven, None, |_, arming| arming == Some(Arming::Holding)).await;
    until(&mut driven, None, |_, arming| arming == Some(Arming::Disarmed)).await;
    adapter.wait_until_off(&[1, 2]);
    // Actions alone do not bring them back.
    watch(&mut driven, [0.2, 0.2], |_| {}).await;
    assert_eq!(adapter.count("motor_enabled"), 2);
    driven.motors.order(Asked::Arm).expect("it listens");
    until(&mut driven, Some([0.2, 0.2]), |_, arming| arming == Some(Arming::Armed)).await;
    driven.motors.order(Asked::Disarm).expect("it listens");
    until(&mut driven, Some([0.2, 0.2]), |_, arming| arming == Some(Arming::Disarmed)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_motor_that_fails_stops_all() {
    for (fault, repair) in [
        (Order::Fault(0xd), Order::Fault(0)),
        (Order::Hot(95), Order::Hot(30)),
        (Order::Mute(true), Order::Mute(false)),
    ] {
        let adapter = Adapter::plug(AXES);
        let mut driven = open(&adapter);
        driven.motors.order(Asked::Arm).expect("it listens");
        until(&mut driven, Some([0.1, 0.1]), |_, arming| arming == Some(Arming::Armed)).await;
        adapter.apply(2, fault);
        // A motor that sends nothing leaves no sample to wait for: only notices.
        let faulted = async {
            let mut ticks = interval(Duration::from_millis(20));
            loop {
                ticks.tick().await;
                driven.hand.point(&[0.1, 0.1]);
                while let Ok(notice) = driven.notices.try_recv() {
                    if notice.arming == Arming::Faulted {
                        return;
                    }
                }
            }
        };
        timeout(PATIENCE, faulted).await.unwrap_or_else(|_| panic!("{fault:?} is not noticed"));
        // One that sends nothing receives nothing either.
        adapter.wait_until_off(if fault == Order::Mute(true) { &[1] } else { &[1, 2] });
        adapter.apply(2, repair);
        let enabled = adapter.count("motor_enabled");
        watch(&mut driven, [0.1, 0.1], |_| {}).await;
        assert_eq!(adapter.count("motor_enabled"), enabled, "{fault:?}: nothing armed them");
        driven.motors.order(Asked::Arm).expect("it listens");
        until(&mut driven, Some([0.1, 0.1]), |_, arming| arming == Some(Arming::Armed)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pulled_adapter_ends_the_driver() {
    let adapter = Adapter::plug(AXES);
    let mut driven = open(&adapter);
    until(&mut driven, None, |_, _| true).await;
    drop(adapter);
    let ended = async {
        loop {
            if let Err(error) = driven.motors.read().await {
                return error;
            }
        }
    };
    let error = timeout(PATIENCE, ended).await.expect("it ends");
    assert!(matches!(error, DriverError::Gone), "{error}");
    assert!(driven.motors.order(Asked::Arm).is_err());
}

/// The fault is ordered by the environment, which belongs to a process: this test runs itself in one of its own.
#[test]
fn a_panic_of_thread_control_turns_motors_off() {
    let folder = tempfile::tempdir().expect("a folder");
    let order = folder.path().join("now");
    let output = std::process::Command::new(std::env::current_exe().expect("this program"))
        .args(["--exact", "motors::in_a_process_that_panics", "--ignored"])
        .env("RAPID_FAULT", format!("control:{}", order.display()))
        // A backtrace is made before anything is dropped, and would take longer than the motors wait.
        .env("RUST_BACKTRACE", "1")
        .env("MOTORS_PANIC_AT", &order)
        .output()
        .expect("it runs");
    let [printed, errors] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    // Of a name that fits no test nothing runs, and nothing fails.
    assert!(output.status.success() && printed.contains("1 passed"), "{}: {printed}{errors}", output.status);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "run by a_panic_of_thread_control_turns_motors_off"]
async fn in_a_process_that_panics() {
    rapid_system::panics::to_log();
    let order = std::env::var_os("MOTORS_PANIC_AT").expect("the file at which thread `control` panics");
    let adapter = Adapter::plug(AXES);
    let mut driven = open(&adapter);
    driven.motors.order(Asked::Arm).expect("it listens");
    until(&mut driven, Some([0.1, 0.1]), |_, arming| arming == Some(Arming::Armed)).await;
    std::fs::write(order, "").expect("the order");
    adapter.wait_until_off(&[1, 2]);
    assert_eq!(adapter.count("motor_timeout"), 0, "they were disabled, and did not time out by themselves");
    let ended = async {
        loop {
            if let Err(error) = driven.motors.read().await {
                return error;
            }
        }
    };
    let error = timeout(PATIENCE, ended).await.expect("it ends");
    assert!(error.to_string().contains("panicked"), "{error}");
}
