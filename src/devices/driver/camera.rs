//! Cameras: V4L2 capture from kernel buffers that are borrowed, not copied.
//!
//! nokhwa finds cameras and their formats. Capture uses the v4l crate below it, with buffers of our own (`node`),
//! because of what `make bench BENCH="--only capture"` measures for nokhwa 0.10 beside this driver, MJPEG of 640x480 on
//! the virtual bench (two emulated processors):
//!
//! |                                                     | this driver | nokhwa    |
//! |-----------------------------------------------------|-------------|-----------|
//! | bytes handed over of a picture of 23 kB             | 23 kB       | 614 kB    |
//! | processor time per picture                          | 1.0 ms      | 1.8 ms    |
//! | control returns after, from a camera that is silent for 10 s | 0.5 s | 10.0 s  |
//! | an error after an unplug                            | 10 to 53 ms | 25 to 59 ms |
//!
//! nokhwa copies the whole buffer, including the tail of older pictures behind a compressed one; its stream has neither
//! a time limit nor a descriptor to wait on, so a silent camera would block a thread for ever; and it converts the
//! kernel's capture time to the wall clock, which may be set at any time.

#[cfg(feature = "cameras")]
mod capture;
mod format;
#[cfg(feature = "cameras")]
mod listing;
#[cfg(feature = "cameras")]
mod node;

use std::path::Path;

#[cfg(feature = "cameras")]
pub use self::capture::Camera;
pub use self::format::{CameraInfo, ControlInfo, Mode, Rate, Rates, Size};
pub use self::listing::{cameras, formats, name, query, set_control};

/// Whether the camera at `node`, one of [`cameras`], is a USB device.
pub fn is_on_usb(node: &Path) -> bool {
    let class = Path::new("/sys/class/video4linux").join(node.file_name().unwrap_or_default());
    class.canonicalize().is_ok_and(|device| device.to_string_lossy().contains("/usb"))
}

/// A program that was built without cameras finds none.
#[cfg(not(feature = "cameras"))]
#[expect(missing_docs, clippy::missing_errors_doc, reason = "documented in camera/listing.rs")]
mod listing {
    use std::path::{Path, PathBuf};

    use rapid_registry::PixelFormat;

    use super::CameraInfo;
    use crate::driver::{DriverError, built_without};

    pub fn cameras() -> Vec<PathBuf> {
        Vec::new()
    }

    /// All: an entry finds its node, and is refused when that is opened.
    pub fn formats(_: &Path) -> Vec<String> {
        PixelFormat::WORDS.iter().map(|(word, _)| (*word).to_owned()).collect()
    }

    pub fn name(_: &Path) -> Result<Option<String>, DriverError> {
        Err(built_without("cameras"))
    }

    pub fn query(_: &Path) -> Result<CameraInfo, DriverError> {
        Err(built_without("cameras"))
    }

    pub fn set_control(_: &Path, _: &str, _: i64) -> Result<i64, String> {
        Err(built_without("cameras").to_string())
    }
}
