use super::*;
use crate::emu::descriptor::{CS_INTERFACE, check_configuration, walk};
use crate::emu::frame::{self, FrameId, first_number};
use crate::emu::source::Source;
use crate::emu::spec::{Format, Mode};
use crate::emu::uvc::Pictures;

/// A camera for depth and one for colour.
fn pair() -> Cameras {
    let content = |format, fps| vec![(Mode { format, width: 64, height: 48, fps: vec![fps] }, Pictures::default())];
    Cameras::new(vec![content(Format::Z16, 15), content(Format::Yuyv, 30)], first_number(2))
}

fn commit(interface: u16) -> Setup {
    Setup { kind: 0x21, request: 1, value: 0x0200, index: interface, length: 26 }
}

fn live(cameras: &mut Cameras) -> [bool; 2] {
    [0, 1].map(|place| cameras.at(place).is_some_and(|camera| camera.live().is_some()))
}

fn identity(cameras: &mut Cameras, place: u8) -> FrameId {
    let mut frame = Vec::new();
    cameras.at(place).unwrap().produce(7, &mut frame);
    frame::identity(&frame).unwrap()
}

#[test]
fn each_camera_has_its_own_interfaces_and_endpoint() {
    let bytes = pair().configuration();
    check_configuration(&bytes);
    let of = |kind: u8, at: usize| walk(&bytes).filter(|d| d[1] == kind).map(|d| d[at]).collect::<Vec<_>>();
    assert_eq!((of(11, 2), of(11, 3)), (vec![0, 2], vec![2, 2]), "interface associations");
    assert_eq!(of(4, 2), [0, 1, 2, 3], "interfaces");
    assert_eq!(of(5, 2), [0x81, 0x82], "endpoints");
    // Class-specific headers, with one streaming interface and one format: of 13 bytes for control, of 14 for streaming.
    let headers = |length: u8, at: usize| {
        walk(&bytes).filter(|d| d[..3] == [length, CS_INTERFACE, 1]).map(|d| d[at]).collect::<Vec<_>>()
    };
    assert_eq!(headers(13, 12), [1, 3], "baInterfaceNr");
    assert_eq!(headers(14, 6), [0x81, 0x82], "bEndpointAddress");
}

#[test]
fn a_request_reaches_only_the_camera_of_its_interface() {
    let mut cameras = pair();
    assert_eq!(live(&mut cameras), [false, false]);
    assert_eq!(cameras.control(commit(3), &[]), Answer::Done);
    assert_eq!(live(&mut cameras), [false, true]);
    assert_eq!(cameras.control(commit(1), &[]), Answer::Done);
    assert_eq!(live(&mut cameras), [true, true]);
    let periods = [0, 1].map(|place| cameras.at(place).unwrap().live().unwrap().period.as_millis());
    assert_eq!(periods, [66, 33]);
    for nobodys in [0, 2, 4, 5] {
        assert_eq!(cameras.control(commit(nobodys), &[]), Answer::Stall, "interface {nobodys}");
    }
    // Brightness: of the second camera, whose control interface is 2.
    let ask = |interface: u16| Setup { kind: 0xa1, request: 0x81, value: 0x0200, index: 0x0300 | interface, length: 2 };
    assert_eq!(cameras.control(Setup { kind: 0x21, request: 1, ..ask(2) }, &[5, 0]), Answer::Done);
    assert_eq!(cameras.control(ask(2), &[]), Answer::Data(vec![5, 0]));
    assert_eq!(cameras.control(ask(0), &[]), Answer::Data(vec![0, 0]));
}

#[test]
fn a_stream_ends_at_its_own_endpoint() {
    let mut cameras = pair();
    for interface in [1, 3] {
        cameras.control(commit(interface), &[]);
    }
    cameras.halt_cleared(0x02);
    assert_eq!(live(&mut cameras), [true, true]);
    cameras.halt_cleared(0x81);
    assert_eq!(live(&mut cameras), [false, true]);
    cameras.stop();
    assert_eq!(live(&mut cameras), [false, false]);
}

#[test]
fn each_camera_counts_its_own_frames() {
    let mut cameras = pair();
    for sent in 0..3 {
        let ids = [0, 1].map(|place| identity(&mut cameras, place));
        assert_eq!(ids.map(|id| (id.device(), id.camera())), [(2, 0), (2, 1)]);
        assert_eq!(ids.map(|id| id.number), [2_000_000 + sent, 2_250_000]);
        cameras.at(0).unwrap().sent();
    }
    assert!(cameras.at(2).is_none());
}
