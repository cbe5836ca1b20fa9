//! Against `tests/golden/damiao.json`, and for values of any kind.

use proptest::prelude::*;
use serde_json::Value;

use super::*;
use crate::control::damiao::parameter;

fn golden() -> Value {
    serde_json::from_str(include_str!("../../../../../tests/golden/damiao.json")).unwrap()
}

fn hex(text: &Value) -> [u8; 8] {
    let bytes: Vec<u8> = text.as_str().unwrap().split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
    bytes.try_into().unwrap()
}

fn dmh3510() -> Ranges {
    Ranges::new(12.5, 280.0, 1.0).unwrap()
}

#[test]
fn commands_match_the_public_drivers() {
    let golden = golden();
    let cases = golden["mit"].as_array().unwrap();
    assert_eq!(cases.len(), 5);
    for case in cases {
        let value = |name: &str| case[name].as_f64().unwrap();
        let command = Mit { kp: value("kp"), kd: value("kd"), q: value("q"), dq: value("dq"), tau: value("tau") };
        assert_eq!(mit(5, &command, &dmh3510()), Ok(CanFrame::standard(5, hex(&case["data"]))), "{case}");
    }
}

#[test]
fn state_commands_and_requests_match_the_public_drivers() {
    let mode = parameter::Value::Whole(parameter::ControlMode::Mit as u32);
    for case in golden()["frames"].as_array().unwrap() {
        let frame = match case["what"].as_str().unwrap() {
            "enable" => StateCommand::Enable.frame(5),
            "disable" => StateCommand::Disable.frame(5),
            "set zero" => StateCommand::SetZero.frame(5),
            "clear error" => StateCommand::ClearError.frame(5),
            "set MIT mode" => parameter::write(5, parameter::Parameter::ControlMode, mode),
            "refresh" => parameter::refresh(5),
            other => panic!("{other}"),
        };
        assert_eq!((u64::from(frame.id), frame.data), (case["id"].as_u64().unwrap(), hex(&case["data"])), "{case}");
    }
}

#[test]
fn each_mode_of_the_motor_has_its_own_id_and_floats() {
    let frame = position_velocity(5, 1.0, -2.5).unwrap();
    assert_eq!((frame.id, frame.data), (0x105, [0, 0, 0x80, 0x3f, 0, 0, 0x20, 0xc0]));
    let frame = velocity(5, -2.5).unwrap();
    assert_eq!((frame.id, frame.data), (0x205, [0, 0, 0x20, 0xc0, 0, 0, 0, 0]));
    for bad in [f64::NAN, f64::INFINITY, 1e300] {
        assert_eq!(velocity(5, bad), Err(NotFinite));
        assert_eq!(position_velocity(5, bad, 1.0), Err(NotFinite));
        assert_eq!(position_velocity(5, 1.0, bad), Err(NotFinite));
    }
}

#[test]
fn every_bit_of_feedback_is_read() {
    // ERR 8 of motor 5; position 0xffff, velocity 0x000, torque 0xfff, 41 and 57 °C.
    let frame = CanFrame::standard(0x15, [0x85, 0xff, 0xff, 0x00, 0x0f, 0xff, 41, 57]);
    let feedback = Feedback::decode(&frame, &dmh3510()).unwrap();
    assert_eq!((feedback.id, feedback.status), (5, MotorStatus::OverVoltage));
    assert_eq!((feedback.q, feedback.dq, feedback.tau), (12.5, -280.0, 1.0));
    assert_eq!((feedback.mos, feedback.rotor), (41, 57));
    for odd in [
        CanFrame { len: 7, ..frame },
        CanFrame { extended: true, ..frame },
        CanFrame { remote: true, ..frame },
        CanFrame { error: true, ..frame },
    ] {
        assert_eq!(Feedback::decode(&odd, &dmh3510()), None);
    }
}

#[test]
fn each_status_has_its_own_code_and_text() {
    let mut words: Vec<String> = (0..16)
        .map(|code| {
            let status = MotorStatus::from_code(code);
            assert_eq!(status.code(), code);
            assert_eq!(status.is_fault(), code >= 8);
            status.to_string()
        })
        .collect();
    words.sort();
    words.dedup();
    assert_eq!(words.len(), 16);
}

#[test]
fn ranges_are_finite_and_above_zero() {
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert_eq!(Ranges::new(bad, 1.0, 1.0), None);
        assert_eq!(Ranges::new(1.0, bad, 1.0), None);
        assert_eq!(Ranges::new(1.0, 1.0, bad), None);
    }
}

#[test]
fn an_extreme_mit_command_is_never_a_state_command() {
    for tau in [1.0, 0.999, 0.9985, 0.998, 0.997] {
        let most = Mit { kp: 500.0, kd: 5.0, q: 12.5, dq: 280.0, tau };
        let data = mit(5, &most, &dmh3510()).unwrap().data;
        assert_ne!(data[..7], STATE_COMMAND, "{tau}");
        assert_eq!(data[..6], [0xff; 6]);
    }
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![4 => -20.0..20.0, 2 => -1e4..1e4, 1 => any::<f64>()]
}

/// What is read back of a command, of which every field is `end` at most.
fn field(data: [u8; 8], high: u32, bits: u32) -> u64 {
    u64::from_be_bytes(data) >> (64 - high - bits) & ((1 << bits) - 1)
}

proptest! {
    #[test]
    fn encoded_values_round_trip_or_saturate(
        kp in number(), kd in number(), q in number(), dq in number(), tau in number(),
        p in 0.1..100.0, v in 0.1..400.0, t in 0.1..400.0,
    ) {
        let ranges = Ranges::new(p, v, t).unwrap();
        let command = Mit { kp, kd, q, dq, tau };
        let all_finite = [kp, kd, q, dq, tau].iter().all(|value| value.is_finite());
        let frame = mit(3, &command, &ranges);
        prop_assert_eq!(frame.is_ok(), all_finite);
        if let Ok(frame) = frame {
            for (meant, low, high, at, bits) in
                [(q, -p, p, 0, 16), (dq, -v, v, 16, 12), (kp, 0.0, 500.0, 28, 12), (kd, 0.0, 5.0, 40, 12), (tau, -t, t, 52, 12)]
            {
                let quantum = (high - low) / ((1_u64 << bits) - 1) as f64;
                let sent = low + field(frame.data, at, bits) as f64 * quantum;
                // Cut off: at most a quantum less, and never more but for rounding.
                let short = meant.clamp(low, high) - sent;
                prop_assert!((-1e-5 * quantum..=quantum * 1.000_001).contains(&short), "{meant} was sent as {sent}");
            }
        }
    }

    #[test]
    fn feedback_round_trips_through_a_frame(
        id in 0_u8..16, code in 0_u8..16, q in -12.5..12.5, dq in -45.0..45.0, tau in -20.0..20.0,
        mos in any::<u8>(), rotor in any::<u8>(),
    ) {
        let ranges = Ranges::new(12.5, 45.0, 20.0).unwrap();
        let sent = Feedback { id, status: MotorStatus::from_code(code), q, dq, tau, mos, rotor };
        let read = Feedback::decode(&sent.encode(0x11, &ranges).unwrap(), &ranges).unwrap();
        prop_assert_eq!((read.id, read.status, read.mos, read.rotor), (id, sent.status, mos, rotor));
        prop_assert!((read.q - q).abs() <= 25.0 / 65_535.0 * 1.000_001);
        prop_assert!((read.dq - dq).abs() <= 90.0 / 4095.0 * 1.000_001);
        prop_assert!((read.tau - tau).abs() <= 40.0 / 4095.0 * 1.000_001);
    }

    #[test]
    fn any_frame_decodes_within_the_ranges_or_is_rejected(data in any::<[u8; 8]>(), len in any::<u8>(), kinds in 0_u8..8) {
        let frame = CanFrame {
            id: 0x11, extended: kinds & 1 != 0, remote: kinds & 2 != 0, error: kinds & 4 != 0, len, data,
        };
        let read = Feedback::decode(&frame, &dmh3510());
        prop_assert_eq!(read.is_some(), kinds == 0 && len == 8);
        if let Some(read) = read {
            prop_assert!(read.q.abs() <= 12.5 && read.dq.abs() <= 280.0 && read.tau.abs() <= 1.0);
            // What was counted is counted again, to the last bit.
            prop_assert_eq!(read.encode(0x11, &dmh3510()), Some(frame));
            let again = mit(0x11, &Mit { q: read.q, dq: read.dq, tau: read.tau, kp: 0.0, kd: 0.0 }, &dmh3510()).unwrap();
            prop_assert_eq!(again.data[..2].to_vec(), data[1..3].to_vec());
        }
    }
}
