//! The terminal: switched to raw mode for the screen, and restored afterwards.
//!
//! A panic anywhere while the screen is up would write its message into the picture, and a panic that a
//! supervisor recovers from must not end the picture. So messages of panics are kept, and printed once the
//! terminal is restored.

use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::os::fd::{AsFd as _, BorrowedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crossterm::cursor::{Hide, Show};
use crossterm::event::{
    DisableBracketedPaste, DisableMouseCapture, EnableBracketedPaste, EnableMouseCapture, Event, KeyCode, KeyModifiers,
};
use crossterm::terminal::{
    Clear, ClearType, DisableLineWrap, EnableLineWrap, EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode,
    enable_raw_mode,
};
use futures::{Stream, StreamExt as _};
use rapid_system::outlet::Outlet;
use rapid_system::panics;
use ratatui::Terminal;
use ratatui::backend::CrosstermBackend;
use rustix::event::{PollFd, PollFlags, Timespec};
use rustix::io::Errno;
use tokio::sync::Notify;

use super::model::Model;
use super::picture::Canvas;
use super::theme::Theme;
use super::view;

/// How long a blocked terminal may take for the last frame before it is abandoned.
const LAST_FRAME: Duration = Duration::from_millis(500);

static UP: AtomicBool = AtomicBool::new(false);

/// The terminal while it shows the monitor.
pub(super) struct Screen {
    terminal: Terminal<CrosstermBackend<Frame>>,
    frame: Frame,
    outlet: Option<Outlet>,
    /// How often the bell has rung.
    rung: u64,
    canvas: Canvas,
    mouse: bool,
}

impl Screen {
    /// Switches the terminal to the screen.
    pub(super) fn open(mouse: bool) -> io::Result<Self> {
        if !io::stdout().is_terminal() {
            return Err(io::Error::other("standard output is not a terminal"));
        }
        let outlet = Outlet::new("screen", 1, io::stdout())?;
        enter_raw_mode()?;
        let frame = Frame::default();
        let outlet = Some(outlet);
        let canvas = Canvas::detect(|name| std::env::var(name).ok(), cell(), places_pictures_in_text);
        let mut screen = match Terminal::new(CrosstermBackend::new(frame.clone())) {
            Ok(terminal) => Self { terminal, frame, outlet, rung: 0, canvas, mouse },
            Err(error) => {
                restore();
                return Err(error);
            }
        };
        screen.enter()?;
        Ok(screen)
    }

    fn enter(&mut self) -> io::Result<()> {
        if self.mouse {
            crossterm::queue!(self.frame, EnableMouseCapture)?;
        }
        // Pasted text is marked, so it is not read as keys.
        crossterm::queue!(self.frame, EnterAlternateScreen, DisableLineWrap, Hide, EnableBracketedPaste)
    }

    /// Takes the terminal again after the process was stopped: the shell has used it meanwhile. One in the background is left
    /// alone, because setting its modes from there stops the process; the shell continues it again in the foreground.
    pub(super) fn resume(&mut self) -> io::Result<()> {
        if !in_foreground() {
            return Ok(());
        }
        disable_raw_mode()?;
        enable_raw_mode()?;
        self.enter()?;
        self.clear()
    }

    /// Clears the screen: the next frame is compared with an empty one. `Terminal::clear` would wait for the terminal to
    /// report its cursor.
    fn clear(&mut self) -> io::Result<()> {
        crossterm::queue!(self.frame, Clear(ClearType::All))?;
        self.terminal.swap_buffers();
        Ok(())
    }

    /// Notified when the terminal has accepted a frame.
    pub(super) fn room(&self) -> Arc<Notify> {
        self.outlet.as_ref().map(Outlet::room).unwrap_or_default()
    }

    /// Draws the model, unless the terminal has not yet accepted the previous frame: then it returns false.
    pub(super) fn draw(&mut self, model: &Model, theme: Theme) -> io::Result<bool> {
        if !self.outlet.as_ref().is_some_and(Outlet::is_idle) {
            return Ok(false);
        }
        // In the background the terminal is the shell's.
        if !in_foreground() {
            return Ok(true);
        }
        self.canvas.begin_frame();
        self.terminal.draw(|frame| view::draw(frame, model, theme, &mut self.canvas))?;
        if self.canvas.leaves_a_trace() {
            self.frame.take();
            self.clear()?;
            self.terminal.draw(|frame| view::draw(frame, model, theme, &mut self.canvas))?;
        }
        // With the picture: what is not drawn because the terminal is blocked rings with the next.
        if std::mem::replace(&mut self.rung, model.rings()) != model.rings() {
            self.frame.write_all(b"\x07")?;
        }
        let bytes = self.frame.take();
        let Some(outlet) = &self.outlet else { return Ok(false) };
        if outlet.is_closed() {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        // There is space: this is the only sender.
        let _ = outlet.try_send(bytes);
        Ok(true)
    }

    /// Restores the terminal after the last frame.
    pub(super) async fn close(mut self) {
        if let Some(outlet) = self.outlet.take() {
            // The terminal is restored even if this fails.
            let _ = outlet.finish(LAST_FRAME).await;
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        if let Some(outlet) = self.outlet.take() {
            outlet.drain(LAST_FRAME);
        }
        restore();
    }
}

/// Whether the terminal is this job's. True where there are no jobs.
fn in_foreground() -> bool {
    rustix::termios::tcgetpgrp(io::stdout()).map_or(true, |group| group == rustix::process::getpgrp())
}

/// Pixels of a cell, if the terminal reports them.
fn cell() -> Option<(u16, u16)> {
    let size = crossterm::terminal::window_size().ok()?;
    let of_cell = |pixels: u16, cells: u16| pixels.checked_div(cells).filter(|pixels| *pixels > 0);
    Some((of_cell(size.width, size.columns)?, of_cell(size.height, size.rows)?))
}

/// How long the first frame waits for the answer. One that comes later is left out of the keys, see [`without_answers`].
const ANSWER: Duration = Duration::from_millis(300);
/// Its name and version (XTVERSION), and its attributes (DA1), which every terminal answers: the end of the answers.
const NAME_AND_ATTRIBUTES: &[u8] = b"\x1b[>q\x1b[c";

/// Whether the terminal draws pictures in the place of text, by its version. Keys that are pressed meanwhile are lost.
fn places_pictures_in_text() -> bool {
    let (mut answer, end) = (Vec::new(), Instant::now() + ANSWER);
    let mut terminal = io::stdout();
    if terminal.write_all(NAME_AND_ATTRIBUTES).and_then(|()| terminal.flush()).is_err() {
        return false;
    }
    while !is_answered(&answer) {
        let left = end.saturating_duration_since(Instant::now());
        // So short a time has this form.
        let limit = Timespec::try_from(left).unwrap_or_default();
        let input = rustix::stdio::stdin();
        let mut bytes = [0; 256];
        match rustix::event::poll(&mut [PollFd::new(&input, PollFlags::IN)], Some(&limit)) {
            Ok(1..) => match rustix::io::read(input, &mut bytes) {
                Ok(count @ 1..) => answer.extend_from_slice(bytes.get(..count).unwrap_or_default()),
                _ => return false,
            },
            Err(Errno::INTR) => {}
            _ => return false,
        }
    }
    has_placeholders(&String::from_utf8_lossy(&answer))
}

/// Leaves the answer to [`NAME_AND_ATTRIBUTES`] out, if it comes when nothing waits for it any more: crossterm reads
/// `ESC P > | ... ESC \` as Alt+P, letters and Alt+\. (It takes the attributes for what they are.)
pub(super) fn without_answers(events: impl Stream<Item = io::Result<Event>>) -> impl Stream<Item = io::Result<Event>> {
    /// More letters than a name and a version have: what follows is typed.
    const LONGEST: u8 = 64;
    let mut left = 0_u8;
    events.filter(move |event| {
        let key = match event {
            Ok(Event::Key(key)) => Some(key),
            _ => None,
        };
        let is_alt = |letter| {
            key.is_some_and(|key| key.code == KeyCode::Char(letter) && key.modifiers.contains(KeyModifiers::ALT))
        };
        let is_answer = key.is_some() && left > 0;
        left = if is_alt('P') {
            LONGEST
        } else if is_alt('\\') {
            0
        } else {
            left.saturating_sub(u8::from(is_answer))
        };
        std::future::ready(!is_answer && left == 0 || key.is_none())
    })
}

/// Whether the attributes have arrived: `ESC [ ? 62 ; 22 c`.
fn is_answered(answer: &[u8]) -> bool {
    let Some(begin) = answer.windows(3).position(|three| three == b"\x1b[?") else { return false };
    answer.iter().skip(begin).any(|byte| *byte == b'c')
}

/// Whether a terminal with this answer has the placeholders of kitty's graphics: `ESC P > | kitty(0.35.2) ESC \`. Other
/// terminals with that protocol have had them from the beginning.
fn has_placeholders(answer: &str) -> bool {
    let Some(name) = answer.split("\x1bP>|").nth(1) else { return false };
    let Some(version) = name.strip_prefix("kitty(") else { return true };
    let mut numbers = version.split(['.', ')']).map_while(|number| number.parse::<u32>().ok());
    (numbers.next(), numbers.next()) >= (Some(0), Some(28))
}

/// A writer to the terminal: standard output or, if that is redirected, the controlling terminal.
pub(super) fn writer() -> io::Result<Box<dyn Write>> {
    if io::stdout().is_terminal() {
        return Ok(Box::new(io::stdout()));
    }
    Ok(Box::new(controlling()?))
}

fn controlling() -> io::Result<File> {
    File::options().read(true).write(true).open("/dev/tty")
}

/// Switches the terminal to raw mode, until [`restore`].
pub(super) fn enter_raw_mode() -> io::Result<()> {
    enable_raw_mode()?;
    panics::keep();
    UP.store(true, Ordering::SeqCst);
    Ok(())
}

/// Restores the terminal and prints the messages that were kept. Errors are ignored: there is no terminal
/// left to report them on.
pub(super) fn restore() {
    if !UP.swap(false, Ordering::SeqCst) {
        return;
    }
    let (done, is_done) = mpsc::channel();
    let leave = move || {
        if let Ok(mut terminal) = writer() {
            let _ = crossterm::execute!(
                terminal,
                DisableMouseCapture,
                DisableBracketedPaste,
                EnableLineWrap,
                LeaveAlternateScreen,
                Show
            );
        }
        let _ = done.send(());
    };
    let left = std::thread::Builder::new().name("screen".to_owned()).spawn(leave).is_ok()
        && is_sent(&is_done, LAST_FRAME / LOOKS, accepts);
    let _ = disable_raw_mode();
    let messages = panics::release();
    if left {
        for message in messages {
            let _ = writeln!(io::stderr(), "{message}");
        }
    }
}

/// How many looks at a terminal [`LAST_FRAME`] is divided into.
const LOOKS: u32 = 5;

/// Waits until it is sent; false once the terminal has accepted nothing in [`LOOKS`] consecutive looks, one `every` so long: the
/// program exits anyway. A terminal that accepts bytes is waited for: on a busy machine the thread has not run yet, and the
/// messages printed afterwards are the only report of what happened.
fn is_sent(done: &mpsc::Receiver<()>, every: Duration, accepts: impl Fn() -> bool) -> bool {
    let mut refused = 0;
    while refused < LOOKS {
        match done.recv_timeout(every) {
            Ok(()) => return true,
            // A write in progress refuses others, too.
            Err(RecvTimeoutError::Timeout) => refused = if accepts() { 0 } else { refused + 1 },
            Err(RecvTimeoutError::Disconnected) => return false,
        }
    }
    false
}

/// Whether the terminal accepts bytes now: not while it is stopped or full, or a write waits for that to end.
fn accepts() -> bool {
    let is_ready = |terminal: BorrowedFd<'_>| {
        let now = Timespec::default();
        matches!(rustix::event::poll(&mut [PollFd::from_borrowed_fd(terminal, PollFlags::OUT)], Some(&now)), Ok(1..))
    };
    if io::stdout().is_terminal() {
        return is_ready(io::stdout().as_fd());
    }
    controlling().is_ok_and(|terminal| is_ready(terminal.as_fd()))
}

/// The bytes of the frame being drawn.
#[derive(Debug, Clone, Default)]
struct Frame(Arc<Mutex<Vec<u8>>>);

impl Frame {
    fn take(&self) -> Vec<u8> {
        std::mem::take(&mut lock(&self.0))
    }
}

impl Write for Frame {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        lock(&self.0).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A poisoned lock here guards complete values: continue with them.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use crossterm::event::KeyEvent;

    use super::*;

    #[tokio::test]
    async fn a_late_answer_is_not_typed() {
        let key = |letter: char, modifiers| Ok(Event::Key(KeyEvent::new(KeyCode::Char(letter), modifiers)));
        let plain = |text: &str| text.chars().map(|letter| key(letter, KeyModifiers::NONE)).collect::<Vec<_>>();
        let alt = |letter| [key(letter, KeyModifiers::ALT)];
        let typed = |events: Vec<io::Result<Event>>| async {
            let letter = |event: io::Result<Event>| match event.unwrap() {
                Event::Key(key) => key.code.as_char().unwrap(),
                _ => '*',
            };
            without_answers(futures::stream::iter(events)).map(letter).collect::<String>().await
        };
        let mut answered = plain("ab");
        answered.extend(alt('P'));
        answered.extend(plain(">|kitty(0.35"));
        answered.push(Ok(Event::FocusGained));
        answered.extend(plain(".2)"));
        answered.extend(alt('\\'));
        answered.extend(plain("itq"));
        assert_eq!(typed(answered).await, "ab*itq");
        // Who presses Alt+P is not locked out.
        let pressed = alt('P').into_iter().chain(plain(&"x".repeat(70))).collect();
        assert_eq!(typed(pressed).await.len(), 6);
    }

    #[test]
    fn a_terminal_that_accepts_bytes_is_waited_for_and_no_other() {
        let (done, is_done) = mpsc::channel();
        let looked = std::cell::Cell::new(0);
        // Accepts in every fifth look until the one of this number, in which `then` happens.
        let sent = |last: u32, then: &dyn Fn()| {
            looked.set(0);
            is_sent(&is_done, Duration::from_millis(1), || {
                looked.set(looked.get() + 1);
                if looked.get() == last {
                    then();
                }
                looked.get() <= last && looked.get().is_multiple_of(LOOKS)
            })
        };
        assert!(sent(20, &|| done.send(()).unwrap()), "late");
        assert_eq!(looked.get(), 20);
        assert!(!sent(20, &|| ()), "stopped in between");
        assert_eq!(looked.get(), 20 + LOOKS);
    }

    #[test]
    fn an_old_kitty_shows_no_pictures_among_text() {
        for (answer, expected) in [
            ("\x1bP>|kitty(0.26.5)\x1b\\\x1b[?62;c", false),
            ("\x1bP>|kitty(0.27.9)\x1b\\\x1b[?62;c", false),
            ("\x1bP>|kitty(0.28.0)\x1b\\\x1b[?62;c", true),
            ("j\x1bP>|kitty(0.35.2)\x1b\\\x1b[?62;c", true),
            ("\x1bP>|kitty(1.0)\x1b\\\x1b[?62;c", true),
            ("\x1bP>|ghostty 1.1.3\x1b\\\x1b[?62;22c", true),
            ("\x1bP>|kitty(\x1b\\\x1b[?62;c", false),
            ("\x1b[?62;c", false),
            ("", false),
        ] {
            assert_eq!(has_placeholders(answer), expected, "{answer:?}");
            assert_eq!(is_answered(answer.as_bytes()), !answer.is_empty(), "{answer:?}");
        }
        assert!(!is_answered(b"\x1bP>|kitty(0.35.2)\x1b\\\x1b[?6"), "the c of its name is not the end");
    }
}
