//! Which samples are the steps of an observation: `state` of three steps, of the ticks k - 6, k - 3 and k; `grip`, of the
//! same modality, of the ticks k - 2, k - 1 and k.

use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::example;

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
    let id = observer.buffers[0].id.unwrap();
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
            assert!(observer.observe(tick, at(tick), at(tick), ARM).is_some());
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
        assert!(observer.observe(tick, at(tick), at(tick), ARM).is_some());
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
        assert_eq!(observer.observe(tick, at(tick), at(tick), mask).is_some(), is_there);
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
        observer.observe(tick, at(tick), at(tick), mask);
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
        observer.observe(tick, at(tick), at(tick), ARM);
        let [apart, together] = steps(&observer, &bundle, tick);
        let known = |tick: u64| if (8..10).contains(&tick) { 7 } else { tick };
        if tick >= 6 {
            assert_eq!(apart, [6, 3, 0].map(|back| known(tick - back)), "tick {tick}");
            assert_eq!(together, [2, 1, 0].map(|back| known(tick - back)), "tick {tick}");
        }
    }
    // A long gap, and the numbers of another run after it.
    push(&mut observer, 90, Duration::from_millis(5), 90, 1);
    observer.observe(90, at(90), at(90), ARM);
    assert_eq!(steps(&observer, &bundle, 90)[0], [15, 15, 90]);
    observer.clear();
    push(&mut observer, 91, Duration::from_millis(5), 91, 1);
    observer.observe(0, at(91), at(91), ARM);
    assert_eq!(steps(&observer, &bundle, 91)[0], [91, 91, 91]);
}

/// `state`, the arm's newest sample among others, and `felt`, a history of its samples.
fn bundle_with_history(steps: usize, apart: usize) -> Bundle {
    bundle(|policy| {
        let mut state = policy["observations"][1].clone();
        state["required"] = false.into();
        let felt = json!({
            "key": "felt", "kind": "image", "modality": "arm", "required": false, "down_sample_steps": apart,
            "shape": [3, 8, 8], "color": "rgb", "resize": null, "crop": null, "operation": null,
            "history": {"steps": steps, "valid": "felt_valid"}, "normalization": {"mode": "identity"}});
        policy["observations"] = json!([state, felt]);
        policy["mask_aware"] = true.into();
        policy["mask"] = json!({"input": "mask", "order": ["arm"], "absent": "zero_embedding"});
    })
}

/// The numbers of the samples of `felt`, and that of the newest of `state`, as `request` has them at `tick`.
fn felt(observer: &Observer, request: &mut Request, tick: u64) -> (Vec<Option<u64>>, Option<u64>) {
    (request.tick, request.stamp) = (tick, at(tick));
    observer.fill(request);
    let number = |observation, step| {
        let sample = request.sample(observation, step)?;
        assert_eq!(sample.bytes, sample.seq.to_le_bytes(), "the bytes of another sample");
        Some(sample.seq)
    };
    ((0..request.steps(1)).map(|step| number(1, step)).collect(), number(0, request.steps(0) - 1))
}

#[test]
fn nothing_stands_in_for_a_step_of_a_history() {
    // A sample a tick, of which two are kept in the ring.
    for apart in [1, 3] {
        let bundle = bundle_with_history(4, apart);
        let mut observer = observer(&bundle, 2);
        let mut request = Request::new(&bundle);
        let is_there = |tick: u64| !(10..16).contains(&tick);
        for tick in 0..40_u64 {
            if is_there(tick) {
                push(&mut observer, tick, Duration::from_millis(5), 100 + tick, if tick < 10 { 1 } else { 2 });
            }
            let mask = if is_there(tick) { ARM } else { PhysicalMask::EMPTY };
            assert_eq!(observer.observe(tick, at(tick), at(tick), mask).is_some(), is_there(tick));
            let (felt, newest) = felt(&observer, &mut request, tick);
            let of = |back: u64| tick.checked_sub(back).filter(|tick| is_there(*tick)).map(|tick| 100 + tick);
            assert_eq!(felt, [3, 2, 1, 0].map(|back| of(back * apart as u64)), "tick {tick}, {apart} apart");
            assert_eq!(newest, of(0), "tick {tick}");
            assert_eq!([request.is_present(0), request.is_present(1)], [is_there(tick); 2], "tick {tick}");
            // The steps before the unplug are shown until they are older than the history.
            assert_eq!(request.has_samples(1), felt.iter().any(Option::is_some), "tick {tick}");
            let seqs: Vec<_> = request.samples(&bundle).into_iter().map(|samples| samples.seqs).collect();
            assert_eq!(seqs[1], felt, "what is recorded");
            assert_eq!(seqs[0].is_empty(), !is_there(tick), "what is recorded");
        }
    }
}

#[test]
fn a_history_begins_with_the_run_and_a_missed_tick_has_the_choice_before_it() {
    let bundle = bundle_with_history(3, 2);
    let mut observer = observer(&bundle, 60);
    let mut request = Request::new(&bundle);
    // Present, but without a sample.
    assert!(observer.observe(0, at(0), at(0), ARM).is_none());
    assert_eq!(felt(&observer, &mut request, 0), (vec![None; 3], None));
    for (tick, expected) in [
        (1, [None, None, Some(1)]),
        (2, [None, None, Some(2)]),
        (3, [None, Some(1), Some(3)]),
        // Of tick 4, 5 and 6, which are missed, with the choice of tick 3.
        (7, [Some(3), Some(3), Some(7)]),
        (8, [Some(3), Some(3), Some(8)]),
        (9, [Some(3), Some(7), Some(9)]),
        // More of them than the history has.
        (30, [Some(9), Some(9), Some(30)]),
    ] {
        push(&mut observer, tick, Duration::from_millis(5), tick, 1);
        observer.observe(tick, at(tick), at(tick), ARM);
        assert_eq!(felt(&observer, &mut request, tick).0, expected, "tick {tick}");
    }
    observer.clear();
    push(&mut observer, 31, Duration::from_millis(5), 31, 1);
    observer.observe(0, at(31), at(31), ARM);
    assert_eq!(felt(&observer, &mut request, 31).0, [None, None, Some(31)], "of another run");
}

#[test]
fn a_history_is_not_held_and_counts_for_nothing_when_it_is_old() {
    let bundle = bundle_with_history(3, 2).holding_last(Some(Duration::from_mins(1)));
    let mut observer = observer(&bundle, 60);
    let mut request = Request::new(&bundle);
    assert_eq!(observer.first_sight(ARM), None);
    push(&mut observer, 0, Duration::from_millis(5), 7, 1);
    let age = observer.observe(0, at(0), at(0), ARM);
    assert!(age.is_some());
    // The arm has left: only `state` is held, and nothing that is present has an age.
    assert_eq!(observer.observe(2, at(2), at(2), PhysicalMask::EMPTY), None);
    assert_eq!(felt(&observer, &mut request, 2), (vec![None, Some(7), None], Some(7)));
    assert_eq!([request.is_present(0), request.is_present(1)], [true, false]);
    // Back, with a sample of now: the age is that of this one.
    push(&mut observer, 4, Duration::from_millis(5), 9, 2);
    assert_eq!(observer.observe(4, at(4), at(4), ARM), age);
    // Tick 2 was the last one that was looked at, tick 3 has its choice: none.
    assert_eq!(felt(&observer, &mut request, 4).0, [Some(7), None, Some(9)]);
}

proptest! {
    /// A step of a history is the newest step that an observation without one had at its tick, if it had any.
    #[test]
    fn a_history_is_what_was_newest_at_its_ticks(
        steps in 2_usize..9,
        apart in 1_usize..6,
        depth in 2_usize..6,
        // Ticks since the last one that was looked at, samples before it, and whether the arm is there.
        ticks in prop::collection::vec(
            (prop_oneof![8 => Just(1_u64), 1 => 2_u64..5, 1 => Just(60)], 0_u64..4, prop::bool::weighted(0.8)),
            1..150,
        ),
    ) {
        let bundle = bundle_with_history(steps, apart);
        let mut observer = observer(&bundle, depth);
        let mut request = Request::new(&bundle);
        let mut newest: Vec<Option<u64>> = Vec::new();
        let (mut seq, mut epoch, mut was_there) = (0, 0, false);
        for (since, samples, is_there) in ticks {
            let missed = usize::try_from(since).unwrap() - 1;
            let last = newest.last().copied();
            newest.extend(last.into_iter().cycle().take(missed));
            let tick = newest.len() as u64;
            epoch += u32::from(is_there && !was_there);
            was_there = is_there;
            for sample in (0..samples).filter(|_| is_there) {
                seq += 1;
                push(&mut observer, tick, Duration::from_millis(5 + 20 * (samples - 1 - sample)), seq, epoch);
            }
            let mask = if is_there { ARM } else { PhysicalMask::EMPTY };
            observer.observe(tick, at(tick), at(tick), mask);
            let (felt, now) = felt(&observer, &mut request, tick);
            newest.push(now);
            let of = |step: usize| newest.iter().rev().nth((steps - 1 - step) * apart).copied().flatten();
            prop_assert_eq!(felt, (0..steps).map(of).collect::<Vec<_>>(), "tick {}", tick);
        }
    }
}

/// Whatever is wrong with it, also if it is the first: the policy sees the whole one, and none before that.
#[test]
fn a_picture_that_is_not_usable_is_never_observed() {
    use rapid_core::sample::Encoding;
    use rapid_pictures::jpeg::{Values, encode};
    let encoded = |side: u16| {
        let pixels: Vec<u8> = (0..usize::from(side).pow(2)).map(|at| u8::try_from(at * at % 251).unwrap()).collect();
        let mut jpeg = Vec::new();
        encode(&pixels, [side, side], Values::Grey, 90, &mut jpeg).unwrap();
        jpeg
    };
    let whole = encoded(64);
    let lost = [&whole[..400], &whole[500..]].concat();
    let bundle = bundle(|_| {});
    for (name, payload, flags) in
        [("damaged inside", lost, 0), ("another size", encoded(32), 0), ("flagged", whole.clone(), FLAG_ERROR)]
    {
        let mut observer = observer(&bundle, 60);
        let id = observer.buffers[0].id.unwrap();
        let mut push = |tick: u64, payload: &[u8], flags| {
            let captured = at(tick).0 - 5_000_000;
            let encoding = Encoding::Mjpeg as u32;
            let header = SampleHeader {
                seq: tick,
                capture_ns: captured,
                recv_ns: captured,
                encoding,
                flags,
                ..SampleHeader::default()
            };
            observer.push(id, &header, payload);
            observer.observe(tick, at(tick), at(tick), ARM);
            let mut request = Request::new(&bundle);
            (request.tick, request.stamp) = (tick, at(tick));
            observer.fill(&mut request);
            request.cell(0, 2).filter(|_| request.is_present(0)).map(|cell| (cell.seq, cell.bytes.clone()))
        };
        // One of another size is known for one only beside others.
        if name != "another size" {
            assert_eq!(push(0, &payload, flags), None, "{name}, first");
        }
        assert_eq!(push(1, &whole, 0), Some((1, whole.clone())), "{name}");
        assert_eq!(push(2, &payload, flags), Some((1, whole.clone())), "{name}");
        assert_eq!(push(3, &whole, 0), Some((3, whole.clone())), "{name}");
    }
}
