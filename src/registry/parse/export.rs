//! `[export]`: the numbers of the state and of the action, by name.

use rapid_core::action::ACTION_TOPIC;

use super::device::Draft;
use crate::columns::{ColumnError, Vector, choose};
use crate::section::Section;
use crate::spec::ExportSpec;

const FIX: &str = "write NAME, NAME.0, NAME.0-5, or the names that its numbers have by its joints or pose";

/// Reads the table of a rig with these entries.
pub(super) fn read(section: &Section<'_>, drafts: &[Draft<'_>]) -> ExportSpec {
    section.allow(&["state", "action"]);
    let sensors: Vec<Vector> = drafts.iter().filter_map(Draft::vector).collect();
    let actions = drafts.iter().find_map(|draft| draft.action.as_ref()).map(|action| Vector {
        name: ACTION_TOPIC.to_owned(),
        length: Some(action.names.len()),
        names: action.names.clone(),
    });
    let with_actions: Vec<Vector> = sensors.iter().cloned().chain(actions).collect();
    ExportSpec { state: parts(section, "state", &sensors), action: parts(section, "action", &with_actions) }
}

fn parts(section: &Section<'_>, key: &str, vectors: &[Vector]) -> Vec<String> {
    let Some(parts) = section.texts(key) else { return Vec::new() };
    if parts.is_empty() {
        section.report(key, format!("{key} is an empty list"), "name columns, or remove the key");
    }
    match choose(&parts, vectors) {
        // Of an entry with another problem.
        Ok(_) | Err(ColumnError::NoLength(_)) => {}
        Err(error @ ColumnError::Twice(_)) => section.report(key, error.to_string(), "name each column once"),
        Err(error) => section.report(key, error.to_string(), FIX),
    }
    parts
}
