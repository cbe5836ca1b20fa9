//! Sessions of one folder: each is its task's and its run's, whatever else is collected there, and whatever becomes of the
//! folder or of the disk.

use std::os::unix::fs::symlink;
use std::path::Path;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::{Place, Running, until};

/// Runs `rapid WORDS` in this place; its output, or its error.
fn ask(place: &Place, words: &[&str]) -> Result<String, String> {
    let output = place.run(words);
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim_end().to_owned();
    if output.status.success() { Ok(text(&output.stdout)) } else { Err(text(&output.stderr)) }
}

fn session(place: &Place) -> Value {
    serde_json::from_str(&ask(place, &["session", "--json"]).expect("a session")).expect("JSON")
}

/// What a session has of its episodes; not what its last answer was.
fn collected(place: &Place) -> [Value; 3] {
    let status = session(place);
    ["counted", "discarded", "episodes"].map(|key| status[key].clone())
}

fn run(place: &Place, task: &str) -> Running {
    place.start(&["--sim", "--headless", "--out", "out", "--task", task, "--episode-time", "700ms"], "motor_state")
}

fn end(running: Running) {
    running.signal(Signal::INT);
    let (code, output, error) = running.end();
    assert_eq!(code, Some(0), "{output}{error}");
}

/// Records an episode; the name of its file.
fn record(place: &Place) -> String {
    let started = ask(place, &["episode", "start"]).expect("it starts");
    ask(place, &["episode", "stop"]).expect("it stops");
    started.rsplit('/').next().expect("a name").to_owned()
}

/// Records two episodes with a label and a mark, the first of them long enough to count, and one that is discarded.
fn collect(place: &Place, reason: &str) -> [String; 3] {
    let started = ask(place, &["episode", "start"]).expect("it starts");
    let first = started.rsplit('/').next().expect("a name").to_owned();
    until("it ends", || session(place)["phase"]["phase"] == "idle");
    ask(place, &["episode", "label", "failure", reason]).expect("a label");
    ask(place, &["episode", "start"]).expect("it starts");
    ask(place, &["episode", "mark", reason]).expect("a mark");
    ask(place, &["episode", "stop"]).expect("it stops");
    let second = session(place)["episodes"].as_array().and_then(|all| all.last()?["file"].as_str().map(str::to_owned));
    let third = record(place);
    ask(place, &["episode", "discard"]).expect("it is discarded");
    [first, second.expect("a name"), third]
}

#[test]
fn switching_the_task_and_back_keeps_counts_labels_and_undo() {
    let place = Place::lenient();
    let mut running = run(&place, "pour");
    let poured = collect(&place, "spilled");
    let of_pour = collected(&place);
    assert_eq!(of_pour[..2], [Value::from(1), Value::from(1)], "{}", session(&place));
    end(running);
    running = run(&place, "stack");
    assert_eq!(session(&place)["episodes"], Value::Array(Vec::new()), "another task has another session");
    collect(&place, "fell");
    let of_stack = collected(&place);
    end(running);
    for _ in 0..2 {
        for (task, expected) in [("pour", &of_pour), ("stack", &of_stack)] {
            running = run(&place, task);
            assert_eq!(collected(&place), *expected, "{task}");
            end(running);
        }
    }
    running = run(&place, "pour");
    // Within a run too.
    ask(&place, &["session", "plan", "--task", "stack"]).expect("a plan");
    ask(&place, &["session", "plan", "--task", "pour"]).expect("a plan");
    assert_eq!(collected(&place), of_pour);
    ask(&place, &["episode", "label", "success", "--episode", &poured[1]]).expect("a label");
    let back = ask(&place, &["episode", "undo"]).expect("it comes back");
    assert!(back.contains(&poured[2]) && place.path("out").join(&poured[2]).exists(), "{back}");
    assert!(ask(&place, &["session", "end"]).is_ok_and(|text| text.contains("3 episodes kept")));
    end(running);
    running = run(&place, "stack");
    assert_eq!(collected(&place), of_stack, "what another session deletes is its own");
    ask(&place, &["episode", "undo"]).expect("it comes back");
    end(running);
}

#[test]
fn two_runs_in_one_folder_keep_what_is_each_ones() {
    let (place, mut other) = (Place::lenient(), Place::lenient());
    let first = run(&place, "pour");
    let of_first = collect(&place, "spilled");
    let before = collected(&place);
    std::fs::remove_dir_all(other.path("out")).ok();
    symlink(place.path("out"), other.path("out")).expect("a link of ours");
    let second = run(&other, "pour");
    let of_second = collect(&other, "fell");
    assert!(of_first.iter().all(|file| !of_second.contains(file)), "{of_first:?} {of_second:?}");
    assert_eq!(collected(&place), before, "the second run changed the first one's session");
    assert_eq!(collected(&other)[2].as_array().map(Vec::len), Some(3));
    ask(&other, &["session", "end"]).expect("it ends");
    assert_eq!(place.files("out/.trash"), [format!("{}.mcap", of_first[2].trim_end_matches(".mcap"))]);
    end(second);
    ask(&place, &["episode", "undo"]).expect("it comes back");
    assert!(place.path("out").join(&of_first[2]).exists());
    end(first);
    // What was noted in either is found.
    for (file, reason) in [(&of_first[0], "spilled"), (&of_second[0], "fell")] {
        let listed = ask(&place, &["list", "--json", &format!("out/{file}")]).expect("a list");
        assert!(listed.contains(reason), "{listed}");
    }
    other.instance = place.instance.clone();
}

#[test]
fn a_link_in_place_of_the_trash_is_not_followed() {
    let place = Place::lenient();
    let running = run(&place, "pour");
    let file = record(&place);
    std::fs::create_dir(place.path("elsewhere")).expect("a folder");
    symlink(place.path("elsewhere"), place.path("out/.trash")).expect("a link");
    for words in [&["episode", "discard"][..], &["episode", "discard", &file]] {
        let why = ask(&place, words).expect_err("it is not discarded");
        assert!(why.contains(&file) && why.contains(".trash") && why.contains("link"), "{why}");
        assert_eq!(session(&place)["discarded"], 0);
    }
    assert!(place.path("out").join(&file).exists() && place.files("elsewhere").is_empty());
    std::fs::remove_file(place.path("out/.trash")).expect("the link");
    ask(&place, &["episode", "discard"]).expect("it is discarded");
    // Nothing is deleted, and nothing comes back, through a link.
    std::fs::rename(place.path("out/.trash"), place.path("moved")).expect("a folder");
    symlink(place.path("moved"), place.path("out/.trash")).expect("a link");
    let why = ask(&place, &["episode", "undo"]).expect_err("it stays");
    assert!(why.contains(".trash") && why.contains("link"), "{why}");
    let why = ask(&place, &["session", "end"]).expect_err("its trash is not deleted");
    assert!(why.contains("the session is ended, but its trash is not deleted") && why.contains("link"), "{why}");
    assert_eq!(place.files("moved"), [file]);
    end(running);
}

#[test]
fn a_folder_that_is_moved_during_a_session_is_named_and_nothing_is_split() {
    let place = Place::lenient();
    let running = run(&place, "pour");
    let file = record(&place);
    let before = collected(&place);
    let (out, away) = (place.path("out"), place.path("away"));
    std::fs::rename(&out, &away).expect("it is moved");
    for words in
        [&["episode", "label", "success"][..], &["episode", "discard"], &["episode", "start"], &["session", "end"]]
    {
        let why = ask(&place, words).expect_err("the folder is elsewhere");
        assert!(why.contains(&*away.to_string_lossy()) && why.contains("move it back"), "{words:?}: {why}");
    }
    assert!(!out.exists(), "{:?}", place.files("out"));
    std::fs::rename(&away, &out).expect("it is moved back");
    assert_eq!(collected(&place), before);
    ask(&place, &["episode", "label", "success"]).expect("a label");
    // While an episode is recorded, all of it goes along.
    ask(&place, &["episode", "start"]).expect("it starts");
    std::fs::rename(&out, &away).expect("it is moved");
    ask(&place, &["episode", "stop"]).expect("it stops");
    assert!(!out.exists(), "{:?}", place.files("out"));
    assert_eq!(place.episodes("away").len(), 2);
    end(running);
    let journal = std::fs::read_to_string(away.join("session.toml")).expect("the journal");
    let journal: toml::Table = journal.parse().expect("TOML");
    let episodes = journal["episode"].as_array().expect("a list");
    assert!(episodes.len() == 2 && episodes.iter().all(|entry| entry.get("verdict").is_some()), "{journal}");
    assert_eq!(episodes[0]["file"].as_str(), Some(&*file));
}

/// Starts a run whose folders take no change while the file `full` is there.
fn run_with_full_disk(place: &Place, full: &Path) -> Running {
    let mut command =
        place.command(&["--sim", "--headless", "--out", "out", "--task", "pour", "--episode-time", "700ms"]);
    command.env("RAPID_FAULT", format!("disk:{}", full.display()));
    place.start_as(command, "motor_state")
}

#[test]
fn on_a_full_disk_each_order_fails_and_changes_nothing() {
    let place = Place::lenient();
    let full = place.path("full");
    let running = run_with_full_disk(&place, &full);
    let collected_before = {
        collect(&place, "spilled");
        collected(&place)
    };
    std::fs::write(&full, "").expect("a file");
    let orders: [&[&str]; 7] = [
        &["episode", "label", "success"],
        &["episode", "note", "pads"],
        &["episode", "note", ""],
        &["episode", "discard"],
        &["episode", "undo"],
        &["session", "plan", "--goal", "7"],
        &["session", "end"],
    ];
    for words in orders {
        let why = ask(&place, words).expect_err("it is not on the disk");
        assert!(why.contains("storage space") || why.contains("space left"), "{words:?}: {why}");
        assert_eq!(collected(&place), collected_before, "{words:?}");
        assert_eq!(session(&place)["goal"], Value::Null);
    }
    std::fs::remove_file(&full).expect("a file");
    ask(&place, &["episode", "start"]).expect("it starts");
    std::fs::write(&full, "").expect("a file");
    let why = ask(&place, &["episode", "mark", "grasped"]).expect_err("it is not on the disk");
    assert!(why.contains("space"), "{why}");
    running.signal(Signal::INT);
    let (code, _, error) = running.end();
    assert_eq!(code, Some(1), "{error}");
    assert!(error.contains("storage space"), "{error}");
}

/// A session that cannot be right is moved aside, and named with its line; the run collects all the same.
#[test]
fn a_journal_with_impossible_numbers_is_named_and_hinders_nothing() {
    for (wrong, line) in [
        ("seconds = inf", 7),
        ("seconds = nan", 7),
        ("seconds = -1.0", 7),
        ("seconds = 1e300", 7),
        ("verdict = \"GOOD\"\n[[episode.marks]]\nat = inf", 9),
    ] {
        let place = Place::lenient();
        std::fs::create_dir(place.path("out")).expect("a folder");
        let head = "begun = \"2026-11-24T13:00:00.000Z\"\n[plan]\ntask = \"pour\"\n";
        let episode = "[[episode]]\nfile = \"a.mcap\"\nbegun = \"2026-11-24T13:00:00.000Z\"\n";
        place.write("out/session.toml", &format!("{head}{episode}{wrong}\n"));
        place.write("out/b.mcap", "no episode");
        let listed = place.run(&["list", "out"]);
        let error = String::from_utf8_lossy(&listed.stderr).into_owned();
        assert!(error.contains(&format!("session.toml: not a session file: line {line}: ")), "{wrong}: {error}");
        let running = run(&place, "pour");
        let file = record(&place);
        ask(&place, &["episode", "label", "success"]).expect("a label");
        let ended = ask(&place, &["session", "end"]).expect("it ends");
        assert!(ended.contains("1 episode kept"), "{ended}");
        record(&place);
        assert!(place.path("out").join(file).exists());
        end(running);
    }
}
