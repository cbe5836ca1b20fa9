//! Whatever happens to a file, every message of every chunk whose check value is right is in the repaired one,
//! and no other.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::ops::Range;
use std::os::unix::ffi::OsStringExt;

use super::copy::recover_bytes;
use super::tests::{go_on, names, put, recorded};
use super::{Outcome, left_behind, recover};
use crate::episode_format::op;
use crate::episode_format::testing::{self, Message, metadata, strictly};
use crate::episode_format::walk::MAGIC;

/// Mutations of each file.
const CASES: usize = 120;

/// A chunk of a whole file: where its record's content lies, and its messages.
struct Chunk {
    content: Range<usize>,
    messages: Vec<Message>,
}

/// The chunks of a whole file, read without any of the code under test.
fn chunks(bytes: &[u8]) -> Vec<Chunk> {
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
    let mut places = memchr(bytes, head);
    places.any(|at| bytes[at + head.len()..].starts_with(rest))
}

fn memchr<'a>(bytes: &'a [u8], part: &'a [u8]) -> impl Iterator<Item = usize> + 'a {
    let last = bytes.len().saturating_sub(part.len());
    (0..=last).filter(move |at| bytes[*at..].starts_with(part))
}

#[tokio::test]
async fn of_every_file_every_message_of_every_right_chunk_is_kept_and_none_is_made() {
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
                // Without its channels a message is nobody's: they stand in the first chunk, and in the summary.
                let names = right.iter().any(|chunk| chunk.content == chunks[0].content)
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
fn largest(chunks: &[Chunk]) -> (usize, &Range<usize>) {
    let ranges = chunks.iter().map(|chunk| &chunk.content).enumerate();
    ranges.max_by_key(|(_, range)| range.len()).unwrap()
}

/// The bytes up to the end of the last chunk, as a killed recorder leaves them.
fn unfinished(bytes: &[u8]) -> &[u8] {
    &bytes[..chunks(bytes).last().unwrap().content.end]
}

#[tokio::test]
async fn of_a_torn_chunk_nothing_is_taken_once_the_machine_was_started_anew() {
    let (folder, mut bytes) = recorded().await;
    let boot = crate::episode_format::boot_id().unwrap();
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
        let said = recover(&path, &mut go_on).unwrap();
        let Outcome::Repaired(repaired) = &said.outcome else { panic!("{said:?}") };
        let kept = strictly(&fs::read(&repaired.to).unwrap());
        assert_eq!((kept.len(), repaired.ordered_messages), (whole, 0));
        assert!(original.starts_with(&kept));
        let left_out = repaired.left_out;
        assert!(left_out.unproven_bytes > 0, "{left_out:?}");
        let about = &metadata(&fs::read(&repaired.to).unwrap())["rapid/recovered"];
        assert_eq!(about["unproven_messages"], left_out.unproven_messages.to_string());
        assert_eq!((about["lossless"].as_str(), about["ordered_messages"].as_str()), ("false", "0"));
        assert!(said.sentence().1.contains("nothing proves that they are whole"), "{}", said.sentence().1);
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
async fn damage_before_the_first_chunk_is_not_emptiness() {
    let (folder, bytes) = recorded().await;
    let all = strictly(&bytes);
    let mut partial = unfinished(&bytes).to_vec();
    partial[11] ^= 1;
    let path = put(&folder, "a_001.mcap.partial", &partial);
    let said = recover(&path, &mut go_on).unwrap();
    let Outcome::Repaired(repaired) = said.outcome else { panic!("{said:?}") };
    let whole = fs::read(&repaired.to).unwrap();
    assert_eq!((strictly(&whole), repaired.left_out.gaps), (all, 1));
    assert_eq!(metadata(&whole)["rapid"], metadata(&bytes)["rapid"]);
    assert_eq!(names(folder.path()), ["a_001.mcap", "a_001.mcap.damaged"]);
    // Not even the first bytes are needed; without a message nothing can be made of it, and it is kept.
    for (name, from, to) in [("b", 0, 60), ("c", 100, partial.len())] {
        let mut partial = unfinished(&bytes).to_vec();
        partial[from..to].fill(0);
        let path = put(&folder, &format!("{name}_001.mcap.partial"), &partial);
        let said = recover(&path, &mut go_on).unwrap();
        let kept = match said.outcome {
            Outcome::Repaired(repaired) if name == "b" => repaired.original.unwrap(),
            Outcome::Unreadable { kept } if name == "c" => kept,
            other => panic!("{other:?}"),
        };
        assert_eq!((fs::read(&kept).unwrap(), kept.extension().unwrap().to_str()), (partial, Some("damaged")));
    }
}

#[tokio::test]
async fn a_file_is_already_repaired_by_its_content_not_by_its_name_and_size() {
    let (folder, bytes) = recorded().await;
    let partial = unfinished(&bytes).to_vec();
    let path = put(&folder, "a_001.mcap.partial", &partial);
    let Outcome::Repaired(first) = recover(&path, &mut go_on).unwrap().outcome else { panic!() };
    let mut other = partial.clone();
    other[largest(&chunks(&bytes)).1.end - 500] ^= 1;
    fs::write(&path, &other).unwrap();
    let said = recover(&path, &mut go_on).unwrap();
    let Outcome::Repaired(second) = &said.outcome else { panic!("{said:?}") };
    assert!(second.to != first.to && second.damaged_chunks == 1);
    assert_eq!(fs::read(second.original.as_ref().unwrap()).unwrap(), other);
    fs::write(&path, &partial).unwrap();
    let said = recover(&path, &mut go_on).unwrap();
    assert_eq!(said.outcome, Outcome::AlreadyRepaired { to: first.to, kept: None });
}

#[tokio::test]
async fn names_that_are_no_text_are_repaired_too() {
    let (folder, bytes) = recorded().await;
    let name = |ending: &str| {
        folder.path().join(std::ffi::OsString::from_vec([b"a_\xff_001.mcap", ending.as_bytes()].concat()))
    };
    fs::write(name(".partial"), unfinished(&bytes)).unwrap();
    assert_eq!(left_behind(folder.path()).unwrap(), [name(".partial")]);
    let Outcome::Repaired(repaired) = recover(&name(".partial"), &mut go_on).unwrap().outcome else { panic!() };
    assert_eq!(repaired.to, name(""));
}

/// A file of somebody else, recorded before, small enough to be a message.
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

#[test]
fn a_file_that_is_the_payload_of_a_message_is_not_taken_for_part_of_the_episode() {
    let payload = foreign();
    let mut bytes = Vec::new();
    let mut writer = testing::options().compression(None).create(std::io::Cursor::new(&mut bytes)).unwrap();
    let about = BTreeMap::from([("begin_wall_ns".to_owned(), testing::BEGIN.to_string())]);
    writer.write_metadata(&mcap::records::Metadata { name: "rapid".into(), metadata: about }).unwrap();
    let data = payload.as_slice().into();
    let (name, media_type) = ("a.mcap".to_owned(), "application/mcap".to_owned());
    writer.attach(&mcap::Attachment { log_time: 0, create_time: 0, name, media_type, data }).unwrap();
    let schema = writer.add_schema("rapid.Bytes", "protobuf", b"").unwrap();
    let channel = writer.add_channel(schema, "/rapid/bytes", "protobuf", &BTreeMap::new()).unwrap();
    for sequence in 0..6 {
        let log_time = testing::BEGIN + u64::from(sequence) * 1_000_000;
        let header = mcap::records::MessageHeader { channel_id: channel, sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, &[&[7; 30][..], &payload].concat()).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    let chunks = chunks(&bytes);
    let all: BTreeSet<Message> = chunks.iter().flat_map(|chunk| chunk.messages.clone()).collect();
    assert_eq!((all.len(), chunks.len()), (6, 6));
    let mut random = Random(7);
    let mut tried = 0;
    for state in [&bytes[..], unfinished(&bytes)] {
        for chunk in &chunks {
            let content = chunk.content.clone();
            // Its opcode, its length, its head, its first message, all but a part, its end and what follows.
            let start = content.start;
            let parts = [start - 9..start - 8, start - 8..start - 4, start - 9..start + 40, start + 16..start + 80];
            let ends = [start + 100..start + 101, start - 9..start + 700, content.end - 100..content.end + 200];
            for part in parts.into_iter().chain(ends) {
                let mut damaged = state.to_vec();
                let end = part.end.min(damaged.len());
                damaged[part.start..end].iter_mut().for_each(|byte| *byte ^= 0x40);
                let kept = strictly(&recover_bytes(&damaged).unwrap());
                assert!(kept.iter().all(|message| all.contains(message)), "{part:?} of {content:?}");
                tried += 1;
            }
        }
        // Without an index and without the beginning nothing says when the episode was recorded.
        let about = state.windows(13).position(|part| part == b"begin_wall_ns").unwrap() + 40;
        for _ in 0..300 {
            let (what, damaged) = mutate(&mut random, state);
            if damaged.get(..about) != state.get(..about) {
                continue;
            }
            let kept = recover_bytes(&damaged).map(|whole| strictly(&whole)).unwrap_or_default();
            let invented = kept.iter().find(|message| !all.contains(*message));
            assert!(invented.is_none(), "{what}: {:?}", invented.map(|message| (&message.0, message.1)));
            tried += 1;
        }
    }
    println!("{tried} ways to damage a file with a file in it, no message of the inner one taken");
}
