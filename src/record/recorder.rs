//! The handle to the `writer` thread, and what it is made with.

use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{self, Sender};
use std::thread::JoinHandle;

use tokio::sync::{oneshot, watch};
use tokio_util::sync::CancellationToken;

use super::RecordError;
use super::episode::{EpisodeReport, EpisodeRequest};
use super::file::Sink;
use super::source::Source;
use super::space::Asker;
use super::writer::{Order, Reply, Writer};
use crate::disk::Disk;
use crate::registry::Registry;
use crate::status::{Board, EpisodeWatch};
use crate::time::{Stamp, WallClock};

type Opener = Box<dyn FnMut(File) -> Box<dyn Sink> + Send>;

/// What the thread works with.
pub struct RecorderConfig {
    /// What may be recorded.
    pub registry: Arc<Registry>,
    /// Where the state of the recording is reported, and events come from.
    pub board: Arc<Board>,
    /// Makes the sink of an episode of the file opened for it; the file itself unless a test wants
    /// the disk to fail.
    pub sink: Opener,
    /// Says what is free on the disk of an episode's file.
    pub disk: Asker,
    /// Reads the clocks.
    pub clock: Box<dyn FnMut() -> WallClock + Send>,
    /// Says when an episode begins that is asked for now: now. A test sends what it means to lie at
    /// the beginning from here, so that it lies there however long the machine takes.
    pub begin: Box<dyn FnMut() -> Stamp + Send>,
}

impl RecorderConfig {
    /// Episodes of `registry`, reported on `board`, written to their files.
    #[must_use]
    pub fn new(registry: Arc<Registry>, board: Arc<Board>) -> Self {
        Self {
            registry,
            board,
            sink: Box::new(|file| Box::new(file)),
            disk: Box::new(Disk::of),
            clock: Box::new(WallClock::now),
            begin: Box::new(Stamp::now),
        }
    }
}

/// The handle. Dropping it ends an episode in progress and waits for its file, some 150 ms and
/// what the disk takes.
#[derive(Debug)]
pub struct Recorder {
    orders: Option<Sender<Order>>,
    thread: Option<JoinHandle<()>>,
    ended: CancellationToken,
    episode: EpisodeWatch,
}

impl Recorder {
    /// Starts the `writer` thread. Events are recorded that are announced from now on.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn spawn(source: impl Source + 'static, config: RecorderConfig) -> io::Result<Self> {
        let (orders, inbox) = mpsc::channel();
        let events = config.board.events();
        let ended = CancellationToken::new();
        let (tell, episode) = watch::channel(None);
        let guard = ended.clone().drop_guard();
        let thread = std::thread::Builder::new().name("writer".to_owned()).spawn(move || {
            // Dropped by a panic too.
            let _guard = guard;
            Writer::new(config, inbox, events, tell).run(source);
        })?;
        Ok(Self { orders: Some(orders), thread: Some(thread), ended, episode })
    }

    /// Cancelled when the thread has ended: before the handle is dropped, by a panic.
    #[must_use]
    pub fn ended(&self) -> CancellationToken {
        self.ended.clone()
    }

    /// The episode in progress: from when its file is open until its last sample is written.
    #[must_use]
    pub fn episode(&self) -> EpisodeWatch {
        self.episode.clone()
    }

    /// Begins an episode; returns the name its file will have.
    ///
    /// # Errors
    /// When there is one in progress, or its file cannot be made.
    pub async fn start(&self, request: EpisodeRequest) -> Result<PathBuf, RecordError> {
        self.ask(|reply| Order::Start(request, reply)).await
    }

    /// Fixes the end of the episode in progress, if there is one, to the moment `at`; an earlier end stays. Does
    /// not wait: its last samples may still be on their way.
    pub fn end(&self, at: Stamp) {
        if let Some(orders) = &self.orders {
            // Without its thread there is no episode.
            let _ = orders.send(Order::End(at));
        }
    }

    /// Ends the episode in progress at this moment; see [`Self::stop_at`].
    ///
    /// # Errors
    /// Those of [`Self::stop_at`].
    pub async fn stop(&self) -> Result<EpisodeReport, RecordError> {
        self.stop_at(Stamp::now()).await
    }

    /// Ends the episode in progress at the moment `at`; returns once its file is closed. An episode
    /// whose end is fixed already, by its duration or by [`Self::end`], is waited for all the same.
    ///
    /// # Errors
    /// When there is none: one that its duration or the disk ended is told by `What::Episode` alone.
    pub async fn stop_at(&self, at: Stamp) -> Result<EpisodeReport, RecordError> {
        self.end(at);
        self.ask(Order::Await).await
    }

    /// Drops the last episode, `file`, if it is too short to be used and none has begun since; another file that
    /// has its name by now, or one that was changed, stays.
    ///
    /// # Errors
    /// When it is another episode, or the file cannot be removed.
    pub async fn drop_short(&self, file: PathBuf) -> Result<(), RecordError> {
        self.ask(|reply| Order::Drop(file, reply)).await
    }

    async fn ask<T>(&self, order: impl FnOnce(Reply<T>) -> Order) -> Result<T, RecordError> {
        let (reply, answer) = oneshot::channel();
        let orders = self.orders.as_ref().ok_or(RecordError::Ended)?;
        orders.send(order(reply)).map_err(|_| RecordError::Ended)?;
        answer.await.unwrap_or(Err(RecordError::Ended))
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.orders = None;
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been caught and told there.
            let _ = thread.join();
        }
    }
}
