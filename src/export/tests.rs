//! Rows of an episode made by hand: raw pictures, samples that cannot be used, frames before their samples.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use super::cells::CellMaker;
use super::features::{Actions, Features, MASK, STATE, VALID};
use super::picture::{Codec, Pictures, Shape};
use super::rows::{Index, Refusal, Row};
use super::table::{Position, Rows, Table};
use super::video::{FrameMaker, Shown};
use crate::action::ACTION_TOPIC;
use crate::episode::encode;
use crate::episode::schema::{FRAME, SampleSchema};
use crate::episode::{FRAME_TOPIC, text_map};
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::observation::Observation;
use crate::pixels::{Picture, Pixels};
use crate::sample::{Encoding, SampleHeader};

const BEGIN: u64 = 1_700_000_000_000_000_000;
const GREY: [u8; 8] = [0, 30, 60, 90, 120, 150, 180, 255];
const YUYV: [u8; 16] = [90, 100, 80, 140, 200, 128, 16, 128, 235, 90, 40, 200, 77, 33, 11, 99];
const CAMERA: &str = "observation.images.cam";

/// Writes messages with the topic's own numbers.
struct Recording {
    path: PathBuf,
    writer: mcap::Writer<std::io::BufWriter<File>>,
    message: Vec<u8>,
}

impl Recording {
    fn new(folder: &Path) -> Self {
        let path = folder.join("a.mcap");
        let mut writer = mcap::Writer::new(std::io::BufWriter::new(File::create(&path).unwrap())).unwrap();
        let modalities = r#"[{"name": "cam", "bit": 0, "kind": "image", "shape": [2, 4]},
            {"name": "force", "bit": 4, "kind": "scalars", "shape": [1]}]"#;
        let about = [("modalities", modalities), ("observation_hz", "10"), ("task", "x")];
        let metadata = text_map(about.map(|(key, value)| (key, value.to_owned())));
        writer.write_metadata(&mcap::records::Metadata { name: "rapid".into(), metadata }).unwrap();
        Self { path, writer, message: Vec::new() }
    }

    fn write(&mut self, schema: (&str, &[u8]), topic: &str, bit: Option<u8>, sequence: u32, at_ms: u64) {
        let schema = self.writer.add_schema(schema.0, "protobuf", schema.1).unwrap();
        let metadata = bit.map(|bit| ("bit".to_owned(), bit.to_string())).into_iter().collect();
        let channel_id = self.writer.add_channel(schema, topic, "protobuf", &metadata).unwrap();
        let log_time = BEGIN + at_ms * 1_000_000;
        let header = mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.writer.write_to_known_channel(&header, &self.message).unwrap();
    }

    /// A tick, and the numbers of the samples that belong to it.
    fn frame(&mut self, number: u32, named: [Option<u64>; 2]) {
        let mut observation = Observation::new(&[0, 4].map(|bit| ModalityId::new(bit).unwrap()));
        for (slot, seq) in observation.slots.iter_mut().zip(named) {
            (slot.present, slot.valid, slot.seq) = (seq.is_some(), seq.is_some(), seq);
            observation.mask = PhysicalMask(observation.mask.0 | u64::from(seq.is_some()) << slot.id.bit());
        }
        let at_ms = u64::from(number) * 100;
        encode::frame(&mut self.message, BEGIN + at_ms * 1_000_000, number.into(), &observation);
        self.write((FRAME.name, FRAME.data), FRAME_TOPIC, None, number, at_ms);
    }

    fn sample(&mut self, bit: Option<u8>, sequence: u32, encoding: Encoding, payload: &[u8]) {
        let header = SampleHeader { encoding: encoding as u32, width: 4, height: 2, ..SampleHeader::default() };
        let kind = SampleSchema::of(&header, payload);
        let at_ms = u64::from(sequence) * 100;
        encode::sample(&mut self.message, kind, BEGIN + at_ms * 1_000_000, "", &header, payload);
        let topic = bit.map_or_else(|| ACTION_TOPIC.to_owned(), |bit| format!("/rapid/{bit}/{encoding:?}"));
        self.write((kind.schema().name, kind.schema().data), &topic, bit, sequence, at_ms);
    }

    fn numbers(&mut self, bit: Option<u8>, sequence: u32, values: &[f64]) {
        let payload: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.sample(bit, sequence, Encoding::F64, &payload);
    }

    fn end(mut self) -> PathBuf {
        self.writer.finish().unwrap();
        self.path
    }
}

#[test]
fn a_picture_that_cannot_be_decoded_is_a_black_frame_that_is_not_valid() {
    let folder = tempfile::tempdir().unwrap();
    let mut recording = Recording::new(folder.path());
    for number in 0..3 {
        recording.frame(number, [(number < 2).then_some(number.into()), None]);
    }
    let mut jpeg = Vec::new();
    jpeg_encoder::Encoder::new(&mut jpeg, 90).encode(&[200; 8], 4, 2, jpeg_encoder::ColorType::Luma).unwrap();
    recording.sample(Some(0), 0, Encoding::Mjpeg, &jpeg);
    // With its beginning, its size and its end, but without the pixels.
    let scan = jpeg.windows(2).position(|mark| mark == [0xff, 0xda]).unwrap();
    let cut = [&jpeg[..scan], &[0xff, 0xd9]].concat();
    recording.sample(Some(0), 1, Encoding::Mjpeg, &cut);
    let path = recording.end();

    let stop = AtomicBool::new(false);
    let index = Index::read(&path, &stop).unwrap();
    let shape = Shape::new(2, 4, 3).unwrap();
    let features = Features {
        fps: index.fps,
        modalities: vec!["cam".to_owned(), "force".to_owned()],
        cameras: vec![(0, shape)],
        pictures: Pictures::Video(Codec::Av1),
        state: Vec::new(),
        actions: Actions::Absent,
    };
    let kinds = index.modalities.iter().map(|modality| modality.kind).collect();
    let (mut frames, mut maker) = (FrameMaker::default(), CellMaker::new(&features, kinds).unwrap());
    let mut found = Vec::new();
    let take = |row: &Row<'_>| {
        let (frame, shown) = frames.frame(row, 0, shape);
        let (brightness, length) = (frame[0], frame.len());
        if shown == Shown::Damaged {
            maker.damaged.insert((0, row.number));
        }
        let cells = maker.cells(row)?;
        assert!(cells.pictures.is_empty() && length == 24);
        found.push((shown, brightness > 100, cells.mask[0] > 0.0, cells.valid[0] > 0.0));
        Ok::<_, Refusal>(())
    };
    index.rows(&path, &stop, take).unwrap();
    let expected =
        [(Shown::Picture, true, true, true), (Shown::Damaged, false, true, false), (Shown::Black, false, false, false)];
    assert_eq!(found, expected);
}

fn rgb(encoding: Encoding, bytes: &[u8]) -> Vec<u8> {
    let mut pixels = Pixels::default();
    pixels.decode(&Picture { encoding, width: 4, height: 2, bytes }).unwrap();
    pixels.values().to_vec()
}

fn decoded(file: &[u8]) -> Vec<u8> {
    let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
    let mut values = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut values).unwrap();
    values
}

#[test]
fn raw_pictures_lose_nothing_and_what_cannot_be_used_is_black_and_not_valid() {
    let folder = tempfile::tempdir().unwrap();
    let mut recording = Recording::new(folder.path());
    // Frames before the samples that they name, and one whose samples are not in the file.
    let named = [[Some(0), Some(0)], [Some(1), Some(1)], [Some(2), Some(2)], [None, Some(2)], [Some(9), None]];
    for (number, named) in (0..).zip(named) {
        recording.frame(number, named);
    }
    recording.sample(Some(0), 0, Encoding::Grey, &GREY);
    recording.sample(Some(0), 1, Encoding::Yuyv, &YUYV);
    recording.sample(Some(0), 2, Encoding::Grey, &GREY[..7]);
    recording.numbers(Some(4), 0, &[0.1]);
    recording.numbers(Some(4), 1, &[f64::NAN]);
    recording.numbers(Some(4), 2, &[-7.0]);
    recording.numbers(None, 1, &[1.0, 2.0]);
    let path = recording.end();

    let stop = AtomicBool::new(false);
    let index = Index::read(&path, &stop).unwrap();
    let features = Features {
        fps: index.fps,
        modalities: vec!["cam".to_owned(), "force".to_owned()],
        cameras: vec![(0, Shape::new(2, 4, 3).unwrap())],
        state: vec![(1, 1)],
        pictures: Pictures::Files,
        actions: Actions::Topic(2),
    };
    let kinds = index.modalities.iter().map(|modality| modality.kind).collect();
    let mut maker = CellMaker::new(&features, kinds).unwrap();
    let table = folder.path().join("a.parquet");
    let position = Position { episode: 3, first: 70, task: 1 };
    let mut written = Table::new(File::create(&table).unwrap(), &features, position).unwrap();
    let write = |row: &Row<'_>| {
        written.push(&maker.cells(row)?).unwrap();
        Ok::<_, Refusal>(())
    };
    index.rows(&path, &stop, write).unwrap();
    written.finish().unwrap();

    let mut rows = Rows::open(File::open(&table).unwrap()).unwrap();
    let black = vec![0; 24];
    let expected = [
        (rgb(Encoding::Grey, &GREY), f64::from(0.1_f32), [1.0, 1.0], [1.0, 1.0]),
        (rgb(Encoding::Yuyv, &YUYV), 0.0, [1.0, 1.0], [1.0, 0.0]),
        (black.clone(), -7.0, [1.0, 1.0], [0.0, 1.0]),
        (black.clone(), -7.0, [0.0, 1.0], [0.0, 1.0]),
        (black, 0.0, [1.0, 0.0], [0.0, 0.0]),
    ];
    for (number, (picture, force, mask, valid)) in (0_i64..).zip(expected) {
        let row = rows.advance().unwrap().expect("a row");
        assert_eq!(decoded(row.picture(CAMERA).unwrap()), picture, "{number}");
        // A feature of one number is a plain column.
        assert_eq!(row.numbers(STATE).unwrap(), [force], "{number}");
        assert_eq!((row.numbers(MASK).unwrap(), row.numbers(VALID).unwrap()), (mask.into(), valid.into()), "{number}");
        assert_eq!(row.numbers("action").unwrap(), [1.0, 2.0]);
        let own = ["episode_index", "frame_index", "index", "task_index"].map(|key| row.integer(key).unwrap());
        assert_eq!(own, [3, number, 70 + number, 1]);
    }
    assert!(rows.advance().unwrap().is_none());
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    assert!(matches!(Index::read(&path, &stop), Err(Refusal::Interrupted)));
}
