//! `rapid list`: recorded episodes, filtered and sorted, with what people noted about them.

use crate::support::Place;
use crate::support::terminal::OnTerminal;

/// The names that `rapid list out WORDS` shows, from its lines and from its JSON.
fn listed(place: &Place, words: &[&str]) -> Vec<String> {
    let of = |words: &[&str]| {
        let output = place.run(words);
        assert!(output.stderr.is_empty(), "{output:?}");
        String::from_utf8(output.stdout).expect("text")
    };
    let json = of(&[&["list", "out", "--json"], words].concat());
    let name = |line: &str| {
        let row: serde_json::Value = serde_json::from_str(line).expect("JSON");
        row["file"].as_str().expect("a path").strip_prefix("out/").expect("in the folder").to_owned()
    };
    let names: Vec<String> = json.lines().map(name).collect();
    let text = of(&[&["list", "out"], words].concat());
    let (total, rows) = text.trim_end().rsplit_once('\n').unwrap_or(("", ""));
    let (rows, total) = if rows.is_empty() { ("", text.as_str()) } else { (total, rows) };
    assert_eq!(rows.lines().count(), names.len(), "{text}");
    assert!(rows.lines().zip(&names).all(|(row, name)| row.contains(name.as_str())), "{text}");
    assert!(total.starts_with(&names.len().to_string()), "{text}");
    names
}

#[test]
fn episodes_are_listed_by_what_is_in_them_and_what_was_noted() {
    let place = Place::new();
    let scenario = "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"motor_state\"\n";
    place.write("two.toml", scenario);
    let record = |words: &[&str]| {
        let common = ["--headless", "--record", "--out", "out", "--duration"];
        place.run(&[&common, words].concat());
    };
    record(&["500ms", "--sim", "--task", "Place block", "--tag", "finger=soft"]);
    record(&["500ms", "--sim", "two.toml", "--task", "push"]);
    // Of several chunks, one of which is to be damaged.
    record(&["3s", "--sim", "--task", "push"]);
    let all = listed(&place, &[]);
    let [block, two, push] = all.as_slice() else { panic!("{all:?}") };
    let session = format!(
        "begun = \"2026-11-24T13:00:00.000Z\"\n[[episode]]\nfile = \"{block}\"\nbegun = \"2026-11-24T13:00:00.000Z\"\n\
         label = \"failure\"\nlabel_reason = \"slipped\"\nnote = \"new pads\"\n"
    );
    place.write("out/session.toml", &session);
    // A byte in the middle of the third is not what was written: it is never listed as GOOD.
    let path = place.path("out").join(push);
    let mut bytes = std::fs::read(&path).expect("the episode");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x55;
    std::fs::write(&path, bytes).expect("the episode");

    let names = |names: &[&String]| names.iter().map(|name| (*name).clone()).collect::<Vec<_>>();
    assert_eq!(listed(&place, &["--label", "failure"]), names(&[block]));
    assert_eq!(listed(&place, &["--label", "none", "--task", "PUSH"]), names(&[two, push]));
    assert_eq!(listed(&place, &["--tag", "finger=soft"]), names(&[block]));
    assert_eq!(listed(&place, &["--without", "tactile_tip"]), names(&[two]));
    assert_eq!(listed(&place, &["--sensor", "tactile_tip", "--sensor", "cam_wrist"]), names(&[block, push]));
    assert!(!listed(&place, &["--verdict", "good"]).contains(push));
    // On a busy machine the others need not be GOOD.
    let sorted = place.run(&["list", "out", "--sort", "verdict", "--json"]).stdout;
    let severity = |line: &str| {
        let row: serde_json::Value = serde_json::from_str(line).expect("JSON");
        ["BAD", "SUSPECT", "GOOD"].iter().position(|word| row["verdict"] == *word).expect("a verdict")
    };
    let severities: Vec<usize> = String::from_utf8(sorted).expect("text").lines().map(severity).collect();
    assert!(severities.len() == 3 && severities.is_sorted() && severities[0] < 2, "{severities:?}");
    assert_eq!(listed(&place, &["--since", "2020-01-01", "--before", "2020-01-02"]), names(&[]));
    assert_eq!(listed(&place, &["--since", "2020-01-01", "--utc"]), all);
    let text = String::from_utf8(place.run(&["list", "out"]).stdout).expect("text");
    assert!(text.contains("failure: slipped; new pads") && text.contains("finger=soft"), "{text}");

    // What cannot be read is never left out, and changes the exit code; a damaged session is reported.
    place.write("out/broken.mcap", "not an episode");
    place.write("out/session.toml", "begun = 3");
    let output = place.run(&["list", "out", "--tag", "finger=hard"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("broken.mcap") && text.contains("1 cannot be read"), "{text}");
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("labels and notes are missing: "), "{output:?}");
    assert_eq!(place.run(&["list", "out", "--since", "yesterday"]).status.code(), Some(2));
    let mistyped = place.run(&["list", "uot"]);
    assert_eq!((mistyped.status.code(), mistyped.stdout.len()), (Some(2), 0), "{mistyped:?}");
    assert!(String::from_utf8_lossy(&mistyped.stderr).contains("uot: "), "{mistyped:?}");
}

#[test]
fn progress_is_shown_on_a_terminal_alone_and_erased() {
    let place = Place::new();
    std::fs::create_dir(place.path("out")).expect("folder");
    for name in ["a", "b", "c"] {
        place.write(&format!("out/{name}.mcap"), "not an episode");
    }
    let shown = OnTerminal::start_in(&place, &["list", "out"], &[]).read_to_end();
    let (progress, rest) = shown.rsplit_once("\x1b[2K").expect("a line was erased");
    assert!(progress.contains("episodes ···················· 0/3"), "{shown:?}");
    assert!(rest.contains("3 cannot be read") && !rest.contains("episodes █"), "{shown:?}");
    let shown = OnTerminal::start_in(&place, &["list", "out"], &[("TERM", "dumb")]).read_to_end();
    assert!(shown.contains("3 cannot be read") && !shown.contains('\x1b'), "{shown:?}");
    let output = place.run(&["list", "out"]);
    assert!(output.stderr.is_empty() && !output.stdout.contains(&0x1b), "{output:?}");
}
