//! `[button.NAME]`.

use std::time::Duration;

use super::device::Draft;
use super::identity::name_problem;
use super::input::{self, GpioKeys, KeyKeys, LEVELS, LINE, NumberKeys, PortKeys, SILENCE, are_one, inputs};
use crate::keys::{About, FLAG, Key, Keys, Own, Real, Time, Words, keys, text};
use crate::section::Section;
use crate::spec::{
    Bound, ButtonAction, ButtonSpec, FieldInput, GpioInput, InputSpec, InterlockSpec, KeyInput, LineInput, LineOff,
    MAX_BUTTONS,
};

keys! {
    /// `[button.NAME]`.
    struct ButtonKeys {
        /// What a press does.
        press: Option<ButtonAction> = Words(&ButtonAction::WORDS), within ACTION;
        /// What a press of `hold_after` does instead.
        hold: Option<ButtonAction> = Words(&ButtonAction::WORDS), within ACTION;
        /// A press of this length is a hold.
        hold_after: Duration = Time(Duration::from_millis(200), Duration::from_secs(10)), or Duration::from_secs(1);
        /// What two presses in a row do instead.
        double: Option<ButtonAction> = Words(&ButtonAction::WORDS), within ACTION;
    }

    /// Of a key.
    struct GrabKeys {
        /// Whether no other program gets what the device sends.
        grab: bool = FLAG, or false;
    }

    /// Of a line of a chip.
    struct LevelKeys {
        /// The level while it is pressed.
        pressed_while: Option<bool> = Words(&LEVELS),
            need "write pressed_while = \"low\" for a button that connects the line to ground, or \"high\"";
    }

    /// Of a serial port.
    struct LineKeys {
        /// The line that is sent at each press.
        line: Option<String> = LINE;
        /// Instead of it, the line that is sent at a press.
        pressed: Option<String> = LINE;
        /// The line that is sent at the release.
        released: Option<String> = LINE;
        /// Lines are sent again and again: without one for this long the button is lost.
        silence: Option<Duration> = SILENCE, usually "lines are sent at changes";
    }

    /// Of a number.
    struct FieldKeys {
        /// Above this it is pressed.
        pressed_above: Option<f64> = Real::ANY;
        /// Below this it is pressed.
        pressed_below: Option<f64> = Real::ANY;
        /// Above this it is released; between the two it stays as it was.
        released_above: Option<f64> = Real::ANY;
        /// Below this it is released; between the two it stays as it was.
        released_below: Option<f64> = Real::ANY;
        /// Missing for this long it is lost.
        silence: Duration = SILENCE, or Duration::from_millis(500);
    }
}

const KEY: Keys = &[KeyKeys::KEYS, GrabKeys::KEYS];
const GPIO: Keys = &[GpioKeys::KEYS, LevelKeys::KEYS];
const SERIAL: Keys = &[PortKeys::KEYS, LineKeys::KEYS];
const FIELD: Keys = &[NumberKeys::KEYS, FieldKeys::KEYS];
const INPUT: [Key; 4] =
    inputs([|| About::Table(KEY), || About::Table(GPIO), || About::Table(SERIAL), || About::Table(FIELD)]);
/// The keys of `[button.NAME]`.
pub(super) const KEYS: Keys = &[ButtonKeys::KEYS, &INPUT];
const ACTION: Own<ButtonAction> = text(action, "");

/// Reads the buttons, in the order of the file.
pub(super) fn buttons(root: &Section<'_>, drafts: &[Draft<'_>], stops: &[InterlockSpec]) -> Vec<ButtonSpec> {
    let Some(tables) = root.table("button") else { return Vec::new() };
    let mut buttons = Vec::new();
    for (index, (at, name, _)) in tables.fields().into_iter().enumerate() {
        if index == MAX_BUTTONS {
            tables.report_child(at, name, format!("more than {MAX_BUTTONS} buttons"), "remove some of them");
            break;
        }
        let Some(section) = tables.table(name) else { continue };
        if let Some((_, fix)) = name_problem(name) {
            let fix = fix.replace("[device.", "[button.");
            section.report_at(section.at, format!("{name:?} cannot be a button's name"), fix);
        }
        section.known(KEYS);
        let ButtonKeys { press, hold, hold_after, double } = ButtonKeys::values(&section);
        let input = input(&section, drafts);
        check_actions(&section, [press, hold, double], input.as_ref());
        let Some(input) = input else { continue };
        check_reader(&section, &input, stops, &buttons);
        if section.has("hold_after") && !section.has("hold") {
            section.report("hold_after", "hold_after without hold", "write hold = \"discard\", or remove hold_after");
        }
        buttons.push(ButtonSpec { name: name.to_owned(), input, press, hold, hold_after, double });
    }
    buttons
}

fn action(section: &Section<'_>, key: &str) -> Option<ButtonAction> {
    if section.word(key) == Some("arm") {
        let fix = "arm in the monitor (a, then ctrl-y) or by `rapid arm`; a button can disarm";
        let message = "a button does not arm: whoever steps on it by mistake would move the actuator";
        return section.refuse(key, message, fix);
    }
    section.choice(key, &ButtonAction::WORDS)
}

/// What a press, a hold and two presses do.
fn check_actions(section: &Section<'_>, actions: [Option<ButtonAction>; 3], input: Option<&InputSpec>) {
    let gestures = ["press", "hold", "double"];
    if !gestures.iter().any(|key| section.has(key)) {
        section.missing("press", "write press = \"toggle\": what a press does; also hold = and double =");
    }
    for (key, action) in gestures.into_iter().zip(actions).skip(1) {
        if section.has(key) && actions.contains(&Some(ButtonAction::Disarm)) {
            let message = format!("{key} beside disarm: it would be carried out late");
            section.report(key, message, "write press = \"disarm\" into a table of its own, without hold and double");
        } else if key == "hold"
            && action.is_some()
            && matches!(input, Some(InputSpec::Serial(line)) if line.off == LineOff::AtOnce)
        {
            let fix = "write pressed = and released = into serial, the lines of both; or remove hold";
            section.report(key, "a line of text is a whole press and cannot be held", fix);
        }
    }
}

/// What another entry reads already, or keeps from others.
fn check_reader(section: &Section<'_>, input: &InputSpec, stops: &[InterlockSpec], buttons: &[ButtonSpec]) {
    let same = "remove one of them, or name another input";
    for stop in stops {
        if are_one(&stop.input, input) {
            section.report_at(section.at, format!("[stop.{}] reads the same input", stop.name), same);
        } else if let (InputSpec::Key(key), InputSpec::Key(other)) = (input, &stop.input)
            && key.grab
            && key.device == other.device
        {
            let message = format!("grab = true, and [stop.{}] is a key of the same device", stop.name);
            section.report_at(section.at, message, "write grab = false: a stop must not get its key late");
        }
    }
    for button in buttons {
        match (input, &button.input) {
            (InputSpec::Serial(line), InputSpec::Serial(other)) if line.path == other.path => {
                if (line.baud, line.silence) != (other.baud, other.silence) {
                    let message = format!("[button.{}] reads the port with another baud or silence", button.name);
                    section.report_at(section.at, message, "write the same baud and silence in both");
                }
                if line.on == other.on {
                    let message = format!("[button.{}] reads the same input", button.name);
                    section.report_at(section.at, message, "remove one of them, or name another line");
                }
            }
            (input, other) if are_one(input, other) => {
                section.report_at(section.at, format!("[button.{}] reads the same input", button.name), same);
            }
            _ => {}
        }
    }
}

fn input(section: &Section<'_>, drafts: &[Draft<'_>]) -> Option<InputSpec> {
    let (input, table) = input::only(section, "a button", "each of them is a button")?;
    match input {
        "key" => key(&table).map(InputSpec::Key),
        "gpio" => gpio(&table).map(InputSpec::Gpio),
        "serial" => line(&table).map(InputSpec::Serial),
        _ => field(&table, drafts).map(InputSpec::Field),
    }
}

fn key(table: &Section<'_>) -> Option<KeyInput> {
    table.known(KEY);
    let (keys, GrabKeys { grab }) = (KeyKeys::values(table), GrabKeys::values(table));
    let (code, number) = keys.code?;
    Some(KeyInput { device: keys.device?, code, number, on_while_pressed: true, grab })
}

fn gpio(table: &Section<'_>) -> Option<GpioInput> {
    table.known(GPIO);
    let (keys, level) = (GpioKeys::values(table), LevelKeys::values(table));
    Some(GpioInput { chip: keys.chip?, line: keys.line?, on_while_high: level.pressed_while? })
}

fn line(table: &Section<'_>) -> Option<LineInput> {
    table.known(SERIAL);
    let PortKeys { path, baud } = PortKeys::values(table);
    let LineKeys { line, pressed, released, silence } = LineKeys::values(table);
    let (on, off) = if table.has("line") {
        for key in ["pressed", "released", "silence"].into_iter().filter(|key| table.has(key)) {
            let fix = "write line = for a box that sends one line per press, or pressed = and released =";
            table.report(key, format!("{key} beside line"), fix);
        }
        (line?, LineOff::AtOnce)
    } else {
        if !table.has("pressed") {
            let fix = "write line = the line that is sent at each press; or pressed = and released =";
            table.missing("line", fix);
        } else if !table.has("released") {
            table.missing(
                "released",
                "write released = the line that is sent at the release; or line = instead of both",
            );
        }
        if pressed.is_some() && pressed == released {
            table.report("released", "released is the same line as pressed", "write another");
        }
        (pressed?, LineOff::Line(released?))
    };
    Some(LineInput { path: path?, baud, on, off, silence })
}

fn field(table: &Section<'_>, drafts: &[Draft<'_>]) -> Option<FieldInput> {
    table.known(FIELD);
    let (NumberKeys { device, index }, keys) = (input::number(table, drafts), FieldKeys::values(table));
    let none = "write pressed_above = 0.5, or pressed_below, for what counts as pressed";
    let pressed = [("pressed_above", keys.pressed_above), ("pressed_below", keys.pressed_below)];
    let on = input::bound(table, pressed[0], pressed[1], "remove one", none);
    let both = "remove one: released_below belongs to pressed_above, released_above to pressed_below";
    let released = [("released_above", keys.released_above), ("released_below", keys.released_below)];
    let has_off = released.iter().any(|(key, _)| table.has(key));
    let off = has_off.then(|| input::bound(table, released[0], released[1], both, none));
    let (key, is_beyond) = match (on, off.flatten()) {
        (Some(Bound::Above(on)), Some(Bound::Below(off))) => ("released_below", off <= on),
        (Some(Bound::Below(on)), Some(Bound::Above(off))) => ("released_above", off >= on),
        (Some(Bound::Above(_)), Some(Bound::Above(_))) => ("released_above", false),
        (Some(Bound::Below(_)), Some(Bound::Below(_))) => ("released_below", false),
        _ => ("", true),
    };
    if !is_beyond {
        let fix =
            "write pressed_above = 0.6 with released_below = 0.4, or pressed_below = 0.4 with released_above = 0.6";
        table.report(key, "it is pressed and released at the same numbers", fix);
    }
    let off = off.map_or(Some(None), |off| off.map(Some))?;
    Some(FieldInput { device: device?, index: index?, on: on?, off, silence: keys.silence })
}
