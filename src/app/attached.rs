//! Screens of other processes (`rapid monitor`): each gets snapshots, and what it requests is treated as a request of the
//! screen of the run.
//!
//! Invariant: an attached screen delays nothing: its snapshots are made and written by a task of its own, and one that
//! does not read gets fewer of them, and after [`STUCK`] none.
//! Invariant: no attached screen ends the run.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use rapid_status::attach::Encoder;
use rapid_status::{Board, Command};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, timeout};

use crate::orders::receive::Viewer;

/// Screens at a time.
const SCREENS: usize = 8;
/// Time between two snapshots.
const FRAME: Duration = Duration::from_millis(100);
/// A screen that takes nothing for this long is dropped.
const STUCK: Duration = Duration::from_secs(10);
/// Longest command: a note of 500 characters, each of them escaped, is a fifth of it.
const LONGEST_COMMAND: u64 = 16_384;

/// What is needed to attach screens.
#[derive(Debug)]
pub(super) struct Attached {
    board: Arc<Board>,
    commands: mpsc::Sender<Command>,
    count: Arc<AtomicUsize>,
}

/// The place of a screen, which is free again when this is dropped.
struct ScreenGuard(Arc<AtomicUsize>);

impl ScreenGuard {
    /// `None` when [`SCREENS`] are attached.
    fn acquire(count: &Arc<AtomicUsize>) -> Option<Self> {
        let place = Self(Arc::clone(count));
        (count.fetch_add(1, Ordering::Relaxed) < SCREENS).then_some(place)
    }
}

impl Drop for ScreenGuard {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Attached {
    /// Screens that show `board` and send their requests to `commands`.
    pub(super) fn new(board: Arc<Board>, commands: mpsc::Sender<Command>) -> Self {
        Self { board, commands, count: Arc::default() }
    }

    pub(super) const fn board(&self) -> &Arc<Board> {
        &self.board
    }

    /// Attaches a screen until it or the run ends.
    pub(super) fn attach(&self, viewer: Viewer) {
        let Viewer { stream, read_only } = viewer;
        let place = ScreenGuard::acquire(&self.count);
        let (board, commands) = (Arc::clone(&self.board), self.commands.clone());
        tokio::spawn(async move {
            if let Ok(stream) = stream.set_nonblocking(true).and_then(|()| UnixStream::from_std(stream)) {
                // A screen that has left, or is stuck, is not an error of the run.
                let _ = serve(stream, place, &board, &commands, read_only).await;
            }
        });
    }
}

async fn serve(
    stream: UnixStream,
    place: Option<ScreenGuard>,
    board: &Board,
    commands: &mpsc::Sender<Command>,
    read_only: bool,
) -> io::Result<()> {
    let (from, mut to) = stream.into_split();
    let Some(_place) = place else {
        return to.write_all(format!("{SCREENS} screens are attached already\n").as_bytes()).await;
    };
    tokio::select! {
        outcome = show(to, board) => outcome,
        outcome = obey(from, commands, read_only) => outcome,
    }
}

/// Sends snapshots until the screen does not take them.
async fn show(mut to: OwnedWriteHalf, board: &Board) -> io::Result<()> {
    let mut encoder = Encoder::default();
    to.write_all(&Encoder::hello(env!("CARGO_PKG_VERSION"), std::process::id())).await?;
    let mut frames = interval(FRAME);
    frames.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        frames.tick().await;
        let bytes = encoder.encode(board.snapshot());
        timeout(STUCK, to.write_all(&bytes)).await??;
    }
}

/// Takes commands until the screen has left.
async fn obey(from: OwnedReadHalf, commands: &mpsc::Sender<Command>, read_only: bool) -> io::Result<()> {
    let mut from = BufReader::new(from);
    loop {
        let mut line = String::new();
        (&mut from).take(LONGEST_COMMAND).read_line(&mut line).await?;
        if !line.ends_with('\n') {
            return Ok(());
        }
        let command = match serde_json::from_str(&line)? {
            // The end of a screen is not the end of the run.
            Command::Quit => return Ok(()),
            look @ Command::Look(_) => look,
            _ if read_only => continue,
            command => command,
        };
        if commands.send(command).await.is_err() {
            return Ok(());
        }
    }
}
