//! The emulator's log, one JSON object per line on stdout.
//!
//! Invariant: every line contains both clocks, read at the event and not when it was printed.

use std::io::Write;
use std::sync::Mutex;

use serde_json::{Map, Value, json};

use crate::clock;

/// A time on both clocks.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// CLOCK_MONOTONIC, ns.
    pub mono_ns: u64,
    /// CLOCK_REALTIME, ns.
    pub real_ns: u64,
}

impl Moment {
    /// Now.
    pub fn now() -> Self {
        Self { mono_ns: clock::mono_ns(), real_ns: clock::real_ns() }
    }
}

/// The destination of the log.
pub struct Log {
    out: Mutex<Box<dyn Write + Send>>,
}

impl Log {
    /// Prints to `out`.
    pub fn new(out: Box<dyn Write + Send>) -> Self {
        Self { out: Mutex::new(out) }
    }

    /// Prints `{"action":..., <fields>, "mono_ns":.., "real_ns":..}`. A closed output is ignored.
    pub fn write(&self, action: &str, moment: Moment, fields: Value) {
        let mut line = Map::new();
        line.insert("action".into(), json!(action));
        if let Value::Object(fields) = fields {
            line.extend(fields);
        }
        line.insert("mono_ns".into(), json!(moment.mono_ns));
        line.insert("real_ns".into(), json!(moment.real_ns));
        let text = format!("{}\n", Value::Object(line));
        let mut out = self.out.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let _gone = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    }
}
