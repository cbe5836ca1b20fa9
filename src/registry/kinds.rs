//! The kinds of devices that a registry can name. A kind is one module here: the table of its keys with their errors, and
//! what follows from its specification alone. [`kinds!`] lists them.

pub(crate) mod camera;
pub(crate) mod can;
pub(crate) mod lan;
pub(crate) mod process;
pub(crate) mod serial;

use std::time::Duration;

use rapid_core::modality::ModalityKind;

use super::keys::Keys;
use super::parse::device;
use super::parse::program::Programs;
use super::section::Section;
use super::simulation::SimSource;
use super::spec::{KINDS, Opens, VerdictSpec};
use super::system_files::Needs;
use camera::CameraSpec;
use can::CanSpec;
use lan::{LanPicture, LanSpec};
use process::ProcessSpec;
use serial::SerialSpec;

/// What follows from the specification of a device alone.
pub(crate) trait Kind {
    /// Content of its samples.
    fn modality_kind(&self) -> ModalityKind;

    /// Image: `[height, width]`. Scalars: how many. Bytes: empty.
    fn shape(&self) -> Vec<u32>;

    /// Which node of its device it is read from.
    fn opens(&self) -> Opens;

    /// The format of its pictures, if it sends any and the entry states it.
    fn picture(&self) -> Option<LanPicture> {
        None
    }

    /// The format on one line.
    fn format(&self) -> String;

    /// Its lines in the descriptor of the module.
    fn descriptor(&self) -> String;

    /// Bytes of its largest sample unless the entry states otherwise, and the least that may be written.
    fn sizes(&self) -> (u64, u64);

    /// Samples that are kept for a reader unless the entry states otherwise: about two seconds of pictures; a serial line may
    /// send 1000 samples a second.
    fn depth(&self) -> u64 {
        self.picture().map_or(2048, LanPicture::depth)
    }

    /// Silent for this long it is stalled unless the entry states otherwise: half a second, or ten periods of a slow camera.
    fn stall_after(&self) -> Duration {
        self.picture().map_or(STALL_AFTER, LanPicture::stall_after)
    }

    /// Changes the usual limits of the verdict on it.
    fn judge(&self, _limits: &mut VerdictSpec, _sync_window: Duration) {}

    /// Highest data rate, bytes per second, with samples of this size; `None` if only the device, or its program, knows it.
    fn bytes_per_second(&self, max_bytes: usize) -> Option<f64>;

    /// What it needs of the system besides udev.
    fn need(&self, _needs: &mut Needs) {}

    /// For a device without a node: what else a rule for it matches, and what it runs when the device is plugged in.
    fn on_plug(&self) -> Option<[String; 2]> {
        None
    }

    /// Why it can be added only before a run.
    fn only_at_start(&self) -> Option<&'static str> {
        None
    }

    /// What a simulated device sends in its place.
    fn simulated(&self, seed: u64) -> SimSource {
        /// Typical for the state of a motor controller.
        const SERIAL_HZ: u32 = 100;
        match (self.picture(), self.shape().as_slice()) {
            (Some(LanPicture { width, height, fps }), [_, _]) if self.modality_kind() == ModalityKind::Depth => {
                SimSource::Depth { width, height, fps, seed }
            }
            (Some(LanPicture { width, height, fps }), [_, _]) => {
                SimSource::Camera { width, height, fps, seed, bytes: 0 }
            }
            (_, [channels]) => SimSource::Serial { channels: *channels as usize, hz: SERIAL_HZ, seed },
            // A device that sends bytes has no channels: only a number of messages a second is written here.
            _ => SimSource::Serial { channels: 1, hz: SERIAL_HZ, seed },
        }
    }
}

/// Silent for this long a device is stalled, unless its kind or its entry states otherwise.
pub(crate) const STALL_AFTER: Duration = Duration::from_millis(500);

/// The settings of an entry, and for how long the device may be silent if its own table states that.
pub(crate) type Settings = (NodeSpec, Option<Duration>);

/// Bytes of a compressed picture of this size. One of a small, noisy scene with its tables can exceed two bytes a pixel.
pub(crate) fn compressed(pixels: u64) -> u64 {
    const SMALLEST: u64 = 64 << 10;
    pixels.max(SMALLEST)
}

/// Notes the keys of `table` that samples of this kind do not have: those of pictures, or `channels` of numbers. Its word.
pub(crate) fn check_samples(table: &Section<'_>, kind: ModalityKind, of_pictures: &[&str]) -> &'static str {
    let word = KINDS.iter().find(|(_, known)| *known == kind).map_or("", |(word, _)| word);
    for key in of_pictures.iter().copied().chain(["channels"]).filter(|key| table.has(key)) {
        let (is_own, owner) = match (key, kind) {
            ("channels", kind) => (kind == ModalityKind::Scalars, "scalars"),
            // Depth has one.
            ("format", kind) => (kind == ModalityKind::Image, "image"),
            (_, kind) => (matches!(kind, ModalityKind::Image | ModalityKind::Depth), "image"),
        };
        if !is_own {
            let message = format!("samples of kind {word:?} have no {key}");
            table.report(key, message, format!("remove {key}, or write kind = {owner:?}"));
        }
    }
    word
}

/// Lists the kinds: how each is specified, and the module that has `read`, `TABLE` and `impl Kind`. The name of the module is the
/// word for the kind.
macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident($spec:ty) = $module:ident;)+) => {
        /// How a device is read.
        #[derive(Debug, Clone, PartialEq)]
        pub enum NodeSpec {
            $($(#[$doc])* $kind($spec)),+
        }

        impl NodeSpec {
            /// The kind of node: `camera`, `serial`, `can`, `lan` or `process`.
            pub const fn kind(&self) -> &'static str {
                match self {
                    $(Self::$kind(_) => stringify!($module)),+
                }
            }

            pub(crate) fn of_kind(&self) -> &dyn Kind {
                match self {
                    $(Self::$kind(spec) => spec),+
                }
            }
        }

        /// How a device is read, without the settings.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub(crate) enum Word {
            $($kind),+
        }

        impl Word {
            /// Every kind and its word.
            pub(crate) const ALL: &[(&str, Self)] = &[$((stringify!($module), Self::$kind)),+];

            pub(crate) const fn word(self) -> &'static str {
                match self {
                    $(Self::$kind => stringify!($module)),+
                }
            }

            /// Reads the settings of an entry; `None` if a problem with them was reported.
            pub(crate) fn read(self, entry: &Section<'_>, programs: Programs<'_>) -> Option<Settings> {
                match self {
                    $(Self::$kind => $module::read(entry, programs)),+
                }
            }
        }

        /// The keys of `[device.NAME]`.
        pub(crate) const KEYS: Keys = &[
            device::OF_THE_DEVICE, device::StreamKeys::KEYS, &[$($module::TABLE),+], device::TABLES, device::HOOKS,
        ];
    };
}

kinds! {
    /// A V4L2 camera.
    Camera(CameraSpec) = camera;
    /// A serial line.
    Serial(SerialSpec) = serial;
    /// A CAN adapter.
    Can(CanSpec) = can;
    /// A device on the network, or behind a network adapter.
    Lan(LanSpec) = lan;
    /// A program that reads the device and publishes.
    Process(ProcessSpec) = process;
}

impl NodeSpec {
    /// The shape of a sample, as in [`Modality`](rapid_core::modality::Modality).
    pub fn shape(&self) -> Vec<u32> {
        self.of_kind().shape()
    }

    /// The format of its pictures, if it sends any and the entry states it.
    pub fn picture(&self) -> Option<LanPicture> {
        self.of_kind().picture()
    }

    /// Which node of its device it is read from.
    pub fn opens(&self) -> Opens {
        self.of_kind().opens()
    }

    /// Content of the samples of a device that is read like this.
    pub fn modality_kind(&self) -> ModalityKind {
        self.of_kind().modality_kind()
    }

    /// The format on one line: `640x480@30 MJPG`, `115200 baud line csv x3`, `tactile_publisher scalars x16`.
    pub fn format(&self) -> String {
        self.of_kind().format()
    }

    /// Highest data rate, bytes per second, with samples of this size; `None` if only the device, or its program, knows it.
    pub fn bytes_per_second(&self, max_bytes: usize) -> Option<f64> {
        self.of_kind().bytes_per_second(max_bytes)
    }
}
