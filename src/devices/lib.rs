//! Devices: as they are plugged in, read and switched.
//!
//! Invariant: nothing here knows a mask, a slot or an episode in progress: the rig decides.

#![cfg_attr(
    not(all(feature = "cameras", feature = "lan", feature = "motors")),
    allow(dead_code, unused_imports, unused_variables, clippy::match_same_arms, clippy::needless_pass_by_value)
)]

pub mod calibration;
pub mod driver;
#[cfg(test)]
#[path = "../../tests/support/effort.rs"]
mod effort;
pub mod flash;
#[cfg(all(test, feature = "motors"))]
#[path = "../../tests/support/given.rs"]
mod given;
pub mod hotplug;
pub mod inputs;
pub mod interlocks;
#[cfg(feature = "lan")]
pub mod link;
#[cfg(test)]
#[path = "../../tests/support/patience.rs"]
mod patience;
#[cfg(test)]
#[path = "../../tests/support/ports.rs"]
mod ports;
#[cfg(test)]
#[path = "../../tests/support/recorded.rs"]
mod recorded;
#[cfg(test)]
#[path = "../../tests/support/skip.rs"]
mod skip;
