//! `rapid --sim task --expert --record`: what it reports of demonstrations is what their files hold.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]
#![allow(clippy::case_sensitive_file_extension_comparisons, reason = "names that rapid itself writes")]

use std::process::Output;
use std::time::Duration;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::{Episode, Place, events, until};

const EXPERT: [&str; 5] = ["--sim", "task", "--expert", "--record", "--out"];
/// Between two steps of the task.
const STEP: Duration = Duration::from_millis(100);

fn errors(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A tag of an episode.
fn tag(episode: &Episode, key: &str) -> String {
    let tags: Value = serde_json::from_str(episode.value("rapid", "tags")).expect("JSON");
    tags[key].as_str().unwrap_or_else(|| panic!("no {key}: {tags}")).to_owned()
}

fn read(place: &Place, folder: &str) -> Vec<Episode> {
    place.episodes(folder).iter().map(|file| Episode::read(&place.path(folder).join(file))).collect()
}

#[test]
fn the_summary_counts_what_is_in_the_files() {
    let place = Place::new();
    let output = place.run(&[&EXPERT[..], &["out", "--episodes", "3", "--seed", "1000"]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", errors(&output));
    let episodes = read(&place, "out");
    assert_eq!(episodes.len(), 3);
    let triangular = episodes.iter().filter(|episode| tag(episode, "texture") == "triangular").count();
    let good = episodes.iter().filter(|episode| episode.value("rapid/summary", "verdict") == "GOOD").count();
    let steps: usize = episodes.iter().map(|episode| episode.topic("/action").count()).sum();
    let seconds = STEP.as_millis() as usize * steps / 1000;
    let expected = format!(
        "3 demonstrations in out: {triangular} triangular, {} hexagonal, {good} GOOD; {steps} steps, {:02}:{:02} of robot time",
        3 - triangular,
        seconds / 60,
        seconds % 60
    );
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.starts_with(&expected), "{text}, by the files: {expected}");
    assert!(steps > 100 && good == 3, "{text}");
}

#[test]
fn each_line_of_json_is_about_its_file() {
    let place = Place::new();
    let output = place
        .run(&[&EXPERT[..], &["out", "--json", "--episodes", "2", "--seed", "1000", "--task", "sort it"]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", errors(&output));
    let lines = events(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(lines.len(), 2);
    let mut seeds = Vec::new();
    for line in &lines {
        let file = line["file"].as_str().expect("a name");
        let episode = Episode::read(&place.path(file));
        assert_eq!(line["event"], "demonstration");
        assert_eq!(line["steps"], episode.topic("/action").count(), "{line}");
        assert_eq!(
            (line["texture"].as_str(), line["size"].as_str()),
            (Some(&*tag(&episode, "texture")), Some(&*tag(&episode, "size")))
        );
        assert_eq!(line["seed"].as_u64().expect("a number").to_string(), tag(&episode, "seed"));
        assert_eq!(episode.value("rapid", "task"), "sort it");
        seeds.push(line["seed"].as_u64());
        // A second look at it comes to the same verdict.
        let again = place.run(&["inspect", "--json", file]);
        let again: Value = serde_json::from_slice(&again.stdout).expect("an object");
        assert_eq!(again["verdict"], line["verdict"], "{again}");
        // At each step the arm is asked to go somewhere, at the time of the step.
        let times: Vec<u64> = episode.topic("/action").map(|action| action.log_time).collect();
        assert!(times.windows(2).all(|pair| u128::from(pair[1] - pair[0]) == STEP.as_nanos()), "{times:?}");
    }
    assert!(seeds[0] >= Some(1000) && seeds[1] > seeds[0], "{seeds:?}");
    assert_eq!(place.episodes("out").len(), 2);
}

#[test]
fn demonstrations_are_added_to_those_of_a_folder_and_an_interrupt_ends_between_two() {
    let place = Place::new();
    let one = place.run(&[&EXPERT[..], &["out", "--seed", "1000"]].concat());
    assert_eq!(one.status.code(), Some(0), "{}", errors(&one));
    let before = std::fs::read(place.path("out").join(&place.episodes("out")[0])).expect("the first");
    let running = place
        .start(&[&EXPERT[..], &["out", "--json", "--episodes", "100000", "--seed", "2000"]].concat(), "demonstration");
    until("three of them", || running.reported().len() >= 3);
    running.signal(Signal::INT);
    let (code, output, _) = running.end();
    let reported = events(&output);
    assert_eq!(code, Some(0), "{output}");
    // Each file is whole, and was reported.
    let files = place.episodes("out");
    assert!(files.len() == 1 + reported.len() && files.iter().all(|file| file.ends_with(".mcap")), "{files:?}");
    for episode in read(&place, "out") {
        assert!(episode.topic("/action").count() > 0);
        assert_eq!(episode.value("rapid/summary", "verdict"), "GOOD");
    }
    assert_eq!(std::fs::read(place.path("out").join(&files[0])).expect("the first"), before);
}

#[test]
fn what_cannot_be_demonstrated_is_refused_and_writes_nothing() {
    let place = Place::new();
    place.write("file", "mine");
    for (arguments, words) in [
        (
            vec!["--sim", "task", "--expert", "--record", "--out", "file"],
            "file: not a folder; choose another with --out",
        ),
        (vec!["--sim", "task", "--expert", "--record", "--out", "none/of/these"], "none/of"),
        (vec!["--sim", "task", "--expert", "--out", "out"], "--record"),
        (vec!["--sim", "--expert", "--record", "--out", "out"], "--sim task --expert --record"),
        (vec!["--sim", "task", "--expert", "--record", "--infer", "--out", "out"], "--infer"),
        (vec!["--sim", "task", "--record", "--episodes", "2", "--out", "out"], "--expert"),
        (vec!["--sim", "task", "--expert", "--record", "--episodes", "some", "--out", "out"], "some"),
        (vec!["--sim", "task", "--expert", "--record", "--tag", "finger", "--out", "out"], "finger"),
    ] {
        let output = place.run(&arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", errors(&output));
        assert!(errors(&output).starts_with("error: ") && errors(&output).contains(words), "{}", errors(&output));
        assert!(output.stdout.is_empty() && !place.path("out").exists(), "{arguments:?}");
    }
    assert_eq!(std::fs::read_to_string(place.path("file")).expect("the file"), "mine");
}
