//! Measuring a sensor: its samples against events known to have happened.
//!
//! `brightness` reduces a picture to one number, `latency` finds the delay at which those numbers
//! follow a light.
//!
//! Invariant: pure: no clock, no device, no file.
//! Invariant: no bytes of a picture cause a panic.

mod brightness;
mod latency;

pub use brightness::{BrightnessError, brightness};
pub use latency::{Estimate, Flip, Refusal, Seen, estimate};
