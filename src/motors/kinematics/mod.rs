//! The arm that motors move: where its tip is, and where its motors must be for the tip to be elsewhere.
//!
//! [`Chain`] is read from the description of the robot (URDF, wiki.ros.org/urdf/XML) and computes the pose of the tip;
//! [`Arm`] adds what the registry states about it and turns actions into targets of the motors.
//!
//! Invariant: nothing in a file causes a panic, and no number that is not finite gets to the motors.
//! Invariant: [`Arm::state`] does not allocate or lock: it is called for every sample. [`Solver::targets`] does both, and
//! belongs in a thread of its own.

mod arm;
mod chain;
#[cfg(test)]
pub(crate) mod tests;

pub use arm::{Arm, ArmError, Solver};
pub use chain::{Chain, ChainError};
