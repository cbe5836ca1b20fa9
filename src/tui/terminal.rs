//! The terminal: switched to raw mode for the screen, and restored afterwards.
//!
//! A panic anywhere while the screen is up would write its message into the picture, and a panic that a
//! supervisor recovers from must not end the picture. So messages of panics are kept, and printed once the
//! terminal is restored.

use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::Duration;

use crossterm::cursor::{Hide, Show};
use crossterm::event::{DisableBracketedPaste, DisableMouseCapture, EnableBracketedPaste, EnableMouseCapture};
use crossterm::terminal::{
    Clear, ClearType, DisableLineWrap, EnableLineWrap, EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode,
    enable_raw_mode,
};
use ratatui::Terminal;
use ratatui::backend::CrosstermBackend;
use tokio::sync::Notify;

use super::model::Model;
use super::picture::Canvas;
use super::theme::Theme;
use super::view;
use crate::outlet::Outlet;
use crate::panics;

/// How long a blocked terminal may take for the last frame before it is abandoned.
const LAST_FRAME: Duration = Duration::from_millis(500);

/// The screen is up.
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
        let canvas = Canvas::detect(|name| std::env::var(name).ok(), cell());
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
        if rustix::termios::tcgetpgrp(io::stdout()).ok() != Some(rustix::process::getpgrp()) {
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
            outlet.finish_blocking(LAST_FRAME);
        }
        restore();
    }
}

/// Pixels of a cell, if the terminal reports them.
fn cell() -> Option<(u16, u16)> {
    let size = crossterm::terminal::window_size().ok()?;
    let of_cell = |pixels: u16, cells: u16| pixels.checked_div(cells).filter(|pixels| *pixels > 0);
    Some((of_cell(size.width, size.columns)?, of_cell(size.height, size.rows)?))
}

/// A writer to the terminal: standard output or, if that is redirected, the controlling terminal.
pub(super) fn writer() -> io::Result<Box<dyn Write>> {
    if io::stdout().is_terminal() {
        return Ok(Box::new(io::stdout()));
    }
    Ok(Box::new(File::options().read(true).write(true).open("/dev/tty")?))
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
    // A stopped terminal accepts nothing: the program exits anyway.
    let left = std::thread::Builder::new().name("screen".to_owned()).spawn(leave).is_ok()
        && is_done.recv_timeout(LAST_FRAME).is_ok();
    let _ = disable_raw_mode();
    let messages = panics::release();
    if left {
        for message in messages {
            let _ = writeln!(io::stderr(), "{message}");
        }
    }
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
