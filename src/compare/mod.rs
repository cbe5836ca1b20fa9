//! A policy compared with a recorded episode, without rig, bus or clock.
//!
//! An episode that a policy recorded holds, for every chunk, the samples it was computed from and the seed of its
//! noise: [`again`] recomputes each of them. In any other episode [`beside`] lets the policy watch, and compares what
//! it would have done with what was done.
//!
//! Invariant: memory holds samples of a few seconds, not the whole episode.
//! Invariant: what cannot be compared is counted with its reason, never compared with a guess.

pub mod again;
pub mod beside;
mod difference;
mod survey;
#[cfg(test)]
mod tests;

use std::path::Path;

use rapid_episode::ReadError;
use rapid_policy::bundle::{Bundle, BundleErrors};
use rapid_policy::model::Model;
use rapid_policy::onnxruntime::Environment;
use rapid_policy::sampler::{Computing, PolicyError};
use rapid_registry::Registry;
use serde::Serialize;

use self::again::Wanted;
pub use self::again::{Again, ChunkInputs};
pub use self::beside::Beside;
pub use self::difference::{AxisDifference, Difference, Spread};

use self::survey::Survey;

/// Why there is no comparison.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// The file.
    #[error(transparent)]
    File(#[from] ReadError),
    /// The file holds no registry that can be read.
    #[error("{file}: {why}")]
    Registry {
        /// The file.
        file: String,
        /// What is wrong.
        why: String,
    },
    /// The policy does not suit the rig that the episode was recorded on.
    #[error("{file}: the policy does not suit the rig of this episode: {errors}")]
    Unsuited {
        /// The file.
        file: String,
        /// Why.
        errors: BundleErrors,
    },
    /// Nothing in the file can be compared.
    #[error("{0}: holds neither chunks of a policy nor actions: there is nothing to compare with")]
    Nothing(String),
    /// The graphs.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

/// A policy compared with an episode.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Comparison {
    /// A policy recorded the episode, and its chunks were recomputed.
    Again(Again),
    /// A person or another program acted.
    Beside(Beside),
}

/// Receives progress.
pub trait Watcher {
    /// `done` of about `total` pieces are done. Returns whether to continue.
    fn at(&mut self, done: usize, total: usize) -> bool;
}

/// A comparison, and other facts about the file.
#[derive(Debug, Clone, Serialize)]
pub struct Compared {
    /// The result.
    #[serde(flatten)]
    pub comparison: Comparison,
    /// Name of the policy that recorded it, as the file states it.
    pub recorded_policy: Option<String>,
    /// Hash of the contents of its bundle.
    pub recorded_policy_hash: Option<String>,
    /// Which part of the file could not be read.
    pub damage: Option<String>,
    /// It was interrupted.
    pub interrupted: bool,
}

/// What the file holds, and the registry that it was recorded with, which the policy suits.
fn examined(file: &Path, bundle: &Bundle) -> Result<(Survey, Registry), CompareError> {
    let name = || file.display().to_string();
    let survey = Survey::read(file, &bundle.observations)?;
    let registry = survey.registry.as_deref().filter(|text| !text.is_empty());
    let wrong = |why: String| CompareError::Registry { file: name(), why };
    let text = registry.ok_or_else(|| wrong("holds no registry: it was not recorded by rapid".to_owned()))?;
    let registry = Registry::parse(text, None)
        .map_err(|errors| wrong(format!("the registry in it cannot be read: {errors}")))?
        .registry;
    let actuators: Vec<_> =
        registry.actuator().into_iter().map(|(device, action)| (device.name.as_str(), action.names.len())).collect();
    let suits = bundle.check_registry(&registry).and_then(|()| bundle.check_actuators(&actuators));
    suits.map_err(|errors| CompareError::Unsuited { file: name(), errors })?;
    if !survey.is_of_a_policy() && survey.actions.is_empty() {
        return Err(CompareError::Nothing(name()));
    }
    Ok((survey, registry))
}

/// What chunk `number` of an episode, from 0, was computed from, or the first chunk of which the file holds all; `None` if the
/// file does not hold all of it.
///
/// # Errors
/// As [`compare`].
pub fn inputs(
    file: &Path,
    bundle: &Bundle,
    environment: &Environment,
    computing: Computing,
    number: Option<usize>,
) -> Result<Option<ChunkInputs>, CompareError> {
    let (survey, registry) = examined(file, bundle)?;
    let mut model = Model::load(bundle, environment, computing)?;
    let mut ended = Ended { watcher: &mut Unwatched, interrupted: false };
    let wanted = number.map_or(Wanted::FirstInputs, Wanted::Inputs);
    let (_, inputs) = again::compare(file, &survey, (bundle, &registry), &mut model, wanted, &mut ended)?;
    Ok(inputs)
}

/// Compares the policy of `bundle` with the episode in `file`. `steps`: denoising steps instead of the bundle's own.
///
/// # Errors
/// When the file cannot be read or holds nothing to compare with, or the policy does not suit it.
pub fn compare(
    file: &Path,
    bundle: &Bundle,
    environment: &Environment,
    computing: Computing,
    watcher: &mut dyn Watcher,
) -> Result<Compared, CompareError> {
    let (survey, registry) = examined(file, bundle)?;
    let mut model = Model::load(bundle, environment, computing)?;
    let mut ended = Ended { watcher, interrupted: false };
    let comparison = if survey.is_of_a_policy() {
        let (again, _) =
            again::compare(file, &survey, (bundle, &registry), &mut model, Wanted::Comparison, &mut ended)?;
        Comparison::Again(again)
    } else {
        Comparison::Beside(beside::compare(file, &survey, bundle, &registry, &mut model, &mut ended)?)
    };
    let interrupted = ended.interrupted;
    let (recorded_policy, recorded_policy_hash) = survey.policy.unzip();
    Ok(Compared { comparison, recorded_policy, recorded_policy_hash, damage: survey.damage, interrupted })
}

/// Work whose progress is not shown.
struct Unwatched;

impl Watcher for Unwatched {
    fn at(&mut self, _: usize, _: usize) -> bool {
        true
    }
}

/// A watcher, and whether it has ended the work.
struct Ended<'a> {
    watcher: &'a mut dyn Watcher,
    interrupted: bool,
}

impl Ended<'_> {
    fn advance(&mut self, done: usize, total: usize) -> bool {
        self.interrupted |= !self.watcher.at(done, total);
        !self.interrupted
    }
}
