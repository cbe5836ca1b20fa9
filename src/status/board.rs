//! The board: where stages report the data that a screen may show.
//!
//! One writer per item: the rig writes slots and the mask, streams write their own counters, the recorder writes the
//! recording. A screen only takes [`Snapshot`]s.
//!
//! Invariant: per-sample data are atomics; the locks here guard data that changes at most a few times a second, and are
//! never held while waiting.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rapid_core::interlock::InputState;
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::{MAX_MODALITIES, ModalityId, ModalityKind};
use rapid_core::sample::{Epoch, SampleHeader};
use rapid_core::text;
use rapid_core::time::{Stamp, realtime_ns};
use rapid_registry::{DeviceSpec, InterlockSpec, Registry};
use tokio::sync::broadcast;

use super::detail::{DeviceDetail, Intervals, StaticDetail};
use super::preview::{LOOKED_AT, Preview};
use super::session::{Answered, SessionStatus};
use super::{
    DeviceStatus, Event, Grade, Level, LogLine, PolicyStatus, PrintedOn, Provenance, RecordingStatus, SlotState,
    Snapshot, StopStatus, UnregisteredDevice, Verdict, What,
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

/// The sample that a policy compares all later ones of an observation with, or that stands for them.
#[derive(Debug, Clone)]
pub struct ReferenceSample {
    /// Key of the observation.
    pub observation: String,
    /// Name of the modality.
    pub modality: String,
    /// As received.
    pub header: SampleHeader,
    /// As the device sent it.
    pub payload: Vec<u8>,
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
    fn note(&mut self, what: &What) {
        match what {
            What::Episode(end) => self.kept.push((end.file.clone(), end.verdict.grade)),
            What::Discarded { file } => shift(&mut self.kept, &mut self.discarded, file),
            What::Restored { file } => shift(&mut self.discarded, &mut self.kept, file),
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
struct SlotStatus {
    state: SlotState,
    epoch: Epoch,
    detail: String,
}

/// See the module's comment.
#[derive(Debug)]
pub struct Board {
    rig: String,
    started: Stamp,
    /// Ascending by bit.
    entries: Mutex<Vec<Entry>>,
    unregistered: Mutex<Vec<UnregisteredDevice>>,
    registry_answer: Mutex<Option<Answered>>,
    counters: Vec<StreamCounters>,
    slots: Mutex<Vec<SlotStatus>>,
    mask: AtomicU64,
    mask_sequence: AtomicU64,
    stops: Mutex<Vec<StopStatus>>,
    recording: Mutex<Option<RecordingStatus>>,
    not_started: Mutex<Option<String>>,
    policy: Mutex<Option<PolicyStatus>>,
    references: Mutex<Vec<Arc<ReferenceSample>>>,
    last_episode: Mutex<Option<(PathBuf, Verdict)>>,
    session: Mutex<Option<SessionStatus>>,
    disk_free: Mutex<Option<u64>>,
    links: Mutex<Vec<String>>,
    simulated: AtomicBool,
    episodes: Mutex<EpisodeCounts>,
    log: Mutex<Log>,
    /// Until when a modality is looked at.
    looks: Vec<AtomicU64>,
    /// The newest incarnation of each modality.
    opened: Mutex<Vec<Option<Provenance>>>,
    previews: Mutex<Vec<Arc<Preview>>>,
    events: broadcast::Sender<Event>,
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
    fn of(device: &DeviceSpec) -> Self {
        let DeviceSpec { id, name, topic, verdict, .. } = device;
        Self {
            id: *id,
            name: name.clone(),
            topic: topic.clone(),
            kind: device.node.modality_kind(),
            nominal_hz: verdict.hz,
            detail: StaticDetail::of(device),
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
            entries: Mutex::new(registry.devices.iter().map(Entry::of).collect()),
            unregistered: Mutex::new(Vec::new()),
            registry_answer: Mutex::new(None),
            counters,
            slots: Mutex::new(vec![SlotStatus::default(); MAX_MODALITIES]),
            mask: AtomicU64::new(0),
            mask_sequence: AtomicU64::new(0),
            stops: Mutex::new(registry.stops.iter().map(unreported).collect()),
            recording: Mutex::new(None),
            not_started: Mutex::new(None),
            policy: Mutex::new(None),
            references: Mutex::new(Vec::new()),
            last_episode: Mutex::new(None),
            session: Mutex::new(None),
            disk_free: Mutex::new(None),
            links: Mutex::new(Vec::new()),
            simulated: AtomicBool::new(false),
            episodes: Mutex::new(EpisodeCounts::default()),
            log: Mutex::new(Log::default()),
            looks: (0..MAX_MODALITIES).map(|_| AtomicU64::new(0)).collect(),
            opened: Mutex::new(vec![None; MAX_MODALITIES]),
            previews: Mutex::new(Vec::new()),
            events: broadcast::channel(EVENT_DEPTH).0,
        }
    }

    /// The counters of a stream.
    pub fn counters(&self, id: ModalityId) -> &StreamCounters {
        &self.counters[id.index()]
    }

    /// Adds an entry, whose bit no other has.
    pub fn add(&self, device: &DeviceSpec) {
        let mut entries = lock(&self.entries);
        let at = entries.partition_point(|entry| entry.id < device.id);
        entries.insert(at, Entry::of(device));
    }

    /// Reports connected units that no entry matches.
    pub fn set_unregistered(&self, mut units: Vec<UnregisteredDevice>) {
        for unit in &mut units {
            unit.device = text::plain(&unit.device).into_owned();
        }
        *lock(&self.unregistered) = units;
    }

    /// Reports the answer to a request about the registry.
    pub fn set_registry_answer(&self, answer: Answered) {
        *lock(&self.registry_answer) = Some(answer);
    }

    /// Reports the state of a slot.
    pub fn set_slot(&self, id: ModalityId, state: SlotState, epoch: Epoch, detail: &str) {
        let slot = &mut lock(&self.slots)[id.index()];
        slot.state = state;
        slot.epoch = epoch;
        detail.clone_into(&mut slot.detail);
    }

    /// Reports the state of stop `index` of the registry, and announces it.
    pub fn set_stop(&self, index: usize, state: InputState, detail: &str) {
        let changed = lock(&self.stops).get_mut(index).map(|stop| {
            stop.state = state;
            detail.clone_into(&mut stop.detail);
            stop.clone()
        });
        if let Some(stop) = changed {
            self.announce(What::Stop(stop));
        }
    }

    /// Emergency stops and enabling switches, in the order of the registry.
    pub fn stops(&self) -> Vec<StopStatus> {
        lock(&self.stops).clone()
    }

    /// Reports a publication of the mask.
    pub fn set_mask(&self, mask: PhysicalMask, sequence: u64) {
        self.mask.store(mask.0, Ordering::Relaxed);
        self.mask_sequence.store(sequence, Ordering::Relaxed);
    }

    /// The mask as published.
    pub fn mask(&self) -> PhysicalMask {
        PhysicalMask(self.mask.load(Ordering::Relaxed))
    }

    /// Reports the recording in progress, or that there is none.
    pub fn set_recording(&self, recording: Option<RecordingStatus>) {
        *lock(&self.recording) = recording;
    }

    /// Reports why an episode was not begun, or that one has.
    pub fn set_not_started(&self, why: Option<String>) {
        *lock(&self.not_started) = why.map(|why| text::plain(&why).into_owned());
    }

    /// Whether an episode is in progress.
    pub fn is_recording(&self) -> bool {
        lock(&self.recording).is_some()
    }

    /// Reports the policy's status, or that there is no policy.
    pub fn set_policy(&self, policy: Option<PolicyStatus>) {
        *lock(&self.policy) = policy;
    }

    /// Reports a sample that the policy compares all later ones with. A run has one policy.
    pub fn add_reference(&self, reference: ReferenceSample) {
        lock(&self.references).push(Arc::new(reference));
    }

    /// Those of the policy from number `from` on, in the order in which it took them.
    pub fn references(&self, from: usize) -> Vec<Arc<ReferenceSample>> {
        lock(&self.references).get(from..).unwrap_or_default().to_vec()
    }

    /// Reports the last finished file.
    pub fn set_last_episode(&self, file: PathBuf, verdict: Verdict) {
        *lock(&self.last_episode) = Some((file, verdict));
    }

    /// Reports the session.
    pub fn set_session(&self, session: SessionStatus) {
        *lock(&self.session) = Some(session);
    }

    /// Reports that the devices are simulated.
    pub fn set_simulated(&self) {
        self.simulated.store(true, Ordering::Relaxed);
    }

    /// Reports the free space on the disk of the episodes, bytes.
    pub fn set_disk_free(&self, free: Option<u64>) {
        *lock(&self.disk_free) = free;
    }

    /// Reports the links to the page of this run, the likeliest first.
    pub fn set_links(&self, links: Vec<String>) {
        *lock(&self.links) = links;
    }

    /// Adds a line to the log, now. The device that it is about is the one with which it begins.
    pub fn log(&self, level: Level, text: &str) {
        self.write(level, text, (self.device_in(text).as_deref(), None));
    }

    fn device_in(&self, text: &str) -> Option<String> {
        let begins = |name: &str| text.strip_prefix(name).is_some_and(|rest| rest.starts_with([':', ' ', ',']));
        lock(&self.entries).iter().map(|entry| &entry.name).find(|name| begins(name)).cloned()
    }

    /// Without characters from a device that could move a terminal's cursor.
    fn write(&self, level: Level, text: &str, (device, printed): (Option<&str>, Option<PrintedOn>)) {
        let (text, device) = (text::plain(text).into_owned(), device.map(str::to_owned));
        let mut log = lock(&self.log);
        let line = LogLine { number: log.added, wall_ns: realtime_ns(), level, device, printed, text };
        log.added += 1;
        if log.lines.len() == LOG_LINES {
            log.lines.pop_front();
        }
        log.lines.push_back(Arc::new(line));
    }

    /// Announces an event, now, to all subscribers, and adds it to the log.
    pub fn announce(&self, what: What) {
        if let Some((level, text)) = what.log_line() {
            let (device, printed) = what.source();
            let named = if device.is_none() { self.device_in(&text) } else { None };
            self.write(level, &text, (device.or(named.as_deref()), printed));
        }
        if let What::Opened { bit, provenance, .. } = &what
            && let Some(opened) = lock(&self.opened).get_mut(bit.index())
        {
            *opened = Some(Provenance::clone(provenance));
        }
        lock(&self.episodes).note(&what);
        // An error only means that there is no subscriber.
        let _ = self.events.send(Event { stamp: Stamp::now(), what });
    }

    /// The episodes of this run.
    pub fn episodes(&self) -> EpisodeCounts {
        lock(&self.episodes).clone()
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
        let mut previews = lock(&self.previews);
        let last = previews.iter().position(|preview| preview.device == id);
        if last
            .and_then(|last| previews.get(last))
            .is_some_and(|last| !last.is_outdated(Stamp(header.capture_ns), payload.len()))
        {
            return;
        }
        if let Some(last) = last {
            previews.remove(last);
        }
        previews.extend(Preview::of(id, header, payload).map(Arc::new));
    }

    /// The newest sample of a device that is looked at, if there is one.
    pub fn newest_preview(&self, id: ModalityId) -> Option<Arc<Preview>> {
        lock(&self.previews).iter().find(|preview| preview.device == id).cloned()
    }

    /// The modalities whose samples are pictures.
    pub fn cameras(&self) -> Vec<ModalityId> {
        lock(&self.entries).iter().filter(|entry| entry.kind == ModalityKind::Image).map(|entry| entry.id).collect()
    }

    /// The node of a device that was opened.
    pub fn node(&self, id: ModalityId) -> Option<String> {
        lock(&self.opened).get(id.index())?.as_ref().map(|opened| opened.node.clone())
    }

    /// Reports that a control of a device was set.
    pub fn set_control(&self, id: ModalityId, name: &str, value: i64) {
        if let Some(Some(opened)) = lock(&self.opened).get_mut(id.index()) {
            opened.negotiated.controls.insert(name.to_owned(), value);
        }
    }

    /// The name of the entry of a bit.
    pub fn name(&self, id: ModalityId) -> Option<String> {
        lock(&self.entries).iter().find(|entry| entry.id == id).map(|entry| entry.name.clone())
    }

    /// Of the devices that are looked at.
    fn details(&self, now: Stamp) -> Vec<DeviceDetail> {
        let entries = lock(&self.entries);
        let looked_at = entries.iter().filter(|entry| self.is_looked_at(entry.id, now));
        let detail = |entry: &Entry| {
            let opened = lock(&self.opened);
            let opened = opened.get(entry.id.index()).and_then(Option::as_ref);
            DeviceDetail::of(&entry.detail, opened, self.counters(entry.id).intervals.counts())
        };
        looked_at.map(detail).collect()
    }

    /// Those of devices that are looked at; the others are dropped.
    fn previews(&self, now: Stamp) -> Vec<Arc<Preview>> {
        let mut previews = lock(&self.previews);
        previews.retain(|preview| self.is_looked_at(preview.device, now));
        previews.clone()
    }

    /// The current state of everything.
    pub fn snapshot(&self) -> Snapshot {
        let taken = Stamp::now();
        let slots = lock(&self.slots).clone();
        let device = |Entry { id, name, topic, nominal_hz, .. }: &Entry| {
            let counters = &self.counters[id.index()];
            let slot = &slots[id.index()];
            let newest = counters.newest.load(Ordering::Relaxed);
            DeviceStatus {
                name: name.clone(),
                id: *id,
                topic: topic.clone(),
                state: slot.state,
                epoch: slot.epoch,
                detail: slot.detail.clone(),
                nominal_hz: *nominal_hz,
                samples: counters.samples.load(Ordering::Relaxed),
                gaps: counters.gaps.load(Ordering::Relaxed),
                bytes: counters.bytes.load(Ordering::Relaxed),
                newest: (newest > 0).then_some(Stamp(newest)),
            }
        };
        let devices = lock(&self.entries).iter().map(device).collect();
        let (last_episode, last_verdict) = lock(&self.last_episode).clone().unzip();
        Snapshot {
            rig: self.rig.clone(),
            taken,
            uptime: taken.since(self.started),
            mask: self.mask(),
            mask_sequence: self.mask_sequence.load(Ordering::Relaxed),
            devices,
            unregistered: lock(&self.unregistered).clone(),
            registry_answer: lock(&self.registry_answer).clone(),
            stops: self.stops(),
            recording: lock(&self.recording).clone(),
            not_started: lock(&self.not_started).clone(),
            policy: lock(&self.policy).clone(),
            last_episode,
            last_verdict,
            session: lock(&self.session).clone(),
            disk_free: *lock(&self.disk_free),
            links: lock(&self.links).clone(),
            simulated: self.simulated.load(Ordering::Relaxed),
            log: lock(&self.log).lines.iter().cloned().collect(),
            details: self.details(taken),
            previews: self.previews(taken),
        }
    }
}

fn unreported(stop: &InterlockSpec) -> StopStatus {
    let detail = "it has not reported yet".to_owned();
    StopStatus { stop: stop.name.clone(), kind: stop.kind, state: InputState::Lost, detail }
}

/// A poisoned lock here guards plain values that are always complete: they remain usable.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
