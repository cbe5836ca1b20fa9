use super::*;

#[test]
fn the_phones_measurements_are_in_the_picture() {
    let mut pose = [0.5_f32; 16];
    (pose[0], pose[1], pose[2]) = (f32::NAN, f32::MAX, f32::MIN_POSITIVE);
    let frame = Frame { pose, device_time: f64::MAX, wall_clock: 1_700_000_000.25 };
    let mut output = Vec::new();
    assert!(annotate(&[0xff, 0xd8, 0xff, 0xda, 7], &frame, &mut output));
    assert!(output.len() < COMMENT, "{}", output.len());
    assert!(output.starts_with(&[0xff, 0xd8, 0xff, 0xfe]) && output.ends_with(&[0xff, 0xda, 7]));
    let length = usize::from(u16::from_be_bytes([output[4], output[5]]));
    let comment: serde_json::Value = serde_json::from_slice(&output[6..4 + length]).expect("JSON");
    assert_eq!(comment["pose"].as_array().map(Vec::len), Some(16));
    assert!(comment["pose"][0].is_null());
    assert_eq!(comment["pose"][3], 0.5);
    assert_eq!(comment["wall_clock"], 1_700_000_000.25);
    assert_eq!(&output[4 + length..], [0xff, 0xda, 7]);
    output.clear();
    assert!(!annotate(b"no picture", &frame, &mut output));
    assert_eq!(output, b"no picture");
}
