//! Policies: what strangers write into `policy.json`, and what cameras send to one.

use rapid_core::sample::Encoding;
use rapid_policy::bundle::{Bundle, ColorOrder, ImageSpec, Normalization, Operation};
use rapid_policy::picture::{Picture, Preprocessor};

use crate::seeds;

/// `policy.json`: what is accepted keeps what the types promise.
pub fn bundle(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    match Bundle::parse(text, "policy.json") {
        Ok(bundle) => {
            assert!((1..=bundle.horizon - bundle.action_start).contains(&bundle.n_action_steps));
            assert!(bundle.control_hz.is_finite() && bundle.control_hz > 0.0);
            let covered: usize = bundle.action.normalization.iter().map(|slice| slice.slice.len()).sum();
            assert_eq!(covered, bundle.action.outputs());
            assert!(bundle.mask_aware <= bundle.mask.is_some(), "a reader that knows the mask reads it");
            for observation in &bundle.observations {
                let Some(history) = &observation.history else { continue };
                assert!((2..=64).contains(&history.steps) && bundle.mask_aware && !observation.required);
                assert!((history.steps - 1) * observation.down_sample_steps <= 600, "as many samples are kept");
            }
        }
        Err(errors) => assert!(!errors.diagnostics.is_empty()),
    }
}

/// A picture: refused, or numbers in range; what is refused changes nothing.
pub fn picture(bytes: &[u8]) {
    let [kind, width, height, payload @ ..] = bytes else { return };
    let encoding = [Encoding::Mjpeg, Encoding::Yuyv, Encoding::Grey][usize::from(*kind) % 3];
    let spec = ImageSpec {
        height: 8,
        width: 8,
        color: ColorOrder::Rgb,
        resize: Some([9, 10]),
        crop: Some([8, 8]),
        operation: Some(Operation::DiffToReference),
    };
    let mut preprocessor = Preprocessor::new(spec, &Normalization::Identity);
    let picture = Picture { encoding, width: u32::from(*width), height: u32::from(*height), bytes: payload };
    let mut out = vec![-1.0; preprocessor.output_len()];
    match preprocessor.write(&picture, &mut out) {
        Ok(()) => assert!(out.iter().all(|value| (value - 0.5).abs() < 1e-6), "the first picture is its own reference"),
        Err(error) => {
            assert!(out.iter().all(|value| *value == -1.0) && !error.to_string().is_empty());
        }
    }
}

/// Bundles the tests know, good and bad, and the one of the repository.
#[must_use]
pub fn bundles() -> Vec<Vec<u8>> {
    ["tests/bundle/valid", "tests/bundle/invalid", "models/tactile-id"]
        .into_iter()
        .flat_map(|folder| seeds::files(folder, ".json"))
        .collect()
}

/// A picture of each encoding.
#[must_use]
pub fn pictures() -> Vec<Vec<u8>> {
    let raw = |kind: u8, bytes: usize| [&[kind, 16, 12][..], &vec![0x80; bytes]].concat();
    let source = rapid_registry::simulation::SimSource::Camera { width: 16, height: 12, fps: 30, seed: 1, bytes: 0 };
    let jpeg = rapid_devices::driver::sim::frame(&source, 0).unwrap_or_default();
    vec![[&[0, 16, 12][..], &jpeg].concat(), raw(1, 16 * 12 * 2), raw(2, 16 * 12)]
}
