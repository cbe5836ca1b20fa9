//! What every part of `rapid` speaks of: modalities, the mask, samples, time, observations and how they are
//! synchronised, actions and who permits them, and text that is safe for a terminal.
//!
//! Invariant: nothing here opens a device, a file or a socket, starts a thread or waits; the clocks are read, and a
//! bell of the kernel is rung.

#![forbid(unsafe_code)]

pub mod action;
pub mod bell;
pub mod capture;
pub mod clip;
pub mod interlock;
pub mod mask;
pub mod modality;
pub mod observation;
pub mod permission;
pub mod points;
pub mod provenance;
pub mod random;
pub mod remote;
pub mod rotation;
pub mod sample;
pub mod site;
pub mod sync;
pub mod text;
pub mod time;
pub mod topic;
pub mod walked;
mod words;
