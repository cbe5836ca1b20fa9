//! The quality of an episode: what is counted while it is recorded, or while its file is read.
//!
//! Samples, masks and frames go in, one [`Quality`] a modality comes out. The recorder and `inspect`
//! use the same code: of one file both say the same, as far as the file holds what they count.
//!
//! Invariant: pure: no clock, no input or output; times are ns on whatever clock the caller uses.
//! Invariant: taking a sample, a mask that has not changed or a frame allocates nothing, unless the
//! caller is far behind.

mod drift;
mod jpeg;
mod meter;
mod plugged;
mod presence;
mod tally;
#[cfg(test)]
mod tests;

use std::time::Duration;

use serde::Serialize;

use crate::mask::PhysicalMask;
use crate::modality::{MAX_MODALITIES, ModalityId};
use crate::registry::{DeviceSpec, Registry, VerdictSpec};
use crate::sync::Grid;
use crate::time::{Stamp, nanoseconds};
use plugged::Plugged;
use presence::Presence;

pub(super) use meter::{Counts, Meter, Seen};
pub use tally::Spread;
pub(super) use tally::Tally;

/// Room for intervals without a sample until the mask of their time is known; a reader that is further
/// behind has a disk that stands still, and may allocate.
const PENDING: usize = 32;
/// Most of them; then they are judged by the masks there are. A sensor at 1 kHz has so many in four seconds, in which the
/// mask is published two thousand times.
const MOST_PENDING: usize = 4096;

/// A modality as it is to be measured.
#[derive(Debug, Clone)]
pub(super) struct Measured {
    /// Its number.
    pub(super) id: ModalityId,
    /// Its limits say whether payloads are compared, and its nominal rate.
    pub(super) limits: VerdictSpec,
    /// How long before its capture what a sample shows happened, ns.
    pub(super) latency_ns: u64,
}

impl Measured {
    /// Every modality of a registry.
    pub(super) fn all(registry: &Registry) -> Vec<Self> {
        let measured = |device: &DeviceSpec| Self {
            id: device.id,
            limits: device.verdict,
            latency_ns: nanoseconds(device.latency),
        };
        registry.devices.iter().map(measured).collect()
    }
}

/// When frames are, and how long they wait.
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
    pub(super) fn of(registry: &Registry, begin: Stamp, settle: Duration) -> Self {
        let window = registry.rig.sync_window;
        Self { begin_ns: begin.0, hz: registry.rig.observation_hz, window, wait: window + settle }
    }
}

/// What a modality was like over an episode.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[cfg_attr(test, derive(Default))]
pub struct Quality {
    /// Samples in the file.
    pub samples: u64,
    /// Payload bytes in the file.
    pub bytes: u64,
    /// Samples that the device lost.
    pub lost: u64,
    /// Samples lost between the driver and the file.
    pub dropped: u64,
    /// Samples that the driver called damaged, and pictures that are not whole.
    pub damaged: u64,
    /// Of `damaged`, JPEG pictures without their beginning or their end.
    pub truncated: u64,
    /// Samples whose number or capture time does not go on.
    pub duplicates: u64,
    /// Samples that are byte for byte the one before; absent where that is not looked at.
    pub repeated: u64,
    /// Repetitions in the longest run of such samples.
    pub frozen_samples: u64,
    /// Length of that run, seconds.
    pub frozen: f64,
    /// Samples received after their frame's deadline.
    pub late: u64,
    /// Time from capture to receipt, ms.
    pub lateness: Option<Spread>,
    /// How much later than at the beginning samples arrived at the end, measured by the earliest of
    /// each, ms: the device's clock runs slow, or fast if negative. Unknown of few samples.
    pub clock_drift: Option<f64>,
    /// Furthest capture time after the receipt, ms: a clock that is ahead.
    pub clock_ahead: f64,
    /// Distance between a tick and its sample, ms.
    pub offset: Option<Spread>,
    /// Share of the episode in which it was present, 0 to 1; unknown without a mask.
    pub presence: Option<f64>,
    /// Time in which it was present, seconds; all of it without a mask.
    pub present: f64,
    /// Time in which its device was plugged in, seconds, as far as events tell.
    pub plugged: f64,
    /// Longest time in which it was plugged in and not present, seconds.
    pub opening: f64,
    /// Samples a second while present; absent when it never was.
    pub hz: Option<f64>,
    /// Samples a second it should send, where something says so.
    pub nominal_hz: Option<f64>,
    /// Longest time without a sample while it was present, seconds.
    pub longest_gap: f64,
    /// Frames in which it was present.
    pub frames_present: u64,
    /// Frames with a sample of it in the window.
    pub frames_valid: u64,
    /// Frames in which it was present without such a sample; the first and the last of a presence are not
    /// counted: the sample that belongs to them may lie outside of it, or of the episode.
    pub frames_missed: u64,
}

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Measures {
    grid: Grid,
    window_ns: u64,
    wait_ns: u64,
    begin_ns: u64,
    presence: Presence,
    lanes: Vec<Option<Lane>>,
    /// Between the earliest and the latest sample of a frame.
    skew: Tally,
}

#[derive(Debug)]
struct Lane {
    measured: Measured,
    meter: Meter,
    longest_gap_ns: u64,
    pending: Vec<(u64, u64)>,
    plugged: Plugged,
}

impl Measures {
    pub(super) fn new(modalities: &[Measured], frames: Frames) -> Self {
        let mut lanes = Vec::new();
        lanes.resize_with(MAX_MODALITIES, || None);
        for measured in modalities {
            let compares = measured.limits.compares();
            if let Some(lane) = lanes.get_mut(measured.id.index()) {
                *lane = Some(Lane {
                    measured: measured.clone(),
                    meter: Meter::new(frames.begin_ns, compares),
                    longest_gap_ns: 0,
                    pending: Vec::with_capacity(PENDING),
                    plugged: Plugged::default(),
                });
            }
        }
        Self {
            grid: Grid::new(Stamp(frames.begin_ns), frames.hz),
            window_ns: nanoseconds(frames.window),
            wait_ns: nanoseconds(frames.wait),
            begin_ns: frames.begin_ns,
            presence: Presence::new(frames.begin_ns),
            lanes,
            skew: Tally::new(),
        }
    }

    /// Takes a sample that belongs to the episode.
    pub(super) fn sample(&mut self, id: ModalityId, seen: &Seen<'_>) {
        let Some(Some(lane)) = self.lanes.get(id.index()) else { return };
        let shown = seen.capture_ns.saturating_sub(lane.measured.latency_ns);
        let tick = self.nearest_tick(shown);
        // No frame waits for one between the windows: it has the time that its own would give it.
        let due = if shown.abs_diff(tick) <= self.window_ns { tick } else { shown };
        let deadline = due.saturating_add(self.wait_ns);
        let Some(Some(lane)) = self.lanes.get_mut(id.index()) else { return };
        let Some((from, to)) = lane.meter.sample(seen, deadline) else { return };
        if to - from > lane.longest_gap_ns {
            if lane.pending.len() >= MOST_PENDING {
                lane.settle(&self.presence);
            }
            lane.pending.push((from, to));
        }
    }

    /// Counts samples that are missing.
    pub(super) fn missing(&mut self, id: ModalityId, lost: u64, dropped: u64) {
        if let Some(Some(lane)) = self.lanes.get_mut(id.index()) {
            // Saturating: the numbers come from whoever publishes.
            let counts = &mut lane.meter.counts;
            counts.lost = counts.lost.saturating_add(lost);
            counts.dropped = counts.dropped.saturating_add(dropped);
        }
    }

    /// Takes a publication of the mask.
    pub(super) fn mask(&mut self, at_ns: u64, mask: PhysicalMask) {
        self.presence.push(at_ns, mask);
    }

    /// Takes that a device was plugged in, or out; one that was there before from the beginning.
    pub(super) fn plugged(&mut self, id: ModalityId, at_ns: u64, there: bool) {
        if let Some(Some(lane)) = self.lanes.get_mut(id.index()) {
            lane.plugged.push(at_ns, there);
        }
    }

    /// Takes a frame: of each modality its number, whether it is present, and the age in ns of its
    /// sample if there is one in the window.
    pub(super) fn frame(&mut self, slots: impl Iterator<Item = (ModalityId, bool, Option<i64>)>) {
        let mut ages: Option<(i64, i64)> = None;
        for (id, present, age) in slots {
            let Some(Some(Lane { meter, .. })) = self.lanes.get_mut(id.index()) else { continue };
            meter.frame(present, age.is_some());
            let Some(age) = age else { continue };
            meter.offset.push(age.unsigned_abs());
            ages = Some(ages.map_or((age, age), |(least, most)| (least.min(age), most.max(age))));
        }
        if let Some((least, most)) = ages {
            self.skew.push(most.abs_diff(least));
        }
    }

    /// Every mask published before the samples taken so far has been taken.
    pub(super) fn settle(&mut self) {
        for lane in self.lanes.iter_mut().flatten() {
            lane.settle(&self.presence);
        }
    }

    /// What there is of a modality so far.
    pub(super) fn meter(&self, id: ModalityId) -> Option<&Meter> {
        self.lanes.get(id.index())?.as_ref().map(|lane| &lane.meter)
    }

    /// Samples dropped so far, of all modalities.
    pub(super) fn dropped(&self) -> u64 {
        self.lanes.iter().flatten().fold(0, |sum, lane| sum.saturating_add(lane.meter.counts.dropped))
    }

    /// Between the earliest and the latest sample of a frame, ms.
    pub(super) fn skew(&self) -> Option<Spread> {
        self.skew.spread()
    }

    /// What a modality was like in an episode that ended at `end_ns`; `None` of one that is not
    /// measured.
    pub(super) fn quality(&self, id: ModalityId, end_ns: u64) -> Option<Quality> {
        let Lane { measured, meter, longest_gap_ns, pending, plugged } = self.lanes.get(id.index())?.as_ref()?;
        let gaps = pending.iter().copied().chain([(meter.latest_ns, end_ns)]);
        let longest_gap_ns = gaps
            .fold(*longest_gap_ns, |longest, (from, to)| longest.max(without_samples(&self.presence, id, from, to)));
        let length = end_ns.saturating_sub(self.begin_ns) as f64 / 1e9;
        let known = self.presence.is_known();
        let together: u64 = self.presence.spans(id, self.begin_ns, end_ns).map(|(from, to)| to - from).sum();
        let plugged = plugged.time(&self.presence, id, self.begin_ns, end_ns);
        let present = if known { together as f64 / 1e9 } else { length };
        let Counts { samples, bytes, lost, dropped, damaged, truncated, duplicates, repeated, late } = meter.counts;
        Some(Quality {
            samples,
            bytes,
            lost,
            dropped,
            damaged,
            truncated,
            duplicates,
            repeated,
            frozen_samples: meter.longest_run.samples,
            frozen: meter.longest_run.length_ns as f64 / 1e9,
            late,
            lateness: meter.lateness.spread(),
            clock_drift: meter.drift.over_the_episode().map(|ns| ns as f64 / 1e6),
            clock_ahead: meter.ahead_ns as f64 / 1e6,
            offset: meter.offset.spread(),
            presence: (known && length > 0.0).then(|| (present / length).clamp(0.0, 1.0)),
            present,
            plugged: plugged.plugged_ns as f64 / 1e9,
            opening: if known { plugged.idle_ns as f64 / 1e9 } else { 0.0 },
            // To three decimals, which is all a mean over seconds can say.
            hz: (present > 0.0).then(|| (samples as f64 / present * 1e3).round() / 1e3),
            nominal_hz: measured.limits.hz,
            longest_gap: longest_gap_ns as f64 / 1e9,
            frames_present: meter.frames_present,
            frames_valid: meter.frames_valid,
            frames_missed: meter.frames_missed,
        })
    }

    fn nearest_tick(&self, at_ns: u64) -> u64 {
        let after = self.grid.ticks_before(Stamp(at_ns));
        let (before, after) = (self.grid.tick(after.saturating_sub(1)).0, self.grid.tick(after).0);
        if at_ns.abs_diff(before) <= at_ns.abs_diff(after) { before } else { after }
    }
}

impl Lane {
    fn settle(&mut self, presence: &Presence) {
        for (from, to) in self.pending.drain(..) {
            let gap = without_samples(presence, self.measured.id, from, to);
            self.longest_gap_ns = self.longest_gap_ns.max(gap);
        }
    }
}

/// Longest time between `from` and `to` in which the modality was there: an absence is no gap.
fn without_samples(presence: &Presence, id: ModalityId, from: u64, to: u64) -> u64 {
    if !presence.is_known() {
        return to.saturating_sub(from);
    }
    presence.spans(id, from, to).map(|(begin, end)| end - begin).max().unwrap_or(0)
}
