//! `action`: what a policy moves.

use serde_json::Value;

use super::keys;
use super::observations::refuse_rotation;
use super::parse::normalization;
use super::read::{Object, Problems};
use super::spec::{BundleAction, Normalization, SliceNormalization};

const MAX_ACTION: usize = 1024;

pub(super) fn read(root: &Object, problems: &mut Problems) -> Option<BundleAction> {
    let action = root.object("action", keys::ACTION, problems)?;
    let actuator = action.text("actuator", problems);
    let len = action.integers("shape", 1, 1..=MAX_ACTION, problems).and_then(|shape| shape.first().copied());
    let names = action.texts("names", problems);
    let units = action.texts("units", problems);
    for (key, list) in [("names", &names), ("units", &units)] {
        if let (Some(list), Some(len)) = (list, len)
            && list.len() != len
        {
            let message = format!("has {} entries, but an action has {len} values", list.len());
            action.report(key, &message, problems);
        }
    }
    representation(&action, problems);
    refuse_rotation(&action, problems);
    let limits = limits(&action, len, problems);
    let normalization = normalizations(&action, len, problems);
    let (min, max) = limits?;
    Some(BundleAction { actuator: actuator?, names: names?, units: units?, min, max, normalization: normalization? })
}

fn representation(action: &Object, problems: &mut Problems) {
    // The other two are in the format only.
    let words = [("absolute", true), ("relative", false), ("delta", false)];
    if action.word("representation", &words, problems) == Some(false) {
        let given = action.value("representation", problems).and_then(Value::as_str).unwrap_or_default();
        let message = format!("= \"{given}\" is not supported: only absolute targets are executed");
        action.report("representation", &message, problems);
    }
}

fn limits(action: &Object, len: Option<usize>, problems: &mut Problems) -> Option<(Vec<f32>, Vec<f32>)> {
    let limits = action.object("limits", keys::LIMITS, problems)?;
    let min = limits.numbers("min", len, problems);
    let max = limits.numbers("max", len, problems);
    let (min, max) = (min?, max?);
    for (at, (min, max)) in min.iter().zip(&max).enumerate().filter(|(_, (min, max))| max < min) {
        limits.report("max", &format!("[{at}] = {max} is below min[{at}] = {min}"), problems);
    }
    Some((min, max))
}

fn normalizations(action: &Object, len: Option<usize>, problems: &mut Problems) -> Option<Vec<SliceNormalization>> {
    let list = action.list("normalization", problems)?;
    let mut found: Vec<SliceNormalization> = Vec::with_capacity(list.len());
    for (at, value) in list.iter().enumerate() {
        found.extend(sliced(format!("{}[{at}]", action.path("normalization")), value, problems));
    }
    // A slice that could not be read covers nobody knows what.
    if found.len() < list.len() {
        return None;
    }
    let len = len?;
    let mut covered = vec![0_u8; len];
    for part in &found {
        let beyond = part.slice.end > len;
        if beyond {
            let message = format!("covers values up to {}, but an action has {len}", part.slice.end);
            action.report("normalization", &message, problems);
        }
        for count in covered.iter_mut().take(part.slice.end).skip(part.slice.start) {
            *count = count.saturating_add(1);
        }
    }
    for (value, count) in covered.iter().enumerate().filter(|(_, count)| **count != 1) {
        let message = match count {
            0 => format!("does not cover value {value}"),
            _ => format!("covers value {value} more than once"),
        };
        action.report("normalization", &message, problems);
    }
    found.sort_by_key(|part| part.slice.start);
    Some(found)
}

fn sliced(entry: String, value: &Value, problems: &mut Problems) -> Option<SliceNormalization> {
    let slice =
        value.is_object().then(|| Object::new(entry.clone(), value, keys::ANY_MODE.sliced, &mut Problems::new("")));
    let slice = slice.flatten().and_then(|object| object.slice("slice", problems));
    let len = slice.as_ref().map(ExactSizeIterator::len);
    let normalization: Option<Normalization> = normalization(entry, value, len, true, problems);
    Some(SliceNormalization { slice: slice?, normalization: normalization? })
}
