//! The palette: how words are highlighted, in printed lines and in the monitor.
//!
//! Invariant: a meaning has its style here and nowhere else. Only the 16 colours that the user's own terminal theme
//! defines, so that dark and light terminals both read well.

use std::io::IsTerminal;

use anstyle::{AnsiColor, Color, Style};

use crate::{DeviceState, Grade, Level};

/// Something good.
pub const GOOD: Style = AnsiColor::Green.on_default();
/// Something that needs attention.
pub const WARN: Style = AnsiColor::Yellow.on_default();
/// Something wrong.
pub const BAD: Style = AnsiColor::Red.on_default().bold();
/// Something secondary.
pub const FAINT: Style = Style::new().dimmed();
/// A name or a heading.
pub const BOLD: Style = Style::new().bold();
/// A row of a QR code: white on black, whatever the colours of the terminal are, because a camera reads it.
pub const CODE: Style =
    Style::new().fg_color(Some(Color::Ansi(AnsiColor::BrightWhite))).bg_color(Some(Color::Ansi(AnsiColor::Black)));

/// The style of a state.
pub const fn of_state(state: DeviceState) -> Style {
    match state {
        DeviceState::Streaming => GOOD,
        DeviceState::Opening | DeviceState::Backoff => WARN,
        DeviceState::Stalled => AnsiColor::Magenta.on_default(),
        DeviceState::Absent => AnsiColor::Red.on_default(),
        DeviceState::Failed => BAD,
    }
}

/// The style of a severity.
pub const fn of_level(level: Level) -> Style {
    match level {
        Level::Debug => FAINT,
        Level::Info => Style::new(),
        Level::Warn => WARN,
        Level::Error => BAD,
    }
}

/// The style of a verdict.
pub const fn of_grade(grade: Grade) -> Style {
    match grade {
        Grade::Good => GOOD,
        Grade::Suspect => WARN,
        Grade::Bad => BAD,
    }
}

/// Whether words are highlighted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Palette {
    /// With ANSI escape sequences, the 16 colours.
    Ansi,
    /// No highlighting.
    #[default]
    Plain,
}

impl Palette {
    /// The palette for `out` in the environment of this process, by the conventions of <https://no-color.org> and
    /// <https://bixense.com/clicolors>: `NO_COLOR` takes precedence over `CLICOLOR_FORCE`, that over `CLICOLOR=0`, and
    /// that over the terminal, which must not be `TERM=dumb` or without a `TERM`.
    pub fn for_output(out: &impl IsTerminal) -> Self {
        let can_show = || out.is_terminal() && anstyle_query::term_supports_ansi_color();
        // anstyle-query takes `0` as a request too.
        let is_forced = std::env::var_os("CLICOLOR_FORCE").is_some_and(|value| !value.is_empty() && value != "0");
        let shown = is_forced || (anstyle_query::clicolor() != Some(false) && can_show());
        if shown && !anstyle_query::no_color() { Self::Ansi } else { Self::Plain }
    }

    /// `text` as something good.
    pub fn good(self, text: &str) -> String {
        self.paint(GOOD, text)
    }

    /// `text` as something that needs attention.
    pub fn warn(self, text: &str) -> String {
        self.paint(WARN, text)
    }

    /// `text` as something wrong.
    pub fn bad(self, text: &str) -> String {
        self.paint(BAD, text)
    }

    /// `text` as something secondary.
    pub fn faint(self, text: &str) -> String {
        self.paint(FAINT, text)
    }

    /// `text` as a name or a heading.
    pub fn bold(self, text: &str) -> String {
        self.paint(BOLD, text)
    }

    /// `text` as a row of a QR code.
    pub fn code(self, text: &str) -> String {
        self.paint(CODE, text)
    }

    /// `text` in the style of a state.
    pub fn state(self, state: DeviceState, text: &str) -> String {
        self.paint(of_state(state), text)
    }

    /// `text` in the style of a severity.
    pub fn level(self, level: Level, text: &str) -> String {
        self.paint(of_level(level), text)
    }

    /// `text` in the style of a verdict.
    pub fn grade(self, grade: Grade, text: &str) -> String {
        self.paint(of_grade(grade), text)
    }

    fn paint(self, style: Style, text: &str) -> String {
        match self {
            Self::Ansi if !text.is_empty() => format!("{style}{text}{style:#}"),
            _ => text.to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_highlighted_only_with_ansi() {
        for (shown, expected) in [
            (Palette::Ansi.good("yes"), "\x1b[32myes\x1b[0m"),
            (Palette::Ansi.bad("no"), "\x1b[1m\x1b[31mno\x1b[0m"),
            (Palette::Ansi.code("█"), "\x1b[97m\x1b[40m█\x1b[0m"),
            (Palette::Ansi.level(Level::Info, "line"), "line"),
            (Palette::Ansi.bad(""), ""),
            (Palette::Plain.bad("no"), "no"),
        ] {
            assert_eq!(shown, expected);
        }
    }
}
