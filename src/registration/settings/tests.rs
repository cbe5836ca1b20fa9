//! What the entries of connected units would contain.

use std::path::PathBuf;
use std::sync::Arc;

use rapid_devices::driver::camera::Mode;
use rapid_registry::simulation::SimDevice;

use super::*;

#[test]
fn a_camera_is_configured_with_a_format_it_offers() {
    let mode = |fourcc: &str, width, height, rates: &[u32]| Mode {
        fourcc: fourcc.into(),
        size: Size::One { width, height },
        rates: Rates::List(rates.iter().map(|frames| Rate { frames: *frames, seconds: 1 }).collect()),
    };
    for (modes, expected) in [
        (vec![mode("YUYV", 640, 480, &[30]), mode("MJPG", 1280, 720, &[30, 60])], Some((1280, 720, 30, "MJPG"))),
        (vec![mode("MJPG", 320, 240, &[30]), mode("MJPG", 640, 480, &[25, 60])], Some((640, 480, 25, "MJPG"))),
        (vec![mode("GREY", 400, 400, &[])], Some((400, 400, 30, "GREY"))),
        (vec![mode("H264", 640, 480, &[30])], None),
        (Vec::new(), None),
    ] {
        let camera = CameraInfo {
            path: PathBuf::new(),
            name: String::new(),
            driver: String::new(),
            modes,
            controls: Vec::new(),
        };
        assert_eq!(best(&camera), expected);
    }
    let range = Rates::Range { slowest: Rate { frames: 5, seconds: 1 }, fastest: Rate { frames: 15, seconds: 1 } };
    assert_eq!(fps(&range), 15);
    let sim = SimSource::Serial { channels: 4, hz: 10, seed: 1 };
    let sim = DeviceNode::Sim(Arc::new(SimDevice::new("x", sim, rapid_core::time::Stamp(0))));
    assert_eq!(suggested(&sim, None), serial_settings("csv", 4));
}

#[test]
fn lines_are_recognised_as_numbers_or_not() {
    let look = |lines: &[&str]| {
        let lines: Vec<Vec<u8>> = lines.iter().map(|line| line.as_bytes().to_vec()).collect();
        lines_look_like(&lines)
    };
    assert_eq!(look(&["cut", "1, 2.5,-3", "4,5,6"]), Some(serial_settings("csv", 3)));
    assert_eq!(look(&["", "[1,2]", "[3,4]"]), Some(serial_settings("json", 2)));
    assert_eq!(look(&["", "{\"a\":1,\"b\":\"x\"}"]), Some(serial_settings("json", 1)));
    for lines in [&["1,2"][..], &["", "hello"], &["", "1,2", "1,2,3"], &["", "{}"], &[]] {
        assert_eq!(look(lines), None, "{lines:?}");
    }
    assert_eq!(lines_look_like(&[vec![], vec![0xff, 0xfe]]), None);
}
