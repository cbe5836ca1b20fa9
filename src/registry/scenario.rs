//! Scenarios: the simulated devices and when they are plugged, unplugged or become silent.

use std::time::Duration;

use crate::device::{LanIdentity, UsbIdentity};
use crate::simulation::{SimFaults, SimSource};

/// A whole scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct Scenario {
    /// The devices that can be plugged.
    pub devices: Vec<ScenarioDevice>,
    /// Its events, ascending by time; the order in the file decides between equal times.
    pub events: Vec<ScenarioEvent>,
    /// After this time the events begin again, if given.
    pub repeat: Option<Duration>,
}

/// A device of a scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct ScenarioDevice {
    /// Name within the scenario; the registry entry it simulates unless `usb` states otherwise.
    pub name: String,
    /// The identity it reports when plugged.
    pub usb: UsbIdentity,
    /// It is on the network and reports this instead; then only the port of `usb` is used.
    pub lan: Option<LanIdentity>,
    /// The data it sends.
    pub source: SimSource,
    /// Plugged when the scenario begins.
    pub plugged: bool,
    /// Its faults.
    pub faults: SimFaults,
}

/// An event of a scenario.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ScenarioEvent {
    /// When, from the beginning.
    pub at: Duration,
    /// Name of the device.
    pub device: String,
    /// What.
    pub action: ScenarioAction,
}

/// The kinds of events of a simulated device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ScenarioAction {
    /// Plugged in, into another port if one is given.
    Plug {
        /// Port path; the device's last one if absent.
        port: Option<String>,
    },
    /// Unplugged.
    Unplug,
    /// Stays attached and sends nothing.
    Silence,
    /// Sends again.
    Resume,
}
