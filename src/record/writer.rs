//! The `writer` thread.
//!
//! It takes samples from the bus all the time, so that an episode begins with an empty queue; while
//! there is no episode it throws them away.
//!
//! Invariant: an episode in progress is finished whatever ends the thread: the last handle dropped,
//! an error of the disk, a panic.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Duration;

use tokio::sync::broadcast::{self, error::TryRecvError as EventError};
use tokio::sync::{oneshot, watch};

use super::RecordError;
use super::episode::{Closing, EpisodePath, EpisodeReport, EpisodeRequest, PARTIAL};
use super::provenance::Attached;
use super::publishers::Publishers;
use super::recorder::RecorderConfig;
use super::session::{Beginning, Session};
use super::short::Short;
use super::source::Source;
use super::space::{Finding, Space};
use super::streams::Streams;
use crate::fault;
use crate::status::{Episode, Event, Level, RecordingStatus, What};
use crate::time::{ClockWatch, Stamp};

/// Longest wait for samples: what an order, an event or a due frame may have to wait.
const TURN: Duration = Duration::from_millis(20);
/// How often what was written is handed to the kernel. A kill may take a second at most: half of it
/// is for what lies on the bus and for frames that are not due yet.
const FLUSH_EVERY: Duration = Duration::from_millis(500);
/// How often the board is told.
const STATUS_EVERY: Duration = Duration::from_millis(200);
/// How often it is looked whether the wall clock was set.
const CLOCK_EVERY: Duration = Duration::from_millis(100);
/// Least distance of two complaints about the bus.
const COMPLAIN_EVERY: Duration = Duration::from_secs(5);

/// Where an answer goes.
pub(super) type Reply<T> = oneshot::Sender<Result<T, RecordError>>;

/// What the thread is asked for.
pub(super) enum Order {
    /// Begin an episode now.
    Start(EpisodeRequest, Reply<PathBuf>),
    /// Fix the end of the episode in progress to this moment: that at which it was asked for.
    End(Stamp),
    /// Answer when the file of the episode in progress is closed.
    Await(Reply<EpisodeReport>),
    /// Drop this file, the last episode, if it is short.
    Drop(PathBuf, Reply<()>),
}

/// The thread's own state.
pub(super) struct Writer {
    config: RecorderConfig,
    inbox: Receiver<Order>,
    events: broadcast::Receiver<Event>,
    streams: Streams,
    attached: Attached,
    /// Of the episode in progress, or of the time since the last one began.
    publishers: Publishers,
    session: Option<Session>,
    /// The last episode, if it is too short to be used, until the next one begins.
    short: Option<Short>,
    /// Files that were dropped: their names are not given again.
    dropped: Vec<PathBuf>,
    /// Told of the session.
    episode: watch::Sender<Option<Arc<Episode>>>,
    /// Room for the session's file.
    space: Option<Space>,
    clock: ClockWatch,
    clock_looked: Stamp,
    waiting: Vec<Reply<EpisodeReport>>,
    flushed: Stamp,
    reported: Stamp,
    complained: Option<Stamp>,
}

enum Turn {
    Again,
    Last,
}

impl Writer {
    pub(super) fn new(
        mut config: RecorderConfig,
        inbox: Receiver<Order>,
        events: broadcast::Receiver<Event>,
        episode: watch::Sender<Option<Arc<Episode>>>,
    ) -> Self {
        let clock = ClockWatch::new((config.clock)());
        Self {
            config,
            inbox,
            events,
            streams: Streams::new(),
            attached: Attached::default(),
            publishers: Publishers::default(),
            session: None,
            short: None,
            dropped: Vec::new(),
            episode,
            space: None,
            clock,
            clock_looked: Stamp::default(),
            waiting: Vec::new(),
            flushed: Stamp::default(),
            reported: Stamp::default(),
            complained: None,
        }
    }

    /// Works until the last handle is dropped and nothing is left to be written, or until it panics.
    pub(super) fn run(mut self, mut source: impl Source) {
        loop {
            // Unwinding leaves a session whole: it is only ever replaced or taken as a whole, and
            // what of it was half written is for its file to refuse.
            match catch_unwind(AssertUnwindSafe(|| self.turn(&mut source))) {
                Ok(Turn::Again) => {}
                Ok(Turn::Last) => return,
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

    fn turn(&mut self, source: &mut impl Source) -> Turn {
        fault::point("writer");
        if let Err(error) = source.wait(TURN) {
            self.complain_about_bus(&error);
            // What cannot be waited on is looked at regularly instead.
            std::thread::sleep(TURN);
        }
        // Read before the drain: what was received by then has been taken after it.
        let now = Stamp::now();
        let Self { streams, session, .. } = self;
        let drained =
            source.drain(&mut |topic, header, payload| streams.take(session.as_mut(), topic, header, payload));
        if let Some(reason) = source.lost() {
            self.finish(now, Some(reason));
        } else if let Err(error) = drained {
            self.complain_about_bus(&error);
        }
        let Self { publishers, config, .. } = self;
        source.foreign(&mut |seen| publishers.note(seen).into_iter().for_each(|event| config.board.announce(event)));
        self.take_events();
        let open = self.take_orders();
        self.watch_clock(now);
        self.advance(now);
        match (open, &self.session) {
            (false, None) => Turn::Last,
            _ => Turn::Again,
        }
    }

    fn take_events(&mut self) {
        loop {
            match self.events.try_recv() {
                Ok(event) => {
                    self.attached.take(&event);
                    if let Some(session) = &mut self.session {
                        session.event(&event);
                    }
                }
                Err(EventError::Lagged(count)) => {
                    if let Some(session) = &mut self.session {
                        session.missed_events(count);
                    }
                }
                Err(EventError::Empty | EventError::Closed) => return,
            }
        }
    }

    /// Does what is asked; says whether a handle is left to ask more.
    fn take_orders(&mut self) -> bool {
        loop {
            match self.inbox.try_recv() {
                Ok(Order::Start(request, reply)) => {
                    let started = self.start(&request);
                    // Whoever asked may have gone.
                    let _ = reply.send(started);
                }
                Ok(Order::End(at)) => {
                    if let Some(session) = &mut self.session {
                        session.end_at(at);
                    }
                }
                Ok(Order::Await(reply)) => match &self.session {
                    Some(_) => self.waiting.push(reply),
                    None => {
                        let _ = reply.send(Err(RecordError::Idle));
                    }
                },
                Ok(Order::Drop(file, reply)) => {
                    let _ = reply.send(self.drop_short(file));
                }
                Err(TryRecvError::Empty) => return true,
                Err(TryRecvError::Disconnected) => {
                    if let Some(session) = &mut self.session {
                        session.end_at(Stamp::now());
                    }
                    return false;
                }
            }
        }
    }

    fn start(&mut self, request: &EpisodeRequest) -> Result<PathBuf, RecordError> {
        if let Some(session) = &self.session {
            return Err(RecordError::Busy(session.name().to_owned()));
        }
        let clock = (self.config.clock)();
        let begin = (self.config.begin)();
        let path = EpisodePath::create_beside(&request.out, &request.task, clock.wall_ns(begin), &self.dropped)?;
        let (finished, partial) = (path.finished.clone(), path.partial.clone());
        // Nothing was recorded into it, and it was made a moment ago.
        let refuse = |error| {
            let _ = std::fs::remove_file(&partial);
            error
        };
        let failed = |source| refuse(RecordError::Io { path: partial.clone(), source });
        // One descriptor for the names, the room and the writeback, another for the sink.
        let (watched, file) = (Arc::clone(&path.file), path.file.try_clone().map_err(failed)?);
        let reserve = self.config.registry.rig.disk_reserve;
        let space = Space::begin(watched, &request.out, reserve, begin, &mut self.config.disk).map_err(refuse)?;
        let beginning = Beginning {
            registry: Arc::clone(&self.config.registry),
            board: Arc::clone(&self.config.board),
            request,
            path,
            sink: (self.config.sink)(file),
            attached: &self.attached,
            clock,
            begin,
        };
        let mut session = Session::begin(beginning, &self.streams.masks).map_err(failed)?;
        // An episode says what they say from its beginning, not only what changes.
        for stop in self.config.board.stops() {
            session.event(&Event { stamp: begin, what: What::Stop(stop) });
        }
        // Withdrawn before the next one shows.
        self.set_short(None);
        self.config.board.set_recording(Some(session.status(begin)));
        self.config.board.announce(What::Recording { file: finished.clone() });
        self.session = Some(session);
        self.publishers = Publishers::default();
        self.episode.send_replace(Some(Arc::new(Episode::new(&finished))));
        self.space = Some(space);
        (self.flushed, self.reported) = (begin, begin);
        Ok(finished)
    }

    fn advance(&mut self, now: Stamp) {
        let Some(session) = &mut self.session else { return };
        session.advance(now, &self.streams.masks);
        if now.since(self.flushed) >= FLUSH_EVERY {
            session.flush();
            self.flushed = now;
        }
        if session.is_over(now) {
            self.finish(now, None);
            return;
        }
        if now.since(self.reported) >= STATUS_EVERY && !session.is_ending(now) {
            let room = self.space.as_ref().and_then(Space::left);
            self.config.board.set_recording(Some(RecordingStatus { room, ..session.status(now) }));
            self.reported = now;
        }
        self.watch_space(now);
    }

    fn watch_space(&mut self, now: Stamp) {
        let found = self.space.as_mut().and_then(|space| space.look(now, &mut self.config.disk));
        let Some((found, session)) = found.zip(self.session.as_ref()) else { return };
        match found {
            Finding::Low { free, left } => {
                let folder = session.name().parent().map(Path::to_owned).unwrap_or_default();
                self.config.board.announce(What::DiskLow { folder, free, seconds: left.as_secs() });
            }
            Finding::Removed => {
                let file = session.name().display();
                let text =
                    format!("{file}: removed while it is recorded; it will be written again when the episode ends");
                self.complain(Level::Error, text);
            }
            // Without waiting for what may still be on its way: it would need room.
            Finding::Spent(reason) => self.finish(now, Some(reason)),
        }
    }

    fn watch_clock(&mut self, now: Stamp) {
        if now.since(self.clock_looked) < CLOCK_EVERY {
            return;
        }
        self.clock_looked = now;
        if let Some(step_ns) = self.clock.look((self.config.clock)()) {
            self.config.board.announce(What::ClockStep { seconds: step_ns as f64 / 1e9 });
        }
    }

    fn finish(&mut self, now: Stamp, reason: Option<String>) {
        let Some(session) = self.session.take() else { return };
        let ended = self.episode.send_replace(None);
        let closing = Closing { reason, publishers: self.publishers.list() };
        let report = session.finish(now, &self.streams.masks, closing);
        ended.inspect(|ended| ended.end(&report.file));
        if let Some(space) = self.space.take() {
            space.release();
        }
        let board = &self.config.board;
        board.set_recording(None);
        if report.file.extension().is_none_or(|extension| extension != PARTIAL) {
            board.set_last_episode(report.file.clone(), report.verdict.clone());
            self.set_short(Short::of(&report));
        }
        let board = &self.config.board;
        let EpisodeReport { file, seconds, messages, bytes, dropped, error, verdict } = report.clone();
        board.announce(What::Episode { file, seconds, messages, bytes, dropped, error, verdict });
        for reply in self.waiting.drain(..) {
            let _ = reply.send(Ok(report.clone()));
        }
    }

    fn set_short(&mut self, short: Option<Short>) {
        self.config.board.set_short_episode(short.as_ref().map(Short::offer));
        self.short = short;
    }

    fn drop_short(&mut self, file: PathBuf) -> Result<(), RecordError> {
        let Some(short) = self.short.take_if(|short| short.is(&file)) else { return Err(RecordError::Kept(file)) };
        // Tried once: what cannot be removed is not offered again.
        self.set_short(None);
        let seconds = short.remove().map_err(|source| RecordError::Io { path: file.clone(), source })?;
        self.config.board.forget_last_episode();
        self.dropped.push(file.clone());
        self.config.board.announce(What::Dropped { file, seconds });
        Ok(())
    }

    fn complain_about_bus(&mut self, error: &str) {
        let now = Stamp::now();
        if self.complained.is_none_or(|at| now.since(at) >= COMPLAIN_EVERY) {
            self.complained = Some(now);
            self.complain(Level::Error, format!("recorder: {error}"));
        }
    }

    fn complain(&self, level: Level, text: String) {
        self.config.board.announce(What::Log { level, text });
    }
}

fn panic_text(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}
