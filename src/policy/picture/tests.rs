use proptest::prelude::*;
use rapid_core::sample::Encoding;
use rapid_pictures::jpeg::Values;

use super::*;

const PLAIN: ImageSpec =
    ImageSpec { height: 2, width: 2, color: ColorOrder::Rgb, resize: None, crop: None, operation: None };

fn identity(spec: ImageSpec) -> Preprocessor {
    Preprocessor::new(spec, &Normalization::Identity)
}

fn picture(encoding: Encoding, [height, width]: [usize; 2], bytes: &[u8]) -> Picture<'_> {
    let side = |side: usize| u32::try_from(side).unwrap();
    Picture { encoding, width: side(width), height: side(height), bytes }
}

fn jpeg(pixels: &[u8], [height, width]: [usize; 2]) -> Vec<u8> {
    let mut jpeg = Vec::new();
    let side = |side: usize| u16::try_from(side).unwrap();
    rapid_pictures::jpeg::encode(pixels, [side(height), side(width)], Values::Rgb, 100, &mut jpeg).unwrap();
    jpeg
}

#[track_caller]
fn close(found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len());
    for (place, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert!((found - expected).abs() <= tolerance, "at {place}: {found}, expected {expected}");
    }
}

/// The same by the definition, one value after the other, of grey pixels: resized, then cropped.
fn plain_resize(pixels: &[u8], size: [usize; 2], resized: [usize; 2], wanted: [usize; 2]) -> Vec<f64> {
    let at = |row: usize, column: usize| f64::from(pixels[row * size[1] + column]) / 255.0;
    let source = |place: usize, axis: usize| {
        let source = (place as f64 + 0.5) * size[axis] as f64 / resized[axis] as f64 - 0.5;
        source.clamp(0.0, (size[axis] - 1) as f64)
    };
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "pixels of a small picture")]
    let neighbours = |source: f64| [source.floor() as usize, source.ceil() as usize];
    let mut whole = Vec::new();
    for row in 0..resized[0] {
        for column in 0..resized[1] {
            let (y, x) = (source(row, 0), source(column, 1));
            let mut value = 0.0;
            for near_y in neighbours(y).into_iter().collect::<std::collections::BTreeSet<_>>() {
                for near_x in neighbours(x).into_iter().collect::<std::collections::BTreeSet<_>>() {
                    let weight = (1.0 - (y - near_y as f64).abs()) * (1.0 - (x - near_x as f64).abs());
                    value += weight * at(near_y, near_x);
                }
            }
            whole.push(value);
        }
    }
    // Halves go to the even neighbour.
    let start = |axis: usize| {
        let rest = resized[axis] - wanted[axis];
        [rest / 2, rest.div_ceil(2)]
            .into_iter()
            .find(|start| rest.is_multiple_of(2) || start.is_multiple_of(2))
            .unwrap()
    };
    let [top, left] = [start(0), start(1)];
    let rows = top..top + wanted[0];
    rows.flat_map(|row| whole[row * resized[1] + left..][..wanted[1]].to_vec()).collect()
}

proptest! {
    #[test]
    fn resizing_and_cropping_follow_their_definition(
        size in (1..12_usize, 1..12_usize), resized in (1..12_usize, 1..12_usize),
        cropped in (1..12_usize, 1..12_usize), pixels in proptest::collection::vec(any::<u8>(), 144),
    ) {
        let (size, resized) = ([size.0, size.1], [resized.0, resized.1]);
        let wanted = [cropped.0.min(resized[0]), cropped.1.min(resized[1])];
        let pixels = &pixels[..size[0] * size[1]];
        let spec = ImageSpec { height: wanted[0], width: wanted[1], resize: Some(resized), crop: Some(wanted), ..PLAIN };
        let mut preprocessor = identity(spec);
        let mut out = vec![0.0; preprocessor.output_len()];
        preprocessor.write(&picture(Encoding::Grey, size, pixels), &mut out).unwrap();
        let expected = plain_resize(pixels, size, resized, wanted);
        for plane in out.chunks_exact(wanted[0] * wanted[1]) {
            for (found, expected) in plane.iter().zip(&expected) {
                prop_assert!((f64::from(*found) - expected).abs() < 1e-6, "{found} {expected}");
            }
        }
    }

    #[test]
    fn damaged_pictures_are_refused_or_decoded_without_a_panic(
        places in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..20),
        cut in any::<prop::sample::Index>(),
    ) {
        let pixels: Vec<u8> = (0..3 * 32 * 24).map(|at| u8::try_from(at * 7 % 251).unwrap()).collect();
        let mut bytes = jpeg(&pixels, [24, 32]);
        for (place, value) in places {
            let at = place.index(bytes.len());
            bytes[at] = value;
        }
        bytes.truncate(1 + cut.index(bytes.len()));
        let mut preprocessor = identity(ImageSpec { resize: Some([2, 2]), ..PLAIN });
        let mut out = [7.0; 12];
        match preprocessor.write(&picture(Encoding::Mjpeg, [24, 32], &bytes), &mut out) {
            Ok(()) => prop_assert!(out.iter().all(|value| (0.0..=1.0).contains(value))),
            Err(_) => prop_assert!(out.iter().all(|value| value.to_bits() == 7.0_f32.to_bits())),
        }
    }
}

#[test]
fn channels_are_planar_in_the_order_of_the_bundle() {
    // Red, green, blue, white; a JPEG of large even patches keeps their colours.
    let patches = [[250, 10, 20], [10, 250, 20], [20, 10, 250], [255, 255, 255]];
    let (size, mut pixels) = ([64, 64], Vec::new());
    for row in 0..64 {
        for column in 0..64 {
            pixels.extend(patches[2 * (row / 32) + column / 32]);
        }
    }
    let bytes = jpeg(&pixels, size);
    for (color, order) in [(ColorOrder::Rgb, [0, 1, 2]), (ColorOrder::Bgr, [2, 1, 0])] {
        let mut preprocessor = identity(ImageSpec { color, resize: Some([2, 2]), ..PLAIN });
        let mut out = [0.0; 12];
        preprocessor.write(&picture(Encoding::Mjpeg, size, &bytes), &mut out).unwrap();
        let expected: Vec<f32> =
            order.into_iter().flat_map(|channel| patches.map(|patch| f32::from(patch[channel]) / 255.0)).collect();
        close(&out, &expected, 0.012);
    }
}

#[test]
fn yuyv_is_bt_601_of_limited_range() {
    let mut preprocessor = identity(ImageSpec { height: 1, ..PLAIN });
    let mut out = [0.0; 6];
    // Black and white; then the red of the standard's colour bars and its grey.
    preprocessor.write(&picture(Encoding::Yuyv, [1, 2], &[16, 128, 235, 128]), &mut out).unwrap();
    close(&out, &[0.0, 1.0, 0.0, 1.0, 0.0, 1.0], 1e-6);
    preprocessor.write(&picture(Encoding::Yuyv, [1, 2], &[81, 90, 81, 240]), &mut out).unwrap();
    close(&out, &[1.0, 1.0, 0.0, 0.0, 0.0, 0.0], 1.01 / 255.0);
}

#[test]
fn the_first_picture_is_the_reference_until_a_new_episode() {
    let spec = ImageSpec { operation: Some(Operation::DiffToReference), ..PLAIN };
    let mut preprocessor = Preprocessor::new(spec, &Normalization::MinMax { min: vec![0.0; 3], max: vec![1.0; 3] });
    let mut out = [0.0; 12];
    let mut write = |preprocessor: &mut Preprocessor, grey: u8| {
        preprocessor.write(&picture(Encoding::Grey, [2, 2], &[grey; 4]), &mut out).unwrap();
        out[5]
    };
    assert!(!preprocessor.reference().unwrap().taken);
    close(&[write(&mut preprocessor, 51), write(&mut preprocessor, 255)], &[0.0, 0.8], 1e-6);
    close(&[write(&mut preprocessor, 0)], &[-0.2], 1e-6);
    // A damaged picture does not become the reference.
    preprocessor.reference().unwrap().reset();
    assert!(preprocessor.write(&picture(Encoding::Mjpeg, [2, 2], b"no picture"), &mut [0.0; 12]).is_err());
    assert!(!preprocessor.reference().unwrap().taken);
    close(&[write(&mut preprocessor, 255), write(&mut preprocessor, 0)], &[0.0, -1.0], 1e-6);
}

#[test]
fn normalisation_is_by_channel() {
    let pixels: Vec<u8> = [[51, 102, 255]; 4].concat();
    let write = |normalization: &Normalization| {
        let mut preprocessor = Preprocessor::new(PLAIN, normalization);
        let mut out = [0.0; 12];
        let bytes = jpeg(&pixels, [2, 2]);
        preprocessor.write(&picture(Encoding::Mjpeg, [2, 2], &bytes), &mut out).unwrap();
        [out[0], out[4], out[8]]
    };
    let min_max = Normalization::MinMax { min: vec![0.0, 0.2, 0.5], max: vec![1.0, 0.6, 1.0] };
    close(&write(&min_max), &[-0.6, 0.0, 1.0], 0.02);
    let mean_std = Normalization::MeanStd { mean: vec![0.1, 0.4, 0.5], std: vec![0.1, 0.5, 0.4], eps: 0.1 };
    close(&write(&mean_std), &[0.5, 0.0, 1.0], 0.03);
}

#[test]
fn unsuitable_pictures_are_refused_with_their_reason() {
    let grey = vec![9; 6];
    let whole = jpeg(&vec![90; 3 * 16 * 16], [16, 16]);
    let cases: [(Picture<'_>, &str); 7] = [
        (picture(Encoding::F64, [2, 2], &grey), "the samples are F64, not pictures"),
        (picture(Encoding::Grey, [2, 2], &grey), "6 bytes, where a picture of 2x2 has 4"),
        (picture(Encoding::Yuyv, [1, 3], &grey), "damaged picture: an odd number of pixels in YUYV"),
        (picture(Encoding::Grey, [0, 2], &[]), "damaged picture: 2x0 pixels"),
        (
            picture(Encoding::Grey, [2, 3], &grey),
            "a picture of 3x2, where the policy takes 2x2: set the camera to that",
        ),
        (
            picture(Encoding::Mjpeg, [2, 2], &whole),
            "damaged picture: [16, 16] pixels across and down in a sample of [2, 2]",
        ),
        (picture(Encoding::Mjpeg, [16, 16], &whole[..whole.len() / 2]), "damaged picture: "),
    ];
    for (picture, expected) in cases {
        let error = identity(PLAIN).write(&picture, &mut [0.0; 12]).unwrap_err().to_string();
        assert!(error.starts_with(expected), "{error}");
    }
    let cropped = ImageSpec { crop: Some([2, 2]), ..PLAIN };
    assert!(identity(cropped).write(&picture(Encoding::Grey, [1, 6], &grey), &mut [0.0; 12]).is_err());
    identity(cropped).write(&picture(Encoding::Grey, [2, 3], &grey), &mut [0.0; 12]).unwrap();
}

#[test]
fn a_truncated_picture_is_not_padded_with_grey() {
    let pixels: Vec<u8> = (0..3 * 64 * 64).map(|at| u8::try_from(at * 31 % 253).unwrap()).collect();
    let whole = jpeg(&pixels, [64, 64]);
    let mut preprocessor = identity(ImageSpec { resize: Some([2, 2]), ..PLAIN });
    for share in [2, 3, 5, 8, 12] {
        let cut = &whole[..whole.len() - whole.len() / share];
        let result = preprocessor.write(&picture(Encoding::Mjpeg, [64, 64], cut), &mut [0.0; 12]);
        assert!(matches!(result, Err(PictureError::Pixels(PixelError::Damaged(_)))), "without 1/{share}");
    }
}
