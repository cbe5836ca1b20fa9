//! Schemas of what is recorded, written into every file. They are compiled from the `.proto` files beside them; the test
//! `schemas_match_their_proto_files` shows how.

use rapid_core::modality::ModalityKind;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_registry::{DeviceSpec, LanProtocol, LanSpec, NodeSpec, PixelFormat, RemoteSamples};

/// Message encoding and schema encoding of every channel.
pub const PROTOBUF: &str = "protobuf";

/// A schema: the name of its message and the `FileDescriptorSet` that describes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Schema {
    /// Fully qualified name of the message.
    pub name: &'static str,
    /// Serialized `google.protobuf.FileDescriptorSet`, imports included.
    pub data: &'static [u8],
}

macro_rules! schema {
    ($name:literal) => {
        Schema { name: $name, data: include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/proto/", $name, ".bin")) }
    };
}

/// `foxglove.Log`.
pub const LOG: Schema = schema!("foxglove.Log");
/// `rapid.Event`.
pub const EVENT: Schema = schema!("rapid.Event");
/// `rapid.Frame`.
pub const FRAME: Schema = schema!("rapid.Frame");
/// `foxglove.PoseInFrame`.
pub const POSE: Schema = schema!("foxglove.PoseInFrame");
/// `foxglove.FrameTransform`.
pub const TRANSFORM: Schema = schema!("foxglove.FrameTransform");
/// `foxglove.CameraCalibration`.
pub const CALIBRATION: Schema = schema!("foxglove.CameraCalibration");
/// `foxglove.JointStates`.
pub const JOINTS: Schema = schema!("foxglove.JointStates");
/// `foxglove.PointCloud`.
pub const POINTS: Schema = schema!("foxglove.PointCloud");
/// `rapid.Mask`.
pub const MASK: Schema = schema!("rapid.Mask");

/// How the samples of a modality are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleSchema {
    /// `foxglove.CompressedImage`.
    CompressedImage,
    /// `foxglove.RawImage`.
    RawImage,
    /// `rapid.Scalars`.
    Scalars,
    /// `rapid.Bytes`.
    Bytes,
}

impl SampleSchema {
    /// How many there are.
    pub const COUNT: usize = 4;

    /// The schema itself.
    pub const fn schema(self) -> Schema {
        match self {
            Self::CompressedImage => schema!("foxglove.CompressedImage"),
            Self::RawImage => schema!("foxglove.RawImage"),
            Self::Scalars => schema!("rapid.Scalars"),
            Self::Bytes => schema!("rapid.Bytes"),
        }
    }

    /// The schema of this name.
    pub fn named(name: &str) -> Option<Self> {
        [Self::CompressedImage, Self::RawImage, Self::Scalars, Self::Bytes]
            .into_iter()
            .find(|schema| schema.schema().name == name)
    }

    /// Index into arrays with one entry per schema.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The schema expected of a device by the registry.
    pub fn expected(device: &DeviceSpec) -> Self {
        match &device.node {
            NodeSpec::Camera(camera) => Self::of_pictures(camera.format),
            NodeSpec::Lan(LanSpec {
                protocol: LanProtocol::Remote { samples: RemoteSamples::Pictures(_, format), .. },
                ..
            }) => Self::of_pictures(*format),
            NodeSpec::Serial(_) | NodeSpec::Process(_) | NodeSpec::Can(_) | NodeSpec::Lan(_) => {
                match device.modality().kind {
                    ModalityKind::Scalars => Self::Scalars,
                    // Raw pictures of a program get their own channel when the first one arrives.
                    ModalityKind::Image => Self::CompressedImage,
                    ModalityKind::Depth => Self::RawImage,
                    ModalityKind::Bytes => Self::Bytes,
                }
            }
        }
    }

    const fn of_pictures(format: PixelFormat) -> Self {
        match format {
            PixelFormat::Mjpg => Self::CompressedImage,
            PixelFormat::Yuyv | PixelFormat::Grey | PixelFormat::Z16 => Self::RawImage,
        }
    }

    /// The schema that stores a sample without losing a byte: a payload that does not match its header is written as
    /// bytes.
    pub fn for_sample(header: &SampleHeader, payload: &[u8]) -> Self {
        match Encoding::from_raw(header.encoding) {
            Some(Encoding::Mjpeg) => Self::CompressedImage,
            Some(Encoding::Yuyv | Encoding::Grey | Encoding::Depth) => Self::RawImage,
            Some(Encoding::F64) if payload.len().is_multiple_of(8) => Self::Scalars,
            Some(Encoding::F64 | Encoding::Bytes | Encoding::Mask) | None => Self::Bytes,
        }
    }
}
