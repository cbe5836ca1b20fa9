//! `rapid --infer` from the command line to the recording: the trained policy on simulated devices that
//! come and go.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::path::Path;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::{self, Episode, EventMessage, Place, events, until};

/// What the policy observes. A replugged device may be started at once.
const REGISTRY: &str = r#"
[rig]
name = "infer"
observation_hz = 10
cooldown = "0ms"

[device.cam_wrist]
vid = "1209"
pid = "7a01"
node = "camera"
bit = 0
[device.cam_wrist.camera]
width = 96
height = 96
fps = 30

[device.tactile_tip]
vid = "1209"
pid = "7a02"
node = "camera"
bit = 1
[device.tactile_tip.camera]
width = 96
height = 96
fps = 30

[device.arm]
vid = "1209"
pid = "7a03"
node = "can"
bit = 2
[device.arm.can]
protocol = "damiao"
motors = [
    { name = "x", slave = 1, type = "DM4310", kp = 20, kd = 1, position = [-1.1, 1.0] },
    { name = "y", slave = 2, type = "DM4310", kp = 20, kd = 1, position = [-1.0, 1.0] },
    { name = "z", slave = 3, type = "DM4310", kp = 20, kd = 1, position = [0.03, 0.9] },
    { name = "grip", slave = 4, type = "DM4310", kp = 20, kd = 1, position = [0.0, 1.0] },
]
"#;

/// The tactile sensor is pulled out for five seconds: a busy machine computes for more than one of them before it acts.
const PULLED: &str = "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\nname = \"arm\"\n\
                      [[event]]\nat = \"3s\"\nunplug = \"tactile_tip\"\n[[event]]\nat = \"8s\"\nplug = \"tactile_tip\"\n";

/// For longer and longer: a machine that is busier still needs many seconds for a chunk.
const PULLED_AGAIN: &str = "[[event]]\nat = \"18s\"\nunplug = \"tactile_tip\"\n[[event]]\nat = \"38s\"\nplug = \"tactile_tip\"\n\
                            [[event]]\nat = \"58s\"\nunplug = \"tactile_tip\"\n[[event]]\nat = \"118s\"\nplug = \"tactile_tip\"\n";

/// All sensors stay.
const PLUGGED: &str =
    "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\nname = \"arm\"\n";

/// The folder of the policy of the repository.
const BUNDLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/tactile-id");

/// Runs a policy in `place` and gives the exit code, the events and standard error.
fn infer(place: &Place, bundle: &str, scenario: &str, more: &[&str]) -> (Option<i32>, Vec<Value>, String) {
    let registry = place.write("rig.toml", REGISTRY).display().to_string();
    let scenario = place.write("play.toml", scenario).display().to_string();
    let arguments = ["--json", "--infer", bundle, "--config", &registry, "--sim", &scenario];
    let output = place.run(&[&arguments[..], more].concat());
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    (output.status.code(), events(&text), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// The same, interrupted once what it has reported is enough: how long that takes depends on the machine.
fn infer_until(
    place: &Place,
    bundle: &str,
    scenario: &str,
    more: &[&str],
    is_enough: impl Fn(&[Value]) -> bool,
) -> (Option<i32>, Vec<Value>, String) {
    let registry = place.write("rig.toml", REGISTRY).display().to_string();
    let scenario = place.write("play.toml", scenario).display().to_string();
    let arguments = ["--json", "--infer", bundle, "--config", &registry, "--sim", &scenario];
    let running = place.start(&[&arguments[..], more].concat(), "\"event\":");
    until("what is needed", || is_enough(&running.reported()));
    running.signal(Signal::INT);
    let (code, printed, stderr) = running.end();
    (code, events(&printed), stderr)
}

/// Has a chunk been computed with this mask, after `events[..from]`? The place of the first.
fn asked(events: &[Value], mask: &str, from: usize) -> Option<usize> {
    (from..events.len()).find(|at| events[*at]["event"] == "chunk" && events[*at]["mask"] == mask)
}

/// Has it been asked with all sensors, without one, and with all again?
fn pulled_and_back(events: &[Value]) -> bool {
    let with = asked(events, "0x07", 0);
    let without = with.and_then(|at| asked(events, "0x05", at));
    without.and_then(|at| asked(events, "0x07", at)).is_some()
}

/// Has it, without the sensor, acted on a chunk until it was asked for the next one, and was it asked with all sensors later?
/// Between two absences the sensor sends for at least ten seconds.
fn acted_without(events: &[Value]) -> bool {
    let chunks: Vec<_> = of(events, "chunk").collect();
    let is_out = |chunk: &Value| chunk["mask"] == "0x05";
    let ticks = |pair: &[&Value]| pair[1]["tick"].as_u64().zip(pair[0]["tick"].as_u64()).map(|(next, one)| next - one);
    let is_one_absence = |pair: &[&Value]| pair.iter().all(|chunk| is_out(chunk)) && ticks(pair) < Some(100);
    let acted = chunks.windows(2).position(|pair| is_one_absence(pair) && pair[0]["used"] == true);
    acted.is_some_and(|acted| chunks[acted..].iter().any(|chunk| !is_out(chunk)))
}

/// The same, interrupted once the policy acts: how long it takes to load depends on the machine.
fn infer_until_it_acts(place: &Place, arguments: &[&str]) -> (Option<i32>, Vec<Value>, String) {
    let running = place.start(&[&["--json", "--infer"], arguments].concat(), "\"event\":\"act\"");
    running.signal(Signal::INT);
    let (code, printed, stderr) = running.end();
    (code, events(&printed), stderr)
}

/// The exit code by the verdicts of the episodes.
fn recorded_code(events: &[Value]) -> Option<i32> {
    support::recorded_code(&events.iter().map(Value::to_string).collect::<Vec<_>>().join("\n"))
}

fn of<'a>(events: &'a [Value], event: &'a str) -> impl Iterator<Item = &'a Value> {
    events.iter().filter(move |printed| printed["event"] == event)
}

/// Numbers of the samples of a modality that a chunk was computed from.
fn samples(chunk: &Value, modality: &str) -> usize {
    let samples = chunk["samples"].as_array().expect("samples");
    let of = samples.iter().find(|of| of["modality"] == modality).expect("the modality");
    of["seqs"].as_array().expect("numbers").len()
}

/// Holds for another reason than that the machine is slow.
fn holds(events: &[Value]) -> Vec<&Value> {
    of(events, "hold").filter(|hold| hold["reason"] != "the next actions are still being computed").collect()
}

/// A copy of the policy in `place` whose `policy.json` has `to` in place of `from`.
fn changed(place: &Place, from: &str, to: &str) -> String {
    let folder = place.path("policy");
    std::fs::create_dir(&folder).expect("folder");
    for file in ["encoder.onnx", "denoiser.onnx"] {
        std::fs::copy(Path::new(BUNDLE).join(file), folder.join(file)).expect("graph");
    }
    let text = std::fs::read_to_string(Path::new(BUNDLE).join("policy.json")).expect("policy.json");
    assert!(text.contains(from), "{from}");
    std::fs::write(folder.join("policy.json"), text.replacen(from, to, 1)).expect("policy.json");
    folder.display().to_string()
}

/// The same with so many actions of a chunk executed, at another rate.
pub(crate) fn paced(place: &Place, executed: u32, hz: f64) -> String {
    let rate = |executed: u32, hz: f64| {
        format!("\"n_action_steps\": {executed},\n  \"action_start\": 1,\n  \"control_hz\": {hz:.1},")
    };
    changed(place, &rate(8, 10.0), &rate(executed, hz))
}

#[test]
fn a_pulled_sensor_is_left_out_at_the_next_tick_and_actions_continue() {
    let place = Place::new();
    let scenario = [PULLED, PULLED_AGAIN].concat();
    let is_enough = |events: &[Value]| pulled_and_back(events) && acted_without(events);
    let (code, printed, stderr) = infer_until(&place, BUNDLE, &scenario, &["--record", "--out", "out"], is_enough);
    assert_eq!(code, recorded_code(&printed), "{stderr}");
    let policy = of(&printed, "policy").next().expect("an event of the policy");
    assert_eq!((&policy["policy"], &policy["dry_run"]), (&"tactile-id".into(), &false.into()));
    assert!(holds(&printed).is_empty(), "{:?}", holds(&printed));
    let masks: Vec<_> =
        of(&printed, "chunk").map(|chunk| (chunk["mask"].as_str(), samples(chunk, "tactile_tip"))).collect();
    assert!(masks.contains(&(Some("0x07"), 2)) && masks.contains(&(Some("0x05"), 0)), "{masks:?}");
    assert!(masks.iter().all(|mask| matches!(mask, (Some("0x07"), 2) | (Some("0x05"), 0))), "{masks:?}");
    assert_eq!(masks.last(), Some(&(Some("0x07"), 2)), "it is back");

    // The recording holds what the policy saw and what it did.
    let files = place.files("out");
    let episode = Episode::read(&place.path("out").join(files.first().expect("an episode")));
    let recorded: Vec<Value> = episode
        .topic("/rapid/event")
        .map(|message| serde_json::from_str(&message.decode::<EventMessage>().json).expect("JSON"))
        .collect();
    let chunks: Vec<_> = recorded.iter().filter(|event| event["event"] == "chunk").collect();
    // All of them but the one that was being computed when the episode ended, if there was one.
    let ticks = |chunk: &Value| chunk["tick"].as_u64();
    let announced: Vec<_> = of(&printed, "chunk").map(ticks).collect();
    assert_eq!(chunks.iter().map(|chunk| ticks(chunk)).collect::<Vec<_>>(), announced[..chunks.len()]);
    assert!(announced.len() - chunks.len() <= 1, "{announced:?}");
    let actions: Vec<_> = episode.topic("/action").collect();
    // An action is recorded at its tick, and the ticks lie on the grid.
    let first = actions.first().expect("an action");
    for action in &actions {
        let ticks = u64::from(action.sequence - first.sequence);
        assert_eq!(action.log_time - first.log_time, ticks * 100_000_000);
    }
    // While the bit was clear, actions continued.
    let edges = episode.mask_edges();
    let out = edges.iter().position(|(_, mask)| *mask == 0x05).expect("it was pulled out");
    let from = edges[out].0;
    let acts = |pair: &[(u64, u64)]| actions.iter().any(|action| (pair[0].0..pair[1].0).contains(&action.log_time));
    assert!(edges.windows(2).any(|pair| pair[0].1 == 0x05 && acts(pair)), "{edges:?}");

    // The first tick after the bit was cleared asks without it, unless a chunk is being computed at that time.
    let asked = chunks.iter().filter(|chunk| chunk["mask"] == "0x05").filter_map(|chunk| chunk["tick"].as_u64()).min();
    let begin = first.log_time - u64::from(first.sequence) * 100_000_000;
    let cleared = (from - begin).div_ceil(100_000_000);
    let before = chunks.iter().filter_map(|chunk| chunk["tick"].as_u64()).filter(|tick| *tick < cleared).max();
    let busy = before.is_some_and(|tick| {
        let late = chunks.iter().find(|chunk| chunk["tick"] == tick).and_then(|chunk| chunk["latency_ms"].as_f64());
        late.is_some_and(|ms| tick as f64 + ms / 100.0 > cleared as f64)
    });
    // A tick that a busy machine left out has no action either.
    let acted = |asked: u64| actions.iter().any(|action| (cleared..asked).contains(&u64::from(action.sequence)));
    assert!(
        busy || asked.is_some_and(|asked| asked >= cleared && !acted(asked)),
        "cleared at tick {cleared}, asked at {asked:?}"
    );
}

#[test]
fn without_required_modalities_it_does_not_start_unless_it_may_wait() {
    let place = Place::new();
    let arm_later = "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\nname = \"arm\"\n\
                     plugged = false\n[[event]]\nat = \"5s\"\nplug = \"arm\"\n";
    let (code, printed, stderr) = infer(&place, BUNDLE, arm_later, &["--duration", "20s"]);
    assert_eq!(code, Some(3), "{stderr}");
    assert!(stderr.contains("the policy needs arm") && stderr.contains("--wait"), "{stderr}");
    assert_eq!(of(&printed, "policy").count(), 0);

    let (code, printed, stderr) =
        infer_until(&place, BUNDLE, arm_later, &["--wait"], |events| of(events, "act").count() > 0);
    assert_eq!(code, Some(0), "{stderr}");
    let waits = |printed: &Value| printed["event"] == "log" && printed["text"] == "the policy waits for arm";
    assert!(printed.iter().any(waits) && of(&printed, "act").count() > 0, "{printed:?}");
}

#[test]
fn a_dry_run_computes_and_moves_nothing() {
    let place = Place::new();
    let arguments = ["--sim", "task", "--dry-run", "--record", "--out", "out"];
    let (code, printed, stderr) = infer_until_it_acts(&place, &arguments);
    assert_eq!(code, recorded_code(&printed), "{stderr}");
    assert!(of(&printed, "chunk").count() > 0);
    let files = place.files("out");
    let episode = Episode::read(&place.path("out").join(files.first().expect("an episode")));
    assert_eq!(episode.topic("/action").count(), 0);
}

#[test]
fn a_policy_not_trained_without_a_sensor_holds_until_it_is_back_or_ignored() {
    let place = Place::new();
    let bundle = changed(&place, "\"mask_aware\": true", "\"mask_aware\": false");
    let continues = |events: &[Value]| {
        let held = events.iter().position(|event| event["event"] == "hold" && event["device"] == "tactile_tip");
        held.is_some_and(|held| of(&events[held..], "act").count() > 0)
    };
    let (code, printed, stderr) = infer_until(&place, &bundle, PULLED, &[], continues);
    assert_eq!(code, Some(0), "{stderr}");
    let [hold] = holds(&printed)[..] else { panic!("{:?}", holds(&printed)) };
    assert_eq!(hold["device"], "tactile_tip");
    let acted = printed.iter().rposition(|event| event["event"] == "act");
    let stopped = printed.iter().position(|event| std::ptr::eq(event, hold));
    assert!(acted > stopped, "it continues when the sensor is back");

    let (code, printed, stderr) = infer_until(&place, &bundle, PULLED, &["--ignore-missing"], pulled_and_back);
    assert_eq!(code, Some(0), "{stderr}");
    assert!(holds(&printed).is_empty(), "{:?}", holds(&printed));
    assert!(of(&printed, "chunk").any(|chunk| chunk["mask"] == "0x05"));
}

#[test]
fn an_invalid_policy_or_one_for_another_rig_is_rejected_and_named() {
    let place = Place::new();
    let (code, _, stderr) = infer(&place, "nowhere", "", &[]);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(stderr.contains("nowhere/policy.json"), "{stderr}");
    let bundle = changed(&place, "\"modality\": \"tactile_tip\"", "\"modality\": \"tactile_top\"");
    let (code, _, stderr) = infer(&place, &bundle, "", &[]);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(stderr.contains("tactile_top"), "{stderr}");
    let (code, _, stderr) = infer(&place, BUNDLE, "", &["--ort-lib", "/nowhere/libonnxruntime.so", "--duration", "5s"]);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(stderr.contains("/nowhere/libonnxruntime.so"), "{stderr}");
    let text = place.write("libonnxruntime.so", "no library").display().to_string();
    let (code, _, stderr) = infer(&place, BUNDLE, "", &["--ort-lib", &text, "--duration", "5s"]);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(stderr.contains(&format!("{text} (--ort-lib): it cannot be loaded: ")), "{stderr}");
}

/// A device that does not move is not an actuator, whatever the registry states.
#[test]
fn a_device_that_takes_no_actions_is_refused_before_anything_starts() {
    let place = Place::new();
    let still = "[device.arm]\nvid = \"1209\"\npid = \"7a03\"\nnode = \"serial\"\nbit = 2\n[device.arm.tty]\nchannels = 4\n\
                 [device.arm.action]\nnames = [\"x\", \"y\", \"z\", \"grip\"]\nunits = [\"m\", \"m\", \"m\", \"1\"]\n\
                 min = [-1.1, -1.0, 0.03, 0.0]\nmax = [1.0, 1.0, 0.9, 1.0]\n";
    let (cameras, _) = REGISTRY.split_once("[device.arm]").expect("an arm");
    let registry = place.write("still.toml", &format!("{cameras}{still}")).display().to_string();
    for arguments in [&["check"][..], &["--infer", BUNDLE, "--sim", "--duration", "2s"]] {
        let output = place.run(&[arguments, &["--config", &registry]].concat());
        let printed = [output.stdout, output.stderr].concat();
        let printed = String::from_utf8_lossy(&printed);
        assert_eq!(output.status.code(), Some(2), "{printed}");
        assert!(printed.contains("[device.arm] node \"serial\" takes no actions: nothing would move"), "{printed}");
    }
    // Without the table there is no actuator at all.
    let (without, _) = still.split_once("[device.arm.action]").expect("a table");
    let registry = place.write("without.toml", &format!("{cameras}{without}")).display().to_string();
    let output = place.run(&["--infer", BUNDLE, "--sim", "--config", &registry, "--duration", "2s"]);
    let printed = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{printed}");
    assert!(printed.contains("actuator \"arm\" takes no actions"), "{printed}");
}

/// The policy that the program carries fits the simulated task, and reports it on any other rig.
#[test]
fn the_embedded_policy_is_available_in_any_folder_and_names_the_rig_it_fits() {
    let place = Place::new();
    let (code, printed, stderr) = infer_until_it_acts(&place, &["--sim", "task", "--record", "--out", "out"]);
    assert_eq!(code, recorded_code(&printed), "{stderr}");
    let policy = of(&printed, "policy").next().expect("an event of the policy");
    assert_eq!((&policy["policy"], &policy["folder"]), (&"tactile-id".into(), &"inside rapid".into()));
    let folder = rapid_policy::bundle::Bundle::load(Path::new(BUNDLE)).expect("the same as a folder");
    assert_eq!(policy["hash"], folder.hash);

    let builtin = place.write("builtin.toml", rapid_registry::BUILTIN).display().to_string();
    let output = place.run(&["--infer", "--config", &builtin, "--sim", "--duration", "2s"]);
    let printed = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{printed}");
    assert!(printed.contains("for the simulated task only: rapid --infer --sim task"), "{printed}");
}

/// It was trained with each of its cameras taken away.
#[test]
fn the_policy_continues_without_the_wrist_camera_and_holds_without_both() {
    let place = Place::new();
    let pulled = "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\nname = \"arm\"\n\
                  [[event]]\nat = \"4s\"\nunplug = \"cam_wrist\"\n[[event]]\nat = \"8s\"\nunplug = \"tactile_tip\"\n";
    let (code, printed, stderr) = infer_until(&place, BUNDLE, pulled, &[], |events| !holds(events).is_empty());
    assert_eq!(code, Some(0), "{stderr}");
    assert!(of(&printed, "chunk").any(|chunk| chunk["mask"] == "0x06"), "it is asked without the wrist camera");
    let [hold] = holds(&printed)[..] else { panic!("{:?}", holds(&printed)) };
    assert_eq!(
        (&hold["reason"], &hold["device"]),
        (&"no picture that the policy observes is there".into(), &"cam_wrist".into())
    );
    assert!(of(&printed, "chunk").all(|chunk| chunk["mask"] != "0x04"), "nothing is asked without both");
}

#[test]
fn a_held_sensor_is_observed_as_it_was_and_then_not_at_all() {
    let place = Place::new();
    let options = ["--hold-last", "1s", "--record", "--out", "out"];
    let ns = |chunk: &Value| chunk["observed_ns"].as_u64().expect("a time");
    let is_gone = |events: &[Value]| {
        let away = || of(events, "chunk").filter(|chunk| chunk["mask"] == "0x05").map(ns);
        away().max() > away().min().map(|first| first + 1_100_000_000)
    };
    let (code, printed, stderr) = infer_until(&place, BUNDLE, PULLED, &options, is_gone);
    assert_eq!(code, recorded_code(&printed), "{stderr}");
    let seqs = |chunk: &Value| {
        let samples = chunk["samples"].as_array().expect("samples");
        let tactile = samples.iter().find(|of| of["modality"] == "tactile_tip").expect("the modality");
        tactile["seqs"].as_array().expect("numbers").iter().filter_map(Value::as_u64).collect::<Vec<_>>()
    };
    let away: Vec<&Value> = of(&printed, "chunk").filter(|chunk| chunk["mask"] == "0x05").collect();
    let first = away.first().expect("it is asked without the sensor");
    // A second after the last tick at which it was there: that is one between the last chunk with it and the first
    // without. A policy that computes for longer than a second is first asked when the second is over.
    let with = of(&printed, "chunk").filter(|chunk| chunk["mask"] == "0x07" && ns(chunk) < ns(first)).map(ns).max();
    let with = with.expect("it is asked with the sensor");
    let (held, gone): (Vec<&Value>, Vec<&Value>) = away.iter().partition(|chunk| !seqs(chunk).is_empty());
    let last = held.first().map(|chunk| seqs(chunk)).unwrap_or_default();
    assert!(held.is_empty() || last.len() == 2, "{held:?}");
    assert!(held.iter().all(|chunk| seqs(chunk) == last), "the same samples again: {held:?}");
    assert!(held.iter().all(|chunk| ns(chunk) - ns(first) < 1_000_000_000), "{held:?}");
    assert!(!gone.is_empty() && gone.iter().all(|chunk| ns(chunk) - with > 1_000_000_000), "{gone:?}");

    // What was held can be computed again from the recording.
    let file = place.path("out").join(&place.files("out")[0]).display().to_string();
    let replayed = place.run(&["--json", "replay", &file, "--infer", BUNDLE, "--tolerance", "1e-5"]);
    assert_eq!(replayed.status.code(), Some(0), "{}", String::from_utf8_lossy(&replayed.stderr));
    let line = |printed: &[Value]| support::logged(printed, "its last samples stand in for it, for 1s").len();
    assert_eq!(line(&printed), 2, "of both cameras, at the start");

    // Its inputs go to a new file: an episode that is named by mistake stays.
    let before = std::fs::read(&file).expect("the episode");
    let observed = place.run(&["policy", "observe", &file, BUNDLE, "--to", &file]);
    let error = String::from_utf8_lossy(&observed.stderr).into_owned();
    assert!(!observed.status.success() && error.contains("choose another file with --to"), "{error}");
    assert_eq!(std::fs::read(&file).expect("the episode"), before);
}

/// The picture with which the policy compares all later ones of the fingertip is from before the episode.
#[test]
fn chunks_of_an_episode_that_begins_while_the_policy_acts_can_be_computed_again() {
    let place = Place::new();
    let registry = place.write("rig.toml", REGISTRY).display().to_string();
    let scenario = place.write("play.toml", PLUGGED).display().to_string();
    let arguments = ["--json", "--infer", BUNDLE, "--config", &registry, "--sim", &scenario, "--out", "out"];
    let running = place.start(&arguments, "\"event\":\"act\"");
    let chunks = || running.reported().iter().filter(|line| line["event"] == "chunk").count();
    let ask = |words: &[&str]| {
        let output = place.run(words);
        assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    };
    until("the policy has answered", || chunks() > 0);
    ask(&["episode", "start"]);
    let before = chunks();
    until("it has answered in the episode", || chunks() > before + 4);
    ask(&["episode", "stop"]);
    running.signal(Signal::INT);
    let (code, _, stderr) = running.end();
    assert_eq!(code, Some(0), "the verdict on an episode that was ordered is not a result of the run: {stderr}");

    let file = place.path("out").join(&place.episodes("out")[0]).display().to_string();
    let replayed = place.run(&["--json", "replay", &file, "--infer", BUNDLE, "--tolerance", "1e-5"]);
    assert_eq!(replayed.status.code(), Some(0), "{}", String::from_utf8_lossy(&replayed.stderr));
    let again: Value = serde_json::from_slice(&replayed.stdout).expect("an object");
    assert!(again["compared"].as_u64() >= Some(3), "{again}");
    assert_eq!(again["reference_unknown"], 0, "{again}");
}

#[test]
fn a_policy_too_slow_for_its_rate_is_refused_with_the_figures() {
    let place = Place::new();
    // Its 15 actions cover 15 ms, and a chunk has ten times its steps.
    let fast = paced(&place, 8, 1000.0);
    let (code, _, stderr) = infer(&place, &fast, PULLED, &["--denoising-steps", "100", "--duration", "3m"]);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(stderr.contains("too slow on this machine") && stderr.contains("15 actions cover 15 ms"), "{stderr}");
    assert!(stderr.contains("--threads"), "{stderr}");
}

/// All actions of a chunk are executed before the next one is requested: however fast that is computed, there is a pause.
#[test]
fn a_policy_that_pauses_between_chunks_acts_after_a_warning_with_the_figures() {
    let place = Place::new();
    let pausing = paced(&place, 15, 1.0);
    let (code, printed, stderr) = infer_until_it_acts(&place, &[pausing.as_str(), "--sim", "task"]);
    assert_eq!(code, Some(0), "{stderr}");
    let is_warning = |event: &Value| {
        let text = event["text"].as_str().unwrap_or_default();
        let words = "15 actions cover 15000 ms at 1 Hz: the robot pauses between chunks; try a smaller n_action_steps";
        event["event"] == "log" && event["level"] == "warn" && text.contains(words)
    };
    let warned = printed.iter().position(is_warning);
    let acted = printed.iter().position(|event| event["event"] == "act");
    assert!(warned.is_some() && warned < acted, "{printed:?}");
}

#[test]
fn threads_and_provider_are_options_and_what_a_library_lacks_is_named() {
    let place = Place::new();
    let (code, _, stderr) = infer_until_it_acts(&place, &["--sim", "task", "--threads", "2"]);
    assert_eq!(code, Some(0), "{stderr}");
    let (code, _, stderr) = infer(&place, BUNDLE, PULLED, &["--provider", "cuda", "--duration", "3m"]);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(stderr.contains("--provider cuda: ") && stderr.contains("onnxruntime-gpu"), "{stderr}");
}
