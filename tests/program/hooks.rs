//! Hooks: the real binary, simulated plugs, and real programs that are notified of them and of episodes.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::collections::BTreeMap;
use std::path::Path;

use crate::support::{self, Episode, Place, events, logged};
use rustix::process::Signal;
use serde_json::Value;

/// Notes its name, its arguments and its input, one line a hook.
const NOTE: &str = "#!/bin/sh\n\
    echo \"$*|$DEVICE_NAME|$DEVICE_NODE|$DEVICE_SERIAL|$DEVICE_ADDR|$RAPID_TOPIC|$RAPID_EPISODE|$SESSION_ID|$OUTPUT_DIR\" \
    >>notes.txt\n\
    echo \"hook prints $1\"\n";

/// A line of [`NOTE`].
#[derive(Debug, Clone, PartialEq, Eq)]
struct Noted {
    hook: String,
    reported: BTreeMap<&'static str, String>,
}

fn notes(place: &Place) -> Vec<Noted> {
    let text = std::fs::read_to_string(place.path("notes.txt")).unwrap_or_default();
    let names = ["node", "serial", "port", "topic", "episode", "session", "folder"];
    text.lines()
        .map(|line| {
            let mut fields = line.split('|').map(str::to_owned);
            let hook = fields.next().expect("arguments");
            let device = fields.next().expect("a device");
            let reported = names.into_iter().zip(fields).collect();
            Noted { hook: format!("{device} {hook}"), reported }
        })
        .collect()
}

fn hooks(place: &Place) -> Vec<String> {
    notes(place).into_iter().map(|noted| noted.hook).collect()
}

fn script(place: &Place, name: &str, text: &str) {
    support::executable::script(&place.path(name), text);
}

/// An entry for a simulated motor with these hooks.
fn registry(place: &Place, hooks: &str) {
    script(place, "note", NOTE);
    let text = format!(
        "[rig]\ncooldown = \"200ms\"\n[device.motor]\nvid = \"2e8a\"\npid = \"000a\"\nserial_number = \"M1\"\n\
         node = \"serial\"\nbit = 0\n{hooks}\n[device.motor.tty]\nchannels = 2\n"
    );
    place.write("devices.toml", &text);
}

const ALL: &str = "on_attach = [\"note\", \"attach\", \"a b\"]\non_detach = [\"note\", \"detach\"]\n\
                   on_record_start = [\"note\", \"start\"]\non_record_stop = [\"note\", \"stop\"]";

/// The arguments of a run that plays `scenario`.
fn sim(place: &Place, scenario: &str) -> [&'static str; 6] {
    place.write("sim.toml", scenario);
    ["--sim", "sim.toml", "--config", "devices.toml", "--headless", "--json"]
}

#[test]
fn hooks_are_notified_of_plugs_and_of_episodes_in_their_order() {
    let place = Place::new();
    registry(&place, ALL);
    let scenario = "[[event]]\nat = \"2s\"\nunplug = \"motor\"\n[[event]]\nat = \"3s\"\nplug = \"motor\"\n";
    let output = place.run(&[&sim(&place, scenario)[..], &["--record", "--out", "out", "--duration", "5s"]].concat());
    let code = support::recorded_code(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(output.status.code(), code, "{}", String::from_utf8_lossy(&output.stderr));
    let noted = notes(&place);
    let order: Vec<&str> = noted.iter().map(|noted| noted.hook.as_str()).collect();
    let round = ["motor attach a b", "motor start", "motor stop"];
    assert_eq!(order, [&round[..], &["motor detach"], &round].concat(), "no detach at the end of the run");

    let file = place.path("out").join(&place.files("out")[0]);
    let session = file.file_stem().expect("a name").to_string_lossy().into_owned();
    for Noted { hook, reported } in &noted {
        assert_eq!(reported["serial"], "M1");
        assert_eq!(reported["topic"], "/rapid/serial/motor");
        assert!(reported["node"].starts_with("sim:") && !reported["port"].is_empty(), "{reported:?}");
        let is_record = hook.ends_with("start") || hook.ends_with("stop");
        assert_eq!(Path::new(&reported["episode"]).is_absolute(), is_record, "{hook} {reported:?}");
        if is_record {
            let episode = Path::new(&reported["episode"]).canonicalize().expect("the finished file");
            assert_eq!(episode, file.canonicalize().expect("the finished file"));
            assert_eq!(reported["session"], session);
            assert_eq!(Path::new(&reported["folder"]).join(format!("{session}.mcap")), Path::new(&reported["episode"]));
        }
    }
    let reported = events(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(logged(&reported, "motor: on_detach: hook prints detach").len(), 1, "{reported:#?}");
}

/// Another program takes the name that the episode is to get, or damages its file.
#[test]
fn the_hook_at_the_end_knows_the_file_as_it_ended() {
    let take = "cp /bin/true \"$RAPID_EPISODE\"";
    let cut = "sleep 2; : >\"$RAPID_EPISODE.partial\"";
    for (what, begun, name) in [("taken", take, "_002.mcap"), ("cut", cut, "_001.mcap.partial")] {
        let place = Place::new();
        registry(&place, "on_record_start = [\"/bin/sh\", \"begun\"]\non_record_stop = [\"note\", \"stop\"]");
        script(&place, "begun", begun);
        let run = [&sim(&place, "")[..], &["--record", "--out", "out", "--duration", "4s"]].concat();
        let output = place.run(&run);
        let [Noted { reported, .. }] = &notes(&place)[..] else { panic!("{what}: {:?}", notes(&place)) };
        assert!(
            reported["episode"].ends_with(name) && Path::new(&reported["episode"]).is_file(),
            "{what}: {reported:?}"
        );
        assert_eq!(format!("{}.mcap", reported["session"]), name_of(&reported["episode"]).trim_end_matches(".partial"));
        let events = events(&String::from_utf8_lossy(&output.stdout));
        let end = events.iter().find(|event| event["event"] == "episode").expect("the end of an episode");
        assert_eq!(name_of(end["file"].as_str().expect("a name")), name_of(&reported["episode"]), "{what}");
    }
}

fn name_of(file: &str) -> &str {
    file.rsplit('/').next().unwrap_or(file)
}

#[test]
fn a_hook_that_hangs_or_fails_is_reported_and_delays_nothing() {
    let place = Place::new();
    registry(
        &place,
        "on_attach = [\"/bin/sh\", \"-c\", \"exit 3\"]\non_record_start = [\"hang\"]\non_record_stop = [\"note\", \"stop\"]",
    );
    script(&place, "hang", "#!/bin/sh\ntrap '' TERM\nsleep 1000 &\necho $! >asleep.txt\nwait\n");
    let output = place.run(&[&sim(&place, "")[..], &["--record", "--out", "out", "--duration", "3s"]].concat());
    let code = support::recorded_code(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(output.status.code(), code, "{}", String::from_utf8_lossy(&output.stderr));
    let reported = events(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(logged(&reported, "motor: on_attach: its process ended with code 3").len(), 1, "{reported:#?}");
    let killed = "motor: on_record_start: did not end within 10 s and was killed";
    assert_eq!(logged(&reported, killed).len(), 1, "{reported:#?}");
    assert_eq!(hooks(&place), ["motor stop"], "it comes all the same, after the kill");
    let asleep = std::fs::read_to_string(place.path("asleep.txt")).expect("a process id");
    // One that is not reaped yet has no command line any more.
    let command = std::fs::read(Path::new("/proc").join(asleep.trim()).join("cmdline")).unwrap_or_default();
    assert!(command.is_empty(), "a child process outlived it: {}", String::from_utf8_lossy(&command));

    // The episode was over, and its file closed, before the hook was killed.
    let stamp = |what: &dyn Fn(&Value) -> bool| {
        reported.iter().find(|event| what(event)).and_then(|event| event["stamp"].as_u64()).expect("an event")
    };
    let ended = stamp(&|event| event["event"] == "episode");
    let was_killed = stamp(&|event| event["text"].as_str().is_some_and(|text| text.contains(killed)));
    assert!(was_killed > ended, "the episode's end did not wait for its hook");
    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    let masks: Vec<u32> = episode.topic("/rapid/mask").map(|message| message.sequence).collect();
    assert!(masks.windows(2).all(|pair| pair[1] == pair[0] + 1), "a hole in the mask");
    assert!(episode.topic("/rapid/serial/motor").count() > 0);
}

#[test]
fn a_second_signal_waits_for_no_hook() {
    let place = Place::new();
    registry(&place, "on_record_start = [\"hang\"]\non_record_stop = [\"note\", \"stop\"]");
    script(&place, "hang", "#!/bin/sh\necho hangs\nsleep 1000\n");
    let arguments = [&sim(&place, "")[..], &["--record", "--out", "out"]].concat();
    let mut running = place.start(&arguments, "motor: on_record_start: hangs");
    running.signal(Signal::INT);
    running.wait_for("\"event\":\"episode\"");
    running.signal(Signal::INT);
    let (code, output, _) = running.end();
    assert_eq!(code, Some(130));
    let reported = events(&output);
    assert_eq!(logged(&reported, "on_record_start: killed, as the run was interrupted twice").len(), 1, "{output}");
    assert_eq!(logged(&reported, "on_record_stop: not run, as the run was interrupted twice").len(), 1, "{output}");
    assert_eq!(hooks(&place), [""; 0]);
}
