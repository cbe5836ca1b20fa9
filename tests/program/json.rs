//! Every object that `--json` prints is described in docs/schema.json, and every event of a rig is.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use proc_macro2::{TokenStream, TokenTree};

use crate::support::{Place, python};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn schema() -> PathBuf {
    root().join("docs/schema.json")
}

/// The events that the schema describes.
fn described() -> BTreeSet<String> {
    let text = std::fs::read_to_string(schema()).expect("the schema");
    let schema: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let kinds = schema["anyOf"].as_array().expect("kinds").iter();
    let name = |kind: &serde_json::Value| kind["$ref"].as_str().expect("a name").replace("#/$defs/", "");
    let event = |name: String| schema["$defs"][name]["properties"]["event"]["const"].as_str().map(str::to_owned);
    kinds.map(|kind| event(name(kind)).expect("an event")).collect()
}

/// The variants of `enum EventKind`, as they are written in JSON.
fn variants(source: &str) -> Vec<String> {
    let tokens: Vec<TokenTree> = source.parse::<TokenStream>().expect("Rust").into_iter().collect();
    let is_word = |token: &TokenTree, word: &str| matches!(token, TokenTree::Ident(ident) if ident == word);
    let at = tokens
        .windows(2)
        .position(|pair| is_word(&pair[0], "enum") && is_word(&pair[1], "EventKind"))
        .expect("EventKind");
    let TokenTree::Group(body) = &tokens[at + 2] else { panic!("its variants follow its name") };
    let snake = |name: String| {
        let word = |c: char| if c.is_uppercase() { format!("_{}", c.to_lowercase()) } else { c.to_string() };
        name.chars().map(word).collect::<String>().trim_start_matches('_').to_owned()
    };
    // `#[serde(rename = "x")]` before a variant is its name.
    let mut renamed = None;
    let mut names = Vec::new();
    for token in body.stream() {
        match token {
            TokenTree::Group(attribute) => {
                let text = attribute.to_string();
                let rename =
                    text.strip_prefix("[serde (rename = \"").or_else(|| text.strip_prefix("[serde(rename = \""));
                renamed = rename.and_then(|rest| rest.split('"').next()).map(str::to_owned);
            }
            TokenTree::Ident(name) => names.push(renamed.take().unwrap_or_else(|| snake(name.to_string()))),
            _ => {}
        }
    }
    names
}

#[test]
fn every_event_of_a_rig_is_in_the_schema() {
    let source = std::fs::read_to_string(root().join("src/status/event.rs")).expect("the source");
    let (variants, described) = (variants(&source), described());
    assert!(variants.len() > 15 && variants.contains(&"disk_low".to_owned()), "{variants:?}");
    let missing: Vec<_> = variants.into_iter().filter(|name| !described.contains(name)).collect();
    assert!(missing.is_empty(), "docs/schema.json does not describe {missing:?}");
}

/// The output of a command, which must be objects, one a line.
fn lines(output: &Output) -> String {
    let text = String::from_utf8(output.stdout.clone()).expect("text");
    for line in text.lines() {
        let value: serde_json::Value = serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
        assert!(value["event"].is_string(), "{line}");
    }
    text
}

/// Validates lines, and returns the events among them.
fn validated(lines: &str) -> BTreeSet<String> {
    let mut check = Command::new(python())
        .arg(root().join("tests/python/check_json.py"))
        .arg(schema())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("Python");
    check.stdin.take().expect("a pipe").write_all(lines.as_bytes()).expect("written");
    let output = check.wait_with_output().expect("Python");
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}");
    text.lines().filter_map(|line| line.strip_prefix("seen ")).map(str::to_owned).collect()
}

#[test]
fn what_is_printed_is_as_in_the_schema() {
    let place = Place::new();
    place.write("devices.toml", include_str!("../../devices.toml"));
    place.write("mistake.toml", "[device.a]\nvid = \"1\"\n");
    // Long enough for a progress event.
    let record = ["--sim", "--headless", "--json", "--record", "--goal", "1", "--episode-time", "11s", "--out", "out"];
    let mut running = place.start(&record, "\"recording\"");
    let mut printed = String::new();
    running.wait_for("\"streaming\"");
    let mut run = |arguments: &[&str], code: i32| run(&place, arguments, code, &mut printed);
    run(&["mask", "--json"], 0);
    run(&["episode", "mark", "here", "--json"], 0);
    run(&["session", "--json"], 0);
    run(&["check", "--json"], 0);
    run(&["check", "--config", "mistake.toml", "--json"], 2);
    run(&["devices", "--sim", "--json"], 0);
    let doctor = place.run(&["doctor", "--json"]);
    printed_by(&doctor, &mut printed);
    let (_, text, _) = running.end();
    printed.push_str(&text);
    finished(&place, &mut printed);
    errors(&place, &mut printed);
    let seen = validated(&printed);
    for event in EVENTS {
        assert!(seen.contains(*event), "{event} was not printed: {seen:?}");
    }
}

/// The commands that read episodes, and those that edit the registry.
fn finished(place: &Place, printed: &mut String) {
    let mut run = |arguments: &[&str], code: i32| run(place, arguments, code, printed);
    run(&["list", "out", "--json"], 0);
    run(&["inspect", "out", "--json"], 0);
    let [episode] = place.episodes("out").try_into().expect("one episode");
    let episode = format!("out/{episode}");
    run(&["inspect", &episode, "--json"], 0);
    run(&["inspect", &episode, "--plot", "--json"], 0);
    assert!(run(&["recover", "out", "--json"], 0).contains("\"nothing\""));
    run(&["export", "out", "--to", "lerobot", "--out", "set", "--include-bad", "--json"], 0);
    let table = "set/data/chunk-000/file-000.parquet";
    std::fs::write(place.path(table), "no table").expect("a file");
    run(&["export", "out", "--to", "lerobot", "--out", "set", "--verify", "--json"], 1);
    let bytes = std::fs::read(place.path(&episode)).expect("the episode");
    std::fs::write(place.path("out/cut.mcap.partial"), &bytes[..bytes.len() / 2]).expect("a file");
    assert!(run(&["recover", "out", "--json"], 0).contains("\"repaired\""));
    run(&["ablation", "--finger", "soft", "--modality", "vision", "--in", "out", "--json"], 0);
    run(
        &[
            "register",
            "--sim",
            "--json",
            "--vid",
            "046d",
            "--pid",
            "0825",
            "--name",
            "another",
            "--node",
            "camera",
            "--dry-run",
        ],
        0,
    );
    run(&["unregister", "cam_wrist", "--dry-run", "--json"], 0);
    run(&["register", "--module", "tip_soft", "--dry-run", "--json"], 0);
    run(&["modules", "--json"], 0);
    run(&["policy", "show", "--sim", "task", "--json"], 0);
}

/// What ends the program is the last object, whether it is an argument, a file or a rig.
fn errors(place: &Place, printed: &mut String) {
    for (arguments, command) in [
        (&["inspect", "none.mcap", "--json"][..], "inspect"),
        (&["inspect", "--json"], "inspect"),
        (&["session", "--json", "--instance", "nobody"], "session"),
        (&["check", "--config", "none.toml", "--json", "--no-such-option"], "check"),
        (&["--sim", "none.toml", "--headless", "--json"], "run"),
        (&["list", "--since", "yesterday", "--json"], "list"),
    ] {
        let output = place.run(arguments);
        let code = output.status.code().expect("a code");
        let text = printed_by(&output, printed);
        let last: serde_json::Value = serde_json::from_str(text.lines().last().expect("a line")).expect("JSON");
        assert_eq!((&last["event"], &last["command"]), (&"error".into(), &command.into()), "{last}");
        assert_eq!((last["exit_code"].as_i64(), code > 0), (Some(code.into()), true), "{last}");
        assert!(last["message"].as_str().is_some_and(|message| !message.is_empty()), "{last}");
        assert!(!output.stderr.is_empty(), "{arguments:?}");
    }
}

/// Events that must occur, so that they are checked.
const EVENTS: &[&str] = &[
    "begin",
    "attach",
    "opened",
    "state",
    "recording",
    "mark",
    "progress",
    "episode",
    "summary",
    "mask",
    "answer",
    "session",
    "entry",
    "mistake",
    "plugged",
    "finding",
    "listed",
    "inspection",
    "plotted",
    "exported",
    "difference",
    "export",
    "repair",
    "configuration",
    "registered",
    "registered_module",
    "module_type",
    "unregistered",
    "policy_bundle",
    "error",
];

fn run(place: &Place, arguments: &[&str], code: i32, printed: &mut String) -> String {
    let output = place.run(arguments);
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {output:?}");
    printed_by(&output, printed)
}

fn printed_by(output: &Output, printed: &mut String) -> String {
    let lines = lines(output);
    printed.push_str(&lines);
    lines
}

/// The SHA-256 of a file by coreutils.
fn by_sha256sum(path: &Path) -> String {
    let output = Command::new("sha256sum").arg(path).output().expect("sha256sum");
    let text = String::from_utf8(output.stdout).expect("text");
    text.split(' ').next().expect("a hash").to_owned()
}

#[test]
fn the_hash_of_a_file_is_that_of_sha256sum() {
    let place = Place::new();
    let record = ["--sim", "--headless", "--json", "--record", "--duration", "2s", "--out", "out"];
    let recorded = place.run(&record);
    assert_eq!(recorded.status.code(), crate::support::recorded_code(&String::from_utf8_lossy(&recorded.stdout)));
    let [episode] = place.episodes("out").try_into().expect("one episode");
    let path = place.path("out").join(&episode);
    let bytes = std::fs::read(&path).expect("the episode");
    assert!(bytes.len() > 256 << 10, "several pieces are read: {}", bytes.len());
    // A file that differs in its last byte, and one that is not an episode at all.
    std::fs::write(place.path("out/other.mcap"), [&bytes[..bytes.len() - 1], b"x"].concat()).expect("a file");
    std::fs::write(place.path("out/text.mcap"), "no episode").expect("a file");
    let one = place.run(&["inspect", &format!("out/{episode}"), "--json"]);
    let one: serde_json::Value = serde_json::from_slice(&one.stdout).expect("JSON");
    assert_eq!(one["sha256"].as_str(), Some(by_sha256sum(&path).as_str()), "{one}");
    let listed = lines(&place.run(&["inspect", "out", "--json"]));
    let listed: Vec<serde_json::Value> = listed.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    assert_eq!(listed.len(), 3, "{listed:?}");
    for line in &listed {
        let file = Path::new(line["file"].as_str().expect("a path"));
        let expected = by_sha256sum(&place.path("out").join(file.file_name().expect("a name")));
        assert_eq!(line["sha256"].as_str(), Some(expected.as_str()), "{line}");
    }
    let hashes: BTreeSet<_> = listed.iter().map(|line| line["sha256"].to_string()).collect();
    assert_eq!(hashes.len(), 3);
}
