//! Measuring a sensor: what its samples showed, against what is known to have happened.
//!
//! `brightness` makes one number of a picture, `latency` finds the delay at which those numbers
//! follow a light.
//!
//! Invariant: pure: no clock, no device, no file.
//! Invariant: no bytes of a picture make this panic.

mod brightness;
mod latency;

pub(crate) use brightness::with_mark;
pub use brightness::{BrightnessError, brightness};
pub use latency::{Estimate, Flip, Refusal, Seen, estimate};
