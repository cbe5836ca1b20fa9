//! `[export]`: the numbers of the state and of the action, by name.

use rapid_core::action::ACTION_TOPIC;

use super::device::Draft;
use crate::columns::{ColumnError, Vector, choose};
use crate::section::Section;
use crate::spec::ExportSpec;

const FIX: &str = "write NAME, NAME.0, NAME.0-5, or the names that its numbers have by its joints or pose";

/// Reads the table of a rig with these entries.
pub(super) fn read(section: &Section<'_>, drafts: &[Draft<'_>]) -> ExportSpec {
    let spec = ExportSpec::read(section);
    let sensors: Vec<Vector> = drafts.iter().filter_map(Draft::vector).collect();
    let actions = drafts.iter().find_map(|draft| draft.action.as_ref()).map(|action| Vector {
        name: ACTION_TOPIC.to_owned(),
        length: Some(action.names.len()),
        names: action.names.clone(),
    });
    let with_actions: Vec<Vector> = sensors.iter().cloned().chain(actions).collect();
    check(section, "state", &spec.state, &sensors);
    check(section, "action", &spec.action, &with_actions);
    spec
}

fn check(section: &Section<'_>, key: &str, parts: &[String], vectors: &[Vector]) {
    match choose(parts, vectors) {
        // Of an entry with another problem.
        Ok(_) | Err(ColumnError::NoLength(_)) => {}
        Err(error @ ColumnError::Twice(_)) => section.report(key, error.to_string(), "name each column once"),
        Err(error) => section.report(key, error.to_string(), FIX),
    }
}
