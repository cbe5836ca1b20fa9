//! `[stop.NAME]`.

use std::path::PathBuf;
use std::str::FromStr as _;
use std::time::Duration;

use super::device::Draft;
use super::name::name_problem;
use crate::interlock::{MAX_STOPS, StopKind};
use crate::registry::diagnostic::{Diagnostic, did_you_mean};
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{Bound, FieldInput, GpioInput, InterlockInput, InterlockSpec, KeyInput, LineInput};

const KEYS: [&str; 6] = ["kind", "actuators", "key", "gpio", "serial", "field"];
const INPUTS: [&str; 4] = ["key", "gpio", "serial", "field"];
const KINDS: [(&str, StopKind); 2] = [("emergency", StopKind::Emergency), ("enabling", StopKind::Enabling)];
/// Levels of a line of a GPIO chip.
pub(super) const LEVELS: [(&str, bool); 2] = [("high", true), ("low", false)];
/// Longest line that is looked for on a serial port, bytes.
const LONGEST_LINE: usize = 64;
/// A stop that is silent for this long is lost, unless it says otherwise.
const SILENCE: Duration = Duration::from_millis(200);

/// Reads the stops, in the order of the file.
pub(super) fn interlocks(
    root: &Section<'_>,
    drafts: &[Draft<'_>],
    problems: &mut Problems<'_>,
    warnings: &mut Vec<Diagnostic>,
) -> Vec<InterlockSpec> {
    let Some(tables) = root.table(problems, "stop") else { return Vec::new() };
    let mut stops = Vec::new();
    for (index, (at, name, _)) in tables.fields().into_iter().enumerate() {
        if index == MAX_STOPS {
            problems.report(at, &tables.child(name), format!("more than {MAX_STOPS} stops"), "remove some of them");
            break;
        }
        let Some(section) = tables.table(problems, name) else { continue };
        if let Some((_, fix)) = name_problem(name) {
            let fix = fix.replace("[device.", "[stop.");
            problems.report(section.at, &section.entry, format!("{name:?} cannot be a stop's name"), fix);
        }
        section.allow(problems, &KEYS);
        if !section.has("kind") {
            section.missing(problems, "kind", "write kind = \"emergency\", or \"enabling\" for a switch that is held");
        }
        let kind = section.choice(problems, "kind", &KINDS);
        let actuators = actuators(&section, drafts, problems, warnings);
        let input = input(&section, kind.unwrap_or(StopKind::Emergency), drafts, problems);
        if let (Some(kind), Some(input)) = (kind, input) {
            let earlier = stops.iter().find(|earlier: &&InterlockSpec| are_one(&earlier.input, &input));
            if let Some(earlier) = earlier {
                let message = format!("[stop.{}] reads the same input", earlier.name);
                problems.report(section.at, &section.entry, message, "remove one of them, or name another input");
            }
            stops.push(InterlockSpec { name: name.to_owned(), kind, actuators, input });
        }
    }
    stops
}

/// Are they one input, which only one can read?
fn are_one(one: &InterlockInput, other: &InterlockInput) -> bool {
    match (one, other) {
        (InterlockInput::Key(one), InterlockInput::Key(other)) => {
            (&one.device, one.number) == (&other.device, other.number)
        }
        (InterlockInput::Gpio(one), InterlockInput::Gpio(other)) => (&one.chip, one.line) == (&other.chip, other.line),
        (InterlockInput::Serial(one), InterlockInput::Serial(other)) => one.path == other.path,
        // Several numbers of a device may stop, and one number within a range.
        _ => false,
    }
}

/// The actuators that it stops: all by default.
fn actuators(
    section: &Section<'_>,
    drafts: &[Draft<'_>],
    problems: &mut Problems<'_>,
    warnings: &mut Vec<Diagnostic>,
) -> Vec<String> {
    let known: Vec<&Draft<'_>> = drafts.iter().filter(|draft| draft.action.is_some()).collect();
    let all = || known.iter().map(|draft| draft.name.clone()).collect();
    let names: Vec<String> = if section.has("actuators") {
        let Some(names) = section.texts(problems, "actuators") else { return Vec::new() };
        if names.is_empty() {
            let fix = "name an actuator, or remove the line: then it stops all";
            section.report(problems, "actuators", "actuators is empty: nothing would stop".to_owned(), fix);
        }
        names
    } else {
        all()
    };
    for name in &names {
        if !known.iter().any(|draft| draft.name == *name) {
            let message = if drafts.iter().any(|draft| draft.name == *name) {
                format!("[device.{name}] is no actuator")
            } else {
                format!("there is no [device.{name}]")
            };
            let known: Vec<&str> = known.iter().map(|draft| draft.name.as_str()).collect();
            let fix = if known.is_empty() {
                "register an actuator: motors behind a CAN adapter".to_owned()
            } else {
                did_you_mean(name, &known, "actuators are")
            };
            section.report(problems, "actuators", message, fix);
        }
    }
    if known.is_empty() && names.is_empty() && !section.has("actuators") {
        let message = "the rig has no actuator: it is shown and recorded, and stops nothing".to_owned();
        let fix = "register the motors, or remove the table".to_owned();
        warnings.push(problems.diagnostic(section.at, &section.entry, message, fix));
    }
    for draft in known.iter().filter(|draft| names.contains(&draft.name) && draft.is_moved_by_a_program()) {
        let message =
            format!("[device.{}] is moved by a program, which takes no orders: it is not stopped", draft.name);
        let fix = "let the program subscribe to the event, or stop its device by other means".to_owned();
        warnings.push(problems.diagnostic(section.at, &section.entry, message, fix));
    }
    names
}

fn input(
    section: &Section<'_>,
    kind: StopKind,
    drafts: &[Draft<'_>],
    problems: &mut Problems<'_>,
) -> Option<InterlockInput> {
    let written: Vec<&str> = INPUTS.into_iter().filter(|input| section.has(input)).collect();
    let [input] = written.as_slice() else {
        if let [_, second, ..] = written.as_slice() {
            let message = format!("{} and {second}: a stop has one input", written.first().unwrap_or(&""));
            section.report(problems, second, message, "write a table of its own for each input: each of them stops");
        } else {
            let fix = "write key = { ... }, gpio = { ... }, serial = { ... } or field = { ... }";
            problems.report(section.at, &section.entry, "it has no input", fix);
        }
        return None;
    };
    let table = section.table(problems, input)?;
    match *input {
        "key" => key(&table, kind, problems).map(InterlockInput::Key),
        "gpio" => gpio(&table, problems).map(InterlockInput::Gpio),
        "serial" => line(&table, problems).map(InterlockInput::Serial),
        _ => field(&table, drafts, problems).map(InterlockInput::Field),
    }
}

fn need(table: &Section<'_>, keys: &[(&str, &str)], problems: &mut Problems<'_>) {
    for (key, fix) in keys.iter().filter(|(key, _)| !table.has(key)) {
        table.missing(problems, key, fix);
    }
}

fn key(table: &Section<'_>, kind: StopKind, problems: &mut Problems<'_>) -> Option<KeyInput> {
    table.allow(problems, &["device", "code", "runs_while"]);
    let device = "write device = \"/dev/input/by-id/...\", or the name that `evtest` shows";
    need(
        table,
        &[("device", device), ("code", "write code = \"KEY_...\" or \"BTN_...\", as `evtest` shows it")],
        problems,
    );
    let device = table.text(problems, "device").filter(|text| {
        let is_empty = text.value.trim().is_empty();
        if is_empty {
            table.report(problems, "device", "device is empty".to_owned(), device);
        }
        !is_empty
    });
    let code = table.text(problems, "code").map(|code| code.value);
    let number = code.and_then(|code| {
        let number = evdev::KeyCode::from_str(code).ok().map(evdev::KeyCode::code);
        if number.is_none() {
            let fix = "write a name of linux/input-event-codes.h, as `evtest` shows it, for example \"KEY_B\"";
            table.report(problems, "code", format!("there is no key {code:?}"), fix);
        }
        number
    });
    let runs = if table.has("runs_while") {
        table.choice(problems, "runs_while", &[("pressed", true), ("released", false)])
    } else {
        Some(kind == StopKind::Enabling)
    };
    Some(KeyInput {
        device: device?.value.to_owned(),
        code: code?.to_owned(),
        number: number?,
        runs_while_pressed: runs?,
    })
}

fn gpio(table: &Section<'_>, problems: &mut Problems<'_>) -> Option<GpioInput> {
    table.allow(problems, &["chip", "line", "runs_while"]);
    let runs = "write runs_while = \"high\" or \"low\": the level of a closed contact, so that a broken wire stops";
    let (chip, line) = gpio_line(table, problems);
    need(table, &[("runs_while", runs)], problems);
    let runs = table.choice(problems, "runs_while", &LEVELS);
    Some(GpioInput { chip: chip?, line: line?, runs_while_high: runs? })
}

/// Reads `chip` and `line`, the level of which is a third key.
pub(super) fn gpio_line(table: &Section<'_>, problems: &mut Problems<'_>) -> (Option<PathBuf>, Option<u32>) {
    let keys = [
        ("chip", "write chip = \"/dev/gpiochip0\"; `gpiodetect` lists them"),
        ("line", "write line = its number on the chip; `gpioinfo` lists them"),
    ];
    need(table, &keys, problems);
    let chip = absolute(table, "chip", problems);
    (chip, table.integer(problems, "line", 0..=65_535).and_then(|line| u32::try_from(line.value).ok()))
}

fn line(table: &Section<'_>, problems: &mut Problems<'_>) -> Option<LineInput> {
    table.allow(problems, &["path", "baud", "run", "stop", "silence"]);
    let keys = [
        ("path", "write path = \"/dev/serial/by-id/...\""),
        ("run", "write run = the line that is sent, again and again, while the actuator may move"),
    ];
    need(table, &keys, problems);
    let path = absolute(table, "path", problems);
    let baud = if table.has("baud") {
        table.integer(problems, "baud", 300..=4_000_000).and_then(|baud| u32::try_from(baud.value).ok())
    } else {
        Some(115_200)
    };
    let mut words = ["run", "stop"].map(|key| {
        let text = table.text(problems, key)?.value;
        let is_line = (1..=LONGEST_LINE).contains(&text.len()) && !text.chars().any(char::is_control);
        if !is_line || text.trim() != text {
            let fix = format!("write 1 to {LONGEST_LINE} characters without a line end, and no space around them");
            table.report(problems, key, format!("{key} = {text:?} is no line"), fix);
            return None;
        }
        Some(text.to_owned())
    });
    if words[0].is_some() && words[0] == words[1] {
        table.report(problems, "stop", "stop is the same line as run".to_owned(), "write another, or remove it");
    }
    let silence = silence(table, problems);
    let (run, stop) = (words[0].take(), words[1].take());
    if stop.is_none() && table.has("stop") {
        return None;
    }
    Some(LineInput { path: path?, baud: baud?, run: run?, stop, silence })
}

fn field(table: &Section<'_>, drafts: &[Draft<'_>], problems: &mut Problems<'_>) -> Option<FieldInput> {
    table.allow(problems, &["device", "index", "runs_above", "runs_below", "silence"]);
    let keys = [
        ("device", "write device = the entry whose samples hold the number"),
        ("index", "write index = which number of a sample, from 0"),
    ];
    need(table, &keys, problems);
    let index = table.integer(problems, "index", 0..=1023).and_then(|index| usize::try_from(index.value).ok());
    let device = table.text(problems, "device").map(|device| device.value);
    if let Some(name) = device {
        match drafts.iter().find(|draft| draft.name == name) {
            None => {
                let known: Vec<&str> = drafts.iter().map(|draft| draft.name.as_str()).collect();
                let fix = did_you_mean(name, &known, "entries are");
                table.report(problems, "device", format!("there is no [device.{name}]"), fix);
            }
            Some(draft) => match (draft.numbers(), index) {
                (Some(0), _) => {
                    let message = format!("samples of [device.{name}] are no numbers");
                    table.report(
                        problems,
                        "device",
                        message,
                        "name an entry whose samples are: serial, motors, a program",
                    );
                }
                (Some(count), Some(index)) if index >= count => {
                    let message = format!("index = {index}, and a sample of [device.{name}] has {count} numbers");
                    table.report(problems, "index", message, format!("write index = 0 to {}", count - 1));
                }
                // What it sends is unknown, which has been reported.
                _ => {}
            },
        }
    }
    let range = || f64::MIN..=f64::MAX;
    let runs = match (table.has("runs_above"), table.has("runs_below")) {
        (true, false) => table.number(problems, "runs_above", range()).map(Bound::Above),
        (false, true) => table.number(problems, "runs_below", range()).map(Bound::Below),
        (true, true) => {
            let fix = "remove one; for a range write two stops";
            table.report(problems, "runs_below", "runs_above and runs_below".to_owned(), fix);
            None
        }
        (false, false) => {
            table.missing(
                problems,
                "runs_above",
                "write runs_above = 0.5, or runs_below, for what lets the actuator move",
            );
            None
        }
    };
    let silence = silence(table, problems);
    Some(FieldInput { device: device?.to_owned(), index: index?, runs: runs?, silence })
}

fn silence(table: &Section<'_>, problems: &mut Problems<'_>) -> Duration {
    table.duration(problems, "silence", Duration::from_millis(10)..=Duration::from_secs(5)).unwrap_or(SILENCE)
}

fn absolute(table: &Section<'_>, key: &str, problems: &mut Problems<'_>) -> Option<PathBuf> {
    let text = table.text(problems, key)?.value;
    if text.starts_with('/') && !text.chars().any(char::is_control) {
        return Some(PathBuf::from(text));
    }
    table.report(problems, key, format!("{key} = {text:?} is no absolute path"), "write the whole path, from /dev/");
    None
}
