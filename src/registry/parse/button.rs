//! `[button.NAME]`.

use std::time::Duration;

use super::device::Draft;
use super::identity::name_problem;
use super::input::{self, INPUTS, LEVELS, are_one};
use crate::section::Section;
use crate::spec::{
    Bound, ButtonAction, ButtonSpec, FieldInput, GpioInput, InputSpec, InterlockSpec, KeyInput, LineInput, LineOff,
    MAX_BUTTONS,
};

const KEYS: [&str; 4] = ["press", "hold", "hold_after", "double"];
/// A press of this length is a hold, unless its entry states otherwise.
const HOLD_AFTER: Duration = Duration::from_secs(1);
/// A number that is missing for this long is lost, unless its entry states otherwise.
const SILENCE: Duration = Duration::from_millis(500);

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
        section.allow(&[&KEYS[..], &INPUTS].concat());
        let input = input(&section, drafts);
        let [press, hold, double] = actions(&section, input.as_ref());
        let Some(input) = input else { continue };
        check_reader(&section, &input, stops, &buttons);
        let range = Duration::from_millis(200)..=Duration::from_secs(10);
        let hold_after = section.duration("hold_after", range).unwrap_or(HOLD_AFTER);
        if section.has("hold_after") && !section.has("hold") {
            section.report("hold_after", "hold_after without hold", "write hold = \"discard\", or remove hold_after");
        }
        buttons.push(ButtonSpec { name: name.to_owned(), input, press, hold, hold_after, double });
    }
    buttons
}

/// What a press, a hold and two presses do.
fn actions(section: &Section<'_>, input: Option<&InputSpec>) -> [Option<ButtonAction>; 3] {
    let gestures = ["press", "hold", "double"];
    if !gestures.iter().any(|key| section.has(key)) {
        section.missing("press", "write press = \"toggle\": what a press does; also hold = and double =");
    }
    let actions = gestures.map(|key| {
        if section.word(key) == Some("arm") {
            let fix = "arm in the monitor (a, then ctrl-y) or by `rapid arm`; a button can disarm";
            let message = "a button does not arm: whoever steps on it by mistake would move the actuator";
            return section.refuse(key, message, fix);
        }
        section.has(key).then(|| section.choice(key, &ButtonAction::WORDS))?
    });
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
    actions
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
    table.allow(&["device", "code", "grab"]);
    let (device, code) = input::key(table);
    let grab = table.has("grab").then(|| table.flag("grab"));
    let (code, number) = code?;
    Some(KeyInput { device: device?, code, number, on_while_pressed: true, grab: grab.unwrap_or(Some(false))? })
}

fn gpio(table: &Section<'_>) -> Option<GpioInput> {
    table.allow(&["chip", "line", "pressed_while"]);
    let (chip, line) = input::gpio_line(table);
    table.need(
        "pressed_while",
        "write pressed_while = \"low\" for a button that connects the line to ground, or \"high\"",
    );
    let pressed = table.choice("pressed_while", &LEVELS);
    Some(GpioInput { chip: chip?, line: line?, on_while_high: pressed? })
}

fn line(table: &Section<'_>) -> Option<LineInput> {
    table.allow(&["path", "baud", "line", "pressed", "released", "silence"]);
    let (path, baud) = input::port(table);
    let [line, pressed, released] = ["line", "pressed", "released"].map(|key| input::line(table, key));
    let silence = table.duration("silence", Duration::from_millis(10)..=Duration::from_secs(5));
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
    Some(LineInput { path: path?, baud: baud?, on, off, silence })
}

fn field(table: &Section<'_>, drafts: &[Draft<'_>]) -> Option<FieldInput> {
    table.allow(&["device", "index", "pressed_above", "pressed_below", "released_above", "released_below", "silence"]);
    let (device, index) = input::number(table, drafts);
    let none = "write pressed_above = 0.5, or pressed_below, for what counts as pressed";
    let on = input::bound(table, "pressed_above", "pressed_below", "remove one", none);
    let both = "remove one: released_below belongs to pressed_above, released_above to pressed_below";
    let has_off = table.has("released_above") || table.has("released_below");
    let off = has_off.then(|| input::bound(table, "released_above", "released_below", both, none));
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
    let silence = table.duration("silence", Duration::from_millis(10)..=Duration::from_secs(5)).unwrap_or(SILENCE);
    let off = off.map_or(Some(None), |off| off.map(Some))?;
    Some(FieldInput { device: device?, index: index?, on: on?, off, silence })
}
