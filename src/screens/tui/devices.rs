//! The device table: one row per modality, and a line about the selected one.

use std::time::Duration;

use rapid_core::text;
use rapid_status::{DeviceState, DeviceStatus, Finding, Level, Snapshot};
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Modifier, Style, Stylize};
use ratatui::text::{Line, Span};

use super::history::{self, Cell};
use super::model::Model;
use super::theme::Theme;
use super::view;

/// Columns of state, rate, age, gaps and total, each with the space before it.
const STATE: usize = 12;
const RATE: usize = 7;
const AGE: usize = 8;
const GAPS: usize = 7;
const TOTAL: usize = 9;
/// The nominal rate, after the measured one: `/1000`.
const NOMINAL: usize = 6;
/// From this width on, a device has its nominal rate and a strip of its last minute.
const WITH_STRIP: u16 = 108;
/// A second with less than this share of the nominal rate is marked.
const LOW: f32 = 0.9;
/// Columns before the name: selection mark, bit, space.
const BIT: usize = 5;

/// The rows in view: `rows` of the table and `selection` lines (0 or 1) about the selected device.
pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, (rows, selection): (u16, u16), model: &Model, theme: Theme) {
    let devices = model.rows();
    let rows = usize::from(rows);
    let first = first_row(model.selected, rows, devices.len());
    let unregistered = model.shown().unregistered.len();
    let remark = match remark(first, rows, devices.len(), theme) {
        _ if unregistered > 0 => Span::styled(
            format!("{} without an entry: N", text::counted(unregistered as u64, "device")),
            theme.warning(),
        )
        .into(),
        remark => remark,
    };
    let inner = view::panel(frame, area, "Devices", remark, theme);
    let name = name_width(model.shown(), inner.width);
    let mut lines = inner.rows();
    if let Some(line) = lines.next() {
        frame.render_widget(head(name, line.width, theme), line);
    }
    if devices.is_empty()
        && let Some(line) = lines.next()
    {
        let text = if unregistered > 0 {
            "     no devices registered: N names one"
        } else {
            "     no devices registered: plug one in"
        };
        frame.render_widget(Line::styled(text, theme.faint()), line);
    }
    for (index, device) in devices.iter().enumerate().skip(first).take(rows) {
        let Some(line) = lines.next() else { break };
        let selected = index == model.selected;
        frame.render_widget(row((device, selected), name, line.width, model, theme), line);
        if selected {
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

/// The device at this line of the panel, whose table has so many rows.
pub(super) fn row_at(line: usize, rows: usize, model: &Model) -> Option<usize> {
    let devices = model.rows().len();
    // The rule and the head of the table come first.
    let row = line.checked_sub(2).filter(|row| *row < rows)? + first_row(model.selected, rows, devices);
    (row < devices).then_some(row)
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

/// Columns of the total, or none: a truncated number would be another number, and the strip shows more in its place.
fn total_width(name: usize, width: u16) -> usize {
    let is_room = BIT + name + STATE + RATE + AGE + GAPS + TOTAL <= usize::from(width);
    if is_room && width < WITH_STRIP { TOTAL } else { 0 }
}

/// Columns of the nominal rate, or none.
const fn nominal_width(width: u16) -> usize {
    if width >= WITH_STRIP { NOMINAL } else { 0 }
}

/// Columns of the strip, without the two before it: a divisor of its seconds, or none.
const fn strip_width(width: u16) -> usize {
    match width {
        0..WITH_STRIP => 0,
        WITH_STRIP..158 => 20,
        158..188 => 30,
        188.. => history::SECONDS,
    }
}

/// The last minute: a bar per cell, as high as the rate.
fn strip(device: &DeviceStatus, width: u16, model: &Model, theme: Theme) -> Vec<Span<'static>> {
    const BARS: [(&str, &str); 8] =
        [("▁", "1"), ("▂", "2"), ("▃", "3"), ("▄", "4"), ("▅", "5"), ("▆", "6"), ("▇", "7"), ("█", "8")];
    let columns = strip_width(width);
    if columns == 0 {
        return Vec::new();
    }
    let span = |cell: &Cell| match cell {
        Cell::Unknown => Span::raw(" "),
        Cell::Absent => Span::styled(theme.symbol("×", "x"), theme.faint()),
        Cell::Rate(share) => {
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 7, and saturates")]
            let bar = BARS.get((share * 7.99) as usize).copied().unwrap_or(("█", "8"));
            let style = if *share < LOW { theme.warning() } else { theme.state(DeviceState::Streaming) };
            Span::styled(theme.symbol(bar.0, bar.1), style)
        }
    };
    let mut spans: Vec<_> = model.strip(device.id, columns).iter().map(span).collect();
    spans.insert(0, Span::raw("  "));
    spans
}

/// `/30`, or nothing if it is not known.
fn nominal(device: &DeviceStatus) -> String {
    let Some(hz) = device.nominal_hz else { return String::new() };
    if hz.fract() == 0.0 && hz < 10_000.0 { format!("/{hz:.0}") } else { format!("/{}", text::hertz(hz)) }
}

fn head(name: usize, width: u16, theme: Theme) -> Line<'static> {
    let total = total_width(name, width);
    let nominal = nominal_width(width);
    let strip = match strip_width(width) {
        0 => String::new(),
        columns => format!("  {:columns$}", "last 60 s"),
    };
    let head = format!(
        "{:>4} {:name$} {:width$}{:>RATE$}{:nominal$}{:>AGE$}{:>GAPS$}{:>total$}{strip}  detail",
        "bit",
        "name",
        "state",
        "Hz",
        if nominal > 0 { "/want" } else { "" },
        "age",
        "gaps",
        if total > 0 { "total" } else { "" },
        width = STATE - 1
    );
    Line::styled(head, theme.faint())
}

fn row(
    (device, selected): (&DeviceStatus, bool),
    name: usize,
    width: u16,
    model: &Model,
    theme: Theme,
) -> Line<'static> {
    let reading = model.reading(device.id);
    let running = device.state.is_present();
    let none = theme.symbol("–", "-").to_owned();
    let rate = if running { text::hertz(reading.hz) } else { none.clone() };
    let age = reading.age.filter(|_| running).map_or(none, text::age);
    let is_old = device.state == DeviceState::Stalled || reading.age.is_some_and(|age| age >= Duration::from_secs(1));
    let lost = model.lost(device);
    let gaps = if lost > 0 { theme.level(Level::Warn) } else { theme.faint() };
    let word = format!("{} {}", theme.state_symbol(device.state), device.state.word());
    let total = total_width(name, width);
    let strip = strip(device, width, model, theme);
    let wanted = nominal_width(width);
    let used =
        BIT + name + STATE + RATE + wanted + AGE + GAPS + total + strip.iter().map(Span::width).sum::<usize>() + 2;
    let detail = usize::from(width).saturating_sub(used);
    let detail = text::cut(&detail_of(device, model, theme), detail, theme.ellipsis()).into_owned();
    let figures = if running { Style::new() } else { theme.faint() };
    let style = match finding(device, model) {
        Some(finding) => theme.grade(finding.grade),
        None if device.state == DeviceState::Failed => theme.alarm(),
        None => theme.faint(),
    };
    let mut spans = vec![
        Span::styled(if selected { theme.symbol("▸", ">") } else { " " }, theme.title()),
        Span::styled(format!("{:>3} ", device.id.bit()), theme.faint()),
        Span::raw(theme.column(&device.name, name)),
        Span::raw(" "),
        Span::styled(format!("{word:width$}", width = STATE - 1), theme.state(device.state)),
        Span::styled(format!("{rate:>RATE$}"), figures),
        Span::styled(if wanted > 0 { format!("{:wanted$}", nominal(device)) } else { String::new() }, theme.faint()),
        Span::styled(format!("{age:>AGE$}"), if running && is_old { theme.warning() } else { figures }),
        Span::styled(format!("{:>GAPS$}", compact(lost)), gaps),
        Span::styled(if total > 0 { format!("{:>total$}", compact(device.samples)) } else { String::new() }, figures),
    ];
    spans.extend(strip);
    spans.extend([Span::raw("  "), Span::styled(detail, style)]);
    Line::from(spans)
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
    model.latest().recording.as_ref()?.outlook.finding(&device.name)
}

/// The detail of a device, first what is wrong with it; for an absent one, since when.
fn detail_of(device: &DeviceStatus, model: &Model, theme: Theme) -> String {
    if let Some(finding) = finding(device, model) {
        return format!("would be {}: {}", finding.grade.word(), theme.safe(&finding.text));
    }
    if device.state != DeviceState::Absent || !device.detail.is_empty() {
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
    let mut parts = vec![detail_of(device, model, theme), theme.safe(&device.topic)];
    parts.push(format!("{} samples, {}", device.samples, text::size(device.bytes)));
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
