//! A bundle of horizon 6, from index 1, 3 actions each; `cam` and `arm` required, `tip` not. The
//! action of index i in the chunk of tick o is `[100 o + i, 0.5]`.

use proptest::prelude::*;

use super::*;
use crate::example;

const HORIZON: u64 = 6;
const STEPS: u64 = 3;
const START: u64 = 1;
const ALL: PhysicalMask = PhysicalMask(0b111);
const NO_CAM: PhysicalMask = PhysicalMask(0b110);
const NO_TIP: PhysicalMask = PhysicalMask(0b101);
const FRESH: Situation = Situation { mask: ALL, observation_age: Some(Duration::from_millis(300)) };
const OLD: Situation = Situation { mask: ALL, observation_age: Some(Duration::from_millis(301)) };

fn seen(mask: PhysicalMask) -> Situation {
    Situation { mask, ..FRESH }
}

fn bundle() -> Bundle {
    let mut bundle = Bundle::parse(example::POLICY, "policy.json").unwrap();
    (bundle.horizon, bundle.n_action_steps, bundle.action_start) = (6, 3, 1);
    bundle.action.names.truncate(2);
    bundle.action.min = vec![0.0, 0.0];
    bundle.action.max = vec![1e6, 1.0];
    bundle
}

fn registry() -> Registry {
    let camera =
        |name, port| format!("[device.{name}]\nvid = \"1\"\npid = \"1\"\nport = \"{port}\"\nnode = \"camera\"\n");
    let text = camera("cam_wrist", "1-1") + &camera("tactile_tip", "1-2") + &camera("arm", "1-3");
    Registry::parse(&text, None).unwrap_or_else(|errors| panic!("{errors}")).registry
}

fn queue() -> ActionQueue {
    ActionQueue::new(&bundle(), &registry(), WithoutMask::Hold)
}

#[expect(clippy::cast_precision_loss, reason = "small numbers")]
fn chunk(observed: u64) -> Vec<f32> {
    (0..HORIZON).flat_map(|index| [(100 * observed + index) as f32, 0.5]).collect()
}

/// The first value of the action of `tick`, or why there is none.
fn at(queue: &mut ActionQueue, tick: u64, situation: Situation) -> Result<f32, HoldReason> {
    let step = queue.step(tick, situation);
    step.action.map(|action| action[0]).ok_or_else(|| step.hold.unwrap())
}

/// One tick in which each request is answered at once.
fn lockstep(queue: &mut ActionQueue, tick: u64, situation: Situation) -> Result<f32, HoldReason> {
    if queue.wants_observation(tick, situation) {
        queue.accept_chunk(tick, &chunk(tick)).unwrap();
    }
    at(queue, tick, situation)
}

#[test]
fn with_immediate_answers_every_chunk_is_executed_for_n_action_steps() {
    let mut queue = queue();
    let values: Vec<f32> = (0..7).map(|tick| lockstep(&mut queue, tick, FRESH).unwrap()).collect();
    assert_eq!(values, [1.0, 2.0, 3.0, 301.0, 302.0, 303.0, 601.0]);
    let counts = queue.counts();
    assert_eq!((counts.requests, counts.chunks, counts.actions, counts.holds, counts.late_chunks), (3, 3, 7, 0, 0));
}

#[test]
fn the_old_chunk_bridges_the_time_until_the_new_one_arrives() {
    let mut queue = queue();
    assert!(queue.wants_observation(0, FRESH));
    assert_eq!(at(&mut queue, 0, FRESH), Err(HoldReason::Waiting));
    assert_eq!(queue.accept_chunk(0, &chunk(0)), Ok(0), "one tick is what computing takes");
    assert!(!queue.wants_observation(1, FRESH));
    assert_eq!(at(&mut queue, 1, FRESH), Ok(2.0));
    assert_eq!(at(&mut queue, 2, FRESH), Ok(3.0));
    assert!(queue.wants_observation(3, FRESH));
    assert_eq!(at(&mut queue, 3, FRESH), Ok(4.0), "beyond n_action_steps");
    assert!(!queue.wants_observation(4, FRESH), "one is with the policy");
    assert_eq!(at(&mut queue, 4, FRESH), Ok(5.0));
    assert_eq!(queue.accept_chunk(3, &chunk(3)), Ok(1), "late, and used from the action of the tick");
    let step = queue.step(5, FRESH);
    assert_eq!((step.action, step.index, step.chunk_age_ticks), (Some(&[303.0, 0.5][..]), Some(3), Some(2)));
    let counts = queue.counts();
    assert_eq!((counts.late_chunks, counts.skipped_actions, counts.holds, counts.held_ticks), (1, 1, 1, 1));
}

#[test]
fn a_chunk_with_nan_or_infinity_is_dropped_whole() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut queue = queue();
        lockstep(&mut queue, 0, FRESH).unwrap();
        for tick in 1..=4 {
            if queue.wants_observation(tick, FRESH) {
                let mut values = chunk(tick);
                *values.last_mut().unwrap() = bad;
                assert_eq!(queue.accept_chunk(tick, &values), Err(ChunkError::NotFinite));
            }
            assert_eq!(at(&mut queue, tick, FRESH), Ok((1 + tick) as f32), "the old one continues");
        }
        assert_eq!(at(&mut queue, 5, FRESH), Err(HoldReason::Unusable), "as long as it lasts");
        assert_eq!(queue.counts().not_finite_chunks, 2, "asked again at the next tick");
        assert_eq!(lockstep(&mut queue, 6, FRESH), Ok(601.0));
    }
}

#[test]
fn a_chunk_of_another_length_or_tick_is_not_used() {
    let mut queue = queue();
    assert_eq!(queue.accept_chunk(0, &chunk(0)), Err(ChunkError::Unasked));
    assert!(queue.wants_observation(0, FRESH));
    assert_eq!(queue.accept_chunk(7, &chunk(7)), Err(ChunkError::Unasked));
    assert_eq!(queue.in_flight, Some(0));
    assert_eq!(queue.accept_chunk(0, &chunk(0)[1..]), Err(ChunkError::Length));
    assert_eq!(queue.in_flight, None);
    let counts = queue.counts();
    assert_eq!((counts.unasked_chunks, counts.wrong_length_chunks, counts.chunks), (2, 1, 0));
}

#[test]
fn a_failed_request_is_repeated() {
    let mut queue = queue();
    assert!(queue.wants_observation(0, FRESH));
    queue.failed(1);
    assert!(!queue.wants_observation(0, FRESH));
    queue.failed(0);
    assert_eq!(at(&mut queue, 0, FRESH), Err(HoldReason::Unusable));
    assert_eq!(lockstep(&mut queue, 1, FRESH), Ok(101.0));
    assert_eq!(queue.counts().failed_requests, 1);
}

#[test]
fn a_chunk_without_remaining_actions_is_dropped() {
    let mut queue = queue();
    assert!(queue.wants_observation(0, FRESH));
    for tick in 0..5 {
        assert_eq!(at(&mut queue, tick, FRESH), Err(HoldReason::Waiting));
    }
    assert_eq!(queue.accept_chunk(0, &chunk(0)), Err(ChunkError::Expired));
    assert_eq!(queue.counts().expired_chunks, 1);
    // With one tick less its last action would have been executed.
    let mut queue = self::queue();
    assert!(queue.wants_observation(0, FRESH));
    for tick in 0..4 {
        assert_eq!(at(&mut queue, tick, FRESH), Err(HoldReason::Waiting));
    }
    assert_eq!(queue.accept_chunk(0, &chunk(0)), Ok(3));
    assert_eq!(at(&mut queue, 4, FRESH), Ok(5.0));
    assert_eq!(queue.counts().skipped_actions, 3);
}

#[test]
fn values_beyond_the_limits_are_clamped_and_reported_once_a_chunk() {
    let mut queue = queue();
    for tick in [0, 3] {
        assert!(queue.wants_observation(tick, FRESH));
        let mut values = chunk(tick);
        values[3] = 1.5;
        values[4] = -7.0;
        queue.accept_chunk(tick, &values).unwrap();
        let step = queue.step(tick, FRESH);
        assert_eq!((step.action.unwrap()[1], step.clamped_is_news), (1.0, true));
        let step = queue.step(tick + 1, FRESH);
        assert_eq!((step.action, step.clamped_is_news), (Some(&[0.0, 0.5][..]), false));
        let step = queue.step(tick + 2, FRESH);
        assert_eq!((step.action.unwrap()[1], step.clamped_is_news), (0.5, false));
    }
    assert_eq!(queue.counts().clamped_actions, 4);
}

#[test]
fn a_chunk_without_poses_is_refused_and_counted() {
    let mut queue = queue();
    assert_eq!(lockstep(&mut queue, 0, FRESH), Ok(1.0));
    for tick in 1..3 {
        assert!(lockstep(&mut queue, tick, FRESH).is_ok());
    }
    assert!(queue.wants_observation(3, FRESH));
    assert_eq!(queue.refuse(2, ChunkError::NoBase), ChunkError::Unasked, "another request");
    assert_eq!(queue.refuse(3, ChunkError::NoRotation), ChunkError::NoRotation);
    assert_eq!(at(&mut queue, 3, FRESH), Ok(4.0), "the previous chunk continues");
    assert!(queue.wants_observation(4, FRESH), "at once again");
    assert_eq!(queue.refuse(4, ChunkError::NoBase), ChunkError::NoBase);
    assert_eq!((queue.counts().no_pose_chunks, queue.counts().unasked_chunks, queue.counts().chunks), (2, 1, 1));
    assert_eq!(at(&mut queue, 6, FRESH), Err(HoldReason::Unusable));
}

#[test]
fn an_old_observation_requests_no_chunk() {
    let mut queue = queue();
    lockstep(&mut queue, 0, FRESH).unwrap();
    for tick in 1..=4 {
        assert_eq!(lockstep(&mut queue, tick, OLD), Ok((1 + tick) as f32), "the current chunk continues");
    }
    assert_eq!(lockstep(&mut queue, 5, OLD), Err(HoldReason::ObservationOld));
    let none = Situation { observation_age: None, ..FRESH };
    assert_eq!(lockstep(&mut queue, 6, none), Err(HoldReason::ObservationOld));
    assert_eq!(queue.counts().old_observations, 4);
    assert_eq!(lockstep(&mut queue, 7, FRESH), Ok(701.0));
}

#[test]
fn without_a_required_modality_it_holds_at_once_and_drops_its_chunk() {
    let mut queue = queue();
    lockstep(&mut queue, 0, FRESH).unwrap();
    assert!(!queue.wants_observation(1, seen(NO_CAM)));
    let step = queue.step(1, seen(NO_CAM));
    assert_eq!((step.action, step.hold, step.missing), (None, Some(HoldReason::RequiredMissing), Some("cam_wrist")));
    assert!(step.hold_is_news);
    assert!(!queue.step(2, seen(NO_CAM)).hold_is_news);
    // It is back, and the chunk of tick 0 has actions for tick 3.
    assert!(queue.wants_observation(3, FRESH));
    assert_eq!(at(&mut queue, 3, FRESH), Err(HoldReason::Waiting));
    queue.accept_chunk(3, &chunk(3)).unwrap();
    assert_eq!(at(&mut queue, 4, FRESH), Ok(302.0));
    assert_eq!((queue.counts().holds, queue.counts().held_ticks), (1, 3));
}

#[test]
fn a_request_from_before_a_hold_is_not_executed_after_it() {
    let mut queue = queue();
    lockstep(&mut queue, 0, FRESH).unwrap();
    for tick in 1..3 {
        assert!(lockstep(&mut queue, tick, FRESH).is_ok());
    }
    assert!(queue.wants_observation(3, FRESH));
    assert!(at(&mut queue, 3, FRESH).is_ok());
    assert_eq!(at(&mut queue, 4, seen(NO_CAM)), Err(HoldReason::RequiredMissing));
    assert_eq!(queue.accept_chunk(3, &chunk(3)), Err(ChunkError::BeforeHold));
    assert_eq!(queue.counts().before_hold_chunks, 1);
    assert_eq!(lockstep(&mut queue, 5, FRESH), Ok(501.0));
}

#[test]
fn a_modality_that_leaves_during_a_wait_restarts_the_wait() {
    let mut queue = queue();
    assert!(queue.wants_observation(0, FRESH));
    assert_eq!(at(&mut queue, 0, FRESH), Err(HoldReason::Waiting));
    assert_eq!(at(&mut queue, 1, seen(NO_CAM)), Err(HoldReason::RequiredMissing));
    assert_eq!(at(&mut queue, 2, FRESH), Err(HoldReason::Waiting));
    assert_eq!(queue.accept_chunk(0, &chunk(0)), Err(ChunkError::BeforeHold));
    assert_eq!(lockstep(&mut queue, 3, FRESH), Ok(301.0));
}

#[test]
fn without_an_optional_modality_a_mask_aware_policy_continues() {
    let mut queue = queue();
    for tick in 0..10 {
        assert!(lockstep(&mut queue, tick, seen(NO_TIP)).is_ok());
    }
    assert_eq!(queue.counts().holds, 0);
}

#[test]
fn a_policy_that_is_not_mask_aware_holds_unless_configured_to_continue() {
    let unaware = Bundle { mask_aware: false, ..bundle() };
    let mut queue = ActionQueue::new(&unaware, &registry(), WithoutMask::Hold);
    lockstep(&mut queue, 0, FRESH).unwrap();
    let step = queue.step(1, seen(NO_TIP));
    assert_eq!((step.hold, step.missing), (Some(HoldReason::NotMaskAware), Some("tactile_tip")));
    assert_eq!(lockstep(&mut queue, 2, FRESH), Ok(201.0), "it is back");

    let mut queue = ActionQueue::new(&unaware, &registry(), WithoutMask::GoOn);
    assert_eq!(lockstep(&mut queue, 0, seen(NO_TIP)), Ok(1.0));
    assert_eq!(at(&mut queue, 1, seen(NO_CAM)), Err(HoldReason::RequiredMissing), "required all the same");
}

#[test]
fn the_highest_tick_numbers_cause_no_overflow() {
    let mut queue = queue();
    lockstep(&mut queue, 0, FRESH).unwrap();
    assert!(queue.wants_observation(u64::MAX, FRESH));
    assert_eq!(queue.accept_chunk(u64::MAX, &chunk(0)), Ok(0));
    assert_eq!(at(&mut queue, u64::MAX, FRESH), Ok(1.0));
    assert!(at(&mut queue, 0, FRESH).is_err(), "a tick before the chunk's observation");
}

#[derive(Debug, Clone, Copy)]
enum Event {
    Tick(Situation, u64),
    Answer(Answer),
}

#[derive(Debug, Clone, Copy)]
enum Answer {
    Good,
    Bad,
    Short,
    Never,
    Stranger(u64),
}

fn event() -> impl Strategy<Value = Event> {
    let situation = prop_oneof![
        6 => Just(FRESH), 1 => Just(OLD), 1 => Just(seen(NO_CAM)), 1 => Just(seen(NO_TIP)),
    ];
    let answer = prop_oneof![
        6 => Just(Answer::Good), 1 => Just(Answer::Bad), 1 => Just(Answer::Short), 1 => Just(Answer::Never),
        1 => (0_u64..60).prop_map(Answer::Stranger),
    ];
    prop_oneof![
        3 => (situation, prop_oneof![9 => Just(1_u64), 1 => 1_u64..9]).prop_map(|(s, by)| Event::Tick(s, by)),
        2 => answer.prop_map(Event::Answer),
    ]
}

proptest! {
    #[test]
    fn only_actions_of_the_tick_and_from_after_the_hold_are_ever_executed(
        aware in any::<bool>(),
        events in prop::collection::vec(event(), 1..120),
    ) {
        let bundle = Bundle { mask_aware: aware, ..bundle() };
        let mut queue = ActionQueue::new(&bundle, &registry(), WithoutMask::Hold);
        let (mut tick, mut asked) = (0, None);
        let mut held_from: Option<u64> = None;
        let mut holding = false;
        for event in events {
            match event {
                Event::Tick(situation, by) => {
                    tick += by;
                    if queue.wants_observation(tick, situation) {
                        prop_assert_eq!(asked, None, "at most one is in flight");
                        prop_assert_eq!(situation.observation_age, FRESH.observation_age);
                        asked = Some(tick);
                    }
                    let step = queue.step(tick, situation);
                    prop_assert_eq!(step.action.is_some(), step.hold.is_none());
                    let Some(action) = step.action else {
                        held_from = if holding { held_from } else { Some(tick) };
                        holding = true;
                        continue;
                    };
                    holding = false;
                    let (index, age) = (step.index.unwrap() as u64, step.chunk_age_ticks.unwrap());
                    let observed = tick - age;
                    prop_assert!(index < HORIZON);
                    prop_assert_eq!(index, START + tick - observed);
                    prop_assert_eq!(action, &[(100 * observed + index) as f32, 0.5][..]);
                    prop_assert!(held_from.is_none_or(|held| observed >= held), "{} of before {:?}", observed, held_from);
                    prop_assert!(situation.mask != NO_CAM && (aware || situation.mask == ALL));
                }
                Event::Answer(Answer::Stranger(observed)) => {
                    if asked != Some(observed) {
                        prop_assert_eq!(queue.accept_chunk(observed, &chunk(observed)), Err(ChunkError::Unasked));
                    }
                }
                Event::Answer(answer) => {
                    let Some(observed) = asked.take() else { continue };
                    match answer {
                        Answer::Good => _ = queue.accept_chunk(observed, &chunk(observed)),
                        Answer::Bad => {
                            let mut values = chunk(observed);
                            values[3] = f32::NAN;
                            prop_assert_eq!(queue.accept_chunk(observed, &values), Err(ChunkError::NotFinite));
                        }
                        Answer::Short => {
                            prop_assert_eq!(queue.accept_chunk(observed, &[0.0]), Err(ChunkError::Length));
                        }
                        Answer::Never | Answer::Stranger(_) => queue.failed(observed),
                    }
                }
            }
            prop_assert_eq!(queue.in_flight, asked);
        }
        prop_assert_eq!(bundle.n_action_steps as u64, STEPS);
    }
}

/// In training one of several pictures was always there: what the policy does without any is not in its training.
#[test]
fn without_any_picture_it_holds_and_without_one_of_two_it_continues() {
    const NO_PICTURE: PhysicalMask = PhysicalMask(0b100);
    let mut bundle = bundle();
    bundle.observations[0].required = false;
    let mut queue = ActionQueue::new(&bundle, &registry(), WithoutMask::Hold);
    assert_eq!(lockstep(&mut queue, 0, seen(NO_CAM)), Ok(1.0));
    assert_eq!(lockstep(&mut queue, 1, seen(NO_TIP)), Ok(101.0));
    assert!(!queue.wants_observation(2, seen(NO_PICTURE)));
    let step = queue.step(2, seen(NO_PICTURE));
    assert_eq!((step.hold, step.missing), (Some(HoldReason::NoPicture), Some("cam_wrist")));
    assert_eq!(lockstep(&mut queue, 3, seen(NO_CAM)), Ok(301.0));
    let mut queue = ActionQueue::new(&bundle, &registry(), WithoutMask::GoOn);
    assert_eq!(lockstep(&mut queue, 0, seen(NO_PICTURE)), Ok(1.0));
}

/// Of one camera that is observed twice, a history is not a second picture.
#[test]
fn a_history_is_no_picture_besides_those_of_its_modality() {
    const ARM_ALONE: PhysicalMask = PhysicalMask(0b100);
    let text = include_str!("../../../tests/bundle/valid/history.json");
    let mut with_history = bundle();
    with_history.observations = Bundle::parse(text, "policy.json").unwrap().observations;
    // The wrist's camera is left out: the tactile sensor, its history, the arm.
    with_history.observations.remove(0);
    for at_first in [false, true] {
        if at_first {
            with_history.observations.swap(0, 1);
        }
        let mut queue = ActionQueue::new(&with_history, &registry(), WithoutMask::Hold);
        assert_eq!(lockstep(&mut queue, 0, seen(ARM_ALONE)), Ok(1.0));
    }
    // With the camera there are two pictures, one of them a history alone: only what is there now counts.
    let mut with_history = bundle();
    with_history.observations = Bundle::parse(text, "policy.json").unwrap().observations;
    with_history.observations[0].required = false;
    with_history.observations.remove(1);
    let mut queue = ActionQueue::new(&with_history, &registry(), WithoutMask::Hold);
    assert_eq!(lockstep(&mut queue, 0, seen(NO_CAM)), Ok(1.0));
    assert_eq!(lockstep(&mut queue, 1, seen(ARM_ALONE)), Err(HoldReason::NoPicture));
}
