//! Events: state changes worth a line on a screen and a message in a recording, and the only place that turns them into
//! text. The log and a recording contain the sentence; lines in columns contain its parts.

use std::path::PathBuf;
use std::time::Duration;

use rapid_core::action::Arming;
use rapid_core::clip::ClipState;
use rapid_core::mask::SizedMask;
use rapid_core::modality::ModalityId;
use rapid_core::provenance::{KernelDriver, Negotiated, UnplugSource};
use rapid_core::sample::Epoch;
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_registry::device::Unit;
use serde::Serialize;

use super::{Chunk, DeviceState, Grade, Hold, Level, PolicyEnd, PrintedOn, StopStatus, Verdict};

/// A state change with its time. As JSON, one object: `{"event":"state","device":...}`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Event {
    /// When it happened, `CLOCK_MONOTONIC` ns.
    pub stamp: Stamp,
    /// What happened.
    #[serde(flatten)]
    pub what: EventKind,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum EventKind {
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
        /// Its kernel driver.
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
    /// A registered device was unplugged.
    Detach {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// What noticed the removal first.
        #[serde(rename = "witness")]
        source: UnplugSource,
    },
    /// A device changed its state.
    State {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// The new state.
        state: DeviceState,
        /// The mask after the change, in JSON `0x05`.
        mask: SizedMask,
        /// Why, or the settings agreed with the device.
        detail: String,
    },
    /// A device was plugged in that matches no entry of the registry.
    Unregistered {
        /// `vid:pid`, serial, product as the device reports them.
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
    Episode(EpisodeReport),
    /// An episode was moved to the trash.
    Discarded {
        /// The file, as it was.
        #[serde(serialize_with = "text::lossy")]
        file: PathBuf,
    },
    /// An episode was taken back from the trash.
    Restored {
        /// The file.
        #[serde(serialize_with = "text::lossy")]
        file: PathBuf,
    },
    /// A moment of the episode in progress was marked.
    Mark {
        /// What it is; may be empty.
        text: String,
    },
    /// The disk of the episode in progress is nearly full; reported once per episode.
    DiskLow {
        /// The folder.
        #[serde(serialize_with = "text::lossy")]
        folder: PathBuf,
        /// Free space on its disk, bytes.
        free: u64,
        /// Time until the episode will be closed at the present write rate.
        seconds: u64,
    },
    /// The wall clock was set. Capture times of an episode in progress stay on the previous clock.
    ClockStep {
        /// By how much, forward; back if negative.
        seconds: f64,
    },
    /// An episode that an earlier run did not finish was repaired.
    Recovered {
        /// The repaired file.
        #[serde(serialize_with = "text::lossy")]
        file: PathBuf,
        /// Length of the recorded data, in seconds.
        seconds: f64,
        /// Messages.
        messages: u64,
        /// Bytes of the unfinished file that are not in the repaired one.
        unread_bytes: u64,
        /// Chunks left out because their contents have changed since they were written.
        damaged_chunks: u64,
        /// What was kept and what is lost, for people.
        text: String,
    },
    /// A policy was loaded and starts running.
    Policy {
        /// Name given in its bundle.
        policy: String,
        /// Folder of the bundle.
        #[serde(serialize_with = "text::lossy")]
        folder: PathBuf,
        /// Identifies the bundle's contents.
        hash: String,
        /// The origin of onnxruntime.
        library: String,
        /// Ticks of its control grid a second.
        hz: f64,
        /// No action is executed.
        dry_run: bool,
    },
    /// The policy returned actions.
    Chunk(Box<Chunk>),
    /// The policy stops acting at this moment.
    Hold(Hold),
    /// The policy acts again, or for the first time.
    Act {
        /// Tick of the control grid.
        tick: u64,
    },
    /// The policy ended.
    PolicyEnd(PolicyEnd),
    /// The clock of a phone, or of the computer that a device is on, twice a second while its samples arrive.
    Clock {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// That clock minus the one here, ns.
        offset_ns: i64,
        /// How far that, and so the capture times since the last such event, may be wrong, either way, ns.
        uncertainty_ns: u64,
    },
    /// What a device that records by itself does about the episode in progress.
    Clip {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// What its own recording does.
        state: ClipState,
        /// Why, for people; may be empty.
        text: String,
    },
    /// An actuator was armed or disarmed, or disabled itself.
    Actuator {
        /// Modality.
        device: String,
        /// Its bit.
        bit: ModalityId,
        /// Whether it may move now.
        arming: Arming,
        /// It needs attention.
        is_problem: bool,
        /// What happened, for people.
        text: String,
    },
    /// The input of an emergency stop or an enabling switch has changed, or is lost.
    Stop(StopStatus),
    /// Another program publishes on a topic of the rig; reported once per episode for each topic and program.
    Publisher {
        /// The topic.
        topic: String,
        /// Its process.
        process: u32,
        /// The command line of the process.
        command: String,
    },
    /// A log line without an event of its own.
    Log {
        /// Severity.
        level: Level,
        /// Text.
        text: String,
    },
    /// A line of the log that a program of a device printed.
    #[serde(rename = "log")]
    Printed {
        /// Severity: `info`, since programs print greetings on either output.
        level: Level,
        /// Modality.
        device: String,
        /// On which output.
        printed: PrintedOn,
        /// The modality, the hook if it was one, and what was printed.
        text: String,
    },
}

/// How an episode ended.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpisodeReport {
    /// The file; its name still ends in `.partial` if it could not be finished.
    #[serde(serialize_with = "text::lossy")]
    pub file: PathBuf,
    /// Length in seconds.
    pub seconds: f64,
    /// Messages handed to the file.
    pub messages: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// Samples lost on the way to the file.
    pub dropped: u64,
    /// Why the file, or the episode in it, is not whole, if it is not.
    pub error: Option<String>,
    /// The verdict.
    #[serde(flatten)]
    pub verdict: Verdict,
}

/// The origin of the samples of one epoch of a modality.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Provenance {
    /// The incarnation; every sample's header names it.
    pub epoch: Epoch,
    /// Node, for example `/dev/video0`.
    pub node: String,
    /// When the unit was attached; a restart does not change it.
    pub attached: Stamp,
    /// The unit.
    #[serde(flatten)]
    pub unit: Unit,
    /// The settings agreed with it. The driver is the one found by hot-plug if the open node names none.
    #[serde(flatten)]
    pub negotiated: Negotiated,
    /// `latency` of the registry's entry, ns.
    pub latency_ns: u64,
}

impl EpisodeReport {
    /// Whether it ended early, but with a whole file.
    fn is_cut_short(&self) -> bool {
        self.error.is_some() && self.file.extension().is_some_and(|extension| extension == "mcap")
    }

    fn describe(&self) -> Description {
        let Self { file, seconds, messages, bytes, dropped, error, verdict } = self;
        let level = match (error, verdict.grade) {
            (None, Grade::Good) => Level::Info,
            (None, Grade::Suspect) => Level::Warn,
            (Some(_), _) | (None, Grade::Bad) => Level::Error,
        };
        let end = match error {
            None => "finished",
            Some(_) if self.is_cut_short() => "cut short",
            Some(_) => "not whole",
        };
        let remarks = Some(verdict.remarks()).filter(|remarks| !remarks.is_empty());
        let remarks = remarks.map(|remarks| format!(", {remarks}")).unwrap_or_default();
        // If an error caused a reason, the reason includes the error.
        let why = if verdict.reasons.is_empty() { error.clone().unwrap_or_default() } else { verdict.why() };
        let why = if why.is_empty() { why } else { format!(": {why}") };
        let (word, file, size) = (verdict.grade.word(), file.display(), text::size(*bytes));
        let sentence = format!(
            "{word} {file} {end}, {seconds:.1} s, {messages} messages, {size}, {dropped} dropped{remarks}{why}"
        );
        Description::new(level, "episode", word, sentence).without(&format!("{word} "))
    }
}

/// Number of digits that identify a bundle.
const HASH: usize = 12;

/// An event as text. Names of devices and files are included unchanged, with any control characters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Description {
    /// Its severity.
    pub level: Level,
    /// The device, or the stage.
    pub subject: String,
    /// The bit of the device, if it has one.
    pub bit: Option<ModalityId>,
    /// The event, in a word or two.
    pub word: &'static str,
    /// The complete sentence.
    pub sentence: String,
    /// Offset in `sentence` at which the detail starts.
    detail: usize,
}

impl Description {
    /// An independent sentence that starts with neither `subject` nor `word`.
    fn new(level: Level, subject: &str, word: &'static str, sentence: String) -> Self {
        Self { level, subject: subject.to_owned(), bit: None, word, sentence, detail: 0 }
    }

    /// The sentence "subject word", followed by `joint` and the rest.
    fn joined(level: Level, subject: &str, word: &'static str, joint: &str, rest: &str) -> Self {
        let mut sentence = format!("{subject} {word}");
        let detail = sentence.len() + joint.len();
        if !rest.is_empty() {
            sentence.push_str(joint);
            sentence.push_str(rest);
        }
        Self { level, subject: subject.to_owned(), bit: None, word, sentence, detail }
    }

    /// The detail starts after `prefix`, the start of the sentence.
    fn without(self, prefix: &str) -> Self {
        Self { detail: prefix.len(), ..self }
    }

    fn with_bit(self, bit: ModalityId) -> Self {
        Self { bit: Some(bit), ..self }
    }

    /// The sentence without `subject` and `word`.
    pub fn detail(&self) -> &str {
        self.sentence.get(self.detail..).unwrap_or_default()
    }
}

impl EventKind {
    /// The event as text.
    pub fn describe(&self) -> Description {
        use Description as D;
        match self {
            Self::Attach { device, bit, node, unit, .. } => {
                let serial = unit.serial().map(|serial| format!(", serial {serial}")).unwrap_or_default();
                let rest = format!("{node}, {}{serial}", unit.location());
                D::joined(Level::Info, device, "attached", ": ", &rest).with_bit(*bit)
            }
            Self::Opened { device, bit, provenance } => {
                let unit = provenance.unit.serial().unwrap_or("without a serial number");
                let rest = format!("epoch {}: unit {unit}", provenance.epoch.0);
                D::joined(Level::Info, device, "opened", " in ", &rest).with_bit(*bit)
            }
            Self::Detach { device, bit, source } => {
                let rest = format!("({})", source.word());
                D::joined(Level::Warn, device, "detached", " ", &rest).with_bit(*bit)
            }
            Self::State { device, bit, state, mask, detail } => {
                let detail = if detail.is_empty() { String::new() } else { format!(": {detail}") };
                let rest = format!("mask {mask}{detail}");
                D::joined(state.level(), device, state.word(), ", ", &rest).with_bit(*bit)
            }
            Self::Unregistered { device, reason } => {
                D::new(Level::Info, "device", "unregistered", format!("{device} not registered: {reason}"))
            }
            Self::Policy { policy, hash, hz, dry_run, library, .. } => {
                let (word, dry) = if *dry_run { ("dry run", ", dry run: nothing moves") } else { ("loaded", "") };
                let hash: String = hash.chars().take(HASH).collect();
                let sentence = format!("policy {policy} loaded: {hz} Hz, hash {hash}, onnxruntime {library}{dry}");
                D::new(Level::Info, "policy", word, sentence).without("policy ")
            }
            Self::Chunk(chunk) => describe_chunk(chunk),
            Self::Hold(hold) => D::joined(Level::Warn, "policy", "holds", ": ", &hold.to_string()),
            Self::Act { tick } => D::joined(Level::Info, "policy", "acts", " ", &format!("from tick {tick}")),
            Self::PolicyEnd(end) => D::joined(Level::Info, "policy", "ended", ": ", &end.to_string()),
            Self::Recording { file } => {
                D::new(Level::Info, "episode", "recording", format!("recording {}", file.display()))
                    .without("recording ")
            }
            Self::Episode(end) => end.describe(),
            Self::Discarded { file } => {
                D::new(Level::Info, "episode", "discarded", format!("episode {} is in the trash", file.display()))
            }
            Self::Restored { file } => {
                D::new(Level::Info, "episode", "restored", format!("episode {} is back", file.display()))
            }
            Self::Mark { text } => {
                let text = if text.is_empty() { String::new() } else { format!(" {text:?}") };
                D::new(Level::Info, "episode", "mark", format!("mark{text}"))
            }
            // Data was lost before this run began.
            Self::Recovered { text, .. } => D::new(Level::Warn, "episode", "repaired", text.clone()),
            Self::DiskLow { folder, free, seconds } => {
                let (free, left) = (text::size(*free), text::about(Duration::from_secs(*seconds)));
                let folder = folder.display();
                let sentence =
                    format!("{folder}: disk nearly full, {free} free: the episode will be closed in about {left}");
                D::new(Level::Warn, "disk", "warn", sentence)
            }
            Self::ClockStep { seconds } => {
                let (direction, by) = (if *seconds < 0.0 { "back" } else { "forward" }, seconds.abs());
                let sentence =
                    format!("the wall clock was set {direction} by {by:.3} s; times of capture stay as they are");
                D::new(Level::Warn, "clock", "warn", sentence)
            }
            Self::Clock { device, bit, offset_ns, uncertainty_ns } => {
                let (offset, within) = (*offset_ns as f64 / 1e9, *uncertainty_ns as f64 / 1e6);
                let rest = format!("of the device is {offset:+.6} s from this one, within {within:.3} ms");
                D::joined(Level::Debug, device, "clock", " ", &rest).with_bit(*bit)
            }
            Self::Clip { device, bit, state, text } => {
                let level = match state {
                    ClipState::Asked => Level::Debug,
                    ClipState::Recording => Level::Info,
                    ClipState::Refused | ClipState::Stopped => Level::Warn,
                };
                let rest = if text.is_empty() { String::new() } else { format!(": {text}") };
                D::joined(level, device, "clip", " ", &format!("{}{rest}", state.word())).with_bit(*bit)
            }
            Self::Actuator { device, bit, arming, is_problem, text } => {
                let prefix = format!("{device}: ");
                let sentence = format!("{prefix}{text}");
                D::new(warn_if(*is_problem), device, arming.word(), sentence).without(&prefix).with_bit(*bit)
            }
            Self::Stop(stop) => D::new(warn_if(stop.is_problem()), &stop.stop, stop.word(), stop.sentence()),
            Self::Publisher { topic, process, command } => {
                let sentence = format!("another program publishes on {topic}: process {process} ({command}); end it");
                D::new(Level::Warn, "bus", "warn", sentence)
            }
            Self::Log { level, text } => D::new(*level, "log", level.word(), text.clone()),
            Self::Printed { level, device, printed, text } => {
                let described = D::new(*level, device, printed.word(), text.clone());
                if text.starts_with(&format!("{device}: ")) {
                    described.without(&format!("{device}: "))
                } else {
                    described
                }
            }
        }
    }

    /// The event as a log line. `None` if the following event includes it, and for a chunk that was on time.
    pub fn log_line(&self) -> Option<(Level, String)> {
        let described = self.describe();
        let is_silent = match self {
            // The state of the device changes with the first two; that event names the source or the agreed settings. The last
            // is a measurement, twice a second.
            Self::Detach { .. } | Self::Opened { .. } | Self::Clock { .. } => true,
            // A policy produces them continuously.
            Self::Chunk(chunk) => chunk.skipped == 0,
            _ => false,
        };
        (!is_silent).then_some((described.level, described.sentence))
    }

    /// The device that the event is about, and on which output a program printed it, if one did.
    pub(super) fn source(&self) -> (Option<&str>, Option<PrintedOn>) {
        match self {
            Self::Attach { device, .. }
            | Self::Opened { device, .. }
            | Self::Detach { device, .. }
            | Self::State { device, .. }
            | Self::Clock { device, .. }
            | Self::Clip { device, .. }
            | Self::Actuator { device, .. } => (Some(device), None),
            Self::Printed { device, printed, .. } => (Some(device), Some(*printed)),
            _ => (None, None),
        }
    }
}

fn warn_if(is_problem: bool) -> Level {
    if is_problem { Level::Warn } else { Level::Info }
}

fn describe_chunk(chunk: &Chunk) -> Description {
    let (level, word, late) = match chunk.skipped {
        0 => (Level::Debug, "chunk", String::new()),
        1 => (Level::Warn, "late chunk", ", 1 action too late".to_owned()),
        late => (Level::Warn, "late chunk", format!(", {late} actions too late")),
    };
    let sentence = format!("chunk of tick {}: {:.1} ms{late}, mask {}", chunk.tick, chunk.latency_ms, chunk.mask);
    Description::new(level, "policy", word, sentence).without("chunk of ")
}

#[cfg(test)]
mod tests {
    use rapid_core::mask::{PhysicalMask, SizedMask};
    use rapid_core::provenance::UnplugSource;

    use super::*;
    use crate::DeviceState;

    #[test]
    fn a_state_is_a_sentence_in_the_log() {
        let bit = ModalityId::new(1).expect("below 64");
        let state = |state, detail: &str| EventKind::State {
            device: "tactile_tip".into(),
            bit,
            state,
            mask: SizedMask { mask: PhysicalMask(5), devices: 3 },
            detail: detail.into(),
        };
        let table = [
            (
                state(DeviceState::Absent, "unplugged (kernel)"),
                Level::Info,
                "tactile_tip absent, mask 0x05: unplugged (kernel)",
            ),
            (state(DeviceState::Streaming, ""), Level::Info, "tactile_tip streaming, mask 0x05"),
            (state(DeviceState::Failed, "busy"), Level::Error, "tactile_tip failed, mask 0x05: busy"),
        ];
        for (what, level, text) in table {
            assert_eq!(what.log_line(), Some((level, text.to_owned())));
        }
        let detach = EventKind::Detach { device: "tactile_tip".into(), bit, source: UnplugSource::Kernel };
        assert_eq!((detach.log_line(), detach.describe().detail()), (None, "(kernel)"));
    }
}
