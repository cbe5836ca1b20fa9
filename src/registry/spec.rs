//! What `devices.toml` says once it has been checked: nothing downstream validates again.
//!
//! Invariant: every value here is within the range its comment states; names, topics and bits are
//! unique; no two entries of one kind of node mean the same unit; `Registry::devices` is in
//! ascending order of bit.

mod can;
mod hooks;
mod interlock;
mod lan;
mod module;
mod motors;

use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;

pub use hooks::{Hook, Hooks};

use super::limits::VerdictSpec;
use crate::modality::{Modality, ModalityId, ModalityKind};
use crate::sample::SampleHeader;

pub use can::{
    CAN_BATCH, CAN_RECORD, CAN_RESTART_MS, CanAdapter, CanProtocol, CanSpec, MOTOR_CHANNELS, SLCAN_BITRATES,
};
pub use interlock::{Bound, FieldInput, GpioInput, InterlockInput, InterlockSpec, KeyInput, LineInput};
pub use lan::{LanFind, LanPicture, LanProtocol, LanSpec, PhoneStream, Probe, own_side};
pub use module::{ModuleError, ModuleSpec, mounted};
pub use motors::{
    BrakeSpec, DamiaoSpec, MAX_MOTORS, MotionSpec, MotorKind, MotorMode, MotorSpec, Stop, StopSpec, WatchSpec,
};

/// Samples that the pool of a topic holds beyond its depth: what 8 subscribers hold back, 4 each, the
/// one being written, and one that is on its way out. The bus reserves them.
pub const POOL_SPARE: usize = MAX_SUBSCRIBERS * MAX_BORROWED + 2;
/// Programs that may subscribe to a topic at once: recorder, policy, and others'.
pub const MAX_SUBSCRIBERS: usize = 8;
/// Samples a subscriber may hold without giving them back.
pub const MAX_BORROWED: usize = 4;
/// Shared memory beside the payload of each sample, bytes: our header, and at most this much for that
/// of iceoryx2 0.10 and for alignment.
pub(super) const SAMPLE_OVERHEAD: usize = size_of::<SampleHeader>() + 64;
/// Shared memory of the mask's topic and of iceoryx2's own books, bytes; part of the budget.
pub(super) const RESERVED_BYTES: u64 = 512 << 10;

/// A checked `devices.toml`.
#[derive(Debug, Clone, PartialEq)]
pub struct Registry {
    /// The `[rig]` table.
    pub rig: RigSpec,
    /// One entry a modality, ascending by bit, at least one, at most 64.
    pub devices: Vec<DeviceSpec>,
    /// What can be mounted, in the order of the file.
    pub modules: Vec<ModuleSpec>,
    /// Emergency stops and enabling switches, in the order of the file, at most 16.
    pub stops: Vec<InterlockSpec>,
    /// Where the text came from, for messages. `None` for the built-in registry.
    pub path: Option<PathBuf>,
    /// The text itself, recorded with every episode.
    pub text: String,
}

/// The `[rig]` table.
#[derive(Debug, Clone, PartialEq)]
pub struct RigSpec {
    /// Name of the rig, default `rig`.
    pub name: String,
    /// Rate of the observation grid in Hz, `0.1..=1000`, default 30.
    pub observation_hz: f64,
    /// Half width of the window in which a sample counts as belonging to a tick, default 25 ms
    /// (paper, section "Synchronized Subscriber").
    pub sync_window: Duration,
    /// How long a returned device waits after a removal before it is started, default 2 s.
    pub cooldown: Duration,
    /// Upper bound of the shared memory all topics may reserve, bytes, default 512 MiB.
    pub memory_budget: u64,
    /// What recording leaves free on its disk, bytes; `None` is the smaller of 1 GiB and a twentieth
    /// of the disk.
    pub disk_reserve: Option<u64>,
    /// Names of the entries without whose samples an episode is SUSPECT; none by default.
    pub expect: Vec<String>,
}

/// One `[device.NAME]` table.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceSpec {
    /// The modality's name: `[a-z][a-z0-9_]*`, at most 64 bytes.
    pub name: String,
    /// Bit in the mask.
    pub id: ModalityId,
    /// Which device this is.
    pub identity: IdentitySpec,
    /// How it is read.
    pub node: NodeSpec,
    /// Topic on the bus and in the recording: `/` then `[a-zA-Z0-9_/-]*`.
    pub topic: String,
    /// Where on the gripper the module sits.
    pub mount: Option<Mount>,
    /// No sample for this long while attached: the slot says Stalled. At least 10 ms; default the
    /// larger of 500 ms and 10 sample periods. Of a program, its `heartbeat`, default 2 s.
    pub stall_after: Duration,
    /// Largest payload in bytes.
    pub max_bytes: usize,
    /// Samples a subscriber may fall behind before the oldest is lost, `2..=4096`.
    pub depth: usize,
    /// What an observation holds when the device is attached but no sample lies in the window.
    pub when_stale: WhenStale,
    /// What a sample captured at `t` shows happened at `t - latency`; up to 1 s, default 0. Taken
    /// off when samples are aligned, and there alone.
    pub latency: Duration,
    /// What the verdict on its part of an episode is made of.
    pub verdict: VerdictSpec,
    /// The device is an actuator, and takes these actions.
    pub action: Option<ActionSpec>,
    /// What is run when something happens to it.
    pub hooks: Hooks,
}

/// `[device.NAME.action]`: what an actuator may be told. All lists have one entry an axis, `1..=64` of
/// them.
#[derive(Debug, Clone, PartialEq)]
pub struct ActionSpec {
    /// What each axis is called.
    pub names: Vec<String>,
    /// Its unit, for people.
    pub units: Vec<String>,
    /// Lowest target, finite.
    pub min: Vec<f64>,
    /// Highest target, finite and above the lowest.
    pub max: Vec<f64>,
}

/// Which device an entry means.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize)]
#[serde(untagged)]
pub enum IdentitySpec {
    /// A USB device.
    Usb(UsbSpec),
    /// A device on the network: [`NodeSpec::Lan`] says where it is looked for.
    Lan {},
}

impl IdentitySpec {
    /// The USB device, if it is one.
    #[must_use]
    pub const fn usb(&self) -> Option<&UsbSpec> {
        match self {
            Self::Usb(usb) => Some(usb),
            Self::Lan {} => None,
        }
    }

    /// Its serial number, if the entry has one.
    #[must_use]
    pub fn serial(&self) -> Option<&str> {
        self.usb()?.serial.as_deref()
    }
}

/// Which USB device an entry means.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize)]
pub struct UsbSpec {
    /// USB vendor id.
    #[serde(serialize_with = "super::attachment::usb_id")]
    pub vid: u16,
    /// USB product id.
    #[serde(serialize_with = "super::attachment::usb_id")]
    pub pid: u16,
    /// Serial number as the device reports it. Takes precedence over `port`.
    pub serial: Option<String>,
    /// Port path in the kernel's notation, for example `1-2.3` (bus 1, port 2, port 3 of the hub).
    pub port: Option<String>,
}

/// How a device is read.
#[derive(Debug, Clone, PartialEq)]
pub enum NodeSpec {
    /// A V4L2 camera.
    Camera(CameraSpec),
    /// A serial line.
    Serial(SerialSpec),
    /// A program that reads the device and publishes.
    Process(ProcessSpec),
    /// A CAN adapter.
    Can(CanSpec),
    /// A device on the network, or behind a network adapter.
    Lan(LanSpec),
}

/// `[device.NAME.camera]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraSpec {
    /// Pixels, `1..=8192`, default 640.
    pub width: u32,
    /// Pixels, `1..=8192`, default 480.
    pub height: u32,
    /// Frames per second, `1..=1000`, default 30.
    pub fps: u32,
    /// Pixel format, default MJPG.
    pub format: PixelFormat,
    /// Controls set at start: V4L2 control name as listed by `rapid devices`, value.
    pub controls: Vec<(String, i64)>,
}

/// Pixel formats a camera may be asked for, by their V4L2 names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum PixelFormat {
    /// Motion JPEG.
    Mjpg,
    /// YUV 4:2:2 packed.
    Yuyv,
    /// 8-bit luminance.
    Grey,
}

/// `[device.NAME.serial]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialSpec {
    /// Bits per second, default 115200.
    pub baud: u32,
    /// Where one message ends and the next begins, default `line`.
    pub framing: Framing,
    /// What a message holds, default `csv`.
    pub parse: Parse,
    /// Numbers in a message, `1..=1024`; 0 with `Parse::Raw`.
    pub channels: usize,
}

/// `node = "PROGRAM"` with `[device.NAME.process]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessSpec {
    /// The program: an absolute path, or the name as it is written where nothing is to be run (a
    /// registry read from an episode).
    pub program: PathBuf,
    /// Its arguments, none by default.
    pub args: Vec<String>,
    /// Which node of the device it opens, default [`Opens::Usb`].
    pub opens: Opens,
    /// What its samples hold, default bytes.
    pub kind: ModalityKind,
    /// Image: `[height, width]`. Scalars: `[channels]`. Bytes: empty.
    pub shape: Vec<u32>,
}

/// The node of its USB device that a program opens. The program starts when udev has that node in
/// place, and is given its path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Opens {
    /// The V4L2 capture node.
    Video,
    /// The serial line.
    Tty,
    /// The USB device itself, `/dev/bus/usb/...`: for programs that use libusb or find the device
    /// themselves.
    Usb,
    /// Its network interface, which has no path: `can` and `lan` read it, no program.
    Net,
}

/// Message boundaries on a serial line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Framing {
    /// A newline ends a message; a carriage return before it is dropped.
    Line,
    /// Consistent overhead byte stuffing: a zero byte ends a message.
    Cobs,
    /// Messages of exactly this many bytes.
    Fixed(usize),
}

/// Content of a serial message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parse {
    /// Numbers separated by commas.
    Csv,
    /// A JSON array of numbers, or an object whose numeric values are taken in order.
    Json,
    /// Little-endian 32-bit floats.
    F32le,
    /// Not looked into.
    Raw,
}

/// Where a module sits (paper, section "Modular hardware").
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Mount {
    /// In front.
    Front,
    /// The fingertip.
    Tip,
    /// On top.
    Top,
    /// Below.
    Bottom,
}

/// What an observation holds for an attached modality without a sample in the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum WhenStale {
    /// The newest sample with its age.
    #[default]
    Hold,
    /// Nothing.
    Zero,
}

impl DeviceSpec {
    /// What this device adds to an observation.
    #[must_use]
    pub fn modality(&self) -> Modality {
        Modality { name: self.name.clone(), kind: self.node.modality_kind(), shape: self.node.shape() }
    }
}

impl NodeSpec {
    /// The shape of a sample, as in [`Modality`].
    #[must_use]
    pub fn shape(&self) -> Vec<u32> {
        match (self, self.modality_kind()) {
            (Self::Camera(camera), _) => vec![camera.height, camera.width],
            (Self::Serial(_), ModalityKind::Bytes) => Vec::new(),
            (Self::Serial(serial), _) => vec![u32::try_from(serial.channels).unwrap_or(u32::MAX)],
            (Self::Process(process), _) => process.shape.clone(),
            (Self::Can(can), _) => can.shape(),
            (Self::Lan(lan), _) => lan.shape(),
        }
    }

    /// Which node of its device it is read from.
    #[must_use]
    pub fn opens(&self) -> Opens {
        match self {
            Self::Camera(_) => Opens::Video,
            Self::Serial(_) => Opens::Tty,
            Self::Process(process) => process.opens,
            Self::Can(can) if can.adapter != CanAdapter::SocketCan => Opens::Tty,
            Self::Can(_) | Self::Lan(_) => Opens::Net,
        }
    }

    /// What samples of a device that is read like this hold.
    #[must_use]
    pub fn modality_kind(&self) -> ModalityKind {
        match self {
            Self::Camera(_) => ModalityKind::Image,
            Self::Serial(serial) if serial.parse == Parse::Raw => ModalityKind::Bytes,
            Self::Serial(_) => ModalityKind::Scalars,
            Self::Process(process) => process.kind,
            Self::Can(can) => can.modality_kind(),
            Self::Lan(lan) => lan.modality_kind(),
        }
    }
}

impl Registry {
    /// The entry of a modality.
    #[must_use]
    pub fn device(&self, id: ModalityId) -> Option<&DeviceSpec> {
        self.devices.iter().find(|device| device.id == id)
    }

    /// The actuator, if there is one.
    #[must_use]
    pub fn actuator(&self) -> Option<(&DeviceSpec, &ActionSpec)> {
        self.devices.iter().find_map(|device| Some((device, device.action.as_ref()?)))
    }

    /// The entry of this name.
    #[must_use]
    pub fn named(&self, name: &str) -> Option<&DeviceSpec> {
        self.devices.iter().find(|device| device.name == name)
    }
}
