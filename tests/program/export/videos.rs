//! Pictures as videos: read back, damaged, made by an ffmpeg that fails, hangs or is killed, and continued.

use std::fmt::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use arrow_array::types::Float64Type;
use rustix::process::Signal;

use super::*;
use crate::support::{executable, until};

const WRIST: &str = "observation.images.cam_wrist";
const TACTILE: &str = "observation.images.tactile_tip";

fn video(set: &str, camera: &str, episode: usize) -> String {
    format!("{set}/videos/{camera}/chunk-000/file-{episode:03}.mp4")
}

/// Runs the ffmpeg of `make setup`.
fn ffmpeg(place: &Place, words: &[&str]) -> Output {
    let mut command = Command::new("ffmpeg");
    command.args(["-v", "error", "-nostdin"]).args(words).current_dir(place.folder.path());
    let output = command.output().expect("ffmpeg, which `make setup` installs");
    assert!(output.status.success(), "{output:?}");
    output
}

/// Every file below a folder whose name shows that it is not complete.
fn incomplete(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for path in std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()) {
        if path.is_dir() {
            found.extend(incomplete(&path));
        } else if path.extension().is_some_and(|extension| extension == "tmp") {
            found.push(path);
        }
    }
    found
}

#[test]
fn a_video_has_a_frame_for_each_row_and_what_differs_is_found() {
    let place = Place::new();
    // The demonstration unplugs the tactile camera after 4 s.
    record(&place, "out", "5s", &["--sim"]);
    let run = |words: &[&str]| {
        let (objects, code) = export(&place, words);
        (of(&objects, "difference").into_iter().cloned().collect::<Vec<_>>(), of(&objects, "export")[0].clone(), code)
    };
    let (differences, summary, code) = run(&["out", "--include-bad", "--pictures", "av1", "--verify"]);
    assert_eq!((code, differences.len(), &summary["exported"]), (0, 0, &1.into()), "{differences:?}");
    assert!(summary["psnr_db"].as_f64().expect("dB") > 30.0, "{summary}");

    // Another form is refused by name; without one it is that of the dataset.
    let common = ["export", "out", "--include-bad", "--to", "lerobot", "--out"];
    let other = place.run(&[&common[..], &["set", "--pictures", "jpeg"]].concat());
    let text = String::from_utf8_lossy(&other.stderr).into_owned();
    assert_eq!(other.status.code(), Some(2), "{text}");
    assert!(text.contains("set: its pictures are av1, and --pictures is jpeg"), "{text}");
    assert_eq!(run(&["out", "--include-bad"]).1["already"], 1);

    // All but the pictures is as it is with JPEGs.
    assert_eq!(place.run(&[&common[..], &["files"]].concat()).status.code(), Some(0));
    assert_eq!(json(&place, "set/meta/stats.json"), json(&place, "files/meta/stats.json"));
    let [with, without] = ["set", "files"].map(|set| rows(&place, &format!("{set}/data/chunk-000/file-000.parquet")));
    let columns = |batch: &RecordBatch| batch.schema().fields().iter().map(|field| field.name().clone()).collect();
    let (with_names, mut without_names): (Vec<String>, Vec<String>) = (columns(&with[0]), columns(&without[0]));
    without_names.retain(|name| !name.starts_with("observation.images"));
    assert_eq!(with_names, without_names);
    for name in &with_names {
        assert_eq!(with[0].column_by_name(name), without[0].column_by_name(name), "{name}");
    }
    let info = json(&place, "set/meta/info.json");
    assert_eq!(info["features"][WRIST]["info"]["video.codec"], "av1");
    let facts = &rows(&place, "set/meta/episodes/chunk-000/file-000.parquet")[0];
    let end = facts.column_by_name(&format!("videos/{TACTILE}/to_timestamp")).expect("a column");
    let frames = info["total_frames"].as_f64().expect("frames");
    let found = end.as_primitive::<Float64Type>().value(0);
    assert!((found - frames / 30.0).abs() < 1e-9, "{found} of {frames} frames");
    assert_eq!(incomplete(&place.path("set")), Vec::<PathBuf>::new());
    replaced(&place, &run);
}

/// The differences, the summary, the exit code.
type Outcome = (Vec<Value>, Value, i32);

/// The tactile camera's video is replaced by ones that are wrong.
fn replaced(place: &Place, run: &dyn Fn(&[&str]) -> Outcome) {
    let path = video("set", TACTILE, 0);
    let whole = std::fs::read(place.path(&path)).expect("the video");
    std::fs::copy(place.path(&path), place.path("whole.mp4")).expect("copied");
    let wrong = |words: &[&str]| {
        let encoded = ["-c:v", "libx264", "-bf", "0", "-y", &path];
        ffmpeg(place, &[&["-i", "whole.mp4"], words, &encoded].concat());
        let (differences, _, code) = run(&["out", "--include-bad", "--verify"]);
        let is_named = differences.iter().all(|difference| difference["feature"] == TACTILE);
        assert!(code == 1 && is_named, "{words:?}: {differences:?}");
        differences.iter().fold(String::new(), |mut text, difference| {
            let _ = writeln!(text, "{}: {}", difference["frame"], difference["what"]);
            text
        })
    };
    let negative = wrong(&["-vf", "negate"]);
    assert!(negative.contains("another picture: "), "{negative}");
    let brighter = wrong(&["-vf", "eq=brightness=0.06"]);
    assert!(brighter.contains("a picture, where the camera has none"), "{brighter}");
    let short = wrong(&["-frames:v", "100"]);
    assert!(short.contains("null: ") && short.contains("the video has 100 frames, and the episode 1"), "{short}");
    assert!(short.contains("100: \"the video cannot be decoded from here on"), "{short}");
    let late = wrong(&["-vf", "setpts=PTS+3/30/TB"]);
    assert!(late.contains("frame 0 of the video is not at its time"), "{late}");
    std::fs::write(place.path(&path), &whole[..whole.len() / 2]).expect("written");
    let (differences, _, code) = run(&["out", "--include-bad", "--verify"]);
    assert!(code == 1 && !differences.is_empty(), "{differences:?}");
    std::fs::write(place.path(&path), &whole).expect("written");
    assert_eq!(run(&["out", "--include-bad", "--verify"]).2, 0);
    std::fs::remove_file(place.path(&path)).expect("removed");
    let missing = place.run(&["export", "out", "--to", "lerobot", "--out", "set"]);
    let text = String::from_utf8_lossy(&missing.stderr).into_owned();
    assert!(missing.status.code() == Some(1) && text.contains("file-000.mp4: No such file"), "{text}");
}

/// A program before ffmpeg: `encoding` is what it does in place of encoding; what it is otherwise called for, ffmpeg does.
fn wrapped(place: &Place, encoding: &str) -> String {
    let text = format!("#!/bin/sh\ncase \"$*\" in *pipe:0*) {encoding} ;; *) exec ffmpeg \"$@\" ;; esac\n");
    let path = place.path("wrapped");
    executable::script(&path, &text);
    path.to_string_lossy().into_owned()
}

/// The number in this file, once it is there.
fn process(place: &Place, name: &str) -> u32 {
    let mut found = None;
    until("the program starts", || {
        let text = std::fs::read_to_string(place.path(name)).unwrap_or_default();
        found = text.strip_suffix('\n').and_then(|number| number.parse().ok());
        found.is_some()
    });
    found.expect("a number")
}

/// Waits until a process has ended, also one that its parent has not waited for.
fn gone(process: u32) {
    until("the program ends", || {
        let state = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
        state.is_empty() || state.contains(") Z ")
    });
}

#[test]
fn an_ffmpeg_that_fails_leaves_nothing_and_the_next_one_continues() {
    let place = Place::new();
    record(&place, "out", "1500ms", &["--sim"]);
    let words = ["export", "out", "--include-bad", "--to", "lerobot", "--out", "set", "--pictures", "h264", "--ffmpeg"];
    let failing = |encoding: &str, message: &str| {
        let output = place.run(&[&words[..], &[&wrapped(&place, encoding)]].concat());
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(1) && text.contains(message), "{encoding}: {text}");
        assert!(!place.path("set/meta").exists(), "{encoding}");
        assert_eq!(incomplete(&place.path("set")), Vec::<PathBuf>::new(), "{encoding}");
    };
    failing("echo no space on it >&2; exit 1", "exit status: 1: no space on it");
    failing("head -c 100000 >/dev/null; kill -SEGV $$", "signal: 11");
    // As if the last pictures were lost.
    failing("head -c 9216000 | ffmpeg \"$@\"; cat >/dev/null", "frames, and the episode ");
    failing("cat >/dev/null", "wrapped: exit status: ");

    let absent = place.run(&[&words[..], &["/no/such/ffmpeg"]].concat());
    let text = String::from_utf8_lossy(&absent.stderr).into_owned();
    assert!(absent.status.code() == Some(2) && text.contains("apt install ffmpeg"), "{text}");
    executable::script(&place.path("other"), "#!/bin/sh\necho V..... libsvtav1\n");
    let other = place.run(&[&words[..], &["./other"]].concat());
    let text = String::from_utf8_lossy(&other.stderr).into_owned();
    assert!(other.status.code() == Some(2) && text.contains("no encoder libx264"), "{text}");

    let (objects, code) = export(&place, &["out", "--include-bad", "--pictures", "h264", "--verify"]);
    assert_eq!((code, &of(&objects, "export")[0]["exported"]), (0, &1.into()), "{objects:?}");
}

#[test]
fn an_interrupt_ends_an_ffmpeg_that_hangs() {
    let place = Place::new();
    record(&place, "out", "1500ms", &["--sim"]);
    let hanging = wrapped(&place, "sleep 1000 & echo $! >pid.new; mv pid.new pid; wait");
    let words = ["export", "out", "--include-bad", "--to", "lerobot", "--out", "set", "--pictures", "h264"];
    let child = place.command(&[&words[..], &["--ffmpeg", &hanging]].concat()).spawn().expect("rapid runs");
    let hung = process(&place, "pid");
    let id = rustix::process::Pid::from_child(&child);
    rustix::process::kill_process(id, Signal::INT).expect("signal");
    let output = child.wait_with_output().expect("its end");
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        output.status.code() == Some(1) && text.contains("has 0 episodes, and the same command continues"),
        "{text}"
    );
    gone(hung);
    assert_eq!(incomplete(&place.path("set")), Vec::<PathBuf>::new());
}

#[test]
fn killed_while_it_encodes_it_continues_from_every_state_that_it_may_leave() {
    let place = Place::new();
    for _ in 0..2 {
        record(&place, "out", "1500ms", &["--sim"]);
    }
    let kill = ["export", "out", "--include-bad", "--to", "lerobot", "--out", "set", "--pictures", "h264", "--ffmpeg"];
    // Killed in its first episode: ffmpeg ends by itself, when no more pictures come.
    let slow = wrapped(&place, "echo $$ >pid.new; mv pid.new pid; exec ffmpeg \"$@\"");
    let mut child = place.command(&[&kill[..], &[&slow]].concat()).spawn().expect("rapid runs");
    let encoder = process(&place, "pid");
    child.kill().expect("killed");
    child.wait().expect("its end");
    gone(encoder);
    // After the first episode, at some moment of the second.
    drop(place.start(&[&kill[..], &["ffmpeg", "--json"]].concat(), "\"outcome\":\"exported\""));
    let (objects, code) = export(&place, &["out", "--include-bad", "--verify"]);
    let summary = of(&objects, "export")[0];
    assert_eq!((code, &summary["episodes"], &summary["differences"]), (0, &2.into(), &0.into()), "{objects:?}");

    // Videos of a third episode without facts, one without a name, and an episode whose facts were not written.
    for camera in [WRIST, TACTILE] {
        std::fs::copy(place.path(&video("set", camera, 0)), place.path(&video("set", camera, 2))).expect("copied");
    }
    place.write(&format!("set/videos/{WRIST}/.0123.mp4.tmp"), "half");
    std::fs::remove_file(place.path("set/meta/episodes/chunk-000/file-001.parquet")).expect("removed");
    let (objects, code) = export(&place, &["out", "--include-bad", "--verify"]);
    let summary = of(&objects, "export")[0];
    assert_eq!((code, &summary["already"], &summary["exported"]), (0, &1.into(), &1.into()), "{objects:?}");
    assert_eq!(incomplete(&place.path("set")), Vec::<PathBuf>::new());
    // What is beyond the last episode is removed when the set is opened again.
    assert_eq!(export(&place, &["out", "--include-bad"]).1, 0);
    assert!(!place.path(&video("set", WRIST, 2)).exists());
}
