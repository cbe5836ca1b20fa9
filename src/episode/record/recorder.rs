//! The recorder: the handle to the `writer` thread, its configuration, its source of samples (an inbox of the bus, or
//! the script of a test), and the thread itself.
//!
//! The thread always takes samples from the bus, so that an episode begins with an empty queue; without an episode it
//! discards them.
//!
//! Invariant: an episode in progress is finished whatever ends the thread: the last handle dropped,
//! an error of the disk, a panic.

#[cfg(test)]
mod tests;

use std::any::Any;
use std::collections::VecDeque;
use std::fs::File;
use std::io;
use std::ops::ControlFlow;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{self, Receiver, Sender, TryRecvError};
use std::thread::JoinHandle;
use std::time::Duration;

use rapid_bus::{Foreign, Inbox, Queues, Subscription, TopicId};
use rapid_core::sample::SampleHeader;
use rapid_core::time::{ClockWatch, Stamp, WallClock};
use rapid_registry::Registry;
use rapid_status::stops::{Reported, States};
use rapid_status::{Board, Episode, EpisodeReport, EpisodeWatch, Event, EventKind, Level, RecordingStatus};
use rapid_system::disk::{Disk, FileLimit};
use rapid_system::fault;
use tokio::sync::broadcast::{self, error::TryRecvError as EventError};
use tokio::sync::{oneshot, watch};
use tokio_util::sync::CancellationToken;

use super::RecordError;
use super::episode_path::{EpisodePath, EpisodeRequest};
use super::open_episode::{Beginning, OpenEpisode};
use super::provenance::Attached;
use super::publishers::Publishers;
use super::space::{Asker, Finding, Space};
use super::streams::Streams;
use crate::ReferenceSample;
use crate::chunk_writer::Sink;
use crate::made::Shown;
use crate::partial::PARTIAL;

/// Longest wait for samples, which delays a command, an event or a due frame.
const TURN: Duration = Duration::from_millis(20);
/// How often written data is passed to the kernel. A kill may lose a second at most: half of it is for samples on the
/// bus and for frames that are not due yet.
const FLUSH_EVERY: Duration = Duration::from_millis(500);
/// How often the board is updated.
const STATUS_EVERY: Duration = Duration::from_millis(200);
/// Interval at which the episode in progress is judged, for that state.
const JUDGE_EVERY: Duration = Duration::from_millis(500);
/// How often the wall clock is checked for a step.
const CLOCK_EVERY: Duration = Duration::from_millis(100);
/// Shortest time between two complaints about the bus.
const COMPLAIN_EVERY: Duration = Duration::from_secs(5);

/// A consumer's end of the bus.
pub trait Source: Send {
    /// Waits until something was published or `timeout` has passed.
    ///
    /// # Errors
    /// When the bus cannot be waited on; the text is the reason.
    fn wait(&mut self, timeout: Duration) -> Result<(), String>;

    /// Delivers every pending sample, oldest first within a topic; bytes are borrowed for the call.
    ///
    /// # Errors
    /// When the bus cannot be read; the text is the reason.
    fn drain(&mut self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String>;

    /// The foreign publishers on our topics since the last call; none if the source cannot know.
    fn foreign(&mut self, take: &mut dyn FnMut(Foreign<'_>)) {
        let _ = take;
    }

    /// Delivers the samples of another topic, too; one that cannot does not.
    fn add(&mut self, subscription: Subscription) {
        drop(subscription);
    }
}

impl Source for Inbox {
    fn wait(&mut self, timeout: Duration) -> Result<(), String> {
        Self::wait(self, timeout).map_err(|error| error.to_string())
    }

    fn drain(&mut self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String> {
        Queues::drain(self, take).map_err(|error| error.to_string())
    }

    fn foreign(&mut self, take: &mut dyn FnMut(Foreign<'_>)) {
        Queues::foreign(self, take);
    }

    fn add(&mut self, subscription: Subscription) {
        Self::add(self, subscription);
    }
}

type Opener = Box<dyn FnMut(File) -> Box<dyn Sink> + Send>;

/// The configuration of the thread.
pub struct RecorderConfig {
    /// What may be recorded.
    pub registry: Arc<Registry>,
    /// Where the state of the recording is reported, and events come from.
    pub board: Arc<Board>,
    /// Creates an episode's sink from its open file: the file itself, unless a test simulates disk failures.
    pub sink: Opener,
    /// Returns the free space on the disk of an episode's file.
    pub disk: Asker,
    /// Returns how large an episode's file may become.
    pub limit: Box<dyn FnMut(&File) -> FileLimit + Send>,
    /// Reads the clocks.
    pub clock: Box<dyn FnMut() -> WallClock + Send>,
    /// Returns the start time of an episode requested now: now. Tests use it to send the samples of the beginning, so
    /// that they belong to it on machines of any speed.
    pub begin: Box<dyn FnMut() -> Stamp + Send>,
    /// The emergency stops and enabling switches: an episode records their states at its beginning.
    pub stops: States,
    /// Where what is written is shown, if anywhere.
    pub shown: Option<Shown>,
}

impl RecorderConfig {
    /// Episodes of `registry`, reported on `board`, written to their files; its stops have not reported.
    pub fn new(registry: Arc<Registry>, board: Arc<Board>) -> Self {
        Self {
            stops: Reported::nothing(&registry).states(),
            registry,
            board,
            sink: Box::new(|file| Box::new(file)),
            disk: Box::new(Disk::of_file),
            limit: Box::new(FileLimit::of),
            clock: Box::new(WallClock::now),
            begin: Box::new(Stamp::now),
            shown: None,
        }
    }
}

/// The handle. Dropping it ends an episode in progress and waits for its file, some 150 ms plus the time of the disk,
/// unless the thread was [handed over](Self::hand_over).
#[derive(Debug)]
pub struct Recorder {
    orders: Option<Sender<RecorderOrder>>,
    thread: Option<JoinHandle<()>>,
    additions: Sender<RecorderAddition>,
    references: Sender<ReferenceSample>,
    thread_ended: CancellationToken,
    episode: EpisodeWatch,
    /// Each receives the end of an episode that was requested, until it is taken; nothing if it did not begin.
    ends: VecDeque<oneshot::Receiver<EpisodeReport>>,
    clock: watch::Receiver<WallClock>,
}

/// A modality that is added. An episode in progress keeps the modalities that it began with; the next one has it.
#[derive(Debug)]
pub struct RecorderAddition {
    /// What may be recorded from now on.
    pub registry: Arc<Registry>,
    /// Its samples; `None` if only modules are added.
    pub subscription: Option<Subscription>,
}

impl Recorder {
    /// Starts the `writer` thread. Events announced from now on are recorded.
    ///
    /// # Errors
    /// When the system provides no thread.
    pub fn spawn(source: impl Source + 'static, mut config: RecorderConfig) -> io::Result<Self> {
        let (orders, inbox) = mpsc::channel();
        let (additions, added) = mpsc::channel();
        let (references, taken) = mpsc::channel();
        let events = config.board.events();
        let thread_ended = CancellationToken::new();
        let (notify, episode) = watch::channel(None);
        let (in_force, clock) = watch::channel((config.clock)());
        let guard = thread_ended.clone().drop_guard();
        let thread = std::thread::Builder::new().name("writer".to_owned()).spawn(move || {
            // Dropped by a panic too.
            let _guard = guard;
            Writer::new(config, inbox, added, References::new(taken), events, notify, in_force).run(source);
        })?;
        let (orders, thread, ends) = (Some(orders), Some(thread), VecDeque::new());
        Ok(Self { orders, thread, additions, references, thread_ended, episode, ends, clock })
    }

    /// Cancelled when the thread has ended: before the handle is dropped, by a panic.
    pub fn thread_ended(&self) -> CancellationToken {
        self.thread_ended.clone()
    }

    /// Hands over the thread: dropping the handle still ends it, and its new owner joins it.
    pub const fn hand_over(&mut self) -> Option<JoinHandle<()>> {
        self.thread.take()
    }

    /// The episode in progress: from when its file is open until its last sample is written.
    pub fn episode(&self) -> EpisodeWatch {
        self.episode.clone()
    }

    /// The clock of the episode in progress, otherwise the present one. It changes before an episode begins: whoever
    /// reads it after the capture of a sample of an episode has the clock of that episode.
    pub fn clock(&self) -> watch::Receiver<WallClock> {
        self.clock.clone()
    }

    /// Begins an episode; returns the name its file will have. [`Self::ended`] returns its end, also if this is
    /// cancelled.
    ///
    /// # Errors
    /// When there is one in progress, or its file cannot be created.
    pub async fn start(&mut self, request: EpisodeRequest) -> Result<PathBuf, RecordError> {
        let ((begun, beginning), (ended, end)) = (oneshot::channel(), oneshot::channel());
        let orders = self.orders.as_ref().ok_or(RecordError::Ended)?;
        orders.send(RecorderOrder::Start { request, begun, ended }).map_err(|_| RecordError::Ended)?;
        self.ends.push_back(end);
        beginning.await.unwrap_or(Err(RecordError::Ended))
    }

    /// Sets the end of the episode in progress, if any, to the moment `at`; an earlier end stays. Does not wait: its
    /// last samples may still be in transit.
    pub fn end(&self, at: Stamp) {
        if let Some(orders) = &self.orders {
            // Without its thread there is no episode.
            let _ = orders.send(RecorderOrder::End(at));
        }
    }

    /// Waits for the end of the oldest episode whose end was not taken: its file is closed then. `None` if there is none.
    /// Cancel-safe.
    pub async fn ended(&mut self) -> Option<EpisodeReport> {
        while let Some(end) = self.ends.front_mut() {
            let end = end.await;
            self.ends.pop_front();
            if let Ok(end) = end {
                return Some(end);
            }
        }
        None
    }

    /// Ends the episode in progress at this moment, unless its end is fixed already, and waits for it as
    /// [`Self::ended`] does.
    pub async fn stop(&mut self) -> Option<EpisodeReport> {
        self.end(Stamp::now());
        self.ended().await
    }

    /// For modalities that are added during the run. It does not keep the thread.
    pub fn additions(&self) -> Sender<RecorderAddition> {
        self.additions.clone()
    }

    /// For the samples that the policy compares all later ones with: each is attached to the episode in progress, and to all
    /// later ones. A run has one policy. It does not keep the thread.
    pub fn references(&self) -> Sender<ReferenceSample> {
        self.references.clone()
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.orders = None;
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been caught and reported there.
            let _ = thread.join();
        }
    }
}

/// Requests to the thread.
enum RecorderOrder {
    /// Begin an episode now.
    Start {
        request: EpisodeRequest,
        /// Receives the name its file will have.
        begun: oneshot::Sender<Result<PathBuf, RecordError>>,
        ended: oneshot::Sender<EpisodeReport>,
    },
    /// Fix the end of the episode in progress to this moment, when it was requested.
    End(Stamp),
}

/// The references of the policy, in the order in which it took them.
struct References {
    taken: Receiver<ReferenceSample>,
    all: Vec<ReferenceSample>,
}

impl References {
    const fn new(taken: Receiver<ReferenceSample>) -> Self {
        Self { taken, all: Vec::new() }
    }

    fn all(&mut self) -> &[ReferenceSample] {
        self.all.extend(self.taken.try_iter());
        &self.all
    }
}

/// The thread's own state.
struct Writer {
    config: RecorderConfig,
    inbox: Receiver<RecorderOrder>,
    added: Receiver<RecorderAddition>,
    references: References,
    events: broadcast::Receiver<Event>,
    streams: Streams,
    attached: Attached,
    /// Those of the episode in progress, or of the time since the last one began.
    publishers: Publishers,
    open: Option<OpenEpisode>,
    /// Receives the end of the episode in progress.
    ended: Option<oneshot::Sender<EpisodeReport>>,
    /// Receives the reports of the episode.
    episode: watch::Sender<Option<Arc<Episode>>>,
    /// Room for the episode's file.
    space: Option<Space>,
    clock: ClockWatch,
    /// Receives the clock of each episode.
    in_force: watch::Sender<WallClock>,
    clock_looked: Stamp,
    flushed: Stamp,
    reported: Stamp,
    /// When the episode in progress was last judged.
    judged: Stamp,
    complained: Option<Stamp>,
}

impl Writer {
    fn new(
        config: RecorderConfig,
        inbox: Receiver<RecorderOrder>,
        added: Receiver<RecorderAddition>,
        references: References,
        events: broadcast::Receiver<Event>,
        episode: watch::Sender<Option<Arc<Episode>>>,
        in_force: watch::Sender<WallClock>,
    ) -> Self {
        let clock = ClockWatch::new(*in_force.borrow());
        Self {
            config,
            inbox,
            added,
            references,
            events,
            streams: Streams::new(),
            attached: Attached::default(),
            publishers: Publishers::default(),
            open: None,
            ended: None,
            episode,
            space: None,
            clock,
            in_force,
            clock_looked: Stamp::default(),
            flushed: Stamp::default(),
            reported: Stamp::default(),
            judged: Stamp::default(),
            complained: None,
        }
    }

    /// Runs until the last handle is dropped and everything is written, or until it panics.
    fn run(mut self, mut source: impl Source) {
        loop {
            // Unwinding leaves an open episode complete: it is only replaced or taken as a whole, and its file refuses
            // half-written data.
            match catch_unwind(AssertUnwindSafe(|| self.turn(&mut source))) {
                Ok(ControlFlow::Continue(())) => {}
                Ok(ControlFlow::Break(())) => return,
                Err(panic) => {
                    let text = format!("the writer thread panicked: {}", panic_text(panic.as_ref()));
                    self.complain(Level::Error, text.clone());
                    let finished = catch_unwind(AssertUnwindSafe(|| self.finish(Stamp::now(), Some(text))));
                    if let Err(panic) = finished {
                        let text = panic_text(panic.as_ref());
                        self.complain(Level::Error, format!("and again while it ended the episode: {text}"));
                    }
                    return;
                }
            }
        }
    }

    fn turn(&mut self, source: &mut impl Source) -> ControlFlow<()> {
        fault::point("writer");
        while let Ok(RecorderAddition { registry, subscription }) = self.added.try_recv() {
            if let Some(subscription) = subscription {
                source.add(subscription);
            }
            self.config.registry = registry;
        }
        if let Err(error) = source.wait(TURN) {
            self.complain_about_bus(&error);
            // A source that cannot be waited on is polled.
            std::thread::sleep(TURN);
        }
        // Read before the drain: samples received by then are taken by it.
        let now = Stamp::now();
        let Self { streams, open, .. } = self;
        let drained =
            source.drain(&mut |topic, header, payload| streams.receive(open.as_mut(), topic, header, payload));
        if let Err(error) = drained {
            self.complain_about_bus(&error);
        }
        let Self { publishers, config, .. } = self;
        source.foreign(&mut |seen| publishers.note(seen).into_iter().for_each(|event| config.board.announce(event)));
        self.take_events();
        let open = self.take_orders();
        self.watch_clock(now);
        self.advance(now);
        match (open, &self.open) {
            (false, None) => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        }
    }

    fn take_events(&mut self) {
        loop {
            match self.events.try_recv() {
                Ok(event) => {
                    self.attached.apply(&event);
                    if let Some(open) = &mut self.open {
                        open.event(&event);
                    }
                }
                Err(EventError::Lagged(count)) => {
                    if let Some(open) = &mut self.open {
                        open.missed_events(count);
                    }
                }
                Err(EventError::Empty | EventError::Closed) => return,
            }
        }
    }

    /// Carries out a request; returns whether a handle is left that could send more.
    fn take_orders(&mut self) -> bool {
        loop {
            match self.inbox.try_recv() {
                Ok(RecorderOrder::Start { request, begun, ended }) => {
                    let started = self.start(&request);
                    if started.is_ok() {
                        self.ended = Some(ended);
                    }
                    // The requester may have ended.
                    let _ = begun.send(started);
                }
                Ok(RecorderOrder::End(at)) => {
                    if let Some(open) = &mut self.open {
                        open.end_at(at);
                    }
                }
                Err(TryRecvError::Empty) => return true,
                Err(TryRecvError::Disconnected) => {
                    if let Some(open) = &mut self.open {
                        open.end_at(Stamp::now());
                    }
                    return false;
                }
            }
        }
    }

    fn start(&mut self, request: &EpisodeRequest) -> Result<PathBuf, RecordError> {
        if let Some(open) = &self.open {
            return Err(RecordError::Busy(open.name().to_owned()));
        }
        let clock = (self.config.clock)();
        // Before the beginning: see `Recorder::clock`.
        self.in_force.send_replace(clock);
        let begin = (self.config.begin)();
        let path = EpisodePath::create(request, clock.wall_ns(begin))?;
        let (finished, partial) = (path.finished.clone(), path.partial.clone());
        // Nothing was recorded into it, and it was just created.
        let refuse = |error| {
            let _ = std::fs::remove_file(&partial);
            error
        };
        let failed = |source| refuse(RecordError::Io { path: partial.clone(), source });
        // One descriptor for the names, the disk space and the writeback, another for the sink.
        let (watched, file) = (Arc::clone(&path.file), path.file.try_clone().map_err(failed)?);
        let reserve = self.config.registry.rig.disk_reserve;
        let limit = (self.config.limit)(&watched);
        let space =
            Space::begin(watched, limit, &request.out, reserve, begin, &mut self.config.disk).map_err(refuse)?;
        let beginning = Beginning {
            registry: Arc::clone(&self.config.registry),
            board: Arc::clone(&self.config.board),
            request,
            path,
            sink: (self.config.sink)(file),
            limit,
            attached: &self.attached,
            clock,
            begin,
            shown: self.config.shown.clone(),
            references: self.references.all(),
        };
        let mut open = OpenEpisode::begin(beginning, &self.streams.masks).map_err(failed)?;
        // An episode records their state at its beginning, not only changes.
        let stops = self.config.stops.borrow().clone();
        for stop in stops {
            open.event(&Event { stamp: begin, what: EventKind::Stop(stop) });
        }
        self.config.board.set_recording(Some(open.status(begin)));
        self.config.board.announce(EventKind::Recording { file: finished.clone() });
        self.open = Some(open);
        self.publishers = Publishers::default();
        self.episode.send_replace(Some(Arc::new(Episode::new(&finished))));
        self.space = Some(space);
        (self.flushed, self.reported) = (begin, begin);
        Ok(finished)
    }

    fn advance(&mut self, now: Stamp) {
        let Some(open) = &mut self.open else { return };
        open.advance(now, &self.streams.masks);
        if now.since(self.flushed) >= FLUSH_EVERY {
            open.attach(self.references.all());
            open.flush();
            self.flushed = now;
        }
        if open.is_over(now) {
            self.finish(now, None);
            return;
        }
        if now.since(self.reported) >= STATUS_EVERY && !open.is_ending(now) {
            let room = self.space.as_ref().and_then(Space::left);
            if now.since(self.judged) >= JUDGE_EVERY {
                open.judge(now, self.publishers.list());
                self.judged = now;
            }
            self.config.board.set_recording(Some(RecordingStatus { room, ..open.status(now) }));
            self.reported = now;
        }
        self.watch_space(now);
    }

    fn watch_space(&mut self, now: Stamp) {
        let found = self.space.as_mut().and_then(|space| space.check(now, &mut self.config.disk));
        let Some((found, open)) = found.zip(self.open.as_ref()) else { return };
        match found {
            Finding::Low { free, left } => {
                let folder = open.name().parent().map(Path::to_owned).unwrap_or_default();
                self.config.board.announce(EventKind::DiskLow { folder, free, seconds: left.as_secs() });
            }
            Finding::FileLimit(text) => self.complain(Level::Warn, text),
            Finding::Removed => {
                let file = open.name().display();
                let text =
                    format!("{file}: removed while it is recorded; it will be written again when the episode ends");
                self.complain(Level::Error, text);
            }
            // Without waiting for samples in transit: these would need space.
            Finding::Spent(reason) => self.finish(now, Some(reason)),
        }
    }

    fn watch_clock(&mut self, now: Stamp) {
        if now.since(self.clock_looked) < CLOCK_EVERY {
            return;
        }
        self.clock_looked = now;
        let now = (self.config.clock)();
        if let Some(step_ns) = self.clock.detect_step(now) {
            if self.open.is_none() {
                self.in_force.send_replace(now);
            }
            self.config.board.announce(EventKind::ClockStep { seconds: step_ns as f64 / 1e9 });
        }
    }

    fn finish(&mut self, now: Stamp, reason: Option<String>) {
        let Some(mut open) = self.open.take() else { return };
        open.attach(self.references.all());
        let ended = self.episode.send_replace(None);
        let report = open.finish(now, &self.streams.masks, reason, self.publishers.list());
        ended.inspect(|ended| ended.end(&report.file));
        if let Some(space) = self.space.take() {
            space.release();
        }
        let board = &self.config.board;
        board.set_recording(None);
        if report.file.extension().is_none_or(|extension| extension != PARTIAL) {
            board.set_last_episode(report.file.clone(), report.verdict.clone());
        }
        board.announce(EventKind::Episode(report.clone()));
        if let Some(ended) = self.ended.take() {
            // The handle may have been dropped.
            let _ = ended.send(report);
        }
    }

    fn complain_about_bus(&mut self, error: &str) {
        let now = Stamp::now();
        if self.complained.is_none_or(|at| now.since(at) >= COMPLAIN_EVERY) {
            self.complained = Some(now);
            self.complain(Level::Error, format!("recorder: {error}"));
        }
    }

    fn complain(&self, level: Level, text: String) {
        self.config.board.announce(EventKind::Log { level, text });
    }
}

fn panic_text(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}
