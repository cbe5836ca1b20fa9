//! Independent eyes inside the guest: what a camera delivers and what the mask says, read without `rapid`.
//!
//! Invariant: the only `unsafe` of the bench is here, in the V4L2 calls.

pub mod mask;
pub mod v4l;
