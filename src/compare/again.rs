//! The chunks of a recorded policy, recomputed from the samples that their events name.
//!
//! Chunks are processed in the order in which the policy produced them. The reference that later samples are compared with is
//! the attached sample. Files of earlier versions and of `rapid eval` have none; there it is the first sample that a chunk
//! names. If an earlier request got no answer, and so left no event, the reference may differ
//! here, and the difference shows it.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;

use rapid_core::sample::SampleHeader;
use rapid_episode::decode::{Content, Scratch};
use rapid_episode::reader::{Item, Reader};
use rapid_policy::bundle::{Bundle, ObservationInput, ObservationSpec, Operation, VectorOperation};
use rapid_policy::compose::Composer;
use rapid_policy::model::Model;
use rapid_policy::request::Request;
use rapid_registry::Registry;
use serde::Serialize;

use super::difference::{Difference, distance};
use super::survey::{RecordedAction, RecordedChunk, RecordedSamples, SEQUENCE_BITS, Survey, header};
use super::{CompareError, Ended};

/// The result.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Again {
    /// Chunks in the file.
    pub chunks: u64,
    /// Those that were recomputed.
    pub compared: u64,
    /// Those with samples missing from the file: captured before the episode began, or lost.
    pub samples_missing: u64,
    /// Those with a reference that is neither attached nor known to be in the file.
    pub reference_unknown: u64,
    /// Those with other observations or another length than the policy's: from another policy.
    pub unlike: u64,
    /// Those whose event cannot be read.
    pub unreadable: u64,
    /// Those that could not be computed.
    pub failed: u64,
    /// Why, of the last of them.
    pub failure: Option<String>,
    /// Between the chunks in the file and the recomputed ones.
    pub difference: Difference,
    /// The actions in the file compared with the chunks in the file.
    pub actions: Actions,
}

/// The published actions compared with those of the chunks, clamped to the limits.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Actions {
    /// Actions in the file.
    pub recorded: u64,
    /// Those whose tick a chunk in the file covers, and which cannot be of a chunk from before the episode. If several chunks
    /// cover it, the nearest counts.
    pub compared: u64,
    /// The others.
    pub without_chunk: u64,
    /// The difference.
    pub difference: Difference,
}

impl Again {
    /// The largest of all differences; `None` if nothing was compared.
    pub fn largest(&self) -> Option<f64> {
        let actions = self.actions.difference.all.largest;
        (self.compared > 0).then(|| self.difference.all.largest.max(actions))
    }
}

/// A sample: position of its device in the registry, and the number that the message holds.
type Key = (usize, u64);

/// The state of the computation.
struct Work<'a> {
    bundle: &'a Bundle,
    model: &'a mut Model,
    request: Request,
    /// Position in the registry of each observation's device.
    devices: Vec<Option<usize>>,
    references: Vec<Reference>,
    samples: BTreeMap<Key, (SampleHeader, Vec<u8>)>,
    /// How many of the remaining chunks use a sample, for samples in the file.
    uses: BTreeMap<Key, u32>,
    /// The network's output.
    output: Vec<f32>,
    composer: Composer,
    /// What is executed of it.
    chunk: Vec<f32>,
    again: Again,
    tried: usize,
    wanted: Wanted,
    inputs: Option<ChunkInputs>,
}

/// What is computed of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Wanted {
    /// All chunks.
    Comparison,
    /// The inputs of the first chunk that can be computed.
    FirstInputs,
    /// The inputs of the chunk with this number, from 0.
    Inputs(usize),
}

/// What a chunk is computed from, as the graphs take it.
#[derive(Debug, Clone, PartialEq)]
pub struct ChunkInputs {
    /// Its number among the chunks of the policy in the episode, from 0.
    pub number: usize,
    /// The observations by key, each with its shape and its numbers; behind one with a history which of its steps have
    /// a sample, by the name of that input.
    pub observations: Vec<(String, Vec<usize>, Vec<f32>)>,
    /// The mask, with the name of the input; `None` if the policy has none.
    pub mask: Option<(String, Vec<f32>)>,
    /// The first sample: `[horizon, values of an action in the network's output]`.
    pub noise: Vec<f32>,
    /// The noise of each step of the scheduler that adds some.
    pub step_noise: Vec<Vec<f32>>,
    /// The chunk as it was recorded, `[horizon, executed values]`, in the units of the action.
    pub recorded: Vec<f32>,
}

/// Computes the chunks again, up to the one whose inputs are wanted: they are returned if it can be computed.
pub(super) fn compare(
    file: &Path,
    survey: &Survey,
    (bundle, registry): (&Bundle, &Registry),
    model: &mut Model,
    wanted: Wanted,
    ended: &mut Ended<'_>,
) -> Result<(Again, Option<ChunkInputs>), CompareError> {
    let device = |name: &str| registry.devices.iter().position(|device| device.name == name);
    let topics: BTreeMap<&str, usize> =
        registry.devices.iter().enumerate().map(|(at, device)| (device.topic.as_str(), at)).collect();
    let again = Again {
        chunks: survey.chunks.len() as u64 + survey.unreadable,
        unreadable: survey.unreadable,
        difference: Difference::new(&bundle.action),
        actions: actions(survey, bundle),
        ..Again::default()
    };
    let composer = Composer::new(bundle);
    let mut work = Work {
        bundle,
        request: Request::new(bundle),
        devices: bundle.observations.iter().map(|observation| device(&observation.modality)).collect(),
        references: Reference::all(survey, bundle, registry),
        samples: BTreeMap::new(),
        uses: BTreeMap::new(),
        output: vec![0.0; model.chunk_len()],
        chunk: vec![0.0; composer.chunk_len()],
        composer,
        model,
        again,
        tried: 0,
        wanted,
        inputs: None,
    };
    work.take_attached(survey);
    let mut waiting: VecDeque<&RecordedChunk> = VecDeque::new();
    for chunk in &survey.chunks {
        if !work.is_like(chunk) {
            work.again.unlike += 1;
            continue;
        }
        waiting.push_back(chunk);
        for key in work.keys(chunk) {
            let topic = registry.devices.get(key.0).map_or("", |device| &device.topic);
            if survey.holds(topic, key.1) {
                *work.uses.entry(key).or_default() += 1;
            }
        }
    }
    let total = waiting.len();
    let (mut reader, mut scratch) = (Reader::open(file)?, Scratch::default());
    loop {
        while let Some(chunk) =
            waiting.front().copied().filter(|chunk| !work.has_what_is_wanted() && work.is_ready(chunk))
        {
            if !ended.advance(total - waiting.len(), total) {
                return Ok((work.again, None));
            }
            work.compute(chunk);
            waiting.pop_front();
        }
        if waiting.is_empty() || work.has_what_is_wanted() {
            return Ok((work.again, work.inputs));
        }
        if !reader.advance()? {
            break;
        }
        let Item::Message(message) = reader.item() else { continue };
        let Some(device) = topics.get(message.channel.topic.as_str()) else { continue };
        let key = (*device, u64::from(message.sequence));
        if !work.uses.contains_key(&key) || work.samples.contains_key(&key) {
            continue;
        }
        if let Some(Content::Sample(sample)) = message.content(&mut scratch) {
            work.samples.insert(key, (header(&message, &sample), sample.payload.to_vec()));
        }
    }
    // The file has changed since the survey.
    work.again.samples_missing += waiting.len() as u64;
    Ok((work.again, work.inputs))
}

impl Work<'_> {
    /// Whether its observations and length match this policy's.
    fn is_like(&self, chunk: &RecordedChunk) -> bool {
        let observations = &self.bundle.observations;
        let same = |(samples, observation): (&RecordedSamples, &ObservationSpec)| {
            let (seqs, steps) = (&samples.seqs, self.bundle.steps_of(observation));
            let fits = match observation.history {
                Some(_) => seqs.len() == steps,
                None => [0, steps].contains(&seqs.len()) && seqs.iter().all(Option::is_some),
            };
            samples.modality == observation.modality && fits
        };
        chunk.samples.len() == observations.len()
            && chunk.samples.iter().zip(observations).all(same)
            && chunk.actions.len() == self.chunk.len()
    }

    /// The samples it was computed from.
    fn keys(&self, chunk: &RecordedChunk) -> Vec<Key> {
        let of = |(samples, device): (&RecordedSamples, &Option<usize>)| {
            let device = *device;
            let key = move |number: &u64| Some((device?, number & SEQUENCE_BITS));
            samples.seqs.iter().flatten().filter_map(key).collect::<Vec<_>>()
        };
        chunk.samples.iter().zip(&self.devices).flat_map(of).collect()
    }

    /// Whether all of its samples that the file holds have been read.
    fn is_ready(&self, chunk: &RecordedChunk) -> bool {
        self.keys(chunk).iter().all(|key| self.samples.contains_key(key) || !self.uses.contains_key(key))
    }

    /// Whether later chunks add nothing.
    fn has_what_is_wanted(&self) -> bool {
        match self.wanted {
            Wanted::Comparison => false,
            Wanted::FirstInputs => self.inputs.is_some(),
            Wanted::Inputs(number) => self.tried > number,
        }
    }

    fn compute(&mut self, chunk: &RecordedChunk) {
        let whole = self.fill(chunk);
        let uses = |reference: &Reference, request: &Request, at: usize, wanted: Reference| {
            *reference == wanted && request.has_samples(at)
        };
        let lost = |(at, reference): (usize, &Reference)| uses(reference, &self.request, at, Reference::Lost);
        if !whole || self.references.iter().enumerate().any(lost) {
            let counter = if whole { &mut self.again.reference_unknown } else { &mut self.again.samples_missing };
            *counter += 1;
            self.take_references(chunk);
        } else {
            let answered = self.model.answer(&self.request, &mut self.output);
            let now = if answered.is_ok() { Reference::Known } else { Reference::Lost };
            for (at, reference) in self.references.iter_mut().enumerate() {
                if uses(reference, &self.request, at, Reference::Next) {
                    *reference = now;
                }
            }
            match answered {
                Ok(()) => {
                    // One that gives no actions is NaN, in the file too.
                    let _ = self.composer.compose(&self.request, &self.output, &mut self.chunk);
                    self.hold_against(chunk);
                    if matches!(self.wanted, Wanted::FirstInputs) || self.wanted == Wanted::Inputs(self.tried) {
                        self.inputs = Some(self.inputs(chunk));
                    }
                }
                Err(error) => {
                    self.again.failed += 1;
                    self.again.failure = Some(error.to_string());
                }
            }
        }
        self.tried += 1;
        for key in self.keys(chunk) {
            let Some(uses) = self.uses.get_mut(&key) else { continue };
            *uses = uses.saturating_sub(1);
            if *uses == 0 {
                self.uses.remove(&key);
                self.samples.remove(&key);
            }
        }
    }

    /// The inputs of the chunk that was computed last.
    fn inputs(&self, chunk: &RecordedChunk) -> ChunkInputs {
        let (bundle, tensors) = (self.bundle, self.model.tensors());
        let mut observations = Vec::new();
        for (at, observation) in bundle.observations.iter().enumerate() {
            let steps = bundle.steps_of(observation);
            let shape = match &observation.input {
                ObservationInput::Image(image) => vec![1, steps, 3, image.height, image.width],
                ObservationInput::Vector(vector) => vec![1, steps, vector.len],
            };
            observations.push((observation.key.clone(), shape, tensors.values(at).to_vec()));
            if let Some(history) = &observation.history {
                observations.push((history.valid.clone(), vec![1, steps], tensors.valid(at).to_vec()));
            }
        }
        let (noise, step_noise) = self.model.noise(chunk.seed);
        ChunkInputs {
            number: self.tried,
            observations,
            mask: bundle.mask.as_ref().map(|mask| (mask.input.clone(), tensors.mask().to_vec())),
            noise,
            step_noise,
            recorded: chunk.actions.iter().map(|value| value.unwrap_or(f32::NAN)).collect(),
        }
    }

    /// Builds the request of a chunk. Returns whether all of its samples are there.
    fn fill(&mut self, chunk: &RecordedChunk) -> bool {
        let mut whole = true;
        self.request.tick = chunk.tick;
        self.request.seed = chunk.seed;
        self.request.mask = chunk.mask().unwrap_or_default();
        for (at, (samples, device)) in chunk.samples.iter().zip(&self.devices).enumerate() {
            self.request.set_present(at, !samples.seqs.is_empty());
            for (step, number) in samples.seqs.iter().enumerate() {
                let Some(number) = number else {
                    if let Some(cell) = self.request.cell_mut(at, step) {
                        cell.clear();
                    }
                    continue;
                };
                let kept = device.and_then(|device| self.samples.get(&(device, number & SEQUENCE_BITS)));
                whole &= kept.is_some();
                // One that is not in the file was a sample all the same.
                let (header, bytes) =
                    kept.map_or((SampleHeader::default(), &[][..]), |(header, bytes)| (*header, bytes));
                if let Some(cell) = self.request.cell_mut(at, step) {
                    cell.set(&SampleHeader { seq: *number, ..header }, bytes);
                }
            }
        }
        whole
    }

    /// For a chunk that cannot be computed: its samples are still the references of later ones.
    fn take_references(&mut self, chunk: &RecordedChunk) {
        let has_samples: Vec<bool> = (0..self.references.len()).map(|at| self.request.has_samples(at)).collect();
        for at in 0..has_samples.len() {
            if self.references.get(at) != Some(&Reference::Next) || has_samples.get(at) != Some(&true) {
                continue;
            }
            let number = chunk.samples.get(at).and_then(|samples| samples.seqs.iter().flatten().next());
            let device = self.devices.get(at).copied().flatten();
            let key = device.zip(number).map(|(device, number)| (device, number & SEQUENCE_BITS));
            let sample = key.and_then(|key| self.samples.get(&key));
            let is_known = sample.is_some_and(|(header, bytes)| {
                let header = SampleHeader { seq: number.copied().unwrap_or_default(), ..*header };
                observe_alone(self.model, &mut self.request, at, (&header, bytes))
            });
            if let Some(reference) = self.references.get_mut(at) {
                *reference = if is_known { Reference::Known } else { Reference::Lost };
            }
        }
    }

    /// The references that are attached to the episode.
    fn take_attached(&mut self, survey: &Survey) {
        for (at, observation) in self.bundle.observations.iter().enumerate() {
            let Some((header, bytes)) = survey.references.get(&observation.key) else { continue };
            let Some(reference) = self.references.get_mut(at).filter(|reference| **reference != Reference::None) else {
                continue;
            };
            // One that this policy cannot use is ignored.
            if observe_alone(self.model, &mut self.request, at, (header, bytes)) {
                *reference = Reference::Known;
            }
        }
    }

    fn hold_against(&mut self, chunk: &RecordedChunk) {
        self.again.compared += 1;
        let values = self.bundle.action.len();
        let rows = chunk.actions.chunks(values).zip(self.chunk.chunks(values));
        for (index, (recorded, computed)) in rows.enumerate() {
            let tick = chunk.tick.saturating_add(index as u64).saturating_sub(self.bundle.action_start as u64);
            let recorded = recorded.iter().map(|value| value.map_or(f64::NAN, f64::from));
            self.again.difference.add(tick, recorded, computed.iter().copied().map(f64::from));
        }
    }
}

/// Shows the model a sample in all steps of observation `at`, and nothing else. Returns whether it can be used: then it is the
/// reference, if there was none.
fn observe_alone(model: &mut Model, request: &mut Request, at: usize, (header, bytes): (&SampleHeader, &[u8])) -> bool {
    request.clear();
    for step in 0..request.steps(at) {
        if let Some(cell) = request.cell_mut(at, step) {
            cell.set(header, bytes);
        }
    }
    request.set_present(at, true);
    model.observe(request).is_ok()
}

/// The recorded actions compared with the recorded chunks.
fn actions(survey: &Survey, bundle: &Bundle) -> Actions {
    let mut actions = Actions { difference: Difference::new(&bundle.action), ..Actions::default() };
    let chunks: BTreeMap<u64, &RecordedChunk> =
        survey.chunks.iter().map(|chunk| (chunk.tick & SEQUENCE_BITS, chunk)).collect();
    let known_from = known_from(survey, bundle);
    for action in &survey.actions {
        actions.recorded += 1;
        let tick = u64::from(action.sequence);
        let is_known = tick >= known_from;
        let covering = chunks.range(tick.saturating_sub(bundle.horizon as u64)..=tick).filter(|_| is_known);
        let planned = covering.filter_map(|(_, chunk)| planned(chunk, action, bundle));
        let apart = |planned: &Vec<f64>| {
            planned.iter().zip(&action.values).map(|(one, other)| distance(*one, *other)).fold(0.0, f64::max)
        };
        match planned.min_by(|one, other| apart(one).total_cmp(&apart(other))) {
            Some(planned) => {
                actions.compared += 1;
                actions.difference.add(action.sequence.into(), planned.into_iter(), action.values.iter().copied());
            }
            None => actions.without_chunk += 1,
        }
    }
    actions
}

/// The tick from which on all actions are of chunks in the file. Before it they may be of one from before the episode.
pub(super) fn known_from(survey: &Survey, bundle: &Bundle) -> u64 {
    if holds_every_chunk(survey, bundle) {
        return 0;
    }
    // The action of an observation's own tick is of an earlier chunk: its own is not computed yet.
    let begins = |chunk: &RecordedChunk| (chunk.tick & SEQUENCE_BITS).saturating_add(chunk.skipped).saturating_add(1);
    survey.chunks.iter().find(|chunk| chunk.used != Some(false)).map_or(u64::MAX, begins)
}

/// The action of `chunk` for the tick of `action`, within the limits.
fn planned(chunk: &RecordedChunk, action: &RecordedAction, bundle: &Bundle) -> Option<Vec<f64>> {
    let age = u64::from(action.sequence).checked_sub(chunk.tick & SEQUENCE_BITS)?;
    let index = usize::try_from(age).ok()?.checked_add(bundle.action_start)?;
    let values = bundle.action.len();
    let row = chunk.actions.get(index.checked_mul(values)?..)?.get(..values)?;
    if action.values.len() != values {
        return None;
    }
    let limits = bundle.action.min.iter().zip(&bundle.action.max);
    let clamped = row.iter().zip(limits).map(|(value, (min, max))| match value {
        Some(value) => f64::from(value.max(*min).min(*max)),
        None => f64::NAN,
    });
    Some(clamped.collect())
}

/// Whether the reference of an observation is known: the first sample that the policy used, with which it compared all later
/// pictures, or which stood for them. A recording may have begun after that; then the inputs of the policy are unknown, though every
/// sample of the chunk is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reference {
    /// It needs none: its samples are used as they are.
    None,
    /// The next sample becomes the reference.
    Next,
    /// It was read.
    Known,
    /// It is not in the file.
    Lost,
}

impl Reference {
    /// The state at the first chunk of the file, for every observation.
    fn all(survey: &Survey, bundle: &Bundle, registry: &Registry) -> Vec<Self> {
        let whole = holds_every_chunk(survey, bundle);
        let of = |observation: &ObservationSpec| {
            let has_one = match &observation.input {
                ObservationInput::Image(image) => image.operation == Some(Operation::DiffToReference),
                ObservationInput::Vector(vector) => vector.operation == Some(VectorOperation::FirstOfRun),
            };
            if !has_one {
                return Self::None;
            }
            // If the very first sample of the run is in the file, none can have been used before.
            let device = registry.named(&observation.modality);
            let first = || !survey.is_begun_in_damage && device.is_some_and(|device| survey.holds(&device.topic, 0));
            if whole || first() { Self::Next } else { Self::Lost }
        };
        bundle.observations.iter().map(of).collect()
    }
}

/// Whether the recording began before the policy's first chunk.
fn holds_every_chunk(survey: &Survey, bundle: &Bundle) -> bool {
    let Some(chunk) = survey.chunks.first() else { return true };
    if chunk.tick == 0 {
        return true;
    }
    if survey.is_begun_in_damage {
        return false;
    }
    // Reported when the policy is loaded.
    if survey.policy.is_some() {
        return true;
    }
    let begun = chunk.observed_ns as f64 - chunk.tick as f64 * 1e9 / bundle.control_hz;
    // Half a tick is more than the rounding error of these numbers, and less than a chunk takes.
    let slack = 0.5e9 / bundle.control_hz;
    survey.begin_monotonic_ns.is_some_and(|begin| begun + slack >= begin as f64)
}
