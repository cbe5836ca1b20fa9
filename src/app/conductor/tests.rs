use std::fs::File;
use std::io;

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::super::Signals;
use super::super::streaming::Streaming;
use super::*;
use crate::bus::TopicId;
use crate::interlocks::Watched;
use crate::record::{RecorderConfig, Sink, Source};
use crate::registry::Registry;
use crate::sample::{Epoch, SampleHeader};
use crate::status::{Grade, Level, Snapshot, Verdict};

/// How long a condition may take to hold.
const PATIENCE: Duration = Duration::from_secs(30);

/// A bus on which nothing is published.
struct Quiet;

impl Source for Quiet {
    fn wait(&mut self, _: Duration) -> Result<(), String> {
        std::thread::sleep(Duration::from_millis(1));
        Ok(())
    }

    fn drain(&mut self, _: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String> {
        Ok(())
    }
}

/// A file whose disk fails at the end.
struct Lost(File);

impl io::Write for Lost {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

impl Sink for Lost {
    fn sync(&mut self) -> io::Result<()> {
        Err(io::Error::other("lost"))
    }
}

/// A conductor whose rig and screen do nothing.
struct Bench {
    conductor: Conductor,
    running: Running,
    keys: mpsc::UnboundedSender<Request>,
    board: Arc<Board>,
    out: tempfile::TempDir,
}

impl Bench {
    fn new(record: bool, duration: Option<Duration>, sink: fn(File) -> Box<dyn Sink>) -> Self {
        let registry = Arc::new(Registry::builtin());
        let board = Arc::new(Board::new(&registry));
        let out = tempfile::tempdir().unwrap();
        let config = RecorderConfig { sink: Box::new(sink), ..RecorderConfig::new(registry, Arc::clone(&board)) };
        let recorder = Recorder::spawn(Quiet, config).unwrap();
        let (keys, requests) = mpsc::unbounded_channel();
        let episode = EpisodeRequest {
            out: out.path().to_owned(),
            task: "test".to_owned(),
            tags: Vec::new(),
            modules: Vec::new(),
            duration: None,
        };
        let conductor = Conductor {
            events: board.events(),
            board: Arc::clone(&board),
            recorder,
            episode,
            record,
            duration,
            begin_episode: record,
        };
        let running = Running {
            inference: None,
            discovery: idle_stage(),
            recording: idle_stage(),
            synchronisation: idle_stage(),
            streaming: Streaming {
                stage: idle_stage(),
                ending: CancellationToken::new(),
                closed: CancellationToken::new(),
                release: CancellationToken::new(),
                hurry: CancellationToken::new(),
            },
            permission: Arc::default(),
            watched: Watched::begin(&Registry::builtin(), &Arc::default(), &board).unwrap(),
            mask_ended: CancellationToken::new(),
            kind: Screen::Monitor,
            screen: idle_stage(),
            signals: Signals::listen().unwrap(),
            requests,
        };
        Self { conductor, running, keys, board, out }
    }

    /// Files of episodes, finished or not.
    fn files(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.out.path()).unwrap();
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

fn idle_stage() -> Stage {
    Stage::start("idle", |_| std::future::pending())
}

/// Waits until the file being recorded, if any, meets the condition.
async fn until(board: &Board, what: &str, holds: impl Fn(Option<&str>) -> bool) {
    let begun = std::time::Instant::now();
    loop {
        let recording = board.snapshot().recording;
        if holds(recording.as_ref().and_then(|recording| recording.file.to_str())) {
            return;
        }
        assert!(begun.elapsed() < PATIENCE, "{what} does not hold: {recording:?}");
        std::thread::sleep(Duration::from_millis(1));
        tokio::task::yield_now().await;
    }
}

/// Lets all other tasks do what they can: the clock of the tests advances when no task has work.
async fn idle() {
    tokio::time::sleep(2 * SETTLE_LIMIT).await;
}

#[tokio::test(start_paused = true)]
async fn keys_pressed_while_an_episode_ends_are_handled_in_order() {
    let mut bench = Bench::new(false, None, |file| Box::new(file));
    let keys = async {
        let press = async |count: usize| {
            for _ in 0..count {
                bench.keys.send(Request::ToggleRecording(Stamp::now())).unwrap();
            }
        };
        press(1).await;
        until(&bench.board, "the first", |file| file.is_some()).await;
        press(2).await;
        until(&bench.board, "the second", |file| file.is_some_and(|file| file.ends_with("_002.mcap"))).await;
        idle().await;
        press(1).await;
        until(&bench.board, "the end of the second", |file| file.is_none()).await;
        bench.keys.send(Request::Quit).unwrap();
    };
    let (outcome, ()) = tokio::join!(bench.conductor.conduct(&mut bench.running), keys);
    outcome.unwrap();
    bench.conductor.finish_episode().await.unwrap();
    let files = bench.files();
    assert!(files.len() == 2 && !files.iter().any(|file| file.contains("partial")), "{files:?}");
}

#[tokio::test(start_paused = true)]
async fn a_key_pressed_while_devices_settle_begins_exactly_one_episode() {
    let mut bench = Bench::new(true, None, |file| Box::new(file));
    let silent = Registry::builtin().devices[0].id;
    bench.board.set_slot(silent, SlotState::Opening, Epoch(1), "");
    let keys = async {
        bench.keys.send(Request::ToggleRecording(Stamp::now())).unwrap();
        until(&bench.board, "an episode", |file| file.is_some()).await;
        idle().await;
        bench.keys.send(Request::Quit).unwrap();
    };
    let (outcome, ()) = tokio::join!(bench.conductor.conduct(&mut bench.running), keys);
    outcome.unwrap();
    bench.conductor.finish_episode().await.unwrap();
    assert_eq!(bench.files().len(), 1, "{:?}", bench.files());
}

#[tokio::test]
async fn the_last_episode_whose_file_fails_is_an_error_of_the_run() {
    let mut bench = Bench::new(false, None, |file| Box::new(Lost(file)));
    for _ in 0..3 {
        bench.conductor.toggle(Stamp::now()).await.unwrap();
    }
    let error = bench.conductor.finish_episode().await.unwrap_err().to_string();
    assert!(error.contains("_002.mcap.partial") && error.contains("lost"), "{error}");
    assert!(error.contains("`rapid recover ") && error.matches("_002").count() == 2, "{error}");
}

fn ended(error: Option<&str>) -> What {
    What::Episode {
        file: "a.mcap".into(),
        seconds: 1.0,
        messages: 1,
        bytes: 1,
        dropped: 0,
        error: error.map(str::to_owned),
        verdict: Verdict { grade: Grade::Good, reasons: Vec::new(), sensors: None },
    }
}

/// More events than the channel buffers for a reader.
fn flood(board: &Board) {
    for _ in 0..10_000 {
        board.announce(What::Log { level: Level::Info, text: String::new() });
    }
}

#[tokio::test(start_paused = true)]
async fn an_end_among_missed_events_still_ends_the_run() {
    for error in [None, Some("torn")] {
        let mut bench = Bench::new(true, Some(Duration::from_secs(1)), |file| Box::new(file));
        bench.conductor.begin_episode = false;
        bench.board.announce(ended(error));
        flood(&bench.board);
        let conducted = tokio::time::timeout(PATIENCE, bench.conductor.conduct(&mut bench.running)).await;
        let error_text = conducted.expect("an end").err().map(|error| error.to_string());
        assert_eq!(error_text.as_deref(), error.map(|_| "a.mcap: torn"));
    }
}

#[tokio::test]
async fn an_end_during_shutdown_is_found_before_and_after_missed_events() {
    for end_first in [true, false] {
        let mut bench = Bench::new(true, None, |file| Box::new(file));
        if end_first {
            bench.board.announce(ended(Some("torn")));
            flood(&bench.board);
        } else {
            flood(&bench.board);
            bench.board.announce(ended(Some("torn")));
        }
        let error = bench.conductor.finish_episode().await.unwrap_err();
        assert_eq!(error.to_string(), "a.mcap: torn");
    }
}

/// Begins an episode and ends it at its first moment; its file.
async fn moment(board: &Board, keys: &mpsc::UnboundedSender<Request>) -> PathBuf {
    keys.send(Request::ToggleRecording(Stamp::now())).unwrap();
    until(board, "an episode", |file| file.is_some()).await;
    let file = board.snapshot().recording.unwrap().file;
    keys.send(Request::ToggleRecording(Stamp(0))).unwrap();
    when(board, "an offer", |snapshot| snapshot.short_episode.is_some()).await;
    assert_eq!(board.snapshot().short_episode.unwrap().file, file);
    file
}

async fn when(board: &Board, what: &str, holds: impl Fn(&Snapshot) -> bool) {
    let begun = std::time::Instant::now();
    while !holds(&board.snapshot()) {
        assert!(begun.elapsed() < PATIENCE, "{what} does not hold: {:?}", board.snapshot());
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

#[tokio::test]
async fn only_the_last_episode_is_dropped_on_request() {
    let mut bench = Bench::new(false, None, |file| Box::new(file));
    let keys = async {
        let first = moment(&bench.board, &bench.keys).await;
        let second = moment(&bench.board, &bench.keys).await;
        // Not the last one; and a file that is not an episode.
        let foreign = first.with_file_name("notes.mcap");
        std::fs::write(&foreign, "precious").unwrap();
        for file in [&first, &foreign] {
            bench.keys.send(Request::DropEpisode(file.clone())).unwrap();
        }
        // Requests are carried out in order: both were refused by the time this one has begun.
        let third = moment(&bench.board, &bench.keys).await;
        assert!(first.exists() && foreign.exists() && second.exists());
        bench.keys.send(Request::DropEpisode(third.clone())).unwrap();
        when(&bench.board, "its file is gone", |snapshot| snapshot.last_episode.is_none()).await;
        assert!(!third.exists() && bench.board.snapshot().short_episode.is_none());
        // A request for one after the next has begun.
        let fourth = moment(&bench.board, &bench.keys).await;
        bench.keys.send(Request::ToggleRecording(Stamp::now())).unwrap();
        bench.keys.send(Request::DropEpisode(fourth.clone())).unwrap();
        bench.keys.send(Request::ToggleRecording(Stamp::now())).unwrap();
        bench.keys.send(Request::Quit).unwrap();
        fourth
    };
    let (outcome, fourth) = tokio::join!(bench.conductor.conduct(&mut bench.running), keys);
    outcome.unwrap();
    assert!(fourth.exists());
    assert_eq!(bench.files().len(), 5, "{:?}", bench.files());
}
