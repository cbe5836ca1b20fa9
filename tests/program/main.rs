//! The program as a user starts it: each test starts the built binary with a folder and an instance of its own.
//!
//! One executable for all of them, because linking forty of them takes minutes. Its tests run side by side: whatever
//! belongs to the process (environment, current folder, umask) is set for a child only, and what belongs to the machine
//! (shared memory, ports) carries the name of the test's instance.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "what fails here fails a test")]

#[path = "../support/mod.rs"]
mod support;

mod ablation;
mod alone;
mod binary;
mod buttons;
mod calibrate;
mod compare;
mod demonstrate;
mod docs;
mod ends;
mod export;
#[cfg(feature = "foxglove")]
mod foxglove;
#[cfg(feature = "foxglove")]
mod foxglove_hostile;
mod hooks;
mod hostile;
mod infer;
mod json;
mod kill;
mod lan;
mod lan_gopro;
mod lan_hostile;
mod lan_mdns;
mod lan_remote;
mod list;
mod many_devices;
mod modules;
mod nodes;
mod notes;
mod observe;
mod old_files;
mod plot;
mod policy;
mod process;
mod provenance;
mod publishers;
mod python;
mod register;
mod reload;
mod scenarios;
mod screen;
mod scripts;
mod second_run;
mod session;
mod sessions;
mod shared_memory;
mod skips;
mod stops;
mod streams;
mod task;
mod verdict;
#[cfg(feature = "web")]
mod web;
