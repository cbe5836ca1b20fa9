//! Episodes survive `kill -9`: the next run repairs what is there.
//!
//! What is in the file when a run is killed depends on how much of the machine its threads got. That whatever is half a
//! second old is written is a test on the recorder's own clock (`src/episode/record/recorder/tests.rs`); here a run is killed when
//! its file has what was published at an earlier moment, and all of that is in the repaired one.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]
#![allow(clippy::case_sensitive_file_extension_comparisons, reason = "names that rapid itself writes")]

use std::fs;
use std::path::{Path, PathBuf};

use rapid_registry::Registry;

use crate::support::{self, Episode, Place, Running, events, wait_for};
use rustix::process::Signal;
use serde_json::Value;

const RECORD: [&str; 6] = ["--sim", "--headless", "--json", "--record", "--out", "out"];
/// When a run is killed.
#[derive(Debug, Clone, Copy)]
enum Moment {
    /// As soon as it reports that it records.
    AtOnce,
    /// As soon as its file has grown so many times.
    Grown(usize),
    /// So many publications of the mask after that: usually just before it would grow again.
    Later(usize, u64),
}

/// The number of the last mask in a file that is being written, or 0.
fn written(partial: &Path) -> u64 {
    support::last_written(partial, "/rapid/mask").map_or(0, |mask| mask.sequence.into())
}

/// A killed run: its file, and the number of a mask that was in it before.
struct Killed {
    partial: PathBuf,
    mask: u64,
}

fn kill(place: &Place, moment: Moment) -> Killed {
    let mut running: Running = place.start(&RECORD, "\"event\":\"recording\"");
    let name = wait_for("partial file", || place.files("out").into_iter().find(|name| name.ends_with(".partial")));
    let partial = place.path("out").join(name);
    let grow = |times: usize| {
        for _ in 0..times {
            let before = fs::metadata(&partial).expect("partial").len();
            wait_for("growth", || (fs::metadata(&partial).expect("partial").len() > before).then_some(()));
        }
    };
    let mut mask = 0;
    if !matches!(moment, Moment::AtOnce) {
        running.wait_for("\"mask\":\"0x07\"");
        // While it records, and not only at its end, the file gets what was published.
        mask = place.published();
        wait_for("file with this mask", || (written(&partial) >= mask).then_some(()));
    }
    match moment {
        Moment::AtOnce => {}
        Moment::Grown(times) => grow(times),
        Moment::Later(times, publications) => {
            grow(times);
            let from = place.published();
            wait_for("publications", || (place.published() >= from + publications).then_some(()));
        }
    }
    running.signal(Signal::KILL);
    assert_eq!(running.end().0, None);
    Killed { partial, mask }
}

/// What `rapid inspect` reads of a file.
fn inspected(place: &Place, file: &Path) -> Value {
    let output = place.run(&["inspect", "--json", &file.display().to_string()]);
    serde_json::from_slice(&output.stdout).expect("JSON")
}

fn check(place: &Place, killed: &Killed, repaired: &Path) {
    let episode = Episode::read(repaired);
    let contiguous = |topic: &str| {
        let numbers: Vec<u32> = episode.topic(topic).map(|message| message.sequence).collect();
        for pair in numbers.windows(2) {
            assert_eq!(pair[1], pair[0] + 1, "{topic}");
        }
        numbers
    };
    for device in Registry::builtin().devices {
        // A simulated camera that a busy machine reads too late loses pictures.
        let is_camera = device.topic.starts_with("/rapid/camera/");
        let count = if is_camera { episode.topic(&device.topic).count() } else { contiguous(&device.topic).len() };
        assert!(count > 0, "{}", device.name);
    }
    assert!(contiguous("/rapid/frame").first().is_none_or(|first| *first == 0));
    let masks = contiguous("/rapid/mask");
    let last = u64::from(*masks.last().expect("a mask"));
    assert!(last >= killed.mask, "mask {} was in the file, and {last} is the last of the repaired one", killed.mask);
    assert_eq!(episode.value("rapid", "task"), "episode");
    assert_eq!(episode.value("rapid/recovered", "messages"), episode.messages.len().to_string());
    assert_eq!(episode.value("rapid/summary", "messages"), episode.messages.len().to_string());
    let report = inspected(place, repaired);
    assert_eq!((&report["end"], &report["damaged_chunks"]), (&"finished".into(), &0.into()));
}

#[test]
fn a_killed_episode_is_whole_after_the_next_start_except_for_its_end() {
    for moment in [Moment::Grown(2), Moment::Later(3, 200), Moment::Grown(5), Moment::Later(4, 100)] {
        let place = Place::new();
        let killed = kill(&place, moment);
        let readable = inspected(&place, &killed.partial)["messages"].clone();
        // A repair leaves the processors to everything else, and the end of a run interrupts it.
        let mut running = place.start(&RECORD, "\"event\":\"recording\"");
        running.wait_for("\"event\":\"recovered\"");
        running.signal(Signal::INT);
        let (code, output, errors) = running.end();
        assert_eq!(code, support::recorded_code(&output), "{errors}");
        let repaired = killed.partial.with_extension("");
        let files = place.files("out");
        assert!(files.len() == 2 && files[0].ends_with("_001.mcap") && files[1].ends_with("_002.mcap"), "{files:?}");
        let printed = events(&output);
        let reported = printed.iter().find(|event| event["event"] == "recovered").expect("a word on it");
        // Of what can be read nothing is lost by the repair.
        assert_eq!(reported["messages"], readable, "{moment:?}");
        let text = reported["text"].as_str().expect("text");
        assert!(text.contains("repaired, ") && text.contains("the last second may be missing"), "{text}");
        check(&place, &killed, &repaired);
    }
}

#[test]
fn an_episode_killed_at_once_is_not_left_behind() {
    let place = Place::new();
    let killed = kill(&place, Moment::AtOnce);
    let name = |ending: &str| killed.partial.with_extension("").display().to_string() + ending;
    let output = place.run(&["recover", "out"]);
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(output.status.code(), Some(0), "{printed}");
    assert!(!killed.partial.exists());
    let repaired = Path::new(&name("")).exists() && printed.contains(": repaired, ");
    let empty = Path::new(&name(".empty")).exists() && printed.contains("nothing was recorded in it");
    assert!(repaired || empty, "{printed}");
}

#[test]
fn recover_reports_present_and_missing_data_of_each_file() {
    let place = Place::new();
    let killed = kill(&place, Moment::Grown(2));
    let bytes = fs::read(&killed.partial).expect("partial");
    // As a loss of power would: the last write is cut.
    fs::write(&killed.partial, &bytes[..bytes.len() - 1000]).expect("cut");
    let finished = killed.partial.with_extension("");
    let shown = |output: &std::process::Output| String::from_utf8_lossy(&output.stdout).into_owned();

    let output = place.run(&["recover", "--json", "out"]);
    assert_eq!(output.status.code(), Some(0));
    let reported: Value = serde_json::from_str(shown(&output).trim()).expect("one object");
    assert_eq!((&reported["outcome"], &reported["end"]), (&"repaired".into(), &"torn".into()));
    assert!(reported["to"].as_str().expect("name").ends_with("_001.mcap"), "{reported}");
    assert!(reported["unread_bytes"].as_u64() > Some(0) && reported["messages"].as_u64() > Some(0), "{reported}");
    let whole = fs::read(&finished).expect("repaired");

    let output = place.run(&["recover", "out"]);
    assert_eq!((output.status.code(), shown(&output).as_str()), (Some(0), "out: nothing to repair\n"));
    let file = finished.display().to_string();
    let output = place.run(&["recover", &file]);
    assert!(output.status.success() && shown(&output).ends_with(": whole; nothing to repair\n"), "{}", shown(&output));

    // A copy that was cut: the whole one stands beside it.
    let copy = place.path("copy.mcap");
    fs::write(&copy, &whole[..whole.len() * 2 / 3]).expect("cut");
    let output = place.run(&["recover", "copy.mcap"]);
    assert!(output.status.success() && shown(&output).contains("; now copy.recovered.mcap"), "{}", shown(&output));
    assert_eq!(fs::read(&copy).expect("copy").len(), whole.len() * 2 / 3);
    Episode::read(&place.path("copy.recovered.mcap"));

    // What cannot be repaired is reported, and the rest is done.
    let text = place.write("text.mcap", "no episode").display().to_string();
    for (files, code) in [(vec!["missing.mcap"], 2), (vec![text.as_str()], 2), (vec![text.as_str(), &file], 2)] {
        let output = place.run(&[&["recover"][..], &files].concat());
        assert_eq!(output.status.code(), Some(code), "{files:?}");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(errors.contains(files[0]) && errors.starts_with("error: "), "{errors}");
    }
    // One that is being recorded is left alone, by a recover and by another run.
    let running =
        place.start(&["--sim", "--headless", "--json", "--record", "--out", "live"], "\"event\":\"recording\"");
    let live = wait_for("partial", || place.files("live").into_iter().find(|name| name.ends_with(".partial")));
    let output = place.run(&["recover", &format!("live/{live}")]);
    assert_eq!(output.status.code(), Some(1));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(errors.contains("another rapid is writing or repairing it"), "{errors}");
    let instance = format!("{}-b", place.instance);
    let second = Place { instance, folder: tempfile::tempdir().expect("folder") };
    let out = place.path("live").display().to_string();
    let arguments = ["--sim", "--headless", "--json", "--record", "--duration", "1s", "--out", &out];
    let output = second.run(&arguments);
    let code = support::recorded_code(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(output.status.code(), code, "{}", String::from_utf8_lossy(&output.stderr));
    assert!(shown(&output).contains("another rapid writes or repairs it; left alone"), "{}", shown(&output));
    running.signal(Signal::INT);
    let (code, output, _) = running.end();
    assert_eq!(code, support::recorded_code(&output));
    let files = place.files("live");
    assert!(files.len() == 2 && files.iter().all(|name| name.ends_with(".mcap")), "{files:?}");
    Episode::read(&place.path("live").join(&files[0]));
}
