//! Inputs with two levels, and what has one: emergency stops, enabling switches, buttons.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use rapid_core::interlock::StopKind;
use serde::Serialize;

use super::Registry;

/// Buttons of a rig, at most.
pub const MAX_BUTTONS: usize = 32;

/// One `[stop.NAME]` table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InterlockSpec {
    /// Its name: `[a-z][a-z0-9_]*`, at most 64 bytes.
    pub name: String,
    /// What it stops.
    pub kind: StopKind,
    /// Names of the entries that it stops, each an actuator; empty if the rig has none.
    pub actuators: Vec<String>,
    /// What it is read from: the actuator may move while it is on.
    pub input: InputSpec,
}

/// One `[button.NAME]` table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ButtonSpec {
    /// Its name: `[a-z][a-z0-9_]*`, at most 64 bytes.
    pub name: String,
    /// What it is read from: it is pressed while that is on.
    pub input: InputSpec,
    /// What a press does.
    pub press: Option<ButtonAction>,
    /// What a press of at least [`Self::hold_after`] does instead.
    pub hold: Option<ButtonAction>,
    /// Default 1 s.
    pub hold_after: Duration,
    /// What two presses in a row do instead.
    pub double: Option<ButtonAction>,
}

/// What a button does. There is none that arms the actuator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ButtonAction {
    /// Begin an episode, or end the one in progress.
    Toggle,
    /// Begin an episode.
    Start,
    /// End the episode in progress.
    Stop,
    /// End the episode in progress and begin the next.
    Next,
    /// Discard the episode and record it again.
    Redo,
    /// Discard the episode.
    Discard,
    /// Take back the episode discarded last.
    Undo,
    /// Mark this moment.
    Mark,
    /// Label the episode a success.
    Success,
    /// Label the episode a failure.
    Failure,
    /// Disarm the actuator.
    Disarm,
}

impl ButtonAction {
    /// The words for them in the registry.
    pub const WORDS: [(&str, Self); 11] = [
        ("toggle", Self::Toggle),
        ("start", Self::Start),
        ("stop", Self::Stop),
        ("next", Self::Next),
        ("redo", Self::Redo),
        ("discard", Self::Discard),
        ("undo", Self::Undo),
        ("mark", Self::Mark),
        ("success", Self::Success),
        ("failure", Self::Failure),
        ("disarm", Self::Disarm),
    ];
}

impl fmt::Display for ButtonAction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(Self::WORDS.iter().find(|(_, action)| action == self).map_or("", |(word, _)| word))
    }
}

/// What is read.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum InputSpec {
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
    /// The device: an absolute path, or the name that it reports.
    pub device: String,
    /// The key's name in `linux/input-event-codes.h`.
    pub code: String,
    /// The key's number there.
    pub number: u16,
    /// It is on while the key is pressed; otherwise while it is not.
    pub on_while_pressed: bool,
    /// No other program gets what the device sends.
    pub grab: bool,
}

/// `gpio = { ... }`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct GpioInput {
    /// The chip, for example `/dev/gpiochip0`.
    pub chip: PathBuf,
    /// Its line.
    pub line: u32,
    /// It is on while the line is high; otherwise while it is low. The line is biased to the other level, so that it is
    /// off with a broken wire.
    pub on_while_high: bool,
}

/// `serial = { ... }`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LineInput {
    /// The port, absolute.
    pub path: PathBuf,
    /// Bits a second, default 115200.
    pub baud: u32,
    /// The line that means that it is on.
    pub on: String,
    /// What means that it is off.
    pub off: LineOff,
    /// The lines are sent repeatedly: without one of the two for this long the input is lost. `None`: they are sent at
    /// changes only.
    pub silence: Option<Duration>,
}

/// What means that an input of lines is off.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LineOff {
    /// Every other line.
    Others,
    /// This line; lines other than the two are ignored.
    Line(String),
    /// Nothing: the line is a whole press.
    AtOnce,
}

/// `field = { ... }`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FieldInput {
    /// The entry, whose samples are numbers.
    pub device: String,
    /// Which number of a sample, from 0.
    pub index: usize,
    /// The numbers at which it is on.
    pub on: Bound,
    /// The numbers at which it is off; between the two it stays as it was. `None`: all others.
    pub off: Option<Bound>,
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
    /// Whether `value` is on this side. NaN is not.
    pub fn holds(self, value: f64) -> bool {
        match self {
            Self::Above(bound) => value > bound,
            Self::Below(bound) => value < bound,
        }
    }
}

impl fmt::Display for Bound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Above(bound) => write!(f, "above {bound}"),
            Self::Below(bound) => write!(f, "below {bound}"),
        }
    }
}

impl Registry {
    /// Everything that is an input, each with what it is: `stop pendant`, `button pedal`.
    pub fn inputs(&self) -> impl Iterator<Item = (String, &InputSpec)> {
        let stops = self.stops.iter().map(|stop| (format!("stop {}", stop.name), &stop.input));
        stops.chain(self.buttons.iter().map(|button| (format!("button {}", button.name), &button.input)))
    }
}

impl InputSpec {
    /// What it is read from, for people. `on` and `off` are the words for its levels: `runs`, `stops`.
    pub fn text(&self, on: &str, off: &str) -> String {
        let lost = |silence| format!(", lost after {silence:?} without it");
        match self {
            Self::Key(key) => {
                let state = if key.on_while_pressed { "pressed" } else { "not pressed" };
                // A button is pressed while its key is.
                let when = if state == on { String::new() } else { format!(", {on} while {state}") };
                let grab = if key.grab { ", which no other program gets" } else { "" };
                format!("{} of {}{grab}{when}", key.code, key.device)
            }
            Self::Gpio(gpio) => {
                let level = if gpio.on_while_high { "high" } else { "low" };
                format!("line {} of {}, {on} while {level}", gpio.line, gpio.chip.display())
            }
            Self::Serial(line) => {
                let other = match &line.off {
                    LineOff::Line(text) if line.silence.is_none() => format!(", {off} with {text:?}"),
                    LineOff::Line(_) | LineOff::Others | LineOff::AtOnce => String::new(),
                };
                let lost = line.silence.map(lost).unwrap_or_default();
                format!("{} at {} baud, {on} with {:?}{other}{lost}", line.path.display(), line.baud, line.on)
            }
            Self::Field(field) => {
                let other = field.off.map(|bound| format!(", {off} {bound}")).unwrap_or_default();
                let (device, index, lost) = (&field.device, field.index, lost(field.silence));
                format!("number {index} of {device}, {on} {}{other}{lost}", field.on)
            }
        }
    }
}
