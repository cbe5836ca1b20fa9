//! Thread `control` with simulated motors behind it: what they are told, and that they are turned off.

#![expect(clippy::expect_used, reason = "helpers of tests")]

#[path = "support/motors.rs"]
mod motors;

use std::time::Duration;

use motors::{Adapter, PATIENCE, spec};
use rapid::action::{Arming, Order as Asked};
use rapid::driver::DriverError;
use rapid::driver::can::link::Link;
use rapid::driver::can::motors::Motors;
use rapid::time::Stamp;
use tokio::time::{Instant, interval, timeout};
use vbench::emu::order::Order;

const AXES: u16 = 2;

fn open(adapter: &Adapter) -> Motors {
    let link = Link::open_damiao(&adapter.path).expect("the line");
    Motors::start(link, &spec(AXES)).expect("a thread")
}

/// Reads samples, and the notices between them, until `done` is content with both. Sends `target` ten times
/// a second meanwhile.
async fn until(motors: &mut Motors, target: Option<[f64; 2]>, mut done: impl FnMut(&[f64], Option<Arming>) -> bool) {
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
                    motors.command(&target, Stamp::now()).expect("it listens");
                }
            }
            while let Some(notice) = motors.take_notice() {
                arming = Some(notice.arming);
            }
            if !values.is_empty() && done(&values, arming) {
                return;
            }
        }
    };
    timeout(PATIENCE, work).await.expect("it comes to that");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn motors_move_after_an_arm_and_are_turned_off_at_the_end() {
    let adapter = Adapter::plug(AXES);
    let mut motors = open(&adapter);
    // Samples come without an arm, and actions move nothing.
    let begun = Instant::now();
    until(&mut motors, Some([0.5, -0.5]), |_, _| begun.elapsed() > Duration::from_secs(1)).await;
    assert_eq!((adapter.count("motor_enabled"), adapter.count("commands_begin")), (0, 0), "{:?}", adapter.told());

    motors.order(Asked::Arm).expect("it listens");
    until(&mut motors, Some([0.5, -0.5]), |values, arming| {
        arming == Some(Arming::Armed) && (values[0] - 0.5).abs() < 0.05 && (values[6] + 0.5).abs() < 0.05
    })
    .await;
    assert_eq!(adapter.count("motor_enabled"), 2);
    // Beyond the limits it goes to the limit.
    until(&mut motors, Some([3.0, -0.5]), |values, _| values[0] > 0.95).await;
    let begun = Instant::now();
    until(&mut motors, Some([3.0, -0.5]), |values, _| {
        assert!(values[0] < 1.05, "beyond its limit: {values:?}");
        begun.elapsed() > Duration::from_secs(1)
    })
    .await;

    motors.close().await;
    adapter.wait_until_off(&[1, 2]);
    assert_eq!(adapter.count("motor_timeout"), 0, "they were told, and did not find out by themselves");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_actions_they_hold_and_are_disabled_until_they_are_armed_again() {
    let adapter = Adapter::plug(AXES);
    let mut motors = open(&adapter);
    motors.order(Asked::Arm).expect("it listens");
    until(&mut motors, Some([0.2, 0.2]), |_, arming| arming == Some(Arming::Armed)).await;
    until(&mut motors, None, |_, arming| arming == Some(Arming::Holding)).await;
    until(&mut motors, None, |_, arming| arming == Some(Arming::Disarmed)).await;
    adapter.wait_until_off(&[1, 2]);
    // Actions alone do not bring them back.
    let begun = Instant::now();
    until(&mut motors, Some([0.2, 0.2]), |_, _| begun.elapsed() > Duration::from_millis(500)).await;
    assert_eq!(adapter.count("motor_enabled"), 2);
    motors.order(Asked::Arm).expect("it listens");
    until(&mut motors, Some([0.2, 0.2]), |_, arming| arming == Some(Arming::Armed)).await;
    motors.order(Asked::Disarm).expect("it listens");
    until(&mut motors, Some([0.2, 0.2]), |_, arming| arming == Some(Arming::Disarmed)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_motor_that_fails_stops_all() {
    for (fault, mend) in [
        (Order::Fault(0xd), Order::Fault(0)),
        (Order::Hot(95), Order::Hot(30)),
        (Order::Mute(true), Order::Mute(false)),
    ] {
        let adapter = Adapter::plug(AXES);
        let mut motors = open(&adapter);
        motors.order(Asked::Arm).expect("it listens");
        until(&mut motors, Some([0.1, 0.1]), |_, arming| arming == Some(Arming::Armed)).await;
        adapter.befall(2, fault);
        // A motor that says nothing leaves no sample to wait for: only notices.
        let faulted = async {
            let mut ticks = interval(Duration::from_millis(20));
            loop {
                ticks.tick().await;
                let _ = motors.command(&[0.1, 0.1], Stamp::now());
                while let Some(notice) = motors.take_notice() {
                    if notice.arming == Arming::Faulted {
                        return;
                    }
                }
            }
        };
        timeout(PATIENCE, faulted).await.unwrap_or_else(|_| panic!("{fault:?} is not noticed"));
        // One that says nothing hears nothing either.
        adapter.wait_until_off(if fault == Order::Mute(true) { &[1] } else { &[1, 2] });
        adapter.befall(2, mend);
        let enabled = adapter.count("motor_enabled");
        let begun = Instant::now();
        until(&mut motors, Some([0.1, 0.1]), |_, _| begun.elapsed() > Duration::from_millis(300)).await;
        assert_eq!(adapter.count("motor_enabled"), enabled, "{fault:?}: nobody armed them");
        motors.order(Asked::Arm).expect("it listens");
        until(&mut motors, Some([0.1, 0.1]), |_, arming| arming == Some(Arming::Armed)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pulled_adapter_ends_the_driver() {
    let adapter = Adapter::plug(AXES);
    let mut motors = open(&adapter);
    until(&mut motors, None, |_, _| true).await;
    drop(adapter);
    let ended = async {
        loop {
            if let Err(error) = motors.read().await {
                return error;
            }
        }
    };
    let error = timeout(PATIENCE, ended).await.expect("it ends");
    assert!(matches!(error, DriverError::Gone), "{error}");
    assert!(motors.command(&[0.0, 0.0], Stamp::now()).is_err());
}

/// The fault is ordered by the environment, which belongs to a process: this test runs itself in one of its own.
#[test]
fn a_panic_of_thread_control_turns_motors_off() {
    let folder = tempfile::tempdir().expect("a folder");
    let order = folder.path().join("now");
    let output = std::process::Command::new(std::env::current_exe().expect("this program"))
        .args(["--exact", "in_a_process_that_panics", "--ignored"])
        .env("RAPID_FAULT", format!("control:{}", order.display()))
        // A backtrace is made before anything is dropped, and would take longer than the motors wait.
        .env("RUST_BACKTRACE", "1")
        .env("MOTORS_PANIC_AT", &order)
        .output()
        .expect("it runs");
    let [said, errors] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    // Of a name that fits no test nothing runs, and nothing fails.
    assert!(output.status.success() && said.contains("1 passed"), "{}: {said}{errors}", output.status);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "run by a_panic_of_thread_control_turns_motors_off"]
async fn in_a_process_that_panics() {
    rapid::panics::to_log();
    let order = std::env::var_os("MOTORS_PANIC_AT").expect("the file at which thread `control` panics");
    let adapter = Adapter::plug(AXES);
    let mut motors = open(&adapter);
    motors.order(Asked::Arm).expect("it listens");
    until(&mut motors, Some([0.1, 0.1]), |_, arming| arming == Some(Arming::Armed)).await;
    std::fs::write(order, "").expect("the order");
    adapter.wait_until_off(&[1, 2]);
    assert_eq!(adapter.count("motor_timeout"), 0, "they were told, and did not find out by themselves");
    let ended = async {
        loop {
            if let Err(error) = motors.read().await {
                return error;
            }
        }
    };
    let error = timeout(PATIENCE, ended).await.expect("it ends");
    assert!(error.to_string().contains("panicked"), "{error}");
}
