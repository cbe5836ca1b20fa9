//! `policy.json` against files: each in `bundle/invalid` is refused with exactly the text beside it
//! (`NAME.expected`), each in `bundle/valid` is accepted; and no text at all makes it panic.

#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_policy::bundle::{
    BetaSchedule, Bundle, ColorOrder, Normalization, ObservationInput, Operation, SchedulerKind, VectorOperation,
    WhenAbsent,
};

use crate::support::mistakes;
use proptest::prelude::*;

fn files(folder: &str) -> Vec<PathBuf> {
    mistakes::files(&format!("bundle/{folder}"), "json")
}

fn valid(name: &str) -> Bundle {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/bundle/valid/{name}.json"));
    Bundle::parse(&mistakes::read(&path), "policy.json").unwrap()
}

#[test]
fn every_mistake_is_reported_in_full() {
    mistakes::check("bundle/invalid", "json", 80, |text| {
        let errors = Bundle::parse(text, "policy.json").err()?;
        Some((errors.to_string(), errors.diagnostics))
    });
}

#[test]
fn valid_files_are_accepted() {
    for path in files("valid") {
        let text = std::fs::read_to_string(&path).unwrap();
        let bundle = Bundle::parse(&text, "policy.json").unwrap_or_else(|errors| panic!("{errors}"));
        let covered: usize = bundle.action.normalization.iter().map(|part| part.slice.len()).sum();
        assert_eq!(covered, bundle.action.outputs(), "{}", path.display());
        assert!(bundle.n_action_steps + bundle.action_start <= bundle.horizon);
        assert_eq!(bundle.hash.len(), 64);
    }
}

#[test]
fn every_key_is_parsed() {
    let bundle = valid("every_key");
    assert_eq!((bundle.n_obs_steps, bundle.horizon, bundle.n_action_steps, bundle.action_start), (2, 16, 15, 1));
    assert_eq!((bundle.max_observation_age.as_millis(), bundle.mask_aware, bundle.mask), (250, false, None));
    let [wrist, pose, grip] = bundle.observations.as_slice() else { panic!("three observations") };
    let ObservationInput::Image(image) = &wrist.input else { panic!("an image") };
    assert_eq!((image.height, image.width, image.color), (80, 90, ColorOrder::Bgr));
    assert_eq!((image.resize, image.crop), (Some([96, 128]), Some([80, 90])));
    assert_eq!((image.operation, wrist.required), (Some(Operation::DiffToReference), true));
    let Normalization::MeanStd { mean, std, eps } = &wrist.normalization else { panic!("mean and std") };
    assert_eq!((mean[2], std[0], *eps), (0.406, 0.229, 1e-8));
    let ObservationInput::Vector(vector) = &pose.input else { panic!("a vector") };
    assert_eq!((vector.len, vector.slice.clone(), &pose.normalization), (3, Some(0..3), &Normalization::Identity));
    assert_eq!(vector.operation, Some(VectorOperation::FirstOfRun));
    let ObservationInput::Vector(vector) = &grip.input else { panic!("a vector") };
    assert_eq!((vector.len, vector.slice.clone(), grip.modality.as_str()), (1, None, "gripper"));
    let held = [wrist.when_absent, grip.when_absent];
    assert_eq!(held, [WhenAbsent::Zero, WhenAbsent::HoldLast(Duration::from_millis(2500))]);
    let slices: Vec<_> = bundle.action.normalization.iter().map(|part| part.slice.clone()).collect();
    assert_eq!(slices, [0..3, 3..4], "sorted, in any order in the file");
    assert_eq!((bundle.scheduler.kind, bundle.scheduler.beta_schedule), (SchedulerKind::Ddpm, BetaSchedule::Linear));
    assert_eq!((bundle.scheduler.clip_sample_range, bundle.scheduler.steps_offset), (2.5, 1));
    assert_eq!(bundle.encoder.sha256, "abcdef0123456789".repeat(4));
}

#[test]
fn a_history_is_parsed() {
    let bundle = valid("history");
    let [_, tactile, touched, _] = bundle.observations.as_slice() else { panic!("four observations") };
    let history = touched.history.as_ref().unwrap();
    assert_eq!((history.steps, history.valid.as_str(), touched.down_sample_steps), (12, "touched_valid", 5));
    assert_eq!((tactile.history.as_ref(), bundle.steps_of(tactile), bundle.steps_of(touched)), (None, 2, 12));
    // Nothing is held in it, whatever is asked for.
    let held = bundle.holding_last(Some(Duration::from_secs(20)));
    let modalities: Vec<_> = held.observations.iter().map(|observation| observation.when_absent).collect();
    let twenty = WhenAbsent::HoldLast(Duration::from_secs(20));
    assert_eq!(modalities, [WhenAbsent::Zero, twenty, WhenAbsent::Zero, WhenAbsent::Zero]);
}

/// A valid or nearly valid file with some bytes replaced, removed, doubled.
fn mutated() -> impl Strategy<Value = String> {
    let sources: Vec<String> =
        files("valid").iter().chain(&files("invalid")).map(|path| std::fs::read_to_string(path).unwrap()).collect();
    let edit = (any::<prop::sample::Index>(), 0_usize..12, "[ -~\\n\"\\[\\]:,.]{0,6}|\\PC{0,2}|-?[0-9]{1,25}|null");
    (prop::sample::select(sources), prop::collection::vec(edit, 1..6)).prop_map(|(mut text, edits)| {
        for (place, length, new) in edits {
            let mut chars: Vec<char> = text.chars().collect();
            let at = place.index(chars.len() + 1);
            let end = (at + length).min(chars.len());
            chars.splice(at..end, new.chars());
            text = chars.into_iter().collect();
        }
        text
    })
}

proptest! {
    #[test]
    fn no_text_causes_a_panic(text in mutated()) {
        if let Err(errors) = Bundle::parse(&text, "policy.json") {
            prop_assert!(!errors.diagnostics.is_empty());
            prop_assert!(!errors.to_string().chars().any(|c| c.is_control() && c != '\n'));
        }
    }
}
