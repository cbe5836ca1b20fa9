//! Messages derived from the samples of a device whose [`Form`] is known, which viewers draw: poses, transforms, the states
//! of joints, the calibration of a camera, and the points of a LiDAR. They are recorded beside the samples, and carry their capture time and
//! sequence number.
//!
//! Invariant: nothing here is read again by `rapid`: the samples are what was measured.
//! Invariant: numbers that do not form a pose (not finite, or without a rotation) give no message.

use rapid_core::rotation::{self, Quaternion};
use rapid_registry::{DeviceSpec, Form, JointsSpec, POSE_ENDING, PoseLayout, PoseSpec, Quantity, TipForm};

use super::encode::{self, Joint, Pose};
use super::schema::{self, SampleSchema, Schema};

/// The topic of all transforms.
pub const TRANSFORM_TOPIC: &str = "/tf";

/// A kind of derived message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Derived {
    /// `foxglove.PoseInFrame`.
    Pose,
    /// `foxglove.FrameTransform`.
    Transform,
    /// `foxglove.JointStates`.
    Joints,
    /// `foxglove.CameraCalibration`.
    Calibration,
    /// `foxglove.PointCloud`.
    Points,
}

impl Derived {
    /// Those of a device.
    pub const fn for_device(device: &DeviceSpec) -> &'static [Self] {
        match device.form {
            Some(Form::Pose(_)) => &[Self::Pose, Self::Transform],
            Some(Form::Joints(JointsSpec { tip: Some(_), .. })) => &[Self::Joints, Self::Pose, Self::Transform],
            Some(Form::Joints(_)) => &[Self::Joints],
            Some(Form::Calibration(_)) => &[Self::Calibration],
            Some(Form::Points(_)) => &[Self::Points],
            None => &[],
        }
    }

    /// Its topic.
    pub fn topic(self, device: &DeviceSpec) -> String {
        let ending = device.form.as_ref().map_or("", Form::ending);
        match self {
            Self::Transform => TRANSFORM_TOPIC.to_owned(),
            Self::Pose => format!("{}{POSE_ENDING}", device.topic),
            Self::Joints | Self::Calibration | Self::Points => format!("{}{ending}", device.topic),
        }
    }

    /// Its schema.
    pub const fn schema(self) -> Schema {
        match self {
            Self::Pose => schema::POSE,
            Self::Transform => schema::TRANSFORM,
            Self::Joints => schema::JOINTS,
            Self::Calibration => schema::CALIBRATION,
            Self::Points => schema::POINTS,
        }
    }

    /// Writes the message of a sample of `schema` (numbers are little-endian 64-bit floats), captured at `wall_ns` by the
    /// device `name`. False if it gives none.
    pub fn encode(
        self,
        out: &mut Vec<u8>,
        wall_ns: u64,
        name: &str,
        form: &Form,
        (schema, payload): (SampleSchema, &[u8]),
    ) -> bool {
        let has_numbers = || schema == SampleSchema::Scalars && payload.len() == 8 * form.numbers();
        match form {
            Form::Calibration(camera) => {
                if !matches!(schema, SampleSchema::CompressedImage | SampleSchema::RawImage) {
                    return false;
                }
                encode::calibration(out, wall_ns, name, camera);
            }
            Form::Points(spec) => return schema == SampleSchema::Bytes && encode::points(out, wall_ns, spec, payload),
            _ if !has_numbers() => return false,
            Form::Pose(spec) => {
                let Some(pose) = pose(spec, payload) else { return false };
                match self {
                    Self::Pose => encode::pose(out, wall_ns, &spec.parent, &pose),
                    Self::Transform => encode::transform(out, wall_ns, [&spec.parent, name], &pose),
                    Self::Joints | Self::Calibration | Self::Points => return false,
                }
            }
            Form::Joints(spec) => match (self, &spec.tip) {
                (Self::Joints, _) => encode::joints(out, wall_ns, joints(spec, payload)),
                (Self::Pose | Self::Transform, Some(tip)) => {
                    let Some(pose) = tip_pose(tip, payload.get(8 * spec.end()..).unwrap_or_default()) else {
                        return false;
                    };
                    if self == Self::Pose {
                        encode::pose(out, wall_ns, &tip.parent, &pose);
                    } else {
                        encode::transform(out, wall_ns, [&tip.parent, name], &pose);
                    }
                }
                _ => return false,
            },
        }
        true
    }
}

/// The pose of the tip of an arm.
fn tip_pose(tip: &TipForm, numbers: &[u8]) -> Option<Pose> {
    let at = |index| number(numbers, index).filter(|number| number.is_finite());
    let rotation = tip.numbers() - 4;
    let rotation = [at(rotation)?, at(rotation + 1)?, at(rotation + 2)?, at(rotation + 3)?];
    Some(Pose { position: [at(0)?, at(1)?, at(2)?], rotation: rotation::normalized(rotation)? })
}

fn number(payload: &[u8], index: usize) -> Option<f64> {
    let bytes = payload.get(index * 8..index * 8 + 8)?;
    Some(f64::from_le_bytes(bytes.try_into().ok()?))
}

fn pose(spec: &PoseSpec, payload: &[u8]) -> Option<Pose> {
    let at = |index| number(payload, index).filter(|number| number.is_finite());
    let (position, rotation) = match spec.layout {
        PoseLayout::Quaternion => ([at(0)?, at(1)?, at(2)?], [at(3)?, at(4)?, at(5)?, at(6)?]),
        PoseLayout::Columns => matrix(|row, column| at(column * 4 + row))?,
        PoseLayout::Rows => matrix(|row, column| at(row * 4 + column))?,
    };
    Some(Pose { position, rotation: rotation::normalized(rotation)? })
}

/// Position and quaternion of a homogeneous matrix.
fn matrix(at: impl Fn(usize, usize) -> Option<f64>) -> Option<([f64; 3], Quaternion)> {
    let row = |row| Some([at(row, 0)?, at(row, 1)?, at(row, 2)?]);
    let rotation = rotation::of_matrix([row(0)?, row(1)?, row(2)?]);
    Some(([at(0, 3)?, at(1, 3)?, at(2, 3)?], rotation))
}

fn joints<'a>(spec: &'a JointsSpec, payload: &'a [u8]) -> impl Iterator<Item = Joint<'a>> {
    spec.names.iter().enumerate().map(move |(joint, name)| {
        let of = |wanted: Quantity| {
            let place = spec.quantities.iter().position(|quantity| *quantity == wanted)?;
            number(payload, joint * spec.quantities.len() + place)
        };
        Joint { name, position: of(Quantity::Position), velocity: of(Quantity::Velocity), effort: of(Quantity::Effort) }
    })
}

#[cfg(test)]
mod tests;
