//! Subcommands that run without a rig: each writes to a given stream and returns its outcome.

pub mod ablation;
pub mod arm;
pub mod artifacts;
pub mod calibrate;
pub mod check;
#[cfg(feature = "policy")]
pub mod compare;
pub mod completions;
#[cfg(feature = "policy")]
pub mod demonstrate;
pub mod devices;
pub mod doctor;
#[cfg(feature = "policy")]
pub mod eval;
#[cfg(feature = "export")]
pub mod export;
pub mod inspect;
pub mod list;
pub mod logs;
pub mod mask;
pub mod modules;
pub mod monitor;
pub mod notes;
pub mod plot;
#[cfg(feature = "policy")]
pub mod policy;
pub mod progress;
pub mod recover;
pub mod register;
pub mod session;

/// An object of the output with what it is about as its key `event`.
#[derive(serde::Serialize)]
struct Tagged<'a, T> {
    event: &'static str,
    #[serde(flatten)]
    value: &'a T,
}

/// `value`, an object, as one line of JSON with the key `event`: the kind of an object, by which docs/schema.json
/// distinguishes all that are printed. Without a line end.
fn json_line(event: &'static str, value: &impl serde::Serialize) -> std::io::Result<String> {
    Ok(rapid_core::text::json(&Tagged { event, value })?)
}

/// How a listing is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Format {
    /// Plain text.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

/// The outcome of a command; the caller turns it into an exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CommandStatus {
    /// Success.
    Done,
    /// The configuration is invalid; its mistakes have been written.
    BadConfiguration,
}
