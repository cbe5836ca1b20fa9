//! `[stop.NAME]`.

use std::time::Duration;

use rapid_core::interlock::{MAX_STOPS, StopKind};

use super::device::{Draft, Kind};
use super::identity::name_problem;
use super::input::{self, INPUTS, LEVELS, are_one};
use crate::diagnostic::did_you_mean;
use crate::section::Section;
use crate::spec::{FieldInput, GpioInput, InputSpec, InterlockSpec, KeyInput, LineInput, LineOff};

const KINDS: [(&str, StopKind); 2] = [("emergency", StopKind::Emergency), ("enabling", StopKind::Enabling)];
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
        section.allow(&[&["kind", "actuators"][..], &INPUTS].concat());
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

fn input(section: &Section<'_>, kind: StopKind, drafts: &[Draft<'_>]) -> Option<InputSpec> {
    let (input, table) = input::only(section, "a stop", "each of them stops")?;
    match input {
        "key" => key(&table, kind).map(InputSpec::Key),
        "gpio" => gpio(&table).map(InputSpec::Gpio),
        "serial" => line(&table).map(InputSpec::Serial),
        _ => field(&table, drafts).map(InputSpec::Field),
    }
}

fn key(table: &Section<'_>, kind: StopKind) -> Option<KeyInput> {
    table.allow(&["device", "code", "runs_while"]);
    let (device, code) = input::key(table);
    let on_while_pressed = if table.has("runs_while") {
        table.choice("runs_while", &[("pressed", true), ("released", false)])
    } else {
        Some(kind == StopKind::Enabling)
    };
    let (code, number) = code?;
    Some(KeyInput { device: device?, code, number, on_while_pressed: on_while_pressed?, grab: false })
}

fn gpio(table: &Section<'_>) -> Option<GpioInput> {
    table.allow(&["chip", "line", "runs_while"]);
    let runs = "write runs_while = \"high\" or \"low\": the level of a closed contact, so that a broken wire stops";
    let (chip, line) = input::gpio_line(table);
    table.need("runs_while", runs);
    let runs = table.choice("runs_while", &LEVELS);
    Some(GpioInput { chip: chip?, line: line?, on_while_high: runs? })
}

fn line(table: &Section<'_>) -> Option<LineInput> {
    table.allow(&["path", "baud", "run", "stop", "silence"]);
    let (path, baud) = input::port(table);
    table.need("run", "write run = the line that is sent, again and again, while the actuator may move");
    let [run, stop] = ["run", "stop"].map(|key| input::line(table, key));
    if run.is_some() && run == stop {
        table.report("stop", "stop is the same line as run".to_owned(), "write another, or remove it");
    }
    let silence = silence(table);
    let off = if table.has("stop") { LineOff::Line(stop?) } else { LineOff::Others };
    Some(LineInput { path: path?, baud: baud?, on: run?, off, silence: Some(silence) })
}

fn field(table: &Section<'_>, drafts: &[Draft<'_>]) -> Option<FieldInput> {
    table.allow(&["device", "index", "runs_above", "runs_below", "silence"]);
    let (device, index) = input::number(table, drafts);
    let both = "remove one; for a range write two stops";
    let none = "write runs_above = 0.5, or runs_below, for what lets the actuator move";
    let on = input::bound(table, "runs_above", "runs_below", both, none);
    let silence = silence(table);
    Some(FieldInput { device: device?, index: index?, on: on?, off: None, silence })
}

fn silence(table: &Section<'_>) -> Duration {
    table.duration("silence", Duration::from_millis(10)..=Duration::from_secs(5)).unwrap_or(SILENCE)
}
