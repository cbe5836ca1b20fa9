//! A child's output, as lines of the log and of its device's file.
//!
//! Invariant: the lines of a child are bounded in length and in rate; omitted lines are counted and reported. A child
//! that prints faster blocks on its pipe, as at a slow terminal, and costs the rig a few reads each [`PAUSE`].

use std::io;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_status::{Board, EventKind, Level, PrintedOn};
use tokio::net::unix::pipe::Receiver;
use tokio::time::sleep;

use super::logbook::Logbook;
use super::programs::Programs;

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
                result = stdout.readable(), if out => self.read_once(0, |chunk| result.and_then(|()| stdout.try_read(chunk))),
                result = stderr.readable(), if err => self.read_once(1, |chunk| result.and_then(|()| stderr.try_read(chunk))),
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
                // The end of the child may be seen before what it printed last: `try_read` asks the runtime, not the pipe.
                self.read_once(index, |chunk| Ok(rustix::io::read(pipe, chunk)?));
            }
            if let Some(lines) = self.lines.get_mut(index)
                && let Some(line) = lines.rest()
            {
                self.print(index, &line);
            }
        }
        self.notify();
    }

    fn read_once(&mut self, index: usize, read: impl FnOnce(&mut [u8]) -> io::Result<usize>) {
        let mut chunk = [0; CHUNK];
        let read = match read(&mut chunk) {
            Ok(read) => read,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
            Err(_) => 0,
        };
        let Some(lines) = self.lines.get_mut(index) else { return };
        lines.closed = read == 0;
        let complete = lines.feed(chunk.get(..read).unwrap_or_default());
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
        self.board.announce(EventKind::Printed { level: Level::Info, device, printed, text });
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
        self.board.announce(EventKind::Log { level, text });
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
    fn feed(&mut self, bytes: &[u8]) -> Vec<String> {
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

    /// A child that has ended, before the runtime has noticed that its pipe can be read.
    #[tokio::test]
    async fn what_a_child_prints_last_is_logged_however_soon_it_ends() {
        use std::io::Write as _;
        let board = Arc::new(Board::new(&rapid_registry::Registry::builtin()));
        let mut events = board.events();
        let now = Stamp::now();
        let mut output = Output {
            device: "motor".to_owned(),
            whose: String::new(),
            logbook: Logbook::without_folder(),
            board,
            lines: [Lines::default(), Lines::default()],
            limit: Limit::new(now),
            left_out: 0,
            reported: now,
        };
        let pipes = ["out", "err"].map(|text| {
            let (reader, mut writer) = io::pipe().unwrap();
            writer.write_all(text.as_bytes()).unwrap();
            Receiver::from_owned_fd(reader.into()).unwrap()
        });
        // The runtime has not looked at it yet.
        assert_eq!(pipes[0].try_read(&mut [0; 8]).unwrap_err().kind(), io::ErrorKind::WouldBlock);
        output.finish(&pipes[0], &pipes[1]);
        let printed = [(); 2].map(|()| match events.try_recv().unwrap().what {
            EventKind::Printed { text, .. } => text,
            other => panic!("{other:?}"),
        });
        assert_eq!(printed, ["motor: out", "motor: err"]);
    }

    #[test]
    fn lines_are_cut_and_sanitized() {
        let mut lines = Lines::default();
        assert_eq!(lines.feed(b"one\r\n\n\ntw"), ["one"]);
        assert_eq!(lines.feed(b"o\n\x1b[31mred\xff\n"), ["two", " [31mred\u{fffd}"]);
        assert_eq!(lines.feed(&[b'x'; 3 * LONGEST]), [""; 0]);
        let cut = lines.feed(b"y\nnext");
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
            let expected = whole.feed(&bytes);
            let mut got = halves.feed(first);
            got.extend(halves.feed(second));
            prop_assert_eq!(got, expected);
            prop_assert_eq!(halves.rest(), whole.rest());
        }
    }
}
