//! What the tests of the binary share: a run of `rapid` with a folder and an instance of its own.

#![allow(dead_code, reason = "each test binary uses its own part of this module")]
#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// How long a condition may take to come true before a test gives up. It is no requirement: a slow
/// machine only makes the test slow.
pub(crate) const PATIENCE: Duration = Duration::from_mins(1);

/// A folder and an instance name of a test's own.
pub(crate) struct Place {
    pub(crate) folder: tempfile::TempDir,
    pub(crate) instance: String,
}

impl Place {
    pub(crate) fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        Self {
            folder: tempfile::tempdir().expect("temporary folder"),
            instance: format!("test-{}-{number}", std::process::id()),
        }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        std::fs::write(&path, text).expect("write");
        path
    }

    pub(crate) fn mask_file(&self) -> PathBuf {
        PathBuf::from(format!("/dev/shm/rapid_hardware_mask.{}", self.instance))
    }

    /// `rapid ARGUMENTS` in this place, with output to the caller and no terminal.
    pub(crate) fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rapid"));
        command
            .current_dir(self.folder.path())
            .env_remove("RAPID_LOG")
            .env("HOME", self.folder.path())
            .env_remove("XDG_CONFIG_HOME")
            .args(["--instance", &self.instance])
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    }

    pub(crate) fn run(&self, arguments: &[&str]) -> Output {
        self.command(arguments).output().expect("rapid runs")
    }

    /// Starts a run whose standard output goes to a file, and waits for its first line with `word`.
    pub(crate) fn start(&self, arguments: &[&str], word: &str) -> Running {
        let log = self.path("output.txt");
        let file = std::fs::File::create(&log).expect("output file");
        let child = self.command(arguments).stdout(file).spawn().expect("rapid runs");
        let mut running = Running { child: Some(child), log };
        running.wait_for(word);
        running
    }

    /// Files in `folder` of this place, by name.
    pub(crate) fn files(&self, folder: &str) -> Vec<String> {
        let mut names: Vec<_> = std::fs::read_dir(self.path(folder))
            .map(|entries| entries.flatten().map(|e| e.file_name().to_string_lossy().into_owned()).collect())
            .unwrap_or_default();
        names.sort();
        names
    }
}

/// A run in progress. It is killed when dropped, so that a failing test leaves nothing behind.
pub(crate) struct Running {
    child: Option<Child>,
    log: PathBuf,
}

impl Running {
    pub(crate) fn pid(&self) -> u32 {
        self.child.as_ref().expect("running").id()
    }

    pub(crate) fn output(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    pub(crate) fn wait_for(&mut self, word: &str) {
        let begun = Instant::now();
        while !self.output().contains(word) {
            let ended = self.child.as_mut().expect("running").try_wait().expect("wait");
            assert!(ended.is_none(), "ended with {ended:?} before {word:?}: {}", self.output());
            assert!(begun.elapsed() < PATIENCE, "no {word:?} in: {}", self.output());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    pub(crate) fn signal(&self, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_raw(self.pid().cast_signed()).expect("pid");
        rustix::process::kill_process(pid, signal).expect("signal");
    }

    /// Waits for the end: exit code, standard output, standard error.
    pub(crate) fn end(mut self) -> (Option<i32>, String, String) {
        let child = self.child.take().expect("running");
        let output = child.wait_with_output().expect("wait");
        let text = std::fs::read_to_string(&self.log).unwrap_or_default();
        (output.status.code(), text, String::from_utf8_lossy(&output.stderr).into_owned())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(mut child) = self.child.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// The events of a headless run with `--json`.
pub(crate) fn events(output: &str) -> Vec<serde_json::Value> {
    output
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("not JSON ({error}): {line}")))
        .collect()
}

/// Everything a recorded episode says, read by the mcap crate.
pub(crate) struct Episode {
    pub(crate) metadata: Vec<mcap::records::Metadata>,
    pub(crate) messages: Vec<Message>,
}

pub(crate) struct Message {
    pub(crate) topic: String,
    pub(crate) sequence: u32,
    pub(crate) log_time: u64,
    pub(crate) data: Vec<u8>,
}

impl Episode {
    pub(crate) fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).expect("episode");
        let messages = mcap::MessageStream::new(&bytes)
            .expect("a whole file")
            .map(|message| {
                let message = message.expect("a whole message");
                Message {
                    topic: message.channel.topic.clone(),
                    sequence: message.sequence,
                    log_time: message.log_time,
                    data: message.data.to_vec(),
                }
            })
            .collect();
        let summary = mcap::Summary::read(&bytes).expect("summary").expect("a finished file has one");
        let metadata =
            summary.metadata_indexes.iter().map(|index| mcap::read::metadata(&bytes, index).expect("metadata"));
        Self { metadata: metadata.collect(), messages }
    }

    pub(crate) fn topic<'a>(&'a self, topic: &'a str) -> impl Iterator<Item = &'a Message> {
        self.messages.iter().filter(move |message| message.topic == topic)
    }

    /// The changes of the recorded mask: log time and value.
    pub(crate) fn mask_edges(&self) -> Vec<(u64, u64)> {
        let mut edges: Vec<(u64, u64)> = Vec::new();
        for message in self.topic("/rapid/mask") {
            let mask = fixed64(&message.data, 2).unwrap_or(0);
            if edges.last().is_none_or(|(_, last)| *last != mask) {
                edges.push((message.log_time, mask));
            }
        }
        edges
    }
}

/// A `fixed64` field of a protobuf message whose fields are numbered below 16.
fn fixed64(mut data: &[u8], field: u8) -> Option<u64> {
    while let Some((tag, rest)) = data.split_first() {
        let (wire, size) = (tag & 7, rest);
        data = match wire {
            0 => &size[size.iter().position(|byte| byte & 0x80 == 0)? + 1..],
            1 if tag >> 3 == field => return Some(u64::from_le_bytes(size[..8].try_into().ok()?)),
            1 => &size[8..],
            2 => &size[1 + usize::from(size[0])..],
            _ => return None,
        };
    }
    None
}
