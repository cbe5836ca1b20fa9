//! The board: where stages report the data that a screen may show.
//!
//! It is what screens see and nothing else: what one stage sends another goes over a channel or a handle of the stage that
//! owns it. One writer per item: the rig writes the states of devices and the mask, streams write their own counters, the
//! recorder writes the recording. A screen only takes [`Snapshot`]s.
//!
//! Invariant: per-sample data and the mask are atomics; everything else is guarded by one lock, so that a snapshot is of one
//! moment. It changes at most a few times a second.
//! Invariant: the lock is never held while waiting, nor while a sample or a line is copied or converted; nothing is logged
//! under it, since a line of the log takes it.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::{MAX_MODALITIES, ModalityId, ModalityKind};
use rapid_core::sample::{Epoch, SampleHeader};
use rapid_core::text;
use rapid_core::time::{Stamp, realtime_ns};
use rapid_core::walked::WalkedPictures;
use rapid_registry::{DeviceSpec, Registry};
use tokio::sync::broadcast;

use super::detail::{DeviceDetail, Intervals, StaticDetail};
use super::preview::{LOOKED_AT, Preview};
use super::session::{Answered, SessionStatus};
use super::{
    DeviceState, DeviceStatus, Event, EventKind, Grade, Level, LogLine, PolicyStatus, PrintedOn, Provenance,
    RecordingStatus, Snapshot, StopStatus, UnregisteredDevice, Verdict,
};

/// Log lines kept for the screen.
const LOG_LINES: usize = 2000;
/// Events a slow reader may fall behind before it misses some; it is then notified.
const EVENT_DEPTH: usize = 4096;

/// Counters of one stream, written only by its task.
#[derive(Debug, Default)]
pub struct StreamCounters {
    samples: AtomicU64,
    gaps: AtomicU64,
    bytes: AtomicU64,
    newest: AtomicU64,
    intervals: Intervals,
}

impl StreamCounters {
    /// Counts one sample of `bytes` bytes captured at `captured`, before which `lost` samples were lost.
    pub fn count(&self, bytes: usize, captured: Stamp, lost: u64) {
        self.samples.fetch_add(1, Ordering::Relaxed);
        self.bytes.fetch_add(bytes as u64, Ordering::Relaxed);
        let before = self.newest.swap(captured.0, Ordering::Relaxed);
        // None before the first sample.
        if before > 0 {
            self.intervals.count(captured.since(Stamp(before)));
        }
        self.lose(lost);
    }

    /// Counts samples that were lost.
    pub fn lose(&self, lost: u64) {
        if lost > 0 {
            self.gaps.fetch_add(lost, Ordering::Relaxed);
        }
    }
}

/// The episodes of a run.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EpisodeCounts {
    /// Files and grades, oldest first.
    kept: Vec<(PathBuf, Grade)>,
    /// Those that were discarded, likewise.
    discarded: Vec<(PathBuf, Grade)>,
}

impl EpisodeCounts {
    /// Takes an event about an episode.
    pub fn note(&mut self, what: &EventKind) {
        match what {
            EventKind::Episode(end) => self.kept.push((end.file.clone(), end.verdict.grade)),
            EventKind::Discarded { file } => shift(&mut self.kept, &mut self.discarded, file),
            EventKind::Restored { file } => shift(&mut self.discarded, &mut self.kept, file),
            _ => {}
        }
    }

    /// How many BAD ones there are, and the file of the last; `None` if there is none.
    pub fn bad(&self) -> Option<(usize, PathBuf)> {
        let bad = || self.kept.iter().filter(|(_, grade)| *grade == Grade::Bad);
        bad().next_back().map(|(file, _)| (bad().count(), file.clone()))
    }

    /// For people: how many there are, and how to continue; `None` without any.
    pub fn summary(&self) -> Option<String> {
        let [good, suspect, bad] = [Grade::Good, Grade::Suspect, Grade::Bad]
            .map(|grade| self.kept.iter().filter(|(_, other)| *other == grade).count());
        let (last, _) = self.kept.last()?;
        let episodes = if self.kept.len() == 1 { "episode" } else { "episodes" };
        let folder = text::plain(&last.parent().unwrap_or(Path::new("")).to_string_lossy()).into_owned();
        let discarded = match self.discarded.len() {
            0 => String::new(),
            count => format!("; {count} discarded"),
        };
        Some(format!(
            "{} {episodes} in {folder} ({good} GOOD, {suspect} SUSPECT, {bad} BAD{discarded}); next: rapid inspect {folder}",
            self.kept.len()
        ))
    }
}

/// Moves the episode `file` from one list to another.
fn shift(from: &mut Vec<(PathBuf, Grade)>, to: &mut Vec<(PathBuf, Grade)>, file: &Path) {
    if let Some(index) = from.iter().rposition(|(other, _)| other == file) {
        to.push(from.remove(index));
    }
}

/// The newest lines of the log.
#[derive(Debug, Default)]
struct Log {
    lines: VecDeque<Arc<LogLine>>,
    /// All lines so far.
    added: u64,
}

#[derive(Debug, Clone, Default)]
struct ReportedState {
    state: DeviceState,
    epoch: Epoch,
    detail: String,
}

/// See the module's comment.
#[derive(Debug)]
pub struct Board {
    rig: String,
    started: Stamp,
    counters: Vec<StreamCounters>,
    mask: AtomicU64,
    mask_sequence: AtomicU64,
    /// Until when a modality is looked at.
    looks: Vec<AtomicU64>,
    state: Mutex<State>,
    events: broadcast::Sender<Event>,
    walked: Arc<WalkedPictures>,
}

/// What a snapshot shows besides the counters and the mask.
#[derive(Debug)]
struct State {
    /// Ascending by bit.
    entries: Vec<Entry>,
    unregistered: Vec<UnregisteredDevice>,
    registry_answer: Option<Answered>,
    states: Vec<ReportedState>,
    stops: Vec<StopStatus>,
    recording: Option<RecordingStatus>,
    not_started: Option<String>,
    policy: Option<PolicyStatus>,
    last_episode: Option<(PathBuf, Verdict)>,
    session: Option<SessionStatus>,
    disk_free: Option<u64>,
    links: Vec<String>,
    simulated: bool,
    episodes: EpisodeCounts,
    log: Log,
    /// The newest incarnation of each modality.
    opened: Vec<Option<Provenance>>,
    previews: Vec<Arc<Preview>>,
}

impl State {
    fn new(registry: &Registry) -> Self {
        Self {
            entries: registry.devices.iter().map(Entry::new).collect(),
            unregistered: Vec::new(),
            registry_answer: None,
            states: vec![ReportedState::default(); MAX_MODALITIES],
            stops: StopStatus::unreported(registry),
            recording: None,
            not_started: None,
            policy: None,
            last_episode: None,
            session: None,
            disk_free: None,
            links: Vec::new(),
            simulated: false,
            episodes: EpisodeCounts::default(),
            log: Log::default(),
            opened: vec![None; MAX_MODALITIES],
            previews: Vec::new(),
        }
    }

    /// The device with whose name a line begins.
    fn device_in(&self, text: &str) -> Option<String> {
        let begins = |name: &str| text.strip_prefix(name).is_some_and(|rest| rest.starts_with([':', ' ', ',']));
        self.entries.iter().map(|entry| &entry.name).find(|name| begins(name)).cloned()
    }

    /// Adds a line, now, which is about the device with whose name it begins if it names none.
    fn write(&mut self, line: LogLine) {
        let device = line.device.or_else(|| self.device_in(&line.text));
        let line = LogLine { number: self.log.added, wall_ns: realtime_ns(), device, ..line };
        self.log.added += 1;
        if self.log.lines.len() == LOG_LINES {
            self.log.lines.pop_front();
        }
        self.log.lines.push_back(Arc::new(line));
    }

    fn preview(&self, id: ModalityId) -> Option<&Arc<Preview>> {
        self.previews.iter().find(|preview| preview.device == id)
    }

    fn note_opened(&mut self, what: &EventKind) {
        if let EventKind::Opened { bit, provenance, .. } = what
            && let Some(opened) = self.opened.get_mut(bit.index())
        {
            *opened = Some(Provenance::clone(provenance));
        }
    }
}

/// What an entry of the registry contributes to each snapshot.
#[derive(Debug)]
struct Entry {
    id: ModalityId,
    name: String,
    topic: String,
    kind: ModalityKind,
    nominal_hz: Option<f64>,
    detail: StaticDetail,
}

impl Entry {
    fn new(device: &DeviceSpec) -> Self {
        let DeviceSpec { id, name, topic, verdict, .. } = device;
        Self {
            id: *id,
            name: name.clone(),
            topic: topic.clone(),
            kind: device.node.modality_kind(),
            nominal_hz: verdict.hz,
            detail: StaticDetail::new(device),
        }
    }
}

impl Board {
    /// An empty board for the devices of `registry`.
    pub fn new(registry: &Registry) -> Self {
        let mut counters = Vec::with_capacity(MAX_MODALITIES);
        counters.resize_with(MAX_MODALITIES, StreamCounters::default);
        Self {
            rig: registry.rig.name.clone(),
            started: Stamp::now(),
            counters,
            mask: AtomicU64::new(0),
            mask_sequence: AtomicU64::new(0),
            looks: (0..MAX_MODALITIES).map(|_| AtomicU64::new(0)).collect(),
            state: Mutex::new(State::new(registry)),
            events: broadcast::channel(EVENT_DEPTH).0,
            walked: Arc::default(),
        }
    }

    /// A poisoned lock guards plain values that are always complete: they remain usable.
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The counters of a stream.
    pub fn counters(&self, id: ModalityId) -> &StreamCounters {
        &self.counters[id.index()]
    }

    /// Adds an entry, whose bit no other has.
    pub fn add(&self, device: &DeviceSpec) {
        let entry = Entry::new(device);
        let entries = &mut self.state().entries;
        let at = entries.partition_point(|entry| entry.id < device.id);
        entries.insert(at, entry);
    }

    /// Reports connected units that no entry matches.
    pub fn set_unregistered(&self, mut units: Vec<UnregisteredDevice>) {
        for unit in &mut units {
            unit.device = text::plain(&unit.device).into_owned();
        }
        self.state().unregistered = units;
    }

    /// Reports the answer to a request about the registry.
    pub fn set_registry_answer(&self, answer: Answered) {
        self.state().registry_answer = Some(answer);
    }

    /// Reports the state of a device.
    pub fn set_device_state(&self, id: ModalityId, state: DeviceState, epoch: Epoch, detail: &str) {
        let reported = &mut self.state().states[id.index()];
        reported.state = state;
        reported.epoch = epoch;
        detail.clone_into(&mut reported.detail);
    }

    /// Reports the state of an emergency stop or an enabling switch, and announces it.
    pub fn set_stop(&self, stop: StopStatus) {
        if let Some(shown) = self.state().stops.iter_mut().find(|shown| shown.stop == stop.stop) {
            shown.clone_from(&stop);
        }
        self.announce(EventKind::Stop(stop));
    }

    /// Reports a publication of the mask.
    pub fn set_mask(&self, mask: PhysicalMask, sequence: u64) {
        self.mask.store(mask.0, Ordering::Relaxed);
        self.mask_sequence.store(sequence, Ordering::Relaxed);
    }

    /// Reports the recording in progress, or that there is none.
    pub fn set_recording(&self, recording: Option<RecordingStatus>) {
        self.state().recording = recording;
    }

    /// Reports why an episode was not begun, or that one has.
    pub fn set_not_started(&self, why: Option<String>) {
        let why = why.map(|why| text::plain(&why).into_owned());
        self.state().not_started = why;
    }

    /// Reports the policy's status, or that there is no policy.
    pub fn set_policy(&self, policy: Option<PolicyStatus>) {
        self.state().policy = policy;
    }

    /// Reports the last finished file.
    pub fn set_last_episode(&self, file: PathBuf, verdict: Verdict) {
        self.state().last_episode = Some((file, verdict));
    }

    /// Reports the session.
    pub fn set_session(&self, session: SessionStatus) {
        self.state().session = Some(session);
    }

    /// Reports that the devices are simulated.
    pub fn set_simulated(&self) {
        self.state().simulated = true;
    }

    /// Reports the free space on the disk of the episodes, bytes.
    pub fn set_disk_free(&self, free: Option<u64>) {
        self.state().disk_free = free;
    }

    /// Reports the links to the page of this run, the likeliest first.
    pub fn set_links(&self, links: Vec<String>) {
        self.state().links = links;
    }

    /// Adds a line to the log, now. The device that it is about is the one with which it begins.
    pub fn log(&self, level: Level, text: &str) {
        let line = plain(level, text, None, None);
        self.state().write(line);
    }

    /// Announces an event, now, to all subscribers, and adds it to the log.
    pub fn announce(&self, what: EventKind) {
        self.announce_at(Stamp::now(), what);
    }

    /// The same for an event of an earlier moment.
    pub fn announce_at(&self, stamp: Stamp, what: EventKind) {
        let line = what.log_line().map(|(level, text)| {
            let (device, printed) = what.source();
            plain(level, &text, device, printed)
        });
        {
            let mut state = self.state();
            if let Some(line) = line {
                state.write(line);
            }
            state.note_opened(&what);
            state.episodes.note(&what);
        }
        // An error only means that there is no subscriber.
        let _ = self.events.send(Event { stamp, what });
    }

    /// The episodes of this run.
    pub fn episodes(&self) -> EpisodeCounts {
        self.state().episodes.clone()
    }

    /// All events from now on.
    pub fn events(&self) -> broadcast::Receiver<Event> {
        self.events.subscribe()
    }

    /// A screen looks at a device, from `now` on for [`LOOKED_AT`].
    pub fn look(&self, id: ModalityId, now: Stamp) {
        if let Some(until) = self.looks.get(id.index()) {
            until.store(now.after(LOOKED_AT).0, Ordering::Relaxed);
        }
    }

    fn is_looked_at(&self, id: ModalityId, now: Stamp) -> bool {
        self.looks.get(id.index()).is_some_and(|until| until.load(Ordering::Relaxed) > now.0)
    }

    /// Keeps a published sample as the preview of its device, if a screen looks at it and the last one is old enough.
    pub fn preview(&self, id: ModalityId, header: &SampleHeader, payload: &[u8]) {
        if !self.is_looked_at(id, Stamp(header.recv_ns)) {
            return;
        }
        let is_due = |last: &Arc<Preview>| last.is_outdated(Stamp(header.capture_ns), payload.len());
        if !self.state().preview(id).is_none_or(is_due) {
            return;
        }
        let preview = Preview::from_sample(id, header, payload).map(Arc::new);
        let previews = &mut self.state().previews;
        previews.retain(|last| last.device != id);
        previews.extend(preview);
    }

    /// The newest sample of a device that is looked at, if there is one.
    pub fn newest_preview(&self, id: ModalityId) -> Option<Arc<Preview>> {
        self.state().preview(id).cloned()
    }

    /// What was found of the pictures of the run.
    pub fn walked(&self) -> Arc<WalkedPictures> {
        Arc::clone(&self.walked)
    }

    /// The modalities whose samples are pictures.
    pub fn cameras(&self) -> Vec<ModalityId> {
        let state = self.state();
        state.entries.iter().filter(|entry| entry.kind == ModalityKind::Image).map(|entry| entry.id).collect()
    }

    /// The node of a device that was opened.
    pub fn node(&self, id: ModalityId) -> Option<String> {
        self.state().opened.get(id.index())?.as_ref().map(|opened| opened.node.clone())
    }

    /// Reports that a control of a device was set.
    pub fn set_control(&self, id: ModalityId, name: &str, value: i64) {
        if let Some(Some(opened)) = self.state().opened.get_mut(id.index()) {
            opened.negotiated.controls.insert(name.to_owned(), value);
        }
    }

    /// The name of the entry of a bit.
    pub fn name(&self, id: ModalityId) -> Option<String> {
        self.state().entries.iter().find(|entry| entry.id == id).map(|entry| entry.name.clone())
    }

    /// The current state of everything.
    pub fn snapshot(&self) -> Snapshot {
        let mut state = self.state();
        let taken = Stamp::now();
        // Those of devices that no screen shows are dropped.
        state.previews.retain(|preview| self.is_looked_at(preview.device, taken));
        let (last_episode, last_verdict) = state.last_episode.clone().unzip();
        Snapshot {
            rig: self.rig.clone(),
            taken,
            uptime: taken.since(self.started),
            mask: PhysicalMask(self.mask.load(Ordering::Relaxed)),
            mask_sequence: self.mask_sequence.load(Ordering::Relaxed),
            devices: state.entries.iter().map(|entry| self.device(entry, &state)).collect(),
            unregistered: state.unregistered.clone(),
            registry_answer: state.registry_answer.clone(),
            stops: state.stops.clone(),
            recording: state.recording.clone(),
            not_started: state.not_started.clone(),
            policy: state.policy.clone(),
            last_episode,
            last_verdict,
            session: state.session.clone(),
            disk_free: state.disk_free,
            links: state.links.clone(),
            simulated: state.simulated,
            log: state.log.lines.iter().cloned().collect(),
            details: self.details(&state, taken),
            previews: state.previews.clone(),
        }
    }

    fn device(&self, entry: &Entry, state: &State) -> DeviceStatus {
        let counters = &self.counters[entry.id.index()];
        let reported = &state.states[entry.id.index()];
        let newest = counters.newest.load(Ordering::Relaxed);
        DeviceStatus {
            name: entry.name.clone(),
            id: entry.id,
            topic: entry.topic.clone(),
            state: reported.state,
            epoch: reported.epoch,
            detail: reported.detail.clone(),
            nominal_hz: entry.nominal_hz,
            samples: counters.samples.load(Ordering::Relaxed),
            gaps: counters.gaps.load(Ordering::Relaxed),
            bytes: counters.bytes.load(Ordering::Relaxed),
            newest: (newest > 0).then_some(Stamp(newest)),
        }
    }

    /// Of the devices that are looked at.
    fn details(&self, state: &State, now: Stamp) -> Vec<DeviceDetail> {
        let looked_at = state.entries.iter().filter(|entry| self.is_looked_at(entry.id, now));
        let detail = |entry: &Entry| {
            let opened = state.opened.get(entry.id.index()).and_then(Option::as_ref);
            DeviceDetail::new(&entry.detail, opened, self.counters(entry.id).intervals.counts())
        };
        looked_at.map(detail).collect()
    }
}

/// A line of the log as of yet without its place. It has no characters from a device that could move a terminal's cursor.
fn plain(level: Level, text: &str, device: Option<&str>, printed: Option<PrintedOn>) -> LogLine {
    let (text, device) = (text::plain(text).into_owned(), device.map(str::to_owned));
    LogLine { number: 0, wall_ns: 0, level, device, printed, text }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;

    #[test]
    fn a_snapshot_is_of_one_moment() {
        let text = "[device.tof]\nvid = \"1\"\npid = \"2\"\nnode = \"camera\"\nbit = 0\n";
        let registry = Registry::parse(text, None).unwrap().registry;
        let (board, id) = (Board::new(&registry), registry.devices[0].id);
        let is_over = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for number in 1_u32.. {
                    if is_over.load(Ordering::Relaxed) {
                        return;
                    }
                    board.set_device_state(id, DeviceState::Absent, Epoch(number), "");
                    board.set_links(vec![number.to_string()]);
                }
            });
            let mixed = (0..20_000).find_map(|_| {
                let Snapshot { devices, links, .. } = board.snapshot();
                let (first, second) = (devices[0].epoch.0, links.first().map_or(0, |link| link.parse().unwrap()));
                (first < second).then_some((first, second))
            });
            is_over.store(true, Ordering::Relaxed);
            assert_eq!(mixed, None, "the first was set before the second");
        });
    }
}
