//! Episodes survive `kill -9`: the next run repairs what is there, and at most the last second is
//! missing.
//!
//! A loaded machine may hold up the thread that writes; how long threads of the killed run were ready
//! and got no processor, by the kernel's count, and how late another thread is that writes to the same disk, and that much
//! more may be missing.

#![allow(clippy::expect_used, clippy::print_stdout, reason = "what fails here fails a test, which may print more")]
#![allow(clippy::case_sensitive_file_extension_comparisons, reason = "names that rapid itself writes")]

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crate::support::{self, Episode, PATIENCE, Place, Running, events};
use rapid::registry::Registry;
use rustix::process::Signal;
use serde_json::Value;

const RECORD: [&str; 6] = ["--sim", "--headless", "--json", "--record", "--out", "out"];
/// How often the mask is published.
const MASK_EVERY: Duration = Duration::from_millis(2);

/// When a run is killed.
#[derive(Debug, Clone, Copy)]
enum Moment {
    /// As soon as it reports that it records.
    AtOnce,
    /// As soon as its file has grown so many times.
    Grown(usize),
    /// So many publications of the mask after that: just before it would grow again.
    Later(usize, u64),
}

fn wait_for<T>(what: &str, mut found: impl FnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(found) = found() {
            return found;
        }
        assert!(begun.elapsed() < PATIENCE, "no {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// The number of the last mask published.
fn published(place: &Place) -> u64 {
    wait_for("whole mask record", || {
        let record = fs::read(place.mask_file()).ok()?;
        // Odd while it is being written.
        (record.len() == 32 && record[6] % 2 == 0)
            .then(|| u64::from_le_bytes(record[24..].try_into().expect("eight bytes")))
    })
}

/// How long the threads of a process have been ready to run and were not run (proc(5), schedstat).
fn held_up(pid: u32) -> Duration {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).expect("a process").flatten();
    let delay = |thread: fs::DirEntry| {
        let text = fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split_whitespace().nth(1)?.parse::<u64>().ok()
    };
    Duration::from_nanos(threads.filter_map(delay).sum())
}

/// How late a thread is that writes a byte into this folder every 10 ms, in total so far, ns. It ends with the last reader.
fn lateness(folder: PathBuf) -> Arc<AtomicU64> {
    const PERIOD: Duration = Duration::from_millis(10);
    let late = Arc::new(AtomicU64::new(0));
    let sum = Arc::clone(&late);
    std::thread::spawn(move || {
        let mut file = tempfile::tempfile_in(folder).expect("a file");
        while Arc::strong_count(&sum) > 1 {
            let begun = Instant::now();
            std::thread::sleep(PERIOD);
            file.write_all(&[0]).expect("written");
            // Waking takes some time on an idle machine, too.
            let delay = begun.elapsed().saturating_sub(2 * PERIOD);
            sum.fetch_add(delay.as_nanos().try_into().expect("seconds"), Ordering::Relaxed);
        }
    });
    late
}

/// A killed run: its file, the last mask it published, and how long its threads were held up.
struct Killed {
    partial: PathBuf,
    mask: u64,
    held_up: Duration,
}

fn kill(place: &Place, moment: Moment) -> Killed {
    let late = lateness(place.path("."));
    let mut running: Running = place.start(&RECORD, "\"event\":\"recording\"");
    let name = wait_for("partial file", || place.files("out").into_iter().find(|name| name.ends_with(".partial")));
    let partial = place.path("out").join(name);
    let grow = |times: usize| {
        for _ in 0..times {
            let before = fs::metadata(&partial).expect("partial").len();
            wait_for("growth", || (fs::metadata(&partial).expect("partial").len() > before).then_some(()));
        }
    };
    if !matches!(moment, Moment::AtOnce) {
        running.wait_for("\"mask\":\"0x07\"");
    }
    match moment {
        Moment::AtOnce => {}
        Moment::Grown(times) => grow(times),
        Moment::Later(times, publications) => {
            grow(times);
            let from = published(place);
            wait_for("publications", || (published(place) >= from + publications).then_some(()));
        }
    }
    let mask = published(place);
    let held_up = held_up(running.pid()) + Duration::from_nanos(late.load(Ordering::Relaxed));
    running.signal(Signal::KILL);
    assert_eq!(running.end().0, None);
    Killed { partial, mask, held_up }
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
    let missing = MASK_EVERY * u32::try_from(killed.mask.saturating_sub(last)).expect("few");
    println!("lost {missing:?}; held up {:?}", killed.held_up);
    assert!(missing <= Duration::from_secs(1) + killed.held_up, "{missing:?} are lost");
    assert_eq!(episode.value("rapid", "task"), "episode");
    assert_eq!(episode.value("rapid/recovered", "messages"), episode.messages.len().to_string());
    assert_eq!(episode.value("rapid/summary", "messages"), episode.messages.len().to_string());
    let report = inspected(place, repaired);
    assert_eq!((&report["end"], &report["damaged_chunks"]), (&"finished".into(), &0.into()));
}

#[test]
fn a_killed_episode_is_whole_after_the_next_start_except_for_its_last_second() {
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
