//! Dropping an episode that is too short to be used, and nothing else.

use super::*;
use crate::status::ShortEpisode;

/// What another program does to the file of a short episode before it is dropped.
type Deed = fn(&Path);

/// Records an episode of this length; its file.
async fn recorded(bench: &Bench, milliseconds: u64) -> PathBuf {
    let finished = bench.recorder.start(bench.request(Some(Duration::from_millis(milliseconds)))).await.unwrap();
    // Its duration ends it, by now or later; either way its file is closed behind this.
    let _ = bench.recorder.stop_at(Stamp(u64::MAX)).await;
    finished
}

fn offered(bench: &Bench) -> Option<ShortEpisode> {
    bench.board.snapshot().short_episode
}

fn names(bench: &Bench) -> Vec<String> {
    let entries = std::fs::read_dir(bench.folder.path().join("out")).unwrap();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[tokio::test]
async fn a_short_episode_can_be_dropped_once_and_its_name_is_not_given_again() {
    let bench = Bench::new();
    let mut events = bench.board.events();
    let file = recorded(&bench, 200).await;
    let offer = offered(&bench).expect("an offer");
    assert_eq!((&offer.file, offer.length), (&file, Duration::from_millis(200)));
    assert_eq!(bench.board.snapshot().last_verdict.map(|verdict| verdict.grade), Some(Grade::Bad));
    bench.recorder.drop_short(file.clone()).await.unwrap();
    assert!(!file.exists());
    let snapshot = bench.board.snapshot();
    assert_eq!((snapshot.last_episode, snapshot.last_verdict, snapshot.short_episode), (None, None, None));
    bench.until_closed(&mut events).await;
    assert_eq!(events.recv().await.unwrap().what, What::Dropped { file: file.clone(), seconds: 0.2 });
    let report = &snapshot.log.last().unwrap().text;
    assert!(report.starts_with("episode ") && report.ends_with("_001.mcap dropped; it was 0.2 s long"), "{report}");
    assert!(matches!(bench.recorder.drop_short(file.clone()).await, Err(RecordError::Kept(_))));
    // Devices and programs that record on their own know the name as the dropped episode's.
    let next = recorded(&bench, 200).await;
    assert_ne!(next, file);
    assert_eq!(names(&bench), [next.file_name().unwrap().to_str().unwrap()]);
}

#[tokio::test]
async fn only_the_last_episode_can_be_dropped_and_only_if_it_is_short() {
    let bench = Bench::new();
    // Long enough.
    let long = recorded(&bench, 500).await;
    assert_eq!(offered(&bench), None);
    assert!(matches!(bench.recorder.drop_short(long.clone()).await, Err(RecordError::Kept(_))));
    // Short, and another has begun.
    let first = recorded(&bench, 100).await;
    assert!(offered(&bench).is_some());
    let second = bench.recorder.start(bench.request(None)).await.unwrap();
    assert_eq!(offered(&bench), None, "withdrawn when the next episode begins");
    assert!(matches!(bench.recorder.drop_short(first.clone()).await, Err(RecordError::Kept(_))));
    assert!(matches!(bench.recorder.drop_short(second.clone()).await, Err(RecordError::Kept(_))));
    assert!(bench.recorder.stop().await.unwrap().seconds >= 0.0);
    // Of two short ones the last.
    let third = recorded(&bench, 100).await;
    assert!(matches!(bench.recorder.drop_short(first.clone()).await, Err(RecordError::Kept(_))));
    bench.recorder.drop_short(third.clone()).await.unwrap();
    assert!(long.exists() && first.exists() && second.exists() && !third.exists(), "{:?}", names(&bench));
}

#[tokio::test]
async fn a_file_that_no_longer_belongs_to_the_recorder_is_not_removed() {
    let deeds: [(&str, Deed); 5] = [
        ("replaced by a longer one", |file| std::fs::rename(file.with_file_name("other"), file).unwrap()),
        ("overwritten in place", |file| std::fs::write(file, "precious").unwrap()),
        ("extended", |file| File::options().append(true).open(file).unwrap().write_all(b"precious").unwrap()),
        ("a link instead", |file| {
            std::fs::remove_file(file).unwrap();
            std::os::unix::fs::symlink(file.with_file_name("other"), file).unwrap();
        }),
        ("removed", |file| std::fs::remove_file(file).unwrap()),
    ];
    for (what, deed) in deeds {
        let bench = Bench::new();
        let file = recorded(&bench, 100).await;
        std::fs::write(file.with_file_name("other"), "precious").unwrap();
        deed(&file);
        let before = names(&bench);
        let error = bench.recorder.drop_short(file.clone()).await.unwrap_err();
        assert!(matches!(error, RecordError::Io { .. }), "{what}: {error}");
        assert_eq!(names(&bench), before, "{what}");
        assert_eq!(offered(&bench), None, "{what}: not offered twice");
    }
}
