//! Outlet: a terminal or a pipe that may be slow, behind a separate thread. The screen, the lines of a run and the log
//! each have one.
//!
//! Invariant: the sender never waits for the reader at the other end longer than it chooses to.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::{Notify, mpsc, oneshot};

/// A thread that writes the pieces sent to it, in order.
#[derive(Debug)]
pub struct Outlet {
    sender: mpsc::Sender<Vec<u8>>,
    room: Arc<Notify>,
    /// Pieces accepted, and pieces written; neither decreases.
    sent: AtomicU64,
    written: Arc<AtomicU64>,
    ended: oneshot::Receiver<io::Result<()>>,
}

impl Outlet {
    /// Starts the thread `name`, which takes up to `depth` pieces ahead of what `out` has taken.
    ///
    /// # Errors
    /// When the system provides no further thread.
    pub fn new(name: &str, depth: usize, mut out: impl Write + Send + 'static) -> io::Result<Self> {
        let (sender, mut pieces) = mpsc::channel::<Vec<u8>>(depth);
        let (report, ended) = oneshot::channel();
        let room = Arc::new(Notify::new());
        let written = Arc::new(AtomicU64::new(0));
        let (made, count) = (Arc::clone(&room), Arc::clone(&written));
        std::thread::Builder::new().name(name.to_owned()).spawn(move || {
            let mut outcome = Ok(());
            while let Some(piece) = pieces.blocking_recv() {
                made.notify_one();
                outcome = out.write_all(&piece).and_then(|()| out.flush());
                if outcome.is_err() {
                    break;
                }
                count.fetch_add(1, Ordering::Release);
            }
            // One that waits for room sees that the writer is gone.
            made.notify_one();
            // The receiver may be gone.
            let _ = report.send(outcome);
        })?;
        Ok(Self { sender, room, sent: AtomicU64::new(0), written, ended })
    }

    /// Notified when the writer has taken a piece, or has ended.
    pub fn room(&self) -> Arc<Notify> {
        Arc::clone(&self.room)
    }

    /// Whether everything sent so far has been passed to the writer.
    pub fn is_idle(&self) -> bool {
        self.sender.capacity() == self.sender.max_capacity()
    }

    /// Whether the other end is gone.
    pub fn is_closed(&self) -> bool {
        self.sender.is_closed()
    }

    /// Sends a piece if there is room; true if there was.
    #[must_use = "a piece without room is lost"]
    pub fn try_send(&self, piece: Vec<u8>) -> bool {
        self.sender.try_reserve().map(|permit| self.pass(permit, piece)).is_ok()
    }

    /// Sends a piece as soon as there is room; false when the other end is gone.
    pub async fn send(&self, piece: Vec<u8>) -> bool {
        self.sender.reserve().await.map(|permit| self.pass(permit, piece)).is_ok()
    }

    /// Counts a piece before the writer has it: no piece that is written is missing in the count.
    fn pass(&self, permit: mpsc::Permit<'_, Vec<u8>>, piece: Vec<u8>) {
        self.sent.fetch_add(1, Ordering::AcqRel);
        permit.send(piece);
    }

    /// Waits until the other end is gone.
    pub async fn closed(&self) {
        self.sender.closed().await;
    }

    /// Waits until everything is written, at most `within`.
    ///
    /// # Errors
    /// The writer's error when it ended early; `TimedOut` when the reader takes too long.
    pub async fn finish(self, within: Duration) -> io::Result<()> {
        drop(self.sender);
        match tokio::time::timeout(within, self.ended).await {
            Ok(Ok(outcome)) => outcome,
            Ok(Err(_)) => Err(io::Error::other("the writer ended without an outcome")),
            Err(_) => Err(io::ErrorKind::TimedOut.into()),
        }
    }

    /// Blocks until everything that this thread has sent is written, or the other end is gone, at most `within`.
    pub fn drain(&self, within: Duration) {
        let (sent, deadline) = (self.sent.load(Ordering::Acquire), Instant::now() + within);
        while self.written.load(Ordering::Acquire) < sent && !self.is_closed() && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

/// Writes one text, and waits at most `within` for its reader.
pub fn write_within(out: impl Write + Send + 'static, text: String, within: Duration) {
    // Without a thread, or with a reader that is gone, there is no place left to report it.
    let Ok(outlet) = Outlet::new("outlet", 1, out) else { return };
    let _ = outlet.try_send(text.into_bytes());
    outlet.drain(within);
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Broken;

    impl Write for Broken {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[tokio::test]
    async fn a_broken_pipe_is_reported_without_blocking() {
        let outlet = Outlet::new("test", 1, Broken).unwrap();
        assert!(outlet.send(b"x".to_vec()).await);
        outlet.closed().await;
        assert!(!outlet.send(b"y".to_vec()).await);
        let error = outlet.finish(Duration::from_secs(5)).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::BrokenPipe);
    }

    #[test]
    fn a_drained_outlet_has_written_everything_or_lost_its_reader() {
        let long = Duration::from_hours(1);
        let (mut reader, writer) = io::pipe().unwrap();
        let outlet = Outlet::new("test", 8, writer).unwrap();
        for piece in ["one ", "two ", "three"] {
            assert!(outlet.try_send(piece.as_bytes().to_vec()));
        }
        outlet.drain(long);
        // Written before its end, and it can still be used.
        let mut text = [0; 13];
        io::Read::read_exact(&mut reader, &mut text).unwrap();
        assert_eq!(&text, b"one two three");
        assert!(outlet.try_send(b"four".to_vec()));
        outlet.drain(long);
        drop(outlet);
        let mut text = String::new();
        io::Read::read_to_string(&mut reader, &mut text).unwrap();
        assert_eq!(text, "four");

        let outlet = Outlet::new("test", 8, Broken).unwrap();
        while outlet.try_send(b"x".to_vec()) {
            std::thread::yield_now();
        }
        outlet.drain(long);

        // A reader that takes nothing: the pipe is full, and the wait ends nevertheless.
        let (_reader, writer) = io::pipe().unwrap();
        let outlet = Outlet::new("test", 8, writer).unwrap();
        assert!(outlet.try_send(vec![0; 1 << 20]));
        outlet.drain(Duration::from_millis(10));
    }

    #[tokio::test]
    async fn pieces_arrive_in_order() {
        let (mut reader, writer) = io::pipe().unwrap();
        let outlet = Outlet::new("test", 2, writer).unwrap();
        for piece in ["one ", "two ", "three"] {
            assert!(outlet.send(piece.as_bytes().to_vec()).await);
        }
        outlet.finish(Duration::from_secs(5)).await.unwrap();
        let mut text = String::new();
        io::Read::read_to_string(&mut reader, &mut text).unwrap();
        assert_eq!(text, "one two three");
    }
}
