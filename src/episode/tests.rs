//! Files that were made to break a reader.

use super::framing::MAGIC;
use super::op;
use super::record_iter::{FileEnd, Integrity, RecordIter};
use super::testing::{episode, layouts, mutated, mutations};
use crate::effort::{cases, every};
use proptest::prelude::*;

/// A record's opcode and content.
type Shown = (u8, Vec<u8>);

/// The records of `bytes`, and how whole they are.
fn integrity(bytes: &[u8]) -> Option<(Vec<Shown>, Integrity)> {
    let mut iter = RecordIter::new(bytes, bytes.len() as u64).unwrap()?;
    let mut records = Vec::new();
    while let Some(record) = iter.next().unwrap() {
        records.push((record.opcode, record.data.to_vec()));
    }
    Some((records, iter.integrity()))
}

fn record(opcode: u8, content: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(content.len() as u64).to_le_bytes(), content].concat()
}

/// A chunk with any head.
fn chunk(compression: &str, size: u64, crc: u32, records: &[u8]) -> Vec<u8> {
    let mut content = [0_u8; 16].to_vec();
    content.extend(size.to_le_bytes());
    content.extend(crc.to_le_bytes());
    content.extend(u32::try_from(compression.len()).unwrap().to_le_bytes());
    content.extend(compression.as_bytes());
    content.extend((records.len() as u64).to_le_bytes());
    content.extend(records);
    record(op::CHUNK, &content)
}

fn file(records: &[Vec<u8>]) -> Vec<u8> {
    [&MAGIC[..], &records.concat()].concat()
}

#[test]
fn a_whole_file_is_sound_and_every_flipped_bit_of_it_is_noticed() {
    for options in layouts() {
        let bytes = episode(options);
        let (whole, found) = integrity(&bytes).unwrap();
        assert!(found.sound && found.end == FileEnd::Finished && found.bytes == bytes.len() as u64);
        assert_eq!(whole.iter().filter(|(opcode, _)| *opcode == op::MESSAGE).count(), 200);
        for at in (0..bytes.len()).step_by(every(15)) {
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << (at % 8);
            assert!(integrity(&flipped).is_none_or(|(_, found)| !found.sound), "bit {} of byte {at}", at % 8);
        }
        for cut in (0..bytes.len()).step_by(every(13)) {
            assert!(integrity(&bytes[..cut]).is_none_or(|(_, found)| !found.sound && found.end != FileEnd::Finished));
        }
        let (_, found) = integrity(&[&bytes[..], b"more"].concat()).unwrap();
        assert!(!found.sound && found.bytes == bytes.len() as u64);
    }
}

#[test]
fn a_record_longer_than_its_chunk_is_damage_with_every_compression() {
    let inner = [&[op::MESSAGE][..], &u64::MAX.to_le_bytes(), &[0; 30]].concat();
    let zstd = zstd::encode_all(&inner[..], 0).unwrap();
    let mut lz4 = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
    std::io::Write::write_all(&mut lz4, &inner).unwrap();
    let (lz4, _) = lz4.finish();
    for (compression, records) in [("", &inner), ("zstd", &zstd), ("lz4", &lz4)] {
        // With the right check value, with none, with a wrong one.
        for crc in [crc32fast::hash(&inner), 0, 1] {
            let bytes = file(&[chunk(compression, inner.len() as u64, crc, records)]);
            let (found, integrity) = integrity(&bytes).unwrap();
            assert!(found.is_empty(), "{compression} {crc}");
            assert_eq!((integrity.damaged_chunks, integrity.end), (1, FileEnd::Unfinished), "{compression} {crc}");
        }
    }
}

#[test]
fn impossible_lengths_allocate_no_memory() {
    let huge = [u64::MAX, 1 << 63, 1 << 40, 1 << 28];
    for length in huge {
        for opcode in (0..=0x10).chain([0x7f, 0x80, 0xff]) {
            let bytes = [&MAGIC[..], &[opcode], &length.to_le_bytes(), b"little"].concat();
            let (records, found) = integrity(&bytes).unwrap();
            assert!(records.is_empty() && found.end != FileEnd::Finished);
            // A file that claims to be as long as that, and is not.
            let mut records = RecordIter::new(&*bytes, u64::MAX).unwrap().unwrap();
            while records.advance().unwrap() {}
        }
        for compression in ["", "zstd", "lz4", "none"] {
            let (records, found) = integrity(&file(&[chunk(compression, length, 0, b"little")])).unwrap();
            assert!(records.is_empty());
            assert_eq!(found.damaged_chunks, 1);
        }
    }
}

#[test]
fn a_chunk_is_decompressed_only_to_its_stated_size() {
    // A hundred MiB of zeros in a few kB.
    let zeros = zstd::encode_all(&vec![0; 100 << 20][..], 0).unwrap();
    assert!(zeros.len() < 100_000);
    let (records, found) = integrity(&file(&[chunk("zstd", 18, 0, &zeros)])).unwrap();
    // Two records of opcode 0 and no content, of no use to anybody.
    assert_eq!((records.len(), found.damaged_chunks), (2, 0));
}

#[test]
fn nested_and_empty_chunks_are_skipped() {
    let mut inner = record(op::MESSAGE, b"message");
    for _ in 0..1000 {
        inner = chunk("", inner.len() as u64, 0, &inner);
    }
    let (records, found) = integrity(&file(&[inner, chunk("", 0, 0, b""), record(op::CHUNK, b"")])).unwrap();
    // The outermost is opened; chunks are not shown.
    assert_eq!(records.iter().map(|(opcode, _)| *opcode).collect::<Vec<_>>(), [op::CHUNK]);
    assert_eq!((found.damaged_chunks, found.end), (1, FileEnd::Unfinished));
}

#[test]
fn attachments_and_private_records_are_shown_and_invalid_text_is_not_trusted() {
    let bytes = file(&[record(op::ATTACHMENT, &[0; 36]), record(0x85, b"mine"), chunk("\u{fffd}", 0, 0, b"")]);
    let mut bytes = bytes;
    // The name of the compression is no UTF-8.
    let at = bytes.windows(3).position(|window| window == "\u{fffd}".as_bytes()).unwrap();
    bytes[at] = 0xff;
    let (records, found) = integrity(&bytes).unwrap();
    assert_eq!(records.iter().map(|(opcode, _)| *opcode).collect::<Vec<_>>(), [op::ATTACHMENT, 0x85]);
    assert_eq!(found.damaged_chunks, 1);
}

#[test]
fn a_file_without_a_summary_is_whole() {
    for options in layouts() {
        let options = options.emit_statistics(false).emit_summary_offsets(false).emit_chunk_indexes(false);
        let options = options.emit_attachment_indexes(false).emit_metadata_indexes(false);
        let bytes = episode(options.repeat_channels(false).repeat_schemas(false));
        let footer = &bytes[bytes.len() - 28..];
        assert_eq!(footer[..8], [0; 8], "a summary");
        let (_, found) = integrity(&bytes).unwrap();
        assert!(found.sound && found.end == FileEnd::Finished, "{found:?}");
    }
}

#[test]
fn decompression_is_bounded_by_the_size_of_the_file() {
    let channel = [&[1, 0, 0, 0, 2, 0, 0, 0][..], b"/a", &[0; 8]].concat();
    let mut records = vec![record(op::CHANNEL, &channel)];
    // Times and numbers differ, or they were one chunk many times.
    for number in 0..9_u8 {
        let message = [&[1, 0, number, 0, 0, 0, number, 0, 0, 0, 0, 0, 0, 0][..], &vec![0; 60 << 20]].concat();
        let message = record(op::MESSAGE, &message);
        let packed = zstd::encode_all(&message[..], 0).unwrap();
        records.push(chunk("zstd", message.len() as u64, crc32fast::hash(&message), &packed));
    }
    let bytes = file(&records);
    assert!(bytes.len() < 100_000);
    let mut iter = RecordIter::new(&*bytes, bytes.len() as u64).unwrap().unwrap();
    let mut shown = 0;
    while let Some(record) = iter.next().unwrap() {
        shown += record.data.len();
    }
    let found = iter.integrity();
    println!("{} bytes, {shown} shown, {} chunks left out", bytes.len(), found.left_out.swollen_chunks);
    assert_eq!((shown >> 20, found.left_out.swollen_chunks, found.sound), (240, 5, false));
}

#[test]
fn mutated_bytes_never_panic() {
    let config = ProptestConfig { cases: cases(400), failure_persistence: None, ..ProptestConfig::default() };
    for bytes in layouts().map(episode) {
        proptest!(config.clone(), |(mutations in mutations())| {
            integrity(&mutated(&bytes, &mutations));
        });
    }
}

#[test]
fn files_that_were_hardly_written_are_refused_before_they_are_read() {
    use std::os::unix::fs::FileExt as _;
    const TERABYTES: u64 = 4 << 40;
    let folder = tempfile::tempdir_in(".").unwrap();
    let whole = episode(layouts().into_iter().next().unwrap());
    let large = |opcode: u8, content: &[u8]| [&[opcode][..], &(TERABYTES - 1000).to_le_bytes(), content].concat();
    let begins = [
        ("nothing", Vec::new()),
        ("magic", MAGIC.to_vec()),
        ("an episode", whole),
        ("a private record", file(&[large(0x80, b"")])),
        ("an attachment", file(&[large(op::ATTACHMENT, &[0; 30])])),
        ("a chunk", file(&[large(op::CHUNK, &[0; 40])])),
    ];
    for (what, begin) in begins {
        for end in [Vec::new(), MAGIC.to_vec()] {
            let path = folder.path().join(format!("{what}.mcap.partial"));
            let written = std::fs::File::create(&path).unwrap();
            written.write_all_at(&begin, 0).unwrap();
            written.set_len(TERABYTES).unwrap();
            written.write_all_at(&end, TERABYTES).unwrap();
            drop(written);
            let listed = crate::record::inspect::list(&path).error.unwrap_or_default();
            let errors = [
                listed,
                crate::sha256(&path).unwrap_err().to_string(),
                crate::recover::recover(&path, &mut |_, _| std::ops::ControlFlow::Continue(()))
                    .unwrap_err()
                    .to_string(),
                crate::recover::is_damaged(&path, &mut |_, _| std::ops::ControlFlow::Continue(()))
                    .unwrap_err()
                    .to_string(),
            ];
            for error in errors {
                assert!(error.contains("were never written (a sparse file)"), "{what}: {error}");
            }
            std::fs::remove_file(&path).unwrap();
        }
    }
}

#[test]
fn an_episode_with_holes_in_it_is_read_like_any_other() {
    use std::os::unix::fs::FileExt as _;
    let folder = tempfile::tempdir_in(".").unwrap();
    // A record of zeros, as `cp --sparse=always` writes it.
    let mut bytes = episode(layouts().into_iter().next().unwrap());
    let end = bytes.split_off(MAGIC.len());
    let (path, black) = (folder.path().join("holes.mcap"), 8_u64 << 20);
    let written = std::fs::File::create(&path).unwrap();
    let head = [&MAGIC[..], &[0x80], &black.to_le_bytes()].concat();
    written.write_all_at(&head, 0).unwrap();
    written.write_all_at(&end, head.len() as u64 + black).unwrap();
    drop(written);
    assert_eq!(crate::record::inspect::list(&path).error, None);
}
