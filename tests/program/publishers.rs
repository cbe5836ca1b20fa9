//! Another program of the same user publishes on topics of a run that records: nothing of it is taken for ours, and
//! the episode's verdict has it as a reason.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use rapid_bus::Header;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;

use crate::support::{Episode, MaskMessage, Place, until};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::*;
use rustix::process::Signal;

/// No mask of the simulated rig, which has three devices.
const FORGED_MASK: u64 = 0xf0;
const FORGED_PICTURE: &[u8] = b"no picture of ours";

type Port = Publisher<ipc::Service, [u8], Header>;

fn publisher(place: &Place, topic: &str) -> Port {
    let mut config = Config::global_config().clone();
    config.global.prefix = FileName::new(format!("iox2_{}_", place.instance).as_bytes()).expect("prefix");
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .expect("node");
    let name = ServiceName::new(topic).expect("name");
    let service =
        node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<Header>().open().expect("topic");
    service.publisher_builder().initial_max_slice_len(64).create().expect("publisher")
}

fn give(port: &Port, seq: u64, encoding: Encoding, payload: &[u8]) {
    let now = Stamp::now().0;
    let mut sample = port.loan_slice_uninit(payload.len()).expect("loan");
    *sample.user_header_mut() = Header(SampleHeader {
        seq,
        capture_ns: now,
        recv_ns: now,
        encoding: encoding as u32,
        ..SampleHeader::default()
    });
    sample.write_from_slice(payload).send().expect("send");
}

#[test]
fn a_second_publisher_adds_nothing_to_an_episode_and_is_named_in_its_verdict() {
    let place = Place::new();
    let arguments = ["--sim", "--headless", "--json", "--record", "--out", "out"];
    let running = place.start(&arguments, "\"event\":\"recording\"");
    let (mask, picture) = (publisher(&place, "/rapid/mask"), publisher(&place, "/rapid/camera/wrist"));
    let mut seq = 0;
    let reported = |topic: &str| {
        let events = running.reported();
        events.into_iter().find(|event| event["event"] == "publisher" && event["topic"] == topic)
    };
    until("an event of both", || {
        seq += 1;
        let forged = [FORGED_MASK, 1_000_000 + seq].map(u64::to_le_bytes).concat();
        give(&mask, 1_000_000 + seq, Encoding::Mask, &forged);
        give(&picture, 1_000_000 + seq, Encoding::Mjpeg, FORGED_PICTURE);
        reported("/rapid/mask").is_some() && reported("/rapid/camera/wrist").is_some()
    });
    let process = u64::from(std::process::id());
    let event = reported("/rapid/mask").expect("reported");
    assert_eq!(event["process"], process);
    let own = std::env::current_exe().expect("this program");
    let own = own.file_name().and_then(|name| name.to_str()).expect("its name");
    assert!(event["command"].as_str().is_some_and(|command| command.contains(own)), "{event}");
    running.signal(Signal::INT);
    let (_, output, printed) = running.end();
    assert!(output.contains("\"event\":\"episode\""), "{output} {printed}");

    let files = place.files("out");
    assert_eq!(files.len(), 1, "{files:?}");
    let file = place.path("out").join(&files[0]);
    let episode = Episode::read(&file);
    assert!(episode.topic("/rapid/mask").count() > 0);
    for message in episode.topic("/rapid/mask") {
        assert_eq!(message.decode::<MaskMessage>().mask & FORGED_MASK, 0);
    }
    assert!(episode.topic("/rapid/camera/wrist").all(|message| message.payload() != FORGED_PICTURE));
    let reasons = episode.value("rapid/summary", "reasons");
    assert_ne!(episode.value("rapid/summary", "verdict"), "GOOD");
    for topic in ["/rapid/mask", "/rapid/camera/wrist"] {
        let named = format!("another program published on {topic}: process {process} (");
        assert!(reasons.contains(&named), "{reasons}");
    }
    // By the file alone the judgement is the same.
    let inspected = place.run(&["--json", "inspect", &file.display().to_string()]);
    let inspected: serde_json::Value = serde_json::from_slice(&inspected.stdout).expect("JSON");
    let recorded: serde_json::Value = serde_json::from_str(reasons).expect("JSON");
    let of_publishers = |reasons: &serde_json::Value| {
        let texts = reasons.as_array().expect("a list").iter().filter_map(|reason| reason.as_str());
        texts.filter(|reason| reason.contains("another program")).map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(of_publishers(&inspected["reasons"]), of_publishers(&recorded), "{inspected}");
    assert_eq!(of_publishers(&recorded).len(), 2);
    // No topic of another program is left behind.
    drop((mask, picture));
}
