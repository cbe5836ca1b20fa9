use proptest::prelude::*;
use rapid_core::sample::FLAG_ERROR;
use rapid_core::time::Stamp;

use super::*;

fn spec(format: PixelFormat) -> CameraSpec {
    CameraSpec { width: 640, height: 480, fps: 30, format, depth_unit_um: 1000, controls: Vec::new() }
}

fn agreed(fourcc: [u8; 4], width: u32, rate: Option<(u32, u32)>) -> Agreed {
    let rate = rate.map(|(numerator, denominator)| Rate::of_interval(numerator, denominator));
    Agreed { fourcc, width, height: 480, bytes_per_line: 1280, rate }
}

fn frame(sequence: u32, stamp: Option<u64>) -> Frame {
    Frame { sequence, bytes_used: 10, is_damaged: false, stamp: stamp.map(Stamp) }
}

fn layout(format: PixelFormat, width: u32, height: u32, stride: usize) -> Layout {
    Layout { format, width, height, stride }
}

#[test]
fn only_the_requested_format_is_accepted() {
    let mjpg = spec(PixelFormat::Mjpg);
    assert!(agreed(*b"MJPG", 640, Some((1, 30))).accept(&mjpg).is_some());
    assert!(agreed(*b"MJPG", 640, Some((1001, 30000))).accept(&mjpg).is_some(), "29.97 is called 30");
    assert!(agreed(*b"MJPG", 640, None).accept(&mjpg).is_some(), "a driver that sets no rates");
    assert!(agreed(*b"MJPG", 640, Some((1, 15))).accept(&mjpg).is_none());
    assert!(agreed(*b"MJPG", 640, Some((0, 0))).accept(&mjpg).is_none());
    assert!(agreed(*b"MJPG", 800, Some((1, 30))).accept(&mjpg).is_none());
    assert!(agreed(*b"YUYV", 640, Some((1, 30))).accept(&mjpg).is_none());
}

#[test]
fn the_error_lists_offered_formats_and_the_setting_to_change() {
    let size = Size::One { width: 1280, height: 720 };
    let rates = Rates::List(vec![Rate::of_interval(1, 30), Rate::of_interval(1, 15)]);
    let yuyv = Size::Range { smallest: (2, 2), largest: (640, 480) };
    let offered = [
        Mode { fourcc: "MJPG".into(), size, rates },
        Mode { fourcc: "YUYV".into(), size: yuyv, rates: Rates::List(vec![Rate::of_interval(1001, 30000)]) },
    ];
    assert_eq!(
        not_offered("cam_wrist", &spec(PixelFormat::Mjpg), Path::new("/dev/video0"), &offered),
        "/dev/video0 offers no MJPG 640x480 at 30 fps; it offers MJPG 1280x720 at 15, 30 fps; YUYV 2x2 to 640x480 at \
         29.97 fps - set format, width, height and fps in [device.cam_wrist.camera]"
    );
}

#[test]
fn a_camera_is_listed_in_three_lines() {
    let info = CameraInfo {
        path: "/dev/video2".into(),
        name: "C270".into(),
        driver: "uvcvideo".into(),
        modes: vec![Mode {
            fourcc: "GREY".into(),
            size: Size::One { width: 8, height: 4 },
            rates: Rates::List(vec![Rate::of_interval(2, 15)]),
        }],
        controls: vec![control("Gain", 0, 255)],
    };
    assert_eq!(
        info.to_string(),
        "/dev/video2 C270 (uvcvideo)\n  formats: GREY 8x4 at 7.5 fps\n  controls: Gain 0..=255 (default 0)"
    );
}

fn control(name: &str, minimum: i64, maximum: i64) -> ControlInfo {
    ControlInfo { id: 1, name: name.to_owned(), minimum, maximum, step: 1, default: 0 }
}

#[test]
fn controls_are_found_by_any_spelling_of_their_name() {
    let offered = [control("White Balance, Automatic", 0, 1), control("Exposure Time, Absolute", 3, 2047)];
    for name in ["white_balance_automatic", "White Balance, Automatic", "WHITE BALANCE AUTOMATIC"] {
        assert_eq!(
            find_control(&offered, name, 1).map(|control| control.name.as_str()),
            Ok("White Balance, Automatic")
        );
    }
    let unknown = find_control(&offered, "zoom", 1).unwrap_err();
    assert_eq!(unknown, "no control zoom; it offers white_balance_automatic, exposure_time_absolute");
    assert!(find_control(&offered, "exposure_time_absolute", 1).unwrap_err().contains("3..=2047"));
    assert!(find_control(&[], "zoom", 1).unwrap_err().contains("offers none"));
}

#[test]
fn row_padding_is_removed() {
    let padded = layout(PixelFormat::Yuyv, 2, 2, 6);
    assert!(padded.is_padded());
    assert_eq!(padded.picture_bytes(), 8);
    let bytes = [1, 2, 3, 4, 0, 0, 5, 6, 7, 8, 0, 0];
    let mut rows = Vec::new();
    for whole in [&bytes[..], &bytes[..10]] {
        assert_eq!(frame(0, None).flags(padded, whole), 0, "padding of the last row may be missing");
        padded.compact(whole, &mut rows);
        assert_eq!(rows, [1, 2, 3, 4, 5, 6, 7, 8]);
    }
    assert_eq!(frame(0, None).flags(padded, &bytes[..9]), FLAG_ERROR);
    padded.compact(&bytes[..9], &mut rows);
    assert_eq!(rows, [1, 2, 3, 4, 5, 6, 7]);
    let tight = layout(PixelFormat::Grey, 4, 2, 4);
    assert!(!tight.is_padded());
    assert_eq!(frame(0, None).flags(tight, &[0; 8]), 0);
    assert_eq!(frame(0, None).flags(tight, &[0; 7]), FLAG_ERROR);
    assert!(!layout(PixelFormat::Mjpg, 640, 480, 1280).is_padded(), "compressed pictures have no rows");
}

#[test]
fn damaged_pictures_are_flagged() {
    let mjpg = layout(PixelFormat::Mjpg, 640, 480, 0);
    assert_eq!(frame(0, None).flags(mjpg, &[0xff, 0xd8, 0xff]), 0);
    assert_eq!(frame(0, None).flags(mjpg, &[0, 0, 0]), FLAG_ERROR);
    let damaged = Frame { is_damaged: true, ..frame(0, None) };
    assert_eq!(damaged.flags(mjpg, &[0xff, 0xd8]), FLAG_ERROR);
}

#[test]
fn gaps_and_empty_pictures_are_lost_pictures() {
    let mut progress = Numbering::default();
    assert_eq!(progress.accept(5), 0, "samples before the first are unknown");
    assert_eq!(progress.accept(6), 0);
    assert_eq!(progress.accept(9), 2);
    progress.skip(10);
    assert_eq!(progress.accept(11), 1);
    progress.skip(14);
    assert_eq!(progress.accept(15), 3);
    assert_eq!(progress.accept(15), 0, "a driver that does not count");
    let mut wrapping = Numbering::default();
    wrapping.accept(u32::MAX);
    assert_eq!(wrapping.accept(1), 1);
}

#[test]
fn the_kernels_time_is_used_where_it_is_plausible() {
    let mut progress = Numbering::default();
    assert_eq!(progress.stamp(&frame(0, Some(100)), Stamp(110)), (Stamp(100), true));
    assert_eq!(progress.stamp(&frame(1, None), Stamp(120)), (Stamp(120), false));
    assert_eq!(progress.stamp(&frame(2, Some(500)), Stamp(130)), (Stamp(130), false), "in the future");
    assert_eq!(progress.stamp(&frame(3, Some(90)), Stamp(140)), (Stamp(140), false), "before the last");
    assert_eq!(progress.stamp(&frame(4, Some(145)), Stamp(150)), (Stamp(145), true));
}

/// An error in a picture's stamp.
#[derive(Debug, Clone, Copy)]
enum StampError {
    None,
    Later,
    Earlier,
}

proptest! {
    /// Pictures every 33 ms that arrive `delay` after their capture, some of the first with wrong stamps: capture times
    /// increase, and every kernel stamp later than `delay` after the last wrong one is used.
    #[test]
    fn a_wrong_stamp_is_off_by_no_more_than_its_delay(
        delay in 0..200_u64,
        wrong in proptest::collection::vec(
            prop_oneof![Just(StampError::None), Just(StampError::None), Just(StampError::Later), Just(StampError::Earlier)], 1..12),
    ) {
        const FRAME: u64 = 33;
        const BEGIN: u64 = 10_000;
        let mut progress = Numbering::default();
        let mut last = Stamp(0);
        let mut safe_from = 0;
        for number in 0..40_u64 {
            let captured = BEGIN + number * FRAME;
            let arrived = captured + delay;
            let (report, is_wrong) = match wrong.get(usize::try_from(number).unwrap()) {
                Some(StampError::Later) => (arrived + 1000, true),
                Some(StampError::Earlier) => (captured.saturating_sub(BEGIN / 2), true),
                Some(StampError::None) | None => (captured, false),
            };
            let (stamp, is_kernels) = progress.stamp(&frame(0, Some(report)), Stamp(arrived));
            prop_assert!(stamp > last, "{stamp:?} after {last:?}");
            last = stamp;
            if is_wrong {
                // Moved by at most a nanosecond per picture.
                safe_from = arrived + 40;
            } else if captured > safe_from {
                prop_assert_eq!((stamp, is_kernels), (Stamp(captured), true), "picture {}", number);
            }
        }
    }
}

#[test]
fn one_bad_first_stamp_does_not_shift_a_camera_whose_pictures_take_longer_than_a_frame() {
    let mut progress = Numbering::default();
    assert_eq!(progress.stamp(&frame(0, Some(999)), Stamp(100)), (Stamp(100), false), "in the future");
    let used: Vec<bool> =
        (1..10).map(|number| progress.stamp(&frame(0, Some(number * 33)), Stamp(100 + number * 33)).1).collect();
    assert_eq!(used, [false, false, false, true, true, true, true, true, true]);
}
