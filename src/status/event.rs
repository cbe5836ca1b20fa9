//! Events: state changes worth a line on a screen and a message in a recording.

use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;

use super::{Chunk, Grade, Level, SlotState, StopStatus, Verdict};
use crate::action::Arming;
use crate::modality::ModalityId;
use crate::provenance::{KernelDriver, Negotiated};
use crate::registry::Unit;
use crate::sample::Epoch;
use crate::text;
use crate::time::Stamp;

/// A state change, with its moment. As JSON, one object: `{"event":"state","device":...}`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Event {
    /// When it happened, `CLOCK_MONOTONIC` ns.
    pub stamp: Stamp,
    /// What happened.
    #[serde(flatten)]
    pub what: What,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum What {
    /// A registered device was plugged in.
    Attach {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// Node, for example `/dev/video0`.
        node: String,
        /// The unit.
        #[serde(flatten)]
        unit: Unit,
        /// The kernel's driver of it.
        driver: Option<KernelDriver>,
    },
    /// A registered device was opened, in a new epoch: its samples come from this unit.
    Opened {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// Where its samples come from.
        #[serde(flatten)]
        provenance: Box<Provenance>,
    },
    /// A registered device was pulled out.
    Detach {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// Who told first: `stream`, `kernel`, `udev`, `enumeration`, `link`, `goodbye`, `lease` or `script`.
        witness: String,
    },
    /// A slot changed its state.
    State {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// The new state.
        state: SlotState,
        /// The mask after the change, `0x05`.
        mask: String,
        /// Why, or what was agreed with the device.
        detail: String,
    },
    /// Something was plugged in that no entry of the registry means.
    Unregistered {
        /// `vid:pid`, serial, product as the device says.
        device: String,
        /// Why no entry matches.
        reason: String,
    },
    /// An episode began.
    Recording {
        /// The file being written, with its final name.
        #[serde(serialize_with = "text::lossy")]
        file: PathBuf,
    },
    /// An episode ended and its file is closed.
    Episode {
        /// The file; `.partial` remains at its end if it could not be finished.
        #[serde(serialize_with = "text::lossy")]
        file: PathBuf,
        /// Length in seconds.
        seconds: f64,
        /// Messages.
        messages: u64,
        /// Bytes of the file.
        bytes: u64,
        /// Samples lost on the way to the file.
        dropped: u64,
        /// Why the file is not whole, if it is not.
        error: Option<String>,
        /// What it is worth.
        #[serde(flatten)]
        verdict: Verdict,
    },
    /// An episode too short to be used was dropped, as the user asked: its file is gone.
    Dropped {
        /// The file.
        #[serde(serialize_with = "text::lossy")]
        file: PathBuf,
        /// Length in seconds.
        seconds: f64,
    },
    /// The disk of the episode in progress is nearly full; told once an episode.
    DiskLow {
        /// The folder.
        #[serde(serialize_with = "text::lossy")]
        folder: PathBuf,
        /// What is free on its disk, bytes.
        free: u64,
        /// Until the episode will be closed, at the rate it is written with.
        seconds: u64,
    },
    /// The wall clock was set. Capture times of an episode in progress go on by the clock it began with.
    ClockStep {
        /// By how much, forward; back if negative.
        seconds: f64,
    },
    /// An episode that an earlier run did not finish was repaired.
    Recovered {
        /// The repaired file.
        #[serde(serialize_with = "text::lossy")]
        file: PathBuf,
        /// Length of what was recorded, in seconds.
        seconds: f64,
        /// Messages.
        messages: u64,
        /// Bytes of the unfinished file that are not in the repaired one.
        unread_bytes: u64,
        /// Chunks left out because they are not what was written.
        damaged_chunks: u64,
        /// What is there and what is lost, for people.
        text: String,
    },
    /// A policy was loaded and runs from now on.
    Policy {
        /// What its bundle calls itself.
        policy: String,
        /// Folder of the bundle.
        #[serde(serialize_with = "text::lossy")]
        folder: PathBuf,
        /// Names the bundle's contents.
        hash: String,
        /// Where onnxruntime comes from.
        library: String,
        /// Ticks of its control grid a second.
        hz: f64,
        /// Nothing is carried out.
        dry_run: bool,
    },
    /// The policy gave actions.
    Chunk(Box<Chunk>),
    /// The policy does nothing from this moment on.
    Hold {
        /// The modality whose absence is the reason, or empty.
        device: String,
        /// Why.
        reason: String,
    },
    /// The policy acts again, or for the first time.
    Act {
        /// Tick of the control grid.
        tick: u64,
    },
    /// The policy ended.
    PolicyEnd {
        /// Ticks with an action.
        actions: u64,
        /// Ticks without.
        held: u64,
        /// Chunks that were used.
        chunks: u64,
        /// Answers that were not used or never came.
        unused: u64,
        /// From the observation to the chunk, ms: half of them were faster.
        latency_p50_ms: f64,
        /// Of a hundred one was slower.
        latency_p99_ms: f64,
    },
    /// An actuator was armed or disarmed, or disabled itself.
    Actuator {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// May it move now?
        arming: Arming,
        /// Somebody should look after it.
        is_problem: bool,
        /// What happened, for people.
        text: String,
    },
    /// The input of an emergency stop or an enabling switch says something else than before, or is lost.
    Stop(StopStatus),
    /// Another program publishes on a topic of ours; once an episode for each topic and program.
    Publisher {
        /// The topic.
        topic: String,
        /// Its process.
        process: u32,
        /// The command line of the process.
        command: String,
    },
    /// A line of the log that has no event of its own.
    Log {
        /// Severity.
        level: Level,
        /// Text.
        text: String,
    },
}

/// Where the samples of one epoch of a modality come from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Provenance {
    /// The incarnation; every sample's header names it.
    pub epoch: Epoch,
    /// Node, for example `/dev/video0`.
    pub node: String,
    /// When the unit was attached: one that was started again is still the same attachment.
    pub attached: Stamp,
    /// The unit.
    #[serde(flatten)]
    pub unit: Unit,
    /// What was agreed with it. The driver is hot-plug's where the open node names none.
    #[serde(flatten)]
    pub negotiated: Negotiated,
    /// `latency` of the registry's entry, ns.
    pub latency_ns: u64,
}

impl What {
    /// Did an episode end before its time, with a file that is whole all the same?
    #[must_use]
    pub fn is_cut_short(&self) -> bool {
        let Self::Episode { file, error: Some(_), .. } = self else { return false };
        file.extension().is_some_and(|extension| extension == "mcap")
    }

    /// The event as a line of the log; `None` where the event that follows says it all.
    #[must_use]
    pub fn sentence(&self) -> Option<(Level, String)> {
        Some(match self {
            Self::Attach { device, node, unit, .. } => {
                let serial = unit.serial().map(|serial| format!(", serial {serial}")).unwrap_or_default();
                (Level::Info, format!("{device} attached ({node} at {}{serial})", unit.location()))
            }
            // The slot's state changes with it and names the witness, or what was agreed.
            Self::Detach { .. } | Self::Opened { .. } => return None,
            Self::State { device, state, detail, .. } => {
                let level = match state {
                    SlotState::Failed => Level::Error,
                    SlotState::Stalled | SlotState::Backoff => Level::Warn,
                    SlotState::Absent | SlotState::Opening | SlotState::Streaming => Level::Info,
                };
                let state = state.word();
                let text = if detail.is_empty() {
                    format!("{device} {state}")
                } else {
                    format!("{device} {state} ({detail})")
                };
                (level, text)
            }
            Self::Unregistered { device, reason } => (Level::Info, format!("{device} is not used: {reason}")),
            Self::Policy { policy, hz, dry_run, library, .. } => {
                let dry = if *dry_run { ", dry run: nothing moves" } else { "" };
                (Level::Info, format!("policy {policy} loaded: {hz} Hz, onnxruntime {library}{dry}"))
            }
            Self::Chunk(chunk) => {
                let late = match chunk.skipped {
                    0 => String::new(),
                    1 => ", 1 action too late".to_owned(),
                    late => format!(", {late} actions too late"),
                };
                let text =
                    format!("chunk of tick {}: {:.1} ms{late}, mask {}", chunk.tick, chunk.latency_ms, chunk.mask);
                (if chunk.skipped > 0 { Level::Warn } else { Level::Debug }, text)
            }
            Self::Hold { device, reason } => {
                let device = if device.is_empty() { String::new() } else { format!(": {device}") };
                (Level::Warn, format!("policy holds: {reason}{device}"))
            }
            Self::Act { tick } => (Level::Info, format!("policy acts from tick {tick}")),
            Self::PolicyEnd { actions, held, chunks, unused, latency_p50_ms, latency_p99_ms } => {
                let text = format!(
                    "policy ended: {actions} actions, {held} ticks held, {chunks} chunks, {unused} unused, latency p50 \
                     {latency_p50_ms:.1} ms p99 {latency_p99_ms:.1} ms"
                );
                (Level::Info, text)
            }
            Self::Recording { file } => (Level::Info, format!("recording {}", file.display())),
            Self::Episode { file, seconds, error: Some(error), verdict, .. } => {
                let word = if self.is_cut_short() { "cut short" } else { "not whole" };
                let grade = verdict.grade.word();
                let (file, sensors) = (file.display(), with_comma(verdict));
                (Level::Error, format!("{grade} {file} is {word} after {seconds:.1} s{sensors}: {error}"))
            }
            Self::Episode { file, seconds, error: None, verdict, .. } => {
                let level = match verdict.grade {
                    Grade::Good => Level::Info,
                    Grade::Suspect => Level::Warn,
                    Grade::Bad => Level::Error,
                };
                let (file, word) = (file.display(), verdict.grade.word());
                let why = if verdict.reasons.is_empty() { String::new() } else { format!(": {}", verdict.why()) };
                (level, format!("{word} {file} finished, {seconds:.1} s{}{why}", with_comma(verdict)))
            }
            Self::Dropped { file, seconds } => {
                (Level::Info, format!("episode {} dropped; it was {seconds:.1} s long", file.display()))
            }
            Self::DiskLow { folder, free, seconds } => {
                let (free, left) = (text::size(*free), text::about(Duration::from_secs(*seconds)));
                let folder = folder.display();
                let text =
                    format!("{folder}: disk nearly full, {free} free: the episode will be closed in about {left}");
                (Level::Warn, text)
            }
            Self::ClockStep { seconds } => {
                let direction = if *seconds < 0.0 { "back" } else { "forward" };
                let by = seconds.abs();
                (
                    Level::Warn,
                    format!("the wall clock was set {direction} by {by:.3} s; times of capture stay as they are"),
                )
            }
            // Something was lost before this run began.
            Self::Recovered { text, .. } => (Level::Warn, text.clone()),
            Self::Actuator { device, is_problem, text, .. } => {
                (if *is_problem { Level::Warn } else { Level::Info }, format!("{device}: {text}"))
            }
            Self::Stop(stop) => (if stop.is_problem() { Level::Warn } else { Level::Info }, stop.sentence()),
            Self::Publisher { topic, process, command } => {
                let text = format!("another program publishes on {topic}: process {process} ({command}); end it");
                (Level::Warn, text)
            }
            Self::Log { level, text } => (*level, text.clone()),
        })
    }
}

/// Which sensors took part, behind a comma; nothing if unknown.
fn with_comma(verdict: &Verdict) -> String {
    verdict.sensors.as_ref().map(|sensors| format!(", {sensors}")).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_is_a_sentence_of_the_log() {
        let bit = ModalityId::new(1).expect("below 64");
        let state = |state, detail: &str| What::State {
            device: "tactile_tip".into(),
            bit,
            state,
            mask: "0x05".into(),
            detail: detail.into(),
        };
        let table = [
            (
                state(SlotState::Absent, "unplugged, told by kernel"),
                Level::Info,
                "tactile_tip absent (unplugged, told by kernel)",
            ),
            (state(SlotState::Streaming, ""), Level::Info, "tactile_tip streaming"),
            (state(SlotState::Failed, "busy"), Level::Error, "tactile_tip failed (busy)"),
        ];
        for (what, level, text) in table {
            assert_eq!(what.sentence(), Some((level, text.to_owned())));
        }
        let detach = What::Detach { device: "tactile_tip".into(), bit, witness: "kernel".into() };
        assert_eq!(detach.sentence(), None);
    }
}
