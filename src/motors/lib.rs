//! Motors, without the wires to them: from an action to their commands, and from a pose of an arm's tip to their positions.
//!
//! Invariant: nothing here sends, waits or reads a clock.

#[cfg(test)]
#[path = "../../tests/support/arm.rs"]
mod arms;
pub mod control;
pub mod kinematics;

#[cfg(test)]
extern crate self as rapid_motors;
