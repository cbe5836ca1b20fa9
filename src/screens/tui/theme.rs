//! Colours and symbols, according to what the terminal can show.
//!
//! The styles are those of [`rapid_status::palette`]; what only the monitor shows is added here. Every meaning that has a colour
//! also has a symbol or a word.

use rapid_core::text;
use rapid_status::palette::{self, Palette};
use rapid_status::{DeviceState, Grade, Level};
use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::border;

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
    /// Whether there are colours. Without them letters are still bold, faint, underlined or reversed.
    pub palette: Palette,
    /// Characters.
    pub charset: Charset,
}

impl Theme {
    /// The theme with `palette` for the environment: `TERM`, and the locale in `LC_ALL`, `LC_CTYPE` or `LANG`, the first
    /// that is set.
    pub fn detect(palette: Palette, variable: impl Fn(&str) -> Option<String>) -> Self {
        let set = |name: &str| variable(name).filter(|value| !value.is_empty());
        let term = set("TERM").unwrap_or_default();
        let locale = ["LC_ALL", "LC_CTYPE", "LANG"].into_iter().find_map(set).unwrap_or_default().to_lowercase();
        // The kernel's own console has a font of 256 or 512 glyphs, without most of our symbols.
        let unicode = (locale.contains("utf-8") || locale.contains("utf8")) && term != "linux" && term != "dumb";
        Self { palette, charset: if unicode { Charset::Unicode } else { Charset::Ascii } }
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

    /// `style` as far as there are colours.
    fn style(self, style: anstyle::Style) -> Style {
        match self.palette {
            Palette::Ansi => style.into(),
            Palette::Plain => style.fg_color(None).bg_color(None).into(),
        }
    }

    /// Labels, rules, secondary text.
    pub fn faint(self) -> Style {
        self.style(palette::FAINT)
    }

    /// Names of panels and keys.
    pub fn title(self) -> Style {
        self.style(anstyle::AnsiColor::Cyan.on_default().bold())
    }

    /// Something that needs the user's attention.
    pub fn warning(self) -> Style {
        self.style(palette::WARN.bold())
    }

    /// Something is wrong.
    pub fn alarm(self) -> Style {
        self.style(palette::BAD)
    }

    /// Everything is in order.
    pub fn good(self) -> Style {
        self.style(palette::GOOD)
    }

    /// A row of a QR code.
    pub fn code(self) -> Style {
        self.style(palette::CODE)
    }

    /// A verdict.
    pub fn grade(self, grade: Grade) -> Style {
        match grade {
            Grade::Suspect => self.warning(),
            Grade::Good | Grade::Bad => self.style(palette::of_grade(grade)),
        }
    }

    /// A state of a device.
    pub fn state(self, state: DeviceState) -> Style {
        self.style(palette::of_state(state))
    }

    /// The symbol of a state, one column.
    pub fn state_symbol(self, state: DeviceState) -> &'static str {
        match state {
            DeviceState::Streaming => self.symbol("●", "*"),
            DeviceState::Opening => self.symbol("◐", "~"),
            DeviceState::Backoff => self.symbol("◌", ":"),
            DeviceState::Stalled => self.symbol("◆", "!"),
            DeviceState::Absent => self.symbol("○", "-"),
            DeviceState::Failed => self.symbol("✕", "X"),
        }
    }

    /// A cell of the mask.
    pub fn mask_cell(self, present: bool, edge: Edge) -> Style {
        let filled = match (present, edge) {
            (_, Edge::Recent) => Some(if present { Color::LightYellow } else { Color::LightRed }),
            (true, Edge::None) => Some(Color::Green),
            (false, Edge::None) => None,
        };
        match (filled, self.palette) {
            (None, _) => self.faint(),
            (Some(colour), Palette::Ansi) => Style::new().fg(Color::Black).bg(colour),
            (Some(_), Palette::Plain) if edge == Edge::Recent && !present => {
                Style::new().add_modifier(Modifier::UNDERLINED)
            }
            (Some(_), Palette::Plain) => Style::new().add_modifier(Modifier::REVERSED),
        }
    }

    /// A line of the log.
    pub fn level(self, level: Level) -> Style {
        self.style(palette::of_level(level))
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
        use Charset::{Ascii, Unicode};
        let table: [(Environment, Charset); 6] = [
            (&[], Ascii),
            (&[("LANG", "en_US.UTF-8"), ("TERM", "xterm")], Unicode),
            (&[("LANG", "C.utf8")], Unicode),
            (&[("LANG", "en_US.UTF-8"), ("LC_ALL", "C")], Ascii),
            (&[("LANG", "en_US.UTF-8"), ("TERM", "linux")], Ascii),
            (&[("LANG", "en_US.UTF-8"), ("TERM", "dumb")], Ascii),
        ];
        for (environment, charset) in table {
            let variable =
                |name: &str| environment.iter().find(|(key, _)| *key == name).map(|(_, value)| (*value).to_owned());
            for palette in [Palette::Ansi, Palette::Plain] {
                assert_eq!(Theme::detect(palette, variable), Theme { palette, charset }, "{environment:?}");
            }
        }
    }

    #[test]
    fn without_colours_the_other_differences_stay() {
        let [coloured, plain] =
            [Palette::Ansi, Palette::Plain].map(|palette| Theme { palette, charset: Charset::Ascii });
        let bold = Style::new().add_modifier(Modifier::BOLD);
        assert_eq!((coloured.alarm(), plain.alarm()), (bold.fg(Color::Red), bold));
        assert_eq!((coloured.code(), plain.code()), (Style::new().fg(Color::White).bg(Color::Black), Style::new()));
        let absent = DeviceState::Absent;
        assert_eq!((coloured.state(absent), plain.state(absent)), (Style::new().fg(Color::Red), Style::new()));
    }
}
