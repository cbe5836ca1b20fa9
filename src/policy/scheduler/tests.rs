//! Against every case of `tests/golden/scheduler.json`, computed with the diffusers library, 0.35.2:
//! timesteps, alphas, and every sample on the way for a network in closed form.

use serde_json::Value;

use super::*;

const TOLERANCE: f32 = 1e-5;

fn golden() -> Value {
    serde_json::from_str(include_str!("../../../tests/golden/scheduler.json")).unwrap()
}

fn floats(value: &Value) -> Vec<f32> {
    #[expect(clippy::cast_possible_truncation, reason = "they were 32-bit floats")]
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap() as f32).collect()
}

fn word<T: Copy>(config: &Value, key: &str, words: &[(&str, T)]) -> T {
    let given = config[key].as_str().unwrap_or(words[0].0);
    words.iter().find(|(word, _)| *word == given).unwrap_or_else(|| panic!("{key} = {given}")).1
}

fn spec(config: &Value, steps: usize) -> SchedulerSpec {
    #[expect(clippy::cast_possible_truncation, reason = "small numbers")]
    SchedulerSpec {
        kind: word(config, "type", &[("DDIM", SchedulerKind::Ddim), ("DDPM", SchedulerKind::Ddpm)]),
        num_train_timesteps: config["num_train_timesteps"].as_u64().unwrap() as usize,
        beta_schedule: word(
            config,
            "beta_schedule",
            &[
                ("squaredcos_cap_v2", BetaSchedule::SquaredcosCapV2),
                ("linear", BetaSchedule::Linear),
                ("scaled_linear", BetaSchedule::ScaledLinear),
            ],
        ),
        beta_start: config["beta_start"].as_f64().unwrap(),
        beta_end: config["beta_end"].as_f64().unwrap(),
        prediction_type: word(
            config,
            "prediction_type",
            &[
                ("epsilon", PredictionType::Epsilon),
                ("sample", PredictionType::Sample),
                ("v_prediction", PredictionType::VPrediction),
            ],
        ),
        clip_sample: config["clip_sample"].as_bool().unwrap(),
        clip_sample_range: config["clip_sample_range"].as_f64().unwrap() as f32,
        set_alpha_to_one: config["set_alpha_to_one"].as_bool().unwrap_or(true),
        steps_offset: config["steps_offset"].as_u64().unwrap_or(0) as usize,
        timestep_spacing: word(
            config,
            "timestep_spacing",
            &[
                ("leading", TimestepSpacing::Leading),
                ("trailing", TimestepSpacing::Trailing),
                ("linspace", TimestepSpacing::Linspace),
            ],
        ),
        num_inference_steps: steps,
    }
}

/// The network of the golden vectors: `tanh(0.7 * x + 0.3 * sin(flat index) - t / T)`.
fn predict(x: &[f32], timestep: i64, total: usize) -> Vec<f32> {
    #[expect(clippy::cast_precision_loss, reason = "small numbers")]
    let (t, total) = (timestep as f32, total as f32);
    x.iter().enumerate().map(|(at, x)| (0.7 * x + 0.3 * (at as f32).sin() - t / total).tanh()).collect()
}

#[track_caller]
fn close(found: &[f32], wanted: &[f32], what: &str) {
    assert_eq!(found.len(), wanted.len(), "{what}");
    let worst = found.iter().zip(wanted).map(|(a, b)| (a - b).abs()).fold(0.0_f32, f32::max);
    assert!(worst <= TOLERANCE, "{what}: off by {worst}");
}

#[test]
fn every_golden_case_is_reproduced() {
    let golden = golden();
    let cases = golden["cases"].as_object().unwrap();
    assert_eq!(cases.len(), 12);
    for (name, case) in cases {
        let steps = usize::try_from(case["n"].as_u64().unwrap()).unwrap();
        let spec = spec(&case["cfg"], steps);
        close(&alphas_cumprod(&spec), &floats(&case["alphas_cumprod"]), &format!("{name}: alphas"));
        let scheduler = Scheduler::new(&spec, steps).unwrap();
        let timesteps: Vec<_> = scheduler.timesteps().collect();
        let wanted: Vec<_> = case["timesteps"].as_array().unwrap().iter().map(|t| t.as_i64().unwrap()).collect();
        assert_eq!(timesteps, wanted, "{name}");
        let mut x = floats(&case["x"][0]);
        for (at, timestep) in timesteps.iter().enumerate() {
            let prediction = predict(&x, *timestep, spec.num_train_timesteps);
            let noise = case["noise"].as_array().map(|noise| floats(&noise[at]));
            scheduler.step(at, &mut x, &prediction, noise.as_deref());
            close(&x, &floats(&case["x"][at + 1]), &format!("{name}, after step {at}"));
        }
    }
}

fn example() -> SchedulerSpec {
    let golden = golden();
    spec(&golden["cases"]["ddim_T100_n10_eps"]["cfg"], 10)
}

#[test]
fn scaled_linear_betas_are_the_squares_of_evenly_spaced_roots() {
    let spec =
        SchedulerSpec { beta_schedule: BetaSchedule::ScaledLinear, beta_start: 0.01, beta_end: 0.09, ..example() };
    let alphas = alphas_cumprod(&SchedulerSpec { num_train_timesteps: 3, ..spec });
    close(&alphas, &[0.99, 0.99 * 0.96, 0.99 * 0.96 * 0.91], "roots 0.1, 0.2, 0.3");
}

#[test]
fn unsupported_schedulers_are_rejected() {
    let spec = example();
    assert_eq!(Scheduler::new(&spec, 0), Err(SchedulerError::Steps { steps: 0, train: 100 }));
    assert_eq!(Scheduler::new(&spec, 101), Err(SchedulerError::Steps { steps: 101, train: 100 }));
    let offset = SchedulerSpec { steps_offset: 10, ..spec };
    assert_eq!(Scheduler::new(&offset, 10), Err(SchedulerError::Offset { timestep: 100, train: 100 }));
    let betas = SchedulerSpec { beta_schedule: BetaSchedule::Linear, beta_start: 1e-9, ..spec };
    assert_eq!(Scheduler::new(&betas, 10), Err(SchedulerError::Betas { timestep: 0 }));
}

#[test]
fn every_number_of_steps_descends_through_existing_timesteps() {
    for spacing in [TimestepSpacing::Leading, TimestepSpacing::Trailing, TimestepSpacing::Linspace] {
        for kind in [SchedulerKind::Ddim, SchedulerKind::Ddpm] {
            for steps in 1..=100 {
                let spec = SchedulerSpec { timestep_spacing: spacing, kind, ..example() };
                let scheduler = Scheduler::new(&spec, steps).unwrap();
                let timesteps: Vec<_> = scheduler.timesteps().collect();
                assert_eq!(timesteps.len(), steps);
                assert!(timesteps.windows(2).all(|pair| pair[0] > pair[1]), "{spacing:?} {steps}: {timesteps:?}");
                assert!(timesteps.iter().all(|timestep| (0..100).contains(timestep)));
                let mut x = [0.5, -3.0];
                for (at, timestep) in timesteps.iter().enumerate() {
                    assert_eq!(scheduler.wants_noise(at), kind == SchedulerKind::Ddpm && *timestep > 0);
                    scheduler.step(at, &mut x, &[0.1, -0.2], Some(&[1.0, -1.0]));
                }
                assert!(x.iter().all(|x| x.is_finite()), "{spacing:?} {kind:?} {steps}");
            }
        }
    }
}
