//! How long `rapid export` takes for an episode, beside LeRobot's own writer of the same rows in the same run.
//!
//! LeRobot is measured where `make lerobot-test` has made its environment; elsewhere there is no baseline, and no figure
//! takes its place.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use serde_json::Value;

use crate::figure::Figure;
use crate::process::Running;
use crate::stats::median;
use crate::{Absent, Bench, Failure, LIMIT};

/// Seconds of LeRobot for an episode.
struct Baseline {
    image: f64,
    video: f64,
}

/// Which of them.
type Which = fn(&Baseline) -> f64;

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let folder = bench.scratch.path().join("export");
    std::fs::create_dir_all(&folder)?;
    let episode = record(bench, &folder)?;
    let mut figures = Vec::new();
    let baseline = baseline(bench, &episode);
    let lerobot = |of: Which| baseline.as_ref().ok().map(of);
    let forms: [(&str, Which, &str); 3] =
        [("jpeg", |base| base.image, ">= 20"), ("av1", |base| base.video, ">= 2"), ("h264", |base| base.video, "")];
    let has_ffmpeg =
        Command::new("ffmpeg").arg("-version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok();
    for (form, of, target) in forms {
        let name = format!("export/{form}, an episode");
        if form != "jpeg" && !has_ffmpeg {
            figures.push(Figure::of_failure(name, &Absent("ffmpeg: apt install ffmpeg".to_owned()).into()));
            continue;
        }
        let mut seconds = Vec::new();
        for run in 0..bench.runs {
            bench.progress(&format!("export: {form}, run {} of {}", run + 1, bench.runs));
            seconds.push(export(bench, &episode, &folder.join(format!("{form}-{run}")), form)?);
        }
        let taken = median(&seconds);
        let note = "from the start of the program to its end; baseline: LeRobot's add_frame, save_episode and finalize";
        let milliseconds = |seconds: f64| seconds * 1e3;
        let own = Figure::new(name, "ms", taken.map(milliseconds)).baseline(lerobot(of).map(milliseconds));
        figures.push(own.note(note));
        if target.is_empty() {
            continue;
        }
        let name = format!("export/{form}, time of LeRobot against it");
        figures.push(match (&baseline, taken) {
            (Ok(base), Some(taken)) => Figure::new(name, "x", Some(of(base) / taken)).target(target),
            (Err(why), _) => Figure::of_failure(name, why),
            (Ok(_), None) => Figure::missing(name, "no run"),
        });
    }
    Ok(figures)
}

/// The simulated rig's two cameras and its motor.
fn record(bench: &Bench, folder: &Path) -> Result<PathBuf, Failure> {
    let seconds = format!("{}s", bench.length(6, 3).as_secs().max(2));
    let instance = format!("bench-export-{}", std::process::id());
    let mut command = Command::new(&bench.rapid);
    command.args(["--sim", "--headless", "--record", "--duration", &seconds, "--instance", &instance]);
    command.arg("--out").arg(folder.join("episodes"));
    Running::start(&mut command)?.finish(LIMIT, || {})?;
    let mut files = std::fs::read_dir(folder.join("episodes"))?.flatten().map(|entry| entry.path());
    let episode = files.find(|path| path.extension().is_some_and(|extension| extension == "mcap"));
    Ok(episode.ok_or("no episode was recorded")?)
}

/// Seconds of one export.
fn export(bench: &Bench, episode: &Path, out: &Path, form: &str) -> Result<f64, Failure> {
    let mut command = Command::new(&bench.rapid);
    command.arg("export").arg(episode).args(["--to", "lerobot", "--include-bad", "--pictures", form, "--out"]).arg(out);
    let begun = Instant::now();
    let status = command.stdout(Stdio::null()).status()?;
    let seconds = begun.elapsed().as_secs_f64();
    std::fs::remove_dir_all(out)?;
    if status.success() { Ok(seconds) } else { Err(format!("rapid export --pictures {form}: {status}").into()) }
}

/// LeRobot's own writer, by `models/export_speed.py`.
fn baseline(bench: &Bench, episode: &Path) -> Result<Baseline, Failure> {
    let home = || std::env::var_os("HOME").map(|home| Path::new(&home).join(".cache"));
    let cache = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from).or_else(home).unwrap_or_default();
    let python = cache.join("rapid/venv-lerobot/bin/python");
    if !python.is_file() {
        let what = "environment of LeRobot, so that its writer was not measured: `make lerobot-test` makes one (8 GB)";
        return Err(Absent(what.to_owned()).into());
    }
    bench.progress("export: LeRobot's own writer");
    let mut command = Command::new(python);
    command.arg("models/export_speed.py").arg(episode).arg("--rapid").arg(&bench.rapid);
    command.args(["--times", &bench.runs.to_string()]).env("HF_HUB_OFFLINE", "1");
    // PyTorch leaves its cache there.
    command.env("TMPDIR", episode.parent().unwrap_or(episode));
    let usage = Running::start(&mut command)?.finish(LIMIT, || {})?;
    let line = usage.output.lines().last().unwrap_or_default();
    let found: Value =
        serde_json::from_str(line).map_err(|error| format!("models/export_speed.py: {error}: {line}"))?;
    let seconds = |key: &str| found[key].as_f64().ok_or_else(|| format!("models/export_speed.py gave no {key}"));
    Ok(Baseline { image: seconds("lerobot_image_s")?, video: seconds("lerobot_video_s")? })
}
