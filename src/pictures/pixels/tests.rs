use super::*;

#[test]
fn depth_is_shades_and_its_length_is_checked() {
    let bytes = [0_u16, 1, 16, 4080, u16::MAX, 160].map(u16::to_le_bytes).concat();
    let mut pixels = Pixels::default();
    let picture = |bytes| Picture { encoding: Encoding::Depth, width: 3, height: 2, bytes };
    assert_eq!(pixels.decode(&picture(&bytes)), Ok([2, 3]));
    let shades: Vec<u8> = pixels.values().iter().step_by(CHANNELS).copied().collect();
    assert_eq!(shades, [0, 255, 254, 0, 0, 245]);
    assert!(pixels.decode(&picture(&bytes[1..])).is_err());
}

#[test]
fn yuyv_is_bt_601_of_limited_range() {
    for value in 0..=255_u8 {
        let [y, u, v] = [f64::from(value) - 16.0, f64::from(255 - value) - 128.0, f64::from(value / 2) - 128.0];
        let y = y * 255.0 / 219.0;
        let expected = [y + 1.596_027 * v, y - 0.391_762 * u - 0.812_968 * v, y + 2.017_232 * u];
        let found = colors(&[value, 255 - value, value, value / 2]);
        for (found, expected) in found.iter().zip(expected) {
            assert!((f64::from(*found) - expected.clamp(0.0, 255.0)).abs() <= 0.51, "{value}: {found} {expected}");
        }
    }
}

/// How far pixels are from those that training sees.
#[derive(Debug)]
struct Apart {
    /// Largest difference, of 255, without the last row and column.
    inside: u8,
    /// The same in the last row and column.
    at_edge: u8,
    /// Share of the values that differ.
    share: f64,
}

impl Apart {
    /// Decoded `found` compared with `expected`, both red, green and blue of each pixel, row by row.
    fn between(found: &[u8], expected: &[u8], [height, width]: [usize; 2]) -> Self {
        assert_eq!(found.len(), expected.len());
        let differences = found.iter().zip(expected).enumerate().map(|(at, (found, expected))| {
            let pixel = at / CHANNELS;
            (found.abs_diff(*expected), pixel / width == height - 1 || pixel % width == width - 1)
        });
        let differences: Vec<(u8, bool)> = differences.collect();
        let largest = |edge: bool| {
            let part = differences.iter().filter(|(_, is_at_edge)| *is_at_edge == edge);
            part.map(|(difference, _)| *difference).max().unwrap_or(0)
        };
        let different = differences.iter().filter(|(difference, _)| *difference > 0).count();
        Self { inside: largest(false), at_edge: largest(true), share: different as f64 / differences.len() as f64 }
    }

    fn is_within(&self, bound: &Self) -> bool {
        self.inside <= bound.inside && self.at_edge <= bound.at_edge && self.share <= bound.share
    }
}

/// Height, width and pixels of a picture in the binary form of PPM: three lines of text, then red, green and blue.
fn ppm(bytes: &[u8]) -> ([usize; 2], &[u8]) {
    let mut parts = bytes.splitn(4, |byte| *byte == b'\n');
    let [_, size, _, pixels] = [(); 4].map(|()| parts.next().unwrap());
    let mut sides = std::str::from_utf8(size).unwrap().split(' ').map(|side| side.parse::<usize>().unwrap());
    let (width, height) = (sides.next().unwrap(), sides.next().unwrap());
    ([height, width], pixels)
}

/// Training decodes with Pillow, which made `tests/golden/jpeg` (`models/tests/test_jpeg_golden.py`). The decoders round at
/// different places. Where colours are sampled at every second pixel, zune-jpeg rounds halves up, and libjpeg-turbo up and
/// down in turns. Where a picture ends within a block, libjpeg-turbo repeats the last colour, and zune-jpeg takes the rest of
/// the block, which is not part of the picture.
#[test]
fn pictures_differ_from_those_of_training_by_no_more_than_documented() {
    let cases = [
        ("task_wrist", Apart { inside: 3, at_edge: 3, share: 0.015 }),
        ("task_tactile", Apart { inside: 3, at_edge: 3, share: 0.015 }),
        ("camera_422", Apart { inside: 4, at_edge: 4, share: 0.17 }),
        ("camera_420", Apart { inside: 4, at_edge: 4, share: 0.30 }),
        ("cut_422", Apart { inside: 4, at_edge: 10, share: 0.17 }),
        ("cut_420", Apart { inside: 4, at_edge: 10, share: 0.30 }),
    ];
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/jpeg");
    for (name, bound) in cases {
        let read = |kind: &str| std::fs::read(folder.join(format!("{name}.{kind}"))).unwrap();
        let (jpeg, file) = (read("jpg"), read("ppm"));
        let (size, rgb) = ppm(&file);
        let mut pixels = Pixels::default();
        let [height, width] = size.map(|side| u32::try_from(side).unwrap());
        pixels.decode(&Picture { encoding: Encoding::Mjpeg, width, height, bytes: &jpeg }).unwrap();
        let found = Apart::between(pixels.values(), rgb, size);
        println!("{name}: {found:?}");
        assert!(found.is_within(&bound), "{name}: {found:?}, not within {bound:?}");
        // The check can fail: one pixel further to the right nothing fits.
        let moved = [&rgb[rgb.len() - CHANNELS..], &rgb[..rgb.len() - CHANNELS]].concat();
        let found = Apart::between(pixels.values(), &moved, size);
        assert!(found.inside > bound.inside && found.share > bound.share, "{name}: {found:?}");
    }
}
