//! The joints between two links of a description, and the pose of the last link.

use k::nalgebra::{Isometry3, Quaternion, Translation3, Unit, UnitQuaternion, Vector3};
use urdf_rs::{JointType, Robot};

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
    /// A joint whose kind does not have one position.
    #[error("joint {0:?} is neither fixed, revolute, continuous nor prismatic")]
    Kind(String),
    /// A joint that depends on another.
    #[error("joint {0:?} mimics another, which no motor does")]
    Mimic(String),
    /// A number that is not finite, an axis of length 0, or limits the wrong way round.
    #[error("joint {0:?} has an axis, an origin or limits that are none")]
    Numbers(String),
}

/// How a joint moves.
#[derive(Debug, Clone, Copy)]
enum Motion {
    /// About an axis, rad.
    Turn(Unit<Vector3<f64>>),
    /// Along an axis, m.
    Slide(Unit<Vector3<f64>>),
}

/// A joint that moves.
#[derive(Debug, Clone)]
pub(super) struct Joint {
    pub(super) name: String,
    /// Where it is at position 0, relative to the joint before it.
    origin: Isometry3<f64>,
    motion: Motion,
    /// Its lowest and highest position; infinite without a limit.
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
        if ![x, y, z, roll, pitch, yaw, ax, ay, az, limits[0], limits[1]].iter().all(|number| number.is_finite()) {
            return Err(ChainError::Numbers(name()));
        }
        let turned = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        let origin = self.end * Isometry3::from_parts(Translation3::new(x, y, z), turned);
        let axis = || Unit::try_new(Vector3::new(ax, ay, az), 1e-6).ok_or_else(|| ChainError::Numbers(name()));
        let motion = match joint.joint_type {
            JointType::Fixed => {
                self.end = origin;
                return Ok(());
            }
            JointType::Revolute | JointType::Continuous => Motion::Turn(axis()?),
            JointType::Prismatic => Motion::Slide(axis()?),
            _ => return Err(ChainError::Kind(name())),
        };
        if joint.mimic.is_some() {
            return Err(ChainError::Mimic(name()));
        }
        let limits = match joint.joint_type {
            JointType::Continuous => [f64::NEG_INFINITY, f64::INFINITY],
            _ if limits[0] <= limits[1] => limits,
            _ => return Err(ChainError::Numbers(name())),
        };
        self.joints.push(Joint { name: name(), origin, motion, limits });
        self.end = Isometry3::identity();
        Ok(())
    }

    /// The pose of the tip: x, y, z, m, and the quaternion `x y z w`, with each joint at its position.
    pub fn pose(&self, positions: impl Iterator<Item = f64>) -> ([f64; 3], [f64; 4]) {
        let mut pose = Isometry3::identity();
        for (joint, position) in self.joints.iter().zip(positions) {
            pose *= joint.origin;
            match joint.motion {
                Motion::Turn(axis) => pose *= UnitQuaternion::from_axis_angle(&axis, position),
                Motion::Slide(axis) => pose *= Translation3::from(axis.into_inner() * position),
            }
        }
        pose *= self.end;
        let place = pose.translation.vector;
        let turned = pose.rotation.coords;
        ([place.x, place.y, place.z], [turned.x, turned.y, turned.z, turned.w])
    }

    /// The same chain for the solver, with these limits of its joints.
    pub(super) fn serial(&self, limits: impl Iterator<Item = [f64; 2]>) -> k::SerialChain<f64> {
        let mut last: Option<k::Node<f64>> = None;
        let mut nodes = Vec::new();
        let moving = self.joints.iter().zip(limits).map(|(joint, [low, high])| {
            let kind = match joint.motion {
                Motion::Turn(axis) => k::JointType::Rotational { axis },
                Motion::Slide(axis) => k::JointType::Linear { axis },
            };
            (joint.name.as_str(), joint.origin, kind, Some(k::joint::Range::new(low, high)))
        });
        for (name, origin, kind, limits) in moving.chain([("tip", self.end, k::JointType::Fixed, None)]) {
            let node = k::NodeBuilder::new().name(name).joint_type(kind).limits(limits);
            let node = node.translation(origin.translation).rotation(origin.rotation).into_node();
            if let Some(last) = last.replace(node.clone()) {
                node.set_parent(&last);
            }
            nodes.push(node);
        }
        k::SerialChain::new_unchecked(k::Chain::from_nodes(nodes))
    }
}

/// The joints from `frame` to `tip` in order.
fn path<'a>(robot: &'a Robot, frame: Option<&str>, tip: &str) -> Result<Vec<&'a urdf_rs::Joint>, ChainError> {
    let not_attached =
        || ChainError::NotAttached { frame: frame.unwrap_or("the root").to_owned(), tip: tip.to_owned() };
    let mut path = Vec::new();
    let mut link = tip;
    while Some(link) != frame {
        let Some(joint) = robot.joints.iter().find(|joint| joint.child.link == link) else {
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

/// A pose for the solver; `None` if the quaternion is none.
pub(super) fn isometry(position: [f64; 3], rotation: [f64; 4]) -> Option<Isometry3<f64>> {
    let [x, y, z, w] = rotation;
    let turned = Unit::try_new(Quaternion::new(w, x, y, z), 1e-6)?;
    let [x, y, z] = position;
    Some(Isometry3::from_parts(Translation3::new(x, y, z), turned))
}
