//! An open camera: started as its entry requests, and read.
//!
//! Invariant: a borrowed picture is exactly the bytes that the kernel reports it wrote; row padding is removed.
//! Invariant: a picture that the kernel discarded, or that arrived empty, is counted in `lost`.
//! Invariant: dropping a camera neither waits for the device nor panics.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

use rapid_core::sample::FLAG_DEVICE_TIME;
use rapid_core::time::Stamp;
use rapid_registry::CameraSpec;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::super::{Agreed, DriverError, Reading, unblock};
use super::format::{self, Frame, Layout, Numbering};
use super::listing::query;
use super::node::{self, Node, Ring};

/// After this long without a picture the node is asked whether its device still exists: the wake-up of a removal
/// reaches epoll only once, and may come before the node knows of it.
const ASK_AFTER: Duration = Duration::from_millis(500);
/// Time limit for reading back all controls; a camera that answers slowly reports fewer of them.
const READ_BACK: Duration = Duration::from_millis(300);

/// An open, streaming camera.
#[derive(Debug)]
pub struct Camera {
    /// `None` only while being dropped.
    ring: Option<AsyncFd<Ring>>,
    layout: Layout,
    progress: Numbering,
    /// Rows without their padding, for cameras that pad them.
    compact: Vec<u8>,
    /// With the control values at the start of the stream.
    pub(in crate::driver) agreed: Agreed,
}

impl Camera {
    /// Opens the node at `path` as the registry's entry `name` requests, and starts it.
    ///
    /// # Errors
    /// When the node is gone, held by another program, not permitted, or does not offer the requested format, size,
    /// rate or controls; in the last case the error lists the available ones.
    pub async fn open(name: &str, spec: &CameraSpec, path: &Path) -> Result<Self, DriverError> {
        let (name, spec, path) = (name.to_owned(), spec.clone(), path.to_owned());
        let Started { ring, layout, agreed } = unblock(move || start(&name, &spec, &path)).await?;
        // Registered only while streaming: before, the node reports an error to every poll.
        // SAFETY: the ring owns its node's descriptor, never replaces it, and closes it only when dropped, which
        // happens by or after the `AsyncFd`.
        let ring = unsafe { AsyncFd::register_with_interest(ring, Interest::READABLE | Interest::ERROR) }
            .map_err(|error| DriverError::Retry(format!("the node cannot be polled: {}", io::Error::from(error))))?;
        let compact = Vec::with_capacity(if layout.is_padded() { layout.picture_bytes() } else { 0 });
        Ok(Self { ring: Some(ring), layout, progress: Numbering::default(), compact, agreed })
    }

    /// The next picture.
    ///
    /// # Errors
    /// [`DriverError::Gone`] when the camera was unplugged, [`DriverError::Retry`] when its stream
    /// broke.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let Some(ring) = self.ring.as_mut() else { return Err(DriverError::Gone) };
        let (frame, arrived) = loop {
            // If the future is dropped, every filled buffer stays with the kernel.
            let frame = next_frame(ring).await?;
            if frame.bytes_used > 0 {
                break (frame, Stamp::now());
            }
            self.progress.skip(frame.sequence);
        };
        let lost = self.progress.accept(frame.sequence);
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
}

impl Drop for Camera {
    /// Stopping the stream of a dead device may take the kernel seconds, so a thread does it.
    fn drop(&mut self) {
        let Some(ring) = self.ring.take() else { return };
        let ring = ring.into_inner();
        // If no thread can be started, the ring is closed here.
        let _ = std::thread::Builder::new().name("camera-close".to_owned()).spawn(move || drop(ring));
    }
}

/// Returns the borrowed buffer and waits for the next one.
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
            // Only this shows that no picture is left: epoll reports each arrival once, and readiness cleared with
            // pictures waiting would leave them there until the next one arrives.
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => guard.clear_ready(),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(stream_error(guard.get_inner(), &error)),
        }
    }
}

/// EIO occurs both for a broken stream and for a device that is being removed; the node can tell.
fn stream_error(ring: &Ring, error: &io::Error) -> DriverError {
    if node::is_gone(error) || ring.is_gone() {
        return DriverError::Gone;
    }
    DriverError::Retry(format!("the camera's stream broke: {error}"))
}

/// A streaming camera, and the settings agreed with it.
struct Started {
    ring: Ring,
    layout: Layout,
    agreed: Agreed,
}

fn start(name: &str, spec: &CameraSpec, path: &Path) -> Result<Started, DriverError> {
    let node = Node::open(path)?;
    let card = node.capture_card(path)?;
    set_controls(name, spec, &node, path)?;
    let agreed = match node.negotiate(spec) {
        Ok(agreed) => agreed.accept(spec),
        // Most drivers answer with the nearest supported format; some refuse.
        Err(error) if error.raw_os_error() == Some(libc::EINVAL) => None,
        Err(error) => return Err(node::setup_error(path, "format", &error)),
    };
    let Some((layout, rate)) = agreed else {
        // The listing sets a format itself, which a node with a format set by us would refuse.
        drop(node);
        let offered = query(path).map(|info| info.modes).unwrap_or_default();
        return Err(DriverError::Fatal(format::not_offered(name, spec, path, &offered)));
    };
    let description = format::describe(&card, layout, rate);
    let negotiated = format::negotiated(card, layout, rate, read_controls(&node));
    let ring = Ring::start(node).map_err(|error| node::setup_error(path, "stream", &error))?;
    Ok(Started { ring, layout, agreed: Agreed { description, negotiated } })
}

/// The values of all controls that report theirs.
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
    for (requested, value) in &spec.controls {
        let control =
            format::find_control(&offered, requested, *value).map_err(|why| format::control_error(name, path, &why))?;
        node.set_control(control.id, *value).map_err(|error| match error.raw_os_error() {
            Some(libc::ENODEV) => DriverError::Gone,
            _ => format::control_error(
                name,
                path,
                &format!(
                    "{requested} cannot be set to {value} now ({error}): where an automatic mode governs it, switch that \
                     off in an earlier line"
                ),
            ),
        })?;
    }
    Ok(())
}
