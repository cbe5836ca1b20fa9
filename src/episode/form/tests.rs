//! Derived messages, read by the descriptors that are written into the file.

use proptest::prelude::*;
use prost_reflect::{DescriptorPool, DynamicMessage, ReflectMessage as _};
use rapid_core::points::PacketFormat;
use rapid_registry::{CalibrationSpec, PointsSpec};

use super::*;

const WALL: u64 = 1_700_000_000_123_456_789;

fn payload(numbers: &[f64]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

fn decode(derived: Derived, bytes: &[u8]) -> DynamicMessage {
    let schema = derived.schema();
    let pool = DescriptorPool::decode(schema.data).unwrap();
    let message = DynamicMessage::decode(pool.get_message_by_name(schema.name).unwrap(), bytes).unwrap();
    assert_eq!(message.unknown_fields().count(), 0);
    message
}

fn inner(message: &DynamicMessage, field: &str) -> DynamicMessage {
    message.get_field_by_name(field).unwrap().as_message().unwrap().clone()
}

/// The numbers of a vector or a quaternion.
fn doubles(message: &DynamicMessage) -> Vec<f64> {
    message.descriptor().fields().map(|field| message.get_field(&field).as_f64().unwrap()).collect()
}

fn pose_of(layout: PoseLayout) -> Form {
    Form::Pose(PoseSpec { layout, parent: "world".to_owned() })
}

/// The message of these numbers, if they give one.
fn message(derived: Derived, form: &Form, numbers: &[f64]) -> Option<DynamicMessage> {
    let mut out = b"what was there".to_vec();
    derived
        .encode(&mut out, WALL, "phone", form, (SampleSchema::Scalars, &payload(numbers)))
        .then(|| decode(derived, &out))
}

/// The quaternion of a pose of these numbers.
fn rotation(form: &Form, numbers: &[f64]) -> Vec<f64> {
    doubles(&inner(&inner(&message(Derived::Pose, form, numbers).unwrap(), "pose"), "orientation"))
}

fn cross(one: [f64; 3], other: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|at| one[(at + 1) % 3] * other[(at + 2) % 3] - one[(at + 2) % 3] * other[(at + 1) % 3])
}

/// A vector turned by a quaternion `x y z w` of length 1.
fn turned(quaternion: [f64; 4], vector: [f64; 3]) -> [f64; 3] {
    let axis = [quaternion[0], quaternion[1], quaternion[2]];
    let once = cross(axis, vector);
    let twice = cross(axis, once);
    [0, 1, 2].map(|at| vector[at] + 2.0 * (quaternion[3] * once[at] + twice[at]))
}

#[test]
fn a_pose_is_a_message_and_a_transform() {
    let numbers = [1.0, -2.0, 3.5, 0.0, 0.0, 2.0, 0.0];
    let form = pose_of(PoseLayout::Quaternion);
    let pose = message(Derived::Pose, &form, &numbers).unwrap();
    assert_eq!(pose.get_field_by_name("frame_id").unwrap().as_str(), Some("world"));
    let stamp = inner(&pose, "timestamp");
    assert_eq!(stamp.get_field_by_name("seconds").unwrap().as_i64(), Some(1_700_000_000));
    assert_eq!(doubles(&inner(&inner(&pose, "pose"), "position")), [1.0, -2.0, 3.5]);
    assert_eq!(rotation(&form, &numbers), [0.0, 0.0, 1.0, 0.0], "of length 1");
    let transform = message(Derived::Transform, &form, &numbers).unwrap();
    assert_eq!(transform.get_field_by_name("parent_frame_id").unwrap().as_str(), Some("world"));
    assert_eq!(transform.get_field_by_name("child_frame_id").unwrap().as_str(), Some("phone"));
    assert_eq!(doubles(&inner(&transform, "translation")), [1.0, -2.0, 3.5]);
    assert_eq!(doubles(&inner(&transform, "rotation")), [0.0, 0.0, 1.0, 0.0]);
}

#[test]
fn numbers_that_are_no_pose_give_no_message() {
    let quaternion = pose_of(PoseLayout::Quaternion);
    let columns = pose_of(PoseLayout::Columns);
    let mut singular = [0.0; 16];
    singular[0] = -1.0;
    let mut unknown = [0.5; 16];
    unknown[14] = f64::NAN;
    for (form, numbers) in [
        (&quaternion, &[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0][..]),
        (&quaternion, &[f64::INFINITY, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
        (&quaternion, &[0.0, 0.0, 0.0, f64::MAX, f64::MAX, 0.0, 1.0]),
        (&quaternion, &[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
        (&columns, &unknown),
        (&columns, &[1.0; 15]),
        (&columns, &[]),
    ] {
        for derived in [Derived::Pose, Derived::Transform, Derived::Joints] {
            assert!(message(derived, form, numbers).is_none(), "{derived:?} {numbers:?}");
        }
    }
    let mut out = Vec::new();
    assert!(
        !Derived::Pose.encode(&mut out, WALL, "phone", &quaternion, (SampleSchema::Scalars, &[0; 55])),
        "half a number"
    );
    assert!(message(Derived::Pose, &columns, &singular).is_some(), "it is scaled to the nearest length");
}

#[test]
fn joints_have_the_quantities_that_are_known() {
    let names = ["shoulder", "", "elbow with a name that is longer than one byte can count ".repeat(4).as_str()]
        .map(str::to_owned)
        .to_vec();
    let quantities = vec![Quantity::Other, Quantity::Effort, Quantity::Position];
    let form = Form::Joints(JointsSpec { names: names.clone(), quantities, tip: None });
    let numbers = [9.0, 1.0, 0.0, 9.0, f64::NAN, -2.0, 9.0, 3.0, 4.0];
    let states = message(Derived::Joints, &form, &numbers).unwrap();
    let joints = states.get_field_by_name("joints").unwrap().as_list().unwrap().to_vec();
    let found: Vec<_> = joints.iter().map(|joint| joint.as_message().unwrap()).collect();
    let number = |joint: usize, field: &str| {
        let has = found[joint].has_field_by_name(field);
        has.then(|| found[joint].get_field_by_name(field).unwrap().as_f64().unwrap())
    };
    for (at, name) in names.iter().enumerate() {
        assert_eq!(found[at].get_field_by_name("name").unwrap().as_str(), Some(name.as_str()));
        assert_eq!(number(at, "velocity"), None);
    }
    assert_eq!((number(0, "position"), number(0, "effort")), (Some(0.0), Some(1.0)), "0 is a position");
    assert!(number(1, "effort").unwrap().is_nan() && number(1, "position") == Some(-2.0));
    assert_eq!((number(2, "position"), number(2, "effort")), (Some(4.0), Some(3.0)));
    assert!(message(Derived::Joints, &form, &numbers[1..]).is_none());
}

#[test]
fn a_calibrated_camera_gives_its_intrinsics_with_each_picture() {
    let intrinsics = [600.5, 0.0, 320.0, 0.0, 601.0, 240.0, 0.0, 0.0, 1.0];
    let camera = CalibrationSpec {
        width: 640,
        height: 480,
        model: "plumb_bob".to_owned(),
        distortion: vec![0.1, -0.2, 0.0, 0.0, 0.3],
        intrinsics,
    };
    let form = Form::Calibration(camera);
    let mut out = Vec::new();
    for schema in [SampleSchema::CompressedImage, SampleSchema::RawImage] {
        assert!(Derived::Calibration.encode(&mut out, WALL, "cam", &form, (schema, b"a picture")));
        let message = decode(Derived::Calibration, &out);
        let list = |field: &str| {
            let list = message.get_field_by_name(field).unwrap().as_list().unwrap().to_vec();
            list.iter().map(|number| number.as_f64().unwrap()).collect::<Vec<_>>()
        };
        assert_eq!((list("D"), list("K")), (vec![0.1, -0.2, 0.0, 0.0, 0.3], intrinsics.to_vec()));
        assert_eq!(list("R"), [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!(list("P"), [600.5, 0.0, 320.0, 0.0, 0.0, 601.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        let text = |field: &str| message.get_field_by_name(field).unwrap().as_str().unwrap().to_owned();
        assert_eq!([text("frame_id"), text("distortion_model")], ["cam", "plumb_bob"]);
        let pixels = |field: &str| message.get_field_by_name(field).unwrap().as_u32();
        assert_eq!((pixels("width"), pixels("height")), (Some(640), Some(480)));
    }
    for schema in [SampleSchema::Bytes, SampleSchema::Scalars] {
        assert!(!Derived::Calibration.encode(&mut out, WALL, "cam", &form, (schema, b"no picture")));
    }
}

#[test]
fn a_packet_of_a_lidar_is_a_cloud_of_its_points() {
    let mut packet = vec![0; 36 + 2 * 14];
    let length = u16::try_from(packet.len()).unwrap();
    packet[1..3].copy_from_slice(&length.to_le_bytes());
    (packet[5], packet[10]) = (2, 1);
    for (at, number) in [2500_i32, -1500, 40].into_iter().enumerate() {
        packet[50 + 4 * at..54 + 4 * at].copy_from_slice(&number.to_le_bytes());
    }
    packet[62] = 200;
    let form = Form::Points(PointsSpec { format: PacketFormat::Livox, frame: "base".to_owned() });
    let mut out = Vec::new();
    assert!(Derived::Points.encode(&mut out, WALL, "lidar", &form, (SampleSchema::Bytes, &packet)));
    let cloud = decode(Derived::Points, &out);
    assert_eq!(cloud.get_field_by_name("frame_id").unwrap().as_str(), Some("base"));
    assert_eq!(cloud.get_field_by_name("point_stride").unwrap().as_u32(), Some(13));
    assert_eq!(doubles(&inner(&inner(&cloud, "pose"), "orientation")), [0.0, 0.0, 0.0, 1.0]);
    let fields = cloud.get_field_by_name("fields").unwrap();
    let fields = fields.as_list().unwrap().iter().map(|field| {
        let of = |name: &str| field.as_message().unwrap().get_field_by_name(name).unwrap().into_owned();
        (of("name").as_str().unwrap().to_owned(), of("offset").as_u32(), of("type").as_enum_number())
    });
    let wanted = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 1)];
    assert!(fields.eq(wanted.map(|(name, at, kind)| (name.to_owned(), Some(at), Some(kind)))));
    let data = cloud.get_field_by_name("data").unwrap().as_bytes().unwrap().clone();
    let coordinates = [2.5_f32, -1.5, 0.04].map(f32::to_le_bytes).concat();
    assert_eq!(data.as_ref(), [&coordinates[..], &[200]].concat(), "the first has no distance");
    // Another kind of packet, and bytes that are not a packet.
    packet[10] = 0;
    for other in [&packet[..], b"", b"packet"] {
        assert!(!Derived::Points.encode(&mut out, WALL, "lidar", &form, (SampleSchema::Bytes, other)));
    }
    assert!(!Derived::Points.encode(&mut out, WALL, "lidar", &form, (SampleSchema::Scalars, &packet)));
}

proptest! {
    #[test]
    fn a_matrix_and_its_quaternion_turn_alike(
        parts in prop::array::uniform4(-1.0..1.0_f64), place in prop::array::uniform3(-9.0..9.0_f64),
    ) {
        let length = parts.iter().map(|part| part * part).sum::<f64>().sqrt();
        prop_assume!(length > 0.1);
        let quaternion = parts.map(|part| part / length);
        let columns: Vec<[f64; 3]> =
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].iter().map(|axis| turned(quaternion, *axis)).collect();
        let mut by_columns: Vec<f64> = columns.iter().flat_map(|column| [column[0], column[1], column[2], 0.0]).collect();
        by_columns.extend([place[0], place[1], place[2], 1.0]);
        let by_rows: Vec<f64> = (0..16).map(|at| by_columns[at % 4 * 4 + at / 4]).collect();
        for (layout, numbers) in [(PoseLayout::Columns, &by_columns), (PoseLayout::Rows, &by_rows)] {
            let found = rotation(&pose_of(layout), numbers);
            // A quaternion and its negative are the same rotation.
            let product: f64 = found.iter().zip(quaternion).map(|(a, b)| a * b).sum();
            prop_assert!((product.abs() - 1.0).abs() < 1e-9, "{found:?} {quaternion:?}");
            let pose = message(Derived::Pose, &pose_of(layout), numbers).unwrap();
            prop_assert_eq!(doubles(&inner(&inner(&pose, "pose"), "position")), place);
        }
    }
}
