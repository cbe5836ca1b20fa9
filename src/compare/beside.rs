//! A policy that watches an episode in which a person or another program acted: what it would have done at each tick,
//! compared with what was done.
//!
//! Inference runs as for a policy in control, every `n_action_steps` ticks and when a modality appears or disappears;
//! its answer is available immediately, and its actions are clamped to the limits. It observes the effects of the
//! recorded actions, not of its own.
//!
//! The control grid begins with the episode. The action of a tick is the one captured nearest to it, at most
//! half a tick away.

use std::collections::BTreeMap;
use std::path::Path;

use rapid_core::modality::MAX_MODALITIES;
use rapid_core::sample::{Epoch, SampleHeader};
use rapid_core::sync::Grid;
use rapid_core::time::Stamp;
use rapid_policy::bundle::Bundle;
use rapid_policy::horizon::{Counts, WithoutMask};
use rapid_policy::model::Model;
use rapid_policy::pilot::Pilot;
use rapid_policy::request::Request;
use rapid_registry::Registry;
use serde::Serialize;

use super::difference::Difference;
use super::survey::{Ordered, Received, Survey};
use super::{CompareError, Ended};

/// Seed of the policy's noise.
const SEED: u64 = 0;

/// The result.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Beside {
    /// Ticks of the control grid within the episode.
    pub ticks: u64,
    /// Those at which both acted.
    pub compared: u64,
    /// Those at which the policy alone acted.
    pub without_recorded: u64,
    /// Those at which the policy would have held, by reason.
    pub held: BTreeMap<String, u64>,
    /// Actions in the file.
    pub recorded: u64,
    /// What the policy's executor counted.
    pub counts: Counts,
    /// The last reason why the policy had no answer.
    pub failure: Option<String>,
    /// Between what the policy would have done and what was done.
    pub difference: Difference,
}

struct Follower<'a> {
    grid: Grid,
    /// The next tick.
    tick: u64,
    pilot: Pilot,
    model: &'a mut Model,
    request: Request,
    chunk: Vec<f32>,
    recorded: BTreeMap<u64, &'a [f64]>,
    beside: Beside,
}

pub(super) fn compare(
    file: &Path,
    survey: &Survey,
    bundle: &Bundle,
    registry: &Registry,
    model: &mut Model,
    ended: &mut Ended<'_>,
) -> Result<Beside, CompareError> {
    let grid = Grid::new(Stamp(survey.begin_ns), bundle.control_hz);
    let mut watch = Follower {
        grid,
        tick: 0,
        pilot: Pilot::new(bundle, registry, WithoutMask::Hold, SEED),
        request: Request::new(bundle),
        chunk: vec![0.0; model.chunk_len()],
        model,
        recorded: by_tick(survey, grid, bundle.control_hz),
        beside: Beside {
            recorded: survey.actions.len() as u64,
            difference: Difference::new(&bundle.action),
            ..Beside::default()
        },
    };
    // After this many ticks without input no action is left.
    let idle = bundle.horizon as u64 + grid.ticks_before(Stamp(survey.begin_ns).after(bundle.max_observation_age));
    let mut received = Ordered::open(file, registry)?;
    let mut epochs = [Epoch::default(); MAX_MODALITIES];
    let mut last = None;
    while let Some((at, what)) = received.next()? {
        let due = grid.ticks_before(Stamp(at));
        let end = due.min(watch.tick.saturating_add(idle));
        while watch.tick < end {
            if !ended.advance(usize::try_from(watch.tick).unwrap_or(usize::MAX), survey.actions.len()) {
                return Ok(watch.end());
            }
            watch.tick();
        }
        watch.tick = watch.tick.max(due);
        last = Some(at);
        match what {
            Received::Sample { id, header, payload } => {
                let epoch = epochs.get(id.index()).copied().unwrap_or_default().0;
                watch.pilot.observer.push(id, &SampleHeader { epoch, ..header }, &payload);
            }
            Received::Mask(mask) => watch.pilot.mask = mask,
            Received::Opened { id, epoch } => {
                if let Some(place) = epochs.get_mut(id.index()) {
                    *place = epoch;
                }
            }
        }
    }
    // The moment of the end is also a tick if it has an action.
    if last.is_some_and(|last| grid.tick(watch.tick) == Stamp(last)) && watch.recorded.contains_key(&watch.tick) {
        watch.tick();
    }
    Ok(watch.end())
}

impl Follower<'_> {
    fn tick(&mut self) {
        let (number, stamp) = (self.tick, self.grid.tick(self.tick));
        self.tick += 1;
        self.beside.ticks += 1;
        if self.pilot.observe(number, stamp, stamp) {
            self.pilot.fill(number, stamp, &mut self.request);
            let refused = match self.model.answer(&self.request, &mut self.chunk) {
                Ok(()) => self.pilot.answer(&self.request, &self.chunk).err().map(|refused| refused.to_string()),
                Err(error) => {
                    self.pilot.queue.failed(number);
                    Some(error.to_string())
                }
            };
            self.beside.failure = refused.or_else(|| self.beside.failure.take());
        }
        let step = self.pilot.step(number);
        let recorded =
            self.recorded.get(&number).filter(|recorded| recorded.len() == self.beside.difference.axes.len());
        match (step.action, recorded) {
            (Some(action), Some(recorded)) => {
                self.beside.compared += 1;
                let action = action.iter().copied().map(f64::from);
                self.beside.difference.add(number, action, recorded.iter().copied());
            }
            (Some(_), None) => self.beside.without_recorded += 1,
            (None, _) => {
                let reason = step.hold.map(|reason| reason.to_string()).unwrap_or_default();
                *self.beside.held.entry(reason).or_default() += 1;
            }
        }
    }

    fn end(mut self) -> Beside {
        self.beside.counts = self.pilot.queue.counts();
        self.beside
    }
}

/// The recorded action of each tick.
fn by_tick(survey: &Survey, grid: Grid, hz: f64) -> BTreeMap<u64, &[f64]> {
    let half = 0.5e9 / hz;
    let mut nearest: BTreeMap<u64, (u64, &[f64])> = BTreeMap::new();
    for action in &survey.actions {
        let after = grid.ticks_before(Stamp(action.at_ns));
        for tick in [after.saturating_sub(1), after] {
            let away = grid.tick(tick).0.abs_diff(action.at_ns);
            let found = nearest.entry(tick).or_insert((u64::MAX, &[]));
            if away < found.0 && away as f64 <= half {
                *found = (away, &action.values);
            }
        }
    }
    nearest.into_iter().map(|(tick, (_, values))| (tick, values)).collect()
}
