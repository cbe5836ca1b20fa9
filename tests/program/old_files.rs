//! Files of earlier formats stay readable: those of `tests/old`, whose README states what each does not have.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::support::{Episode, MaskMessage, Place, events};

fn old() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/old/before_plugged.mcap")
}

/// What a command prints on that file, with `--json`.
fn printed(place: &Place, words: &[&str]) -> Vec<Value> {
    let output = place.run(&[words, &["--json"]].concat());
    assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    events(&String::from_utf8_lossy(&output.stdout))
}

#[test]
fn the_file_is_of_the_format_before_plugged() {
    let bytes = std::fs::read(old()).expect("the file");
    let summary = mcap::Summary::read(&bytes).expect("a whole file").expect("a summary");
    let has_field = |name: &str, field: &[u8]| {
        let schema = summary.schemas.values().find(|schema| schema.name == name).expect("its schema");
        schema.data.windows(field.len()).any(|part| part == field)
    };
    assert!(has_field("rapid.Frame", b"present") && has_field("rapid.Mask", b"mask"));
    assert!(!has_field("rapid.Frame", b"plugged") && !has_field("rapid.Mask", b"plugged"));
    let episode = Episode::read(&old());
    let frames = episode.frames();
    assert_eq!(frames.len(), 18);
    let slots: Vec<_> = frames.iter().flat_map(|(_, frame)| &frame.modalities).collect();
    assert_eq!(slots.iter().filter(|slot| slot.present).count(), 14 + 18);
    assert!(slots.iter().all(|slot| !slot.plugged), "a field that is not there is false");
    assert!(episode.topic("/rapid/mask").all(|message| message.decode::<MaskMessage>().plugged == 0));
}

#[test]
fn an_old_file_is_inspected_listed_and_needs_no_repair() {
    let place = Place::new();
    let file = old().display().to_string();
    let report = printed(&place, &["inspect", &file]);
    let [report] = report.as_slice() else { panic!("{report:?}") };
    assert_eq!(
        (&report["verdict"], &report["recorded_verdict"]["verdict"]),
        (&"GOOD".into(), &"GOOD".into()),
        "{report}"
    );
    assert_eq!(
        (&report["messages"], &report["frames"], &report["damaged_chunks"]),
        (&1026.into(), &18.into(), &0.into())
    );
    let edges: Vec<&str> =
        report["mask"].as_array().expect("edges").iter().filter_map(|edge| edge["mask"].as_str()).collect();
    assert_eq!(edges, ["0x03", "0x02"]);
    let [cam, motor] = ["cam", "motor"].map(|name| {
        let modalities = report["modalities"].as_array().expect("modalities");
        modalities.iter().find(|modality| modality["name"] == name).expect("its entry").clone()
    });
    assert_eq!((&cam["messages"], &cam["frames_valid"], &motor["messages"]), (&13.into(), &13.into(), &90.into()));
    // By the events, which the frames did not have.
    assert!((1.37..1.39).contains(&cam["quality"]["plugged"].as_f64().expect("a number")), "{cam}");
    assert_eq!((cam["quality"]["lost"].as_u64(), motor["quality"]["clock_uncertainty"].as_f64()), (Some(0), None));
    let listed = printed(&place, &["list", &file]);
    assert_eq!((&listed[0]["verdict"], &listed[0]["end"]), (&"GOOD".into(), &"finished".into()), "{listed:?}");
    assert_eq!(printed(&place, &["recover", &file])[0]["outcome"], "whole");
}

#[test]
fn an_old_file_is_replayed_and_what_is_recorded_of_it_has_plugged() {
    let place = Place::new();
    let file = old().display().to_string();
    let output = place.run(&["replay", &file, "--headless", "--json", "--record", "--out", "again"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), crate::support::recorded_code(&text), "{text}");
    let reported = events(&text);
    let unplugged = |event: &Value| event["event"] == "detach" && event["device"] == "cam";
    assert_eq!(reported.iter().filter(|event| unplugged(event)).count(), 1, "{text}");
    let [again] = place.episodes("again").try_into().expect("one episode");
    let (before, after) = (Episode::read(&old()), Episode::read(&place.path("again").join(again)));
    let payloads = |episode: &Episode, topic: &str| -> Vec<Vec<u8>> {
        episode.messages.iter().filter(|message| message.topic == topic).map(crate::support::Message::payload).collect()
    };
    for topic in ["/rapid/camera/cam", "/rapid/serial/motor"] {
        let (known, found) = (payloads(&before, topic), payloads(&after, topic));
        assert!(!found.is_empty() && found.iter().all(|payload| known.contains(payload)), "{topic}");
    }
    let frames = after.frames();
    let slots: Vec<_> = frames.iter().flat_map(|(_, frame)| &frame.modalities).collect();
    assert!(slots.iter().any(|slot| slot.plugged) && slots.iter().all(|slot| slot.plugged || !slot.present));
}

#[cfg(feature = "export")]
#[test]
fn an_old_file_is_exported_and_the_export_is_verified() {
    let place = Place::new();
    let file = old().display().to_string();
    let export = ["export", &file, "--to", "lerobot", "--out", "set"];
    let done = printed(&place, &export);
    let total = done.last().expect("a line");
    assert_eq!(
        (&total["exported"], &total["frames"], &total["left_out"]),
        (&1.into(), &18.into(), &0.into()),
        "{done:?}"
    );
    let verified = printed(&place, &[&export[..], &["--verify"]].concat());
    let total = verified.last().expect("a line");
    assert_eq!((&total["verified"], &total["differences"]), (&18.into(), &0.into()), "{verified:?}");
}
