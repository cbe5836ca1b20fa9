//! As many devices as the mask has bits, simulated and recorded.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::fmt::Write as _;
use std::path::Path;

use rapid_bus::Bus;
use rapid_devices::driver::sim;
use rapid_registry::scenario::Scenario;
use rapid_registry::{NodeSpec, Registry};

use crate::shared_memory::after;
use crate::support::{self, Episode, Place, events};

const CAMERAS: usize = 16;
const SECONDS: usize = 4;
const CAMERA_FPS: usize = 10;
const SERIAL_HZ: usize = 50;
/// All of it: the registry must fit its topics in, whatever a topic holds beside its depth.
const BUDGET: u64 = 64 << 20;
const ALL: u64 = u64::MAX;

fn registry(devices: usize) -> String {
    let mut text = format!("[rig]\nname = \"many\"\nmemory_budget = \"{}MiB\"\n", BUDGET >> 20);
    for number in 0..devices {
        let (node, table) = if number < CAMERAS { ("camera", "camera") } else { ("serial", "tty") };
        // Bits against the order of the file, so that one is not mistaken for the other.
        let bit = if devices == 64 { 63 - number } else { number.min(63) };
        write!(
            text,
            "\n[device.d{number}]\nvid = \"1209\"\npid = \"{number:04x}\"\nserial = \"UNIT{number}\"\nnode = \"{node}\"\n\
             bit = {bit}\nstall_after = \"10s\"\n[device.d{number}.{table}]\n"
        )
        .expect("a string takes every write");
        text.push_str(match node {
            "camera" => "width = 64\nheight = 48\nfps = 10\n",
            _ => "baud = 115200\nparse = \"csv\"\nchannels = 3\n",
        });
    }
    text
}

fn scenario(devices: usize) -> String {
    (0..devices).fold(String::new(), |mut text, number| {
        let hz = if number < CAMERAS { CAMERA_FPS } else { SERIAL_HZ };
        write!(text, "[[device]]\nname = \"d{number}\"\nhz = {hz}\nseed = {}\n\n", 1000 + number).expect("a string");
        text
    })
}

#[test]
fn sixty_four_devices_are_recorded_without_a_hole() {
    let place = Place::new();
    let config = place.write("many.toml", &registry(64)).display().to_string();
    let played = place.write("scenario.toml", &scenario(64)).display().to_string();
    let duration = format!("{SECONDS}s");
    let mut arguments = vec!["--sim", &played, "--config", &config, "--headless", "--json", "--record"];
    arguments.extend(["--out", "out", "--duration", &duration]);
    // The limit that a session and a unit have by default.
    let output = after(&place, "ulimit -Sn 1024", &arguments).output().expect("a shell");
    let code = support::recorded_code(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(output.status.code(), code, "{}", String::from_utf8_lossy(&output.stderr));
    let events = events(&String::from_utf8_lossy(&output.stdout));
    for state in ["opening", "streaming"] {
        assert_eq!(events.iter().filter(|event| event["state"] == state).count(), 64, "{state}");
    }
    let states = events.iter().filter(|event| event["event"] == "state").count();
    assert_eq!(states, 128, "only opening and streaming");

    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    let masks: Vec<u64> = episode.mask_edges().into_iter().map(|(_, mask)| mask).collect();
    // On a slow machine the recording begins before the last has come; a bit that came stays.
    assert_eq!(masks.last(), Some(&ALL), "{masks:x?}");
    assert!(masks.windows(2).all(|pair| pair[0] & !pair[1] == 0), "{masks:x?}");
    let registry = Registry::load(&place.path("many.toml")).expect("accepted").registry;
    let scenario = Scenario::load(&place.path("scenario.toml"), &registry).expect("accepted");
    let whole = masks.len() == 1;
    for device in &registry.devices {
        let source = &scenario.devices.iter().find(|source| source.name == device.name).expect("simulated").source;
        let messages: Vec<_> = episode.topic(&device.topic).collect();
        let hz = if matches!(device.node, NodeSpec::Camera(_)) { CAMERA_FPS } else { SERIAL_HZ };
        let least = if whole { SECONDS * hz - 1 } else { 1 };
        assert!(messages.len() >= least, "{}: {} messages", device.name, messages.len());
        for pair in messages.windows(2) {
            assert_eq!(pair[1].sequence, pair[0].sequence + 1, "{}", device.name);
        }
        for message in messages {
            assert_eq!(Some(message.payload()), sim::frame(source, message.sequence), "{}", device.name);
        }
    }
    let frames = episode.frames();
    assert_eq!(frames.len(), SECONDS * 30);
    let last = &frames.last().expect("frames").1;
    assert_eq!(last.mask, ALL);
    assert_eq!(last.modalities.iter().map(|slot| slot.bit).collect::<Vec<_>>(), (0..64).collect::<Vec<_>>());
    assert_eq!(
        (episode.value("rapid/summary", "dropped"), episode.value("rapid/summary", "masks_dropped")),
        ("0", "0")
    );
}

#[test]
fn the_topics_reserve_no_more_than_the_memory_budget() {
    let place = Place::new();
    let registry = Registry::parse(&registry(64), None).expect("accepted").registry;
    assert_eq!(registry.rig.memory_budget, BUDGET);
    let bus = Bus::open(&registry, Some(&place.instance)).expect("bus");
    let pools =
        place.shared_memory().into_iter().filter(|file| Path::new(file).extension().is_some_and(|kind| kind == "data"));
    let in_memory: u64 = pools.map(|file| std::fs::metadata(format!("/dev/shm/{file}")).expect("file").len()).sum();
    assert!(in_memory >= bus.reserved_bytes(), "the files of the pools are all there: {in_memory}");
    assert!(in_memory <= BUDGET, "{in_memory} bytes of {BUDGET}");
}

#[test]
fn a_sixty_fifth_is_refused() {
    let place = Place::new();
    let config = place.write("many.toml", &registry(65)).display().to_string();
    let output = place.run(&["--config", &config, "check"]);
    assert_eq!(output.status.code(), Some(2));
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(printed.contains("d64") && printed.contains("more than 64 devices"), "{printed}");
    let run = place.run(&["--config", &config, "--sim", "--headless", "--duration", "1s"]);
    assert_eq!(run.status.code(), Some(2));
    assert!(!place.mask_file().exists());
}
