//! A policy at the controls allocates nothing once it has warmed up, tick by tick: what it sees, what it asks,
//! what it does. An answer to a request costs what the JPEG decoder makes for its pictures, and no more on
//! this side of onnxruntime.
//!
//! Warm is what has held the largest samples once: each place of a ring, each cell of a request.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "what fails here fails a test")]

use std::sync::LazyLock;
use std::time::Duration;

use rapid_core::mask::PhysicalMask;
use rapid_core::sample::{Encoding, FLAG_ERROR, SampleHeader};
use rapid_core::time::Stamp;
use rapid_policy::bundle::Bundle;
use rapid_policy::compose::Composer;
use rapid_policy::horizon::{ActionQueue, Situation, WithoutMask};
use rapid_policy::model::Model;
use rapid_policy::observer::Observer;
use rapid_policy::onnxruntime::Environment;
use rapid_policy::pilot::Pilot;
use rapid_policy::request::Request;
use rapid_policy::sampler::Computing;
use rapid_registry::Registry;
use rapid_registry::simulation::task::{SIDE, layout};
use rapid_registry::task::PARTS;

use crate::support::allocations::allocations;
use crate::support::onnx::{
    ACTION, Change, HISTORY, HISTORY_STEPS, HORIZON, STEPS, encoder_of_history, write_bundle, write_graphs,
};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;

/// Between two ticks.
const PERIOD: Duration = Duration::from_millis(100);
/// Bytes of the largest sample.
const LARGEST: usize = 4000;
const TICKS: u64 = 400;

fn bundle() -> (tempfile::TempDir, Bundle) {
    changed_bundle(&[])
}

fn changed_bundle(changes: &[Change<'_>]) -> (tempfile::TempDir, Bundle) {
    let folder = tempfile::tempdir().unwrap();
    write_bundle(folder.path(), changes);
    let bundle = Bundle::load(folder.path()).unwrap();
    (folder, bundle)
}

fn at(tick: u64) -> Stamp {
    Stamp(1_000_000_000).after(PERIOD * u32::try_from(tick).unwrap())
}

/// Ticks in which each place of every ring is written.
fn warm_up(registry: &Registry) -> u64 {
    2 * registry.devices.iter().map(|device| device.depth as u64).max().unwrap()
}

/// A picture of the size that the devices of the task send.
static JPEG: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let mut jpeg = Vec::new();
    let side = u16::try_from(SIDE).unwrap();
    let pixels = vec![90; SIDE * SIDE * 3];
    rapid_pictures::jpeg::encode(&pixels, [side; 2], rapid_pictures::jpeg::Values::Rgb, 50, &mut jpeg).unwrap();
    jpeg
});

/// Of the devices of the task, the samples of a tick, captured before it: as large as they get, or of a size that
/// goes up and down. Now and then one is damaged.
fn samples(registry: &Registry, tick: u64, large: bool, mut take: impl FnMut(usize, &SampleHeader, &[u8])) {
    let mut bytes = [7; LARGEST];
    let captured = at(tick).0 - 5_000_000;
    for (place, (name, part)) in PARTS.iter().enumerate() {
        let (encoding, width, height) = layout(*part);
        let header = SampleHeader {
            seq: tick,
            capture_ns: captured,
            recv_ns: captured + 1_000_000,
            id: u32::try_from(place).unwrap(),
            epoch: 1,
            encoding: encoding as u32,
            flags: if tick % 37 == 5 { FLAG_ERROR } else { 0 },
            width,
            height,
            ..SampleHeader::default()
        };
        let len = if large { LARGEST } else { usize::try_from(tick * 131 % LARGEST as u64).unwrap() };
        // A whole picture, with any number of bytes behind its end.
        let jpeg: &[u8] = if encoding == Encoding::Mjpeg { &JPEG } else { &[] };
        let len = len.max(jpeg.len());
        bytes[..jpeg.len()].copy_from_slice(jpeg);
        // The rig with the arm has no phone.
        let Some(device) = registry.devices.iter().position(|device| device.name == *name) else { continue };
        take(device, &header, &bytes[..len]);
    }
}

#[test]
fn a_tick_does_not_allocate() {
    let (_folder, bundle) = bundle();
    let registry = Registry::task();
    let mut pilot = Pilot::new(&bundle, &registry, WithoutMask::Hold, 0);
    let mut request = Request::new(&bundle);
    let chunk = [0.5; HORIZON * ACTION];
    let wild = [f32::NAN; HORIZON * ACTION];
    let mut asked: Option<u64> = None;
    let mut tick = |number: u64, large: bool| {
        samples(&registry, number, large, |device, header, payload| {
            pilot.observer.push(registry.devices[device].id, header, payload);
        });
        // Of 16 ticks the tactile sensor is away for four, and the wrist's camera for two of these.
        pilot.mask = PhysicalMask(match number % 16 {
            0..12 => 0b111,
            12 | 13 => 0b101,
            _ => 0b100,
        });
        if let Some(asked) = asked.take_if(|asked| number - *asked > number % 3) {
            match number % 5 {
                0 => pilot.queue.failed(asked),
                1 => drop(pilot.queue.accept_chunk(asked, &wild)),
                _ => drop(pilot.queue.accept_chunk(asked, &chunk)),
            }
        }
        // Late by a while at times.
        let now = at(number).after(Duration::from_millis(number % 7));
        if pilot.observe(number, at(number), now) {
            pilot.fill(number, at(number), &mut request);
            asked = Some(number);
        }
        let _ = pilot.step(number);
    };
    let begin = warm_up(&registry);
    (0..begin).for_each(|number| tick(number, true));
    assert_eq!(allocations(|| drop(vec![1])), 1, "nothing is counted");
    assert_eq!(allocations(|| (begin..begin + TICKS).for_each(|number| tick(number, false))), 0);
    let counts = pilot.queue.counts();
    assert!(counts.actions > TICKS / 4 && counts.held_ticks > 0, "{counts:?}");
    assert!(counts.requests > TICKS / 16 && counts.chunks > 0, "{counts:?}");
    assert!(counts.failed_requests > 0 && counts.not_finite_chunks > 0, "{counts:?}");
}

#[test]
fn composing_a_chunk_and_steps_far_apart_do_not_allocate() {
    let relative = r#""representation": "relative", "base": {"modality": "arm", "position": [0, 3]}"#;
    let (_folder, bundle) = changed_bundle(&[
        Change { what: r#""representation": "absolute""#, with: relative },
        Change { what: r#""required": true,"#, with: r#""required": true, "down_sample_steps": 5,"# },
    ]);
    assert_eq!(bundle.observations[2].down_sample_steps, 5);
    let registry = Registry::task();
    let mut pilot = Pilot::new(&bundle, &registry, WithoutMask::Hold, 0);
    let mut request = Request::new(&bundle);
    let output = [0.5; HORIZON * ACTION];
    let mut tick = |number: u64, large: bool| {
        samples(&registry, number, large, |device, header, payload| {
            pilot.observer.push(registry.devices[device].id, header, payload);
        });
        pilot.mask = PhysicalMask(0b111);
        if pilot.observe(number, at(number), at(number)) {
            pilot.fill(number, at(number), &mut request);
            // Some samples of the arm are too short for a pose.
            let _ = pilot.answer(&request, &output);
        }
        let _ = pilot.step(number);
    };
    let begin = warm_up(&registry);
    (0..begin).for_each(|number| tick(number, true));
    assert_eq!(allocations(|| (begin..begin + TICKS).for_each(|number| tick(number, false))), 0);
    let counts = pilot.queue.counts();
    assert!(counts.chunks > TICKS / 16 && counts.actions > TICKS / 2, "{counts:?}");
}

#[test]
fn a_history_with_gaps_does_not_allocate() {
    let (_folder, bundle) = changed_bundle(&[HISTORY]);
    assert!(bundle.observations[1].history.is_some());
    let registry = Registry::task();
    let mut pilot = Pilot::new(&bundle, &registry, WithoutMask::Hold, 0);
    let mut request = Request::new(&bundle);
    let mut seen = [0_u64; 2];
    let mut tick = |number: u64, large: bool| {
        samples(&registry, number, large, |device, header, payload| {
            pilot.observer.push(registry.devices[device].id, header, payload);
        });
        pilot.mask = PhysicalMask(if number % 16 < 12 { 0b111 } else { 0b101 });
        let _ = pilot.observe(number, at(number), at(number));
        // Every step of the history is of every tick at some time.
        pilot.fill(number, at(number), &mut request);
        for step in 0..request.steps(1) {
            seen[usize::from(request.sample(1, step).is_some())] += 1;
        }
    };
    // So does a copy of the history: it has places for 10 ticks.
    let begin = warm_up(&registry).max(64);
    (0..begin).for_each(|number| tick(number, true));
    assert_eq!(allocations(|| (begin..begin + TICKS).for_each(|number| tick(number, false))), 0);
    assert!(seen.iter().all(|steps| *steps > TICKS / 2), "{seen:?}");
}

#[test]
fn a_picture_of_a_history_is_decoded_once() {
    const SIDE: u16 = 8;
    let folder = tempfile::tempdir().unwrap();
    write_graphs(folder.path(), &encoder_of_history(HISTORY_STEPS), &[HISTORY]);
    let bundle = Bundle::load(folder.path()).unwrap();
    let environment = Environment::open(None).expect("`make setup` fetches the library; then build again");
    let mut model = Model::load(&bundle, &environment, Computing::default()).unwrap();
    let mut request = Request::new(&bundle);
    let pictures: Vec<Vec<u8>> = [40, 80, 120, 160, 200, 240].map(|color| jpeg(SIDE, color)).into();
    // The steps of a history that begins with picture `first`.
    let fill = |request: &mut Request, first: usize| {
        for (step, picture) in pictures.iter().enumerate().skip(first).take(HISTORY_STEPS).enumerate() {
            let (number, payload) = picture;
            let side = u32::from(SIDE);
            let (seq, encoding) = (number as u64, Encoding::Mjpeg as u32);
            let header = SampleHeader { seq, encoding, width: side, height: side, ..SampleHeader::default() };
            request.cell_mut(1, step).unwrap().set(&header, payload);
        }
    };
    let mut chunk = vec![0.0; model.chunk_len()];
    let mut answer = |request: &Request| model.answer(request, &mut chunk).unwrap();
    fill(&mut request, 0);
    answer(&request);
    answer(&request);
    assert_eq!(allocations(|| (0..50).for_each(|_| answer(&request))), 0, "the same pictures");
    // The steps move on by one picture.
    fill(&mut request, 1);
    let one = allocations(|| answer(&request));
    fill(&mut request, 2);
    let other = allocations(|| answer(&request));
    assert!(one > 0 && one == other, "{one} and {other}");
}

#[test]
fn composing_a_rotation_does_not_allocate() {
    for name in ["relative", "delta"] {
        let path = format!("{}/tests/bundle/valid/{name}.json", env!("CARGO_MANIFEST_DIR"));
        let bundle = Bundle::parse(&std::fs::read_to_string(path).unwrap(), "policy.json").unwrap();
        let composer = Composer::new(&bundle);
        let mut request = Request::new(&bundle);
        let arm = bundle.action.representation.base().unwrap().observation;
        let header = SampleHeader { encoding: Encoding::F64 as u32, ..SampleHeader::default() };
        let pose: Vec<u8> = [0.1_f64, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0].into_iter().flat_map(f64::to_le_bytes).collect();
        request.set_present(arm, true);
        for step in 0..bundle.n_obs_steps {
            request.cell_mut(arm, step).unwrap().set(&header, &pose);
        }
        let output: Vec<f32> = (0_u8..10).map(|at| f32::from(at % 4) / 4.0).collect();
        let output = output[..bundle.action.outputs()].repeat(bundle.horizon);
        let mut actions = vec![0.0; composer.chunk_len()];
        let mut wild = |output: &[f32], request: &Request| composer.compose(request, output, &mut actions);
        assert!(wild(&output, &request).is_ok(), "{name}");
        let zeros = vec![0.0; output.len()];
        assert_eq!(allocations(|| (0..50).for_each(|_| _ = wild(&output, &request))), 0, "{name}");
        assert_eq!(allocations(|| (0..50).for_each(|_| _ = wild(&zeros, &request))), 0, "{name}");
    }
}

#[test]
fn keeping_a_sample_does_not_allocate() {
    let (_folder, bundle) = bundle();
    let registry = Registry::task();
    let mut observer = Observer::new(&bundle, &registry);
    let mut push = |number: u64, large: bool| {
        samples(&registry, number, large, |device, header, payload| {
            observer.push(registry.devices[device].id, header, payload);
        });
    };
    let begin = warm_up(&registry);
    (0..begin).for_each(|number| push(number, true));
    assert_eq!(allocations(|| (begin..begin + TICKS).for_each(|number| push(number, false))), 0);
    let last = begin + TICKS - 1;
    assert!(observer.observe(last, at(last), at(last), PhysicalMask(0b111)).is_some(), "nothing was kept");
}

#[test]
fn a_step_of_the_horizon_never_allocates() {
    let (_folder, bundle) = bundle();
    let mut queue = ActionQueue::new(&bundle, &Registry::task(), WithoutMask::Hold);
    // Beyond the limits, so that they are held against it.
    let chunk = [10.0; HORIZON * ACTION];
    let allocated = allocations(|| {
        for tick in 0..TICKS {
            let mask = PhysicalMask(if tick % 50 < 40 { 0b111 } else { 0b110 });
            let situation = Situation { mask, observation_age: Some(Duration::from_millis(tick % 400)) };
            let asked = queue.wants_observation(tick, situation);
            let _ = queue.step(tick, situation);
            if asked {
                let _ = queue.accept_chunk(tick, &chunk);
            }
        }
    });
    assert_eq!(allocated, 0);
    let counts = queue.counts();
    assert!(counts.actions > 0 && counts.held_ticks > 0 && counts.chunks > 0, "{counts:?}");
}

/// A picture as a camera sends it.
fn jpeg(side: u16, color: u8) -> Vec<u8> {
    let mut jpeg = Vec::new();
    let pixels = vec![color; 3 * usize::from(side) * usize::from(side)];
    rapid_pictures::jpeg::encode(&pixels, [side; 2], rapid_pictures::jpeg::Values::Rgb, 90, &mut jpeg).unwrap();
    jpeg
}

#[test]
fn an_answer_allocates_only_for_the_decoder_of_its_pictures() {
    const SIDE: u16 = 8;
    let (_folder, bundle) = bundle();
    let environment = Environment::open(None).expect("`make setup` fetches the library; then build again");
    let mut model = Model::load(&bundle, &environment, Computing::default()).unwrap();
    let mut request = Request::new(&bundle);
    let pictures: Vec<Vec<u8>> = [40, 200].map(|color| jpeg(SIDE, color)).into();
    let state: Vec<u8> = [0.1_f64, 0.2, 0.3, 0.4].into_iter().flat_map(f64::to_le_bytes).collect();
    for step in 0..STEPS {
        for (observation, payload) in [&pictures[0], &pictures[1], &state].into_iter().enumerate() {
            let (encoding, side) =
                if observation < 2 { (Encoding::Mjpeg, u32::from(SIDE)) } else { (Encoding::F64, 0) };
            let header =
                SampleHeader { encoding: encoding as u32, width: side, height: side, ..SampleHeader::default() };
            request.cell_mut(observation, step).unwrap().set(&header, payload);
            request.set_present(observation, true);
        }
    }
    let mut pixels = vec![0; 3 * usize::from(SIDE) * usize::from(SIDE)];
    let mut decode = |picture: &Vec<u8>| {
        let mut decoder = JpegDecoder::new(ZCursor::new(picture));
        decoder.decode_headers().unwrap();
        decoder.decode_into(&mut pixels).unwrap();
    };
    pictures.iter().for_each(&mut decode);
    let decoder = allocations(|| pictures.iter().for_each(&mut decode)) * STEPS as u64;
    assert!(decoder > 0, "the decoder is not counted");

    let mut chunk = vec![0.0; model.chunk_len()];
    let mut answer = |request: &Request| model.answer(request, &mut chunk).unwrap();
    answer(&request);
    assert_eq!(allocations(|| (0..50).for_each(|_| answer(&request))), 50 * decoder);
    // Numbers alone cost nothing.
    request.set_present(0, false);
    request.set_present(1, false);
    assert_eq!(allocations(|| (0..50).for_each(|_| answer(&request))), 0);
}
