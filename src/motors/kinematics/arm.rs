//! An arm of the registry: what its motors are in the chain, and what its actions mean.

use std::path::{Path, PathBuf};

use k::SerialChain;
use k::nalgebra::{DMatrix, DVector, Isometry3, Quaternion, UnitQuaternion};
use rapid_core::action::NoAction;
use rapid_registry::{EffectorSpec, MAX_MOTORS, MOTOR_CHANNELS, MotorSpec, TipRotation};
use rapid_system::limited::read_text;

use super::chain::{Chain, ChainError, isometry};

/// How near the tip must come to its target: a tenth of what the motors resolve.
pub(super) const NEAR_M: f64 = 1e-4;
pub(super) const NEAR_RAD: f64 = 1e-3;
/// Steps of the solver: what a tip moves within a tick needs three.
const STEPS: usize = 100;
/// Damping of a step (Levenberg 1944): directions in which the tip moves by less, m or rad for each rad of the joints, are
/// hardly taken. Without it a joint that does not move the tip turns by rounding errors.
const DAMPING: f64 = 1e-2;
/// No joint turns further in one step, rad: of several ways to reach a pose the one that leads there is found.
const FARTHEST_STEP: f64 = 0.3;
/// No joint turns further for one action, rad: another way to reach the pose, with the elbow on the other side, is not taken.
const FARTHEST: f64 = 2.0;
/// A description has some kB.
const LARGEST_FILE: u64 = 16 << 20;

/// Why the description does not fit the motors.
#[derive(Debug, thiserror::Error)]
pub enum ArmError {
    /// It cannot be read.
    #[error("{}: {source}", file.display())]
    File {
        /// The description.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It has no such chain.
    #[error("{}: {source}", file.display())]
    Chain {
        /// The description.
        file: PathBuf,
        /// Why.
        source: ChainError,
    },
    /// A joint without a motor, or a motor without a joint.
    #[error("{}: {message}", file.display())]
    Names {
        /// The description.
        file: PathBuf,
        /// Which.
        message: String,
    },
    /// A joint whose motor must be elsewhere.
    #[error(
        "{}: the limits of joint {joint:?} and the `position` of its motor ({range:?}) do not overlap",
        file.display()
    )]
    Range {
        /// The description.
        file: PathBuf,
        /// The joint.
        joint: String,
        /// What its motor may be.
        range: [f64; 2],
    },
}

impl ArmError {
    /// What to write in place of it.
    pub const fn fix(&self) -> &'static str {
        match self {
            Self::File { .. } => "write urdf = the path of a description, relative to this file",
            Self::Chain { source: ChainError::NoDescription(_), .. } => "write a URDF file; xacro is expanded first",
            Self::Chain { source: ChainError::NoLink(_) | ChainError::NotAttached { .. }, .. } => {
                "write the names of two of its links as `frame` and `tip`"
            }
            Self::Chain { .. } => "correct that joint in the description",
            Self::Names { .. } => "give each motor the name of its joint, and name that of the gripper as `gripper`",
            Self::Range { .. } => "write limits of the joint and position of the motor that overlap",
        }
    }
}

/// See the module's comment.
#[derive(Debug, Clone)]
pub struct Arm {
    spec: EffectorSpec,
    chain: Chain,
    /// The motor of each joint of the chain.
    motors: Vec<usize>,
    /// What each joint may be: within its own limits and those of its motor.
    limits: Vec<[f64; 2]>,
}

impl Arm {
    /// Reads the description of an arm with these motors.
    ///
    /// # Errors
    /// When it cannot be read, or has other joints than there are motors.
    pub fn open(spec: &EffectorSpec, motors: &[MotorSpec]) -> Result<Self, ArmError> {
        let file = &spec.urdf;
        let text = read(file).map_err(|source| ArmError::File { file: file.clone(), source })?;
        Self::from_urdf(spec, motors, &text)
    }

    /// The same of a description that is at hand.
    ///
    /// # Errors
    /// When it has other joints than there are motors.
    pub fn from_urdf(spec: &EffectorSpec, motors: &[MotorSpec], urdf: &str) -> Result<Self, ArmError> {
        let chain = Chain::read(urdf, spec.frame.as_deref(), &spec.tip);
        let chain = chain.map_err(|source| ArmError::Chain { file: spec.urdf.clone(), source })?;
        let mismatch = |message: String| ArmError::Names { file: spec.urdf.clone(), message };
        let gripper = spec.gripper.map(|gripper| gripper.motor);
        let mut found = Vec::new();
        let mut limits = Vec::new();
        for joint in &chain.joints {
            let motor = motors.iter().enumerate().find(|(_, motor)| motor.name == joint.name);
            let Some((at, motor)) = motor else {
                return Err(mismatch(format!("joint {:?} moves the tip, and no motor has its name", joint.name)));
            };
            if Some(at) == gripper {
                let message = format!("joint {:?} moves the tip, and its motor is the gripper", joint.name);
                return Err(mismatch(message));
            }
            if found.contains(&at) {
                return Err(mismatch(format!("two joints have the name {:?}", joint.name)));
            }
            let [low, high] = [joint.limits[0].max(motor.position[0]), joint.limits[1].min(motor.position[1])];
            if low >= high {
                let (file, joint) = (spec.urdf.clone(), joint.name.clone());
                return Err(ArmError::Range { file, joint, range: motor.position });
            }
            found.push(at);
            limits.push([low, high]);
        }
        let idle = motors.iter().enumerate().find(|(at, _)| !found.contains(at) && Some(*at) != gripper);
        if let Some((_, motor)) = idle {
            let message = format!(
                "motor {:?} is no joint between the frame and link {:?}, and not the gripper",
                motor.name, spec.tip
            );
            return Err(mismatch(message));
        }
        Ok(Self { spec: spec.clone(), chain, motors: found, limits })
    }

    /// Numbers that [`Self::state`] writes.
    pub const fn numbers(&self) -> usize {
        self.spec.numbers()
    }

    /// Writes the pose of the tip behind the numbers of the motors, [`MOTOR_CHANNELS`] each, the position first: position,
    /// opening if there is a gripper, quaternion `x y z w`.
    pub fn state(&self, motors: &[f64], out: &mut [f64]) {
        let position = |motor: usize| motors.get(motor * MOTOR_CHANNELS).copied().unwrap_or(f64::NAN);
        let (place, turned) = self.chain.pose(self.motors.iter().map(|motor| position(*motor)));
        let opening = self.spec.gripper.map(|grip| (position(grip.motor) - grip.closed) / (grip.open - grip.closed));
        for (out, number) in out.iter_mut().zip(place.into_iter().chain(opening).chain(turned)) {
            *out = number;
        }
    }

    /// What turns actions into targets.
    pub fn solver(&self) -> Solver {
        Solver { serial: self.chain.serial(), arm: self.clone() }
    }
}

/// The text of a description.
fn read(file: &Path) -> std::io::Result<String> {
    // Without opening it: opening a pipe would wait for its writer.
    if !std::fs::metadata(file)?.is_file() {
        return Err(std::io::Error::other("it is not a file"));
    }
    read_text(&std::fs::File::open(file)?, LARGEST_FILE)
}

/// See [`Arm::solver`].
pub struct Solver {
    arm: Arm,
    serial: SerialChain<f64>,
}

impl std::fmt::Debug for Solver {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Solver").field("arm", &self.arm).finish_non_exhaustive()
    }
}

impl Solver {
    /// The motors of the joints that move the tip: all but the gripper's.
    pub fn joints(&self) -> &[usize] {
        &self.arm.motors
    }

    /// The position of each motor for an action (x, y, z; the quaternion if it is commanded; the opening of the gripper), with
    /// the motors at `from` at present. A position beyond the box of the registry is moved to its edge.
    ///
    /// # Errors
    /// When the action has another length, or the tip does not get there from where it is: the pose is too far away, beyond the
    /// limits of the joints, or the arm is stretched so that it has no way there. Then the motors should stay.
    pub fn targets(&mut self, action: &[f64], from: &[f64]) -> Result<[f64; MAX_MOTORS], NoAction> {
        let Arm { spec, motors, chain, .. } = &self.arm;
        let turned = if spec.rotation == TipRotation::Commanded { 4 } else { 0 };
        if action.len() != 3 + turned + usize::from(spec.gripper.is_some()) {
            return Err(NoAction::Length);
        }
        let mut action = action.iter().copied();
        let mut next = || action.next().filter(|number| number.is_finite()).ok_or(NoAction::OutOfReach);
        let mut place = [next()?, next()?, next()?];
        for (number, (min, max)) in place.iter_mut().zip(spec.min.iter().zip(&spec.max)) {
            *number = number.clamp(*min, *max);
        }
        let start = motors.iter().map(|motor| from.get(*motor).copied().filter(|number| number.is_finite()));
        let start: Vec<f64> = start.collect::<Option<_>>().ok_or(NoAction::OutOfReach)?;
        let turned = match spec.rotation {
            TipRotation::Commanded => [next()?, next()?, next()?, next()?],
            TipRotation::Held(rotation) => rotation,
            TipRotation::Free => chain.pose(start.iter().copied()).1,
        };
        let target = isometry(place, turned).ok_or(NoAction::OutOfReach)?;
        let gripper = spec.gripper.map(|gripper| Ok((gripper, next()?.clamp(0.0, 1.0)))).transpose()?;
        let found = self.solve(&target, &start).ok_or(NoAction::OutOfReach)?;
        let mut targets = [0.0; MAX_MOTORS];
        for (motor, position) in self.arm.motors.iter().zip(&found) {
            *targets.get_mut(*motor).ok_or(NoAction::OutOfReach)? = *position;
        }
        if let Some((gripper, opening)) = gripper {
            let place = targets.get_mut(gripper.motor).ok_or(NoAction::OutOfReach)?;
            *place = gripper.closed + opening * (gripper.open - gripper.closed);
        }
        Ok(targets)
    }

    /// The joints with the tip at `target`, by damped steps from `start`. `None` if they do not lead there.
    fn solve(&self, target: &Isometry3<f64>, start: &[f64]) -> Option<Vec<f64>> {
        let limits = &self.arm.limits;
        let mut joints: Vec<f64> =
            start.iter().zip(limits).map(|(joint, [low, high])| joint.clamp(*low, *high)).collect();
        for _ in 0..STEPS {
            self.serial.set_joint_positions_unchecked(&joints);
            let error = self.error(target);
            let (far, turned) = (error.rows(0, 3).norm(), error.rows(3, error.len() - 3).norm());
            if far < NEAR_M && turned < NEAR_RAD {
                let is_near = joints.iter().zip(start).all(|(joint, start)| (joint - start).abs() <= FARTHEST);
                return is_near.then_some(joints);
            }
            let slope = k::jacobian(&self.serial).rows(0, error.len()).into_owned();
            let across = slope.transpose();
            let damped = &slope * &across + DMatrix::identity(error.len(), error.len()) * DAMPING.powi(2);
            let step = across * damped.cholesky()?.solve(&error);
            let shorter = (FARTHEST_STEP / step.amax()).min(1.0);
            for ((joint, by), [low, high]) in joints.iter_mut().zip(step.iter()).zip(limits) {
                *joint = (*joint + by * shorter).clamp(*low, *high);
            }
        }
        None
    }

    /// From the tip to `target`: m, and rad about x, y and z as far as they are commanded.
    fn error(&self, target: &Isometry3<f64>) -> DVector<f64> {
        let tip = self.serial.end_transform();
        let far = target.translation.vector - tip.translation.vector;
        let mut turn = target.rotation * tip.rotation.inverse();
        if self.arm.spec.free_yaw {
            // Without its part about z, which may be anything.
            let [_, _, z, w] = *turn.coords.as_ref();
            let about_z = Quaternion::new(w, 0.0, 0.0, z);
            if about_z.norm() > 1e-9 {
                turn = UnitQuaternion::from_quaternion(about_z).inverse() * turn;
            }
        }
        let turn = turn.scaled_axis();
        let all = [far.x, far.y, far.z, turn.x, turn.y, turn.z];
        DVector::from_column_slice(all.get(..self.arm.spec.commanded()).unwrap_or(&all))
    }
}
