use std::fs::File;
use std::io;

use rapid_bus::TopicId;
use rapid_core::sample::{Epoch, SampleHeader};
use rapid_devices::interlocks::Watched;
use rapid_episode::record::Recorder;
use rapid_episode::record::{EpisodeRequest, RecorderConfig, Sink, Source};
use rapid_registry::Registry;
use rapid_status::session::{Label, SessionRequest};
use rapid_status::stops::Reported;
use rapid_status::{Level, Snapshot};
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;

use super::super::Signals;
use super::super::buttons::Buttons;
use super::super::streaming::Streaming;
use super::*;
use crate::patience::PATIENCE;
use crate::session::journal::Plan;

mod kept;

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
        Self::with_plan(record, duration, sink, Plan::default())
    }

    fn with_plan(record: bool, duration: Option<Duration>, sink: fn(File) -> Box<dyn Sink>, plan: Plan) -> Self {
        let registry = Arc::new(Registry::builtin());
        let board = Arc::new(Board::new(&registry));
        let out = tempfile::tempdir().unwrap();
        let config = RecorderConfig { sink: Box::new(sink), ..RecorderConfig::new(registry, Arc::clone(&board)) };
        let recorder = Recorder::spawn(Quiet, config).unwrap();
        let (keys, requests) = mpsc::unbounded_channel();
        let episode = EpisodeRequest { out: out.path().to_owned(), ..EpisodeRequest::default() };
        let plan = Plan { task: "test".to_owned(), ..plan };
        let collection = Collection::new(recorder, episode, plan, true, &board, watch::channel(Vec::new()).1).unwrap();
        let conductor = Conductor {
            board: Arc::clone(&board),
            collection,
            record,
            is_single: true,
            duration,
            begin_episode: record,
            loaded: CancellationToken::new(),
        };
        conductor.loaded.cancel();
        let running = Running {
            inference: None,
            servers: Vec::new(),
            trials: None,
            discovery: idle_stage(),
            recording: idle_stage(),
            synchronisation: idle_stage(),
            reload: idle_stage(),
            streaming: Streaming {
                stage: idle_stage(),
                commands: mpsc::channel(1).0,
                ending: CancellationToken::new(),
                closed: CancellationToken::new(),
                release: CancellationToken::new(),
                hurry: CancellationToken::new(),
            },
            permission: Arc::default(),
            watched: Watched::begin(
                &Registry::builtin(),
                &Arc::default(),
                &Reported::nothing(&Registry::builtin()),
                &board,
            )
            .unwrap(),
            buttons: Buttons::default(),
            mask_ended: CancellationToken::new(),
            kind: Screen::Monitor,
            screen: idle_stage(),
            signals: Signals::listen().unwrap(),
            requests,
        };
        Self { conductor, running, keys, board, out }
    }

    /// Waits for thread `session`, which would write into a folder that is being removed.
    async fn end(mut self) {
        self.conductor.collection.close().await.unwrap();
    }

    /// Files of episodes, finished or not; not of what is noted about them.
    fn files(&self) -> Vec<String> {
        let mut names = self.names();
        names.retain(|name| name.contains(".mcap") && !name.contains(".toml"));
        names
    }

    fn names(&self) -> Vec<String> {
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
    tokio::time::sleep(2 * crate::app::settling::LIMIT).await;
}

#[tokio::test(start_paused = true)]
async fn the_time_of_a_run_begins_when_its_policy_is_loaded() {
    let length = Duration::from_secs(5);
    let mut bench = Bench::new(false, Some(length), |file| Box::new(file));
    bench.conductor.loaded = CancellationToken::new();
    let loaded = bench.conductor.loaded.clone();
    let begun = Instant::now();
    let loading = async {
        tokio::time::sleep(10 * length).await;
        loaded.cancel();
    };
    let (outcome, ()) = tokio::join!(bench.conductor.conduct(&mut bench.running), loading);
    outcome.unwrap();
    assert!((11 * length..12 * length).contains(&begun.elapsed()), "{:?}", begun.elapsed());
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn keys_pressed_while_an_episode_ends_are_handled_in_order() {
    let mut bench = Bench::new(false, None, |file| Box::new(file));
    let keys = async {
        let press = async |count: usize| {
            for _ in 0..count {
                bench.keys.send(end()).unwrap();
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
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_key_pressed_while_devices_settle_begins_exactly_one_episode() {
    let mut bench = Bench::new(true, None, |file| Box::new(file));
    let silent = Registry::builtin().devices[0].id;
    bench.board.set_device_state(silent, DeviceState::Opening, Epoch(1), "");
    let keys = async {
        bench.keys.send(end()).unwrap();
        until(&bench.board, "an episode", |file| file.is_some()).await;
        idle().await;
        bench.keys.send(Request::Quit).unwrap();
    };
    let (outcome, ()) = tokio::join!(bench.conductor.conduct(&mut bench.running), keys);
    outcome.unwrap();
    bench.conductor.finish_episode().await.unwrap();
    assert_eq!(bench.files().len(), 1, "{:?}", bench.files());
    bench.end().await;
}

#[tokio::test]
async fn the_last_episode_whose_file_fails_is_an_error_of_the_run() {
    let mut bench = Bench::new(false, None, |file| Box::new(Lost(file)));
    let collection = &mut bench.conductor.collection;
    collection.request(&SessionRequest::Start, Stamp::now(), None).await.unwrap();
    collection.end_episode().await;
    let end = collection.ended().await;
    collection.note_end(&end).await.unwrap();
    bench.conductor.collection.request(&SessionRequest::Start, Stamp::now(), None).await.unwrap();
    let error = bench.conductor.finish_episode().await.unwrap_err().to_string();
    assert!(error.contains("_002.mcap.partial") && error.contains("lost"), "{error}");
    assert!(error.contains("`rapid recover ") && error.matches("_002").count() == 2, "{error}");
    bench.end().await;
}

/// More events than the channel buffers for a reader.
fn flood(board: &Board) {
    for _ in 0..10_000 {
        board.announce(EventKind::Log { level: Level::Info, text: String::new() });
    }
}

type Disk = fn(File) -> Box<dyn Sink>;

/// A bench whose only episode has ended, on a disk that failed or not, before many other events.
async fn ended(duration: Option<Duration>, disk: Disk) -> Bench {
    let mut bench = Bench::new(true, duration, disk);
    bench.conductor.begin_episode = false;
    flood(&bench.board);
    let collection = &mut bench.conductor.collection;
    collection.request(&SessionRequest::Start, Stamp::now(), None).await.unwrap();
    collection.end_episode().await;
    until(&bench.board, "the end", |file| file.is_none()).await;
    flood(&bench.board);
    bench
}

const DISKS: [(Disk, bool); 2] = [(|file| Box::new(file), false), (|file| Box::new(Lost(file)), true)];

#[tokio::test(start_paused = true)]
async fn an_end_among_many_events_still_ends_the_run() {
    for (disk, is_lost) in DISKS {
        let mut bench = ended(Some(Duration::from_secs(1)), disk).await;
        let conducted = tokio::time::timeout(PATIENCE, bench.conductor.conduct(&mut bench.running)).await;
        let error = conducted.expect("an end").err().map(|error| error.to_string());
        assert_eq!(error.map(|error| error.contains("_001.mcap.partial: lost")), is_lost.then_some(true));
        bench.end().await;
    }
}

#[tokio::test]
async fn an_end_during_shutdown_is_found_among_many_events() {
    let mut bench = ended(None, |file| Box::new(Lost(file))).await;
    let error = bench.conductor.finish_episode().await.unwrap_err().to_string();
    assert!(error.contains("_001.mcap.partial: lost"), "{error}");
    // It is found once.
    bench.conductor.finish_episode().await.unwrap();
    bench.end().await;
}

/// A request that a signal interrupts is still carried out by the recorder.
#[tokio::test]
async fn the_end_of_an_episode_whose_beginning_was_not_waited_for_is_found() {
    let mut bench = Bench::new(false, None, |file| Box::new(Lost(file)));
    let collection = &mut bench.conductor.collection;
    let begun = collection.request(&SessionRequest::Start, Stamp::now(), None);
    assert!(futures::FutureExt::now_or_never(begun).is_none(), "the recorder's thread has answered already");
    until(&bench.board, "an episode", |file| file.is_some()).await;
    let error = bench.conductor.finish_episode().await.unwrap_err().to_string();
    assert!(error.contains("_001.mcap.partial: lost"), "{error}");
    bench.end().await;
}

async fn when(board: &Board, what: &str, holds: impl Fn(&Snapshot) -> bool) {
    let begun = std::time::Instant::now();
    while !holds(&board.snapshot()) {
        assert!(begun.elapsed() < PATIENCE, "{what} does not hold: {:?}", board.snapshot());
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

/// Makes a request; the answer.
async fn ask(keys: &mpsc::UnboundedSender<Request>, request: SessionRequest) -> Result<String, String> {
    let (reply, answer) = oneshot::channel();
    keys.send(Request::Session(request, Stamp::now(), Some(reply))).unwrap();
    answer.await.expect("an answer")
}

#[tokio::test]
async fn episodes_are_discarded_restored_labelled_and_the_session_ended_by_requests() {
    let mut bench = Bench::new(false, None, |file| Box::new(file));
    let keys = async {
        let ask = async |request| ask(&bench.keys, request).await;
        let trash = |name: &str| bench.out.path().join(".trash").join(name).exists();
        let first = ask(SessionRequest::Start).await.unwrap();
        assert!(first.ends_with("_001.mcap"), "{first}");
        assert_eq!(ask(SessionRequest::Start).await.unwrap_err(), "an episode is being recorded");
        ask(SessionRequest::Mark { text: "grasped".to_owned() }).await.unwrap();
        // The end of the first is answered when its file is closed, the beginning of the next when it has begun.
        let ended = ask(SessionRequest::Stop).await.unwrap();
        assert!(ended.contains("_001.mcap: "), "{ended}");
        let label = SessionRequest::Label { episode: None, label: Label::Failure, reason: "dropped".to_owned() };
        let labelled = ask(label).await.unwrap();
        assert!(labelled.ends_with("_001.mcap: failure"), "{labelled}");
        ask(SessionRequest::Start).await.unwrap();
        let discarded = ask(SessionRequest::Discard { episode: None }).await.unwrap();
        assert!(discarded.contains("_002.mcap"), "{discarded}");
        let last = bench.board.snapshot().last_episode.unwrap();
        let name = last.file_name().unwrap().to_str().unwrap();
        when(&bench.board, "it is in the trash", |_| trash(name)).await;
        ask(SessionRequest::Undo).await.unwrap();
        when(&bench.board, "it is back", |_| !trash(name)).await;
        // Recorded again: the discarded one keeps its name, so the next has another.
        ask(SessionRequest::Redo).await.unwrap();
        let stopped = ask(SessionRequest::Stop).await.unwrap();
        assert!(stopped.contains("_003.mcap"), "{stopped}");
        when(&bench.board, "two are kept", |now| now.session.as_ref().unwrap().verdicts == [0, 0, 2]).await;
        let ended = ask(SessionRequest::EndSession).await.unwrap();
        assert_eq!(ended, "session ended: 2 episodes kept, 1 deleted");
        bench.keys.send(Request::Quit).unwrap();
    };
    let (outcome, ()) = tokio::join!(bench.conductor.conduct(&mut bench.running), keys);
    outcome.unwrap();
    bench.conductor.collection.close().await.unwrap();
    let names = bench.names();
    // With what was noted about the first.
    assert_eq!(names.len(), 5, "{names:?}");
    assert!(names[1].ends_with("_001.mcap.toml"), "{names:?}");
    assert!(names.iter().filter(|name| name.starts_with("session-")).count() == 2, "{names:?}");
}

#[tokio::test]
async fn a_run_for_several_episodes_ends_when_they_are_recorded() {
    let plan = Plan {
        goal: Some(2),
        countdown: Some(Duration::from_millis(20)),
        reset_time: Some(Duration::from_millis(20)),
        ..Plan::default()
    };
    let mut bench = Bench::with_plan(true, None, |file| Box::new(file), plan);
    bench.conductor.is_single = false;
    bench.running.kind = Screen::Lines;
    let keys = async {
        for number in ["_001", "_002", "_003"] {
            until(&bench.board, number, |file| file.is_some_and(|file| file.contains(number))).await;
            let _ =
                ask(&bench.keys, SessionRequest::Label { episode: None, label: Label::Success, reason: String::new() })
                    .await;
            // What has no sample is BAD and does not count: the third is one too many for the goal.
            let request = if number == "_003" { Request::Quit } else { end() };
            bench.keys.send(request).unwrap();
        }
    };
    let (outcome, ()) = tokio::join!(bench.conductor.conduct(&mut bench.running), keys);
    outcome.unwrap();
    bench.conductor.finish_episode().await.unwrap();
    bench.conductor.collection.close().await.unwrap();
    assert_eq!(bench.files().len(), 3, "{:?}", bench.files());
}

/// Ends the episode in progress; the plan decides what follows.
fn end() -> Request {
    Request::Session(SessionRequest::Toggle, Stamp::now(), None)
}

#[tokio::test]
async fn the_file_of_an_earlier_session_is_kept_whenever_this_one_gets_its_own() {
    // From the first episode on, or since something was requested of a run that had none.
    for is_kept in [true, false] {
        let out = tempfile::tempdir().unwrap();
        let earlier = "begun = \"2026-01-01T00:00:00.000Z\"\n[plan]\ntask = \"earlier\"\n";
        std::fs::write(out.path().join("session.toml"), earlier).unwrap();
        let registry = Arc::new(Registry::builtin());
        let board = Arc::new(Board::new(&registry));
        let recorder = Recorder::spawn(Quiet, RecorderConfig::new(registry, Arc::clone(&board))).unwrap();
        let episode = EpisodeRequest { out: out.path().to_owned(), ..EpisodeRequest::default() };
        let plan = Plan { task: "now".to_owned(), ..Plan::default() };
        let mut collection =
            Collection::new(recorder, episode, plan, is_kept, &board, watch::channel(Vec::new()).1).unwrap();
        collection.start().await.unwrap();
        let label = SessionRequest::Label { episode: None, label: Label::Success, reason: String::new() };
        collection.request(&label, Stamp::now(), None).await.unwrap();
        collection.finish_episode().await.unwrap();
        collection.close().await.unwrap();
        let read = |name: &str| std::fs::read_to_string(out.path().join(name)).unwrap_or_default();
        assert_eq!(read("session-2026-01-01T000000000Z.toml"), earlier);
        assert!(read("session.toml").contains("task = \"now\""), "{is_kept}");
    }
}
