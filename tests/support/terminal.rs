//! A pseudo-terminal for one test.

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::process::{Child, Command};
use std::time::Instant;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{PATIENCE, Place};

/// A terminal with `rapid` in its own session on it.
pub(crate) struct OnTerminal {
    /// Output of the terminal; closing it closes the terminal.
    pub(crate) master: Option<OwnedFd>,
    pub(crate) child: Child,
}

impl OnTerminal {
    /// `fault` is the value of `RAPID_FAULT`.
    pub(crate) fn start(place: &Place, arguments: &[&str], fault: &str) -> Self {
        Self::start_in(place, arguments, &[("RAPID_FAULT", fault)])
    }

    /// With these variables, and none of those that decide about colours besides them.
    pub(crate) fn start_in(place: &Place, arguments: &[&str], environment: &[(&str, &str)]) -> Self {
        use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("terminal");
        grantpt(&master).expect("terminal");
        unlockpt(&master).expect("terminal");
        let size = rustix::termios::Winsize { ws_row: 40, ws_col: 120, ws_xpixel: 0, ws_ypixel: 0 };
        rustix::termios::tcsetwinsize(&master, size).expect("its size");
        let name = ptsname(&master, Vec::new()).expect("its name").into_string().expect("text");
        let open = || File::options().read(true).write(true).open(&name).expect("its other end");
        let command = place.command(arguments);
        let mut session = Command::new("setsid");
        session.arg("--ctty").arg(command.get_program()).args(command.get_args());
        session
            .current_dir(place.folder.path())
            .env("HOME", place.folder.path())
            .env("RAPID_INSTANCE", &place.instance)
            .env("TERM", "xterm")
            .env_remove("NO_COLOR")
            .env_remove("CLICOLOR")
            .env_remove("CLICOLOR_FORCE")
            .envs(environment.iter().copied());
        let child = session.stdin(open()).stdout(open()).stderr(open()).spawn().expect("setsid runs rapid");
        Self { master: Some(master), child }
    }

    /// Reads the output until this appears, and returns it.
    pub(crate) fn read_until(&mut self, word: &str) -> String {
        let shown = self.read(word, |shown| shown.contains(word));
        assert!(shown.contains(word), "it ended without {word:?}: {shown}");
        shown
    }

    /// Reads the output until the program has ended, and returns it.
    pub(crate) fn read_to_end(&mut self) -> String {
        self.read("the end of the program", |_| false)
    }

    /// Until what was read is enough, or the other end has been closed, by all who had it.
    fn read(&mut self, what: &str, is_enough: impl Fn(&str) -> bool) -> String {
        let mut file = File::from(self.master.as_ref().expect("open").try_clone().expect("clone"));
        let (mut shown, mut piece) = (Vec::new(), [0; 4096]);
        let begun = Instant::now();
        loop {
            let text = String::from_utf8_lossy(&shown);
            if is_enough(&text) {
                return text.into_owned();
            }
            // A monitor draws all the time: the limit is not one of silence.
            assert!(begun.elapsed() < PATIENCE, "{what}: not met in time: {text}");
            let second = Timespec { tv_sec: 1, tv_nsec: 0 };
            if poll(&mut [PollFd::new(&file, PollFlags::IN)], Some(&second)).expect("output") == 0 {
                continue;
            }
            match file.read(&mut piece) {
                Ok(count) => shown.extend_from_slice(&piece[..count]),
                Err(error) if error.raw_os_error() == Some(rustix::io::Errno::IO.raw_os_error()) => {
                    return text.into_owned();
                }
                Err(error) => panic!("output: {error}"),
            }
        }
    }

    /// Types this.
    pub(crate) fn type_in(&self, text: &str) {
        let mut file = File::from(self.master.as_ref().expect("open").try_clone().expect("clone"));
        file.write_all(text.as_bytes()).expect("input");
    }

    /// Whether the terminal echoes typed text. It does not while a program uses it in raw mode.
    pub(crate) fn echoes(&self) -> bool {
        use rustix::termios::{LocalModes, tcgetattr};
        let master = self.master.as_ref().expect("open");
        tcgetattr(master).expect("modes").local_modes.contains(LocalModes::ECHO)
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
