//! Simulated devices: what they send, their faults, and the cable by which a scenario unplugs them.
//!
//! A simulated device enters like a real one: by a hot-plug event whose [`Attachment`] carries a
//! [`SimDevice`], opened by `driver::open`. No other code distinguishes them.
//!
//! [`Attachment`]: crate::device::Attachment

pub mod task;

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rapid_core::provenance::{KernelDriver, ReplaySource};
use rapid_core::time::Stamp;

use self::task::SharedTrial;

/// Faults of a simulated device while it is plugged in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SimFaults {
    /// From this moment of the scenario on it sends the same bytes repeatedly.
    pub freeze_at: Option<Duration>,
    /// After this number of samples one is truncated.
    pub truncate_every: Option<u64>,
    /// After this number of samples one is sent twice.
    pub duplicate_every: Option<u64>,
    /// After this number of samples one is lost by the device, which reports it.
    pub lose_every: Option<u64>,
    /// Samples arrive this long after their capture.
    pub delay: Duration,
    /// A camera's pictures show the light as it was this long before their capture time.
    pub latency: Duration,
    /// Its clock is fast by this many parts per million, slow if negative.
    pub clock_ppm: i64,
    /// Time needed to close it.
    pub close: Duration,
}

/// The data that a simulated device sends.
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
        /// Determines the pictures.
        seed: u64,
        /// Least size of a picture, which is padded to it. 0: as the encoder produces it.
        bytes: usize,
    },
    /// Depth images of these dimensions in pixels; bytes are a function of seed and sequence.
    Depth {
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
        /// Frames per second.
        fps: u32,
        /// Determines the pictures.
        seed: u64,
    },
    /// Vectors of numbers; values are a function of seed and sequence.
    Serial {
        /// Numbers in a sample.
        channels: usize,
        /// Samples per second.
        hz: u32,
        /// Determines the values.
        seed: u64,
    },
    /// A part of the simulated task.
    Task {
        /// Which part.
        part: TaskPart,
        /// The trial it takes part in, with the other parts.
        trial: SharedTrial,
    },
    /// No data: the program of the entry runs as it would for a real device.
    Process,
    /// The samples of one topic of a recorded episode, at their recorded distances in time.
    Replay {
        /// The episode.
        file: PathBuf,
        /// The topic in it.
        topic: String,
        /// Wall time of the episode's beginning as recorded, ns: time zero of the scenario.
        begin_ns: u64,
        /// The episode, for a recording of this replay.
        of: Arc<ReplaySource>,
    },
}

/// A device of the simulated task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskPart {
    /// The camera at the wrist.
    Wrist,
    /// The camera behind the gel of the fingertip.
    Tactile,
    /// The arm: its state, and the actuator.
    Arm,
    /// The pose of the gripper in a hand.
    Phone,
    /// The opening of the gripper in a hand.
    Gripper,
}

impl TaskPart {
    /// Numbers in a sample; `None` of a camera.
    pub const fn numbers(self) -> Option<u32> {
        match self {
            Self::Wrist | Self::Tactile => None,
            Self::Arm => Some(task::AXIS_COUNT),
            // A homogeneous matrix.
            Self::Phone => Some(16),
            Self::Gripper => Some(1),
        }
    }
}

/// Reported in place of the kernel's driver of a simulated device.
pub fn driver() -> KernelDriver {
    KernelDriver { name: "rapid-sim".to_owned(), version: Some(env!("CARGO_PKG_VERSION").to_owned()) }
}

/// A simulated device that is plugged in: its cable, shared between the script that unplugs it and
/// the driver that reads it.
#[derive(Debug)]
pub struct SimDevice {
    /// Name within the scenario.
    pub name: String,
    /// The data it sends.
    pub source: SimSource,
    /// Its faults.
    pub faults: SimFaults,
    /// The scenario's time zero.
    pub begun: Stamp,
    unplugged: AtomicBool,
    silent: AtomicBool,
    /// The number of recording commands it received, and of commands to end one.
    episodes: (AtomicU32, AtomicU32),
    /// Next sequence number; it continues over a replug, like that of a device with its own counter.
    pub sequence: AtomicU32,
    /// The light that a camera records.
    pub light: SimLight,
}

/// A light in front of a simulated camera, and its changes. Without a first change there is
/// none.
#[derive(Debug, Default)]
pub struct SimLight(Mutex<Vec<(Stamp, bool)>>);

impl SimLight {
    /// Puts one in front of the camera, dark.
    pub fn install(&self) {
        self.changes().push((Stamp(0), false));
    }

    /// It is lit from now on, or dark. Returns the moment, which is taken under the lock: a picture of a later moment is
    /// drawn with this change, however long this thread is suspended.
    pub fn switch(&self, lit: bool) -> Stamp {
        let mut changes = self.changes();
        let now = Stamp::now();
        changes.push((now, lit));
        now
    }

    /// Whether it was lit at this moment. Dark before the first change.
    pub fn was_lit(&self, at: Stamp) -> bool {
        self.changes().iter().rev().find(|(since, _)| *since <= at).is_some_and(|(_, lit)| *lit)
    }

    /// Whether there is one.
    pub fn is_there(&self) -> bool {
        !self.changes().is_empty()
    }

    /// Whole values: a poisoned lock guards no broken state.
    fn changes(&self) -> MutexGuard<'_, Vec<(Stamp, bool)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl SimDevice {
    /// A device just plugged in.
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

    /// The same device, with these faults.
    #[must_use]
    pub fn with_faults(self, faults: SimFaults) -> Self {
        Self { faults, ..self }
    }

    /// Pulls the cable: the next read reports it.
    pub fn unplug(&self) {
        self.unplugged.store(true, Ordering::Release);
    }

    /// Whether the cable is pulled.
    pub fn is_unplugged(&self) -> bool {
        self.unplugged.load(Ordering::Acquire)
    }

    /// Makes the device stop or resume sending.
    pub fn set_silent(&self, silent: bool) {
        self.silent.store(silent, Ordering::Release);
    }

    /// Whether it sends nothing.
    pub fn is_silent(&self) -> bool {
        self.silent.load(Ordering::Acquire)
    }

    /// Commands it to record, or to end that.
    pub fn record(&self, record: bool) {
        let (begun, over) = &self.episodes;
        if record { begun } else { over }.fetch_add(1, Ordering::AcqRel);
    }

    /// How many recording commands it received, and how many to end one.
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
