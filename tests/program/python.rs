//! Other programs read what `rapid` publishes: Python, from the wheels `make setup` installs.
//!
//! The examples are run as they stand there; `RAPID_INSTANCE` keeps a test apart from a rig on the same machine.

// The binding is published as a wheel for this architecture alone.
#![cfg(target_arch = "x86_64")]
#![expect(clippy::expect_used, reason = "a test ends where what it needs is missing")]

use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rapid_bus::{Bus, TopicId};
use rapid_core::mask::{MaskRecord, PhysicalMask};
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_registry::Registry;

use crate::support::{self, Place, python, sweep_bus, until};

/// What the simulated wrist camera would send.
const PAYLOAD: &[u8] = b"\xff\xd8\xff\xe0 a picture";

/// A program of `examples/python`.
fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/python").join(name)
}

/// Publishes the wrist camera's topic, twenty samples a second, until dropped.
struct Camera {
    instance: String,
    end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Camera {
    fn start(test: &str) -> Self {
        let instance = format!("py{test}{}", std::process::id());
        let registry = Registry::builtin();
        let bus = Bus::open(&registry, Some(&instance)).expect("bus");
        let device = registry.named("cam_wrist").expect("an entry of the built-in registry").id;
        let writer = bus.writer(TopicId::Modality(device)).expect("its writer");
        let end = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&end);
        let thread = std::thread::spawn(move || {
            let _bus = bus;
            for seq in 0.. {
                if ended.load(Ordering::Relaxed) {
                    break;
                }
                let header = SampleHeader {
                    seq,
                    lost: 9,
                    capture_ns: 1_000_000 + seq,
                    recv_ns: 2_000_000 + seq,
                    id: u32::from(device.bit()),
                    epoch: 5,
                    encoding: Encoding::Mjpeg as u32,
                    flags: 2,
                    width: 640,
                    height: 480,
                };
                writer.publish(header, PAYLOAD).expect("publish");
                std::thread::sleep(Duration::from_millis(50));
            }
        });
        Self { instance, end, thread: Some(thread) }
    }
}

impl Drop for Camera {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        // iceoryx2 for Python leaves the file that counts its nodes.
        sweep_bus(&self.instance);
    }
}

/// A Python that is ended with the test.
struct Running(Child);

impl Running {
    fn start(command: &mut Command) -> (Self, BufReader<ChildStdout>) {
        let mut child = command.stdout(Stdio::piped()).spawn().expect("python");
        let output = BufReader::new(child.stdout.take().expect("its output"));
        (Self(child), output)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_subscriber_in_python_sees_headers_and_payloads() {
    let camera = Camera::start("sub");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/subscribe.py");
    let (mut python, mut output) = Running::start(
        Command::new(python()).arg(script).args(["/rapid/camera/wrist", "5"]).env("RAPID_INSTANCE", &camera.instance),
    );
    let mut text = String::new();
    output.read_to_string(&mut text).expect("its output");
    assert!(python.0.wait().expect("its end").success(), "{text}");

    let samples: Vec<serde_json::Value> =
        text.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect();
    assert_eq!(samples.len(), 5);
    let first = samples[0]["seq"].as_u64().expect("a sequence number");
    for (n, sample) in (first..).zip(&samples) {
        let expected = serde_json::json!({
            "seq": n, "lost": 9, "capture_ns": 1_000_000 + n, "recv_ns": 2_000_000 + n, "id": 0, "epoch": 5, "encoding": 1,
            "flags": 2, "width": 640, "height": 480, "bytes": PAYLOAD.len(), "begins": "ffd8ffe020612070",
        });
        assert_eq!(*sample, expected);
    }
}

#[test]
fn a_missing_topic_is_reported() {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/subscribe.py");
    let instance = format!("pynone{}", std::process::id());
    let ended = Command::new(python())
        .arg(script)
        .args(["/rapid/camera/wrist", "1", "0.1"])
        .env("RAPID_INSTANCE", &instance)
        .output()
        .expect("python");
    sweep_bus(&instance);
    assert_eq!(ended.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&ended.stderr).contains("no such topic"), "{ended:?}");
}

#[test]
fn the_subscriber_of_the_examples_runs() {
    let camera = Camera::start("example");
    let ended = Command::new(python())
        .arg(example("subscribe.py"))
        .args(["/rapid/camera/wrist", "3"])
        .env("RAPID_INSTANCE", &camera.instance)
        .output()
        .expect("python");
    assert!(ended.status.success(), "{ended:?}");
    let output = String::from_utf8_lossy(&ended.stdout);
    let numbers: Vec<u64> = output
        .lines()
        .filter(|line| line.contains(" epoch 5 ") && line.ends_with(&format!(" {} bytes", PAYLOAD.len())))
        .filter_map(|line| line.strip_prefix("seq ")?.split(' ').next()?.parse().ok())
        .collect();
    assert!(numbers.len() == 3 && numbers.is_sorted(), "{output}");
}

#[test]
fn the_mcap_library_of_python_reads_an_episode() {
    let folder = tempfile::tempdir().expect("a folder");
    let recorded = Command::new(env!("CARGO_BIN_EXE_rapid"))
        .args(["--sim", "--headless", "--record", "--duration", "2s", "--task", "python", "--out"])
        .arg(folder.path())
        .args(["--instance", &format!("pymcap{}", std::process::id())])
        .output()
        .expect("rapid");
    let code = support::recorded_code(&String::from_utf8_lossy(&recorded.stdout));
    assert_eq!(recorded.status.code(), code, "{recorded:?}");
    let mut files = std::fs::read_dir(folder.path()).expect("the folder");
    let episode = files.next().expect("an episode").expect("its name").path();
    assert!(files.next().is_none(), "one episode, nothing beside it");

    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/episode.py");
    let read = Command::new(python()).arg(script).arg(&episode).output().expect("python");
    assert!(read.status.success(), "{read:?}");
    let topics: serde_json::Value = serde_json::from_slice(&read.stdout).expect("JSON");
    assert_eq!(topics["/rapid/camera/wrist"]["schema"], "foxglove.CompressedImage");
    assert_eq!(topics["/rapid/camera/tactile"]["schema"], "foxglove.CompressedImage");
    // Two seconds on the 30 Hz grid.
    assert_eq!(topics["/rapid/frame"]["messages"], 60);
    for topic in ["/rapid/camera/wrist", "/rapid/camera/tactile", "/rapid/serial/motor", "/rapid/mask"] {
        assert_ne!(topics[topic]["messages"], 0, "{topics}");
        assert_eq!(topics[topic]["messages"], topics[topic]["counted"], "{topics}");
        assert_eq!(topics[topic]["backwards"], 0, "{topics}");
    }
}

#[test]
fn the_mask_reader_of_the_examples_reads_again_after_a_torn_read() {
    let place = Place::new();
    let file = place.mask_file();
    let record = MaskRecord {
        device_count: 3,
        generation: 4,
        mask: PhysicalMask(0b101),
        realtime_ns: rapid_core::time::realtime_ns() + 3_600_000_000_000,
        sequence: 42,
    };
    // A write is in progress when it begins to read, and ends while it looks.
    let unfinished = MaskRecord { generation: 3, mask: PhysicalMask(0b111), sequence: 41, ..record };
    std::fs::write(&file, unfinished.to_bytes()).expect("the record");
    let mut python = Command::new(python());
    python.arg(example("mask.py")).env("RAPID_INSTANCE", &place.instance);
    let mut running = python.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("python");
    let open = |pid: u32| {
        let descriptors = std::fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
        descriptors.filter_map(|entry| std::fs::read_link(entry.path()).ok()).any(|path| path == file)
    };
    until("a look at the mask", || open(running.id()) || running.try_wait().expect("python").is_some());
    std::fs::File::options().write(true).open(&file).expect("the file").write_all(&record.to_bytes()).expect("the end");
    let ended = running.wait_with_output().expect("python");
    assert!(ended.status.success(), "{ended:?}");
    assert_eq!(String::from_utf8_lossy(&ended.stdout).trim(), "42 0b101 True False True");
}

/// Observations of the simulated rig, put together from three topics while its tactile camera is unplugged. The window
/// is wider than the time between two frames: an observation looks only back from its tick, and with the usual 25 ms a
/// camera of 30 Hz is stale at each tick where its phase is unlucky.
#[test]
fn observations_name_samples_that_are_on_their_topics() {
    let place = Place::new();
    // 240 observations are 8 s at least: whenever they begin, it is there for some of them, and not for others.
    let scenario = "repeat = \"8s\"\n[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"tactile_tip\"\n[[device]]\n\
        name = \"motor_state\"\n[[event]]\nat = \"4s\"\nunplug = \"tactile_tip\"\n[[event]]\nat = \"6s\"\nplug = \"tactile_tip\"\n";
    place.write("sim.toml", scenario);
    let wide = ["--sim", "sim.toml", "--headless", "--json", "--window", "50ms"];
    let running = place.start(&wide, "\"mask\":\"0x07\"");
    let shapes = ["/rapid/camera/wrist=480x640x3", "/rapid/camera/tactile=240x320x3", "/rapid/serial/motor=3"];
    let ended = Command::new(python())
        .arg(example("observe.py"))
        .arg("240")
        .args(shapes)
        .env("RAPID_INSTANCE", &place.instance)
        .output()
        .expect("python");
    drop(running);
    assert!(ended.status.success(), "{ended:?}");
    let text = String::from_utf8_lossy(&ended.stdout);
    let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split("; ").collect()).collect();
    assert_eq!(lines.len(), 240, "{text}");
    // What came before the example subscribed is named and not received.
    let is_valid = |slot: &&str| slot.contains(": valid ") && !slot.contains("mean 0.000");
    assert!(lines.iter().any(|line| line[1..].iter().all(is_valid)), "{text}");
    let absent = "/rapid/camera/tactile: absent nan ms (240, 320, 3) mean 0.000";
    let unplugged = |line: &&Vec<&str>| line[0].ends_with("mask 0x05") && line[2] == absent;
    let out: Vec<_> = lines.iter().filter(unplugged).collect();
    assert!(out.iter().any(|line| is_valid(&line[1]) && is_valid(&line[3])), "{text}");
    // Each observation has the same shapes.
    let shapes = |line: &Vec<&str>| {
        ["(480, 640, 3)", "(240, 320, 3)", "(3,)"].iter().zip(&line[1..]).all(|(shape, slot)| slot.contains(shape))
    };
    assert!(lines.iter().all(shapes), "{text}");
}

#[test]
fn the_ten_lines_of_the_readme_print_observations() {
    let place = Place::new();
    let _running = place.start(&["--sim", "--headless", "--json", "--window", "50ms"], "\"mask\":\"0x07\"");
    let mut child = Command::new(python())
        .arg(example("ten_lines.py"))
        .env("RAPID_INSTANCE", &place.instance)
        .stdout(Stdio::piped())
        .spawn()
        .expect("python");
    let lines = BufReader::new(child.stdout.take().expect("a pipe")).lines();
    let whole = lines.map_while(Result::ok).find(|line| line.ends_with("missing: []")).expect("a whole observation");
    child.kill().expect("killed");
    child.wait().expect("ended");
    assert!(whole.starts_with("brightness ") && !whole.starts_with("brightness 0,"), "{whole}");
}

#[test]
fn what_the_client_makes_of_samples_is_as_documented() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let tested = Command::new(python())
        .args(["-m", "unittest", "-v", "test_client"])
        .current_dir(root.join("tests/python"))
        .env("PYTHONPATH", root.join("examples/python"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .expect("python");
    let text = String::from_utf8_lossy(&tested.stderr);
    assert!(tested.status.success() && text.contains("Ran 5 tests"), "{text}");
}
