//! Lines of text on a serial port, sent repeatedly, or at each change.
//!
//! Where lines are sent at changes only, an input is off when the port is opened. Where they are sent repeatedly, what
//! arrives before the first line end after opening is part of a line and is ignored.
//!
//! Invariant: memory is bounded, whatever the port sends.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;

use rapid_core::text::not_opened;
use rapid_registry::{LineInput, LineOff};
use rapid_system::tty;
use rustix::fs::{Mode, OFlags, open};
use rustix::io::Errno;
use rustix::termios::{ControlModes, OptionalActions, QueueSelector, tcflush, tcgetattr, tcsetattr};

/// Longest line that is evaluated; a longer one cannot be one of the meaningful lines.
const LONGEST: usize = 128;

/// Most reads in a row.
const MOST_READS: usize = 64;

/// An open port.
#[derive(Debug)]
pub(super) struct Lines {
    fd: OwnedFd,
    shown: String,
    words: Words,
}

impl Lines {
    /// Opens the port of these lines, which is one, exclusively, 8 bits without parity.
    pub(super) fn open(specs: &[LineInput]) -> Result<Self, String> {
        let Some(spec) = specs.first() else { return Err("no line".to_owned()) };
        let shown = spec.path.display().to_string();
        let fail = |error: Errno| not_opened(&shown, "dialout", &error.into());
        let flags = OFlags::RDONLY | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let fd = open(&spec.path, flags, Mode::empty()).map_err(fail)?;
        tty::hold(&fd).map_err(fail)?;
        let mut settings = tcgetattr(&fd).map_err(fail)?;
        settings.make_raw();
        settings.control_modes |= ControlModes::CREAD | ControlModes::CLOCAL;
        settings.set_speed(spec.baud).map_err(fail)?;
        tcsetattr(&fd, OptionalActions::Now, &settings).map_err(fail)?;
        // Data that waited in the kernel is older than this opening.
        tcflush(&fd, QueueSelector::IFlush).map_err(fail)?;
        Ok(Self { fd, shown, words: Words::new(specs) })
    }

    pub(super) fn drain(&mut self, report: &mut dyn FnMut(usize, bool)) -> Result<(), String> {
        self.words.begin(report);
        let mut bytes = [0; 256];
        // A flooded port must not delay the thread at the end of the run.
        for _ in 0..MOST_READS {
            match rustix::io::read(&self.fd, &mut bytes) {
                Ok(0) => return Err(format!("{} is not plugged in", self.shown)),
                Ok(count) => self.words.feed(bytes.get(..count).unwrap_or_default(), report),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Ok(()),
                Err(error) => return Err(not_opened(&self.shown, "dialout", &error.into())),
            }
        }
        Ok(())
    }

    /// Why it is silent, and what was received nevertheless.
    pub(super) fn why_silent(&mut self) -> String {
        let silence = self.silence().unwrap_or_default();
        let on = self.words.all.first().map_or("", |word| word.on.as_str());
        match std::mem::take(&mut self.words.unused) {
            0 => format!("nothing was received for {silence:?}"),
            bytes => format!(
                "no line {on:?} for {silence:?}, though {bytes} bytes came: check `baud`, and that lines end with \\n"
            ),
        }
    }

    pub(super) fn silence(&self) -> Option<Duration> {
        self.words.all.iter().find_map(|word| word.silence)
    }
}

impl AsFd for Lines {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

/// From bytes to levels.
#[derive(Debug)]
struct Words {
    all: Vec<LineInput>,
    line: Vec<u8>,
    /// The line began before the port was opened, or is too long.
    is_part: bool,
    is_first: bool,
    has_begun: bool,
    /// Bytes since the last meaningful line.
    unused: u64,
}

impl Words {
    fn new(specs: &[LineInput]) -> Self {
        Self {
            all: specs.to_vec(),
            line: Vec::with_capacity(LONGEST),
            is_part: specs.iter().any(|spec| spec.silence.is_some()),
            is_first: true,
            has_begun: false,
            unused: 0,
        }
    }

    /// Reports the level at the opening, where it is known.
    fn begin(&mut self, report: &mut dyn FnMut(usize, bool)) {
        if std::mem::replace(&mut self.has_begun, true) {
            return;
        }
        for (which, _) in self.all.iter().enumerate().filter(|(_, word)| word.silence.is_none()) {
            report(which, false);
        }
    }

    fn feed(&mut self, bytes: &[u8], report: &mut dyn FnMut(usize, bool)) {
        for byte in bytes {
            self.unused += 1;
            match byte {
                b'\n' => self.end_line(report),
                _ if self.line.len() == LONGEST => self.is_part = true,
                _ => self.line.push(*byte),
            }
        }
    }

    fn end_line(&mut self, report: &mut dyn FnMut(usize, bool)) {
        let line = if self.is_part { None } else { Some(self.line.trim_ascii()) };
        for (which, word) in self.all.iter().enumerate() {
            let is_on = line == Some(word.on.as_bytes());
            let is_off = match &word.off {
                LineOff::Line(off) => line == Some(off.as_bytes()),
                LineOff::Others => !is_on && !self.is_first,
                LineOff::AtOnce => is_on,
            };
            if is_on {
                report(which, true);
            }
            if is_off {
                report(which, false);
            }
            if is_on || is_off {
                self.unused = 0;
            }
        }
        self.line.clear();
        (self.is_part, self.is_first) = (false, false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(on: &str, off: LineOff, silence: Option<Duration>) -> LineInput {
        LineInput { path: "/dev/null".into(), baud: 9600, on: on.to_owned(), off, silence }
    }

    /// The levels that follow from `bytes`: `+` on, `-` off, after the number of the input unless that is 0.
    fn levels(specs: &[LineInput], bytes: &[u8]) -> String {
        // Regardless of how it is split.
        let mut all = [1, 2, 7, 4096].map(|size| {
            let (mut words, mut levels) = (Words::new(specs), String::new());
            let mut report = |which: usize, is_on| {
                levels += if which == 0 { "" } else { ["1", "2"][which - 1] };
                levels.push(if is_on { '+' } else { '-' });
            };
            words.begin(&mut report);
            for piece in bytes.chunks(size) {
                words.begin(&mut report);
                words.feed(piece, &mut report);
            }
            levels
        });
        assert!(all.iter().all(|one| *one == all[0]), "{all:?}");
        std::mem::take(&mut all[0])
    }

    #[test]
    fn of_repeated_lines_all_others_or_one_mean_off() {
        let long = [b"\n", &[b'R'; 500][..], b"RUN\nRUN\n"].concat();
        let silence = Some(Duration::from_millis(100));
        for (bytes, others, stop) in [
            (&b"RUN\nRUN\nRUN\n"[..], "++", "++"),
            (b"UN\r\nRUN\r\nRUN\n", "++", "++"),
            (b"\nRUN\nSTOP\nRUN\n", "+-+", "+-+"),
            (b"\nRUN \n run\nRUNRUN\n\nRU", "+---", "+"),
            (b"\nR\xffN\nRUN", "-", ""),
            (&long, "-+", "+"),
        ] {
            assert_eq!(levels(&[spec("RUN", LineOff::Others, silence)], bytes), others, "{}", bytes.escape_ascii());
            let one = spec("RUN", LineOff::Line("STOP".to_owned()), silence);
            assert_eq!(levels(&[one], bytes), stop, "{}", bytes.escape_ascii());
        }
    }

    #[test]
    fn lines_at_changes_count_from_the_first_byte_and_begin_off() {
        let specs = [
            spec("start", LineOff::AtOnce, None),
            spec("down", LineOff::Line("up".to_owned()), None),
            spec("stop", LineOff::AtOnce, None),
        ];
        for (bytes, expected) in [
            (&b""[..], "-1-2-"),
            (b"start\nstart\r\n", "-1-2-+-+-"),
            (b"restart\nstop\nstar", "-1-2-2+2-"),
            (b"down\ndown\nstart\nup\nup\n", "-1-2-1+1++-1-1-"),
        ] {
            assert_eq!(levels(&specs, bytes), expected, "{}", bytes.escape_ascii());
        }
    }
}
