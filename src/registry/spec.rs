//! The content of a checked `devices.toml`: no other code validates it again.
//!
//! Invariant: every value here is within the range its comment states; names, topics and bits are
//! unique; no two entries of one kind of node identify the same unit; `Registry::devices` is in
//! ascending order of bit.

mod export;
mod form;
mod inference;
mod input;
mod module;
mod rig;
mod verdict;

use std::path::PathBuf;
use std::time::Duration;

use rapid_core::modality::{Modality, ModalityId, ModalityKind};
use rapid_core::sample::SampleHeader;
use rapid_core::sync::{SyncModality, WhenStale};
use serde::Serialize;

pub use super::kinds::NodeSpec;
pub use super::kinds::camera::{CameraSpec, PixelFormat};
pub use super::kinds::can::{
    BrakeSpec, CAN_BATCH, CAN_RECORD, CAN_RESTART_MS, CanAdapter, CanProtocol, CanSpec, DamiaoSpec, EffectorSpec,
    GripperSpec, MAX_MOTORS, MOTOR_CHANNELS, MotionSpec, MotorKind, MotorMode, MotorSpec, Mounting, SLCAN_BITRATES,
    Stop, StopSpec, TipRotation, WatchSpec,
};
pub use super::kinds::lan::{
    LanFind, LanPicture, LanProtocol, LanSpec, PREVIEW_DECODER, PhoneStream, Probe, RemoteSamples, own_side,
};
pub use super::kinds::process::ProcessSpec;
pub use super::kinds::serial::{Framing, Parse, SerialSpec};
pub use export::ExportSpec;
pub(super) use form::tip_numbers;
pub use form::{CalibrationSpec, Form, JointsSpec, POSE_ENDING, PointsSpec, PoseLayout, PoseSpec, Quantity, TipForm};
pub use inference::{InferenceSpec, Provider};
pub use input::{
    Bound, ButtonAction, ButtonSpec, FieldInput, GpioInput, InputSpec, InterlockSpec, KeyInput, LineInput, LineOff,
    MAX_BUTTONS,
};
pub use module::{ModuleError, ModuleSpec, TransformSpec, mounted};
pub use rig::RigSpec;
pub use verdict::{Limits, VerdictSpec};

/// Samples that the pool of a topic holds beyond its depth: those that 8 subscribers hold, 4 each, the
/// one being written, and one that is about to be replaced. The bus reserves them.
pub const POOL_SPARE: usize = MAX_SUBSCRIBERS * MAX_BORROWED + 2;
/// Programs that may subscribe to a topic at once: recorder, synchronisation, policy, and others'.
pub const MAX_SUBSCRIBERS: usize = 8;
/// Samples a subscriber may hold without returning them.
pub const MAX_BORROWED: usize = 4;
/// Shared memory in addition to the payload of each sample, bytes: our header, and at most this much for that
/// of iceoryx2 0.10 and for alignment.
pub(super) const SAMPLE_OVERHEAD: usize = size_of::<SampleHeader>() + 64;
/// Shared memory of the topics of mask and observations and, for some devices, of iceoryx2's management data, bytes;
/// part of the budget.
pub(super) const RESERVED_BYTES: u64 = 768 << 10;

/// A checked `devices.toml`.
#[derive(Debug, Clone, PartialEq)]
pub struct Registry {
    /// The `[rig]` table.
    pub rig: RigSpec,
    /// The `[inference]` table.
    pub inference: InferenceSpec,
    /// The `[export]` table.
    pub export: ExportSpec,
    /// One entry per modality, ascending by bit, at least one, at most 64.
    pub devices: Vec<DeviceSpec>,
    /// The modules that can be mounted, in the order of the file.
    pub modules: Vec<ModuleSpec>,
    /// Emergency stops and enabling switches, in the order of the file, at most 16.
    pub stops: Vec<InterlockSpec>,
    /// Buttons, in the order of the file, at most [`MAX_BUTTONS`].
    pub buttons: Vec<ButtonSpec>,
    /// Where the text came from, for messages. `None` for the built-in registry.
    pub path: Option<PathBuf>,
    /// The text itself, recorded with every episode.
    pub text: String,
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
    /// Position of the module on the gripper.
    pub mount: Option<Mount>,
    /// Without a sample for this long while attached, the slot is Stalled. At least 10 ms; default the
    /// larger of 500 ms and 10 sample periods. For a program, its `heartbeat`, default 2 s.
    pub stall_after: Duration,
    /// Largest payload in bytes.
    pub max_bytes: usize,
    /// Samples a subscriber may fall behind before the oldest is lost, `2..=4096`.
    pub depth: usize,
    /// What an observation holds when the device is attached but no sample is in the window.
    pub when_stale: WhenStale,
    /// A sample captured at `t` shows events of `t - latency`; up to 1 s, default 0. Only subtracted
    /// when samples are aligned.
    pub latency: Duration,
    /// Limits for the verdict on its part of an episode.
    pub verdict: VerdictSpec,
    /// What its numbers mean, if viewers know messages for it.
    pub form: Option<Form>,
    /// The device is an actuator, and takes these actions.
    pub action: Option<ActionSpec>,
    /// Programs that are run at its events.
    pub hooks: Hooks,
}

/// `[device.NAME.action]`: the limits of an actuator's actions. All lists have one entry per axis, `1..=64` of
/// them.
#[derive(Debug, Clone, PartialEq)]
pub struct ActionSpec {
    /// Name of each axis.
    pub names: Vec<String>,
    /// Its unit, as text for the user.
    pub units: Vec<String>,
    /// Lowest target, finite.
    pub min: Vec<f64>,
    /// Highest target, finite and above the lowest.
    pub max: Vec<f64>,
}

/// Which device an entry identifies.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize)]
#[serde(untagged)]
pub enum IdentitySpec {
    /// A USB device.
    Usb(UsbSpec),
    /// A device on the network: [`NodeSpec::Lan`] states how it is found.
    Lan {},
}

impl IdentitySpec {
    /// The USB device, if it is one.
    pub const fn usb(&self) -> Option<&UsbSpec> {
        match self {
            Self::Usb(usb) => Some(usb),
            Self::Lan {} => None,
        }
    }

    /// Its serial number, if the entry has one.
    pub fn serial(&self) -> Option<&str> {
        self.usb()?.serial.as_deref()
    }
}

/// Which USB device an entry identifies.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize)]
pub struct UsbSpec {
    /// USB vendor id.
    #[serde(serialize_with = "crate::device::usb_id")]
    pub vid: u16,
    /// USB product id.
    #[serde(serialize_with = "crate::device::usb_id")]
    pub pid: u16,
    /// Serial number as the device reports it. Takes precedence over `port`.
    pub serial: Option<String>,
    /// Port path in the kernel's notation, for example `1-2.3` (bus 1, port 2, port 3 of the hub).
    pub port: Option<String>,
}

/// The node of its USB device that a program opens. The program starts when udev has created that
/// node, and receives its path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Opens {
    /// The V4L2 capture node.
    Video,
    /// The serial line.
    Tty,
    /// The USB device itself, `/dev/bus/usb/...`: for programs that use libusb or search for the device
    /// themselves.
    Usb,
    /// Its network interface, which has no path: read by `can` and `lan`, not by a program.
    Net,
}

/// Position of a module (paper, section "Modular hardware").
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

impl DeviceSpec {
    /// The modality that this device provides.
    pub fn modality(&self) -> Modality {
        Modality { name: self.name.clone(), kind: self.node.modality_kind(), shape: self.node.shape() }
    }

    /// The same as the synchroniser needs to know it; `capacity` samples of it are kept.
    pub const fn synchronised(&self, capacity: usize) -> SyncModality {
        SyncModality { id: self.id, when_stale: self.when_stale, latency: self.latency, capacity }
    }
}

impl Registry {
    /// The entry of a modality.
    pub fn device(&self, id: ModalityId) -> Option<&DeviceSpec> {
        self.devices.iter().find(|device| device.id == id)
    }

    /// The actuator, if there is one.
    pub fn actuator(&self) -> Option<(&DeviceSpec, &ActionSpec)> {
        self.devices.iter().find_map(|device| Some((device, device.action.as_ref()?)))
    }

    /// Whether another entry reads another capture node of the same unit: one camera with several streams.
    pub fn shares_unit(&self, device: &DeviceSpec) -> bool {
        let is_video = |other: &DeviceSpec| other.node.opens() == Opens::Video && other.identity.usb().is_some();
        let is_alone = |usb: &UsbSpec| usb.serial.is_none() && usb.port.is_none();
        is_video(device)
            && !device.identity.usb().is_some_and(is_alone)
            && self
                .devices
                .iter()
                .any(|other| other.id != device.id && is_video(other) && other.identity == device.identity)
    }

    /// The entry of this name.
    pub fn named(&self, name: &str) -> Option<&DeviceSpec> {
        self.devices.iter().find(|device| device.name == name)
    }
}

/// Programs to run at events of a device: the hooks of an entry; by default none.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Hooks {
    /// `on_attach`: the device was attached. Its node is opened meanwhile.
    pub attach: Option<Hook>,
    /// `on_detach`: it was removed, and the program that read it, if any, has ended.
    pub detach: Option<Hook>,
    /// `on_record_start`: an episode begins, or the device was attached during one.
    pub record_start: Option<Hook>,
    /// `on_record_stop`: that episode is over, or the device was removed.
    pub record_stop: Option<Hook>,
}

/// A program and its arguments; run without a shell.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Hook {
    /// As in [`ProcessSpec::program`].
    pub program: PathBuf,
    /// Its arguments.
    pub args: Vec<String>,
}

impl Hooks {
    /// Their keys in `devices.toml`.
    pub const KEYS: [&str; 4] = ["on_attach", "on_detach", "on_record_start", "on_record_stop"];

    /// Each hook with its key in `devices.toml`.
    pub fn all(&self) -> impl Iterator<Item = (&'static str, &Hook)> {
        let hooks = [&self.attach, &self.detach, &self.record_start, &self.record_stop];
        Self::KEYS.into_iter().zip(hooks).filter_map(|(key, hook)| Some((key, hook.as_ref()?)))
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.all().next().is_none()
    }
}

rapid_core::words! {
    /// Every slot and its name.
    Mount, 4: "front" = Front, "tip" = Tip, "top" = Top, "bottom" = Bottom;
    /// Every node a program may open and its name.
    Opens, 3: "video" = Video, "tty" = Tty, "usb" = Usb; "net" = Net;
    /// Every order of a pose's numbers and its name.
    PoseLayout, 3: "columns" = Columns, "rows" = Rows, "quaternion" = Quaternion;
    /// Everything that a joint's number may be, and its name.
    Quantity, 4: "position" = Position, "velocity" = Velocity, "effort" = Effort, "other" = Other;
}

/// What the samples of a program may hold.
pub(super) const KINDS: [(&str, ModalityKind); 4] = [
    ("scalars", ModalityKind::Scalars),
    ("image", ModalityKind::Image),
    ("depth", ModalityKind::Depth),
    ("bytes", ModalityKind::Bytes),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_has_a_word() {
        let formats = PixelFormat::WORDS.map(|(_, format)| format.to_string());
        assert_eq!(formats, ["MJPG", "YUYV", "GREY", "Z16"]);
        let parses = [Parse::Csv, Parse::Json, Parse::F32le, Parse::Raw].map(|parse| parse.to_string());
        assert_eq!(parses, ["csv", "json", "f32le", "raw"]);
        let mounts = [Mount::Front, Mount::Tip, Mount::Top, Mount::Bottom].map(|mount| mount.to_string());
        assert_eq!(mounts, ["front", "tip", "top", "bottom"]);
        assert_eq!(Framing::Fixed(12).to_string(), "fixed 12");
    }
}
