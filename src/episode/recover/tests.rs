//! Repair of episodes that the recorder wrote and something happened to.

use std::collections::BTreeSet;
use std::io::Write;
use std::time::Duration;

use proptest::prelude::*;
use rapid_status::{Grade, Level};

use super::copy::Error;
use super::report::About;
use super::*;
use crate::effort::every;
use crate::record::Sink;
use crate::record::tests::{Bench, registry};
use crate::testing::{self, Message, metadata, mutated, mutations, strictly};

pub(super) fn keep_going(_: u64, _: u64) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

pub(super) fn repaired(path: &Path) -> Repaired {
    match recover(path, &mut keep_going).unwrap().outcome {
        RepairOutcome::Repaired(repaired) => *repaired,
        other => panic!("{other:?}"),
    }
}

pub(super) fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// The bytes of an episode of the recorder, and a folder to play with.
pub(super) async fn recorded() -> (tempfile::TempDir, Vec<u8>) {
    let mut bench = Bench::new();
    let (file, _) = bench.one_second().await;
    bench.until_file(&file).await;
    (tempfile::tempdir().unwrap(), fs::read(&file).unwrap())
}

pub(super) fn put(folder: &tempfile::TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    path
}

#[tokio::test]
async fn a_torn_episode_becomes_a_whole_one_with_all_its_content() {
    let (folder, bytes) = recorded().await;
    let original = strictly(&bytes);
    let cut = bytes.len() * 3 / 5;
    let partial = put(&folder, "20261121_t_003.mcap.partial", &bytes[..cut]);
    let report = recover(&partial, &mut keep_going).unwrap();
    let RepairOutcome::Repaired(ref repaired) = report.outcome else { panic!("{report:?}") };
    assert_eq!(names(folder.path()), ["20261121_t_003.mcap"]);
    assert_eq!(repaired.to, folder.path().join("20261121_t_003.mcap"));
    let whole = fs::read(&repaired.to).unwrap();
    let messages = strictly(&whole);
    assert!(messages.len() > 100 && original.starts_with(&messages));
    assert_eq!((repaired.messages, repaired.end), (messages.len() as u64, FileEnd::Torn));
    assert_eq!((repaired.damaged_chunks, repaired.refused_records, &repaired.original), (0, 0, &None));
    assert!(repaired.unread_bytes > 0 && repaired.ordered_messages > 0);
    let (level, sentence) = report.sentence();
    let expected = format!(
        "20261121_t_003.mcap.partial: repaired, {:.1} s, {} messages; the last second may be missing: {} bytes at the end were torn; \
         {} messages of a torn chunk taken without a check value, written since this machine was started",
        repaired.seconds,
        rapid_core::text::count(repaired.messages),
        rapid_core::text::count(repaired.unread_bytes),
        rapid_core::text::count(repaired.ordered_messages)
    );
    assert!(level == Level::Info && sentence.ends_with(&expected), "{sentence}");

    // The recorder's metadata at the beginning are as they were; those at the end are made of
    // what is there.
    let (before, after) = (metadata(&bytes), metadata(&whole));
    assert_eq!(after["rapid"], before["rapid"]);
    let count = |topic: &str| messages.iter().filter(|message| message.0 == topic).count();
    let tallies: serde_json::Value = serde_json::from_str(&after["rapid/summary"]["modalities"]).unwrap();
    for name in ["cam_wrist", "tof", "never", "raw"] {
        assert_eq!(tallies[name]["samples"], count(&format!("/rapid/{name}")), "{name}");
    }
    assert_eq!(after["rapid/summary"]["messages"], messages.len().to_string());
    assert_eq!(after["rapid/summary"]["frames"], count("/rapid/frame").to_string());
    let last = messages.iter().map(|message| message.2).max().unwrap();
    let begin: u64 = before["rapid"]["begin_wall_ns"].parse().unwrap();
    let seconds = (last - begin) as f64 / 1e9;
    assert_eq!(after["rapid/summary"]["duration_s"], seconds.to_string());
    let about = &after["rapid/recovered"];
    assert_eq!((about["messages"].as_str(), about["end"].as_str()), (messages.len().to_string().as_str(), "torn"));
    assert_eq!((about["last_wall_ns"].as_str(), about["damaged_chunks"].as_str()), (last.to_string().as_str(), "0"));
    assert_eq!((about["source_bytes"].as_str()), cut.to_string());
    assert_eq!(about["software"], concat!("rapid ", env!("CARGO_PKG_VERSION")));
    let (old, new) = (mcap::Summary::read(&bytes).unwrap().unwrap(), mcap::Summary::read(&whole).unwrap().unwrap());
    assert_eq!(new.channels, old.channels);
    assert_eq!(new.schemas, old.schemas);
    let attached = mcap::read::attachment(&whole, &new.attachment_indexes[0]).unwrap();
    assert_eq!((attached.name.as_str(), &*attached.data), ("devices.toml", registry().text.as_bytes()));
    // For `inspect` it is an episode like any other.
    let inspected = crate::record::inspect::inspect(&repaired.to).unwrap();
    assert_eq!((inspected.end, inspected.messages), (FileEnd::Finished, messages.len() as u64));
    assert!((inspected.seconds - seconds).abs() < 1e-9 && inspected.dropped.is_none());
    assert_eq!(inspected.verdict.grade().unwrap(), Grade::Bad, "a modality of the test never delivers");
    let reason = format!(
        "the file is not whole: it was repaired; what came last may be missing; {} messages at its end are taken without a check value",
        rapid_core::text::count(repaired.ordered_messages)
    );
    assert!(inspected.verdict.reasons().contains(&reason.as_str()), "{:?}", inspected.verdict);
}

#[tokio::test]
async fn cut_at_any_byte_everything_before_the_cut_is_kept() {
    let (_folder, bytes) = recorded().await;
    let original = strictly(&bytes);
    let mut before = 0;
    for cut in (0..bytes.len()).step_by(397) {
        let Some(whole) = recover_bytes(&bytes[..cut]) else {
            assert!(cut < MAGIC.len());
            continue;
        };
        let messages = strictly(&whole);
        assert!(original.starts_with(&messages), "cut at {cut}");
        assert!(messages.len() >= before, "cut at {cut}");
        before = messages.len();
    }
    assert_eq!(before, original.len());
}

#[test]
fn a_flipped_bit_loses_messages_and_never_invents_any() {
    for (layout, bytes) in testing::layouts().map(testing::episode).into_iter().enumerate() {
        // The last is a file without chunks: it has no check value but that of the whole.
        let is_checked = layout < 3;
        let original: BTreeSet<Message> = strictly(&bytes).into_iter().collect();
        assert_eq!(original.len(), 200);
        for at in (0..bytes.len()).step_by(3 * every(13)) {
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << (at % 8);
            let Some(whole) = recover_bytes(&flipped) else { continue };
            let messages = strictly(&whole);
            if is_checked {
                assert!(messages.iter().all(|message| original.contains(message)), "byte {at}");
            }
        }
    }
}

#[test]
fn whatever_happened_to_a_file_the_repaired_one_is_whole() {
    let config = ProptestConfig { cases: 100, failure_persistence: None, ..ProptestConfig::default() };
    for bytes in testing::layouts().map(testing::episode) {
        proptest!(config.clone(), |(mutations in mutations())| {
            if let Some(whole) = recover_bytes(&mutated(&bytes, &mutations)) {
                strictly(&whole);
                // Repaired once, it needs no repair.
                let summary = copy::summary(&*whole, whole.len() as u64, &mut keep_going).unwrap().unwrap();
                prop_assert!(summary.is_whole());
            }
        });
    }
}

#[tokio::test]
async fn a_file_being_written_is_left_alone() {
    let (folder, bytes) = recorded().await;
    let partial = put(&folder, "a_001.mcap.partial", &bytes[..bytes.len() / 2]);
    let held = File::open(&partial).unwrap();
    held.lock().unwrap();
    let error = recover(&partial, &mut keep_going).unwrap_err();
    assert!(matches!(error, RecoverError::Busy(_)), "{error}");
    assert_eq!(names(folder.path()), ["a_001.mcap.partial"]);
    drop(held);
    repaired(&partial);

    // The recorder's own, from its first moment to its last.
    let mut bench = Bench::new();
    let (finished, _) = bench.one_second().await;
    let partial = finished.with_extension("mcap.partial");
    while !finished.exists() {
        match recover(&partial, &mut keep_going) {
            Err(RecoverError::Busy(_)) => {}
            Err(RecoverError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {}
            other => panic!("{other:?}"),
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    assert!(strictly(&fs::read(&finished).unwrap()).len() > 100);
    assert_eq!(names(finished.parent().unwrap()).len(), 1);
}

#[tokio::test]
async fn files_without_messages_are_reported_and_kept() {
    let (folder, bytes) = recorded().await;
    let empty = put(&folder, "a_001.mcap.partial", b"");
    assert_eq!(recover(&empty, &mut keep_going).unwrap().outcome, RepairOutcome::Empty { kept: None });
    let noise = put(&folder, "a_002.mcap.partial", b"no MCAP file");
    let kept = folder.path().join("a_002.mcap.damaged");
    assert_eq!(
        recover(&noise, &mut keep_going).unwrap().outcome,
        RepairOutcome::Unreadable { kept: kept.clone(), failed: None }
    );
    assert_eq!(fs::read(kept).unwrap(), b"no MCAP file");
    // Header, metadata and channels, as they are on the disk when an episode has just begun.
    let mut bare = bytes.clone();
    let first = strictly(&bytes)[1].4.clone();
    bare.truncate(bytes.windows(first.len()).position(|window| window == first).unwrap());
    let bare = put(&folder, "a_003.mcap.partial", &bare);
    let kept = folder.path().join("a_003.mcap.empty");
    assert_eq!(recover(&bare, &mut keep_going).unwrap().outcome, RepairOutcome::Empty { kept: Some(kept) });
    assert_eq!(names(folder.path()), ["a_002.mcap.damaged", "a_003.mcap.empty"]);
    // A second one of that name does not replace the first.
    let noise = put(&folder, "a_002.mcap.partial", b"other");
    recover(&noise, &mut keep_going).unwrap();
    assert_eq!(names(folder.path()), ["a_002.mcap.damaged", "a_002.mcap.damaged-2", "a_003.mcap.empty"]);
}

#[tokio::test]
async fn an_interrupted_repair_is_repeated() {
    let (folder, bytes) = recorded().await;
    let many = bytes[..bytes.len() * 9 / 10].to_vec();
    let partial = put(&folder, "a_001.mcap.partial", &many);
    // By the user.
    let private = [&[0x80][..], &(2_u64 << 20).to_le_bytes(), &vec![7; 2 << 20]].concat();
    let long = put(&folder, "b_001.mcap.partial", &[&many[..MAGIC.len()], &private, &many[MAGIC.len()..]].concat());
    let error = recover(&long, &mut |_, _| ControlFlow::Break(())).unwrap_err();
    assert!(matches!(error, RecoverError::Interrupted(_)), "{error}");
    assert_eq!(names(folder.path()), ["a_001.mcap.partial", "b_001.mcap.partial"]);
    fs::remove_file(&long).unwrap();
    // By a kill: half of a repaired file is there.
    put(&folder, "a_001.mcap.recovering", &bytes[..1000]);
    let first = repaired(&partial);
    assert_eq!(names(folder.path()), ["a_001.mcap"]);
    // By a kill between the two last steps: the repaired file has its name, the original is there too.
    fs::write(&partial, &many).unwrap();
    let again = recover(&partial, &mut keep_going).unwrap();
    assert_eq!(again.outcome, RepairOutcome::AlreadyRepaired { to: first.to.clone(), kept: None });
    assert_eq!(names(folder.path()), ["a_001.mcap"]);
    // A file of that name that is something else is not taken for it, nor replaced.
    fs::write(&partial, &many[..many.len() - 1]).unwrap();
    let other = repaired(&partial);
    assert_eq!(other.to, folder.path().join("a_001.recovered.mcap"));
    assert_eq!(names(folder.path()), ["a_001.mcap", "a_001.recovered.mcap"]);
}

#[test]
fn unread_parts_of_an_interrupted_repair_are_kept_by_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let mut damaged = testing::episode(testing::options().compression(None));
    let topic = damaged.windows(10).position(|window| window == b"/rapid/tof").unwrap();
    let mask = damaged[topic..].windows(10).position(|window| window == b"/rapid/mas").unwrap() + topic;
    damaged[mask] = b'X';
    let partial = put(&folder, "a_001.mcap.partial", &damaged);
    let first = repaired(&partial);
    assert!(first.damaged_chunks > 0 && first.original.is_some());
    // By a kill between the two last steps: the repaired file has its name, the original is not set aside.
    fs::rename(first.original.unwrap(), &partial).unwrap();
    let report = recover(&partial, &mut keep_going).unwrap();
    let kept = folder.path().join("a_001.mcap.damaged");
    assert_eq!(report.outcome, RepairOutcome::AlreadyRepaired { to: first.to, kept: Some(kept.clone()) });
    assert_eq!((report.sentence().0, fs::read(&kept).unwrap()), (Level::Warn, damaged));
    assert_eq!(names(folder.path()), ["a_001.mcap", "a_001.mcap.damaged"]);
}

#[test]
fn bytes_after_the_end_of_a_file_are_kept() {
    let whole = testing::episode(testing::options());
    let other = testing::episode(testing::options().compression(None));
    for behind in [&b"x"[..], &[0; 5000], &whole, &other] {
        let folder = tempfile::tempdir().unwrap();
        let bytes = [&whole[..], behind].concat();
        let partial = put(&folder, "a_001.mcap.partial", &bytes);
        let first = repaired(&partial);
        let original = first.original.expect("what was not read is kept");
        assert_eq!(fs::read(original).unwrap(), bytes);
        assert_eq!(strictly(&fs::read(first.to).unwrap()), strictly(&whole));
        assert_eq!(first.left_out.bytes_behind, behind.len() as u64);
    }
}

/// A disk with space for this many bytes.
struct SmallDisk(Vec<u8>, usize);

impl Write for SmallDisk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let taken = bytes.len().min(self.1 - self.0.len());
        if taken == 0 && !bytes.is_empty() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.0.extend(&bytes[..taken]);
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Sink for SmallDisk {
    fn sync(&mut self) -> io::Result<()> {
        if self.1 == self.0.len() { Err(io::ErrorKind::StorageFull.into()) } else { Ok(()) }
    }
}

#[test]
fn a_disk_full_at_any_byte_is_an_error() {
    let bytes = testing::episode(testing::options().compression(None));
    let about = About { name: "bytes.mcap", sha256: String::new(), time_ns: 0, boot: None, failed: None };
    let needed = recover_bytes(&bytes).unwrap().len();
    for room in (0..needed).step_by(13) {
        let disk = SmallDisk(Vec::new(), room);
        let copied = copy::copy(&*bytes, bytes.len() as u64, &about, disk, &mut keep_going);
        assert!(matches!(copied, Err(Error::Write(error)) if error.kind() == io::ErrorKind::StorageFull), "{room}");
    }
}

#[tokio::test]
async fn an_episode_that_only_lacks_its_name_gets_it() {
    let (folder, bytes) = recorded().await;
    let partial = put(&folder, "a_001.mcap.partial", &bytes);
    let to = folder.path().join("a_001.mcap");
    assert_eq!(recover(&partial, &mut keep_going).unwrap().outcome, RepairOutcome::Whole { to: to.clone() });
    assert_eq!(names(folder.path()), ["a_001.mcap"]);
    assert_eq!(fs::read(&to).unwrap(), bytes);
    assert_eq!(recover(&to, &mut keep_going).unwrap().outcome, RepairOutcome::Whole { to: to.clone() });
    assert_eq!(fs::read(&to).unwrap(), bytes);
}

#[tokio::test]
async fn a_repair_is_found_again_under_any_name() {
    let (folder, bytes) = recorded().await;
    let cut = put(&folder, "a_001.mcap", &bytes[..bytes.len() - 30]);
    for number in [1, 2] {
        let other = if number == 1 { "a_001.recovered.mcap" } else { "a_001.recovered-2.mcap" };
        put(&folder, other, b"another file");
        let made = repaired(&cut);
        for _ in 0..2 {
            let again = recover(&cut, &mut keep_going).unwrap();
            assert_eq!(again.outcome, RepairOutcome::AlreadyRepaired { to: made.to.clone(), kept: None });
        }
        fs::remove_file(&made.to).unwrap();
    }
}

#[tokio::test]
async fn a_damaged_finished_file_gets_a_whole_one_beside_it() {
    let (folder, bytes) = recorded().await;
    let original = strictly(&bytes);
    let cut = put(&folder, "a_001.mcap", &bytes[..bytes.len() - 30]);
    let made = repaired(&cut);
    assert_eq!((&made.to, &made.original), (&folder.path().join("a_001.recovered.mcap"), &Some(cut.clone())));
    assert_eq!(strictly(&fs::read(&made.to).unwrap()), original);
    assert_eq!(fs::read(&cut).unwrap(), bytes[..bytes.len() - 30]);
    let again = recover(&cut, &mut keep_going).unwrap();
    assert_eq!(again.outcome, RepairOutcome::AlreadyRepaired { to: made.to.clone(), kept: None });
    // The recorder had written its summary: that one is kept, and there is no second one.
    assert_eq!(metadata(&fs::read(&made.to).unwrap())["rapid/summary"], metadata(&bytes)["rapid/summary"]);

    // The chunk with the channels is damaged: the index still knows them.
    let mut damaged = testing::episode(testing::options().compression(None));
    let topic = damaged.windows(10).position(|window| window == b"/rapid/tof").unwrap();
    let first = damaged[topic..].windows(10).position(|window| window == b"/rapid/mas").unwrap() + topic;
    damaged[first] = b'X';
    let all: BTreeSet<Message> = strictly(&testing::episode(testing::options())).into_iter().collect();
    let file = put(&folder, "b_001.mcap", &damaged);
    let made = repaired(&file);
    assert_eq!((made.damaged_chunks, made.end), (1, FileEnd::Finished));
    let kept = strictly(&fs::read(&made.to).unwrap());
    assert!(kept.len() > 150 && kept.len() < 200, "{}", kept.len());
    assert!(kept.iter().all(|message| all.contains(message)));
    // Left over of an episode, the same is kept for further attempts.
    let file = put(&folder, "c_001.mcap.partial", &damaged);
    let made = repaired(&file);
    assert_eq!(made.original, Some(folder.path().join("c_001.mcap.damaged")));
    assert_eq!(fs::read(made.original.unwrap()).unwrap(), damaged);
    assert!(!file.exists());
}

#[test]
fn anything_but_a_file_is_an_error_and_not_touched() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("folder.mcap.partial")).unwrap();
    rustix::fs::mknodat(rustix::fs::CWD, at("pipe.mcap.partial"), rustix::fs::FileType::Fifo, 0o600.into(), 0).unwrap();
    fs::write(at("target"), testing::episode(testing::options())).unwrap();
    std::os::unix::fs::symlink(at("target"), at("link.mcap.partial")).unwrap();
    std::os::unix::fs::symlink(at("nowhere"), at("dangling.mcap.partial")).unwrap();
    let before = names(folder.path());
    for name in ["folder", "pipe", "link", "dangling"] {
        let error = recover(&at(&format!("{name}.mcap.partial")), &mut keep_going).unwrap_err();
        assert!(matches!(error, RecoverError::NotFile(_)) && error.is_bad_argument(), "{name}: {error}");
    }
    assert!(matches!(recover(Path::new("/dev/zero"), &mut keep_going), Err(RecoverError::NotFile(_))));
    assert!(recover(&at("missing.mcap"), &mut keep_going).unwrap_err().is_bad_argument());
    fs::write(at("text.mcap"), "no").unwrap();
    assert!(matches!(recover(&at("text.mcap"), &mut keep_going), Err(RecoverError::NotMcap(_))));
    fs::write(at("bare.mcap"), MAGIC).unwrap();
    assert!(matches!(recover(&at("bare.mcap"), &mut keep_going), Err(RecoverError::Nothing(_))));
    assert_eq!(left_behind(folder.path()).unwrap(), Vec::<PathBuf>::new());
    fs::remove_file(at("text.mcap")).unwrap();
    fs::remove_file(at("bare.mcap")).unwrap();
    assert_eq!(names(folder.path()), before);
    // A link in the place of the file to be written is not followed, nor what it means written to.
    let partial = at("a.mcap.partial");
    let bytes = testing::episode(testing::options());
    fs::write(&partial, &bytes[..bytes.len() / 2]).unwrap();
    std::os::unix::fs::symlink(at("target"), at("a.mcap.recovering")).unwrap();
    repaired(&partial);
    fs::write(&partial, &bytes[..=bytes.len() / 2]).unwrap();
    fs::hard_link(at("target"), at("a.mcap.recovering")).unwrap();
    repaired(&partial);
    assert_eq!(fs::read(at("target")).unwrap(), bytes);
}

#[tokio::test]
async fn two_repairs_at_once_make_one_file() {
    let (folder, bytes) = recorded().await;
    for round in 0..20 {
        let partial = put(&folder, &format!("a_{round:03}.mcap.partial"), &bytes[..bytes.len() / 2]);
        let together = std::sync::Barrier::new(4);
        let outcomes: Vec<_> = std::thread::scope(|scope| {
            let repair = || {
                together.wait();
                recover(&partial, &mut keep_going)
            };
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(repair)).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        let made = outcomes.iter().filter(|outcome| outcome.is_ok()).count();
        assert_eq!(made, 1, "{outcomes:?}");
        for error in outcomes.into_iter().filter_map(Result::err) {
            let gone = matches!(&error, RecoverError::Io { source, .. } if source.kind() == io::ErrorKind::NotFound);
            assert!(gone || matches!(error, RecoverError::Busy(_)), "{error}");
        }
        assert_eq!(names(folder.path()).len(), round + 1);
    }
}
