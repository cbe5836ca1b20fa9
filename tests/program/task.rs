//! The simulated task from the command line: demonstrations, and trials of the trained policy.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::sync::Arc;

use rapid_core::time::{Stamp, WallClock};
use rapid_episode::record::EpisodeRequest;
use rapid_episode::record::stepped::Stepped;
use rapid_registry::Registry;
use rapid_registry::scenario::Scenario;
use rapid_status::Board;

use crate::support::{self, Episode, Place, events};
use rapid::lockstep::timing::Timing;
use rapid::lockstep::{Lockstep, STEP};
use serde_json::Value;

/// The folder of the policy of the repository.
const BUNDLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/tactile-id");

fn printed(place: &Place, arguments: &[&str]) -> Vec<Value> {
    let output = place.run(&[&["--json"], arguments].concat());
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), support::recorded_code(&text), "{}", String::from_utf8_lossy(&output.stderr));
    events(&text)
}

/// Payloads of a topic.
fn payloads(episode: &Episode, topic: &str) -> Vec<Vec<u8>> {
    episode.topic(topic).map(support::Message::payload).collect()
}

#[test]
fn demonstrations_are_whole_episodes_and_the_same_seed_gives_the_same_one() {
    let place = Place::new();
    let record = |out: &str| {
        let demonstrate = ["--sim", "task", "--expert", "--record", "--episodes", "2", "--seed", "1000", "--out", out];
        printed(&place, &demonstrate)
    };
    let (first, second) = (record("a"), record("b"));
    let words = |printed: &[Value], key: &str| printed.iter().map(|one| one[key].clone()).collect::<Vec<_>>();
    assert_eq!(words(&first, "verdict"), ["GOOD", "GOOD"]);
    assert_eq!(words(&first, "seed"), words(&second, "seed"));
    let mut textures = words(&first, "texture");
    textures.sort_by_key(ToString::to_string);
    assert_eq!(textures, ["hexagonal", "triangular"], "one of each");

    let read = |folder: &str| {
        let files = place.files(folder);
        assert_eq!(files.len(), 2);
        Episode::read(&place.path(folder).join(&files[0]))
    };
    let (a, b) = (read("a"), read("b"));
    for topic in ["/rapid/camera/wrist", "/rapid/camera/tactile", "/rapid/serial/arm", "/action"] {
        assert!(!payloads(&a, topic).is_empty() && payloads(&a, topic) == payloads(&b, topic), "{topic}");
    }
    // Every tick has its samples, captured at that very moment, and the action that was taken on them.
    let frames = a.frames();
    let actions: Vec<u64> = a.topic("/action").map(|action| action.log_time).collect();
    assert_eq!(frames.iter().map(|(message, _)| message.log_time).collect::<Vec<_>>(), actions);
    for (message, frame) in &frames {
        assert_eq!(frame.mask, 0b111);
        assert!(frame.modalities.iter().all(|one| one.valid && one.age_ns.unwrap_or(0) == 0), "{}", message.log_time);
    }
}

#[test]
fn a_demonstration_by_hand_has_poses_and_no_action() {
    let place = Place::new();
    let hand = ["--sim", "task", "--handheld", "--expert", "--record", "--seed", "1000", "--out", "hand"];
    let arm = ["--sim", "task", "--expert", "--record", "--seed", "1000", "--out", "arm"];
    for demonstrate in [&hand[..], &arm] {
        assert_eq!(printed(&place, demonstrate)[0]["verdict"], "GOOD");
    }
    let read = |folder: &str| Episode::read(&place.path(folder).join(&place.files(folder)[0]));
    let (hand, arm) = (read("hand"), read("arm"));
    assert_eq!((hand.topic("/action").count(), hand.topic("/rapid/serial/arm").count()), (0, 0));
    assert!(hand.value("rapid", "configuration").contains("handheld_adapter"), "the module at the bottom");
    assert!(hand.value("rapid", "tags").contains("\"use\":\"handheld\""));
    // The same hand moves both: what the phone and the fingers report is the state of the arm.
    let numbers = |episode: &Episode, topic: &str| -> Vec<Vec<f64>> {
        let of = |payload: Vec<u8>| payload.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
        payloads(episode, topic).into_iter().map(of).collect()
    };
    let (phone, gripper) = (numbers(&hand, "/rapid/phone"), numbers(&hand, "/rapid/gripper"));
    let states = numbers(&arm, "/rapid/serial/arm");
    assert_eq!((phone.len(), gripper.len()), (states.len(), states.len()));
    for ((phone, gripper), state) in phone.iter().zip(&gripper).zip(&states) {
        assert_eq!([&phone[12..15], &gripper[..]].concat(), *state);
        assert_eq!((phone.len(), phone[15]), (16, 1.0));
    }
    assert_eq!(hand.topic("/rapid/phone/pose").count(), phone.len());
}

#[test]
fn a_live_trial_reports_where_the_block_went_and_the_next_one_begins() {
    let place = Place::new();
    let mut running = place.start(&["--sim", "task", "--infer", BUNDLE, "--json"], "\"event\":\"act\"");
    running.wait_for("the next block is on the table");
    let reported = running.reported();
    let ended = support::logged(&reported, "trial 0: ");
    assert!(ended[0].contains("the next block is on the table"), "{ended:?}");
    assert!(
        ["sorted: it is in the bin", "wrong bin", "neither bin"].iter().any(|end| ended[0].contains(end)),
        "{ended:?}"
    );
}

#[test]
fn seeds_of_the_training_are_not_evaluated_without_a_warning() {
    let place = Place::new();
    let warned = |seed: &str| {
        let output = place.run(&["eval", BUNDLE, "--trials", "1", "--condition", "full", "--seed", seed]);
        assert_eq!(output.status.code(), Some(0));
        String::from_utf8_lossy(&output.stderr).contains("this policy was trained on demonstrations with the seeds")
    };
    assert!(warned("1000") && !warned("50000"));
}

#[test]
fn the_policy_with_a_history_continues_after_the_unplug() {
    let place = Place::new();
    let bundle = concat!(env!("CARGO_MANIFEST_DIR"), "/models/tactile-id-memory");
    let shown = printed(&place, &["policy", "show", bundle, "--sim", "task"]);
    let observations = shown[0]["observations"].as_array().expect("observations");
    assert!(observations.iter().any(|one| one["history"]["steps"] == 20), "{shown:?}");
    let trials = printed(&place, &["eval", bundle, "--trials", "1", "--condition", "hot-unplug"]);
    let trial = trials.iter().find(|line| line["event"] == "trial").expect("a trial");
    assert_eq!((&trial["status"], &trial["failure"]), (&"degraded".into(), &Value::Null), "{trial}");
    assert!(trial["unplugged_at"].as_u64() > trial["touched_at"].as_u64(), "{trial}");
    assert!(["big", "small"].contains(&trial["size"].as_str().expect("a size")), "{trial}");
}

/// Whatever the phases of its sensors are, and wherever between two of their samples an episode begins.
#[test]
fn the_frames_of_the_rig_are_valid_whatever_the_phases_are() {
    let place = Place::new();
    let registry = Arc::new(Registry::task());
    for seed in 0..12 {
        let board = Arc::new(Board::new(&registry));
        let mut recorder = Stepped::new(Arc::clone(&registry), board, WallClock::now());
        let timings = Timing::draw(seed, &[true; 3]);
        let scenario = Scenario::task(&registry, seed);
        let mut rig = Lockstep::new(&registry, scenario, Stamp::now(), &timings).expect("a rig");
        for _ in 0..3 {
            rig.rest(&mut recorder).expect("a rest");
        }
        let out = place.path(&seed.to_string());
        std::fs::create_dir(&out).expect("folder");
        let request = EpisodeRequest { out, task: "phases".into(), ..EpisodeRequest::default() };
        recorder.begin(&request, rig.now()).expect("an episode");
        for _ in 0..30 {
            rig.step(0.0, &mut recorder).expect("a step");
            recorder.advance(rig.now());
        }
        let report = recorder.finish(rig.now()).expect("a report");
        let frames = Episode::read(&report.file).frames().into_iter().map(|(_, frame)| frame).collect::<Vec<_>>();
        assert_eq!(frames.len(), 30);
        // The sample before the first tick is not of the episode, nor that after the last one.
        for frame in &frames[1..29] {
            let valid = frame.modalities.iter().all(|one| one.valid);
            assert!(valid, "seed {seed}, frame {}: {timings:?}: {:?}", frame.index, frame.modalities);
        }
    }
    assert!(STEP.as_millis() == 100);
}

/// The same of a run in real time: at each tick a sample of every device lies in the window, however late it came.
#[test]
fn a_run_in_real_time_captures_a_sample_for_every_tick() {
    let place = Place::new();
    let window = Registry::task().rig.sync_window.as_nanos();
    for out in ["a", "b", "c"] {
        printed(&place, &["--sim", "task", "--headless", "--record", "--duration", "2s", "--out", out]);
        let episode = Episode::read(&place.path(out).join(&place.files(out)[0]));
        let frames = episode.frames();
        assert!(frames.len() >= 19, "{}", frames.len());
        for topic in ["/rapid/camera/wrist", "/rapid/camera/tactile", "/rapid/serial/arm"] {
            let captured: Vec<u64> = episode.topic(topic).map(|sample| sample.log_time).collect();
            // Where a busy machine lost some, and before the first and after the last one, no tick can have one.
            let pairs = captured.windows(2).filter(|pair| pair[1] - pair[0] < 150_000_000);
            let mut seen = 0;
            for pair in pairs {
                for (tick, _) in frames.iter().filter(|(tick, _)| (pair[0]..pair[1]).contains(&tick.log_time)) {
                    let nearest = (tick.log_time - pair[0]).min(pair[1] - tick.log_time);
                    assert!(u128::from(nearest) <= window, "{topic}: {nearest} ns");
                    seen += 1;
                }
            }
            assert!(seen > 0, "{topic}: {} samples", captured.len());
        }
    }
}

#[test]
fn trials_are_reproducible_and_a_fixed_set_of_sensors_ends_those_in_which_one_is_pulled() {
    let place = Place::new();
    let trials = |more: &[&str]| {
        let condition = ["--trials", "2", "--condition", "hot-unplug", "--condition", "hot-replug"];
        printed(&place, &[&["eval", BUNDLE], &condition[..], more].concat())
    };
    let dynamic = trials(&[]);
    assert_eq!(dynamic, trials(&[]));
    let rows: Vec<&Value> = dynamic.iter().filter(|row| row["event"] == "condition").collect();
    assert_eq!(rows.len(), 2);
    for row in rows {
        assert_eq!((&row["trials"], &row["crash"]), (&2.into(), &0.into()));
        let ends = ["success", "wrong_bin", "incomplete"].map(|end| row[end].as_u64().expect("a count"));
        assert_eq!(ends.iter().sum::<u64>(), 2);
    }
    // The sensor was missed: the policy was asked again, and acted at every tick but the first.
    for trial in dynamic.iter().filter(|row| row["event"] == "trial") {
        assert_eq!((&trial["counts"]["held_ticks"], &trial["failure"]), (&1.into(), &Value::Null), "{trial}");
        assert!(trial["unplugged_at"].is_u64());
    }
    let fixed = trials(&["--static-config"]);
    for row in fixed.iter().filter(|row| row["event"] == "condition") {
        assert_eq!((&row["crash"], &row["status"]), (&2.into(), &"crash".into()));
    }
    // The policy sees nothing leave: it is asked at every eighth tick, and at no other.
    for trial in fixed.iter().filter(|row| row["event"] == "trial") {
        let count = |key: &str| trial["counts"][key].as_u64().expect("a count");
        assert_eq!(count("requests"), (count("actions") + count("held_ticks")).div_ceil(8), "{trial}");
    }
}

#[test]
fn the_expert_supports_only_the_task_and_reports_it() {
    let place = Place::new();
    let refused = |arguments: &[&str]| {
        let output = place.run(arguments);
        assert_eq!(output.status.code(), Some(2));
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(refused(&["--sim", "--expert", "--record"]).contains("--sim task --expert --record"));
    assert!(refused(&["--sim", "task", "--expert"]).contains("--record"));
    assert!(refused(&["--sim", "task", "--expert", "--record", "--duration", "3s"]).contains("--duration"));
    assert!(refused(&["eval", BUNDLE, "--condition", "sometimes"]).contains("hot-unplug"));
}
