//! The whole rig on simulated devices: each scenario is run by the real binary and recorded; what it
//! announced and what it wrote are held against what the scenario must lead to.
//!
//! A scenario is `scenarios/NAME.toml`, as `rapid --sim` takes it, with the registry
//! `scenarios/NAME.devices.toml`, or the built-in one if there is none, and `NAME.expect.toml`
//! ([`Expectation`]). Whatever is expected, every recording must obey these rules:
//!
//! 1. The mask goes through the values expected, in order. Between two of them every change sets or
//!    clears bits in which the two differ, towards the later one; where they differ in one bit there
//!    is therefore nothing between them.
//! 2. No sample of a modality was captured after its `detach` event and before its next `attach`,
//!    or before its first `attach`.
//! 3. The sequence numbers of a modality have no hole, an unplug included: what was not sent while
//!    unplugged was not lost.
//! 4. Every payload is, byte for byte, one that a device of the scenario that may be this modality
//!    sends as some number; within one attachment that number grows with the message's sequence.
//! 5. There are `duration * observation_hz` frames, numbered from 0. A frame has the mask in force at
//!    its tick, every modality of the registry, `present` where the bit is set, `valid` only where it
//!    is. Where it is valid the sample named is in the file and within the window. For a modality
//!    that stayed plugged it is the nearest of those received by the frame's deadline.
//! 6. A device that returns within the cooldown is not opened before its end.
//! 7. The events in the file are those announced while it was recorded.
//! 8. Metadata and summary agree with the registry and the messages.
//! 9. The verdict and its reasons are those expected, the same in the event, in the file and in what
//!    `inspect` makes of the file.
//!
//! Devices with faults break rules 3, 4 and 8 by intention, and are not held to them.
//!
//! A scenario's clock begins with the program, the recording once every device delivers. On a machine
//! so loaded that this takes longer than the scenario's first event, or that the mask with the last of them
//! is published only after the beginning, the run shows nothing: it is made again.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::sync::Grid;
use rapid_core::time::Stamp;
use rapid_devices::driver::sim;
use rapid_episode::record::inspect::{Inspection, inspect};
use rapid_registry::scenario::{Scenario, ScenarioDevice};
use rapid_registry::simulation::{SimFaults, SimSource};
use rapid_registry::{DeviceSpec, Registry};

use crate::support::{self, Episode, EventMessage, Message, Place, events};
use serde::Deserialize;
use serde_json::Value;

/// `NAME.expect.toml`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Expectation {
    /// Length of the recording.
    duration: String,
    /// Rule 1.
    mask: Vec<String>,
    /// Beginnings of reports of devices that no entry means, in order.
    #[serde(default)]
    unregistered: Vec<String>,
    /// Every modality of the registry.
    device: BTreeMap<String, ExpectedDevice>,
    /// Rule 9.
    verdict: String,
    /// Beginnings of the reasons, in any order.
    #[serde(default)]
    reasons: Vec<String>,
    /// Beginnings of the lines of the log, each of which comes at least once.
    #[serde(default)]
    log: Vec<String>,
}

impl Expectation {
    fn masks(&self) -> impl Iterator<Item = u64> {
        self.mask.iter().map(|mask| u64::from_str_radix(mask.trim_start_matches("0x"), 16).expect("a mask"))
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ExpectedDevice {
    /// Every state that is announced.
    states: Vec<String>,
    /// Least number of messages in the recording.
    messages: usize,
    /// Port of every attachment that is announced.
    ports: Vec<String>,
    /// Devices of the scenario it may be; the one of its own name if not given.
    from: Option<Vec<String>>,
}

/// Runs of a scenario before the machine is given up.
const ATTEMPTS: usize = 5;

struct Run {
    registry: Registry,
    scenario: Scenario,
    expected: Expectation,
    events: Vec<Value>,
    episode: Episode,
    inspected: Inspection,
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/scenarios")
}

fn check(name: &str) {
    let run = run(name);
    masks(&run);
    states(&run);
    absences(&run);
    sequences(&run);
    payloads(&run);
    frames(&run);
    cooldowns(&run);
    recorded_events(&run);
    metadata(&run);
    verdict(&run);
}

fn run(name: &str) -> Run {
    let scenario_file = folder().join(format!("{name}.toml"));
    let devices = folder().join(format!("{name}.devices.toml"));
    let devices = devices.exists().then_some(devices);
    let registry = devices.as_deref().map_or_else(Registry::builtin, |path| {
        let loaded = Registry::load(path).unwrap_or_else(|errors| panic!("{errors}"));
        assert!(loaded.warnings.is_empty(), "{:?}", loaded.warnings);
        loaded.registry
    });
    let scenario = Scenario::load(&scenario_file, &registry).unwrap_or_else(|errors| panic!("{errors}"));
    let text = std::fs::read_to_string(folder().join(format!("{name}.expect.toml"))).expect("expectation");
    let expected: Expectation = toml::from_str(&text).unwrap_or_else(|error| panic!("{name}: {error}"));

    for _ in 0..ATTEMPTS {
        let place = Place::new();
        let scenario_file = scenario_file.display().to_string();
        let mut arguments = vec!["--sim", &scenario_file, "--headless", "--json", "--record", "--out", "out"];
        arguments.extend(["--duration", &expected.duration]);
        let devices = devices.as_ref().map(|path| path.display().to_string());
        if let Some(devices) = &devices {
            arguments.extend(["--config", devices]);
        }
        let output = place.run(&arguments);
        let printed = String::from_utf8_lossy(&output.stderr);
        let shown = String::from_utf8_lossy(&output.stdout);
        assert_eq!(output.status.code(), support::recorded_code(&shown), "{printed}");
        let events = events(&String::from_utf8_lossy(&output.stdout));
        if !began_in_time(&events, &scenario) {
            continue;
        }
        let files = place.files("out");
        assert_eq!(files.len(), 1, "{files:?}");
        let file = place.path("out").join(&files[0]);
        let episode = Episode::read(&file);
        if episode.mask_edges().first().map(|(_, mask)| *mask) != expected.masks().next() {
            continue;
        }
        let inspected = inspect(&file).expect("an episode");
        return Run { registry, scenario, expected, events, episode, inspected };
    }
    panic!(
        "in {ATTEMPTS} runs the recording never began before the scenario's first event, with the first mask expected"
    );
}

/// Did the recording begin before anything happened, with everything delivering that is plugged?
fn began_in_time(events: &[Value], scenario: &Scenario) -> bool {
    let recording = events.iter().position(|event| event["event"] == "recording").expect("a recording");
    let first = scenario.events.first().map_or(Duration::MAX, |event| event.at);
    let freezes = scenario.devices.iter().filter_map(|device| device.faults.freeze_at);
    let first = freezes.min().unwrap_or(first).min(first);
    let begun = stamp(&events[0]);
    let plugged = scenario.devices.iter().filter(|device| device.plugged).count();
    let streaming = events[..recording].iter().filter(|event| event["state"] == "streaming").count();
    streaming == plugged && u128::from(stamp(&events[recording]) - begun) < first.as_nanos()
}

fn stamp(event: &Value) -> u64 {
    event["stamp"].as_u64().expect("a stamp")
}

impl Run {
    fn of<'a>(&'a self, device: &'a str, kind: &'a str) -> impl Iterator<Item = &'a Value> {
        self.events.iter().filter(move |event| event["event"] == kind && event["device"] == device)
    }

    /// Attach and detach events in order, as stamps.
    fn attachments(&self, device: &str) -> Vec<(u64, Option<u64>)> {
        let mut attachments: Vec<(u64, Option<u64>)> = Vec::new();
        for event in self.events.iter().filter(|event| event["device"] == device) {
            match (event["event"].as_str(), attachments.last_mut()) {
                (Some("attach"), last) => {
                    assert!(last.is_none_or(|(_, end)| end.is_some()), "{device}: attached twice");
                    attachments.push((stamp(event), None));
                }
                (Some("detach"), last) => {
                    let end = &mut last.expect("detached after it was attached").1;
                    assert!(end.replace(stamp(event)).is_none(), "{device}: detached twice");
                }
                _ => {}
            }
        }
        attachments
    }

    /// Stamp of a log time.
    fn monotonic(&self, log_time: u64) -> u64 {
        let offset: i128 = self.episode.value("rapid", "wall_minus_monotonic_ns").parse().expect("a number");
        u64::try_from(i128::from(log_time) - offset).expect("after boot")
    }

    fn messages<'a>(&'a self, device: &'a DeviceSpec) -> Vec<&'a Message> {
        let mut messages: Vec<_> = self.episode.topic(&device.topic).collect();
        messages.sort_by_key(|message| message.sequence);
        messages
    }

    /// Does a device that may be this modality do something wrong?
    fn is_faulty(&self, device: &DeviceSpec) -> bool {
        let own = vec![device.name.clone()];
        let from = self.expected.device[&device.name].from.as_ref().unwrap_or(&own);
        let faulty = |source: &ScenarioDevice| source.faults != SimFaults::default() && from.contains(&source.name);
        self.scenario.devices.iter().any(faulty)
    }

    /// Is the device plugged all the time?
    fn stays(&self, device: &str) -> bool {
        self.attachments(device).first().is_some_and(|(_, end)| end.is_none())
            && self.of(device, "attach").next().map(stamp) < self.recording().next().map(stamp)
    }

    fn recording(&self) -> impl Iterator<Item = &Value> {
        self.events.iter().filter(|event| event["event"] == "recording")
    }
}

/// Rule 1.
fn masks(run: &Run) {
    let expected: Vec<u64> = run.expected.masks().collect();
    let edges: Vec<u64> = run.episode.mask_edges().into_iter().map(|(_, mask)| mask).collect();
    let mut targets = expected.iter().copied();
    assert_eq!(edges.first().copied(), targets.next(), "{edges:x?}");
    let mut target = targets.next();
    for pair in edges.windows(2) {
        let wanted = target.unwrap_or_else(|| panic!("{edges:x?} continues after {expected:x?}"));
        assert_eq!((pair[0] ^ pair[1]) & !(pair[0] ^ wanted), 0, "{edges:x?} on the way to {wanted:x}");
        if pair[1] == wanted {
            target = targets.next();
        }
    }
    assert_eq!(target, None, "{edges:x?} never got there");
}

fn states(run: &Run) {
    let known: BTreeSet<&str> = run.registry.devices.iter().map(|device| device.name.as_str()).collect();
    assert_eq!(run.expected.device.keys().map(String::as_str).collect::<BTreeSet<_>>(), known);
    for (device, expected) in &run.expected.device {
        let states: Vec<_> = run.of(device, "state").map(|event| event["state"].as_str().expect("a word")).collect();
        assert_eq!(states, expected.states, "{device}");
        let ports: Vec<_> = run.of(device, "attach").map(|event| event["port"].as_str().expect("a port")).collect();
        assert_eq!(ports, expected.ports, "{device}");
    }
    let strangers: Vec<_> = run.events.iter().filter(|event| event["event"] == "unregistered").collect();
    assert_eq!(strangers.len(), run.expected.unregistered.len(), "{strangers:?}");
    for (stranger, begins) in strangers.iter().zip(&run.expected.unregistered) {
        assert!(stranger["device"].as_str().is_some_and(|device| device.starts_with(begins)), "{stranger}");
    }
    let mut missed = run.events.iter().filter(|event| event["event"] == "missed");
    assert_eq!(missed.next(), None);
    let logged = run.events.iter().filter(|event| event["event"] == "log");
    let logged: Vec<&str> = logged.map(|event| event["text"].as_str().expect("text")).collect();
    let expected = &run.expected.log;
    let surprising: Vec<_> = logged
        .iter()
        .filter(|line| !is_load(line) && !expected.iter().any(|begins| line.starts_with(begins)))
        .collect();
    assert!(surprising.is_empty(), "{surprising:?}");
    for begins in expected {
        assert!(logged.iter().any(|line| line.starts_with(begins)), "{begins:?} in {logged:?}");
    }
}

/// On a machine that is loaded enough, samples come too late for their frame: that is true, and no
/// fault of the scenario's.
fn is_load(text: &str) -> bool {
    text.contains("too late for their frame")
}

/// Rule 2.
fn absences(run: &Run) {
    for device in &run.registry.devices {
        let attachments = run.attachments(&device.name);
        for message in run.messages(device) {
            let captured = run.monotonic(message.log_time);
            let inside =
                attachments.iter().any(|(begin, end)| captured >= *begin && end.is_none_or(|end| captured <= end));
            assert!(inside, "{}: captured at {captured}, attached {attachments:?}", device.name);
        }
    }
}

/// Rule 3.
fn sequences(run: &Run) {
    for device in &run.registry.devices {
        let messages = run.messages(device);
        let least = run.expected.device[&device.name].messages;
        assert!(messages.len() >= least, "{}: {} messages", device.name, messages.len());
        assert!(run.episode.channels.contains(&device.topic), "{}", device.topic);
        if run.is_faulty(device) {
            continue;
        }
        for pair in messages.windows(2) {
            let (before, after) = (pair[0], pair[1]);
            assert_eq!(after.sequence, before.sequence + 1, "{}", device.name);
            assert!(after.log_time > before.log_time, "{}: {} goes back", device.name, after.sequence);
        }
    }
}

/// Rule 4.
fn payloads(run: &Run) {
    for device in run.registry.devices.iter().filter(|device| !run.is_faulty(device)) {
        let own = vec![device.name.clone()];
        let from = run.expected.device[&device.name].from.as_ref().unwrap_or(&own);
        let sources: Vec<&SimSource> = from
            .iter()
            .map(|name| &run.scenario.devices.iter().find(|source| source.name == *name).expect("a device").source)
            .collect();
        let attachments = run.attachments(&device.name);
        let mut numbers: BTreeMap<usize, Vec<(u32, u32, usize)>> = BTreeMap::new();
        for message in run.messages(device) {
            let payload = message.payload();
            let number = number(&payload);
            let of = |source: &&SimSource| sim::frame(source, number).as_ref() == Some(&payload);
            let source = sources.iter().position(of);
            let source = source.unwrap_or_else(|| panic!("{}: foreign payload, number {number}", device.name));
            let captured = run.monotonic(message.log_time);
            let attachment = attachments.iter().rposition(|(begin, _)| *begin <= captured).expect("rule 2");
            numbers.entry(attachment).or_default().push((number, message.sequence, source));
        }
        for (attachment, numbers) in numbers {
            let (first, sequence, source) = numbers[0];
            for (number, of, from) in numbers {
                assert_eq!(number - first, of - sequence, "{}: attachment {attachment}", device.name);
                assert_eq!(from, source, "{}: another unit in attachment {attachment}", device.name);
            }
        }
    }
}

/// The number a simulated device wrote into a payload: in the comment of a picture, or as the first
/// of its numbers.
fn number(payload: &[u8]) -> u32 {
    if payload.starts_with(&[0xff, 0xd8]) {
        let length = usize::from(u16::from_be_bytes([payload[4], payload[5]]));
        let comment = std::str::from_utf8(&payload[6..4 + length]).expect("text");
        return comment.rsplit(' ').next().and_then(|number| number.parse().ok()).expect("a number");
    }
    let first = f64::from_le_bytes(*payload.first_chunk().expect("a number"));
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "compared with the bytes afterwards")]
    let number = first as u32;
    number
}

/// Whether it is a JPEG without its end: the one way in which the simulator damages pictures.
fn is_cut(sample: &Message) -> bool {
    let payload = sample.payload();
    payload.starts_with(&[0xff, 0xd8]) && !payload.ends_with(&[0xff, 0xd9])
}

/// Rule 5.
fn frames(run: &Run) {
    let duration = humantime::parse_duration(&run.expected.duration).expect("a duration");
    let window = u64::try_from(run.registry.rig.sync_window.as_nanos()).expect("short");
    let frames = run.episode.frames();
    let begin = Stamp(run.episode.value("rapid", "begin_monotonic_ns").parse().expect("a number"));
    let grid = Grid::new(begin, run.registry.rig.observation_hz);
    assert_eq!(frames.len() as u64, grid.ticks_before(begin.after(duration)));
    let masks: Vec<(u64, u64)> = run
        .episode
        .topic("/rapid/mask")
        .map(|message| (message.log_time, message.decode::<support::MaskMessage>().mask))
        .collect();
    let samples: Vec<Vec<&Message>> = run.registry.devices.iter().map(|device| run.messages(device)).collect();
    let stays: Vec<bool> = run.registry.devices.iter().map(|device| run.stays(&device.name)).collect();
    let mut valid = vec![0; run.registry.devices.len()];
    for (index, (message, frame)) in frames.iter().enumerate() {
        assert_eq!((frame.index, message.sequence as usize), (index as u64, index));
        let tick = message.log_time;
        assert_eq!(run.monotonic(tick), grid.tick(frame.index).0, "frame {index}");
        let in_force = masks.iter().rfind(|(time, _)| *time <= tick).expect("the mask before the first tick").1;
        assert_eq!(frame.mask, in_force, "frame {index}");
        assert_eq!(frame.modalities.len(), run.registry.devices.len());
        for (at, (slot, device)) in frame.modalities.iter().zip(&run.registry.devices).enumerate() {
            let what = format!("frame {index}, {}: {slot:?}", device.name);
            assert_eq!(slot.bit, u32::from(device.id.bit()), "{what}");
            assert_eq!(slot.present, in_force >> slot.bit & 1 == 1, "{what}");
            assert!(slot.plugged || !slot.present, "{what}: it runs, and is not plugged in");
            assert!(slot.present || !(slot.valid || slot.stale || slot.seq.is_some()), "{what}");
            assert_eq!(slot.stale, slot.present && !slot.valid, "{what}");
            if slot.valid {
                valid[at] += 1;
                let seq = slot.seq.expect("a valid sample has a number");
                let named = samples[at].iter().find(|sample| u64::from(sample.sequence) == seq);
                let named = named.unwrap_or_else(|| panic!("not in the file: {what}"));
                assert!(named.log_time.abs_diff(tick) <= window, "{what}");
                assert!(!is_cut(named), "not a whole picture: {what}");
                let age = i128::from(tick) - i128::from(named.log_time);
                assert_eq!(slot.age_ns.map(i128::from), Some(age), "{what}");
            }
            if stays[at] && slot.present {
                let nearest = samples[at]
                    .iter()
                    .filter(|sample| sample.publish_time.max(sample.log_time) <= message.publish_time)
                    .filter(|sample| sample.log_time.abs_diff(tick) <= window && !is_cut(sample))
                    .min_by_key(|sample| (sample.log_time.abs_diff(tick), sample.log_time, sample.sequence));
                let nearest = nearest.map(|sample| u64::from(sample.sequence));
                assert_eq!(slot.seq.filter(|_| slot.valid), nearest, "{what}");
            }
        }
    }
    for (device, valid) in run.registry.devices.iter().zip(valid) {
        let messages = run.expected.device[&device.name].messages;
        assert!(valid > 0 || messages == 0 || run.is_faulty(device), "{} is valid in no frame", device.name);
    }
}

/// Rule 6, of which the simulator of the core checks the exact times. Here events are stamped when they are announced,
/// after the step that decided; what certainly precedes a removal is the last sample before it.
fn cooldowns(run: &Run) {
    let cooldown = u64::try_from(run.registry.rig.cooldown.as_nanos()).expect("short");
    for device in &run.registry.devices {
        let openings: Vec<u64> =
            run.of(&device.name, "state").filter(|event| event["state"] == "opening").map(stamp).collect();
        for (attached, detached) in run.attachments(&device.name) {
            let Some(detached) = detached else { continue };
            let Some(next) = openings.iter().find(|opening| **opening > detached) else { continue };
            let samples = run.messages(device).into_iter().map(|message| run.monotonic(message.log_time));
            let last = samples.filter(|stamp| *stamp <= detached).fold(attached, u64::max);
            assert!(next - last >= cooldown, "{}: opened {} ns after", device.name, next - last);
        }
    }
}

/// Rule 7.
fn recorded_events(run: &Run) {
    let begin: u64 = run.episode.value("rapid", "begin_monotonic_ns").parse().expect("a number");
    let duration = humantime::parse_duration(&run.expected.duration).expect("a duration");
    let end = begin + u64::try_from(duration.as_nanos()).expect("short");
    let announced: Vec<Value> = run
        .events
        .iter()
        .filter(|event| event["stamp"].as_u64().is_some_and(|stamp| (begin..end).contains(&stamp)))
        .map(|event| {
            let mut event = event.clone();
            event.as_object_mut().expect("an object").remove("time");
            event
        })
        .collect();
    let recorded: Vec<Value> = run
        .episode
        .topic("/rapid/event")
        .map(|message| serde_json::from_str(&message.decode::<EventMessage>().json).expect("JSON"))
        .collect();
    assert_eq!(recorded, announced);
}

/// Rule 8.
fn metadata(run: &Run) {
    let json = |name, key| -> Value { serde_json::from_str(run.episode.value(name, key)).expect("JSON") };
    let layout: BTreeMap<&str, u8> =
        run.registry.devices.iter().map(|device| (device.name.as_str(), device.id.bit())).collect();
    assert_eq!(json("rapid", "layout"), serde_json::json!(layout));
    assert_eq!(run.episode.value("rapid", "registry"), run.registry.text);
    let modalities = json("rapid", "modalities");
    let topics: Vec<_> = modalities.as_array().expect("a list").iter().map(|modality| &modality["topic"]).collect();
    assert_eq!(topics, run.registry.devices.iter().map(|device| &device.topic).collect::<Vec<_>>());
    let counted = json("rapid/summary", "modalities");
    for device in &run.registry.devices {
        let printed = &counted[&device.name];
        let messages = run.messages(device);
        let bytes: usize = messages.iter().map(|message| message.payload().len()).sum();
        assert_eq!(
            (&printed["samples"], &printed["bytes"]),
            (&messages.len().into(), &bytes.into()),
            "{}",
            device.name
        );
        for fault in ["lost", "dropped", "damaged", "truncated", "duplicates", "repeated"] {
            assert!(printed[fault] == 0 || run.is_faulty(device), "{}: {fault} {}", device.name, printed[fault]);
        }
    }
    for (key, expected) in [("dropped", 0), ("masks_dropped", 0), ("events_missed", 0)] {
        assert_eq!(run.episode.value("rapid/summary", key), expected.to_string(), "{key}");
    }
    assert_eq!(run.episode.value("rapid/summary", "messages"), run.episode.messages.len().to_string());
    let ended = run.events.iter().find(|event| event["event"] == "episode").expect("an episode");
    assert_eq!((&ended["dropped"], &ended["error"]), (&0.into(), &Value::Null));
}

/// Rule 9.
fn verdict(run: &Run) {
    let reasons: Vec<String> = serde_json::from_str(run.episode.value("rapid/summary", "reasons")).expect("JSON");
    let word = run.episode.value("rapid/summary", "verdict");
    let ended = run.events.iter().find(|event| event["event"] == "episode").expect("an episode");
    assert_eq!((&ended["verdict"], &ended["reasons"]), (&word.into(), &serde_json::json!(reasons)));

    let Inspection { verdict, recorded_verdict, modalities, .. } = &run.inspected;
    let verdict = verdict.verdict().expect("an episode");
    assert_eq!((verdict.grade.word(), &verdict.reasons), (word, &reasons), "inspect has the same verdict");
    assert_eq!(recorded_verdict.as_ref(), Some(verdict));
    let counted: Value = serde_json::from_str(run.episode.value("rapid/summary", "modalities")).expect("JSON");
    for modality in modalities {
        let read = serde_json::to_value(modality.quality).expect("JSON");
        assert_eq!(read, counted[&modality.name], "{}: inspect counts the same", modality.name);
    }

    // Whoever has a sample and was not present in between is named, with the time.
    let edges = run.episode.mask_edges();
    let is_away = |bit: u8| edges.iter().any(|(_, mask)| mask & (1 << bit) == 0);
    let sensors = verdict.sensors.as_ref().expect("those of the registry");
    let named: BTreeSet<&str> = sensors.away.iter().map(|absence| absence.name.as_str()).collect();
    let away = modalities.iter().filter(|modality| modality.topic.messages > 0 && is_away(modality.bit));
    assert_eq!(named, away.map(|modality| modality.name.as_str()).collect());
    assert!(sensors.away.iter().all(|absence| absence.seconds > 0.0 && absence.seconds < absence.of), "{sensors}");
    let sentence = ended["sensors"]["away"].as_array().map_or(0, Vec::len);
    assert_eq!(sentence, named.len(), "the end of the episode names them, too");

    let expected = &run.expected.reasons;
    for begins in expected {
        assert!(reasons.iter().any(|reason| reason.starts_with(begins)), "{begins:?} in {reasons:?}");
    }
    let surprising: Vec<_> =
        reasons.iter().filter(|reason| !expected.iter().any(|begins| reason.starts_with(begins))).collect();
    assert!(surprising.iter().all(|reason| is_load(reason)), "{surprising:?}");
    if surprising.is_empty() {
        assert_eq!(word, run.expected.verdict, "{reasons:?}");
    }
}

macro_rules! scenarios {
    ($($name:ident)*) => {
        $(#[test] fn $name() { check(stringify!($name)); })*

        #[test]
        fn every_scenario_in_the_folder_is_run() {
            let run: BTreeSet<String> = [$(stringify!($name).to_owned()),*].into();
            let written: BTreeSet<String> = std::fs::read_dir(folder())
                .expect("folder")
                .filter_map(|entry| entry.expect("entry").file_name().into_string().ok()?.strip_suffix(".expect.toml").map(str::to_owned))
                .collect();
            assert_eq!(run, written);
        }
    };
}

scenarios! {
    demonstration
    replug_into_the_same_port
    replug_into_another_port
    equal_units_without_serial
    silence
    a_stranger
    everything_at_once
    bouncing
    absent_at_the_start
    a_frozen_camera
    damaged_lost_and_twice
    late_and_fast
    away_and_expected
    another_unit_takes_over
}
