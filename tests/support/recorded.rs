//! A small episode, and what can happen to its bytes.

#![allow(clippy::unwrap_used, reason = "what fails here fails a test")]
#![allow(dead_code, reason = "each crate uses a part of it")]

use std::collections::BTreeMap;
use std::io::Cursor;

use proptest::prelude::*;
use proptest::sample::Index;

pub(crate) const BEGIN: u64 = 1_700_000_000_000_000_000;
pub(crate) const REGISTRY: &str = r#"
[device.tof]
vid = "0x10c4"
pid = 0xea60
serial_number = "T1"
node = "serial"
bit = 0
topic = "/rapid/tof"
[device.tof.tty]
channels = 1
[device.cam]
vid = "046d"
pid = "0825"
port = "1-2.3"
node = "camera"
bit = 3
topic = "/rapid/cam"
"#;

/// A `rapid.Scalars` of one value, by hand: field 2, length-delimited, eight bytes.
fn scalars(value: f64) -> Vec<u8> {
    [&[0x12, 8][..], &value.to_le_bytes()].concat()
}

/// A `rapid.Mask`, by hand: field 2, fixed64.
fn mask(bits: u64) -> Vec<u8> {
    [&[0x11][..], &bits.to_le_bytes()].concat()
}

/// Small chunks, so that there are several.
pub(crate) fn options() -> mcap::WriteOptions {
    mcap::WriteOptions::new().chunk_size(Some(512)).compression(Some(mcap::Compression::Zstd))
}

/// Every way to lay out a file.
pub(crate) fn layouts() -> [mcap::WriteOptions; 4] {
    [
        options(),
        options().compression(Some(mcap::Compression::Lz4)),
        options().compression(None),
        options().use_chunks(false),
    ]
}

/// 100 samples, 10 ms apart, and a mask that shows `tof` (bit 0) from the beginning, gone at 400 ms,
/// back at 700 ms; `cam` (bit 3) comes at 500 ms.
pub(crate) fn episode(options: mcap::WriteOptions) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut writer = options.create(Cursor::new(&mut bytes)).unwrap();
    let entries = [("layout", r#"{"tof":0,"cam":3}"#), ("registry", REGISTRY), ("task", "x")];
    let mut metadata: BTreeMap<_, _> =
        entries.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
    metadata.insert("begin_wall_ns".to_owned(), BEGIN.to_string());
    writer.write_metadata(&mcap::records::Metadata { name: "rapid".into(), metadata }).unwrap();
    let data = REGISTRY.as_bytes().into();
    let (name, media_type) = ("devices.toml".to_owned(), "application/toml".to_owned());
    writer.attach(&mcap::Attachment { log_time: BEGIN, create_time: BEGIN, name, media_type, data }).unwrap();
    let channel = |writer: &mut mcap::Writer<_>, topic: &str, schema: &str, modality: Option<&str>| {
        let schema = writer.add_schema(schema, "protobuf", b"").unwrap();
        let metadata = modality.map(|name| ("modality".to_owned(), name.to_owned())).into_iter().collect();
        writer.add_channel(schema, topic, "protobuf", &metadata).unwrap()
    };
    let tof = channel(&mut writer, "/rapid/tof", "rapid.Scalars", Some("tof"));
    let masks = channel(&mut writer, "/rapid/mask", "rapid.Mask", None);
    let mut write = |channel_id, sequence, at_ms: u64, data: &[u8]| {
        let log_time = BEGIN + at_ms * 1_000_000;
        let header = mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, data).unwrap();
    };
    for i in 0..100_u32 {
        let at = u64::from(i) * 10;
        let bits = u64::from(!(400..700).contains(&at)) | u64::from(at >= 500) << 3;
        write(masks, i, at, &mask(bits));
        write(tof, i, at, &scalars(f64::from(i)));
    }
    writer.finish().unwrap();
    drop(writer);
    bytes
}

/// One message as the strictest reader there is gives it.
pub(crate) type Message = (String, u32, u64, u64, Vec<u8>);

/// Every message of a whole file, in its order; the index must be right too.
pub(crate) fn strictly(bytes: &[u8]) -> Vec<Message> {
    let messages: Vec<Message> = mcap::MessageStream::new(bytes)
        .unwrap()
        .map(|message| {
            let message = message.unwrap();
            let (sequence, at, published) = (message.sequence, message.log_time, message.publish_time);
            (message.channel.topic.clone(), sequence, at, published, message.data.to_vec())
        })
        .collect();
    let summary = mcap::Summary::read(bytes).unwrap().unwrap();
    assert_eq!(summary.stats.as_ref().unwrap().message_count, messages.len() as u64);
    let indexed: usize = summary
        .chunk_indexes
        .iter()
        .filter(|chunk| !chunk.message_index_offsets.is_empty())
        .map(|chunk| summary.read_message_indexes(bytes, chunk).unwrap().values().map(Vec::len).sum::<usize>())
        .sum();
    assert!(indexed == messages.len() || summary.chunk_indexes.is_empty());
    messages
}

/// Metadata records of a whole file by name.
pub(crate) fn metadata(bytes: &[u8]) -> BTreeMap<String, BTreeMap<String, String>> {
    let summary = mcap::Summary::read(bytes).unwrap().unwrap();
    let records = summary.metadata_indexes.iter().map(|index| mcap::read::metadata(bytes, index).unwrap());
    records.map(|record| (record.name, record.metadata)).collect()
}

/// What can happen to bytes.
#[derive(Debug, Clone)]
pub(crate) enum Mutation {
    /// A bit changes.
    Flip(Index, u8),
    /// A length or count becomes another one.
    Word(Index, u64),
    /// The file ends here.
    Cut(Index),
    /// A part is zero, as after a loss of power.
    Zero(Index, usize),
    /// A part is missing.
    Drop(Index, usize),
    /// A part is there twice.
    Twice(Index, usize),
}

/// One to eight of them.
pub(crate) fn mutations() -> impl Strategy<Value = Vec<Mutation>> {
    let at = any::<Index>;
    let length = 1..600_usize;
    let word = prop_oneof![any::<u64>(), 0..4096_u64, Just(u64::MAX), Just(1 << 63), Just(1 << 32), Just(1 << 28)];
    let mutation = prop_oneof![
        4 => (at(), 0..8_u8).prop_map(|(at, bit)| Mutation::Flip(at, bit)),
        3 => (at(), word).prop_map(|(at, value)| Mutation::Word(at, value)),
        1 => at().prop_map(Mutation::Cut),
        1 => (at(), length.clone()).prop_map(|(at, length)| Mutation::Zero(at, length)),
        1 => (at(), length.clone()).prop_map(|(at, length)| Mutation::Drop(at, length)),
        1 => (at(), length).prop_map(|(at, length)| Mutation::Twice(at, length)),
    ];
    prop::collection::vec(mutation, 1..8)
}

/// `bytes` after all that has happened to them.
pub(crate) fn mutated(bytes: &[u8], mutations: &[Mutation]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for mutation in mutations {
        if bytes.is_empty() {
            break;
        }
        let size = bytes.len();
        let part = |at: &Index, length: usize| at.index(size)..(at.index(size) + length).min(size);
        match mutation {
            Mutation::Flip(at, bit) => bytes[at.index(size)] ^= 1 << bit,
            Mutation::Word(at, value) => {
                let range = part(at, 8);
                let count = range.len();
                bytes[range].copy_from_slice(&value.to_le_bytes()[..count]);
            }
            Mutation::Cut(at) => bytes.truncate(at.index(size)),
            Mutation::Zero(at, length) => bytes[part(at, *length)].fill(0),
            Mutation::Drop(at, length) => drop(bytes.drain(part(at, *length))),
            Mutation::Twice(at, length) => {
                let range = part(at, *length);
                let again = bytes[range.clone()].to_vec();
                bytes.splice(range.end..range.end, again);
            }
        }
    }
    bytes
}
