//! The log: a panel with the newest lines, or a page of its own.

use rapid_core::text;
use rapid_core::time::realtime_ns;
use rapid_status::{Level, PrintedOn};
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Modifier;
use ratatui::text::{Line, Span};

use super::log_view::{Entry, LogView};
use super::model::Model;
use super::theme::Theme;
use super::view;

/// Columns of the level and of the output that a program printed on.
const LEVEL: usize = 6;

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    draw_view(frame, area, (&model.log, "Log"), model, theme);
}

/// The lines about one device, in a panel of its page.
pub(super) fn draw_device(frame: &mut Frame<'_>, area: Rect, device: &str, model: &Model, theme: Theme) {
    let view = LogView::of_device(device);
    draw_view(frame, area, (&view, "Its log"), model, theme);
}

fn draw_view(frame: &mut Frame<'_>, area: Rect, (view, title): (&LogView, &str), model: &Model, theme: Theme) {
    let log = &model.shown().log;
    let inner = view::panel(frame, area, title, remark(view, model, theme), theme);
    let entries = view.entries(log);
    let mut rows = Vec::new();
    // From the newest back, until the panel is full.
    for entry in entries.iter().rev() {
        let lines = render(entry, usize::from(inner.width), view, model, theme);
        rows.extend(lines.into_iter().rev());
        if rows.len() >= usize::from(inner.height) {
            break;
        }
    }
    rows.truncate(usize::from(inner.height));
    if rows.is_empty() {
        let nothing = if log.is_empty() { "nothing yet" } else { "no line matches" };
        rows.push(Line::styled(nothing, theme.faint()));
    }
    for (line, row) in rows.into_iter().rev().zip(inner.rows()) {
        frame.render_widget(line, row);
    }
}

fn remark(view: &LogView, model: &Model, theme: Theme) -> Line<'static> {
    let log = &model.shown().log;
    let filter = theme.safe(&view.describe());
    let below = view.below(log);
    if below > 0 {
        let filter = if filter.is_empty() { filter } else { format!("{filter}; ") };
        return Span::styled(format!("{filter}{below} newer below"), theme.warning()).into();
    }
    if !filter.is_empty() {
        return Span::styled(filter, theme.warning()).into();
    }
    let newest = log.last().map_or_else(realtime_ns, |line| line.wall_ns);
    Span::styled(format!("times in {}", theme.safe(&model.zone.name(newest))), theme.faint()).into()
}

fn render(entry: &Entry<'_>, width: usize, view: &LogView, model: &Model, theme: Theme) -> Vec<Line<'static>> {
    let line = entry.line;
    let time = model.zone.time_of_day(line.wall_ns);
    let level = match line.printed {
        // A traceback is not a message of rapid, and no greeting either.
        Some(PrintedOn::Stderr) => "stderr",
        Some(PrintedOn::Stdout) => "prints",
        None => line.level.word(),
    };
    let style = if line.printed == Some(PrintedOn::Stderr) { theme.warning() } else { theme.level(line.level) };
    let times = if entry.times > 1 { format!(" ({}{})", theme.symbol("×", "x"), entry.times) } else { String::new() };
    let room = width.saturating_sub(time.len() + LEVEL + 3);
    let text = theme.safe(&line.text);
    let head = vec![Span::styled(time.clone(), theme.faint()), Span::styled(format!("  {level:LEVEL$} "), style)];
    if !view.wraps || text::width(&text) + text::width(&times) <= room {
        let text = text::cut(&text, room.saturating_sub(text::width(&times)), theme.ellipsis()).into_owned();
        return vec![with_text(head, &text, &times, view, line.level, theme)];
    }
    let indent = " ".repeat(time.len() + LEVEL + 3);
    let pieces = wrapped(&(text + &times), room);
    let rows = pieces.iter().enumerate().map(|(place, piece)| {
        let head = if place == 0 { head.clone() } else { vec![Span::raw(indent.clone())] };
        with_text(head, piece, "", view, line.level, theme)
    });
    rows.collect()
}

/// `head`, then the text, in which what is searched for stands out.
fn with_text(
    mut head: Vec<Span<'static>>,
    text: &str,
    times: &str,
    view: &LogView,
    level: Level,
    theme: Theme,
) -> Line<'static> {
    let style = theme.level(level);
    let found = if view.search.is_empty() { None } else { text.to_lowercase().find(&view.search.to_lowercase()) };
    // Lower case may have other lengths: then nothing stands out.
    match found.and_then(|at| {
        Some((text.get(..at)?, text.get(at..at + view.search.len())?, text.get(at + view.search.len()..)?))
    }) {
        Some((before, found, after)) => {
            head.push(Span::styled(before.to_owned(), style));
            head.push(Span::styled(found.to_owned(), style.add_modifier(Modifier::REVERSED)));
            head.push(Span::styled(after.to_owned(), style));
        }
        None => head.push(Span::styled(text.to_owned(), style)),
    }
    head.push(Span::styled(times.to_owned(), theme.warning()));
    Line::from(head)
}

/// The text in rows of at most so many columns, broken at spaces where there are any.
fn wrapped(text: &str, columns: usize) -> Vec<String> {
    let columns = columns.max(8);
    let mut rows = vec![String::new()];
    for word in text.split_inclusive(' ') {
        let last = rows.last().map_or(0, |row| text::width(row));
        if last > 0 && last + text::width(word.trim_end()) > columns {
            rows.push(String::new());
        }
        for c in word.chars() {
            if rows.last().is_some_and(|row| text::width(row) >= columns) && c != ' ' {
                rows.push(String::new());
            }
            if let Some(row) = rows.last_mut() {
                row.push(c);
            }
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_broken_at_spaces_and_within_what_is_too_long() {
        assert_eq!(wrapped("one two three four", 9), ["one two ", "three ", "four"]);
        assert_eq!(wrapped("abcdefghijklmnop x", 8), ["abcdefgh", "ijklmnop ", "x"]);
        assert_eq!(wrapped("", 10), [""]);
    }
}
