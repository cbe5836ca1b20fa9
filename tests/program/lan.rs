//! Devices on the network: servers and senders on 127.0.0.1 that behave as cameras, LiDARs and phones do, in
//! front of the real binary.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::f64::consts::FRAC_1_SQRT_2;
use std::io::Write;
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::support::lan::{
    HEIGHT, Packets, RIG, RUN, Server, WIDTH, camera, camera_entry, free_ports, lidar_rig, life_of, picture, stop,
    wait_for,
};
use crate::support::{self, Episode, Place, until};
use serde_json::Value;
use vbench::emu::lan::lidar;

#[test]
fn a_camera_appears_is_recorded_is_killed_and_comes_back() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &format!("{RIG}{}", camera_entry("cam", 0, port)));
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    let first = Server::start(port, camera);
    wait_for(&running, "cam", "streaming", 1);
    drop(first);
    wait_for(&running, "cam", "by lease", 1);
    let _second = Server::start(port, camera);
    wait_for(&running, "cam", "streaming", 2);
    let reported = stop(running);
    let life = life_of(&reported, "cam");
    assert_eq!(life.iter().filter(|word| *word == "by lease").count(), 1, "{life:?}");
    let gone = reported.iter().position(|event| event["event"] == "detach").expect("gone");
    assert_eq!(reported[gone + 1]["mask"], "0x00");
    // The bit was cleared when the connection ended, before the lease did.
    let backoff = reported.iter().find(|event| event["state"] == "backoff").expect("its connection ended");
    assert_eq!(backoff["mask"], "0x00");

    let files = place.files("out");
    let episode = Episode::read(&place.path("out").join(&files[0]));
    let edges: Vec<u64> = episode.mask_edges().iter().map(|(_, mask)| *mask).collect();
    assert_eq!(edges, [0, 1, 0, 1]);
    let pictures: Vec<Vec<u8>> = episode.topic("/rapid/lan/cam").map(support::Message::payload).collect();
    assert_eq!(pictures[0], picture(0), "the picture is as the camera sent it");
}

#[test]
fn entries_that_are_added_while_the_rig_runs_are_searched_for() {
    let (place, [first, second]) = (Place::new(), free_ports());
    // Without anything on the network at the start.
    let tof = "[device.tof]\nvid = \"1209\"\npid = \"0001\"\nnode = \"serial\"\nbit = 5\ntty = { channels = 1 }\n";
    let small = |name: &str, bit: u32, port: u16| {
        let own = "node = \"lan\"\nmax_bytes = \"64KiB\"\ndepth = 8\n";
        camera_entry(name, bit, port).replace("node = \"lan\"\n", own)
    };
    let (cam, late) = (small("cam", 0, first), small("late", 1, second));
    place.write("devices.toml", &format!("{RIG}{tof}"));
    let running = place.start(&RUN, "begin");
    let reload = |text: &str, added: &str| {
        place.write("devices.toml", text);
        let output = place.run(&["reload"]);
        let answer = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        assert!(output.status.success() && answer.contains(added), "{answer}");
    };
    let _first = Server::start(first, camera);
    reload(&format!("{RIG}{tof}{cam}"), "[device.cam] as bit 0");
    wait_for(&running, "cam", "streaming", 1);
    reload(&format!("{RIG}{tof}{cam}{late}"), "[device.late] as bit 1");
    let server = Server::start(second, camera);
    wait_for(&running, "late", "streaming", 1);
    drop(server);
    wait_for(&running, "late", "by lease", 1);
    let _second = Server::start(second, camera);
    wait_for(&running, "late", "streaming", 2);
    let reported = stop(running);
    let opened = reported.iter().filter(|event| event["event"] == "opened" && event["device"] == "cam").count();
    assert_eq!(opened, 1, "the other one was not interrupted: {:?}", life_of(&reported, "cam"));
}

#[test]
fn packets_become_samples_unchanged() {
    let (place, [port]) = (Place::new(), free_ports());
    let entry = format!(
        "{RIG}[device.lidar]\nnode = \"lan\"\nbit = 0\nmax_bytes = \"1KiB\"\n[device.lidar.lan]\nprotocol = \"udp\"\n\
         host = \"127.0.0.1\"\nport = {port}\nlease = \"1s\"\n"
    );
    place.write("devices.toml", &entry);
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    let packets = Packets::send(port, |number| {
        let mut packet = number.to_le_bytes().to_vec();
        // Each tenth is larger than the entry permits.
        packet.resize(if number % 10 == 9 { 1025 } else { 1000 }, 7);
        packet
    });
    wait_for(&running, "lidar", "streaming", 1);
    packets.end_after_a_hundred();
    wait_for(&running, "lidar", "by lease", 1);
    let reported = stop(running);
    let lost = reported.iter().rfind(|event| event["event"] == "summary").expect("a summary")["devices"][0].clone();
    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    let samples: Vec<Vec<u8>> = episode.topic("/rapid/lan/lidar").map(support::Message::payload).collect();
    assert!(samples.len() > 20, "{}", samples.len());
    assert!(samples.iter().all(|packet| packet.len() == 1000 && packet[4..].iter().all(|byte| *byte == 7)));
    let numbers: Vec<u32> =
        samples.iter().map(|packet| u32::from_le_bytes([packet[0], packet[1], packet[2], packet[3]])).collect();
    assert!(numbers.windows(2).all(|pair| pair[0] < pair[1] && pair[1] % 10 != 9), "{numbers:?}");
    assert!(lost["gaps"].as_u64().is_some_and(|gaps| gaps > 0), "what was too large is lost: {lost}");
}

/// `foxglove.PointCloud`.
#[derive(Clone, PartialEq, prost::Message)]
struct Cloud {
    #[prost(fixed32, tag = "4")]
    stride: u32,
    #[prost(bytes = "vec", tag = "6")]
    data: Vec<u8>,
}

#[test]
fn packets_of_a_lidar_are_recorded_with_their_points() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &lidar_rig(port));
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    let packets = Packets::send(port, |number| {
        // Each tenth is not a packet of points: it is recorded all the same.
        let packet = lidar::packet(number, 0);
        packet[..if number % 10 == 9 { 1205 } else { packet.len() }].to_vec()
    });
    wait_for(&running, "lidar", "streaming", 1);
    packets.end_after_a_hundred();
    stop(running);
    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    let packets: Vec<_> = episode.topic("/rapid/lan/lidar").collect();
    let clouds: Vec<_> = episode.topic("/rapid/lan/lidar/points").collect();
    let whole: Vec<_> = packets.iter().filter(|packet| packet.payload().len() == lidar::PACKET).collect();
    assert!(packets.len() > whole.len() && whole.len() > 20, "{} packets, {} whole", packets.len(), whole.len());
    assert_eq!(clouds.len(), whole.len());
    for (recorded, cloud) in whole.iter().zip(clouds) {
        assert_eq!((recorded.log_time, recorded.sequence), (cloud.log_time, cloud.sequence));
        let cloud: Cloud = cloud.decode();
        let points: Vec<_> = cloud.data.chunks_exact(usize::try_from(cloud.stride).expect("small")).collect();
        // The packet's number takes the place of its first four returns, of which some are 0: none.
        assert!((380..=384).contains(&points.len()), "{}", points.len());
        // The last return is that of the highest laser, at 1310 x 2 mm.
        let number =
            |at: usize| f32::from_le_bytes(points[points.len() - 1][at..at + 4].try_into().expect("four bytes"));
        let (level, up) = (number(0).hypot(number(4)), number(8) + 0.0112);
        assert!((level.hypot(up) - 2.62).abs() < 1e-3 && (up.atan2(level).to_degrees() - 15.0).abs() < 1e-2);
        assert_eq!(points[points.len() - 1][12], 100, "its reflectivity");
    }
}

/// The pose that a phone sends: a homogeneous matrix, column by column, as `ARKit` has it. Turned by 90 degrees about z.
const POSE: [f32; 16] = [0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.25, -1.5, 3.0, 1.0];
/// The same as a position and a quaternion `x y z w`.
const PLACE: ([f64; 3], [f64; 4]) = ([0.25, -1.5, 3.0], [0.0, 0.0, FRAC_1_SQRT_2, FRAC_1_SQRT_2]);

/// A phone: connects, names its session, sends frames; connects again when that ends. By `ahead` its clock is further for
/// a frame of that number, s.
fn phone(port: u16, sends: &AtomicBool, ahead: fn(u32) -> f64) {
    while sends.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(20));
        let Ok(mut stream) = TcpStream::connect(("127.0.0.1", port)) else { continue };
        let mut send = |kind: u8, payload: &[u8]| {
            let length = u32::try_from(payload.len()).expect("short").to_le_bytes();
            stream.write_all(&[&length[..], &[kind, 0, 0, 0], payload].concat()).is_ok()
        };
        let begun = Instant::now();
        let mut number = 0;
        let mut goes = send(0, br#"{"sessionId":"s","deviceModel":"iPhone"}"#);
        while goes && sends.load(Ordering::Relaxed) {
            let picture = picture(number);
            let mut frame = u32::try_from(picture.len()).expect("short").to_le_bytes().to_vec();
            frame.extend(POSE.iter().flat_map(|number| number.to_le_bytes()));
            frame.extend((begun.elapsed().as_secs_f64() + ahead(number)).to_le_bytes());
            frame.extend(1.7e9_f64.to_le_bytes());
            frame.extend(picture);
            goes = send(3, b"{}") && send(1, &frame);
            number += 1;
            std::thread::sleep(Duration::from_millis(30));
        }
    }
}

/// `foxglove.Vector3`.
#[derive(Clone, PartialEq, prost::Message)]
struct Vector {
    #[prost(double, tag = "1")]
    x: f64,
    #[prost(double, tag = "2")]
    y: f64,
    #[prost(double, tag = "3")]
    z: f64,
}

/// `foxglove.Quaternion`.
#[derive(Clone, PartialEq, prost::Message)]
struct Quaternion {
    #[prost(double, tag = "1")]
    x: f64,
    #[prost(double, tag = "2")]
    y: f64,
    #[prost(double, tag = "3")]
    z: f64,
    #[prost(double, tag = "4")]
    w: f64,
}

/// `foxglove.Pose`.
#[derive(Clone, PartialEq, prost::Message)]
struct Pose {
    #[prost(message, optional, tag = "1")]
    position: Option<Vector>,
    #[prost(message, optional, tag = "2")]
    orientation: Option<Quaternion>,
}

/// `foxglove.PoseInFrame`.
#[derive(Clone, PartialEq, prost::Message)]
struct PoseInFrame {
    #[prost(string, tag = "2")]
    frame_id: String,
    #[prost(message, optional, tag = "3")]
    pose: Option<Pose>,
}

/// `foxglove.FrameTransform`.
#[derive(Clone, PartialEq, prost::Message)]
struct FrameTransform {
    #[prost(string, tag = "2")]
    parent: String,
    #[prost(string, tag = "3")]
    child: String,
    #[prost(message, optional, tag = "4")]
    translation: Option<Vector>,
    #[prost(message, optional, tag = "5")]
    rotation: Option<Quaternion>,
}

#[track_caller]
fn is_the_place(position: Option<Vector>, rotation: Option<Quaternion>) {
    let (Vector { x, y, z }, turned) = (position.expect("a position"), rotation.expect("a rotation"));
    let found = [x, y, z, turned.x, turned.y, turned.z, turned.w];
    let expected = PLACE.0.into_iter().chain(PLACE.1);
    assert!(found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-9), "{found:?}");
}

/// Each sample has its pose and its transform, of its time and number.
fn check_poses(episode: &Episode) {
    let of = |topic: &str| -> Vec<_> { episode.messages.iter().filter(|message| message.topic == topic).collect() };
    let (samples, poses, transforms) = (of("/rapid/lan/phone"), of("/rapid/lan/phone/pose"), of("/tf"));
    assert!(!samples.is_empty() && samples.len() == poses.len() && samples.len() == transforms.len());
    assert_eq!(episode.schemas["/rapid/lan/phone/pose"], "foxglove.PoseInFrame");
    assert_eq!(episode.schemas["/tf"], "foxglove.FrameTransform");
    for ((sample, pose), transform) in samples.into_iter().zip(poses).zip(transforms) {
        for derived in [pose, transform] {
            assert_eq!((derived.log_time, derived.sequence), (sample.log_time, sample.sequence));
        }
        let PoseInFrame { frame_id, pose } = pose.decode();
        let Pose { position, orientation } = pose.expect("a pose");
        assert_eq!(frame_id, "world");
        is_the_place(position, orientation);
        let FrameTransform { parent, child, translation, rotation } = transform.decode();
        assert_eq!([parent, child], ["world", "phone"]);
        is_the_place(translation, rotation);
    }
}

fn phone_entry(port: u16, probe: u16, stream: &str) -> String {
    format!(
        "{RIG}[device.phone]\nnode = \"lan\"\nbit = 0\n[device.phone.lan]\nprotocol = \"iphone\"\n\
         host = \"127.0.0.1\"\nport = {port}\nprobe_port = {probe}\nstream = {stream:?}\n\
         width = {WIDTH}\nheight = {HEIGHT}\n"
    )
}

#[test]
fn a_phone_whose_times_are_wrong_or_uncertain_is_not_good() {
    let (place, [port, probe]) = (Place::new(), free_ports());
    place.write("devices.toml", &phone_entry(port, probe, "pose"));
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    let _listener = Server::start(probe, drop);
    let sends = Arc::new(AtomicBool::new(true));
    let sender = std::thread::spawn({
        let sends = Arc::clone(&sends);
        // Its first frames took 200 ms longer than the next ones; one has a time of the future.
        let ahead = |number| match number {
            0..10 => 1.0 - 0.2,
            20 => 51.0,
            _ => 1.0,
        };
        move || phone(port, &sends, ahead)
    });
    until("a report after the wrong times", || {
        let clocks: Vec<_> = running.reported().into_iter().filter(|event| event["event"] == "clock").collect();
        clocks.len() >= 4 && clocks.iter().any(|event| event["uncertainty_ns"].as_u64() > Some(150_000_000))
    });
    sends.store(false, Ordering::Relaxed);
    sender.join().expect("no panic");
    let reported = stop(running);
    let ended = reported.iter().find(|event| event["event"] == "episode").expect("an episode");
    let reasons: Vec<_> = ended["reasons"].as_array().expect("reasons").iter().filter_map(Value::as_str).collect();
    for expected in ["phone: capture times uncertain by ±", " samples damaged (limit 1 %)"] {
        assert!(reasons.iter().any(|reason| reason.contains(expected)), "{expected}: {reasons:#?}");
    }
    let inspected = place.run(&["inspect", "--json", &format!("out/{}", place.files("out")[0])]);
    let inspected: Value = serde_json::from_slice(&inspected.stdout).expect("JSON");
    assert_eq!(inspected["reasons"], ended["reasons"], "the recorder and a reader of the file agree");
    let quality = &inspected["modalities"][0]["quality"];
    assert_eq!(quality["damaged"], 1, "{quality}");
    assert!(quality["clock_uncertainty"].as_f64() > Some(150.0), "{quality}");
}

#[test]
fn a_phone_connects_and_sends_pictures_with_poses() {
    for stream in ["image", "pose"] {
        let (place, [port, probe]) = (Place::new(), free_ports());
        place.write("devices.toml", &phone_entry(port, probe, stream));
        let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
        let listener = Server::start(probe, drop);
        let sends = Arc::new(AtomicBool::new(true));
        let sender = std::thread::spawn({
            let sends = Arc::clone(&sends);
            move || phone(port, &sends, |_| 0.0)
        });
        wait_for(&running, "phone", "streaming", 1);
        sends.store(false, Ordering::Relaxed);
        drop(listener);
        sender.join().expect("no panic");
        wait_for(&running, "phone", "by lease", 1);
        stop(running);
        let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
        let first = episode.topic("/rapid/lan/phone").next().expect("a sample").payload();
        if stream == "pose" {
            let numbers: Vec<f64> = first.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
            assert_eq!(numbers, POSE.map(f64::from).to_vec());
            check_poses(&episode);
        } else {
            let length = usize::from(u16::from_be_bytes([first[4], first[5]]));
            let reported: Value = serde_json::from_slice(&first[6..4 + length]).expect("a comment in JSON");
            assert_eq!((reported["pose"][13].as_f64(), reported["wall_clock"].as_f64()), (Some(-1.5), Some(1.7e9)));
            assert!(
                !episode.channels.iter().any(|topic| topic == "/tf" || topic.ends_with("/pose")),
                "no topic of its own"
            );
            assert_eq!([&first[..2], &first[4 + length..]].concat(), picture(0), "the picture is as it was");
        }
    }
}

#[test]
fn a_picture_of_another_size_is_reported_with_the_fix() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &format!("{RIG}{}", camera_entry("cam", 0, port)).replace("width = 64", "width = 640"));
    let _server = Server::start(port, camera);
    let running = place.start(&RUN, "begin");
    wait_for(&running, "cam", "failed", 1);
    let reported = stop(running);
    let failed = reported.iter().find(|event| event["state"] == "failed").expect("failed");
    let detail = failed["detail"].as_str().expect("why");
    assert!(detail.contains("64x48") && detail.contains("[device.cam.lan]"), "{detail}");
}

#[test]
fn entries_on_the_network_are_simulated_like_any_other() {
    let place = Place::new();
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/registry/valid/lan.toml"));
    place.write("devices.toml", &text.expect("a registry"));
    place.write("sim.toml", "[[event]]\nat = \"1h\"\nunplug = \"lidar\"\n");
    let running = place.start(&[&["--sim", "sim.toml"], &RUN[..]].concat(), "begin");
    for device in ["cam_lan", "lidar", "lidar_asked", "gopro", "cam_behind_adapter", "phone", "phone_pose"] {
        wait_for(&running, device, "streaming", 1);
    }
    stop(running);
}
