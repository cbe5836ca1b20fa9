use super::*;
use crate::emu::descriptor::check_configuration;

const MS: u64 = 1_000_000;
const ZERO_MIT: [u8; 8] = [0x7f, 0xff, 0x7f, 0xf0, 0, 0, 0x07, 0xff];
const RESTING: [u8; 8] = [0x05, 0x7f, 0xff, 0x7f, 0xf7, 0xff, 30, 30];

fn adapter(protocol: Protocol) -> Adapter {
    Adapter::new(protocol, &[MotorSpec::parse("5/15/DMH3510").unwrap()])
}

fn taken(adapter: &mut Adapter, now_ns: u64) -> Vec<Vec<u8>> {
    let mut all = Vec::new();
    loop {
        let mut transfer = Vec::new();
        if !adapter.take(1, 512, now_ns, &mut transfer) {
            return all;
        }
        all.push(transfer);
    }
}

fn start(adapter: &mut Adapter, brp: u32) {
    let words = |words: &[u32]| words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<u8>>();
    let setup = |request| Setup { kind: 0x41, request, value: 0, index: 0, length: 20 };
    adapter.control(setup(1), &words(&[5, 6, 4, 1, brp]), 0);
    adapter.control(setup(2), &words(&[1, 0]), 0);
}

fn actions(adapter: &mut Adapter) -> Vec<&'static str> {
    let mut reported = Vec::new();
    adapter.reported(&mut reported);
    reported.into_iter().map(|reported| reported.action).collect()
}

#[test]
fn configurations_add_up() {
    for protocol in [Protocol::GsUsb, Protocol::Slcan, Protocol::Damiao] {
        check_configuration(&adapter(protocol).configuration());
    }
}

#[test]
fn a_gs_usb_frame_comes_back_before_its_answer() {
    let mut adapter = adapter(Protocol::GsUsb);
    let frame = Frame::data(5, ZERO_MIT);
    adapter.receive(&gsusb::encode(&frame, 7), 0);
    assert_eq!(taken(&mut adapter, 0), Vec::<Vec<u8>>::new(), "it is not on the bus yet");
    start(&mut adapter, 3);
    adapter.receive(&gsusb::encode(&frame, 7), 0);
    let transfers: Vec<_> = taken(&mut adapter, 0).iter().map(|transfer| gsusb::decode(transfer)).collect();
    assert_eq!(transfers, [Some((7, frame)), Some((FROM_THE_BUS, Frame::data(0x15, RESTING)))]);
    assert_eq!(actions(&mut adapter), ["can_up", "commands_begin"]);
    adapter.reset();
    assert_eq!(actions(&mut adapter), ["can_down"]);
}

#[test]
fn a_wrong_bit_rate_reaches_no_motor() {
    let mut adapter = adapter(Protocol::GsUsb);
    start(&mut adapter, 6);
    adapter.receive(&gsusb::encode(&Frame::data(5, ZERO_MIT), 7), 0);
    assert_eq!(taken(&mut adapter, 0), Vec::<Vec<u8>>::new());
}

#[test]
fn frames_queued_while_bus_off_are_sent_afterwards() {
    let mut adapter = adapter(Protocol::GsUsb);
    start(&mut adapter, 3);
    assert!(adapter.apply(None, Order::BusOff(true), 0));
    adapter.receive(&gsusb::encode(&Frame::data(5, ZERO_MIT), 7), 0);
    assert_eq!(taken(&mut adapter, 0), [gsusb::bus_off(true).to_vec()]);
    adapter.apply(None, Order::BusOff(false), MS);
    assert_eq!(taken(&mut adapter, MS).len(), 3, "the adapter is back, the echo, the answer");
}

#[test]
fn serial_adapters_reach_the_same_motor() {
    let mut slcan = adapter(Protocol::Slcan);
    slcan.receive(b"S8\rO\rt00587FFF7FF0000007FF\rC\rt0050\r", 0);
    assert_eq!(taken(&mut slcan, 0), [b"\r\rz\rt0158057FFF7FF7FF1E1E\r\r\x07".to_vec()]);
    assert_eq!(actions(&mut slcan), ["can_up", "can_down", "commands_begin"]);

    let mut damiao = adapter(Protocol::Damiao);
    let mut bytes = [0; 30];
    bytes[..4].copy_from_slice(&[0x55, 0xaa, 0x1e, 0x03]);
    (bytes[13], bytes[18]) = (5, 8);
    bytes[21..29].copy_from_slice(&ZERO_MIT);
    damiao.receive(&bytes[..10], 0);
    damiao.receive(&bytes[10..], 0);
    let [transfer] = &taken(&mut damiao, 0)[..] else { panic!("one transfer") };
    assert_eq!((transfer.len(), &transfer[7..15]), (16, &RESTING[..]));
}

#[test]
fn a_motor_keeps_moving_when_the_adapter_is_pulled() {
    let mut adapter = adapter(Protocol::GsUsb);
    start(&mut adapter, 3);
    for bytes in [[0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfc], ZERO_MIT] {
        adapter.receive(&gsusb::encode(&Frame::data(5, bytes), 7), 0);
    }
    adapter.receive(&gsusb::encode(&Frame::data(0x7ff, [5, 0, 0x55, 9, 0x10, 0x27, 0, 0]), 7), 0);
    adapter.reset();
    assert_eq!(adapter.tend(MS), Some(100 * MS));
    assert_eq!(adapter.tend(100 * MS), Some(500 * MS));
    assert_eq!(adapter.tend(500 * MS), None);
    let reported = actions(&mut adapter);
    assert!(reported.ends_with(&["commands_end", "motor_timeout", "motor_fault"]), "{reported:?}");
}

#[test]
fn generated_frames_fill_transfers() {
    let mut adapter = adapter(Protocol::Slcan);
    adapter.apply(None, Order::Flood(8_000.0), 0);
    assert_eq!(taken(&mut adapter, 10 * MS).len(), 0, "no host listens");
    adapter.receive(b"S8\rO\r", 10 * MS);
    let bytes: Vec<u8> = taken(&mut adapter, 20 * MS).concat();
    let lines: Vec<&[u8]> = bytes.split(|byte| *byte == b'\r').filter(|line| line.len() > 5).collect();
    assert_eq!(lines.len(), 160);
    assert!(lines[0].starts_with(b"t7F0800000000") && lines[159].starts_with(b"t7F089F000000"));
}
