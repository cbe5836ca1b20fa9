//! Topics that episodes have and a bus has not: a run publishes what they hold as [`crate::observation`] and as its log.

/// One message per frame of the episode: the mask, and the ages of what the frame is made of.
pub const FRAME_TOPIC: &str = "/rapid/frame";
/// Plugs, unplugs, and whatever else happened to a device.
pub const EVENT_TOPIC: &str = "/rapid/event";
/// Log messages of the process.
pub const LOG_TOPIC: &str = "/rapid/log";
