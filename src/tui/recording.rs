//! The recording panel: the episode being written, or what the last one was.

use std::path::Path;

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::model::Model;
use super::theme::Theme;
use super::view;
use crate::status::RecordingStatus;
use crate::text;

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let inner = view::panel(frame, area, "Recording", Line::default(), theme);
    let lines = match &model.shown().recording {
        Some(recording) => under_way(recording, inner, model, theme),
        None => idle(inner, model, theme),
    };
    for (line, row) in lines.into_iter().zip(inner.rows()) {
        frame.render_widget(line, row);
    }
}

fn under_way(recording: &RecordingStatus, area: Rect, model: &Model, theme: Theme) -> Vec<Line<'static>> {
    let mut figures = vec![Span::raw(text::clock(recording.elapsed))];
    if let Some(left) = recording.room {
        // In place of what can wait: the line is full.
        let left = format!("{} disk full in {}", theme.symbol("▲", "!"), text::clock(left));
        figures.extend([Span::raw("   "), Span::styled(left, theme.alarm())]);
    } else {
        let messages = Span::raw(recording.messages.to_string());
        figures.extend([Span::styled("   messages ", theme.faint()), messages]);
    }
    figures.extend([
        Span::raw(format!("   {}", text::size(recording.bytes))),
        Span::raw(format!("   {:.1} MB/s", model.totals().recorded / 1e6)),
    ]);
    let dropped = format!("dropped {}", recording.dropped);
    figures.push(Span::raw("   "));
    figures.push(if recording.dropped > 0 {
        Span::styled(format!("{} {dropped}", theme.symbol("▲", "!")), theme.alarm())
    } else {
        Span::styled(dropped, theme.faint())
    });
    let mark = Span::styled(format!("{} REC ", theme.symbol("●", "*")), theme.recording());
    let width = usize::from(area.width);
    if area.height >= 2 {
        let file = file(&recording.file, width.saturating_sub(mark.width()), theme);
        figures.insert(0, Span::raw(" ".repeat(mark.width())));
        return vec![Line::from(vec![mark, Span::raw(file)]), Line::from(figures)];
    }
    let figures = Line::from(figures);
    let room = width.saturating_sub(mark.width() + figures.width() + 3);
    let file = file(&recording.file, room, theme);
    let mut line = Line::from(vec![mark, Span::raw(file), Span::raw("   ")]);
    line.spans.extend(figures.spans);
    vec![line]
}

fn idle(area: Rect, model: &Model, theme: Theme) -> Vec<Line<'static>> {
    let mut first = Line::from(vec![Span::styled("space", theme.title()), Span::raw(" starts an episode")]);
    let Some(last) = &model.shown().last_episode else { return vec![first] };
    let label = Span::styled("last ", theme.faint());
    let width = usize::from(area.width);
    if area.height >= 2 {
        let file = file(last, width.saturating_sub(label.width()), theme);
        return vec![first, Line::from(vec![label, Span::raw(file)])];
    }
    let file = file(last, width.saturating_sub(first.width() + 3 + label.width()), theme);
    first.spans.extend([Span::raw("   "), label, Span::raw(file)]);
    vec![first]
}

/// The path if it fits, otherwise the name of the file.
fn file(path: &Path, columns: usize, theme: Theme) -> String {
    let whole = theme.safe(&path.display().to_string());
    if text::width(&whole) <= columns {
        return whole;
    }
    let name = path.file_name().map(|name| theme.safe(&name.to_string_lossy())).unwrap_or_default();
    text::cut(&name, columns, theme.ellipsis()).into_owned()
}
