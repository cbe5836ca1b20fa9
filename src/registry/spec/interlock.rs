//! `[stop.NAME]`: emergency stops and enabling switches, and what each is read from.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;

use crate::interlock::StopKind;

/// One `[stop.NAME]` table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InterlockSpec {
    /// Its name: `[a-z][a-z0-9_]*`, at most 64 bytes.
    pub name: String,
    /// What it stops.
    pub kind: StopKind,
    /// Names of the entries that it stops, each an actuator; empty if the rig has none.
    pub actuators: Vec<String>,
    /// What it is read from.
    pub input: InterlockInput,
}

/// What a stop is read from.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum InterlockInput {
    /// A key of an input device of the kernel (evdev).
    Key(KeyInput),
    /// A line of a GPIO chip.
    Gpio(GpioInput),
    /// Lines of text on a serial port.
    Serial(LineInput),
    /// A number in the samples of an entry.
    Field(FieldInput),
}

/// `key = { ... }`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct KeyInput {
    /// The device: an absolute path, or the name that it gives itself.
    pub device: String,
    /// The key's name in `linux/input-event-codes.h`.
    pub code: String,
    /// The key's number there.
    pub number: u16,
    /// The actuator may move while the key is pressed; otherwise while it is not.
    pub runs_while_pressed: bool,
}

/// `gpio = { ... }`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct GpioInput {
    /// The chip, for example `/dev/gpiochip0`.
    pub chip: PathBuf,
    /// Its line.
    pub line: u32,
    /// The actuator may move while the line is high; otherwise while it is low. The line is pulled the other way, so
    /// that a broken wire stops.
    pub runs_while_high: bool,
}

/// `serial = { ... }`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LineInput {
    /// The port, absolute.
    pub path: PathBuf,
    /// Bits a second, default 115200.
    pub baud: u32,
    /// The line that says that the actuator may move.
    pub run: String,
    /// The line that says that it may not; then any other than the two is left out. Without it every other line says so.
    pub stop: Option<String>,
    /// Without one of the two for this long the input is lost.
    pub silence: Duration,
}

/// `field = { ... }`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FieldInput {
    /// The entry, whose samples are numbers.
    pub device: String,
    /// Which number of a sample, from 0.
    pub index: usize,
    /// The numbers at which the actuator may move.
    pub runs: Bound,
    /// Without a sample for this long the input is lost.
    pub silence: Duration,
}

/// One side of a number.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Bound {
    /// Above this.
    Above(f64),
    /// Below this.
    Below(f64),
}

impl Bound {
    /// Is `value` on this side? One that is no number is not.
    #[must_use]
    pub fn holds(self, value: f64) -> bool {
        match self {
            Self::Above(bound) => value > bound,
            Self::Below(bound) => value < bound,
        }
    }
}

impl fmt::Display for InterlockInput {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Key(key) => {
                let state = if key.runs_while_pressed { "pressed" } else { "not pressed" };
                write!(f, "{} of {}, runs while {state}", key.code, key.device)
            }
            Self::Gpio(gpio) => {
                let level = if gpio.runs_while_high { "high" } else { "low" };
                write!(f, "line {} of {}, runs while {level}", gpio.line, gpio.chip.display())
            }
            Self::Serial(line) => {
                let (path, run) = (line.path.display(), &line.run);
                write!(f, "{path} at {} baud, runs with {run:?}, lost after {:?} without it", line.baud, line.silence)
            }
            Self::Field(field) => {
                let (device, index) = (&field.device, field.index);
                let (side, bound) = match field.runs {
                    Bound::Above(bound) => ("above", bound),
                    Bound::Below(bound) => ("below", bound),
                };
                write!(f, "number {index} of {device}, runs {side} {bound}, lost after {:?} without it", field.silence)
            }
        }
    }
}
