//! The registry is changed while a run records: an entry is added, and everything else continues; any other change is
//! refused, and nothing happens.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::process::Output;

use rustix::process::Signal;
use serde_json::{Value, json};

use crate::support::skip::skipped;
use crate::support::{Episode, FrameMessage, LENIENT, Place, Running, events, until};

const RIG: &str = include_str!("../../devices.toml");

/// Two devices of the registry, and one that no entry means.
const SCENARIO: &str = r#"
[[device]]
name = "cam_wrist"

[[device]]
name = "motor_state"

[[device]]
name = "spare"
like = "tactile_tip"
serial = "SPARE1"
port = "1-4"
product = "Spare Camera"
"#;

const ADD: [&str; 8] = ["register", "--sim", "scenario.toml", "--serial", "SPARE1", "--name", "spare_cam", "--yes"];

fn rig() -> String {
    format!("{RIG}{LENIENT}")
}

fn recording(options: &[&str]) -> (Place, Running) {
    let place = Place::new();
    place.write("devices.toml", &rig());
    place.write("scenario.toml", SCENARIO);
    let arguments = ["--sim", "scenario.toml", "--headless", "--json", "--record", "--out", "out"];
    let running = place.start(&[&arguments[..], options].concat(), "\"recording\"");
    until("both devices stream", || record(&place).mask == 0b101);
    (place, running)
}

/// The mask as it is published.
struct Record {
    devices: u8,
    mask: u64,
    sequence: u64,
}

fn record(place: &Place) -> Record {
    let bytes = std::fs::read(place.mask_file()).unwrap_or_default();
    let word =
        |at: usize| bytes.get(at..at + 8).map_or(0, |word| u64::from_le_bytes(word.try_into().expect("8 bytes")));
    Record { devices: bytes.get(5).copied().unwrap_or_default(), mask: word(8), sequence: word(24) }
}

fn reload(place: &Place) -> Result<String, String> {
    let output: Output = place.run(&["reload"]);
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim_end().to_owned();
    match output.status.code() {
        Some(0) => Ok(text(&output.stdout)),
        Some(1) => Err(text(&output.stderr)),
        code => panic!("{code:?}: {}", text(&output.stderr)),
    }
}

fn ask(place: &Place, words: &[&str]) -> String {
    let output = place.run(words);
    assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Waits until so many more masks are published: an episode of some length.
fn publications(place: &Place, count: u64) {
    let sequence = record(place).sequence;
    until("the mask is published", || record(place).sequence > sequence + count);
}

/// How many messages each topic has, whose numbers are without a hole; except for the cameras: a simulated one that a busy
/// machine reads too late loses pictures, as a real one does.
fn contiguous(episode: &Episode) -> BTreeMap<String, usize> {
    let mut last: BTreeMap<&str, u32> = BTreeMap::new();
    let mut counts = BTreeMap::new();
    for message in &episode.messages {
        let before = last.insert(&message.topic, message.sequence);
        if let Some(before) = before.filter(|_| !message.topic.starts_with("/rapid/camera/")) {
            assert_eq!(message.sequence, before + 1, "{}", message.topic);
        }
        *counts.entry(message.topic.clone()).or_insert(0) += 1;
    }
    counts
}

fn verdict(place: &Place, file: &str) -> Value {
    serde_json::from_str(&ask(place, &["inspect", "--json", &format!("out/{file}")])).expect("JSON")
}

#[test]
fn an_added_device_streams_while_nothing_else_is_interrupted() {
    let (place, running) = recording(&["--rate", "50"]);
    assert_eq!(record(&place).devices, 3);
    assert_eq!(reload(&place), Ok("no entry was added, and no other change needs a restart".to_owned()));
    ask(&place, &ADD);
    let added = reload(&place).expect("it is taken over");
    assert_eq!(added, "added [device.spare_cam] as bit 3; recorded from the next episode on");
    until("its bit is set", || record(&place).mask == 0b1101);
    assert_eq!(record(&place).devices, 4);
    until("the JSON file has it", || {
        let json = std::fs::read_to_string(format!("{}.json", place.mask_file().display())).unwrap_or_default();
        json.contains("spare_cam") && json.contains("\"device_count\": 4")
    });
    // The text is the same now: there is nothing to take over.
    assert!(reload(&place).expect("no change").starts_with("no entry was added"));
    // It streams for a while in this episode.
    publications(&place, 1000);
    ask(&place, &["episode", "next"]);
    publications(&place, 1000);
    ask(&place, &["episode", "stop"]);
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, Some(0), "{output}{errors}");
    let opened = |device: &str| {
        events(&output).iter().filter(|event| event["event"] == "opened" && event["device"] == device).count()
    };
    assert_eq!(["cam_wrist", "motor_state", "spare_cam"].map(opened), [1; 3], "no device was opened again");

    let files = place.episodes("out");
    assert_eq!(files.len(), 2, "{files:?}");
    for (file, is_with) in files.iter().zip([false, true]) {
        let verdict = verdict(&place, file);
        assert_eq!(verdict["verdict"], "GOOD", "{verdict}");
        let episode = Episode::read(&place.path(&format!("out/{file}")));
        let counts = contiguous(&episode);
        assert!(["/rapid/mask", "/rapid/camera/wrist"].iter().all(|topic| counts[*topic] > 0), "{counts:?}");
        assert_eq!(counts.get("/rapid/camera/spare_cam").is_some_and(|count| *count > 0), is_with, "{counts:?}");
        assert_eq!(episode.channels.iter().any(|topic| topic.contains("spare")), is_with);
        // The bit was set in the first episode, too; its frames are of the modalities that it began with.
        let expected = if is_with { vec![0b1101] } else { vec![0b101, 0b1101] };
        assert_eq!(episode.mask_edges().iter().map(|(_, mask)| *mask).collect::<Vec<_>>(), expected);
        let frames = episode.frames();
        let (_, last) = frames.last().expect("a frame");
        assert_eq!(
            last.modalities.iter().map(|modality| modality.bit).collect::<Vec<_>>(),
            [0, 1, 2, 3][..3 + usize::from(is_with)]
        );
        // Not at every tick: the phase of its pictures is its own.
        let is_valid = |frame: &FrameMessage| frame.modalities.iter().any(|slot| slot.bit == 3 && slot.valid);
        assert_eq!(frames.iter().any(|(_, frame)| is_valid(frame)), is_with);
    }
}

#[test]
fn any_other_change_is_refused_and_leaves_the_run_as_it_was() {
    let (place, running) = recording(&[]);
    let files = || place.shared_memory();
    let before = files();
    let spare = "\n[device.spare_cam]\nvid = \"2bc5\"\npid = \"0501\"\nserial = \"SPARE1\"\nnode = \"camera\"\n";
    let rig = rig();
    let motor = rig.find("[device.motor_state]").expect("an entry");
    for (case, text, reasons) in [
        ("a removed entry", format!("{}{LENIENT}", &rig[..motor]), &["[device.motor_state]: it is removed"][..]),
        ("another bit", rig.replace("\nbit = 0", "\nbit = 9"), &["[device.cam_wrist]: its bit 0 is now 9"]),
        ("another format", rig.replace("width = 640", "width = 320"), &["[device.cam_wrist]: format"]),
        ("another key of the rig", rig.replace("cooldown = \"2s\"", "cooldown = \"3s\""), &["[rig]: cooldown changed"]),
        ("not TOML", format!("{rig}{spare}bit = \n"), &["devices.toml:", "nothing was changed"]),
        ("a bit that is taken", format!("{rig}{spare}bit = 0\n"), &["bit 0 is already taken"]),
        (
            "no memory budget",
            format!("{rig}{spare}bit = 3\nmax_bytes = \"64MB\"\ndepth = 60\n"),
            &["more than memory_budget"],
        ),
        (
            "an added entry and another change",
            format!("{}{spare}bit = 3\n", rig.replace("bench-1", "bench-2")),
            &["[rig]: name changed"],
        ),
    ] {
        assert_ne!(text, rig, "{case}");
        place.write("devices.toml", &text);
        let why = reload(&place).expect_err(case);
        for reason in reasons.iter().chain(&["nothing was changed"]) {
            assert!(why.contains(reason), "{case}: {why}");
        }
        let now = record(&place);
        assert_eq!((now.devices, now.mask), (3, 0b101), "{case}");
        assert_eq!(files(), before, "{case}");
    }
    std::fs::remove_file(place.path("devices.toml")).expect("it is there");
    assert!(reload(&place).expect_err("no file").contains("devices.toml"));
    publications(&place, 500);
    ask(&place, &["episode", "stop"]);
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, Some(0), "{output}{errors}");
    let files = place.episodes("out");
    assert_eq!(verdict(&place, &files[0])["verdict"], "GOOD");
    contiguous(&Episode::read(&place.path(&format!("out/{}", files[0]))));
    assert!(output.contains("[rig]: name changed"), "a refusal is in the log: {output}");
}

/// What the screen requests, over the socket of the run: its answer.
fn request(place: &Place, running: &Running, request: &Value) -> Value {
    let user = rustix::process::geteuid().as_raw();
    let name = format!("rapid/{user}/{}/{}", place.instance, running.pid());
    let address = SocketAddr::from_abstract_name(name).expect("a name");
    let mut stream = UnixStream::connect_addr(&address).expect("it listens");
    stream.write_all(format!("{request}\n").as_bytes()).expect("it reads");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("it answers");
    serde_json::from_str(&answer).expect("JSON")
}

#[test]
fn a_connected_device_is_registered_and_taken_over_by_one_request() {
    let (place, running) = recording(&[]);
    let device = "2bc5:0501  port 1-4  serial \"SPARE1\"  Spare Camera";
    let register = |device: &str, name: &str| {
        request(&place, &running, &json!({ "do": "register", "device": device, "name": name }))
    };
    let text = || std::fs::read_to_string(place.path("devices.toml")).expect("devices.toml");
    for (device, name, why) in [(device, "cam_wrist", "already exists"), ("2bc5:0501", "spare", "it is not plugged in")]
    {
        let answer = register(device, name);
        assert!(answer["ok"] == false && answer["text"].as_str().is_some_and(|text| text.contains(why)), "{answer}");
        assert_eq!(text(), rig());
    }
    let answer = register(device, "spare");
    assert_eq!(answer["text"], "added [device.spare] as bit 3; recorded from the next episode on", "{answer}");
    until("its bit is set", || record(&place).mask == 0b1101);
    ask(&place, &["check"]);
    // An entry that cannot be taken over stays in the file, and the answer states it.
    place.write("devices.toml", &text().replace("bench-1", "bench-2"));
    assert_eq!(register(device, "again")["ok"], false);
    publications(&place, 500);
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
}

#[test]
fn without_memory_for_its_topic_an_entry_is_refused_with_the_numbers() {
    let free = rustix::fs::statvfs("/dev/shm").map_or(0, |space| space.f_bavail * space.f_frsize);
    if free > 48 << 30 {
        skipped("/dev/shm is larger than what an entry may take");
        return;
    }
    let place = Place::new();
    let rig = RIG.replace("memory_budget = \"512MiB\"", "memory_budget = \"64GiB\"");
    place.write("devices.toml", &rig);
    place.write("scenario.toml", SCENARIO);
    let running = place.start(&["--sim", "scenario.toml", "--headless"], "motor_state");
    until("both devices stream", || record(&place).mask == 0b101);
    let before = place.shared_memory();
    let spare = "vid = \"2bc5\"\npid = \"0501\"\nserial = \"SPARE1\"\nnode = \"camera\"\nbit = 3\n\
        camera = { width = 320, height = 240 }";
    let huge = "[device.huge]\nvid = \"2bc5\"\npid = \"0502\"\nnode = \"camera\"\nbit = 4\nmax_bytes = \"16MiB\"\ndepth = 3500";
    place.write("devices.toml", &format!("{rig}\n[device.spare]\n{spare}\n{huge}\n"));
    let why = reload(&place).expect_err("there is not that much");
    for part in ["/dev/shm: ", " free of ", " are needed; ", "nothing was changed"] {
        assert!(why.contains(part), "{why}");
    }
    assert_eq!((record(&place).devices, place.shared_memory()), (3, before));
    // Both or none were to be taken over; alone the first is.
    place.write("devices.toml", &format!("{rig}\n[device.spare]\n{spare}\n"));
    reload(&place).expect("it is taken over");
    until("its bit is set", || record(&place).mask == 0b1101);
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
    assert_eq!(place.shared_memory().len(), 0, "{:?}", place.shared_memory());
}

#[test]
fn without_a_file_there_is_nothing_to_read_again() {
    let place = Place::new();
    assert!(reload(&place).expect_err("no run").contains("runs here"));
    let running = place.start(&["--sim", "--headless"], "motor_state");
    assert!(reload(&place).expect_err("no file").contains("--config"));
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
}
