//! The help: all keys, and the meaning of the states.

use ratatui::Frame;
use ratatui::layout::{Constraint, Flex, Layout, Rect};
use ratatui::style::Modifier;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Clear, Padding, Paragraph};

use super::keys;
use super::theme::Theme;
use crate::status::SlotState;

/// Width of the box with its border and padding.
const WIDTH: u16 = 58;
const STATES: [(SlotState, &str); 6] = [
    (SlotState::Streaming, "samples arrive; bit set"),
    (SlotState::Stalled, "attached, samples have stopped; bit set"),
    (SlotState::Opening, "attached, waiting for the first sample"),
    (SlotState::Backoff, "attached, waiting to be restarted"),
    (SlotState::Failed, "attached, given up: replug it or press r"),
    (SlotState::Absent, "not attached"),
];

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, theme: Theme) {
    let keys = keys::help()
        .map(|(key, meaning)| Line::from(vec![Span::styled(format!("{key:<12}"), theme.title()), Span::raw(meaning)]));
    let states = STATES.iter().map(|(state, meaning)| {
        let word = format!("{} {:<10}", theme.state_symbol(*state), state.word());
        Line::from(vec![Span::styled(word, theme.state(*state)), Span::raw(*meaning)])
    });
    let mut lines: Vec<_> = keys.chain(std::iter::once(Line::default())).chain(states).collect();
    let room = usize::from(area.height.saturating_sub(2));
    if lines.len() > room {
        // A low screen shows only the keys.
        lines.truncate(keys::help().count());
    }
    let height = u16::try_from(lines.len()).unwrap_or(u16::MAX).saturating_add(2).min(area.height);
    let [middle] = Layout::vertical([Constraint::Length(height)]).flex(Flex::Center).areas(area);
    let [middle] = Layout::horizontal([Constraint::Length(WIDTH)]).flex(Flex::Center).areas(middle);
    let block = Block::bordered()
        .border_set(theme.border())
        .border_style(theme.faint())
        .title(Span::styled(" Keys and states ", theme.title().remove_modifier(Modifier::DIM)))
        .padding(Padding::horizontal(1));
    frame.render_widget(Clear, middle);
    frame.render_widget(Paragraph::new(lines).block(block), middle);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// On 80x24 every key is in the help.
    #[test]
    fn no_key_is_cut() {
        assert!(keys::help().count() + 2 <= 24);
    }

    #[test]
    fn no_line_is_cut() {
        let longest =
            keys::help().map(|(_, meaning)| meaning.len()).chain(STATES.iter().map(|(_, meaning)| meaning.len()));
        assert!(longest.max().expect("lines") + 12 <= usize::from(WIDTH) - 4);
    }
}
