//! Other programs that damage, replace or only look at the file while it is recorded.

use std::fs::OpenOptions;
use std::io::{Read as _, Seek, SeekFrom};
use std::time::Instant;

use super::*;
use crate::patience::PATIENCE;
use crate::{recover, testing};

/// Bytes that are in the kernel's hands before the file is touched.
const ENOUGH: u64 = 200_000;

/// What another program does to a file; what it keeps open stays so until the episode has ended.
type Deed = fn(&Path) -> Option<File>;

fn writable(file: &Path) -> File {
    OpenOptions::new().read(true).write(true).open(file).unwrap()
}

fn cut(file: &Path, to: fn(u64) -> u64) {
    let file = writable(file);
    let size = file.metadata().unwrap().len();
    file.set_len(to(size)).unwrap();
}

fn overwrite(file: &Path) -> File {
    let mut file = writable(file);
    let middle = file.metadata().unwrap().len() / 2;
    file.seek(SeekFrom::Start(middle)).unwrap();
    file.write_all(&[0; 4096]).unwrap();
    file
}

async fn recorded(deed: Deed) -> (Bench, PathBuf, Option<File>, tokio::sync::broadcast::Receiver<rapid_status::Event>) {
    let mut bench = Bench::new();
    let events = bench.board.events();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    for seq in 0..400 {
        bench.sample(CAM, 1, seq, Stamp::now().0, 0);
    }
    let partial = finished.with_extension("mcap.partial");
    let begun = Instant::now();
    while std::fs::metadata(&partial).unwrap().len() < ENOUGH {
        assert!(begun.elapsed() < PATIENCE, "nothing is flushed");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let kept = deed(&partial);
    (bench, finished, kept, events)
}

#[tokio::test]
async fn a_file_that_is_cut_or_replaced_while_it_is_recorded_ends_the_episode_and_is_bad() {
    let deeds: [(&str, &str, Deed); 7] = [
        ("cut to nothing", "another program cut it while it was recorded", |file| {
            cut(file, |_| 0);
            None
        }),
        ("cut to a third", "another program cut it while it was recorded", |file| {
            cut(file, |size| size / 3);
            None
        }),
        ("cut to a third, and filled up but for a byte", "another program cut it while it was recorded", |file| {
            let file = writable(file);
            let size = file.metadata().unwrap().len();
            file.set_len(size / 3).unwrap();
            file.set_len(size - 1).unwrap();
            None
        }),
        ("emptied by opening it, as a shell does", "another program cut it while it was recorded", |file| {
            OpenOptions::new().write(true).truncate(true).open(file).unwrap();
            None
        }),
        ("extended", "another program wrote 5 bytes into it", |file| {
            OpenOptions::new().append(true).open(file).unwrap().write_all(b"extra").unwrap();
            None
        }),
        ("replaced by renaming", "another program put another file in its place", |file| {
            let other = file.with_file_name("other");
            std::fs::write(&other, "of another program").unwrap();
            std::fs::rename(&other, file).unwrap();
            None
        }),
        ("removed, and another made", "another program put another file in its place", |file| {
            std::fs::remove_file(file).unwrap();
            std::fs::write(file, "of another program").unwrap();
            None
        }),
    ];
    for (what, why, deed) in deeds {
        let (bench, finished, _, mut events) = recorded(deed).await;
        // The end is not requested.
        let closed = tokio::time::timeout(PATIENCE, bench.until_closed(&mut events)).await;
        let EventKind::Episode(EpisodeReport { file, error, verdict, .. }) =
            closed.unwrap_or_else(|_| panic!("{what}: does not end"))
        else {
            unreachable!()
        };
        let error = error.unwrap_or_else(|| panic!("{what}: no error"));
        assert!(error.contains(why), "{what}: {error}");
        assert_eq!(verdict.grade, Grade::Bad, "{what}");
        assert!(verdict.why().contains(why), "{what}: {}", verdict.why());
        assert!(!finished.exists() && file.extension().is_some_and(|extension| extension == "partial"), "{what}");
        assert_eq!(error.matches(".mcap").count(), 0, "{what}: the caller names the file: {error}");
        found_again(what, why, &file);
        if why.contains("place") {
            let partial = finished.with_extension("mcap.partial");
            assert_eq!(std::fs::read_to_string(partial).unwrap(), "of another program", "{what}");
            // What was recorded is kept beside it.
            assert!(std::fs::metadata(&file).unwrap().len() >= ENOUGH, "{what}: {}", file.display());
        }
    }
}

#[tokio::test]
async fn a_file_modified_while_it_is_recorded_is_not_called_good() {
    let deeds: [(&str, Deed); 4] = [
        ("overwritten by one that has it open, after another has read it", |file| {
            let mut writer = writable(file);
            drop(File::open(file).unwrap());
            writer.seek(SeekFrom::Start(file.metadata().unwrap().len() / 2)).unwrap();
            writer.write_all(&[0; 4096]).unwrap();
            Some(writer)
        }),
        ("overwritten in the middle", |file| {
            overwrite(file);
            None
        }),
        ("overwritten and kept open", |file| Some(overwrite(file))),
        ("cut and filled up again", |file| {
            let file = writable(file);
            let size = file.metadata().unwrap().len();
            file.set_len(size / 3).unwrap();
            file.set_len(size).unwrap();
            None
        }),
    ];
    for (what, deed) in deeds {
        let (mut bench, finished, _kept, _) = recorded(deed).await;
        let report = bench.recorder.stop().await.unwrap();
        let error = report.error.unwrap_or_else(|| panic!("{what}: no error"));
        assert!(error.contains("another program") && error.contains("while it was recorded"), "{what}: {error}");
        assert_eq!(report.verdict.grade, Grade::Bad, "{what}");
        assert!(!finished.exists(), "{what}");
        found_again(what, "another program", &report.file);
    }
}

/// Is there a message in a whole chunk of the file? A chunk of channels alone is written if no sample came before the first
/// flush. Read without any of the code under test. A chunk that is being written while the
/// file is cut is continued behind the cut: of such a length, but not whole.
fn has_message(bytes: &[u8]) -> bool {
    records(&bytes[bytes.len().min(8)..]).any(|(op, content)| {
        if op != crate::op::CHUNK || content.len() < 40 {
            return false;
        }
        // Two times, the size, the check value, no compression, and the size again.
        let (head, inner) = content.split_at(40);
        let check = u32::from_le_bytes(head[24..28].try_into().unwrap());
        crc32fast::hash(inner) == check && records(inner).any(|(op, _)| op == crate::op::MESSAGE)
    })
}

/// Opcode and content of the whole records at the beginning of these bytes.
fn records(mut bytes: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    std::iter::from_fn(move || {
        let (head, rest) = bytes.split_at_checked(9)?;
        let length = usize::try_from(u64::from_le_bytes(head[1..].try_into().unwrap())).ok()?;
        let (content, behind) = rest.split_at_checked(length)?;
        bytes = behind;
        Some((head[0], content))
    })
}

#[test]
fn a_chunk_that_is_only_as_long_as_a_whole_one_is_not_whole() {
    let bytes = testing::episode(testing::options().compression(None));
    let mut end = (0..bytes.len()).find(|end| has_message(&bytes[..*end])).map(|end| bytes[..end].to_vec()).unwrap();
    *end.last_mut().unwrap() ^= 1;
    assert!(!has_message(&end));
}

/// The recorder's judgement is found again by every reader of the file, and in what a repair makes of it.
fn found_again(what: &str, why: &str, file: &Path) {
    let is_found = |file: &Path| {
        let answer = inspect::list(file).verdict;
        assert_eq!(answer.grade(), Some(Grade::Bad), "{what}: {}: {answer:?}", file.display());
        assert!(answer.reasons().iter().any(|reason| reason.contains(why)), "{what}: {}: {answer:?}", file.display());
    };
    is_found(file);
    // In another folder: a test may still have to see what is in this one.
    let folder = tempfile::tempdir().unwrap();
    let partial = folder.path().join(file.file_name().unwrap());
    std::fs::copy(file, &partial).unwrap();
    let answer = recover::recover(&partial, &mut |_, _| std::ops::ControlFlow::Continue(())).unwrap();
    assert!(answer.sentence().1.contains(why), "{what}: {}", answer.sentence().1);
    let repaired = match &answer.outcome {
        recover::RepairOutcome::Repaired(repaired) => repaired,
        // What the other program left of it ends within the first chunk.
        recover::RepairOutcome::Unreadable { kept, .. } if !has_message(&std::fs::read(file).unwrap()) => {
            return is_found(kept);
        }
        _ => panic!("{what}: {answer:?}"),
    };
    is_found(&repaired.to);
    // Once more, as it is repaired again or given its name.
    let again = recover::recover(&repaired.to, &mut |_, _| std::ops::ControlFlow::Continue(())).unwrap();
    assert!(matches!(again.outcome, recover::RepairOutcome::Whole { .. }), "{what}: {again:?}");
    is_found(&repaired.to);
}

#[test]
fn an_episode_with_nothing_left_but_its_reason_is_bad_for_that_reason() {
    let folder = tempfile::tempdir().unwrap();
    let why = "another program cut it while it was recorded: all of it is gone";
    let file = folder.path().join("a_001.mcap.partial");
    for before in [&b""[..], &[0; 100]] {
        std::fs::write(&file, [before, &crate::Failed::mark(why)].concat()).unwrap();
        found_again("nothing is left", why, &file);
    }
}

#[tokio::test]
async fn an_episode_that_is_whole_when_the_disk_refuses_it_stays_bad() {
    // The last write of all: the summary is GOOD by then.
    let mut bench = Bench::with_sink(|file| Box::new(super::faults::Unsure(file)));
    bench.recorder.start(bench.request(None)).await.unwrap();
    bench.sample(TOF, 1, 0, Stamp::now().0, 0);
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!(report.verdict.grade, Grade::Bad);
    found_again("not on the disk", "cable of the disk pulled", &report.file);
}

#[tokio::test]
async fn an_episode_whose_name_was_taken_gets_the_next_one_and_keeps_its_verdict() {
    let deeds: [(&str, Deed); 5] = [
        ("a file", |file| Some(File::create_new(file.with_extension("")).unwrap())),
        ("an episode", |file| {
            std::fs::copy(file, file.with_extension("")).unwrap();
            None
        }),
        ("a link that leads nowhere", |file| {
            std::os::unix::fs::symlink("nowhere", file.with_extension("")).unwrap();
            None
        }),
        ("a folder", |file| {
            std::fs::create_dir(file.with_extension("")).unwrap();
            None
        }),
        ("two files", |file| {
            std::fs::write(file.with_extension(""), "first").unwrap();
            std::fs::write(
                file.with_file_name(
                    file.file_name().unwrap().to_str().unwrap().replace("_001.mcap.partial", "_002.mcap"),
                ),
                "second",
            )
            .unwrap();
            None
        }),
    ];
    for (what, deed) in deeds {
        let (mut bench, finished, _kept, mut events) = recorded(deed).await;
        let planted = std::fs::symlink_metadata(&finished).unwrap();
        let report = bench.recorder.stop().await.unwrap();
        assert_eq!(report.error, None, "{what}");
        let number = if what == "two files" { "_003.mcap" } else { "_002.mcap" };
        let expected = finished.to_str().unwrap().replace("_001.mcap", number);
        assert_eq!(report.file, Path::new(&expected), "{what}");
        let answer = inspect::inspect(&report.file).unwrap();
        assert_eq!(answer.verdict.verdict(), Some(&report.verdict), "{what}");
        assert!(!report.verdict.why().contains("not whole") && !report.verdict.why().contains("written"), "{what}");
        assert_eq!(read(&report.file).on("/rapid/cam_wrist").count(), 400, "{what}");
        let there = std::fs::symlink_metadata(&finished).unwrap();
        let is = |it: &std::fs::Metadata| (it.file_type(), it.len(), std::os::unix::fs::MetadataExt::ino(it));
        assert_eq!(is(&there), is(&planted), "{what}");
        assert!(!finished.with_extension("mcap.partial").exists(), "{what}");
        let mut logged = Vec::new();
        while let Ok(event) = events.try_recv() {
            if let EventKind::Log { level: Level::Warn, text } = event.what {
                logged.push(text);
            }
        }
        let names =
            [finished.file_name().unwrap(), report.file.file_name().unwrap()].map(|name| name.to_str().unwrap());
        assert!(logged.iter().any(|text| names.iter().all(|name| text.contains(name))), "{what}: {logged:?}");
    }
}

#[tokio::test]
async fn a_file_that_others_only_read_or_touch_is_recorded_as_usual() {
    let deeds: [(&str, Deed); 4] = [
        ("read", |file| {
            File::open(file).unwrap().read_to_end(&mut Vec::new()).unwrap();
            None
        }),
        ("read, and kept open", |file| Some(File::open(file).unwrap())),
        ("touched", |file| {
            drop(writable(file));
            None
        }),
        ("open for writing", |file| Some(writable(file))),
    ];
    for (what, deed) in deeds {
        let (mut bench, finished, _kept, _) = recorded(deed).await;
        let report = bench.recorder.stop().await.unwrap();
        assert_eq!((report.error, report.file.as_path()), (None, finished.as_path()), "{what}");
        assert_eq!(read(&finished).on("/rapid/cam_wrist").count(), 400, "{what}");
    }
}
