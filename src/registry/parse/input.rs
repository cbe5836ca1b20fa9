//! Tables of inputs with two levels, as far as stops and buttons have them in common.

use std::path::PathBuf;
use std::str::FromStr as _;

use super::device::Draft;
use super::names;
use crate::diagnostic::did_you_mean;
use crate::section::Section;
use crate::spec::{Bound, InputSpec};

/// The keys of which each stop and button has one.
pub(super) const INPUTS: [&str; 4] = ["key", "gpio", "serial", "field"];
/// Levels of a line of a GPIO chip.
pub(super) const LEVELS: [(&str, bool); 2] = [("high", true), ("low", false)];
/// Longest line that is searched for on a serial port, bytes.
const LONGEST_LINE: usize = 64;

/// The key of the one input in `section`, which is `what`, and its table; `separate` is what several tables do.
pub(super) fn only<'a>(section: &Section<'a>, what: &str, separate: &str) -> Option<(&'static str, Section<'a>)> {
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
pub(super) fn are_one(one: &InputSpec, other: &InputSpec) -> bool {
    match (one, other) {
        (InputSpec::Key(one), InputSpec::Key(other)) => (&one.device, one.number) == (&other.device, other.number),
        (InputSpec::Gpio(one), InputSpec::Gpio(other)) => (&one.chip, one.line) == (&other.chip, other.line),
        (InputSpec::Serial(one), InputSpec::Serial(other)) => one.path == other.path,
        // Several numbers of a device may be inputs, and one number within a range.
        _ => false,
    }
}

/// Reads `device` and `code`, with the number of the code.
pub(super) fn key(table: &Section<'_>) -> (Option<String>, Option<(String, u16)>) {
    let device = "write device = \"/dev/input/by-id/...\", or the name that `evtest` shows";
    table.need("device", device);
    table.need("code", "write code = \"KEY_...\" or \"BTN_...\", as `evtest` shows it");
    let path = match table.text("device") {
        Some(text) if text.trim().is_empty() => table.refuse("device", "device is empty", device),
        text => text,
    };
    let code = table.text("code").and_then(|code| {
        let fix = "write a name of linux/input-event-codes.h, as `evtest` shows it, for example \"KEY_B\"";
        let number = evdev::KeyCode::from_str(code).ok().map(evdev::KeyCode::code);
        let number = number.or_else(|| table.refuse("code", format!("there is no key {code:?}"), fix));
        Some((code.to_owned(), number?))
    });
    (path.map(str::to_owned), code)
}

/// Reads `chip` and `line`; the level is a third key.
pub(super) fn gpio_line(table: &Section<'_>) -> (Option<PathBuf>, Option<u32>) {
    table.need("chip", "write chip = \"/dev/gpiochip0\"; `gpiodetect` lists them");
    table.need("line", "write line = its number on the chip; `gpioinfo` lists them");
    let chip = absolute(table, "chip");
    (chip, table.integer("line", 0..=65_535))
}

/// Reads `path` and `baud` of a serial port.
pub(super) fn port(table: &Section<'_>) -> (Option<PathBuf>, Option<u32>) {
    table.need("path", "write path = \"/dev/serial/by-id/...\"");
    let path = absolute(table, "path");
    let baud = if table.has("baud") { table.integer("baud", 300..=4_000_000) } else { Some(115_200) };
    (path, baud)
}

/// Reads a line of text.
pub(super) fn line(table: &Section<'_>, key: &str) -> Option<String> {
    let text = table.text(key)?;
    let is_line = (1..=LONGEST_LINE).contains(&text.len()) && !text.chars().any(char::is_control);
    if !is_line || text.trim() != text {
        let fix = format!("write 1 to {LONGEST_LINE} characters without a line end, and no space around them");
        return table.refuse(key, format!("{key} = {text:?} is not a line"), fix);
    }
    Some(text.to_owned())
}

/// Reads `device` and `index` of a number in the samples of an entry.
pub(super) fn number(table: &Section<'_>, drafts: &[Draft<'_>]) -> (Option<String>, Option<usize>) {
    table.need("device", "write device = the entry whose samples hold the number");
    table.need("index", "write index = which number of a sample, from 0");
    let index = table.integer("index", 0..=1023);
    let device = table.text("device");
    if let Some(name) = device {
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
                    let message = format!("index = {index}, and a sample of [device.{name}] has {count} numbers");
                    table.report("index", message, format!("write index = 0 to {}", count - 1));
                }
                // The content of its samples is unknown, which has been reported.
                _ => {}
            },
        }
    }
    (device.map(str::to_owned), index)
}

/// Reads one of the keys `above` and `below`; `both` is the fix for both of them, `none` for neither.
pub(super) fn bound(table: &Section<'_>, above: &str, below: &str, both: &str, none: &str) -> Option<Bound> {
    let range = || f64::MIN..=f64::MAX;
    match (table.has(above), table.has(below)) {
        (true, false) => table.number(above, range()).map(Bound::Above),
        (false, true) => table.number(below, range()).map(Bound::Below),
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
