//! Why a run could not begin or continue.

use std::io;
use std::path::{Path, PathBuf};

use rapid_bus::BusError;
use rapid_devices::hotplug::HotplugError;
use rapid_episode::record::RecordError;
use rapid_screens::logging::LoggingError;
use rapid_screens::tui::TuiError;

use super::LAST_CHUNK;
use crate::rig::RigError;
use crate::rig::presence::PresenceError;

/// Why a run could not begin or continue.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// The log.
    #[error(transparent)]
    Logging(#[from] LoggingError),
    /// The mask.
    #[error(transparent)]
    Presence(#[from] PresenceError),
    /// The bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// Plugging.
    #[error(transparent)]
    Hotplug(#[from] HotplugError),
    /// The rig.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The recorder.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The monitor.
    #[error(transparent)]
    Tui(#[from] TuiError),
    /// A stage that a build may lack: a server, or the policy.
    #[error(transparent)]
    Optional(Box<dyn std::error::Error + Send + Sync>),
    /// The output of a headless run.
    #[error("output: {0}")]
    Output(io::Error),
    /// A thread or signal handler.
    #[error("system call failed: {0}")]
    System(#[from] io::Error),
    /// Its chunks take longer than their actions.
    #[error("the policy is too slow on this machine: {0}")]
    TooSlow(String),
    /// What the policy requires is not present.
    #[error("the policy needs {0}: plug it in, or use --wait to start when it is there")]
    Required(String),
    /// The policy does not end.
    #[error("the policy did not end within {} s", LAST_CHUNK.as_secs())]
    Stuck,
    /// An episode's file is not whole.
    #[error("{}: {reason}{}", file.display(), repair(file))]
    Episode {
        /// What exists of it.
        file: PathBuf,
        /// Why.
        reason: String,
    },
    /// The session's file lacks what was collected.
    #[error("{0}; the episodes themselves are there: `rapid list` shows them, and `rapid label` labels them")]
    Unsaved(String),
    /// Other programs could not stop the actuator.
    #[error("orders to the actuator cannot be received: {0}")]
    Orders(#[source] io::Error),
    /// Emergency stops would not be noticed.
    #[error("emergency stops cannot be read: {0}")]
    Interlocks(#[source] io::Error),
    /// A run without a screen recorded an episode that must not be used.
    #[error("{}", bad(*count, file))]
    Bad {
        /// Episodes that are BAD.
        count: usize,
        /// The last of them.
        file: PathBuf,
    },
    /// A task or thread of this program panicked.
    #[error("{0} panicked; please report this")]
    Panicked(&'static str),
    /// A second signal came while the run was ending.
    #[error("interrupted twice")]
    InterruptedTwice,
}

impl AppError {
    /// The error of a stage that a build may lack.
    #[cfg(any(feature = "foxglove", feature = "policy", feature = "web"))]
    pub(super) fn optional(error: impl std::error::Error + Send + Sync + 'static) -> Self {
        Self::Optional(Box::new(error))
    }
}

fn bad(count: usize, file: &Path) -> String {
    let file = file.display();
    let many = if count > 1 { format!(", and {} before it", count - 1) } else { String::new() };
    format!("{file} is BAD{many}: its verdict above has the reasons; see `rapid inspect`")
}

/// What to do about a file that did not get its finished name; empty if it did.
fn repair(file: &Path) -> String {
    let is_finished = file.extension().is_some_and(|extension| extension == "mcap");
    if is_finished {
        String::new()
    } else {
        format!("; `rapid recover {}` keeps what can be read of it", file.display())
    }
}
