//! `rapid`: hot-plug discovery, physical mask, streaming, synchronisation and recording for
//! robot-learning rigs, in one binary.

pub mod bus;
pub mod commands;
pub mod driver;
pub mod headless;
pub mod hotplug;
pub mod logging;
pub mod mask;
pub mod modality;
pub mod outlet;
pub mod record;
pub mod registry;
pub mod rig;
pub mod sample;
pub mod status;
pub mod sync;
pub mod text;
pub mod time;
pub mod tui;
