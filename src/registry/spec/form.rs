//! What the samples of a device mean, where viewers know messages for that: `[device.NAME.pose]`, `[device.NAME.joints]`,
//! `[device.NAME.calibration]` and `[device.NAME.points]`.
//!
//! Samples are recorded as they are; messages of these forms are derived from them (`episode::form`).

use rapid_core::points::PacketFormat;

/// The end of the topic of poses.
pub const POSE_ENDING: &str = "/pose";

/// See the module's comment.
#[derive(Debug, Clone, PartialEq)]
pub enum Form {
    /// The pose of a frame that has the name of the entry.
    Pose(PoseSpec),
    /// The states of joints.
    Joints(JointsSpec),
    /// Pictures of a calibrated camera.
    Calibration(CalibrationSpec),
    /// Packets of a LiDAR.
    Points(PointsSpec),
}

/// How points are given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PointsSpec {
    /// The format of its packets.
    pub format: PacketFormat,
    /// The frame in which they are given, default the name of the entry.
    pub frame: String,
}

/// How a pose is given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PoseSpec {
    /// The order of its values.
    pub layout: PoseLayout,
    /// The frame in which it is given, default `world`.
    pub parent: String,
}

/// The numbers of a pose. Positions are in m.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoseLayout {
    /// A homogeneous matrix of 4 by 4, column by column.
    Columns,
    /// The same, row by row.
    Rows,
    /// Position, then the quaternion `x y z w`.
    Quaternion,
}

impl PoseLayout {
    /// How many numbers it has.
    pub const fn numbers(self) -> usize {
        match self {
            Self::Columns | Self::Rows => 16,
            Self::Quaternion => 7,
        }
    }
}

/// The numbers of joints: those of the first, those of the second and so on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JointsSpec {
    /// Their names, as in the robot's description; at least one, none twice.
    pub names: Vec<String>,
    /// What the numbers of each are, in order; none but [`Quantity::Other`] twice.
    pub quantities: Vec<Quantity>,
    /// The pose of the tip of their arm, if its numbers follow those of the joints.
    pub tip: Option<TipForm>,
}

impl JointsSpec {
    /// The index of the first number after those of the joints.
    pub fn end(&self) -> usize {
        self.names.len().saturating_mul(self.quantities.len())
    }
}

/// The pose of the tip of an arm: position, opening of the gripper if it has one, quaternion `x y z w`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TipForm {
    /// The frame in which it is given, default `world`.
    pub parent: String,
    /// The opening is there.
    pub has_opening: bool,
}

impl TipForm {
    /// How many numbers it has.
    pub const fn numbers(&self) -> usize {
        tip_numbers(self.has_opening)
    }
}

/// Numbers of the pose of a tip, with the opening of its gripper or without.
pub(crate) const fn tip_numbers(has_opening: bool) -> usize {
    7 + if has_opening { 1 } else { 0 }
}

/// What a number of a joint is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// rad, or m.
    Position,
    /// rad/s, or m/s.
    Velocity,
    /// Nm, or N.
    Effort,
    /// Something that the message does not have.
    Other,
}

/// The intrinsics of a camera, for the size of its pictures.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibrationSpec {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// The model of its lens: `plumb_bob`, the default, `rational_polynomial` or `kannala_brandt`.
    pub model: String,
    /// Its parameters: 5, 8 or 4, or none.
    pub distortion: Vec<f64>,
    /// The matrix of 3 by 3, row by row: `fx 0 cx, 0 fy cy, 0 0 1`, in pixels; finite, the focal lengths above 0.
    pub intrinsics: [f64; 9],
}

impl Form {
    /// How many numbers a sample has; 0 of pictures and packets.
    pub fn numbers(&self) -> usize {
        match self {
            Self::Pose(pose) => pose.layout.numbers(),
            Self::Joints(joints) => joints.end().saturating_add(joints.tip.as_ref().map_or(0, TipForm::numbers)),
            Self::Calibration(_) | Self::Points(_) => 0,
        }
    }

    /// The names of the numbers of a sample, in order: `x`, `qw`, `m03` (row 0, column 3), `shoulder.position`, `tip.x`; of
    /// a quantity without a name its place among those of the joint, as `shoulder.3`. None of pictures and packets.
    pub fn names(&self) -> Vec<String> {
        const POSE: [&str; 7] = ["x", "y", "z", "qx", "qy", "qz", "qw"];
        let matrix = |by_column: bool| {
            let cell = move |at: usize| if by_column { (at % 4, at / 4) } else { (at / 4, at % 4) };
            (0..16).map(cell).map(|(row, column)| format!("m{row}{column}")).collect()
        };
        match self {
            Self::Pose(pose) => match pose.layout {
                PoseLayout::Columns => matrix(true),
                PoseLayout::Rows => matrix(false),
                PoseLayout::Quaternion => POSE.map(str::to_owned).into(),
            },
            Self::Joints(joints) => {
                let word = |(at, quantity): (usize, &Quantity)| match quantity {
                    Quantity::Position => "position".to_owned(),
                    Quantity::Velocity => "velocity".to_owned(),
                    Quantity::Effort => "effort".to_owned(),
                    Quantity::Other => at.to_string(),
                };
                let words: Vec<String> = joints.quantities.iter().enumerate().map(word).collect();
                let of_joint = |joint: &String| words.iter().map(|word| format!("{joint}.{word}")).collect::<Vec<_>>();
                let [x, y, z, rotation @ ..] = POSE;
                let opening = joints.tip.iter().filter(|tip| tip.has_opening).map(|_| "opening");
                let tip = [x, y, z].into_iter().chain(opening).chain(rotation).map(|name| format!("tip.{name}"));
                let tip = tip.filter(|_| joints.tip.is_some());
                joints.names.iter().flat_map(of_joint).chain(tip).collect()
            }
            Self::Calibration(_) | Self::Points(_) => Vec::new(),
        }
    }

    /// The end of the topic with its messages, after the topic of the device.
    pub const fn ending(&self) -> &'static str {
        match self {
            Self::Pose(_) => POSE_ENDING,
            Self::Joints(_) => "/joints",
            Self::Calibration(_) => "/calibration",
            Self::Points(_) => "/points",
        }
    }

    /// That of another topic with messages of the same samples.
    pub const fn further_ending(&self) -> Option<&'static str> {
        match self {
            Self::Joints(JointsSpec { tip: Some(_), .. }) => Some(POSE_ENDING),
            _ => None,
        }
    }
}
