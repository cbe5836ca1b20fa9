//! Messages as protobuf, written by hand into a reused buffer.
//!
//! Wire format: <https://protobuf.dev/programming-guides/encoding/>. Fields at their default value
//! are left out, as proto3 does.
//!
//! Invariant: once the buffer has grown to the largest message, nothing here allocates.

use std::ops::Range;

use rapid_core::mask::Bits;
use rapid_core::observation::Observation;
use rapid_core::points;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_registry::{CalibrationSpec, PointsSpec};
use rapid_status::{Event, EventKind, Level};

use super::schema::SampleSchema;

const VARINT: u8 = 0;
const FIXED64: u8 = 1;
const BYTES: u8 = 2;
const FIXED32: u8 = 5;

/// Writes a sample as a message of `schema`. `wall_ns` is its capture time on the wall clock, `frame_id`
/// the modality's name. Returns where in
/// `out` the payload lies.
pub fn sample(
    out: &mut Vec<u8>,
    schema: SampleSchema,
    wall_ns: u64,
    frame_id: &str,
    header: &SampleHeader,
    payload: &[u8],
) -> Range<usize> {
    out.clear();
    timestamp(out, wall_ns);
    match schema {
        SampleSchema::CompressedImage => {
            let place = bytes(out, 2, payload);
            bytes(out, 3, b"jpeg");
            bytes(out, 4, frame_id.as_bytes());
            place
        }
        SampleSchema::RawImage => {
            let (encoding, bytes_a_pixel) = match Encoding::from_raw(header.encoding) {
                Some(Encoding::Grey) => ("mono8", 1),
                Some(Encoding::Depth) => ("16UC1", 2),
                // The name that older and newer Foxglove both know.
                _ => ("yuv422_yuy2", 2),
            };
            fixed32(out, 2, header.width);
            fixed32(out, 3, header.height);
            bytes(out, 4, encoding.as_bytes());
            fixed32(out, 5, header.width.saturating_mul(bytes_a_pixel));
            let place = bytes(out, 6, payload);
            bytes(out, 7, frame_id.as_bytes());
            place
        }
        // A packed repeated double is little-endian 64-bit floats, which is what the payload holds;
        // bytes are bytes.
        SampleSchema::Scalars | SampleSchema::Bytes => bytes(out, 2, payload),
    }
}

/// Writes a `rapid.Mask`.
pub fn mask(out: &mut Vec<u8>, wall_ns: u64, bits: impl Into<Bits>, sequence: u64) {
    let Bits { mask, plugged } = bits.into();
    out.clear();
    timestamp(out, wall_ns);
    fixed64(out, 2, mask.0);
    varint_field(out, 3, sequence);
    fixed64(out, 4, plugged.0);
}

/// Writes a `rapid.Frame`.
pub fn frame(out: &mut Vec<u8>, wall_ns: u64, index: u64, observation: &Observation) {
    out.clear();
    timestamp(out, wall_ns);
    varint_field(out, 2, index);
    fixed64(out, 3, observation.mask.0);
    for slot in &observation.slots {
        // Every field but the age and the sequence number takes 2 bytes, those at most 11.
        nested(out, 4, |out| {
            varint_field(out, 1, u64::from(slot.id.bit()));
            varint_field(out, 2, u64::from(slot.valid));
            varint_field(out, 3, u64::from(slot.stale));
            if let Some(seq) = slot.seq {
                key(out, 4, VARINT);
                varint(out, zigzag(slot.age_ns));
                key(out, 5, VARINT);
                varint(out, seq);
            }
            varint_field(out, 6, u64::from(slot.present));
            varint_field(out, 7, u64::from(slot.plugged));
        });
    }
}

/// The fields of a `rapid.Event`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct EventText<'a> {
    /// Kind of the event.
    pub kind: &'a str,
    /// The modality, or empty.
    pub device: &'a str,
    /// For people.
    pub text: &'a str,
    /// All of it as JSON.
    pub json: &'a str,
}

/// What a `rapid.Event` holds of an announced event.
#[derive(Debug)]
pub struct Announced {
    json: serde_json::Value,
    text: String,
    whole: String,
}

impl Announced {
    /// Of this event.
    ///
    /// # Errors
    /// When it has no form as JSON.
    pub fn new(event: &Event) -> Result<Self, serde_json::Error> {
        let json = serde_json::to_value(event)?;
        Ok(Self { text: event.what.describe().sentence, whole: json.to_string(), json })
    }

    /// The fields of the message.
    pub fn fields(&self) -> EventText<'_> {
        let field = |name| self.json.get(name).and_then(serde_json::Value::as_str).unwrap_or_default();
        EventText { kind: field("event"), device: field("device"), text: &self.text, json: &self.whole }
    }
}

/// What of an event is a `foxglove.Log` as well.
pub fn logged(event: &Event) -> Option<(Level, &str)> {
    match &event.what {
        EventKind::Log { level, text } | EventKind::Printed { level, text, .. } => Some((*level, text)),
        _ => None,
    }
}

/// Writes a `rapid.Event`.
pub fn event(out: &mut Vec<u8>, wall_ns: u64, event: &EventText<'_>) {
    out.clear();
    timestamp(out, wall_ns);
    bytes(out, 2, event.kind.as_bytes());
    bytes(out, 3, event.device.as_bytes());
    bytes(out, 4, event.text.as_bytes());
    bytes(out, 5, event.json.as_bytes());
}

/// Writes a `foxglove.Log`.
pub fn log(out: &mut Vec<u8>, wall_ns: u64, level: Level, text: &str) {
    let level = match level {
        Level::Debug => 1,
        Level::Info => 2,
        Level::Warn => 3,
        Level::Error => 4,
    };
    out.clear();
    timestamp(out, wall_ns);
    varint_field(out, 2, level);
    bytes(out, 3, text.as_bytes());
    bytes(out, 4, b"rapid");
}

/// A position in m, and a rotation as a quaternion `x y z w` of length 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Where.
    pub position: [f64; 3],
    /// How it is turned.
    pub rotation: [f64; 4],
}

/// The state of a joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Joint<'a> {
    /// Its name.
    pub name: &'a str,
    /// rad, or m.
    pub position: Option<f64>,
    /// rad/s, or m/s.
    pub velocity: Option<f64>,
    /// Nm, or N.
    pub effort: Option<f64>,
}

/// Writes a `foxglove.PoseInFrame`.
pub fn pose(out: &mut Vec<u8>, wall_ns: u64, frame_id: &str, pose: &Pose) {
    out.clear();
    timestamp(out, wall_ns);
    bytes(out, 2, frame_id.as_bytes());
    nested(out, 3, |out| {
        nested(out, 1, |out| doubles(out, &pose.position));
        nested(out, 2, |out| doubles(out, &pose.rotation));
    });
}

/// Writes a `foxglove.FrameTransform` of the second frame in the first.
pub fn transform(out: &mut Vec<u8>, wall_ns: u64, [parent, child]: [&str; 2], pose: &Pose) {
    out.clear();
    timestamp(out, wall_ns);
    bytes(out, 2, parent.as_bytes());
    bytes(out, 3, child.as_bytes());
    nested(out, 4, |out| doubles(out, &pose.position));
    nested(out, 5, |out| doubles(out, &pose.rotation));
}

/// Writes a `foxglove.JointStates`.
pub fn joints<'a>(out: &mut Vec<u8>, wall_ns: u64, joints: impl Iterator<Item = Joint<'a>>) {
    const OF_A_DOUBLE: u64 = 9;
    out.clear();
    timestamp(out, wall_ns);
    for Joint { name, position, velocity, effort } in joints {
        let numbers = [(2, position), (3, velocity), (5, effort)];
        let written = numbers.iter().filter(|(_, number)| number.is_some()).count() as u64;
        let name_length = if name.is_empty() { 0 } else { field_length(name.len() as u64) + name.len() as u64 };
        key(out, 2, BYTES);
        varint(out, name_length + OF_A_DOUBLE * written);
        bytes(out, 1, name.as_bytes());
        // Present, though it may be 0.
        for (field, number) in numbers {
            if let Some(number) = number {
                key(out, field, FIXED64);
                out.extend_from_slice(&number.to_le_bytes());
            }
        }
    }
}

/// Writes a `foxglove.CameraCalibration`: without rectification, and projected by the intrinsics.
pub fn calibration(out: &mut Vec<u8>, wall_ns: u64, frame_id: &str, camera: &CalibrationSpec) {
    let CalibrationSpec { width, height, model, distortion, intrinsics } = camera;
    out.clear();
    timestamp(out, wall_ns);
    fixed32(out, 2, *width);
    fixed32(out, 3, *height);
    bytes(out, 4, model.as_bytes());
    packed(out, 5, distortion.iter().copied());
    packed(out, 6, intrinsics.iter().copied());
    packed(out, 7, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0].into_iter());
    let rows = intrinsics.as_chunks::<3>().0.iter();
    packed(out, 8, rows.flat_map(|[first, second, third]| [*first, *second, *third, 0.0]));
    bytes(out, 9, frame_id.as_bytes());
}

/// Bytes of a point: x, y, z (f32) and the reflectivity.
const POINT: u8 = 13;
/// Its fields: name, place, and type (`foxglove.PackedElementField.NumericType`: 1 UINT8, 7 FLOAT32).
const POINT_FIELDS: [(&str, u32, u64); 4] = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 1)];

/// Writes a `foxglove.PointCloud` of a packet; false if it is not a packet of points.
pub fn points(out: &mut Vec<u8>, wall_ns: u64, spec: &PointsSpec, packet: &[u8]) -> bool {
    let mut count = 0;
    if !points::read(spec.format, packet, |_| count += 1) {
        return false;
    }
    out.clear();
    timestamp(out, wall_ns);
    bytes(out, 2, spec.frame.as_bytes());
    // At the origin of its frame, and not turned.
    nested(out, 3, |out| nested(out, 2, |out| doubles(out, &[0.0, 0.0, 0.0, 1.0])));
    fixed32(out, 4, POINT.into());
    for (name, at, kind) in POINT_FIELDS {
        nested(out, 5, |out| {
            bytes(out, 1, name.as_bytes());
            fixed32(out, 2, at);
            varint_field(out, 3, kind);
        });
    }
    key(out, 6, BYTES);
    varint(out, u64::from(POINT) * count);
    points::read(spec.format, packet, |point| {
        point.position.iter().for_each(|part| out.extend_from_slice(&part.to_le_bytes()));
        out.push(point.reflectivity);
    })
}

/// A repeated double; nothing of none.
fn packed(out: &mut Vec<u8>, field: u8, values: impl Iterator<Item = f64> + Clone) {
    let count = values.clone().count() as u64;
    if count > 0 {
        key(out, field, BYTES);
        varint(out, 8 * count);
        values.for_each(|value| out.extend_from_slice(&value.to_le_bytes()));
    }
}

/// Fields from 1 on.
fn doubles(out: &mut Vec<u8>, values: &[f64]) {
    for (field, value) in (1..).zip(values) {
        fixed64(out, field, value.to_bits());
    }
}

/// A message within a message, of less than 128 bytes: its length is put in once it is known.
fn nested(out: &mut Vec<u8>, field: u8, write: impl FnOnce(&mut Vec<u8>)) {
    key(out, field, BYTES);
    let at = out.len();
    out.push(0);
    write(out);
    let length = out.len() - at - 1;
    if let (Some(byte), Ok(length)) = (out.get_mut(at), u8::try_from(length)) {
        *byte = length;
    }
}

/// `google.protobuf.Timestamp timestamp = 1`: seconds = 1, nanos = 2.
fn timestamp(out: &mut Vec<u8>, wall_ns: u64) {
    let (seconds, nanos) = (wall_ns / 1_000_000_000, wall_ns % 1_000_000_000);
    key(out, 1, BYTES);
    let length = field_length(seconds) + field_length(nanos);
    varint(out, length);
    varint_field(out, 1, seconds);
    varint_field(out, 2, nanos);
}

/// Length of a varint field with a number below 16, key included; 0 for a value that is left out.
fn field_length(value: u64) -> u64 {
    if value == 0 { 0 } else { 1 + u64::from((64 - value.leading_zeros()).div_ceil(7)) }
}

/// Field numbers here are below 16: the key is one byte.
fn key(out: &mut Vec<u8>, field: u8, wire: u8) {
    out.push(field << 3 | wire);
}

fn varint_field(out: &mut Vec<u8>, field: u8, value: u64) {
    if value != 0 {
        key(out, field, VARINT);
        varint(out, value);
    }
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        // The low seven bits, with the mark that more follow.
        out.push((value & 0x7f) as u8 | 0x80);
        value >>= 7;
    }
    out.push((value & 0x7f) as u8);
}

fn zigzag(value: i64) -> u64 {
    (value.cast_unsigned() << 1) ^ (value >> 63).cast_unsigned()
}

fn fixed64(out: &mut Vec<u8>, field: u8, value: u64) {
    if value != 0 {
        key(out, field, FIXED64);
        out.extend_from_slice(&value.to_le_bytes());
    }
}

fn fixed32(out: &mut Vec<u8>, field: u8, value: u32) {
    if value != 0 {
        key(out, field, FIXED32);
        out.extend_from_slice(&value.to_le_bytes());
    }
}

/// Returns where `value` lies.
fn bytes(out: &mut Vec<u8>, field: u8, value: &[u8]) -> Range<usize> {
    if !value.is_empty() {
        key(out, field, BYTES);
        varint(out, value.len() as u64);
        out.extend_from_slice(value);
    }
    out.len() - value.len()..out.len()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use prost_reflect::{DescriptorPool, DynamicMessage, Value};
    use rapid_core::mask::PhysicalMask;
    use rapid_core::modality::ModalityId;
    use rapid_core::sample::Epoch;
    use rapid_core::sync::{SyncModality, SyncSample, Synchronizer, WhenStale};
    use rapid_core::time::Stamp;

    use super::*;
    use crate::schema::{EVENT, FRAME, LOG, MASK, Schema};

    const WALL: u64 = 1_700_000_000_123_456_789;

    /// Reads `bytes` by the descriptor that is written into the file, as text; nothing may be left
    /// unknown.
    fn decode(schema: Schema, bytes: &[u8]) -> DynamicMessage {
        let pool = DescriptorPool::decode(schema.data).unwrap();
        let descriptor = pool.get_message_by_name(schema.name).unwrap();
        let message = DynamicMessage::decode(descriptor, bytes).unwrap();
        assert_eq!(message.unknown_fields().count(), 0);
        message
    }

    fn text(message: &DynamicMessage, field: &str) -> String {
        message.get_field_by_name(field).unwrap().as_str().unwrap().to_owned()
    }

    fn number(message: &DynamicMessage, field: &str) -> i128 {
        match *message.get_field_by_name(field).unwrap() {
            Value::U32(v) => v.into(),
            Value::U64(v) => v.into(),
            Value::I32(v) | Value::EnumNumber(v) => v.into(),
            Value::I64(v) => v.into(),
            Value::Bool(v) => v.into(),
            ref other => panic!("{field} is {other:?}"),
        }
    }

    fn wall(message: &DynamicMessage) -> u64 {
        let field = message.get_field_by_name("timestamp").unwrap();
        let timestamp = field.as_message().unwrap();
        u64::try_from(number(timestamp, "seconds") * 1_000_000_000 + number(timestamp, "nanos")).unwrap()
    }

    #[test]
    fn samples_decode_with_the_recorded_descriptor() {
        let mut out = Vec::new();
        let header = |encoding, width, height| SampleHeader { encoding, width, height, ..SampleHeader::default() };

        let payload: Vec<u8> = (0..=255).collect();
        sample(&mut out, SampleSchema::CompressedImage, WALL, "cam_wrist", &header(1, 640, 480), &payload);
        let message = decode(SampleSchema::CompressedImage.schema(), &out);
        assert_eq!(wall(&message), WALL);
        assert_eq!(message.get_field_by_name("data").unwrap().as_bytes().unwrap().as_ref(), payload);
        assert_eq!((text(&message, "format"), text(&message, "frame_id")), ("jpeg".into(), "cam_wrist".into()));

        for (encoding, name, step) in [(2, "yuv422_yuy2", 8), (3, "mono8", 4), (6, "16UC1", 8)] {
            sample(&mut out, SampleSchema::RawImage, WALL, "cam", &header(encoding, 4, 2), &payload[..8]);
            let message = decode(SampleSchema::RawImage.schema(), &out);
            assert_eq!((number(&message, "width"), number(&message, "height")), (4, 2));
            assert_eq!((text(&message, "encoding").as_str(), number(&message, "step")), (name, step));
            assert_eq!(message.get_field_by_name("data").unwrap().as_bytes().unwrap().len(), 8);
        }

        let values = [1.5_f64, -0.25, f64::MAX];
        let payload: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        sample(&mut out, SampleSchema::Scalars, 0, "arm", &header(4, 0, 0), &payload);
        let message = decode(SampleSchema::Scalars.schema(), &out);
        let decoded = message.get_field_by_name("values").unwrap();
        let decoded: Vec<f64> = decoded.as_list().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        assert_eq!(decoded, values);
        assert_eq!(wall(&message), 0);

        sample(&mut out, SampleSchema::Bytes, u64::MAX, "x", &header(0, 0, 0), b"\x00\xff");
        let message = decode(SampleSchema::Bytes.schema(), &out);
        assert_eq!(message.get_field_by_name("data").unwrap().as_bytes().unwrap().as_ref(), b"\x00\xff");
        assert_eq!(wall(&message), u64::MAX);
    }

    #[test]
    fn a_payload_that_does_not_match_its_header_is_bytes() {
        let header = |encoding| SampleHeader { encoding, ..SampleHeader::default() };
        assert_eq!(SampleSchema::for_sample(&header(4), &[0; 16]), SampleSchema::Scalars);
        assert_eq!(SampleSchema::for_sample(&header(4), &[0; 15]), SampleSchema::Bytes);
        assert_eq!(SampleSchema::for_sample(&header(77), &[0; 16]), SampleSchema::Bytes);
        assert_eq!(SampleSchema::for_sample(&header(1), &[]), SampleSchema::CompressedImage);
    }

    #[test]
    fn masks_events_and_log_lines_decode() {
        let mut out = Vec::new();
        let bits = Bits { mask: PhysicalMask(0x8000_0000_0000_0001), plugged: PhysicalMask(0x8000_0000_0000_0011) };
        mask(&mut out, WALL, bits, u64::MAX);
        let message = decode(MASK, &out);
        assert_eq!(number(&message, "mask"), 0x8000_0000_0000_0001);
        assert_eq!(number(&message, "plugged"), 0x8000_0000_0000_0011);
        assert_eq!((number(&message, "sequence"), wall(&message)), (u64::MAX.into(), WALL));

        let report = EventText { kind: "attach", device: "cam", text: "cam attached", json: "{}" };
        event(&mut out, WALL, &report);
        let message = decode(EVENT, &out);
        assert_eq!([text(&message, "kind"), text(&message, "device")], ["attach", "cam"]);
        assert_eq!([text(&message, "text"), text(&message, "json")], ["cam attached", "{}"]);

        log(&mut out, WALL, Level::Warn, "späť");
        let message = decode(LOG, &out);
        assert_eq!((number(&message, "level"), text(&message, "message")), (3, "späť".into()));
    }

    #[test]
    fn frames_decode() {
        let id = |bit| ModalityId::new(bit).unwrap();
        let modalities: Vec<_> = [0, 1, 63]
            .map(|bit| SyncModality { id: id(bit), when_stale: WhenStale::Hold, latency: Duration::ZERO, capacity: 4 })
            .into();
        let mut sync = Synchronizer::new(&modalities, Duration::from_nanos(10));
        let stamp = Stamp(100);
        let sample = |capture, seq| SyncSample { capture: Stamp(capture), recv: stamp, seq, epoch: Epoch(0), keep: () };
        sync.push(id(0), sample(105, 0));
        sync.push(id(63), sample(3, u64::MAX));
        let observation = sync.observe(stamp, Stamp(u64::MAX), PhysicalMask(1 | 1 << 63));
        let mut out = Vec::new();
        frame(&mut out, WALL, 300, observation);
        let message = decode(FRAME, &out);
        assert_eq!((number(&message, "index"), number(&message, "mask")), (300, 1 | 1 << 63));
        let list = message.get_field_by_name("modalities").unwrap();
        let report: Vec<_> = list
            .as_list()
            .unwrap()
            .iter()
            .map(|slot| {
                let slot = slot.as_message().unwrap();
                let seq = slot.has_field_by_name("seq").then(|| number(slot, "seq"));
                let flags = [number(slot, "present"), number(slot, "valid"), number(slot, "stale")];
                (number(slot, "bit"), flags, number(slot, "age_ns"), seq)
            })
            .collect();
        let expected =
            [(0, [1, 1, 0], -5, Some(0)), (1, [0, 0, 0], 0, None), (63, [1, 0, 1], 97, Some(u64::MAX.into()))];
        assert_eq!(report, expected);
    }
}
