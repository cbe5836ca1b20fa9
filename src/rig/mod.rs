//! rig
pub mod slot;
