//! The episodes panel: those of the session, the newest first.

use rapid_core::text;
use rapid_status::session::{EpisodeEntry, Label, SessionStatus};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::text::{Line, Span};

use super::model::Model;
use super::theme::Theme;
use super::view;

/// Columns of the name of a file.
const NAME: usize = 34;

/// Episodes to list, of those that have ended.
fn ended(session: &SessionStatus) -> impl Iterator<Item = &EpisodeEntry> {
    session.episodes.iter().rev().filter(|entry| entry.verdict.is_some())
}

/// Rows for the panel without its rule, at most `most`; 0 if there is nothing to list.
pub(super) fn rows(model: &Model, most: u16) -> u16 {
    let count = model.latest().session.as_ref().map_or(0, |session| ended(session).count());
    u16::try_from(count).unwrap_or(most).min(most)
}

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, rows: u16, model: &Model, theme: Theme) {
    let Some(session) = &model.latest().session else { return };
    let remark = Span::styled(counts(session), theme.faint());
    let inner = view::panel(frame, area, "Episodes", remark.into(), theme);
    for (entry, row) in ended(session).zip(inner.rows()).take(usize::from(rows)) {
        frame.render_widget(line(entry, usize::from(row.width), theme), row);
    }
}

/// The page: every episode of the session that is known here, and the selected one in full.
pub(super) fn draw_page(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let Some(session) = &model.latest().session else {
        let inner = view::panel(frame, area, "Episodes", Line::default(), theme);
        return frame.render_widget(Line::styled("this run records no session", theme.faint()), inner);
    };
    let entries: Vec<&EpisodeEntry> = session.episodes.iter().rev().collect();
    let about = entries.get(model.episode).map_or_else(Vec::new, |entry| in_full(entry, session, area.width, theme));
    let lines = u16::try_from(about.len()).unwrap_or(u16::MAX).min(area.height / 2) + 1;
    let [list, below] = Layout::vertical([Constraint::Fill(1), Constraint::Length(lines)]).areas(area);
    let remark = Span::styled(counts(session), theme.faint());
    let inner = view::panel(frame, list, "Episodes", remark.into(), theme);
    let first = model.episode.saturating_sub(usize::from(inner.height / 2));
    for (place, (entry, row)) in
        entries.iter().enumerate().skip(first).zip(inner.rows()).map(|((place, entry), row)| (place, (entry, row)))
    {
        let [mark, rest] = Layout::horizontal([Constraint::Length(2), Constraint::Fill(1)]).areas(row);
        if place == model.episode {
            frame.render_widget(Span::styled(theme.symbol("▸", ">"), theme.title()), mark);
        }
        frame.render_widget(line(entry, usize::from(rest.width), theme), rest);
    }
    if entries.is_empty() {
        frame.render_widget(Line::styled("none yet: space begins one", theme.faint()), inner);
    }
    let name = entries.get(model.episode).map_or_else(String::new, |entry| theme.safe(&entry.file));
    let inner = view::panel(frame, below, &text::cut(&name, 60, theme.ellipsis()), Line::default(), theme);
    for (line, row) in about.into_iter().zip(inner.rows()) {
        frame.render_widget(line, row);
    }
}

/// Everything that is known of an episode.
fn in_full(entry: &EpisodeEntry, session: &SessionStatus, width: u16, theme: Theme) -> Vec<Line<'static>> {
    let fact = |name: &str, value: &str| {
        let room = usize::from(width).saturating_sub(14);
        let value = text::cut(&theme.safe(value), room, theme.ellipsis()).into_owned();
        Line::from(vec![Span::styled(format!("{name:<10}"), theme.faint()), Span::raw(value)])
    };
    let verdict = match entry.verdict {
        Some(grade) => {
            let length = entry.seconds.map(|seconds| format!(", {seconds:.1} s")).unwrap_or_default();
            Line::from(vec![
                Span::styled(format!("{:<10}", "verdict"), theme.faint()),
                Span::styled(grade.word(), theme.grade(grade)),
                Span::raw(length),
            ])
        }
        None => fact("verdict", "none yet"),
    };
    let mut lines = vec![fact("begun", &entry.begun), verdict];
    lines.extend(entry.reasons.iter().map(|reason| fact("reason", reason)));
    lines.extend(entry.sensors.as_ref().map(|sensors| fact("took part", &sensors.to_string())));
    lines.extend(entry.label.map(|label| match entry.label_reason.as_str() {
        "" => fact("label", label.word()),
        why => fact("label", &format!("{}: {why}", label.word())),
    }));
    lines.extend((!entry.note.is_empty()).then(|| fact("note", &entry.note)));
    lines.extend(entry.marks.iter().map(|mark| fact("mark", &format!("{:.1} s {}", mark.at, mark.text))));
    lines.extend(entry.discarded.then(|| fact("trash", "discarded; u takes the last one back")));
    lines.push(fact("folder", &session.folder.to_string_lossy()));
    lines
}

/// `12 of 50, 9 GOOD 2 SUSPECT 1 BAD, 1 in the trash`.
fn counts(session: &SessionStatus) -> String {
    let [good, suspect, bad] = session.verdicts;
    let trash = if session.discarded > 0 { format!(", {} in the trash", session.discarded) } else { String::new() };
    format!("{}, {good} GOOD {suspect} SUSPECT {bad} BAD{trash}", session.progress())
}

fn line(entry: &EpisodeEntry, width: usize, theme: Theme) -> Line<'static> {
    let name = text::left(&theme.safe(&entry.file), NAME, theme.ellipsis());
    let grade = entry.verdict.map_or_else(
        || Span::raw(" ".repeat(9)),
        |grade| {
            let style = if entry.discarded { theme.faint() } else { theme.grade(grade) };
            Span::styled(format!("  {:7}", grade.word()), style)
        },
    );
    let length = entry.seconds.map(|seconds| format!("{seconds:.1} s")).unwrap_or_default();
    let length = Span::raw(format!("  {length:>9}"));
    let label = match entry.label {
        Some(label @ Label::Success) => Span::styled(format!("  {:7}", label.word()), theme.good()),
        Some(label @ Label::Failure) => Span::styled(format!("  {:7}", label.word()), theme.warning()),
        None => Span::raw(" ".repeat(9)),
    };
    let discarded = if entry.discarded { "discarded".to_owned() } else { String::new() };
    let marks = match entry.marks.len() {
        0 => String::new(),
        count => text::counted(count as u64, "mark"),
    };
    let sensors = entry.sensors.as_ref().map(ToString::to_string).unwrap_or_default();
    let reasons = entry.reasons.join("; ");
    let remarks = [&discarded, &entry.label_reason, &entry.note, &marks, &reasons, &sensors];
    let remarks: Vec<_> = remarks.into_iter().filter(|text| !text.is_empty()).map(|text| theme.safe(text)).collect();
    let style = if entry.discarded { theme.faint() } else { ratatui::style::Style::new() };
    let mut line = Line::from(vec![Span::styled(name, style), grade, length, label]);
    let room = width.saturating_sub(line.width() + 2);
    let remarks = text::cut(&remarks.join("; "), room, theme.ellipsis()).into_owned();
    line.push_span(Span::styled(format!("  {remarks}"), theme.faint()));
    line
}
