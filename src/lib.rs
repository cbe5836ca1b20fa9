//! `rapid`: hot-plug discovery, physical mask, streaming, synchronisation and recording for
//! robot-learning rigs, in one binary.

pub mod commands;
pub mod driver;
pub mod headless;
pub mod hotplug;
pub mod logging;
pub mod mask;
pub mod modality;
pub mod outlet;
pub mod registry;
pub mod sample;
pub mod status;
pub mod text;
pub mod time;
pub mod tui;
