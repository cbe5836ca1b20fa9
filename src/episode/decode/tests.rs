use proptest::prelude::*;
use prost::Message as _;

use super::*;

#[derive(prost::Message)]
struct CompressedImage {
    #[prost(message, optional, tag = "1")]
    timestamp: Option<Timestamp>,
    #[prost(bytes = "vec", tag = "2")]
    data: Vec<u8>,
    #[prost(string, tag = "3")]
    format: String,
    #[prost(string, tag = "4")]
    frame_id: String,
}

#[derive(prost::Message)]
struct Timestamp {
    #[prost(int64, tag = "1")]
    seconds: i64,
    #[prost(int32, tag = "2")]
    nanos: i32,
}

#[derive(prost::Message)]
struct RawImage {
    #[prost(fixed32, tag = "2")]
    width: u32,
    #[prost(fixed32, tag = "3")]
    height: u32,
    #[prost(string, tag = "4")]
    encoding: String,
    #[prost(fixed32, tag = "5")]
    step: u32,
    #[prost(bytes = "vec", tag = "6")]
    data: Vec<u8>,
    #[prost(string, tag = "7")]
    frame_id: String,
}

#[derive(prost::Message)]
struct Scalars {
    #[prost(message, optional, tag = "1")]
    timestamp: Option<Timestamp>,
    #[prost(double, repeated, tag = "2")]
    values: Vec<f64>,
}

#[derive(prost::Message)]
struct Loose {
    #[prost(double, repeated, packed = "false", tag = "2")]
    values: Vec<f64>,
}

#[derive(prost::Message)]
struct Mask {
    #[prost(message, optional, tag = "1")]
    timestamp: Option<Timestamp>,
    #[prost(fixed64, tag = "2")]
    bits: u64,
    #[prost(uint64, tag = "3")]
    sequence: u64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Shape {
    encoding: Encoding,
    width: u32,
    height: u32,
}

fn read(schema: SampleSchema, message: &[u8]) -> Option<(Vec<u8>, Shape)> {
    let mut scratch = vec![9; 3];
    let Sample { encoding, width, height, payload } = sample(schema, message, &mut scratch)?;
    Some((payload.to_vec(), Shape { encoding, width, height }))
}

fn now() -> Timestamp {
    Timestamp { seconds: 1_700_000_000, nanos: 5 }
}

/// Start of image, an application segment, and a frame header of 640x480.
fn jpeg() -> Vec<u8> {
    let mut bytes = vec![0xff, 0xd8, 0xff, 0xe0, 0, 4, 1, 2, 0xff, 0xff, 0xc0, 0, 8, 8];
    bytes.extend_from_slice(&480_u16.to_be_bytes());
    bytes.extend_from_slice(&640_u16.to_be_bytes());
    bytes.push(3);
    bytes
}

#[test]
fn compressed_pictures_are_decoded_with_their_size() {
    let image = CompressedImage { timestamp: Some(now()), data: jpeg(), format: "jpeg".into(), frame_id: "cam".into() };
    let shape = Shape { encoding: Encoding::Mjpeg, width: 640, height: 480 };
    assert_eq!(read(SampleSchema::CompressedImage, &image.encode_to_vec()), Some((jpeg(), shape)));
    let png = CompressedImage { format: "png".into(), ..image };
    assert_eq!(read(SampleSchema::CompressedImage, &png.encode_to_vec()), None);
}

#[test]
fn raw_pictures_are_decoded_without_padding() {
    let mut image = RawImage {
        width: 2,
        height: 2,
        encoding: "mono8".into(),
        step: 3,
        data: vec![1, 2, 0, 3, 4, 0],
        frame_id: "cam".into(),
    };
    let shape = Shape { encoding: Encoding::Grey, width: 2, height: 2 };
    assert_eq!(read(SampleSchema::RawImage, &image.encode_to_vec()), Some((vec![1, 2, 3, 4], shape)));
    image = RawImage { encoding: "yuyv".into(), step: 4, data: vec![7; 8], ..image };
    assert_eq!(read(SampleSchema::RawImage, &image.encode_to_vec()).unwrap().1.encoding, Encoding::Yuyv);
    image.encoding = "rgb8".into();
    assert_eq!(read(SampleSchema::RawImage, &image.encode_to_vec()), None);
}

#[test]
fn packed_and_unpacked_numbers_are_decoded() {
    let values = vec![1.5, -2.0, f64::INFINITY];
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    let shape = Shape { encoding: Encoding::F64, width: 3, height: 0 };
    let packed = Scalars { timestamp: Some(now()), values: values.clone() }.encode_to_vec();
    assert_eq!(read(SampleSchema::Scalars, &packed), Some((bytes.clone(), shape)));
    assert_eq!(read(SampleSchema::Scalars, &Loose { values }.encode_to_vec()), Some((bytes, shape)));
    assert_eq!(read(SampleSchema::Scalars, &[0x12, 3, 1, 2, 3]), None, "three bytes are not doubles");
}

#[test]
fn masks_are_fixed_64_bit_words() {
    let message = Mask { timestamp: Some(now()), bits: 1 << 63 | 5, sequence: 300 }.encode_to_vec();
    assert_eq!(mask(&message), Some(PhysicalMask(1 << 63 | 5)));
    assert_eq!(mask(&[]), Some(PhysicalMask(0)), "zero is not written");
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        for schema in [SampleSchema::CompressedImage, SampleSchema::RawImage, SampleSchema::Scalars, SampleSchema::Bytes] {
            read(schema, &bytes);
        }
        for kind in [Kind::Mask, Kind::Frame, Kind::Event, Kind::Other] {
            content(kind, &bytes, &mut Scratch::default());
        }
        jpeg_frame(&bytes);
    }

    #[test]
    fn damaged_messages_are_read_or_refused(at in 0_usize..60, byte in any::<u8>(), cut in 0_usize..60) {
        let image = CompressedImage { timestamp: Some(now()), data: jpeg(), format: "jpeg".into(), frame_id: "cam".into() };
        let mut message = image.encode_to_vec();
        if let Some(place) = message.get_mut(at) {
            *place = byte;
        }
        message.truncate(cut.max(1));
        read(SampleSchema::CompressedImage, &message);
    }
}
