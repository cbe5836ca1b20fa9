//! The quality of an episode: what is counted while it is recorded, or while its file is read.
//!
//! Samples, masks and frames go in, one [`Quality`] a modality comes out. The recorder and `inspect`
//! use the same code and agree on a file, as far as it holds what they count.
//!
//! Invariant: pure: no clock, no input or output; times are ns on whatever clock the caller uses.
//! Invariant: taking a sample, a mask that has not changed or a frame allocates nothing, unless the
//! caller is far behind.

mod presence;
#[cfg(test)]
mod tests;

use std::hash::{DefaultHasher, Hasher};
use std::time::Duration;

use hdrhistogram::Histogram;
use rapid_core::clip::ClipState;
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::sync::Grid;
use rapid_core::time::{Stamp, nanoseconds};
use rapid_pictures::judge::Judgement;
use rapid_registry::{DeviceSpec, Registry, VerdictSpec};
use serde::Serialize;

use self::presence::{Plugged, PresenceHistory};

/// Room for intervals without a sample, or between equal ones, until the mask of their time is known. A reader that is
/// further behind waits for a stalled disk, and may allocate.
const PENDING: usize = 32;
/// Most of these intervals; beyond, they are judged by the known masks. A sensor at 1 kHz has this many in four
/// seconds, in which the mask is published two thousand times.
const MOST_PENDING: usize = 4096;

/// A modality to be measured.
#[derive(Debug, Clone)]
pub(super) struct Measured {
    pub(super) name: String,
    pub(super) id: ModalityId,
    /// Its limits: whether payloads are compared, and its nominal rate.
    pub(super) limits: VerdictSpec,
    /// Time from the event that a sample shows to its capture, ns.
    pub(super) latency_ns: u64,
}

impl Measured {
    /// Every modality of a registry.
    pub(super) fn all(registry: &Registry) -> Vec<Self> {
        let measured = |device: &DeviceSpec| Self {
            name: device.name.clone(),
            id: device.id,
            limits: device.verdict,
            latency_ns: nanoseconds(device.latency),
        };
        registry.devices.iter().map(measured).collect()
    }
}

/// The times of frames, and how long each waits for samples.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frames {
    /// Beginning of the episode and of the grid, ns.
    pub(super) begin_ns: u64,
    /// Ticks a second.
    pub(super) hz: f64,
    /// Greatest distance of a frame's samples from its tick.
    pub(super) window: Duration,
    /// How long after its tick a frame is evaluated.
    pub(super) wait: Duration,
}

impl Frames {
    /// The frames of an episode that begins at `begin`; each waits for its window and for `settle`.
    pub(super) fn new(registry: &Registry, begin: Stamp, settle: Duration) -> Self {
        let window = registry.rig.sync_window;
        Self { begin_ns: begin.0, hz: registry.rig.observation_hz, window, wait: window + settle }
    }
}

/// The quality of a modality over an episode.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Quality {
    /// Samples in the file.
    pub samples: u64,
    /// Payload bytes in the file.
    pub bytes: u64,
    /// Samples that the device lost.
    pub lost: u64,
    /// Samples lost between the driver and the file.
    pub dropped: u64,
    /// Samples that the driver called damaged, and pictures that are not usable.
    pub damaged: u64,
    /// Of `damaged`, pictures that lack a part or are damaged inside.
    pub truncated: u64,
    /// Of `damaged`, pictures of another size or kind than the camera's.
    pub other_shape: u64,
    /// Samples with a non-increasing sequence number or capture time.
    pub duplicates: u64,
    /// Samples that equal the previous one byte for byte; not counted if payloads are not compared.
    pub repeated: u64,
    /// Repetitions in the longest run of such samples.
    pub frozen_samples: u64,
    /// Length of that run while it was present, seconds.
    pub frozen: f64,
    /// Samples received after their frame's deadline.
    pub late: u64,
    /// Time from capture to receipt, ms.
    pub lateness: Option<Spread>,
    /// Growth of the shortest lateness from the beginning to the end, ms: the device's clock runs slow, or fast if
    /// negative. Unknown with few samples.
    pub clock_drift: Option<f64>,
    /// Largest excess of a capture time over its receipt, ms: the clock is ahead.
    pub clock_ahead: f64,
    /// How far the capture times of a device of another computer may be wrong, ms: the most of the episode, by the
    /// events.
    pub clock_uncertainty: Option<f64>,
    /// Distance between a tick and its sample, ms.
    pub offset: Option<Spread>,
    /// Share of the episode in which it was present, 0 to 1; unknown without a mask.
    pub presence: Option<f64>,
    /// Time in which it was present, seconds; all of it without a mask.
    pub present: f64,
    /// Time in which its device was plugged in, seconds, by the events.
    pub plugged: f64,
    /// Longest time in which it was plugged in and not present, seconds.
    pub opening: f64,
    /// Samples a second while present; absent when it never was.
    pub hz: Option<f64>,
    /// Expected samples a second, if known.
    pub nominal_hz: Option<f64>,
    /// Longest time without a sample while it was present, seconds.
    pub longest_gap: f64,
    /// Its own recording, of a device that was asked to record by itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clip: Option<ClipQuality>,
    /// Frames in which it was present.
    pub frames_present: u64,
    /// Frames with a sample of it in the window.
    pub frames_valid: u64,
    /// Frames in which it was present without such a sample. The first and the last of a presence are not counted:
    /// their sample may lie outside the presence or the episode.
    pub frames_missed: u64,
}

/// What a device that records by itself has of an episode, by the events.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ClipQuality {
    /// Time in which it reported that it records, seconds.
    pub recorded: f64,
    /// When it first did, seconds from the beginning; `None`: never.
    pub began: Option<f64>,
    /// How often it was asked and did not begin.
    pub refused: u64,
    /// How often it stopped without being asked to.
    pub stopped: u64,
}

impl Quality {
    /// Samples that should be in the file.
    pub(super) fn expected(&self) -> u64 {
        self.samples.saturating_add(self.lost).saturating_add(self.dropped)
    }
}

#[derive(Debug)]
pub(super) struct Measures {
    grid: Grid,
    window_ns: u64,
    wait_ns: u64,
    begin_ns: u64,
    presence: PresenceHistory,
    modalities: Vec<Option<ModalityMeters>>,
    /// Between the earliest and the latest sample of a frame.
    skew: DurationHistogram,
}

#[derive(Debug)]
struct ModalityMeters {
    measured: Measured,
    meter: Meter,
    longest_gap_ns: u64,
    pending: Vec<(u64, u64)>,
    plugged: Plugged,
    uncertainty_ns: Option<u64>,
    clip: ClipMeter,
}

impl Measures {
    pub(super) fn new(all: &[Measured], frames: Frames) -> Self {
        let mut modalities = Vec::new();
        modalities.resize_with(MAX_MODALITIES, || None);
        for measured in all {
            let compares = measured.limits.compares();
            if let Some(modality) = modalities.get_mut(measured.id.index()) {
                *modality = Some(ModalityMeters {
                    measured: measured.clone(),
                    meter: Meter::new(frames.begin_ns, compares),
                    longest_gap_ns: 0,
                    pending: Vec::with_capacity(PENDING),
                    plugged: Plugged::default(),
                    uncertainty_ns: None,
                    clip: ClipMeter::default(),
                });
            }
        }
        Self {
            grid: Grid::new(Stamp(frames.begin_ns), frames.hz),
            window_ns: nanoseconds(frames.window),
            wait_ns: nanoseconds(frames.wait),
            begin_ns: frames.begin_ns,
            presence: PresenceHistory::new(frames.begin_ns),
            modalities,
            skew: DurationHistogram::default(),
        }
    }

    /// Takes a sample that belongs to the episode.
    pub(super) fn sample(&mut self, id: ModalityId, seen: &SampleFacts<'_>) {
        let Some(Some(modality)) = self.modalities.get(id.index()) else { return };
        let shown = seen.capture_ns.saturating_sub(modality.measured.latency_ns);
        let tick = self.nearest_tick(shown);
        // No frame waits for a sample between the windows: it has the deadline that its own frame would have.
        let due = if shown.abs_diff(tick) <= self.window_ns { tick } else { shown };
        let deadline = due.saturating_add(self.wait_ns);
        let Some(Some(modality)) = self.modalities.get_mut(id.index()) else { return };
        if modality.meter.repeats.len() >= MOST_PENDING {
            modality.settle(&self.presence);
        }
        let Some((from, to)) = modality.meter.sample(seen, deadline) else { return };
        if to - from > modality.longest_gap_ns {
            if modality.pending.len() >= MOST_PENDING {
                modality.settle(&self.presence);
            }
            modality.pending.push((from, to));
        }
    }

    /// Counts samples that are missing.
    pub(super) fn missing(&mut self, id: ModalityId, lost: u64, dropped: u64) {
        if let Some(Some(modality)) = self.modalities.get_mut(id.index()) {
            // Saturating: the numbers come from the publisher.
            let counts = &mut modality.meter.counts;
            counts.lost = counts.lost.saturating_add(lost);
            counts.dropped = counts.dropped.saturating_add(dropped);
        }
    }

    /// Takes a publication of the mask.
    pub(super) fn mask(&mut self, at_ns: u64, mask: PhysicalMask) {
        self.presence.push(at_ns, mask);
    }

    /// Records that a device was plugged in or out; one that was there before counts from the beginning.
    pub(super) fn plugged(&mut self, id: ModalityId, at_ns: u64, there: bool) {
        if let Some(Some(modality)) = self.modalities.get_mut(id.index()) {
            modality.plugged.push(at_ns, there);
            if !there {
                // Nothing is known of its recording from here on.
                modality.clip.recording.push(at_ns, false);
            }
        }
    }

    /// Takes what a device that records by itself does.
    pub(super) fn clip(&mut self, id: ModalityId, at_ns: u64, state: ClipState) {
        if let Some(Some(modality)) = self.modalities.get_mut(id.index()) {
            modality.clip.push(at_ns, state);
        }
    }

    /// Takes how far the capture times of a device of another computer may be wrong.
    pub(super) fn uncertainty(&mut self, id: ModalityId, ns: u64) {
        if let Some(Some(modality)) = self.modalities.get_mut(id.index()) {
            modality.uncertainty_ns = modality.uncertainty_ns.max(Some(ns));
        }
    }

    /// Takes a frame: per modality its number, whether it is present, and the age in ns of its sample in the window, if
    /// any.
    pub(super) fn frame(&mut self, slots: impl Iterator<Item = (ModalityId, bool, Option<i64>)>) {
        let mut ages: Option<(i64, i64)> = None;
        for (id, present, age) in slots {
            let Some(Some(ModalityMeters { meter, .. })) = self.modalities.get_mut(id.index()) else { continue };
            meter.frame(present, age.is_some());
            let Some(age) = age else { continue };
            meter.offset.push(age.unsigned_abs());
            ages = Some(ages.map_or((age, age), |(least, most)| (least.min(age), most.max(age))));
        }
        if let Some((least, most)) = ages {
            self.skew.push(most.abs_diff(least));
        }
    }

    /// Call once every mask published before the samples so far has been taken.
    pub(super) fn settle(&mut self) {
        for modality in self.modalities.iter_mut().flatten() {
            modality.settle(&self.presence);
        }
    }

    /// The counts of a modality so far.
    pub(super) fn meter(&self, id: ModalityId) -> Option<&Meter> {
        self.modalities.get(id.index())?.as_ref().map(|modality| &modality.meter)
    }

    /// Samples dropped so far, of all modalities.
    pub(super) fn dropped(&self) -> u64 {
        self.modalities.iter().flatten().fold(0, |sum, modality| sum.saturating_add(modality.meter.counts.dropped))
    }

    /// Between the earliest and the latest sample of a frame, ms.
    pub(super) fn skew(&self) -> Option<Spread> {
        self.skew.spread()
    }

    /// The quality of a modality in an episode that ended at `end_ns`; `None` if it is not measured.
    pub(super) fn quality(&self, id: ModalityId, end_ns: u64) -> Option<Quality> {
        let ModalityMeters { measured, meter, longest_gap_ns, pending, plugged, uncertainty_ns, clip } =
            self.modalities.get(id.index())?.as_ref()?;
        let gaps = pending.iter().copied().chain([(meter.latest_ns, end_ns)]);
        let longest_gap_ns =
            gaps.fold(*longest_gap_ns, |longest, (from, to)| longest.max(self.presence.longest(id, from, to)));
        let length = end_ns.saturating_sub(self.begin_ns) as f64 / 1e9;
        let known = self.presence.is_known();
        let plugged = plugged.time(&self.presence, id, self.begin_ns, end_ns);
        let mut runs = meter.runs;
        meter.repeats.iter().for_each(|repeat| runs.add(*repeat, &self.presence, id));
        let present = self.presence.time(id, self.begin_ns, end_ns) as f64 / 1e9;
        Some(Quality {
            frozen_samples: runs.longest.samples,
            frozen: runs.longest.length_ns as f64 / 1e9,
            lateness: meter.lateness.spread(),
            clock_drift: meter.drift.over_the_episode().map(|ns| ns as f64 / 1e6),
            clock_ahead: meter.ahead_ns as f64 / 1e6,
            clip: clip.quality(self.begin_ns, end_ns),
            clock_uncertainty: uncertainty_ns.map(|ns| ns as f64 / 1e6),
            offset: meter.offset.spread(),
            presence: (known && length > 0.0).then(|| (present / length).clamp(0.0, 1.0)),
            present,
            plugged: plugged.plugged_ns as f64 / 1e9,
            opening: if known { plugged.idle_ns as f64 / 1e9 } else { 0.0 },
            // To three decimals, the resolution of a mean over seconds.
            hz: (present > 0.0).then(|| (meter.counts.samples as f64 / present * 1e3).round() / 1e3),
            nominal_hz: measured.limits.hz,
            longest_gap: longest_gap_ns as f64 / 1e9,
            ..meter.counts
        })
    }

    fn nearest_tick(&self, at_ns: u64) -> u64 {
        let after = self.grid.ticks_before(Stamp(at_ns));
        let (before, after) = (self.grid.tick(after.saturating_sub(1)).0, self.grid.tick(after).0);
        if at_ns.abs_diff(before) <= at_ns.abs_diff(after) { before } else { after }
    }
}

impl ModalityMeters {
    fn settle(&mut self, presence: &PresenceHistory) {
        for (from, to) in self.pending.drain(..) {
            let gap = presence.longest(self.measured.id, from, to);
            self.longest_gap_ns = self.longest_gap_ns.max(gap);
        }
        for repeat in self.meter.repeats.drain(..) {
            self.meter.runs.add(repeat, presence, self.measured.id);
        }
    }
}

/// When a device that records by itself did.
#[derive(Debug, Default)]
struct ClipMeter {
    is_asked: bool,
    recording: Plugged,
    first_ns: Option<u64>,
    refused: u64,
    stopped: u64,
}

impl ClipMeter {
    fn push(&mut self, at_ns: u64, state: ClipState) {
        self.is_asked = true;
        self.recording.push(at_ns, state == ClipState::Recording);
        match state {
            ClipState::Asked => {}
            ClipState::Recording => drop(self.first_ns.get_or_insert(at_ns)),
            ClipState::Refused => self.refused += 1,
            ClipState::Stopped => self.stopped += 1,
        }
    }

    fn quality(&self, begin_ns: u64, end_ns: u64) -> Option<ClipQuality> {
        let Self { is_asked, recording, first_ns, refused, stopped } = self;
        let seconds = |ns: u64| ns as f64 / 1e9;
        is_asked.then(|| ClipQuality {
            recorded: seconds(recording.total(begin_ns, end_ns)),
            began: first_ns.map(|first| seconds(first.saturating_sub(begin_ns))),
            refused: *refused,
            stopped: *stopped,
        })
    }
}

/// The measured properties of a sample.
#[derive(Debug, Clone, Copy)]
pub(super) struct SampleFacts<'a> {
    /// Its number; of a file only the lower 32 bits.
    pub(super) seq: u64,
    /// When it was captured, ns on the clock of the episode.
    pub(super) capture_ns: u64,
    /// When it was received, ns on the same clock.
    pub(super) recv_ns: u64,
    /// The driver called it damaged.
    pub(super) flagged: bool,
    /// Its source gave it the number of the sample before it.
    pub(super) again: bool,
    /// Whether it is usable, if it is a picture.
    pub(super) picture: Judgement,
    pub(super) payload: &'a [u8],
    /// The bytes equal those of the previous sample; `None`: to be determined here by hashing.
    pub(super) repeated: Option<bool>,
}

/// A run of samples that are byte for byte the same.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Run {
    /// Repetitions of the first one.
    pub(super) samples: u64,
    /// From the first one to the last while it was present, ns.
    pub(super) length_ns: u64,
}

/// The interval between two such samples; `None`: the next sample differed.
type Repeat = Option<(u64, u64)>;

/// Runs of samples, as far as the mask of their time is known.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Runs {
    /// The one in progress.
    pub(super) newest: Run,
    longest: Run,
}

impl Runs {
    /// The time of an absence does not count, whatever came before and after it.
    fn add(&mut self, repeat: Repeat, presence: &PresenceHistory, id: ModalityId) {
        let Some((from, to)) = repeat else {
            self.newest = Run::default();
            return;
        };
        self.newest.samples += 1;
        self.newest.length_ns = self.newest.length_ns.saturating_add(presence.time(id, from, to));
        if self.newest.length_ns >= self.longest.length_ns {
            self.longest = self.newest;
        }
    }
}

/// What is counted of one modality, sample by sample. Taking a sample neither allocates nor locks nor logs.
#[derive(Debug, Default)]
pub(super) struct Meter {
    /// The part of the quality that is counted per sample and frame.
    pub(super) counts: Quality,
    pub(super) runs: Runs,
    /// Until the mask of their time is known.
    repeats: Vec<Repeat>,
    /// Receipt minus capture.
    pub(super) lateness: DurationHistogram,
    /// Largest excess of a capture time over its receipt, ns.
    pub(super) ahead_ns: u64,
    pub(super) drift: Drift,
    /// Distance of a tick to the sample chosen for it.
    pub(super) offset: DurationHistogram,
    /// Was it present in the newest frame? Did that frame lack a sample without being the first of a presence?
    was_present: bool,
    lacked: bool,
    /// Latest capture so far; the beginning before the first sample.
    pub(super) latest_ns: u64,
    begin_ns: u64,
    seq: Option<u64>,
    /// Are samples compared with the previous one?
    compares: bool,
    /// Length and hash of the bytes of the newest sample, unless the source of samples compares them. Equal samples
    /// have equal hashes; a deliberate collision makes the verdict worse, never better.
    newest: Option<(usize, u64)>,
}

impl Meter {
    /// A meter of an episode that begins at `begin_ns`. `compares`: payloads are compared with the
    /// previous one.
    fn new(begin_ns: u64, compares: bool) -> Self {
        let repeats = Vec::with_capacity(PENDING);
        Self { latest_ns: begin_ns, begin_ns, compares, repeats, ..Self::default() }
    }

    /// Takes a sample whose frame waits until `deadline_ns`. Returns the interval since the previous sample.
    fn sample(&mut self, seen: &SampleFacts<'_>, deadline_ns: u64) -> Option<(u64, u64)> {
        let first = self.seq.is_none();
        self.counts.samples += 1;
        self.counts.bytes += seen.payload.len() as u64;
        self.counts.truncated += u64::from(seen.picture == Judgement::NotWhole);
        self.counts.other_shape += u64::from(seen.picture == Judgement::OtherShape);
        self.counts.damaged += u64::from(!seen.picture.is_usable() || seen.flagged);
        // A lower number at a later time is a restarted publisher.
        let again = seen.again || self.seq == Some(seen.seq) || (!first && seen.capture_ns <= self.latest_ns);
        self.counts.duplicates += u64::from(again);
        self.seq = Some(seen.seq);
        self.counts.late += u64::from(seen.recv_ns > deadline_ns);
        self.time(seen);
        self.compare(seen);
        let before = self.latest_ns;
        self.latest_ns = before.max(seen.capture_ns);
        (before < seen.capture_ns).then_some((before, seen.capture_ns))
    }

    /// Takes a frame, in the order of time: was it present, and was there a sample in the window?
    fn frame(&mut self, present: bool, valid: bool) {
        self.counts.frames_present += u64::from(present);
        self.counts.frames_valid += u64::from(valid);
        // The previous frame was not the last of a presence.
        self.counts.frames_missed += u64::from(present && self.lacked);
        self.lacked = present && !valid && self.was_present;
        self.was_present = present;
    }

    fn time(&mut self, seen: &SampleFacts<'_>) {
        let lateness = seen.recv_ns.saturating_sub(seen.capture_ns);
        self.lateness.push(lateness);
        let ahead = seen.capture_ns.saturating_sub(seen.recv_ns);
        self.ahead_ns = self.ahead_ns.max(ahead);
        let signed = |ns: u64| i64::try_from(ns).unwrap_or(i64::MAX);
        self.drift.push(seen.recv_ns.saturating_sub(self.begin_ns), signed(lateness).saturating_sub(signed(ahead)));
    }

    fn compare(&mut self, seen: &SampleFacts<'_>) {
        if !self.compares {
            return;
        }
        let repeated = seen.repeated.unwrap_or_else(|| {
            let mut hasher = DefaultHasher::new();
            hasher.write(seen.payload);
            let newest = Some((seen.payload.len(), hasher.finish()));
            std::mem::replace(&mut self.newest, newest) == newest
        });
        let repeated = repeated && self.counts.samples > 1;
        self.counts.repeated += u64::from(repeated);
        if repeated {
            self.repeats.push(Some((self.latest_ns, seen.capture_ns.max(self.latest_ns))));
        } else if self.repeats.last().map_or(self.runs.newest.samples > 0, Option::is_some) {
            self.repeats.push(None);
        }
    }
}

/// Number of parts of an episode; when more are needed, parts are merged in pairs.
const CELLS: usize = 16;
/// Initial length of a part.
const FIRST_WIDTH_NS: u64 = 250_000_000;
/// Least samples in a quarter: fewer may all have been delayed.
const LEAST_SAMPLES: u64 = 10;

#[derive(Debug, Clone, Copy)]
struct Cell {
    samples: u64,
    least_ns: i64,
}

impl Cell {
    const EMPTY: Self = Self { samples: 0, least_ns: i64::MAX };

    fn with(self, other: Self) -> Self {
        Self { samples: self.samples + other.samples, least_ns: self.least_ns.min(other.least_ns) }
    }
}

/// Whether the clock of a device runs at the rate of this machine's. Memory is fixed, however long an episode is.
///
/// A sample cannot arrive before its capture plus the shortest transport time. That shortest lateness is a property of
/// the device; if it changes over an episode, the clock runs fast or slow.
#[derive(Debug)]
pub(super) struct Drift {
    width_ns: u64,
    cells: [Cell; CELLS],
}

impl Default for Drift {
    fn default() -> Self {
        Self { width_ns: FIRST_WIDTH_NS, cells: [Cell::EMPTY; CELLS] }
    }
}

impl Drift {
    /// Takes the lateness of a sample received `since_begin_ns` after the beginning.
    fn push(&mut self, since_begin_ns: u64, lateness_ns: i64) {
        // At most 36 times: then a part covers all of u64.
        while since_begin_ns / self.width_ns >= CELLS as u64 {
            self.fold();
        }
        let index = usize::try_from(since_begin_ns / self.width_ns).unwrap_or(CELLS - 1);
        if let Some(cell) = self.cells.get_mut(index) {
            *cell = cell.with(Cell { samples: 1, least_ns: lateness_ns });
        }
    }

    fn fold(&mut self) {
        for index in 0..CELLS {
            let at = |index: usize| self.cells.get(index).copied().unwrap_or(Cell::EMPTY);
            let folded = at(2 * index).with(at(2 * index + 1));
            if let Some(cell) = self.cells.get_mut(index) {
                *cell = folded;
            }
        }
        self.width_ns = self.width_ns.saturating_mul(2);
    }

    /// By how much the shortest lateness grew from the first quarter of the samples' time to the
    /// last, ns; `None` when there are too few samples.
    fn over_the_episode(&self) -> Option<i64> {
        let holds = |cell: &Cell| cell.samples > 0;
        let first = self.cells.iter().position(holds)?;
        let last = self.cells.iter().rposition(holds)?;
        let cells = self.cells.get(first..=last)?;
        let quarter = cells.len() / 4;
        if quarter == 0 {
            return None;
        }
        let sum = |cells: &[Cell]| cells.iter().copied().fold(Cell::EMPTY, Cell::with);
        let (begin, end) = (sum(cells.get(..quarter)?), sum(cells.get(cells.len() - quarter..)?));
        (begin.samples.min(end.samples) >= LEAST_SAMPLES).then(|| end.least_ns.saturating_sub(begin.least_ns))
    }
}

/// Longest time resolved, microseconds: an hour.
const LONGEST_US: u64 = 3_600_000_000;
/// Two digits: an error of 1 % at most, in 13 KiB per histogram.
const DIGITS: u8 = 2;

/// A histogram of times of one kind.
#[derive(Debug)]
pub(super) struct DurationHistogram {
    /// `None` only if the bounds above were invalid.
    times: Option<Histogram<u32>>,
    longest_ns: u64,
    count: u64,
}

/// Median, a high percentile and the longest of some times, ms.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Median.
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Longest.
    pub max: f64,
}

impl Default for DurationHistogram {
    fn default() -> Self {
        Self { times: Histogram::new_with_bounds(1, LONGEST_US, DIGITS).ok(), longest_ns: 0, count: 0 }
    }
}

impl DurationHistogram {
    pub(super) fn push(&mut self, time_ns: u64) {
        self.longest_ns = self.longest_ns.max(time_ns);
        self.count += 1;
        if let Some(times) = &mut self.times {
            times.saturating_record(time_ns / 1000);
        }
    }

    /// Percentiles of the times; `None` without any.
    pub(super) fn spread(&self) -> Option<Spread> {
        let times = self.times.as_ref().filter(|_| self.count > 0)?;
        let max = self.longest_ns as f64 / 1e6;
        // The histogram returns the upper end of a cell.
        let at = |quantile| (times.value_at_quantile(quantile) as f64 / 1e3).min(max);
        Some(Spread { p50: at(0.5), p95: at(0.95), p99: at(0.99), max })
    }
}
