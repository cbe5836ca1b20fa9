//! The kinds of devices that a registry can name, each with its keys and what follows from them.

pub(super) mod camera;
