//! What several parts of `rapid` ask of the operating system: folders that others may write to, free space of a
//! disk, ports that are held, lines of GPIO, the scheduling of threads, and who is at the other end of a socket.
//!
//! Invariant: nothing here knows a device, an episode or a configuration.

pub mod disk;
pub mod folder;
pub mod gpio;
pub mod peer;
#[cfg(test)]
#[path = "../../tests/support/ports.rs"]
mod ports;
pub mod realtime;
#[cfg(test)]
#[path = "../../tests/support/skip.rs"]
mod skip;
pub mod tty;
