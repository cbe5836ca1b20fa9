//! Scenarios of the virtual bench, each in a boot of the guest unless its file describes another way.
//!
//! As many run at a time as the kind of guest permits ([`vbench::guest`]). While they do, others are prepared or judged.

mod accidents;
mod adapters;
mod arm;
mod brake;
mod buses;
mod buttons;
mod calibrate;
mod commands;
mod deaf_child;
mod endless;
mod endurance;
mod guard;
mod hub;
mod kill;
mod lan;
mod motors;
mod policy;
mod scenarios;
mod service;
#[path = "../../../support/skip.rs"]
mod skip;
mod streams;
mod strings;
mod unprivileged;

use vbench::guest::Image;

/// Whether a scenario whose motors or policy have the product's own limits of time cannot be run here, which is then reported: an
/// emulated processor does not keep them.
fn lacks_virtual_time() -> bool {
    let guest = Image::locate().unwrap_or_else(|error| panic!("{error}"));
    if !guest.is_virtual() {
        skip::skipped("needs virtual time, and guests here are emulated machines");
    }
    !guest.is_virtual()
}
