//! The last line: the keys, or a question or message of the program.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::model::{Model, Quit};
use super::theme::Theme;
use crate::status::SlotState;
use crate::text;

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let message = match model.quit {
        Quit::Asked => Some("recording: q again to finish the episode and quit, any other key to continue".to_owned()),
        Quit::Ending if model.is_recording() => Some("finishing the episode, then quitting".to_owned()),
        Quit::Ending => Some("quitting".to_owned()),
        Quit::No => model.notice().map(|notice| theme.safe(notice)),
    };
    let line = match message {
        Some(message) => {
            let message = text::cut(&message, usize::from(area.width).saturating_sub(2), theme.ellipsis()).into_owned();
            Line::styled(format!(" {message}"), theme.warning())
        }
        None => keys(usize::from(area.width), model, theme),
    };
    frame.render_widget(line, area);
}

/// As many keys as fit, the most used first; `?` and `q` always.
fn keys(width: usize, model: &Model, theme: Theme) -> Line<'static> {
    let episode = if model.is_recording() { "end episode" } else { "start episode" };
    let failed = model.selected_device().is_some_and(|device| device.state == SlotState::Failed);
    let mut keys = vec![("space", episode), (theme.symbol("↑↓", "up/dn"), "select")];
    if failed {
        keys.push(("r", "restart"));
    }
    keys.extend([("p", if model.is_paused() { "continue" } else { "pause" }), ("pgup/pgdn", "log")]);
    let last = [("?", "help"), ("q", "quit")];
    let columns = |(key, meaning): (&str, &str)| text::width(key) + text::width(meaning) + 4;
    let mut room = width.saturating_sub(last.iter().map(|key| columns(*key)).sum::<usize>() + 1);
    let mut spans = vec![Span::raw(" ")];
    for key in keys {
        let Some(left) = room.checked_sub(columns(key)) else { break };
        room = left;
        push(&mut spans, key, theme);
    }
    for key in last {
        push(&mut spans, key, theme);
    }
    Line::from(spans)
}

fn push(spans: &mut Vec<Span<'static>>, (key, meaning): (&'static str, &'static str), theme: Theme) {
    spans.push(Span::styled(key, theme.title()));
    spans.push(Span::styled(format!(" {meaning}   "), theme.faint()));
}
