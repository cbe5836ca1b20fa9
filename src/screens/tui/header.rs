//! The first line: rig, uptime, the mask as a number, emergency stops and enabling switches, and whether an episode
//! is being recorded.

use rapid_core::interlock::{InputState, StopKind};
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_status::{DeviceState, Grade, StopStatus};
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Style, Stylize};
use ratatui::text::{Line, Span};

use super::link::LinkState;
use super::model::Model;
use super::recording;
use super::theme::Theme;

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let width = usize::from(area.width);
    let mut left = identity(model, theme);
    let right = right(model, width.saturating_sub(left.width() + 2), theme);
    // In this order as long as they fit; the binary form is the longest and is left out first.
    let hex = mask_hex(model, theme);
    let publication = publication(model, theme);
    let binary = mask_binary(model);
    let room = width.saturating_sub(left.width() + right.width() + 2);
    let with_publication = hex.width() + publication.width() <= room;
    let with_binary = hex.width() + publication.width() + binary.width() <= room;
    if hex.width() <= room {
        left.spans.extend(hex.spans);
    }
    if with_binary {
        left.spans.extend(binary.spans);
    }
    if with_publication {
        left.spans.extend(publication.spans);
    }
    let space = width.saturating_sub(left.width() + right.width());
    left.spans.push(Span::raw(" ".repeat(space)));
    left.spans.extend(right.spans);
    frame.render_widget(left, area);
}

fn identity(model: &Model, theme: Theme) -> Line<'static> {
    let snapshot = model.shown();
    let rig = text::cut(&theme.safe(&snapshot.rig), 20, theme.ellipsis()).into_owned();
    Line::from(vec![
        Span::styled(" rapid ", theme.title()),
        Span::raw(rig).bold(),
        Span::styled("   up ", theme.faint()),
        Span::raw(text::clock(snapshot.uptime)),
    ])
}

fn mask_hex(model: &Model, theme: Theme) -> Line<'static> {
    let snapshot = model.shown();
    Line::from(vec![
        Span::styled("   mask ", theme.faint()),
        Span::raw(snapshot.mask.hex(snapshot.devices.len())).bold(),
    ])
}

fn mask_binary(model: &Model) -> Line<'static> {
    let snapshot = model.shown();
    let binary = snapshot.mask.binary(snapshot.devices.len());
    let bytes: Vec<_> = binary.as_bytes().chunks(8).map(String::from_utf8_lossy).collect();
    Line::from(vec![Span::raw("  "), Span::raw(bytes.join(" "))])
}

fn publication(model: &Model, theme: Theme) -> Line<'static> {
    Line::from(vec![
        Span::styled("   published ", theme.faint()),
        Span::raw(format!("{:>3.0} Hz", model.totals.publications)),
    ])
}

/// The first stop that blocks motion, and how many more do; or that all stops permit motion.
fn stops(model: &Model, theme: Theme) -> Vec<Span<'static>> {
    let all = &model.shown().stops;
    let is_blocked = |stop: &&StopStatus| stop.state != InputState::Runs;
    // An emergency stop comes before an enabling switch that is not held.
    let blocked = all.iter().filter(is_blocked).min_by_key(|stop| !stop.is_problem());
    let word = match (blocked.or_else(|| all.first()), all.len()) {
        (None, _) => return Vec::new(),
        (Some(stop), count) if blocked.is_some() || count == 1 => {
            let what = match (stop.kind, stop.state) {
                (StopKind::Enabling, _) => "enable",
                (StopKind::Emergency, InputState::Runs) => "stop",
                (StopKind::Emergency, _) => "STOP",
            };
            format!("{what} {} {}", text::cut(&theme.safe(&stop.stop), 16, theme.ellipsis()), stop.word())
        }
        (Some(_), count) => format!("{count} stops run"),
    };
    let more = all.iter().filter(is_blocked).count().saturating_sub(1);
    let more = if more > 0 { format!(" +{more}") } else { String::new() };
    let style = match blocked {
        None => theme.faint(),
        Some(stop) if stop.is_problem() => theme.alarm(),
        Some(_) => theme.warning(),
    };
    vec![Span::styled(word + &more, style), Span::raw("  ")]
}

/// What is wrong, the worst first: what the episode would be judged for, devices that were unplugged, and those in trouble.
pub(super) fn draw_banner(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    if matches!(model.link, LinkState::Lost { .. }) {
        return;
    }
    let snapshot = model.latest();
    let finding = snapshot.recording.as_ref().and_then(|recording| recording.outlook.findings.first());
    let mut parts: Vec<(String, Style)> = Vec::new();
    if let Some(finding) = finding {
        let text = format!("{}: the episode would be {}", finding.sentence(), finding.grade.word());
        parts.push((text, theme.grade(finding.grade)));
    }
    for device in &snapshot.devices {
        let ago = model.unplugged_for(device).map(|ago| format!("{} unplugged {} ago", device.name, text::clock(ago)));
        let trouble = match device.state {
            DeviceState::Failed | DeviceState::Stalled => Some(format!("{} {}", device.name, device.state.word())),
            _ => None,
        };
        parts.extend(ago.or(trouble).map(|text| (text, theme.state(device.state))));
    }
    let mut line = Line::default();
    for (place, (text, style)) in parts.into_iter().enumerate() {
        let joint = if place == 0 { theme.symbol(" ▲ ", " ! ") } else { theme.symbol(" · ", " | ") };
        let room = usize::from(area.width).saturating_sub(line.width() + 3);
        line.push_span(Span::styled(joint, style));
        line.push_span(Span::styled(text::cut(&theme.safe(&text), room, theme.ellipsis()).into_owned(), style));
    }
    frame.render_widget(line, area);
}

fn right(model: &Model, room: usize, theme: Theme) -> Line<'static> {
    let mut spans = stops(model, theme);
    match model.link {
        LinkState::Own => {}
        LinkState::Attached { read_only, .. } => {
            let word = if read_only { "attached, read-only  " } else { "attached  " };
            spans.push(Span::styled(word, theme.faint()));
        }
        LinkState::Lost { since, runs, .. } => {
            let ago = text::clock(Stamp::now().since(since));
            let (ended, then) = if runs {
                (format!("LINK LOST {ago} ago"), "connecting again")
            } else {
                (format!("RUN ENDED {ago} ago"), "waiting for the next")
            };
            let all = format!("{ended}, {then}  ");
            spans.push(Span::styled(if all.len() <= room { all } else { ended }, theme.alarm()));
            // What it last recorded is not being recorded.
            return Line::from(spans);
        }
    }
    if model.is_paused() {
        spans.push(Span::styled("view paused", theme.warning()));
        spans.push(Span::raw("  "));
    }
    if let Some(recording) = &model.latest().recording {
        let grade = recording.outlook.grade();
        if grade != Grade::Good {
            spans.push(Span::styled(format!("would be {}", grade.word()), theme.grade(grade)));
            spans.push(Span::raw("  "));
        }
        spans.push(Span::styled(recording::mark(recording, theme), theme.alarm()));
        spans.push(Span::raw(" "));
    }
    Line::from(spans)
}
