//! A policy whose output can be computed by hand records an episode of the simulated task in which the tactile sensor
//! is unplugged and plugged in again; changes made to the file must be found, and nothing else.

#[path = "../../tests/support/onnx.rs"]
mod onnx;

use std::io::Cursor;
use std::path::PathBuf;
use std::sync::Arc;

use rapid_core::action::ACTION_TOPIC;
use rapid_core::time::{Stamp, WallClock};
use rapid_core::topic::EVENT_TOPIC;
use rapid_episode::ABOUT;
use rapid_episode::decode::{self, Content, Kind, Scratch};
use rapid_episode::record::EpisodeRequest;
use rapid_episode::record::stepped::Stepped;
use rapid_status::Board;
use serde_json::Value;

use super::*;
use crate::lockstep::evaluate::{Bench, Condition, Configuration, Recording, Trial};

/// Trial with the same noise as a policy that watches.
const SEED: u64 = 0;
const ARM: &str = "/rapid/serial/arm";
const TACTILE: &str = "/rapid/camera/tactile";

struct Recorded {
    folder: tempfile::TempDir,
    bundle: Bundle,
    environment: Environment,
    bytes: Vec<u8>,
    trial: Trial,
}

/// Never interrupts.
struct Patient;

impl Watcher for Patient {
    fn at(&mut self, _: usize, _: usize) -> bool {
        true
    }
}

/// One message of a file, to be changed.
struct Message {
    topic: String,
    sequence: u32,
    log_time: u64,
    data: Vec<u8>,
}

impl Message {
    /// The event in it.
    fn event(&self) -> Option<Value> {
        let mut scratch = Scratch::default();
        let Some(Content::Event(event)) = decode::content(Kind::Event, &self.data, &mut scratch) else { return None };
        (self.topic == EVENT_TOPIC).then(|| serde_json::from_str(event.json).unwrap())
    }

    fn is_chunk(&self) -> bool {
        self.event().is_some_and(|event| event["event"] == "chunk")
    }

    /// Adds to the first of its numbers, the last bytes of a `rapid.Scalars` of four.
    fn add(&mut self, sum: f64) {
        let at = self.data.len() - 4 * 8;
        let number: [u8; 8] = self.data[at..at + 8].try_into().unwrap();
        self.data[at..at + 8].copy_from_slice(&(f64::from_le_bytes(number) + sum).to_le_bytes());
    }
}

impl Recorded {
    fn new() -> Self {
        Self::with_changes(&[])
    }

    /// Of a policy with these changes.
    fn with_changes(changes: &[onnx::Change<'_>]) -> Self {
        Self::with(&onnx::encoder(), changes)
    }

    /// Of a policy with this encoder.
    fn with(encoder: &[u8], changes: &[onnx::Change<'_>]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        onnx::write_graphs(&folder.path().join("bundle"), encoder, changes);
        let bundle = Bundle::load(&folder.path().join("bundle")).unwrap();
        let environment = Environment::open(None).expect("`make setup` fetches the library; then build again");
        let registry = Arc::new(Registry::task());
        let mut model = Model::load(&bundle, &environment, Computing::default()).unwrap();
        let configuration = Configuration::Dynamic;
        let mut bench = Bench { bundle: &bundle, registry: &registry, model: &mut model, configuration };
        let board = Arc::new(Board::new(&registry));
        let mut recorder = Stepped::new(Arc::clone(&registry), board, WallClock::now());
        let out = folder.path().to_owned();
        let request = EpisodeRequest { out, task: "sort".into(), ..EpisodeRequest::default() };
        let library = &environment.origin.to_string();
        let recording = Recording { recorder: &mut recorder, request: &request, library, begun: Stamp(9_000_000_000) };
        let (trial, report) = bench.record(Condition::HotReplug, SEED, recording).unwrap();
        assert!(trial.failure.is_none() && trial.counts.chunks > 5, "{trial:?}");
        let bytes = std::fs::read(&report.file).unwrap();
        Self { folder, bundle, environment, bytes, trial }
    }

    /// The file with its messages changed by `edit`, which decides which of them to keep, and its metadata by `about`.
    fn edited(
        &self,
        edit: impl FnMut(&mut Message) -> bool,
        about: impl Fn(&mut std::collections::BTreeMap<String, String>),
    ) -> Vec<u8> {
        self.edited_with(edit, about, &[])
    }

    /// The file as if the recording had begun with the second chunk, with these attachments.
    fn begun_later(&self, attachments: &[mcap::Attachment<'_>]) -> Vec<u8> {
        let begin = self.messages().into_iter().filter(Message::is_chunk).nth(1).unwrap().log_time;
        let about = |about: &mut std::collections::BTreeMap<String, String>| {
            let number = |key: &str| about[key].parse::<u64>().unwrap();
            let (wall, monotonic) = (number("begin_wall_ns"), number("begin_monotonic_ns"));
            about.insert("begin_wall_ns".into(), begin.to_string());
            about.insert("begin_monotonic_ns".into(), (monotonic + begin - wall).to_string());
        };
        self.edited_with(|message| message.log_time >= begin, about, attachments)
    }

    /// What is attached of the sample that is the reference of observation `key`: the message of its topic.
    fn attached(&self, key: &str, topic: &str, number: u64) -> mcap::Attachment<'static> {
        let is_it = |message: &Message| message.topic == topic && u64::from(message.sequence) == number;
        let Message { log_time, data, .. } = self.messages().into_iter().find(is_it).unwrap();
        let schema = if topic == ARM { "rapid.Scalars" } else { "foxglove.CompressedImage" };
        let media_type = format!("application/protobuf; messageType={schema}");
        let name = format!("reference/{key}");
        mcap::Attachment { log_time, create_time: log_time, name, media_type, data: data.into() }
    }

    fn edited_with(
        &self,
        mut edit: impl FnMut(&mut Message) -> bool,
        about: impl Fn(&mut std::collections::BTreeMap<String, String>),
        attachments: &[mcap::Attachment<'_>],
    ) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut writer = mcap::WriteOptions::new().compression(None).create(Cursor::new(&mut bytes)).unwrap();
        for record in mcap::read::LinearReader::new(&self.bytes).unwrap() {
            if let mcap::records::Record::Metadata(mut metadata) = record.unwrap()
                && metadata.name == ABOUT
            {
                about(&mut metadata.metadata);
                writer.write_metadata(&metadata).unwrap();
            }
        }
        for attachment in attachments {
            writer.attach(attachment).unwrap();
        }
        for message in mcap::MessageStream::new(&self.bytes).unwrap() {
            let mut message = message.unwrap();
            let (topic, data) = (message.channel.topic.clone(), message.data.to_vec());
            let mut changed = Message { topic, sequence: message.sequence, log_time: message.log_time, data };
            if edit(&mut changed) {
                message.data = changed.data.into();
                writer.write(&message).unwrap();
            }
        }
        writer.finish().unwrap();
        drop(writer);
        bytes
    }

    fn messages(&self) -> Vec<Message> {
        let mut messages = Vec::new();
        self.edited(
            |message| {
                let Message { topic, sequence, log_time, data } = message;
                let (topic, data) = (topic.clone(), data.clone());
                messages.push(Message { topic, sequence: *sequence, log_time: *log_time, data });
                true
            },
            |_| {},
        );
        messages
    }

    fn chunks(&self) -> Vec<Value> {
        let chunks = self.messages().into_iter().filter(Message::is_chunk);
        chunks.map(|message| message.event().unwrap()).collect()
    }

    /// Number of the first sample of observation `at` of a chunk.
    fn sample(chunk: &Value, at: usize) -> Option<u64> {
        chunk["samples"][at]["seqs"][0].as_u64()
    }

    fn file(&self, bytes: &[u8]) -> PathBuf {
        let file = self.folder.path().join("changed.mcap");
        std::fs::write(&file, bytes).unwrap();
        file
    }

    fn compared(&self, bytes: &[u8]) -> Result<Compared, CompareError> {
        compare(&self.file(bytes), &self.bundle, &self.environment, Computing::default(), &mut Patient)
    }

    fn again(&self, bytes: &[u8]) -> Again {
        match self.compared(bytes).unwrap().comparison {
            Comparison::Again(again) => again,
            Comparison::Beside(beside) => panic!("a demonstration: {beside:?}"),
        }
    }
}

#[test]
fn recorded_chunks_are_recomputed_and_changes_are_found() {
    let recorded = Recorded::new();
    let chunks = recorded.chunks();
    assert_eq!(chunks.len() as u64, recorded.trial.counts.chunks);
    let blind = chunks.iter().filter(|chunk| Recorded::sample(chunk, 1).is_none()).count() as u64;
    assert!((1..chunks.len() as u64).contains(&blind), "some without the tactile sensor: {blind}");

    let compared = recorded.compared(&recorded.bytes).unwrap();
    assert_eq!(compared.recorded_policy.as_deref(), Some("by-hand"));
    assert_eq!(compared.recorded_policy_hash.as_deref(), Some(recorded.bundle.hash.as_str()));
    assert!(compared.damage.is_none() && !compared.interrupted);
    let whole = recorded.again(&recorded.bytes);
    assert_eq!((whole.chunks, whole.compared), (chunks.len() as u64, chunks.len() as u64), "{whole:?}");
    assert!(whole.largest().unwrap() < 1e-6, "{whole:?}");
    assert_eq!(whole.difference.all.values, whole.compared * (onnx::HORIZON * onnx::ACTION) as u64);
    let actions = &whole.actions;
    assert_eq!((actions.compared, actions.without_chunk), (recorded.trial.counts.actions, 0), "{actions:?}");

    // An action that differs from the chunk.
    let tick = 20;
    let edit = |message: &mut Message| {
        if message.topic == ACTION_TOPIC && message.sequence == tick {
            message.add(0.25);
        }
        true
    };
    let changed = recorded.again(&recorded.edited(edit, |_| {}));
    let found = changed.actions.difference.axes[0].spread;
    assert!((found.largest - 0.25).abs() < 1e-6 && found.at_tick == u64::from(tick), "{found:?}");
    assert!(changed.difference.all.largest < 1e-6 && changed.actions.difference.axes[1].spread.largest < 1e-6);

    // Numbers of the arm that one chunk was computed from.
    let number = Recorded::sample(&chunks[3], 2).unwrap();
    let edit = |message: &mut Message| {
        if message.topic == ARM && u64::from(message.sequence) == number {
            message.add(0.5);
        }
        true
    };
    let changed = recorded.again(&recorded.edited(edit, |_| {}));
    assert!(changed.difference.all.largest > 1e-3 && changed.compared == whole.compared, "{changed:?}");

    // Without them it cannot be computed, but the others can.
    let keep = |message: &mut Message| message.topic != ARM || u64::from(message.sequence) != number;
    let changed = recorded.again(&recorded.edited(keep, |_| {}));
    let missing = chunks.iter().filter(|chunk| made_of_arm(chunk, number)).count() as u64;
    assert_eq!((changed.samples_missing, changed.compared), (missing, whole.compared - missing), "{changed:?}");
    assert!(changed.difference.all.largest < 1e-6, "{changed:?}");

    // The inputs that are written without a number are those of the first chunk that is whole.
    let number = Recorded::sample(&chunks[0], 2).unwrap();
    let first = chunks.iter().position(|chunk| !made_of_arm(chunk, number)).unwrap();
    let keep = |message: &mut Message| message.topic != ARM || u64::from(message.sequence) != number;
    let file = recorded.file(&recorded.edited(keep, |_| {}));
    let inputs = |number| {
        inputs(&file, &recorded.bundle, &recorded.environment, Computing::default(), number)
            .unwrap()
            .map(|it| it.number)
    };
    assert!(first > 0);
    assert_eq!((inputs(None), inputs(Some(0)), inputs(Some(first))), (Some(first), None, Some(first)));
}

/// Whether a chunk was computed from sample `number` of the arm.
fn made_of_arm(chunk: &Value, number: u64) -> bool {
    chunk["samples"][2]["seqs"].as_array().unwrap().contains(&number.into())
}

#[test]
fn the_reference_picture_is_the_first_one_or_unknown() {
    let recorded = Recorded::new();
    let chunks = recorded.chunks();
    let feeling: Vec<&Value> = chunks.iter().filter(|chunk| Recorded::sample(chunk, 1).is_some()).collect();
    let total = chunks.len() as u64;

    // The first chunk cannot be computed, but its tactile picture is still the reference.
    let arm = Recorded::sample(&chunks[0], 2).unwrap();
    let keep = |message: &mut Message| message.topic != ARM || u64::from(message.sequence) != arm;
    let changed = recorded.again(&recorded.edited(keep, |_| {}));
    assert_eq!((changed.samples_missing, changed.compared), (1, total - 1), "{changed:?}");
    assert!(changed.difference.all.largest < 1e-6, "{changed:?}");

    // Without that picture everything compared with it is unknown.
    let first = Recorded::sample(feeling[0], 1).unwrap();
    let keep = |message: &mut Message| message.topic != TACTILE || u64::from(message.sequence) != first;
    let changed = recorded.again(&recorded.edited(keep, |_| {}));
    assert_eq!((changed.samples_missing, changed.reference_unknown), (1, feeling.len() as u64 - 1), "{changed:?}");
    assert_eq!(changed.compared, total - feeling.len() as u64);
    assert!(changed.difference.all.largest < 1e-6, "{changed:?}");

    // The recording begins long after the policy.
    let changed = recorded.again(&recorded.begun_later(&[]));
    assert_eq!(changed.chunks, total - 1);
    assert!(changed.reference_unknown > 0 && changed.compared > 0 && changed.actions.without_chunk == 0, "{changed:?}");
    assert_eq!(changed.compared, total - feeling.len() as u64, "{changed:?}");
    assert!(changed.difference.all.largest < 1e-6, "{changed:?}");
}

/// Of pictures, of pictures in a history and of numbers.
#[test]
fn a_reference_from_before_the_episode_is_attached_to_it() {
    let first = onnx::Change { what: r#""slice": [0, 4],"#, with: r#""slice": [0, 4], "operation": "first_of_run","# };
    let history = || Recorded::with(&onnx::encoder_of_history(onnx::HISTORY_STEPS), &[onnx::HISTORY]);
    for (recorded, at, key, topic) in [
        (Recorded::new(), 1, "tactile", TACTILE),
        (history(), 1, "tactile", TACTILE),
        (Recorded::with_changes(&[first]), 2, "state", ARM),
    ] {
        let chunks = recorded.chunks();
        let of_chunk = |chunk: &Value, at: usize| {
            let seqs = chunk["samples"][at]["seqs"].as_array().unwrap().clone();
            seqs.iter().filter_map(Value::as_u64).collect::<Vec<u64>>()
        };
        // The other reference of the third policy.
        let tactile = || recorded.attached("tactile", TACTILE, of_chunk(&chunks[0], 1)[0]);
        let again = |attachment| recorded.again(&recorded.begun_later(&[attachment, tactile()]));
        let without = recorded.again(&recorded.begun_later(&[]));
        assert!(without.reference_unknown > 2, "{key}: {without:?}");
        let attached = recorded.attached(key, topic, of_chunk(&chunks[0], at)[0]);
        let with = again(attached);
        assert_eq!(
            (with.reference_unknown, with.compared),
            (0, without.compared + without.reference_unknown),
            "{key}: {with:?}"
        );
        assert!(with.largest().unwrap() < 1e-6, "{key}: {with:?}");

        // It is what is attached that counts, also where the first sample in the file would be another.
        let last = chunks.iter().rev().find_map(|chunk| of_chunk(chunk, at).last().copied()).unwrap();
        let wrong = again(recorded.attached(key, topic, last));
        assert!(wrong.difference.all.largest > 1e-5, "{key}: {wrong:?}");
        // One that cannot be read is ignored, as is that of another policy's observation.
        let [mut cut, mut foreign] = [(); 2].map(|()| recorded.attached(key, topic, last));
        cut.data.to_mut().truncate(9);
        foreign.name = "reference/other".to_owned();
        for none in [cut, foreign] {
            let unknown = recorded.again(&recorded.begun_later(&[none]));
            assert_eq!(unknown.reference_unknown, without.reference_unknown, "{key}: {unknown:?}");
        }
    }
}

/// Before the first chunk of such an episode is used, actions are of one that is not in it.
#[test]
fn actions_of_a_chunk_from_before_the_episode_are_not_compared() {
    let folder = tempfile::tempdir().unwrap();
    onnx::write_bundle(folder.path(), &[]);
    let bundle = Bundle::load(folder.path()).unwrap();
    let known_from = |chunks: &[(u64, bool, u64)], policy: Option<(String, String)>| {
        let chunk = |(tick, used, skipped): &(u64, bool, u64)| {
            serde_json::from_value(serde_json::json!({
                "tick": tick, "observed_ns": tick * 100_000_000, "mask": "0x07", "seed": 1, "samples": [], "actions": [],
                "used": used, "skipped": skipped,
            }))
            .unwrap()
        };
        let chunks = chunks.iter().map(chunk).collect();
        let survey = Survey { begin_monotonic_ns: Some(3_900_000_000), chunks, policy, ..Survey::default() };
        again::known_from(&survey, &bundle)
    };
    assert_eq!(known_from(&[(40, true, 0)], None), 41, "the action of its own tick is of the chunk before");
    assert_eq!(known_from(&[(40, true, 3), (48, true, 0)], None), 44, "so late");
    assert_eq!(known_from(&[(40, false, 0), (48, true, 1)], None), 50, "not used");
    assert_eq!(known_from(&[(40, false, 0)], None), u64::MAX);
    assert_eq!(known_from(&[(40, true, 0)], Some(("name".into(), "hash".into()))), 0, "it began in the episode");
    assert_eq!(known_from(&[(0, true, 0)], None), 0, "the first of the run");
}

#[test]
fn chunks_of_a_history_are_recomputed_with_its_gaps() {
    let recorded = Recorded::with(&onnx::encoder_of_history(onnx::HISTORY_STEPS), &[onnx::HISTORY]);
    let chunks = recorded.chunks();
    let steps = |chunk: &Value| -> Vec<Option<u64>> {
        chunk["samples"][1]["seqs"].as_array().unwrap().iter().map(Value::as_u64).collect()
    };
    let all: Vec<_> = chunks.iter().map(steps).collect();
    assert!(all.iter().all(|steps| steps.len() == onnx::HISTORY_STEPS), "{all:?}");
    let is_there = |steps: &Vec<Option<u64>>| steps.last().is_some_and(Option::is_some);
    let seen = |steps: &Vec<Option<u64>>| steps.iter().flatten().count();
    // Nothing before the run; without the sensor what it has felt is still seen; when it is back, not what it missed.
    let ticks = usize::try_from(chunks[0]["tick"].as_u64().unwrap()).unwrap();
    assert_eq!((is_there(&all[0]), seen(&all[0])), (true, ticks / 3 + 1), "{all:?}");
    let gone = all.iter().position(|steps| !is_there(steps)).unwrap();
    assert!(seen(&all[gone]) > 0, "{all:?}");
    let back = all.iter().skip(gone).find(|steps| is_there(steps)).unwrap();
    assert!(back[onnx::HISTORY_STEPS - 2].is_none(), "{all:?}");

    let whole = recorded.again(&recorded.bytes);
    assert_eq!((whole.chunks, whole.compared), (chunks.len() as u64, chunks.len() as u64), "{whole:?}");
    assert!(whole.largest().unwrap() < 1e-6, "{whole:?}");

    // What the graphs are given: zeros for each step without a sample, and which these are.
    let file = recorded.file(&recorded.bytes);
    let inputs =
        inputs(&file, &recorded.bundle, &recorded.environment, Computing::default(), Some(gone)).unwrap().unwrap();
    let of = |key: &str| inputs.observations.iter().find(|(name, _, _)| name == key).unwrap().clone();
    let (_, shape, valid) = of("tactile_valid");
    let expected: Vec<f32> = all[gone].iter().map(|seq| f32::from(u8::from(seq.is_some()))).collect();
    assert_eq!((shape, &valid), (vec![1, onnx::HISTORY_STEPS], &expected));
    let (_, shape, values) = of("tactile");
    assert_eq!(shape, [1, onnx::HISTORY_STEPS, 3, onnx::SIDE, onnx::SIDE]);
    for (step, valid) in values.chunks(values.len() / onnx::HISTORY_STEPS).zip(&valid) {
        assert!(*valid > 0.0 || step.iter().all(|value| *value == 0.0), "{step:?}");
    }
    assert_eq!(inputs.mask.unwrap().1, [1.0, 0.0], "the mask is of now");

    // The first picture of the history is the reference: without it nothing that is compared with it is known.
    let first = all[0].iter().flatten().next().copied().unwrap();
    let keep = |message: &mut Message| message.topic != TACTILE || u64::from(message.sequence) != first;
    let changed = recorded.again(&recorded.edited(keep, |_| {}));
    let feeling = all.iter().filter(|steps| seen(steps) > 0).count() as u64;
    assert_eq!(changed.samples_missing + changed.reference_unknown, feeling, "{changed:?}");
    assert_eq!(changed.compared, chunks.len() as u64 - feeling, "{changed:?}");
}

#[test]
fn the_first_numbers_of_a_run_stand_for_all_later_ones() {
    let first = onnx::Change { what: r#""slice": [0, 4],"#, with: r#""slice": [0, 4], "operation": "first_of_run","# };
    let recorded = Recorded::with_changes(&[first]);
    let chunks = recorded.chunks();
    let whole = recorded.again(&recorded.bytes);
    assert_eq!((whole.chunks, whole.compared), (chunks.len() as u64, chunks.len() as u64), "{whole:?}");
    assert!(whole.difference.all.largest < 1e-6, "{whole:?}");

    // Numbers of a later sample change nothing, those of the first sample everything.
    let with_changed = |number: u64| {
        let edit = |message: &mut Message| {
            if message.topic == ARM && u64::from(message.sequence) == number {
                message.add(0.5);
            }
            true
        };
        recorded.again(&recorded.edited(edit, |_| {}))
    };
    let later = with_changed(Recorded::sample(&chunks[3], 2).unwrap());
    assert!(later.difference.all.largest < 1e-6 && later.compared == whole.compared, "{later:?}");
    let first = Recorded::sample(&chunks[0], 2).unwrap();
    let changed = with_changed(first);
    // A difference of one chunk among all of them would be small in the mean.
    let of_all = |spread: &Spread| spread.largest > 1e-3 && spread.mean > spread.largest / 2.0;
    assert!(changed.difference.axes.iter().any(|axis| of_all(&axis.spread)), "{changed:?}");

    // Without it no chunk can be computed.
    let keep = |message: &mut Message| message.topic != ARM || u64::from(message.sequence) != first;
    let without = recorded.again(&recorded.edited(keep, |_| {}));
    assert_eq!(
        (without.compared, without.samples_missing + without.reference_unknown),
        (0, whole.compared),
        "{without:?}"
    );
}

#[test]
fn actions_without_chunks_are_compared_with_those_of_a_watching_policy() {
    let recorded = Recorded::new();
    // Its own actions without its chunks; those of the inference ticks came from the chunk before.
    let inferred: Vec<u64> = recorded.chunks().iter().map(|chunk| chunk["tick"].as_u64().unwrap()).collect();
    let mut kept = 0;
    let keep = |message: &mut Message| {
        let is_action = message.topic == ACTION_TOPIC;
        let dropped = message.is_chunk() || is_action && inferred.contains(&message.sequence.into());
        kept += u64::from(is_action && !dropped);
        !dropped
    };
    let bytes = recorded.edited(keep, |_| {});
    let compared = recorded.compared(&bytes).unwrap();
    let Comparison::Beside(beside) = compared.comparison else { panic!("of a policy") };
    assert_eq!((beside.recorded, beside.compared, beside.held.len()), (kept, kept, 0), "{beside:?}");
    assert_eq!((beside.ticks, beside.without_recorded), (recorded.trial.steps.into(), inferred.len() as u64));
    assert!(beside.difference.all.largest < 1e-6, "{beside:?}");

    let tick = 30;
    assert!(!inferred.contains(&tick));
    let edit = |message: &mut Message| {
        if message.topic == ACTION_TOPIC && u64::from(message.sequence) == tick {
            message.add(-0.5);
        }
        !message.is_chunk() && (message.topic != ACTION_TOPIC || !inferred.contains(&message.sequence.into()))
    };
    let Comparison::Beside(beside) = recorded.compared(&recorded.edited(edit, |_| {})).unwrap().comparison else {
        panic!("of a policy")
    };
    let found = beside.difference.axes[0].spread;
    assert!((found.largest - 0.5).abs() < 1e-6 && found.at_tick == tick, "{found:?}");

    // Without the mask no modality is present.
    let keep = |message: &mut Message| !message.is_chunk() && message.topic != rapid_core::mask::MASK_TOPIC;
    let Comparison::Beside(beside) = recorded.compared(&recorded.edited(keep, |_| {})).unwrap().comparison else {
        panic!("of a policy")
    };
    assert!(beside.compared == 0 && beside.held.values().sum::<u64>() == beside.ticks, "{beside:?}");
}

#[test]
fn a_damaged_file_is_compared_up_to_the_damage_and_a_foreign_one_rejected_by_name() {
    let recorded = Recorded::new();
    let cut = recorded.compared(&recorded.bytes[..recorded.bytes.len() * 2 / 3]).unwrap();
    assert!(cut.damage.as_ref().is_some_and(|damage| damage.contains("ends within a record")), "{cut:?}");
    let Comparison::Again(again) = &cut.comparison else { panic!("{cut:?}") };
    assert!(again.compared > 0 && again.largest().unwrap() < 1e-6, "{again:?}");
    // Any bytes may be wrong.
    for at in (0..recorded.bytes.len()).step_by(recorded.bytes.len() / 12) {
        let mut bytes = recorded.bytes.clone();
        bytes[at] ^= 0x55;
        if let Ok(Compared { comparison: Comparison::Again(again), damage, .. }) = recorded.compared(&bytes) {
            assert!(again.difference.all.largest < 1e-6, "at {at}, {damage:?}: {again:?}");
        }
    }

    let nothing = recorded.edited(|message| message.topic != ACTION_TOPIC && !message.is_chunk(), |_| {});
    let foreign = recorded.edited(|_| true, std::collections::BTreeMap::clear);
    let renamed = |about: &mut std::collections::BTreeMap<String, String>| {
        let registry = about["registry"].replace("tactile_tip", "fingertip");
        about.insert("registry".into(), registry);
    };
    let other = recorded.edited(|_| true, renamed);
    for (bytes, expected) in [
        (nothing, "nothing to compare with"),
        (foreign, "holds no registry"),
        (other, "\"tactile_tip\" is not in devices.toml"),
        (b"no episode".to_vec(), "not an MCAP file"),
    ] {
        let error = recorded.compared(&bytes).unwrap_err().to_string();
        assert!(error.contains("changed.mcap: ") && error.contains(expected), "{error}");
    }
}
