//! A bench for the recorder: a scripted source, and episodes read back with the `mcap` crate.

mod episode;
mod faults;
mod open_episode;
mod room;
mod tampering;

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use prost_reflect::{DescriptorPool, DynamicMessage, ReflectMessage, Value};
use rapid_bus::TopicId;
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Encoding, FLAG_ERROR, SampleHeader};
use rapid_core::time::Stamp;
use rapid_registry::Registry;
use rapid_registry::device::UsbIdentity;
use rapid_status::{Board, EpisodeReport, EventKind, Grade, Level};

use super::*;

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

    /// A sample of a device that reports `lost` lost samples so far.
    fn sample_after(&self, lost: u64, bit: u8, epoch: u32, seq: u64, capture: u64, flags: u32) {
        let (encoding, payload) = match bit {
            CAM => (Encoding::Mjpeg, picture(seq)),
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
        self.put((TopicId::Modality(id(bit)), header, payload));
    }

    /// A sample of this size.
    fn sized(&self, bit: u8, seq: u64, capture: u64, bytes: usize) {
        let encoding = if bit == TOF { Encoding::F64 } else { Encoding::Grey };
        let header = SampleHeader {
            seq,
            capture_ns: capture,
            recv_ns: capture,
            id: bit.into(),
            epoch: 1,
            encoding: encoding as u32,
            width: 4,
            height: 2,
            ..SampleHeader::default()
        };
        self.put((TopicId::Modality(id(bit)), header, vec![0; bytes]));
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
        self.put((TopicId::Mask, header, payload));
    }

    /// The events of [`Bench::one_second`].
    fn one_second(&self, t0: u64) {
        for n in 0..500 {
            let at = t0 + n * 2 * MS;
            let cam = u64::from(!(300..600).contains(&(n * 2)));
            let raw = u64::from(n >= 100) << RAW;
            self.mask(cam | 0b10 | raw, n + 2, at);
        }
        for n in 0..33_u64 {
            let (at, epoch) = (n * 30, if n < 15 { 1 } else { 2 });
            if !(300..600).contains(&at) {
                self.sample_after(0, CAM, epoch, if n < 15 { n } else { n - 10 }, t0 + at * MS, 0);
            }
        }
        let mut seq = 100;
        for n in 0..100 {
            seq += if n == 50 { 8 } else { 1 };
            if n != 20 {
                self.sample_after(if n < 50 { 0 } else { 7 }, TOF, 1, seq, t0 + n * 10 * MS, 0);
            }
        }
        self.sample_after(0, RAW, 1, 0, t0 + 230 * MS, 0);
        self.sample_after(0, RAW, 1, 1, t0 + 400 * MS, FLAG_ERROR);
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

/// A picture of eight by eight pixels, with its number in a comment.
fn picture(number: u64) -> Vec<u8> {
    let mut jpeg = Vec::new();
    rapid_pictures::jpeg::encode(&[90; 64], [8, 8], rapid_pictures::jpeg::Values::Grey, 90, &mut jpeg).unwrap();
    let inside = number.to_le_bytes().repeat(100);
    let length = u16::try_from(inside.len() + 2).unwrap().to_be_bytes();
    [&jpeg[..2], &[0xff, 0xfe], &length, &inside, &jpeg[2..]].concat()
}

pub(crate) fn registry() -> Registry {
    let mut text = "[rig]\nname = \"bench\"\n".to_owned();
    let cameras = [(CAM, "cam_wrist", "MJPG"), (NEVER, "never", "YUYV"), (RAW, "raw", "GREY")];
    for (bit, name, format) in cameras {
        // The bench sends what it likes, not the camera's rate.
        let _ = write!(
            text,
            "[device.{name}]\nvid = \"0001\"\npid = \"{bit:04x}\"\nnode = \"camera\"\ntopic = \"/rapid/{name}\"\n\
             bit = {bit}\n[device.{name}.camera]\nwidth = 4\nheight = 2\nfps = 30\nformat = \"{format}\"\n\
             [device.{name}.verdict]\nrate = \"off\"\n"
        );
    }
    let _ = write!(
        text,
        "[device.tof]\nvid = \"0001\"\npid = \"{TOF:04x}\"\nnode = \"serial\"\ntopic = \"/rapid/tof\"\nbit = {TOF}\n\
         [device.tof.tty]\nbaud = 115200\nparse = \"csv\"\nchannels = 2\n"
    );
    Registry::parse(&text, None).unwrap().registry
}

pub(crate) struct Bench {
    pub(crate) folder: tempfile::TempDir,
    board: Arc<Board>,
    script: Script,
    recorder: Recorder,
    /// Called with the first moment of the next episode, before anything else happens in it.
    at_begin: Arc<Mutex<Option<AtBegin>>>,
}

type AtBegin = Box<dyn FnOnce(Stamp) + Send>;

impl Bench {
    pub(crate) fn new() -> Self {
        Self::with_sink(|file| Box::new(file))
    }

    fn with_sink(sink: impl FnMut(File) -> Box<dyn Sink> + Send + 'static) -> Self {
        Self::with(|config| config.sink = Box::new(sink))
    }

    /// A bench whose recorder has another disk or clock.
    fn with(change: impl FnOnce(&mut RecorderConfig)) -> Self {
        let registry = Arc::new(registry());
        let board = Arc::new(Board::new(&registry));
        let script = Script::default();
        let mut config = RecorderConfig::new(registry, Arc::clone(&board));
        change(&mut config);
        let at_begin: Arc<Mutex<Option<AtBegin>>> = Arc::default();
        let call = Arc::clone(&at_begin);
        config.begin = Box::new(move || {
            let begin = Stamp::now();
            call.lock().unwrap().take().into_iter().for_each(|call| call(begin));
            begin
        });
        let recorder = Recorder::spawn(script.clone(), config).unwrap();
        Self { folder: tempfile::tempdir().unwrap(), board, script, recorder, at_begin }
    }

    fn request(&self, duration: Option<Duration>) -> EpisodeRequest {
        EpisodeRequest {
            out: self.folder.path().join("out"),
            task: "place block".to_owned(),
            tags: vec![("finger".to_owned(), "soft".to_owned())],
            duration,
            ..EpisodeRequest::default()
        }
    }

    fn sample(&self, bit: u8, epoch: u32, seq: u64, capture: u64, flags: u32) {
        self.script.sample_after(0, bit, epoch, seq, capture, flags);
    }

    fn mask(&self, mask: u64, sequence: u64, capture: u64) {
        self.script.mask(mask, sequence, capture);
    }

    /// Half a second in which nothing is sent and these events are announced, `before` it begins and within.
    pub(crate) async fn half_a_second(&mut self, before: Vec<EventKind>, within: Vec<EventKind>) -> PathBuf {
        self.mask(0, 1, Stamp::now().0);
        self.script.taken().await;
        for what in before {
            self.board.announce(what);
        }
        let finished = self.recorder.start(self.request(Some(Duration::from_millis(500)))).await.unwrap();
        for what in within {
            self.board.announce(what);
        }
        self.until_file(&finished).await;
        finished
    }

    /// Half a second in which `tof` is present and sends `numbers`, without a flag: as recorders of earlier versions took them.
    pub(crate) async fn half_a_second_of(&mut self, numbers: impl Fn(u64) -> [f64; 2] + Send + 'static) -> PathBuf {
        self.mask(0b10, 1, Stamp::now().0);
        self.script.taken().await;
        let script = self.script.clone();
        *self.at_begin.lock().unwrap() = Some(Box::new(move |begin| {
            for n in 0..50 {
                let capture_ns = begin.0 + (1 + n * 10) * MS;
                script.mask(0b10, n + 2, capture_ns);
                let header = SampleHeader {
                    seq: n,
                    capture_ns,
                    recv_ns: capture_ns,
                    id: TOF.into(),
                    epoch: 1,
                    encoding: Encoding::F64 as u32,
                    width: 2,
                    ..SampleHeader::default()
                };
                let payload = numbers(n).into_iter().flat_map(f64::to_le_bytes).collect();
                script.put((TopicId::Modality(id(TOF)), header, payload));
            }
        }));
        let finished = self.recorder.start(self.request(Some(Duration::from_millis(500)))).await.unwrap();
        self.until_file(&finished).await;
        finished
    }

    /// One second of a rig, laid out from `t0` on: the camera is away in the middle, the
    /// `tof` loses seven samples itself and one of its is lost on the way, `raw` sends one damaged frame and has no bit in
    /// the mask at first.
    ///
    /// Returns the file's name and `t0`, which lies 1 ms after the beginning of the episode.
    pub(crate) async fn one_second(&mut self) -> (PathBuf, Stamp) {
        self.mask(0b11, 1, Stamp::now().0);
        self.script.taken().await;
        let script = self.script.clone();
        let (notify, reported) = std::sync::mpsc::channel();
        let at_begin: AtBegin = Box::new(move |begin| {
            let t0 = begin.after(Duration::from_millis(1));
            script.one_second(t0.0);
            notify.send(t0).unwrap();
        });
        *self.at_begin.lock().unwrap() = Some(at_begin);
        let finished = self.recorder.start(self.request(Some(Duration::from_secs(1)))).await.unwrap();
        let attach = EventKind::Attach {
            device: "raw".to_owned(),
            bit: id(RAW),
            node: "/dev/video7".to_owned(),
            unit: UsbIdentity { port: "1-2".to_owned(), serial: Some("S7".to_owned()), ..UsbIdentity::default() }
                .into(),
            driver: None,
        };
        self.board.announce(attach);
        self.board.announce(EventKind::Log { level: Level::Info, text: "hello".to_owned() });
        (finished, reported.recv().unwrap())
    }

    /// Waits until a file has its final name.
    pub(crate) async fn until_file(&self, file: &Path) {
        while !file.exists() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    async fn until_closed(&self, events: &mut tokio::sync::broadcast::Receiver<rapid_status::Event>) -> EventKind {
        loop {
            let event = events.recv().await.unwrap();
            if matches!(event.what, EventKind::Episode(_)) {
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
