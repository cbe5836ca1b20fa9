//! What an event of an episode says to people. Pure.

use crate::status::What;

/// An event for people.
pub(super) fn describe(what: &What) -> String {
    match what {
        What::Attach { device, node, unit, .. } => {
            let serial = unit.serial().map(|serial| format!(", serial {serial}")).unwrap_or_default();
            format!("{device} attached: {node}, {}{serial}", unit.location())
        }
        What::Opened { device, provenance, .. } => {
            let unit = provenance.unit.serial().unwrap_or("without a serial number");
            format!("{device} opened in epoch {}: unit {unit}", provenance.epoch.0)
        }
        What::Detach { device, witness, .. } => format!("{device} detached, told by {witness}"),
        What::State { device, state, mask, detail, .. } => {
            let state = format!("{state:?}").to_lowercase();
            format!("{device} {state}, mask {mask}: {detail}")
        }
        What::Unregistered { device, reason } => format!("{device} not registered: {reason}"),
        What::Recording { file } => format!("recording {}", file.display()),
        What::Episode { file, .. } => format!("finished {}", file.display()),
        What::Recovered { text, .. } | What::Log { text, .. } => text.clone(),
        What::Actuator { .. }
        | What::Stop(_)
        | What::Publisher { .. }
        | What::Dropped { .. }
        | What::DiskLow { .. }
        | What::ClockStep { .. }
        | What::Policy { .. }
        | What::Chunk(_)
        | What::Hold { .. }
        | What::Act { .. }
        | What::PolicyEnd { .. } => what.sentence().map_or_else(String::new, |(_, sentence)| sentence),
    }
}
