//! The registry: `devices.toml`, the only place where devices are declared.
//!
//! Text -> `section` (tables with positions) -> `parse` -> [`Registry`]; from it are derived the assignment of
//! attached devices to entries (`identity`), the content of a simulation (`scenario_file`) and the
//! files read by udev and systemd (`system_files`).

pub mod ablation;
pub mod candidate;
pub mod catalogue;
pub mod columns;
pub mod device;
mod diagnostic;
mod difference;
pub mod edit;
mod identity;
pub mod import;
pub mod keys;
mod kinds;
mod parse;
pub mod scenario;
mod scenario_file;
mod section;
pub mod simulation;
#[cfg(test)]
#[path = "../../tests/support/skip.rs"]
mod skip;
mod spec;
pub mod system_files;
pub mod task;
pub mod trust;
pub mod units;

pub use diagnostic::did_you_mean;
pub use diagnostic::{Diagnostic, RegistryErrors};
pub use difference::Difference;
pub use identity::{Assigner, Assignment, Detached, Explanation};
pub use parse::{BUILTIN, Loaded, like_a_name, name_problem};
pub use section::read_file;
pub use spec::{
    ActionSpec, Bound, BrakeSpec, ButtonAction, ButtonSpec, CAN_BATCH, CAN_RECORD, CAN_RESTART_MS, CalibrationSpec,
    CameraSpec, CanAdapter, CanProtocol, CanSpec, DamiaoSpec, DeviceSpec, EffectorSpec, ExportSpec, FieldInput, Form,
    Framing, GpioInput, GripperSpec, Hook, Hooks, IdentitySpec, InferenceSpec, InputSpec, InterlockSpec, JointsSpec,
    KeyInput, LanFind, LanPicture, LanProtocol, LanSpec, Limits, LineInput, LineOff, MAX_BORROWED, MAX_BUTTONS,
    MAX_MOTORS, MAX_SUBSCRIBERS, MOTOR_CHANNELS, ModuleError, ModuleSpec, MotionSpec, MotorKind, MotorMode, MotorSpec,
    Mount, Mounting, NodeSpec, Opens, POOL_SPARE, POSE_ENDING, PREVIEW_DECODER, Parse, PhoneStream, PixelFormat,
    PointsSpec, PoseLayout, PoseSpec, Probe, ProcessSpec, Provider, Quantity, Registry, RemoteSamples, RigSpec,
    SLCAN_BITRATES, SerialSpec, Stop, StopSpec, TipForm, TipRotation, TransformSpec, UsbSpec, VerdictSpec, WatchSpec,
    mounted, own_side,
};
