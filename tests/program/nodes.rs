//! Programs in other languages that read devices for `rapid`: those of `examples/python`, with the wheels
//! `make setup` installs, and of `examples/c`, with the machine's C compiler.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use rapid_core::sample::Encoding;

use crate::support::{self, Episode, Place, events, logged, until};
use rustix::process::Signal;
use serde_json::Value;

const SIM: [&str; 6] = ["--sim", "sim.toml", "--config", "devices.toml", "--headless", "--json"];
/// Samples a second.
const RATE: &str = "100";

/// A registry of one device, read by the program that `node` names.
fn place(node: &str, more: &str) -> Place {
    let place = Place::new();
    let text = format!(
        "[rig]\ncooldown = \"200ms\"\n[device.counter]\nvid = \"2e8a\"\npid = \"000a\"\nserial = \"C1\"\nbit = 0\n{node}\n\
         topic = \"/rapid/counter\"\n[device.counter.process]\nkind = \"scalars\"\n{more}\n"
    );
    place.write("devices.toml", &text);
    place
}

fn example(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples").join(path)
}

/// Records a program that counts and is replugged: what it publishes arrives, in order and on the clock of `rapid`.
/// A program that takes longer to begin than it is plugged in at first has half a minute at the next time.
fn check_counter(place: &Place) {
    let events_of = "[[event]]\nat = \"3s\"\nunplug = \"counter\"\n[[event]]\nat = \"4s\"\nplug = \"counter\"\n";
    place.write("sim.toml", &format!("repeat = \"30s\"\n{events_of}"));
    let running = place.start(&[&SIM[..], &["--record", "--out", "out"]].concat(), "\"event\":\"recording\"");
    let states = |reported: &[Value]| -> Vec<String> {
        reported.iter().filter_map(|event| event["state"].as_str().map(str::to_owned)).collect()
    };
    let streams = |states: &[String]| states.iter().filter(|state| *state == "streaming").count();
    until("two programs that were read", || streams(&states(&running.reported())) == 2);
    // The second sends for a while, too.
    let begun = place.published();
    until("a second", || place.published() > begun + 500);
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, support::recorded_code(&output), "{errors}");
    let reported = events(&output);
    let states = states(&reported);
    assert_eq!((states[0].as_str(), streams(&states)), ("opening", 2), "{reported:#?}");
    for pair in states.windows(2) {
        let next: &[&str] = match pair[0].as_str() {
            "opening" => &["streaming", "absent"],
            "streaming" => &["absent"],
            _ => &["opening"],
        };
        assert!(next.contains(&pair[1].as_str()), "{reported:#?}");
    }
    assert!(logged(&reported, "counter: reads sim:").len() >= 2, "{reported:#?}");
    assert!(logged(&reported, "was killed").is_empty(), "it ends on SIGTERM: {reported:#?}");

    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    let samples: Vec<_> = episode.topic("/rapid/counter").collect();
    assert!(samples.windows(2).all(|pair| pair[1].sequence == pair[0].sequence + 1), "a hole in the samples");
    let numbers: Vec<[f64; 2]> = samples
        .iter()
        .map(|sample| {
            let payload = sample.payload();
            let (numbers, rest) = payload.as_chunks::<8>();
            assert!(rest.is_empty());
            [numbers[0], numbers[1]].map(f64::from_le_bytes)
        })
        .collect();
    // Whole numbers, far below where floats leave some out.
    let restarts = numbers.windows(2).filter(|pair| (pair[1][0] - pair[0][0] - 1.0).abs() > 0.5).count();
    assert_eq!(restarts, 1, "two programs, each from its beginning");
    // `log_time` is the time of capture: it goes as the program's own clock does.
    let offsets: Vec<f64> =
        samples.iter().zip(&numbers).map(|(sample, [_, clock])| sample.log_time as f64 / 1e9 - clock).collect();
    let spread = offsets.iter().copied().fold(f64::MIN, f64::max) - offsets.iter().copied().fold(f64::MAX, f64::min);
    assert!(spread < 0.5, "{spread} s between the clocks");
}

#[test]
#[cfg(target_arch = "x86_64")]
fn a_program_in_python_reads_a_device() {
    let (python, script) = (support::python(), example("python/publisher.py"));
    let node = format!("node = \"process\"\non_attach = [{python:?}, {script:?}, \"--rate\", {RATE:?}]");
    check_counter(&place(&node, "channels = 2"));
}

/// A program that asks an actuator to go to 0.25, until dropped.
#[cfg(target_arch = "x86_64")]
struct Acting(std::process::Child);

#[cfg(target_arch = "x86_64")]
impl Acting {
    fn start(python: &Path, place: &Place) -> Self {
        let mut act = Command::new(python);
        act.arg(example("python/act.py")).args(["600", "0.25"]).env("RAPID_INSTANCE", &place.instance);
        Self(act.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("python"))
    }
}

#[cfg(target_arch = "x86_64")]
impl Drop for Acting {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[cfg(target_arch = "x86_64")]
fn position(payload: &[u8]) -> f64 {
    f64::from_le_bytes(payload.try_into().expect("one number"))
}

#[test]
#[cfg(target_arch = "x86_64")]
fn an_actuator_in_python_follows_the_targets_of_another_program() {
    let (python, script) = (support::python(), example("python/actuator.py"));
    let action =
        "channels = 1\n[device.counter.action]\nnames = [\"position\"]\nunits = [\"m\"]\nmin = [0.0]\nmax = [0.4]";
    let place = place(&format!("node = \"process\"\non_attach = [{python:?}, {script:?}]"), action);
    place.write("sim.toml", "");
    let running = place.start(&[&SIM[..], &["--record", "--out", "out"]].concat(), "\"event\":\"recording\"");
    let acting = Acting::start(&python, &place);
    let partial = place.path("out").join(&place.files("out")[0]);
    until("the target is reached", || {
        let last = support::last_written(&partial, "/rapid/counter");
        last.is_some_and(|last| (position(&last.payload()) - 0.25).abs() < 1e-9)
    });
    drop(acting);
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, support::recorded_code(&output), "{errors}");
    assert!(logged(&events(&output), "does not move").is_empty(), "the rig leaves it to the program: {output}");

    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    assert!(episode.topic("/action").count() > 0);
    let positions: Vec<f64> = episode.topic("/rapid/counter").map(|sample| position(&sample.payload())).collect();
    let (first, last) = (positions.first().expect("samples"), positions.last().expect("samples"));
    assert!(*first < 0.2 && (last - 0.25).abs() < 1e-9, "from {first} to {last}");
    let fastest = positions.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
    assert!(fastest < 0.005 + 1e-9, "{fastest} m a step");
}

/// `librapid_node.a`, built with all that the tests of the workspace need: where those were built before, there is nothing to
/// do. In the profile of this test.
fn c_library() -> PathBuf {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut build = Command::new(cargo);
    build.args(["test", "--locked", "--workspace", "--no-run", "--test", "archive", "--message-format", "json"]);
    if Path::new(env!("CARGO_BIN_EXE_rapid")).parent().is_some_and(|folder| folder.ends_with("release")) {
        build.arg("--release");
    }
    let printed = build.current_dir(env!("CARGO_MANIFEST_DIR")).output().expect("cargo");
    assert!(printed.status.success(), "{}", String::from_utf8_lossy(&printed.stderr));
    let files = events(&String::from_utf8_lossy(&printed.stdout));
    let files = files
        .iter()
        .filter(|line| line["target"]["name"] == "rapid_node")
        .filter_map(|line| line["filenames"].as_array());
    let archive = files
        .flatten()
        .filter_map(serde_json::Value::as_str)
        .map(Path::new)
        .find(|file| file.extension().is_some_and(|end| end == "a"));
    archive.expect("cargo prints the archive's path").into()
}

/// Compiles a program of `examples/c` into a place, with the library or with none.
fn compile(name: &str, place: &Place, archive: Option<PathBuf>) {
    let libraries = archive.map(|archive| [archive.into_os_string(), "-lpthread".into(), "-ldl".into(), "-lm".into()]);
    let compiled = Command::new("cc")
        .args(["-std=c11", "-D_POSIX_C_SOURCE=200809L", "-Wall", "-Wextra", "-Werror", "-O1", "-o"])
        .arg(place.path(name))
        .arg(example("c").join(name).with_extension("c"))
        .arg("-I")
        .arg(example("c"))
        .args(libraries.into_iter().flatten())
        .output()
        .expect("cc");
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
}

#[test]
fn programs_in_c_subscribe_and_read_the_mask() {
    let place = Place::new();
    compile("subscriber", &place, Some(c_library()));
    compile("mask", &place, None);
    let _running = place.start(&["--sim", "--headless", "--json"], "\"state\":\"streaming\"");
    let run = |program: &str, arguments: &[&str]| {
        let mut command = Command::new(place.path(program));
        let ended = command.args(arguments).env("RAPID_INSTANCE", &place.instance).output().expect("a program");
        assert!(ended.status.success(), "{ended:?}");
        String::from_utf8_lossy(&ended.stdout).into_owned()
    };
    let samples = run("subscriber", &["/rapid/serial/motor", "3"]);
    let numbers = samples.lines().filter_map(|line| line.strip_prefix("seq ")?.split(' ').next()?.parse::<u64>().ok());
    assert!(numbers.count() == 3 && samples.contains(", 24 bytes"), "{samples}");
    let mask = run("mask", &[]);
    // Sequence, mask, and a bit for each of the three devices.
    assert_eq!(mask.split_whitespace().count(), 5, "{mask}");
}

#[test]
fn a_program_in_c_reads_a_device() {
    let place = place("node = \"publisher\"", &format!("channels = 2\nargs = [{RATE:?}]"));
    compile("publisher", &place, Some(c_library()));
    check_counter(&place);

    // Both sides of the C interface mean the same by an encoding.
    let header = std::fs::read_to_string(example("c/rapid_node.h")).expect("rapid_node.h");
    for (name, encoding) in [
        ("BYTES", Encoding::Bytes),
        ("MJPEG", Encoding::Mjpeg),
        ("YUYV", Encoding::Yuyv),
        ("GREY", Encoding::Grey),
        ("F64", Encoding::F64),
    ] {
        assert!(header.contains(&format!("RAPID_{name} = {}", encoding as u32)), "{name}");
    }
}
