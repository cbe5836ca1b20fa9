//! What a repair takes without proof, leaves out or gives a name: counted, reported, and judged by what is left.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use super::super::chunk_writer::{Channel, ChunkWriter};
use super::damage::{Chunk, chunks, largest, unfinished};
use super::tests::{keep_going, names, put, recorded, repaired};
use super::{FileEnd, RecoverError, RepairOutcome, recover};
use crate::effort::every;
use crate::episode_id::EpisodeId;
use crate::framing::MAGIC;
use crate::record::inspect::{Inspection, inspect};
use crate::testing::{Message, metadata, strictly};

/// Makes something of this name.
type Plant<'a> = &'a dyn Fn(&Path);

/// Where the check value of a chunk lies in its content.
const CRC: std::ops::Range<usize> = 24..28;

#[tokio::test]
async fn a_whole_episode_whose_name_is_taken_gets_a_free_one_and_stays_as_it_is() {
    let (_folder, bytes) = recorded().await;
    let (_folder, other) = recorded().await;
    let plant: [(&str, Plant<'_>); 4] = [
        ("a file", &|at| fs::write(at, "of another program").unwrap()),
        ("another episode", &|at| fs::write(at, &other).unwrap()),
        ("a link that leads nowhere", &|at| std::os::unix::fs::symlink("nowhere", at).unwrap()),
        ("a folder", &|at| fs::create_dir(at).unwrap()),
    ];
    for (what, plant) in plant {
        let folder = tempfile::tempdir().unwrap();
        plant(&folder.path().join("a_001.mcap"));
        for free in ["a_001.recovered.mcap", "a_001.recovered-2.mcap"] {
            let partial = put(&folder, "a_001.mcap.partial", &bytes);
            let report = recover(&partial, &mut keep_going).unwrap();
            let to = folder.path().join(free);
            assert_eq!(report.outcome, RepairOutcome::Whole { to: to.clone() }, "{what}");
            assert!(report.sentence().1.contains(free), "{what}: {}", report.sentence().1);
            assert_eq!(fs::read(&to).unwrap(), bytes, "{what}");
            let seen = inspect(&to).unwrap();
            assert_eq!(seen.verdict.verdict(), seen.recorded_verdict.as_ref(), "{what}");
        }
        assert_eq!(names(folder.path()), ["a_001.mcap", "a_001.recovered-2.mcap", "a_001.recovered.mcap"], "{what}");
        let there = folder.path().join("a_001.mcap");
        match what {
            "a file" => assert_eq!(fs::read(there).unwrap(), b"of another program"),
            "another episode" => assert_eq!(fs::read(there).unwrap(), other),
            _ => assert!(fs::symlink_metadata(there).is_ok_and(|there| !there.is_file()), "{what}"),
        }
    }
}

/// Changes something in each chunk that nothing but its check value shows, and takes that away.
fn without_check_values<'a>(
    bytes: &'a [u8],
    chunks: &'a [Chunk],
) -> impl Iterator<Item = (&'static str, &'a Chunk, Vec<u8>)> + 'a {
    chunks.iter().filter(|chunk| !chunk.messages.is_empty()).flat_map(move |chunk| {
        let changed = |keep: bool, header: bool| {
            let mut bytes = bytes.to_vec();
            let content = chunk.content.clone();
            bytes[content.start..][CRC].fill(0);
            let last = chunk.messages.last().unwrap().4.len();
            bytes[content.end - last.div_ceil(2)] ^= u8::from(!keep) << 5;
            // The name of the program is no longer to be read.
            bytes[MAGIC.len() + 20] ^= u8::from(header) << 7;
            bytes
        };
        [
            ("only the check value", chunk, changed(true, false)),
            ("and a bit", chunk, changed(false, false)),
            ("and a bit, and the header", chunk, changed(false, true)),
        ]
    })
}

#[tokio::test]
async fn no_chunk_of_ours_is_accepted_without_its_check_value() {
    let (folder, whole) = recorded().await;
    let chunks = chunks(&whole);
    let all = strictly(&whole);
    let mut tried = 0;
    for (state, name) in [(&whole[..], "a_001.mcap"), (unfinished(&whole), "b_001.mcap.partial")] {
        for (what, chunk, bytes) in without_check_values(state, &chunks) {
            let what = format!("{name}, {what}, {:?}", chunk.content);
            let file = put(&folder, name, &bytes);
            let report = recover(&file, &mut keep_going).unwrap();
            let kept = match &report.outcome {
                RepairOutcome::Repaired(repaired) => {
                    assert_eq!((repaired.damaged_chunks, repaired.original.is_some()), (1, true), "{what}");
                    strictly(&fs::read(&repaired.to).unwrap())
                }
                RepairOutcome::Unreadable { .. } => Vec::new(),
                other => panic!("{what}: {other:?}"),
            };
            let expected: Vec<&Message> = all.iter().filter(|message| !chunk.messages.contains(message)).collect();
            assert_eq!(kept.iter().collect::<Vec<_>>(), expected, "{what}");
            for name in names(folder.path()) {
                fs::remove_file(folder.path().join(name)).unwrap();
            }
            tried += 1;
        }
    }
    assert!(tried > 10);
}

/// The ends of the records in a chunk that is not compressed, and whether each is a message.
fn records(bytes: &[u8], chunk: &Chunk) -> Vec<(usize, bool)> {
    let (mut at, mut ends) = (chunk.content.start + 40, Vec::new());
    while at < chunk.content.end {
        let length = usize::try_from(u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap())).unwrap();
        let is_message = bytes[at] == crate::op::MESSAGE;
        at += 9 + length;
        ends.push((at, is_message));
    }
    ends
}

#[tokio::test]
async fn every_byte_of_a_torn_chunk_is_counted_and_its_messages_are_reported_as_unproven() {
    let (folder, whole) = recorded().await;
    let chunks = chunks(&whole);
    let (index, _) = largest(&chunks);
    let ends = records(&whole, &chunks[index]);
    for count in [2, ends.len() / 3, ends.len() / 2, ends.len() - 3] {
        for left in [0, 1, 13, 25] {
            let end = ends[count].0;
            let mut bytes = whole[..end + left].to_vec();
            // Nothing shows it: the chunk has no check value that could be verified.
            bytes[end - 3] ^= 0x20;
            let taken = ends[..=count].iter().filter(|(_, is_message)| *is_message).count() as u64;
            let partial = put(&folder, "a_001.mcap.partial", &bytes);
            let seen = inspect(&partial).unwrap();
            let report = recover(&partial, &mut keep_going).unwrap();
            let RepairOutcome::Repaired(made) = &report.outcome else { panic!("{report:?}") };
            let what = format!("{count} records, {left} bytes");
            assert_eq!(
                (made.ordered_messages, made.unread_bytes, made.end),
                (taken, left as u64, FileEnd::Torn),
                "{what}"
            );
            assert_eq!((seen.ordered_messages, seen.unread_bytes), (taken, left as u64), "{what}");
            let about = &metadata(&fs::read(&made.to).unwrap())["rapid/recovered"];
            assert_eq!((&about["ordered_messages"], &about["unread_bytes"]), (&taken.to_string(), &left.to_string()));
            assert!(taken == 0 || report.sentence().1.contains("without a check value"), "{}", report.sentence().1);
            assert!(left > 0 || !report.sentence().1.contains("0 bytes"), "{}", report.sentence().1);
            let shown = inspect(&made.to).unwrap();
            for shown in [&shown, &seen] {
                let is_stated = shown.verdict.reasons().iter().any(|reason| reason.contains("without a check value"));
                assert!(taken == 0 || is_stated, "{what}: {:?}", shown.verdict);
                assert_ne!(shown.verdict.grade(), Some(rapid_status::Grade::Good));
            }
            fs::remove_file(&made.to).unwrap();
        }
    }
}

/// Samples of a modality as they were recorded, and what the recorder counted as missing.
fn expected(summary: &BTreeMap<String, String>, name: &str) -> u64 {
    let modalities: serde_json::Value = serde_json::from_str(&summary["modalities"]).unwrap();
    ["samples", "lost", "dropped"].iter().map(|key| modalities[name][key].as_u64().unwrap()).sum()
}

/// Is everything that the recorder took in the counts, although it is not in the file?
fn accounts_for_all(what: &str, seen: &Inspection, bytes: &[u8]) {
    let summary = &metadata(bytes)["rapid/summary"];
    for modality in &seen.modalities {
        let quality = modality.quality.as_ref().unwrap();
        assert_eq!(
            quality.samples + quality.lost + quality.dropped,
            expected(summary, &modality.name),
            "{what}: {}: {quality:?}",
            modality.name
        );
    }
    let dropped: u64 = seen.modalities.iter().map(|modality| modality.quality.as_ref().unwrap().dropped).sum();
    assert_eq!(seen.dropped, Some(dropped), "{what}");
    let missing = summary["messages"].parse::<u64>().unwrap() - seen.messages;
    let reasons = seen.verdict.reasons();
    let of = format!("the recorder wrote {} messages, the file has {}", summary["messages"], seen.messages);
    assert!(missing == 0 || reasons.contains(&of.as_str()), "{what}: {reasons:?}");
}

/// The same episode in many chunks, as a slower one has them.
fn in_small_chunks(bytes: &[u8]) -> Vec<u8> {
    let summary = mcap::Summary::read(bytes).unwrap().unwrap();
    let mut report = metadata(bytes);
    let mut whole = Vec::new();
    let mut file = ChunkWriter::new(&mut whole, Some(EpisodeId::new(1, 1))).unwrap();
    file.metadata("rapid", report.remove("rapid").unwrap()).unwrap();
    for (id, schema) in &summary.schemas {
        file.schema(Some(*id), &schema.name, &schema.encoding, &schema.data).unwrap();
    }
    for (id, of) in &summary.channels {
        let schema = of.schema.as_ref().map_or(0, |schema| schema.id);
        let channel = Channel { schema, topic: &of.topic, encoding: &of.message_encoding, metadata: &of.metadata };
        file.channel(Some(*id), &channel).unwrap();
    }
    for (number, message) in mcap::MessageStream::new(bytes).unwrap().map(Result::unwrap).enumerate() {
        let (sequence, log_time) = (message.sequence, message.log_time);
        let channel_id = message.channel.id;
        let publish_time = message.publish_time;
        let header = mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time };
        file.message(&header, &message.data).unwrap();
        if number % 90 == 89 {
            file.flush().unwrap();
        }
    }
    file.metadata("rapid/summary", report.remove("rapid/summary").unwrap()).unwrap();
    file.finish().unwrap();
    whole
}

#[tokio::test]
async fn losses_of_a_damaged_or_repaired_file_are_counted_from_the_rest() {
    let (folder, recorded) = recorded().await;
    let whole = in_small_chunks(&recorded);
    let chunks = chunks(&whole);
    let masks = |messages: &[Message]| messages.iter().filter(|message| message.0 == "/rapid/mask").count();
    let mut middle = 0;
    for (number, chunk) in chunks.iter().enumerate() {
        let mut bytes = whole.clone();
        bytes[chunk.content.end - 1] ^= 1;
        let what = format!("chunk {number} of {}", chunks.len());
        let file = put(&folder, "a_001.mcap", &bytes);
        let seen = inspect(&file).unwrap();
        accounts_for_all(&what, &seen, &whole);
        let made = repaired(&file);
        let seen = inspect(&made.to).unwrap();
        accounts_for_all(&what, &seen, &whole);
        let reasons = seen.verdict.reasons();
        let has = |text: &str| reasons.iter().any(|reason| reason.contains(text));
        assert!(has("it was repaired") && has("damaged chunk"), "{what}: {reasons:?}");
        assert!(!has("what came last may be missing"), "{what}: {reasons:?}");
        let gone = masks(&chunk.messages);
        let has_masks = |chunks: &[Chunk]| chunks.iter().any(|chunk| masks(&chunk.messages) > 0);
        if gone > 0 && has_masks(&chunks[..number]) && has_masks(&chunks[number + 1..]) {
            let text = if gone == 1 { "publication of the mask is" } else { "publications of the mask are" };
            assert!(has(&format!("{gone} {text} not in the file")), "{what}: {reasons:?}");
            middle += 1;
        }
        fs::remove_file(&made.to).unwrap();
    }
    assert!(middle > 2, "{middle} chunks with masks lie in the middle");
}

#[tokio::test]
async fn recover_and_inspect_agree_on_whole_files() {
    let (folder, whole) = recorded().await;
    let footer = whole.len() - MAGIC.len() - 20;
    let begin = usize::try_from(u64::from_le_bytes(whole[footer..footer + 8].try_into().unwrap())).unwrap();
    let both = [begin - 4..begin, footer + 16..footer + 20];
    for (what, missing) in [("of the data", &both[..1]), ("of the summary", &both[1..]), ("both", &both[..])] {
        let mut bytes = whole.clone();
        for range in missing {
            bytes[range.clone()].fill(0);
        }
        for name in ["a_001.mcap", "b_001.mcap.partial"] {
            let file = put(&folder, name, &bytes);
            let reasons = inspect(&file).unwrap();
            let is_whole = !reasons.verdict.reasons().iter().any(|reason| reason.contains("not whole"));
            let report = recover(&file, &mut keep_going).unwrap();
            assert_eq!(matches!(report.outcome, RepairOutcome::Whole { .. }), is_whole, "{what}, {name}: {report:?}");
            for name in names(folder.path()) {
                fs::remove_file(folder.path().join(name)).unwrap();
            }
        }
    }
}

#[tokio::test]
async fn the_chunks_of_a_repaired_file_are_no_larger_than_those_recorded() {
    let (folder, whole) = recorded().await;
    let largest_of = |bytes: &[u8]| chunks(bytes).iter().map(|chunk| chunk.content.len()).max().unwrap();
    let partial = put(&folder, "a_001.mcap.partial", &whole[..whole.len() - 30]);
    let made = repaired(&partial);
    let whole_again = fs::read(&made.to).unwrap();
    assert_eq!(strictly(&whole_again), strictly(&whole));
    // Small ones are put together.
    assert!(largest_of(&whole_again) <= largest_of(&whole) + (64 << 10), "{}", largest_of(&whole_again));
    println!("{} chunks, largest {}", chunks(&whole).len(), largest_of(&whole));
}

/// What is there is right, and yet it is not all: the index and the check value of the whole are not of this.
#[tokio::test]
async fn the_repair_of_a_file_without_one_of_its_chunks_reports_it() {
    let (folder, mut bytes) = recorded().await;
    let cut = chunks(&bytes)[1].content.clone();
    bytes.drain(cut.start - 9..cut.end);
    let report = recover(&put(&folder, "a_001.mcap", &bytes), &mut keep_going).unwrap();
    assert!(report.sentence().1.contains("parts of it may be missing"), "{report:?}");
    // A file of which nothing is missing has no such word.
    let RepairOutcome::Repaired(made) = report.outcome else { panic!("{report:?}") };
    let report = recover(&made.to, &mut keep_going).unwrap();
    assert!(!report.sentence().1.contains("missing"), "{report:?}");
}

/// Where the records of a file begin that stand outside its chunks.
fn boundaries(bytes: &[u8]) -> Vec<usize> {
    let (mut at, mut all) = (MAGIC.len(), Vec::new());
    while at < bytes.len() - MAGIC.len() {
        all.push(at);
        at += 9 + usize::try_from(u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap())).unwrap();
    }
    all
}

/// An episode that is cut anywhere, and another one behind it: the second is not part of the first, whichever record the cut
/// goes through or stands before, and whichever of them is longer.
#[tokio::test]
async fn unread_bytes_are_reported_and_the_original_is_kept() {
    let (folder, first) = recorded().await;
    let (_other, second) = recorded().await;
    let (all, other) = (strictly(&first), strictly(&second));
    let is_known = chunks(&first)[0].content.end;
    let ends = boundaries(&first);
    let begin = ends[1];
    let cuts = ends.into_iter().skip(1).chain((begin..first.len()).step_by(first.len() / 100 * every(4)));
    let shorter = &second[..second.len() / 5];
    for (cut, behind) in cuts.flat_map(|cut| [(cut, &second[..]), (cut, shorter)]) {
        let bytes = [&first[..cut], behind].concat();
        for name in ["a_001.mcap.partial", "b_001.mcap"] {
            let what = format!("{name}, cut at {cut} of {}, {} bytes behind", first.len(), behind.len());
            let file = put(&folder, name, &bytes);
            let seen = inspect(&file).unwrap();
            assert_ne!(seen.verdict.grade(), Some(rapid_status::Grade::Good), "{what}");
            let reasons = seen.verdict.reasons().join("; ");
            assert!(reasons.contains("not readable") || reasons.contains("left out"), "{what}: {reasons}");
            let original = match recover(&file, &mut keep_going) {
                Ok(report) => match &report.outcome {
                    RepairOutcome::Repaired(made) => {
                        let kept = strictly(&fs::read(&made.to).unwrap());
                        let is_second = cut < is_known && !kept.is_empty() && other.starts_with(&kept);
                        assert!(is_second || all.starts_with(&kept), "{what}: {report:?}");
                        // Chunks that can be read, damaged ones and those of the second, are counted as chunks.
                        let is_counted = made.damaged_chunks + made.left_out.other_chunks > 0
                            || made.unread_bytes >= behind.len() as u64 / 2;
                        assert!(is_second || is_counted, "{what}: {report:?}");
                        let counts = [
                            rapid_core::text::counted(made.unread_bytes, "byte"),
                            rapid_core::text::counted(made.damaged_chunks, "damaged chunk"),
                            "another episode's".to_owned(),
                        ];
                        let sentence = report.sentence().1;
                        assert!(is_second || counts.iter().any(|count| sentence.contains(count)), "{what}: {sentence}");
                        made.original.clone().unwrap_or_else(|| panic!("{what}: not kept: {report:?}"))
                    }
                    RepairOutcome::Unreadable { kept, .. } => kept.clone(),
                    other => panic!("{what}: {other:?}"),
                },
                Err(RecoverError::Nothing(_)) => file,
                Err(error) => panic!("{what}: {error}"),
            };
            assert_eq!(fs::read(original).unwrap(), bytes, "{what}");
            for name in names(folder.path()) {
                fs::remove_file(folder.path().join(name)).unwrap();
            }
        }
    }
}
