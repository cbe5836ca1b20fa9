//! Rows of an episode made by hand: raw pictures, samples that cannot be used, frames before their samples.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int64Type};
use rapid_core::action::ACTION_TOPIC;
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::observation::Observation;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::topic::FRAME_TOPIC;
use rapid_episode::encode;
use rapid_episode::schema::{FRAME, SampleSchema};
use rapid_episode::{sha256, text_map};
use rapid_pictures::pixels::{Picture, Pixels};
use rapid_registry::ExportSpec;
use rapid_status::Grade;
use rapid_status::session::Notes;

use super::cells::CellMaker;
use super::error::SetError;
use super::features::{Axis, Features, Known, MASK, Origin, PLUGGED, STATE, VALID};
use super::picture::{Codec, Pictures, Shape};
use super::rows::{Form, Index, Listed, Refusal, Row};
use super::set::{DataSet, prepare};
use super::statistics::Column;
use super::survey::{Content, Stream, Survey, Verdicts, survey};
use super::table::{Position, Rows, Table};
use super::verify::verify;
use super::video::{Encoded, FrameMaker, Shown};

const BEGIN: u64 = 1_700_000_000_000_000_000;
const GREY: [u8; 8] = [0, 30, 60, 90, 120, 150, 180, 255];
const YUYV: [u8; 16] = [90, 100, 80, 140, 200, 128, 16, 128, 235, 90, 40, 200, 77, 33, 11, 99];
const CAMERA: &str = "observation.images.cam";

/// Writes messages with the topic's own numbers.
struct Recording {
    path: PathBuf,
    writer: mcap::Writer<std::io::BufWriter<File>>,
    message: Vec<u8>,
    /// The tick at which devices without a sample are plugged in: their drivers do not run. At others they are unplugged.
    crashed: u32,
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
        Self { path, writer, message: Vec::new(), crashed: 3 }
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
            slot.plugged = seq.is_some() || number == self.crashed;
            observation.mask = PhysicalMask(observation.mask.0 | u64::from(seq.is_some()) << slot.id.bit());
        }
        let at_ms = u64::from(number) * 100;
        encode::frame(&mut self.message, BEGIN + at_ms * 1_000_000, number.into(), &observation);
        self.write((FRAME.name, FRAME.data), FRAME_TOPIC, None, number, at_ms);
    }

    fn sample(&mut self, bit: Option<u8>, sequence: u32, encoding: Encoding, payload: &[u8]) {
        self.sized(bit, sequence, encoding, [4, 2], payload);
    }

    fn sized(&mut self, bit: Option<u8>, sequence: u32, encoding: Encoding, [width, height]: [u32; 2], payload: &[u8]) {
        let header = SampleHeader { encoding: encoding as u32, width, height, ..SampleHeader::default() };
        let kind = SampleSchema::for_sample(&header, payload);
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
    rapid_pictures::jpeg::encode(&[200; 8], [2, 4], rapid_pictures::jpeg::Values::Grey, 90, &mut jpeg).unwrap();
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
        action: Vec::new(),
        choice: ExportSpec::default(),
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
        [(Shown::Picture, true, true, true), (Shown::Black, false, true, false), (Shown::Black, false, false, false)];
    assert_eq!(found, expected);
}

fn axis(origin: Origin, at: usize) -> Axis {
    Axis { origin, at, name: String::new() }
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

/// Of an episode without statistics.
fn surveyed(path: &Path, task: &str) -> Survey {
    let index = Index::read(path, &AtomicBool::new(false)).unwrap();
    let none = Column::default();
    let stream = |listed: &Listed| Stream {
        name: listed.name.clone(),
        content: Content::Bytes,
        names: Vec::new(),
        columns: Vec::new(),
        present: none,
        plugged: none,
        valid: none,
        age: none,
    };
    Survey {
        file: path.to_owned(),
        bytes: 0,
        sha256: sha256(path).unwrap(),
        grade: Grade::Good,
        noted: Notes::default(),
        rows: index.ticks.len(),
        unusable: 0,
        unfit: Vec::new(),
        fps: index.fps,
        task: task.to_owned(),
        streams: index.modalities.iter().map(stream).collect(),
        export: ExportSpec::default(),
        unread_registry: None,
        action_names: Vec::new(),
        action: None,
        time_ns: none,
        kinds: index.modalities.iter().map(|modality| modality.kind).collect(),
        bits: Vec::new(),
        topics: Vec::new(),
    }
}

#[test]
fn rows_that_were_prepared_for_another_position_are_written_again() {
    let folder = tempfile::tempdir().unwrap();
    let recorded = |name: &str, value: f64, crashed: u32| {
        let folder = folder.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        let mut recording = Recording { crashed, ..Recording::new(&folder) };
        for number in 0..3 {
            recording.frame(number, [None, Some(number.into())]);
            recording.numbers(Some(4), number, &[value]);
        }
        recording.end()
    };
    let (first, second) = (recorded("first", 1.0, 1), recorded("second", 2.0, 1));
    let (first, second) = (surveyed(&first, "push"), surveyed(&second, "pull"));
    let features = Features {
        fps: first.fps,
        modalities: vec!["cam".to_owned(), "force".to_owned()],
        cameras: Vec::new(),
        pictures: Pictures::Files,
        state: vec![axis(Origin::Modality(1), 0)],
        action: Vec::new(),
        choice: ExportSpec::default(),
    };
    let stop = AtomicBool::new(false);
    // Of the second episode alone, prepared for its position behind others.
    let appended = |name: &str, others: &[&Survey]| {
        let out = folder.path().join(name);
        let mut set = DataSet::open(&out).unwrap();
        set.begin().unwrap();
        let position = *set.positions(others.iter().copied().chain([&second])).last().unwrap();
        let prepared = prepare(&out, &second, &features, position, Encoded::default(), &stop).unwrap();
        assert_eq!(set.append(&second, &features, prepared, &stop).unwrap(), 0);
        let different = |file: &Path| verify(&set, 0, file, None, &stop).unwrap().differences;
        assert_eq!(different(&second.file), []);
        let of_state = different(&first.file);
        assert!(of_state.len() == 3 && of_state.iter().all(|found| found.feature.as_deref() == Some(STATE)));
        // At the other tick the camera is plugged in, and its driver does not run.
        let of_plugged = different(&recorded(&format!("{name} crashed"), 2.0, 2));
        let of_plugged: Vec<_> = of_plugged.iter().map(|found| (found.frame, found.feature.as_deref())).collect();
        assert_eq!(of_plugged, [1, 2].map(|frame| (Some(frame), Some(PLUGGED))));
        let files = ["data/chunk-000/file-000.parquet", "meta/tasks.parquet"];
        (position, files.map(|file| std::fs::read(out.join(file)).unwrap()))
    };
    let ((position, again), (first_position, once)) = (appended("again", &[&first]), appended("once", &[]));
    assert_eq!(position, Position { episode: 1, first: 3, task: 1 });
    assert_eq!(first_position, Position { episode: 0, first: 0, task: 0 });
    assert!(again == once, "they differ");
    let mut set = DataSet::open(&folder.path().join("stopped")).unwrap();
    let prepared = prepare(set.folder(), &first, &features, first_position, Encoded::default(), &stop).unwrap();
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    let refused = set.append(&first, &features, prepared, &stop);
    assert!(matches!(refused, Err(SetError::Refused(Refusal::Interrupted))), "{refused:?}");
    assert_eq!(set.episodes(), 0);
}

/// Writes a file of a folder, with the folders on the way.
fn put(folder: &Path, file: &str, contents: &[u8]) -> PathBuf {
    let path = folder.join(file);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(&path, contents).unwrap();
    path
}

#[test]
fn what_a_killed_export_left_is_removed_when_the_set_is_opened() {
    let folder = tempfile::tempdir().unwrap();
    let left = [
        "data/chunk-000/.file-003.parquet.tmp",
        "data/chunk-012/.file-000.parquet.tmp",
        "videos/observation.images.cam/.file-003.mp4.tmp",
        "videos/observation.images.cam/.0a9f.mp4.tmp",
        "meta/.stats.json.4711.tmp",
        "meta/episodes/chunk-000/.file-000.parquet.4711.123456789.tmp",
    ];
    let new = folder.path().join("new");
    let in_new = left.map(|file| put(&new, file, b"rows"));
    // Nothing is appended.
    drop(DataSet::open(&new).unwrap());
    assert_eq!(in_new.map(|path| path.exists()), [false; 6]);
    // A folder of something else is left as it is.
    let other = put(&new, left[0], b"rows");
    put(&new, "notes.txt", b"mine");
    DataSet::open(&new).unwrap_err();
    assert!(other.exists());
    // Beside a dataset other files are left alone.
    let set = folder.path().join("set");
    exported(&set, &[recorded(folder.path(), "a", [true, true], [0.0; 3])]);
    let in_set = left.map(|file| put(&set, file, b"rows"));
    let kept = [
        "README.md",
        "data/mine/.notes.tmp",
        "data/chunk-000/notes.tmp",
        "data/chunk-000/.notes.tmp",
        "videos/mine/.notes.tmp",
        "meta/notes.json",
    ];
    let kept = kept.map(|file| put(&set, file, b"mine"));
    assert_eq!(DataSet::open(&set).unwrap().episodes(), 1);
    assert_eq!((in_set.map(|path| path.exists()), kept.map(|path| path.exists())), ([false; 6], [true; 6]));
}

/// All that is in a folder, with what it holds or leads to.
fn everything(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        let (path, kind) = (entry.path(), entry.file_type().unwrap());
        if kind.is_symlink() {
            found.insert(path.clone(), std::fs::read_link(&path).unwrap().into_os_string().into_encoded_bytes());
        } else if kind.is_dir() {
            found.extend(everything(&path));
            found.insert(path, Vec::new());
        } else {
            found.insert(path.clone(), std::fs::read(&path).unwrap());
        }
    }
    found
}

/// Something of another program in a place of the dataset.
#[derive(Debug, Clone, Copy)]
enum Strange {
    File(&'static str),
    Folder(&'static str),
    /// To a folder of somebody else, or to a file in it.
    Link(&'static str),
}

impl Strange {
    fn put(self, set: &Path, elsewhere: &Path) {
        match self {
            Self::File(file) => drop(put(set, file, b"of somebody else")),
            Self::Folder(file) => std::fs::create_dir_all(set.join(file)).unwrap(),
            Self::Link(file) => {
                std::fs::create_dir_all(set.join(file).parent().unwrap()).unwrap();
                let is_file = file.contains(".parquet") || file.contains(".json");
                let target = if is_file { elsewhere.join("theirs") } else { elsewhere.to_owned() };
                std::os::unix::fs::symlink(target, set.join(file)).unwrap();
            }
        }
    }
}

#[test]
fn an_export_does_not_touch_what_it_did_not_write() {
    use Strange::{File, Folder, Link};
    let folder = tempfile::tempdir().unwrap();
    let elsewhere = folder.path().join("elsewhere");
    put(&elsewhere, "theirs", b"of somebody else");
    let episodes = ["a", "b"].map(|name| recorded(folder.path(), name, [true, true], [0.0; 3]));
    let [first, second] = &episodes;
    // In the place of a new dataset.
    let of_new = [
        File("data/chunk-000/file-000.parquet"),
        File("data/chunk-000/file-007.parquet"),
        File("data/train.csv"),
        File("data"),
        File("meta/info.json.old"),
        File("meta/tasks.parquet"),
        File("meta/stats.json"),
        File("meta/episodes/chunk-000/file-000.parquet"),
        File("videos/observation.images.cam/chunk-000/file-000.mp4"),
        Folder("data/chunk-000/file-000.parquet"),
        Folder("mine"),
        Link("data"),
        Link("data/chunk-000"),
        Link("data/chunk-000/file-000.parquet"),
        Link("meta"),
        Link("meta/episodes"),
        Link("meta/tasks.parquet"),
        Link("videos"),
    ];
    // In the place of the second episode of a dataset of one, or of what is written again with it.
    let of_second = [
        File("data/chunk-000/file-001.parquet"),
        File("data/chunk-000/file-001.parquet/mine"),
        File("data/chunk-001/file-000.parquet"),
        File("videos/observation.images.cam/chunk-000/file-001.mp4"),
        File("meta/episodes/chunk-000/file-002.parquet"),
        Folder("meta/episodes/chunk-000/file-002.parquet"),
        Link("data/chunk-000/file-001.parquet"),
        Link("data/chunk-001"),
        Link("videos/observation.images.cam"),
    ];
    let of_new = of_new.into_iter().map(|strange| (strange, None));
    let all = of_new.chain(of_second.into_iter().map(|strange| (strange, Some(first))));
    for (number, (strange, before)) in all.enumerate() {
        let out = folder.path().join(format!("set {number}"));
        if let Some(first) = before {
            exported(&out, std::slice::from_ref(first));
        }
        strange.put(&out, &elsewhere);
        let found = everything(folder.path());
        let refused = DataSet::open(&out).map(|set| set.episodes()).map_err(|error| error.to_string());
        assert!(
            refused.as_ref().is_err_and(|text| text.contains("--out takes a new folder")),
            "{strange:?}: {refused:?}"
        );
        assert!(everything(folder.path()) == found, "{strange:?}");
    }
    // Put there while the set is open, and there before the rows get their name.
    let out = folder.path().join("meanwhile");
    exported(&out, std::slice::from_ref(first));
    let stop = AtomicBool::new(false);
    let mut set = DataSet::open(&out).unwrap();
    let survey = survey(second, sha256(second).unwrap(), Verdicts::All, &stop).unwrap();
    let features = set.features().unwrap().clone();
    let position = set.positions([&survey])[0];
    let prepared = prepare(&out, &survey, &features, position, Encoded::default(), &stop).unwrap();
    let theirs = put(&out, "data/chunk-000/file-001.parquet", b"of somebody else");
    set.append(&survey, &features, prepared, &stop).unwrap_err();
    assert_eq!(std::fs::read(&theirs).unwrap(), b"of somebody else");
}

#[test]
fn a_dataset_without_its_info_is_not_begun_anew() {
    let folder = tempfile::tempdir().unwrap();
    let episodes = ["a", "b"].map(|name| recorded(folder.path(), name, [true, true], [0.0; 3]));
    let out = folder.path().join("set");
    exported(&out, &episodes);
    std::fs::remove_file(out.join("meta/info.json")).unwrap();
    let found = everything(&out);
    let refused = DataSet::open(&out).unwrap_err().to_string();
    assert!(refused.contains("file-001.parquet: of a dataset without its meta/info.json"), "{refused}");
    assert!(everything(&out) == found);
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
        state: vec![axis(Origin::Modality(1), 0)],
        pictures: Pictures::Files,
        action: vec![axis(Origin::Topic, 1), axis(Origin::Modality(1), 0), axis(Origin::Topic, 0)],
        choice: ExportSpec::default(),
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
        let plugged = if number == 4 { vec![1.0, 0.0] } else { vec![1.0, 1.0] };
        assert_eq!(row.numbers(PLUGGED).unwrap(), plugged, "{number}");
        // A feature of one number is a plain column.
        assert_eq!(row.numbers(STATE).unwrap(), [force], "{number}");
        assert_eq!((row.numbers(MASK).unwrap(), row.numbers(VALID).unwrap()), (mask.into(), valid.into()), "{number}");
        assert_eq!(row.numbers("action").unwrap(), [2.0, force, 1.0], "{number}");
        let own = ["episode_index", "frame_index", "index", "task_index"].map(|key| row.integer(key).unwrap());
        assert_eq!(own, [3, number, 70 + number, 1]);
    }
    assert!(rows.advance().unwrap().is_none());
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    assert!(matches!(Index::read(&path, &stop), Err(Refusal::Interrupted)));
}

/// An episode in which devices that are not in `present` never were.
fn recorded(folder: &Path, name: &str, present: [bool; 2], values: [f64; 3]) -> PathBuf {
    let folder = folder.join(name);
    std::fs::create_dir(&folder).unwrap();
    let mut recording = Recording::new(&folder);
    for (number, value) in (0..).zip(values) {
        recording.frame(number, present.map(|is_present| is_present.then_some(number.into())));
        if present[0] {
            recording.sample(Some(0), number, Encoding::Grey, &GREY);
        }
        if present[1] {
            recording.numbers(Some(4), number, &[value]);
        }
    }
    recording.end()
}

/// These episodes as a new dataset, which is compared with them.
fn exported(out: &Path, episodes: &[PathBuf]) -> Vec<Survey> {
    let stop = AtomicBool::new(false);
    let surveys: Vec<Survey> =
        episodes.iter().map(|path| survey(path, sha256(path).unwrap(), Verdicts::All, &stop).unwrap()).collect();
    let mut set = DataSet::open(out).unwrap();
    set.begin().unwrap();
    for (number, episode) in surveys.iter().enumerate() {
        let choice = ExportSpec::default();
        let features = Features::from_survey(episode, &choice, Pictures::Files, &Known::default()).unwrap();
        let position = set.positions([episode])[0];
        let prepared = prepare(out, episode, &features, position, Encoded::default(), &stop).unwrap();
        assert_eq!(set.append(episode, &features, prepared, &stop).unwrap(), number);
        assert_eq!(verify(&set, number, &episode.file, None, &stop).unwrap().differences, []);
    }
    surveys
}

/// The statistics of a feature, by their name.
type Named = BTreeMap<String, Vec<f64>>;

/// All numbers of a list of lists, of any depth.
fn flat_numbers(value: &serde_json::Value) -> Vec<f64> {
    match value {
        serde_json::Value::Array(values) => values.iter().flat_map(flat_numbers).collect(),
        // What is not finite is null in JSON.
        value => vec![value.as_f64().unwrap_or(f64::NAN)],
    }
}

/// `meta/stats.json`, by feature.
fn statistics_of_set(out: &Path) -> BTreeMap<String, Named> {
    let text = std::fs::read_to_string(out.join("meta/stats.json")).unwrap();
    let all: BTreeMap<String, BTreeMap<String, serde_json::Value>> = serde_json::from_str(&text).unwrap();
    let flat = |named: BTreeMap<String, serde_json::Value>| {
        named.into_iter().map(|(name, value)| (name, flat_numbers(&value))).collect()
    };
    all.into_iter().map(|(key, named)| (key, flat(named))).collect()
}

/// `stats/...` of an episode's facts, by feature.
fn statistics_of_episode(out: &Path, episode: usize) -> BTreeMap<String, Named> {
    let path = out.join(format!("meta/episodes/chunk-000/file-{episode:03}.parquet"));
    let batch = super::table::one_row(&path).unwrap().unwrap();
    let mut all = BTreeMap::<String, Named>::new();
    for (field, column) in batch.schema().fields().iter().zip(batch.columns()) {
        let Some((key, name)) = field.name().strip_prefix("stats/").and_then(|key| key.rsplit_once('/')) else {
            continue;
        };
        let mut values = Arc::clone(column.as_list::<i32>().values());
        while let Some(lists) = values.as_list_opt::<i32>() {
            values = Arc::clone(lists.values());
        }
        let wide = |value: &i64| f64::from(i32::try_from(*value).unwrap());
        let numbers = match values.as_primitive_opt::<Float64Type>() {
            Some(floats) => floats.values().to_vec(),
            None => values.as_primitive::<Int64Type>().values().iter().map(wide).collect(),
        };
        all.entry(key.to_owned()).or_default().insert(name.to_owned(), numbers);
    }
    all
}

/// `lerobot.datasets.compute_stats.aggregate_feature_stats` of `lerobot` 0.4.4.
fn aggregated(parts: &[&Named]) -> Named {
    let count = |part: &Named| part["count"][0];
    let total: f64 = parts.iter().map(|part| count(part)).sum();
    let columns = parts[0]["mean"].len();
    let weighted = |value: &dyn Fn(&Named, usize) -> f64| -> Vec<f64> {
        let mean = |at| parts.iter().map(|part| value(part, at) * count(part)).sum::<f64>() / total;
        (0..columns).map(mean).collect()
    };
    let mean = weighted(&|part, at| part["mean"][at]);
    let variance = weighted(&|part, at| part["std"][at].powi(2) + (part["mean"][at] - mean[at]).powi(2));
    let mut all: Named = parts[0]
        .keys()
        .filter(|name| name.starts_with('q'))
        .map(|name| (name.clone(), weighted(&|part, at| part[name][at])))
        .collect();
    for (name, worst) in [("min", f64::min as fn(f64, f64) -> f64), ("max", f64::max)] {
        let of = |at: usize| parts.iter().map(|part| part[name][at]).reduce(worst).unwrap();
        all.insert(name.to_owned(), (0..columns).map(of).collect());
    }
    all.insert("std".to_owned(), variance.into_iter().map(f64::sqrt).collect());
    all.extend([("mean".to_owned(), mean), ("count".to_owned(), vec![total])]);
    all
}

#[test]
fn statistics_are_finite_after_lerobot_has_merged_them() {
    let folder = tempfile::tempdir().unwrap();
    // Which of camera and force are there, by episode.
    let [both, camera, force, none] = [[true, true], [true, false], [false, true], [false, false]];
    let sets =
        [vec![both], vec![camera], vec![force], vec![none], vec![none, none], vec![none, both], vec![force, camera]];
    let mut of_sets = Vec::new();
    for (number, episodes) in sets.iter().enumerate() {
        let out = folder.path().join(format!("set {number}"));
        let record = |(at, present): (usize, &[bool; 2])| {
            recorded(folder.path(), &format!("{number} {at}"), *present, [1.0 + at as f64, 2.0, number as f64])
        };
        let files: Vec<PathBuf> = episodes.iter().enumerate().map(record).collect();
        exported(&out, &files);
        let of_episodes: Vec<_> = (0..episodes.len()).map(|at| statistics_of_episode(&out, at)).collect();
        let of_set = statistics_of_set(&out);
        for key in of_set.keys() {
            // As its tools do it that split a set, and that remove an episode.
            let parts: Vec<&Named> = of_episodes.iter().map(|episode| &episode[key]).collect();
            finite(key, &aggregated(&parts));
        }
        of_sets.push(of_set);
    }
    // As its tool does it that joins sets, each with itself and with each other.
    for (a, b) in of_sets.iter().flat_map(|a| of_sets.iter().map(move |b| (a, b))) {
        for key in a.keys() {
            finite(key, &aggregated(&[&a[key], &b[key]]));
        }
    }
}

fn finite(key: &str, statistics: &Named) {
    for (name, values) in statistics {
        assert!(!values.is_empty() && values.iter().all(|value| value.is_finite()), "{key}, {name}: {values:?}");
    }
    assert!(statistics["count"][0] >= 1.0, "{key}");
}

/// A sample of the camera, of the force sensor, or an action, and its size.
#[derive(Clone)]
enum Sent {
    Picture(Encoding, [u32; 2], Vec<u8>),
    Numbers(Vec<f64>),
    Action(Vec<f64>),
}

fn jpeg(shape: [u16; 2], values: rapid_pictures::jpeg::Values) -> Vec<u8> {
    let channels = if values == rapid_pictures::jpeg::Values::Grey { 1 } else { 3 };
    let mut jpeg = Vec::new();
    let pixels = shape.map(usize::from).iter().product::<usize>();
    rapid_pictures::jpeg::encode(&vec![90; channels * pixels], shape, values, 90, &mut jpeg).unwrap();
    jpeg
}

/// An episode of five rows with a JPEG, a number and an action in each, but for `other` in the row `at`.
fn with_another(folder: &Path, name: &str, other: &Sent, at: u32) -> PathBuf {
    let folder = folder.join(name);
    std::fs::create_dir(&folder).unwrap();
    let mut recording = Recording::new(&folder);
    let usual = [
        Sent::Picture(Encoding::Mjpeg, [4, 2], jpeg([2, 4], rapid_pictures::jpeg::Values::Rgb)),
        Sent::Numbers(vec![0.5]),
        Sent::Action(vec![1.0, 2.0]),
    ];
    for number in 0..5 {
        recording.frame(number, [Some(number.into()); 2]);
        for sent in &usual {
            let is_other = number == at && std::mem::discriminant(sent) == std::mem::discriminant(other);
            match if is_other { other } else { sent } {
                Sent::Picture(encoding, size, bytes) => recording.sized(Some(0), number, *encoding, *size, bytes),
                Sent::Numbers(numbers) => recording.numbers(Some(4), number, numbers),
                Sent::Action(numbers) => recording.numbers(None, number, numbers),
            }
        }
    }
    recording.end()
}

#[test]
fn a_sample_that_cannot_be_exported_is_one_row_and_is_named() {
    use rapid_pictures::jpeg::Values;
    let folder = tempfile::tempdir().unwrap();
    let whole = jpeg([2, 4], Values::Rgb);
    let picture = |size: [u32; 2], bytes: &[u8]| Sent::Picture(Encoding::Mjpeg, size, bytes.to_vec());
    let cases = [
        (
            "size",
            picture([16, 8], &jpeg([8, 16], Values::Rgb)),
            "cam: 1 frame (a picture of 16x8, and not a picture of 4x2)",
        ),
        (
            "grey",
            picture([4, 2], &jpeg([2, 4], Values::Grey)),
            "cam: 1 frame (a picture of 4x2 grey, and not a picture of 4x2)",
        ),
        (
            "raw",
            Sent::Picture(Encoding::Yuyv, [2, 2], YUYV[..8].to_vec()),
            "cam: 1 frame (a picture of 2x2, and not a picture of 4x2)",
        ),
        ("cut", picture([4, 2], &whole[..whole.len() - 2]), "cam: 1 frame (damaged)"),
        ("no header", picture([4, 2], &whole[..9]), "cam: 1 frame (damaged)"),
        ("empty", picture([4, 2], &[]), "cam: 1 frame (damaged)"),
        ("depth", Sent::Picture(Encoding::Depth, [4, 2], vec![0; 16]), "cam: 1 frame (damaged)"),
        ("longer", Sent::Numbers(vec![1.0, 2.0]), "force: 1 frame (2 numbers, and not 1 number)"),
        ("none", Sent::Numbers(vec![]), "force: 1 frame (damaged)"),
        ("endless", Sent::Numbers(vec![f64::INFINITY]), "force: 1 frame (damaged)"),
        ("three", Sent::Action(vec![1.0, 2.0, 3.0]), "/action: 1 message (3 numbers, and not 2)"),
        ("no action", Sent::Action(vec![]), "/action: 1 message (0 numbers, and not 2)"),
        ("not finite", Sent::Action(vec![1.0, f64::NAN]), "/action: 1 message (a number that is not finite)"),
    ];
    // Also the first one, which was what the others had to be as.
    for ((name, other, expected), at) in cases.iter().flat_map(|case| [0, 3].map(|at| (case, at))) {
        let name = format!("{name} {at}");
        let episode = with_another(folder.path(), &name, other, at);
        let out = folder.path().join(format!("{name} set"));
        let survey = exported(&out, &[episode]).remove(0);
        assert_eq!(survey.unfit.iter().map(ToString::to_string).collect::<Vec<_>>(), [*expected], "{name}");
        let is_action = expected.starts_with("/action");
        assert_eq!(survey.unusable, u64::from(!is_action), "{name}");
        let mut rows = Rows::open(File::open(out.join("data/chunk-000/file-000.parquet")).unwrap()).unwrap();
        for number in 0..5 {
            let row = rows.advance().unwrap().expect("a row");
            let is_other = number == at;
            let [camera, force] = [expected.starts_with("cam"), expected.starts_with("force")].map(|is| is && is_other);
            let flag = |is_unfit: bool| if is_unfit { 0.0 } else { 1.0 };
            assert_eq!(row.numbers(VALID).unwrap(), [flag(camera), flag(force)], "{name} {number}");
            assert_eq!(row.numbers(MASK).unwrap(), [1.0, 1.0], "{name} {number}");
            assert_eq!(row.numbers(STATE).unwrap(), [0.5 * flag(force)], "{name} {number}");
            // The action before it stays in force.
            assert_eq!(row.numbers("action").unwrap(), [1.0, 2.0], "{name} {number}");
            let found = row.picture(CAMERA).unwrap();
            if camera { assert_eq!(decoded(found), [0; 24], "{name}") } else { assert_eq!(found, whole, "{name}") }
        }
    }
}

#[test]
fn the_form_of_a_sensor_is_that_of_most_rows_then_the_declared_one() {
    let shape = |width| Form::Picture(Shape::new(2, width, 3).unwrap());
    let of =
        |widths: &[u32], declared| Form::most_frequent(widths.iter().map(|width| shape(*width)), Some(shape(declared)));
    assert_eq!(of(&[8, 4, 4], 8), Some(shape(4)));
    assert_eq!(of(&[8, 4], 4), Some(shape(4)));
    assert_eq!(of(&[8, 4], 6), Some(shape(8)), "the first");
    assert_eq!(of(&[], 6), None);
}
