#![doc = include_str!("../docs/architecture.md")]
// The whole program is linted with all features; with fewer, code that only they use is unused.
#![cfg_attr(
    not(all(
        feature = "cameras",
        feature = "foxglove",
        feature = "lan",
        feature = "motors",
        feature = "policy",
        feature = "web"
    )),
    allow(dead_code, unused_imports, unused_variables, clippy::match_same_arms, clippy::needless_pass_by_value)
)]

pub mod alignment;
pub mod app;
pub mod cli;
pub mod commands;
#[cfg(feature = "policy")]
pub mod compare;
pub mod dispatch;
#[cfg(all(test, feature = "policy"))]
#[path = "../tests/support/example.rs"]
mod example;
#[cfg(test)]
#[path = "../tests/support/literal.rs"]
mod literal;
#[cfg(feature = "policy")]
pub mod lockstep;
pub mod orders;
#[cfg(test)]
#[path = "../tests/support/patience.rs"]
mod patience;
#[cfg(test)]
#[path = "../tests/support/recorded.rs"]
mod recorded;
pub mod registration;
pub mod rig;
pub mod session;
#[cfg(test)]
#[path = "../tests/support/skip.rs"]
mod skip;
