//! Faults reported while an episode is recorded, early enough to act on them.
//!
//! Invariant: at most one announcement per modality and second, however many faults occur.

use std::time::Duration;

use rapid_core::text;
use rapid_core::time::{Stamp, nanoseconds};
use rapid_registry::{DeviceSpec, Limits, Registry};
use rapid_status::{Board, EventKind, Level};

use super::quality::{Measures, Meter};

/// Shortest time between announcements of a modality.
const ANNOUNCE_EVERY: Duration = Duration::from_secs(1);
/// Fewer affected samples are not announced: they may be chance, and are in the verdict.
const LEAST_SAMPLES: u64 = 3;

/// What has been announced of a modality.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Announced {
    dropped: u64,
    lost: u64,
    damaged: u64,
    late: u64,
    frozen: bool,
    at: Option<Stamp>,
}

/// Announces new faults, at most once a second per modality; at the end all that are left. `announced` has an entry per
/// modality.
pub(super) fn announce_faults(
    announced: &mut [Announced],
    measures: &Measures,
    registry: &Registry,
    board: &Board,
    now: Stamp,
    is_end: bool,
) {
    for device in &registry.devices {
        let Some(known) = announced.get_mut(device.id.index()) else { continue };
        let Some(meter) = measures.meter(device.id) else { continue };
        if (is_end || known.at.is_none_or(|at| now.since(at) >= ANNOUNCE_EVERY))
            && let Some(text) = known.news(device, meter)
        {
            known.at = Some(now);
            let text = format!("{}: {text}", device.name);
            board.announce(EventKind::Log { level: Level::Warn, text });
        }
    }
}

impl Announced {
    /// A new fault, if there is one; it counts as reported from now on.
    fn news(&mut self, device: &DeviceSpec, meter: &Meter) -> Option<String> {
        let Limits { lost, damaged, late, frozen, .. } = device.verdict.suspect;
        let counts = &meter.counts;
        let mut news = Vec::new();
        if counts.dropped > self.dropped {
            news.push(format!(
                "{} lost on the way to the file",
                text::counted(counts.dropped - self.dropped, "sample")
            ));
            self.dropped = counts.dropped;
        }
        // A few are normal: only what would already make the episode suspect is announced.
        let expected = counts.expected();
        for (count, reported, limit, what) in [
            (counts.lost, &mut self.lost, lost, "lost by the device"),
            (counts.damaged, &mut self.damaged, damaged, "damaged"),
            (counts.late, &mut self.late, late, "too late for their frame"),
        ] {
            let beyond = limit.is_some_and(|limit| count as f64 > limit * expected as f64);
            if beyond && count >= reported.saturating_add(LEAST_SAMPLES) {
                news.push(format!("{} {what}", text::counted(count - *reported, "sample")));
                *reported = count;
            }
        }
        let still = frozen.is_some_and(|limit| meter.runs.newest.length_ns > nanoseconds(limit));
        match (still, self.frozen) {
            (true, false) => {
                let seconds = meter.runs.newest.length_ns as f64 / 1e9;
                news.push(format!("frozen, the same bytes for {seconds:.1} s"));
            }
            (false, true) => news.push("no longer frozen".to_owned()),
            _ => {}
        }
        self.frozen = still;
        (!news.is_empty()).then(|| news.join(", "))
    }
}
