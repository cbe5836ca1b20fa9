//! An arm of the registry: what its motors are in the chain, and what its actions mean.

use std::path::PathBuf;

use k::{Constraints, InverseKinematicsSolver as _, JacobianIkSolver, SerialChain};

use super::chain::{Chain, ChainError, isometry};
use crate::registry::{EffectorSpec, MAX_MOTORS, MOTOR_CHANNELS, MotorSpec, TipRotation};

/// How near the tip must come to its target: a tenth of what the motors resolve.
const NEAR_M: f64 = 1e-4;
const NEAR_RAD: f64 = 1e-3;
/// Steps of the solver, and which part of the way to the linear solution each takes. What a tip moves within a tick
/// needs five.
const STEPS: usize = 100;
const PART: f64 = 0.7;

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
    Motors {
        /// The description.
        file: PathBuf,
        /// Which.
        message: String,
    },
}

/// A target that the tip cannot have: too far away, beyond the limits of the joints, or beyond a position from which the
/// arm has no way there (a singular one).
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the arm does not reach the pose that is asked for, or is stretched so that it has no way there")]
pub struct OutOfReach;

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
        let text = std::fs::read_to_string(file).map_err(|source| ArmError::File { file: file.clone(), source })?;
        Self::of(spec, motors, &text)
    }

    /// The same of a description that is at hand.
    ///
    /// # Errors
    /// When it has other joints than there are motors.
    pub fn of(spec: &EffectorSpec, motors: &[MotorSpec], urdf: &str) -> Result<Self, ArmError> {
        let chain = Chain::read(urdf, spec.frame.as_deref(), &spec.tip);
        let chain = chain.map_err(|source| ArmError::Chain { file: spec.urdf.clone(), source })?;
        let mismatch = |message: String| ArmError::Motors { file: spec.urdf.clone(), message };
        let gripper = spec.gripper.map(|gripper| gripper.motor);
        let mut found = Vec::new();
        let mut limits = Vec::new();
        for joint in &chain.joints {
            let motor = motors.iter().enumerate().find(|(_, motor)| motor.name == joint.name);
            let Some((at, motor)) = motor.filter(|(at, _)| Some(*at) != gripper) else {
                return Err(mismatch(format!(
                    "joint {:?} moves the tip, and no motor of [can] has its name",
                    joint.name
                )));
            };
            let [low, high] = [joint.limits[0].max(motor.position[0]), joint.limits[1].min(motor.position[1])];
            if low > high {
                let message =
                    format!("no position of joint {:?} is also one of its motor ({:?})", joint.name, motor.position);
                return Err(mismatch(message));
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
        let (needs_rotation, has_yaw) = (self.spec.rotation != TipRotation::Free, !self.spec.free_yaw);
        Solver {
            serial: self.chain.serial(self.limits.iter().copied()),
            jacobian: JacobianIkSolver::new(NEAR_M, NEAR_RAD, PART, STEPS),
            constraints: Constraints {
                rotation_x: needs_rotation,
                rotation_y: needs_rotation,
                rotation_z: needs_rotation && has_yaw,
                ..Constraints::default()
            },
            arm: self.clone(),
        }
    }
}

/// See [`Arm::solver`].
pub struct Solver {
    arm: Arm,
    serial: SerialChain<f64>,
    jacobian: JacobianIkSolver<f64>,
    constraints: Constraints,
}

impl std::fmt::Debug for Solver {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Solver").field("arm", &self.arm).finish_non_exhaustive()
    }
}

impl Solver {
    /// The position of each motor for an action (x, y, z; the quaternion if it is commanded; the opening of the gripper), with
    /// the motors at `from` at present: of several ways to reach a pose the nearest is taken.
    ///
    /// # Errors
    /// When the tip cannot be there; then the motors should stay.
    pub fn targets(&mut self, action: &[f64], from: &[f64]) -> Result<[f64; MAX_MOTORS], OutOfReach> {
        let Arm { spec, motors, limits, chain } = &self.arm;
        let mut action = action.iter().copied();
        let mut next = || action.next().filter(|number| number.is_finite()).ok_or(OutOfReach);
        let mut place = [next()?, next()?, next()?];
        for (number, (min, max)) in place.iter_mut().zip(spec.min.iter().zip(&spec.max)) {
            *number = number.clamp(*min, *max);
        }
        let start = motors.iter().map(|motor| from.get(*motor).copied().filter(|number| number.is_finite()));
        let start: Vec<f64> = start.collect::<Option<_>>().ok_or(OutOfReach)?;
        let turned = match spec.rotation {
            TipRotation::Commanded => [next()?, next()?, next()?, next()?],
            TipRotation::Held(rotation) => rotation,
            TipRotation::Free => chain.pose(start.iter().copied()).1,
        };
        let target = isometry(place, turned).ok_or(OutOfReach)?;
        let clamped = start.iter().zip(limits).map(|(number, [low, high])| number.clamp(*low, *high));
        self.serial.set_joint_positions_unchecked(&clamped.collect::<Vec<_>>());
        self.jacobian.solve_with_constraints(&self.serial, &target, &self.constraints).map_err(|_| OutOfReach)?;
        let mut targets = [0.0; MAX_MOTORS];
        let found = self.serial.joint_positions();
        for (motor, position) in motors.iter().zip(&found) {
            let place = targets.get_mut(*motor).filter(|_| position.is_finite()).ok_or(OutOfReach)?;
            *place = *position;
        }
        if let Some(gripper) = spec.gripper {
            let opening = next()?.clamp(0.0, 1.0);
            *targets.get_mut(gripper.motor).ok_or(OutOfReach)? =
                gripper.closed + opening * (gripper.open - gripper.closed);
        }
        Ok(targets)
    }
}
