//! The observation of a policy at a tick of the control grid: the samples of the last ticks chosen by `sync`.
//!
//! Samples are kept unchanged; the choices of as many ticks are remembered as the steps of an observation span. Its
//! steps are `down_sample_steps` ticks apart. With more than one tick between them a sample may be wanted long after the
//! newest ones have taken its place: what is chosen is then copied. A step without its own sample (before the first tick,
//! or before a modality was plugged in) uses the sample of the next step, as in training. A tick that was missed has the
//! choice of the one before it. The samples of a modality that has left are shown for as long as the bundle holds them.
//!
//! An observation with a history has steps of its own number, and nothing stands in for one of them: a step has what was
//! chosen at its tick, or no sample. It has them whether or not the modality is present at the last tick. Its samples are
//! copied at any distance of its steps: a ring has what a tick needs, not what so many of them do.
//!
//! Invariant: nothing here allocates once the places of the samples have grown to the largest.

use std::sync::Arc;
use std::time::Duration;

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Epoch, FLAG_ERROR, SampleHeader};
use rapid_core::sync::{SyncModality, SyncSample, Synchronizer, WhenStale};
use rapid_core::time::Stamp;
use rapid_core::walked::WalkedPictures;
use rapid_pictures::judge::PictureJudge;
use rapid_registry::Registry;

use super::bundle::{Bundle, WhenAbsent};
use super::request::Request;

/// See the module's comment.
#[derive(Debug)]
pub struct Observer {
    sync: Synchronizer<usize>,
    judge: PictureJudge,
    buffers: Vec<ObservationBuffer>,
    /// Of the last tick that was observed.
    number: Option<u64>,
}

/// One observation of the bundle.
#[derive(Debug)]
struct ObservationBuffer {
    id: Option<ModalityId>,
    /// The newest samples, each at the index of its ring entry; behind these, if steps are more than a tick apart or a
    /// history, copies of the chosen ones, as many as ticks are remembered.
    places: Vec<StoredSample>,
    /// How many of them are the newest samples.
    newest: usize,
    next: usize,
    /// Where the next copy is written, from the first copy on.
    next_copy: usize,
    /// Steps of the observation.
    steps: usize,
    /// Ticks between two steps.
    apart: usize,
    /// Nothing stands in for a step.
    has_history: bool,
    /// The choices of the last ticks, the newest first.
    chosen: Vec<Option<Chosen>>,
    /// How long those of its last tick stand in for it while it is absent.
    hold: Duration,
    /// The choices of the last tick that had one, and when that was.
    kept: Vec<Option<Chosen>>,
    kept_at: Option<Stamp>,
}

impl ObservationBuffer {
    /// The choices that are shown to the policy at `tick`; `None` if the modality is absent.
    fn shown(&self, tick: Stamp) -> Option<&[Option<Chosen>]> {
        if self.chosen.first().is_some_and(Option::is_some) {
            return Some(&self.chosen);
        }
        let is_held = self.kept_at.is_some_and(|at| tick.since(at) <= self.hold) && !self.hold.is_zero();
        is_held.then_some(self.kept.as_slice())
    }

    /// Makes room for the choice of a tick, `ticks` after the last one.
    fn advance(&mut self, ticks: u64) {
        let last = self.chosen.first().copied().flatten();
        let missed = usize::try_from(ticks).unwrap_or(usize::MAX).clamp(1, self.chosen.len()) - 1;
        self.chosen.rotate_right(1 + missed);
        self.chosen.iter_mut().take(1 + missed).for_each(|chosen| *chosen = last);
        if let Some(newest) = self.chosen.first_mut() {
            *newest = None;
        }
    }

    /// Keeps a chosen sample for as long as its tick is remembered.
    fn keep(&mut self, chosen: Chosen) -> Chosen {
        let (samples, copies) = self.places.split_at_mut(self.newest);
        let Some(sample) = samples.get(chosen.place).filter(|_| !copies.is_empty()) else { return chosen };
        let (next, ticks) = (self.next_copy, copies.len());
        let last = (next + ticks - 1) % ticks;
        let which = |place: &StoredSample| (place.header.seq, place.header.epoch, place.header.capture_ns);
        // Of a device slower than the grid it is the sample of the tick before.
        if copies.get(last).is_some_and(|copy| which(copy) == which(sample)) {
            return Chosen { place: self.newest + last, ..chosen };
        }
        if let Some(copy) = copies.get_mut(next) {
            copy.set(&sample.header, &sample.bytes);
        }
        self.next_copy = (next + 1) % ticks;
        Chosen { place: self.newest + next, ..chosen }
    }

    /// A chosen sample; `None` if it has been overwritten.
    fn sample(&self, chosen: Chosen) -> Option<&StoredSample> {
        self.places.get(chosen.place).filter(|place| place.header.seq == chosen.seq)
    }

    /// Fills the steps of a history, observation `at` of `request`.
    fn fill_history(&self, at: usize, request: &mut Request) {
        for (back, step) in (0..self.steps).rev().enumerate() {
            let Some(cell) = request.cell_mut(at, step) else { continue };
            match self.chosen.get(back * self.apart).copied().flatten().and_then(|chosen| self.sample(chosen)) {
                Some(place) => cell.set(&place.header, &place.bytes),
                None => cell.clear(),
            }
        }
    }
}

#[derive(Debug, Clone, Default)]
struct StoredSample {
    header: SampleHeader,
    bytes: Vec<u8>,
}

impl StoredSample {
    fn set(&mut self, header: &SampleHeader, bytes: &[u8]) {
        self.header = *header;
        self.bytes.clear();
        self.bytes.extend_from_slice(bytes);
    }
}

#[derive(Debug, Clone, Copy)]
struct Chosen {
    place: usize,
    seq: u64,
}

impl Observer {
    /// For the observations of a bundle that matches the registry.
    pub fn new(bundle: &Bundle, registry: &Registry) -> Self {
        let devices = || bundle.observations.iter().map(|observation| registry.named(&observation.modality));
        let modalities: Vec<SyncModality> = devices()
            .flatten()
            .map(|device| SyncModality {
                id: device.id,
                // The policy decides whether a sample is too old.
                when_stale: WhenStale::Hold,
                latency: device.latency,
                capacity: device.depth,
            })
            .collect();
        let buffers = devices().zip(&bundle.observations).map(|(device, observation)| {
            let (steps, apart) = (bundle.steps_of(observation), observation.down_sample_steps);
            let ticks = (steps - 1) * apart + 1;
            let has_history = observation.history.is_some();
            let newest = device.map_or(0, |device| device.depth);
            ObservationBuffer {
                id: device.map(|device| device.id),
                places: vec![StoredSample::default(); newest + if apart > 1 || has_history { ticks } else { 0 }],
                newest,
                next: 0,
                next_copy: 0,
                steps,
                apart,
                has_history,
                chosen: vec![None; ticks],
                hold: match observation.when_absent {
                    WhenAbsent::Zero => Duration::ZERO,
                    WhenAbsent::HoldLast(time) => time,
                },
                kept: vec![None; ticks],
                kept_at: None,
            }
        });
        Self {
            judge: PictureJudge::alone(),
            buffers: buffers.collect(),
            sync: Synchronizer::new(&modalities, registry.rig.sync_window),
            number: None,
        }
    }

    /// Looks up what others in the process have found of pictures.
    pub fn share(&mut self, walked: Arc<WalkedPictures>) {
        self.judge = PictureJudge::sharing(walked);
    }

    /// Stores a sample; ignores samples of modalities that the policy does not observe, samples marked as damaged by their
    /// device, and pictures that are not usable.
    pub fn push(&mut self, id: ModalityId, header: &SampleHeader, payload: &[u8]) {
        if !self.buffers.iter().any(|buffer| buffer.id == Some(id)) {
            return;
        }
        let is_usable = self.judge.sample(id, header, payload).is_usable();
        if header.flags & FLAG_ERROR != 0 || !is_usable {
            return;
        }
        // Observations of one modality (two ways to process one camera) use the same index: the first of them
        // determines it.
        let mut kept = None;
        for buffer in self.buffers.iter_mut().filter(|buffer| buffer.id == Some(id)) {
            let at = buffer.next;
            let Some(place) = buffer.places.get_mut(at).filter(|_| at < buffer.newest) else { continue };
            place.set(header, payload);
            buffer.next = (at + 1) % buffer.newest;
            kept = Some(at);
        }
        let Some(keep) = kept else { return };
        let (capture, recv, epoch) = (Stamp(header.capture_ns), Stamp(header.recv_ns), Epoch(header.epoch));
        self.sync.push(id, SyncSample { capture, recv, seq: header.seq, epoch, keep });
    }

    /// The capture time of the newest sample, once every present modality has sent one.
    pub fn first_sight(&self, mask: PhysicalMask) -> Option<Stamp> {
        let present = self.buffers.iter().filter(|buffer| buffer.id.is_some_and(|id| mask.contains(id)));
        let newest = |buffer: &ObservationBuffer| {
            buffer.places.iter().map(|place| place.header.capture_ns).max().filter(|ns| *ns > 0)
        };
        // `None` if any present modality has no sample.
        let newest = present.map(newest).collect::<Option<Vec<u64>>>()?;
        newest.into_iter().max().map(Stamp)
    }

    /// Observes tick number `number`, at `tick`, with the samples known at `now`; numbers rise. Returns the age of the
    /// oldest chosen sample of the present modalities; `None` if one of them has no sample at all, or none is present.
    pub fn observe(&mut self, number: u64, tick: Stamp, now: Stamp, mask: PhysicalMask) -> Option<Duration> {
        self.sync.observe(tick, now, mask);
        let ticks = self.number.replace(number).map_or(1, |last| number.saturating_sub(last));
        let mut oldest = None;
        let mut whole = true;
        for buffer in &mut self.buffers {
            buffer.advance(ticks);
            let Some(slot) = buffer.id.and_then(|id| self.sync.observation().slot(id)).filter(|slot| slot.present)
            else {
                continue;
            };
            let sample = self.sync.sample(slot);
            let chosen = sample.map(|sample| Chosen { place: sample.keep, seq: sample.seq });
            let chosen = chosen.map(|chosen| buffer.keep(chosen));
            whole &= chosen.is_some();
            if let Some(newest) = buffer.chosen.first_mut().filter(|_| chosen.is_some()) {
                *newest = chosen;
                buffer.kept.copy_from_slice(&buffer.chosen);
                buffer.kept_at = Some(tick);
            }
            let age = Duration::from_nanos(u64::try_from(slot.age_ns).unwrap_or(0));
            oldest = oldest.max(Some(age));
        }
        oldest.filter(|_| whole)
    }

    /// Fills `request` with the samples chosen in the last ticks, up to its own tick.
    pub fn fill(&self, request: &mut Request) {
        for (at, buffer) in self.buffers.iter().enumerate() {
            if buffer.has_history {
                buffer.fill_history(at, request);
                continue;
            }
            let shown = buffer.shown(request.stamp);
            request.set_present(at, shown.is_some());
            let Some(shown) = shown else { continue };
            let mut chosen = None;
            // From the newest step back: a step without a sample uses that of the following step, and so does one whose
            // sample has been overwritten.
            for (back, step) in (0..buffer.steps).rev().enumerate() {
                let kept = shown.get(back * buffer.apart).copied().flatten();
                let kept = kept.filter(|kept| buffer.sample(*kept).is_some());
                chosen = kept.or(chosen);
                let (Some(kept), Some(cell)) = (chosen, request.cell_mut(at, step)) else { continue };
                if let Some(place) = buffer.places.get(kept.place) {
                    cell.set(&place.header, &place.bytes);
                }
            }
        }
    }

    /// Discards all samples.
    pub fn clear(&mut self) {
        self.sync.clear();
        self.number = None;
        for buffer in &mut self.buffers {
            buffer.chosen.fill(None);
            buffer.kept_at = None;
            buffer.next = 0;
            for place in &mut buffer.places {
                place.header = SampleHeader::default();
            }
        }
    }
}

#[cfg(test)]
mod tests;
