//! Panics: where their messages go while the rig runs.
//!
//! Rust's default hook writes to standard error and waits for its reader, before anything is
//! unwound: with a pipe that has no reader, the thread would block and its panic would go unnoticed.
//! So messages go to the log, which waits for no reader. While a screen has the terminal
//! they are kept as well, to be printed once it is restored.
//!
//! Invariant: only this module sets the hook; it stays for the life of the process, as a hook cannot
//! be removed from a chain of hooks.

use std::backtrace::{Backtrace, BacktraceStatus};
use std::panic::PanicHookInfo;
use std::sync::{Mutex, MutexGuard, Once, PoisonError};

/// The target of the log lines written here.
pub const TARGET: &str = "rapid::panics";

/// Name of the thread that moves motors. Its panics have no backtrace: that is created before anything is
/// unwound, takes a good part of a second, and for that long the motors would continue.
pub const CONTROL_THREAD: &str = "control";

/// Where messages go.
#[derive(Debug)]
enum Goes {
    /// To standard error, as by Rust's hook.
    Stderr,
    Log,
    /// To the log and into this list.
    Kept(Vec<String>),
}

static GOES: Mutex<Goes> = Mutex::new(Goes::Stderr);
static HOOK: Once = Once::new();

/// From now on messages go to the log.
pub fn to_log() {
    set(Goes::Log);
}

/// From now on messages go to the log and are kept.
pub fn keep() {
    set(Goes::Kept(Vec::new()));
}

/// The messages kept. From now on they go to standard error.
pub fn release() -> Vec<String> {
    match std::mem::replace(&mut *goes(), Goes::Stderr) {
        Goes::Kept(messages) => messages,
        Goes::Stderr | Goes::Log => Vec::new(),
    }
}

fn set(to: Goes) {
    HOOK.call_once(|| {
        let rust = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if matches!(*goes(), Goes::Stderr) {
                return rust(info);
            }
            report(info);
        }));
    });
    *goes() = to;
}

fn report(info: &PanicHookInfo<'_>) {
    let thread = std::thread::current();
    let message = format!("thread '{}' {info}", thread.name().unwrap_or("unnamed"));
    tracing::error!(target: TARGET, "{message}");
    // Only if requested by RUST_BACKTRACE; it is split because one line cannot hold all of it.
    let backtrace = if thread.name() == Some(CONTROL_THREAD) { Backtrace::disabled() } else { Backtrace::capture() };
    if backtrace.status() == BacktraceStatus::Captured {
        for line in backtrace.to_string().lines() {
            tracing::error!(target: TARGET, "{line}");
        }
    }
    if let Goes::Kept(messages) = &mut *goes() {
        messages.push(message);
    }
}

/// A poisoned lock here guards whole values: continue with them.
fn goes() -> MutexGuard<'static, Goes> {
    GOES.lock().unwrap_or_else(PoisonError::into_inner)
}
