//! The joints between two links of a description, and the pose of the last link.

use std::collections::HashMap;

use k::nalgebra::{Isometry3, Quaternion, Translation3, Unit, UnitQuaternion, Vector3};
use urdf_rs::{JointType, Robot};

/// No number of an arm is larger, in m or rad: products of larger ones would not be finite.
const LARGEST: f64 = 1e3;
/// Elements within elements, at most: a description has six, and its parser calls itself for each.
const DEEPEST: usize = 64;

/// Why a description has no such chain.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ChainError {
    /// It is not a description.
    #[error("not a robot description: {0}")]
    NoDescription(String),
    /// A link that it does not have.
    #[error("it has no link {0:?}")]
    NoLink(String),
    /// The links are not connected that way.
    #[error("link {tip:?} is not attached to link {frame:?}, directly or through others")]
    NotAttached {
        /// The link at the beginning.
        frame: String,
        /// The link at the end.
        tip: String,
    },
    /// A joint whose position is not an angle.
    #[error("joint {0:?} is neither fixed, revolute nor continuous, and the position of a motor is an angle")]
    Kind(String),
    /// A joint that depends on another.
    #[error("joint {0:?} mimics another, which no motor does")]
    Mimic(String),
    /// An axis or an origin that is none.
    #[error("joint {0:?} has an axis of length 0, or a number that is not finite or beyond 1000")]
    Numbers(String),
    /// It has nowhere to go.
    #[error("joint {0:?} has no range: its <limit> has no lower that is below its upper")]
    Range(String),
}

/// A joint that moves.
#[derive(Debug, Clone)]
pub(super) struct Joint {
    pub(super) name: String,
    /// Where it is at position 0, relative to the joint before it.
    origin: Isometry3<f64>,
    axis: Unit<Vector3<f64>>,
    /// Its lowest and highest position, rad; infinite without a limit.
    pub(super) limits: [f64; 2],
}

/// The joints that move between two links, and the last of these links.
#[derive(Debug, Clone)]
pub struct Chain {
    pub(super) joints: Vec<Joint>,
    /// The tip, relative to the last joint.
    end: Isometry3<f64>,
}

impl Chain {
    /// The chain from the link `frame`, or from the root, to the link `tip` of the description `urdf`.
    ///
    /// # Errors
    /// When there is no such chain, or it has a joint that no motor can move.
    pub fn read(urdf: &str, frame: Option<&str>, tip: &str) -> Result<Self, ChainError> {
        if let Some(why) = unreadable(urdf) {
            return Err(ChainError::NoDescription(why));
        }
        let robot = urdf_rs::read_from_string(urdf).map_err(|error| ChainError::NoDescription(error.to_string()))?;
        for link in frame.into_iter().chain([tip]) {
            if !robot.links.iter().any(|known| known.name == link) {
                return Err(ChainError::NoLink(link.to_owned()));
            }
        }
        let mut chain = Self { joints: Vec::new(), end: Isometry3::identity() };
        for joint in path(&robot, frame, tip)? {
            chain.extend(joint)?;
        }
        Ok(chain)
    }

    fn extend(&mut self, joint: &urdf_rs::Joint) -> Result<(), ChainError> {
        let name = || joint.name.clone();
        let [x, y, z] = *joint.origin.xyz;
        let [roll, pitch, yaw] = *joint.origin.rpy;
        let [ax, ay, az] = *joint.axis.xyz;
        let limits = [joint.limit.lower, joint.limit.upper];
        let numbers = [x, y, z, roll, pitch, yaw, ax, ay, az];
        // Also false of what is not a number.
        if !numbers.iter().chain(&limits).all(|number| number.abs() <= LARGEST) {
            return Err(ChainError::Numbers(name()));
        }
        let turned = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        let origin = self.end * Isometry3::from_parts(Translation3::new(x, y, z), turned);
        let limits = match joint.joint_type {
            JointType::Fixed => {
                self.end = origin;
                return Ok(());
            }
            JointType::Continuous => [f64::NEG_INFINITY, f64::INFINITY],
            // Without limits both are 0.
            JointType::Revolute if limits[0] < limits[1] => limits,
            JointType::Revolute => return Err(ChainError::Range(name())),
            _ => return Err(ChainError::Kind(name())),
        };
        if joint.mimic.is_some() {
            return Err(ChainError::Mimic(name()));
        }
        let axis = Unit::try_new(Vector3::new(ax, ay, az), 1e-6).ok_or_else(|| ChainError::Numbers(name()))?;
        self.joints.push(Joint { name: name(), origin, axis, limits });
        self.end = Isometry3::identity();
        Ok(())
    }

    /// The pose of the tip: x, y, z, m, and the quaternion `x y z w`, with each joint at its position.
    pub fn pose(&self, positions: impl Iterator<Item = f64>) -> ([f64; 3], [f64; 4]) {
        let mut pose = Isometry3::identity();
        for (joint, position) in self.joints.iter().zip(positions) {
            pose *= joint.origin;
            pose *= UnitQuaternion::from_axis_angle(&joint.axis, position);
        }
        pose *= self.end;
        let place = pose.translation.vector;
        let turned = pose.rotation.coords;
        ([place.x, place.y, place.z], [turned.x, turned.y, turned.z, turned.w])
    }

    /// The same chain for the solver.
    pub(super) fn serial(&self) -> k::SerialChain<f64> {
        let mut last: Option<k::Node<f64>> = None;
        let mut nodes = Vec::new();
        let moving = self
            .joints
            .iter()
            .map(|joint| (joint.name.as_str(), joint.origin, k::JointType::Rotational { axis: joint.axis }));
        for (name, origin, kind) in moving.chain([("tip", self.end, k::JointType::Fixed)]) {
            let node = k::NodeBuilder::new().name(name).joint_type(kind);
            let node = node.translation(origin.translation).rotation(origin.rotation).into_node();
            if let Some(last) = last.replace(node.clone()) {
                node.set_parent(&last);
            }
            nodes.push(node);
        }
        k::SerialChain::new_unchecked(k::Chain::from_nodes(nodes))
    }
}

/// Why the parser, which calls itself for each element within another, should not get this text; `None` if it may. What two
/// readers of XML could read differently is refused.
fn unreadable(text: &str) -> Option<String> {
    let (mut depth, mut rest) = (0_usize, text);
    while let Some((_, tag)) = rest.split_once('<') {
        let Some((inside, behind)) = split_tag(tag) else {
            return Some("it is not well-formed, or has a document type".to_owned());
        };
        rest = behind;
        match inside.as_bytes() {
            // A comment, a section of text, an instruction.
            [b'!' | b'?', ..] | [.., b'/'] => {}
            [b'/', ..] => depth = depth.saturating_sub(1),
            _ => depth += 1,
        }
        if depth > DEEPEST {
            return Some(format!("elements are nested more than {DEEPEST} deep"));
        }
    }
    None
}

/// What is between a `<` and its `>`, and what follows. `None` of what is not whole or could be read in two ways, and of a
/// document type: its entities would be text that is not here.
fn split_tag(tag: &str) -> Option<(&str, &str)> {
    for (begin, end) in [("!--", "-->"), ("![CDATA[", "]]>"), ("?", "?>")] {
        if let Some(inside) = tag.strip_prefix(begin) {
            let length = inside.find(end).filter(|_| !inside.starts_with(['-', '>']))?;
            return tag.split_at_checked(begin.len() + length + end.len());
        }
    }
    let (mut quote, mut before) = (None, b' ');
    for (at, byte) in tag.bytes().enumerate() {
        match (byte, quote) {
            (b'>', None) => return Some((tag.get(..at)?, tag.get(at + 1..)?)),
            (b'"' | b'\'', None) if before == b'=' => quote = Some(byte),
            (b'"' | b'\'', None) | (b'<', _) => return None,
            (b'!', None) if at == 0 => return None,
            (byte, Some(open)) if byte == open => quote = None,
            _ => {}
        }
        before = if byte.is_ascii_whitespace() { before } else { byte };
    }
    None
}

/// The joints from `frame` to `tip` in order.
fn path<'a>(robot: &'a Robot, frame: Option<&str>, tip: &str) -> Result<Vec<&'a urdf_rs::Joint>, ChainError> {
    let not_attached =
        || ChainError::NotAttached { frame: frame.unwrap_or("the root").to_owned(), tip: tip.to_owned() };
    // The first joint of a link, as if they were searched in order.
    let mut above = HashMap::new();
    for joint in &robot.joints {
        above.entry(joint.child.link.as_str()).or_insert(joint);
    }
    let mut path = Vec::new();
    let mut link = tip;
    while Some(link) != frame {
        let Some(joint) = above.get(link).copied() else {
            if frame.is_none() {
                break;
            }
            return Err(not_attached());
        };
        // A description whose links go in a circle.
        if path.len() == robot.joints.len() {
            return Err(not_attached());
        }
        path.push(joint);
        link = &joint.parent.link;
    }
    path.reverse();
    Ok(path)
}

/// A pose for the solver; `None` if the quaternion has not about the length 1, or a number is not finite.
pub(super) fn isometry(position: [f64; 3], rotation: [f64; 4]) -> Option<Isometry3<f64>> {
    let length = rotation.iter().map(|part| part * part).sum::<f64>().sqrt();
    let is_pose = (0.5..=2.0).contains(&length) && position.iter().all(|number| number.abs() <= LARGEST);
    let ([x, y, z], [qx, qy, qz, qw]) = (position, rotation);
    let turned = UnitQuaternion::from_quaternion(Quaternion::new(qw, qx, qy, qz));
    is_pose.then(|| Isometry3::from_parts(Translation3::new(x, y, z), turned))
}
