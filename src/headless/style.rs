//! Colour in printed lines: whether, and which.

use crate::status::{Grade, Level, SlotState};

/// What the user chose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ColourChoice {
    /// By the environment and by where the output goes.
    #[default]
    Auto,
    /// Always.
    Always,
    /// Never.
    Never,
}

impl ColourChoice {
    /// Are colours to be printed? `CLICOLOR_FORCE` and `NO_COLOR` as on <https://bixense.com/clicolors>
    /// and <https://no-color.org>; the user's own choice comes first, then `NO_COLOR`.
    #[must_use]
    pub fn resolve(self, terminal: Terminal, variable: impl Fn(&str) -> Option<String>) -> Palette {
        let set = |name: &str| variable(name).is_some_and(|value| !value.is_empty());
        let forced = || set("CLICOLOR_FORCE") && variable("CLICOLOR_FORCE").is_none_or(|value| value != "0");
        let dumb = || variable("TERM").is_some_and(|term| term == "dumb");
        let coloured = match self {
            Self::Always => true,
            Self::Never => false,
            Self::Auto if set("NO_COLOR") => false,
            Self::Auto => forced() || (terminal == Terminal::Yes && !dumb()),
        };
        if coloured { Palette::Ansi } else { Palette::Plain }
    }
}

/// Does the output go to a terminal?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Terminal {
    /// Yes.
    Yes,
    /// To a file or a pipe.
    No,
}

impl Terminal {
    /// Where `out` goes.
    #[must_use]
    pub fn of(out: &impl std::io::IsTerminal) -> Self {
        if out.is_terminal() { Self::Yes } else { Self::No }
    }
}

/// Ways to set off a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Palette {
    /// ANSI escape sequences, the 16 colours.
    Ansi,
    /// The word as it is.
    Plain,
}

impl Palette {
    /// `text` as something good.
    #[must_use]
    pub fn good(self, text: &str) -> String {
        self.wrap("32", text)
    }

    /// `text` as something to look at.
    #[must_use]
    pub fn warn(self, text: &str) -> String {
        self.wrap("33", text)
    }

    /// `text` as something wrong.
    #[must_use]
    pub fn bad(self, text: &str) -> String {
        self.wrap("1;31", text)
    }

    /// `text` as something beside the point.
    #[must_use]
    pub fn faint(self, text: &str) -> String {
        self.wrap("2", text)
    }

    /// `text` as a name or a heading.
    #[must_use]
    pub fn bold(self, text: &str) -> String {
        self.wrap("1", text)
    }

    /// `text` in the colour of a state.
    #[must_use]
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
    #[must_use]
    pub fn level(self, level: Level, text: &str) -> String {
        match level {
            Level::Debug => self.faint(text),
            Level::Info => text.to_owned(),
            Level::Warn => self.warn(text),
            Level::Error => self.bad(text),
        }
    }

    /// `text` in the colour of a verdict.
    #[must_use]
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
    fn choice_environment_and_terminal_decide_in_this_order() {
        use ColourChoice::{Always, Auto, Never};
        let table: [(ColourChoice, Terminal, Environment, Palette); 9] = [
            (Auto, Terminal::Yes, &[], Palette::Ansi),
            (Auto, Terminal::No, &[], Palette::Plain),
            (Auto, Terminal::Yes, &[("NO_COLOR", "1")], Palette::Plain),
            (Auto, Terminal::Yes, &[("TERM", "dumb")], Palette::Plain),
            (Auto, Terminal::No, &[("CLICOLOR_FORCE", "1")], Palette::Ansi),
            (Auto, Terminal::No, &[("CLICOLOR_FORCE", "0")], Palette::Plain),
            (Auto, Terminal::No, &[("CLICOLOR_FORCE", "1"), ("NO_COLOR", "1")], Palette::Plain),
            (Always, Terminal::No, &[("NO_COLOR", "1")], Palette::Ansi),
            (Never, Terminal::Yes, &[("CLICOLOR_FORCE", "1")], Palette::Plain),
        ];
        for (choice, terminal, environment, expected) in table {
            let variable =
                |name: &str| environment.iter().find(|(key, _)| *key == name).map(|(_, value)| (*value).to_owned());
            assert_eq!(choice.resolve(terminal, variable), expected, "{choice:?} {terminal:?} {environment:?}");
        }
        assert_eq!(Palette::Ansi.bad("no"), "\x1b[1;31mno\x1b[0m");
        assert_eq!(Palette::Plain.bad("no"), "no");
    }
}
