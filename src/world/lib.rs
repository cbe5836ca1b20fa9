//! The world of the simulated task: physics, pictures, touch, and an expert.
//!
//! A crate of its own, because tests draw tens of thousands of pictures, pixel by pixel: it is optimised in them, too.
//!
//! Invariant: everything follows from the seed and the actions.

#![forbid(unsafe_code)]

mod expert;
mod looks;
mod touch;
mod world;

pub use expert::Expert;
pub use looks::{Looks, SIDE, SIDE_PIXELS};
pub use touch::{Touch, UNSEEN_PERIOD};
pub use world::{AXES, AXIS_COUNT, MAX_STEPS, Outcome, STEP_HZ, Size, Texture, World};
