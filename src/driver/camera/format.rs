//! What cameras offer and what was agreed with one: pure, for people and for pictures.
//!
//! Invariant: nothing here touches a device.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::super::DriverError;
use super::layout::Layout;
use super::node::Card;
use crate::provenance::{Format, Negotiated};
use crate::registry::{CameraSpec, PixelFormat};

/// How far a rate may be from the wished one: 30000/1001 is what many cameras call 30.
const RATE_TOLERANCE: f64 = 0.005;

/// A camera and what it offers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraInfo {
    /// The node.
    pub path: PathBuf,
    /// What the camera calls itself.
    pub name: String,
    /// Kernel driver.
    pub driver: String,
    /// Formats with sizes and rates.
    pub modes: Vec<Mode>,
    /// Controls that can be set to a number.
    pub controls: Vec<ControlInfo>,
}

/// A pixel format in a size, and the rates it comes at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Mode {
    /// V4L2 name of the pixel format, for example `MJPG`.
    pub fourcc: String,
    /// Size.
    pub size: Size,
    /// Rates.
    pub rates: Rates,
}

/// One size, or all within limits.
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
    /// These; none if the driver does not say.
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
    /// The rate of pictures `numerator / denominator` seconds apart.
    #[must_use]
    pub const fn of_interval(numerator: u32, denominator: u32) -> Self {
        Self { frames: denominator, seconds: numerator }
    }

    /// Pictures per second; 0 if the driver gave no interval.
    #[must_use]
    pub fn hz(self) -> f64 {
        if self.seconds == 0 { 0.0 } else { f64::from(self.frames) / f64::from(self.seconds) }
    }

    fn is_near(self, fps: u32) -> bool {
        (self.hz() - f64::from(fps)).abs() <= f64::from(fps) * RATE_TOLERANCE
    }
}

impl fmt::Display for Rate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Two digits tell 29.97 from 30; whole rates are shown without.
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
    if modes.is_empty() { String::from("none that it tells of") } else { join(modes) }
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
    }
}

/// A pixel format's name for people.
pub(super) fn fourcc_text(fourcc: [u8; 4]) -> String {
    fourcc.iter().map(|&byte| if byte.is_ascii_graphic() { char::from(byte) } else { '?' }).collect()
}

/// What the driver made of a wish.
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
    /// Layout and rate, if this is what was wished.
    pub(super) fn accept(self, spec: &CameraSpec) -> Option<(Layout, Option<Rate>)> {
        let format_is_wished =
            self.fourcc == fourcc(spec.format) && (self.width, self.height) == (spec.width, spec.height);
        let rate_is_wished = self.rate.is_none_or(|rate| rate.is_near(spec.fps));
        if !format_is_wished || !rate_is_wished {
            return None;
        }
        let stride = self.bytes_per_line as usize;
        Some((Layout { format: spec.format, width: spec.width, height: spec.height, stride }, self.rate))
    }
}

/// Names compare without case, and blanks, `_`, `-` and `,` alike: `White Balance, Automatic` is
/// `white_balance_automatic`.
pub(super) fn plain_name(name: &str) -> String {
    name.split(|c: char| !c.is_alphanumeric())
        .filter(|word| !word.is_empty())
        .collect::<Vec<_>>()
        .join("_")
        .to_lowercase()
}

/// The control called `wished`, if it takes `value`; otherwise what to tell.
pub(super) fn find_control<'a>(
    offered: &'a [ControlInfo],
    wished: &str,
    value: i64,
) -> Result<&'a ControlInfo, String> {
    let Some(control) = offered.iter().find(|control| plain_name(&control.name) == plain_name(wished)) else {
        let names = offered.iter().map(|control| plain_name(&control.name)).collect::<Vec<_>>().join(", ");
        return Err(format!("no control {wished}; it offers {}", if names.is_empty() { "none" } else { &names }));
    };
    if !(control.minimum..=control.maximum).contains(&value) {
        return Err(format!("{wished} = {value} is out of range {}..={}", control.minimum, control.maximum));
    }
    Ok(control)
}

pub(super) fn control_error(name: &str, path: &Path, why: &str) -> DriverError {
    DriverError::Fatal(format!("{}: {why} - set `controls` in [device.{name}.camera]", path.display()))
}

/// The message for a wish the camera does not fulfil.
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

/// What was agreed, for people.
pub(super) fn describe(card: &Card, layout: Layout, rate: Option<Rate>) -> String {
    let Layout { format, width, height, .. } = layout;
    let rate = rate.map_or_else(|| String::from("its own rate"), |rate| format!("{rate} fps"));
    format!("{} {width}x{height} at {rate}, {} ({})", fourcc_text(fourcc(format)), card.name, card.driver.name)
}

/// What was agreed, for the recording.
pub(super) fn negotiated(
    card: Card,
    layout: Layout,
    rate: Option<Rate>,
    controls: BTreeMap<String, i64>,
) -> Negotiated {
    let Layout { format, width, height, .. } = layout;
    let format = Format::Pictures { fourcc: fourcc_text(fourcc(format)), width, height, fps: rate.map(Rate::hz) };
    Negotiated { driver: Some(card.driver), card: Some(card.name), bus: Some(card.bus), format: Some(format), controls }
}

#[cfg(test)]
mod tests;
