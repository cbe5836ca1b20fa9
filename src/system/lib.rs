//! What several parts of `rapid` ask of the operating system: folders that others may write to, free space of a
//! disk, reads that are bounded, ports that are held, lines of GPIO, the scheduling of threads, who is at the other end of a socket, output that
//! blocks its own thread alone, and what is reported of a panic.
//!
//! Invariant: nothing here knows a device, an episode or a configuration.

pub mod disk;
pub mod fault;
pub mod folder;
pub mod gpio;
pub mod limited;
pub mod outlet;
pub mod panics;
pub mod peer;
#[cfg(test)]
#[path = "../../tests/support/ports.rs"]
mod ports;
pub mod realtime;
#[cfg(test)]
#[path = "../../tests/support/skip.rs"]
mod skip;
pub mod tty;
