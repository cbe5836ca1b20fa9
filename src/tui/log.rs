//! The log panel: the newest lines, or those the user scrolled back to.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::model::Model;
use super::theme::Theme;
use super::view;
use crate::status::LogLine;
use crate::text;
use crate::time::{Zone, realtime_ns};

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let log = &model.shown().log;
    let rows = usize::from(area.height.saturating_sub(1));
    // Scrolled back to the start, the panel is still full.
    let scroll = model.scroll.min(log.len().saturating_sub(rows));
    let remark = if scroll > 0 {
        Span::styled(format!("{scroll} newer below"), theme.warning())
    } else {
        let newest = log.last().map_or_else(realtime_ns, |line| line.wall_ns);
        Span::styled(format!("times in {}", theme.safe(&model.zone.name(newest))), theme.faint())
    };
    let inner = view::panel(frame, area, "Log", remark.into(), theme);
    let end = log.len().saturating_sub(scroll);
    let shown = log.get(end.saturating_sub(rows)..end).unwrap_or_default();
    for (line, row) in shown.iter().zip(inner.rows()) {
        frame.render_widget(render(line, row.width, &model.zone, theme), row);
    }
    if log.is_empty()
        && let Some(row) = inner.rows().next()
    {
        frame.render_widget(Line::styled("nothing yet", theme.faint()), row);
    }
}

fn render(line: &LogLine, width: u16, zone: &Zone, theme: Theme) -> Line<'static> {
    let time = zone.time_of_day(line.wall_ns);
    let room = usize::from(width).saturating_sub(time.len() + 8);
    let text = text::cut(&theme.safe(&line.text), room, theme.ellipsis()).into_owned();
    Line::from(vec![
        Span::styled(time, theme.faint()),
        Span::styled(format!("  {:5} ", line.level.word()), theme.level(line.level)),
        Span::styled(text, theme.level(line.level)),
    ])
}
