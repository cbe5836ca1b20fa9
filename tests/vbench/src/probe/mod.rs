//! Independent eyes inside the guest: what a camera delivers, what the mask says, what kernel and udev tell and how evenly a
//! thread can beat, all without `rapid`.
//!
//! Invariant: the only `unsafe` of the bench is here, in the V4L2 calls.

pub mod beat;
pub mod mask;
pub mod uevent;
pub mod v4l;
