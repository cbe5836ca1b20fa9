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
//!
//! Formats that nokhwa is known not to list are added through the v4l crate below it: nokhwa drops the numerator of an
//! interval (2/15 s becomes 15 fps), knows six pixel formats (grey under a name that V4L2 does not have), and steps
//! through a range of sizes in both dimensions at once, with a panic if a driver gives a step of 0, so it is not used
//! for ranges at all.
//!
//! Invariant: a borrowed picture is exactly the bytes that the kernel reports it wrote; row padding is removed.
//! Invariant: a picture that the kernel discarded, or that arrived empty, is counted in `lost`.
//! Invariant: dropping a camera neither waits for the device nor panics.

mod format;
mod node;

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::io;
use std::os::fd::BorrowedFd;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nokhwa::utils::{ApiBackend, CameraIndex, FrameFormat, RequestedFormat, RequestedFormatType};
use rapid_core::sample::FLAG_DEVICE_TIME;
use rapid_core::time::Stamp;
use rapid_registry::CameraSpec;
use rustix::io::{FdFlags, fcntl_setfd};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use v4l::frameinterval::FrameIntervalEnum;
use v4l::framesize::FrameSizeEnum;
use v4l::video::Capture as _;

use self::format::{Frame, Layout, Numbering, fourcc_text};
use self::node::{Node, Ring, open_error, setup_error};
use super::{Agreed, DriverError, Reading, unblock};

pub use self::format::{CameraInfo, ControlInfo, Mode, Rate, Rates, Size};

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
    pub(super) agreed: Agreed,
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

/// The number in `/dev/videoN`, links such as `/dev/rapid/cam_wrist` followed.
fn video_number(path: &Path) -> Option<u32> {
    let real: PathBuf = path.canonicalize().ok()?;
    real.to_str()?.strip_prefix("/dev/video")?.parse().ok()
}

/// Nodes of all cameras found by nokhwa, on any bus; some carry metadata only and refuse [`query`].
pub fn cameras() -> Vec<PathBuf> {
    if !Path::new("/dev").read_dir().is_ok_and(|names| names.flatten().all(|entry| nokhwa_can_find(&entry.file_name())))
    {
        return Vec::new();
    }
    let Ok(found) = nokhwa::query(ApiBackend::Video4Linux) else { return Vec::new() };
    let numbers: BTreeSet<u32> = found.iter().filter_map(|info| info.index().as_index().ok()).collect();
    numbers.into_iter().map(|number| PathBuf::from(format!("/dev/video{number}"))).collect()
}

/// It takes whatever begins with `video` for a camera with a number, and panics at a name without one.
fn nokhwa_can_find(name: &OsStr) -> bool {
    let name = name.to_string_lossy();
    name.strip_prefix("video").is_none_or(|number| number.parse::<u32>().is_ok())
}

/// The name of the camera at `node`; `None` if it is an encoder, an output or another node without pictures.
///
/// # Errors
/// When it cannot be opened.
pub fn name(node: &Path) -> Result<Option<String>, DriverError> {
    Ok(Node::open(node)?.capture_card(node).ok().map(|card| card.name))
}

/// Whether the camera at `node`, one of [`cameras`], is a USB device.
pub fn is_on_usb(node: &Path) -> bool {
    let class = Path::new("/sys/class/video4linux").join(node.file_name().unwrap_or_default());
    class.canonicalize().is_ok_and(|device| device.to_string_lossy().contains("/usb"))
}

/// Sets a control of the camera at `path` while it streams: any open descriptor may (V4L2 specification, "Opening and
/// closing devices"). Returns the value that it has then. Blocks while the device answers.
///
/// # Errors
/// When the node cannot be opened, or has no such control, or not that value: with what it offers.
pub fn set_control(path: &Path, name: &str, value: i64) -> Result<i64, String> {
    let node = Node::open(path).map_err(|error| error.to_string())?;
    let offered = node.controls();
    let control = format::find_control(&offered, name, value)?;
    node.set_control(control.id, value)
        .and_then(|()| node.control(control.id))
        .map_err(|error| format!("{name}: {error}"))
}

/// The modes and controls of the camera at `path`. Blocks while the device answers; may set its format, unless another
/// program streams from it. Leaves no descriptor open.
///
/// # Errors
/// When the node cannot be opened or is not a camera.
pub fn query(path: &Path) -> Result<CameraInfo, DriverError> {
    let (card, controls) = {
        let node = Node::open(path)?;
        (node.capture_card(path)?, node.controls())
    };
    let exact = enumerate(path)?;
    let found = video_number(path).filter(|_| nokhwa_can_list(&exact)).and_then(through_nokhwa).unwrap_or_default();
    Ok(CameraInfo {
        path: path.to_owned(),
        name: card.name,
        driver: card.driver.name,
        modes: merge(found, exact),
        controls,
    })
}

/// Only discrete sizes and whole rates: nokhwa's listing fails, or worse, on anything else.
fn nokhwa_can_list(modes: &[Mode]) -> bool {
    modes.iter().all(|mode| {
        matches!(mode.size, Size::One { .. })
            && matches!(&mode.rates, Rates::List(rates) if rates.iter().all(|rate| rate.seconds == 1))
    })
}

/// Formats, sizes and rates as nokhwa lists them; `None` where it cannot open the camera, for example
/// because another program streams from it.
fn through_nokhwa(number: u32) -> Option<Vec<Mode>> {
    const KNOWN: [(FrameFormat, [u8; 4]); 3] =
        [(FrameFormat::MJPEG, *b"MJPG"), (FrameFormat::YUYV, *b"YUYV"), (FrameFormat::GRAY, *b"GREY")];
    let request = RequestedFormat::with_formats(
        RequestedFormatType::None,
        &[FrameFormat::MJPEG, FrameFormat::YUYV, FrameFormat::GRAY],
    );
    // nokhwa asserts in places that depend on drivers' answers.
    catch_unwind(AssertUnwindSafe(|| {
        let mut camera =
            nokhwa::Camera::with_backend(CameraIndex::Index(number), request, ApiBackend::Video4Linux).ok()?;
        let offered = camera.compatible_fourcc().ok()?;
        let mut modes = Vec::new();
        for (format, fourcc) in KNOWN {
            if !offered.contains(&format) {
                continue;
            }
            for (size, rates) in camera.compatible_list_by_resolution(format).ok()? {
                modes.push(Mode {
                    fourcc: fourcc_text(fourcc),
                    size: Size::One { width: size.width(), height: size.height() },
                    rates: Rates::List(rates.into_iter().map(|fps| Rate { frames: fps, seconds: 1 }).collect()),
                });
            }
        }
        Some(modes)
    }))
    .ok()
    .flatten()
}

/// All modes of `exact`, in order, then those that only `found` has. If both list a mode, the rates of `exact` are
/// better.
fn merge(found: Vec<Mode>, exact: Vec<Mode>) -> Vec<Mode> {
    let mut modes = exact;
    for mode in found {
        if !modes.iter().any(|known| known.fourcc == mode.fourcc && known.size == mode.size) {
            modes.push(mode);
        }
    }
    modes
}

/// The V4L2 names of the pixel formats that the node at `path` offers; none if it does not answer.
pub fn formats(path: &Path) -> Vec<String> {
    let listed =
        listing(path).and_then(|device| device.enum_formats().map_err(|error| setup_error(path, "formats", &error)));
    listed.unwrap_or_default().into_iter().map(|format| fourcc_text(format.fourcc.repr)).collect()
}

/// The node at `path` for its lists.
fn listing(path: &Path) -> Result<v4l::Device, DriverError> {
    let device = v4l::Device::with_path(path).map_err(|error| open_error(path, &error))?;
    let handle = device.handle();
    // SAFETY: the descriptor is open as long as `handle` lives, which is to the end of the function.
    let fd = unsafe { BorrowedFd::borrow_raw(handle.fd()) };
    // The v4l crate opens without this flag, and a child process must not inherit the node.
    fcntl_setfd(fd, FdFlags::CLOEXEC).map_err(|errno| setup_error(path, "listing", &errno.into()))?;
    Ok(device)
}

fn enumerate(path: &Path) -> Result<Vec<Mode>, DriverError> {
    let device = listing(path)?;
    let formats = device.enum_formats().map_err(|error| setup_error(path, "formats", &error))?;
    let mut modes = Vec::new();
    for format in formats {
        // A format without sizes or a size without rates is listed as far as known.
        for size in device.enum_framesizes(format.fourcc).unwrap_or_default() {
            let (size, width, height) = match size.size {
                FrameSizeEnum::Discrete(one) => {
                    (Size::One { width: one.width, height: one.height }, one.width, one.height)
                }
                FrameSizeEnum::Stepwise(range) => {
                    let smallest = (range.min_width, range.min_height);
                    let largest = (range.max_width, range.max_height);
                    (Size::Range { smallest, largest }, range.max_width, range.max_height)
                }
            };
            let intervals = device.enum_frameintervals(format.fourcc, width, height).unwrap_or_default();
            let rates = rates(intervals.into_iter().map(|interval| interval.interval));
            let mode = Mode { fourcc: fourcc_text(format.fourcc.repr), size, rates };
            if !modes.contains(&mode) {
                modes.push(mode);
            }
        }
    }
    Ok(modes)
}

fn rates(intervals: impl Iterator<Item = FrameIntervalEnum>) -> Rates {
    let mut list = Vec::new();
    for interval in intervals {
        match interval {
            FrameIntervalEnum::Discrete(one) => list.push(Rate::of_interval(one.numerator, one.denominator)),
            // The longest interval is the slowest rate. The driver gives only a range.
            FrameIntervalEnum::Stepwise(range) => {
                return Rates::Range {
                    slowest: Rate::of_interval(range.max.numerator, range.max.denominator),
                    fastest: Rate::of_interval(range.min.numerator, range.min.denominator),
                };
            }
        }
    }
    Rates::List(list)
}

#[cfg(test)]
mod tests {
    use v4l::Fraction;
    use v4l::frameinterval::Stepwise;

    use super::*;

    fn one(fourcc: &str, width: u32, rates: &[(u32, u32)]) -> Mode {
        let rates = rates.iter().map(|&(frames, seconds)| Rate { frames, seconds }).collect();
        Mode { fourcc: fourcc.to_owned(), size: Size::One { width, height: 480 }, rates: Rates::List(rates) }
    }

    #[test]
    fn nokhwa_is_queried_only_where_its_list_is_right() {
        assert!(nokhwa_can_list(&[one("MJPG", 640, &[(30, 1)])]));
        assert!(!nokhwa_can_list(&[one("MJPG", 640, &[(30, 1), (15, 2)])]));
        let range = Size::Range { smallest: (2, 2), largest: (640, 480) };
        assert!(!nokhwa_can_list(&[Mode { size: range, ..one("GREY", 0, &[(30, 1)]) }]));
    }

    #[test]
    fn both_listings_are_merged_and_exact_rates_win() {
        let exact = vec![one("MJPG", 640, &[(15, 2)]), one("H264", 640, &[(30, 1)])];
        let found = vec![one("MJPG", 640, &[(15, 1)]), one("YUYV", 320, &[(30, 1)])];
        let merged = merge(found, exact.clone());
        assert_eq!(merged[..2], exact);
        assert_eq!(merged[2], one("YUYV", 320, &[(30, 1)]));
    }

    #[test]
    fn intervals_become_rates() {
        let discrete =
            [FrameIntervalEnum::Discrete(Fraction::new(2, 15)), FrameIntervalEnum::Discrete(Fraction::new(1, 30))];
        assert_eq!(rates(discrete.into_iter()).to_string(), "7.5, 30 fps");
        let step = Stepwise { min: Fraction::new(1, 60), max: Fraction::new(1, 5), step: Fraction::new(1, 60) };
        assert_eq!(rates([FrameIntervalEnum::Stepwise(step)].into_iter()).to_string(), "5 to 60 fps");
        assert_eq!(rates([].into_iter()).to_string(), "any rate");
    }
}
