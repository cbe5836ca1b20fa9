//! Disks that fill up, folders that go away, clocks that are set.

use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};

use rapid_core::time::WallClock;
use rapid_status::Event;
use rapid_system::disk::{Disk, FileLimit, LimitedBy};

use super::*;

const GIB: u64 = 1 << 30;

/// A recorder on a disk of 100 GiB of which `free` bytes are free.
fn on_disk(free: &Arc<AtomicU64>) -> Bench {
    let free = Arc::clone(free);
    Bench::with(|config| {
        config.disk = Box::new(move |_| Ok(Disk { free: free.load(Ordering::Relaxed), size: 100 * GIB }));
    })
}

async fn until(events: &mut tokio::sync::broadcast::Receiver<Event>, wanted: impl Fn(&EventKind) -> bool) -> EventKind {
    loop {
        let event = events.recv().await.unwrap();
        if wanted(&event.what) {
            return event.what;
        }
    }
}

#[tokio::test]
async fn a_full_disk_is_reported_once_and_ends_the_episode_with_a_whole_file() {
    let free = Arc::new(AtomicU64::new(50 * GIB));
    let mut bench = on_disk(&free);
    let mut events = bench.board.events();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    bench.sample(TOF, 1, 0, Stamp::now().0, 0);
    free.store(GIB + (GIB >> 1), Ordering::Relaxed);
    let low = until(&mut events, |what| matches!(what, EventKind::DiskLow { .. })).await;
    let EventKind::DiskLow { folder, free: reported, seconds } = low else { unreachable!() };
    assert_eq!(folder, finished.parent().unwrap());
    // What is set aside for the file counts as free.
    assert!((GIB + (GIB >> 1)..2 * GIB).contains(&reported) && seconds > 0, "{reported} {seconds}");
    while bench.board.snapshot().recording.is_none_or(|status| status.room.is_none()) {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    free.store(GIB - (128 << 20), Ordering::Relaxed);
    let closed = until(&mut events, |what| {
        assert!(!matches!(what, EventKind::DiskLow { .. }), "reported twice");
        matches!(what, EventKind::Episode(_))
    });
    let EventKind::Episode(EpisodeReport { file, error, .. }) = closed.await else { unreachable!() };
    assert_eq!(file, finished);
    let error = error.unwrap();
    assert!(error.contains("nearly full") && error.contains("disk_reserve") && error.contains("--out"), "{error}");
    let read = read(&finished);
    assert_eq!(read.metadata["rapid/summary"]["cut_short"], error);
    let error_of_first = error.clone();
    let answer = inspect::inspect(&finished).unwrap();
    assert!(
        answer.verdict.verdict().unwrap().grade > Grade::Good
            && answer.verdict.verdict().unwrap().why().contains(&error),
        "{:?}",
        answer.verdict
    );
    assert_eq!(answer.verdict.verdict(), answer.recorded_verdict.as_ref());
    assert_eq!(read.on("/rapid/tof").count(), 1);
    assert_eq!(read.on("/rapid/event").filter(|message| text(&message.4, "kind") == "disk_low").count(), 1);
    assert_eq!(bench.board.snapshot().last_episode, Some(finished));

    let error = bench.recorder.start(bench.request(None)).await.unwrap_err();
    assert!(matches!(error, RecordError::NoRoom { reserve: GIB, .. }), "{error}");
    let answer = error.to_string();
    assert!(answer.contains("/out: ") && answer.contains("939.5 MB free") && answer.contains("1.1 GB"), "{answer}");
    assert!(answer.contains("disk_reserve under [rig]") && answer.contains("--out"), "{answer}");
    assert_eq!(std::fs::read_dir(bench.folder.path().join("out")).unwrap().count(), 1, "nothing was left");

    // Room again.
    free.store(50 * GIB, Ordering::Relaxed);
    bench.recorder.start(bench.request(None)).await.unwrap();
    // No end is lost, also if nothing waited for it when the next episode began.
    assert_eq!(bench.recorder.stop().await.unwrap().error.as_ref(), Some(&error_of_first));
    assert_eq!(bench.recorder.stop().await.unwrap().error, None);
    assert_eq!(bench.recorder.stop().await, None);
}

#[tokio::test]
async fn a_disk_that_does_not_report_its_space_is_written_to() {
    let mut bench = Bench::with(|config| config.disk = Box::new(|_| Err(io::ErrorKind::Unsupported.into())));
    bench.recorder.start(bench.request(None)).await.unwrap();
    assert_eq!(bench.recorder.stop().await.unwrap().error, None);
}

#[tokio::test]
async fn reserved_space_is_released() {
    use std::os::unix::fs::MetadataExt;
    let mut bench = Bench::new();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    assert_eq!(bench.recorder.stop().await.unwrap().error, None);
    let metadata = std::fs::metadata(&finished).unwrap();
    assert!(metadata.blocks() * 512 < metadata.len() + (1 << 20), "{} blocks", metadata.blocks());
}

#[tokio::test]
async fn a_removed_folder_is_recreated_with_the_episode() {
    let mut bench = Bench::new();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    bench.sample(TOF, 1, 0, Stamp::now().0, 0);
    std::fs::remove_dir_all(finished.parent().unwrap()).unwrap();
    bench.sample(TOF, 1, 1, Stamp::now().0, 0);
    bench.script.taken().await;
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!((report.error, report.file.as_path()), (None, finished.as_path()));
    assert_eq!(read(&finished).on("/rapid/tof").count(), 2);
    assert_eq!(std::fs::read_dir(finished.parent().unwrap()).unwrap().count(), 1);
}

#[tokio::test]
async fn a_file_removed_on_a_file_system_that_only_hides_it_is_written_again() {
    // As NFS and libfuse do it.
    for hidden in [".nfs000000000004a1c700000002", ".fuse_hidden0000000300000001"] {
        let mut bench = Bench::new();
        let finished = bench.recorder.start(bench.request(None)).await.unwrap();
        bench.sample(TOF, 1, 0, Stamp::now().0, 0);
        let hidden = finished.with_file_name(hidden);
        std::fs::rename(finished.with_extension("mcap.partial"), &hidden).unwrap();
        bench.script.taken().await;
        let report = bench.recorder.stop().await.unwrap();
        assert_eq!((report.error, report.file.as_path()), (None, finished.as_path()));
        // Which the file system itself takes away.
        std::fs::remove_file(&hidden).unwrap();
        assert_eq!(read(&finished).on("/rapid/tof").count(), 1);
    }
}

#[tokio::test]
async fn a_folder_with_a_non_utf8_name_holds_episodes_like_any_other() {
    use std::os::unix::ffi::OsStrExt;
    let mut bench = Bench::new();
    let mut request = bench.request(None);
    request.out = bench.folder.path().join(std::ffi::OsStr::from_bytes(b"caf\xe9"));
    let finished = bench.recorder.start(request).await.unwrap();
    bench.sample(TOF, 1, 0, Stamp::now().0, 0);
    bench.script.taken().await;
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!((report.error.as_deref(), report.file.as_path()), (None, finished.as_path()));
    assert!(serde_json::to_string(&inspect::list(&finished)).unwrap().contains("caf\u{fffd}/"));
    let read = read(&finished);
    assert_eq!(read.on("/rapid/tof").count(), 1);
    let recording: Vec<_> = read.on("/rapid/event").filter(|message| text(&message.4, "kind") == "recording").collect();
    assert_eq!(recording.len(), 1);
    assert!(text(&recording[0].4, "json").contains("caf\u{fffd}/"), "{}", text(&recording[0].4, "json"));
}

#[tokio::test]
async fn a_removed_file_is_reported_while_recording_and_takes_no_other_name() {
    let mut bench = Bench::new();
    let mut events = bench.board.events();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    std::fs::remove_file(finished.with_extension("mcap.partial")).unwrap();
    until(&mut events, |what| matches!(what, EventKind::Log { text, .. } if text.contains("removed while"))).await;
    std::fs::write(&finished, "of another program").unwrap();
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!(
        report.file.file_name().unwrap().to_str().unwrap(),
        format!("{}-2.mcap", finished.file_stem().unwrap().to_str().unwrap())
    );
    read(&report.file);
    assert_eq!(std::fs::read_to_string(&finished).unwrap(), "of another program");
}

#[tokio::test]
async fn a_folder_that_is_moved_and_replaced_is_followed() {
    let mut bench = Bench::new();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let (out, elsewhere) = (finished.parent().unwrap(), bench.folder.path().join("elsewhere"));
    std::fs::rename(out, &elsewhere).unwrap();
    std::fs::create_dir(out).unwrap();
    std::fs::write(finished.with_extension("mcap.partial"), "of another program").unwrap();
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!((report.error, &report.file), (None, &elsewhere.join(finished.file_name().unwrap())));
    read(&report.file);
    assert_eq!(std::fs::read_dir(&elsewhere).unwrap().count(), 1);
    assert_eq!(std::fs::read_to_string(finished.with_extension("mcap.partial")).unwrap(), "of another program");
}

#[tokio::test]
async fn a_clock_step_is_an_event_and_times_never_decrease() {
    let set = Arc::new(AtomicI64::new(0));
    let mut bench = Bench::with(|config| {
        let set = Arc::clone(&set);
        let offset = i128::from(1_700_000_000 * 1000 * MS);
        config.clock = Box::new(move || WallClock::with_offset(offset + i128::from(set.load(Ordering::Relaxed))));
    });
    let mut events = bench.board.events();
    let finished = bench.recorder.start(bench.request(None)).await.unwrap();
    let mut sample = 0;
    for by in [3600_i64 * 1000, -7200 * 1000] {
        bench.sample(TOF, 1, sample, Stamp::now().0, 0);
        sample += 1;
        set.fetch_add(by * MS.cast_signed(), Ordering::Relaxed);
        let step = until(&mut events, |what| matches!(what, EventKind::ClockStep { .. })).await;
        assert_eq!(step, EventKind::ClockStep { seconds: by as f64 / 1000.0 });
    }
    bench.sample(TOF, 1, sample, Stamp::now().0, 0);
    bench.script.taken().await;
    let report = bench.recorder.stop().await.unwrap();
    assert_eq!((report.error, report.file.as_path()), (None, finished.as_path()));
    let read = read(&finished);
    let reported: Vec<_> = read.on("/rapid/event").filter(|message| text(&message.4, "kind") == "clock_step").collect();
    assert_eq!(reported.len(), 2);
    assert!(text(&reported[0].4, "text").contains("forward by 3600.000 s"), "{}", text(&reported[0].4, "text"));
    assert!(text(&reported[1].4, "text").contains("back by 7200.000 s"), "{}", text(&reported[1].4, "text"));
    for topic in ["/rapid/tof", "/rapid/event", "/rapid/frame"] {
        let times: Vec<u64> = read.on(topic).map(|message| message.2).collect();
        assert!(times.len() > 1 && times.is_sorted_by(|a, b| a < b), "{topic}: {times:?}");
    }
    let begin: u64 = read.metadata["rapid"]["begin_wall_ns"].parse().unwrap();
    assert!(read.messages.iter().all(|message| message.2.abs_diff(begin) < 600 * 1000 * MS));
    // The next one begins by the clock as it is now.
    let next = bench.recorder.start(bench.request(None)).await.unwrap();
    bench.recorder.stop().await.unwrap();
    let next: u64 = read_begin(&next);
    assert!(next.abs_diff(begin - 3600 * 1000 * MS) < 600 * 1000 * MS);
}

fn read_begin(file: &Path) -> u64 {
    read(file).metadata["rapid"]["begin_wall_ns"].parse().unwrap()
}

/// A file that cannot become larger than `1`.
struct Limited(File, u64);

impl Write for Limited {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let room = self.1 - self.0.metadata()?.len();
        if room == 0 {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        self.0.write(&bytes[..bytes.len().min(usize::try_from(room).unwrap())])
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Sink for Limited {
    fn sync(&mut self) -> io::Result<()> {
        self.0.sync_all()
    }
}

#[tokio::test]
async fn an_episode_is_closed_before_its_file_is_too_large() {
    const LIMIT: u64 = 5 << 20;
    for by in [LimitedBy::FileSystem, LimitedBy::Process] {
        // Large samples, and small ones with much about each.
        for (bit, bytes) in [(RAW, 900_000), (TOF, 16)] {
            let mut bench = Bench::with(|config| {
                config.sink = Box::new(|file| Box::new(Limited(file, LIMIT)));
                config.limit = Box::new(move |_| FileLimit { bytes: LIMIT, by });
            });
            let mut events = bench.board.events();
            let finished = bench.recorder.start(bench.request(None)).await.unwrap();
            let mut seq = 0;
            let closed = loop {
                for _ in 0..50 {
                    bench.script.sized(bit, seq, Stamp::now().0, bytes);
                    seq += 1;
                }
                bench.script.taken().await;
                match events.try_recv() {
                    Ok(event) if matches!(event.what, EventKind::Episode(_)) => break event.what,
                    _ => {}
                }
            };
            let EventKind::Episode(EpisodeReport { file, error, verdict, .. }) = closed else { unreachable!() };
            assert_eq!(file, finished, "{error:?}");
            let error = error.unwrap();
            let how = if by == LimitedBy::Process { "ulimit -f" } else { "ext4" };
            assert!(error.contains("/out: ") && error.contains("5.2 MB") && error.contains(how), "{error}");
            assert!(verdict.grade > Grade::Good && verdict.why().contains(&error), "{verdict:?}");
            let size = std::fs::metadata(&file).unwrap().len();
            assert!((LIMIT / 2..LIMIT).contains(&size), "{size}");
            let read = read(&file);
            assert_eq!(read.metadata["rapid/summary"]["cut_short"], error);
            let topic = if bit == RAW { "/rapid/raw" } else { "/rapid/tof" };
            assert!(read.on(topic).count() > 1);
            // The next one is another file.
            bench.recorder.ended().await.unwrap();
            bench.recorder.start(bench.request(None)).await.unwrap();
            assert_eq!(bench.recorder.stop().await.unwrap().error, None);
        }
    }
}

#[tokio::test]
async fn where_files_are_too_small_for_an_episode_none_begins() {
    let mut bench =
        Bench::with(|config| config.limit = Box::new(|_| FileLimit { bytes: 1 << 20, by: LimitedBy::Process }));
    let error = bench.recorder.start(bench.request(None)).await.unwrap_err().to_string();
    assert!(error.contains("/out: too small for an episode: files are limited to 1.0 MB; raise"), "{error}");
    assert_eq!(std::fs::read_dir(bench.folder.path().join("out")).unwrap().count(), 0);
}
