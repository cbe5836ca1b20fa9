//! The virtual USB bench: real kernel paths without hardware.
//!
//! A scenario names emulated devices, a registry and a timeline; the harness boots a guest with a Linux kernel and the
//! real udev, runs the emulator and `rapid` in it, and returns their output and recordings.
//!
//! Invariant: nothing here imports `rapid`; the bench uses only its command line, its output and its files.
//! Invariant: a missing guest or binary is an error that names the remedy, never a skipped test.

pub mod check;
pub mod clock;
pub mod deaf;
pub mod emu;
pub mod entries;
pub mod figure;
pub mod guest;
pub mod latency;
pub mod outcome;
pub mod probe;
pub mod programs;
pub mod proto;
pub mod recording;
pub mod rhythm;
pub mod scenario;
