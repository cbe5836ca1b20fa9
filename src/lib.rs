//! `rapid`: hot-plug discovery, physical mask, streaming, synchronisation and recording for
//! robot-learning rigs, in one binary.

pub mod driver;

pub mod hotplug;

pub mod mask;
pub mod modality;
pub mod outlet;
pub mod registry;
pub mod sample;
pub mod status;
pub mod text;
pub mod time;
pub mod tui;
