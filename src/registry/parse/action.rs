//! `[device.NAME.action]`: that a device is an actuator, and what it may be told.
//!
//! Of what `rapid` reads itself, motors behind a CAN adapter alone move, and each of them is an axis without a table;
//! a program may move what it likes.

use crate::action::MAX_ACTION;
use crate::registry::section::{Problems, Section};
use crate::registry::spec::ActionSpec;

const KEYS: [&str; 4] = ["names", "units", "min", "max"];

/// Reads the table; `None` without one, or if a problem with it was reported. One of a device that does not `move`
/// is such a problem.
pub(super) fn action(section: &Section<'_>, moves: bool, problems: &mut Problems<'_>) -> Option<ActionSpec> {
    let table = section.table(problems, "action")?;
    if !moves {
        let node = section.text(problems, "node").map_or("", |node| node.value);
        let message = format!("node {node:?} takes no actions: nothing would move");
        let fix = "remove the table; motors behind a CAN adapter are axes without one (protocol = \"damiao\"), and any \
                   other device is moved by a program (node = its name)";
        section.report(problems, "action", message, fix);
        return None;
    }
    table.allow(problems, &KEYS);
    for key in KEYS {
        if !table.has(key) {
            table.missing(problems, key, &format!("write {key} = a list with one entry an axis"));
        }
    }
    // All of them first: every mistake is told.
    let (names, units) = (table.texts(problems, "names"), table.texts(problems, "units"));
    let (min, max) = (table.numbers(problems, "min"), table.numbers(problems, "max"));
    let (names, units, min, max) = (names?, units?, min?, max?);
    if names.is_empty() || names.len() > MAX_ACTION {
        let fix = format!("name 1 to {MAX_ACTION} axes");
        table.report(problems, "names", format!("{} axes", names.len()), fix);
        return None;
    }
    for (key, length) in [("units", units.len()), ("min", min.len()), ("max", max.len())] {
        if length != names.len() {
            let message = format!("{length} entries for {} axes", names.len());
            table.report(problems, key, message, "give each axis one entry");
            return None;
        }
    }
    for (name, (low, high)) in names.iter().zip(min.iter().zip(&max)) {
        if !(low.is_finite() && high.is_finite() && low < high) {
            let message = format!("{name} from {low} to {high} is no range");
            table.report(problems, "max", message, "write finite numbers, max above min");
            return None;
        }
    }
    Some(ActionSpec { names, units, min, max })
}
