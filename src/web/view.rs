//! What the page shows of a snapshot.
//!
//! Invariant: pure. Equal views are equal texts: what changes without news, such as the age of a sample, is not in it.

use rapid_core::modality::ModalityId;
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_status::rates::Rates;
use rapid_status::session::{EpisodeEntry, Phase, SessionStatus};
use rapid_status::{DeviceStatus, Finding, Level, RecordingStatus, Snapshot, StopStatus};
use serde::Serialize;

/// Warnings and errors of the log, at most.
const WARNINGS: usize = 4;

/// See the module's comment. Times and sizes are texts for people.
#[derive(Debug, Serialize)]
pub(super) struct View<'a> {
    rig: &'a str,
    is_simulated: bool,
    /// Ascending.
    bits: Vec<Bit<'a>>,
    /// Emergency stops that stop, and inputs that are lost.
    stops: Vec<String>,
    policy: Option<String>,
    phase: &'static str,
    /// Seconds until it ends by itself.
    begins_in: Option<u64>,
    recording: Option<Recording>,
    not_started: Option<&'a str>,
    /// The episode in progress.
    current: Option<&'a str>,
    /// The episode that is shown, and that labels and discards are about: the one in progress, or the last that is kept.
    about: Option<&'a EpisodeEntry>,
    session: Option<Progress<'a>>,
    disk_free: Option<String>,
    /// The newest first.
    warnings: Vec<Warning<'a>>,
}

#[derive(Debug, Serialize)]
struct Bit<'a> {
    #[serde(rename = "bit")]
    id: ModalityId,
    name: &'a str,
    is_set: bool,
    state: &'static str,
    detail: &'a str,
    hz: f64,
    is_camera: bool,
}

#[derive(Debug, Serialize)]
struct Recording {
    time: String,
    size: String,
    dropped: u64,
    disk_full_in: Option<String>,
    verdict: &'static str,
    reasons: Vec<String>,
}

#[derive(Debug, Serialize)]
struct Progress<'a> {
    task: &'a str,
    count: String,
    verdicts: [usize; 3],
    discarded: usize,
}

#[derive(Debug, Serialize)]
struct Warning<'a> {
    /// Since 1970.
    ms: u64,
    level: Level,
    text: &'a str,
}

impl<'a> View<'a> {
    /// What is shown of this snapshot; `cameras` are the modalities whose samples are pictures.
    pub(super) fn new(snapshot: &'a Snapshot, rates: &Rates, cameras: &[ModalityId]) -> Self {
        let session = snapshot.session.as_ref();
        let phase = session.map(|session| session.phase).unwrap_or_default();
        let is_current = matches!(phase, Phase::Recording | Phase::Ending);
        let current = session.and_then(|session| session.episodes.last()).filter(|_| is_current);
        let warnings = snapshot.log.iter().rev().filter(|line| line.level >= Level::Warn).take(WARNINGS);
        Self {
            rig: &snapshot.rig,
            is_simulated: snapshot.simulated,
            bits: snapshot.devices.iter().map(|device| bit(device, snapshot, rates, cameras)).collect(),
            stops: snapshot.stops.iter().filter(|stop| stop.is_problem()).map(StopStatus::sentence).collect(),
            policy: snapshot.policy.as_ref().and_then(|policy| {
                policy.hold.as_ref().map(|hold| format!("the policy {} holds: {hold}", policy.name))
            }),
            phase: word(phase),
            begins_in: until(phase).map(|until| until.since(snapshot.taken).as_millis().div_ceil(1000)).map(saturated),
            recording: snapshot.recording.as_ref().map(recording),
            not_started: snapshot.not_started.as_deref(),
            current: current.map(|entry| &*entry.file),
            about: current.or_else(|| session.and_then(last)),
            session: session.map(progress),
            disk_free: snapshot.disk_free.map(text::size),
            warnings: warnings
                .map(|line| Warning { ms: line.wall_ns / 1_000_000, level: line.level, text: &line.text })
                .collect(),
        }
    }
}

fn saturated(seconds: u128) -> u64 {
    u64::try_from(seconds).unwrap_or(u64::MAX)
}

fn bit<'a>(device: &'a DeviceStatus, snapshot: &Snapshot, rates: &Rates, cameras: &[ModalityId]) -> Bit<'a> {
    let hz = rates.samples(device.id);
    Bit {
        id: device.id,
        name: &device.name,
        is_set: snapshot.mask.contains(device.id),
        state: device.state.word(),
        detail: &device.detail,
        // A figure that people can read: 29.97 and 30.02 are equal.
        hz: if hz < 10.0 { (hz * 10.0).round() / 10.0 } else { hz.round() },
        is_camera: cameras.contains(&device.id),
    }
}

fn recording(recording: &RecordingStatus) -> Recording {
    Recording {
        time: text::clock(recording.elapsed),
        size: text::size(recording.bytes),
        dropped: recording.dropped,
        disk_full_in: recording.room.map(text::clock),
        verdict: recording.outlook.grade().word(),
        reasons: recording.outlook.findings.iter().map(Finding::sentence).collect(),
    }
}

fn progress(session: &SessionStatus) -> Progress<'_> {
    let SessionStatus { task, verdicts, discarded, .. } = session;
    Progress { task, count: session.progress(), verdicts: *verdicts, discarded: *discarded }
}

/// The newest episode that is closed and kept.
fn last(session: &SessionStatus) -> Option<&EpisodeEntry> {
    session.episodes.iter().rev().find(|entry| entry.seconds.is_some() && !entry.discarded)
}

const fn word(phase: Phase) -> &'static str {
    match phase {
        Phase::Idle => "idle",
        Phase::Countdown { .. } => "countdown",
        Phase::Recording => "recording",
        Phase::Ending => "ending",
        Phase::Reset { .. } => "reset",
    }
}

const fn until(phase: Phase) -> Option<Stamp> {
    match phase {
        Phase::Countdown { until } | Phase::Reset { until } => Some(until),
        Phase::Idle | Phase::Recording | Phase::Ending => None,
    }
}

#[cfg(test)]
mod tests {
    use crate::literal::{TAKEN, every_state, id, recording, three_streaming};
    use rapid_status::{Grade, Outlook};

    use super::*;
    use std::time::Duration;

    fn shown(snapshot: &Snapshot) -> serde_json::Value {
        serde_json::to_value(View::new(snapshot, &Rates::default(), &[id(0), id(1)])).unwrap()
    }

    #[test]
    fn bits_are_those_of_the_mask_with_the_reason_of_their_state() {
        let view = shown(&every_state());
        let bits: Vec<_> = view["bits"]
            .as_array()
            .unwrap()
            .iter()
            .map(|bit| (bit["bit"].as_u64().unwrap(), bit["is_set"].as_bool().unwrap(), bit["state"].as_str().unwrap()))
            .collect();
        let expected = [
            (0, true, "streaming"),
            (1, false, "absent"),
            (2, false, "opening"),
            (3, true, "stalled"),
            (4, false, "failed"),
            (5, false, "backoff"),
        ];
        assert_eq!(bits, expected);
        assert_eq!(view["bits"][3]["detail"], "no sample for 500 ms");
        assert_eq!((&view["bits"][1]["is_camera"], &view["bits"][2]["is_camera"]), (&true.into(), &false.into()));
        let warnings: Vec<_> =
            view["warnings"].as_array().unwrap().iter().map(|one| one["text"].as_str().unwrap()).collect();
        assert_eq!(warnings, ["gripper: permission denied", "imu: no sample for 500 ms"]);
    }

    #[test]
    fn an_episode_in_progress_is_named_with_its_verdict_so_far() {
        let mut snapshot = three_streaming();
        let mut entry = EpisodeEntry::begin("a_001.mcap".to_owned(), String::new());
        entry.seconds = Some(4.0);
        let kept = entry.clone();
        entry.discarded = true;
        let begun = EpisodeEntry::begin("a_003.mcap".to_owned(), String::new());
        let episodes = vec![kept, EpisodeEntry { file: "a_002.mcap".to_owned(), ..entry }, begun];
        snapshot.session = Some(SessionStatus {
            episodes,
            phase: Phase::Recording,
            counted: 1,
            goal: Some(5),
            ..SessionStatus::default()
        });
        let finding = Finding { grade: Grade::Suspect, modality: Some("tof".to_owned()), text: "late".to_owned() };
        snapshot.recording = Some(RecordingStatus { outlook: Outlook { findings: vec![finding] }, ..recording(0) });
        let view = shown(&snapshot);
        assert_eq!((&view["current"], &view["about"]["file"]), (&"a_003.mcap".into(), &"a_003.mcap".into()));
        // Once it has ended in the trash, the last that is kept is shown.
        let session = snapshot.session.as_mut().unwrap();
        (session.phase, session.episodes[2].discarded) = (Phase::Idle, true);
        let idle = shown(&snapshot);
        assert_eq!((&idle["current"], &idle["about"]["file"]), (&serde_json::Value::Null, &"a_001.mcap".into()));
        assert_eq!(
            (&view["recording"]["verdict"], &view["recording"]["reasons"][0]),
            (&"SUSPECT".into(), &"tof: late".into())
        );
        assert_eq!((&view["recording"]["time"], &view["session"]["count"]), (&"01:23".into(), &"1 of 5".into()));
    }

    #[test]
    fn what_is_not_new_changes_nothing() {
        let mut snapshot = three_streaming();
        let before = shown(&snapshot);
        snapshot.taken = TAKEN.after(Duration::from_millis(100));
        snapshot.mask_sequence += 50;
        snapshot.devices[0].newest = Some(TAKEN);
        assert_eq!(shown(&snapshot), before);
        // A countdown is news each second.
        let until = TAKEN.after(Duration::from_millis(2500));
        snapshot.session = Some(SessionStatus { phase: Phase::Countdown { until }, ..SessionStatus::default() });
        assert_eq!((&shown(&snapshot)["phase"], &shown(&snapshot)["begins_in"]), (&"countdown".into(), &3.into()));
    }
}
