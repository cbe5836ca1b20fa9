//! The palette: how printed lines highlight words.

use std::io::IsTerminal;

use crate::status::{Grade, Level, SlotState};

/// Ways to highlight a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Palette {
    /// ANSI escape sequences, the 16 colours.
    Ansi,
    /// No highlighting.
    #[default]
    Plain,
}

impl Palette {
    /// The palette for `out` in the environment of this process.
    pub fn of(out: &impl IsTerminal) -> Self {
        Self::detect(out.is_terminal(), |name| std::env::var(name).ok())
    }

    /// The palette for a terminal, or for a file or a pipe. `CLICOLOR_FORCE` and `NO_COLOR` as on
    /// <https://bixense.com/clicolors> and <https://no-color.org>; `NO_COLOR` takes precedence.
    pub fn detect(is_terminal: bool, variable: impl Fn(&str) -> Option<String>) -> Self {
        let set = |name: &str| variable(name).filter(|value| !value.is_empty());
        let forced = set("CLICOLOR_FORCE").is_some_and(|value| value != "0");
        let can_show = is_terminal && set("TERM").is_none_or(|term| term != "dumb");
        if set("NO_COLOR").is_none() && (forced || can_show) { Self::Ansi } else { Self::Plain }
    }

    /// `text` as something good.
    pub fn good(self, text: &str) -> String {
        self.wrap("32", text)
    }

    /// `text` as something that needs attention.
    pub fn warn(self, text: &str) -> String {
        self.wrap("33", text)
    }

    /// `text` as something wrong.
    pub fn bad(self, text: &str) -> String {
        self.wrap("1;31", text)
    }

    /// `text` as something secondary.
    pub fn faint(self, text: &str) -> String {
        self.wrap("2", text)
    }

    /// `text` as a name or a heading.
    pub fn bold(self, text: &str) -> String {
        self.wrap("1", text)
    }

    /// `text` as a row of a QR code: white on black, whatever the colours of the terminal are.
    pub fn code(self, text: &str) -> String {
        self.wrap("97;40", text)
    }

    /// `text` in the colour of a state.
    pub fn state(self, state: SlotState, text: &str) -> String {
        match state {
            SlotState::Streaming => self.good(text),
            SlotState::Opening | SlotState::Backoff => self.warn(text),
            SlotState::Stalled => self.wrap("35", text),
            SlotState::Absent => self.wrap("31", text),
            SlotState::Failed => self.bad(text),
        }
    }

    /// `text` in the colour of a severity.
    pub fn level(self, level: Level, text: &str) -> String {
        match level {
            Level::Debug => self.faint(text),
            Level::Info => text.to_owned(),
            Level::Warn => self.warn(text),
            Level::Error => self.bad(text),
        }
    }

    /// `text` in the colour of a verdict.
    pub fn grade(self, grade: Grade, text: &str) -> String {
        match grade {
            Grade::Good => self.good(text),
            Grade::Suspect => self.warn(text),
            Grade::Bad => self.bad(text),
        }
    }

    fn wrap(self, code: &str, text: &str) -> String {
        match self {
            Self::Ansi if !text.is_empty() => format!("\x1b[{code}m{text}\x1b[0m"),
            _ => text.to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Environment = &'static [(&'static str, &'static str)];

    #[test]
    fn environment_and_terminal_decide_in_this_order() {
        let table: [(bool, Environment, Palette); 7] = [
            (true, &[], Palette::Ansi),
            (false, &[], Palette::Plain),
            (true, &[("NO_COLOR", "1")], Palette::Plain),
            (true, &[("TERM", "dumb")], Palette::Plain),
            (false, &[("CLICOLOR_FORCE", "1")], Palette::Ansi),
            (false, &[("CLICOLOR_FORCE", "0")], Palette::Plain),
            (false, &[("CLICOLOR_FORCE", "1"), ("NO_COLOR", "1")], Palette::Plain),
        ];
        for (is_terminal, environment, expected) in table {
            let variable =
                |name: &str| environment.iter().find(|(key, _)| *key == name).map(|(_, value)| (*value).to_owned());
            assert_eq!(Palette::detect(is_terminal, variable), expected, "{is_terminal} {environment:?}");
        }
        assert_eq!(Palette::Ansi.bad("no"), "\x1b[1;31mno\x1b[0m");
        assert_eq!(Palette::Plain.bad("no"), "no");
    }
}
