use proptest::prelude::*;
use rapid_registry::MotorKind;

use super::*;
use crate::control::damiao::model::{is_shipped, shipped};

#[test]
fn replies_are_read_by_the_type_of_their_parameter() {
    let reply = |data| Reply::decode(&CanFrame::standard(0x15, data));
    let pmax = reply([5, 0, 0x33, 21, 0, 0, 0x48, 0x41]).unwrap();
    assert_eq!((pmax.slave, pmax.written, pmax.parameter, pmax.value), (5, false, Parameter::PMax, Value::Float(12.5)));
    let mode = reply([0x37, 1, 0x55, 10, 1, 0, 0, 0]).unwrap();
    assert_eq!(
        (mode.slave, mode.written, mode.parameter, mode.value),
        (0x137, true, Parameter::ControlMode, Value::Whole(1))
    );
    assert_eq!(reply([5, 0, 0xcc, 10, 1, 0, 0, 0]), None);
    assert_eq!(reply([5, 0, 0x33, 99, 1, 0, 0, 0]), None);
}

#[test]
fn requests_name_the_motor_and_the_parameter() {
    assert_eq!(read(0x137, Parameter::Timeout).data, [0x37, 1, 0x33, 9, 0, 0, 0, 0]);
    assert_eq!(write(5, Parameter::Timeout, Value::Whole(8000)).data, [5, 0, 0x55, 9, 0x40, 0x1f, 0, 0]);
}

#[test]
fn factory_ranges_are_recognised() {
    for kind in MotorKind::ALL {
        let [p, v, t] = shipped(kind);
        assert!(is_shipped(kind, &codec::Ranges::new(p, v, t).unwrap()));
        assert!(!is_shipped(kind, &codec::Ranges::new(p, v * 1.01, t).unwrap()));
    }
}

proptest! {
    #[test]
    fn a_reply_round_trips_through_a_frame(slave in 0_u16..0x800, written: bool, at in 0..ALL.len(), bits: u32) {
        let parameter = ALL[at];
        let value =
            if parameter.is_float() { Value::Float(f32::from_bits(bits)) } else { Value::Whole(bits) };
        let frame = Reply { slave, written, parameter, value }.encode(0x11);
        let read = Reply::decode(&frame).unwrap();
        prop_assert_eq!((read.slave, read.written, read.parameter), (slave, written, parameter));
        prop_assert_eq!(read.value.to_le_bytes(), value.to_le_bytes());
    }
}
