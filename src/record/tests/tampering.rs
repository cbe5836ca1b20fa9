//! Other programs that damage, replace or only look at the file while it is recorded.

use std::fs::OpenOptions;
use std::io::{Read as _, Seek, SeekFrom};
use std::time::Instant;

use super::*;

/// How long a condition may take before a test gives up; no requirement.
const PATIENCE: Duration = Duration::from_secs(30);
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

async fn recorded(
    deed: Deed,
) -> (Bench, PathBuf, Option<File>, tokio::sync::broadcast::Receiver<crate::status::Event>) {
    let bench = Bench::new();
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
    let deeds: [(&str, &str, Deed); 6] = [
        ("cut to nothing", "another program cut it while it was recorded", |file| {
            cut(file, |_| 0);
            None
        }),
        ("cut to a third", "another program cut it while it was recorded", |file| {
            cut(file, |size| size / 3);
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
            std::fs::write(&other, "of somebody else").unwrap();
            std::fs::rename(&other, file).unwrap();
            None
        }),
        ("removed, and another made", "another program put another file in its place", |file| {
            std::fs::remove_file(file).unwrap();
            std::fs::write(file, "of somebody else").unwrap();
            None
        }),
    ];
    for (what, why, deed) in deeds {
        let (bench, finished, _, mut events) = recorded(deed).await;
        // Nobody asks for the end.
        let closed = tokio::time::timeout(PATIENCE, bench.until_closed(&mut events)).await;
        let What::Episode { file, error, verdict, .. } = closed.unwrap_or_else(|_| panic!("{what}: goes on")) else {
            unreachable!()
        };
        let error = error.unwrap_or_else(|| panic!("{what}: no error"));
        assert!(error.contains(why), "{what}: {error}");
        assert_eq!(verdict.grade, Grade::Bad, "{what}");
        assert!(verdict.why().contains(why), "{what}: {}", verdict.why());
        assert!(!finished.exists() && file.extension().is_some_and(|extension| extension == "partial"), "{what}");
        if why.contains("place") {
            let partial = finished.with_extension("mcap.partial");
            assert_eq!(std::fs::read_to_string(partial).unwrap(), "of somebody else", "{what}");
            // What was recorded is kept beside it.
            assert!(std::fs::metadata(&file).unwrap().len() >= ENOUGH, "{what}: {}", file.display());
        }
    }
}

#[tokio::test]
async fn a_file_that_is_changed_within_while_it_is_recorded_is_not_called_good() {
    let deeds: [(&str, Deed); 3] = [
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
        let (bench, finished, _kept, _) = recorded(deed).await;
        let report = bench.recorder.stop().await.unwrap();
        let error = report.error.unwrap_or_else(|| panic!("{what}: no error"));
        assert!(error.contains("another program") && error.contains("while it was recorded"), "{what}: {error}");
        assert_eq!(report.verdict.grade, Grade::Bad, "{what}");
        assert!(!finished.exists(), "{what}");
    }
}

#[tokio::test]
async fn a_file_that_others_only_look_at_or_touch_is_recorded_as_ever() {
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
        let (bench, finished, _kept, _) = recorded(deed).await;
        let report = bench.recorder.stop().await.unwrap();
        assert_eq!((report.error, report.file.as_path()), (None, finished.as_path()), "{what}");
        assert_eq!(read(&finished).on("/rapid/cam_wrist").count(), 400, "{what}");
    }
}
