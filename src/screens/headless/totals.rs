//! The totals of a run, for the summary at its end.
//!
//! Invariant: pure; built from events and snapshots.

use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::modality::MAX_MODALITIES;
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_status::palette::Palette;
use rapid_status::{DeviceState, DeviceStatus, EpisodeReport, Event, EventKind, PolicyEnd, Snapshot, Verdict};
use serde::Serialize;

/// How long each device was present, and which episodes were closed.
#[derive(Debug)]
pub(super) struct RunTotals {
    began: Stamp,
    present: [DevicePresence; MAX_MODALITIES],
    /// Samples that were already counted when the totals began.
    before: Vec<DeviceStatus>,
    episodes: Vec<Episode>,
    /// The policy's name, and whether it is a dry run.
    policy: Option<(String, bool)>,
    policy_end: Option<PolicyEnd>,
    missed: u64,
}

#[derive(Debug, Clone, Copy, Default)]
struct DevicePresence {
    since: Option<Stamp>,
    total: Duration,
    /// The last period in which it was present, if it is not present now.
    last: Option<(Stamp, Stamp)>,
    stalled: bool,
}

impl DevicePresence {
    fn set(&mut self, state: DeviceState, at: Stamp) {
        let running = state.is_present();
        if running {
            self.stalled = state == DeviceState::Stalled;
        }
        match (self.since, running) {
            (None, true) => self.since = Some(at),
            (Some(since), false) => {
                self.total += at.since(since);
                self.last = Some((since, at));
                self.since = None;
            }
            _ => {}
        }
    }

    fn until(self, end: Stamp) -> Duration {
        self.total + self.since.map_or(Duration::ZERO, |since| end.since(since))
    }

    /// The time in which it sent `samples`: without the time it took to close, whose only sign is that the newest
    /// sample is older. The silence of a stalled device counts.
    fn sending(self, end: Stamp, newest: Option<Stamp>, samples: u64) -> Duration {
        let present = self.until(end);
        let last = self.since.map(|since| (since, end)).or(self.last);
        let (Some((since, until)), Some(newest)) = (last, newest) else { return present };
        if self.stalled || newest <= since || newest >= until || samples < 2 {
            return present;
        }
        // The newest sample counts until the next one is due.
        let sent = present.saturating_sub(until.since(newest)).as_secs_f64();
        present.min(Duration::from_secs_f64(sent * samples as f64 / (samples - 1) as f64))
    }
}

/// An episode that was closed.
#[derive(Debug, Clone, Serialize)]
struct Episode {
    #[serde(serialize_with = "text::lossy")]
    file: PathBuf,
    seconds: f64,
    messages: u64,
    bytes: u64,
    dropped: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    #[serde(flatten)]
    verdict: Verdict,
    /// It is in the trash.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    discarded: bool,
}

/// The summary; as JSON one object: `{"event":"summary",...}`.
#[derive(Debug, Serialize)]
#[serde(tag = "event", rename = "summary")]
pub(super) struct Summary {
    seconds: f64,
    devices: Vec<Row>,
    episodes: Vec<Episode>,
    #[serde(skip_serializing_if = "Option::is_none")]
    policy: Option<PolicyRow>,
    /// Events that this output missed because it was behind.
    missed_events: u64,
}

/// The totals of the policy.
#[derive(Debug, Serialize)]
struct PolicyRow {
    policy: String,
    dry_run: bool,
    #[serde(flatten)]
    sum: PolicyEnd,
}

/// The totals of one modality.
#[derive(Debug, Serialize)]
struct Row {
    device: String,
    bit: u8,
    samples: u64,
    /// Mean rate while present and not being closed.
    hz: f64,
    /// Share of the run in which the device was present, 0 to 1.
    present: f64,
    gaps: u64,
    bytes: u64,
}

impl RunTotals {
    pub(super) fn new(snapshot: &Snapshot) -> Self {
        let mut totals = Self {
            began: snapshot.taken,
            present: [DevicePresence::default(); MAX_MODALITIES],
            before: snapshot.devices.clone(),
            episodes: Vec::new(),
            policy: snapshot.policy.as_ref().map(|policy| (policy.name.clone(), policy.dry_run)),
            policy_end: None,
            missed: 0,
        };
        totals.agree(snapshot);
        totals
    }

    /// Adopts the states of the snapshot, since events may be missing.
    pub(super) fn agree(&mut self, snapshot: &Snapshot) {
        for device in &snapshot.devices {
            if let Some(presence) = self.present.get_mut(device.id.index()) {
                presence.set(device.state, snapshot.taken);
            }
        }
    }

    pub(super) fn miss(&mut self, events: u64) {
        self.missed += events;
    }

    pub(super) fn count(&mut self, event: &Event) {
        match &event.what {
            EventKind::State { bit, state, .. } => {
                if let Some(presence) = self.present.get_mut(bit.index()) {
                    presence.set(*state, event.stamp);
                }
            }
            EventKind::Episode(end) => {
                let EpisodeReport { file, seconds, messages, bytes, dropped, error, verdict } = end.clone();
                let discarded = false;
                self.episodes.push(Episode { file, seconds, messages, bytes, dropped, error, verdict, discarded });
            }
            EventKind::Discarded { file } => self.discard(file, true),
            EventKind::Restored { file } => self.discard(file, false),
            EventKind::Policy { policy, dry_run, .. } => self.policy = Some((policy.clone(), *dry_run)),
            EventKind::PolicyEnd(end) => self.policy_end = Some(*end),
            _ => {}
        }
    }

    fn discard(&mut self, file: &Path, discarded: bool) {
        if let Some(episode) = self.episodes.iter_mut().rfind(|episode| episode.file == file) {
            episode.discarded = discarded;
        }
    }

    pub(super) fn summary(self, end: &Snapshot) -> Summary {
        let seconds = end.taken.since(self.began).as_secs_f64();
        let row = |device: &DeviceStatus| {
            let before = self.before.iter().find(|before| before.id == device.id);
            let samples = device.samples - before.map_or(0, |before| before.samples).min(device.samples);
            let presence = self.present.get(device.id.index()).copied().unwrap_or_default();
            let sending = presence.sending(end.taken, device.newest, samples).as_secs_f64();
            let present = presence.until(end.taken).as_secs_f64();
            Row {
                device: device.name.clone(),
                bit: device.id.bit(),
                samples,
                hz: round(if sending > 0.0 { samples as f64 / sending } else { 0.0 }),
                present: round(if seconds > 0.0 { (present / seconds).min(1.0) } else { 0.0 }),
                gaps: device.gaps - before.map_or(0, |before| before.gaps).min(device.gaps),
                bytes: device.bytes - before.map_or(0, |before| before.bytes).min(device.bytes),
            }
        };
        Summary {
            seconds: round(seconds),
            devices: end.devices.iter().map(row).collect(),
            episodes: self.episodes,
            policy: self.policy_end.map(|sum| {
                let (policy, dry_run) = self.policy.unwrap_or_default();
                PolicyRow { policy, dry_run, sum }
            }),
            missed_events: self.missed,
        }
    }
}

/// Rounds to three decimals, the precision of a mean over seconds.
fn round(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

impl Summary {
    /// The summary for people: a table of the modalities, then the episodes.
    pub(super) fn text(&self, name: usize, palette: Palette) -> String {
        let width = name.max(8);
        let head = format!(
            "{:width$}  bit  {:>9}  {:>8}  {:>7}  {:>7}  {:>9}",
            "modality", "samples", "mean Hz", "present", "gaps", "bytes"
        );
        let mut lines = vec![String::new(), palette.faint(&head)];
        for row in &self.devices {
            let name = text::left(&text::plain(&row.device), width, "…");
            let gaps = format!("{:>7}", row.gaps);
            let gaps = if row.gaps > 0 { palette.warn(&gaps) } else { gaps };
            lines.push(format!(
                "{name}  {:>3}  {:>9}  {:>8}  {:>6.1}%  {gaps}  {:>9}",
                row.bit,
                row.samples,
                text::hertz(row.hz),
                row.present * 100.0,
                text::size(row.bytes)
            ));
        }
        for episode in &self.episodes {
            let file = text::plain(&episode.file.display().to_string()).into_owned();
            let dropped = format!("{} dropped", episode.dropped);
            let dropped = if episode.dropped > 0 { palette.warn(&dropped) } else { dropped };
            let grade = episode.verdict.grade;
            let trash = if episode.discarded { "  discarded" } else { "" };
            lines.push(format!(
                "{}  {}  {:.1} s  {} messages  {}  {dropped}  {}{trash}",
                palette.grade(grade, &format!("{:7}", grade.word())),
                palette.bold(&file),
                episode.seconds,
                episode.messages,
                text::size(episode.bytes),
                text::plain(&episode.verdict.remarks())
            ));
            // If an error caused a reason, the reason includes the error.
            let reasons = &episode.verdict.reasons;
            let why = if reasons.is_empty() { episode.error.as_slice() } else { reasons };
            lines.extend(why.iter().map(|reason| format!("         {}", text::plain(reason))));
        }
        if let Some(PolicyRow { policy, dry_run, sum }) = &self.policy {
            let dry = if *dry_run { format!("  {}", palette.warn("dry run")) } else { String::new() };
            lines.push(format!("policy   {}{dry}  {}", palette.bold(&text::plain(policy)), sum));
        }
        if self.missed_events > 0 {
            let events = text::counted(self.missed_events, "event");
            lines.push(palette.warn(&format!("{events} missing above: this output was behind")));
        }
        lines.push(format!("{} s in all", text::hertz(self.seconds)));
        lines.join("\n")
    }
}
