//! Actuation: from an action to the frames that move motors.
//!
//! Owns what may be requested of a motor and when: codecs, limits, interpolation, the deadman and the state
//! machine of a bus of motors ([`motors::MotorBus`]), which puts them together.
//!
//! Invariant: pure. Time comes in as an argument, frames go in and out as values; there is no I/O, and
//! after construction nothing here allocates.
//! Invariant: no bytes from a bus and no numbers in an action cause a panic.

pub mod can;
pub mod damiao;
pub mod deadman;
pub mod interpolate;
pub mod limits;
pub mod motors;
pub mod pace;
pub mod ramp;
