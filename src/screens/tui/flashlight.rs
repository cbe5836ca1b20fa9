//! The whole terminal as a light: white or black.
//!
//! Invariant: the terminal is restored to its previous state, however this ends.

use std::io::{self, Write};
use std::time::Duration;

use crossterm::cursor::{Hide, MoveTo};
use crossterm::event::{Event, KeyCode, KeyModifiers, poll, read};
use crossterm::style::{Color, Print, ResetColor, SetBackgroundColor, SetForegroundColor};
use crossterm::terminal::{
    BeginSynchronizedUpdate, DisableLineWrap, EndSynchronizedUpdate, EnterAlternateScreen, size,
};
use rapid_core::text;

use super::terminal::{enter_raw_mode, restore, writer};

/// The terminal used as a light.
pub struct Flashlight {
    terminal: Box<dyn Write>,
    lit: bool,
}

/// Whether there is a terminal to use as a light.
pub fn is_available() -> bool {
    writer().is_ok()
}

impl Flashlight {
    /// Switches the terminal to black.
    ///
    /// # Errors
    /// When there is none, or it cannot be written to.
    pub fn open() -> io::Result<Self> {
        let terminal = writer()?;
        enter_raw_mode()?;
        let mut light = Self { terminal, lit: false };
        crossterm::execute!(light.terminal, EnterAlternateScreen, DisableLineWrap, Hide)?;
        light.switch(false, "")?;
        Ok(light)
    }

    /// Makes it white or black, with a line of text at the bottom. When this returns, the terminal has
    /// received the bytes; how soon it shows them is unknown.
    ///
    /// # Errors
    /// When the terminal cannot be written to.
    pub fn switch(&mut self, lit: bool, line: &str) -> io::Result<()> {
        self.lit = lit;
        let (columns, rows) = size()?;
        let mut bytes = Vec::with_capacity((usize::from(columns) + 8) * usize::from(rows) + 128);
        crossterm::queue!(bytes, BeginSynchronizedUpdate)?;
        colours(&mut bytes, lit)?;
        // Spaces are printed: not every terminal clears in the colour that is set.
        let blank = " ".repeat(usize::from(columns));
        for row in 0..rows {
            crossterm::queue!(bytes, MoveTo(0, row), Print(&blank))?;
        }
        self.put(&mut bytes, line, (columns, rows))?;
        self.write(&bytes)
    }

    /// Writes another line of text at the bottom.
    ///
    /// # Errors
    /// When the terminal cannot be written to.
    pub fn caption(&mut self, line: &str) -> io::Result<()> {
        let mut bytes = Vec::new();
        crossterm::queue!(bytes, BeginSynchronizedUpdate)?;
        colours(&mut bytes, self.lit)?;
        self.put(&mut bytes, line, size()?)?;
        self.write(&bytes)
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.terminal.write_all(bytes)?;
        self.terminal.flush()
    }

    fn put(&self, bytes: &mut Vec<u8>, line: &str, (columns, rows): (u16, u16)) -> io::Result<()> {
        let grey = SetForegroundColor(if self.lit { Color::DarkGrey } else { Color::Grey });
        let place = MoveTo(0, rows.saturating_sub(1));
        let line = text::left(line, usize::from(columns), "…");
        crossterm::queue!(bytes, grey, place, Print(line), ResetColor, EndSynchronizedUpdate)
    }

    /// Waits up to `wait` for the user to end it: ctrl-C, q or Esc.
    ///
    /// # Errors
    /// When the terminal is gone.
    pub fn is_ended_within(&mut self, wait: Duration) -> io::Result<bool> {
        if !poll(wait)? {
            return Ok(false);
        }
        let Event::Key(key) = read()? else { return Ok(false) };
        let interrupt = key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL);
        Ok(interrupt || matches!(key.code, KeyCode::Char('q') | KeyCode::Esc))
    }
}

impl Drop for Flashlight {
    fn drop(&mut self) {
        restore();
    }
}

/// White or black as well as the terminal can: one that does not support a colour keeps the previous one.
fn colours(bytes: &mut Vec<u8>, lit: bool) -> io::Result<()> {
    let (plain, level) = if lit { (Color::White, 255) } else { (Color::Black, 0) };
    let exact = Color::Rgb { r: level, g: level, b: level };
    crossterm::queue!(bytes, SetBackgroundColor(plain), SetBackgroundColor(exact))
}
