//! The input of a policy for one chunk: numbers of every observation key, and the mask.
//!
//! Invariant: the memory is allocated once, with the length given by the bundle.
//! Invariant: an absent modality is zeros after normalisation, and its element of the mask is 0.
//! Invariant: a step of a history without a sample is zeros after normalisation, and its element of `valid` is 0.

use rapid_core::rotation;

use super::bundle::{Bundle, ObservationInput, ObservationSpec, VectorRotation, VectorSpec};
use super::normalize::Normalizer;

/// Why the numbers of a sample cannot be an observation.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum VectorError {
    /// The observation is made of pictures.
    #[error("observation `{0}` is made of images, not of values")]
    Pictures(String),
    /// The sample has another shape than the policy requires.
    #[error("a sample of {found} values, where observation `{key}` takes {wanted}: see its `slice` in policy.json")]
    Length {
        /// The observation.
        key: String,
        /// Numbers in the sample.
        found: usize,
        /// The expected numbers, in words.
        wanted: String,
    },
    /// A rotation is invalid.
    #[error("observation `{0}` is a rotation, but the quaternion of the sample is invalid: zero, or not finite")]
    Rotation(String),
}

/// The observations of one chunk. An observation is identified by its index in the bundle's list.
#[derive(Debug, Clone)]
pub struct ObservationTensors {
    tensors: Vec<Tensor>,
    mask: Vec<f32>,
}

#[derive(Debug, Clone)]
struct Tensor {
    key: String,
    /// Observation steps in order, the oldest first.
    values: Vec<f32>,
    /// Values per step.
    step: usize,
    vector: Option<(VectorSpec, Normalizer)>,
    /// Its modality's element of the mask, if this observation determines it.
    mask: Option<usize>,
    /// With a history, whether each step has a sample; otherwise empty.
    valid: Vec<f32>,
}

impl ObservationTensors {
    /// All zeros, with every modality absent.
    pub fn new(bundle: &Bundle) -> Self {
        let order = bundle.mask.as_ref().map_or(&[][..], |mask| &mask.order);
        let tensors = bundle.observations.iter().map(|observation| {
            let (step, vector) = match &observation.input {
                ObservationInput::Image(image) => (3 * image.height * image.width, None),
                ObservationInput::Vector(vector) => {
                    let normalizer = Normalizer::new(&observation.normalization, vector.len);
                    (vector.len, Some((vector.clone(), normalizer)))
                }
            };
            let steps = bundle.steps_of(observation);
            // Of a modality with and without a history: what is held while it is absent has its element set.
            let plain = |other: &ObservationSpec| other.modality == observation.modality && other.history.is_none();
            let determines = observation.history.is_none() || !bundle.observations.iter().any(plain);
            let element = order.iter().position(|modality| *modality == observation.modality);
            Tensor {
                key: observation.key.clone(),
                values: vec![0.0; steps * step],
                step,
                vector,
                mask: element.filter(|_| determines),
                valid: vec![0.0; observation.history.as_ref().map_or(0, |_| steps)],
            }
        });
        Self { tensors: tensors.collect(), mask: vec![0.0; order.len()] }
    }

    /// The memory of step `step`, 0 the oldest, of an observation, for a
    /// [`Preprocessor`](super::picture::Preprocessor). `None` if there is no such step.
    pub fn step_mut(&mut self, observation: usize, step: usize) -> Option<&mut [f32]> {
        let tensor = self.tensors.get_mut(observation)?;
        let begin = tensor.step.checked_mul(step)?;
        tensor.values.get_mut(begin..begin.checked_add(tensor.step)?)
    }

    /// Writes step `step` of an observation that is a vector, from the numbers of a sample. A nonexistent step is
    /// ignored.
    ///
    /// # Errors
    /// When the sample does not have the shape given by the bundle.
    pub fn write_vector(&mut self, observation: usize, step: usize, sample: &[f64]) -> Result<(), VectorError> {
        let Some(tensor) = self.tensors.get_mut(observation) else { return Ok(()) };
        let Some((spec, normalizer)) = &tensor.vector else { return Err(VectorError::Pictures(tensor.key.clone())) };
        let wanted = match &spec.slice {
            Some(slice) => sample.get(slice.clone()),
            None => (sample.len() == spec.len).then_some(sample),
        };
        let Some(wanted) = wanted else {
            let wanted = match &spec.slice {
                Some(slice) => format!("numbers {} to {} of at least {}", slice.start, slice.end, slice.end),
                None => spec.len.to_string(),
            };
            return Err(VectorError::Length { key: tensor.key.clone(), found: sample.len(), wanted });
        };
        let rows;
        let wanted = match (spec.rotation, wanted) {
            (None, wanted) => wanted,
            (Some(VectorRotation::Rotation6d), &[x, y, z, w]) => {
                let rotation = rotation::normalized([x, y, z, w]);
                rows = rotation::rows(rotation.ok_or_else(|| VectorError::Rotation(tensor.key.clone()))?);
                rows.as_flattened()
            }
            // A checked bundle takes 4 values.
            (Some(VectorRotation::Rotation6d), _) => return Err(VectorError::Rotation(tensor.key.clone())),
        };
        if let Some(place) = tensor.values.chunks_exact_mut(tensor.step.max(1)).nth(step) {
            for (value, number) in place.iter_mut().zip(wanted) {
                #[expect(clippy::cast_possible_truncation, reason = "networks compute with 32 bits")]
                {
                    *value = *number as f32;
                }
            }
            normalizer.normalize_planes(place);
        }
        Ok(())
    }

    /// Writes step `to` of an observation with the numbers of its step `from`. A nonexistent step is ignored.
    pub fn copy_step(&mut self, observation: usize, from: usize, to: usize) {
        let Some(tensor) = self.tensors.get_mut(observation) else { return };
        let steps = tensor.values.len() / tensor.step.max(1);
        if from != to && from < steps && to < steps {
            tensor.values.copy_within(from * tensor.step..(from + 1) * tensor.step, to * tensor.step);
        }
    }

    /// Sets whether a step of a history has a sample. One that has none is zeros from now on, until it is written again.
    pub fn set_valid(&mut self, observation: usize, step: usize, valid: bool) {
        let Some(element) = self.tensors.get_mut(observation).and_then(|tensor| tensor.valid.get_mut(step)) else {
            return;
        };
        *element = f32::from(u8::from(valid));
        if !valid && let Some(place) = self.step_mut(observation, step) {
            place.fill(0.0);
        }
    }

    /// Sets whether an observation's modality is present. An absent one is zeros from now on, until it is written
    /// again; of one with a history only the mask changes, and [`Self::set_valid`] sets the rest.
    pub fn set_present(&mut self, observation: usize, present: bool) {
        let Some(tensor) = self.tensors.get_mut(observation) else { return };
        if !present && tensor.valid.is_empty() {
            tensor.values.fill(0.0);
        }
        if let Some(element) = tensor.mask.and_then(|place| self.mask.get_mut(place)) {
            *element = f32::from(u8::from(present));
        }
    }

    /// The numbers of an observation, all steps.
    pub fn values(&self, observation: usize) -> &[f32] {
        self.tensors.get(observation).map_or(&[], |tensor| &tensor.values)
    }

    /// Whether each step of a history has a sample, 1 or 0; empty for an observation without a history.
    pub fn valid(&self, observation: usize) -> &[f32] {
        self.tensors.get(observation).map_or(&[], |tensor| &tensor.valid)
    }

    /// The mask, in the order of the bundle; empty if it has none.
    pub fn mask(&self) -> &[f32] {
        &self.mask
    }
}
