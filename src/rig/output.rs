//! A child's output, as lines of the log and of its device's file.
//!
//! Invariant: the lines of a child are bounded in length and in rate; omitted lines are counted and reported. A child
//! that prints faster blocks on its pipe, as at a slow terminal, and costs the rig a few reads each [`PAUSE`].

use std::sync::Arc;
use std::time::Duration;

use tokio::net::unix::pipe::Receiver;
use tokio::time::sleep;

use super::logbook::Logbook;
use super::programs::Programs;
use crate::status::{Board, Level, PrintedOn, What};
use crate::text;
use crate::time::Stamp;

/// Maximum bytes of a line; longer ones are cut.
const LONGEST: usize = 1000;
/// Lines that may come at once...
const BURST: f64 = 100.0;
/// ...and lines a second in the long run.
const RATE: f64 = 20.0;
/// Delay between two reads of a child that prints too much.
const PAUSE: Duration = Duration::from_millis(10);
/// How often the count of omitted lines is logged.
const TELL_EVERY: Duration = Duration::from_secs(5);
/// Bytes per read.
const CHUNK: usize = 16 << 10;

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Output {
    device: String,
    /// Which of the device's programs it is, as `hook: `; empty for the program that reads the device.
    whose: String,
    board: Arc<Board>,
    logbook: Logbook,
    /// Standard output and standard error.
    lines: [Lines; 2],
    limit: Limit,
    left_out: u64,
    reported: Stamp,
}

impl Output {
    /// `hook` is the key of the hook being run, if any.
    pub(super) fn new(device: &str, hook: Option<&str>, programs: &Programs) -> Self {
        let now = Stamp::now();
        Self {
            device: device.to_owned(),
            whose: hook.map_or_else(String::new, |hook| format!("{hook}: ")),
            board: Arc::clone(&programs.board),
            logbook: programs.logbook.clone(),
            lines: [Lines::default(), Lines::default()],
            limit: Limit::new(now),
            left_out: 0,
            reported: now,
        }
    }

    /// Reads both pipes; never returns. Dropping the future loses nothing.
    pub(super) async fn follow(&mut self, stdout: &Receiver, stderr: &Receiver) {
        loop {
            let [out, err] = self.lines.each_ref().map(|lines| !lines.closed);
            tokio::select! {
                result = stdout.readable(), if out => self.look(0, result.is_ok().then_some(stdout)),
                result = stderr.readable(), if err => self.look(1, result.is_ok().then_some(stderr)),
                () = sleep(TELL_EVERY.saturating_sub(Stamp::now().since(self.reported))), if self.left_out > 0 => {
                    self.notify();
                }
                else => std::future::pending().await,
            }
            if self.limit.is_used_up() {
                sleep(PAUSE).await;
            }
        }
    }

    /// Reads the available bytes and logs the rest.
    pub(super) fn finish(&mut self, stdout: &Receiver, stderr: &Receiver) {
        for (index, pipe) in [stdout, stderr].into_iter().enumerate() {
            // At most one pipe's capacity: a pipe that is still written to would never end.
            for _ in 0..4 {
                self.look(index, Some(pipe));
            }
            if let Some(lines) = self.lines.get_mut(index)
                && let Some(line) = lines.rest()
            {
                self.print(index, &line);
            }
        }
        self.notify();
    }

    /// Reads once; does nothing without a pipe.
    fn look(&mut self, index: usize, pipe: Option<&Receiver>) {
        let mut chunk = [0; CHUNK];
        let read = match pipe.map(|pipe| pipe.try_read(&mut chunk)) {
            Some(Ok(read)) => read,
            Some(Err(error)) if error.kind() == std::io::ErrorKind::WouldBlock => return,
            Some(Err(_)) | None => 0,
        };
        let Some(lines) = self.lines.get_mut(index) else { return };
        lines.closed = read == 0;
        let complete = lines.take(chunk.get(..read).unwrap_or_default());
        for line in complete {
            self.print(index, &line);
        }
    }

    fn print(&mut self, index: usize, line: &str) {
        if !self.limit.allows(Stamp::now()) {
            self.left_out += 1;
            return;
        }
        let text = self.keep(line);
        let (device, printed) = (self.device.clone(), if index == 0 { PrintedOn::Stdout } else { PrintedOn::Stderr });
        self.board.announce(What::Printed { level: Level::Info, device, printed, text });
    }

    fn notify(&mut self) {
        self.reported = Stamp::now();
        let left_out = std::mem::take(&mut self.left_out);
        if left_out > 0 {
            self.note(Level::Warn, &format!("prints too much: {} left out", text::counted(left_out, "line")));
        }
    }

    /// Adds a line to the log and to the device's file.
    pub(super) fn note(&self, level: Level, line: &str) {
        let text = self.keep(line);
        self.board.announce(What::Log { level, text });
    }

    /// Adds a line to the device's file; the line as it is for the log.
    fn keep(&self, line: &str) -> String {
        let line = format!("{}{line}", self.whose);
        self.logbook.write(&self.device, &line);
        format!("{}: {line}", self.device)
    }
}

/// Bytes to lines.
#[derive(Debug, Default)]
struct Lines {
    line: Vec<u8>,
    /// The rest of the line is discarded.
    is_cut: bool,
    closed: bool,
}

impl Lines {
    /// The non-empty lines that end in `bytes`.
    fn take(&mut self, bytes: &[u8]) -> Vec<String> {
        let mut complete = Vec::new();
        for piece in bytes.split_inclusive(|byte| *byte == b'\n') {
            let (text, ends) = match piece.split_last() {
                Some((b'\n', text)) => (text, true),
                _ => (piece, false),
            };
            let room = LONGEST - self.line.len();
            self.is_cut |= text.len() > room;
            self.line.extend_from_slice(text.get(..room).unwrap_or(text));
            if ends {
                complete.extend(self.rest());
            }
        }
        complete
    }

    /// The line so far, as text that is safe for a terminal.
    fn rest(&mut self) -> Option<String> {
        let mut line = text::plain(&String::from_utf8_lossy(&self.line)).trim_end().to_owned();
        self.line.clear();
        if std::mem::take(&mut self.is_cut) {
            line.push('\u{2026}');
        }
        (!line.is_empty()).then_some(line)
    }
}

/// A token bucket for logged lines.
#[derive(Debug)]
struct Limit {
    left: f64,
    filled: Stamp,
}

impl Limit {
    const fn new(now: Stamp) -> Self {
        Self { left: BURST, filled: now }
    }

    fn allows(&mut self, now: Stamp) -> bool {
        self.left = (self.left + now.since(self.filled).as_secs_f64() * RATE).min(BURST);
        self.filled = now;
        let allowed = self.left >= 1.0;
        if allowed {
            self.left -= 1.0;
        }
        allowed
    }

    fn is_used_up(&self) -> bool {
        self.left < 1.0
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn lines_are_cut_and_sanitized() {
        let mut lines = Lines::default();
        assert_eq!(lines.take(b"one\r\n\n\ntw"), ["one"]);
        assert_eq!(lines.take(b"o\n\x1b[31mred\xff\n"), ["two", " [31mred\u{fffd}"]);
        assert_eq!(lines.take(&[b'x'; 3 * LONGEST]), [""; 0]);
        let cut = lines.take(b"y\nnext");
        assert_eq!(cut, [format!("{}\u{2026}", "x".repeat(LONGEST))]);
        assert_eq!(lines.rest().as_deref(), Some("next"));
        assert_eq!(lines.rest(), None);
    }

    #[test]
    fn a_flood_is_thinned_to_the_rate() {
        let mut limit = Limit::new(Stamp(0));
        let mut allowed = 0;
        // Ten seconds, one line each 100 us.
        for step in 0..100_000_u64 {
            allowed += u32::from(limit.allows(Stamp(step * 100_000)));
        }
        assert_eq!(allowed, 100 + 200 - 1);
        assert!(limit.is_used_up());
        assert!(limit.allows(Stamp(11_000_000_000)), "quiet for a second, its lines pass again");
    }

    proptest! {
        #[test]
        fn chunking_does_not_change_the_lines(bytes: Vec<u8>, at in 0..200_usize) {
            let (first, second) = bytes.split_at(at.min(bytes.len()));
            let mut whole = Lines::default();
            let mut halves = Lines::default();
            let expected = whole.take(&bytes);
            let mut got = halves.take(first);
            got.extend(halves.take(second));
            prop_assert_eq!(got, expected);
            prop_assert_eq!(halves.rest(), whole.rest());
        }
    }
}
