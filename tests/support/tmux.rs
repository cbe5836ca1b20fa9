//! Real terminals for one test: a tmux server of its own, whose panes show what a user sees.

use std::path::{Path, PathBuf};
use std::process::Command;

use super::{Place, until};

/// A tmux server with an environment of its own. Dropping it ends the server and whatever runs in its panes.
pub(crate) struct Tmux {
    socket: PathBuf,
    folder: PathBuf,
    environment: Vec<(&'static str, String)>,
}

/// A terminal of a [`Tmux`] with a shell whose prompt is [`PROMPT`].
pub(crate) struct Pane<'a> {
    tmux: &'a Tmux,
    name: String,
}

/// What the shell of a pane prints when it waits for a command.
pub(crate) const PROMPT: &str = "ready>";

impl Tmux {
    /// A server in this place, which stays when its last pane closes.
    pub(crate) fn new(place: &Place) -> Self {
        let version = Command::new("tmux").arg("-V").output();
        assert!(version.is_ok_and(|version| version.status.success()), "there is no tmux: run `make setup`");
        let programs = Path::new(env!("CARGO_BIN_EXE_rapid")).parent().expect("its folder").display();
        let path = std::env::var("PATH").expect("PATH");
        let folder = place.folder.path().to_owned();
        let environment = vec![
            ("PATH", format!("{programs}:{path}")),
            ("HOME", folder.display().to_string()),
            ("LC_ALL", "C.UTF-8".to_owned()),
            ("TZ", "UTC".to_owned()),
            // The variable itself would not do: a shell of root replaces it.
            ("ENV", place.write("shell", &format!("PS1='{PROMPT} '\n")).display().to_string()),
            ("RAPID_INSTANCE", place.instance.clone()),
            // Pictures depend on what the terminal answers; characters do not.
            ("RAPID_PICTURES", "text".to_owned()),
        ];
        let tmux = Self { socket: folder.join("tmux"), folder, environment };
        tmux.run(&["start-server", ";", "set-option", "-g", "exit-empty", "off"]).expect("a server");
        tmux
    }

    /// Runs a command of tmux; returns its output, or its error.
    fn run(&self, words: &[&str]) -> Result<String, String> {
        let mut command = Command::new("tmux");
        command.arg("-S").arg(&self.socket).args(["-f", "/dev/null"]).args(words).current_dir(&self.folder);
        // The server passes the environment of its first client to the panes.
        command.env_clear().envs(self.environment.iter().map(|(name, value)| (*name, value.as_str())));
        let output = command.output().expect("tmux runs");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        if output.status.success() { Ok(text(&output.stdout)) } else { Err(text(&output.stderr)) }
    }

    /// Opens a terminal of so many columns and rows.
    pub(crate) fn pane(&self, name: &str, (columns, rows): (usize, usize)) -> Pane<'_> {
        let (columns, rows) = (columns.to_string(), rows.to_string());
        self.run(&["new-session", "-d", "-s", name, "-x", &columns, "-y", &rows, "sh"]).expect("a pane");
        let pane = Pane { tmux: self, name: name.to_owned() };
        pane.until("the shell is ready", |screen| screen.contains(PROMPT));
        pane
    }
}

impl Drop for Tmux {
    fn drop(&mut self) {
        let _ = self.run(&["kill-server"]);
    }
}

impl Pane<'_> {
    /// What the terminal shows, a line per row, without the spaces at their ends.
    pub(crate) fn screen(&self) -> String {
        self.tmux.run(&["capture-pane", "-p", "-t", &self.name]).unwrap_or_default()
    }

    /// The same with the sequences for colours.
    pub(crate) fn coloured(&self) -> String {
        self.tmux.run(&["capture-pane", "-p", "-e", "-t", &self.name]).unwrap_or_default()
    }

    /// Waits until the screen is like this; returns it.
    pub(crate) fn until(&self, what: &str, holds: impl Fn(&str) -> bool) -> String {
        let mut screen = String::new();
        let seen = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            until(what, || {
                screen = self.screen();
                holds(&screen)
            });
        }));
        assert!(seen.is_ok(), "{what}: not seen in pane {}:\n{screen}", self.name);
        screen
    }

    /// The same; keeps each screen that differs from the one before.
    pub(crate) fn until_seeing(&self, what: &str, seen: &mut Vec<String>, holds: impl Fn(&str) -> bool) {
        let seen = std::cell::RefCell::new(seen);
        self.until(what, |screen| {
            let mut seen = seen.borrow_mut();
            if seen.last().is_none_or(|last| last != screen) {
                seen.push(screen.to_owned());
            }
            holds(screen)
        });
    }

    /// Waits until the screen contains all of these; returns it.
    pub(crate) fn shows(&self, words: &[&str]) -> String {
        self.until(&format!("{words:?}"), |screen| words.iter().all(|word| screen.contains(word)))
    }

    /// Waits until the screen contains this no more; returns it.
    pub(crate) fn hides(&self, word: &str) -> String {
        self.until(&format!("no {word:?}"), |screen| !screen.is_empty() && !screen.contains(word))
    }

    /// Types this text.
    pub(crate) fn type_in(&self, text: &str) {
        self.tmux.run(&["send-keys", "-t", &self.name, "-l", "--", text]).expect("the pane is there");
    }

    /// Presses a key by tmux's name for it: `Enter`, `Escape`, `Left`, `C-c`.
    pub(crate) fn press(&self, key: &str) {
        self.tmux.run(&["send-keys", "-t", &self.name, key]).expect("the pane is there");
    }

    /// Gives the shell a command.
    pub(crate) fn order(&self, command: &str) {
        self.type_in(command);
        self.press("Enter");
    }

    /// Changes the size of the terminal.
    pub(crate) fn resize(&self, (columns, rows): (usize, usize)) {
        let (columns, rows) = (columns.to_string(), rows.to_string());
        self.tmux.run(&["resize-window", "-t", &self.name, "-x", &columns, "-y", &rows]).expect("it is resized");
    }

    /// The process on the terminal: the shell, or what it has been replaced by with `exec`.
    pub(crate) fn process(&self) -> rustix::process::Pid {
        let pid = self.tmux.run(&["display-message", "-p", "-t", &self.name, "#{pane_pid}"]).expect("a pane");
        rustix::process::Pid::from_raw(pid.trim().parse().expect("a number")).expect("a process")
    }

    /// The name of the program that the terminal belongs to at present.
    pub(crate) fn program(&self) -> String {
        let name = self.tmux.run(&["display-message", "-p", "-t", &self.name, "#{pane_current_command}"]);
        name.expect("a pane").trim().to_owned()
    }

    /// Takes the terminal away, as a connection that breaks does.
    pub(crate) fn hang_up(&self) {
        let _ = self.tmux.run(&["kill-session", "-t", &self.name]);
    }

    /// Whether the terminal is still there.
    pub(crate) fn is_open(&self) -> bool {
        self.tmux.run(&["has-session", "-t", &self.name]).is_ok()
    }
}
