//! A program on a pseudo-terminal of its own: what it prints and when, what it costs, and what is typed.
//!
//! Invariant: a program never outlives its handle: dropping it kills the program.

use std::fs::File;
use std::io::{self, Read, Write};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};

use crate::beat;
use crate::{Absent, Failure};

/// Columns and rows of the terminal.
pub(crate) const SIZE: (u16, u16) = (120, 40);
/// Polling interval of its end.
const LOOK: Duration = Duration::from_millis(20);

/// See the module's comment.
#[derive(Debug)]
pub(crate) struct OnTerminal {
    child: Child,
    master: File,
    printed: Receiver<(Instant, Vec<u8>)>,
}

impl OnTerminal {
    /// Starts the program of `command`, with its arguments, in a session of its own on a new terminal.
    ///
    /// # Errors
    /// When there is no terminal, or the program cannot be started.
    pub(crate) fn start(command: &Command) -> Result<Self, Failure> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        tcsetwinsize(&master, Winsize { ws_row: SIZE.1, ws_col: SIZE.0, ws_xpixel: 0, ws_ypixel: 0 })?;
        let path = ptsname(&master, Vec::new())?.into_string()?;
        let end = || File::options().read(true).write(true).open(&path).map(Stdio::from);
        // The size of a terminal is that of the controlling one: without a session it would be that of the bench.
        let mut session = Command::new("setsid");
        session.arg("--ctty").arg(command.get_program()).args(command.get_args());
        session.env("TERM", "xterm-256color").env("LC_ALL", "C.UTF-8").env_remove("NO_COLOR");
        for variable in ["RAPID_PICTURES", "TERM_PROGRAM", "LC_TERMINAL", "KITTY_WINDOW_ID", "TMUX"] {
            session.env_remove(variable);
        }
        let child =
            session.stdin(end()?).stdout(end()?).stderr(end()?).spawn().map_err(|error| match error.kind() {
                io::ErrorKind::NotFound => Failure::from(Absent("setsid: install util-linux".to_owned())),
                _ => error.into(),
            })?;
        let (master, (sender, printed)) = (File::from(master), channel());
        let mut output = master.try_clone()?;
        std::thread::spawn(move || {
            let mut piece = vec![0; 1 << 16];
            // The terminal is gone with the program, which is an error here.
            while let Ok(count @ 1..) = output.read(&mut piece) {
                if sender.send((Instant::now(), piece[..count].to_vec())).is_err() {
                    return;
                }
            }
        });
        Ok(Self { child, master, printed })
    }

    /// Its process.
    pub(crate) fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// Types this; returns when.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub(crate) fn type_in(&mut self, text: &str) -> io::Result<Instant> {
        let now = Instant::now();
        self.master.write_all(text.as_bytes())?;
        Ok(now)
    }

    /// Waits until this is printed, in one run of characters without a change of colour or place; returns when.
    ///
    /// # Errors
    /// When the program ends or `limit` passes before.
    pub(crate) fn await_text(&mut self, text: &str, limit: Duration) -> Result<Instant, Failure> {
        let (deadline, mut shown) = (Instant::now() + limit, Vec::new());
        loop {
            match self.printed.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok((when, piece)) => {
                    let from = shown.len().saturating_sub(text.len());
                    shown.extend(piece);
                    if shown[from..].windows(text.len()).any(|window| window == text.as_bytes()) {
                        return Ok(when);
                    }
                }
                Err(RecvTimeoutError::Timeout) => return Err(format!("{text:?} was not shown within {limit:?}").into()),
                Err(RecvTimeoutError::Disconnected) => {
                    let end = shown.len().saturating_sub(400);
                    return Err(format!("the program ended: {}", String::from_utf8_lossy(&shown[end..])).into());
                }
            }
        }
    }

    /// How many bytes were printed since the last call, or the last that was waited for.
    pub(crate) fn bytes(&mut self) -> u64 {
        self.printed.try_iter().map(|(_, piece)| piece.len() as u64).sum()
    }

    /// Asks the program to end, unless it ends by itself, and waits for it.
    ///
    /// # Errors
    /// When it does not end within `limit`, or ends with an error.
    pub(crate) fn end(mut self, asked: bool, limit: Duration) -> Result<(), Failure> {
        if asked {
            kill_process(self.pid(), Signal::TERM)?;
        }
        let deadline = Instant::now() + limit;
        loop {
            match self.child.try_wait()? {
                // Code 4 means a BAD episode: the section judges its own measurements.
                Some(status) if asked || matches!(status.code(), Some(0 | 4)) => return Ok(()),
                Some(status) => return Err(format!("the program on the terminal ended with {status}").into()),
                None if Instant::now() >= deadline => {
                    return Err(format!("the program on the terminal did not end within {limit:?}").into());
                }
                None => beat::sleep(LOOK),
            }
        }
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_secs(20);

    #[test]
    fn what_is_typed_reaches_the_program_and_what_it_prints_is_seen() {
        let script = "stty size; read line; echo got $line";
        let mut on = OnTerminal::start(Command::new("sh").args(["-c", script])).unwrap();
        on.await_text("40 120", LIMIT).unwrap();
        let typed = on.type_in("this\n").unwrap();
        assert!(on.await_text("got this", LIMIT).unwrap() >= typed);
        on.end(false, LIMIT).unwrap();
    }

    #[test]
    fn a_program_that_ends_or_fails_is_an_error_with_its_last_words() {
        let start = || OnTerminal::start(Command::new("sh").args(["-c", "echo why; exit 3"])).unwrap();
        let error = start().await_text("other", LIMIT).unwrap_err().to_string();
        assert!(error.contains("why"), "{error}");
        assert!(start().end(false, LIMIT).is_err());
    }
}
