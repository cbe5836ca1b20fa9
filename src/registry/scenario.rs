//! Scenarios: which simulated devices there are and when they are plugged, unplugged or fall silent.
//!
//! A simulated device enters like a real one: by a hot-plug event whose [`Attachment`] carries a
//! [`SimDevice`], opened by `driver::open`. Nothing beyond knows the difference.
//!
//! [`Attachment`]: super::Attachment

use std::any::Any;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

use super::attachment::{LanIdentity, UsbIdentity};
use crate::provenance::KernelDriver;
use crate::time::Stamp;

/// A whole scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct Scenario {
    /// The devices that can be plugged.
    pub devices: Vec<ScenarioDevice>,
    /// What happens, ascending by time; the order in the file decides between equal times.
    pub events: Vec<ScenarioEvent>,
    /// After this time the events begin again, if given.
    pub repeat: Option<Duration>,
}

/// A device of a scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct ScenarioDevice {
    /// Name within the scenario; the registry entry it stands for unless `usb` says otherwise.
    pub name: String,
    /// What it says it is when plugged.
    pub usb: UsbIdentity,
    /// It is on the network and says this instead; only its port is of use then.
    pub lan: Option<LanIdentity>,
    /// What it sends.
    pub source: SimSource,
    /// Plugged when the scenario begins.
    pub plugged: bool,
    /// What it does wrong.
    pub faults: SimFaults,
}

/// What a simulated device does wrong while it is plugged in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SimFaults {
    /// From this moment of the scenario on it sends the same bytes again and again.
    pub freeze_at: Option<Duration>,
    /// Every so many samples one is cut in the middle.
    pub truncate_every: Option<u64>,
    /// Every so many samples one is sent twice.
    pub duplicate_every: Option<u64>,
    /// Every so many samples one is lost by the device, which says so.
    pub lose_every: Option<u64>,
    /// Samples arrive so long after their capture.
    pub delay: Duration,
    /// A camera's pictures show the light as it was so long before their capture time.
    pub latency: Duration,
    /// Its clock runs fast by so many parts in a million, slow if negative.
    pub clock_ppm: i64,
    /// Closing it takes so long.
    pub close: Duration,
}

/// What a simulated device sends.
#[derive(Debug, Clone, PartialEq)]
pub enum SimSource {
    /// JPEG pictures of these dimensions in pixels; bytes are a function of seed and sequence.
    Camera {
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
        /// Frames per second.
        fps: u32,
        /// Chooses the pictures.
        seed: u64,
        /// Least size of a picture; what it lacks is filled up. 0: as the encoder makes it.
        bytes: usize,
    },
    /// Vectors of numbers; values are a function of seed and sequence.
    Serial {
        /// Numbers in a sample.
        channels: usize,
        /// Samples per second.
        hz: u32,
        /// Chooses the values.
        seed: u64,
    },
    /// A part of the simulated task.
    Task {
        /// Which.
        part: TaskPart,
        /// The trial it stands in, with the other parts.
        scene: Arc<Scene>,
    },
    /// Nothing of its own: the program of the entry runs as it would for a real device.
    Process,
    /// The samples of one topic of a recorded episode, at their recorded distances in time.
    Replay {
        /// The episode.
        file: PathBuf,
        /// The topic in it.
        topic: String,
        /// Wall time of the episode's beginning as recorded, ns: moment zero of the scenario.
        begin_ns: u64,
    },
}

/// A device of the simulated task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskPart {
    /// The camera at the wrist.
    Wrist,
    /// The camera behind the gel of the fingertip.
    Tactile,
    /// The arm with its gripper: tells its state, and is the actuator.
    Arm,
}

/// What the devices of one simulated task share. What it holds is the driver's own.
#[derive(Debug)]
pub struct Scene {
    /// Number of the trial.
    pub seed: u64,
    /// The trial, once a device has been opened.
    pub trial: OnceLock<Arc<dyn Any + Send + Sync>>,
}

impl PartialEq for Scene {
    fn eq(&self, other: &Self) -> bool {
        self.seed == other.seed
    }
}

/// What stands for the kernel's driver of a simulated device.
#[must_use]
pub fn driver() -> KernelDriver {
    KernelDriver { name: "rapid-sim".to_owned(), version: Some(env!("CARGO_PKG_VERSION").to_owned()) }
}

/// Something that happens in a scenario.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ScenarioEvent {
    /// When, from the beginning.
    pub at: Duration,
    /// Name of the device.
    pub device: String,
    /// What.
    pub action: ScenarioAction,
}

/// What can happen to a simulated device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ScenarioAction {
    /// Plugged in, into another port if one is given.
    Plug {
        /// Port path; the device's last one if absent.
        port: Option<String>,
    },
    /// Pulled out.
    Unplug,
    /// Stays attached and sends nothing more.
    Silence,
    /// Sends again.
    Resume,
}

/// A simulated device that is plugged in: its cable, shared between the script that pulls it and
/// the driver that reads it.
#[derive(Debug)]
pub struct SimDevice {
    /// Name within the scenario.
    pub name: String,
    /// What it sends.
    pub source: SimSource,
    /// What it does wrong.
    pub faults: SimFaults,
    /// The scenario's moment zero.
    pub begun: Stamp,
    unplugged: AtomicBool,
    silent: AtomicBool,
    /// Episodes it was told to record by itself, and of how many of them it was told the end.
    episodes: (AtomicU32, AtomicU32),
    /// Next sequence number; it goes on over a replug, as a device with its own counter would.
    pub sequence: AtomicU32,
    /// What a camera looks at.
    pub light: SimLight,
}

/// A light in front of a simulated camera, and how it was switched. Without a first change there is
/// none.
#[derive(Debug, Default)]
pub struct SimLight(Mutex<Vec<(Stamp, bool)>>);

impl SimLight {
    /// It is lit from this moment on, or dark; moments come in the order of time.
    pub fn switch(&self, at: Stamp, lit: bool) {
        self.changes().push((at, lit));
    }

    /// Was it lit at this moment? Dark before the first change.
    #[must_use]
    pub fn was_lit(&self, at: Stamp) -> bool {
        self.changes().iter().rev().find(|(since, _)| *since <= at).is_some_and(|(_, lit)| *lit)
    }

    /// Is there one?
    #[must_use]
    pub fn is_there(&self) -> bool {
        !self.changes().is_empty()
    }

    /// Whole values: a poisoned lock guards nothing broken.
    fn changes(&self) -> MutexGuard<'_, Vec<(Stamp, bool)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl SimDevice {
    /// A device just plugged in.
    #[must_use]
    pub fn new(name: &str, source: SimSource, begun: Stamp) -> Self {
        Self {
            name: name.to_owned(),
            source,
            faults: SimFaults::default(),
            begun,
            unplugged: AtomicBool::new(false),
            silent: AtomicBool::new(false),
            episodes: (AtomicU32::new(0), AtomicU32::new(0)),
            sequence: AtomicU32::new(0),
            light: SimLight::default(),
        }
    }

    /// The same device, doing this wrong.
    #[must_use]
    pub fn with_faults(self, faults: SimFaults) -> Self {
        Self { faults, ..self }
    }

    /// Pulls the cable: the next read says so.
    pub fn unplug(&self) {
        self.unplugged.store(true, Ordering::Release);
    }

    /// Is the cable pulled?
    #[must_use]
    pub fn is_unplugged(&self) -> bool {
        self.unplugged.load(Ordering::Acquire)
    }

    /// Makes the device stop or go on sending.
    pub fn set_silent(&self, silent: bool) {
        self.silent.store(silent, Ordering::Release);
    }

    /// Does it send nothing?
    #[must_use]
    pub fn is_silent(&self) -> bool {
        self.silent.load(Ordering::Acquire)
    }

    /// Tells it to record by itself, or to end that.
    pub fn record(&self, record: bool) {
        let (begun, over) = &self.episodes;
        if record { begun } else { over }.fetch_add(1, Ordering::AcqRel);
    }

    /// How often it was told to record, and how often to end that.
    #[must_use]
    pub fn recordings(&self) -> (u32, u32) {
        let (begun, over) = &self.episodes;
        (begun.load(Ordering::Acquire), over.load(Ordering::Acquire))
    }
}

impl PartialEq for SimDevice {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name && self.source == other.source
    }
}
