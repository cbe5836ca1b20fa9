//! `rapid --foxglove`: a client that shares no code with the server gets the bytes that are recorded, and one that does
//! not read costs the recording nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant, SystemTime};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor};
use rustix::process::Signal;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest as _;
use tungstenite::{Error, Message, WebSocket};

use crate::support::lan::{Packets, RUN, free_ports, lidar_rig, stop};
use crate::support::{Episode, FrameMessage, LENIENT, MaskMessage, PATIENCE, Place, Running, logged, until};
use vbench::emu::lan::lidar;

/// A port that is free: the kernel chooses it.
pub(crate) const ANY: &str = "127.0.0.1:0";
/// A run that records until it is interrupted.
const RECORD: [&str; 8] = ["--sim", "--headless", "--json", "--record", "--out", "out", "--foxglove", ANY];
/// Of the binary messages of the protocol: samples, and the answers of services.
const MESSAGE_DATA: u8 = 1;
const SERVICE_ANSWER: u8 = 3;

/// A channel as the server advertises it.
struct Channel {
    topic: String,
    schema: String,
    /// `FileDescriptorSet`.
    descriptors: Vec<u8>,
    message: MessageDescriptor,
}

pub(crate) struct Received {
    channel: u32,
    pub(crate) log_time: u64,
    data: Vec<u8>,
}

/// A client by the protocol's description (<https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md>).
pub(crate) struct Client {
    socket: WebSocket<TcpStream>,
    /// The topic to which it subscribes; every one without it.
    only: Option<&'static str>,
    channels: BTreeMap<u32, Channel>,
    /// Names of the services and their numbers.
    services: BTreeMap<String, u32>,
    pub(crate) received: Vec<Received>,
    /// How many of them each channel has: asked after each message.
    counts: BTreeMap<u32, usize>,
    /// Answers of services, and texts of status messages.
    pub(crate) answers: Vec<Value>,
    pub(crate) is_open: bool,
}

impl Client {
    /// Connects, and subscribes to every topic that is advertised.
    pub(crate) fn connect(address: &str) -> Self {
        Self::connect_for(address, None)
    }

    /// Connects, and subscribes to this topic, or to every one.
    pub(crate) fn connect_for(address: &str, only: Option<&'static str>) -> Self {
        Self::try_connect(address, only).expect("a handshake")
    }

    /// The same; `None` if it is not let in.
    pub(crate) fn try_connect(address: &str, only: Option<&'static str>) -> Option<Self> {
        let mut request = format!("ws://{address}").into_client_request().expect("a request");
        request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().expect("a header"));
        let stream = TcpStream::connect(address).ok()?;
        let (socket, _) = tungstenite::client(request, stream).ok()?;
        socket.get_ref().set_read_timeout(Some(Duration::from_millis(100))).expect("a timeout");
        let (channels, services, received, counts, answers) = Default::default();
        Some(Self { socket, only, channels, services, received, counts, answers, is_open: true })
    }

    /// Takes what has come.
    pub(crate) fn read(&mut self) {
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => self.text(&serde_json::from_str(&text).expect("JSON")),
                Ok(Message::Binary(bytes)) => self.binary(&bytes),
                Ok(_) => {}
                Err(Error::Io(error)) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => return,
                Err(_) => {
                    self.is_open = false;
                    return;
                }
            }
        }
    }

    pub(crate) fn read_until(&mut self, what: &str, mut holds: impl FnMut(&Self) -> bool) {
        let begun = Instant::now();
        while !holds(self) {
            assert!(self.is_open && begun.elapsed() < PATIENCE, "{what}: not met in time: {:?}", self.of_topics());
            self.read_one();
        }
    }

    /// Reads until a sample is newer than this time: what is read first may have waited long.
    fn read_past(&mut self, time_ns: u128) {
        self.read_until("what is so new", |client| {
            client.received.last().is_some_and(|last| u128::from(last.log_time) > time_ns)
        });
    }

    /// At most one message: there is always a next one.
    pub(crate) fn read_one(&mut self) {
        match self.socket.read() {
            Ok(Message::Text(text)) => self.text(&serde_json::from_str(&text).expect("JSON")),
            Ok(Message::Binary(bytes)) => self.binary(&bytes),
            Err(Error::Io(error)) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Ok(_) => {}
            Err(_) => self.is_open = false,
        }
    }

    fn text(&mut self, message: &Value) {
        let list = |of: &str| message[of].as_array().expect("a list").clone();
        let number = |value: &Value| u32::try_from(value.as_u64().expect("a number")).expect("32 bits");
        match message["op"].as_str() {
            Some("advertise") => {
                for channel in list("channels") {
                    let text = |of: &str| channel[of].as_str().expect("a text").to_owned();
                    assert_eq!([text("encoding"), text("schemaEncoding")], ["protobuf", "protobuf"]);
                    let descriptors = BASE64_STANDARD.decode(text("schema")).expect("base 64");
                    let pool = DescriptorPool::decode(descriptors.as_slice()).expect("descriptors");
                    let schema = text("schemaName");
                    let message = pool.get_message_by_name(&schema).expect("the message of the schema");
                    let id = number(&channel["id"]);
                    if self.only.is_none_or(|only| channel["topic"] == only) {
                        let subscription = json!({ "id": id, "channelId": channel["id"] });
                        self.send(&json!({ "op": "subscribe", "subscriptions": [subscription] }));
                    }
                    self.channels.insert(id, Channel { topic: text("topic"), schema, descriptors, message });
                }
            }
            Some("advertiseServices") => {
                for service in list("services") {
                    let name = service["name"].as_str().expect("a name").to_owned();
                    self.services.insert(name, number(&service["id"]));
                }
            }
            Some("serviceCallFailure" | "status" | "parameterValues") => self.answers.push(message.clone()),
            _ => {}
        }
    }

    fn binary(&mut self, bytes: &[u8]) {
        let (kind, rest) = bytes.split_first().expect("a kind");
        let word = |at: usize| u32::from_le_bytes(rest[at..at + 4].try_into().expect("4 bytes"));
        match *kind {
            MESSAGE_DATA => {
                let (log_time, data) = (rest[4..12].try_into().expect("8 bytes"), rest[12..].to_vec());
                *self.counts.entry(word(0)).or_default() += 1;
                self.received.push(Received { channel: word(0), log_time: u64::from_le_bytes(log_time), data });
            }
            // Service, call, encoding, payload.
            SERVICE_ANSWER => {
                let payload = &rest[12 + word(8) as usize..];
                self.answers.push(serde_json::from_slice(payload).expect("JSON"));
            }
            _ => {}
        }
    }

    fn send(&mut self, message: &Value) {
        self.is_open &= self.socket.send(Message::text(message.to_string())).is_ok();
    }

    /// Sends a request about parameters; returns what they are then, by name.
    fn parameters(&mut self, request: &Value) -> BTreeMap<String, Value> {
        self.answers.clear();
        self.send(request);
        self.read_until("parameters", |client| !client.answers.is_empty());
        let answer = self.answers.remove(0);
        let list = answer["parameters"].as_array().unwrap_or_else(|| panic!("no parameters: {answer}"));
        list.iter().map(|one| (one["name"].as_str().expect("a name").to_owned(), one["value"].clone())).collect()
    }

    /// Calls a service; returns its answer, or why it failed.
    fn call(&mut self, service: &str) -> String {
        self.answers.clear();
        let id = self.services[service];
        let mut request = vec![2];
        request.extend([id, 7, 4].iter().flat_map(|word| word.to_le_bytes()));
        request.extend_from_slice(b"json{}");
        self.socket.send(Message::binary(request)).expect("it is sent");
        self.read_until(service, |client| !client.answers.is_empty());
        let answer = self.answers.remove(0);
        let text = answer.get("text").or_else(|| answer.get("message"));
        text.and_then(Value::as_str).unwrap_or_else(|| panic!("no text: {answer}")).to_owned()
    }

    pub(crate) fn count(&self, topic: &str) -> usize {
        self.counts.iter().filter(|(channel, _)| self.channels[channel].topic == topic).map(|(_, count)| count).sum()
    }

    /// How many messages of each topic it has.
    fn of_topics(&self) -> Vec<(&str, usize)> {
        self.counts.iter().map(|(channel, count)| (self.channels[channel].topic.as_str(), *count)).collect()
    }

    /// Asserts that what was received and belongs to an episode is what its file holds, except for what the file counts
    /// as dropped, and returns how many messages of each topic were compared.
    pub(crate) fn compare(&self, place: &Place, file: &str) -> BTreeMap<&str, usize> {
        let path = place.path(file);
        let episode = Episode::read(&path);
        let bytes = std::fs::read(&path).expect("the episode");
        let summary = mcap::Summary::read(&bytes).expect("a summary").expect("a finished file");
        let begin: u64 = episode.value("rapid", "begin_wall_ns").parse().expect("a number");
        let mut recorded: BTreeMap<(&str, u64), Vec<&[u8]>> = BTreeMap::new();
        let mut last: BTreeMap<&str, u64> = BTreeMap::new();
        for message in &episode.messages {
            recorded.entry((&message.topic, message.log_time)).or_default().push(&message.data);
            let last = last.entry(&message.topic).or_default();
            *last = message.log_time.max(*last);
        }
        for channel in self.channels.values() {
            let Some(file) = summary.channels.values().find(|other| other.topic == channel.topic) else { continue };
            let schema = file.schema.as_ref().expect("a schema");
            assert_eq!((&schema.name, &*schema.data), (&channel.schema, &channel.descriptors[..]), "{}", channel.topic);
        }
        let (mut counts, mut absent) = (BTreeMap::new(), BTreeMap::<&str, Vec<u64>>::new());
        for Received { channel, log_time, data } in &self.received {
            let Channel { topic, message, .. } = &self.channels[channel];
            let decoded = DynamicMessage::decode(message.clone(), &data[..]).expect("a message of the schema");
            assert_eq!(decoded.unknown_fields().count(), 0, "{topic}");
            if (begin..=last.get(topic.as_str()).copied().unwrap_or_default()).contains(log_time) {
                if let Some(all) = recorded.get(&(topic.as_str(), *log_time)) {
                    assert!(all.contains(&&data[..]), "{topic} at {log_time}: another message in the file");
                    *counts.entry(topic.as_str()).or_default() += 1;
                } else {
                    absent.entry(topic.as_str()).or_default().push(log_time - begin);
                }
            }
        }
        // On a busy machine the recorder may lose what a viewer gets: never without counting it.
        for (topic, absent) in absent {
            let key = if topic == "/rapid/mask" { "masks_dropped" } else { "dropped" };
            let counted: u64 = episode.value("rapid/summary", key).parse().expect("a number");
            assert!(
                absent.len() as u64 <= counted,
                "{topic}: the file counts {counted}, without those at {absent:?} ns"
            );
        }
        counts
    }
}

/// Where a run listens.
pub(crate) fn address(running: &Running) -> String {
    let reported = running.reported();
    let text = logged(&reported, "Foxglove: open connection ws://").first().copied().expect("an address");
    text.rsplit_once("ws://").expect("an address").1.to_owned()
}

pub(crate) fn start(place: &Place, options: &[&str]) -> Running {
    place.start(&[&RECORD[..], options].concat(), "\"event\":\"recording\"")
}

/// Ends a run that recorded one GOOD episode, and returns its file.
pub(crate) fn good(place: &Place, running: Running) -> String {
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, Some(0), "{output}{errors}");
    let episode = crate::support::events(&output).into_iter().find(|event| event["event"] == "episode");
    let episode = episode.expect("an episode");
    assert_eq!((&episode["verdict"], &episode["dropped"]), (&json!("GOOD"), &json!(0)), "{episode}");
    format!("out/{}", place.episodes("out")[0])
}

fn now_ns() -> u128 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).expect("after 1970").as_nanos()
}

#[test]
fn every_message_is_the_one_that_is_recorded() {
    let place = Place::lenient();
    let running = start(&place, &[]);
    let mut client = Client::connect(&address(&running));
    let has_enough = |client: &Client| {
        let most = [("/rapid/mask", 2000), ("/rapid/camera/wrist", 60), ("/rapid/serial/motor", 200)];
        most.iter().all(|(topic, count)| client.count(topic) > *count) && client.count("/rapid/event") > 0
    };
    client.read_until("messages of every topic", has_enough);
    // A line of the log.
    let marked = place.run(&["episode", "mark", "here"]);
    assert!(marked.status.success());
    let file = good(&place, running);
    client.read();
    assert!(!client.is_open, "the connection is closed with the run");
    let topics: Vec<_> = client.channels.values().map(|channel| channel.topic.as_str()).collect();
    for topic in ["/rapid/observation", "/rapid/log", "/rapid/camera/tactile"] {
        assert!(topics.contains(&topic), "{topics:?}");
    }
    assert!(!topics.contains(&"/action"), "there is no actuator: {topics:?}");
    let counts = client.compare(&place, &file);
    for (topic, least) in [
        ("/rapid/mask", 1500),
        ("/rapid/camera/wrist", 40),
        ("/rapid/serial/motor", 150),
        ("/rapid/frame", 40),
        ("/rapid/event", 1),
    ] {
        assert!(counts[topic] >= least, "{counts:?}");
    }
    assert!(client.count("/rapid/observation") > 20);
}

#[test]
fn poses_and_joints_are_derived_from_the_numbers_live_and_recorded() {
    let place = Place::new();
    let tracker = "[device.tracker]\nvid = \"1209\"\npid = \"0001\"\nserial = \"T\"\nnode = \"serial\"\nbit = 5\n\
        [device.tracker.tty]\nbaud = 115200\nparse = \"csv\"\nchannels = 7\n[device.tracker.pose]\nlayout = \"quaternion\"\n";
    let joints =
        "[device.motor_state.joints]\nnames = [\"gripper\"]\nquantities = [\"effort\", \"other\", \"position\"]\n";
    let camera = "[device.cam_wrist.calibration]\nintrinsics = [600, 0, 320, 0, 600, 240, 0, 0, 1]\n";
    place.write("devices.toml", &[include_str!("../../devices.toml"), joints, camera, tracker, LENIENT].concat());
    let running = start(&place, &[]);
    let mut client = Client::connect(&address(&running));
    let topics = ["/rapid/serial/motor/joints", "/rapid/serial/tracker/pose", "/tf"];
    client.read_until("derived messages", |client| topics.iter().all(|topic| client.count(topic) > 100));
    let file = good(&place, running);
    client.read();
    let counts = client.compare(&place, &file);
    assert!(topics.iter().all(|topic| counts[topic] > 50), "{counts:?}");
    // Each sample has its own, of the same time and number, and they are its numbers.
    let episode = Episode::read(&place.path(&file));
    let of = |topic: &str| episode.messages.iter().filter(|message| message.topic == topic).collect::<Vec<_>>();
    let decoded = |topic: &str, data: &[u8]| {
        let channel = client.channels.values().find(|channel| channel.topic == topic).expect("the channel");
        DynamicMessage::decode(channel.message.clone(), data).expect("a message of the schema")
    };
    let (numbers, states) = (of("/rapid/serial/motor"), of(topics[0]));
    assert_eq!(numbers.len(), states.len());
    for (numbers, states) in numbers.iter().zip(&states) {
        assert_eq!((numbers.log_time, numbers.sequence), (states.log_time, states.sequence));
        let values =
            decoded("/rapid/serial/motor", &numbers.data).get_field_by_name("values").expect("values").into_owned();
        let values: Vec<f64> =
            values.as_list().expect("a list").iter().filter_map(prost_reflect::Value::as_f64).collect();
        let joints = decoded(topics[0], &states.data).get_field_by_name("joints").expect("joints").into_owned();
        let joint = joints.as_list().expect("a list")[0].as_message().expect("a joint").clone();
        let of = |field: &str| joint.get_field_by_name(field).expect("a field").as_f64();
        assert_eq!((of("effort"), of("position")), (Some(values[0]), Some(values[2])));
        assert!(!joint.has_field_by_name("velocity"));
    }
    assert_eq!(of("/rapid/serial/tracker").len(), of(topics[1]).len());
    assert_eq!(of(topics[1]).len(), of(topics[2]).len());
    assert_eq!(of("/rapid/camera/wrist").len(), of("/rapid/camera/wrist/calibration").len());
    assert!(counts["/rapid/camera/wrist/calibration"] > 10, "{counts:?}");
    // They are not devices of their own.
    let report = place.run(&["inspect", "--json", &file]).stdout;
    let report: Value = serde_json::from_slice(&report).expect("JSON");
    assert_eq!(report["modalities"].as_array().map(Vec::len), Some(4), "{report}");
}

#[test]
fn depth_is_shown_as_it_is_recorded_and_observations_name_what_is_recorded() {
    const DEPTH: &str = "/rapid/camera/wrist/depth";
    const OBSERVATION: &str = "/rapid/observation";
    /// Bits and topics of what is plugged in. Bit 1 is not.
    const PLUGGED: [(u32, &str); 3] = [(0, "/rapid/camera/wrist"), (2, "/rapid/serial/motor"), (3, DEPTH)];
    let place = Place::new();
    let depth = "[device.cam_wrist.stream.depth]\nbit = 3\n[device.cam_wrist.stream.depth.camera]\nwidth = 96\n\
        height = 64\nfps = 30\nformat = \"Z16\"\ndepth_unit = \"100um\"\n";
    place.write("devices.toml", &[include_str!("../../devices.toml"), depth, LENIENT].concat());
    let devices = ["cam_wrist", "cam_wrist_depth", "motor_state"].map(|name| format!("[[device]]\nname = {name:?}\n"));
    place.write("play.toml", &devices.concat());
    let options = ["--sim", "play.toml", "--headless", "--json", "--record", "--out", "out", "--foxglove", ANY];
    let running = place.start(&options, "\"event\":\"recording\"");
    let mut client = Client::connect(&address(&running));
    client.read_until("messages", |client| [DEPTH, OBSERVATION].iter().all(|topic| client.count(topic) > 90));
    let file = good(&place, running);
    client.read();
    assert!(client.compare(&place, &file)[DEPTH] > 40);
    let (received, channels) = (&client.received, &client.channels);
    let of = |topic: &'static str| received.iter().filter(move |message| channels[&message.channel].topic == topic);
    for Received { channel, data, .. } in of(DEPTH) {
        let message = DynamicMessage::decode(client.channels[channel].message.clone(), &data[..]).expect("a picture");
        let encoding = message.get_field_by_name("encoding").expect("a field").into_owned();
        assert_eq!(encoding.as_str(), Some("16UC1"));
    }

    let episode = Episode::read(&place.path(&file));
    let begin: u64 = episode.value("rapid", "begin_wall_ns").parse().expect("a number");
    // When the samples of the file were captured, by topic and number, and until when it has all.
    let recorded: BTreeMap<(&str, u32), u64> =
        episode.messages.iter().map(|message| ((&*message.topic, message.sequence), message.log_time)).collect();
    let last_ones = PLUGGED.map(|(_, topic)| episode.topic(topic).map(|message| message.log_time).max());
    let complete = last_ones.into_iter().min().flatten().expect("samples of each");
    let masks: Vec<_> = episode.topic("/rapid/mask").collect();
    let (mut compared, mut last) = (BTreeMap::new(), None);
    for Received { log_time, data, .. } in of(OBSERVATION) {
        let observation = <FrameMessage as prost::Message>::decode(&data[..]).expect("an observation");
        assert!(last.replace(observation.index).is_none_or(|last| last < observation.index), "{last:?}");
        // Its samples may be older than the file, or newer.
        if !(begin + 500_000_000..=complete).contains(log_time) {
            continue;
        }
        let published = masks.partition_point(|mask| mask.log_time <= *log_time);
        let mask = masks[published.checked_sub(1).expect("a mask")].decode::<MaskMessage>();
        assert_eq!(observation.mask, mask.mask, "at {log_time}");
        assert_eq!(observation.modalities.len(), 4);
        for modality in &observation.modalities {
            let is_set = |bits: u64| bits & (1 << modality.bit) != 0;
            assert_eq!((modality.present, modality.plugged), (is_set(mask.mask), is_set(mask.plugged)), "{modality:?}");
            let topic = PLUGGED.iter().find(|(bit, _)| *bit == modality.bit).map(|(_, topic)| *topic);
            let Some((age, seq)) = modality.age_ns.zip(modality.seq) else {
                assert!(!modality.valid, "{modality:?} at {log_time}");
                continue;
            };
            let topic = topic.unwrap_or_else(|| panic!("{modality:?} is not plugged in"));
            let captured = recorded[&(topic, u32::try_from(seq).expect("few"))];
            assert_eq!(i128::from(captured), i128::from(*log_time) - i128::from(age), "{topic} {seq} at {log_time}");
            // The window of the registry.
            assert_eq!(modality.valid, age.unsigned_abs() <= 25_000_000, "{modality:?}");
            assert_eq!(modality.stale, !modality.valid, "{modality:?}");
            *compared.entry(topic).or_insert(0) += 1;
        }
    }
    assert!(PLUGGED.iter().all(|(_, topic)| compared.get(topic).is_some_and(|count| *count > 20)), "{compared:?}");
}

#[test]
fn points_of_a_lidar_are_shown_as_they_are_recorded() {
    const POINTS: &str = "/rapid/lan/lidar/points";
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &[lidar_rig(port).as_str(), LENIENT].concat());
    let mut running =
        place.start(&[&RUN[..], &["--record", "--out", "out", "--foxglove", ANY]].concat(), "\"event\":\"begin\"");
    running.wait_for("Foxglove: open connection");
    let mut client = Client::connect(&address(&running));
    let packets = Packets::send(port, |number| lidar::packet(number, 0).to_vec());
    client.read_until("points", |client| client.count(POINTS) > 200 && client.count("/rapid/lan/lidar") > 200);
    packets.end_after_a_hundred();
    stop(running);
    client.read();
    let counts = client.compare(&place, &format!("out/{}", place.episodes("out")[0]));
    assert!(counts[POINTS] > 100 && counts["/rapid/lan/lidar"] > 100, "{counts:?}");
    for Received { channel, data, .. } in &client.received {
        let Channel { topic, message, .. } = &client.channels[channel];
        if topic == POINTS {
            let cloud = DynamicMessage::decode(message.clone(), &data[..]).expect("points");
            let field = |name: &str| cloud.get_field_by_name(name).expect("a field").into_owned();
            let stride = field("point_stride").as_u32().expect("a number");
            let points = field("data").as_bytes().expect("bytes").len() / usize::try_from(stride).expect("small");
            assert!((380..=384).contains(&points), "{points}");
        }
    }
}

#[test]
fn where_the_sensors_of_the_mounted_modules_sit_is_recorded_and_shown() {
    let place = Place::new();
    let modules = "[module.straight]\nslot = \"top\"\ndevices = [\"cam_wrist\"]\n\
        [module.straight.transform.cam_wrist]\nposition = [0, 0, 0.1]\n\
        [module.angled]\nslot = \"top\"\ndevices = [\"cam_wrist\"]\n\
        [module.angled.transform.cam_wrist]\nparent = \"flange\"\nposition = [0, 0.5, 0.25]\nrotation = [0.6, 0, 0, 0.8]\n";
    place.write("devices.toml", &[include_str!("../../devices.toml"), modules, LENIENT].concat());
    let running = start(&place, &["--module", "angled"]);
    // A client that connects during the episode has them too, again and again.
    let mut client = Client::connect(&address(&running));
    client.read_until("transforms", |client| client.count("/tf") > 1 && client.count("/rapid/camera/wrist") > 30);
    let file = good(&place, running);
    client.read();
    assert!(client.compare(&place, &file)["/tf"] > 1);
    let episode = Episode::read(&place.path(&file));
    let of_places: Vec<_> = episode.messages.iter().filter(|message| message.topic == "/tf").collect();
    let [transform] = of_places[..] else { panic!("{}", of_places.len()) };
    assert_eq!(transform.log_time.to_string(), episode.value("rapid", "begin_wall_ns"));
    let channel = client.channels.values().find(|channel| channel.topic == "/tf").expect("the channel");
    let message = DynamicMessage::decode(channel.message.clone(), &transform.data[..]).expect("a transform");
    let text = |field: &str| message.get_field_by_name(field).expect("a field").as_str().expect("text").to_owned();
    assert_eq!([text("parent_frame_id"), text("child_frame_id")], ["flange", "cam_wrist"]);
    let number = |part: &str, field: &str| {
        let part = message.get_field_by_name(part).expect("a part").into_owned();
        part.as_message().expect("a message").get_field_by_name(field).expect("a field").as_f64().expect("a number")
    };
    for (part, field, expected) in [
        ("translation", "x", 0.0),
        ("translation", "y", 0.5),
        ("translation", "z", 0.25),
        ("rotation", "x", 0.6),
        ("rotation", "y", 0.0),
        ("rotation", "w", 0.8),
    ] {
        assert!((number(part, field) - expected).abs() < 1e-12, "{part}.{field}");
    }
}

#[test]
fn where_a_sensor_sat_in_an_earlier_episode_is_shown_no_more() {
    let place = Place::new();
    let modules = "[module.angled]\nslot = \"top\"\ndevices = [\"cam_wrist\"]\n[module.straight]\nslot = \"top\"\n\
        devices = [\"cam_wrist\"]\n[module.angled.transform.cam_wrist]\nposition = [0, 0.5, 0.25]\n";
    place.write("devices.toml", &[include_str!("../../devices.toml"), modules, LENIENT].concat());
    let running = start(&place, &["--module", "angled"]);
    let mut client = Client::connect(&address(&running));
    client.read_until("transforms", |client| client.count("/tf") > 1);
    assert!(place.run(&["session", "plan", "--module", "straight"]).status.success());
    assert!(place.run(&["episode", "next"]).status.success());
    // What was on its way until then may be of the first episode.
    let next = now_ns();
    client.read_past(next + 1_000_000_000);
    let shown = client.count("/tf");
    client.read_past(next + 4_000_000_000);
    assert_eq!(client.count("/tf"), shown, "the camera is not on that mount any more");
    running.signal(Signal::INT);
    let (_, output, errors) = running.end();
    let episodes = place.episodes("out");
    let [first, second] = episodes.as_slice() else { panic!("{output} {errors}") };
    let places = |file: &String| Episode::read(&place.path("out").join(file)).topic("/tf").count();
    assert_eq!((places(first), places(second)), (1, 0));
}

#[cfg(feature = "policy")]
#[test]
fn actions_of_a_policy_are_shown_as_they_are_recorded() {
    let place = Place::new();
    let options = ["--sim", "task", "--infer", "--json", "--record", "--out", "out", "--foxglove", ANY];
    let running = place.start(&options, "\"event\":\"recording\"");
    let mut client = Client::connect(&address(&running));
    client.read_until("actions", |client| client.count("/action") > 20);
    running.signal(Signal::INT);
    while client.is_open {
        client.read_one();
    }
    let (code, output, errors) = running.end();
    assert!(matches!(code, Some(0 | 4)), "{code:?}: {output}{errors}");
    let counts = client.compare(&place, &format!("out/{}", place.episodes("out")[0]));
    assert!(counts["/action"] > 10, "{counts:?}");
}

#[test]
fn an_added_entry_is_shown_from_then_on() {
    const SCENARIO: &str = "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"spare\"\nlike = \"tactile_tip\"\n\
                            serial = \"SPARE1\"\nport = \"1-4\"\nproduct = \"Spare Camera\"\n";
    let place = Place::lenient();
    place.write("scenario.toml", SCENARIO);
    let options = ["--sim", "scenario.toml", "--headless", "--json", "--record", "--out", "out", "--foxglove", ANY];
    let running = place.start(&options, "\"event\":\"recording\"");
    let mut client = Client::connect(&address(&running));
    client.read_until("pictures", |client| client.count("/rapid/camera/wrist") > 5);
    let add = ["register", "--sim", "scenario.toml", "--serial", "SPARE1", "--name", "spare_cam", "--yes"];
    assert!(place.run(&add).status.success() && place.run(&["reload"]).status.success());
    client.read_until("pictures of the added camera", |client| client.count("/rapid/camera/spare_cam") > 5);
    // A second of the wrist's: an episode of less than half a one is too short to be GOOD.
    client.read_until("an episode that is long enough", |client| client.count("/rapid/camera/wrist") > 30);
    let file = good(&place, running);
    client.read();
    let counts = client.compare(&place, &file);
    // The log reports the entry.
    assert!(counts["/rapid/camera/wrist"] > 5 && counts["/rapid/log"] > 0, "{counts:?}");
}

/// 10 MB of pictures a second: in some seconds more than the socket takes.
const LARGE: &str = "[[device]]\nname = \"cam_wrist\"\nbytes = \"280kB\"\n[[device]]\nname = \"tactile_tip\"\nbytes = \"70kB\"\n\
                     [[device]]\nname = \"motor_state\"\n";

#[test]
fn a_client_that_does_not_read_costs_the_recording_nothing() {
    let place = Place::lenient();
    place.write("scenario.toml", LARGE);
    let options = ["--sim", "scenario.toml", "--headless", "--json", "--record", "--out", "out", "--foxglove", ANY];
    let running = place.start(&options, "\"event\":\"recording\"");
    let mut client = Client::connect(&address(&running));
    client.read_until("messages", |client| client.count("/rapid/camera/wrist") > 5 && client.count("/rapid/mask") > 50);
    // It does not read until far more was left out for it than there are pictures: masks, too. The server's thread is not urgent:
    // how long that takes depends on the machine.
    let left_out = || {
        let log = String::from_utf8_lossy(&place.run(&["logs"]).stdout).into_owned();
        let reports = log.lines().filter_map(|line| {
            let count = line.split_once(" reads slowly: ")?.1.split_once(" messages left out for newer ones")?.0;
            let digits: String = count.chars().filter(char::is_ascii_digit).collect();
            Some(digits.parse::<u64>().expect("a number"))
        });
        reports.sum::<u64>()
    };
    until("two thousand messages are left out", || left_out() > 2000);
    // What waits for it is bounded, and the newest is in it; then it continues.
    client.read_past(now_ns());
    let resumed = client.received.len();
    client.read_until("more", |client| client.received.len() > resumed + 100);
    let file = good(&place, running);
    client.compare(&place, &file);
    let masks = client.received.iter().filter(|message| client.channels[&message.channel].topic == "/rapid/mask");
    let times: BTreeSet<_> = masks.map(|message| message.log_time).collect();
    // The mask in the file has no hole. How even its rhythm is, `make bench` measures.
    let episode = Episode::read(&place.path(&file));
    let masks: Vec<_> = episode.topic("/rapid/mask").collect();
    assert!(masks.len() > 1000, "{}", masks.len());
    assert!(masks.windows(2).all(|pair| pair[1].sequence == pair[0].sequence + 1));
    let (first, last) = (times.first().expect("a mask"), times.last().expect("a mask"));
    let missing =
        masks.iter().filter(|mask| (first..last).contains(&&mask.log_time) && !times.contains(&mask.log_time));
    let missing = missing.count();
    assert!(missing > 500, "{missing} masks were left out");
}

#[test]
fn a_client_that_reads_again_gets_the_newest_picture() {
    const CAMERA: &str = "/rapid/camera/wrist";
    let place = Place::lenient();
    place.write("scenario.toml", LARGE);
    let options = ["--sim", "scenario.toml", "--headless", "--json", "--record", "--out", "out", "--foxglove", ANY];
    let running = place.start(&options, "\"event\":\"recording\"");
    // To nothing else: no other messages push pictures out of what waits for it.
    let mut slow = Client::connect_for(&address(&running), Some(CAMERA));
    slow.read_until("pictures", |client| client.received.len() > 5);
    // It reads nothing, while another client gets four seconds of pictures.
    let mut other = Client::connect_for(&address(&running), Some(CAMERA));
    other.read_until("pictures of four seconds", |client| client.received.len() > 120);
    let newest = other.received.last().expect("a picture").log_time;
    slow.read_until("a picture as new", |client| client.received.last().is_some_and(|last| last.log_time >= newest));
    // First come those that were on their way when it stopped: the kernel holds them. Then there is a hole, and behind it is
    // what waited for the client: a queue would have many older pictures.
    let times: Vec<_> = slow.received.iter().map(|picture| picture.log_time).collect();
    let holes = times.windows(2).map(|pair| pair[1] - pair[0]).enumerate();
    let (before, hole) = holes.max_by_key(|(_, hole)| *hole).expect("two pictures");
    assert!(hole > 1_000_000_000, "it was never stuck: {hole} ns between two pictures");
    let older = times[before + 1..].iter().filter(|time| **time < newest).count();
    assert!(older <= 2, "{older} pictures were older than the newest one, of {} behind the hole", times.len() - before);
    let file = good(&place, running);
    assert!(slow.compare(&place, &file)[CAMERA] > 5 && other.compare(&place, &file)[CAMERA] > 100);
}

#[test]
fn a_ninth_client_gets_nothing_and_why() {
    let place = Place::lenient();
    let running = start(&place, &[]);
    let address = address(&running);
    let mut clients: Vec<_> = (0..8).map(|_| Client::connect(&address)).collect();
    for client in &mut clients {
        client.read_until("masks", |client| client.count("/rapid/mask") > 10);
    }
    let mut ninth = Client::connect(&address);
    ninth.read_until("the reason", |client| !client.answers.is_empty());
    let reason = ninth.answers[0]["message"].as_str().expect("a text");
    assert!(reason.contains("8 clients at a time"), "{reason}");
    // The others are served as before, and it gets nothing meanwhile.
    let before = clients[0].received.len();
    clients[0].read_until("more", |client| client.received.len() > before + 100);
    ninth.read();
    assert!(ninth.received.is_empty(), "{}", ninth.received.len());
    drop(clients);
    // One that comes before their places are free is answered so, and gets nothing.
    until("a place is free", || {
        let mut next = Client::connect(&address);
        next.read_until("masks or the reason", |client| client.count("/rapid/mask") > 0 || !client.answers.is_empty());
        next.count("/rapid/mask") > 0
    });
    good(&place, running);
}

#[test]
fn a_port_in_use_is_an_error_of_the_start() {
    let place = Place::new();
    let taken = TcpListener::bind(ANY).expect("a port");
    let address = taken.local_addr().expect("an address").to_string();
    let options = ["--sim", "--headless", "--record", "--duration", "5s", "--out", "out", "--foxglove", &address];
    let output = place.run(&options);
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{errors}");
    let expected = format!("error: --foxglove {address}: Address already in use");
    // On a machine that gives no real-time priority a warning stands before it.
    let error = errors.lines().find(|line| !line.contains("  warn  ")).unwrap_or_default();
    assert!(error.starts_with(&expected) && error.contains("name another port"), "{errors}");
    assert!(place.episodes("out").is_empty() && place.shared_memory().is_empty(), "{:?}", place.shared_memory());
}

#[test]
fn an_address_of_the_network_is_served_and_warned_of() {
    const WARNING: &str = "can be reached from other machines";
    let place = Place::lenient();
    for (at, control, is_warned) in [("0.0.0.0:0", false, true), ("0.0.0.0:0", true, true), (ANY, true, false)] {
        let mut options = vec!["--sim", "--headless", "--json", "--out", "out", "--foxglove", at];
        options.extend(control.then_some("--foxglove-control"));
        let mut running = place.start(&options, "Foxglove: open connection");
        if is_warned {
            running.wait_for(WARNING);
        }
        let address = address(&running);
        let (host, port) = address.rsplit_once(':').expect("a port");
        assert_eq!(Some(host), at.strip_suffix(":0"));
        let mut client = Client::connect(&format!("127.0.0.1:{port}"));
        client.read_until("masks", |client| client.count("/rapid/mask") > 10);
        let reported = running.reported();
        let warnings = logged(&reported, WARNING);
        assert_eq!(warnings.len(), usize::from(is_warned), "{at}: {reported:?}");
        for warning in warnings {
            assert!(warning.contains(&address) && warning.contains("there is no password"), "{warning}");
            assert_eq!(warning.contains("arms motors"), control, "{warning}");
        }
        let levels = reported.iter().filter(|event| event["text"].as_str().is_some_and(|text| text.contains(WARNING)));
        assert!(levels.map(|event| &event["level"]).all(|level| level == "warn"), "{reported:?}");
        running.signal(Signal::INT);
        assert_eq!(running.end().0, Some(0));
    }
}

#[test]
fn the_end_of_its_thread_costs_no_episode() {
    let place = Place::lenient();
    let order = place.path("now");
    let mut command = place.command(&RECORD);
    command.env("RAPID_FAULT", format!("foxglove:{}", order.display()));
    let mut running = place.start_as(command, "\"event\":\"recording\"");
    let mut client = Client::connect(&address(&running));
    // An episode of less than half a second is BAD.
    client.read_until("a second", |client| client.count("/rapid/mask") > 500);
    std::fs::write(order, "").expect("order");
    running.wait_for("Foxglove: its thread panicked; the run continues without it");
    until("the connection is closed", || {
        client.read();
        !client.is_open
    });
    good(&place, running);
}

#[test]
fn a_client_controls_a_run_only_if_that_was_allowed() {
    let place = Place::lenient();
    let options = ["--sim", "--headless", "--json", "--out", "out", "--foxglove", ANY];
    let running = place.start(&options, "Foxglove: open connection");
    let mut client = Client::connect(&address(&running));
    client.read_until("masks", |client| client.count("/rapid/mask") > 100);
    assert!(client.services.is_empty(), "{:?}", client.services);
    running.signal(Signal::INT);
    running.end();

    let running = place.start(&[&options[..], &["--foxglove-control"]].concat(), "Foxglove: open connection");
    let mut client = Client::connect(&address(&running));
    client.read_until("the services", |client| client.services.len() == 4);
    client.read_until("pictures", |client| client.count("/rapid/camera/wrist") > 0);
    let all = client.parameters(&json!({ "op": "getParameters", "id": "1", "parameterNames": [] }));
    assert_eq!((&all["task"], &all["tags"]), (&json!("episode"), &json!({})));
    let wanted = json!([{ "name": "task", "value": "pour tea" }, { "name": "tags", "value": { "finger": "soft" } }]);
    let set = client.parameters(&json!({ "op": "setParameters", "id": "2", "parameters": wanted }));
    assert_eq!((&set["task"], &set["tags"]), (&json!("pour tea"), &json!({ "finger": "soft" })));
    let begun = client.call("/rapid/start");
    assert!(begun.contains("pour-tea_001.mcap"), "{begun}");
    // An episode of less than half a second is BAD.
    client.read_past(now_ns() + 1_000_000_000);
    let ended = client.call("/rapid/stop");
    assert!(ended.contains("001.mcap"), "{ended}");
    assert_eq!(client.call("/rapid/arm"), "no actuator is plugged in: plug it in, then arm it");
    assert_eq!(client.call("/rapid/disarm"), "disarmed; no actuator is plugged in");
    good(&place, running);
}
