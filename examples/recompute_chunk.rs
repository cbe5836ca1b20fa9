//! Computes a chunk of actions that a policy gave in an episode once more, from the recording alone: the first one whose samples
//! are all in it. If the policy was already running when the episode began, some samples of the first chunks are not in it.
//!
//!     recompute_chunk EPISODE [POLICY]
//!
//! The event of a chunk names the samples that it was computed from, the mask and the seed of its noise
//! (docs/policies.md describes all of it). What is printed: the first numbers of the noise, and how far the chunk
//! computed here is from the recorded one. POLICY is the folder of the policy; by default the one inside `rapid`.

#![expect(clippy::print_stdout, reason = "a program's output is for its caller")]

use std::collections::BTreeMap;
use std::error::Error;
use std::path::Path;

use prost::Message;
use rapid_core::mask::PhysicalMask;
use rapid_core::random::Random;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_policy::bundle::{Bundle, ObservationInput};
use rapid_policy::compose::Composer;
use rapid_policy::model::Model;
use rapid_policy::onnxruntime::Environment;
use rapid_policy::request::Request;
use rapid_policy::sampler::Computing;
use serde::Deserialize;

/// The stream of the seed that noise is drawn from: ASCII "policy".
const NOISE: u64 = 0x706f_6c69_6379;

/// `rapid.Event`, as far as it is needed.
#[derive(Clone, PartialEq, Message)]
struct EventMessage {
    #[prost(string, tag = "2")]
    kind: String,
    #[prost(string, tag = "5")]
    json: String,
}

/// `foxglove.CompressedImage` and `rapid.Scalars`: the payload is field 2 of both.
#[derive(Clone, PartialEq, Message)]
struct SampleMessage {
    #[prost(bytes = "vec", tag = "2")]
    payload: Vec<u8>,
}

#[derive(Deserialize)]
struct Chunk {
    tick: u64,
    mask: String,
    seed: u64,
    samples: Vec<Observed>,
    /// Null where the answer of the policy gave none.
    actions: Vec<Option<f32>>,
}

#[derive(Deserialize)]
struct Observed {
    modality: String,
    /// Null for a step of a history without a sample.
    seqs: Vec<Option<u64>>,
}

/// A modality's entry in the metadata record `rapid`.
#[derive(Deserialize)]
struct Modality {
    name: String,
    topic: String,
    shape: Vec<u32>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args_os().skip(1);
    let file = arguments.next().ok_or("usage: recompute_chunk EPISODE [POLICY]")?;
    let bytes = std::fs::read(&file)?;
    let modalities = modalities(&bytes)?;
    let bundle = Bundle::open(arguments.next().as_deref().map(Path::new))?;
    let mut model = Model::load(&bundle, &Environment::open(None)?, Computing::default())?;
    let (chunks, samples) = contents(&bytes, &modalities)?;
    if chunks.is_empty() {
        return Err("the episode holds no chunk: no policy ran while it was recorded".into());
    }
    let whole = chunks.iter().find_map(|chunk| Some((chunk, request(chunk, &samples, &modalities, &bundle)?)));
    let (chunk, request) = whole.ok_or("no chunk of this policy has all of its samples in the episode")?;
    let has_all_references = take_references(&bytes, &modalities, &bundle, chunk, &mut model)?;
    if !has_all_references && chunk.tick > 0 {
        return Err(
            "the reference of an observation of this chunk is not attached, and may be from before the episode".into(),
        );
    }

    let mut output = vec![0.0; model.chunk_len()];
    let mut noise = output.clone();
    Random::new(chunk.seed, NOISE).fill_normal(&mut noise);
    model.answer(&request, &mut output)?;
    // What the network answers may be relative to a pose in the samples.
    let composer = Composer::new(&bundle);
    let mut computed = vec![0.0; composer.chunk_len()];
    composer.compose(&request, &output, &mut computed)?;
    if computed.len() != chunk.actions.len() {
        return Err("the chunk is of another policy".into());
    }
    let recorded: Vec<f32> = chunk.actions.iter().copied().flatten().collect();
    let apart = computed.iter().zip(&recorded).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max);
    println!("tick {}, mask {}, seed {}", chunk.tick, chunk.mask, chunk.seed);
    println!("noise begins {:?}", &noise[..noise.len().min(4)]);
    println!("action 0, recorded {:?}", &recorded[..bundle.action.len()]);
    println!("action 0, computed {:?}", &computed[..bundle.action.len()]);
    println!("largest difference of {} numbers: {apart:e}", computed.len());
    Ok(())
}

/// By modality and the number in the message, the payload of each sample.
type Samples = BTreeMap<(String, u32), Vec<u8>>;

/// The chunks and the samples of the file.
fn contents(bytes: &[u8], modalities: &[Modality]) -> Result<(Vec<Chunk>, Samples), Box<dyn Error>> {
    let (mut chunks, mut samples) = (Vec::new(), Samples::new());
    for message in mcap::MessageStream::new(bytes)? {
        let message = message?;
        let topic = &message.channel.topic;
        if let Some(modality) = modalities.iter().find(|modality| modality.topic == *topic) {
            // A raw picture is another message: as if it were not there.
            let Ok(sample) = SampleMessage::decode(&*message.data) else { continue };
            samples.entry((modality.name.clone(), message.sequence)).or_insert(sample.payload);
        } else if topic == "/rapid/event" {
            let event = EventMessage::decode(&*message.data)?;
            if event.kind == "chunk" {
                chunks.push(serde_json::from_str(&event.json)?);
            }
        }
    }
    Ok((chunks, samples))
}

/// What the policy was asked for; `None` if a sample is not in the file, an action is not a number, or the chunk is of another policy.
fn request(chunk: &Chunk, samples: &Samples, modalities: &[Modality], bundle: &Bundle) -> Option<Request> {
    let mut request = Request::new(bundle);
    request.tick = chunk.tick;
    request.seed = chunk.seed;
    request.mask = PhysicalMask(u64::from_str_radix(chunk.mask.trim_start_matches("0x"), 16).ok()?);
    for (at, observed) in chunk.samples.iter().enumerate() {
        // An absent modality has none.
        request.set_present(at, !observed.seqs.is_empty());
        for (step, seq) in observed.seqs.iter().enumerate() {
            // In a new request a step of a history has no sample.
            let Some(seq) = seq else { continue };
            // A message has the lower 32 bits of a sample's number.
            let number = u32::try_from(seq & 0xffff_ffff).ok()?;
            let payload = samples.get(&(observed.modality.clone(), number))?;
            let header = SampleHeader { seq: *seq, ..header(modalities, &observed.modality)? };
            request.cell_mut(at, step)?.set(&header, payload);
        }
    }
    chunk.actions.iter().all(Option::is_some).then_some(request)
}

/// Gives the policy its references, the attachments `reference/KEY`. Returns whether every observation of `chunk` that needs one
/// has one.
fn take_references(
    bytes: &[u8],
    modalities: &[Modality],
    bundle: &Bundle,
    chunk: &Chunk,
    model: &mut Model,
) -> Result<bool, Box<dyn Error>> {
    let mut has_all = true;
    let summary = mcap::Summary::read(bytes)?.ok_or("the episode is not finished: run rapid recover")?;
    for (at, observation) in bundle.observations.iter().enumerate() {
        let name = format!("reference/{}", observation.key);
        let Some(index) = summary.attachment_indexes.iter().find(|index| index.name == name) else {
            let is_used = chunk.samples.get(at).is_some_and(|observed| observed.seqs.iter().any(Option::is_some));
            let needs_one = match &observation.input {
                ObservationInput::Image(image) => image.operation.is_some(),
                ObservationInput::Vector(vector) => vector.operation.is_some(),
            };
            has_all &= !(is_used && needs_one);
            continue;
        };
        let message = SampleMessage::decode(&*mcap::read::attachment(bytes, index)?.data)?;
        let header = header(modalities, &observation.modality).ok_or("the policy is of another rig")?;
        let mut request = Request::new(bundle);
        request.set_present(at, true);
        for step in 0..request.steps(at) {
            request.cell_mut(at, step).ok_or("the policy has no such step")?.set(&header, &message.payload);
        }
        model.observe(&request)?;
    }
    Ok(has_all)
}

/// How the samples of a modality are encoded.
fn header(modalities: &[Modality], name: &str) -> Option<SampleHeader> {
    let modality = modalities.iter().find(|modality| modality.name == name)?;
    let (encoding, width, height) = match *modality.shape.as_slice() {
        [height, width] => (Encoding::Mjpeg, width, height),
        _ => (Encoding::F64, 0, 0),
    };
    Some(SampleHeader { encoding: encoding as u32, width, height, ..SampleHeader::default() })
}

/// The modalities, from the metadata record `rapid`.
fn modalities(bytes: &[u8]) -> Result<Vec<Modality>, Box<dyn Error>> {
    let summary = mcap::Summary::read(bytes)?.ok_or("the episode is not finished: run rapid recover")?;
    for index in &summary.metadata_indexes {
        if index.name == "rapid" {
            let record = mcap::read::metadata(bytes, index)?;
            return Ok(serde_json::from_str(record.metadata.get("modalities").ok_or("no modalities")?)?);
        }
    }
    Err("no metadata: the file is not an episode".into())
}
