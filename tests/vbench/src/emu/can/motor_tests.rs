use proptest::prelude::*;

use super::*;
use crate::emu::can::motion::{KD_MAX, KP_MAX, from_unsigned};

const MS: u64 = 1_000_000;
const ENABLE: [u8; 8] = [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfc];
const DISABLE: [u8; 8] = [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfd];
const CLEAR: [u8; 8] = [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfb];
const SET_ZERO: [u8; 8] = [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfe];
const LIMITS: [f64; 3] = [12.5, 280.0, 1.0];
/// MIT: to 1 rad at -10 rad/s with 0.5 Nm, without gains.
const NO_GAINS: [u8; 8] = [0x8a, 0x3c, 0x7b, 0x60, 0x00, 0x00, 0x0b, 0xff];

fn motor() -> Motor {
    Motor::new(Type::named("DMH3510").unwrap(), 0x05, 0x15)
}

fn ask(motor: &mut Motor, id: u16, bytes: [u8; 8], ms: u64) -> [u8; 8] {
    let answer = motor.receive(&Frame::data(id, bytes), ms * MS).expect("an answer");
    assert_eq!((answer.id, answer.len()), (0x15, 8));
    answer.padded()
}

fn position(feedback: [u8; 8]) -> f64 {
    from_unsigned(u32::from(u16::from_be_bytes([feedback[1], feedback[2]])), 12.5, 16)
}

fn actions(motor: &mut Motor) -> Vec<&'static str> {
    motor.reported().map(|reported| reported.action).collect()
}

/// MIT bytes as a driver would encode them.
fn mit(position: f64, kp: f64) -> [u8; 8] {
    let [high, low] = (to_unsigned(position, 12.5, 16) as u16).to_be_bytes();
    let [kp_high, kp_low] = ((kp / KP_MAX * 4095.0) as u16).to_be_bytes();
    [high, low, 0x7f, 0xf0 | kp_high, kp_low, 0, 0x07, 0xff]
}

#[test]
fn golden_frames_are_read() {
    let cases = [
        ([0x7f, 0xff, 0x7f, 0xf0, 0x00, 0x00, 0x07, 0xff], [0.0; 5]),
        ([0x7f, 0xff, 0x7f, 0xf0, 0x06, 0x02, 0x87, 0xff], [0.8, 0.05, 0.0, 0.0, 0.0]),
        ([0x7f, 0xff, 0x7f, 0xf0, 0x00, 0x00, 0x09, 0x99], [0.0, 0.0, 0.0, 0.0, 0.2]),
        (NO_GAINS, [0.0, 0.0, 1.0, -10.0, 0.5]),
        ([0x00, 0x00, 0xff, 0xf0, 0x51, 0x33, 0x30, 0x00], [10.0, 1.0, -12.5, 280.0, -1.0]),
    ];
    for (bytes, expected) in cases {
        let Mit { position, velocity, kp, kd, torque } = Mit::decode(bytes, LIMITS);
        let steps = [KP_MAX / 4095.0, KD_MAX / 4095.0, 25.0 / 65535.0, 560.0 / 4095.0, 2.0 / 4095.0];
        for ((found, expected), step) in [kp, kd, position, velocity, torque].into_iter().zip(expected).zip(steps) {
            assert!((found - expected).abs() <= step, "{bytes:02x?}: {found}, expected {expected}");
        }
    }
}

#[test]
fn a_resting_motor_answers_zeros() {
    let feedback = ask(&mut motor(), 0x05, [0x7f, 0xff, 0x7f, 0xf0, 0x00, 0x00, 0x07, 0xff], 1);
    assert_eq!(feedback, [0x05, 0x7f, 0xff, 0x7f, 0xf7, 0xff, 30, 30]);
}

#[test]
fn a_motor_moves_only_when_enabled() {
    let mut motor = motor();
    ask(&mut motor, 0x05, mit(1.0, 10.0), 0);
    assert!(position(ask(&mut motor, 0x05, mit(1.0, 10.0), 50)).abs() < 0.001);
    assert_eq!(ask(&mut motor, 0x05, ENABLE, 60)[0], 0x15);
    ask(&mut motor, 0x05, mit(1.0, 10.0), 70);
    let on_its_way = position(ask(&mut motor, 0x05, mit(1.0, 10.0), 100));
    assert!((0.5..0.8).contains(&on_its_way), "{on_its_way}: one lag is 63 %");
    let there = position(ask(&mut motor, 0x05, mit(1.0, 10.0), 700));
    assert!((there - 1.0).abs() < 0.001, "{there}");
    assert_eq!(ask(&mut motor, 0x05, DISABLE, 710)[0], 0x05);
    ask(&mut motor, 0x05, mit(0.0, 10.0), 720);
    assert!((position(ask(&mut motor, 0x05, mit(0.0, 10.0), 900)) - 1.0).abs() < 0.001, "it moved though disabled");
}

#[test]
fn each_mode_has_its_identifier() {
    let mut motor = motor();
    let set_mode = |motor: &mut Motor, mode| ask(motor, 0x7ff, [0x05, 0, 0x55, 10, mode, 0, 0, 0], 0);
    let pair = |a: f32, b: f32| [a.to_le_bytes(), b.to_le_bytes()].concat().try_into().unwrap();
    assert_eq!(set_mode(&mut motor, 2), [0x05, 0, 0x55, 10, 2, 0, 0, 0]);
    ask(&mut motor, 0x05, ENABLE, 0);
    ask(&mut motor, 0x05, mit(5.0, 10.0), 10);
    ask(&mut motor, 0x105, pair(2.0, 1.0), 500);
    let slowly = position(ask(&mut motor, 0x105, pair(2.0, 1.0), 1500));
    assert!((0.9..1.1).contains(&slowly), "{slowly} after 1 s at 1 rad/s; a frame of another mode is not obeyed");
    set_mode(&mut motor, 3);
    ask(&mut motor, 0x205, pair(-3.0, 0.0), 2000);
    let before = position(ask(&mut motor, 0x205, pair(-3.0, 0.0), 2500));
    let after = position(ask(&mut motor, 0x205, pair(0.0, 0.0), 3500));
    assert!((after - before + 3.0).abs() < 0.01, "{before} to {after}");
}

#[test]
fn parameters_are_read_written_and_saved() {
    let mut motor = motor();
    let vmax = 280.0_f32.to_le_bytes();
    assert_eq!(ask(&mut motor, 0x7ff, [0x05, 0, 0x33, 22, 0, 0, 0, 0], 0)[4..], vmax);
    assert_eq!(ask(&mut motor, 0x7ff, [0x05, 0, 0x55, 9, 0x10, 0x27, 0, 0], 0)[4..], [0x10, 0x27, 0, 0]);
    assert_eq!(motor.registers.patience(), Some(std::time::Duration::from_millis(500)));
    assert_eq!(motor.receive(&Frame::data(0x7ff, [0x05, 0, 0x33, 200, 0, 0, 0, 0]), 0), None, "no such register");
    assert_eq!(motor.receive(&Frame::data(0x7ff, [0x06, 0, 0x33, 22, 0, 0, 0, 0]), 0), None, "another motor's");
    let pmax = f32::NAN.to_le_bytes();
    let refused = ask(&mut motor, 0x7ff, [0x05, 0, 0x55, 21, pmax[0], pmax[1], pmax[2], pmax[3]], 0);
    assert_eq!(refused[4..], 12.5_f32.to_le_bytes(), "a limit that is not a number");

    motor.apply(Order::Power(false), 0);
    motor.apply(Order::Power(true), 0);
    assert_eq!(motor.registers.timeout, 0, "not saved, not kept");
    ask(&mut motor, 0x7ff, [0x05, 0, 0x55, 9, 0x10, 0x27, 0, 0], 0);
    ask(&mut motor, 0x05, ENABLE, 0);
    let save = [0x05, 0, 0xaa, 1, 0, 0, 0, 0];
    assert_eq!(motor.receive(&Frame::data(0x7ff, save), 0), None, "enabled");
    ask(&mut motor, 0x05, DISABLE, 0);
    ask(&mut motor, 0x7ff, save, 0);
    motor.apply(Order::Power(false), 0);
    assert_eq!(motor.receive(&Frame::data(0x05, ENABLE), 0), None, "no power");
    motor.apply(Order::Power(true), 0);
    assert_eq!(motor.registers.timeout, 10_000);
}

#[test]
fn a_motor_times_out_without_frames() {
    let mut motor = motor();
    ask(&mut motor, 0x7ff, [0x05, 0, 0x55, 9, 0x10, 0x27, 0, 0], 0);
    ask(&mut motor, 0x05, ENABLE, 0);
    ask(&mut motor, 0x05, mit(1.0, 10.0), 400);
    assert_eq!(motor.tend(500 * MS), Some(900 * MS), "its patience begins with the last frame");
    assert_eq!(motor.tend(899 * MS), Some(900 * MS));
    assert_eq!(motor.tend(900 * MS), None);
    let reported = actions(&mut motor);
    let expected = ["motor_written", "motor_enabled", "commands_begin", "commands_end", "motor_timeout", "motor_fault"];
    assert_eq!(reported, expected);
    assert_eq!(ask(&mut motor, 0x05, ENABLE, 950)[0] >> 4, COMMUNICATION_LOST, "enabled with a fault");
    ask(&mut motor, 0x05, CLEAR, 960);
    assert_eq!(ask(&mut motor, 0x05, ENABLE, 970)[0] >> 4, 1);
    assert_eq!(actions(&mut motor), ["motor_enable_refused", "motor_cleared", "motor_enabled"]);
}

#[test]
fn a_disabled_motor_waits_forever() {
    let mut motor = motor();
    ask(&mut motor, 0x7ff, [0x05, 0, 0x55, 9, 0x10, 0x27, 0, 0], 0);
    assert_eq!(motor.tend(3_600_000 * MS), None);
    assert_eq!(actions(&mut motor), ["motor_written"]);
}

#[test]
fn changed_states_are_reported_in_feedback() {
    let mut motor = motor();
    ask(&mut motor, 0x05, ENABLE, 0);
    motor.apply(Order::Hot(95), MS);
    let refresh = [0x05, 0, 0xcc, 0, 0, 0, 0, 0];
    let feedback = ask(&mut motor, 0x7ff, refresh, 2);
    assert_eq!((feedback[0], feedback[6], feedback[7]), (0x15, 95, 95), "hot and going");
    motor.apply(Order::Hot(TOO_HOT), 3 * MS);
    assert_eq!(ask(&mut motor, 0x7ff, refresh, 4)[0], 0xc5, "too hot");
    motor.apply(Order::Fault(0xa), 5 * MS);
    assert_eq!(ask(&mut motor, 0x7ff, refresh, 6)[0], 0xa5);
    motor.apply(Order::Mute(true), 7 * MS);
    assert_eq!(motor.receive(&Frame::data(0x7ff, refresh), 8 * MS), None);
    motor.apply(Order::Mute(false), 9 * MS);
    motor.apply(Order::Fault(0), 9 * MS);
    assert_eq!(ask(&mut motor, 0x7ff, refresh, 10)[0], 0x05);
}

#[test]
fn a_run_of_commands_is_summarized() {
    let mut motor = motor();
    ask(&mut motor, 0x05, ENABLE, 0);
    for (ms, position) in [(10, 0.0), (15, 0.1), (40, 0.4), (45, 0.4)] {
        ask(&mut motor, 0x05, mit(position, 10.0), ms);
    }
    motor.tend(145 * MS);
    let reported: Vec<Reported> = motor.reported().collect();
    let end = &reported.last().unwrap();
    assert_eq!(end.action, "commands_end");
    assert_eq!((&end.fields["count"], &end.fields["last_mono_ns"]), (&json!(4), &json!(45 * MS)));
    assert_eq!((&end.fields["longest_gap_ns"], &end.fields["motor"]), (&json!(25 * MS), &json!(5)));
    assert!((end.fields["largest_step"].as_f64().unwrap() - 0.3).abs() < 0.001);
}

/// Applies a line of the script to it.
fn apply(motor: &mut Motor, line: &str, ms: u64) {
    let mut words = line.split_whitespace();
    let (_, order) = crate::emu::order::parse(words.next().unwrap(), &mut words).expect("an order");
    motor.apply(order, ms * MS);
}

/// Commands it every 5 ms; returns the last answer.
fn drive(motor: &mut Motor, bytes: [u8; 8], ms: std::ops::Range<u64>) -> [u8; 8] {
    ms.step_by(5).map(|ms| ask(motor, 0x05, bytes, ms)).last().expect("an answer")
}

#[test]
fn a_loaded_joint_sags_while_on_and_falls_while_off() {
    let mut motor = Motor::new(Type::named("DM4310").unwrap(), 0x05, 0x15);
    for line in ["load 0 1.5", "ends 0 -1 1"] {
        apply(&mut motor, line, 0);
    }
    ask(&mut motor, 0x05, ENABLE, 0);
    // A stiffness of 20 Nm/rad, and damping of 1 Nm s/rad.
    let mut hold = mit(0.0, 20.0);
    hold[5] = 0x33;
    let sagged = position(drive(&mut motor, hold, 0..2_000));
    assert!((sagged + 0.075).abs() < 0.003, "{sagged}");
    ask(&mut motor, 0x05, DISABLE, 2_000);
    ask(&mut motor, 0x05, DISABLE, 2_500);
    assert_eq!((motor.angle(), motor.is_on()), (-1.0, false));
}

#[test]
fn a_wrong_zero_and_a_frozen_encoder_falsify_the_position() {
    let mut motor = motor();
    apply(&mut motor, "inertia 0 0.02", 0);
    apply(&mut motor, "zero 0 0.25", 0);
    let reported = position(ask(&mut motor, 0x05, [0; 8], 5));
    assert!((reported - 0.25).abs() < 0.001 && motor.angle().abs() < 1e-9, "{reported}");
    apply(&mut motor, "freeze 0 1", 5);
    apply(&mut motor, "load 0 0.5", 5);
    let frozen = position(ask(&mut motor, 0x05, [0; 8], 200));
    assert!((frozen - 0.25).abs() < 0.001 && motor.angle() < -0.1, "{frozen} at {}", motor.angle());
    apply(&mut motor, "freeze 0 0", 200);
    let angle = motor.angle();
    ask(&mut motor, 0x05, SET_ZERO, 200);
    assert!(position(ask(&mut motor, 0x05, [0; 8], 200)).abs() < 0.001);
    assert!((motor.angle() - angle).abs() < 1e-9, "another zero moves nothing");
}

#[test]
fn a_blocked_joint_stays_with_and_without_a_body() {
    for body in [None, Some("load 0 0.1")] {
        let mut motor = motor();
        body.into_iter().chain(["block 0 1"]).for_each(|line| apply(&mut motor, line, 0));
        ask(&mut motor, 0x05, ENABLE, 0);
        assert!(position(drive(&mut motor, mit(1.0, 10.0), 0..500)).abs() < 0.001, "{body:?}");
        apply(&mut motor, "block 0 0", 500);
        assert!(position(drive(&mut motor, mit(1.0, 10.0), 500..700)) > 0.5, "{body:?}");
    }
}

proptest! {
    #[test]
    fn a_motor_never_exceeds_its_maximum_speed(
        from in -12.0..12.0, goal in -12.0..12.0, fastest in 0.0..300.0, seconds in 0.0..2.0,
    ) {
        let (position, velocity) = reach(from, goal, fastest, seconds);
        prop_assert!((position - from).abs() <= fastest * seconds + 1e-9);
        prop_assert!(velocity.abs() <= fastest + 1e-9);
        prop_assert!((goal - position).abs() <= (goal - from).abs() + 1e-9);
        // Two steps move as far as one.
        let (middle, _) = reach(from, goal, fastest, seconds / 3.0);
        let (end, _) = reach(middle, goal, fastest, seconds * 2.0 / 3.0);
        prop_assert!((end - position).abs() < 1e-6, "{end} and {position}");
    }

    #[test]
    fn any_frame_is_survived(frames in proptest::collection::vec((crate::emu::can::strategies::frame(), 0_u64..50), 0..50)) {
        let mut motor = motor();
        let mut now_ns = 0;
        for (frame, ms) in frames {
            now_ns += ms * MS;
            motor.receive(&frame, now_ns);
            prop_assert!(motor.movement.position.is_finite());
        }
    }

    #[test]
    fn any_bytes_for_its_parameters_are_survived(
        frames in proptest::collection::vec((prop_oneof![Just(0x05_u16), Just(0x105), Just(0x205), Just(0x7ff)], any::<[u8; 8]>()), 0..50),
    ) {
        let mut motor = motor();
        ask(&mut motor, 0x05, ENABLE, 0);
        for (place, (id, mut bytes)) in frames.into_iter().enumerate() {
            if id == 0x7ff {
                bytes[..2].copy_from_slice(&[0x05, 0]);
            }
            motor.receive(&Frame::data(id, bytes), place as u64 * MS);
            prop_assert!(motor.movement.position.is_finite() && motor.movement.velocity.is_finite());
        }
    }
}
