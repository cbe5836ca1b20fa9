//! Edits of an episode after which every check value is right again: what makes them no good episode is their content.

use std::collections::BTreeMap;
use std::io::Cursor;

use mcap::parse_record;
use mcap::records::op::{ATTACHMENT, DATA_END};
use mcap::records::{Metadata, Record};
use mcap::write::PrivateRecordOptions;

/// Channel, number and two times stand before the data of a message.
const MESSAGE_HEAD: usize = 22;

/// Opcode and content.
type Raw = (u8, Vec<u8>);

/// A part of a file, in the order of the file.
#[derive(Clone)]
enum Part {
    Metadata(Metadata),
    Attachment(Vec<u8>),
    Chunk(Vec<Raw>),
}

/// The records that `bytes` are.
fn records(mut bytes: &[u8]) -> Vec<Raw> {
    let mut records = Vec::new();
    while let Some((opcode, rest)) = bytes.split_first() {
        let (length, rest) = rest.split_first_chunk().expect("a length");
        let (content, rest) = rest.split_at(usize::try_from(u64::from_le_bytes(*length)).expect("a length"));
        records.push((*opcode, content.to_vec()));
        bytes = rest;
    }
    records
}

fn parts(bytes: &[u8]) -> Vec<Part> {
    let part = |(opcode, content): Raw| match parse_record(opcode, &content).expect("a record") {
        Record::Metadata(metadata) => Some(Part::Metadata(metadata)),
        Record::Attachment { .. } => Some(Part::Attachment(content)),
        Record::Chunk { data, .. } => Some(Part::Chunk(records(&data))),
        _ => None,
    };
    // Between the two magic numbers.
    let all = records(&bytes[8..bytes.len() - 8]);
    all.into_iter().take_while(|(opcode, _)| *opcode != DATA_END).filter_map(part).collect()
}

fn written(parts: &[Part], options: mcap::WriteOptions) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let options = options.compression(None).chunk_size(Some(16 << 20)).library("rapid/0.1.0");
    let mut writer = mcap::Writer::with_options(&mut file, options).expect("a writer");
    for part in parts {
        match part {
            Part::Metadata(metadata) => writer.write_metadata(metadata).expect("metadata"),
            Part::Attachment(content) => {
                let Ok(Record::Attachment { header, data, .. }) = parse_record(ATTACHMENT, content) else { panic!() };
                let (name, media_type) = (header.name, header.media_type);
                let (log_time, create_time) = (header.log_time, header.create_time);
                let attachment = mcap::Attachment { log_time, create_time, name, media_type, data };
                writer.attach(&attachment).expect("an attachment");
            }
            Part::Chunk(records) => {
                for (opcode, content) in records {
                    write(&mut writer, &parse_record(*opcode, content).expect("a record"));
                }
                writer.flush().expect("a chunk");
            }
        }
    }
    writer.finish().expect("an end");
    drop(writer);
    file.into_inner()
}

fn write(writer: &mut mcap::Writer<&mut Cursor<Vec<u8>>>, record: &Record<'_>) {
    match record {
        Record::Schema { header, data } => {
            writer.add_schema_with_id(header.id, &header.name, &header.encoding, data).expect("a schema");
        }
        Record::Channel(channel) => {
            let (topic, encoding) = (&channel.topic, &channel.message_encoding);
            writer
                .add_channel_with_id(channel.id, channel.schema_id, topic, encoding, &channel.metadata)
                .expect("a channel");
        }
        Record::Message { header, data } => writer.write_to_known_channel(header, data).expect("a message"),
        Record::Unknown { opcode, data } => {
            let options = PrivateRecordOptions::IncludeInChunks.into();
            writer.write_private_record(*opcode, data, options).expect("a private record");
        }
        _ => {}
    }
}

/// With the value of `key` in the metadata record `name` made another one.
fn with(parts: &[Part], name: &str, key: &str, change: impl Fn(&str) -> String) -> Vec<Part> {
    let mut parts = parts.to_vec();
    let of_name = |part: &mut Part| matches!(part, Part::Metadata(metadata) if metadata.name == name);
    let Some(Part::Metadata(metadata)) = parts.iter_mut().find_map(|part| of_name(part).then_some(part)) else {
        panic!("no {name}")
    };
    let value = metadata.metadata.get_mut(key).expect("the key");
    *value = change(value);
    parts
}

/// With the data of every message on a topic that ends in `topic` made empty.
fn emptied(parts: &[Part], topic: &str) -> Vec<Part> {
    let mut parts = parts.to_vec();
    let mut channels = BTreeMap::new();
    let chunks = parts.iter_mut().filter_map(|part| if let Part::Chunk(records) = part { Some(records) } else { None });
    let mut count = 0;
    for (opcode, content) in chunks.flatten() {
        match parse_record(*opcode, content).expect("a record") {
            Record::Channel(channel) => drop(channels.insert(channel.id, channel.topic)),
            Record::Message { header, .. }
                if channels.get(&header.channel_id).is_some_and(|of| of.ends_with(topic)) =>
            {
                content.truncate(MESSAGE_HEAD);
                count += 1;
            }
            _ => {}
        }
    }
    assert!(count > 0, "no message on {topic}");
    parts
}

fn split(parts: &[Part]) -> (Vec<Part>, Vec<Part>, Vec<Part>) {
    let is_chunk = |part: &Part| matches!(part, Part::Chunk(_));
    let (first, last) = (parts.iter().position(is_chunk), parts.iter().rposition(is_chunk));
    let (first, last) = (first.expect("a chunk"), last.expect("a chunk") + 1);
    (parts[..first].to_vec(), parts[first..last].to_vec(), parts[last..].to_vec())
}

/// `whole` written once more, which changes nothing; then each edit of it. `other`: another good episode of the rig.
pub(crate) fn edits(whole: &[u8], other: &[u8]) -> (Vec<u8>, Vec<(String, Vec<u8>)>) {
    let (whole, other) = (parts(whole), parts(other));
    let usual = mcap::WriteOptions::new;
    let (head, chunks, end) = split(&whole);
    let (other_head, other_chunks, other_end) = split(&other);
    let mut edited: Vec<(&str, Vec<Part>)> = vec![
        ("chunks-of-another", [&head[..], &other_chunks, &other_end].concat()),
        ("chunk-of-another", [&head[..], &chunks, &other_chunks[..1], &end].concat()),
        ("two-metadata", [&head[..], &other_head[..1], &chunks, &end].concat()),
        ("two-summaries", [&head[..], &chunks, &other_end, &end].concat()),
    ];
    let without = |parts: &[Part]| parts.iter().filter(|p| !matches!(p, Part::Attachment(_))).cloned().collect();
    edited.push(("no-attachment", without(&whole)));
    for topic in ["/cam", "/sensor", "/mask", "/frame"] {
        let name: &'static str = Box::leak(format!("empty-{}", topic.replace('/', "-")).into_boxed_str());
        edited.push((name, emptied(&whole, topic)));
    }
    for hz in ["1e30", "0", "-30", "NaN", "inf", "60", "31", "29.5", "15", "x", ""] {
        let name: &'static str = Box::leak(format!("hz-{hz}").into_boxed_str());
        edited.push((name, with(&whole, "rapid", "observation_hz", |_| hz.to_owned())));
    }
    for factor in [0.0, 0.6, 0.9, 1.1, 2.0, 3600.0, -1.0, f64::NAN, f64::INFINITY] {
        let name: &'static str = Box::leak(format!("length-{factor}").into_boxed_str());
        let changed = |printed: &str| (printed.parse::<f64>().expect("seconds") * factor).to_string();
        edited.push((name, with(&whole, "rapid/summary", "duration_s", changed)));
    }
    let wall = |printed: &str| (printed.parse::<u64>().expect("ns") + 1).to_string();
    edited.push(("begin-wall", with(&whole, "rapid", "begin_wall_ns", wall)));
    edited.push(("begin-monotonic", with(&whole, "rapid", "begin_monotonic_ns", wall)));
    edited.push(("registry", with(&whole, "rapid", "registry", |text| format!("{text}\n"))));
    let mut files: Vec<_> = edited.iter().map(|(name, parts)| ((*name).to_owned(), written(parts, usual()))).collect();
    files.push(("no-index".to_owned(), written(&whole, usual().emit_summary_records(false))));
    (written(&whole, usual()), files)
}
