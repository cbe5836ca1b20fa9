//! Subcommands that need no rig: each writes to a given stream and says how it ended.

pub mod ablation;
pub mod arm;
pub mod artifacts;
pub mod calibrate;
pub mod check;
pub mod compare;
pub mod completions;
pub mod demonstrate;
pub mod devices;
pub mod doctor;
mod episodes;
pub mod eval;
pub mod inspect;
pub mod mask;
pub mod progress;
pub mod recover;
pub mod register;

/// How a listing is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Format {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

/// How a command ended; the caller turns it into an exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// It did what was asked.
    Done,
    /// The configuration is wrong; what is wrong has been written.
    BadConfiguration,
}
