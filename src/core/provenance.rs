//! Provenance: what was negotiated with a device when it was opened, and through which driver.
//!
//! Plain data for the log, the events and the recording; filled in by the code that queries the device.
//!
//! Invariant: everything here is what the device or the kernel answered, not what was requested; what
//! they do not report is absent.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// A driver of the kernel.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize)]
pub struct KernelDriver {
    /// Its name, for example `uvcvideo`, `cdc_acm`, `ftdi_sio`.
    pub name: String,
    /// Its version, where it has one: drivers of V4L2 report that of the kernel they belong to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub version: Option<String>,
}

/// What first noticed that a device was unplugged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum UnplugSource {
    /// The stream that read the device.
    Stream,
    /// The kernel's own uevent.
    Kernel,
    /// udev's processed event.
    Udev,
    /// The device was missing when all devices were enumerated again.
    Enumeration,
    /// A device on the network announced its end.
    Goodbye,
    /// Nothing was received from a device on the network for its lease, or it refused a connection.
    Lease,
    /// The link to a device on the network is down.
    Link,
    /// A scenario, or the key that unplugs a simulated device.
    Scenario,
}

impl UnplugSource {
    /// The word for it, as in JSON.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Stream => "stream",
            Self::Kernel => "kernel",
            Self::Udev => "udev",
            Self::Enumeration => "enumeration",
            Self::Goodbye => "goodbye",
            Self::Lease => "lease",
            Self::Link => "link",
            Self::Scenario => "scenario",
        }
    }
}

/// What was negotiated with a device when it was opened.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Negotiated {
    /// The driver that answered.
    pub driver: Option<KernelDriver>,
    /// What the driver calls the device (V4L2 `card`).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub card: Option<String>,
    /// Where the driver reports the device to be (V4L2 `bus_info`).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bus: Option<String>,
    /// The format of its samples.
    pub format: Option<Format>,
    /// Controls and their values as read back, by their names in `devices.toml`.
    pub controls: BTreeMap<String, i64>,
    /// Its samples are those of a recording.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub replay_of: Option<Arc<ReplaySource>>,
}

/// A recording that is replayed.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReplaySource {
    /// Its file.
    pub file: String,
    /// When it began, ns since 1970.
    pub begin_ns: u64,
    /// The word of its verdict; empty if it has none.
    pub verdict: String,
    /// Why it is not GOOD, or has no verdict.
    pub reasons: Vec<String>,
}

impl ReplaySource {
    /// The name of its file, without the folder.
    pub fn name(&self) -> &str {
        self.file.rsplit('/').next().unwrap_or_default()
    }
}

/// The format of the samples of a device.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Format {
    /// Pictures.
    Pictures {
        /// V4L2 name of the pixel format.
        fourcc: String,
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
        /// Images per second; absent if the driver cannot set a rate.
        #[serde(skip_serializing_if = "Option::is_none")]
        fps: Option<f64>,
    },
    /// Messages on a serial line.
    Messages {
        /// Bits a second; absent where there is no line.
        #[serde(skip_serializing_if = "Option::is_none")]
        baud: Option<u32>,
        /// Values in a message; 0 if it is not parsed.
        channels: usize,
        /// Messages a second, where it is known.
        #[serde(skip_serializing_if = "Option::is_none")]
        hz: Option<f64>,
    },
}
