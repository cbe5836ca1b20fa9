//! Results of a scenario: exit codes, the output of each program, recorded files.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::Value;

use crate::emu::log::Moment;
use crate::guest::{Boot, tail};
use crate::recording::{Recording, RecordingError};

/// Why there is no single recording.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeError {
    /// Not exactly one file, or an unfinished one.
    #[error("expected one .mcap and no .partial, found {0:?}")]
    Files(Vec<PathBuf>),
    /// The file cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

/// The emulator's log about one stream of a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stream {
    /// Frames that were sent completely.
    pub sent: u64,
    /// Ticks without a frame: there was no reader, or the machine was busy.
    pub skipped: u64,
}

/// The results of a scenario. Dropping it deletes its folder, unless a test is failing or `RAPID_VBENCH_KEEP` is set.
#[derive(Debug)]
pub struct Outcome {
    name: String,
    /// The folder shared with the guest; results are in `out`.
    pub share: PathBuf,
    /// Exit code of the guest's script.
    pub code: i32,
    /// Exit code of `rapid`, if it ran and ended.
    pub rapid_code: Option<i32>,
    /// From the start of the guest to its end, in the host's time.
    pub wall: Duration,
    /// The same by the guest's clock.
    pub inside: Duration,
    /// Whether that clock is virtual, so that a time in the guest is the same in each run.
    pub is_virtual: bool,
    /// Output of the guest's script.
    pub log: String,
    /// The emulator's log.
    pub emu: Vec<Value>,
    /// JSON lines printed by `rapid`.
    pub rapid: Vec<Value>,
    /// Changes of the mask in shared memory, if they were watched.
    pub mask: Vec<Value>,
}

impl Outcome {
    pub(crate) fn collect(name: String, share: PathBuf, boot: Boot) -> Self {
        let out = share.join("out");
        let text = |path: &Path| fs::read_to_string(path).unwrap_or_default();
        Self {
            name,
            code: boot.code,
            rapid_code: text(&out.join("rapid.rc")).trim().parse().ok(),
            wall: boot.wall,
            inside: boot.inside,
            is_virtual: boot.is_virtual,
            log: text(&share.join("out.log")),
            emu: json_lines(&text(&out.join("emu.jsonl"))),
            rapid: json_lines(&text(&out.join("rapid.jsonl"))),
            mask: json_lines(&text(&out.join("mask.jsonl"))),
            share,
        }
    }

    /// The scenario's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// When the emulator applied `action` to `device`, in order.
    pub fn actions(&self, action: &str, device: usize) -> Vec<Moment> {
        let of_device = |line: &&Value| line["action"] == action && line["device"] == device;
        self.emu.iter().filter(of_device).filter_map(moment).collect()
    }

    /// Frames that a device's camera with this endpoint sent, and ticks without a frame, in each of its finished streams.
    pub fn streams(&self, device: usize, endpoint: u8) -> Vec<Stream> {
        let of_camera = |line: &&Value| line["device"] == device && line["endpoint"] == endpoint;
        let lines: Vec<&Value> = self.emu.iter().filter(of_camera).collect();
        let edges = |action: &str| lines.iter().filter(|line| line["action"] == action).copied().collect::<Vec<_>>();
        let number = |line: &Value, key: &str| line[key].as_u64().unwrap_or_default();
        let stream = |(on, off): (&Value, &Value)| Stream {
            sent: number(off, "sent") - number(on, "sent"),
            skipped: number(off, "skipped") - number(on, "skipped"),
        };
        edges("stream_on").into_iter().zip(edges("stream_off")).map(stream).collect()
    }

    /// Each time the timeline's clock started.
    pub fn origins(&self) -> Vec<Moment> {
        self.emu.iter().filter(|line| line["action"] == "t0").filter_map(moment).collect()
    }

    /// Errors of the emulator.
    pub fn emulator_errors(&self) -> Vec<&Value> {
        self.emu.iter().filter(|line| line["action"] == "error" || line["action"] == "protocol_error").collect()
    }

    /// The states `rapid` reported for a device, in order.
    pub fn states(&self, device: &str) -> Vec<&str> {
        let of_device = |line: &&Value| line["event"] == "state" && line["device"] == device;
        self.rapid.iter().filter(of_device).filter_map(|line| line["state"].as_str()).collect()
    }

    /// The bit `rapid` reported for a device.
    pub fn bit(&self, device: &str) -> Option<u32> {
        let line = self.rapid.iter().find(|line| line["device"] == device && line["bit"].is_u64())?;
        line["bit"].as_u64().and_then(|bit| u32::try_from(bit).ok())
    }

    /// Text of a file the guest wrote to `$out`; empty if there is none.
    pub fn file(&self, name: &str) -> String {
        fs::read_to_string(self.share.join("out").join(name)).unwrap_or_default()
    }

    /// The episode, which must be one finished file.
    pub fn episode(&self) -> Result<Recording, EpisodeError> {
        let folder = fs::read_dir(self.share.join("out/rec"));
        let mut files: Vec<PathBuf> = folder.into_iter().flatten().flatten().map(|entry| entry.path()).collect();
        files.sort();
        let ends = |path: &PathBuf, end: &str| path.to_string_lossy().ends_with(end);
        let episodes: Vec<&PathBuf> = files.iter().filter(|path| ends(path, ".mcap")).collect();
        match episodes[..] {
            [episode] if !files.iter().any(|path| ends(path, ".partial")) => Ok(Recording::open(episode)?),
            _ => Err(EpisodeError::Files(files)),
        }
    }

    /// Information for finding out why a scenario failed.
    pub fn diagnosis(&self) -> String {
        let mut text = format!(
            "scenario {}: guest exit {}, rapid exit {:?}, {:.1} s wall; everything is in {}\n",
            self.name,
            self.code,
            self.rapid_code,
            self.wall.as_secs_f64(),
            self.share.display()
        );
        let out = self.share.join("out");
        let parts = [
            ("guest script", self.share.join("out.log")),
            ("emulator", out.join("emu.jsonl")),
            ("rapid's log", out.join("rapid.log")),
            ("rapid's output", out.join("rapid.jsonl")),
            ("kernel", self.share.join("dmesg.log")),
        ];
        for (title, path) in parts {
            text.push_str(&format!("--- {title}, last lines ---\n{}\n", tail(&path, 25)));
        }
        text
    }
}

impl Drop for Outcome {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("{}", self.diagnosis());
        } else if std::env::var_os("RAPID_VBENCH_KEEP").is_some() {
            eprintln!("vbench: {} is kept in {}", self.name, self.share.display());
        } else {
            let _left_to_the_system = fs::remove_dir_all(&self.share);
        }
    }
}

fn moment(line: &Value) -> Option<Moment> {
    Some(Moment { mono_ns: line["mono_ns"].as_u64()?, real_ns: line["real_ns"].as_u64()? })
}

/// The lines that are JSON objects; a line cut off at the end of a run is not.
pub fn json_lines(text: &str) -> Vec<Value> {
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).filter(Value::is_object).collect()
}
