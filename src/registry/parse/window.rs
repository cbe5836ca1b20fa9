//! Whether the window around each tick fits the rates of the devices.

use std::time::Duration;

use super::device::Draft;
use crate::registry::diagnostic::Diagnostic;
use crate::registry::section::Problems;
use crate::registry::spec::DeviceSpec;
use crate::registry::units::show_duration;

/// Where the entry of a device stands in the file.
pub(super) struct Entry {
    pub(super) name: String,
    pub(super) at: usize,
    pub(super) table: String,
}

/// Where the entries stand.
pub(super) fn entries(drafts: &[Draft<'_>]) -> Vec<Entry> {
    let entry = |draft: &Draft<'_>| {
        let (name, at) = (draft.name.clone(), draft.section.at);
        Entry { name, at, table: draft.section.entry.clone() }
    };
    drafts.iter().map(entry).collect()
}

/// Warns of every device that is so slow that ticks without a sample in `window` alone make an episode SUSPECT.
pub(super) fn too_narrow(
    devices: &[DeviceSpec],
    entries: &[Entry],
    window: Duration,
    problems: &Problems<'_>,
) -> Vec<Diagnostic> {
    let warn = |device: &DeviceSpec| {
        let (hz, least) = (device.verdict.hz?, device.verdict.suspect.valid?);
        // A tick has a sample if one lies within the window before or after it, wherever the two stand to each other.
        let share = hz * 2.0 * window.as_secs_f64();
        let place = entries.iter().find(|entry| entry.name == device.name)?;
        if share >= least.min(1.0) {
            return None;
        }
        let shown = show_duration(window);
        let message = format!(
            "at {hz} samples a second only {:.0} % of the ticks have one within sync_window = {shown}: every episode is SUSPECT",
            share * 100.0
        );
        // Half of the time between two samples, rounded up to a millisecond.
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
        let wide = Duration::from_millis((500.0 / hz).ceil() as u64);
        let wide = show_duration(wide);
        let fix = format!("write sync_window = \"{wide}\" in [rig], or valid = \"off\" in [{}.verdict]", place.table);
        Some(problems.diagnostic(place.at, &place.table, message, fix))
    };
    devices.iter().filter_map(warn).collect()
}
