//! Disks that fail, kills and panics.

use super::*;
use crate::Failed;
use crate::recover;

/// A disk of few bytes, and what it says when they are written.
struct SmallDisk(File, usize, io::ErrorKind);

impl SmallDisk {
    fn new(file: File, bytes: usize) -> Self {
        Self(file, bytes, io::ErrorKind::StorageFull)
    }
}

impl Write for SmallDisk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.1 == 0 {
            return Err(self.2.into());
        }
        let taken = self.0.write(&bytes[..bytes.len().min(self.1)])?;
        self.1 -= taken;
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Sink for SmallDisk {
    fn sync(&mut self) -> io::Result<()> {
        self.0.sync_all()
    }
}

#[tokio::test]
async fn a_full_disk_ends_the_episode_and_not_the_recorder() {
    for kind in [io::ErrorKind::StorageFull, io::ErrorKind::QuotaExceeded, io::ErrorKind::FileTooLarge] {
        let mut episodes = 0;
        let mut bench = Bench::with_sink(move |file| {
            episodes += 1;
            if episodes == 1 { Box::new(SmallDisk(file, 100_000, kind)) } else { Box::new(file) }
        });
        let mut events = bench.board.events();
        let finished = bench.recorder.start(bench.request(None)).await.unwrap();
        for seq in 0..4000 {
            bench.sample(CAM, 1, seq, Stamp::now().0, 0);
        }
        let closed = bench.until_closed(&mut events).await;
        let sentence = closed.describe().sentence;
        let EventKind::Episode(EpisodeReport { file, bytes, error, .. }) = closed else { unreachable!() };
        assert_eq!(file, finished.with_extension("mcap.partial"));
        let why = io::Error::from(kind).to_string();
        assert_eq!(bytes, 100_000 + Failed::mark(&why).len() as u64);
        let error = error.unwrap();
        assert!(error.contains(&why) && error.contains("remove or move recordings"), "{error}");
        assert_eq!(sentence.matches("place-block_001.mcap.partial").count(), 1, "{sentence}");
        assert!(!finished.exists() && bench.board.snapshot().recording.is_none());
        // Its end is kept for whoever waits for it.
        assert_eq!(bench.recorder.ended().await.unwrap().error.as_ref(), Some(&error));
        // The next one goes well.
        let second = bench.recorder.start(bench.request(None)).await.unwrap();
        assert!(second.to_str().unwrap().ends_with("_002.mcap"));
        assert_eq!(bench.recorder.stop().await.unwrap().error, None);
    }
}

/// A disk that is full once and has room again.
struct Recovering(SmallDisk);

impl Write for Recovering {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.0.write(bytes);
        if written.is_err() {
            self.0.1 = usize::MAX;
        }
        written
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Sink for Recovering {
    fn sync(&mut self) -> io::Result<()> {
        self.0.sync()
    }
}

#[tokio::test]
async fn nothing_is_written_after_a_failed_write() {
    let mut bench = Bench::with_sink(|file| Box::new(Recovering(SmallDisk::new(file, 100_000))));
    let mut events = bench.board.events();
    bench.recorder.start(bench.request(None)).await.unwrap();
    for seq in 0..4000 {
        bench.sample(CAM, 1, seq, Stamp::now().0, 0);
    }
    let EventKind::Episode(EpisodeReport { file, bytes, error, .. }) = bench.until_closed(&mut events).await else {
        unreachable!()
    };
    assert!(error.is_some());
    // Nothing of the episode: only that it failed.
    let mark = Failed::mark("no storage space");
    assert_eq!(bytes, 100_000 + mark.len() as u64);
    assert!(std::fs::read(&file).unwrap().ends_with(&mark));
    assert_eq!(inspect::inspect(&file).unwrap().end, inspect::FileEnd::Torn);
}

/// A disk whose cable is pulled between two writes, and put back. Of that its writer, which only
/// remembers what went wrong in a write of its own, knows nothing.
struct Loose(File, u32);

impl Write for Loose {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.1 += 1;
        if self.1 == 2 { Err(io::Error::other("cable pulled")) } else { self.0.flush() }
    }
}

impl Sink for Loose {
    fn sync(&mut self) -> io::Result<()> {
        self.0.sync_all()
    }
}

#[tokio::test]
async fn a_failed_file_gets_no_end_that_makes_it_look_whole() {
    let mut bench = Bench::with_sink(|file| Box::new(Loose(file, 0)));
    let mut events = bench.board.events();
    bench.recorder.start(bench.request(None)).await.unwrap();
    let mut seq = 0;
    let closed = loop {
        bench.sample(CAM, 1, seq, Stamp::now().0, 0);
        seq += 1;
        tokio::task::yield_now().await;
        match events.try_recv() {
            Ok(event) if matches!(event.what, EventKind::Episode(_)) => break event.what,
            _ => {}
        }
    };
    let EventKind::Episode(EpisodeReport { file, error, verdict, .. }) = closed else { unreachable!() };
    assert!(error.unwrap().contains("cable pulled"));
    assert_eq!(verdict.grade, Grade::Bad);
    let answer = inspect::inspect(&file).unwrap();
    assert_eq!((answer.end, answer.recorded_verdict), (inspect::FileEnd::Unfinished, None));
    assert_ne!(answer.verdict.grade().unwrap(), Grade::Good);
    let repaired = recover::recover(&file, &mut |_, _| std::ops::ControlFlow::Continue(())).unwrap();
    assert!(matches!(repaired.outcome, recover::RepairOutcome::Repaired(_)), "{repaired:?}");
}

#[tokio::test]
async fn a_footer_without_our_summary_does_not_make_an_episode_whole() {
    // As a version before this one left it: the writer was dropped, and ended the file itself.
    let mut bench = Bench::new();
    let (file, _) = bench.one_second().await;
    bench.until_file(&file).await;
    let partial = bench.folder.path().join("t_001.mcap.partial");
    let mut writer = mcap::Writer::new(File::create(&partial).unwrap()).unwrap();
    let bytes = std::fs::read(&file).unwrap();
    for record in mcap::read::LinearReader::new(&bytes).unwrap() {
        if let mcap::records::Record::Metadata(metadata) = record.unwrap()
            && metadata.name == "rapid"
        {
            writer.write_metadata(&metadata).unwrap();
        }
    }
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        writer.write(&message.unwrap()).unwrap();
    }
    drop(writer);
    let answer = inspect::inspect(&partial).unwrap();
    let reason = "the file is not whole: the recorder has not finished it";
    assert_eq!(answer.end, inspect::FileEnd::Finished);
    assert!(answer.verdict.reasons().contains(&reason), "{:?}", answer.verdict);
    let answer = recover::recover(&partial, &mut |_, _| std::ops::ControlFlow::Continue(())).unwrap();
    let recover::RepairOutcome::Repaired(repaired) = answer.outcome else { panic!("{answer:?}") };
    // Nothing of it is left out, and nothing of it is kept.
    assert!(repaired.original.is_none() && !partial.exists());
    let answer = inspect::inspect(&repaired.to).unwrap();
    let reasons = answer.verdict.reasons();
    assert!(reasons.iter().any(|answer| answer.contains("it was repaired")), "{reasons:?}");
}

/// A disk that takes everything and keeps nothing for sure.
pub(super) struct Unsure(pub(super) File);

impl Write for Unsure {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Sink for Unsure {
    fn sync(&mut self) -> io::Result<()> {
        Err(io::Error::other("cable of the disk pulled"))
    }
}

#[tokio::test]
async fn a_file_not_yet_on_the_disk_keeps_its_partial_name() {
    let mut bench = Bench::with_sink(|file| Box::new(Unsure(file)));
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!(report.file, finished.with_extension("mcap.partial"));
    assert!(report.error.unwrap().contains("cable of the disk pulled") && !finished.exists());
    assert_eq!(bench.board.snapshot().last_episode, None);
}

#[tokio::test]
async fn a_disk_full_at_the_start_is_an_error_and_leaves_no_file() {
    let mut bench = Bench::with_sink(|file| Box::new(SmallDisk::new(file, 0)));
    let mut request = bench.request(None);
    // More than the buffer in front of the disk holds.
    request.task = "x".repeat(200_000);
    let error = bench.recorder.start(request).await.unwrap_err();
    assert!(error.to_string().contains("no storage space"), "{error}");
    assert_eq!(std::fs::read_dir(bench.folder.path().join("out")).unwrap().count(), 0);
    assert_eq!(bench.recorder.stop().await, None);
}

#[tokio::test]
async fn a_partial_file_holds_all_flushed_messages() {
    let mut bench = Bench::new();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let partial = finished.with_extension("mcap.partial");
    for seq in 0..10 {
        bench.sample(TOF, 1, seq, Stamp::now().0, 0);
    }
    // As a kill would leave it: the file as it is at a moment before its end.
    let answer = loop {
        match inspect::inspect(&partial) {
            Ok(answer) if answer.modalities.iter().any(|m| m.topic.messages == 10) => break answer,
            _ => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    };
    assert_eq!((answer.end, answer.damaged_chunks, answer.dropped), (inspect::FileEnd::Unfinished, 0, None));
    assert_eq!((answer.rig.as_str(), answer.modalities.len()), ("bench", 4));
    assert!(!finished.exists());
    bench.recorder.stop().await.unwrap();
    assert!(finished.exists() && !partial.exists());
}

#[tokio::test]
async fn a_panic_leaves_a_finished_file_and_is_reported() {
    let mut bench = Bench::new();
    let mut events = bench.board.events();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let now = Stamp::now();
    bench.sample(TOF, 1, 0, now.0, 0);
    while bench.board.snapshot().recording.is_none_or(|status| status.bytes == 0) {
        tokio::task::yield_now().await;
    }
    bench.script.panic();
    let EventKind::Episode(EpisodeReport { file, error, .. }) = bench.until_closed(&mut events).await else {
        unreachable!()
    };
    assert_eq!(file, finished);
    assert!(error.unwrap().contains("scripted panic"));
    // A reader of the file sees the recorder's verdict.
    let answer = inspect::inspect(&finished).unwrap();
    assert!(answer.recorded_verdict.as_ref().unwrap().reasons.iter().any(|answer| answer.contains("scripted panic")));
    assert_eq!(answer.verdict.verdict(), answer.recorded_verdict.as_ref());
    assert_eq!(read(&finished).on("/rapid/tof").count(), 1);
    assert!(matches!(bench.recorder.start(bench.request(None)).await, Err(RecordError::Ended)));
}
