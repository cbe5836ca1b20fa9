//! The device table: one row per modality, and a line about the selected one.

use std::time::Duration;

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Modifier, Style, Stylize};
use ratatui::text::{Line, Span};

use super::model::Model;
use super::theme::Theme;
use super::view;
use crate::status::{DeviceStatus, Finding, Level, SlotState, Snapshot};
use crate::text;

/// Columns of state, rate, age, gaps and total, each with the space before it.
const STATE: usize = 12;
const RATE: usize = 7;
const AGE: usize = 8;
const GAPS: usize = 7;
const TOTAL: usize = 9;
/// Columns before the name: selection mark, bit, space.
const BIT: usize = 5;

/// The rows in view: `rows` of the table and `selection` lines (0 or 1) about the selected device.
pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, (rows, selection): (u16, u16), model: &Model, theme: Theme) {
    let devices = &model.shown().devices;
    let rows = usize::from(rows);
    let first = first_row(model.selected, rows, devices.len());
    let inner = view::panel(frame, area, "Devices", remark(first, rows, devices.len(), theme), theme);
    let name = name_width(model.shown(), inner.width);
    let mut lines = inner.rows();
    if let Some(line) = lines.next() {
        frame.render_widget(head(name, line.width, theme), line);
    }
    if devices.is_empty()
        && let Some(line) = lines.next()
    {
        frame.render_widget(Line::styled("     no devices registered", theme.faint()), line);
    }
    for (index, device) in devices.iter().enumerate().skip(first).take(rows) {
        let Some(line) = lines.next() else { break };
        frame.render_widget(row(device, name, line.width, model, theme), line);
        if index == model.selected {
            frame.buffer_mut().set_style(line, Style::new().add_modifier(Modifier::BOLD));
        }
    }
    if selection > 0
        && let (Some(device), Some(line)) = (model.selected_device(), lines.next())
    {
        frame.render_widget(about(device, line.width, model, theme), line);
    }
}

/// The row at the top, so that the selected one is in view and, if possible, in the middle.
fn first_row(selected: usize, rows: usize, devices: usize) -> usize {
    selected.saturating_sub(rows / 2).min(devices.saturating_sub(rows))
}

fn remark(first: usize, rows: usize, devices: usize, theme: Theme) -> Line<'static> {
    if devices <= rows {
        return Line::default();
    }
    let last = (first + rows).min(devices);
    Span::styled(format!("{}-{last} of {devices}", first + 1), theme.faint()).into()
}

fn name_width(snapshot: &Snapshot, width: u16) -> usize {
    let longest = snapshot.devices.iter().map(|device| text::width(&device.name)).max().unwrap_or(0);
    longest.clamp(6, if width >= 110 { 28 } else { 14 })
}

/// Columns of the total, or none: a truncated number would be another number.
fn total_width(name: usize, width: u16) -> usize {
    if BIT + name + STATE + RATE + AGE + GAPS + TOTAL <= usize::from(width) { TOTAL } else { 0 }
}

fn head(name: usize, width: u16, theme: Theme) -> Line<'static> {
    let total = total_width(name, width);
    let head = format!(
        "{:>4} {:name$} {:width$}{:>RATE$}{:>AGE$}{:>GAPS$}{:>total$}  detail",
        "bit",
        "name",
        "state",
        "Hz",
        "age",
        "gaps",
        if total > 0 { "total" } else { "" },
        width = STATE - 1
    );
    Line::styled(head, theme.faint())
}

fn row(device: &DeviceStatus, name: usize, width: u16, model: &Model, theme: Theme) -> Line<'static> {
    let reading = model.reading(device.id);
    let selected = model.selected_device().is_some_and(|selected| selected.id == device.id);
    let running = matches!(device.state, SlotState::Streaming | SlotState::Stalled);
    let none = theme.symbol("–", "-").to_owned();
    let rate = if running { text::hertz(reading.hz) } else { none.clone() };
    let age = reading.age.filter(|_| running).map_or(none, text::age);
    let is_old = device.state == SlotState::Stalled || reading.age.is_some_and(|age| age >= Duration::from_secs(1));
    let gaps = if device.gaps > 0 { theme.level(Level::Warn) } else { theme.faint() };
    let word = format!("{} {}", theme.state_symbol(device.state), device.state.word());
    let total = total_width(name, width);
    let used = BIT + name + STATE + RATE + AGE + GAPS + total + 2;
    let detail = usize::from(width).saturating_sub(used);
    let detail = text::cut(&detail_of(device, model, theme), detail, theme.ellipsis()).into_owned();
    let figures = if running { Style::new() } else { theme.faint() };
    let style = match finding(device, model) {
        Some(finding) => theme.grade(finding.grade),
        None if device.state == SlotState::Failed => theme.alarm(),
        None => theme.faint(),
    };
    Line::from(vec![
        Span::styled(if selected { theme.symbol("▸", ">") } else { " " }, theme.title()),
        Span::styled(format!("{:>3} ", device.id.bit()), theme.faint()),
        Span::raw(theme.column(&device.name, name)),
        Span::raw(" "),
        Span::styled(format!("{word:width$}", width = STATE - 1), theme.state(device.state)),
        Span::styled(format!("{rate:>RATE$}"), figures),
        Span::styled(format!("{age:>AGE$}"), if running && is_old { theme.warning() } else { figures }),
        Span::styled(format!("{:>GAPS$}", compact(device.gaps)), gaps),
        Span::styled(if total > 0 { format!("{:>total$}", compact(device.samples)) } else { String::new() }, figures),
        Span::raw("  "),
        Span::styled(detail, style),
    ])
}

/// A count that fits its column: exact up to six digits.
fn compact(count: u64) -> String {
    match count {
        0..1_000_000 => count.to_string(),
        1_000_000..1_000_000_000 => format!("{:.2}M", count as f64 / 1e6),
        _ => format!("{:.2}G", count as f64 / 1e9),
    }
}

/// What makes the episode in progress worse than GOOD because of this device.
fn finding<'a>(device: &DeviceStatus, model: &'a Model) -> Option<&'a Finding> {
    model.latest().recording.as_ref()?.outlook.of(&device.name)
}

/// The detail of a device, first what is wrong with it; for an absent one, since when.
fn detail_of(device: &DeviceStatus, model: &Model, theme: Theme) -> String {
    if let Some(finding) = finding(device, model) {
        return format!("would be {}: {}", finding.grade.word(), theme.safe(&finding.text));
    }
    if device.state != SlotState::Absent || !device.detail.is_empty() {
        return theme.safe(&device.detail);
    }
    match model.unplugged_for(device) {
        Some(since) => format!("unplugged {} ago", text::about(since)),
        None if device.samples > 0 => "unplugged".to_owned(),
        None => "not plugged in".to_owned(),
    }
}

/// What does not fit the table: first the whole detail, which the table truncates.
fn about(device: &DeviceStatus, width: u16, model: &Model, theme: Theme) -> Line<'static> {
    let mut parts = vec![detail_of(device, model, theme), theme.safe(&device.topic), text::size(device.bytes)];
    parts.retain(|part| !part.is_empty());
    if device.epoch.0 > 1 {
        parts.push(format!("started {} times", device.epoch.0));
    }
    let text = parts.join(theme.symbol(" · ", " | "));
    let arrow = theme.symbol("└ ", "` ");
    let room = usize::from(width).saturating_sub(BIT);
    let text = text::cut(&text, room.saturating_sub(2), theme.ellipsis()).into_owned();
    Line::from(vec![Span::raw(" ".repeat(BIT)), Span::styled(arrow, theme.faint()), Span::raw(text).italic()])
}
