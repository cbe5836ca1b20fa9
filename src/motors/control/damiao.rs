//! Damiao's motors: their frames, their parameters, and the data of each kind from their maker.
//!
//! Firmware whose enable frame is sent to `((mode - 1) << 2) + id` instead of the motor's own id is not
//! supported.

pub mod codec;
pub mod model;
pub mod parameter;
