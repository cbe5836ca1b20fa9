//! Code shared by the tests of the binary: a run of `rapid` with its own folder and instance.

#![allow(dead_code, reason = "each test binary uses its own part of this module")]
#![allow(clippy::expect_used, reason = "what fails here fails a test")]

pub(crate) mod executable;
pub(crate) mod lan;
pub(crate) mod onnx;
mod patience;
pub(crate) mod skip;
pub(crate) mod terminal;
pub(crate) mod tmux;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

pub(crate) use patience::PATIENCE;

/// Lines of a registry. A busy machine is not a defect of the program, and a simulated camera that it delays loses pictures: what
/// remains is what the recorder drops, and damage.
pub(crate) const LENIENT: &str = "\n[verdict]\nlate = \"off\"\ngap = \"off\"\nclock = \"off\"\nrate = \"off\"\n\
    valid = \"off\"\nopening = \"off\"\nfrozen = \"off\"\nlost = \"50%\"\n";

/// Waits for a condition.
pub(crate) fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < PATIENCE, "{what}: not met in time");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Waits for what `found` gives.
pub(crate) fn wait_for<T>(what: &str, mut found: impl FnMut() -> Option<T>) -> T {
    let mut there = None;
    until(what, || {
        there = found();
        there.is_some()
    });
    there.expect(what)
}

/// The Python of `make setup`.
pub(crate) fn python() -> PathBuf {
    let python = std::env::var_os("RAPID_PYTHON").map_or_else(
        || {
            let cache = std::env::var_os("XDG_CACHE_HOME").map_or_else(
                || PathBuf::from(std::env::var_os("HOME").expect("a home directory")).join(".cache"),
                PathBuf::from,
            );
            cache.join("rapid/venv/bin/python")
        },
        PathBuf::from,
    );
    assert!(python.exists(), "no Python environment at {}: run `make setup`", python.display());
    python
}

/// A folder and an instance name for one test.
pub(crate) struct Place {
    pub(crate) folder: tempfile::TempDir,
    pub(crate) instance: String,
}

/// A killed run leaves files in shared memory; they must not reach the next run.
impl Drop for Place {
    fn drop(&mut self) {
        sweep_bus(&self.instance);
        let mask = self.mask_file();
        for file in [mask.with_extension(format!("{}.json", self.instance)), mask] {
            let _ = std::fs::remove_file(file);
        }
    }
}

/// Removes all files that programs of an instance have left of their bus.
pub(crate) fn sweep_bus(instance: &str) {
    for folder in ["/dev/shm", BUS_FILES] {
        sweep(Path::new(folder), &format!("iox2_{instance}_"));
    }
}

/// Where iceoryx2 keeps the files of nodes and services.
const BUS_FILES: &str = "/tmp/iceoryx2";

/// Removes files with this name prefix from a folder and its subfolders, and the folders that contained nothing else.
fn sweep(folder: &Path, prefix: &str) {
    for path in std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()) {
        if path.is_dir() {
            sweep(&path, prefix);
        } else if path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(prefix)) {
            let _ = std::fs::remove_file(&path);
            // Folders with other files stay, and so does the folder of all services.
            if folder.parent().is_some_and(|parent| parent.ends_with("nodes")) {
                let _ = std::fs::remove_dir(folder);
            }
        }
    }
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

    /// With the rig of the repository, whose verdicts do not depend on how fast the machine is: see [`LENIENT`].
    pub(crate) fn lenient() -> Self {
        let place = Self::new();
        place.write("devices.toml", &[include_str!("../../devices.toml"), LENIENT].concat());
        place
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

    /// The number of the last mask that a run in this place has published: there are 500 in a second.
    pub(crate) fn published(&self) -> u64 {
        wait_for("whole mask record", || {
            let record = std::fs::read(self.mask_file()).ok()?;
            // Odd while it is being written.
            (record.len() == 32 && record[6] % 2 == 0)
                .then(|| u64::from_le_bytes(record[24..].try_into().expect("eight bytes")))
        })
    }

    /// Names of the bus's files in shared memory that belong to this instance: iceoryx2 starts all of them with the
    /// prefix that the bus derives from the instance.
    pub(crate) fn shared_memory(&self) -> std::collections::BTreeSet<String> {
        let prefix = format!("iox2_{}_", self.instance);
        let names = std::fs::read_dir("/dev/shm").expect("shared memory").flatten();
        names
            .map(|entry| entry.file_name().to_string_lossy().into_owned())
            .filter(|name| name.starts_with(&prefix))
            .collect()
    }

    /// `rapid ARGUMENTS` in this place, with piped output and no terminal.
    pub(crate) fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_rapid"));
        command
            .current_dir(self.folder.path())
            .env_remove("RAPID_LOG")
            .env("RAPID_INSTANCE", &self.instance)
            .env("HOME", self.folder.path())
            .env_remove("XDG_CONFIG_HOME")
            .env_remove("XDG_STATE_HOME")
            .env_remove("STATE_DIRECTORY")
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
        self.start_as(self.command(arguments), word)
    }

    /// The same for a given command.
    pub(crate) fn start_as(&self, mut command: Command, word: &str) -> Running {
        let log = self.path("output.txt");
        let file = std::fs::File::create(&log).expect("output file");
        let child = command.stdout(file).spawn().expect("rapid runs");
        let mut running = Running { child: Some(child), log };
        running.wait_for(word);
        running
    }

    /// Output of a device's programs, over all runs in this place.
    pub(crate) fn logbook(&self, device: &str) -> String {
        let folder = self.path(".local/state/rapid/logs").join(&self.instance);
        std::fs::read_to_string(folder.join(format!("{device}.log"))).unwrap_or_default()
    }

    /// Files in `folder` of this place but those of a session, by name: the monitor keeps a session, and a file for what is
    /// noted about an episode.
    pub(crate) fn episodes(&self, folder: &str) -> Vec<String> {
        let mut names = self.files(folder);
        names.retain(|name| !name.starts_with("session") && !name.ends_with(".mcap.toml"));
        names
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

/// A run in progress. Dropping it kills it, so that a failing test leaves nothing behind.
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

    /// The events so far of a run with `--json`. An incomplete line is ignored.
    pub(crate) fn reported(&self) -> Vec<serde_json::Value> {
        events(self.output().rsplit_once('\n').map_or("", |(whole, _)| whole))
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

    /// Waits for the end; returns the signal that killed it.
    pub(crate) fn died_of(mut self) -> Option<i32> {
        use std::os::unix::process::ExitStatusExt;
        self.child.take().expect("running").wait_with_output().expect("wait").status.signal()
    }

    /// Waits for the end; returns exit code, standard output and standard error.
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

/// The exit code of a headless run that recorded successfully, from its output: 4 if an episode is BAD.
#[allow(clippy::unnecessary_wraps, reason = "as an exit status gives it")]
pub(crate) fn recorded_code(output: &str) -> Option<i32> {
    let is_bad = output.lines().any(|line| line.contains("\"verdict\":\"BAD\"") || line.starts_with("BAD "));
    Some(if is_bad { 4 } else { 0 })
}

/// Texts of the log that contain `words`.
pub(crate) fn logged<'a>(events: &'a [serde_json::Value], words: &str) -> Vec<&'a str> {
    events.iter().filter_map(|event| event["text"].as_str()).filter(|text| text.contains(words)).collect()
}

/// The contents of a recorded episode, read with the mcap crate.
pub(crate) struct Episode {
    pub(crate) metadata: Vec<mcap::records::Metadata>,
    /// Topics that have a channel, with or without messages.
    pub(crate) channels: Vec<String>,
    /// The names of the schemas of these topics.
    pub(crate) schemas: BTreeMap<String, String>,
    pub(crate) messages: Vec<Message>,
}

pub(crate) struct Message {
    pub(crate) topic: String,
    pub(crate) sequence: u32,
    pub(crate) log_time: u64,
    pub(crate) publish_time: u64,
    pub(crate) data: Vec<u8>,
}

/// The last message of a topic in a file that is being written, read up to where it is not whole.
pub(crate) fn last_written(partial: &Path, topic: &str) -> Option<Message> {
    let bytes = std::fs::read(partial).expect("a file");
    let unfinished = mcap::read::Options::IgnoreEndMagic.into();
    let records = mcap::read::ChunkFlattener::new_with_options(&bytes, unfinished).ok()?;
    let (mut channel, mut last) = (None, None);
    for record in records.map_while(Result::ok) {
        match record {
            mcap::records::Record::Channel(found) if found.topic == topic => channel = Some(found.id),
            mcap::records::Record::Message { header, data } if Some(header.channel_id) == channel => {
                last = Some((header, data.into_owned()));
            }
            _ => {}
        }
    }
    let (header, data) = last?;
    let mcap::records::MessageHeader { sequence, log_time, publish_time, .. } = header;
    Some(Message { topic: topic.to_owned(), sequence, log_time, publish_time, data })
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
                    publish_time: message.publish_time,
                    data: message.data.to_vec(),
                }
            })
            .collect();
        let summary = mcap::Summary::read(&bytes).expect("summary").expect("a finished file has one");
        let metadata =
            summary.metadata_indexes.iter().map(|index| mcap::read::metadata(&bytes, index).expect("metadata"));
        let channels = summary.channels.values().map(|channel| channel.topic.clone()).collect();
        let schema = |channel: &Arc<mcap::Channel<'_>>| {
            Some((channel.topic.clone(), channel.schema.as_ref().map(|schema| schema.name.clone())?))
        };
        let schemas = summary.channels.values().filter_map(schema).collect();
        Self { metadata: metadata.collect(), channels, schemas, messages }
    }

    pub(crate) fn topic<'a>(&'a self, topic: &'a str) -> impl Iterator<Item = &'a Message> {
        self.messages.iter().filter(move |message| message.topic == topic)
    }

    /// A value of the metadata record `name`.
    pub(crate) fn value(&self, name: &str, key: &str) -> &str {
        let record = self.metadata.iter().find(|record| record.name == name).expect("the metadata record");
        record.metadata.get(key).unwrap_or_else(|| panic!("no {key} in {name}"))
    }

    /// The changes of the recorded mask: log time and value, from the one in force at the beginning. On a busy machine others
    /// from before it arrive after it, and are in the file.
    pub(crate) fn mask_edges(&self) -> Vec<(u64, u64)> {
        let number = |key| self.value("rapid", key).parse::<i128>().expect("a number");
        let begin = number("begin_monotonic_ns") + number("wall_minus_monotonic_ns");
        let mut edges: Vec<(u64, u64)> = Vec::new();
        for message in self.topic("/rapid/mask") {
            let mask = message.decode::<MaskMessage>().mask;
            if i128::from(message.log_time) <= begin {
                edges.clear();
            }
            if edges.last().is_none_or(|(_, last)| *last != mask) {
                edges.push((message.log_time, mask));
            }
        }
        edges
    }

    /// The frame index.
    pub(crate) fn frames(&self) -> Vec<(&Message, FrameMessage)> {
        self.topic("/rapid/frame").map(|message| (message, message.decode())).collect()
    }
}

impl Message {
    pub(crate) fn decode<T: prost::Message + Default>(&self) -> T {
        T::decode(self.data.as_slice()).unwrap_or_else(|error| panic!("{}: {error}", self.topic))
    }

    /// The bytes of a sample as received from its device: of a picture, of a vector of numbers, or of raw bytes, field
    /// 2.
    pub(crate) fn payload(&self) -> Vec<u8> {
        self.decode::<SampleMessage>().payload
    }
}

/// `rapid.Mask`.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct MaskMessage {
    #[prost(fixed64, tag = "2")]
    pub(crate) mask: u64,
    #[prost(uint64, tag = "3")]
    pub(crate) sequence: u64,
    #[prost(fixed64, tag = "4")]
    pub(crate) plugged: u64,
}

/// `rapid.Frame`.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct FrameMessage {
    #[prost(uint64, tag = "2")]
    pub(crate) index: u64,
    #[prost(fixed64, tag = "3")]
    pub(crate) mask: u64,
    #[prost(message, repeated, tag = "4")]
    pub(crate) modalities: Vec<FrameModality>,
}

/// `rapid.Frame.Modality`.
#[derive(Clone, PartialEq, prost::Message)]
#[expect(clippy::struct_excessive_bools, reason = "they are the message's")]
pub(crate) struct FrameModality {
    #[prost(uint32, tag = "1")]
    pub(crate) bit: u32,
    #[prost(bool, tag = "2")]
    pub(crate) valid: bool,
    #[prost(bool, tag = "3")]
    pub(crate) stale: bool,
    #[prost(sint64, optional, tag = "4")]
    pub(crate) age_ns: Option<i64>,
    #[prost(uint64, optional, tag = "5")]
    pub(crate) seq: Option<u64>,
    #[prost(bool, tag = "6")]
    pub(crate) present: bool,
    #[prost(bool, tag = "7")]
    pub(crate) plugged: bool,
}

/// `rapid.Event`.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct EventMessage {
    #[prost(string, tag = "5")]
    pub(crate) json: String,
}

/// The common fields of `foxglove.CompressedImage`, `rapid.Scalars` and `rapid.Bytes`; packed doubles are little-endian
/// bytes.
#[derive(Clone, PartialEq, prost::Message)]
struct SampleMessage {
    #[prost(bytes = "vec", tag = "2")]
    payload: Vec<u8>,
}
