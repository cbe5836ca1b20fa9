//! Scenarios of the virtual bench, each in a boot of the guest unless its file describes another way.
//!
//! They wait for each other: one guest runs at a time ([`vbench::guest`]). While it does, another one is prepared or judged.

mod accidents;
mod adapters;
mod arm;
mod brake;
mod buses;
mod buttons;
mod calibrate;
mod commands;
mod deaf_child;
mod endurance;
mod guard;
mod hub;
mod kill;
mod lan;
mod motors;
mod policy;
mod scenarios;
mod service;
mod streams;
mod strings;
mod unprivileged;
