//! Which samples are the steps of an observation: `state` of three steps, of the ticks k - 6, k - 3 and k; `grip`, of the
//! same modality, of the ticks k - 2, k - 1 and k.

use serde_json::{Value, json};

use super::*;
use crate::policy::bundle::example;

const PERIOD: Duration = Duration::from_millis(100);
const ARM: PhysicalMask = PhysicalMask(0b1);

fn bundle(changes: impl FnOnce(&mut Value)) -> Bundle {
    let mut policy: Value = serde_json::from_str(example::POLICY).unwrap();
    let vector = |key: &str| {
        json!({"key": key, "kind": "vector", "modality": "arm", "required": true, "shape": [1],
               "normalization": {"mode": "identity"}})
    };
    let mut state = vector("state");
    state["down_sample_steps"] = 3.into();
    policy["observations"] = json!([state, vector("grip")]);
    policy["n_obs_steps"] = 3.into();
    (policy["mask_aware"], policy["mask"]) = (false.into(), Value::Null);
    changes(&mut policy);
    Bundle::parse(&policy.to_string(), "policy.json").unwrap_or_else(|errors| panic!("{errors}"))
}

/// An arm of which `depth` samples are kept.
fn observer(bundle: &Bundle, depth: usize) -> Observer {
    let text = format!(
        "[device.arm]\nvid = \"1\"\npid = \"3\"\nnode = \"serial\"\ndepth = {depth}\n[device.arm.tty]\nchannels = 1\n"
    );
    let registry = Registry::parse(&text, None).unwrap_or_else(|errors| panic!("{errors}")).registry;
    Observer::new(bundle, &registry)
}

fn at(tick: u64) -> Stamp {
    Stamp(1_000_000_000).after(PERIOD * u32::try_from(tick).unwrap())
}

/// Sample `seq`, `before` a tick; its payload is its number.
fn push(observer: &mut Observer, tick: u64, before: Duration, seq: u64, epoch: u32) {
    let captured = at(tick).0 - u64::try_from(before.as_nanos()).unwrap();
    let header = SampleHeader { seq, capture_ns: captured, recv_ns: captured, epoch, ..SampleHeader::default() };
    let id = observer.lanes[0].id.unwrap();
    observer.push(id, &header, &seq.to_le_bytes());
}

/// The numbers of the samples of each step of an observation; none if it is absent.
fn steps(observer: &Observer, bundle: &Bundle, tick: u64) -> [Vec<u64>; 2] {
    let mut request = Request::new(bundle);
    (request.tick, request.stamp) = (tick, at(tick));
    observer.fill(&mut request);
    [0, 1].map(|observation| {
        let step = |step| {
            let cell = request.cell(observation, step)?;
            assert_eq!(cell.bytes, cell.seq.to_le_bytes(), "the bytes of another sample");
            Some(cell.seq)
        };
        if !request.is_present(observation) {
            return Vec::new();
        }
        (0..request.steps(observation)).filter_map(step).collect()
    })
}

#[test]
fn steps_are_as_many_ticks_apart_as_each_observation_says() {
    let bundle = bundle(|_| {});
    // A sample a tick, of which few are kept; ten a tick, of which not even those of one tick are; one in four ticks.
    for (depth, samples) in [(60, 1), (2, 10)] {
        let mut observer = observer(&bundle, depth);
        for tick in 0..40_u64 {
            for sample in 0..samples {
                let before = Duration::from_millis(5) + PERIOD.mul_f64((samples - 1 - sample) as f64 / samples as f64);
                push(&mut observer, tick, before, tick * samples + sample, 1);
            }
            assert!(observer.look(tick, at(tick), at(tick), ARM).is_some());
            let newest = |back: u64| tick.saturating_sub(back) * samples + samples - 1;
            let [apart, together] = steps(&observer, &bundle, tick);
            // At the beginning there is no earlier tick: the step has the sample of the next one.
            let has = |back: u64| if tick >= back { newest(back) } else { newest(tick / 3 * 3) };
            assert_eq!(apart, [has(6), has(3), has(0)], "{samples} a tick, tick {tick}");
            if samples == 1 {
                let has = |back: u64| newest(back.min(tick));
                assert_eq!(together, [has(2), has(1), has(0)], "tick {tick}");
            }
        }
    }
}

#[test]
fn a_sample_that_lasts_for_ticks_is_the_step_of_each() {
    let bundle = bundle(|_| {});
    let mut observer = observer(&bundle, 2);
    for tick in 0..40_u64 {
        if tick % 4 == 0 {
            push(&mut observer, tick, Duration::from_millis(5), tick, 1);
        }
        assert!(observer.look(tick, at(tick), at(tick), ARM).is_some());
        let [apart, together] = steps(&observer, &bundle, tick);
        if tick >= 6 {
            assert_eq!(apart, [6, 3, 0].map(|back| (tick - back) / 4 * 4), "tick {tick}");
            assert_eq!(together, [2, 1, 0].map(|back| (tick - back) / 4 * 4), "tick {tick}");
        }
    }
}

#[test]
fn after_a_replug_earlier_steps_show_the_first_new_sample() {
    let bundle = bundle(|_| {});
    let mut observer = observer(&bundle, 60);
    for tick in 0..30_u64 {
        let (is_there, epoch) = (!(10..14).contains(&tick), if tick < 12 { 1 } else { 2 });
        // A device counts its samples anew.
        let seq = if tick < 12 { tick } else { 100 + tick };
        if is_there {
            push(&mut observer, tick, Duration::from_millis(5), seq, epoch);
        }
        let mask = if is_there { ARM } else { PhysicalMask::EMPTY };
        assert_eq!(observer.look(tick, at(tick), at(tick), mask).is_some(), is_there);
        let [apart, _] = steps(&observer, &bundle, tick);
        let expected: &[u64] = match tick {
            10..14 => &[],
            // Of k - 3 and k - 6 those that were there; the others have the sample of the step after.
            14 | 15 => &[tick - 6, 100 + tick, 100 + tick],
            16 => &[116, 116, 116],
            17..20 => &[100 + tick - 3, 100 + tick - 3, 100 + tick],
            _ if tick >= 20 => &[100 + tick - 6, 100 + tick - 3, 100 + tick],
            _ => continue,
        };
        assert_eq!(apart, expected, "tick {tick}");
    }
}

#[test]
fn held_samples_stand_in_with_their_distance() {
    let bundle = bundle(|policy| {
        for observation in policy["observations"].as_array_mut().unwrap() {
            observation["required"] = false.into();
            observation["when_absent"] = json!({"hold_last_ms": 300});
        }
    });
    let mut observer = observer(&bundle, 2);
    for tick in 0..16_u64 {
        let mask = if tick < 10 { ARM } else { PhysicalMask::EMPTY };
        if tick < 10 {
            push(&mut observer, tick, Duration::from_millis(5), tick, 1);
        }
        observer.look(tick, at(tick), at(tick), mask);
        let [apart, _] = steps(&observer, &bundle, tick);
        match tick {
            9..=12 => assert_eq!(apart, [3, 6, 9], "tick {tick}"),
            13.. => assert!(apart.is_empty(), "tick {tick}"),
            _ => {}
        }
    }
}

#[test]
fn missed_ticks_count() {
    let bundle = bundle(|_| {});
    let mut observer = observer(&bundle, 60);
    // Tick 8 and 9 are missed.
    for tick in [0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 14, 15_u64] {
        push(&mut observer, tick, Duration::from_millis(5), tick, 1);
        observer.look(tick, at(tick), at(tick), ARM);
        let [apart, together] = steps(&observer, &bundle, tick);
        let known = |tick: u64| if (8..10).contains(&tick) { 7 } else { tick };
        if tick >= 6 {
            assert_eq!(apart, [6, 3, 0].map(|back| known(tick - back)), "tick {tick}");
            assert_eq!(together, [2, 1, 0].map(|back| known(tick - back)), "tick {tick}");
        }
    }
    // A long gap, and the numbers of another run after it.
    push(&mut observer, 90, Duration::from_millis(5), 90, 1);
    observer.look(90, at(90), at(90), ARM);
    assert_eq!(steps(&observer, &bundle, 90)[0], [15, 15, 90]);
    observer.clear();
    push(&mut observer, 91, Duration::from_millis(5), 91, 1);
    observer.look(0, at(91), at(91), ARM);
    assert_eq!(steps(&observer, &bundle, 91)[0], [91, 91, 91]);
}
