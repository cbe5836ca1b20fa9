//! `rapid replay FILE --infer`: a policy beside an episode, with figures that can be computed from the file.
//!
//! The policies are made by hand and always want the same action, whatever they see and whatever noise they begin with.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::path::Path;
use std::process::Output;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::onnx::{Change, write_bundle};
use crate::support::{self, Episode, Place, events};

/// What the policy wants: numbers that floats hold exactly.
const WANTED: [f64; 4] = [0.125, -0.25, 0.5, 0.75];
/// How far what a graph computes with 32 bits may be from it.
const ROUNDING: f64 = 1e-6;

/// A bundle in `place` that wants `wanted`: the spread of its actions is nothing beside that.
fn constant(place: &Place, name: &str, wanted: [f64; 4]) -> String {
    const GIVEN: &str = r#""normalization": [{"slice": [0, 3], "mode": "min_max", "min": [-1, 0, 2], "max": [1, 4, 3]},
                      {"slice": [3, 4], "mode": "mean_std", "mean": [0.5], "std": [0.25]}]"#;
    let spread = [1e-12; 4];
    let own =
        format!(r#""normalization": [{{"slice": [0, 4], "mode": "mean_std", "mean": {wanted:?}, "std": {spread:?}}}]"#);
    let folder = place.path(name);
    write_bundle(&folder, &[Change { what: GIVEN, with: &own }, Change { what: "by-hand", with: name }]);
    folder.display().to_string()
}

/// A demonstration of the simulated task, with its path.
fn demonstration(place: &Place) -> String {
    let run = place.run(&["--sim", "task", "--expert", "--record", "--seed", "1000", "--out", "shown"]);
    assert_eq!(run.status.code(), Some(0), "{}", String::from_utf8_lossy(&run.stderr));
    format!("shown/{}", place.episodes("shown")[0])
}

/// The comparison that was printed; an error may follow.
fn compared(output: &Output) -> Value {
    let printed = events(&String::from_utf8_lossy(&output.stdout));
    printed.into_iter().next().unwrap_or_else(|| panic!("nothing was compared: {}", errors(output)))
}

fn errors(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The recorded actions with their ticks, read without any of the program's code.
fn actions(file: &Path) -> Vec<(u64, [f64; 4])> {
    let episode = Episode::read(file);
    let numbers = |payload: &[u8]| -> [f64; 4] {
        let (numbers, _) = payload.as_chunks::<8>();
        let numbers: Vec<f64> = numbers.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
        numbers.try_into().expect("four axes")
    };
    episode.topic("/action").map(|action| (action.sequence.into(), numbers(&action.payload()))).collect()
}

/// The distances from `wanted` on an axis: their mean, the largest, and its tick.
fn distances(actions: &[(u64, [f64; 4])], wanted: [f64; 4], axis: usize) -> (f64, f64, u64) {
    let all: Vec<(u64, f64)> =
        actions.iter().map(|(tick, action)| (*tick, (action[axis] - wanted[axis]).abs())).collect();
    let mean = all.iter().map(|(_, distance)| distance).sum::<f64>() / all.len() as f64;
    let (tick, largest) = all.into_iter().max_by(|(_, a), (_, b)| a.total_cmp(b)).expect("an action");
    (mean, largest, tick)
}

fn assert_near(found: &Value, expected: f64, what: &str) {
    let found = found.as_f64().unwrap_or_else(|| panic!("{what}: {found}"));
    assert!((found - expected).abs() < ROUNDING, "{what}: {found}, by the file {expected}");
}

#[test]
fn a_demonstration_is_compared_tick_by_tick_and_each_figure_is_that_of_the_file() {
    let place = Place::new();
    let (file, bundle) = (demonstration(&place), constant(&place, "still", WANTED));
    let output = place.run(&["--json", "replay", &file, "--infer", &bundle]);
    assert_eq!(output.status.code(), Some(0), "{}", errors(&output));
    let found = compared(&output);
    let actions = actions(&place.path(&file));
    assert_eq!(
        (&found["event"], &found["kind"], &found["policy"]),
        (&"comparison".into(), &"beside".into(), &"still".into())
    );
    assert_eq!(
        (&found["damage"], &found["interrupted"], &found["recorded_policy"]),
        (&Value::Null, &false.into(), &Value::Null)
    );
    for count in ["ticks", "recorded", "compared"] {
        assert_eq!(found[count], actions.len(), "{count}: {found}");
    }
    let mut means = 0.0;
    for (axis, name) in ["x", "y", "z", "grip"].into_iter().enumerate() {
        let (mean, largest, tick) = distances(&actions, WANTED, axis);
        let shown = &found["difference"]["axes"][axis];
        assert_eq!((&shown["name"], &shown["values"]), (&name.into(), &actions.len().into()), "{found}");
        assert_near(&shown["mean"], mean, name);
        assert_near(&shown["largest"], largest, name);
        // Of several that are as far away any may be named.
        let at = shown["at_tick"].as_u64().expect("a tick");
        let (_, action) = actions.iter().find(|(tick, _)| *tick == at).expect("a tick of the file");
        assert_near(
            &shown["largest"],
            (action[axis] - WANTED[axis]).abs(),
            &format!("{name} at {at}, by the file {tick}"),
        );
        means += mean;
    }
    assert_near(&found["difference"]["mean"], means / 4.0, "all axes");

    // As a table, the same.
    let output = place.run(&["replay", &file, "--infer", &bundle]);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let (mean, largest, _) = distances(&actions, WANTED, 3);
    let row = text.lines().find(|line| line.starts_with("grip ")).unwrap_or_else(|| panic!("no row: {text}"));
    let numbers: Vec<&str> = row.split_whitespace().collect();
    assert_eq!(numbers[2..4], [format!("{mean:.4}"), format!("{largest:.4}")], "{text}");

    // It was not a policy that acted: nothing is computed again, and no tolerance can be met.
    let output = place.run(&["replay", &file, "--infer", &bundle, "--tolerance", "100"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(errors(&output).contains("no policy recorded it"), "{}", errors(&output));
}

#[test]
fn chunks_of_another_policy_differ_by_what_it_wants_more() {
    /// What the other one wants more on the first axis.
    const MORE: f64 = 0.25;
    let place = Place::new();
    let bundle = constant(&place, "still", WANTED);
    let mut other = WANTED;
    other[0] += MORE;
    let other = constant(&place, "other", other);
    let arguments = ["--json", "--infer", &bundle, "--sim", "task", "--record", "--out", "out"];
    let mut running = place.start(&arguments, "\"event\":\"recording\"");
    running.wait_for("\"event\":\"act\"");
    let chunks = |running: &support::Running| running.reported().iter().filter(|line| line["event"] == "chunk").count();
    support::until("three chunks", || chunks(&running) >= 3);
    running.signal(Signal::INT);
    let (code, printed, stderr) = running.end();
    assert_eq!(code, support::recorded_code(&printed), "{stderr}");
    let file = format!("out/{}", place.episodes("out")[0]);
    let file = file.as_str();
    let recorded = actions(&place.path(file));
    assert!(!recorded.is_empty());

    for (bundle, tolerance, more, code) in
        [(&bundle, "1e-5", 0.0, 0), (&other, "0.26", MORE, 0), (&other, "0.24", MORE, 1), (&other, "1e-5", MORE, 1)]
    {
        let output = place.run(&["--json", "replay", file, "--infer", bundle, "--tolerance", tolerance]);
        assert_eq!(output.status.code(), Some(code), "{tolerance}: {}", errors(&output));
        assert_eq!(errors(&output).contains("more than --tolerance"), code == 1, "{}", errors(&output));
        let found = compared(&output);
        assert_eq!(
            (&found["kind"], &found["recorded_policy"], &found["within"]),
            (&"again".into(), &"still".into(), &(code == 0).into())
        );
        assert!(found["compared"].as_u64() > Some(0), "{found}");
        assert_eq!(found["policy_hash"] == found["recorded_policy_hash"], more == 0.0, "{found}");
        for (axis, expected) in [more, 0.0, 0.0, 0.0].into_iter().enumerate() {
            // The mean too: each action of it differs so.
            let shown = &found["difference"]["axes"][axis];
            assert_near(&shown["largest"], expected, "the largest");
            assert_near(&shown["mean"], expected, "the mean");
        }
    }
    let output = place.run(&["replay", file, "--infer", &other]);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("another policy: the bundle differs from that of the recording"), "{text}");
}

#[test]
fn of_a_damaged_episode_the_part_that_can_be_read_is_compared() {
    let place = Place::new();
    let (file, bundle) = (demonstration(&place), constant(&place, "still", WANTED));
    let bytes = std::fs::read(place.path(&file)).expect("the episode");
    std::fs::write(place.path("half.mcap"), &bytes[..bytes.len() / 2]).expect("the half");
    let output = place.run(&["--json", "replay", "half.mcap", "--infer", &bundle]);
    assert_eq!(output.status.code(), Some(0), "{}", errors(&output));
    let found = compared(&output);
    assert_eq!(found["damage"], "the file ends within a record; what could be read is used");
    let part = usize::try_from(found["compared"].as_u64().expect("a count")).expect("few");
    let actions = actions(&place.path(&file));
    assert!(part > 0 && part < actions.len(), "{part} of {}", actions.len());
    for axis in 0..4 {
        let (mean, largest, _) = distances(&actions[..part], WANTED, axis);
        assert_near(&found["difference"]["axes"][axis]["mean"], mean, "of the part");
        assert_near(&found["difference"]["axes"][axis]["largest"], largest, "of the part");
    }
}

#[test]
fn what_cannot_be_compared_is_refused_with_its_name_and_changes_nothing() {
    let place = Place::new();
    let bundle = constant(&place, "still", WANTED);
    let file = demonstration(&place);
    place.write("text.mcap", "no episode");
    let by_hand =
        place.run(&["--sim", "task", "--handheld", "--expert", "--record", "--seed", "1000", "--out", "hand"]);
    assert_eq!(by_hand.status.code(), Some(0), "{}", errors(&by_hand));
    let by_hand = format!("hand/{}", place.episodes("hand")[0]);
    for (arguments, words) in [
        (vec!["replay", "text.mcap", "--infer", &bundle], "text.mcap: not an MCAP file"),
        (vec!["replay", "nothing.mcap", "--infer", &bundle], "nothing.mcap: No such file or directory"),
        (vec!["replay", &file, "--infer", "shown"], "shown/policy.json"),
        (vec!["replay", &by_hand, "--infer", &bundle], "the policy does not suit the rig of this episode"),
        (vec!["replay", &file, "--tolerance", "1"], "--infer"),
        (vec!["replay", &file, "--infer", &bundle, "--tolerance", "some"], "write a number of 0 or more"),
        (vec!["replay", "--infer", &bundle], "<FILE>"),
    ] {
        let output = place.run(&arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", errors(&output));
        assert!(errors(&output).starts_with("error: ") && errors(&output).contains(words), "{}", errors(&output));
        assert!(output.stdout.is_empty(), "{arguments:?}");
    }
    assert_eq!((place.episodes("shown").len(), place.episodes("hand").len()), (1, 1));
}
