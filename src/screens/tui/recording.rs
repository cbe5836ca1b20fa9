//! The recording panel: the episode being written, or the last one and its verdict.

use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_status::session::Phase;
use rapid_status::{RecordingStatus, Verdict};
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::model::Model;
use super::theme::Theme;
use super::view;

/// Columns below which the name of a file is left out.
const FILE_LEAST: usize = 12;

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let inner = view::panel(frame, area, "Recording", remark(model, theme), theme);
    // Also while the view is paused: what is being recorded is not what is being looked at.
    let lines = match &model.latest().recording {
        Some(recording) => in_progress(recording, inner, model, theme),
        None => idle(inner, model, theme),
    };
    for (line, row) in lines.into_iter().zip(inner.rows()) {
        frame.render_widget(line, row);
    }
}

/// How many episodes there are, and for how long there is disk space.
fn remark(model: &Model, theme: Theme) -> Line<'static> {
    let session = model.latest().session.as_ref();
    let progress = session.filter(|session| session.goal.is_some() || session.counted > 0);
    let count = progress.map(|session| match session.goal {
        Some(goal) if model.is_recording() => format!("episode {} of {goal}", session.counted + 1),
        Some(_) => format!("{} episodes", session.progress()),
        None => text::counted(session.counted as u64, "episode"),
    });
    let left = model.disk_left().map(|left| format!("{} of disk left", text::about(left)));
    let parts: Vec<_> = count.into_iter().chain(left).collect();
    Line::styled(parts.join(", "), theme.faint())
}

/// That an episode is being recorded, and since when: `● REC 00:04`.
pub(super) fn mark(recording: &RecordingStatus, theme: Theme) -> String {
    format!("{} REC {}", theme.symbol("●", "*"), text::clock(recording.elapsed))
}

fn in_progress(recording: &RecordingStatus, area: Rect, model: &Model, theme: Theme) -> Vec<Line<'static>> {
    let mut figures = vec![Span::raw(text::clock(recording.elapsed))];
    if let Some(left) = recording.room {
        // Replaces the count of messages: the line is full.
        let left = format!("{} disk full in {}", theme.symbol("▲", "!"), text::clock(left));
        figures.extend([Span::raw("   "), Span::styled(left, theme.alarm())]);
    } else {
        let messages = Span::raw(recording.messages.to_string());
        figures.extend([Span::styled("   messages ", theme.faint()), messages]);
    }
    figures.push(Span::raw(format!("   {}", text::size(recording.bytes))));
    let rate = Span::raw(format!("   {:.1} MB/s", model.totals.recorded / 1e6));
    let dropped = format!("dropped {}", recording.dropped);
    let dropped = if recording.dropped > 0 {
        Span::styled(format!("   {} {dropped}", theme.symbol("▲", "!")), theme.alarm())
    } else {
        Span::styled(format!("   {dropped}"), theme.faint())
    };
    let mark = Span::styled(format!("{} REC ", theme.symbol("●", "*")), theme.alarm());
    let width = usize::from(area.width);
    // What was lost matters more than the rate, and than a piece of a name.
    let used: usize = mark.width() + figures.iter().map(Span::width).sum::<usize>() + dropped.width();
    figures.extend((used + rate.width() <= width).then_some(rate));
    figures.push(dropped);
    if area.height >= 2 {
        figures.insert(0, Span::raw(" ".repeat(mark.width())));
        let mut line = Line::from(vec![mark]);
        let room = width.saturating_sub(line.width());
        match recording.outlook.findings.first() {
            None => line.push_span(Span::raw(file(&recording.file, room, theme))),
            Some(finding) => {
                let name = file(&recording.file, room / 2, theme);
                let room = room.saturating_sub(text::width(&name) + 2);
                let text = format!("would be {}: {}", finding.grade.word(), theme.safe(&finding.sentence()));
                let text = text::cut(&text, room, theme.ellipsis()).into_owned();
                line.spans.extend([Span::raw(name), Span::raw("  "), Span::styled(text, theme.grade(finding.grade))]);
            }
        }
        return vec![line, Line::from(figures)];
    }
    let figures = Line::from(figures);
    let room = width.saturating_sub(mark.width() + figures.width() + 3);
    let mut line = Line::from(vec![mark]);
    if room >= FILE_LEAST {
        line.spans.extend([Span::raw(file(&recording.file, room, theme)), Span::raw("   ")]);
    }
    line.spans.extend(figures.spans);
    vec![line]
}

fn idle(area: Rect, model: &Model, theme: Theme) -> Vec<Line<'static>> {
    let shown = model.latest();
    let mut first = start(model, usize::from(area.width), theme);
    if let Some(why) = &shown.not_started {
        let text = format!("{} not started: {}", theme.symbol("▲", "!"), theme.safe(why));
        return not_started(first, &text, area, theme);
    }
    let is_kept = |file: &&PathBuf| {
        let entries = shown.session.iter().flat_map(|session| &session.episodes);
        let name = file.file_name().unwrap_or_default();
        !entries.rev().find(|entry| name == &*entry.file).is_some_and(|entry| entry.discarded)
    };
    let last = shown.last_episode.as_ref().filter(is_kept);
    let Some((last, verdict)) = last.zip(shown.last_verdict.as_ref()) else {
        return vec![first];
    };
    let Verdict { grade, reasons, .. } = verdict;
    let word = Span::styled(format!("{} ", grade.word()), theme.grade(*grade));
    let label = Span::styled("last ", theme.faint());
    let width = usize::from(area.width);
    if area.height < 2 {
        let room = width.saturating_sub(first.width() + 3 + label.width() + word.width());
        first.spans.extend([Span::raw("   "), label, word, Span::raw(file(last, room, theme))]);
        return vec![first];
    }
    let sensors = theme.safe(&verdict.remarks());
    if !sensors.is_empty() {
        let room = width.saturating_sub(first.width() + 3);
        first.push_span(Span::raw("   "));
        first.push_span(Span::styled(text::cut(&sensors, room, theme.ellipsis()).into_owned(), theme.faint()));
    }
    // As many of the reasons as fit beside the name; the log has all of them.
    let room = width.saturating_sub(label.width() + word.width());
    let name_width = last.file_name().map_or(0, |name| text::width(&name.to_string_lossy()));
    let why = theme.safe(&reasons.join("; "));
    let room_why = room.saturating_sub(name_width + 2);
    let path = file(last, if why.is_empty() { room } else { name_width.min(room) }, theme);
    let mut line = Line::from(vec![label, word, Span::raw(path)]);
    if !why.is_empty() && room_why > 0 {
        line.push_span(Span::raw("  "));
        line.push_span(Span::styled(text::cut(&why, room_why, theme.ellipsis()).into_owned(), theme.grade(*grade)));
    }
    vec![first, line]
}

/// What begins the next episode, and of what it will be.
fn start(model: &Model, width: usize, theme: Theme) -> Line<'static> {
    let shown = model.latest();
    let session = shown.session.as_ref();
    let left = |until: Stamp| text::clock(until.since(shown.taken) + Duration::from_millis(999));
    let key = |before: &'static str, does: &'static str| {
        let spans = vec![Span::raw(before), Span::styled("space", theme.title()), Span::raw(does)];
        if model.is_read_only() { Vec::new() } else { spans }
    };
    let soon = |text: String| {
        let mut line = Line::from(Span::styled(text, theme.warning()));
        line.spans.extend(key("; ", " begins it now"));
        line
    };
    let mut line = match session.map(|session| session.phase).unwrap_or_default() {
        Phase::Countdown { until } => soon(format!("an episode begins in {}", left(until))),
        Phase::Reset { until } => soon(format!("reset the scene: the next episode begins in {}", left(until))),
        Phase::Idle | Phase::Recording | Phase::Ending if model.is_read_only() => {
            Line::styled("no episode", theme.faint())
        }
        Phase::Idle | Phase::Recording | Phase::Ending => Line::from(key("", " starts an episode")),
    };
    if let Some(session) = session {
        let tags: Vec<_> = session.tags.iter().map(|(key, value)| format!("  {key}={value}")).collect();
        let room = width.saturating_sub(line.width() + 3);
        let task = if session.task.is_empty() { String::new() } else { format!("task: {}", session.task) };
        let about = theme.safe(&format!("{task}{}", tags.concat()));
        line.push_span(Span::raw("   "));
        line.push_span(Span::styled(text::cut(&about, room, theme.ellipsis()).into_owned(), theme.faint()));
    }
    line
}

/// Why no episode was begun, on as many lines as there are.
fn not_started(keys: Line<'static>, text: &str, area: Rect, theme: Theme) -> Vec<Line<'static>> {
    let width = usize::from(area.width);
    let cut = |text: &str| Line::styled(text::cut(text, width, theme.ellipsis()).into_owned(), theme.alarm());
    if area.height >= 2 { vec![cut(text), keys] } else { vec![cut(text)] }
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
