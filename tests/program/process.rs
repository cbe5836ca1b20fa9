//! Programs as the nodes of devices: the real binary, simulated plugs, and real child processes that
//! behave badly. The program is `examples/process_node.rs`.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::support::{self, Episode, EventMessage, MaskMessage, Place, Running, events, logged, until};
use rustix::process::Signal;
use serde_json::Value;

const TOPIC: &str = "/rapid/process/counter";

/// The program, which `cargo test` and `make quick` build beside the binary.
fn program() -> PathBuf {
    let path = Path::new(env!("CARGO_BIN_EXE_rapid")).with_file_name("examples").join("process_node");
    assert!(path.exists(), "no {}: run `cargo build --example process_node`", path.display());
    path
}

/// A registry with one entry, whose program gets these arguments.
fn registry(place: &Place, args: &str, more: &str) {
    let text = format!(
        "[rig]\ncooldown = \"200ms\"\n[device.counter]\nvid = \"2e8a\"\npid = \"000a\"\nserial = \"C1\"\n\
         node = \"{}\"\ntopic = {TOPIC:?}\nbit = 0\n[device.counter.process]\nargs = [\"--rate\", \"100\"{args}]\n\
         kind = \"scalars\"\nchannels = 2\n{more}\n",
        program().display()
    );
    place.write("devices.toml", &text);
}

/// The arguments of a run that plays `scenario`.
fn sim(place: &Place, scenario: &str) -> [&'static str; 6] {
    place.write("sim.toml", scenario);
    ["--sim", "sim.toml", "--config", "devices.toml", "--headless", "--json"]
}

/// The first event that `is` what is looked for.
fn find<'a>(events: &'a [Value], is: impl Fn(&Value) -> bool, what: &str) -> &'a Value {
    events.iter().find(|event| is(event)).unwrap_or_else(|| panic!("no {what} in {events:#?}"))
}

fn stamp(event: &Value) -> u64 {
    event["stamp"].as_u64().expect("a stamp")
}

fn states(events: &[Value]) -> Vec<&str> {
    events.iter().filter_map(|event| event["state"].as_str()).collect()
}

/// Process ids of the programs that came to stream, in order.
fn programs(events: &[Value]) -> Vec<u32> {
    let details = events.iter().filter(|event| event["state"] == "streaming").filter_map(|e| e["detail"].as_str());
    details.filter_map(|detail| detail.split_once("process ")?.1.split(',').next()?.parse().ok()).collect()
}

fn is_alive(pid: u32) -> bool {
    Path::new(&format!("/proc/{pid}")).exists()
}

/// Children of a process, dead ones included.
fn children(pid: u32) -> Vec<u32> {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).expect("its threads").flatten();
    let lists = tasks.filter_map(|task| std::fs::read_to_string(task.path().join("children")).ok());
    lists.flat_map(|list| list.split_whitespace().filter_map(|pid| pid.parse().ok()).collect::<Vec<_>>()).collect()
}

fn descriptors(pid: u32) -> usize {
    std::fs::read_dir(format!("/proc/{pid}/fd")).expect("its descriptors").count()
}

/// Waits until the words have been printed this many times.
fn wait_for_count(running: &Running, words: &str, count: usize) {
    until(&format!("{words:?} {count} times"), || running.output().matches(words).count() >= count);
}

/// Process ids of the programs that stream, as soon as there is one.
fn wait_for_programs(running: &Running) -> Vec<u32> {
    let mut pids = Vec::new();
    until("a program", || {
        pids = programs(&running.reported());
        !pids.is_empty()
    });
    pids
}

#[test]
fn an_unresponsive_program_is_unplugged_at_once_and_killed_later_and_its_successor_waits() {
    let place = Place::new();
    registry(&place, ", \"--ignore-sigterm\"", "");
    let scenario = "[[event]]\nat = \"3s\"\nunplug = \"counter\"\n[[event]]\nat = \"4s\"\nplug = \"counter\"\n";
    let output = place.run(&[&sim(&place, scenario)[..], &["--record", "--out", "out", "--duration", "12s"]].concat());
    let code = support::recorded_code(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(output.status.code(), code, "{}", String::from_utf8_lossy(&output.stderr));
    let reported = events(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(states(&reported), ["opening", "streaming", "absent", "opening", "streaming"]);

    // The bit goes with the cable, five seconds before the program does; its successor comes after.
    let absent = find(&reported, |event| event["state"] == "absent", "absent");
    let killed = find(&reported, |event| event["text"].as_str().is_some_and(|t| t.contains("was killed")), "kill");
    let again = reported.iter().rfind(|event| event["state"] == "streaming").expect("streaming again");
    assert_eq!(absent["mask"], "0x00");
    assert!(stamp(killed) - stamp(absent) >= 5_000_000_000, "SIGTERM has its time");
    assert!(stamp(again) > stamp(killed));
    let pids = programs(&reported);
    assert_eq!(pids.len(), 2, "{reported:#?}");
    for pid in pids {
        assert!(!is_alive(pid), "{pid} outlived the run");
    }
    assert_eq!(logged(&reported, "was killed").len(), 2, "one at the unplug, one at the end");

    let files = place.files("out");
    let episode = Episode::read(&place.path("out").join(&files[0]));
    // The mask continues while the program is being ended: no publication is missing, and none of the five
    // seconds is without one, however busy the machine.
    let masks: Vec<u32> = episode.topic("/rapid/mask").map(|message| message.sequence).collect();
    assert!(masks.windows(2).all(|pair| pair[1] == pair[0] + 1), "a hole in the mask");
    let events: Vec<(u64, Value)> = episode
        .topic("/rapid/event")
        .map(|message| (message.log_time, serde_json::from_str(&message.decode::<EventMessage>().json).expect("JSON")))
        .collect();
    let at = |stamp: u64| events.iter().find(|(_, event)| event["stamp"] == stamp).expect("in the episode").0;
    let (absent, killed, again) = (at(stamp(absent)), at(stamp(killed)), at(stamp(again)));
    let part = (killed - absent) / 5;
    for begun in (0..5).map(|number| absent + number * part) {
        let mut published = episode.topic("/rapid/mask").map(|message| message.log_time);
        assert!(published.any(|time| (begun..begun + part).contains(&time)), "no mask for {part} ns");
    }
    let edges: Vec<u64> = episode.mask_edges().into_iter().map(|(_, mask)| mask).collect();
    assert_eq!(edges, [1, 0, 1]);

    // The program continued to publish until it was killed: none of that counts.
    let samples: Vec<_> = episode.topic(TOPIC).collect();
    assert!(!samples.is_empty());
    assert!(samples.windows(2).all(|pair| pair[1].sequence == pair[0].sequence + 1), "a hole in the samples");
    assert!(samples.iter().all(|sample| sample.log_time < absent || sample.log_time > killed.min(again)));
    let counters: Vec<f64> = samples
        .iter()
        .map(|sample| f64::from_le_bytes(sample.payload()[..8].try_into().expect("two numbers")))
        .collect();
    // Whole numbers, far below where floats leave some out.
    let restarts = counters.windows(2).filter(|pair| (pair[1] - pair[0] - 1.0).abs() > 0.5).count();
    assert_eq!(restarts, 1, "one program after the other, each from its beginning: {counters:?}");
}

#[test]
fn repeated_plugging_leaves_no_process_no_descriptor_and_no_memory() {
    let place = Place::new();
    registry(&place, "", "");
    let scenario = "repeat = \"1500ms\"\n[[event]]\nat = \"1s\"\nunplug = \"counter\"\n[[event]]\nat = \"1200ms\"\nplug = \"counter\"\n";
    let running = place.start(&sim(&place, scenario), "\"streaming\"");
    wait_for_count(&running, "\"streaming\"", 2);
    let rapid = running.pid();
    let settled = || children(rapid).len() == 1;
    until("one program at a time", settled);
    let (before, memory) = (descriptors(rapid), place.shared_memory().len());
    wait_for_count(&running, "\"streaming\"", 8);
    until("descriptors leak", || settled() && descriptors(rapid) <= before);
    until("shared memory leaks", || place.shared_memory().len() <= memory);
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, Some(0), "{errors}");
    for pid in programs(&events(&output)) {
        assert!(!is_alive(pid), "{pid} outlived the run");
    }
}

#[test]
fn a_program_that_crashes_repeatedly_fails() {
    let place = Place::new();
    registry(&place, ", \"--crash-after\", \"3\"", "");
    let mut running = place.start(&sim(&place, ""), "\"failed\"");
    running.wait_for("\"failed\"");
    running.signal(Signal::INT);
    let (code, output, _) = running.end();
    assert_eq!(code, Some(0));
    let reported = events(&output);
    let round = ["opening", "streaming", "backoff"];
    assert_eq!(states(&reported), [&round.repeat(5)[..], &["opening", "streaming", "failed"]].concat());
    let failed = find(&reported, |event| event["state"] == "failed", "failed");
    assert_eq!(failed["detail"], "its process ended with code 1");
    assert_eq!(failed["mask"], "0x00");
    assert_eq!(logged(&reported, "crashes after 3 samples").len(), 6, "its output is in the log");
    let kept = place.logbook("counter");
    for words in ["started as process", "crashes after 3 samples", "its process ended with code 1"] {
        assert_eq!(kept.matches(words).count(), 6, "{words:?} in {kept}");
    }
}

#[test]
fn every_frame_tells_a_crash_from_an_unplug() {
    let place = Place::new();
    registry(&place, ", \"--crash-after\", \"20\"", "");
    let scenario = "[[device]]\nname = \"counter\"\n[[event]]\nat = \"3s\"\nunplug = \"counter\"\n";
    let output = place.run(&[&sim(&place, scenario)[..], &["--record", "--out", "out", "--duration", "4s"]].concat());
    let text = String::from_utf8_lossy(&output.stdout);
    let episode = Episode::read(&place.path("out").join(&place.episodes("out")[0]));
    // Runs of frames that show the same.
    let frames = episode.frames();
    let shown = frames.iter().map(|(_, frame)| (frame.modalities[0].present, frame.modalities[0].plugged));
    let mut phases: Vec<(bool, bool)> = shown.collect();
    phases.dedup();
    assert!(
        phases.contains(&(true, true)) && phases.contains(&(false, true)),
        "it ran, and crashed: {phases:?} {text}"
    );
    assert_eq!(phases.last(), Some(&(false, false)), "it is unplugged: {phases:?}");
    assert_eq!(
        phases.iter().filter(|phase| **phase == (false, false)).count(),
        1,
        "a crash is not an unplug: {phases:?}"
    );
    assert!(!phases.contains(&(true, false)), "what runs is plugged in: {phases:?}");
    // The topic of the mask carries the same.
    let bits = |message: &support::Message| {
        let message: MaskMessage = message.decode();
        (message.mask, message.plugged)
    };
    let mut published: Vec<(u64, u64)> = episode.topic("/rapid/mask").map(bits).collect();
    published.dedup();
    assert_eq!(published.last(), Some(&(0, 0)), "{published:?}");
    assert!(
        published.contains(&(0, 1)) && published.contains(&(1, 1)) && !published.contains(&(1, 0)),
        "{published:?}"
    );
}

#[test]
fn a_crash_a_stall_and_an_unplug_are_three_things_in_every_frame_and_in_a_data_set() {
    // Present, plugged and valid.
    const RUNNING: [bool; 3] = [true, true, true];
    const CRASHED: [bool; 3] = [false, true, false];
    const STALLED: [bool; 3] = [true, true, false];
    const UNPLUGGED: [bool; 3] = [false, false, false];
    let place = Place::new();
    let entry = |name: &str, bit: usize, args: &str, more: &str| {
        format!(
            "[device.{name}]\nvid = \"2e8a\"\npid = \"000a\"\nserial = \"C{bit}\"\nnode = \"{}\"\nbit = {bit}\n\
             [device.{name}.process]\nargs = [\"--rate\", \"100\", {args}, \"20\"]\nkind = \"scalars\"\nchannels = 2\n{more}\n",
            program().display()
        )
    };
    let crashing = entry("crashing", 0, "\"--crash-after\"", "");
    let stalling = entry("stalling", 1, "\"--silent-after\"", "heartbeat = \"200ms\"");
    place.write("devices.toml", &format!("[rig]\ncooldown = \"200ms\"\n{crashing}{stalling}"));
    let scenario = "[[device]]\nname = \"crashing\"\n[[device]]\nname = \"stalling\"\n\
                    [[event]]\nat = \"4s\"\nunplug = \"crashing\"\n[[event]]\nat = \"4200ms\"\nunplug = \"stalling\"\n";
    let output = place.run(&[&sim(&place, scenario)[..], &["--record", "--out", "out", "--duration", "6s"]].concat());
    let text = String::from_utf8_lossy(&output.stdout);
    let episode = Episode::read(&place.path("out").join(&place.episodes("out")[0]));
    let frames = episode.frames();
    // By frame.
    let shown = |bit: usize| -> Vec<[bool; 3]> {
        let of = |frame: &support::FrameMessage| {
            let slot = &frame.modalities[bit];
            [slot.present, slot.plugged, slot.valid]
        };
        frames.iter().map(|(_, frame)| of(frame)).collect()
    };
    let longest = |shown: &[[bool; 3]], wanted: [bool; 3]| {
        shown.chunk_by(|one, next| one == next).filter(|run| run[0] == wanted).map(<[_]>::len).max().unwrap_or(0)
    };
    let (crashing, stalling) = (shown(0), shown(1));
    for shown in [&crashing, &stalling] {
        assert!(shown.contains(&RUNNING) && shown.contains(&CRASHED), "{shown:?} {text}");
        assert!(shown.iter().all(|flags| [RUNNING, CRASHED, STALLED, UNPLUGGED].contains(flags)), "{shown:?}");
        // Unplugged to the end, and at no crash and no stall before.
        let unplugged = shown.iter().rposition(|flags| *flags != UNPLUGGED).map_or(0, |last| last + 1);
        assert!(unplugged < shown.len(), "{shown:?} {text}");
        let plugged = shown.iter().position(|flags| flags[1]).expect("plugged in");
        assert!(shown[plugged..unplugged].iter().all(|flags| flags[1]), "{shown:?}");
    }
    // Silent for five heartbeats with its bit set before it is ended: 30 ticks, of which one or the other is at an edge.
    assert!(longest(&stalling, STALLED) >= 10, "{stalling:?} {text}");

    let words = ["export", "out", "--to", "lerobot", "--out", "set", "--include-bad", "--verify"];
    let output = place.run(&words);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let data = "set/data/chunk-000/file-000.parquet";
    let [mask, plugged, valid] =
        ["rapid.mask", "rapid.plugged", "rapid.valid"].map(|feature| crate::export::numbers(&place, data, feature));
    for (bit, shown) in [crashing, stalling].iter().enumerate() {
        let of = |rows: &[Vec<f32>]| rows.iter().map(|row| row[bit] > 0.5).collect::<Vec<_>>();
        let found: Vec<[bool; 3]> = of(&mask)
            .into_iter()
            .zip(of(&plugged))
            .zip(of(&valid))
            .map(|((mask, plugged), valid)| [mask, plugged, valid])
            .collect();
        assert_eq!(&found, shown);
    }
}

#[test]
fn a_program_that_is_behind_is_never_good_however_far() {
    let place = Place::new();
    let behind = [0.0, 0.5, 9.0, 12.0, 3600.0, -0.5];
    let entry = |(bit, behind): (usize, &f64)| {
        format!(
            "[device.by{bit}]\nvid = \"2e8a\"\npid = \"000a\"\nserial = \"C{bit}\"\nbit = {bit}\nnode = \"{}\"\n\
             [device.by{bit}.process]\nargs = [\"--rate\", \"100\", \"--behind\", \"{behind}\"]\nkind = \"scalars\"\n\
             channels = 2\n",
            program().display()
        )
    };
    place.write("devices.toml", &behind.iter().enumerate().map(entry).collect::<String>());
    let run = [&sim(&place, "")[..], &["--record", "--duration", "3s", "--out", "out"]].concat();
    let output = place.run(&run);
    let reported = events(&String::from_utf8_lossy(&output.stdout));
    let ended = find(&reported, |event| event["event"] == "episode", "episode");
    let reasons: Vec<&str> = ended["reasons"].as_array().expect("reasons").iter().filter_map(Value::as_str).collect();
    let inspected = place.run(&["inspect", "--json", &format!("out/{}", place.files("out")[0])]);
    let inspected: Value = serde_json::from_slice(&inspected.stdout).expect("JSON");
    assert_eq!(inspected["reasons"], ended["reasons"], "the recorder and a reader of the file agree");
    let modalities = inspected["modalities"].as_array().expect("modalities");
    for (bit, behind) in behind.iter().enumerate() {
        let quality = &modalities[bit]["quality"];
        let (valid, samples) = (quality["frames_valid"].as_u64(), quality["samples"].as_u64());
        if *behind == 0.0 {
            assert!(valid > Some(0), "{quality}");
            continue;
        }
        let own = format!("by{bit}: ");
        let is_known = |reason: &&&str| {
            reason.starts_with(&own)
                && ["damaged", "too late", "nothing was received"].iter().any(|why| reason.contains(why))
        };
        assert!(reasons.iter().any(|reason| is_known(&reason)), "{behind} s behind: {reasons:#?}");
        assert!(valid == Some(0) || samples == Some(0), "{behind} s behind: {quality}");
    }
}

#[test]
fn a_program_that_repeats_one_number_sends_duplicates() {
    let place = Place::new();
    registry(&place, ", \"--same-number\"", "");
    let output = place.run(&[&sim(&place, "")[..], &["--record", "--duration", "2s", "--out", "out"]].concat());
    let reported = events(&String::from_utf8_lossy(&output.stdout));
    let ended = find(&reported, |event| event["event"] == "episode", "episode");
    let is_named = |reason: &Value| {
        reason
            .as_str()
            .is_some_and(|text| text.starts_with("counter: ") && text.contains("with a non-increasing sequence"))
    };
    assert!(
        ended["verdict"] == "BAD" && ended["reasons"].as_array().is_some_and(|all| all.iter().any(is_named)),
        "{ended}"
    );
    assert_eq!(logged(&reported, "counter: samples are duplicates, of seq 7 again").len(), 1, "{reported:#?}");
    let inspected = place.run(&["inspect", "--json", &format!("out/{}", place.files("out")[0])]);
    let inspected: Value = serde_json::from_slice(&inspected.stdout).expect("JSON");
    assert_eq!(inspected["reasons"], ended["reasons"], "the recorder and a reader of the file agree");
}

#[test]
fn a_program_that_floods_its_output_is_thinned_and_its_samples_are_whole() {
    let place = Place::new();
    registry(&place, ", \"--flood-stderr\"", "");
    let output = place.run(&[&sim(&place, "")[..], &["--record", "--out", "out", "--duration", "7s"]].concat());
    let code = support::recorded_code(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(output.status.code(), code, "{}", String::from_utf8_lossy(&output.stderr));
    let reported = events(&String::from_utf8_lossy(&output.stdout));
    let stamps: Vec<u64> = reported.iter().filter_map(|event| event["stamp"].as_u64()).collect();
    let seconds = (stamps[stamps.len() - 1] - stamps[0]) / 1_000_000_000 + 1;
    let lines = logged(&reported, "counter: flood ").len() as u64;
    assert!(lines <= 100 + 20 * seconds, "{lines} lines in {seconds} s");
    assert!(!logged(&reported, "lines left out").is_empty());
    let kept = place.logbook("counter");
    assert_eq!(kept.lines().filter(|line| line.contains(" flood ")).count() as u64, lines, "the file has no more");
    assert!(kept.contains("prints too much: "));
    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    let sequences: Vec<u32> = episode.topic(TOPIC).map(|message| message.sequence).collect();
    assert!(!sequences.is_empty());
    assert!(sequences.windows(2).all(|pair| pair[1] == pair[0] + 1), "a hole in the samples");
}

#[test]
fn a_program_without_a_heartbeat_is_stalled_then_started_again() {
    let place = Place::new();
    registry(&place, ", \"--silent-after\", \"20\"", "heartbeat = \"200ms\"");
    let running = place.start(&sim(&place, ""), "\"backoff\"");
    wait_for_count(&running, "\"streaming\"", 2);
    running.signal(Signal::INT);
    let (_, output, _) = running.end();
    let reported = events(&output);
    assert_eq!(states(&reported)[..6], ["opening", "streaming", "stalled", "backoff", "opening", "streaming"]);
    let stalled = find(&reported, |event| event["state"] == "stalled", "stalled");
    assert_eq!(stalled["mask"], "0x01", "silent is not unplugged");
    let backoff = find(&reported, |event| event["state"] == "backoff", "backoff");
    // How much later than after five heartbeats is the machine's affair.
    let waited = backoff["detail"].as_str().and_then(|detail| detail.strip_prefix("nothing came for "));
    let waited =
        waited.and_then(|rest| rest.split_whitespace().next()?.trim_end_matches(['s', ';']).parse::<f64>().ok());
    assert!(waited.is_some_and(|seconds| seconds >= 1.0), "{backoff}");
    assert!(stamp(backoff) - stamp(stalled) >= 700_000_000, "five heartbeats, not one");
}

#[test]
fn the_end_of_a_run_waits_for_an_unresponsive_program_and_a_second_signal_does_not() {
    for second in [false, true] {
        let place = Place::new();
        registry(&place, ", \"--ignore-sigterm\"", "");
        let mut running = place.start(&sim(&place, ""), "\"streaming\"");
        let pids = wait_for_programs(&running);
        let begun = Instant::now();
        running.signal(Signal::INT);
        if second {
            // The mask is 0 only when all is over: until then there is something to interrupt.
            running.wait_for("asked to end");
            running.signal(Signal::INT);
        }
        let (code, output, _) = running.end();
        assert_eq!(code, Some(if second { 130 } else { 0 }));
        assert!(second || begun.elapsed().as_secs() >= 5, "SIGTERM has its time");
        assert_eq!(logged(&events(&output), "was killed").len(), 1, "{output}");
        for pid in pids {
            assert!(!is_alive(pid), "{pid} outlived the run");
        }
    }
}

#[test]
fn killing_rapid_ends_its_programs() {
    let place = Place::new();
    registry(&place, ", \"--ignore-sigterm\"", "");
    let running = place.start(&sim(&place, ""), "\"streaming\"");
    let pids = wait_for_programs(&running);
    assert!(pids.iter().all(|pid| is_alive(*pid)) && pids.len() == 1);
    running.signal(Signal::KILL);
    running.end();
    until("the program outlived rapid", || !pids.iter().any(|pid| is_alive(*pid)));
}

#[test]
fn the_file_of_a_device_continues_across_runs() {
    let place = Place::new();
    registry(&place, "", "");
    for run in 1..=2 {
        let running = place.start(&sim(&place, ""), "\"streaming\"");
        running.signal(Signal::INT);
        assert_eq!(running.end().0, Some(0));
        let kept = place.logbook("counter");
        assert_eq!(kept.matches("its process was ended by SIGTERM").count(), run, "{kept}");
        assert!(kept.lines().all(|line| line.starts_with("20") && line.contains("Z ")), "{kept}");
    }
}

#[test]
fn a_program_that_cannot_be_found_is_reported_before_anything_runs() {
    let place = Place::new();
    place.write("devices.toml", "[device.counter]\nvid = \"1\"\npid = \"2\"\nbit = 0\nnode = \"no_such_program\"\n");
    let output = place.run(&sim(&place, ""));
    assert_eq!(output.status.code(), Some(2));
    let printed = String::from_utf8_lossy(&output.stderr);
    assert!(printed.contains("node \"no_such_program\" is neither built in nor a program"), "{printed}");
}
