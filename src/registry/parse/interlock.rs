//! `[stop.NAME]` and `[module.NAME]`.

use std::path::PathBuf;
use std::str::FromStr as _;
use std::time::Duration;

use super::device::{Draft, Kind};
use super::identity::name_problem;
use super::names;
use crate::interlock::{MAX_STOPS, StopKind};
use crate::registry::diagnostic::did_you_mean;
use crate::registry::section::Section;
use crate::registry::spec::{
    Bound, FieldInput, GpioInput, InterlockInput, InterlockSpec, KeyInput, LineInput, ModuleSpec, Mount,
};

const KEYS: [&str; 6] = ["kind", "actuators", "key", "gpio", "serial", "field"];
const INPUTS: [&str; 4] = ["key", "gpio", "serial", "field"];
const KINDS: [(&str, StopKind); 2] = [("emergency", StopKind::Emergency), ("enabling", StopKind::Enabling)];
/// Levels of a line of a GPIO chip.
pub(super) const LEVELS: [(&str, bool); 2] = [("high", true), ("low", false)];
/// Longest line that is searched for on a serial port, bytes.
const LONGEST_LINE: usize = 64;
/// A stop that is silent for this long is lost, unless its entry states otherwise.
const SILENCE: Duration = Duration::from_millis(200);

/// Reads the stops, in the order of the file.
pub(super) fn interlocks(root: &Section<'_>, drafts: &[Draft<'_>]) -> Vec<InterlockSpec> {
    let Some(tables) = root.table("stop") else { return Vec::new() };
    let mut stops = Vec::new();
    for (index, (at, name, _)) in tables.fields().into_iter().enumerate() {
        if index == MAX_STOPS {
            tables.report_child(at, name, format!("more than {MAX_STOPS} stops"), "remove some of them");
            break;
        }
        let Some(section) = tables.table(name) else { continue };
        if let Some((_, fix)) = name_problem(name) {
            let fix = fix.replace("[device.", "[stop.");
            section.report_at(section.at, format!("{name:?} cannot be a stop's name"), fix);
        }
        section.allow(&KEYS);
        section.need("kind", "write kind = \"emergency\", or \"enabling\" for a switch that is held");
        let kind = section.choice("kind", &KINDS);
        let actuators = actuators(&section, drafts);
        let input = input(&section, kind.unwrap_or(StopKind::Emergency), drafts);
        if let (Some(kind), Some(input)) = (kind, input) {
            let earlier = stops.iter().find(|earlier: &&InterlockSpec| are_one(&earlier.input, &input));
            if let Some(earlier) = earlier {
                let message = format!("[stop.{}] reads the same input", earlier.name);
                section.report_at(section.at, message, "remove one of them, or name another input");
            }
            stops.push(InterlockSpec { name: name.to_owned(), kind, actuators, input });
        }
    }
    stops
}

/// Whether they are the same input, which only one can read.
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
fn actuators(section: &Section<'_>, drafts: &[Draft<'_>]) -> Vec<String> {
    let known: Vec<&Draft<'_>> = drafts.iter().filter(|draft| draft.action.is_some()).collect();
    let names: Vec<String> = if section.has("actuators") {
        let Some(names) = section.texts("actuators") else { return Vec::new() };
        if names.is_empty() {
            let fix = "name an actuator, or remove the line: then it stops all";
            section.report("actuators", "actuators is empty: nothing would stop".to_owned(), fix);
        }
        names
    } else {
        known.iter().map(|draft| draft.name.clone()).collect()
    };
    for name in &names {
        if !known.iter().any(|draft| draft.name == *name) {
            let message = if drafts.iter().any(|draft| draft.name == *name) {
                format!("[device.{name}] is not an actuator")
            } else {
                format!("there is no [device.{name}]")
            };
            let fix = if known.is_empty() {
                "register an actuator: motors behind a CAN adapter".to_owned()
            } else {
                did_you_mean(name, known.iter().map(|draft| &draft.name), "actuators are")
            };
            section.report("actuators", message, fix);
        }
    }
    if known.is_empty() && names.is_empty() && !section.has("actuators") {
        let message = "the rig has no actuator: it is shown and recorded, and stops nothing";
        section.warn_at(section.at, message, "register the motors, or remove the table");
    }
    for draft in known.iter().filter(|draft| names.contains(&draft.name) && draft.kind == Some(Kind::Process)) {
        let message =
            format!("[device.{}] is moved by a program, which takes no orders: it is not stopped", draft.name);
        let fix = "let the program subscribe to the event, or stop its device by other means";
        section.warn_at(section.at, message, fix);
    }
    names
}

fn input(section: &Section<'_>, kind: StopKind, drafts: &[Draft<'_>]) -> Option<InterlockInput> {
    let written: Vec<&str> = INPUTS.into_iter().filter(|input| section.has(input)).collect();
    let [input] = written.as_slice() else {
        if let [_, second, ..] = written.as_slice() {
            let message = format!("{} and {second}: a stop has one input", written.first().unwrap_or(&""));
            section.report(second, message, "write a separate table for each input: each of them stops");
        } else {
            let fix = "write key = { ... }, gpio = { ... }, serial = { ... } or field = { ... }";
            section.report_at(section.at, "it has no input", fix);
        }
        return None;
    };
    let table = section.table(input)?;
    match *input {
        "key" => key(&table, kind).map(InterlockInput::Key),
        "gpio" => gpio(&table).map(InterlockInput::Gpio),
        "serial" => line(&table).map(InterlockInput::Serial),
        _ => field(&table, drafts).map(InterlockInput::Field),
    }
}

fn key(table: &Section<'_>, kind: StopKind) -> Option<KeyInput> {
    table.allow(&["device", "code", "runs_while"]);
    let device = "write device = \"/dev/input/by-id/...\", or the name that `evtest` shows";
    table.need("device", device);
    table.need("code", "write code = \"KEY_...\" or \"BTN_...\", as `evtest` shows it");
    let device = match table.text("device") {
        Some(text) if text.trim().is_empty() => table.refuse("device", "device is empty", device),
        text => text,
    };
    let code = table.text("code");
    let number = code.and_then(|code| {
        let fix = "write a name of linux/input-event-codes.h, as `evtest` shows it, for example \"KEY_B\"";
        let number = evdev::KeyCode::from_str(code).ok().map(evdev::KeyCode::code);
        number.or_else(|| table.refuse("code", format!("there is no key {code:?}"), fix))
    });
    let runs = if table.has("runs_while") {
        table.choice("runs_while", &[("pressed", true), ("released", false)])
    } else {
        Some(kind == StopKind::Enabling)
    };
    Some(KeyInput { device: device?.to_owned(), code: code?.to_owned(), number: number?, runs_while_pressed: runs? })
}

fn gpio(table: &Section<'_>) -> Option<GpioInput> {
    table.allow(&["chip", "line", "runs_while"]);
    let runs = "write runs_while = \"high\" or \"low\": the level of a closed contact, so that a broken wire stops";
    let (chip, line) = gpio_line(table);
    table.need("runs_while", runs);
    let runs = table.choice("runs_while", &LEVELS);
    Some(GpioInput { chip: chip?, line: line?, runs_while_high: runs? })
}

/// Reads `chip` and `line`; the level is a third key.
pub(super) fn gpio_line(table: &Section<'_>) -> (Option<PathBuf>, Option<u32>) {
    table.need("chip", "write chip = \"/dev/gpiochip0\"; `gpiodetect` lists them");
    table.need("line", "write line = its number on the chip; `gpioinfo` lists them");
    let chip = absolute(table, "chip");
    (chip, table.integer("line", 0..=65_535))
}

fn line(table: &Section<'_>) -> Option<LineInput> {
    table.allow(&["path", "baud", "run", "stop", "silence"]);
    table.need("path", "write path = \"/dev/serial/by-id/...\"");
    table.need("run", "write run = the line that is sent, again and again, while the actuator may move");
    let path = absolute(table, "path");
    let baud = if table.has("baud") { table.integer("baud", 300..=4_000_000) } else { Some(115_200) };
    let mut words = ["run", "stop"].map(|key| {
        let text = table.text(key)?;
        let is_line = (1..=LONGEST_LINE).contains(&text.len()) && !text.chars().any(char::is_control);
        if !is_line || text.trim() != text {
            let fix = format!("write 1 to {LONGEST_LINE} characters without a line end, and no space around them");
            return table.refuse(key, format!("{key} = {text:?} is not a line"), fix);
        }
        Some(text.to_owned())
    });
    if words[0].is_some() && words[0] == words[1] {
        table.report("stop", "stop is the same line as run".to_owned(), "write another, or remove it");
    }
    let silence = silence(table);
    let (run, stop) = (words[0].take(), words[1].take());
    if stop.is_none() && table.has("stop") {
        return None;
    }
    Some(LineInput { path: path?, baud: baud?, run: run?, stop, silence })
}

fn field(table: &Section<'_>, drafts: &[Draft<'_>]) -> Option<FieldInput> {
    table.allow(&["device", "index", "runs_above", "runs_below", "silence"]);
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
    let range = || f64::MIN..=f64::MAX;
    let runs = match (table.has("runs_above"), table.has("runs_below")) {
        (true, false) => table.number("runs_above", range()).map(Bound::Above),
        (false, true) => table.number("runs_below", range()).map(Bound::Below),
        (true, true) => {
            let fix = "remove one; for a range write two stops";
            table.refuse("runs_below", "runs_above and runs_below".to_owned(), fix)
        }
        (false, false) => {
            table.missing("runs_above", "write runs_above = 0.5, or runs_below, for what lets the actuator move");
            None
        }
    };
    let silence = silence(table);
    Some(FieldInput { device: device?.to_owned(), index: index?, runs: runs?, silence })
}

fn silence(table: &Section<'_>) -> Duration {
    table.duration("silence", Duration::from_millis(10)..=Duration::from_secs(5)).unwrap_or(SILENCE)
}

fn absolute(table: &Section<'_>, key: &str) -> Option<PathBuf> {
    let text = table.text(key)?;
    if text.starts_with('/') && !text.chars().any(char::is_control) {
        return Some(PathBuf::from(text));
    }
    table.refuse(key, format!("{key} = {text:?} is not an absolute path"), "write the whole path, from /dev/")
}

/// Reads the modules, in the order of the file.
pub(super) fn modules(root: &Section<'_>, drafts: &[Draft<'_>]) -> Vec<ModuleSpec> {
    let Some(tables) = root.table("module") else { return Vec::new() };
    let mut modules: Vec<ModuleSpec> = Vec::new();
    for (_, name, _) in tables.fields() {
        let Some(section) = tables.table(name) else { continue };
        if let Some((_, fix)) = name_problem(name) {
            let fix = fix.replace("[device.", "[module.");
            section.report_at(section.at, format!("{name:?} cannot be a module's name"), fix);
        }
        modules.extend(module(name, &section, drafts, &modules));
    }
    modules
}

fn module(name: &str, section: &Section<'_>, drafts: &[Draft<'_>], earlier: &[ModuleSpec]) -> Option<ModuleSpec> {
    section.allow(&["slot", "tags", "devices"]);
    section.need("slot", "write slot = \"front\", \"tip\", \"top\" or \"bottom\"");
    let mount = section.choice("slot", &Mount::WORDS);
    let mut tags = Vec::new();
    for tag in section.texts("tags").unwrap_or_default() {
        match tag.split_once('=') {
            Some((key, value)) if !key.is_empty() => tags.push((key.to_owned(), value.to_owned())),
            _ => section.report("tags", format!("{tag:?} is not a tag"), "write KEY=VALUE, as \"finger=soft\""),
        }
    }
    let devices = section.texts("devices").unwrap_or_default();
    for device in &devices {
        let Some(draft) = drafts.iter().find(|draft| draft.name == *device) else {
            let fix = did_you_mean(device, names(drafts), "entries are");
            section.report("devices", format!("there is no [device.{device}]"), fix);
            continue;
        };
        if let (Some(mount), Some(own)) = (mount, draft.mount)
            && mount != own
        {
            let message = format!("slot of [device.{device}] is {own}, and of its module {mount}");
            section.report("slot", message, "write the same slot in both, or in the module alone");
        }
        if let Some(other) = earlier.iter().find(|other| other.devices.contains(device)) {
            let message = format!("[device.{device}] is a sensor of [module.{}] already", other.name);
            section.report("devices", message, "name it in one of the two");
        }
    }
    Some(ModuleSpec { name: name.to_owned(), mount: mount?, tags, devices })
}
