//! Simulated cameras with a known latency.

use std::time::Duration;

use proptest::prelude::*;

use super::*;
use crate::effort::{cases, every};
use crate::flash;

const BEGIN: Stamp = Stamp(1_000_000_000_000);

/// A camera that records the pattern.
#[derive(Debug, Clone, Copy)]
struct Camera {
    latency_ms: f64,
    fps: f64,
    /// Share of a picture's time in which it is exposed.
    exposure: f64,
    contrast: f64,
    /// Standard deviation of the brightness, share of the contrast.
    noise: f64,
    /// Share of the pictures that are lost.
    dropped: f64,
    /// How far the camera adapts to the light, share of the contrast, and how fast, seconds.
    adapts: (f64, f64),
    seed: u64,
}

const CAMERA: Camera = Camera {
    latency_ms: 40.0,
    fps: 30.0,
    exposure: 0.5,
    contrast: 100.0,
    noise: 0.0,
    dropped: 0.0,
    adapts: (0.0, 1.0),
    seed: 1,
};

/// Pseudo-random numbers from 0 to 1.
fn random(state: &mut u64) -> f64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    (*state >> 11) as f64 / (1_u64 << 53) as f64
}

fn flips(seconds: u64) -> Vec<Flip> {
    flash::changes()
        .take_while(|change| change.after < Duration::from_secs(seconds))
        .map(|change| Flip { at: BEGIN.after(change.after), lit: change.lit })
        .collect()
}

#[test]
fn the_light_is_the_same_wherever_the_search_begins() {
    let scene = Scene::new(&flips(20), &seen(CAMERA, 20)).expect("a scene");
    let mut state = 7;
    let mut next = 0;
    for _ in 0..10_000 {
        let at = 24.0 * random(&mut state) - 2.0;
        assert_eq!(scene.lit_until(at, &mut next).to_bits(), scene.lit_until(at, &mut 0).to_bits(), "{at} s");
        assert_eq!(next, scene.flips.partition_point(|(flip, ..)| *flip <= at), "{at} s");
    }
}

fn seen(camera: Camera, seconds: u64) -> Vec<Seen> {
    let mut state = camera.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let phase = random(&mut state) / camera.fps;
    let mut level = 0.0;
    let mut pictures = Vec::new();
    for index in 0_u32.. {
        let at = phase + f64::from(index) / camera.fps;
        if at > seconds as f64 {
            break;
        }
        let middle = at - camera.latency_ms / 1e3;
        let half = (camera.exposure / camera.fps).max(1e-6) / 2.0;
        let span = |at: f64| Duration::from_secs_f64(at.max(0.0));
        let light = flash::lit_share(span(middle - half), span(middle + half));
        let (depth, time) = camera.adapts;
        level += (light - level) / (camera.fps * time).max(1.0);
        // The sum of twelve is close enough to a Gaussian.
        let noise = (0..12).map(|_| random(&mut state)).sum::<f64>() - 6.0;
        let brightness = 30.0 + camera.contrast * (light - depth * level + camera.noise * noise);
        if random(&mut state) >= camera.dropped {
            let at = BEGIN.after(Duration::from_secs_f64(at));
            pictures.push(Seen { at, brightness: brightness.clamp(0.0, 255.0) });
        }
    }
    pictures
}

fn measure(camera: Camera) -> Estimate {
    estimate(&flips(12), &seen(camera, 13)).unwrap_or_else(|refusal| panic!("{camera:?}: {refusal}"))
}

#[track_caller]
fn near(camera: Camera, within_ms: f64) {
    let estimate = measure(camera);
    let error = estimate.latency_ms - camera.latency_ms;
    assert!(error.abs() <= within_ms, "{camera:?}: {estimate:?}, {error:.2} ms off");
}

#[test]
fn the_latency_is_found_to_a_few_milliseconds() {
    near(CAMERA, 1.0);
    near(Camera { latency_ms: 0.0, ..CAMERA }, 1.0);
    near(Camera { latency_ms: -20.0, ..CAMERA }, 1.0);
    near(Camera { latency_ms: 480.0, fps: 15.0, ..CAMERA }, 2.0);
    near(Camera { fps: 120.0, noise: 0.05, ..CAMERA }, 1.0);
    near(Camera { exposure: 0.0, ..CAMERA }, 1.0);
    near(Camera { exposure: 1.0, ..CAMERA }, 1.0);
    near(Camera { adapts: (0.6, 0.8), ..CAMERA }, 2.0);
    near(Camera { contrast: 6.0, noise: 0.03, ..CAMERA }, 3.0);
}

#[test]
fn the_uncertainty_interval_nearly_always_contains_the_true_value() {
    let (mut held, mut tried) = (0, 0);
    for seed in (0..60).step_by(every(3)) {
        let camera = Camera { seed, latency_ms: seed as f64 * 5.3, noise: 0.04, exposure: 0.3, ..CAMERA };
        let estimate = measure(camera);
        tried += 1;
        held += u64::from((estimate.latency_ms - camera.latency_ms).abs() <= estimate.uncertainty_ms);
        assert!(estimate.uncertainty_ms < 8.0, "{estimate:?}");
    }
    assert!(held * 100 >= tried * 90, "{held} of {tried}");
}

#[test]
fn a_random_delay_of_the_screen_adds_its_mean() {
    // A display shows a change at its next refresh, 0 to 16.7 ms later.
    let mut state = 77;
    let mut late = flips(12);
    for flip in &mut late {
        flip.at = flip.at.before(Duration::from_secs_f64(random(&mut state) / 60.0));
    }
    let estimate = estimate(&late, &seen(CAMERA, 13)).unwrap();
    assert!((estimate.latency_ms - 48.3).abs() < 5.0, "{estimate:?}");
}

#[test]
fn pictures_that_do_not_follow_the_light_are_refused_with_a_reason() {
    let of = |seen: Vec<Seen>| estimate(&flips(12), &seen).unwrap_err();
    let level = |brightness: f64, spread: f64| {
        let mut state = 5;
        let mut seen = seen(CAMERA, 13);
        for seen in &mut seen {
            seen.brightness = brightness + spread * (random(&mut state) - 0.5);
        }
        seen
    };
    assert!(matches!(of(level(120.0, 0.5)), Refusal::Flat { .. }));
    assert_eq!(of(level(254.0, 0.5)), Refusal::Saturated);
    assert!(matches!(of(level(120.0, 80.0)), Refusal::Unlike { correlation } if correlation < 0.35));
    // A lamp that blinks on its own.
    let mut blinking = seen(CAMERA, 13);
    for seen in &mut blinking {
        seen.brightness = if seen.at.0 / 400_000_000 % 2 == 0 { 20.0 } else { 200.0 };
    }
    assert!(matches!(of(blinking), Refusal::Unlike { .. }));
    assert!(matches!(of(seen(CAMERA, 0)), Refusal::TooFew { pictures: 0..30, flips: 8.. }));
    assert!(matches!(estimate(&[], &seen(CAMERA, 13)), Err(Refusal::TooFew { flips: 0, .. })));
    // A light that switches at regular intervals fits at every second one of them.
    let even: Vec<_> = (0..40_u64)
        .map(|index| Flip { at: BEGIN.after(Duration::from_millis(index * 150)), lit: index % 2 == 0 })
        .collect();
    let follows: Vec<_> = (0..180_u64)
        .map(|index| Seen {
            at: BEGIN.after(Duration::from_millis(index * 33)),
            brightness: if index * 33 % 300 < 150 { 200.0 } else { 20.0 },
        })
        .collect();
    assert!(matches!(estimate(&even, &follows), Err(Refusal::Ambiguous { .. })));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: cases(48), ..ProptestConfig::default() })]

    #[test]
    fn the_error_stays_below_a_few_ms(
        latency_ms in 0.0_f64..500.0, fps in 15.0_f64..120.0, exposure in 0.0_f64..1.0, contrast in 10.0_f64..200.0,
        noise in 0.0_f64..0.05, dropped in 0.0_f64..0.2, seed in any::<u64>(),
    ) {
        let camera = Camera { latency_ms, fps, exposure, contrast, noise, dropped, seed, ..CAMERA };
        let estimate = measure(camera);
        let half_a_picture = 500.0 / fps;
        let error = (estimate.latency_ms - latency_ms).abs();
        prop_assert!(error < half_a_picture.min(6.0), "{:?} {:?}: {}", camera, estimate, error);
        prop_assert!(estimate.uncertainty_ms < half_a_picture.max(6.0), "{:?}", estimate);
    }

    #[test]
    fn no_input_causes_a_panic(
        flips in proptest::collection::vec((any::<u64>(), any::<bool>()), 0..30),
        seen in proptest::collection::vec((any::<u64>(), any::<f64>()), 0..60),
    ) {
        let flips: Vec<_> = flips.into_iter().map(|(at, lit)| Flip { at: Stamp(at), lit }).collect();
        let seen: Vec<_> = seen.into_iter().map(|(at, brightness)| Seen { at: Stamp(at), brightness }).collect();
        let _ = estimate(&flips, &seen);
    }
}
