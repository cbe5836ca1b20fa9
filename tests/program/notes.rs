//! What people note about an episode: of any folder, with or without a run, and wherever the episode goes.

use std::path::Path;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::Place;

/// Runs `rapid WORDS` in this place; its output, or its error.
fn ask(place: &Place, words: &[&str]) -> Result<String, String> {
    let output = place.run(words);
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim_end().to_owned();
    if output.status.success() { Ok(text(&output.stdout)) } else { Err(text(&output.stderr)) }
}

/// What `rapid list` says about this file.
fn listed(place: &Place, file: &str) -> Value {
    let row = ask(place, &["list", "--json", file]).expect("a row");
    serde_json::from_str(&row).unwrap_or_else(|error| panic!("{error}: {row}"))
}

/// Records an episode as a run does that keeps no session; its path.
fn record(place: &Place) -> String {
    let before = place.episodes("out");
    place.run(&["--sim", "--headless", "--record", "--out", "out", "--duration", "600ms"]);
    let new = place.episodes("out").into_iter().find(|name| !before.contains(name));
    format!("out/{}", new.expect("an episode"))
}

fn copy(place: &Place, from: &str, to: &str) {
    std::fs::copy(place.path(from), place.path(to)).expect("a copy");
}

#[test]
fn an_episode_without_a_session_is_labelled_and_it_goes_where_the_file_goes() {
    let place = Place::lenient();
    let file = record(&place);
    assert_eq!(place.files("out").len(), 1, "no session");
    let answer = ask(&place, &["label", &file, "failure", "it slipped"]).expect("a label");
    assert!(answer.ends_with(".mcap: failure"), "{answer}");
    let answer = ask(&place, &["label", &file, "--note", "new pads", "--json"]).expect("a note");
    assert!(answer.contains(r#""event":"answer""#) && answer.contains("noted"), "{answer}");
    ask(&place, &["label", &file, "--mark", "250ms=grasped", "--mark", "100ms"]).expect("marks");
    let row = listed(&place, &file);
    let expected = (&"failure".into(), &"it slipped".into(), &"new pads".into());
    assert_eq!((&row["label"], &row["label_reason"], &row["note"]), expected, "{row}");
    let text = std::fs::read_to_string(place.path(&format!("{file}.toml"))).expect("the notes");
    let notes: toml::Table = text.parse().expect("TOML");
    let marks: Vec<_> = notes["marks"].as_array().expect("marks").iter().map(|mark| mark["at"].as_float()).collect();
    assert_eq!(marks, [Some(0.1), Some(0.25)]);
    // Selected, drawn, and copied with the file.
    assert_eq!(ask(&place, &["list", "out", "--label", "success"]).map(|text| text.lines().count()), Ok(1));
    ask(&place, &["inspect", &file, "--plot"]).expect("a picture");
    let picture = std::fs::read_to_string(place.path(&file).with_extension("svg")).expect("a picture");
    assert!(picture.contains("it slipped") && picture.contains("new pads"));
    std::fs::create_dir(place.path("copied")).expect("a folder");
    copy(&place, &file, "copied/a.mcap");
    copy(&place, &format!("{file}.toml"), "copied/a.mcap.toml");
    assert_eq!(listed(&place, "copied/a.mcap")["label"], "failure");
    // A truncated copy is repaired beside it, with what was noted.
    let whole = std::fs::read(place.path("copied/a.mcap")).expect("a file");
    std::fs::write(place.path("copied/a.mcap"), &whole[..whole.len() / 2]).expect("half of it");
    ask(&place, &["recover", "copied/a.mcap"]).expect("it is repaired");
    assert_eq!(listed(&place, "copied/a.recovered.mcap")["note"], "new pads");
    // What was given is taken away.
    ask(&place, &["label", &file, "none"]).expect("no label");
    ask(&place, &["label", &file, "--note", ""]).expect("no note");
    let row = listed(&place, &file);
    assert_eq!((&row["label"], row["note"].as_str().unwrap_or_default()), (&Value::Null, ""), "{row}");
}

#[test]
fn a_label_that_is_given_beside_a_run_is_in_its_session_and_follows_into_the_trash() {
    let place = Place::lenient();
    let run = || place.start(&["--sim", "--headless", "--out", "out", "--task", "pour"], "motor_state");
    let mut running = run();
    let mut files = Vec::new();
    for _ in 0..2 {
        let started = ask(&place, &["episode", "start"]).expect("it starts");
        ask(&place, &["episode", "stop"]).expect("it stops");
        files.push(started.split_once(' ').expect("a path").1.to_owned());
    }
    ask(&place, &["label", &files[0], "failure", "slipped"]).expect("a label");
    // The run changes only what it is asked to change.
    ask(&place, &["episode", "note", "pads", "--episode", files[0].rsplit('/').next().expect("a name")])
        .expect("a note");
    let row = listed(&place, &files[0]);
    assert_eq!((&row["label"], &row["note"]), (&"failure".into(), &"pads".into()), "{row}");
    ask(&place, &["label", &files[1], "success", "upright"]).expect("a label");
    ask(&place, &["episode", "discard"]).expect("it is discarded");
    assert!(!place.path(&format!("{}.toml", files[1])).exists());
    ask(&place, &["episode", "undo"]).expect("it comes back");
    assert_eq!(listed(&place, &files[1])["label"], "success");
    running.signal(Signal::KILL);
    drop(running);
    // The next run takes over what is beside the files.
    running = run();
    let status: Value = serde_json::from_str(&ask(&place, &["session", "--json"]).expect("a session")).expect("JSON");
    let labels: Vec<_> = (0..2).map(|at| status["episodes"][at]["label_reason"].clone()).collect();
    assert_eq!(labels, ["slipped", "upright"]);
    ask(&place, &["label", &files[1], "failure", "fell later"]).expect("a label");
    ask(&place, &["session", "end"]).expect("it ends");
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
    for ending in [".toml", ".md"] {
        let of_session = |name: &String| name.starts_with("session-") && name.ends_with(ending);
        let name = place.files("out").into_iter().find(of_session).expect("a file of the session");
        let text = std::fs::read_to_string(place.path("out").join(&name)).expect("text");
        assert!(text.contains("slipped") && text.contains("fell later"), "{text}");
    }
}

#[test]
fn what_cannot_be_noted_is_an_error_and_changes_nothing() {
    let place = Place::lenient();
    let file = record(&place);
    ask(&place, &["label", &file, "success"]).expect("a label");
    let beside = place.path(&format!("{file}.toml"));
    let before = std::fs::read_to_string(&beside).expect("the notes");
    let long = "x".repeat(2001);
    place.write("other.txt", "no episode");
    for (words, code, named) in [
        (&["label", "out/missing.mcap", "success"][..], 1, "missing.mcap: No such file"),
        (&["label", "out", "success"], 2, "out: not an episode"),
        (&["label", "other.txt", "success"], 2, "other.txt: not an episode"),
        (&["label", &file, "perhaps"], 2, "perhaps"),
        (&["label", &file, "failure", &long], 1, "longer than 2000 bytes"),
        (&["label", &file, "--note", &long], 1, "longer than 2000 bytes"),
        // All of it, or nothing.
        (
            &["label", &file, "failure", "--note", "x", "--mark", "1ms", "--mark", "1h=y"],
            2,
            "it has no moment at 3600 s",
        ),
        (&["label", &file, "--mark", "12"], 2, "12.5s"),
        (&["label", &file, "--mark", "40years"], 2, "no episode is that long"),
        (&["label", &file], 2, "nothing to note"),
    ] {
        let output = place.run(words);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(code) && error.contains(named), "{words:?}: {error}");
        assert_eq!(std::fs::read_to_string(&beside).expect("the notes"), before, "{words:?}");
    }
    // What is there and is not understood stays, and is named with its line.
    for (wrong, line) in [("label = \"success\"\nsurprise = 1\n", 2), ("[[marks]]\nat = inf\n", 2), ("note = [\n", 1)] {
        std::fs::write(&beside, wrong).expect("a file");
        let why = ask(&place, &["label", &file, "failure"]).expect_err("it is not replaced");
        let named = format!("{}.toml: line {line}: ", Path::new(&file).display());
        assert!(why.contains(&named), "{why}");
        assert_eq!(std::fs::read_to_string(&beside).expect("the notes"), wrong);
        let output = place.run(&["list", "out"]);
        let warning = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(warning.contains(&named), "{warning}");
    }
}
