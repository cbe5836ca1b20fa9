//! The registry: `devices.toml`, the single point where a device is made known.

mod attachment;
pub mod scenario;
mod spec;

pub use attachment::{Attachment, DeviceNode, UsbIdentity};
pub use spec::{
    CameraSpec, DeviceSpec, Framing, IdentitySpec, Mount, NodeSpec, Parse, PixelFormat, Registry, RigSpec, SerialSpec,
    WhenStale,
};
