//! The last line: the keys, or a question or message of the program.

use rapid_core::text;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::keys;
use super::model::{Model, Quit};
use super::theme::Theme;

/// Columns that a question leaves for its answer.
const ROOM: usize = 20;

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let message = match model.quit {
        Quit::Asked => Some("recording: q again to finish the episode and quit, any other key to continue".to_owned()),
        Quit::Ending if model.is_recording() => Some("finishing the episode, then quitting".to_owned()),
        Quit::Ending => Some("quitting".to_owned()),
        Quit::No => model.notice().map(|notice| theme.safe(notice)),
    };
    if let Some((question, text)) = model.prompt().filter(|_| model.quit == Quit::No) {
        let question =
            text::cut(&theme.safe(&question), usize::from(area.width).saturating_sub(ROOM), theme.ellipsis())
                .into_owned();
        return prompt(frame, area, &question, &theme.safe(text), theme);
    }
    let line = match message {
        Some(message) => {
            let message = text::cut(&message, usize::from(area.width).saturating_sub(2), theme.ellipsis()).into_owned();
            Line::styled(format!(" {message}"), theme.warning())
        }
        None => match model
            .tour
            .and_then(|tour| tour.text(model.latest(), model.selected_device().map(|device| &*device.name)))
        {
            Some(step) => {
                let step = text::cut(&theme.safe(&step), usize::from(area.width).saturating_sub(2), theme.ellipsis())
                    .into_owned();
                Line::styled(format!(" {step}"), theme.title())
            }
            None => keys(usize::from(area.width), model, theme),
        },
    };
    frame.render_widget(line, area);
}

/// The question, and the end of what is typed.
fn prompt(frame: &mut Frame<'_>, area: Rect, question: &str, text: &str, theme: Theme) {
    let room = usize::from(area.width).saturating_sub(text::width(question) + 2);
    let mut from = 0;
    while text::width(text.get(from..).unwrap_or_default()) > room {
        from += text.get(from..).and_then(|rest| rest.chars().next()).map_or(1, char::len_utf8);
    }
    let cursor = Span::styled(theme.symbol("█", "_"), theme.warning());
    let typed = Span::raw(text.get(from..).unwrap_or_default().to_owned());
    frame.render_widget(Line::from(vec![Span::styled(format!(" {question}"), theme.warning()), typed, cursor]), area);
}

/// As many keys as fit, the most used before others; `?` and `q` always.
fn keys(width: usize, model: &Model, theme: Theme) -> Line<'static> {
    let mut keys = keys::footer(model);
    let last = keys.split_off(keys.len().saturating_sub(2));
    let columns = |(key, meaning): (&str, &str)| text::width(key) + text::width(meaning) + 3;
    let mut room = width.saturating_sub(last.iter().map(|key| columns(*key)).sum::<usize>() + 1);
    let mut spans = vec![Span::raw(" ")];
    for key in keys {
        let Some(left) = room.checked_sub(columns(key)) else { continue };
        room = left;
        push(&mut spans, key, theme);
    }
    for key in last {
        push(&mut spans, key, theme);
    }
    Line::from(spans)
}

fn push(spans: &mut Vec<Span<'static>>, (key, meaning): (&'static str, &'static str), theme: Theme) {
    spans.push(Span::styled(key.replace(", ", "/"), theme.title()));
    spans.push(Span::styled(format!(" {meaning}  "), theme.faint()));
}
