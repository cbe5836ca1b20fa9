//! Events: state changes worth a line on a screen and a message in a recording.

use std::path::PathBuf;

use serde::Serialize;

use super::{Level, SlotState};
use crate::modality::ModalityId;
use crate::time::Stamp;

/// A state change, with its moment. As JSON, one object: `{"event":"state","device":...}`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Event {
    /// When it happened, `CLOCK_MONOTONIC` ns.
    pub stamp: Stamp,
    /// What happened.
    #[serde(flatten)]
    pub what: What,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum What {
    /// A registered device was plugged in.
    Attach {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// Node, for example `/dev/video0`.
        node: String,
        /// Port path.
        port: String,
        /// Serial, if it has one.
        serial: Option<String>,
    },
    /// A registered device was pulled out.
    Detach {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// Who told first: `stream`, `kernel`, `udev`, `enumeration` or `script`.
        witness: String,
    },
    /// A slot changed its state.
    State {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// The new state.
        state: SlotState,
        /// The mask after the change, `0x05`.
        mask: String,
        /// Why, or what was agreed with the device.
        detail: String,
    },
    /// Something was plugged in that no entry of the registry means.
    Unregistered {
        /// `vid:pid`, serial, product as the device says.
        device: String,
        /// Why no entry matches.
        reason: String,
    },
    /// An episode began.
    Recording {
        /// The file being written, with its final name.
        file: PathBuf,
    },
    /// An episode ended and its file is closed.
    Episode {
        /// The file; `.partial` remains at its end if it could not be finished.
        file: PathBuf,
        /// Length in seconds.
        seconds: f64,
        /// Messages.
        messages: u64,
        /// Bytes of the file.
        bytes: u64,
        /// Samples lost on the way to the file.
        dropped: u64,
        /// Why the file is not whole, if it is not.
        error: Option<String>,
    },
    /// A line of the log that has no event of its own.
    Log {
        /// Severity.
        level: Level,
        /// Text.
        text: String,
    },
}
