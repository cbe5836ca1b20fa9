//! `observations`: what a policy sees.

use serde_json::Value;

use super::keys::{self, Kind};
use super::parse::{MAX_SIDE, MAX_VALUES, kind_of, normalization};
use super::read::{Object, Problems};
use super::spec::{ImageSpec, MaskSpec, ObservationInput, ObservationSpec, VectorSpec};
use crate::registry::did_you_mean;

/// Channels of every picture.
const CHANNELS: usize = 3;

pub(super) fn read(root: &Object, problems: &mut Problems) -> Option<Vec<ObservationSpec>> {
    let list = root.list("observations", problems)?;
    if list.is_empty() {
        root.report("observations", "is empty", problems);
    }
    let mut observations: Vec<ObservationSpec> = Vec::with_capacity(list.len());
    for (at, value) in list.iter().enumerate() {
        let entry = format!("observations[{at}]");
        if let Some(found) = observation(entry.clone(), value, problems) {
            if observations.iter().any(|earlier| earlier.key == found.key) {
                let message = format!("another observation has the key \"{}\"", found.key);
                problems.report(
                    &entry,
                    message,
                    "give each observation a key of its own, as the encoder's inputs have",
                );
            }
            observations.push(found);
        }
    }
    (observations.len() == list.len()).then_some(observations)
}

fn observation(entry: String, value: &Value, problems: &mut Problems) -> Option<ObservationSpec> {
    let kind = kind_of(value);
    let known = if kind == Some(Kind::Vector) { keys::VECTOR } else { keys::IMAGE };
    if kind.is_none()
        && let Value::Object(map) = value
    {
        // What else it must have depends on this.
        let given =
            map.get("kind").map_or_else(|| "kind is missing".to_owned(), |given| format!("unknown kind {given}"));
        problems.report(&entry, given, "write \"kind\": \"image\" or \"vector\"; this program knows no other");
        return None;
    }
    let object = Object::new(entry, value, known, problems)?;
    let key = object.text("key", problems);
    let modality = object.text("modality", problems);
    let required = object.flag("required", problems);
    refuse_steps(&object, problems);
    let (input, dimensions) = match kind? {
        Kind::Image => (image(&object, problems).map(ObservationInput::Image), Some(CHANNELS)),
        Kind::Vector => {
            let vector = vector(&object, problems);
            let len = vector.as_ref().map(|vector| vector.len);
            (vector.map(ObservationInput::Vector), len)
        }
    };
    let place = object.path("normalization");
    let normalization = object
        .value("normalization", problems)
        .and_then(|value| normalization(place, value, dimensions, false, problems));
    Some(ObservationSpec {
        key: key?,
        modality: modality?,
        required: required?,
        input: input?,
        normalization: normalization?,
    })
}

/// Older observations than one tick apart, and turned ones, are in the format only.
fn refuse_steps(object: &Object, problems: &mut Problems) {
    if object.has("down_sample_steps")
        && let Some(steps) = object.integer("down_sample_steps", 1..=1024, problems)
        && steps != 1
    {
        let message = format!("= {steps} is not supported: observations are one tick of the control grid apart");
        object.report("down_sample_steps", &message, problems);
    }
    refuse_rotation(object, problems);
}

/// `rotation` is in the format only.
pub(super) fn refuse_rotation(object: &Object, problems: &mut Problems) {
    if object.has("rotation")
        && let Some(value) = object.value("rotation", problems)
        && !value.is_null()
    {
        let message = format!("rotation = {value} is not supported: values are taken as they are");
        problems.report(&object.entry, message, "take a policy whose values need no rotation, and leave the key out");
    }
}

fn image(object: &Object, problems: &mut Problems) -> Option<ImageSpec> {
    let shape = object.integers("shape", 3, 1..=MAX_SIDE, problems);
    let color = object.word("color", &keys::COLORS, problems);
    let resize = object.size_or_null("resize", problems);
    let crop = object.size_or_null("crop", problems);
    let operation = object.word_or_null("operation", &keys::OPERATIONS, problems);
    let (shape, resize, crop) = (shape?, resize?, crop?);
    let [channels, height, width] = <[usize; 3]>::try_from(shape).ok()?;
    if channels != CHANNELS {
        let message = format!("= [{channels}, {height}, {width}], but pictures have {CHANNELS} channels");
        object.report("shape", &message, problems);
    }
    let show = |[height, width]: [usize; 2]| format!("[{height}, {width}]");
    if let (Some(resize), Some(crop)) = (resize, crop)
        && (crop[0] > resize[0] || crop[1] > resize[1])
    {
        object.report("crop", &format!("= {} is larger than resize = {}", show(crop), show(resize)), problems);
    }
    if let Some((step, size)) = crop.map(|size| ("crop", size)).or(resize.map(|size| ("resize", size)))
        && size != [height, width]
    {
        let message = format!("= [{channels}, {height}, {width}], but {step} leaves {}", show(size));
        object.report("shape", &message, problems);
    }
    Some(ImageSpec { height, width, color: color?, resize, crop, operation: operation? })
}

fn vector(object: &Object, problems: &mut Problems) -> Option<VectorSpec> {
    let len = *object.integers("shape", 1, 1..=MAX_VALUES, problems)?.first()?;
    let slice = if object.has("slice") { Some(object.slice("slice", problems)?) } else { None };
    if let Some(slice) = slice.as_ref().filter(|slice| slice.len() != len) {
        let message = format!("= [{}, {}] holds {} numbers, shape says {len}", slice.start, slice.end, slice.len());
        object.report("slice", &message, problems);
    }
    Some(VectorSpec { len, slice })
}

/// What the mask says must be about what is observed.
pub(super) fn against_mask(
    root: &Object,
    observations: &[ObservationSpec],
    mask: Option<&MaskSpec>,
    mask_aware: bool,
    problems: &mut Problems,
) {
    let Some(mask) = mask else {
        if mask_aware {
            root.report("mask", "is null, but the bundle is mask_aware", problems);
        }
        return;
    };
    if observations.is_empty() {
        return;
    }
    let known: Vec<&str> = observations.iter().map(|observation| observation.modality.as_str()).collect();
    for (at, modality) in mask.order.iter().enumerate().filter(|(_, modality)| !known.contains(&modality.as_str())) {
        let message = format!("order[{at}] names \"{modality}\", which no observation has");
        problems.report("mask", message, did_you_mean(modality, &known, "the modalities here are"));
    }
    for (at, observation) in observations.iter().enumerate() {
        if observation.key == mask.input {
            let message = format!("input is \"{}\", which is the key of observations[{at}]", mask.input);
            problems.report("mask", message, "write \"input\": the name of the encoder's mask input");
        }
        if mask_aware && !observation.required && !mask.order.contains(&observation.modality) {
            let message = format!("\"{}\" is not required, but mask.order does not have it", observation.modality);
            let fix = "write \"required\": true, or name it in mask.order if the encoder knows when it is absent";
            problems.report(&format!("observations[{at}]"), message, fix);
        }
    }
}
