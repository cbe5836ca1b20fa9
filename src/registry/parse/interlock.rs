//! `[stop.NAME]`.

use std::time::Duration;

use rapid_core::interlock::{MAX_STOPS, StopKind};

use super::device::Draft;
use super::identity::name_problem;
use super::input::{self, GpioKeys, KeyKeys, LEVELS, LINE, NumberKeys, PortKeys, SILENCE, are_one, inputs};
use crate::diagnostic::did_you_mean;
use crate::keys::{About, Key, Keys, Real, TEXTS, Words, keys};
use crate::kinds::Word;
use crate::section::Section;
use crate::spec::{FieldInput, GpioInput, InputSpec, InterlockSpec, KeyInput, LineInput, LineOff};

const KINDS: [(&str, StopKind); 2] = [("emergency", StopKind::Emergency), ("enabling", StopKind::Enabling)];

keys! {
    /// `[stop.NAME]`.
    struct StopKeys {
        /// An emergency stop, or a switch that is held while the actuator may move.
        kind: Option<StopKind> = Words(&KINDS), need "write kind = \"emergency\", or \"enabling\" for a switch that is held";
        /// Entries of the actuators that it stops.
        actuators: Option<Vec<String>> = TEXTS, usually "all";
    }

    /// Of a key.
    struct HeldKeys {
        /// The actuator may move while the key is in this state.
        runs_while: Option<bool> = Words(&[("pressed", true), ("released", false)]), usually "`\"released\"`; if enabling `\"pressed\"`";
    }

    /// Of a line of a chip.
    struct LevelKeys {
        /// The level of a closed contact, so that a broken wire stops.
        runs_while: Option<bool> = Words(&LEVELS), need RUNS_WHILE;
    }

    /// Of a serial port.
    struct LineKeys {
        /// The line that is sent, again and again, while the actuator may move.
        run: Option<String> = LINE, need "write run = the line that is sent, again and again, while the actuator may move";
        /// The line that stops it.
        stop: Option<String> = LINE, usually "every other line";
        /// Without a line for this long it stops.
        silence: Duration = SILENCE, or Duration::from_millis(200);
    }

    /// Of a number.
    struct FieldKeys {
        /// Above this the actuator may move.
        runs_above: Option<f64> = Real::ANY;
        /// Below this the actuator may move.
        runs_below: Option<f64> = Real::ANY;
        /// Without a sample for this long it stops.
        silence: Duration = SILENCE, or Duration::from_millis(200);
    }
}

const RUNS_WHILE: &str =
    "write runs_while = \"high\" or \"low\": the level of a closed contact, so that a broken wire stops";
const KEY: Keys = &[KeyKeys::KEYS, HeldKeys::KEYS];
const GPIO: Keys = &[GpioKeys::KEYS, LevelKeys::KEYS];
const SERIAL: Keys = &[PortKeys::KEYS, LineKeys::KEYS];
const FIELD: Keys = &[NumberKeys::KEYS, FieldKeys::KEYS];
const INPUT: [Key; 4] =
    inputs([|| About::Table(KEY), || About::Table(GPIO), || About::Table(SERIAL), || About::Table(FIELD)]);
/// The keys of `[stop.NAME]`.
pub(super) const KEYS: Keys = &[StopKeys::KEYS, &INPUT];

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
        section.known(KEYS);
        let StopKeys { kind, actuators: written } = StopKeys::values(&section);
        let actuators = actuators(&section, written, drafts);
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
fn actuators(section: &Section<'_>, written: Option<Vec<String>>, drafts: &[Draft<'_>]) -> Vec<String> {
    let known: Vec<&Draft<'_>> = drafts.iter().filter(|draft| draft.action.is_some()).collect();
    let names: Vec<String> = if section.has("actuators") {
        let Some(names) = written else { return Vec::new() };
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
    for draft in known.iter().filter(|draft| names.contains(&draft.name) && draft.kind == Some(Word::Process)) {
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
    table.known(KEY);
    let (keys, held) = (KeyKeys::values(table), HeldKeys::values(table));
    let runs = if table.has("runs_while") { held.runs_while } else { Some(kind == StopKind::Enabling) };
    let (code, number) = keys.code?;
    Some(KeyInput { device: keys.device?, code, number, on_while_pressed: runs?, grab: false })
}

fn gpio(table: &Section<'_>) -> Option<GpioInput> {
    table.known(GPIO);
    let (keys, level) = (GpioKeys::values(table), LevelKeys::values(table));
    Some(GpioInput { chip: keys.chip?, line: keys.line?, on_while_high: level.runs_while? })
}

fn line(table: &Section<'_>) -> Option<LineInput> {
    table.known(SERIAL);
    let PortKeys { path, baud } = PortKeys::values(table);
    let LineKeys { run, stop, silence } = LineKeys::values(table);
    if run.is_some() && run == stop {
        table.report("stop", "stop is the same line as run", "write another, or remove it");
    }
    let off = if table.has("stop") { LineOff::Line(stop?) } else { LineOff::Others };
    Some(LineInput { path: path?, baud, on: run?, off, silence: Some(silence) })
}

fn field(table: &Section<'_>, drafts: &[Draft<'_>]) -> Option<FieldInput> {
    table.known(FIELD);
    let NumberKeys { device, index } = input::number(table, drafts);
    let FieldKeys { runs_above, runs_below, silence } = FieldKeys::values(table);
    let both = "remove one; for a range write two stops";
    let none = "write runs_above = 0.5, or runs_below, for what lets the actuator move";
    let on = input::bound(table, ("runs_above", runs_above), ("runs_below", runs_below), both, none);
    Some(FieldInput { device: device?, index: index?, on: on?, off: None, silence })
}
