//! Tables of inputs with two levels, as far as stops and buttons have them in common.

use std::path::PathBuf;
use std::str::FromStr as _;
use std::time::Duration;

use super::device::Draft;
use super::names;
use crate::diagnostic::did_you_mean;
use crate::keys::{About, Key, Own, TEXT, Time, keys, table, text, whole};
use crate::section::Section;
use crate::spec::{Bound, InputSpec};

/// The keys of which each stop and button has one.
pub(crate) const INPUTS: [&str; 4] = ["key", "gpio", "serial", "field"];
/// Levels of a line of a GPIO chip.
pub(crate) const LEVELS: [(&str, bool); 2] = [("high", true), ("low", false)];
/// A number of a sample that is missing for this long, or a line, by default.
pub(crate) const SILENCE: Time = Time(Duration::from_millis(10), Duration::from_secs(5));
pub(crate) const LINE: Own<String> = text(line, "1 to 64 characters");
const ABSOLUTE: Own<PathBuf> = text(absolute, "an absolute path");
const DEVICE: Own<String> = text(device, "a path, or the name that `evtest` shows");
const CODE: Own<(String, u16)> = text(code, "a name of linux/input-event-codes.h, as `\"KEY_B\"`");

keys! {
    /// `key = { ... }`.
    pub(crate) struct KeyKeys {
        /// The input device.
        device: Option<String> = DEVICE, need NO_DEVICE;
        /// The key.
        code: Option<(String, u16)> = CODE, need "write code = \"KEY_...\" or \"BTN_...\", as `evtest` shows it";
    }

    /// `gpio = { ... }`.
    pub(crate) struct GpioKeys {
        /// The chip.
        chip: Option<PathBuf> = ABSOLUTE, need "write chip = \"/dev/gpiochip0\"; `gpiodetect` lists them";
        /// The number of its line.
        line: Option<u32> = whole::<u32>(0, 65_535), need "write line = its number on the chip; `gpioinfo` lists them";
    }

    /// `serial = { ... }`.
    pub(crate) struct PortKeys {
        /// The port.
        path: Option<PathBuf> = ABSOLUTE, need "write path = \"/dev/serial/by-id/...\"";
        /// Bits a second.
        baud: u32 = whole::<u32>(300, 4_000_000), or 115_200;
    }

    /// `field = { ... }`.
    pub(crate) struct NumberKeys {
        /// The entry whose samples hold the number.
        device: Option<String> = TEXT, need "write device = the entry whose samples hold the number";
        /// Which number of a sample, from 0.
        index: Option<usize> = whole::<usize>(0, 1023), need "write index = which number of a sample, from 0";
    }
}

/// The tables of inputs, of which each stop and button has one, with their keys.
pub(crate) const fn inputs([key, gpio, serial, field]: [fn() -> About; 4]) -> [Key; 4] {
    [
        table("key", "A key of an input device.", key),
        table("gpio", "A line of a GPIO chip.", gpio),
        table("serial", "Lines of text on a serial port.", serial),
        table("field", "A number in the samples of a device.", field),
    ]
}

const NO_DEVICE: &str = "write device = \"/dev/input/by-id/...\", or the name that `evtest` shows";
/// Longest line that is searched for on a serial port, bytes.
const LONGEST_LINE: usize = 64;

/// The key of the one input in `section`, which is `what`, and its table; `separate` is what several tables do.
pub(crate) fn only<'a>(section: &Section<'a>, what: &str, separate: &str) -> Option<(&'static str, Section<'a>)> {
    let written: Vec<&'static str> = INPUTS.into_iter().filter(|input| section.has(input)).collect();
    let [input] = written.as_slice() else {
        if let [_, second, ..] = written.as_slice() {
            let message = format!("{} and {second}: {what} has one input", written.first().unwrap_or(&""));
            section.report(second, message, format!("write a separate table for each input: {separate}"));
        } else {
            let fix = "write key = { ... }, gpio = { ... }, serial = { ... } or field = { ... }";
            section.report_at(section.at, "it has no input", fix);
        }
        return None;
    };
    Some((input, section.table(input)?))
}

/// Whether they are the same input, which only one can read.
pub(crate) fn are_one(one: &InputSpec, other: &InputSpec) -> bool {
    match (one, other) {
        (InputSpec::Key(one), InputSpec::Key(other)) => (&one.device, one.number) == (&other.device, other.number),
        (InputSpec::Gpio(one), InputSpec::Gpio(other)) => (&one.chip, one.line) == (&other.chip, other.line),
        (InputSpec::Serial(one), InputSpec::Serial(other)) => one.path == other.path,
        // Several numbers of a device may be inputs, and one number within a range.
        _ => false,
    }
}

fn device(table: &Section<'_>, key: &str) -> Option<String> {
    match table.text(key)? {
        text if text.trim().is_empty() => table.refuse(key, "device is empty", NO_DEVICE),
        text => Some(text.to_owned()),
    }
}

/// A code with its number.
fn code(table: &Section<'_>, key: &str) -> Option<(String, u16)> {
    let code = table.text(key)?;
    let fix = "write a name of linux/input-event-codes.h, as `evtest` shows it, for example \"KEY_B\"";
    let number = evdev::KeyCode::from_str(code).ok().map(evdev::KeyCode::code);
    let number = number.or_else(|| table.refuse(key, format!("there is no key {code:?}"), fix));
    Some((code.to_owned(), number?))
}

fn line(table: &Section<'_>, key: &str) -> Option<String> {
    let text = table.text(key)?;
    let is_line = (1..=LONGEST_LINE).contains(&text.len()) && !text.chars().any(char::is_control);
    if !is_line || text.trim() != text {
        let fix = format!("write 1 to {LONGEST_LINE} characters without a line end, and no space around them");
        return table.refuse(key, format!("{key} = {text:?} is not a line"), fix);
    }
    Some(text.to_owned())
}

/// Reads `device` and `index` of a number in the samples of an entry.
pub(crate) fn number(table: &Section<'_>, drafts: &[Draft<'_>]) -> NumberKeys {
    let keys = NumberKeys::values(table);
    let index = keys.index;
    if let Some(name) = keys.device.as_deref() {
        match drafts.iter().find(|draft| draft.name == name) {
            None => {
                let fix = did_you_mean(name, names(drafts), "entries are");
                table.report("device", format!("there is no [device.{name}]"), fix);
            }
            Some(draft) => match (draft.numbers(), index) {
                (Some(0), _) => {
                    let message = format!("samples of [device.{name}] are not numbers");
                    table.report("device", message, "name an entry whose samples are: serial, motors, a program");
                }
                (Some(count), Some(index)) if index >= count => {
                    let message = format!("index = {index}, and a sample of [device.{name}] has {count} values");
                    table.report("index", message, format!("write index = 0 to {}", count - 1));
                }
                // The content of its samples is unknown, which has been reported.
                _ => {}
            },
        }
    }
    keys
}

/// The one of two keys that is there, each with its value; `both` is the fix for both of them, `none` for neither.
pub(crate) fn bound(
    table: &Section<'_>,
    (above, over): (&str, Option<f64>),
    (below, under): (&str, Option<f64>),
    both: &str,
    none: &str,
) -> Option<Bound> {
    match (table.has(above), table.has(below)) {
        (true, false) => over.map(Bound::Above),
        (false, true) => under.map(Bound::Below),
        (true, true) => table.refuse(below, format!("{above} and {below}"), both),
        (false, false) => {
            table.missing(above, none);
            None
        }
    }
}

fn absolute(table: &Section<'_>, key: &str) -> Option<PathBuf> {
    let text = table.text(key)?;
    if text.starts_with('/') && !text.chars().any(char::is_control) {
        return Some(PathBuf::from(text));
    }
    table.refuse(key, format!("{key} = {text:?} is not an absolute path"), "write the whole path, from /dev/")
}
