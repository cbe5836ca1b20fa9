//! Colours and symbols, according to what the terminal can show.
//!
//! Only the 16 colours that the user's own terminal theme defines, so that dark and light terminals
//! both read well. Every meaning that has a colour also has a symbol or a word.

use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::border;

use crate::status::{Grade, Level, SlotState};
use crate::text;

/// Can the terminal show colours?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colours {
    /// The 16 colours.
    Sixteen,
    /// None (`NO_COLOR`, or a terminal without).
    None,
}

/// Can the terminal show characters outside ASCII?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Charset {
    /// All of Unicode.
    Unicode,
    /// ASCII only.
    Ascii,
}

/// Colours and characters to draw with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Theme {
    /// Colours.
    pub colours: Colours,
    /// Characters.
    pub charset: Charset,
}

impl Theme {
    /// The theme for the environment: `NO_COLOR` (<https://no-color.org>), `TERM`, and the locale in
    /// `LC_ALL`, `LC_CTYPE` or `LANG`, the first that is set.
    pub fn detect(variable: impl Fn(&str) -> Option<String>) -> Self {
        let set = |name: &str| variable(name).filter(|value| !value.is_empty());
        let term = set("TERM").unwrap_or_default();
        let colours = if set("NO_COLOR").is_some() || term == "dumb" { Colours::None } else { Colours::Sixteen };
        let locale = ["LC_ALL", "LC_CTYPE", "LANG"].into_iter().find_map(set).unwrap_or_default().to_lowercase();
        // The kernel's own console has a font of 256 or 512 glyphs, without most of our symbols.
        let unicode = (locale.contains("utf-8") || locale.contains("utf8")) && term != "linux" && term != "dumb";
        Self { colours, charset: if unicode { Charset::Unicode } else { Charset::Ascii } }
    }

    /// The same meaning in Unicode or ASCII.
    pub fn symbol(self, unicode: &'static str, ascii: &'static str) -> &'static str {
        match self.charset {
            Charset::Unicode => unicode,
            Charset::Ascii => ascii,
        }
    }

    /// The mark at the end of a truncated text.
    pub fn ellipsis(self) -> &'static str {
        self.symbol("…", "~")
    }

    /// Untrusted text as this terminal may show it.
    pub fn safe(self, foreign: &str) -> String {
        let plain = text::plain(foreign);
        match self.charset {
            Charset::Unicode => plain.into_owned(),
            Charset::Ascii => text::ascii(&plain),
        }
    }

    /// Untrusted text in exactly `columns` columns.
    pub fn column(self, foreign: &str, columns: usize) -> String {
        text::left(&self.safe(foreign), columns, self.ellipsis())
    }

    fn colour(self, colour: Color) -> Style {
        match self.colours {
            Colours::Sixteen => Style::new().fg(colour),
            Colours::None => Style::new(),
        }
    }

    /// Labels, rules, secondary text.
    pub fn faint(self) -> Style {
        Style::new().add_modifier(Modifier::DIM)
    }

    /// Names of panels and keys.
    pub fn title(self) -> Style {
        self.colour(Color::Cyan).add_modifier(Modifier::BOLD)
    }

    /// Something that needs the user's attention.
    pub fn warning(self) -> Style {
        self.colour(Color::Yellow).add_modifier(Modifier::BOLD)
    }

    /// Something is wrong.
    pub fn alarm(self) -> Style {
        self.colour(Color::Red).add_modifier(Modifier::BOLD)
    }

    /// Everything is in order.
    pub fn good(self) -> Style {
        self.colour(Color::Green)
    }

    /// A verdict.
    pub fn grade(self, grade: Grade) -> Style {
        match grade {
            Grade::Good => self.good(),
            Grade::Suspect => self.warning(),
            Grade::Bad => self.alarm(),
        }
    }

    /// A state of a slot.
    pub fn state(self, state: SlotState) -> Style {
        match state {
            SlotState::Streaming => self.colour(Color::Green),
            SlotState::Opening | SlotState::Backoff => self.colour(Color::Yellow),
            SlotState::Stalled => self.colour(Color::Magenta),
            SlotState::Absent => self.colour(Color::Red),
            SlotState::Failed => self.alarm(),
        }
    }

    /// The symbol of a state, one column.
    pub fn state_symbol(self, state: SlotState) -> &'static str {
        match state {
            SlotState::Streaming => self.symbol("●", "*"),
            SlotState::Opening => self.symbol("◐", "~"),
            SlotState::Backoff => self.symbol("◌", ":"),
            SlotState::Stalled => self.symbol("◆", "!"),
            SlotState::Absent => self.symbol("○", "-"),
            SlotState::Failed => self.symbol("✕", "X"),
        }
    }

    /// A cell of the mask.
    pub fn mask_cell(self, present: bool, edge: Edge) -> Style {
        let filled = match (present, edge) {
            (_, Edge::Recent) => Some(if present { Color::LightYellow } else { Color::LightRed }),
            (true, Edge::None) => Some(Color::Green),
            (false, Edge::None) => None,
        };
        match (filled, self.colours) {
            (None, _) => self.faint(),
            (Some(colour), Colours::Sixteen) => Style::new().fg(Color::Black).bg(colour),
            (Some(_), Colours::None) if edge == Edge::Recent && !present => {
                Style::new().add_modifier(Modifier::UNDERLINED)
            }
            (Some(_), Colours::None) => Style::new().add_modifier(Modifier::REVERSED),
        }
    }

    /// A line of the log.
    pub fn level(self, level: Level) -> Style {
        match level {
            Level::Debug => self.faint(),
            Level::Info => Style::new(),
            Level::Warn => self.colour(Color::Yellow),
            Level::Error => self.alarm(),
        }
    }

    /// Lines of a box.
    pub fn border(self) -> border::Set<'static> {
        match self.charset {
            Charset::Unicode => border::ROUNDED,
            Charset::Ascii => border::Set {
                top_left: "+",
                top_right: "+",
                bottom_left: "+",
                bottom_right: "+",
                vertical_left: "|",
                vertical_right: "|",
                horizontal_top: "-",
                horizontal_bottom: "-",
            },
        }
    }
}

/// Whether a bit of the mask changed within the last second.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Edge {
    /// No.
    None,
    /// Yes.
    Recent,
}

#[cfg(test)]
mod tests {
    use super::*;

    type Environment = &'static [(&'static str, &'static str)];

    #[test]
    fn the_environment_decides() {
        use {
            Charset::{Ascii, Unicode},
            Colours::{None, Sixteen},
        };
        let table: [(Environment, Colours, Charset); 7] = [
            (&[], Sixteen, Ascii),
            (&[("LANG", "en_US.UTF-8"), ("TERM", "xterm")], Sixteen, Unicode),
            (&[("LANG", "C.utf8")], Sixteen, Unicode),
            (&[("LANG", "en_US.UTF-8"), ("LC_ALL", "C")], Sixteen, Ascii),
            (&[("LANG", "en_US.UTF-8"), ("NO_COLOR", "1")], None, Unicode),
            (&[("LANG", "en_US.UTF-8"), ("NO_COLOR", "")], Sixteen, Unicode),
            (&[("LANG", "en_US.UTF-8"), ("TERM", "linux")], Sixteen, Ascii),
        ];
        for (environment, colours, charset) in table {
            let theme = Theme::detect(|name| {
                environment.iter().find(|(key, _)| *key == name).map(|(_, value)| (*value).to_owned())
            });
            assert_eq!(theme, Theme { colours, charset }, "{environment:?}");
        }
    }
}
