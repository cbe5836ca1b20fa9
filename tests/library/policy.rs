//! A policy from its files to action chunks, on a bundle that can be worked out by hand
//! (`support/onnx.rs`), with the real onnxruntime: the one inside the program. And what that
//! allocates once it has warmed up: nothing on this side of onnxruntime; the JPEG decoder makes its
//! buffers again for every picture.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "what fails here fails a test")]

use std::time::Duration;

use rapid_core::sample::{Encoding, SampleHeader};
use rapid_policy::bundle::{Bundle, ImageSpec, ObservationInput};
use rapid_policy::graphs::LoadedGraph;
use rapid_policy::model::Model;
use rapid_policy::observation::ObservationTensors;
use rapid_policy::onnxruntime::Environment;
use rapid_policy::picture::{Picture, Preprocessor};
use rapid_policy::request::Request;
use rapid_policy::sampler::{Computing, PolicyError, Sampler};
use rapid_registry::InferenceSpec;

use crate::support::allocations::allocations;
use crate::support::onnx::{
    self, ACTION, CONDITION_SHARE, Change, HISTORY, HISTORY_STEPS, HORIZON, Message, SAMPLE_SHARE, SIDE, STEPS,
    TIMESTEP_SHARE, encoder_of_history, encoder_with, external, within, write_bundle, write_graphs,
};

fn bundle(changes: &[Change<'_>]) -> (tempfile::TempDir, Bundle) {
    let folder = tempfile::tempdir().unwrap();
    write_bundle(folder.path(), changes);
    let bundle = Bundle::load(folder.path()).unwrap();
    (folder, bundle)
}

fn sampler(bundle: &Bundle, steps: Option<usize>) -> Sampler {
    let environment = Environment::open(None).expect("`make setup` fetches the library; then build again");
    Sampler::new(bundle, &environment, Computing { denoising_steps: steps, ..Computing::default() }).unwrap()
}

fn chunk(sampler: &mut Sampler, observation: &ObservationTensors, seed: u64) -> Vec<f32> {
    let mut chunk = vec![f32::NAN; sampler.chunk_len()];
    sampler.chunk(observation, seed, &mut chunk).unwrap();
    chunk
}

/// Numbers in the place of pictures, and a state.
fn observation(bundle: &Bundle) -> ObservationTensors {
    let mut observation = ObservationTensors::new(bundle);
    for key in 0..3 {
        observation.set_present(key, true);
    }
    for step in 0..STEPS {
        observation.step_mut(0, step).unwrap().fill(0.25 + 0.5 * step as f32);
        observation.step_mut(1, step).unwrap().fill(-0.75);
        observation.write_vector(2, step, &[0.5, 1.0, 1.5, 2.0]).unwrap();
    }
    observation
}

/// DDIM by its definition (Song et al. 2020, equation 12, eta 0), on the linear network.
fn by_hand(condition: f64, noise: &[f64], steps: usize) -> Vec<f64> {
    let mut alpha = 1.0;
    let alphas: Vec<f64> = (0..100)
        .map(|at| {
            alpha *= 1.0 - (0.0001 + (0.02 - 0.0001) * f64::from(at) / 99.0);
            alpha
        })
        .collect();
    let stride = 100 / steps;
    let mut sample = noise.to_vec();
    for timestep in (0..steps).rev().map(|step| step * stride) {
        let alpha = alphas[timestep];
        let before = if timestep >= stride { alphas[timestep - stride] } else { 1.0 };
        for x in &mut sample {
            let epsilon = f64::from(SAMPLE_SHARE) * *x
                + f64::from(CONDITION_SHARE) * condition
                + f64::from(TIMESTEP_SHARE) * timestep as f64;
            let clean = (*x - (1.0 - alpha).sqrt() * epsilon) / alpha.sqrt();
            *x = before.sqrt() * clean + (1.0 - before).sqrt() * epsilon;
        }
    }
    sample
}

/// To the units of the action, as POLICY has them.
fn in_units(sample: &[f64]) -> Vec<f64> {
    let to_units = |(at, x): (usize, &f64)| match at % ACTION {
        0 => *x,
        1 => (x + 1.0) * 2.0,
        2 => 2.0 + (x + 1.0) / 2.0,
        _ => 0.5 + 0.25 * x,
    };
    sample.iter().enumerate().map(to_units).collect()
}

#[track_caller]
fn close(found: &[f32], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    for (at, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert!((f64::from(*found) - expected).abs() < 1e-4, "at {at}: {found}, expected {expected}");
    }
}

#[test]
fn a_chunk_matches_its_definition() {
    let (_folder, bundle) = bundle(&[]);
    let mut sampler = sampler(&bundle, None);
    let mut observation = observation(&bundle);
    assert_eq!((sampler.chunk_len(), sampler.steps()), (HORIZON * ACTION, 10));
    let noise = |seed| {
        let mut noise = vec![0.0; HORIZON * ACTION];
        rapid_core::random::Random::new(seed, 0x706f_6c69_6379).fill_normal(&mut noise);
        noise.into_iter().map(f64::from).collect::<Vec<_>>()
    };
    // Means of the inputs: wrist 0.5, tactile -0.75, state (0.5..2 of 0..2, so -0.5..1) 0.25.
    let conditions = [([true, true], 0.5 - 0.75 + 0.25), ([true, false], 0.5 + 0.25), ([false, false], 0.25)];
    for (present, condition) in conditions {
        observation.set_present(0, present[0]);
        observation.set_present(1, present[1]);
        for seed in [0, 7] {
            let found = chunk(&mut sampler, &observation, seed);
            close(&found, &in_units(&by_hand(condition / 3.0, &noise(seed), 10)));
            assert_eq!(found, chunk(&mut sampler, &observation, seed), "the same seed");
        }
    }
    let mut four = self::sampler(&bundle, Some(4));
    close(&chunk(&mut four, &observation, 3), &in_units(&by_hand(0.25 / 3.0, &noise(3), 4)));
    assert!(matches!(
        Sampler::new(
            &bundle,
            &Environment::open(None).unwrap(),
            Computing { denoising_steps: Some(101), ..Computing::default() }
        ),
        Err(PolicyError::Scheduler(_))
    ));
}

#[test]
fn nan_is_passed_on_unless_the_mask_marks_the_modality_absent() {
    let (_folder, bundle) = bundle(&[]);
    let mut sampler = sampler(&bundle, None);
    let mut observation = observation(&bundle);
    observation.set_present(1, false);
    let without = chunk(&mut sampler, &observation, 1);
    observation.step_mut(1, 0).unwrap().fill(f32::NAN);
    assert_eq!(chunk(&mut sampler, &observation, 1), without, "modalities that the mask calls absent do not count");
    observation.step_mut(0, 0).unwrap()[0] = f32::NAN;
    assert!(chunk(&mut sampler, &observation, 1).iter().all(|value| value.is_nan()));
    // And nothing of it is left in the next chunk.
    observation.step_mut(0, 0).unwrap().fill(0.25);
    assert_eq!(chunk(&mut sampler, &observation, 1), without);
}

#[test]
fn with_ddpm_the_noise_of_the_steps_depends_on_the_seed_too() {
    let (_folder, bundle) = bundle(&[Change { what: "\"DDIM\"", with: "\"DDPM\"" }]);
    let mut sampler = sampler(&bundle, Some(20));
    let observation = observation(&bundle);
    let first = chunk(&mut sampler, &observation, 5);
    assert_eq!(first, chunk(&mut sampler, &observation, 5));
    assert_ne!(first, chunk(&mut sampler, &observation, 6));
}

/// What is wrong with a policy of these graphs, when it is loaded.
fn refusal(encoder: &[u8], denoiser: &[u8], changes: &[Change<'_>]) -> Option<String> {
    let folder = tempfile::tempdir().unwrap();
    onnx::write_both(folder.path(), encoder, denoiser, changes);
    let bundle = Bundle::load(folder.path()).unwrap();
    let environment = Environment::open(None).unwrap();
    let limit = Duration::from_millis(if denoiser == onnx::denoiser_of(1.0, true) { 300 } else { 60_000 });
    Model::load_within(&bundle, &environment, Computing::default(), limit).err().map(|error| error.to_string())
}

#[test]
fn a_policy_whose_chunks_are_not_finite_is_refused_when_it_is_loaded() {
    let (encoder, denoiser) = (onnx::encoder(), onnx::denoiser());
    assert_eq!(refusal(&encoder, &denoiser, &[]), None);
    for share in [f32::NAN, f32::INFINITY, f32::MAX] {
        let error = refusal(&encoder, &onnx::denoiser_of(share, false), &[]).unwrap();
        assert!(error.starts_with("denoiser.onnx: its trial run gives NaN or infinity"), "{error}");
    }
    // The numbers of its actions are too large for those that are executed.
    let huge = Change { what: r#""mean": [0.5], "std": [0.25]"#, with: r#""mean": [3.4e38], "std": [3.4e38]"# };
    let error = refusal(&encoder, &denoiser, &[huge]).unwrap();
    assert!(error.starts_with("policy.json: its trial run gives NaN or infinity"), "{error}");
}

#[test]
fn a_policy_that_does_not_end_is_refused_when_it_is_loaded() {
    let error = refusal(&onnx::encoder(), &onnx::denoiser_of(1.0, true), &[]).unwrap();
    assert!(error.starts_with("denoiser.onnx: its trial run has not ended after 300ms"), "{error}");
}

#[test]
fn invalid_or_foreign_graphs_are_rejected_and_named() {
    let environment = Environment::open(None).unwrap();
    let error =
        LoadedGraph::load(&environment, "encoder.onnx", b"no graph", InferenceSpec::default()).unwrap_err().to_string();
    assert!(error.starts_with("encoder.onnx: onnxruntime cannot load it: "), "{error}");

    let (_folder, bundle) = bundle(&[
        Change { what: "\"horizon\": 16", with: "\"horizon\": 12" },
        Change { what: "\"key\": \"tactile\"", with: "\"key\": \"finger\"" },
    ]);
    let Err(PolicyError::Bundle(errors)) = Sampler::new(&bundle, &environment, Computing::default()) else {
        panic!("graphs that do not suit are taken");
    };
    let errors = errors.to_string();
    for word in ["finger", "12", "16"] {
        assert!(errors.contains(word), "{word}: {errors}");
    }
}

#[test]
fn numbers_of_the_wrong_shape_are_rejected_and_named() {
    let (_folder, bundle) = bundle(&[]);
    let mut sampler = sampler(&bundle, None);
    let mut observation = observation(&bundle);
    let error = observation.write_vector(2, 0, &[1.0, 2.0, 3.0]).unwrap_err().to_string();
    assert!(error.starts_with("a sample of 3 values, where observation `state` takes numbers 0 to 4"), "{error}");
    assert!(observation.write_vector(0, 0, &[1.0]).is_err() && observation.step_mut(0, STEPS).is_none());
    assert!(matches!(
        sampler.chunk(&observation, 0, &mut [0.0; 3]),
        Err(PolicyError::Place { expected: 64, found: 3 })
    ));
}

/// A request with nothing but a history: a picture, or one that cannot be decoded, for each of its steps.
fn history(bundle: &Bundle, steps: [Option<Result<u8, ()>>; HISTORY_STEPS]) -> Request {
    let mut request = Request::new(bundle);
    for (step, picture) in steps.into_iter().enumerate() {
        let Some(picture) = picture else { continue };
        let grey = [picture.unwrap_or(0); SIDE * SIDE];
        let bytes = if picture.is_ok() { &grey[..] } else { &grey[..3] };
        let (side, seq) = (u32::try_from(SIDE).unwrap(), picture.map_or(0, u64::from));
        let encoding = Encoding::Grey as u32;
        let header = SampleHeader { seq, encoding, width: side, height: side, ..SampleHeader::default() };
        request.cell_mut(1, step).unwrap().set(&header, bytes);
    }
    request
}

#[test]
fn the_encoder_gets_the_steps_of_a_history_and_which_of_them_there_are() {
    let folder = tempfile::tempdir().unwrap();
    let as_it_is = Change { what: r#""operation": "diff_to_reference""#, with: r#""operation": null"# };
    write_graphs(folder.path(), &encoder_of_history(HISTORY_STEPS), &[HISTORY, as_it_is]);
    let bundle = Bundle::load(folder.path()).unwrap();
    let environment = Environment::open(None).expect("`make setup` fetches the library; then build again");
    let load = || Model::load(&bundle, &environment, Computing::default()).unwrap();
    let [mut model, mut sampler] = [load(), load()];
    let value = |grey: u8| f32::from(grey) / 255.0 * 2.0 - 1.0;
    let some = |grey: u8| Some(Ok(grey));
    for steps in [
        [None, None, None, some(10)],
        [None, None, some(10), some(20)],
        [None, some(10), some(20), None],
        [some(10), some(20), None, None],
        [some(20), None, None, some(60)],
        // In another order, and one several times.
        [some(60), some(60), some(20), some(10)],
        // One that cannot be decoded is absent.
        [some(60), Some(Err(())), None, some(70)],
        [None; 4],
    ] {
        let request = history(&bundle, steps);
        let tensors = model.observe(&request).unwrap();
        let greys = steps.map(|step| step.and_then(Result::ok));
        assert_eq!(tensors.valid(1), greys.map(|grey| f32::from(u8::from(grey.is_some()))), "{steps:?}");
        for (numbers, grey) in tensors.values(1).chunks(3 * SIDE * SIDE).zip(greys) {
            let expected = grey.map_or(0.0, value);
            assert!(numbers.iter().all(|number| (number - expected).abs() < 1e-6), "{steps:?}: {numbers:?}");
        }
        assert_eq!(tensors.mask(), [0.0, f32::from(u8::from(steps[3].is_some()))], "the last step is now");
        // The mean of the pictures and the share of the steps that there are, of three numbers of the encoder.
        let count = greys.iter().flatten().count() as f64;
        let sum: f64 = greys.iter().flatten().map(|grey| f64::from(value(*grey))).sum();
        let mut found = vec![0.0; HORIZON * ACTION];
        sampler.answer(&request, &mut found).unwrap();
        let mut noise = vec![0.0; HORIZON * ACTION];
        rapid_core::random::Random::new(0, 0x706f_6c69_6379).fill_normal(&mut noise);
        let noise: Vec<f64> = noise.into_iter().map(f64::from).collect();
        close(&found, &in_units(&by_hand((sum + count) / 4.0 / 3.0, &noise, 10)));
    }
    let damaged = history(&bundle, [some(1), some(2), some(3), Some(Err(()))]);
    assert!(model.observe(&damaged).is_err(), "the newest picture must be one");
    let tensors = model.observe(&history(&bundle, [some(1), some(2), some(3), some(4)])).unwrap();
    assert_eq!(tensors.valid(1), [1.0; 4]);
}

#[test]
fn chunks_and_plain_pictures_allocate_nothing_once_warm() {
    let (_folder, bundle) = bundle(&[Change { what: "\"DDIM\"", with: "\"DDPM\"" }]);
    let mut sampler = sampler(&bundle, None);
    let mut observation = observation(&bundle);
    let ObservationInput::Image(spec) = bundle.observations[1].input else { panic!("a picture") };
    let mut preprocessor = Preprocessor::new(spec, &bundle.observations[1].normalization);
    let mut out = vec![0.0; sampler.chunk_len()];
    let yuyv = [90_u8; 2 * 32 * 24];
    let picture = Picture { encoding: Encoding::Yuyv, width: 32, height: 24, bytes: &yuyv };
    let mut cycle = |seed: u64| {
        preprocessor.write(&picture, observation.step_mut(1, 1).unwrap()).unwrap();
        observation.write_vector(2, 1, &[0.1, 0.2, 0.3, seed as f64]).unwrap();
        observation.set_present(0, seed.is_multiple_of(2));
        sampler.chunk(&observation, seed, &mut out).unwrap();
    };
    cycle(0);
    assert!(allocations(|| drop(vec![1])) == 1, "nothing is counted");
    assert_eq!(allocations(|| (0..100).for_each(&mut cycle)), 0);
}

/// Buffers of the decoder: they grow with the picture's width, and do not with what came before.
#[test]
fn a_jpeg_allocates_only_the_buffers_of_the_decoder() {
    let spec = ImageSpec {
        height: SIDE,
        width: SIDE,
        color: rapid_policy::bundle::ColorOrder::Rgb,
        resize: Some([SIDE, SIDE]),
        crop: None,
        operation: None,
    };
    let mut preprocessor = Preprocessor::new(spec, &rapid_policy::bundle::Normalization::Identity);
    let mut jpeg = Vec::new();
    rapid_pictures::jpeg::encode(
        &vec![90; 3 * 320 * 240],
        [240, 320],
        rapid_pictures::jpeg::Values::Rgb,
        85,
        &mut jpeg,
    )
    .unwrap();
    let picture = Picture { encoding: Encoding::Mjpeg, width: 320, height: 240, bytes: &jpeg };
    let mut out = vec![0.0; preprocessor.output_len()];
    let mut write = || preprocessor.write(&picture, &mut out).unwrap();
    write();
    let once = allocations(&mut write);
    assert!((1..=40).contains(&once), "{once} allocations for a picture");
    assert_eq!(allocations(|| (0..50).for_each(|_| write())), 50 * once);
}

/// Wherever a tensor can be in a model, its numbers must lie in the model: the SHA-256 covers no other file.
#[test]
fn a_tensor_with_external_data_is_rejected_and_named_wherever_it_is() {
    // Fields of messages: ModelProto graph 7, training 20, function 25; GraphProto node 1, initializer 5, sparse 15;
    // NodeProto attribute 5; AttributeProto tensor 5, graph 6, tensors 10, graphs 11, sparse 22 and 23;
    // SparseTensorProto values 1, indices 2; FunctionProto node 7, attribute 11; TrainingInfoProto graphs 1 and 2.
    let paths: &[(&str, &[u64])] = &[
        ("initializer", &[7, 5]),
        ("values of a sparse initializer", &[7, 15, 1]),
        ("indices of a sparse initializer", &[7, 15, 2]),
        ("constant", &[7, 1, 5, 5]),
        ("constants", &[7, 1, 5, 10]),
        ("sparse constant", &[7, 1, 5, 22, 1]),
        ("sparse constants", &[7, 1, 5, 23, 2]),
        ("initializer of a subgraph", &[7, 1, 5, 6, 5]),
        ("initializer of one of many subgraphs", &[7, 1, 5, 11, 5]),
        ("constant of a subgraph of a subgraph", &[7, 1, 5, 6, 1, 5, 6, 1, 5, 5]),
        ("constant of a function", &[25, 7, 5, 5]),
        ("default of a function", &[25, 11, 5]),
        ("subgraph of a function", &[25, 7, 5, 6, 5]),
        ("initial training", &[20, 1, 5]),
        ("training", &[20, 2, 5]),
    ];
    for (what, path) in paths {
        let (model, inside) = path.split_first().expect("a path");
        let tensor = inside.iter().rev().fold(external("far"), |message, field| within(*field, &message));
        let folder = tempfile::tempdir().expect("folder");
        write_graphs(folder.path(), &encoder_with(*model, &tensor), &[]);
        let error = Bundle::load(folder.path()).expect_err(what).to_string();
        let wanted = "encoder.onnx: the numbers of tensor \"far\" lie in another file, \"weights.bin\"";
        assert!(error.contains(wanted) && error.contains("fix: store them in the graph"), "{what}: {error}");
    }
    // The flag without a file, a file without the flag, and no name but that of the node.
    let mut flag = Message::default();
    flag.number(14, 1);
    let mut file = Message::default();
    file.message(13, &within(2, &Message::default()));
    for tensor in [flag, file] {
        let mut node = within(5, &within(5, &tensor));
        node.bytes(2, b"output");
        let folder = tempfile::tempdir().expect("folder");
        write_graphs(folder.path(), &encoder_with(7, &within(1, &node)), &[]);
        let error = Bundle::load(folder.path()).expect_err("external").to_string();
        assert!(error.contains("the numbers of tensor \"output\" lie in another file"), "{error}");
    }
}

#[test]
fn a_truncated_model_is_rejected() {
    let mut cut = onnx::encoder();
    cut.pop();
    let mut ort = onnx::encoder();
    ort.splice(0..0, *b"\x0a\x06\x0a\x04ORTM");
    for (model, what) in [(cut, "cut"), (ort, "onnxruntime's own format"), (b"no graph".to_vec(), "text")] {
        let folder = tempfile::tempdir().expect("folder");
        write_graphs(folder.path(), &model, &[]);
        let error = Bundle::load(folder.path()).expect_err(what).to_string();
        assert!(error.contains("encoder.onnx is not an ONNX model"), "{what}: {error}");
    }
    // A graph in a graph in a graph: deeper than any stack.
    let nested = (0..20_000).fold(Message::default(), |inside, _| within(1, &within(5, &within(6, &inside))));
    let folder = tempfile::tempdir().expect("folder");
    write_graphs(folder.path(), &encoder_with(7, &nested), &[]);
    Bundle::load(folder.path()).expect("nothing in it lies elsewhere");
}
