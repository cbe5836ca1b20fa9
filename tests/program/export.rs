//! `rapid export`: a dataset of recorded episodes, read back; what is left out, continued, damaged and manipulated.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Int64Type};
use arrow_array::{ArrayRef, RecordBatch};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use rapid::cli::{ExportArgs, Layout};
use rapid::commands::{self, Format};
use rapid_registry::BUILTIN;
use serde_json::Value;

use crate::support::{Episode, Place};

mod videos;

const DATA: &str = "set/data/chunk-000/file-000.parquet";
const PNG: &[u8] = b"\x89PNG";
const JPEG: &[u8] = &[0xff, 0xd8];

/// `rapid export WORDS --to lerobot --out set --json`: its objects and its exit code.
fn export(place: &Place, words: &[&str]) -> (Vec<Value>, i32) {
    let output = place.run(&[&["export", "--to", "lerobot", "--out", "set", "--json"], words].concat());
    let text = String::from_utf8(output.stdout).expect("text");
    let objects = text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    (objects, output.status.code().expect("a code"))
}

/// The objects of this kind.
fn of<'a>(objects: &'a [Value], event: &str) -> Vec<&'a Value> {
    objects.iter().filter(|object| object["event"] == event).collect()
}

/// The outcome of each episode by its name, with its reason if it is left out.
fn outcomes(objects: &[Value]) -> BTreeMap<String, String> {
    let outcome = |object: &&Value| {
        let file = PathBuf::from(object["file"].as_str().expect("a file"));
        let name = file.file_name().expect("a name").to_string_lossy().into_owned();
        let reason = object["reason"].as_str().map(|reason| format!(": {reason}")).unwrap_or_default();
        (name, format!("{}{reason}", object["outcome"].as_str().expect("an outcome")))
    };
    of(objects, "exported").iter().map(outcome).collect()
}

fn record(place: &Place, out: &str, duration: &str, words: &[&str]) -> String {
    let before = place.episodes(out);
    let common = ["--headless", "--record", "--out", out, "--duration", duration];
    place.run(&[&common, words].concat());
    let new = place.episodes(out).into_iter().find(|name| !before.contains(name));
    format!("{out}/{}", new.expect("an episode"))
}

/// The rows of a table.
pub(crate) fn rows(place: &Place, name: &str) -> Vec<RecordBatch> {
    let file = File::open(place.path(name)).expect("the table");
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).expect("Parquet").build().expect("Parquet");
    reader.collect::<Result<_, _>>().expect("rows")
}

/// Of each row, the numbers of a feature.
pub(crate) fn numbers(place: &Place, name: &str, feature: &str) -> Vec<Vec<f32>> {
    let of_row = |batch: &RecordBatch| {
        let column = batch.column_by_name(feature).expect("a column");
        let row = |at| {
            // One number is a plain column.
            let row = column.as_fixed_size_list_opt().map_or_else(|| column.slice(at, 1), |lists| lists.value(at));
            row.as_primitive::<Float32Type>().values().to_vec()
        };
        (0..batch.num_rows()).map(row).collect::<Vec<_>>()
    };
    rows(place, name).iter().flat_map(of_row).collect()
}

/// Mask, valid modalities, the file of a picture.
type Pictured = (Vec<bool>, Vec<bool>, Vec<u8>);

/// Of each row: the mask, which modalities are valid, and the picture of `camera`.
fn pictures(place: &Place, name: &str, camera: &str) -> Vec<Pictured> {
    let mut all = Vec::new();
    for batch in rows(place, name) {
        let lists = |key: &str| batch.column_by_name(key).expect("a column").as_fixed_size_list().clone();
        let (masks, valid) = (lists("rapid.mask"), lists("rapid.valid"));
        let files = batch.column_by_name(camera).expect("a camera").as_struct();
        let files = files.column_by_name("bytes").expect("bytes").as_binary::<i32>();
        for at in 0..batch.num_rows() {
            let flags =
                |row: ArrayRef| row.as_primitive::<Float32Type>().values().iter().map(|flag| *flag > 0.5).collect();
            all.push((flags(masks.value(at)), flags(valid.value(at)), files.value(at).to_vec()));
        }
    }
    all
}

fn json(place: &Place, name: &str) -> Value {
    serde_json::from_slice(&std::fs::read(place.path(name)).expect("a file")).expect("JSON")
}

#[test]
fn an_unplugged_sensor_is_black_with_its_mask_and_a_changed_byte_is_found() {
    let place = Place::lenient();
    // The demonstration unplugs the tactile camera after 4 s and plugs it in again.
    let episode = record(&place, "out", "8s", &["--sim", "--task", "place block"]);
    let (objects, code) = export(&place, &["out", "--verify"]);
    assert_eq!(code, 0, "{objects:?}");
    let summary = of(&objects, "export")[0];
    let frames = summary["frames"].as_u64().expect("frames");
    assert_eq!(frames, Episode::read(&place.path(&episode)).topic("/rapid/frame").count() as u64, "{summary}");
    assert_eq!((&summary["verified"], &summary["differences"]), (&frames.into(), &0.into()));

    let info = json(&place, "set/meta/info.json");
    assert_eq!((&info["fps"], &info["total_episodes"], &info["total_frames"]), (&30.into(), &1.into(), &frames.into()));
    let features = info["features"].as_object().expect("features");
    assert!(features.keys().all(|key| !key.contains('/')), "{features:?}");
    assert_eq!(features["observation.images.cam_wrist"]["shape"], serde_json::json!([480, 640, 3]));
    let state = features["observation.state"]["names"].as_array().expect("names");
    assert_eq!((state[0].as_str(), &features["rapid.age"]["dtype"]), (Some("motor_state.0"), &"float64".into()));
    assert_eq!(features["rapid.mask"]["names"], serde_json::json!(["cam_wrist", "tactile_tip", "motor_state"]));

    let tactile = pictures(&place, DATA, "observation.images.tactile_tip");
    let wrist = pictures(&place, DATA, "observation.images.cam_wrist");
    let absent = tactile.iter().filter(|(mask, ..)| !mask[1]).count();
    assert!((15..150).contains(&absent), "{absent}");
    for (mask, valid, picture) in &tactile {
        let is_black = picture.starts_with(PNG);
        assert!(is_black || picture.starts_with(JPEG));
        assert!(mask[1] || is_black);
        if valid[1] {
            assert!(mask[1] && !is_black);
        }
    }
    // Present from its first sample on: later, a sample that is late repeats the last one.
    let first = wrist.iter().position(|(.., picture)| picture.starts_with(JPEG)).expect("a picture");
    assert!(wrist[..first].iter().all(|(_, valid, _)| !valid[0]));
    assert!(wrist[first..].iter().all(|(mask, _, picture)| mask[0] && picture.starts_with(JPEG)));
    // What is present is plugged in; the tactile camera is neither for a time.
    let [masks, plugged] = ["rapid.mask", "rapid.plugged"].map(|feature| numbers(&place, DATA, feature));
    assert!(masks.iter().flatten().zip(plugged.iter().flatten()).all(|(mask, plugged)| mask <= plugged));
    let is_unplugged = |row: &Vec<f32>| row.iter().map(|flag| *flag > 0.5).eq([true, false, true]);
    assert!(plugged.iter().any(is_unplugged), "{plugged:?}");
    // Over the valid rows alone: the black ones would be the least.
    let statistics = json(&place, "set/meta/stats.json");
    let count = statistics["observation.images.tactile_tip"]["count"][0].as_u64().expect("a count");
    let valid = tactile.iter().filter(|(_, valid, _)| valid[1]).count() as u64;
    assert_eq!(count, valid);
    let mean = statistics["rapid.valid"]["mean"][1].as_f64().expect("a mean");
    assert!((mean - valid as f64 / frames as f64).abs() < 1e-9, "{mean}");

    manipulated(&place, &wrist);
}

/// A byte of a picture, and then of the mask's column, is changed in the table.
fn manipulated(place: &Place, wrist: &[Pictured]) {
    let whole = std::fs::read(place.path(DATA)).expect("the table");
    // One that no earlier row repeats: a late sample repeats the last one.
    let is_new = |at: &usize| wrist[..*at].iter().all(|(.., before)| *before != wrist[*at].2);
    let frame = (wrist.len() / 2..wrist.len()).find(is_new).expect("a new picture in half of the episode");
    let picture = &wrist[frame].2;
    let at = whole.windows(picture.len()).position(|bytes| bytes == picture.as_slice()).expect("its bytes, unchanged");
    let mut changed = whole.clone();
    changed[at + 321] ^= 1;
    std::fs::write(place.path(DATA), &changed).expect("written");
    let (objects, code) = export(place, &["out", "--verify"]);
    let differences = of(&objects, "difference");
    let [difference] = differences.as_slice() else { panic!("{objects:?}") };
    assert_eq!((code, &difference["episode"], &difference["frame"]), (1, &0.into(), &frame.into()));
    assert_eq!(difference["feature"], "observation.images.cam_wrist");
    assert!(difference["what"].as_str().expect("text").contains("from byte 321 on"), "{difference}");

    // A table that can no longer be read.
    std::fs::write(place.path(DATA), &whole[..whole.len() - 10]).expect("written");
    let (objects, code) = export(place, &["out", "--verify"]);
    assert!(code == 1 && of(&objects, "difference").len() == 1, "{objects:?}");
    std::fs::write(place.path(DATA), &whole).expect("written");
    assert_eq!(export(place, &["out", "--verify"]).1, 0);
}

#[test]
fn what_does_not_fit_is_named_and_the_rest_is_appended() {
    let place = Place::lenient();
    let first = record(&place, "out", "1500ms", &["--sim", "--task", "push"]);
    // One of each reason. The features are those of the first by name.
    let short = record(&place, "out", "300ms", &["--sim", "--task", "short"]);
    let slow = record(&place, "out", "1500ms", &["--sim", "--rate", "20", "--task", "slow"]);
    let odd = record(&place, "out", "1500ms", &["--sim", "--rate", "12.5", "--task", "slow"]);
    let bytes = std::fs::read(place.path(&first)).expect("the episode");
    let mut holed = bytes.clone();
    let third = holed.len() / 3;
    holed[third..third + 5000].fill(0);
    std::fs::write(place.path("out/holed.mcap"), holed).expect("written");
    std::fs::write(place.path("out/cut.mcap.partial"), &bytes[..bytes.len() / 2]).expect("written");
    std::fs::write(place.path("out/same.mcap"), &bytes).expect("written");
    place.write("out/text.mcap", "no episode");

    let (objects, code) = export(&place, &["out"]);
    assert_eq!(code, 0);
    let found = outcomes(&objects);
    let outcome = |name: &str| found[name.rsplit('/').next().expect("a name")].as_str();
    assert_eq!(outcome(&first), "exported");
    assert!(outcome(&short).starts_with("left_out: BAD (") && outcome(&short).contains("--include-bad"), "{found:?}");
    assert_eq!(outcome(&slow), "left_out: 20 frames a second, and 30 in the dataset");
    assert!(outcome(&odd).starts_with("left_out: 12.5 observations a second"), "{found:?}");
    assert!(outcome("holed.mcap").starts_with("left_out: damaged (1 damaged chunk"), "{found:?}");
    assert!(outcome("cut.mcap.partial").starts_with("left_out: "), "{found:?}");
    assert_eq!(outcome("same.mcap"), format!("left_out: the same as {first}"));
    assert_eq!(outcome("text.mcap"), "left_out: not an MCAP file");
    let summary = of(&objects, "export")[0];
    assert_eq!((&summary["exported"], &summary["left_out"], &summary["bad"]), (&1.into(), &7.into(), &1.into()));

    // Now with the BAD one, and another whose tactile camera was never there: its size is known from the first.
    place.write("two.toml", "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"motor_state\"\n");
    let without = record(&place, "out", "1500ms", &["--sim", "two.toml", "--task", "pull"]);
    let (objects, code) = export(&place, &[&short, &without, &first, "--include-bad", "--verify"]);
    let found = outcomes(&objects);
    let outcome = |name: &str| found[name.rsplit('/').next().expect("a name")].as_str();
    assert_eq!((outcome(&short), outcome(&without), outcome(&first), code), ("exported", "exported", "already", 0));
    let summary = of(&objects, "export")[0];
    assert_eq!((&summary["episodes"], &summary["differences"]), (&3.into(), &0.into()), "{summary}");
    let last = pictures(&place, "set/data/chunk-000/file-002.parquet", "observation.images.tactile_tip");
    assert!(last.iter().all(|(mask, valid, picture)| !mask[1] && !valid[1] && picture.starts_with(PNG)));
    let batch = &rows(&place, "set/data/chunk-000/file-002.parquet")[0];
    let first_of = |key: &str| batch.column_by_name(key).expect("a column").as_primitive::<Int64Type>().value(0);
    assert_eq!((first_of("episode_index"), first_of("frame_index"), first_of("task_index")), (2, 0, 2));
    let before = summary["frames"].as_i64().expect("frames") - i64::try_from(last.len()).expect("a length");
    assert_eq!(first_of("index"), before);
    nothing_left(&place, &short, &slow);
}

fn nothing_left(place: &Place, short: &str, slow: &str) {
    // A different choice of columns is another dataset.
    let state = |words: &[&str]| {
        let common = ["export", slow, "--to", "lerobot", "--out", "other"];
        place.run(&[&common, words].concat())
    };
    let unknown = state(&["--state", "cam_wrist"]);
    let text = String::from_utf8_lossy(&unknown.stderr).into_owned();
    assert!(text.contains("\"cam_wrist\" is not a numeric sensor; those are motor_state"), "{text}");
    assert!(text.contains("error: nothing exported: none of 1 episode"), "{text}");
    assert_eq!((unknown.status.code(), place.path("other").exists()), (Some(1), false));
    let as_action = state(&["--state", "motor_state", "--action", "motor_state"]);
    assert_eq!(as_action.status.code(), Some(0), "{as_action:?}");
    let info = json(place, "other/meta/info.json");
    assert_eq!(info["features"]["action"]["names"], info["features"]["observation.state"]["names"]);

    let output = place.run(&["export", short, "--to", "lerobot", "--out", "third", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let last: Value = serde_json::from_str(text.lines().last().expect("a line")).expect("JSON");
    assert_eq!((&last["event"], &last["exit_code"]), (&"error".into(), &1.into()), "{text}");
    // A folder with anything else is not written to.
    let foreign = place.run(&["export", slow, "--to", "lerobot", "--out", "out"]);
    assert_eq!(foreign.status.code(), Some(2), "{foreign:?}");
    assert!(String::from_utf8_lossy(&foreign.stderr).contains("--out takes a new folder"), "{foreign:?}");
}

/// All files of a folder with their contents, by their path in it.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).expect("a folder").flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let bytes = std::fs::read(&path).expect("a file");
                found.insert(path.strip_prefix(folder).expect("below it").to_owned(), bytes);
            }
        }
    }
    found
}

#[test]
fn one_worker_and_several_write_the_same_bytes() {
    let place = Place::new();
    for task in ["push", "pull", "push", "lift"] {
        record(&place, "out", "1s", &["--sim", "--task", task]);
    }
    let exported = |set: &str, jobs: &str| {
        let common = ["export", "out", "--to", "lerobot", "--include-bad", "--verify", "--out", set, "--jobs", jobs];
        let output = place.run(&common);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        contents(&place.path(set))
    };
    let (one, several) = (exported("one", "1"), exported("several", "4"));
    assert_eq!(one.keys().collect::<Vec<_>>(), several.keys().collect::<Vec<_>>());
    assert_eq!(one.keys().filter(|path| path.starts_with("data")).count(), 4);
    for (path, bytes) in &one {
        assert!(several[path] == *bytes, "{} differs", path.display());
    }
}

#[test]
fn columns_are_chosen_by_the_registry_of_the_episode_and_by_options() {
    let place = Place::new();
    let joints = "[device.motor_state.joints]\nnames = [\"hip\", \"knee\", \"ankle\"]\n";
    let chosen = "[export]\nstate = [\"motor_state.knee\", \"motor_state.0\"]\naction = [\"motor_state.2\"]\n";
    place.write("devices.toml", &format!("{BUILTIN}\n{joints}{chosen}"));
    let first = record(&place, "out", "1500ms", &["--sim", "--config", "devices.toml"]);
    // The registry in the episode is used, and not what the file holds now.
    place.write("devices.toml", BUILTIN);
    let (objects, code) = export(&place, &[&first, "--include-bad", "--verify"]);
    assert_eq!((code, &of(&objects, "export")[0]["differences"]), (0, &0.into()), "{objects:?}");
    let [state, action] =
        ["observation.state", "action"].map(|key| json(&place, "set/meta/info.json")["features"][key].clone());
    assert_eq!(state["names"], serde_json::json!(["motor_state.knee.position", "motor_state.hip.position"]));
    assert_eq!(state["columns"], serde_json::json!(["motor_state.1", "motor_state.0"]));
    assert_eq!(state["chosen"], serde_json::json!(["motor_state.knee", "motor_state.0"]));
    assert_eq!(
        (&action["names"][0], &action["shape"]),
        (&"motor_state.ankle.position".into(), &serde_json::json!([1]))
    );

    // Options come before the registry; the numbers are the same ones, of the same tick.
    let words = ["export", first.as_str(), "--to", "lerobot", "--include-bad", "--verify", "--out", "other"];
    let output =
        place.run(&[&words[..], &["--state", "motor_state", "--action", "motor_state.1-2,motor_state.hip"]].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let other = "other/data/chunk-000/file-000.parquet";
    let all = numbers(&place, other, "observation.state");
    let picked = |picked: &[usize]| -> Vec<Vec<f32>> {
        all.iter().map(|row| picked.iter().map(|at| row[*at]).collect()).collect()
    };
    assert!(all.iter().flatten().any(|number| *number != 0.0));
    assert_eq!(numbers(&place, DATA, "observation.state"), picked(&[1, 0]));
    assert_eq!(numbers(&place, DATA, "action"), picked(&[2]));
    assert_eq!(numbers(&place, other, "action"), picked(&[1, 2, 0]));
    let statistics = [json(&place, "set/meta/stats.json"), json(&place, "other/meta/stats.json")];
    assert_eq!(statistics[0]["observation.state"]["mean"][0], statistics[1]["observation.state"]["mean"][1]);

    // An episode without these names does not fit, and names what it has.
    let second = record(&place, "out", "1500ms", &["--sim"]);
    let (objects, _) = export(&place, &[&first, &second, "--include-bad"]);
    let outcome = outcomes(&objects)[second.rsplit('/').next().expect("a name")].clone();
    assert_eq!(outcome, "left_out: \"motor_state.knee\": motor_state has no column \"knee\"; it has 0-2");
}

/// Sets a flag as soon as an episode is exported.
struct Interrupting<'a>(&'a AtomicBool, Vec<u8>);

impl Write for Interrupting<'_> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.1.extend(bytes);
        if String::from_utf8_lossy(&self.1).contains("\"exported\",\"episode\"") {
            self.0.store(true, Ordering::Relaxed);
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn an_interrupted_export_has_the_episodes_so_far() {
    let place = Place::new();
    for _ in 0..3 {
        record(&place, "out", "1s", &["--sim"]);
    }
    let args = ExportArgs {
        paths: vec![place.path("out")],
        to: Layout::Lerobot,
        out: place.path("set"),
        verdict: Vec::new(),
        label: Vec::new(),
        include_bad: true,
        state: Vec::new(),
        action: Vec::new(),
        pictures: None,
        ffmpeg: None,
        jobs: None,
        verify: true,
    };
    let stop = AtomicBool::new(true);
    let interrupted = |stop: &AtomicBool| {
        let mut out = Interrupting(stop, Vec::new());
        let ended = commands::export::export(&args, Format::Json, stop, &mut out, &mut std::io::sink());
        ended.expect_err("interrupted").to_string()
    };
    assert!(interrupted(&stop).ends_with("has 0 episodes, and the same command continues"));
    assert!(!place.path("set").exists());
    stop.store(false, Ordering::Relaxed);
    assert!(interrupted(&stop).ends_with("has 1 episode, and the same command continues"));
    assert_eq!(json(&place, "set/meta/info.json")["total_episodes"], 1);
    let (objects, code) = export(&place, &["out", "--include-bad", "--verify"]);
    let summary = of(&objects, "export")[0];
    assert_eq!((code, &summary["already"], &summary["exported"]), (0, &1.into(), &2.into()), "{objects:?}");
    assert_eq!(summary["differences"], 0);
}

#[test]
fn a_killed_export_is_continued_from_every_state_that_it_may_leave() {
    let place = Place::lenient();
    for _ in 0..2 {
        record(&place, "out", "1500ms", &["--sim"]);
    }
    let kill = ["export", "out", "--to", "lerobot", "--out", "set", "--json"];
    // After the first episode, at some moment of the second.
    drop(place.start(&kill, "\"outcome\":\"exported\""));
    let (objects, code) = export(&place, &["out", "--verify"]);
    let summary = of(&objects, "export")[0];
    assert_eq!((code, &summary["episodes"], &summary["differences"]), (0, &2.into(), &0.into()), "{objects:?}");
    assert!(summary["already"].as_u64() >= Some(1), "{summary}");

    let [info, stats] = ["set/meta/info.json", "set/meta/stats.json"].map(|name| json(&place, name));
    let facts = place.path("set/meta/episodes/chunk-000/file-001.parquet");
    let third = "set/data/chunk-000/file-002.parquet";
    // A table of a third episode without a name, and one without facts; a set without the facts about all.
    std::fs::write(place.path("set/data/chunk-000/.file-002.parquet.tmp"), "half").expect("written");
    std::fs::copy(place.path(DATA), place.path(third)).expect("copied");
    let mut of_one = info.clone();
    of_one["total_episodes"] = 1.into();
    std::fs::write(place.path("set/meta/info.json"), of_one.to_string()).expect("written");
    let (objects, code) = export(&place, &["out", "--verify"]);
    assert_eq!((code, &of(&objects, "export")[0]["already"]), (0, &2.into()), "{objects:?}");
    assert_eq!(
        (json(&place, "set/meta/info.json"), json(&place, "set/meta/stats.json")),
        (info.clone(), stats.clone())
    );
    assert!(!place.path(third).exists());

    // Killed between the table of the second and its facts.
    std::fs::remove_file(&facts).expect("removed");
    let (objects, code) = export(&place, &["out", "--verify"]);
    let summary = of(&objects, "export")[0];
    assert_eq!((code, &summary["already"], &summary["exported"]), (0, &1.into(), &1.into()), "{objects:?}");
    assert_eq!((json(&place, "set/meta/info.json"), json(&place, "set/meta/stats.json")), (info, stats));
}

/// The text of an episode's facts.
fn fact(place: &Place, episode: usize, key: &str) -> Option<String> {
    let batch = &rows(place, &format!("set/meta/episodes/chunk-000/file-{episode:03}.parquet"))[0];
    Some(batch.column_by_name(key)?.as_string::<i32>().value(0).to_owned())
}

#[test]
fn label_and_verdict_select_and_labels_and_notes_are_in_the_dataset() {
    let place = Place::lenient();
    for duration in ["1s", "1s", "1s", "300ms"] {
        record(&place, "out", duration, &["--sim"]);
    }
    let names = place.episodes("out");
    let [success, failure, unlabelled, short] = names.as_slice() else { panic!("{names:?}") };
    let noted = |label: &str, name: &str| {
        let reason = if label == "failure" { "label_reason = \"slipped\"\nnote = \"new pads\"\n" } else { "" };
        format!("[[episode]]\nfile = \"{name}\"\nbegun = \"2026-11-24T13:00:00.000Z\"\nlabel = \"{label}\"\n{reason}")
    };
    let begin = "begun = \"2026-11-24T13:00:00.000Z\"\n".to_owned();
    let both = [begin.clone(), noted("success", success), noted("failure", failure), noted("success", short)].concat();
    place.write("out/session.toml", &both);
    let selected = |words: &[&str]| {
        let (objects, code) = export(&place, &[&["out"], words].concat());
        let summary = of(&objects, "export")[0].clone();
        let outcomes = outcomes(&objects).into_iter().filter(|(_, outcome)| outcome == "exported");
        (outcomes.map(|(name, _)| name).collect::<Vec<_>>(), summary["not_selected"].as_u64(), code)
    };
    // The short one is BAD; the others are at least SUSPECT.
    let fit = "good,suspect";
    assert_eq!(selected(&["--label", "success", "--verdict", fit]), (vec![success.clone()], Some(3), 0));
    assert_eq!(fact(&place, 0, "rapid/label").as_deref(), Some("success"));
    assert_eq!(selected(&["--label", "success,none", "--verdict", "BAD"]), (vec![short.clone()], Some(2), 0));
    // An episode of an earlier version, whose facts have no labels: LeRobot loads only facts of one form.
    let facts = place.path("set/meta/episodes/chunk-000/file-001.parquet");
    let batch = rows(&place, "set/meta/episodes/chunk-000/file-001.parquet").remove(0);
    let keys = ["rapid/label", "rapid/label_reason", "rapid/note", "rapid/marks"];
    let schema = batch.schema();
    let kept: Vec<usize> =
        (0..batch.num_columns()).filter(|at| !keys.contains(&schema.field(*at).name().as_str())).collect();
    let earlier = batch.project(&kept).expect("columns");
    let mut writer =
        parquet::arrow::ArrowWriter::try_new(File::create(&facts).expect("the facts"), earlier.schema(), None)
            .expect("Parquet");
    writer.write(&earlier).and_then(|()| writer.close()).expect("written");
    assert_eq!(fact(&place, 1, "rapid/label"), None);
    // A label that was changed after the export is in the dataset too, and what is noted beside an episode.
    let beside = "label = \"failure\"\n[[marks]]\nat = 0.5\ntext = \"grasped\"\n";
    place.write(&format!("out/{unlabelled}.toml"), beside);
    place.write("out/session.toml", &[begin, noted("failure", success), noted("failure", failure)].concat());
    assert_eq!(selected(&[]), (vec![failure.clone(), unlabelled.clone()], Some(0), 0));
    let facts = |episode| keys.map(|key| fact(&place, episode, key).expect("a text"));
    assert_eq!(facts(0), ["failure", "slipped", "new pads", ""]);
    assert_eq!(facts(1), ["", "", "", ""]);
    assert_eq!(facts(2), ["failure", "slipped", "new pads", ""]);
    assert_eq!(facts(3), ["failure", "", "", r#"[{"at":0.5,"text":"grasped"}]"#]);

    let none = place.run(&["export", "out", "--to", "lerobot", "--out", "none", "--label", "success"]);
    let text = String::from_utf8_lossy(&none.stderr).into_owned();
    assert!(text.contains("none of 4 episodes has what --label and --verdict select"), "{text}");
    assert_eq!((none.status.code(), place.path("none").exists()), (Some(1), false));
}
