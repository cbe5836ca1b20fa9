use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

use super::*;

/// Pictures of 83x61 pixels by libjpeg: progressive ones refine their coefficients, which the encoder here never does.
const GOLDEN: [(&str, u8, &[u8]); 6] = [
    ("cmyk", 4, include_bytes!("golden/cmyk.jpg")),
    ("optimized_420", 3, include_bytes!("golden/optimized_420.jpg")),
    ("progressive_420", 3, include_bytes!("golden/progressive_420.jpg")),
    ("progressive_grey", 1, include_bytes!("golden/progressive_grey.jpg")),
    ("progressive_restart", 3, include_bytes!("golden/progressive_restart.jpg")),
    ("restart_422", 3, include_bytes!("golden/restart_422.jpg")),
];

/// Numbers that look random and are always the same.
struct Numbers(u64);

impl Numbers {
    fn below(&mut self, limit: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        usize::try_from(self.0 >> 33).unwrap() % limit
    }
}

fn encoded(change: impl FnOnce(&mut Encoder<&mut Vec<u8>>)) -> Vec<u8> {
    let (width, height) = (160_u16, 121_u16);
    let mut numbers = Numbers(7);
    let mut pixels = Vec::new();
    for row in 0..usize::from(height) {
        for column in 0..usize::from(width) {
            let noise = numbers.below(40);
            pixels.extend(
                [column + noise, row + noise, usize::midpoint(column, row)]
                    .map(|value| u8::try_from(value.min(255)).unwrap()),
            );
        }
    }
    let mut jpeg = Vec::new();
    let mut encoder = Encoder::new(&mut jpeg, 85);
    change(&mut encoder);
    encoder.encode(&pixels, width, height, ColorType::Rgb).unwrap();
    jpeg
}

fn variants() -> Vec<(String, Vec<u8>)> {
    use SamplingFactor::{F_1_1, F_1_2, F_2_1, F_2_2, F_4_1, F_4_2};
    let mut all = Vec::new();
    for sampling in [F_1_1, F_1_2, F_2_1, F_2_2, F_4_1, F_4_2] {
        for (progressive, restart, optimized) in [
            (false, 0, false),
            (false, 7, false),
            (false, 1, false),
            (false, 0, true),
            (true, 0, false),
            (true, 0, true),
            (true, 5, false),
        ] {
            let jpeg = encoded(|encoder| {
                encoder.set_sampling_factor(sampling);
                encoder.set_progressive(progressive);
                encoder.set_restart_interval(restart);
                encoder.set_optimized_huffman_tables(optimized);
            });
            all.push((format!("{sampling:?} progressive {progressive} restart {restart} optimized {optimized}"), jpeg));
        }
    }
    all
}

/// The picture without the segments of this marker, or with bytes in front of each.
fn segments(jpeg: &[u8], mut change: impl FnMut(u8, &[u8]) -> Vec<u8>) -> Vec<u8> {
    let (mut out, mut at) = (jpeg[..2].to_vec(), 2);
    loop {
        let marker = jpeg[at + 1];
        let end = at + 2 + usize::from(u16::from_be_bytes([jpeg[at + 2], jpeg[at + 3]]));
        out.extend(change(marker, &jpeg[at..end]));
        at = end;
        if marker == 0xda {
            return [&out, &jpeg[at..]].concat();
        }
    }
}

/// Where the entropy-coded data of a picture with one scan begin.
fn data(jpeg: &[u8]) -> usize {
    let scan = jpeg.windows(2).position(|pair| pair == [0xff, 0xda]).unwrap();
    scan + 2 + usize::from(u16::from_be_bytes([jpeg[scan + 2], jpeg[scan + 3]]))
}

#[test]
fn whole_pictures_of_every_way_of_coding_are_whole() {
    let mut walker = Walker::default();
    for (name, jpeg) in variants() {
        let expected = Frame { width: 160, height: 121, components: 3, length: jpeg.len() };
        assert_eq!(walker.walk(&jpeg), Ok(expected), "{name}");
    }
    for (name, components, jpeg) in GOLDEN {
        let frame = Frame { width: 83, height: 61, components, length: jpeg.len() };
        // Nothing here uses four colours.
        let expected =
            if components == 4 { Err(Damage::Unsupported("neither grey nor of three colours")) } else { Ok(frame) };
        assert_eq!(walker.walk(jpeg), expected, "{name}");
    }
}

#[test]
fn what_cameras_add_belongs_to_no_picture() {
    let plain = encoded(|_| {});
    let length = plain.len();
    let mut walker = Walker::default();
    for tail in [&b"\r\n"[..], &[0xff; 16], &[0; 300], b"t=12.5", &plain, &plain[99..]] {
        assert_eq!(walker.walk(&[&plain, tail].concat()).map(|frame| frame.length), Ok(length), "{tail:?}");
    }
    let without_tables = segments(&plain, |marker, bytes| if marker == 0xc4 { Vec::new() } else { bytes.to_vec() });
    assert!(without_tables.len() < length - 300);
    let filled = segments(&plain, |_, bytes| [&[0xff, 0xff], bytes].concat());
    let picture_inside = segments(&plain, |marker, bytes| match marker {
        0xdb => [&[0xff, 0xe2, 0, 8][..], &[0xff, 0xd8, 0xff, 0xd9, 1, 2], bytes].concat(),
        _ => bytes.to_vec(),
    });
    let ends_in = |fill: &[u8]| [&plain[..length - 2], fill, &plain[length - 2..]].concat();
    for jpeg in [without_tables, filled, picture_inside, ends_in(&[1, 2, 3, 4]), ends_in(&[0; 30]), ends_in(&[0xff; 9])]
    {
        let frame = Frame { width: 160, height: 121, components: 3, length: jpeg.len() };
        assert_eq!(walker.walk(&jpeg), Ok(frame));
    }
    assert!(walker.walk(&ends_in(&[1, 2, 3, 4, 5, 6])).is_err(), "more than fill");
}

#[test]
fn no_part_of_a_picture_is_whole() {
    let mut walker = Walker::default();
    let golden = GOLDEN.map(|(name, _, jpeg)| (name.to_owned(), jpeg.to_vec()));
    for (name, jpeg) in variants().into_iter().chain(golden) {
        for length in (0..jpeg.len()).rev().step_by(1 + jpeg.len() / 300) {
            assert!(walker.walk(&jpeg[..length]).is_err(), "{name}: {length} of {}", jpeg.len());
            let ended = [&jpeg[..length], &[0xff, 0xd9]].concat();
            // Its last bytes may be fill.
            assert!(
                length + 6 > jpeg.len() || walker.walk(&ended).is_err(),
                "{name}: {length} of {}, ended",
                jpeg.len()
            );
        }
    }
}

/// What a bus, a cable or a full buffer does to the inside of a picture; decoders accept all of these.
#[test]
fn damage_inside_is_found() {
    type Change = fn(&mut Vec<u8>, usize);
    const KINDS: [(&str, usize, Change); 5] = [
        ("512 bytes lost", 985, |jpeg, at| _ = jpeg.drain(at..at + 512)),
        ("64 bytes lost", 970, |jpeg, at| _ = jpeg.drain(at..at + 64)),
        ("512 bytes of zeros", 970, |jpeg, at| jpeg[at..at + 512].fill(0)),
        ("512 bytes twice", 985, |jpeg, at| {
            let twice = jpeg[at..at + 512].to_vec();
            jpeg.splice(at..at, twice);
        }),
        ("two packets exchanged", 800, |jpeg, at| jpeg[at..at + 1024].rotate_left(512)),
    ];
    let pictures: Vec<_> = variants().into_iter().filter(|(name, _)| name.contains("progressive false")).collect();
    let mut walker = Walker::default();
    for (name, at_least, change) in KINDS {
        let mut numbers = Numbers(11);
        let found = (0..1000).filter(|index| {
            let mut jpeg = pictures[index % pictures.len()].1.clone();
            let from = data(&jpeg);
            let at = from + numbers.below(jpeg.len() - from - 1030);
            change(&mut jpeg, at);
            walker.walk(&jpeg).is_err()
        });
        let found = found.count();
        assert!(found >= at_least, "{name}: {found} of 1000 found");
    }
}

#[test]
fn restart_markers_are_counted() {
    let plain = encoded(|encoder| encoder.set_restart_interval(3));
    let markers: Vec<usize> = (data(&plain)..plain.len() - 1)
        .filter(|at| plain[*at] == 0xff && matches!(plain[*at + 1], 0xd0..=0xd7))
        .collect();
    let mut walker = Walker::default();
    assert!(markers.len() > 10 && walker.walk(&plain).is_ok());
    for pair in markers.windows(2) {
        let interval = pair[0]..pair[1];
        assert!(walker.walk(&[&plain[..interval.start], &plain[interval.end..]].concat()).is_err(), "one is missing");
        let mut other = plain.clone();
        other[interval.start + 1] ^= 1;
        assert!(walker.walk(&other).is_err(), "another number");
    }
}

#[test]
fn what_the_decoder_does_not_know_is_named() {
    let plain = encoded(|_| {});
    let coded = |marker: u8| {
        let mut jpeg = plain.clone();
        let at = jpeg.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
        jpeg[at + 1] = marker;
        jpeg
    };
    let mut walker = Walker::default();
    assert_eq!(walker.walk(&coded(0xc9)), Err(Damage::Unsupported("arithmetic coding")));
    assert_eq!(walker.walk(&coded(0xc3)), Err(Damage::Unsupported("not a sequential or progressive JPEG")));
    assert_eq!(walker.walk(b"\x89PNG"), Err(Damage::Beginning));
    assert_eq!(walker.walk(&[0xff, 0xd8, 0xff, 0xd9]), Err(Damage::Incomplete));
    assert_eq!(
        walker.walk(&[&[0xff, 0xd8], &plain[..]].concat()),
        Err(Damage::Marker(2)),
        "decoders refuse two beginnings"
    );
}

/// Whatever the bytes, the work is bounded by their number and the largest picture, and nothing panics.
#[test]
fn any_change_is_survived() {
    let mut numbers = Numbers(3);
    let mut walker = Walker::default();
    let pictures: Vec<Vec<u8>> =
        variants().into_iter().map(|(_, jpeg)| jpeg).chain(GOLDEN.map(|(_, _, jpeg)| jpeg.to_vec())).collect();
    for index in 0..4000 {
        let mut jpeg = pictures[index % pictures.len()].clone();
        for _ in 0..=numbers.below(4) {
            let at = numbers.below(if index % 3 == 0 { jpeg.len() } else { jpeg.len().min(700) });
            jpeg[at] = u8::try_from(numbers.below(256)).unwrap();
        }
        let _ = walker.walk(&jpeg);
    }
}
