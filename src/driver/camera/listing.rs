//! Which cameras there are and what they offer.
//!
//! nokhwa finds cameras and their formats. What it is known not to list is filled in through the
//! v4l crate under it: it drops the numerator of an interval (2/15 s becomes 15 fps), knows six pixel
//! formats (grey under a name V4L2 does not have), and steps through a range of sizes in both
//! dimensions at once, with a panic where a driver gives a step of 0, so it is not asked about ranges
//! at all.
//!
//! Invariant: listing never leaves a descriptor open.

use std::os::fd::BorrowedFd;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use nokhwa::utils::{ApiBackend, CameraIndex, FrameFormat, RequestedFormat, RequestedFormatType};
use rustix::io::{FdFlags, fcntl_setfd};
use v4l::frameinterval::FrameIntervalEnum;
use v4l::framesize::FrameSizeEnum;
use v4l::video::Capture as _;

use super::super::DriverError;
use super::format::{CameraInfo, Mode, Rate, Rates, Size, fourcc_text};
use super::node::{Node, open_error, setup_error};
use super::video_number;

/// Nodes of all cameras, as nokhwa finds them; some carry metadata only and refuse [`query`].
#[must_use]
pub fn cameras() -> Vec<PathBuf> {
    let Ok(found) = nokhwa::query(ApiBackend::Video4Linux) else { return Vec::new() };
    let mut numbers: Vec<u32> = found.iter().filter_map(|info| info.index().as_index().ok()).collect();
    numbers.sort_unstable();
    numbers.dedup();
    numbers.into_iter().map(|number| PathBuf::from(format!("/dev/video{number}"))).collect()
}

/// What the camera at `path` offers. Blocks while the device answers; may set its format, unless
/// another program streams from it.
///
/// # Errors
/// When the node cannot be opened or is no camera.
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

/// Only plain sizes and whole rates: anything else ends nokhwa's listing with an error or worse.
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
    let wish = RequestedFormat::with_formats(
        RequestedFormatType::None,
        &[FrameFormat::MJPEG, FrameFormat::YUYV, FrameFormat::GRAY],
    );
    // It asserts in places that depend on what drivers answer.
    catch_unwind(AssertUnwindSafe(|| {
        let mut camera =
            nokhwa::Camera::with_backend(CameraIndex::Index(number), wish, ApiBackend::Video4Linux).ok()?;
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

/// Everything of `exact`, in its order, and what only `found` has. Where both list a mode, `exact`
/// knows its rates better.
fn merge(found: Vec<Mode>, exact: Vec<Mode>) -> Vec<Mode> {
    let mut modes = exact;
    for mode in found {
        if !modes.iter().any(|known| known.fourcc == mode.fourcc && known.size == mode.size) {
            modes.push(mode);
        }
    }
    modes
}

fn enumerate(path: &Path) -> Result<Vec<Mode>, DriverError> {
    let device = v4l::Device::with_path(path).map_err(|error| open_error(path, &error))?;
    let handle = device.handle();
    // SAFETY: the descriptor is open as long as `handle` lives, which is to the end of the function.
    let fd = unsafe { BorrowedFd::borrow_raw(handle.fd()) };
    // The v4l crate opens without it, and a child process must not inherit the node.
    fcntl_setfd(fd, FdFlags::CLOEXEC).map_err(|errno| setup_error(path, "listing", &errno.into()))?;
    let formats = device.enum_formats().map_err(|error| setup_error(path, "formats", &error))?;
    let mut modes = Vec::new();
    for format in formats {
        // A format without sizes or a size without rates is listed as far as it is known.
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
            // The longest interval is the slowest rate. A range is all a driver gives.
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
    fn nokhwa_is_asked_only_where_it_lists_right() {
        assert!(nokhwa_can_list(&[one("MJPG", 640, &[(30, 1)])]));
        assert!(!nokhwa_can_list(&[one("MJPG", 640, &[(30, 1), (15, 2)])]));
        let range = Size::Range { smallest: (2, 2), largest: (640, 480) };
        assert!(!nokhwa_can_list(&[Mode { size: range, ..one("GREY", 0, &[(30, 1)]) }]));
    }

    #[test]
    fn both_listings_make_one_and_exact_rates_win() {
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
