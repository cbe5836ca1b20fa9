//! The view: the layout of the panels.
//!
//! Invariant: drawing changes nothing but the frame.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Position, Rect};
use ratatui::style::Stylize;
use ratatui::text::{Line, Span};
use ratatui::widgets::Paragraph;

use super::model::{Model, Overlay, Page};
use super::picture::Canvas;
use super::theme::Theme;
use super::{detail, devices, episodes, footer, header, help, log, mask, page_link, policy, recording, timeline};

/// Below this size the screen only shows the size it needs.
pub const MINIMUM: (u16, u16) = (60, 12);
/// From this height on, panels have an empty line between them.
const ROOMY: u16 = 32;
/// From this height on, the selected device and the name of the episode have lines of their own.
const WITH_SELECTION: u16 = 20;
/// Least and most lines of log next to a full table.
const LOG_LINES: (u16, u16) = (1, 5);
/// Most episodes that are listed on a roomy terminal.
const EPISODES: u16 = 5;
/// Most lines of the policy: on a small terminal, otherwise, on a roomy one.
const POLICY_LINES: (u16, u16, u16) = (1, 5, 7);

/// From this width and height on, the selected device is shown beside the rig.
pub(super) const WITH_COLUMN: (u16, u16) = (160, 40);
/// Columns of it.
const COLUMN: u16 = 62;
/// From this height on, the bits of the mask have a row each for their last minutes.
const WITH_TIMELINE: u16 = 44;

/// Draws everything.
pub fn draw(frame: &mut Frame<'_>, model: &Model, theme: Theme, canvas: &mut Canvas) {
    let area = frame.area();
    if area.width < MINIMUM.0 || area.height < MINIMUM.1 {
        return draw_too_small(frame, area, model, theme);
    }
    let [header_area, middle, footer_area] =
        Layout::vertical([Constraint::Length(1), Constraint::Fill(1), Constraint::Length(1)]).areas(area);
    header::draw(frame, header_area, model, theme);
    match model.page {
        Page::Rig => {
            let (left, column) = columns(middle, model);
            draw_rig(frame, left, model, theme);
            if let Some(column) = column {
                detail::draw_column(frame, column, model, (theme, canvas));
            }
        }
        Page::Device => detail::draw(frame, middle, model, (theme, canvas)),
        Page::Log => log::draw(frame, middle, model, theme),
        Page::Episodes => episodes::draw_page(frame, middle, model, theme),
    }
    footer::draw(frame, footer_area, model, theme);
    match model.overlay {
        Some(Overlay::Help(page)) => help::draw(frame, area, page, model, theme),
        Some(Overlay::Link) => page_link::draw(frame, area, model, theme),
        None => {}
    }
}

/// Where the panels of the rig are, and how many lines they have.
struct RigLayout {
    banner: Rect,
    plan: mask::Plan,
    mask: Rect,
    devices: Rect,
    /// Rows of the table, and 1 if there is a line about the selected device.
    rows: u16,
    selection: u16,
    timeline: Option<Rect>,
    policy: Rect,
    policy_lines: u16,
    recording: Rect,
    episodes: Rect,
    episode_lines: u16,
    log: Option<Rect>,
}

impl RigLayout {
    /// In the area between header and footer.
    fn new(area: Rect, model: &Model, theme: Theme) -> Self {
        // Thresholds are heights of the whole screen.
        let area = Rect { y: area.y - 1, height: area.height + 2, ..area };
        let gap = u16::from(area.height >= ROOMY);
        let plan = mask::Plan::new(model, area.width, area.height / 4);
        let selection = u16::from(area.height >= WITH_SELECTION);
        let recording_lines = if area.height >= WITH_SELECTION { 2 } else { 1 };
        let policy_lines = policy_lines(area, model, theme);
        // A rule above and, on a roomy terminal, an empty line below.
        let with_rule = |lines: u16| if lines > 0 { 1 + lines + gap } else { 0 };
        let policy_rows = with_rule(policy_lines);
        let episode_lines = if gap > 0 { episodes::rows(model, EPISODES) } else { 0 };
        let episode_rows = with_rule(episode_lines);
        let timeline_lines = if area.height >= WITH_TIMELINE { timeline::rows(model, area.height / 4) } else { 0 };
        let timeline_rows = with_rule(timeline_lines);
        // A rule above each of the four panels, the head of the table, header and footer.
        let fixed = 4
            + 1
            + 2
            + 4 * gap
            + plan.rows()
            + selection
            + recording_lines
            + policy_rows
            + episode_rows
            + timeline_rows;
        // On the smallest terminals the policy panel replaces the log: it shows the reason of a hold itself.
        let with_log = policy_rows == 0 || area.height >= fixed + 1 + LOG_LINES.0;
        let rest = area.height.saturating_sub(if with_log { fixed } else { fixed - 1 });
        let log_least = if with_log { (rest / 3).clamp(LOG_LINES.0, LOG_LINES.1) } else { 0 };
        let devices = u16::try_from(model.shown().devices.len()).unwrap_or(u16::MAX);
        let rows = devices.clamp(1, rest.saturating_sub(log_least).max(1));
        let [_, banner, mask, devices, timeline, policy, recording, episodes, log, _] = Layout::vertical([
            Constraint::Length(1),
            Constraint::Length(gap),
            Constraint::Length(1 + plan.rows() + gap),
            Constraint::Length(2 + rows + selection + gap),
            Constraint::Length(timeline_rows),
            Constraint::Length(policy_rows),
            Constraint::Length(1 + recording_lines + gap),
            Constraint::Length(episode_rows),
            Constraint::Fill(1),
            Constraint::Length(1),
        ])
        .areas(area);
        let (timeline, log) = ((timeline_rows > 0).then_some(timeline), with_log.then_some(log));
        let (policy_lines, episode_lines) = (policy_lines, episode_lines);
        Self {
            banner,
            plan,
            mask,
            devices,
            rows,
            selection,
            timeline,
            policy,
            policy_lines,
            recording,
            episodes,
            episode_lines,
            log,
        }
    }
}

fn policy_lines(area: Rect, model: &Model, theme: Theme) -> u16 {
    let (small, usual, roomy) = POLICY_LINES;
    let most = match area.height {
        ROOMY.. => roomy,
        WITH_SELECTION.. => usual,
        _ => small,
    };
    model.shown().policy.as_ref().map_or(0, |policy| policy::rows(policy, area.width, most, theme))
}

/// The panels of the rig, between header and footer.
fn draw_rig(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let layout = RigLayout::new(area, model, theme);
    header::draw_banner(frame, layout.banner, model, theme);
    mask::draw(frame, layout.mask, &layout.plan, model, theme);
    devices::draw(frame, layout.devices, (layout.rows, layout.selection), model, theme);
    if let Some(area) = layout.timeline {
        timeline::draw(frame, area, model, theme);
    }
    policy::draw(frame, layout.policy, layout.policy_lines, model, theme);
    recording::draw(frame, layout.recording, model, theme);
    if layout.episode_lines > 0 {
        episodes::draw(frame, layout.episodes, layout.episode_lines, model, theme);
    }
    if let Some(area) = layout.log {
        log::draw(frame, area, model, theme);
    }
}

/// What is at a place of the screen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// The row of this device in the table, from 0.
    Device(usize),
    /// The list of devices, beside its rows.
    Devices,
    /// The log.
    Log,
    /// The episodes.
    Episodes,
    /// The selected device.
    Detail,
}

/// What is at this place of a screen of this size.
pub(super) fn target(model: &Model, (width, height): (u16, u16), theme: Theme, place: Position) -> Option<Target> {
    let (left, column) = match model.page {
        Page::Rig if width < MINIMUM.0 || height < MINIMUM.1 => return None,
        Page::Rig => columns(Rect { x: 0, y: 1, width, height: height - 2 }, model),
        Page::Device => return Some(Target::Detail),
        Page::Log => return Some(Target::Log),
        Page::Episodes => return Some(Target::Episodes),
    };
    let layout = RigLayout::new(left, model, theme);
    let is_in = |area: Rect| area.contains(place);
    if is_in(layout.devices) {
        let row = devices::row_at(usize::from(place.y - layout.devices.y), usize::from(layout.rows), model);
        return Some(row.map_or(Target::Devices, Target::Device));
    }
    match () {
        () if column.is_some_and(is_in) => Some(Target::Detail),
        () if layout.log.is_some_and(is_in) => Some(Target::Log),
        () if layout.episode_lines > 0 && is_in(layout.episodes) => Some(Target::Episodes),
        () => None,
    }
}

/// The part of the rig, and that of the selected device where there is room for it.
fn columns(area: Rect, model: &Model) -> (Rect, Option<Rect>) {
    if !model.has_column() {
        return (area, None);
    }
    let column = Constraint::Length(COLUMN.min(area.width / 2));
    let [left, _, right] = Layout::horizontal([Constraint::Fill(1), Constraint::Length(1), column]).areas(area);
    (left, Some(Rect { y: right.y + 1, height: right.height - 1, ..right }))
}

/// What is being recorded comes first: it continues, and the space bar still ends it.
fn draw_too_small(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let mut lines = vec![
        Line::from("The terminal is too small.").bold(),
        Line::from(format!("needs {}x{}, has {}x{}", MINIMUM.0, MINIMUM.1, area.width, area.height)),
    ];
    if let Some(recording) = &model.latest().recording {
        lines.insert(0, Line::styled(recording::mark(recording, theme), theme.alarm()));
    }
    let height = u16::try_from(lines.len()).unwrap_or(u16::MAX).min(area.height);
    let [middle] = Layout::vertical([Constraint::Length(height)]).flex(ratatui::layout::Flex::Center).areas(area);
    frame.render_widget(Paragraph::new(lines).centered(), middle);
}

/// Draws the rule of a panel, with its title at the left and a remark at the right; returns the area below.
pub(super) fn panel(frame: &mut Frame<'_>, area: Rect, title: &str, remark: Line<'_>, theme: Theme) -> Rect {
    let [rule, rest] = Layout::vertical([Constraint::Length(1), Constraint::Fill(1)]).areas(area);
    let dash = theme.symbol("─", "-");
    let left = title.chars().count() + 4;
    let right = if remark.width() == 0 { 1 } else { remark.width() + 4 };
    let fill = usize::from(area.width).saturating_sub(left + right);
    let mut spans = vec![
        Span::styled(format!(" {dash} "), theme.faint()),
        Span::styled(title.to_owned(), theme.title()),
        Span::raw(" "),
        Span::styled(dash.repeat(fill), theme.faint()),
    ];
    if remark.width() > 0 {
        spans.push(Span::raw(" "));
        spans.extend(remark.spans);
        spans.push(Span::styled(format!(" {dash} "), theme.faint()));
    }
    frame.render_widget(Line::from(spans), rule);
    let [_, inner, _] =
        Layout::horizontal([Constraint::Length(1), Constraint::Fill(1), Constraint::Length(1)]).areas(rest);
    inner
}
