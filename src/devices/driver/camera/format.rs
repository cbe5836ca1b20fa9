//! Formats that cameras offer, settings agreed with one, the layout of a picture in a buffer, and the position in the
//! stream: pure, for people and for pictures.
//!
//! Invariant: nothing here touches a device.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::provenance::{Format, KernelDriver, Negotiated};
use rapid_core::sample::{Encoding, FLAG_ERROR};
use rapid_core::time::Stamp;
use rapid_registry::{CameraSpec, PixelFormat};
use serde::Serialize;

use super::super::DriverError;

/// Tolerance of a rate: many cameras call 30000/1001 30.
const RATE_TOLERANCE: f64 = 0.005;

/// A camera with its modes and controls.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraInfo {
    /// The node.
    pub path: PathBuf,
    /// Name reported by the camera.
    pub name: String,
    /// Kernel driver.
    pub driver: String,
    /// Formats with sizes and rates.
    pub modes: Vec<Mode>,
    /// Controls that can be set to a number.
    pub controls: Vec<ControlInfo>,
}

/// A pixel format in one size, and its rates.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Mode {
    /// V4L2 name of the pixel format, for example `MJPG`.
    pub fourcc: String,
    /// Size.
    pub size: Size,
    /// Rates.
    pub rates: Rates,
}

/// One size, or a range of sizes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Size {
    /// This size.
    One {
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
    },
    /// Sizes between the two.
    Range {
        /// Smallest, pixels: width, height.
        smallest: (u32, u32),
        /// Largest, pixels: width, height.
        largest: (u32, u32),
    },
}

/// Rates of a mode.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Rates {
    /// These; none if the driver does not list them.
    List(Vec<Rate>),
    /// Anything between slowest and fastest.
    Range {
        /// Slowest.
        slowest: Rate,
        /// Fastest.
        fastest: Rate,
    },
}

/// Pictures per second, exact.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
pub struct Rate {
    /// Pictures.
    pub frames: u32,
    /// In this many seconds.
    pub seconds: u32,
}

/// A control of a camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ControlInfo {
    /// V4L2 number.
    #[serde(skip)]
    pub id: u32,
    /// Name as the driver gives it.
    pub name: String,
    /// Smallest value.
    pub minimum: i64,
    /// Largest value.
    pub maximum: i64,
    /// Distance of values.
    pub step: u64,
    /// Value after power-up.
    pub default: i64,
}

impl Rate {
    /// The rate of pictures that are `numerator / denominator` seconds apart.
    pub const fn of_interval(numerator: u32, denominator: u32) -> Self {
        Self { frames: denominator, seconds: numerator }
    }

    /// Pictures per second; 0 if the driver gave no interval.
    pub fn hz(self) -> f64 {
        if self.seconds == 0 { 0.0 } else { f64::from(self.frames) / f64::from(self.seconds) }
    }

    fn is_near(self, fps: u32) -> bool {
        (self.hz() - f64::from(fps)).abs() <= f64::from(fps) * RATE_TOLERANCE
    }
}

impl fmt::Display for Rate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Two digits distinguish 29.97 from 30; whole rates are shown without decimals.
        let text = format!("{:.2}", self.hz());
        f.write_str(text.trim_end_matches('0').trim_end_matches('.'))
    }
}

impl fmt::Display for Rates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::List(rates) if rates.is_empty() => f.write_str("any rate"),
            Self::List(rates) => {
                let mut rates = rates.clone();
                rates.sort_by(|a, b| a.hz().total_cmp(&b.hz()));
                for (i, rate) in rates.iter().enumerate() {
                    write!(f, "{}{rate}", if i == 0 { "" } else { ", " })?;
                }
                f.write_str(" fps")
            }
            Self::Range { slowest, fastest } => write!(f, "{slowest} to {fastest} fps"),
        }
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::One { width, height } => write!(f, "{width}x{height}"),
            Self::Range { smallest, largest } => {
                write!(f, "{}x{} to {}x{}", smallest.0, smallest.1, largest.0, largest.1)
            }
        }
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} at {}", self.fourcc, self.size, self.rates)
    }
}

impl fmt::Display for ControlInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}..={} (default {})", self.name, self.minimum, self.maximum, self.default)
    }
}

/// Three lines: camera; formats; controls.
impl fmt::Display for CameraInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} ({})", self.path.display(), self.name, self.driver)?;
        write!(f, "\n  formats: {}", modes_text(&self.modes))?;
        if !self.controls.is_empty() {
            write!(f, "\n  controls: {}", join(&self.controls))?;
        }
        Ok(())
    }
}

fn modes_text(modes: &[Mode]) -> String {
    if modes.is_empty() { String::from("none that it reports") } else { join(modes) }
}

fn join(items: &[impl fmt::Display]) -> String {
    items.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ")
}

/// The V4L2 name of a pixel format.
pub(super) const fn fourcc(format: PixelFormat) -> [u8; 4] {
    match format {
        PixelFormat::Mjpg => *b"MJPG",
        PixelFormat::Yuyv => *b"YUYV",
        PixelFormat::Grey => *b"GREY",
        PixelFormat::Z16 => *b"Z16 ",
    }
}

/// A pixel format's name for people.
pub(super) fn fourcc_text(fourcc: [u8; 4]) -> String {
    fourcc.trim_ascii_end().iter().map(|&byte| if byte.is_ascii_graphic() { char::from(byte) } else { '?' }).collect()
}

/// The format that the driver agreed to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Agreed {
    pub(super) fourcc: [u8; 4],
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) bytes_per_line: u32,
    /// `None` if the driver cannot set a rate.
    pub(super) rate: Option<Rate>,
}

impl Agreed {
    /// Layout and rate, if this is what was requested.
    pub(super) fn accept(self, spec: &CameraSpec) -> Option<(Layout, Option<Rate>)> {
        let format_is_requested =
            self.fourcc == fourcc(spec.format) && (self.width, self.height) == (spec.width, spec.height);
        let rate_is_requested = self.rate.is_none_or(|rate| rate.is_near(spec.fps));
        if !format_is_requested || !rate_is_requested {
            return None;
        }
        let stride = self.bytes_per_line as usize;
        Some((Layout { format: spec.format, width: spec.width, height: spec.height, stride }, self.rate))
    }
}

/// Normalises a name: case is ignored, and blanks, `_`, `-` and `,` are equal: `White Balance, Automatic` is
/// `white_balance_automatic`.
pub(super) fn plain_name(name: &str) -> String {
    name.split(|c: char| !c.is_alphanumeric())
        .filter(|word| !word.is_empty())
        .collect::<Vec<_>>()
        .join("_")
        .to_lowercase()
}

/// The control called `requested` if it accepts `value`, otherwise the error message.
pub(super) fn find_control<'a>(
    offered: &'a [ControlInfo],
    requested: &str,
    value: i64,
) -> Result<&'a ControlInfo, String> {
    let Some(control) = offered.iter().find(|control| plain_name(&control.name) == plain_name(requested)) else {
        let names = offered.iter().map(|control| plain_name(&control.name)).collect::<Vec<_>>().join(", ");
        return Err(format!("no control {requested}; it offers {}", if names.is_empty() { "none" } else { &names }));
    };
    if !(control.minimum..=control.maximum).contains(&value) {
        return Err(format!("{requested} = {value} is out of range {}..={}", control.minimum, control.maximum));
    }
    Ok(control)
}

pub(super) fn control_error(name: &str, path: &Path, why: &str) -> DriverError {
    DriverError::Fatal(format!("{}: {why} - set `controls` in [device.{name}.camera]", path.display()))
}

/// The error message for a requested format that the camera does not offer.
pub(super) fn not_offered(name: &str, spec: &CameraSpec, path: &Path, offered: &[Mode]) -> String {
    format!(
        "{} offers no {} {}x{} at {} fps; it offers {} - set format, width, height and fps in [device.{name}.camera]",
        path.display(),
        fourcc_text(fourcc(spec.format)),
        spec.width,
        spec.height,
        spec.fps,
        modes_text(offered)
    )
}

/// The camera as reported by its driver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Card {
    pub(super) name: String,
    pub(super) driver: KernelDriver,
    pub(super) bus: String,
}

/// The agreed settings, for people.
pub(super) fn describe(card: &Card, layout: Layout, rate: Option<Rate>) -> String {
    let Layout { format, width, height, .. } = layout;
    let rate = rate.map_or_else(|| String::from("its own rate"), |rate| format!("{rate} fps"));
    format!("{} {width}x{height} at {rate}, {} ({})", fourcc_text(fourcc(format)), card.name, card.driver.name)
}

/// The agreed settings, for the recording.
pub(super) fn negotiated(
    card: Card,
    layout: Layout,
    rate: Option<Rate>,
    controls: BTreeMap<String, i64>,
) -> Negotiated {
    let Layout { format, width, height, .. } = layout;
    let format = Format::Pictures { fourcc: fourcc_text(fourcc(format)), width, height, fps: rate.map(Rate::hz) };
    Negotiated {
        driver: Some(card.driver),
        card: Some(card.name),
        bus: Some(card.bus),
        format: Some(format),
        controls,
        replay_of: None,
    }
}

/// Layout of a picture in a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    pub(super) format: PixelFormat,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Bytes from the start of a row to the next, padding included.
    pub(super) stride: usize,
}

impl Layout {
    pub(super) const fn encoding(self) -> Encoding {
        self.format.encoding()
    }

    /// Bytes of a row's pixels; 0 for compressed pictures.
    fn row_bytes(self) -> usize {
        // Two pixels of YUYV share their colour: an odd width is rounded up.
        let width = if self.format == PixelFormat::Yuyv { self.width.next_multiple_of(2) } else { self.width };
        self.encoding().pixel_bytes().unwrap_or(0) * width as usize
    }

    /// Bytes of a picture's pixels; 0 for compressed pictures.
    pub(super) fn picture_bytes(self) -> usize {
        self.row_bytes() * self.height as usize
    }

    /// Whether rows end in padding.
    pub(super) fn is_padded(self) -> bool {
        self.row_bytes() > 0 && self.stride > self.row_bytes()
    }

    /// Whether this is a complete picture, as far as can be judged without decoding it.
    fn is_whole(self, bytes: &[u8]) -> bool {
        match self.format {
            // Start of image marker (ITU-T T.81, table B.1).
            PixelFormat::Mjpg => bytes.starts_with(&[0xff, 0xd8]),
            _ if self.is_padded() => {
                // Some drivers omit the padding of the last row.
                let most = self.stride * self.height as usize;
                let least = most - (self.stride - self.row_bytes());
                (least..=most).contains(&bytes.len())
            }
            PixelFormat::Yuyv | PixelFormat::Grey | PixelFormat::Z16 => bytes.len() == self.picture_bytes(),
        }
    }

    /// Copies the rows of `bytes` without their padding.
    pub(super) fn compact(self, bytes: &[u8], into: &mut Vec<u8>) {
        compact_rows(bytes, self.stride, self.row_bytes(), self.height as usize, into);
    }
}

/// Copies at most `height` rows of `row` bytes each that lie `stride` bytes apart.
fn compact_rows(bytes: &[u8], stride: usize, row: usize, height: usize, into: &mut Vec<u8>) {
    into.clear();
    for line in bytes.chunks(stride.max(1)).take(height) {
        into.extend_from_slice(line.get(..row).unwrap_or(line));
    }
}

/// The kernel's report on a filled buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Frame {
    pub(super) sequence: u32,
    pub(super) bytes_used: usize,
    pub(super) is_damaged: bool,
    /// Capture time, if the kernel gives it on the monotonic clock.
    pub(super) stamp: Option<Stamp>,
}

impl Frame {
    pub(super) fn flags(&self, layout: Layout, bytes: &[u8]) -> u32 {
        if self.is_damaged || !layout.is_whole(bytes) { FLAG_ERROR } else { 0 }
    }
}

/// Position in the stream.
#[derive(Debug, Default)]
pub(super) struct Numbering {
    last_sequence: Option<u32>,
    /// The last capture time passed on.
    last_stamp: Stamp,
    /// The kernel's last accepted capture time.
    last_kernel: Stamp,
    lost: u64,
}

impl Numbering {
    /// A picture that is not passed on.
    pub(super) fn skip(&mut self, sequence: u32) {
        self.count(sequence);
        self.lost += 1;
    }

    /// A picture that is passed on; returns how many were lost before it.
    pub(super) fn accept(&mut self, sequence: u32) -> u64 {
        self.count(sequence);
        std::mem::take(&mut self.lost)
    }

    fn count(&mut self, sequence: u32) {
        if let Some(last) = self.last_sequence {
            let gap = sequence.wrapping_sub(last.wrapping_add(1));
            // A number that stands still or goes back comes from a driver that does not count.
            if gap < 1 << 31 {
                self.lost += u64::from(gap);
            }
        }
        self.last_sequence = Some(sequence);
    }

    /// The kernel's capture time if plausible: not later than now and later than the kernel's previous one (some
    /// cameras' own clocks, which the kernel may translate, jump). Otherwise the moment of arrival. Published capture
    /// times always increase: one that would not is moved after the last and no longer counts as the kernel's.
    ///
    /// A moment of arrival is later than the next pictures' capture times if a picture's latency exceeds the frame
    /// interval. It therefore rejects no capture time of the kernel: these are used again as soon as they pass it.
    pub(super) fn stamp(&mut self, frame: &Frame, arrived: Stamp) -> (Stamp, bool) {
        let kernel = frame.stamp.filter(|stamp| *stamp <= arrived && *stamp > self.last_kernel);
        self.last_kernel = kernel.unwrap_or(self.last_kernel);
        let least = self.last_stamp.after(Duration::from_nanos(1));
        self.last_stamp = kernel.unwrap_or(arrived).max(least);
        (self.last_stamp, kernel == Some(self.last_stamp))
    }
}

#[cfg(test)]
mod tests;
