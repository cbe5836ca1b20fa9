//! The cameras of this machine, what each offers, and its controls.
//!
//! Formats that nokhwa is known not to list are added through the v4l crate below it: nokhwa drops the numerator of an
//! interval (2/15 s becomes 15 fps), knows six pixel formats (grey under a name that V4L2 does not have), and steps
//! through a range of sizes in both dimensions at once, with a panic if a driver gives a step of 0, so it is not used
//! for ranges at all.
//!
//! Invariant: listing never leaves a descriptor open.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::os::fd::BorrowedFd;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use nokhwa::utils::{ApiBackend, CameraIndex, FrameFormat, RequestedFormat, RequestedFormatType};
use rustix::io::{FdFlags, fcntl_setfd};
use v4l::frameinterval::FrameIntervalEnum;
use v4l::framesize::FrameSizeEnum;
use v4l::video::Capture as _;

use super::super::DriverError;
use super::format::{self, CameraInfo, Mode, Rate, Rates, Size, fourcc_text};
use super::node::{Node, open_error, setup_error};

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
/// program streams from it.
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
