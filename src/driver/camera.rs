//! Cameras: V4L2 capture from kernel buffers that are lent, not copied.
//!
//! Finding cameras and what they offer goes through nokhwa (`listing`); capture does not, because its
//! stream never times out, drops the kernel's timestamp and hands out whole buffers with the stale
//! tail of an older picture behind a compressed one. So the buffers are ours (`buffers`), on the
//! types of the v4l crate it stands on.
//!
//! Invariant: a lent picture is exactly what the kernel says it wrote; row padding is taken out.
//! Invariant: a picture the kernel gave up, or that arrived empty, is counted in `lost`.
//! Invariant: dropping a camera neither waits for the device nor panics.

mod buffers;
mod format;
mod layout;
mod listing;
mod node;

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use self::buffers::Ring;
pub use self::format::{CameraInfo, ControlInfo, Mode, Rate, Rates, Size};
pub(super) use self::layout::compact_rows;
use self::layout::{Frame, Layout, Progress};
pub use self::listing::{cameras, query};
use self::node::Node;
use super::{DriverError, Reading, unblock};
use crate::provenance::Negotiated;
use crate::registry::CameraSpec;
use crate::sample::FLAG_DEVICE_TIME;
use crate::time::Stamp;

/// After this long without a picture the node is asked whether its device is still there: the wake-up
/// of a removal reaches epoll only once, and may come before the node knows of it.
const ASK_AFTER: Duration = Duration::from_millis(500);
/// Reading back all controls may take this long; a camera that answers slowly names fewer of them.
const READ_BACK: Duration = Duration::from_millis(300);

/// An open, streaming camera.
#[derive(Debug)]
pub struct Camera {
    /// `None` only while being dropped.
    ring: Option<AsyncFd<Ring>>,
    layout: Layout,
    progress: Progress,
    /// Rows without their padding, for cameras that pad them.
    compact: Vec<u8>,
    description: String,
    negotiated: Negotiated,
}

impl Camera {
    /// Opens the node at `path` as the registry's entry `name` wishes it, and starts it.
    ///
    /// # Errors
    /// When the node is gone, held by another program, not permitted, or does not offer the wished
    /// format, size, rate or controls; the last names what is offered.
    pub async fn open(name: &str, spec: &CameraSpec, path: &Path) -> Result<Self, DriverError> {
        let (name, spec, path) = (name.to_owned(), spec.clone(), path.to_owned());
        let Started { ring, layout, description, negotiated } = unblock(move || start(&name, &spec, &path)).await?;
        // Registered only now that it streams: before, the node reports an error to whoever polls.
        // SAFETY: the ring owns its node's descriptor, never replaces it, and closes it only when it is
        // dropped, which it is by or after the `AsyncFd`.
        let ring = unsafe { AsyncFd::register_with_interest(ring, Interest::READABLE | Interest::ERROR) }
            .map_err(|error| DriverError::Retry(format!("the node cannot be polled: {}", io::Error::from(error))))?;
        let compact = Vec::with_capacity(if layout.is_padded() { layout.picture_bytes() } else { 0 });
        Ok(Self { ring: Some(ring), layout, progress: Progress::default(), compact, description, negotiated })
    }

    /// The next picture.
    ///
    /// # Errors
    /// [`DriverError::Gone`] when the camera was unplugged, [`DriverError::Retry`] when its stream
    /// broke.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let Some(ring) = self.ring.as_mut() else { return Err(DriverError::Gone) };
        let (frame, arrived) = loop {
            // A dropped future leaves every filled buffer with the kernel.
            let frame = next_frame(ring).await?;
            if frame.bytes_used > 0 {
                break (frame, Stamp::now());
            }
            self.progress.skip(frame.sequence);
        };
        let lost = self.progress.take(frame.sequence);
        let (captured, from_kernel) = self.progress.stamp(&frame, arrived);
        let bytes = ring.get_ref().lent();
        let mut flags = frame.flags(self.layout, bytes);
        if from_kernel {
            flags |= FLAG_DEVICE_TIME;
        }
        let bytes = if self.layout.is_padded() {
            self.layout.compact(bytes, &mut self.compact);
            self.compact.as_slice()
        } else {
            bytes
        };
        let Layout { width, height, .. } = self.layout;
        Ok(Reading { bytes, encoding: self.layout.encoding(), captured, flags, width, height, lost })
    }

    /// Format, size, rate and driver as agreed.
    #[must_use]
    pub fn description(&self) -> &str {
        &self.description
    }

    /// The same for the recording, with the controls as they stood when the camera was started.
    #[must_use]
    pub fn negotiated(&self) -> Negotiated {
        self.negotiated.clone()
    }
}

impl Drop for Camera {
    /// Stopping a stream whose device is dead may take the kernel seconds, so a thread does it.
    fn drop(&mut self) {
        let Some(ring) = self.ring.take() else { return };
        let ring = ring.into_inner();
        // Without a thread the ring is closed here, which is the most that is left to do.
        let _ = std::thread::Builder::new().name("camera-close".to_owned()).spawn(move || drop(ring));
    }
}

/// Gives the lent buffer back and waits for the next one.
async fn next_frame(ring: &mut AsyncFd<Ring>) -> Result<Frame, DriverError> {
    ring.get_mut().give_back().map_err(|error| stream_error(ring.get_ref(), &error))?;
    loop {
        let ready = tokio::time::timeout(ASK_AFTER, ring.ready_mut(Interest::READABLE | Interest::ERROR)).await;
        let Ok(ready) = ready else {
            if ring.get_ref().is_gone() {
                return Err(DriverError::Gone);
            }
            continue;
        };
        let mut guard = ready.map_err(|error| DriverError::Retry(format!("polling the camera: {error}")))?;
        match guard.get_inner_mut().dequeue() {
            Ok(frame) => return Ok(frame),
            // Only this says that nothing is left: epoll tells each arrival once, and readiness
            // cleared with pictures waiting would leave them there until the next one comes.
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => guard.clear_ready(),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(stream_error(guard.get_inner(), &error)),
        }
    }
}

/// EIO comes both from a stream that broke and from one whose device is just going: the node knows.
fn stream_error(ring: &Ring, error: &io::Error) -> DriverError {
    if node::is_gone(error) || ring.is_gone() {
        return DriverError::Gone;
    }
    DriverError::Retry(format!("the camera's stream broke: {error}"))
}

/// A camera that streams, and what was agreed with it.
struct Started {
    ring: Ring,
    layout: Layout,
    description: String,
    negotiated: Negotiated,
}

fn start(name: &str, spec: &CameraSpec, path: &Path) -> Result<Started, DriverError> {
    let node = Node::open(path)?;
    let card = node.capture_card(path)?;
    set_controls(name, spec, &node, path)?;
    let agreed = match node.negotiate(spec) {
        Ok(agreed) => agreed.accept(spec),
        // Most drivers answer with what they can do instead; some refuse.
        Err(error) if error.raw_os_error() == Some(libc::EINVAL) => None,
        Err(error) => return Err(node::setup_error(path, "format", &error)),
    };
    let Some((layout, rate)) = agreed else {
        // The listing sets a format by itself, which a node with one set by us would refuse.
        drop(node);
        let offered = query(path).map(|info| info.modes).unwrap_or_default();
        return Err(DriverError::Fatal(format::not_offered(name, spec, path, &offered)));
    };
    let description = format::describe(&card, layout, rate);
    let negotiated = format::negotiated(card, layout, rate, read_controls(&node));
    let ring = Ring::start(node).map_err(|error| node::setup_error(path, "stream", &error))?;
    Ok(Started { ring, layout, description, negotiated })
}

/// The values of all controls that tell theirs.
fn read_controls(node: &Node) -> BTreeMap<String, i64> {
    let begun = Instant::now();
    let offered = node.controls().into_iter().take_while(|_| begun.elapsed() < READ_BACK);
    offered.filter_map(|control| Some((format::plain_name(&control.name), node.control(control.id).ok()?))).collect()
}

fn set_controls(name: &str, spec: &CameraSpec, node: &Node, path: &Path) -> Result<(), DriverError> {
    if spec.controls.is_empty() {
        return Ok(());
    }
    let offered = node.controls();
    for (wished, value) in &spec.controls {
        let control =
            format::find_control(&offered, wished, *value).map_err(|why| format::control_error(name, path, &why))?;
        node.set_control(control.id, *value).map_err(|error| match error.raw_os_error() {
            Some(libc::ENODEV) => DriverError::Gone,
            _ => format::control_error(
                name,
                path,
                &format!(
                    "{wished} cannot be set to {value} now ({error}): where an automatic mode governs it, switch that \
                     off in an earlier line"
                ),
            ),
        })?;
    }
    Ok(())
}

/// The number in `/dev/videoN`, links such as `/dev/rapid/cam_wrist` followed.
fn video_number(path: &Path) -> Option<u32> {
    let real: PathBuf = path.canonicalize().ok()?;
    real.to_str()?.strip_prefix("/dev/video")?.parse().ok()
}
