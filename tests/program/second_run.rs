//! A run after another: the replay of a recording, and a start after a kill.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::collections::BTreeMap;
use std::time::Instant;

use rapid_registry::Registry;

use crate::support::{self, Episode, PATIENCE, Place, events, until};
use rustix::process::Signal;

/// The fingertip is away for a second.
const PULLED: &str = "repeat = \"12s\"\n[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\n\
    name = \"motor_state\"\n[[event]]\nat = \"3s\"\nunplug = \"tactile_tip\"\n[[event]]\nat = \"4s\"\nplug = \"tactile_tip\"\n";

/// All devices, all but the fingertip, all.
const MASKS: [u64; 3] = [7, 5, 7];

fn masks(episode: &Episode) -> Vec<u64> {
    episode.mask_edges().into_iter().map(|(_, mask)| mask).collect()
}

/// Records into `out` until the fingertip has been away and so many more masks were published; returns the episode's file.
/// A machine on which the recording began after the first unplug, before every device delivered, or ended late tries again.
fn record(place: &Place, out: &str, arguments: &[&str], more: u64) -> String {
    let begun = Instant::now();
    for attempt in 0.. {
        let folder = format!("{out}{attempt}");
        let common = ["--headless", "--json", "--record", "--out", &folder];
        let running = place.start(&[arguments, &common].concat(), "\"event\":\"recording\"");
        until("the fingertip has been away", || {
            let reported = running.reported();
            let mut seen = reported.iter().filter_map(|event| event["mask"].as_str());
            seen.any(|mask| mask == "0x05") && seen.any(|mask| mask == "0x07")
        });
        let from = place.published();
        until("what comes after it", || place.published() >= from + more);
        running.signal(Signal::INT);
        let (code, output, errors) = running.end();
        assert_eq!(code, support::recorded_code(&output), "{errors}");
        let file = format!("{folder}/{}", place.files(&folder)[0]);
        if masks(&Episode::read(&place.path(&file))) == MASKS {
            return file;
        }
        assert!(begun.elapsed() < PATIENCE, "no recording of it in {attempt} runs");
    }
    unreachable!()
}

#[test]
fn a_replay_recorded_again_holds_the_same_samples_at_the_same_intervals() {
    let place = Place::new();
    let scenario = place.write("pulled.toml", PULLED).display().to_string();
    let file = record(&place, "first", &["--sim", &scenario], 1000);
    let original = Episode::read(&place.path(&file));
    for (command, words) in
        [("list", "  2/3  "), ("list", "tactile_tip away "), ("inspect", "   2 of 3 sensors\n  tactile_tip away ")]
    {
        let shown = String::from_utf8_lossy(&place.run(&[command, &file]).stdout).into_owned();
        assert!(shown.contains(words) && !shown.contains("3 of 3"), "{command}: {words:?} in {shown}");
    }
    // It ends before that recording does: its devices stay silent then.
    let file = record(&place, "second", &["replay", &file], 250);
    let again = Episode::read(&place.path(&file));

    let mut shifts = BTreeMap::new();
    for device in Registry::builtin().devices {
        let recorded: Vec<_> = original.topic(&device.topic).collect();
        // Every payload of a simulated device is unlike every other.
        let places: BTreeMap<Vec<u8>, usize> =
            recorded.iter().enumerate().map(|(at, message)| (message.payload(), at)).collect();
        assert_eq!(places.len(), recorded.len(), "{}", device.name);
        let replayed: Vec<_> = again.topic(&device.topic).collect();
        let found: Vec<usize> = replayed
            .iter()
            .map(|message| *places.get(&message.payload()).unwrap_or_else(|| panic!("{}: not recorded", device.name)))
            .collect();
        assert!(!found.is_empty(), "{}", device.name);
        for (message, at) in replayed.iter().zip(&found) {
            let shift = i128::from(message.log_time) - i128::from(recorded[*at].log_time);
            shifts.entry(shift).or_insert_with(Vec::new).push(device.name.clone());
        }
        // Contiguous, but for the moment at which the device was plugged in again.
        let jumps = found.windows(2).filter(|pair| pair[1] != pair[0] + 1).count();
        assert!(found.is_sorted_by(|a, b| a < b), "{}", device.name);
        assert!(jumps <= usize::from(device.name == "tactile_tip"), "{}: {jumps} jumps", device.name);
        for pair in replayed.windows(2) {
            assert_eq!(pair[1].sequence, pair[0].sequence + 1, "{}", device.name);
        }
    }
    // Capture times are those recorded, all moved by the same time, to the ns.
    assert_eq!(shifts.len(), 1, "{:?}", shifts.iter().map(|(shift, of)| (shift, of.len())).collect::<Vec<_>>());
}

#[test]
fn after_a_kill_the_next_run_takes_over_and_leaves_nothing_of_the_dead_one() {
    let place = Place::new();
    let arguments = ["--sim", "--headless", "--json", "--record", "--out", "out"];
    let running = place.start(&arguments, "\"event\":\"recording\"");
    running.signal(Signal::KILL);
    assert_eq!(running.end().0, None);
    // The counter of nodes has the same name in each run; every other file has the port's or node's own number in its
    // name.
    let own = |place: &Place| {
        let mut files = place.shared_memory();
        files.retain(|file| !file.ends_with(".global_mgmt"));
        files
    };
    let dead = own(&place);
    for kind in [".data", ".dynamic", ".connection"] {
        assert!(dead.iter().any(|file| file.ends_with(kind)), "nothing is left to reclaim: {dead:?}");
    }
    let mask = std::fs::read(place.mask_file()).expect("the dead one's mask");
    assert_ne!(mask[8], 0, "it died with devices present");

    let mut running = place.start(&arguments, "\"event\":\"recording\"");
    let alive = own(&place);
    assert_eq!(alive.intersection(&dead).collect::<Vec<_>>(), Vec::<&String>::new());
    // The demonstration pulls a camera: the file lives.
    running.wait_for("\"mask\":\"0x05\"");
    let json = std::fs::read_to_string(format!("{}.json", place.mask_file().display())).expect("JSON file");
    let json: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!(json["pid"], running.pid());
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, support::recorded_code(&output), "{errors}");
    // Nothing but what became of the dead one's episode.
    let printed = events(&output);
    let about = |event: &serde_json::Value| event["text"].as_str().is_some_and(|text| text.contains(".mcap.partial: "));
    assert!(!printed.iter().any(|event| event["event"] == "log" && !about(event)), "{output}");
    assert_eq!(own(&place), std::collections::BTreeSet::new());
    assert!(!place.mask_file().exists());
    let files = place.files("out");
    let whole = files
        .iter()
        .find(|file| file.ends_with("_001.mcap") || file.ends_with("_002.mcap"))
        .expect("the second run's episode");
    assert!(Episode::read(&place.path("out").join(whole)).topic("/rapid/mask").count() > 0);
    assert!(
        !files.iter().any(|file| file.ends_with(".mcap.partial")),
        "the killed run's file is looked after: {files:?}"
    );
}

/// A line that loses every twentieth sample.
const GAPPY: &str = "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\n\
    name = \"motor_state\"\n[device.fault]\nlose_every = 10\n";

/// A recording that was made of nothing real is as bad as what was replayed: its samples are numbered anew, without the
/// losses.
#[test]
fn a_recording_of_a_replay_says_so_everywhere_and_keeps_the_verdict_of_its_source() {
    let place = Place::new();
    let scenario = place.write("gappy.toml", GAPPY).display().to_string();
    let common = ["--headless", "--json", "--record", "--duration", "3s", "--out"];
    place.run(&[&["--sim", &scenario][..], &common, &["first"]].concat());
    let source = place.files("first").remove(0);
    let shown = place.run(&[&["replay", &format!("first/{source}")][..], &common, &["second"]].concat());
    assert_eq!(shown.status.code(), Some(4), "{}", String::from_utf8_lossy(&shown.stderr));
    let reason = format!("replay of {source}, which is BAD: motor_state: ");
    let ended = events(&String::from_utf8_lossy(&shown.stdout)).into_iter().find(|event| event["event"] == "episode");
    let ended = ended.expect("an episode");
    assert_eq!((&ended["verdict"], &ended["replay_of"][0]), (&"BAD".into(), &source.as_str().into()));
    assert!(ended["reasons"][0].as_str().is_some_and(|first| first.starts_with(&reason)), "{ended}");

    let again = place.files("second").remove(0);
    let episode = Episode::read(&place.path("second").join(&again));
    for record in ["rapid", "rapid/summary"] {
        let stated: serde_json::Value = serde_json::from_str(episode.value(record, "replay_of")).expect("JSON");
        assert_eq!((&stated[0]["verdict"], stated.as_array().map(Vec::len)), (&"BAD".into(), Some(1)), "{record}");
        assert!(stated[0]["file"].as_str().is_some_and(|file| file.ends_with(&source)), "{stated}");
    }
    let said = |arguments: &[&str]| String::from_utf8_lossy(&place.run(arguments).stdout).into_owned();
    for (arguments, words) in [
        (&["list", "second"][..], format!("BAD      {again}")),
        (&["list", "second"], format!("  3/3           {reason}")),
        (&["inspect", "first", "second"], format!("  replay of {source}, 3 of 3 sensors  {reason}")),
        (&["inspect", &format!("second/{again}")], format!("\n  replay of {source}\n")),
        (&["--json", "inspect", &format!("second/{again}")], format!("\"replay_of\":[\"{source}\"]")),
    ] {
        let text = said(arguments);
        assert!(text.contains(&words), "{arguments:?}: {words:?} in {text}");
    }
}
