//! Status: the only types that stages and screens share.
//!
//! Stages report on the [`board`]; a screen takes a [`Snapshot`] from it and sends [`Command`]s.
//!
//! Invariant: a screen holds no handle into a stage.
//! Invariant: there is no verdict by default. GOOD is a result of `record::verdict`.

pub mod attach;
pub mod board;
pub mod detail;
mod event;
#[cfg(test)]
#[path = "../../tests/support/literal.rs"]
mod literal;
pub mod palette;
pub mod preview;
pub mod rates;
pub mod session;
pub mod stops;

#[cfg(test)]
extern crate self as rapid_status;

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rapid_core::interlock::{InputState, StopKind};
use rapid_core::mask::{PhysicalMask, SizedMask};
use rapid_core::modality::ModalityId;
use rapid_core::sample::Epoch;
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_registry::{InterlockSpec, Registry};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use tokio::sync::{SetOnce, watch};

use detail::DeviceDetail;
use preview::Preview;
use session::{Answered, SessionRequest, SessionStatus};

pub use board::{Board, EpisodeCounts};
pub use event::Description;
pub use event::{EpisodeReport, Event, EventKind, Provenance};

/// Creates an enum whose values have words: `word` returns it, and JSON uses it.
macro_rules! words {
    ($(#[$meta:meta])* $name:ident { $($(#[$of:meta])* $value:ident = $word:literal,)+ }) => {
        $(#[$meta])*
        pub enum $name {
            $($(#[$of])* #[serde(rename = $word)] $value,)+
        }

        impl $name {
            /// The word for it, as in JSON.
            pub const fn word(self) -> &'static str {
                match self {
                    $(Self::$value => $word,)+
                }
            }
        }
    };
}

words! {
    /// What the device of a modality is doing.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
    DeviceState {
        /// Not attached.
        #[default]
        Absent = "absent",
        /// Attached; its first sample has not arrived.
        Opening = "opening",
        /// Samples arrive.
        Streaming = "streaming",
        /// Attached and started, but samples have stopped. The mask bit stays.
        Stalled = "stalled",
        /// Attached; waiting for a start or restart.
        Backoff = "backoff",
        /// Attached; given up until a replug or a manual restart.
        Failed = "failed",
    }
}

impl DeviceState {
    /// Whether the bit of such a device is set in the physical mask. A stalled device is attached and running.
    #[must_use]
    pub const fn is_present(self) -> bool {
        matches!(self, Self::Streaming | Self::Stalled)
    }

    /// Severity of a change to this state.
    pub const fn level(self) -> Level {
        match self {
            Self::Absent | Self::Opening | Self::Streaming => Level::Info,
            Self::Stalled | Self::Backoff => Level::Warn,
            Self::Failed => Level::Error,
        }
    }
}

/// One row of the device table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeviceStatus {
    /// Name of the modality.
    pub name: String,
    /// Its bit.
    pub id: ModalityId,
    /// Topic.
    pub topic: String,
    /// State of the device.
    pub state: DeviceState,
    /// Incarnation.
    pub epoch: Epoch,
    /// Node in use and agreed format, or the reason of the state.
    pub detail: String,
    /// Samples per second that it should send, if known.
    pub nominal_hz: Option<f64>,
    /// Samples since the start of the run.
    pub samples: u64,
    /// Samples lost between device and bus, as counted by the device or kernel.
    pub gaps: u64,
    /// Payload bytes since the start of the run.
    pub bytes: u64,
    /// Capture time of the newest sample.
    pub newest: Option<Stamp>,
}

/// A connected unit that no entry matches and that a driver could read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UnregisteredDevice {
    /// The unit for people, unique among connected units: model, port, serial number, product.
    pub device: String,
    /// The value of `node` in an entry that would read it: `camera`, `serial`, `can` or `lan`.
    pub node: String,
    /// A name for its entry, if the unit suggests one.
    pub name: Option<String>,
}

/// The recording in progress.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordingStatus {
    /// The file being written.
    #[serde(serialize_with = "text::lossy")]
    pub file: PathBuf,
    /// Time since the episode began.
    pub elapsed: Duration,
    /// Messages written.
    pub messages: u64,
    /// Payload bytes written.
    pub bytes: u64,
    /// Samples the recorder lost because its queue overflowed.
    pub dropped: u64,
    /// While the disk is nearly full: time until the episode is closed for lack of disk space.
    pub room: Option<Duration>,
    /// What it would be judged if it ended now.
    pub outlook: Outlook,
}

/// What an episode in progress would be judged if it ended now. Without a finding, as in its first second, it is GOOD.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Outlook {
    /// The most severe first.
    pub findings: Vec<Finding>,
}

impl Outlook {
    /// The grade.
    pub fn grade(&self) -> Grade {
        self.findings.first().map_or(Grade::Good, |finding| finding.grade)
    }

    /// The most severe finding against a modality.
    pub fn finding(&self, modality: &str) -> Option<&Finding> {
        self.findings.iter().find(|finding| finding.modality.as_deref() == Some(modality))
    }
}

/// A failed check of an episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// How severe it is.
    pub grade: Grade,
    /// The modality that it is about, if it is about one.
    pub modality: Option<String>,
    /// Figure and limit, for people.
    pub text: String,
}

impl Finding {
    /// As a reason of a [`Verdict`].
    pub fn sentence(&self) -> String {
        match &self.modality {
            Some(modality) => format!("{modality}: {}", self.text),
            None => self.text.clone(),
        }
    }
}

/// A line of the log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogLine {
    /// Its place in the log of the run, from 0.
    pub number: u64,
    /// Wall time, ns since 1970.
    pub wall_ns: u64,
    /// Severity.
    pub level: Level,
    /// The device that it is about, if it is about one.
    pub device: Option<String>,
    /// Which output of a program printed it; `None` if `rapid` wrote it.
    pub printed: Option<PrintedOn>,
    /// Text, without control characters.
    pub text: String,
}

words! {
    /// The two outputs of a program.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    PrintedOn {
        /// Standard output.
        Stdout = "stdout",
        /// Standard error.
        Stderr = "stderr",
    }
}

words! {
    /// Severity of a log line.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    Level {
        /// Details.
        Debug = "debug",
        /// A state change a user cares about.
        Info = "info",
        /// Something is wrong, and the run continues.
        Warn = "warn",
        /// Something ended that should not have.
        Error = "error",
    }
}

/// Everything a screen may show, copied at one moment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Name of the rig.
    pub rig: String,
    /// When this was taken.
    pub taken: Stamp,
    /// Time since `rapid` started.
    pub uptime: Duration,
    /// The mask as published.
    pub mask: PhysicalMask,
    /// Publications of the mask so far.
    pub mask_sequence: u64,
    /// One per modality, ascending by bit.
    pub devices: Vec<DeviceStatus>,
    /// Connected units that no entry matches.
    pub unregistered: Vec<UnregisteredDevice>,
    /// The last answer to a [`RegistryRequest`].
    pub registry_answer: Option<Answered>,
    /// Emergency stops and enabling switches, in the order of the registry.
    pub stops: Vec<StopStatus>,
    /// The recording in progress.
    pub recording: Option<RecordingStatus>,
    /// Why the last request to begin an episode failed, until one begins.
    pub not_started: Option<String>,
    /// The policy in control, if any.
    pub policy: Option<PolicyStatus>,
    /// The last finished file.
    #[serde(serialize_with = "text::lossy_option")]
    pub last_episode: Option<PathBuf>,
    /// The verdict on it.
    pub last_verdict: Option<Verdict>,
    /// The session, if the run records.
    pub session: Option<SessionStatus>,
    /// Free space on the disk of the episodes, bytes.
    pub disk_free: Option<u64>,
    /// Links to the page of this run, the likeliest first. Whoever has one may begin and end episodes.
    #[serde(default)]
    pub links: Vec<String>,
    /// The devices are simulated.
    pub simulated: bool,
    /// The newest log lines, oldest first.
    pub log: Vec<Arc<LogLine>>,
    /// More about the devices that screens look at.
    pub details: Vec<DeviceDetail>,
    /// The newest samples of the devices that screens look at.
    #[serde(skip)]
    pub previews: Vec<Arc<Preview>>,
}

/// A request about the registry of a run. As JSON: `{"do":"reload"}`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum RegistryRequest {
    /// Read `devices.toml` again and take over what can be taken over without a restart.
    Reload,
    /// Add an entry for a connected unit to `devices.toml`, then do the same.
    Register {
        /// [`UnregisteredDevice::device`].
        device: String,
        /// The name of the entry.
        name: String,
    },
}

/// A request from a screen.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "request", content = "of", rename_all = "snake_case")]
pub enum Command {
    /// A request to the session.
    Session(SessionRequest),
    /// [`RegistryRequest::Reload`]; the answer is [`Snapshot::registry_answer`].
    Reload,
    /// [`RegistryRequest::Register`]; the answer is [`Snapshot::registry_answer`].
    Register {
        /// [`UnregisteredDevice::device`].
        device: String,
        /// The name of the entry.
        name: String,
    },
    /// Start a failed device again.
    Restart(ModalityId),
    /// Unplug this simulated device, or plug it in again.
    Plug(String),
    /// Set a control of a camera until it is opened again. What came of it is a line of the log.
    Control {
        /// The camera.
        device: ModalityId,
        /// The control, as in `devices.toml`.
        name: String,
        /// Its value.
        value: i64,
    },
    /// Provide previews of this device for the next seconds ([`preview`]).
    Look(ModalityId),
    /// End the program.
    Quit,
}

/// The current state of an emergency stop or an enabling switch.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopStatus {
    /// Its name.
    pub stop: String,
    /// Its kind.
    pub kind: StopKind,
    /// The state of its input.
    pub state: InputState,
    /// Why its input is lost; otherwise empty.
    pub detail: String,
}

impl StopStatus {
    /// Those of a registry, in its order, before any of them has reported.
    pub fn unreported(registry: &Registry) -> Vec<Self> {
        let detail = "it has not reported yet";
        let of = |spec: &InterlockSpec| Self {
            stop: spec.name.clone(),
            kind: spec.kind,
            state: InputState::Lost,
            detail: detail.to_owned(),
        };
        registry.stops.iter().map(of).collect()
    }

    /// Whether it needs attention; a released enabling switch does not.
    pub fn is_problem(&self) -> bool {
        match self.kind {
            StopKind::Emergency => self.state != InputState::Runs,
            StopKind::Enabling => self.state == InputState::Lost,
        }
    }

    /// Its state, in one word.
    pub const fn word(&self) -> &'static str {
        self.kind.word(self.state)
    }

    /// For people.
    pub fn sentence(&self) -> String {
        let (kind, name, word) = (self.kind.label(), &self.stop, self.word());
        let rest = match self.state {
            InputState::Lost => format!(" ({})", self.detail),
            InputState::Runs => ": nothing moves until the actuator is armed again".to_owned(),
            InputState::Stopped => String::new(),
        };
        format!("{kind} {name} {word}{rest}")
    }
}

words! {
    /// The quality of an episode, as far as its data show.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    Grade {
        /// No defect was found.
        Good = "GOOD",
        /// Check it before use.
        Suspect = "SUSPECT",
        /// Do not use it.
        Bad = "BAD",
    }
}

/// The verdict on one episode. As JSON:
/// `{"verdict":"SUSPECT","reasons":["..."],"sensors":{"registered":3,"recorded":2,"without":["tactile_tip"]}}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// The word.
    #[serde(rename = "verdict")]
    pub grade: Grade,
    /// Why it is not GOOD, the most severe first: sentences for people, each with modality, figure and limit. Empty if
    /// and only if it is GOOD.
    pub reasons: Vec<String>,
    /// Which sensors took part, and which of them not all the time; unknown (`null`) if the file does not state which were registered.
    pub sensors: Option<Sensors>,
    /// The names of the files that were replayed, if its samples come from recordings.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub replay_of: Vec<String>,
}

impl Verdict {
    /// The reasons in one line; empty for a good episode.
    pub fn why(&self) -> String {
        self.reasons.join("; ")
    }

    /// Whether it has the same grade for the same reasons.
    pub fn agrees_with(&self, other: &Self) -> bool {
        (self.grade, &self.reasons) == (other.grade, &other.reasons)
    }

    /// `1 of 3 sensors, without gel, tactile_tip away 18.0 s of 31.0 s`, before it `replay of a.mcap` if it is one; empty
    /// if nothing is known.
    pub fn remarks(&self) -> String {
        let replays = self.replay_of.iter().map(|file| format!("replay of {file}"));
        replays.chain(self.sensors.as_ref().map(ToString::to_string)).collect::<Vec<_>>().join(", ")
    }
}

/// How many of the registered sensors took part in an episode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sensors {
    /// Entries of the registry.
    pub registered: usize,
    /// Those of them with at least one sample.
    pub recorded: usize,
    /// The names of the others, in the order of their bits.
    pub without: Vec<String>,
    /// Those with a sample that were not present all the time, in the order of their bits.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub away: Vec<Absence>,
}

/// A sensor that was not present in a part of an episode, by the mask.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Absence {
    /// Its name.
    pub name: String,
    /// How long it was not present in all, seconds, to the millisecond.
    pub seconds: f64,
    /// Length of the episode, seconds, likewise.
    pub of: f64,
}

impl Sensors {
    /// How many were present all the time.
    pub const fn throughout(&self) -> usize {
        self.recorded.saturating_sub(self.away.len())
    }

    /// `1 of 3 sensors, without gel`: those that were present all the time are counted.
    pub fn counted(&self) -> String {
        let Self { registered, without, .. } = self;
        let throughout = self.throughout();
        let sensors = if *registered == 1 { "sensor" } else { "sensors" };
        let without = if without.is_empty() { String::new() } else { format!(", without {}", without.join(", ")) };
        format!("{throughout} of {registered} {sensors}{without}")
    }
}

impl std::fmt::Display for Sensors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.counted())?;
        self.away.iter().try_for_each(|absence| write!(f, ", {absence}"))
    }
}

impl std::fmt::Display for Absence {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, seconds, of } = self;
        if *seconds < 1.0 {
            write!(f, "{name} away {:.0} ms of {of:.1} s", seconds * 1e3)
        } else {
            write!(f, "{name} away {seconds:.1} s of {of:.1} s")
        }
    }
}

/// An episode in progress.
#[derive(Debug)]
pub struct Episode {
    /// The path of its finished file, absolute.
    pub file: PathBuf,
    /// The file, once the episode has ended.
    ended: SetOnce<PathBuf>,
}

/// The episode in progress, if any; notifies of changes.
pub type EpisodeWatch = watch::Receiver<Option<Arc<Episode>>>;

impl Episode {
    /// An episode whose finished file will be `file`.
    pub fn new(file: &Path) -> Self {
        Self { file: absolute(file), ended: SetOnce::new() }
    }

    /// The episode has ended as `file`, whose name may differ from the intended one. Only the first call counts.
    pub fn end(&self, file: &Path) {
        let _ = self.ended.set(absolute(file));
    }

    /// Waits until it has ended, whether it is whole or not; returns its file. Cancel-safe.
    pub async fn ended(&self) -> &Path {
        self.ended.wait().await
    }

    /// Its name: the name of its file without `.mcap`, or `.mcap.partial`.
    pub fn id(&self) -> String {
        let stem = Path::new(self.file.file_stem().unwrap_or_default());
        let is_whole = stem.extension().is_none_or(|extension| extension != "mcap");
        let name = if is_whole { stem.as_os_str() } else { stem.file_stem().unwrap_or_default() };
        name.to_string_lossy().into_owned()
    }

    /// The folder of its file.
    pub fn folder(&self) -> &Path {
        self.file.parent().unwrap_or(Path::new("/"))
    }
}

/// Without a working folder the path is used as given.
fn absolute(file: &Path) -> PathBuf {
    std::path::absolute(file).unwrap_or_else(|_| file.to_owned())
}

/// The policy in control, for a screen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PolicyStatus {
    /// Name given in its bundle.
    pub name: String,
    /// Nothing moves: its actions are shown and recorded, but not executed.
    pub dry_run: bool,
    /// The mask it observed last.
    pub mask: PhysicalMask,
    /// Time from the observation to the newest chunk, ms.
    pub latency_ms: Option<f64>,
    /// Ticks since the observation on which the action is based.
    pub chunk_age: Option<u64>,
    /// The newest action: name, value and unit of each axis.
    #[serde(deserialize_with = "or_nan")]
    pub action: Vec<(String, f64, String)>,
    /// Why the policy holds, if it does.
    pub hold: Option<Hold>,
    /// Ticks with an action.
    pub actions: u64,
    /// Ticks without an action.
    pub held: u64,
    /// Chunks that were used.
    pub chunks: u64,
    /// Those of them that came later than the tick after their observation, so that their first actions were skipped.
    pub late: u64,
    /// Answers that were not used or never arrived.
    pub unused: u64,
}

/// Why the policy holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hold {
    /// The modality whose absence is the reason; as JSON `""` if there is none.
    #[serde(serialize_with = "or_empty", deserialize_with = "unless_empty")]
    pub device: Option<String>,
    /// The reason.
    pub reason: String,
}

impl fmt::Display for Hold {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.device {
            None => f.write_str(&self.reason),
            Some(device) => write!(f, "{}: {device}", self.reason),
        }
    }
}

#[expect(clippy::ref_option, reason = "serde gives it so")]
fn or_empty<S: Serializer>(device: &Option<String>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(device.as_deref().unwrap_or_default())
}

/// JSON has no NaN: it is written as null.
fn or_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<(String, f64, String)>, D::Error> {
    let axes = Vec::<(String, Option<f64>, String)>::deserialize(deserializer)?;
    Ok(axes.into_iter().map(|(name, value, unit)| (name, value.unwrap_or(f64::NAN), unit)).collect())
}

fn unless_empty<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<String>, D::Error> {
    Ok(Some(String::deserialize(deserializer)?).filter(|device| !device.is_empty()))
}

/// What a policy did from its start to its end.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PolicyEnd {
    /// Ticks with an action.
    pub actions: u64,
    /// Ticks without an action.
    pub held: u64,
    /// Chunks that were used.
    pub chunks: u64,
    /// Those of them that came later than the tick after their observation, so that their first actions were skipped.
    pub late: u64,
    /// Answers that were not used or never arrived.
    pub unused: u64,
    /// Median time from the observation to the chunk, ms.
    pub latency_p50_ms: f64,
    /// 99th percentile of the same.
    pub latency_p99_ms: f64,
}

impl fmt::Display for PolicyEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { actions, held, chunks, late, unused, latency_p50_ms, latency_p99_ms } = self;
        let [acted, without, computed] =
            [(actions, "action"), (held, "tick"), (chunks, "chunk")].map(|(count, of)| text::counted(*count, of));
        write!(f, "{acted}, {without} held, {computed}, {late} late, {unused} unused")?;
        // Without a chunk there is no latency.
        if *chunks + *unused > 0 {
            write!(f, ", latency p50 {latency_p50_ms:.1} ms p99 {latency_p99_ms:.1} ms")?;
        }
        Ok(())
    }
}

/// The samples of one modality from which a chunk was computed: together with the noise seed, enough to recompute it
/// from the recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ObservedSamples {
    /// The modality.
    pub modality: String,
    /// Sequence numbers of its samples, the oldest step first; empty if it was absent. Of an observation with a history
    /// one for each step, `None` for a step without a sample.
    pub seqs: Vec<Option<u64>>,
}

/// A chunk of actions, its inputs, and its latency.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Chunk {
    /// Tick of its observation on the control grid.
    pub tick: u64,
    /// Time of that tick, `CLOCK_MONOTONIC` ns.
    pub observed_ns: u64,
    /// The modalities present, in JSON `0x05`.
    pub mask: SizedMask,
    /// Seed of the noise.
    pub seed: u64,
    /// From the tick to the answer, ms.
    pub latency_ms: f64,
    /// Whether its actions were valid.
    pub used: bool,
    /// Number of its actions whose time had passed when it arrived.
    pub skipped: u64,
    /// The samples.
    pub samples: Vec<ObservedSamples>,
    /// The actions in order, as the policy returned them.
    pub actions: Vec<f32>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_episode_is_named_by_its_file() {
        let episode = Episode::new(Path::new("out/2026-11-21_place-block_001.mcap"));
        assert!(episode.file.is_absolute());
        assert_eq!(episode.id(), "2026-11-21_place-block_001");
        assert_eq!(Episode::new(Path::new("a.b_001.mcap.partial")).id(), "a.b_001");
        assert!(episode.folder().ends_with("out"));
    }
}
