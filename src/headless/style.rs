//! Colours of printed lines.

use crate::status::{Grade, Level, SlotState};

/// What the user chose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ColourChoice {
    /// Depending on the environment and on the destination of the output.
    #[default]
    Auto,
    /// Always.
    Always,
    /// Never.
    Never,
}

impl ColourChoice {
    /// Whether colours are printed. `CLICOLOR_FORCE` and `NO_COLOR` as on <https://bixense.com/clicolors> and
    /// <https://no-color.org>; the user's own choice takes precedence, then `NO_COLOR`.
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

/// Whether the output goes to a terminal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Terminal {
    /// Yes.
    Yes,
    /// No: a file or a pipe.
    No,
}

impl Terminal {
    /// The destination of `out`.
    pub fn of(out: &impl std::io::IsTerminal) -> Self {
        if out.is_terminal() { Self::Yes } else { Self::No }
    }
}

/// Ways to highlight a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Palette {
    /// ANSI escape sequences, the 16 colours.
    Ansi,
    /// No highlighting.
    Plain,
}

impl Palette {
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
