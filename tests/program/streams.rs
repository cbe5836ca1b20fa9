//! A camera with several streams, and depth images: recorded byte for byte, replayed, shown and left out of
//! datasets.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use rapid_devices::driver::sim;
use rapid_registry::Registry;
use rapid_registry::scenario::Scenario;

use crate::support::{self, Episode, LENIENT, Place, events};
use serde_json::Value;

const RIG: &str = r#"
[device.d435]
vid = "8086"
pid = "0b07"
serial = "D"
node = "camera"
bit = 0
[device.d435.camera]
width = 64
height = 48
fps = 30
format = "MJPG"
[device.d435.verdict]
rate = "off"
valid = "off"
[device.d435.stream.depth]
bit = 3
[device.d435.stream.depth.camera]
width = 96
height = 64
fps = 30
format = "Z16"
depth_unit = "100um"
[device.d435.stream.depth.verdict]
rate = "off"
valid = "off"
"#;

/// `foxglove.RawImage`.
#[derive(Clone, PartialEq, prost::Message)]
struct Raw {
    #[prost(fixed32, tag = "2")]
    width: u32,
    #[prost(fixed32, tag = "3")]
    height: u32,
    #[prost(string, tag = "4")]
    encoding: String,
    #[prost(fixed32, tag = "5")]
    step: u32,
    #[prost(bytes = "vec", tag = "6")]
    data: Vec<u8>,
}

#[test]
fn depth_is_recorded_replayed_and_shown() {
    let place = Place::new();
    place.write("devices.toml", &[RIG, LENIENT].concat());
    // The scenario has a clock of its own: the stream is gone until the recording shows it gone.
    place.write("play.toml", "[[device]]\nname = \"d435\"\n[[device]]\nname = \"d435_depth\"\n");
    let run = |options: &[&str]| {
        let output = place.run(options);
        assert!(output.status.success(), "{options:?}: {}", String::from_utf8_lossy(&output.stderr));
        output
    };
    let record = ["--sim", "play.toml", "--headless", "--json", "--record", "--out", "out", "--duration", "2s"];
    let reported = events(&String::from_utf8_lossy(&run(&record).stdout));
    let file = format!("out/{}", place.files("out")[0]);
    let episode = Episode::read(&place.path(&file));
    assert_eq!(episode.mask_edges().last().expect("a mask").1, 0b1001, "{reported:?}");
    assert!(episode.topic("/rapid/camera/d435").count() > 0);

    let registry = Registry::parse(RIG, None).expect("a registry").registry;
    let scenario = Scenario::demo(&registry);
    let source = &scenario.devices.iter().find(|device| device.name == "d435_depth").expect("a stream").source;
    let pictures: Vec<Raw> = episode.topic("/rapid/camera/d435/depth").map(support::Message::decode).collect();
    assert!(!pictures.is_empty());
    for picture in &pictures {
        assert_eq!((picture.width, picture.height, picture.step), (96, 64, 192));
        assert_eq!(picture.encoding, "16UC1");
        let number = &picture.data[2 * 96 * 63..][..4];
        let sequence = u32::from_le_bytes(number.try_into().expect("four bytes"));
        assert_eq!(Some(&picture.data), sim::frame(source, sequence).as_ref(), "{sequence}");
    }

    let report: Value = serde_json::from_slice(&run(&["inspect", "--json", &file]).stdout).expect("JSON");
    let modalities = report["modalities"].as_array().expect("a list");
    assert_eq!(modalities.len(), 2, "{report}");
    // Played again, the same bytes are recorded.
    run(&["replay", &file, "--record", "--out", "again", "--headless"]);
    let again = Episode::read(&place.path(&format!("again/{}", place.files("again")[0])));
    let replayed: Vec<Raw> = again.topic("/rapid/camera/d435/depth").map(support::Message::decode).collect();
    let places = replayed.iter().map(|picture| pictures.iter().position(|recorded| recorded == picture));
    let places: Vec<usize> = places.collect::<Option<_>>().expect("each was recorded");
    assert!(places.is_sorted_by(|one, next| one < next), "{places:?}");
    // A busy machine loses some.
    assert!(2 * places.len() > pictures.len(), "{} of {}", places.len(), pictures.len());
    // A picture for people has them as shades.
    run(&["inspect", &file, "--plot=plot.svg"]);
    let svg = std::fs::read_to_string(place.path("plot.svg")).expect("a picture");
    assert!(svg.contains("d435_depth") && svg.matches("data:image/jpeg").count() > 10, "{}", svg.len());
}

#[cfg(feature = "export")]
#[test]
fn a_data_set_has_the_other_stream_alone() {
    let place = Place::new();
    place.write("devices.toml", &[RIG, LENIENT].concat());
    let run = |options: &[&str]| {
        let output = place.run(options);
        assert!(output.status.success(), "{options:?}: {}", String::from_utf8_lossy(&output.stderr));
    };
    run(&["--sim", "--headless", "--record", "--out", "out", "--duration", "2s"]);
    run(&["export", "out", "--to", "lerobot", "--out", "set", "--verify", "--include-bad"]);
    // What the dataset lacks is named.
    let words = ["export", "out", "--to", "lerobot", "--include-bad", "--out"];
    let text = place.run(&[&words[..], &["text"]].concat()).stdout;
    let text = String::from_utf8(text).expect("text");
    let depth = "not in the dataset: d435_depth of 1 episode: depth, for which LeRobot has no feature\n";
    assert!(text.contains(depth), "{text}");
    let text = place.run(&[&words[..], &["objects", "--json"]].concat()).stdout;
    let text = String::from_utf8(text).expect("text");
    let summary: Value = serde_json::from_str(text.lines().last().expect("a line")).expect("JSON");
    let lacking = summary["not_exported"].as_array().expect("a list");
    let names: Vec<&str> = lacking.iter().map(|what| what["name"].as_str().expect("a name")).collect();
    // A line of the log is not in every episode.
    let names: Vec<&str> = names.into_iter().filter(|name| *name != "/rapid/log").collect();
    assert_eq!(names, ["/rapid/event", "d435_depth"], "{summary}");
    let info: Value =
        serde_json::from_slice(&std::fs::read(place.path("set/meta/info.json")).expect("a file")).expect("JSON");
    let features = info["features"].as_object().expect("features");
    assert!(features.contains_key("observation.images.d435") && !features.keys().any(|key| key.contains("d435_depth")));
    assert_eq!(features["rapid.mask"]["names"], serde_json::json!(["d435", "d435_depth"]), "{info}");
}

#[test]
fn a_camera_is_unregistered_with_its_streams_and_no_stream_alone() {
    let place = Place::new();
    place.write(
        "devices.toml",
        &[RIG, "[device.other]\nvid = \"1\"\npid = \"2\"\nnode = \"camera\"\nbit = 9\n"].concat(),
    );
    let alone = place.run(&["unregister", "d435_depth", "--yes"]);
    let errors = String::from_utf8_lossy(&alone.stderr);
    assert_eq!(alone.status.code(), Some(2), "{errors}");
    assert!(errors.contains("[device.d435_depth] is a further stream of a camera"), "{errors}");
    let removed = place.run(&["unregister", "d435", "--yes"]);
    let text = String::from_utf8_lossy(&removed.stdout);
    assert!(text.contains("removed [device.d435] with its streams d435_depth"), "{text}");
}
