//! Whole episodes from a scripted source, read back with the `mcap` crate.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use prost_reflect::{DescriptorPool, DynamicMessage, ReflectMessage, Value};

use super::episode::EpisodePath;
use super::session::{Beginning, Hole, MaskHistory, Session};
use super::*;
use crate::bus::TopicId;
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::registry::{
    CameraSpec, DeviceSpec, Framing, IdentitySpec, NodeSpec, Parse, PixelFormat, Registry, RigSpec, SerialSpec,
    WhenStale,
};
use crate::sample::{Encoding, FLAG_ERROR, SampleHeader};
use crate::status::{Board, Level, What};
use crate::time::{Stamp, WallClock};

const MS: u64 = 1_000_000;
const CAM: u8 = 0;
const TOF: u8 = 1;
const NEVER: u8 = 5;
const RAW: u8 = 7;

type Sample = (TopicId, SampleHeader, Vec<u8>);

/// A source that hands over what a test puts in.
#[derive(Clone, Default)]
struct Script(Arc<(Mutex<Queue>, Condvar)>);

#[derive(Default)]
struct Queue {
    samples: VecDeque<Sample>,
    panics: bool,
}

impl Script {
    fn put(&self, sample: Sample) {
        self.0.0.lock().unwrap().samples.push_back(sample);
        self.0.1.notify_all();
    }

    /// Returns once everything put in has been handed over: whatever is asked of the recorder from
    /// now on comes after it.
    async fn taken(&self) {
        while !self.0.0.lock().unwrap().samples.is_empty() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }

    fn panic(&self) {
        self.0.0.lock().unwrap().panics = true;
        self.0.1.notify_all();
    }
}

impl Source for Script {
    fn wait(&mut self, timeout: Duration) -> Result<(), String> {
        let queue = self.0.0.lock().unwrap();
        drop(self.0.1.wait_timeout_while(queue, timeout, |queue| queue.samples.is_empty() && !queue.panics));
        Ok(())
    }

    fn drain(&mut self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String> {
        let (samples, panics) = {
            let mut queue = self.0.0.lock().unwrap();
            (std::mem::take(&mut queue.samples), queue.panics)
        };
        assert!(!panics, "scripted panic");
        for (topic, header, payload) in &samples {
            take(*topic, header, payload);
        }
        Ok(())
    }
}

fn id(bit: u8) -> ModalityId {
    ModalityId::new(bit).unwrap()
}

fn device(bit: u8, name: &str, node: NodeSpec) -> DeviceSpec {
    DeviceSpec {
        name: name.to_owned(),
        id: id(bit),
        identity: IdentitySpec { vid: 1, pid: bit.into(), serial: None, port: None },
        node,
        topic: format!("/rapid/{name}"),
        mount: None,
        stall_after: Duration::from_millis(500),
        max_bytes: 1 << 16,
        depth: 64,
        when_stale: WhenStale::Hold,
    }
}

fn camera(format: PixelFormat) -> NodeSpec {
    NodeSpec::Camera(CameraSpec { width: 4, height: 2, fps: 30, format, controls: Vec::new() })
}

pub(super) fn registry() -> Registry {
    let serial = SerialSpec { baud: 115_200, framing: Framing::Line, parse: Parse::Csv, channels: 2 };
    Registry {
        rig: RigSpec {
            name: "bench".to_owned(),
            observation_hz: 30.0,
            sync_window: Duration::from_millis(25),
            cooldown: Duration::from_secs(2),
            memory_budget: 1 << 29,
        },
        devices: vec![
            device(CAM, "cam_wrist", camera(PixelFormat::Mjpg)),
            device(TOF, "tof", NodeSpec::Serial(serial)),
            device(NEVER, "never", camera(PixelFormat::Yuyv)),
            device(RAW, "raw", camera(PixelFormat::Grey)),
        ],
        path: None,
        text: "[rig]\nname = \"bench\"\n".to_owned(),
    }
}

pub(super) struct Bench {
    pub(super) folder: tempfile::TempDir,
    board: Arc<Board>,
    script: Script,
    recorder: Recorder,
}

impl Bench {
    pub(super) fn new() -> Self {
        Self::with_sink(|file| Box::new(file))
    }

    fn with_sink(sink: impl FnMut(File) -> Box<dyn Sink> + Send + 'static) -> Self {
        let registry = Arc::new(registry());
        let board = Arc::new(Board::new(&registry));
        let script = Script::default();
        let config = RecorderConfig { sink: Box::new(sink), ..RecorderConfig::new(registry, Arc::clone(&board)) };
        let recorder = Recorder::spawn(script.clone(), config).unwrap();
        Self { folder: tempfile::tempdir().unwrap(), board, script, recorder }
    }

    fn request(&self, duration: Option<Duration>) -> EpisodeRequest {
        EpisodeRequest {
            out: self.folder.path().join("out"),
            task: "place block".to_owned(),
            tags: vec![("finger".to_owned(), "soft".to_owned())],
            duration,
        }
    }

    fn sample(&self, bit: u8, epoch: u32, seq: u64, capture: u64, flags: u32) {
        self.sample_after(0, bit, epoch, seq, capture, flags);
    }

    /// A sample of a device that says it lost `lost` ones so far.
    fn sample_after(&self, lost: u64, bit: u8, epoch: u32, seq: u64, capture: u64, flags: u32) {
        let (encoding, payload) = match bit {
            CAM => (Encoding::Mjpeg, seq.to_le_bytes().repeat(100)),
            TOF => (Encoding::F64, [seq as f64, 0.5].iter().flat_map(|v| v.to_le_bytes()).collect()),
            _ => (Encoding::Grey, vec![seq.to_le_bytes()[0]; 8]),
        };
        let header = SampleHeader {
            seq,
            lost,
            capture_ns: capture,
            recv_ns: capture + 5 * MS,
            id: bit.into(),
            epoch,
            encoding: encoding as u32,
            flags,
            width: 4,
            height: 2,
        };
        self.script.put((TopicId::Modality(id(bit)), header, payload));
    }

    fn mask(&self, mask: u64, sequence: u64, capture: u64) {
        let payload = [mask, sequence].iter().flat_map(|v| v.to_le_bytes()).collect();
        let header = SampleHeader {
            seq: sequence,
            capture_ns: capture,
            recv_ns: capture,
            encoding: Encoding::Mask as u32,
            ..SampleHeader::default()
        };
        self.script.put((TopicId::Mask, header, payload));
    }

    /// One second of a rig, laid out from `t0` on: the camera is away in the middle, the
    /// `tof` loses seven samples itself and one of its is lost on the way, `raw` sends one damaged frame and has no bit in
    /// the mask at first.
    ///
    /// Returns the file's name and `t0`, which lies a little after the beginning of the episode.
    pub(super) async fn one_second(&self) -> (PathBuf, Stamp) {
        self.mask(0b11, 1, Stamp::now().0);
        self.script.taken().await;
        let finished = self.recorder.start(self.request(Some(Duration::from_secs(1)))).await.unwrap();
        let attach = What::Attach {
            device: "raw".to_owned(),
            bit: id(RAW),
            node: "/dev/video7".to_owned(),
            port: "1-2".to_owned(),
            serial: Some("S7".to_owned()),
        };
        self.board.announce(attach);
        self.board.announce(What::Log { level: Level::Info, text: "hello".to_owned() });
        let t0 = Stamp::now().0;
        for n in 0..500 {
            let at = t0 + n * 2 * MS;
            let cam = u64::from(!(300..600).contains(&(n * 2)));
            let raw = u64::from(n >= 100) << RAW;
            self.mask(cam | 0b10 | raw, n + 2, at);
        }
        for n in 0..33_u64 {
            let (at, epoch) = (n * 30, if n < 15 { 1 } else { 2 });
            if !(300..600).contains(&at) {
                self.sample(CAM, epoch, if n < 15 { n } else { n - 10 }, t0 + at * MS, 0);
            }
        }
        let mut seq = 100;
        for n in 0..100 {
            seq += if n == 50 { 8 } else { 1 };
            if n != 20 {
                self.sample_after(if n < 50 { 0 } else { 7 }, TOF, 1, seq, t0 + n * 10 * MS, 0);
            }
        }
        self.sample(RAW, 1, 0, t0 + 230 * MS, 0);
        self.sample(RAW, 1, 1, t0 + 400 * MS, FLAG_ERROR);
        (finished, Stamp(t0))
    }

    /// Waits until a file has its final name.
    pub(super) async fn until_file(&self, file: &Path) {
        while !file.exists() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    async fn until_closed(&self, events: &mut tokio::sync::broadcast::Receiver<crate::status::Event>) -> What {
        loop {
            let event = events.recv().await.unwrap();
            if matches!(event.what, What::Episode { .. }) {
                return event.what;
            }
        }
    }
}

/// A file as the `mcap` crate reads it, each message decoded by the descriptor beside it.
struct Read {
    summary: mcap::Summary,
    messages: Vec<(String, u32, u64, u64, DynamicMessage)>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    attachments: BTreeMap<String, Vec<u8>>,
}

fn read(path: &Path) -> Read {
    let bytes = std::fs::read(path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut pools = BTreeMap::new();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(|message| {
        let message = message.unwrap();
        let schema = message.channel.schema.clone().unwrap();
        assert_eq!((schema.encoding.as_str(), message.channel.message_encoding.as_str()), ("protobuf", "protobuf"));
        let pool = pools.entry(schema.id).or_insert_with(|| DescriptorPool::decode(schema.data.as_ref()).unwrap());
        let descriptor = pool.get_message_by_name(&schema.name).unwrap();
        let decoded = DynamicMessage::decode(descriptor, message.data.as_ref()).unwrap();
        assert_eq!(wall(&decoded), message.log_time, "{}", message.channel.topic);
        (message.channel.topic.clone(), message.sequence, message.log_time, message.publish_time, decoded)
    });
    let messages = messages.collect();
    let mut metadata = BTreeMap::new();
    let mut attachments = BTreeMap::new();
    for record in mcap::read::LinearReader::new(&bytes).unwrap() {
        match record.unwrap() {
            mcap::records::Record::Metadata(m) => assert!(metadata.insert(m.name, m.metadata).is_none()),
            mcap::records::Record::Attachment { header, data, .. } => {
                attachments.insert(header.name, data.into_owned());
            }
            _ => {}
        }
    }
    Read { summary, messages, metadata, attachments }
}

impl Read {
    fn on<'a>(&'a self, topic: &'a str) -> impl Iterator<Item = &'a (String, u32, u64, u64, DynamicMessage)> {
        self.messages.iter().filter(move |message| message.0 == topic)
    }
}

fn number(message: &DynamicMessage, field: &str) -> i128 {
    match *message.get_field_by_name(field).unwrap() {
        Value::U32(v) => v.into(),
        Value::U64(v) => v.into(),
        Value::I32(v) | Value::EnumNumber(v) => v.into(),
        Value::I64(v) => v.into(),
        Value::Bool(v) => v.into(),
        ref other => panic!("{field} is {other:?}"),
    }
}

fn wall(message: &DynamicMessage) -> u64 {
    let field = message.get_field_by_name("timestamp").unwrap();
    let timestamp = field.as_message().unwrap();
    u64::try_from(number(timestamp, "seconds") * 1_000_000_000 + number(timestamp, "nanos")).unwrap()
}

fn text(message: &DynamicMessage, field: &str) -> String {
    message.get_field_by_name(field).unwrap().as_str().unwrap().to_owned()
}

#[tokio::test]
async fn an_episode_holds_what_was_captured_and_nothing_else() {
    let bench = Bench::new();
    let mut events = bench.board.events();
    let (finished, t0) = bench.one_second().await;
    let What::Episode { file, seconds, messages, bytes, dropped, error } = bench.until_closed(&mut events).await else {
        unreachable!()
    };
    assert_eq!((file.as_path(), error, seconds), (finished.as_path(), None, 1.0));
    assert_eq!(bytes, std::fs::metadata(&finished).unwrap().len());
    assert!(!finished.with_extension("mcap.partial").exists());
    let snapshot = bench.board.snapshot();
    assert_eq!((snapshot.recording, snapshot.last_episode), (None, Some(finished.clone())));

    let read = read(&finished);
    let stats = read.summary.stats.as_ref().unwrap();
    assert_eq!(stats.message_count, messages);
    assert_eq!(read.attachments["devices.toml"], registry().text.as_bytes());
    let about = &read.metadata["rapid"];
    assert_eq!(about["layout"], r#"{"cam_wrist":0,"never":5,"raw":7,"tof":1}"#);
    assert_eq!((about["task"].as_str(), about["tags"].as_str()), ("place block", r#"{"finger":"soft"}"#));
    assert_eq!((about["rig"].as_str(), about["sync_window_ns"].as_str()), ("bench", "25000000"));
    assert_eq!(about["registry"], registry().text);
    let begin: u64 = about["begin_wall_ns"].parse().unwrap();
    let end = begin + 1000 * MS;

    // Every channel is named, one that never spoke too, by the schema its device lets expect.
    let channels: BTreeMap<_, _> =
        read.summary.channels.values().map(|c| (c.topic.as_str(), c.schema.as_ref().unwrap().name.as_str())).collect();
    let expected = BTreeMap::from([
        ("/rapid/cam_wrist", "foxglove.CompressedImage"),
        ("/rapid/event", "rapid.Event"),
        ("/rapid/frame", "rapid.Frame"),
        ("/rapid/log", "foxglove.Log"),
        ("/rapid/mask", "rapid.Mask"),
        ("/rapid/never", "foxglove.RawImage"),
        ("/rapid/raw", "foxglove.RawImage"),
        ("/rapid/tof", "rapid.Scalars"),
    ]);
    assert_eq!(channels, expected);
    let never = read.summary.channels.values().find(|c| c.topic == "/rapid/never").unwrap();
    assert_eq!((never.metadata["bit"].as_str(), never.metadata["kind"].as_str()), ("5", "image"));

    // Samples: those captured before the end, in order, with their times.
    let mut written = 0;
    for (topic, message) in read.messages.iter().map(|m| (m.0.as_str(), m)) {
        if ["/rapid/cam_wrist", "/rapid/tof", "/rapid/raw"].contains(&topic) {
            assert!((begin..end).contains(&message.2));
            assert_eq!(message.3 - message.2, 5 * MS);
            written += 1;
        }
    }
    let tof: Vec<u32> = read.on("/rapid/tof").map(|m| m.1).collect();
    assert_eq!(tof.len() + read.on("/rapid/cam_wrist").count() + 2, written);
    let late = t0.since(Stamp(about["begin_monotonic_ns"].parse().unwrap()));
    let in_time = |n: &u64| *n != 20 && late + Duration::from_millis(n * 10) < Duration::from_secs(1);
    assert_eq!(tof.len(), (0..100).filter(in_time).count());
    assert!(tof.is_sorted() && tof[0] == 101);
    let values = read.on("/rapid/tof").next().unwrap().4.get_field_by_name("values").unwrap().into_owned();
    assert_eq!(values.as_list().unwrap().iter().map(|v| v.as_f64().unwrap()).collect::<Vec<_>>(), [101.0, 0.5]);
    let cam = read.on("/rapid/cam_wrist").nth(3).unwrap();
    let data = cam.4.get_field_by_name("data").unwrap().as_bytes().unwrap().to_vec();
    assert_eq!(data, u64::from(cam.1).to_le_bytes().repeat(100));
    assert_eq!([text(&cam.4, "format"), text(&cam.4, "frame_id")], ["jpeg", "cam_wrist"]);

    // Losses: seven of the device's own and one on the way.
    assert_eq!(dropped, 1);
    let summary = &read.metadata["rapid/summary"];
    let tallies: serde_json::Value = serde_json::from_str(&summary["modalities"]).unwrap();
    assert_eq!((&tallies["tof"]["lost"], &tallies["tof"]["dropped"]), (&7.into(), &1.into()));
    assert_eq!((&tallies["cam_wrist"]["lost"], &tallies["cam_wrist"]["dropped"]), (&0.into(), &0.into()));
    assert_eq!((&tallies["raw"]["damaged"], &tallies["raw"]["samples"]), (&1.into(), &2.into()));
    assert_eq!(tallies["never"]["samples"], 0);
    assert_eq!((summary["dropped"].as_str(), summary["serials"].as_str()), ("1", r#"{"raw":"S7"}"#));
    assert_eq!((summary["duration_s"].as_str(), summary["lost"].as_str()), ("1", "7"));

    // The mask: first the one in force before the beginning, then every edge at its time.
    let masks: Vec<(u64, i128)> = read.on("/rapid/mask").map(|m| (m.2, number(&m.4, "mask"))).collect();
    assert!(masks[0].0 < begin && masks[1].0 >= begin);
    let edges: Vec<i128> = masks.windows(2).filter(|w| w[0].1 != w[1].1).map(|w| w[1].1).collect();
    assert_eq!(edges, [0b1000_0011, 0b1000_0010, 0b1000_0011]);

    // Events: in the file as they were announced, with the log line in its own channel too.
    let kinds: Vec<String> = read.on("/rapid/event").map(|m| text(&m.4, "kind")).collect();
    assert!(kinds.starts_with(&["recording".into(), "attach".into(), "log".into()]), "{kinds:?}");
    let attach = &read.on("/rapid/event").nth(1).unwrap().4;
    assert_eq!((text(attach, "device"), text(attach, "text").contains("S7")), ("raw".to_owned(), true));
    let json: serde_json::Value = serde_json::from_str(&text(attach, "json")).unwrap();
    assert_eq!((&json["event"], &json["serial"]), (&"attach".into(), &"S7".into()));
    let lines: Vec<String> = read.on("/rapid/log").map(|m| text(&m.4, "message")).collect();
    assert_eq!(lines[0], "hello");
    assert!(lines.iter().any(|line| line.starts_with("tof: ") && line.contains("lost")), "{lines:?}");

    check_frames(&read, begin);
}

/// Chooses the sample of each frame again from nothing but the file.
fn check_frames(read: &Read, begin: u64) {
    let frames: Vec<_> = read.on("/rapid/frame").collect();
    assert_eq!(frames.len(), 30);
    let mut seen = BTreeMap::new();
    for (index, (_, sequence, tick, deadline, frame)) in frames.into_iter().enumerate() {
        assert_eq!((*sequence as usize, number(frame, "index")), (index, index as i128));
        assert_eq!(*tick, begin + index as u64 * 1_000_000_000 / 30);
        assert_eq!(deadline - tick, 125 * MS);
        let mask = read.on("/rapid/mask").filter(|m| m.2 <= *tick).last().map(|m| number(&m.4, "mask")).unwrap();
        assert_eq!(number(frame, "mask"), mask);
        let list = frame.get_field_by_name("modalities").unwrap();
        let list = list.as_list().unwrap();
        assert_eq!(list.len(), 4);
        for (slot, topic) in list.iter().zip(["/rapid/cam_wrist", "/rapid/tof", "/rapid/never", "/rapid/raw"]) {
            let slot = slot.as_message().unwrap();
            let present = mask >> number(slot, "bit") & 1;
            // In this script a replug lies 300 ms apart: only samples of the new attachment are
            // received by the deadline of a tick at which it is present.
            let mut known: Vec<_> = read
                .on(topic)
                .filter(|m| m.3 <= *deadline && !(topic == "/rapid/raw" && m.1 == 1))
                .map(|m| (m.2.abs_diff(*tick), m.2, m.1))
                .collect();
            if topic == "/rapid/cam_wrist" && known.iter().any(|k| k.2 >= 10) {
                known.retain(|k| k.2 >= 10);
            }
            let nearest = known.iter().filter(|k| k.0 <= 25 * MS).min().copied();
            let held = known.iter().filter(|k| k.1 <= *tick).max_by_key(|k| k.1).copied();
            let chosen = if present == 1 { nearest.or(held) } else { None };
            let valid = present == 1 && nearest.is_some();
            let said = ["present", "valid", "stale"].map(|flag| number(slot, flag) == 1);
            assert_eq!(said, [present == 1, valid, present == 1 && !valid], "{topic} in frame {index}");
            let seq = slot.has_field_by_name("seq").then(|| number(slot, "seq"));
            assert_eq!(seq, chosen.map(|c| c.2.into()), "{topic} in frame {index}");
            let age = chosen.map_or(0, |c| i128::from(*tick) - i128::from(c.1));
            assert_eq!(number(slot, "age_ns"), age);
            *seen.entry((topic, said)).or_insert(0) += 1;
        }
    }
    // The script makes each case happen.
    let count = |topic, said| seen.get(&(topic, said)).copied().unwrap_or(0);
    assert!(count("/rapid/cam_wrist", [true, true, false]) > 10);
    assert!(count("/rapid/cam_wrist", [false, false, false]) > 7);
    assert_eq!(count("/rapid/never", [false, false, false]), 30);
    assert!(count("/rapid/raw", [true, false, true]) > 10);
    assert!(count("/rapid/raw", [true, true, false]) > 0);
}

#[tokio::test]
async fn orders_out_of_turn_are_refused_and_a_stop_reports() {
    let bench = Bench::new();
    assert!(matches!(bench.recorder.stop().await, Err(RecordError::Idle)));
    let missing = EpisodeRequest { out: bench.folder.path().join("a/b/c"), ..bench.request(None) };
    assert!(matches!(bench.recorder.start(missing).await, Err(RecordError::NoFolder(_))));
    let first = bench.recorder.start(bench.request(None)).await.unwrap();
    assert!(matches!(bench.recorder.start(bench.request(None)).await, Err(RecordError::Busy(file)) if file == first));
    assert_eq!(bench.board.snapshot().recording.unwrap().file, first);
    let captured = Stamp::now();
    bench.sample(TOF, 1, 0, captured.0, 0);
    while Stamp::now() <= captured {}
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!((report.file.as_path(), report.error, report.dropped), (first.as_path(), None, 0));
    assert!(report.seconds > 0.0 && read(&first).on("/rapid/tof").count() == 1);
    let second = bench.recorder.start(bench.request(None)).await.unwrap();
    assert!(second.to_str().unwrap().ends_with("_place-block_002.mcap"));
    // The handle's end is the episode's end.
    let Bench { recorder, folder, .. } = bench;
    drop(recorder);
    assert!(read(&second).metadata["rapid/summary"]["frames"].parse::<u64>().is_ok());
    drop(folder);
}

/// A disk of few bytes.
struct SmallDisk(File, usize);

impl Write for SmallDisk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.1 == 0 {
            return Err(io::ErrorKind::StorageFull.into());
        }
        let taken = self.0.write(&bytes[..bytes.len().min(self.1)])?;
        self.1 -= taken;
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Sink for SmallDisk {
    fn sync(&mut self) -> io::Result<()> {
        self.0.sync_all()
    }
}

#[tokio::test]
async fn a_full_disk_ends_the_episode_and_not_the_recorder() {
    let mut episodes = 0;
    let bench = Bench::with_sink(move |file| {
        episodes += 1;
        if episodes == 1 { Box::new(SmallDisk(file, 100_000)) } else { Box::new(file) }
    });
    let mut events = bench.board.events();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    for seq in 0..4000 {
        bench.sample(CAM, 1, seq, Stamp::now().0, 0);
    }
    let What::Episode { file, bytes, error, .. } = bench.until_closed(&mut events).await else { unreachable!() };
    assert_eq!(file, finished.with_extension("mcap.partial"));
    assert_eq!(bytes, 100_000);
    let error = error.unwrap();
    assert!(error.contains("no storage space") && error.contains("place-block_001.mcap.partial"), "{error}");
    assert!(!finished.exists() && bench.board.snapshot().recording.is_none());
    // The next one goes well.
    let second = bench.recorder.start(bench.request(None)).await.unwrap();
    assert!(second.to_str().unwrap().ends_with("_002.mcap"));
    assert_eq!(bench.recorder.stop().await.unwrap().error, None);
}

/// A disk that takes everything and keeps nothing for sure.
struct Unsure(File);

impl Write for Unsure {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Sink for Unsure {
    fn sync(&mut self) -> io::Result<()> {
        Err(io::Error::other("cable of the disk pulled"))
    }
}

#[tokio::test]
async fn a_file_that_is_not_on_the_disk_keeps_its_partial_name() {
    let bench = Bench::with_sink(|file| Box::new(Unsure(file)));
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!(report.file, finished.with_extension("mcap.partial"));
    assert!(report.error.unwrap().contains("cable of the disk pulled") && !finished.exists());
    assert_eq!(bench.board.snapshot().last_episode, None);
}

#[tokio::test]
async fn a_disk_full_at_the_start_is_said_and_leaves_nothing() {
    let bench = Bench::with_sink(|file| Box::new(SmallDisk(file, 0)));
    let mut request = bench.request(None);
    // More than the buffer in front of the disk holds.
    request.task = "x".repeat(200_000);
    let error = bench.recorder.start(request).await.unwrap_err();
    assert!(error.to_string().contains("no storage space"), "{error}");
    assert_eq!(std::fs::read_dir(bench.folder.path().join("out")).unwrap().count(), 0);
    assert!(matches!(bench.recorder.stop().await, Err(RecordError::Idle)));
}

/// A session of its own clock, one second after the monotonic clock's zero.
fn session(folder: &Path, board: &Arc<Board>, masks: &MaskHistory) -> Session {
    let clock = WallClock::with_offset(i128::from(1_700_000_000 * 1000 * MS));
    let (path, file) = EpisodePath::create(folder, "t", clock.wall_ns(Stamp(0))).unwrap();
    let beginning = Beginning {
        registry: Arc::new(registry()),
        board: Arc::clone(board),
        request: &EpisodeRequest::default(),
        path,
        sink: Box::new(file),
        attached: &BTreeMap::new(),
        clock,
        begin: Stamp(1000 * MS),
    };
    Session::begin(beginning, masks).unwrap()
}

fn scalars(seq: u64, capture_ms: u64, recv_ms: u64) -> SampleHeader {
    SampleHeader {
        seq,
        capture_ns: capture_ms * MS,
        recv_ns: recv_ms * MS,
        encoding: Encoding::F64 as u32,
        ..SampleHeader::default()
    }
}

#[test]
fn what_comes_late_is_recorded_and_what_comes_too_late_belongs_to_no_frame() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let mut masks = MaskHistory::new();
    masks.push(&scalars(1, 990, 990), PhysicalMask(0b10), 1);
    let mut session = session(folder.path(), &board, &masks);
    let at = |ms: u64| Stamp(ms * MS);
    // Tick 0 is at 1000 ms; its deadline 25 ms + 100 ms later. One sample comes in time, one does not.
    session.sample(id(TOF), &scalars(0, 999, 999), &[0; 8], None);
    session.sample(id(TOF), &scalars(1, 1001, 1126), &[0; 8], None);
    session.sample(id(TOF), &scalars(2, 1010, 1124), &[0; 8], None);
    session.advance(at(1144), &masks);
    assert_eq!(session.status(at(1144)).messages, 3, "two samples and a mask; the frame not before 1145 ms");
    session.advance(at(1145), &masks);
    assert_eq!(session.status(at(1145)).messages, 4);

    session.end_at(at(1100));
    session.end_at(at(1200));
    // Captured before the end and arriving after it; captured at the end.
    session.sample(id(TOF), &scalars(3, 1099, 1190), &[0; 8], None);
    session.sample(id(TOF), &scalars(4, 1100, 1190), &[0; 8], None);
    assert!(!session.is_over(at(1219)) && session.is_over(at(1220)));
    let report = session.finish(at(1220), &masks, None);
    assert_eq!((report.error, report.messages), (None, 7), "one sample and two frames more");
    assert!((report.seconds - 0.1).abs() < 1e-9);

    let read = read(&report.file);
    assert_eq!(read.on("/rapid/tof").map(|m| m.1).collect::<Vec<_>>(), [1, 2, 3]);
    let chosen: Vec<_> = read
        .on("/rapid/frame")
        .map(|(.., frame)| {
            let list = frame.get_field_by_name("modalities").unwrap();
            let slot = list.as_list().unwrap()[1].as_message().unwrap().clone();
            (number(&slot, "valid"), number(&slot, "seq"), number(&slot, "age_ns"))
        })
        .collect();
    // Ticks at 1000, 1033.3, 1066.7 ms, and none at 1100, the end. The sample of 1001 ms is nearer to
    // the first but came too late for it; the second has one in its window, the third holds it.
    assert_eq!(chosen, [(1, 2, -10_000_000), (1, 2, 23_333_333), (0, 2, 56_666_666)]);
}

#[test]
fn losses_are_announced_once_a_second_and_counted_all() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let mut events = board.events();
    let masks = MaskHistory::new();
    let mut session = session(folder.path(), &board, &masks);
    for n in 0..200 {
        let now = 1000 + n * 10;
        let hole = Hole { after: Stamp((now - 9) * MS), before: Stamp(now * MS), lost: 1, dropped: 2 };
        session.sample(id(TOF), &scalars(n, now, now), &[0; 8], Some(hole));
        session.advance(Stamp(now * MS), &masks);
    }
    // One more, so that a number of hostile size comes to the others.
    let hole = Hole { after: Stamp(1500 * MS), before: Stamp(3000 * MS), lost: 0, dropped: u64::MAX };
    session.sample(id(CAM), &scalars(1, 3000, 3000), &[0; 8], Some(hole));
    assert_eq!(session.status(Stamp(0)).dropped, u64::MAX);
    let report = session.finish(Stamp(3001 * MS), &masks, None);
    assert_eq!((report.error, report.dropped), (None, u64::MAX));
    let mut said = Vec::new();
    while let Ok(event) = events.try_recv() {
        if let What::Log { level: Level::Warn, text } = event.what {
            said.push(text);
        }
    }
    let lost = |count: u64, name: &str| format!("{name}: {count} samples lost on the way to the file");
    assert_eq!(said, [lost(2, "tof"), lost(200, "tof"), lost(u64::MAX, "cam_wrist"), lost(196, "tof")]);
    let tallies = &read(&report.file).metadata["rapid/summary"]["modalities"];
    let tallies: serde_json::Value = serde_json::from_str(tallies).unwrap();
    assert_eq!((&tallies["tof"]["samples"], &tallies["tof"]["dropped"]), (&200.into(), &398.into()));
    // The hole before the first sample lies before the episode.
    assert_eq!(tallies["tof"]["lost"], 199);
}

#[test]
fn of_a_hole_across_the_beginning_or_the_end_only_the_part_within_counts() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let masks = MaskHistory::new();
    let mut session = session(folder.path(), &board, &masks);
    let hole = |after: u64, before: u64, missing| {
        Some(Hole { after: Stamp(after * MS), before: Stamp(before * MS), lost: 0, dropped: missing })
    };
    // Every 10 ms; the episode begins at 1000 ms: 960 to 990 do not count.
    session.sample(id(TOF), &scalars(9, 1050, 1050), &[0; 8], hole(950, 1050, 9));
    assert_eq!(session.status(Stamp(0)).dropped, 5);
    // As after a disk that stood still beyond the end: what is left is of later moments, and yet 1060
    // to 1090 ms are lost.
    session.end_at(Stamp(1100 * MS));
    session.sample(id(TOF), &scalars(29, 1250, 1250), &[0; 8], hole(1050, 1250, 19));
    assert_eq!(session.status(Stamp(0)).dropped, 9);
    // Neither a hole in another time nor one of no length.
    session.sample(id(TOF), &scalars(40, 1300, 1300), &[0; 8], hole(1250, 1300, 10));
    session.sample(id(TOF), &scalars(50, 1300, 1300), &[0; 8], hole(1300, 1300, 10));
    let report = session.finish(Stamp(1300 * MS), &masks, None);
    assert_eq!((report.error, report.dropped), (None, 9));
}

#[tokio::test]
async fn a_partial_file_holds_what_was_flushed() {
    let bench = Bench::new();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let partial = finished.with_extension("mcap.partial");
    for seq in 0..10 {
        bench.sample(TOF, 1, seq, Stamp::now().0, 0);
    }
    // As a kill would leave it: the file as it is at a moment before its end.
    let said = loop {
        match inspect::inspect(&partial) {
            Ok(said) if said.modalities.iter().any(|m| m.topic.messages == 10) => break said,
            _ => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    };
    assert_eq!((said.end, said.damaged_chunks, said.dropped), (inspect::FileEnd::Unfinished, 0, None));
    assert_eq!((said.rig.as_str(), said.modalities.len()), ("bench", 4));
    assert!(!finished.exists());
    bench.recorder.stop().await.unwrap();
    assert!(finished.exists() && !partial.exists());
}

#[tokio::test]
async fn what_a_device_should_not_send_is_recorded_as_bytes_and_never_lost() {
    let bench = Bench::new();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let now = Stamp::now().0;
    let header = SampleHeader { seq: 0, capture_ns: now, recv_ns: now, epoch: 1, encoding: 99, ..Default::default() };
    bench.script.put((TopicId::Modality(id(CAM)), header, b"??".to_vec()));
    let header = SampleHeader { seq: u64::MAX, encoding: Encoding::F64 as u32, ..header };
    bench.script.put((TopicId::Modality(id(TOF)), header, b"12345".to_vec()));
    let header = SampleHeader { seq: 3, encoding: Encoding::F64 as u32, ..header };
    bench.script.put((TopicId::Modality(id(TOF)), header, b"12345678".to_vec()));
    bench.script.put((TopicId::Modality(id(40)), header, b"not registered".to_vec()));
    bench.script.put((TopicId::Mask, header, b"short".to_vec()));
    while Stamp::now().0 <= now {}
    assert_eq!(bench.recorder.stop().await.unwrap().error, None);
    let read = read(&finished);
    let data = |topic: &str| -> Vec<(String, Vec<u8>)> {
        let with_data = read.on(topic).filter(|m| m.4.descriptor().get_field_by_name("data").is_some());
        with_data
            .map(|m| {
                let data = m.4.get_field_by_name("data").unwrap().as_bytes().unwrap().to_vec();
                (m.4.descriptor().full_name().to_owned(), data)
            })
            .collect()
    };
    assert_eq!(data("/rapid/cam_wrist"), [("rapid.Bytes".to_owned(), b"??".to_vec())]);
    assert_eq!(data("/rapid/tof"), [("rapid.Bytes".to_owned(), b"12345".to_vec())]);
    assert_eq!(read.on("/rapid/tof").count(), 2);
    assert_eq!(read.on("/rapid/mask").count(), 0);
}

#[tokio::test]
async fn a_panic_leaves_a_finished_file_and_says_so() {
    let bench = Bench::new();
    let mut events = bench.board.events();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let now = Stamp::now();
    bench.sample(TOF, 1, 0, now.0, 0);
    while bench.board.snapshot().recording.is_none_or(|status| status.bytes == 0) {
        tokio::task::yield_now().await;
    }
    bench.script.panic();
    let What::Episode { file, error, .. } = bench.until_closed(&mut events).await else { unreachable!() };
    assert_eq!(file, finished);
    assert!(error.unwrap().contains("scripted panic"));
    assert_eq!(read(&finished).on("/rapid/tof").count(), 1);
    assert!(matches!(bench.recorder.start(bench.request(None)).await, Err(RecordError::Ended)));
}
