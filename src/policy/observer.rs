//! The observation of a policy at a tick of the control grid: the samples of the last ticks chosen by `sync`.
//!
//! Samples are kept unchanged, one copy of each; the choices of as many ticks are remembered as an observation has
//! steps. A step without its own sample (before the first tick, or before a modality was plugged in) uses the sample of
//! the next step, as in training. The samples of a modality that has left are shown for as long as the bundle holds them.
//!
//! Invariant: nothing here allocates once the places of the samples have grown to the largest.

use std::time::Duration;

use super::bundle::{Bundle, WhenAbsent};
use super::request::Request;
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::registry::{Registry, WhenStale};
use crate::sample::{Epoch, FLAG_ERROR, SampleHeader};
use crate::sync::{SyncModality, SyncSample, Synchronizer};
use crate::time::Stamp;

/// See the module's comment.
#[derive(Debug)]
pub struct Observer {
    sync: Synchronizer<usize>,
    lanes: Vec<Lane>,
    /// Steps of an observation.
    steps: usize,
}

/// One observation of the bundle.
#[derive(Debug)]
struct Lane {
    id: Option<ModalityId>,
    /// The newest samples, each at the index of its ring entry.
    places: Vec<Place>,
    next: usize,
    /// The choices of the last ticks, the newest first.
    chosen: Vec<Option<Chosen>>,
    /// How long those of its last tick stand in for it while it is absent.
    hold: Duration,
    /// The choices of the last tick that had one, and when that was.
    kept: Vec<Option<Chosen>>,
    kept_at: Option<Stamp>,
}

impl Lane {
    /// The choices that are shown to the policy at `tick`; `None` if the modality is absent.
    fn shown(&self, tick: Stamp) -> Option<&[Option<Chosen>]> {
        if self.chosen.first().is_some_and(Option::is_some) {
            return Some(&self.chosen);
        }
        let is_held = self.kept_at.is_some_and(|at| tick.since(at) <= self.hold) && !self.hold.is_zero();
        is_held.then_some(self.kept.as_slice())
    }
}

#[derive(Debug, Clone, Default)]
struct Place {
    header: SampleHeader,
    bytes: Vec<u8>,
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
        let lanes = devices().zip(&bundle.observations).map(|(device, observation)| Lane {
            id: device.map(|device| device.id),
            places: vec![Place::default(); device.map_or(0, |device| device.depth)],
            next: 0,
            chosen: vec![None; bundle.n_obs_steps],
            hold: match observation.when_absent {
                WhenAbsent::Zero => Duration::ZERO,
                WhenAbsent::HoldLast(time) => time,
            },
            kept: vec![None; bundle.n_obs_steps],
            kept_at: None,
        });
        Self {
            lanes: lanes.collect(),
            sync: Synchronizer::new(&modalities, registry.rig.sync_window),
            steps: bundle.n_obs_steps,
        }
    }

    /// Stores a sample; ignores samples of modalities that the policy does not observe, and samples marked as damaged
    /// by their device.
    pub fn push(&mut self, id: ModalityId, header: &SampleHeader, payload: &[u8]) {
        if header.flags & FLAG_ERROR != 0 {
            return;
        }
        // Observations of one modality (two ways to process one camera) use the same index: the first of them
        // determines it.
        let mut kept = None;
        for lane in self.lanes.iter_mut().filter(|lane| lane.id == Some(id)) {
            let at = lane.next;
            let Some(place) = lane.places.get_mut(at) else { continue };
            place.header = *header;
            place.bytes.clear();
            place.bytes.extend_from_slice(payload);
            lane.next = (at + 1) % lane.places.len();
            kept = Some(at);
        }
        let Some(keep) = kept else { return };
        let (capture, recv, epoch) = (Stamp(header.capture_ns), Stamp(header.recv_ns), Epoch(header.epoch));
        self.sync.push(id, SyncSample { capture, recv, seq: header.seq, epoch, keep });
    }

    /// The capture time of the newest sample, once every present modality has sent one.
    pub fn first_sight(&self, mask: PhysicalMask) -> Option<Stamp> {
        let present = self.lanes.iter().filter(|lane| lane.id.is_some_and(|id| mask.contains(id)));
        let newest = |lane: &Lane| lane.places.iter().map(|place| place.header.capture_ns).max().filter(|ns| *ns > 0);
        // `None` if any present modality has no sample.
        let newest = present.map(newest).collect::<Option<Vec<u64>>>()?;
        newest.into_iter().max().map(Stamp)
    }

    /// Observes a tick with the samples known at `now`. Returns the age of the oldest chosen sample of the present
    /// modalities; `None` if one of them has no sample at all, or none is present.
    pub fn look(&mut self, tick: Stamp, now: Stamp, mask: PhysicalMask) -> Option<Duration> {
        self.sync.observe(tick, now, mask);
        let mut oldest = None;
        let mut whole = true;
        for lane in &mut self.lanes {
            lane.chosen.rotate_right(1);
            let Some(newest) = lane.chosen.first_mut() else { continue };
            *newest = None;
            let Some(slot) = lane.id.and_then(|id| self.sync.observation().slot(id)).filter(|slot| slot.present) else {
                continue;
            };
            let sample = self.sync.sample(slot);
            *newest = sample.map(|sample| Chosen { place: sample.keep, seq: sample.seq });
            whole &= newest.is_some();
            if newest.is_some() {
                lane.kept.copy_from_slice(&lane.chosen);
                lane.kept_at = Some(tick);
            }
            let age = Duration::from_nanos(u64::try_from(slot.age_ns).unwrap_or(0));
            oldest = oldest.max(Some(age));
        }
        oldest.filter(|_| whole)
    }

    /// Fills `request` with the samples chosen in the last ticks, up to its own tick.
    pub fn fill(&self, request: &mut Request) {
        for (at, lane) in self.lanes.iter().enumerate() {
            let shown = lane.shown(request.stamp);
            request.set_present(at, shown.is_some());
            let Some(shown) = shown else { continue };
            let mut chosen = None;
            // From the newest step back: a step without a sample uses that of the following step, and so does one whose
            // sample has been overwritten.
            for (back, step) in (0..self.steps).rev().enumerate() {
                let kept = shown.get(back).copied().flatten();
                let kept =
                    kept.filter(|kept| lane.places.get(kept.place).is_some_and(|place| place.header.seq == kept.seq));
                chosen = kept.or(chosen);
                let (Some(kept), Some(cell)) = (chosen, request.cell_mut(at, step)) else { continue };
                if let Some(place) = lane.places.get(kept.place) {
                    cell.set(&place.header, &place.bytes);
                }
            }
        }
    }

    /// Discards all samples.
    pub fn clear(&mut self) {
        self.sync.clear();
        for lane in &mut self.lanes {
            lane.chosen.fill(None);
            lane.kept_at = None;
            lane.next = 0;
            for place in &mut lane.places {
                place.header = SampleHeader::default();
            }
        }
    }
}
