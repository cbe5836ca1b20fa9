//! What a run shows: the monitor in a terminal, lines without one, and the log.
//!
//! Invariant: a screen knows snapshots and commands of `rapid-status`, and no stage.

pub mod headless;
#[cfg(test)]
#[path = "../../tests/support/literal.rs"]
mod literal;
pub mod logging;
pub mod tui;
