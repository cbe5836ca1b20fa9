//! Sessions: episodes begun, ended, discarded and labelled from a shell, by a plan and by keys.

use crate::support::terminal::OnTerminal;
use crate::support::{Place, until};
use rustix::process::Signal;

/// Runs `rapid WORDS` in this place; its output, or its error.
fn ask(place: &Place, words: &[&str]) -> Result<String, String> {
    let output = place.run(words);
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim_end().to_owned();
    if output.status.success() { Ok(text(&output.stdout)) } else { Err(text(&output.stderr)) }
}

/// A press within 400 ms of the last one counts as its repeat.
fn next_press() {
    std::thread::sleep(std::time::Duration::from_secs(1));
}

/// The name of the third episode.
fn third(place: &Place) -> String {
    session(place)["episodes"][2]["file"].as_str().expect("a name").to_owned()
}

fn session(place: &Place) -> serde_json::Value {
    serde_json::from_str(&ask(place, &["session", "--json"]).expect("a session")).expect("JSON")
}

#[test]
fn a_script_records_discards_and_labels_and_a_killed_run_loses_none_of_it() {
    let place = Place::new();
    assert!(ask(&place, &["episode", "start"]).unwrap_err().contains("runs here"));
    let running = place.start(&["--sim", "--headless", "--out", "out", "--task", "pour"], "motor_state");
    let started = ask(&place, &["episode", "start"]).expect("it starts");
    assert!(started.ends_with("_pour_001.mcap"), "{started}");
    assert!(ask(&place, &["episode", "start"]).unwrap_err().contains("an episode is being recorded"));
    ask(&place, &["episode", "mark", "grasped"]).expect("a mark");
    let stopped = ask(&place, &["episode", "stop"]).expect("it stops");
    // Its file is whole when the answer arrives.
    assert!(place.path("out").join(started.rsplit('/').next().expect("a name")).exists(), "{stopped}");
    ask(&place, &["episode", "label", "failure", "spilled"]).expect("a label");
    ask(&place, &["episode", "start"]).expect("another");
    ask(&place, &["episode", "discard"]).expect("it is discarded");
    assert_eq!(place.files("out/.trash").len(), 1);
    ask(&place, &["episode", "next"]).expect("a third");
    until("there is something in it", || {
        std::fs::metadata(place.path(&format!("out/{}.partial", third(&place)))).is_ok_and(|file| file.len() > 200_000)
    });
    running.signal(Signal::KILL);
    drop(running);

    // The next run continues the session, and repairs what was being recorded.
    let running = place.start(&["--sim", "--headless", "--out", "out", "--task", "pour"], "motor_state");
    until("the third is repaired", || !place.files("out").iter().any(|name| name.ends_with(".partial")));
    until("its verdict is known", || !session(&place)["episodes"][2]["verdict"].is_null());
    let status = session(&place);
    let episodes = status["episodes"].as_array().expect("a list");
    assert!(episodes[2]["seconds"].as_f64().is_some_and(|seconds| seconds > 0.1), "{status}");
    assert_eq!((episodes.len(), &status["discarded"]), (3, &1.into()), "{status}");
    assert_eq!((&episodes[0]["label"], &episodes[0]["label_reason"]), (&"failure".into(), &"spilled".into()));
    assert_eq!(episodes[0]["marks"][0]["text"], "grasped");
    assert!(place.files("out").contains(&third(&place)), "{status}");
    ask(&place, &["episode", "undo"]).expect("it comes back");
    assert!(place.files("out/.trash").is_empty());
    ask(&place, &["session", "plan", "--task", "stack", "--goal", "7", "--tag", "finger=soft"]).expect("a plan");
    let status = session(&place);
    assert_eq!((&status["task"], &status["goal"]), (&"stack".into(), &7.into()));
    let ended = ask(&place, &["session", "end"]).expect("it ends");
    assert_eq!(ended, "session ended: 3 episodes kept, 0 deleted");
    assert_eq!(session(&place)["episodes"].as_array().map(Vec::len), Some(0));
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
    let names = place.files("out");
    for ending in [".toml", ".md"] {
        let of_session = |name: &&String| name.starts_with("session-") && name.ends_with(ending);
        assert_eq!(names.iter().filter(of_session).count(), 1, "{names:?}");
    }
}

#[test]
fn a_redo_that_cannot_discard_is_answered_so() {
    for countdown in ["1ms", "1s"] {
        let place = Place::new();
        let words = ["--sim", "--headless", "--out", "out", "--countdown", countdown];
        let running = place.start(&words, "motor_state");
        std::fs::create_dir(place.path("out")).expect("a folder");
        std::fs::write(place.path("out/.trash"), "not a folder").expect("a file");
        ask(&place, &["episode", "start"]).expect("it starts");
        let file = session(&place)["episodes"][0]["file"].as_str().expect("a name").to_owned();
        // While it is recorded, and when it is not.
        for stops in [false, true] {
            if stops {
                ask(&place, &["episode", "stop"]).expect("it stops");
            }
            let why = ask(&place, &["episode", "redo"]).expect_err("it cannot be discarded");
            assert!(why.contains(".mcap was not moved: ") && why.contains(".trash"), "{why}");
            // What happens all the same is in the answer.
            assert!(why.contains("; recording out/"), "{why}");
            assert!(place.files("out").contains(&file));
            until("the next is recorded", || session(&place)["phase"]["phase"] == "recording");
            assert_eq!(session(&place)["discarded"], 0, "{}", session(&place));
        }
        running.signal(Signal::INT);
        assert_eq!(running.end().0, Some(0));
    }
}

#[test]
fn a_name_is_not_given_twice_in_a_session() {
    let place = Place::new();
    let run = || place.start(&["--sim", "--headless", "--out", "out", "--task", "pour"], "motor_state");
    let record = |number: u32| {
        let started = ask(&place, &["episode", "start"]).expect("it starts");
        assert!(started.ends_with(&format!("_pour_{number:03}.mcap")), "{started}");
        ask(&place, &["episode", "stop"]).expect("it stops");
        place.path("out").join(started.rsplit('/').next().expect("a name"))
    };
    let end = |running: crate::support::Running| {
        running.signal(Signal::INT);
        assert_eq!(running.end().0, Some(0));
    };
    let running = run();
    // As the upload does with what is in the store.
    std::fs::remove_file(record(1)).expect("it is there");
    std::fs::remove_file(record(2)).expect("it is there");
    // Deleted with its session, and another moved away after it.
    let third = record(3);
    record(4);
    ask(&place, &["episode", "discard"]).expect("it is discarded");
    ask(&place, &["session", "end"]).expect("it ends");
    std::fs::remove_file(third).expect("it is there");
    std::fs::remove_file(record(5)).expect("it is there");
    end(running);
    // The next run knows the names of all sessions.
    let running = run();
    record(6);
    end(running);
}

#[test]
fn a_goal_that_is_reached_already_records_nothing() {
    let place = Place::new();
    let words = ["--sim", "--headless", "--record", "--out", "out", "--goal", "1", "--episode-time", "700ms"];
    assert_eq!(place.run(&words).status.code(), Some(0));
    let again = place.run(&words);
    let text = String::from_utf8_lossy(&again.stdout);
    assert!(again.status.success() && text.contains("as many episodes as --goal wants"), "{text}");
    assert_eq!(place.episodes("out").len(), 1);
}

#[test]
fn a_stopped_run_does_not_hold_up_who_requests_something_of_it() {
    let place = Place::new();
    let running = place.start(&["--sim", "--headless", "--out", "out"], "motor_state");
    running.signal(Signal::STOP);
    for words in [&["session"][..], &["episode", "start"], &["reload"], &["logs"], &["arm"]] {
        let why = ask(&place, words).expect_err("it is stopped");
        assert!(why.contains(" is stopped ") && why.contains("`kill -CONT "), "{words:?}: {why}");
    }
    running.signal(Signal::CONT);
    // What was requested meanwhile is carried out.
    until("the episode is recorded", || session(&place)["episodes"].as_array().is_some_and(|all| all.len() == 1));
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
}

/// The episodes that the journal in `out` has at this moment.
fn journal(place: &Place) -> Vec<toml::Table> {
    let text = std::fs::read_to_string(place.path("out/session.toml")).expect("a journal");
    let mut journal: toml::Table = text.parse().expect("TOML");
    let episodes = journal.remove("episode").expect("episodes");
    episodes.try_into().expect("a list")
}

#[test]
fn what_was_answered_is_on_the_disk_when_the_run_is_killed() {
    let place = Place::new();
    let run = || place.start(&["--sim", "--headless", "--out", "out", "--task", "pour"], "motor_state");
    let killed = |words: &[&[&str]]| {
        let running = run();
        for words in words {
            ask(&place, words).unwrap_or_else(|error| panic!("{words:?}: {error}"));
        }
        running.signal(Signal::KILL);
        drop(running);
        journal(&place)
    };
    let (start, stop): (&[&str], &[&str]) = (&["episode", "start"], &["episode", "stop"]);
    assert_eq!(killed(&[start]).len(), 1);
    let stopped = killed(&[start, stop]);
    assert!(stopped.len() == 2 && stopped[1].contains_key("verdict"), "{stopped:?}");
    let labelled = killed(&[&["episode", "label", "failure", "slipped"]]);
    assert_eq!(labelled[1]["label_reason"].as_str(), Some("slipped"), "{labelled:?}");
    let named = stopped[1]["file"].as_str().expect("a name");
    let noted = killed(&[start, &["episode", "note", "pads", "--episode", named]]);
    assert_eq!((noted.len(), noted[1]["note"].as_str()), (3, Some("pads")), "{noted:?}");
    let discarded = killed(&[start, &["episode", "discard"]]);
    assert!(discarded.len() == 4 && discarded[3]["discarded"].as_bool() == Some(true), "{discarded:?}");
    // What a killed run began does not count: nothing was recorded, or too little.
    let running = run();
    let counted = session(&place)["counted"].as_u64().expect("a count");
    assert_eq!(counted, 0, "{}", session(&place));
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
}

#[test]
fn a_plan_records_its_episodes_and_ends_the_run() {
    let place = Place::new();
    let plan = ["--goal", "2", "--episode-time", "700ms", "--reset-time", "100ms", "--countdown", "50ms"];
    let output = place.run(&[&["--sim", "--headless", "--record", "--out", "out"], &plan[..]].concat());
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{text}");
    assert_eq!(place.episodes("out").len(), 2, "{text}");
    assert_eq!(text.lines().filter(|line| line.starts_with("GOOD ")).count(), 2, "{text}");
    for words in [&["--goal", "2", "--duration", "3s"][..], &["--goal", "0"], &["--episode-time", "0s"]] {
        assert_eq!(place.run(words).status.code(), Some(2), "{words:?}");
    }
}

#[test]
fn keys_discard_redo_note_and_end_a_session_in_the_monitor() {
    let place = Place::new();
    let mut run = OnTerminal::start(&place, &["--sim", "--record", "--out", "out"], "");
    run.read_until("REC");
    let mut shown = std::fs::File::from(run.master.as_ref().expect("open").try_clone().expect("clone"));
    // What is not read would stop the screen.
    std::thread::spawn(move || std::io::copy(&mut shown, &mut std::io::sink()));
    let journal = || std::fs::read_to_string(place.path("out/session.toml")).unwrap_or_default();
    let recorded = |number: &str| journal().contains(number);
    until("the first is in the journal", || recorded("_001"));
    run.type_in("\u{1b}[C");
    until("the second is in the journal", || recorded("_002"));
    next_press();
    run.type_in("\u{1b}[D");
    until("the third is in the journal", || recorded("_003"));
    until("the second is in the trash", || place.files("out/.trash").iter().any(|name| name.contains("_002")));
    // The note is about what the screen shows.
    next_press();
    run.type_in("nnew pads\r");
    until("the note is in the journal", || journal().contains("note = \"new pads\""));
    next_press();
    run.type_in(" ");
    until("no episode is being recorded", || session(&place)["phase"]["phase"] == "idle");
    run.type_in("Eend\r");
    until("the trash is empty", || !place.path("out/.trash").exists());
    // The selected device is unplugged by a key, and plugged in again.
    let mask = || ask(&place, &["mask", "--json"]).unwrap_or_default();
    for (key, value) in [("U", "0x06"), ("U", "0x07")] {
        run.type_in(key);
        until("the bit changes", || mask().contains(value));
    }
    // A screen that still shows the recording asks first.
    next_press();
    run.type_in("q");
    until("the end", || run.child.try_wait().expect("wait").is_some());
    assert_eq!(place.episodes("out").len(), 2, "{:?}", place.files("out"));
}
