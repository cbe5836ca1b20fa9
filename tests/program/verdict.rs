//! GOOD is earned: whatever is changed in the file of a good episode, no way to ask calls it GOOD any more.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]
mod edits;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use rapid_core::random::Random;
use rapid_episode::record::inspect;

use crate::support::{Place, events};
use serde_json::Value;

/// A camera and a serial device, small enough for many copies of an episode.
const DEVICES: &str = "
[rig]
name = \"small\"

[device.cam]
vid = \"1209\"
pid = \"0001\"
serial = \"A\"
node = \"camera\"
bit = 0
[device.cam.camera]
width = 32
height = 24
fps = 30

[device.sensor]
vid = \"1209\"
pid = \"0002\"
serial_number = \"B\"
node = \"serial\"
bit = 1
[device.sensor.tty]
baud = 115200
parse = \"csv\"
channels = 2
";

/// Records an episode of a second that is GOOD; its name.
fn good(place: &Place) -> String {
    place.write("devices.toml", DEVICES);
    let run = ["--json", "--headless", "--sim", "--record", "--duration", "1s", "--task", "t", "--tag", "finger=a"];
    // On a busy machine an episode may be SUSPECT with reason: another is recorded.
    let mut reasons = Vec::new();
    for _ in 0..20 {
        let output = place.run(&run);
        let printed = events(&String::from_utf8_lossy(&output.stdout));
        let end = printed.iter().find(|event| event["event"] == "episode").expect("the end of an episode");
        if end["verdict"] == "GOOD" {
            let file = Path::new(end["file"].as_str().expect("a name"));
            return file.file_name().expect("a name").to_string_lossy().into_owned();
        }
        reasons.push(end["reasons"].to_string());
    }
    panic!("no good episode: {reasons:?}");
}

/// What a file becomes: its name gives what was done.
type Mutants = Vec<(String, Vec<u8>)>;

/// Seeded flips, zeros, cuts and splices over the whole of `whole`, and the table of what was found.
fn mutants(whole: &[u8], foreign: &[u8]) -> Mutants {
    let size = whole.len();
    let mut random = Random::new(12, 0);
    let mut below = |end: usize| usize::try_from(random.below(end as u64)).expect("an index");
    let mut mutants: Mutants = Vec::new();
    // Where T1 was found; the header, the metadata and the end of the file byte by byte.
    let ends = (0..60).chain((60..4096.min(size)).step_by(37)).chain(size - 120..size);
    let places: BTreeSet<usize> = ends.chain((0..250).map(|_| below(size))).collect();
    for at in places {
        let mut bytes = whole.to_vec();
        let bit = below(8);
        bytes[at] ^= 1 << bit;
        mutants.push((format!("flip-{at}-{bit}"), bytes));
    }
    let lengths = [1, 4, 8, 64, 512, 4096, size / 3];
    for number in 0..120 {
        let length = lengths[number % lengths.len()].min(size);
        let at = below(size - length + 1);
        let mut bytes = whole.to_vec();
        bytes[at..at + length].fill(0);
        mutants.push((format!("zero-{at}-{length}"), bytes));
    }
    for (at, length) in [(0, 4096), (8, 4088), (size - 37, 37), (size - 12, 4), (size - 4096, 4096)] {
        let mut bytes = whole.to_vec();
        bytes[at..at + length].fill(0);
        mutants.push((format!("zeros-{at}-{length}"), bytes));
    }
    for number in 0..80 {
        let at = if number < 40 { size - 1 - number } else { below(size) };
        mutants.push((format!("cut-{at}"), whole[..at].to_vec()));
    }
    for _ in 0..80 {
        let (from, to) = (below(size), below(size));
        let (from, to) = (from.min(to), from.max(to));
        mutants.push((format!("without-{from}-{to}"), [&whole[..from], &whole[to..]].concat()));
        mutants.push((format!("twice-{from}-{to}"), [&whole[..to], &whole[from..]].concat()));
    }
    mutants.push(("nothing".to_owned(), Vec::new()));
    mutants.push(("magic-alone".to_owned(), whole[..8].to_vec()));
    mutants.push(("eight-bytes".to_owned(), b"8 bytes!".to_vec()));
    mutants.push(("two-files".to_owned(), [whole, whole].concat()));
    mutants.push(("foreign-behind".to_owned(), [whole, foreign].concat()));
    mutants.push(("foreign-before".to_owned(), [foreign, whole].concat()));
    mutants.push(("all-zeros".to_owned(), vec![0; size]));
    mutants.extend(without_check_values(whole));
    // A range of zeros over zeros has changed nothing.
    mutants.retain(|(_, bytes)| bytes != whole);
    mutants
}

/// The same episode with a check value of zero, which in the format means "none": nothing in it is wrong, and
/// nothing is proven.
fn without_check_values(whole: &[u8]) -> Mutants {
    let u64_at = |at: usize| u64::from_le_bytes(whole[at..at + 8].try_into().expect("8 bytes"));
    let mut mutants = Mutants::new();
    let mut at = 8;
    while at + 9 <= whole.len() - 8 {
        let (opcode, length) = (whole[at], usize::try_from(u64_at(at + 1)).expect("a length"));
        let place = match opcode {
            0x06 => Some(("chunk", at + 9 + 24)),
            0x0f => Some(("data", at + 9)),
            0x02 => Some(("summary", at + 9 + 16)),
            _ => None,
        };
        if let Some((name, crc)) = place {
            let mut bytes = whole.to_vec();
            bytes[crc..crc + 4].fill(0);
            // What lies behind it must be right: the check value of the data holds that of the chunk.
            mutants.push((format!("no-crc-{name}-{at}"), bytes));
        }
        at += 9 + length;
    }
    assert!(mutants.len() >= 3, "{} check values", mutants.len());
    mutants
}

/// Files that other programs wrote.
fn foreign(messages: u32) -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().library("another recorder");
    let mut writer = mcap::Writer::with_options(&mut file, options).expect("a writer");
    let channel = writer.add_channel(0, "/other", "json", &BTreeMap::new()).expect("a channel");
    for sequence in 0..messages {
        let log_time = u64::from(sequence) * 10_000_000;
        let header = mcap::records::MessageHeader { channel_id: channel, sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, b"{}").expect("a message");
    }
    writer.finish().expect("an end");
    drop(writer);
    file.into_inner()
}

/// The training reader's own judgement of the files of a folder: `{file: verdict or null}`.
fn training_reader(folder: &Path) -> BTreeMap<String, Option<String>> {
    let program = "import json, sys; from pathlib import Path; from rapid_policy.judgement import judge; \
                   print(json.dumps({str(p): j.verdict for p, j in judge(sorted(Path(sys.argv[1]).glob('*.mcap'))).items()}))";
    let output = Command::new("python3")
        .args(["-c", program])
        .arg(folder)
        .env("PYTHONPATH", concat!(env!("CARGO_MANIFEST_DIR"), "/models"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .env("RAPID_BIN", env!("CARGO_BIN_EXE_rapid"))
        .output()
        .expect("python3");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

fn counted_as_good(place: &Place, folder: &str) -> u64 {
    let plan = ["ablation", "--in", folder, "--json", "--finger", "a", "--modality", "cam+sensor", "--count", "good"];
    let output = place.run(&plan);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let printed = events(&String::from_utf8_lossy(&output.stdout));
    printed.iter().find_map(|line| line["episodes"].as_u64()).expect("a count")
}

#[test]
fn no_changed_file_is_reported_good_by_any_command() {
    let place = Place::new();
    let name = good(&place);
    let whole = std::fs::read(place.path("episodes").join(&name)).expect("episode");
    assert_eq!(counted_as_good(&place, "episodes"), 1, "the episode itself counts");
    let other = std::fs::read(place.path("episodes").join(good(&place))).expect("episode");
    let mut mutants = mutants(&whole, &foreign(50));
    let (same, edits) = edits::edits(&whole, &other);
    let same = inspect::inspect_bytes(&same).expect("an episode");
    assert_eq!(same.verdict.reasons(), Vec::<&str>::new(), "written again, it is unchanged");
    for (name, bytes) in &edits {
        let printed = inspect::inspect_bytes(bytes).map(|printed| printed.verdict.reasons().join("; "));
        println!("{name}: {}", printed.unwrap_or_default());
    }
    mutants.extend(edits);
    assert!(mutants.len() >= 600, "{} mutations", mutants.len());
    let folder = place.path("mutants");
    std::fs::create_dir(&folder).expect("folder");
    for (name, bytes) in &mutants {
        std::fs::write(folder.join(format!("{name}.mcap")), bytes).expect("mutant");
    }
    std::fs::write(folder.join("whole.mcap"), &whole).expect("the episode");
    let only_whole = BTreeSet::from(["whole".to_owned()]);
    let stem = |path: &str| Path::new(path).file_stem().expect("a name").to_string_lossy().into_owned();

    // 1. `inspect FILE`.
    let names: Vec<&str> = mutants.iter().map(|(name, _)| name.as_str()).chain(["whole"]).collect();
    let is_good = |name: &str| {
        let printed = inspect::inspect(&folder.join(format!("{name}.mcap")));
        printed.is_ok_and(|printed| serde_json::to_value(&printed).expect("JSON")["verdict"] == "GOOD")
    };
    // The longest test of the program: on two processors.
    let good_of = |names: &[&str]| names.iter().filter(|name| is_good(name)).map(ToString::to_string).collect();
    let (left, right) = names.split_at(names.len() / 2);
    let by_file: BTreeSet<String> = std::thread::scope(|scope| {
        let left = scope.spawn(|| -> Vec<String> { good_of(left) });
        good_of(right).into_iter().chain(left.join().expect("a thread")).collect()
    });
    // 2. `inspect DIR`, as jq filters it.
    let output = place.run(&["inspect", "--json", "mutants"]);
    let lines = events(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(lines.len(), mutants.len() + 1);
    let is_good = |line: &&Value| line["verdict"] == "GOOD";
    let by_folder: BTreeSet<String> =
        lines.iter().filter(is_good).map(|line| stem(line["file"].as_str().expect("a name"))).collect();
    // Every file has the key, and a reason unless it is GOOD.
    for line in &lines {
        let reasons = line["reasons"].as_array().expect("reasons");
        assert_eq!(reasons.is_empty(), line["verdict"] == "GOOD" && line.get("verdict").is_some(), "{line}");
    }
    // 3. `ablation --count good`.
    let counted = counted_as_good(&place, "mutants");
    // 4. The training reader.
    let read = training_reader(&folder);
    assert_eq!(read.len(), mutants.len() + 1);
    let by_reader: BTreeSet<String> =
        read.iter().filter(|(_, printed)| printed.as_deref() == Some("GOOD")).map(|(file, _)| stem(file)).collect();
    // 5. The monitor shows what the recorder returns: the same words that the file has.
    let printed = inspect::inspect(&folder.join("whole.mcap")).expect("the episode");
    assert_eq!(printed.verdict.verdict(), printed.recorded_verdict.as_ref());

    println!(
        "mutations: {} tried, GOOD afterwards: {} by inspect FILE, {} by inspect DIR, {} by ablation, {} by training",
        mutants.len(),
        by_file.difference(&only_whole).count(),
        by_folder.difference(&only_whole).count(),
        counted.saturating_sub(1),
        by_reader.difference(&only_whole).count(),
    );
    assert_eq!(by_file, only_whole);
    assert_eq!(by_folder, only_whole);
    assert_eq!(counted, 1);
    assert_eq!(by_reader, only_whole);
    // What is damaged is an episode of ours all the same, as long as anything in it shows that.
    let not_ours = lines.iter().filter(|line| line["reasons"][0] == "not an episode of rapid");
    let not_ours: Vec<String> = not_ours.map(|line| stem(line["file"].as_str().expect("a name"))).collect();
    assert_eq!(not_ours, ["foreign-before"]);
}

#[test]
fn foreign_files_have_no_verdict() {
    let place = Place::new();
    std::fs::create_dir(place.path("episodes")).expect("folder");
    for messages in [0, 50] {
        let bytes = foreign(messages);
        std::fs::write(place.path(&format!("episodes/foreign-{messages}.mcap")), &bytes).expect("file");
        std::fs::write(place.path(&format!("episodes/foreign-cut-{messages}.mcap")), &bytes[..bytes.len() - 9])
            .expect("file");
    }
    let output = place.run(&["inspect", "--json", "episodes"]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let lines = events(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(lines.len(), 4);
    for line in &lines {
        assert_eq!(line.get("verdict"), Some(&Value::Null), "{line}");
        assert_eq!(line["reasons"], serde_json::json!(["not an episode of rapid"]), "{line}");
    }
    let one = place.run(&["inspect", "--json", "episodes/foreign-50.mcap"]);
    let one: Value = serde_json::from_slice(&one.stdout).expect("JSON");
    assert_eq!((one.get("verdict"), &one["messages"]), (Some(&Value::Null), &50.into()));
    let shown = place.run(&["inspect", "episodes"]);
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert_eq!(shown.matches("not an episode of rapid").count(), 4, "{shown}");
    // Files of one name in two folders have their folders beside them.
    std::fs::create_dir(place.path("other")).expect("folder");
    std::fs::copy(place.path("episodes/foreign-50.mcap"), place.path("other/foreign-50.mcap")).expect("copy");
    let shown = place.run(&["inspect", "episodes/foreign-50.mcap", "other/foreign-50.mcap"]);
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert!(shown.contains("episodes/foreign-50.mcap") && shown.contains("other/foreign-50.mcap"), "{shown}");
}
