//! An episode in progress: its contents, the frame of each sample, and its end.
//!
//! Time, in capture time of the monotonic clock:
//!
//! 1. The episode contains samples captured from `begin` on that show events before `end`: a modality's latency is the
//!    time from an event to the capture of the sample that shows it. `end` is fixed by the requested duration or by the
//!    time of the stop. Also written are the mask in force at `begin`, captured before it, and earlier masks that were
//!    still in transit.
//! 2. Tick `k` of the observation grid is `begin + k / observation_hz`; ticks before `end` are
//!    written.
//! 3. A tick is evaluated once, from the samples received by its deadline, `tick + sync_window +` [`SETTLE`] `+` the
//!    longest latency of the rig, under the mask last published at or before the tick. The deadline is the frame's
//!    `publish_time`: a reader of the file can choose the same samples again.
//! 4. A sample received after its tick's deadline is in the file and in no frame.
//! 5. The file is closed [`SETTLE`] `+` [`GRACE`] `+` the longest latency after `end`. A sample captured before `end`
//!    that arrives after that is lost and cannot be counted.
//! 6. A damaged sample is recorded and counted, and belongs to no frame.
//!
//! Invariant: every sample a frame names was written to the file before the frame.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::mask::{Bits, PhysicalMask};
use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::sample::{Epoch, FLAG_ERROR, FLAG_SAME_NUMBER, SampleHeader, are_usable_numbers};
use rapid_core::sync::{Grid, SyncSample, Synchronizer};
use rapid_core::time::{Stamp, WallClock};
use rapid_pictures::judge::PictureJudge;
use rapid_registry::{DeviceSpec, ModuleSpec, Registry};
use rapid_status::{Board, EpisodeReport, Event, EventKind, Level, Outlook, RecordingStatus};
use rapid_system::disk::{FileLimit, is_full};

use super::announce::{Announced, announce_faults};
use super::episode_path::{self, EpisodePath, EpisodeRequest};
use super::file::EpisodeFile;
use super::hole::Hole;
use super::mask_history::MaskHistory;
use super::metadata::{self, Configuration, Ending};
use super::provenance::{Attached, Units};
use super::publishers::Publisher;
use super::quality::{Frames, Measured, Measures, Quality, SampleFacts};
use super::space::MAKE_ROOM;
use super::tampering::FileWatch;
use super::verdict::{Facts, FileState, Judged, Losses, Missing, findings, judge};
use super::writeback::Writeback;
use crate::ReferenceSample;
use crate::chunk_writer::Sink;
use crate::encode::{Announced as Report, logged};
use crate::made::Shown;

/// Samples of a modality that may arrive while a full queue is being written.
const RING_SLACK: usize = 1024;
/// How long after its capture a sample may arrive and still belong to its frame. The slowest known case: a camera at 15
/// Hz stamps the start of exposure and delivers after exposure, transfer and one frame in the kernel's queue, some 70
/// ms later.
pub(super) const SETTLE: Duration = Duration::from_millis(100);
/// Received samples may stay on the bus for this long.
pub(super) const GRACE: Duration = Duration::from_millis(20);

/// An episode is judged from this time on: before, most of its samples are still to come.
const JUDGED_AFTER: Duration = Duration::from_secs(1);

/// Parameters at the start of an open episode.
pub(super) struct Beginning<'a> {
    pub(super) registry: Arc<Registry>,
    pub(super) board: Arc<Board>,
    pub(super) request: &'a EpisodeRequest,
    pub(super) path: EpisodePath,
    pub(super) sink: Box<dyn Sink>,
    /// How large the file may become.
    pub(super) limit: FileLimit,
    pub(super) attached: &'a Attached,
    pub(super) clock: WallClock,
    pub(super) begin: Stamp,
    /// Where what is written is shown.
    pub(super) shown: Option<Shown>,
    /// References that the policy has taken so far.
    pub(super) references: &'a [ReferenceSample],
}

/// The measured quality of each modality in an episode that ends at `end`.
fn qualities<'a>(registry: &'a Registry, measures: &Measures, end: Stamp) -> Vec<(&'a DeviceSpec, Quality)> {
    let quality = |device: &'a DeviceSpec| Some((device, measures.quality(device.id, end.0)?));
    registry.devices.iter().filter_map(quality).collect()
}

fn judged<'a>(qualities: &'a [(&DeviceSpec, Quality)]) -> Vec<Judged<'a>> {
    let judged =
        |(device, quality): &'a (&DeviceSpec, Quality)| Judged { name: &device.name, quality, limits: device.verdict };
    qualities.iter().map(judged).collect()
}

pub(super) struct OpenEpisode {
    registry: Arc<Registry>,
    board: Arc<Board>,
    path: EpisodePath,
    file: EpisodeFile,
    /// None if it has no thread: then only the end of the episode waits for the disk.
    writeback: Option<Writeback>,
    begin: Stamp,
    end: Option<Stamp>,
    grid: Grid,
    next_tick: u64,
    sync: Synchronizer<()>,
    judge: PictureJudge,
    measures: Measures,
    announced: Vec<Announced>,
    missing: Missing,
    logs: u64,
    events: u64,
    units: Units,
    /// References of the policy that are attached.
    references: usize,
    /// How long a tick waits for its samples, in addition to the window.
    settle: Duration,
    /// As last judged.
    outlook: Outlook,
    /// The first error of the file: nothing is written after it.
    failed: Option<io::Error>,
    /// The file has become as large as it may: it takes no more samples, and its end fits.
    full: Option<FileLimit>,
}

impl OpenEpisode {
    /// Begins an episode and writes the file's initial records.
    pub(super) fn begin(beginning: Beginning<'_>, masks: &MaskHistory) -> io::Result<Self> {
        let Beginning { registry, board, request, path, sink, limit, attached, clock, begin, shown, references } =
            beginning;
        let units = Units::new(attached);
        let mask = masks.at(begin).map_or(PhysicalMask::default(), |(_, bits, _)| bits.mask);
        let configuration = Configuration::new(&registry, &request.modules, &request.tags, mask);
        for (named, sensed) in &configuration.contradicted {
            let text =
                format!("module {named} was named, but the sensor in its slot is of {sensed}: recorded as {sensed}");
            board.announce(EventKind::Log { level: Level::Warn, text });
        }
        let report = metadata::beginning(&registry, &request.task, &configuration, &units, clock, begin);
        let tampering = FileWatch::begin(&path);
        let mut file = EpisodeFile::begin(sink, &registry, clock, begin, report, tampering, shown)?.limited(limit);
        let is_mounted = |module: &&ModuleSpec| configuration.modules.contains(&module.name);
        file.transforms(registry.modules.iter().filter(is_mounted), begin)?;
        let settle = SETTLE + registry.devices.iter().map(|device| device.latency).max().unwrap_or_default();
        let mut measures = Measures::new(&Measured::all(&registry), Frames::new(&registry, begin, settle));
        for device in registry.devices.iter().filter(|device| attached.has(&device.name)) {
            measures.plugged(device.id, begin.0, true);
        }
        if let Some((header, bits, sequence)) = masks.at(begin) {
            file.mask(header, *bits, *sequence)?;
            measures.mask(header.capture_ns, bits.mask);
        }
        references.iter().try_for_each(|reference| file.reference(reference))?;
        // If killed right now, it is still an episode, of a known task and rig.
        file.flush()?;
        let kept = |device: &DeviceSpec| device.depth.saturating_add(RING_SLACK);
        let modalities: Vec<_> = registry.devices.iter().map(|device| device.synchronised(kept(device))).collect();
        let judge = PictureJudge::sharing(board.walked());
        let writeback = Writeback::start(Arc::clone(&path.file), &path.folder);
        Ok(Self {
            sync: Synchronizer::new(&modalities, registry.rig.sync_window),
            grid: Grid::new(begin, registry.rig.observation_hz),
            end: request.duration.map(|duration| begin.after(duration)),
            registry,
            board,
            path,
            file,
            writeback,
            begin,
            judge,
            next_tick: 0,
            measures,
            announced: vec![Announced::default(); MAX_MODALITIES],
            missing: Missing::default(),
            logs: 0,
            events: 0,
            units,
            references: references.len(),
            settle,
            outlook: Outlook::default(),
            failed: None,
            full: None,
        })
    }

    /// Takes a sample, and the gap before it. One of a modality that was added after the beginning is not recorded.
    pub(super) fn sample(&mut self, id: ModalityId, header: &SampleHeader, payload: &[u8], hole: Option<Hole>) {
        if self.measures.meter(id).is_none() {
            return;
        }
        let latency = self.latency(id);
        if let (Some(hole), None) = (hole, &self.failed) {
            // Also for a sample after the end: part of the gap may be before it.
            let (lost, dropped) = (self.share(&hole, hole.lost, latency), self.share(&hole, hole.dropped, latency));
            self.measures.missing(id, lost, dropped);
        }
        if !self.holds(Stamp(header.capture_ns), latency) || self.failed.is_some() || !self.has_room(header, payload) {
            return;
        }
        let repeated = Some(self.file.repeats(id, payload));
        if let Err(error) = self.file.sample(id, header, payload) {
            self.failed = Some(error);
            return;
        }
        let flagged = header.flags & FLAG_ERROR != 0;
        let picture = self.judge.sample(id, header, payload);
        let again = header.flags & FLAG_SAME_NUMBER != 0;
        let seen = SampleFacts {
            again,
            seq: header.seq,
            capture_ns: header.capture_ns,
            recv_ns: header.recv_ns,
            flagged,
            picture,
            payload,
            repeated,
        };
        self.measures.sample(id, &seen);
        if flagged || !picture.is_usable() {
            return;
        }
        let sample = SyncSample {
            capture: Stamp(header.capture_ns),
            recv: Stamp(header.recv_ns),
            seq: header.seq,
            epoch: Epoch(header.epoch),
            keep: (),
        };
        self.sync.push(id, sample);
    }

    /// Whether the sample fits into the file. The episode ends with the first that does not.
    fn has_room(&mut self, header: &SampleHeader, payload: &[u8]) -> bool {
        if self.full.is_none() {
            self.full = self.file.full(payload.len());
            if self.full.is_some() {
                self.end_at(Stamp(header.capture_ns));
            }
        }
        self.full.is_none()
    }

    /// Takes a publication of the mask, and the gap before it.
    pub(super) fn mask(&mut self, header: &SampleHeader, bits: Bits, sequence: u64, hole: Option<Hole>) {
        if let (Some(hole), None) = (hole, &self.failed) {
            self.missing.masks = self.missing.masks.saturating_add(self.share(&hole, hole.dropped, Duration::ZERO));
        }
        // A mask from before the beginning that arrives only now follows the one in force at the beginning.
        let captured = Stamp(header.capture_ns);
        if !(captured < self.begin || self.holds(captured, Duration::ZERO)) || self.failed.is_some() {
            return;
        }
        self.failed = self.file.mask(header, bits, sequence).err();
        self.measures.mask(header.capture_ns, bits.mask);
    }

    /// Takes an action, and the gap before it.
    pub(super) fn action(&mut self, header: &SampleHeader, payload: &[u8], hole: Option<Hole>) {
        if let (Some(hole), None) = (hole, &self.failed) {
            let missing = self.share(&hole, hole.lost.saturating_add(hole.dropped), Duration::ZERO);
            self.missing.actions = self.missing.actions.saturating_add(missing);
        }
        if self.holds(Stamp(header.capture_ns), Duration::ZERO) && self.failed.is_none() {
            self.missing.unusable_actions += u64::from(!are_usable_numbers(payload));
            self.failed = self.file.action(header, payload).err();
        }
    }

    pub(super) fn event(&mut self, event: &Event) {
        self.units.apply(event);
        if !self.holds(event.stamp, Duration::ZERO) || self.failed.is_some() {
            return;
        }
        // An event that is not valid JSON is dropped; it is no reason to lose the episode.
        let report = match Report::new(event) {
            Ok(report) => report,
            Err(error) => {
                tracing::error!(%error, ?event, "an event is not recorded");
                self.missing.events += 1;
                return;
            }
        };
        self.failed = self.write_event(event, &report).err();
        self.events += 1;
        if let EventKind::Attach { bit, .. } | EventKind::Detach { bit, .. } = &event.what {
            self.measures.plugged(*bit, event.stamp.0, matches!(event.what, EventKind::Attach { .. }));
        }
        if let EventKind::Clip { bit, state, .. } = &event.what {
            self.measures.clip(*bit, event.stamp.0, *state);
        }
        if let EventKind::Clock { bit, uncertainty_ns, .. } = &event.what {
            self.measures.uncertainty(*bit, *uncertainty_ns);
        }
    }

    /// Counts events that were missed because they came too fast.
    pub(super) fn missed_events(&mut self, count: u64) {
        self.missing.events += count;
    }

    /// Writes the frames whose deadline has passed by `now`; all samples received before have been taken. Announces
    /// faults.
    pub(super) fn advance(&mut self, now: Stamp, masks: &MaskHistory) {
        let ticks = self.end.map_or(u64::MAX, |end| self.grid.ticks_before(end));
        while self.failed.is_none() && self.next_tick < ticks && now >= self.deadline(self.next_tick).after(GRACE) {
            self.write_frame(masks);
        }
        self.full = self.full.or_else(|| self.file.full(0));
        self.measures.settle();
        announce_faults(&mut self.announced, &self.measures, &self.registry, &self.board, now, false);
    }

    /// Fixes the end of the episode, if it is not fixed to an earlier moment.
    pub(super) fn end_at(&mut self, end: Stamp) {
        let end = end.max(self.begin);
        self.end = Some(self.end.map_or(end, |fixed| fixed.min(end)));
    }

    /// Whether it is time to [`Self::finish`].
    pub(super) fn is_over(&self, now: Stamp) -> bool {
        self.failed.is_some()
            || self.full.is_some()
            || self.end.is_some_and(|end| now >= end.after(self.settle).after(GRACE))
    }

    /// Whether the end of the episode is fixed by now.
    pub(super) fn is_ending(&self, now: Stamp) -> bool {
        self.end.is_some_and(|end| now >= end)
    }

    /// Attaches those of all `references` of the policy that are not attached yet. Those captured in the episode are attached,
    /// too: its chunks do not always show which sample was the reference.
    pub(super) fn attach(&mut self, references: &[ReferenceSample]) {
        for reference in references.get(self.references..).unwrap_or_default() {
            if self.failed.is_some() {
                return;
            }
            self.failed = self.file.reference(reference).err();
            self.references += 1;
        }
    }

    /// Passes the written data to the kernel and starts its writeback without waiting for it.
    pub(super) fn flush(&mut self) {
        if self.failed.is_none() {
            self.failed = self.file.flush().err();
        }
        if self.writeback.as_ref().is_some_and(|writeback| writeback.ask().is_none()) {
            self.end_writeback();
        }
    }

    fn end_writeback(&mut self) {
        let ended = self.writeback.take().map_or(Ok(()), Writeback::end);
        self.failed = self.failed.take().or(ended.err());
    }

    /// Why the episode had to end, if its file is full.
    fn cut_short(&self) -> Option<String> {
        let folder = self.path.finished.parent().unwrap_or(Path::new("")).display();
        self.full.map(|limit| format!("{folder}: the episode was closed before its file was too large: {limit}"))
    }

    /// Writes the remaining frames, ends the file and gives it its name. `reason`: why the episode is not whole
    /// although its file may be; `publishers`: other programs that published on our topics.
    pub(super) fn finish(
        mut self,
        now: Stamp,
        masks: &MaskHistory,
        reason: Option<String>,
        publishers: &[Publisher],
    ) -> EpisodeReport {
        self.end_writeback();
        let reason = reason.or_else(|| self.cut_short());
        let end = self.end.unwrap_or(now).min(now).max(self.begin);
        let ticks = self.grid.ticks_before(end);
        while self.failed.is_none() && self.next_tick < ticks {
            self.write_frame(masks);
        }
        announce_faults(&mut self.announced, &self.measures, &self.registry, &self.board, now, true);
        let seconds = end.since(self.begin).as_secs_f64();
        let messages = self.file.messages;
        let dropped = self.measures.dropped();
        let qualities = qualities(&self.registry, &self.measures, end);
        let judged = judged(&qualities);
        let epochs = self.units.epochs(self.begin);
        let facts = Facts {
            modalities: &judged,
            missing: self.missing,
            expect: &self.registry.rig.expect,
            publishers,
            seconds,
            losses: Losses::Apart,
            file: reason.as_deref().map_or(FileState::Whole, FileState::NotWhole),
            findings: &[],
            epochs: &epochs,
        };
        let whole = judge(&facts);
        let ending = Ending {
            facts: &facts,
            messages,
            frames: self.next_tick,
            skew: self.measures.skew(),
            verdict: &whole,
            cut_short: reason.as_deref(),
            units: &self.units,
            begin: self.begin,
        };
        let closed = match self.failed {
            None => {
                let finished = self.file.finish(metadata::end(&ending));
                finished.and_then(|()| episode_path::keep(&self.path))
            }
            Some(error) => Err(error),
        };
        let (file, error, verdict) = match closed {
            Ok(file) => {
                self.path.tell_name(&file, &self.board);
                (file, reason, whole)
            }
            Err(error) => {
                let fix = if is_full(&error) { format!("; {MAKE_ROOM}") } else { String::new() };
                let error = error.to_string();
                let verdict = judge(&Facts { file: FileState::Failed(&error), ..facts });
                let file = episode_path::failed(&self.path, &error);
                (file, Some(reason.into_iter().chain([error + &fix]).collect::<Vec<_>>().join("; ")), verdict)
            }
        };
        let bytes = std::fs::metadata(&file).map_or(0, |metadata| metadata.len());
        EpisodeReport { file, seconds, messages, bytes, dropped, error, verdict }
    }

    /// Judges the episode as if it ended `now`, which is not too early.
    pub(super) fn judge(&mut self, now: Stamp, publishers: &[Publisher]) {
        if now.since(self.begin) < JUDGED_AFTER {
            return;
        }
        let qualities = qualities(&self.registry, &self.measures, now);
        let facts = Facts {
            modalities: &judged(&qualities),
            missing: self.missing,
            expect: &self.registry.rig.expect,
            publishers,
            seconds: now.since(self.begin).as_secs_f64(),
            losses: Losses::Apart,
            file: FileState::Whole,
            findings: &[],
            epochs: &self.units.epochs(self.begin),
        };
        self.outlook = Outlook { findings: findings(&facts) };
    }

    /// For the screen.
    pub(super) fn status(&self, now: Stamp) -> RecordingStatus {
        RecordingStatus {
            file: self.path.finished.clone(),
            elapsed: self.end.unwrap_or(now).min(now).since(self.begin),
            messages: self.file.messages,
            bytes: self.file.bytes,
            dropped: self.measures.dropped(),
            room: None,
            outlook: self.outlook.clone(),
        }
    }

    /// The file's name once it is finished.
    pub(super) fn name(&self) -> &std::path::Path {
        &self.path.finished
    }

    fn holds(&self, capture: Stamp, latency: Duration) -> bool {
        capture >= self.begin && self.end.is_none_or(|end| capture.before(latency) < end)
    }

    fn latency(&self, id: ModalityId) -> Duration {
        self.registry.device(id).map_or(Duration::ZERO, |device| device.latency)
    }

    /// How many of the `count` samples missing in `hole` belong to the episode.
    fn share(&self, hole: &Hole, count: u64, latency: Duration) -> u64 {
        let until_end = self.end.map_or(count, |end| hole.before(end.after(latency), count));
        until_end.saturating_sub(hole.before(self.begin, count))
    }

    fn deadline(&self, tick: u64) -> Stamp {
        self.grid.tick(tick).after(self.registry.rig.sync_window).after(self.settle)
    }

    fn write_frame(&mut self, masks: &MaskHistory) {
        let (index, deadline) = (self.next_tick, self.deadline(self.next_tick));
        let tick = self.grid.tick(index);
        // Before the first publication nothing is known to be present.
        let bits = masks.at(tick).map_or(Bits::default(), |(_, bits, _)| *bits);
        let observation = self.sync.observe(tick, deadline, bits);
        let slots = observation.slots.iter();
        self.measures.frame(slots.map(|slot| (slot.id, slot.present, slot.valid.then_some(slot.age_ns))));
        self.failed = self.file.frame(index, observation, deadline).err();
        self.next_tick += 1;
    }

    fn write_event(&mut self, event: &Event, report: &Report) -> io::Result<()> {
        self.file.event(self.events, event.stamp, &report.fields())?;
        if let Some((level, text)) = logged(event) {
            self.file.log(self.logs, event.stamp, level, text)?;
            self.logs += 1;
        }
        Ok(())
    }
}
