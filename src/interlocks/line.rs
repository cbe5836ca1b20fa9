//! Lines of text on a serial port, sent repeatedly.
//!
//! Invariant: what arrives before the first line end after opening is part of a line and is ignored.
//! Invariant: memory is bounded, whatever the port sends.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;

use rustix::fs::{FlockOperation, Mode, OFlags, flock, open};
use rustix::io::Errno;
use rustix::termios::{ControlModes, OptionalActions, QueueSelector, ioctl_tiocexcl, tcflush, tcgetattr, tcsetattr};

use crate::interlock::InputState;
use crate::registry::LineInput;
use crate::text::not_opened;

/// Longest line that is evaluated; a longer one cannot be one of the meaningful lines.
const LONGEST: usize = 128;

/// Most reads in a row.
const MOST_READS: usize = 64;

/// An open port.
#[derive(Debug)]
pub(super) struct Line {
    fd: OwnedFd,
    shown: String,
    words: Words,
}

impl Line {
    /// Opens the port exclusively, 8 bits without parity.
    pub(super) fn open(spec: &LineInput) -> Result<Self, String> {
        let shown = spec.path.display().to_string();
        let fail = |error: Errno| not_opened(&shown, "dialout", &error.into());
        let flags = OFlags::RDONLY | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let fd = open(&spec.path, flags, Mode::empty()).map_err(fail)?;
        flock(&fd, FlockOperation::NonBlockingLockExclusive).map_err(fail)?;
        ioctl_tiocexcl(&fd).map_err(fail)?;
        let mut settings = tcgetattr(&fd).map_err(fail)?;
        settings.make_raw();
        settings.control_modes |= ControlModes::CREAD | ControlModes::CLOCAL;
        settings.set_speed(spec.baud).map_err(fail)?;
        tcsetattr(&fd, OptionalActions::Now, &settings).map_err(fail)?;
        // Data that waited in the kernel is older than this opening.
        tcflush(&fd, QueueSelector::IFlush).map_err(fail)?;
        Ok(Self { fd, shown, words: Words::new(spec) })
    }

    pub(super) fn take(&mut self, report: &mut dyn FnMut(InputState)) -> Result<(), String> {
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
        let Words { run, silence, unused, .. } = &mut self.words;
        match std::mem::take(unused) {
            0 => format!("nothing was received for {silence:?}"),
            bytes => format!(
                "no line {run:?} for {silence:?}, though {bytes} bytes came: check `baud`, and that lines end with \\n"
            ),
        }
    }

    pub(super) const fn silence(&self) -> Duration {
        self.words.silence
    }
}

impl AsFd for Line {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

/// From bytes to states.
#[derive(Debug)]
struct Words {
    run: String,
    stop: Option<String>,
    silence: Duration,
    line: Vec<u8>,
    /// The line began before the port was opened, or is too long.
    is_part: bool,
    is_first: bool,
    /// Bytes since the last meaningful line.
    unused: u64,
}

impl Words {
    fn new(spec: &LineInput) -> Self {
        Self {
            run: spec.run.clone(),
            stop: spec.stop.clone(),
            silence: spec.silence,
            line: Vec::with_capacity(LONGEST),
            is_part: true,
            is_first: true,
            unused: 0,
        }
    }

    fn feed(&mut self, bytes: &[u8], report: &mut dyn FnMut(InputState)) {
        for byte in bytes {
            self.unused += 1;
            match byte {
                b'\n' => {
                    let line = if self.is_part { None } else { Some(self.line.trim_ascii()) };
                    let is_run = line == Some(self.run.as_bytes());
                    let is_stop = match &self.stop {
                        Some(stop) => line == Some(stop.as_bytes()),
                        None => !is_run && !self.is_first,
                    };
                    if is_run || is_stop {
                        self.unused = 0;
                        report(if is_run { InputState::Runs } else { InputState::Stopped });
                    }
                    self.line.clear();
                    (self.is_part, self.is_first) = (false, false);
                }
                _ if self.line.len() == LONGEST => self.is_part = true,
                _ => self.line.push(*byte),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn states(stop: Option<&str>, bytes: &[u8]) -> String {
        let spec = LineInput {
            path: "/dev/null".into(),
            baud: 9600,
            run: "RUN".to_owned(),
            stop: stop.map(str::to_owned),
            silence: Duration::from_millis(100),
        };
        // Regardless of how it is split.
        let mut all = [1, 2, 7, 4096].map(|size| {
            let (mut words, mut states) = (Words::new(&spec), String::new());
            for piece in bytes.chunks(size) {
                words.feed(piece, &mut |state| {
                    states.push(match state {
                        InputState::Runs => 'r',
                        InputState::Stopped => 's',
                        InputState::Lost => 'l',
                    });
                });
            }
            states
        });
        assert!(all.iter().all(|one| *one == all[0]), "{all:?}");
        std::mem::take(&mut all[0])
    }

    #[test]
    fn any_line_but_the_run_line_stops() {
        let long = [b"\n", &[b'R'; 500][..], b"RUN\nRUN\n"].concat();
        for (bytes, all_others, only_stop) in [
            (&b"RUN\nRUN\nRUN\n"[..], "rr", "rr"),
            (b"UN\r\nRUN\r\nRUN\n", "rr", "rr"),
            (b"\nRUN\nSTOP\nRUN\n", "rsr", "rsr"),
            (b"\nRUN \n run\nRUNRUN\n\nRU", "rsss", "r"),
            (b"\nR\xffN\nRUN", "s", ""),
            (&long, "sr", "r"),
        ] {
            assert_eq!(states(None, bytes), all_others, "{}", bytes.escape_ascii());
            assert_eq!(states(Some("STOP"), bytes), only_stop, "{}", bytes.escape_ascii());
        }
    }
}
