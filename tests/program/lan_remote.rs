//! Sensors of another computer: a server in the place of rapid-remote, in front of the real binary.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use rapid_core::remote::{Head, Kind, requested};
use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;

use crate::support::lan::{HEIGHT, RIG, RUN, Server, WIDTH, free_ports, life, life_of, picture, stop, wait_for};
use crate::support::{self, Episode, EventMessage, Place, until};

/// The clock there is 1000 s ahead.
const OFFSET: i64 = 1_000_000_000_000;

/// The device that a request asks for.
fn asked(stream: &mut TcpStream) -> Option<String> {
    let mut line = Vec::new();
    while line.last() != Some(&b'\n') {
        let mut byte = [0];
        stream.read_exact(&mut byte).ok()?;
        line.push(byte[0]);
    }
    let (host, device) = requested(line.trim_ascii_end())?;
    (host == "robot-b").then(|| device.to_owned())
}

/// Sends `cam_wrist` of robot-b at 50 Hz, with a clock that is known to `uncertainty_ns`, and refuses any other.
fn remote(uncertainty_ns: u64) -> impl Fn(TcpStream) + Send + Sync {
    move |mut stream| {
        if asked(&mut stream).as_deref() != Some("cam_wrist") {
            let head = Head { kind: Kind::Refused, length: 6, ..Head::default() };
            let _ = stream.write_all(&[&head.bytes()[..], b"absent"].concat());
            return;
        }
        let mut send = |bytes: &[u8]| stream.write_all(bytes).is_ok();
        for number in 0_u32.. {
            let picture = picture(number);
            let head = Head {
                kind: Kind::Sample,
                length: u32::try_from(picture.len()).expect("small"),
                encoding: Some(Encoding::Mjpeg),
                // Each second one is lost on the way.
                seq: 2 * u64::from(number),
                capture_ns: Stamp::now().0,
                offset_ns: OFFSET,
                uncertainty_ns,
                width: WIDTH,
                height: HEIGHT,
                ..Head::default()
            };
            if !(send(&Head::default().bytes()) && send(&head.bytes()) && send(&picture)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

fn entry(name: &str, bit: u32, device: &str, port: u16) -> String {
    format!(
        "[device.{name}]\nnode = \"lan\"\nbit = {bit}\n[device.{name}.lan]\nprotocol = \"remote\"\nhost = \"robot-b\"\n\
         device = \"{device}\"\nport = {port}\nwidth = {WIDTH}\nheight = {HEIGHT}\nfps = 50\n"
    )
}

#[test]
fn a_sensor_of_another_computer_comes_goes_and_is_recorded_with_its_clock() {
    let (place, [port]) = (Place::new(), free_ports());
    let (cam, away) = (entry("cam", 0, "cam_wrist", port), entry("away", 1, "other", port));
    place.write("devices.toml", &format!("{RIG}{cam}{away}"));
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    let first = Server::start(port, remote(40_000_000));
    wait_for(&running, "cam", "streaming", 1);
    drop(first);
    wait_for(&running, "cam", "absent", 1);
    let _second = Server::start(port, remote(1_000_000));
    wait_for(&running, "cam", "streaming", 2);
    // Half a second of samples.
    until("two reports of the second clock", || {
        running.reported().iter().filter(|event| event["uncertainty_ns"] == 1_000_000).count() >= 2
    });
    assert_eq!(life(&running, "away"), Vec::<String>::new(), "what is refused is not there");
    let reported = stop(running);
    let clocks: Vec<_> = reported.iter().filter(|event| event["event"] == "clock").collect();
    assert!(clocks.len() >= 2 && clocks.iter().all(|clock| clock["offset_ns"] == OFFSET), "{clocks:?}");
    // The bit fell with the connection.
    let gone = reported.iter().find(|event| event["state"] == "absent").expect("gone");
    assert_eq!(gone["mask"], "0x00", "{:?}", life_of(&reported, "cam"));

    let files = place.files("out");
    let episode = Episode::read(&place.path("out").join(&files[0]));
    assert_eq!(episode.mask_edges().iter().map(|(_, mask)| *mask).collect::<Vec<_>>(), [0, 1, 0, 1]);
    let pictures: Vec<Vec<u8>> = episode.topic("/rapid/lan/cam").map(support::Message::payload).collect();
    assert_eq!(pictures[0], picture(0), "the picture is as it was sent");
    let recorded: Vec<EventMessage> = episode.topic("/rapid/event").map(support::Message::decode).collect();
    let recorded: Vec<_> = recorded.iter().filter(|event| event.json.contains("\"event\":\"clock\"")).collect();
    assert_eq!(recorded.len(), clocks.len());
    assert!(recorded[0].json.contains("\"uncertainty_ns\":40000000"), "{}", recorded[0].json);

    // The recorder and a reader of the file agree.
    let reason = "cam: capture times uncertain by ±40 ms (limit 12 ms)";
    let ended = reported.iter().find(|event| event["event"] == "episode").expect("an episode");
    assert!(ended["reasons"].as_array().expect("reasons").contains(&reason.into()), "{ended}");
    let inspected = place.run(&["inspect", "--json", &format!("out/{}", files[0])]);
    let inspected: serde_json::Value = serde_json::from_slice(&inspected.stdout).expect("JSON");
    assert!(inspected["reasons"].as_array().expect("reasons").contains(&reason.into()), "{inspected}");
    let quality = &inspected["modalities"][0]["quality"];
    assert_eq!(quality["clock_uncertainty"], 40.0, "{quality}");
    let numbers: Vec<u32> = episode.topic("/rapid/lan/cam").map(|message| message.sequence).collect();
    let missing = numbers[numbers.len() - 1] - numbers[0] + 1 - u32::try_from(numbers.len()).expect("few");
    assert!(missing > 0);
    // The first one after the end was preceded by another that is lost.
    let lost = quality["lost"].as_u64().expect("a number");
    assert!((missing..=missing + 1).contains(&u32::try_from(lost).expect("few")), "{missing} missing: {quality}");
}

#[test]
fn a_sensor_in_another_format_fails_with_the_line_to_write() {
    let (place, [port]) = (Place::new(), free_ports());
    let cam = entry("cam", 0, "cam_wrist", port).replace("fps = 50", "fps = 50\nformat = \"GREY\"");
    place.write("devices.toml", &format!("{RIG}{cam}"));
    let running = place.start(&RUN, "begin");
    let _server = Server::start(port, remote(0));
    wait_for(&running, "cam", "failed", 1);
    let reported = stop(running);
    let failed = reported.iter().find(|event| event["state"] == "failed").expect("failed");
    let detail = failed["detail"].as_str().expect("text");
    assert!(detail.contains("write kind = \"image\" and format = \"MJPG\" in [device.cam.lan]"), "{detail}");
}

/// Sends two numbers at 50 Hz: of `fine` both finite, of any other device one of them, in each `every`th sample, that is
/// not.
fn numbers(mut stream: TcpStream) {
    let Some(device) = asked(&mut stream) else { return };
    let (bad, every) = match device.as_str() {
        "nan" => (f64::NAN, 1),
        "inf" => (f64::NEG_INFINITY, 1),
        "some" => (f64::NAN, 2),
        _ => (0.0, 1),
    };
    for number in 0_u32.. {
        let second = if number.is_multiple_of(every) { bad } else { 0.5 };
        let payload = [f64::from(number).to_le_bytes(), second.to_le_bytes()].concat();
        let head = Head {
            kind: Kind::Sample,
            length: 16,
            encoding: Some(Encoding::F64),
            seq: number.into(),
            capture_ns: Stamp::now().0,
            ..Head::default()
        };
        let sent =
            [&Head::default().bytes()[..], &head.bytes(), &payload].iter().all(|part| stream.write_all(part).is_ok());
        if !sent {
            return;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn numbers_that_are_not_finite_are_damaged_and_in_no_frame() {
    let (place, [port]) = (Place::new(), free_ports());
    let names = ["fine", "nan", "inf", "some"];
    let entry = |(bit, name): (usize, &str)| {
        format!(
            "[device.{name}]\nnode = \"lan\"\nbit = {bit}\n[device.{name}.lan]\nprotocol = \"remote\"\n\
             host = \"robot-b\"\ndevice = \"{name}\"\nport = {port}\nkind = \"scalars\"\nchannels = 2\n"
        )
    };
    let entries: String = names.into_iter().enumerate().map(entry).collect();
    place.write("devices.toml", &format!("{RIG}{entries}"));
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    let _server = Server::start(port, numbers);
    for name in names {
        wait_for(&running, name, "streaming", 1);
    }
    until("a second of samples", || running.reported().iter().filter(|event| event["event"] == "clock").count() >= 12);
    let reported = stop(running);
    let ended = reported.iter().find(|event| event["event"] == "episode").expect("an episode");
    let inspected = place.run(&["inspect", "--json", &format!("out/{}", place.files("out")[0])]);
    let inspected: serde_json::Value = serde_json::from_slice(&inspected.stdout).expect("JSON");
    assert_eq!(ended["reasons"], inspected["reasons"], "the recorder and a reader of the file agree");
    let reasons = ended["reasons"].to_string();
    for (modality, name) in inspected["modalities"].as_array().expect("modalities").iter().zip(names) {
        let number = |key: &str| modality["quality"][key].as_u64().expect("a number");
        let (samples, damaged, valid) = (number("samples"), number("damaged"), number("frames_valid"));
        assert!(samples > 30, "{modality}");
        let expected = match name {
            "fine" => 0..=0,
            // The first one recorded may be of either kind.
            "some" => samples / 2..=samples.div_ceil(2),
            _ => samples..=samples,
        };
        assert!(expected.contains(&damaged), "{damaged} of {samples}: {modality}");
        assert_eq!(valid > 0, damaged < samples, "{modality}");
        assert_eq!(
            reasons.contains(&format!("{name}: {damaged} of {samples} samples damaged")),
            damaged > 0,
            "{reasons}"
        );
    }
}
