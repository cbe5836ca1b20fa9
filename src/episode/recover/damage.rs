//! Whatever happens to a file, every message of every chunk whose check value is right is in the repaired one,
//! and no other.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::ops::{ControlFlow, Range};
use std::os::unix::ffi::OsStringExt;

use memchr::memmem;

use super::super::chunk_writer::{Channel, ChunkWriter};
use super::copy::recover_bytes;
use super::tests::{keep_going, names, put, recorded};
use super::{FileEnd, RecoverError, RepairOutcome, left_behind, recover};
use crate::effort::every;
use crate::episode_id::EpisodeId;
use crate::framing::MAGIC;
use crate::op;
use crate::testing::{self, Message, metadata, strictly};

/// Mutations of each file.
const CASES: usize = 120;

/// A chunk of a whole file: where its record's content lies, and its messages.
pub(super) struct Chunk {
    pub(super) content: Range<usize>,
    pub(super) messages: Vec<Message>,
}

/// The chunks of a whole file, read without any of the code under test.
pub(super) fn chunks(bytes: &[u8]) -> Vec<Chunk> {
    let channels = mcap::Summary::read(bytes).unwrap().unwrap().channels;
    let (mut at, mut chunks) = (MAGIC.len(), Vec::new());
    while bytes[at] != op::DATA_END {
        let length = usize::try_from(u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap())).unwrap();
        let content = at + 9..at + 9 + length;
        at = content.end;
        if bytes[content.start - 9] != op::CHUNK {
            continue;
        }
        let mcap::records::Record::Chunk { header, data } =
            mcap::parse_record(op::CHUNK, &bytes[content.clone()]).unwrap()
        else {
            panic!("no chunk")
        };
        let records = mcap::read::ChunkReader::new(header, &data).unwrap().map(Result::unwrap);
        let messages = records.filter_map(|record| match record {
            mcap::records::Record::Message { header, data } => {
                let topic = channels[&header.channel_id].topic.clone();
                Some((topic, header.sequence, header.log_time, header.publish_time, data.into_owned()))
            }
            _ => None,
        });
        chunks.push(Chunk { messages: messages.collect(), content });
    }
    chunks
}

/// The same numbers at every run (xorshift64).
struct Random(u64);

impl Random {
    fn below(&mut self, bound: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 % bound as u64).unwrap()
    }

    fn part(&mut self, size: usize) -> Range<usize> {
        let start = self.below(size);
        start..(start + 1 + self.below(size / 4)).min(size)
    }
}

/// One thing that happens to a file, and its name.
fn mutate(random: &mut Random, bytes: &[u8]) -> (String, Vec<u8>) {
    let mut mutated = bytes.to_vec();
    let name = match random.below(8) {
        0..=2 => {
            let (at, bit) = (random.below(bytes.len()), random.below(8));
            mutated[at] ^= 1 << bit;
            format!("bit {bit} of byte {at} flipped")
        }
        3 => {
            let range = random.part(bytes.len());
            mutated[range.clone()].fill(0);
            format!("zeros in {range:?}")
        }
        4 => {
            // A page that was not written.
            let at = random.below(bytes.len()) & !0xfff;
            let range = at..(at + 4096).min(bytes.len());
            mutated[range.clone()].fill(0);
            format!("zeros in {range:?}")
        }
        5 => {
            let at = random.below(bytes.len());
            mutated.truncate(at);
            format!("cut at {at}")
        }
        6 => {
            let range = random.part(bytes.len());
            mutated.drain(range.clone());
            format!("{range:?} missing")
        }
        _ => {
            let (range, at) = (random.part(bytes.len()), random.below(bytes.len()));
            mutated.splice(at..at, bytes[range.clone()].to_vec());
            format!("{range:?} once more at {at}")
        }
    };
    (name, mutated)
}

fn holds(bytes: &[u8], part: &[u8]) -> bool {
    // The check value and what surrounds it are searched for first: few places have them.
    let (head, rest) = part.split_at(40.min(part.len()));
    memmem::find_iter(bytes, head).any(|at| bytes[at + head.len()..].starts_with(rest))
}

#[tokio::test]
async fn every_message_of_every_intact_chunk_is_kept_and_none_is_invented() {
    let (_folder, own) = recorded().await;
    let mut files = vec![("recorded", own)];
    files.extend(["zstd", "lz4", "plain"].into_iter().zip(testing::layouts().map(testing::episode)));
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let (mut tried, mut intact, mut lost, mut invented, mut changed) = (0, 0, 0, 0, 0);
    let mut worst = Vec::new();
    for (name, whole) in files {
        let chunks = chunks(&whole);
        let all: BTreeSet<&Message> = chunks.iter().flat_map(|chunk| &chunk.messages).collect();
        let end = chunks.last().unwrap().content.end;
        for (state, bytes) in [("finished", &whole[..]), ("unfinished", &whole[..end])] {
            for _ in 0..CASES {
                let (what, mutated) = mutate(&mut random, bytes);
                let before = mutated.clone();
                let repaired = recover_bytes(&mutated).map(|repaired| strictly(&repaired)).unwrap_or_default();
                let kept: BTreeSet<&Message> = repaired.iter().collect();
                let right: Vec<&Chunk> =
                    chunks.iter().filter(|chunk| holds(&mutated, &whole[chunk.content.clone()])).collect();
                // Every chunk of ours defines its channels. Those of another writer stand in its first chunk and in the
                // summary, and without them a message has no topic.
                let names = name == "recorded"
                    || right.iter().any(|chunk| chunk.content == chunks[0].content)
                    || holds(&mutated, &whole[end..]) && state == "finished";
                let wanted = right.iter().flat_map(|chunk| &chunk.messages).filter(|_| names);
                let missing = wanted.filter(|message| !kept.contains(message)).count();
                let made = repaired.len() - kept.iter().filter(|message| all.contains(*message)).count();
                tried += 1;
                intact += right.len();
                lost += missing;
                invented += made;
                changed += usize::from(mutated != before);
                if missing + made > 0 {
                    worst.push(format!("{name}, {state}, {what}: {missing} lost, {made} made"));
                }
            }
        }
    }
    println!(
        "{tried} mutations, {intact} intact chunks, {lost} messages lost, {invented} invented, {changed} inputs changed"
    );
    assert!(tried >= 600 && intact > tried);
    assert_eq!((lost, invented, changed), (0, 0, 0), "{} cases: {worst:#?}", worst.len());
}

/// The largest chunk: which it is, and where its content lies.
pub(super) fn largest(chunks: &[Chunk]) -> (usize, &Range<usize>) {
    let ranges = chunks.iter().map(|chunk| &chunk.content).enumerate();
    ranges.max_by_key(|(_, range)| range.len()).unwrap()
}

/// The bytes up to the end of the last chunk, as a killed recorder leaves them.
pub(super) fn unfinished(bytes: &[u8]) -> &[u8] {
    &bytes[..chunks(bytes).last().unwrap().content.end]
}

#[tokio::test]
async fn nothing_is_taken_from_a_torn_chunk_after_a_reboot() {
    let (folder, mut bytes) = recorded().await;
    let boot = crate::boot_id().unwrap();
    let at = bytes.windows(boot.len()).position(|part| part == boot.as_bytes()).unwrap();
    bytes[at..at + boot.len()].copy_from_slice(boot.replace(|c: char| c.is_ascii_hexdigit(), "0").as_bytes());
    let original = strictly(&bytes);
    let chunks = chunks(&bytes);
    let (largest, torn) = largest(&chunks);
    let whole: usize = chunks[..largest].iter().map(|chunk| chunk.messages.len()).sum();
    let cut = torn.end - 1000;
    for case in 0..30 {
        let mut partial = bytes[..cut].to_vec();
        // A later page reached the disk, this one did not.
        let page = torn.start + 200 + (torn.len() - 6000) * case / 30;
        partial[page..page + 4096].fill(0);
        let path = put(&folder, "a_001.mcap.partial", &partial);
        let report = recover(&path, &mut keep_going).unwrap();
        let RepairOutcome::Repaired(repaired) = &report.outcome else { panic!("{report:?}") };
        let kept = strictly(&fs::read(&repaired.to).unwrap());
        assert_eq!((kept.len(), repaired.ordered_messages), (whole, 0));
        assert!(original.starts_with(&kept));
        let left_out = repaired.left_out;
        assert!(left_out.unproven_bytes > 0, "{left_out:?}");
        let about = &metadata(&fs::read(&repaired.to).unwrap())["rapid/recovered"];
        assert_eq!(about["unproven_messages"], left_out.unproven_messages.to_string());
        assert_eq!((about["lossless"].as_str(), about["ordered_messages"].as_str()), ("false", "0"));
        assert!(report.sentence().1.contains("nothing proves that they are whole"), "{}", report.sentence().1);
        let shown = crate::record::inspect::inspect(&repaired.to).unwrap();
        assert_eq!(shown.recovered["unproven_bytes"], left_out.unproven_bytes.to_string());
        assert_eq!(fs::read(repaired.original.as_ref().unwrap()).unwrap(), partial);
        assert_eq!(names(folder.path()), ["a_001.mcap", "a_001.mcap.damaged"]);
        for name in names(folder.path()) {
            fs::remove_file(folder.path().join(name)).unwrap();
        }
    }
}

#[tokio::test]
async fn a_file_damaged_before_its_first_chunk_is_not_empty() {
    let (folder, bytes) = recorded().await;
    let all = strictly(&bytes);
    let mut partial = unfinished(&bytes).to_vec();
    partial[11] ^= 1;
    let path = put(&folder, "a_001.mcap.partial", &partial);
    let report = recover(&path, &mut keep_going).unwrap();
    let RepairOutcome::Repaired(repaired) = report.outcome else { panic!("{report:?}") };
    let whole = fs::read(&repaired.to).unwrap();
    assert_eq!((strictly(&whole), repaired.left_out.gaps), (all, 1));
    assert_eq!(metadata(&whole)["rapid"], metadata(&bytes)["rapid"]);
    assert_eq!(names(folder.path()), ["a_001.mcap", "a_001.mcap.damaged"]);
    // Not even the first bytes are needed; without a message nothing can be made of it, and it is kept.
    for (name, from, to) in [("b", 0, 60), ("c", 100, partial.len())] {
        let mut partial = unfinished(&bytes).to_vec();
        partial[from..to].fill(0);
        let path = put(&folder, &format!("{name}_001.mcap.partial"), &partial);
        let report = recover(&path, &mut keep_going).unwrap();
        let kept = match report.outcome {
            RepairOutcome::Repaired(repaired) if name == "b" => repaired.original.unwrap(),
            RepairOutcome::Unreadable { kept, .. } if name == "c" => kept,
            other => panic!("{other:?}"),
        };
        assert_eq!((fs::read(&kept).unwrap(), kept.extension().unwrap().to_str()), (partial, Some("damaged")));
    }
}

#[tokio::test]
async fn a_file_counts_as_repaired_by_its_content_not_by_its_name_and_size() {
    let (folder, bytes) = recorded().await;
    let partial = unfinished(&bytes).to_vec();
    let path = put(&folder, "a_001.mcap.partial", &partial);
    let RepairOutcome::Repaired(first) = recover(&path, &mut keep_going).unwrap().outcome else { panic!() };
    let mut other = partial.clone();
    other[largest(&chunks(&bytes)).1.end - 500] ^= 1;
    fs::write(&path, &other).unwrap();
    let report = recover(&path, &mut keep_going).unwrap();
    let RepairOutcome::Repaired(second) = &report.outcome else { panic!("{report:?}") };
    assert!(second.to != first.to && second.damaged_chunks == 1);
    assert_eq!(fs::read(second.original.as_ref().unwrap()).unwrap(), other);
    fs::write(&path, &partial).unwrap();
    let report = recover(&path, &mut keep_going).unwrap();
    assert_eq!(report.outcome, RepairOutcome::AlreadyRepaired { to: first.to, kept: None });
}

#[tokio::test]
async fn files_with_non_utf8_names_are_repaired_too() {
    let (folder, bytes) = recorded().await;
    let name = |ending: &str| {
        folder.path().join(std::ffi::OsString::from_vec([b"a_\xff_001.mcap", ending.as_bytes()].concat()))
    };
    fs::write(name(".partial"), unfinished(&bytes)).unwrap();
    assert_eq!(left_behind(folder.path()).unwrap(), [name(".partial")]);
    let RepairOutcome::Repaired(repaired) = recover(&name(".partial"), &mut keep_going).unwrap().outcome else {
        panic!()
    };
    assert_eq!(repaired.to, name(""));
}

/// Another program's file, recorded before, small enough to be a message.
fn foreign() -> Vec<u8> {
    let mut bytes = Vec::new();
    let options = testing::options().compression(None).chunk_size(Some(100));
    let mut writer = options.create(std::io::Cursor::new(&mut bytes)).unwrap();
    let channel = writer.add_channel(0, "/other", "json", &BTreeMap::new()).unwrap();
    for sequence in 0..20 {
        let log_time = testing::BEGIN - 3_600_000_000_000 + u64::from(sequence) * 1_000_000;
        let header = mcap::records::MessageHeader { channel_id: channel, sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, b"{\"somebody\": \"else\"}").unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    bytes
}

/// An episode of ours: its samples lie in chunks of their own.
fn own(number: u64, payloads: &[Vec<u8>]) -> Vec<u8> {
    own_in(number, &payloads.iter().map(std::slice::from_ref).collect::<Vec<_>>())
}

/// An episode of ours with these payloads in each chunk.
fn own_in(number: u64, chunks: &[&[Vec<u8>]]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut file = ChunkWriter::new(&mut bytes, Some(EpisodeId::new(testing::BEGIN, number))).unwrap();
    let begin = [("begin_wall_ns", testing::BEGIN), ("begin_monotonic_ns", number)];
    let about = begin.into_iter().map(|(key, ns)| (key.to_owned(), ns.to_string())).collect();
    file.metadata("rapid", about).unwrap();
    let schema = file.schema(None, "rapid.Bytes", "protobuf", b"").unwrap();
    let none = BTreeMap::new();
    let channel = Channel { schema, topic: "/rapid/bytes", encoding: "protobuf", metadata: &none };
    let channel_id = file.channel(None, &channel).unwrap();
    let mut sequence = 0;
    for chunk in chunks {
        for payload in *chunk {
            let log_time = testing::BEGIN + u64::from(sequence) * 1_000_000;
            let header = mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
            file.message(&header, payload).unwrap();
            sequence += 1;
        }
        file.flush().unwrap();
    }
    file.finish().unwrap();
    bytes
}

/// Takes episodes of ours apart in which `payload`, a file, is part of the messages that `has` it: what is lost and what is
/// invented. How many were tried, and how many of them nothing decides: neither the outer beginning nor a right chunk of
/// the outer episode is left.
fn nested(payload: &[u8], has: fn(u8) -> bool, random: &mut Random) -> (usize, usize, Vec<String>) {
    let padding = |sequence: u8| [&[sequence; 30][..], if has(sequence) { payload } else { &[] }].concat();
    let bytes = own(1, &(0..6).map(padding).collect::<Vec<_>>());
    let chunks = chunks(&bytes);
    let all: BTreeSet<Message> = chunks.iter().flat_map(|chunk| chunk.messages.clone()).collect();
    assert_eq!((all.len(), chunks.len()), (6, 6));
    let mut damaged = Vec::new();
    for state in [&bytes[..], unfinished(&bytes)] {
        for chunk in &chunks {
            let content = chunk.content.clone();
            // Its opcode, its length, its head, its first message, all but a part, its end and what follows.
            let start = content.start;
            let parts = [start - 9..start - 8, start - 8..start - 4, start - 9..start + 40, start + 16..start + 280];
            let ends = [start + 300..start + 301, start - 9..start + 700, content.end - 100..content.end + 200];
            for part in parts.into_iter().chain(ends) {
                let end = part.end.min(state.len());
                let mut bytes = state.to_vec();
                bytes[part.start.min(end)..end].iter_mut().for_each(|byte| *byte ^= 0x40);
                damaged.push((format!("{part:?} of {content:?} changed"), bytes));
            }
        }
        for end in (0..chunks[1].content.end).step_by(37) {
            let mut bytes = state.to_vec();
            bytes[..end].fill(0);
            damaged.push((format!("zeros in 0..{end}"), bytes));
            damaged.push((format!("0..{end} missing"), state[end..].to_vec()));
        }
        damaged.extend((0..300).map(|_| mutate(random, state)));
    }
    let (mut wrong, mut undecided) = (Vec::new(), 0);
    for (what, damaged) in &damaged {
        let kept = recover_bytes(damaged).map(|whole| strictly(&whole)).unwrap_or_default();
        let right: Vec<_> = chunks.iter().filter(|chunk| holds(damaged, &bytes[chunk.content.clone()])).collect();
        let lost = right.iter().flat_map(|chunk| &chunk.messages).filter(|message| !kept.contains(message)).count();
        let made = kept.iter().filter(|message| !all.contains(*message)).count();
        if right.is_empty() && !damaged.starts_with(&bytes[..chunks[0].content.start - 9]) {
            undecided += 1;
        } else if lost + made > 0 {
            wrong.push(format!("{what}: {lost} lost, {made} made"));
        }
    }
    (damaged.len(), undecided, wrong)
}

/// The index of a chunk's messages has no check value, and one that lacks bytes is as long as it claims to be: by the
/// bytes of what follows. Wherever it then ends, at the end of a record or of the file, no chunk within is lost.
#[test]
fn an_index_with_missing_bytes_loses_no_chunk() {
    let payloads = |count: u8| (0..count).map(|value| vec![value; 12]).collect::<Vec<_>>();
    let (many, few) = (payloads(40), payloads(3));
    let bytes = own_in(1, &[&many, &few, &few]);
    let chunks = chunks(&bytes);
    assert_eq!(chunks.len(), 3);
    let index = chunks[0].content.end;
    assert!(bytes[index] == op::MESSAGE_INDEX && chunks[1].content.start - index > 500);
    let mut wrong = Vec::new();
    let mut tried = 0;
    for (count, state) in [(3, &bytes[..]), (3, unfinished(&bytes)), (2, &bytes[..chunks[1].content.end])] {
        for start in (index + 15..chunks[1].content.start - 9).step_by(16) {
            for end in (start + 1..chunks[1].content.start - 9).step_by(every(11)) {
                let shorter = [&state[..start], &state[end..]].concat();
                let kept = recover_bytes(&shorter).map(|whole| strictly(&whole).len()).unwrap_or_default();
                let wanted: usize = chunks[..count].iter().map(|chunk| chunk.messages.len()).sum();
                tried += 1;
                if kept != wanted {
                    wrong.push(format!("{start}..{end} of {} missing: {kept} of {wanted}", state.len()));
                }
            }
        }
    }
    println!("{tried} ways to shorten an index, {} with losses", wrong.len());
    assert!(tried > 10_000 / every(11) && wrong.is_empty(), "{} cases: {wrong:#?}", wrong.len());
}

/// A record with fields of a later version is longer than they are: what it claims to hold may be a chunk's beginning.
#[test]
fn a_record_with_a_wrong_length_loses_no_chunk() {
    let payloads = |count: u8| (0..count).map(|value| vec![value; 12]).collect::<Vec<_>>();
    let bytes = own_in(1, &[&payloads(40), &payloads(40), &payloads(3)]);
    let (all, chunks) = (strictly(&bytes).len(), chunks(&bytes));
    let (mut tried, mut wrong) = (0, Vec::new());
    let mut at = MAGIC.len();
    while at < chunks[1].content.start - 9 {
        let (opcode, length) = (bytes[at], u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()));
        let next = at + 9 + usize::try_from(length).unwrap();
        for chunk in chunks.iter().filter(|chunk| opcode != op::CHUNK && chunk.content.start > next) {
            // To the beginning of each record within the chunk.
            let mut end = chunk.content.start + 40;
            while end < chunk.content.end {
                for state in [&bytes[..], unfinished(&bytes)] {
                    let mut longer = state.to_vec();
                    longer[at + 1..at + 9].copy_from_slice(&((end - at - 9) as u64).to_le_bytes());
                    let kept = recover_bytes(&longer).map(|whole| strictly(&whole).len()).unwrap_or_default();
                    tried += 1;
                    if kept != all {
                        wrong.push(format!("opcode {opcode} at {at} to {end}: {kept} of {all}"));
                    }
                }
                end += 9 + usize::try_from(u64::from_le_bytes(bytes[end + 1..end + 9].try_into().unwrap())).unwrap();
            }
        }
        at = next;
    }
    assert!(tried > 400 && wrong.is_empty(), "{} of {tried}: {wrong:#?}", wrong.len());
}

#[test]
fn a_file_inside_a_message_is_not_taken_for_part_of_the_episode() {
    // Another program's, and one of ours that began in the same moment and has the same channels.
    let later = |sequence: u8| vec![0x80 | sequence; 40];
    let payloads = [foreign(), own(2, &(0..4).map(later).collect::<Vec<_>>())];
    let mut random = Random(7);
    let everywhere: [fn(u8) -> bool; 2] = [|_| true, |sequence| sequence < 5];
    for (payload, has) in payloads.iter().flat_map(|payload| everywhere.map(|has| (payload, has))) {
        let (tried, undecided, wrong) = nested(payload, has, &mut random);
        println!("{tried} ways to damage an episode with a file in it, {} wrong, {undecided} undecidable", wrong.len());
        assert!(wrong.is_empty() && undecided * 5 < tried, "{} cases: {wrong:#?}", wrong.len());
    }
}

#[tokio::test]
async fn an_episode_after_other_bytes_is_found_and_the_first_of_several() {
    let (folder, bytes) = recorded().await;
    let (all, right) = (strictly(&bytes), chunks(&bytes));
    let mail = b"Content-Type: application/octet-stream\r\n\r\n".repeat(40);
    let mut random = Random(3);
    let noise: Vec<u8> = (0..70_000).map(|_| u8::try_from(random.below(256)).unwrap()).collect();
    let prefixes = [vec![0; 512], vec![0], mail, noise, MAGIC.to_vec(), [&MAGIC[..7], &MAGIC].concat()];
    let other = own(9, &[vec![1; 40], vec![2; 40]]);
    for prefix in &prefixes[..4] {
        for state in [&bytes[..], unfinished(&bytes)] {
            for behind in [&[][..], &[0; 1024], &[&[0; 512][..], &other].concat()] {
                let archive = [prefix, state, behind].concat();
                let path = put(&folder, "a_001.mcap.partial", &archive);
                let report = recover(&path, &mut keep_going).unwrap();
                let RepairOutcome::Repaired(repaired) = &report.outcome else { panic!("{report:?}") };
                let whole = fs::read(&repaired.to).unwrap();
                assert_eq!(strictly(&whole), all, "{} and {} bytes", prefix.len(), behind.len());
                assert_eq!(metadata(&whole)["rapid"], metadata(&bytes)["rapid"]);
                assert_eq!(repaired.left_out.bytes_before, prefix.len() as u64);
                // Each byte is counted once.
                let sentence = report.sentence().1;
                let finished = repaired.end == FileEnd::Finished;
                let is_all_known = finished && behind.iter().all(|byte| *byte == 0);
                assert!(repaired.unread_bytes == 0 || !is_all_known, "{sentence}");
                assert!(repaired.unread_bytes <= (state.len() + behind.len()) as u64, "{sentence}");
                assert_eq!(fs::read(repaired.original.as_ref().unwrap()).unwrap(), archive);
                assert!(sentence.contains("before the beginning of the file"), "{sentence}");
                for name in names(folder.path()) {
                    fs::remove_file(folder.path().join(name)).unwrap();
                }
            }
        }
    }
    for prefix in &prefixes {
        // Of a damaged one, too, no right chunk is lost.
        let mut damaged = [&prefix[..], &bytes].concat();
        let (number, place) = largest(&right);
        damaged[prefix.len() + place.start + 500] ^= 1;
        let left = all.len() - right[number].messages.len();
        assert_eq!(strictly(&recover_bytes(&damaged).unwrap()).len(), left, "after {} bytes", prefix.len());
        // What is not ours is not taken for it.
        let stranger = [&[0; 512][..], &foreign()].concat();
        assert_eq!(recover_bytes(&stranger), None);
    }
    let archive = [&[0; 512][..], &other, &[0; 512], &bytes].concat();
    let kept = strictly(&recover_bytes(&archive).unwrap());
    assert_eq!(kept, strictly(&other), "the first of two");
}

#[tokio::test]
async fn every_chunk_repeats_the_channels_as_the_summary_has_them() {
    let (_folder, bytes) = recorded().await;
    let chunks = chunks(&bytes);
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert!(chunks.len() > 2 && summary.channels.len() > 5);
    let last = &bytes[chunks.last().unwrap().content.clone()];
    let own = last.windows(8).position(|part| part == b"rapid/1\n").unwrap();
    assert_eq!(own, 40 + 9, "behind the heads of the chunk and of the record");
    // The whole of the summary's definitions stands in the last chunk, byte for byte.
    let footer = bytes.len() - 8 - 20;
    let begin = usize::try_from(u64::from_le_bytes(bytes[footer..footer + 8].try_into().unwrap())).unwrap();
    let (mut at, mut found) = (begin, 0);
    while matches!(bytes[at], op::SCHEMA | op::CHANNEL) {
        let end = at + 9 + usize::try_from(u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap())).unwrap();
        assert!(last.windows(end - at).any(|part| *part == bytes[at..end]), "record at {at}");
        (at, found) = (end, found + 1);
    }
    assert_eq!(found, summary.channels.len() + summary.schemas.len());
}

/// A file full of possible chunks, none of them valid: each has to be tried.
fn hostile() -> Vec<u8> {
    let mut bytes = MAGIC.to_vec();
    bytes.extend([0x10; 30]);
    while bytes.len() < 8 << 20 {
        let head = [&[0; 16][..], &100_000_u64.to_le_bytes(), &[1; 4], &[0; 4], &100_000_u64.to_le_bytes()].concat();
        bytes.extend(head);
        bytes.extend([&[op::MESSAGE][..], &30_u64.to_le_bytes(), &[0; 30]].concat());
    }
    bytes
}

#[test]
fn a_long_search_is_watched_and_ends_when_it_is_interrupted() {
    let folder = tempfile::tempdir().unwrap();
    let path = put(&folder, "a_001.mcap.partial", &hostile());
    let mut calls = 0_u64;
    let report = recover(&path, &mut |_, _| {
        calls += 1;
        ControlFlow::Continue(())
    });
    assert!(matches!(report.unwrap().outcome, RepairOutcome::Unreadable { .. }));
    println!("{calls} calls for {} bytes", hostile().len());
    // The hash alone reads each byte once; the search reads every candidate.
    assert!(calls > 8 + 16);
    for at in [1, 9, calls - 1] {
        let path = put(&folder, "b_001.mcap.partial", &hostile());
        let mut left = at;
        let error = recover(&path, &mut |_, _| {
            assert!(left > 0, "called again after it was interrupted");
            left -= 1;
            if left == 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(matches!(error.unwrap_err(), RecoverError::Interrupted(_)), "call {at} of {calls}");
        assert_eq!(fs::read(&path).unwrap(), hostile());
    }
}
