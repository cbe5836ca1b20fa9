//! The help: all keys on two pages, and the meaning of the states.

use rapid_status::DeviceState;
use ratatui::Frame;
use ratatui::layout::{Constraint, Flex, Layout, Rect};
use ratatui::style::Modifier;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Clear, Padding, Paragraph};

use super::keys;
use super::link::LinkState;
use super::model::Model;
use super::theme::Theme;

pub(super) const PAGES: usize = 2;
/// Width of the box with its border and padding.
const WIDTH: u16 = 58;
const STATES: [(DeviceState, &str); 6] = [
    (DeviceState::Streaming, "samples arrive; bit set"),
    (DeviceState::Stalled, "attached, samples have stopped; bit set"),
    (DeviceState::Opening, "attached, waiting for the first sample"),
    (DeviceState::Backoff, "attached, waiting to be restarted"),
    (DeviceState::Failed, "attached, given up: replug it or press r"),
    (DeviceState::Absent, "not attached"),
];

/// The lines of a page, from 1: keys about episodes and motion, then keys about the screen, and the states.
fn lines(page: usize, is_attached: bool, theme: Theme) -> Vec<Line<'static>> {
    let row = |(key, meaning): (&'static str, &'static str)| {
        Line::from(vec![Span::styled(format!("{key:<12}"), theme.title()), Span::raw(meaning)])
    };
    let last = ("q, ctrl-c", "leave; the run continues, and stays armed");
    let keys = keys::help(page == 1).map(|shown| row(if is_attached && shown.0 == last.0 { last } else { shown }));
    if page == 1 {
        return keys.collect();
    }
    let states = STATES.iter().map(|(state, meaning)| {
        let word = format!("{} {:<10}", theme.state_symbol(*state), state.word());
        Line::from(vec![Span::styled(word, theme.state(*state)), Span::raw(*meaning)])
    });
    keys.chain(states).collect()
}

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, page: usize, model: &Model, theme: Theme) {
    let lines = lines(page, model.link != LinkState::Own, theme);
    let height = u16::try_from(lines.len()).unwrap_or(u16::MAX).saturating_add(2).min(area.height);
    let [middle] = Layout::vertical([Constraint::Length(height)]).flex(Flex::Center).areas(area);
    let [middle] = Layout::horizontal([Constraint::Length(WIDTH)]).flex(Flex::Center).areas(middle);
    let title = match page {
        1 if model.is_read_only() => " Keys: episodes and motion: off, this is read-only ",
        1 => " Keys: episodes and motion (? shows the others) ",
        _ => " Keys: the screen; states ",
    };
    let block = Block::bordered()
        .border_set(theme.border())
        .border_style(theme.faint())
        .title(Span::styled(title, theme.title().remove_modifier(Modifier::DIM)))
        .padding(Padding::horizontal(1));
    frame.render_widget(Clear, middle);
    frame.render_widget(Paragraph::new(lines).block(block), middle);
}

#[cfg(test)]
mod tests {
    use rapid_status::palette::Palette;

    use super::*;
    use crate::tui::theme::Charset;

    const THEME: Theme = Theme { palette: Palette::Plain, charset: Charset::Unicode };

    /// On 80x24 every key is in the help.
    #[test]
    fn no_key_is_cut() {
        let shown: usize = (1..=PAGES).map(|page| lines(page, true, THEME).len()).sum();
        assert!((1..=PAGES).all(|page| lines(page, true, THEME).len() + 2 <= 24));
        assert_eq!(shown, keys::help(true).count() + keys::help(false).count() + STATES.len());
    }

    #[test]
    fn no_line_is_cut() {
        let longest = (1..=PAGES).flat_map(|page| lines(page, true, THEME)).map(|line| line.width()).max();
        assert!(longest.expect("lines") <= usize::from(WIDTH) - 4);
    }
}
