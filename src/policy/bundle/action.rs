//! Checks `action`: lengths, and where the pose is that actions are relative to.

use std::ops::Range;

use rapid_registry::did_you_mean;
use serde_json::Value;

use super::file::{ActionFile, BaseFile, Limits, RepresentationWord, Sliced};
use super::normalization::{check_length, normalization};
use super::read::{Problems, read};
use super::spec::{
    ActionRotation, BasePose, BundleAction, ObservationInput, ObservationSpec, POSITION, QUATERNION, Representation,
    SliceNormalization,
};

/// The fix for a shape that is not that of a pose.
const NO_POSE: &str =
    "correct it; if these are not poses, leave rotation out and write \"representation\": \"absolute\"";

/// Checks the action of a policy with these `observations`, as far as they could be read.
pub(super) fn check_action(
    file: ActionFile,
    observations: Option<&[ObservationSpec]>,
    problems: &mut Problems,
) -> Option<BundleAction> {
    let len = file.shape[0].get();
    let executed = executed(&file, len, problems);
    let representation = representation(&file, observations, problems);
    for (name, list) in [("names", &file.names), ("units", &file.units)] {
        let Some(executed) = executed.filter(|executed| *executed != list.len()) else { continue };
        let what =
            if executed == len { "an action has" } else { "with a quaternion in place of rotation_6d an action has" };
        problems.wrong(&format!("action.{name}"), format!("has {} entries, but {what} {executed} values", list.len()));
    }
    let limits = read("action.limits", &file.limits, problems);
    let normalization = slices(&file.normalization, len, problems);
    let Limits { min, max } = limits?;
    let executed = executed?;
    if check_length("action.limits.min", &min, executed, problems)
        & check_length("action.limits.max", &max, executed, problems)
    {
        for (at, (min, max)) in min.iter().zip(&max).enumerate().filter(|(_, (min, max))| max < min) {
            problems.wrong(&format!("action.limits.max[{at}]"), format!("{max} is below min[{at}] = {min}"));
        }
    }
    let ActionFile { actuator, names, units, rotation, .. } = file;
    let (representation, normalization) = (representation?, normalization?);
    Some(BundleAction { actuator, representation, rotation, names, units, min, max, normalization })
}

/// How many values are executed of an output of `len`.
fn executed(file: &ActionFile, len: usize, problems: &mut Problems) -> Option<usize> {
    let rotation = file.rotation.map_or(0, ActionRotation::numbers);
    let is_pose = file.rotation.is_some() || file.representation != RepresentationWord::Absolute;
    if is_pose && len < POSITION + rotation {
        let with = file.rotation.map_or(String::new(), |rotation| format!(" and {}", rotation.word()));
        let message = format!("is [{len}], but a pose has {} values or more: position{with}", POSITION + rotation);
        problems.report("action.shape", message, NO_POSE);
        return None;
    }
    Some(len - rotation + file.rotation.map_or(0, |_| QUATERNION))
}

fn representation(
    file: &ActionFile,
    observations: Option<&[ObservationSpec]>,
    problems: &mut Problems,
) -> Option<Representation> {
    let entry = "action.base";
    let base = match (file.representation, &file.base) {
        (RepresentationWord::Absolute, None) => return Some(Representation::Absolute),
        (RepresentationWord::Absolute, Some(_)) => {
            let fix =
                "leave it out, or write \"representation\": \"relative\" or \"delta\" if that is what was trained";
            problems.report(entry, "is of no use for absolute actions", fix);
            return None;
        }
        (RepresentationWord::Relative | RepresentationWord::Delta, None) => {
            problems.wrong(entry, "is missing, and actions are relative to it");
            return None;
        }
        (RepresentationWord::Relative | RepresentationWord::Delta, Some(base)) => {
            read::<BaseFile>(entry, base, problems)
        }
    };
    let BaseFile { modality, position, rotation } = base?;
    let mut is_right = true;
    let mut check = |key: &str, range: &Range<usize>, wanted| {
        if range.len() != wanted {
            is_right = false;
            let message = format!("[{}, {}] names {} values instead of {wanted}", range.start, range.end, range.len());
            problems.wrong(&format!("{entry}.{key}"), message);
        }
    };
    check("position", &position, POSITION);
    if let Some(rotation) = &rotation {
        check("rotation", rotation, QUATERNION);
    }
    match (&rotation, file.rotation) {
        (None, Some(_)) => {
            is_right = false;
            problems.wrong(&format!("{entry}.rotation"), "is missing, and the action has a rotation");
        }
        (Some(_), None) => {
            is_right = false;
            let fix = "leave it out, or write the rotation of the action: \"rotation_6d\" or \"quaternion\"";
            problems.report(&format!("{entry}.rotation"), "is of no use for an action without a rotation", fix);
        }
        (Some(_), Some(_)) | (None, None) => {}
    }
    let observation = observed(&modality, observations?, problems)?;
    let base = BasePose { modality, observation, position, rotation };
    is_right.then_some(match file.representation {
        RepresentationWord::Relative => Representation::Relative(base),
        RepresentationWord::Absolute | RepresentationWord::Delta => Representation::Delta(base),
    })
}

/// The first required vector of `modality`, so that a request always has a sample of it.
fn observed(modality: &str, observations: &[ObservationSpec], problems: &mut Problems) -> Option<usize> {
    let serves = |one: &ObservationSpec| one.required && matches!(one.input, ObservationInput::Vector(_));
    let found = observations.iter().position(|one| one.modality == modality && serves(one));
    if found.is_none() {
        let known: Vec<&str> = observations.iter().filter(|one| serves(one)).map(|one| one.modality.as_str()).collect();
        let fix = if known.is_empty() {
            "add a required vector observation of the modality that has the pose".to_owned()
        } else {
            did_you_mean(modality, &known, "those of required vectors are")
        };
        let message = format!("\"{modality}\" is not the modality of a required vector observation");
        problems.report("action.base.modality", message, fix);
    }
    found
}

/// The normalisations of an action of `len` values, ascending.
fn slices(list: &[Value], len: usize, problems: &mut Problems) -> Option<Vec<SliceNormalization>> {
    let entry = "action.normalization";
    let read = |(at, value)| sliced(&format!("{entry}[{at}]"), value, problems);
    let found: Vec<Option<SliceNormalization>> = list.iter().enumerate().map(read).collect();
    // The range of a slice that could not be read is unknown.
    let mut found: Vec<SliceNormalization> = found.into_iter().collect::<Option<_>>()?;
    for end in found.iter().map(|part| part.slice.end).filter(|end| *end > len) {
        problems.wrong(entry, format!("covers values up to {end}, but an action has {len}"));
    }
    for value in 0..len {
        match found.iter().filter(|part| part.slice.contains(&value)).count() {
            0 => problems.wrong(entry, format!("does not cover value {value}")),
            1 => {}
            _ => problems.wrong(entry, format!("covers value {value} more than once")),
        }
    }
    found.sort_by_key(|part| part.slice.start);
    Some(found)
}

fn sliced(entry: &str, value: &Value, problems: &mut Problems) -> Option<SliceNormalization> {
    let slice: Option<Range<usize>> = read(entry, value, problems).map(|Sliced { slice }| slice);
    let mut rest = value.clone();
    rest.as_object_mut()?.remove("slice");
    let normalization = normalization(entry, &rest, slice.as_ref().map(ExactSizeIterator::len), problems);
    Some(SliceNormalization { slice: slice?, normalization: normalization? })
}
