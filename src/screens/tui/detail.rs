//! What is known of the selected device: its newest sample as a picture, a plot, gauges or bytes, facts, intervals, and its
//! log. A page of its own, or a column beside the rig on a wide terminal.

use std::time::Duration;

use rapid_core::text;
use rapid_status::detail::{Channel, DeviceDetail, Intervals};
use rapid_status::palette::Palette;
use rapid_status::{DeviceState, DeviceStatus};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Style};
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Axis, Chart, Dataset, GraphType};

use super::lidar::Sweep;
use super::model::Model;
use super::picture::Canvas;
use super::theme::Theme;
use super::{log, view};

/// Channels in one plot; of more, the first ones.
const PLOTTED: usize = 6;
/// Columns of facts beside the sample, on the page.
const FACTS: u16 = 44;
/// Least rows of the histogram with its rule.
const HISTOGRAM: u16 = 6;
const COLOURS: [Color; PLOTTED] = [Color::Cyan, Color::Yellow, Color::Green, Color::Magenta, Color::Blue, Color::Red];

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, (theme, canvas): (Theme, &mut Canvas)) {
    let Some(device) = model.selected_device() else { return };
    let wide = area.width >= 2 * FACTS;
    let [left, right] =
        if wide { Layout::horizontal([Constraint::Fill(1), Constraint::Length(FACTS)]).areas(area) } else { [area; 2] };
    if !wide {
        let facts = facts(device, model, theme);
        let rows = u16::try_from(facts.len()).unwrap_or(u16::MAX).min(area.height / 3) + 1;
        let [top, bottom] = Layout::vertical([Constraint::Length(rows), Constraint::Fill(1)]).areas(area);
        draw_facts(frame, top, device, model, theme);
        return draw_sample(frame, bottom, device, model, (theme, canvas));
    }
    let [sample, histogram] =
        Layout::vertical([Constraint::Fill(1), Constraint::Length(HISTOGRAM.max(area.height / 5))]).areas(left);
    draw_sample(frame, sample, device, model, (theme, canvas));
    draw_intervals(frame, histogram, device, model, theme);
    let rows = u16::try_from(facts(device, model, theme).len()).unwrap_or(u16::MAX) + 2;
    let [top, bottom] = Layout::vertical([Constraint::Length(rows), Constraint::Fill(1)]).areas(right);
    draw_facts(frame, top, device, model, theme);
    log::draw_device(frame, bottom, &device.name, model, theme);
}

/// The column beside the rig.
pub(super) fn draw_column(frame: &mut Frame<'_>, area: Rect, model: &Model, (theme, canvas): (Theme, &mut Canvas)) {
    let Some(device) = model.selected_device() else { return };
    let rows = u16::try_from(facts(device, model, theme).len()).unwrap_or(u16::MAX) + 2;
    let [sample, facts, histogram, log] = Layout::vertical([
        Constraint::Length(area.width / 2 * 3 / 4 + 2),
        Constraint::Length(rows),
        Constraint::Length(HISTOGRAM),
        Constraint::Fill(1),
    ])
    .areas(area);
    draw_sample(frame, sample, device, model, (theme, canvas));
    draw_facts(frame, facts, device, model, theme);
    draw_intervals(frame, histogram, device, model, theme);
    log::draw_device(frame, log, &device.name, model, theme);
}

fn detail<'a>(device: &DeviceStatus, model: &'a Model) -> Option<&'a DeviceDetail> {
    model.shown().details.iter().find(|detail| detail.id == device.id)
}

fn facts(device: &DeviceStatus, model: &Model, theme: Theme) -> Vec<(String, String)> {
    let reading = model.reading(device.id);
    let fact = |name: &str, value: String| (name.to_owned(), value);
    let wanted = device.nominal_hz.map(|hz| format!(" of {}", text::hertz(hz))).unwrap_or_default();
    let state = if device.detail.is_empty() { String::new() } else { format!(": {}", device.detail) };
    let mut facts = vec![
        fact("state", format!("{}{state}", device.state.word())),
        fact("rate", format!("{} Hz{wanted}", text::hertz(reading.hz))),
        fact("run", format!("{} samples, {}, {} lost", device.samples, text::size(device.bytes), device.gaps)),
        fact("starts", device.epoch.0.to_string()),
    ];
    if let Some(finding) =
        model.latest().recording.as_ref().and_then(|recording| recording.outlook.finding(&device.name))
    {
        facts.push(fact("episode", format!("would be {}: {}", finding.grade.word(), finding.text)));
    }
    if let Some(detail) = detail(device, model) {
        facts.extend(detail.facts.iter().cloned());
        facts.extend(detail.controls.iter().map(|(name, value)| (name.clone(), value.to_string())));
    }
    facts.iter().map(|(name, value)| (theme.safe(name), theme.safe(value))).collect()
}

fn draw_facts(frame: &mut Frame<'_>, area: Rect, device: &DeviceStatus, model: &Model, theme: Theme) {
    let name = theme.safe(&device.name);
    let bit = Span::styled(format!("bit {}", device.id.bit()), theme.faint());
    let inner = view::panel(frame, area, &text::cut(&name, 30, theme.ellipsis()), bit.into(), theme);
    let facts = facts(device, model, theme);
    let widest = facts.iter().map(|(name, _)| text::width(name)).max().unwrap_or(0).min(16);
    for ((name, value), row) in facts.iter().zip(inner.rows()) {
        let room = usize::from(row.width).saturating_sub(widest + 1);
        let style = if name == "state" { theme.state(device.state) } else { Style::new() };
        let value = text::cut(value, room, theme.ellipsis()).into_owned();
        let name = text::left(name, widest + 1, theme.ellipsis());
        frame.render_widget(Line::from(vec![Span::styled(name, theme.faint()), Span::styled(value, style)]), row);
    }
}

fn draw_sample(
    frame: &mut Frame<'_>,
    area: Rect,
    device: &DeviceStatus,
    model: &Model,
    (theme, canvas): (Theme, &mut Canvas),
) {
    let preview = model.preview(device.id);
    let remark = preview.map_or_else(String::new, |preview| {
        let age = model.shown().taken.since(preview.captured);
        let is_picture = preview.is_picture();
        let size = if is_picture { format!("{}x{}, ", preview.width, preview.height) } else { String::new() };
        format!("{size}{}, {} old", text::size(preview.bytes as u64), text::age(age).trim())
    });
    let inner = view::panel(frame, area, "Newest sample", Span::styled(remark, theme.faint()).into(), theme);
    let line =
        |frame: &mut Frame<'_>, text: &str| frame.render_widget(Line::styled(text.to_owned(), theme.faint()), inner);
    let Some(preview) = preview else {
        let why = match device.state {
            DeviceState::Streaming => "no sample yet",
            _ => "no samples arrive",
        };
        return line(frame, why);
    };
    if let Some(picture) = model.picture(device.id) {
        return match (picture, model.pictures) {
            (Ok(picture), true) => canvas.draw(frame, inner, picture, theme),
            (Ok(_), false) => line(frame, "pictures are off (c shows them)"),
            (Err(why), _) => line(frame, &theme.safe(why)),
        };
    }
    let channels = detail(device, model).map(|detail| detail.channels.as_slice()).unwrap_or_default();
    let numbers = preview.numbers();
    if channels.iter().any(|channel| channel.limits.is_some()) {
        return draw_gauges(frame, inner, channels, &numbers, theme);
    }
    if !numbers.is_empty() {
        return draw_plot(frame, inner, (device, channels), model, theme);
    }
    if let Some(sweep) = model.sweep(device.id) {
        return draw_sweep(frame, inner, sweep, theme);
    }
    draw_bytes(frame, inner, &preview.payload, theme);
}

/// One row per number: where it is between its limits.
fn draw_gauges(frame: &mut Frame<'_>, area: Rect, channels: &[Channel], numbers: &[f64], theme: Theme) {
    let widest = channels.iter().map(|channel| text::width(&channel.name)).max().unwrap_or(0).min(24);
    for ((channel, number), row) in channels.iter().zip(numbers).zip(area.rows()) {
        let mut spans = vec![
            Span::styled(theme.column(&channel.name, widest + 1), theme.faint()),
            Span::raw(format!("{number:>9.3} ")),
        ];
        if let Some([low, high]) = channel.limits {
            let columns = usize::from(row.width).saturating_sub(widest + 1 + 10 + 22).clamp(8, 60);
            let share = if high > low { ((number - low) / (high - low)).clamp(0.0, 1.0) } else { 0.0 };
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to columns - 1")]
            let at = (share * (columns - 1) as f64).round() as usize;
            let is_outside = *number < low || *number > high;
            let style = if is_outside { theme.alarm() } else { theme.good() };
            let dash = theme.symbol("─", "-");
            spans.extend([
                Span::styled(format!("{low:>9.2} "), theme.faint()),
                Span::styled(dash.repeat(at), theme.faint()),
                Span::styled(theme.symbol("●", "o"), style),
                Span::styled(dash.repeat(columns - 1 - at), theme.faint()),
                Span::styled(format!(" {high:.2}"), theme.faint()),
            ]);
        }
        frame.render_widget(Line::from(spans), row);
    }
}

/// The last seconds of the first numbers.
fn draw_plot(
    frame: &mut Frame<'_>,
    area: Rect,
    (device, channels): (&DeviceStatus, &[Channel]),
    model: &Model,
    theme: Theme,
) {
    let now = model.shown().taken;
    let points: Vec<Vec<(f64, f64)>> = (0..PLOTTED)
        .map(|channel| {
            let of = |(captured, numbers): &(rapid_core::time::Stamp, Vec<f64>)| {
                let value = numbers.get(channel).copied().filter(|value| value.is_finite())?;
                Some((-now.since(*captured).as_secs_f64(), value))
            };
            model.numbers(device.id).filter_map(of).collect()
        })
        .collect();
    let all = || points.iter().flatten().map(|(_, value)| *value);
    let (low, high) =
        all().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    if low > high {
        return frame.render_widget(Line::styled("no finite numbers", theme.faint()), area);
    }
    let margin = ((high - low) * 0.05).max(high.abs().max(low.abs()) * 1e-3).max(1e-6);
    let (low, high) = (low - margin, high + margin);
    let marker = if theme.symbol("u", "a") == "u" { Marker::Braille } else { Marker::Dot };
    let style = |channel: usize| match (theme.palette, COLOURS.get(channel)) {
        (Palette::Ansi, Some(colour)) => Style::new().fg(*colour),
        _ => Style::new(),
    };
    let datasets = points.iter().enumerate().filter(|(_, points)| !points.is_empty()).map(|(channel, points)| {
        let dataset = Dataset::default().data(points).marker(marker).graph_type(GraphType::Line).style(style(channel));
        dataset.name(channels.get(channel).map_or_else(|| channel.to_string(), |known| theme.safe(&known.name)))
    });
    let label = |value: f64| Span::styled(format!("{value:>9.3}"), theme.faint());
    let seconds = points.iter().flatten().map(|(time, _)| -time).fold(1.0_f64, f64::max).ceil();
    let chart = Chart::new(datasets.collect())
        .x_axis(
            Axis::default()
                .bounds([-seconds, 0.0])
                .labels([Span::styled(format!("-{seconds:.0} s"), theme.faint()), Span::styled("now", theme.faint())]),
        )
        .y_axis(Axis::default().bounds([low, high]).labels([label(low), label(f64::midpoint(low, high)), label(high)]));
    frame.render_widget(chart, area);
}

/// A scan from above: x to the right, y up, the sensor in the middle.
fn draw_sweep(frame: &mut Frame<'_>, area: Rect, sweep: &Sweep, theme: Theme) {
    let (columns, rows) = (usize::from(area.width), usize::from(area.height));
    let range = sweep.range();
    let mut cells = vec![vec![false; columns]; rows];
    // A cell is twice as high as it is wide.
    let scale = (columns as f64 / 2.0).min(rows as f64) / range;
    for (x, y) in sweep.points() {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates; outside is not drawn")]
        let (column, row) = (
            (columns as f64 / 2.0 + x * scale).max(0.0) as usize,
            (rows as f64 / 2.0 - y * scale / 2.0).max(0.0) as usize,
        );
        if let Some(cell) = cells.get_mut(row).and_then(|row| row.get_mut(column)) {
            *cell = true;
        }
    }
    let middle = (rows / 2, columns / 2);
    for (place, (cells, row)) in cells.iter().zip(area.rows()).enumerate() {
        let symbol = |(column, is_hit): (usize, &bool)| match (is_hit, (place, column) == middle) {
            (_, true) => "+",
            (true, false) => theme.symbol("•", "*"),
            (false, false) => " ",
        };
        frame.render_widget(Line::raw(cells.iter().enumerate().map(symbol).collect::<String>()), row);
    }
    let scale = Line::styled(format!("from above, {range:.0} m to each side"), theme.faint());
    frame.render_widget(scale, Rect { height: 1.min(area.height), ..area });
}

fn draw_bytes(frame: &mut Frame<'_>, area: Rect, bytes: &[u8], theme: Theme) {
    const PER_ROW: usize = 16;
    for (place, (bytes, row)) in bytes.chunks(PER_ROW).zip(area.rows()).enumerate() {
        let hex: Vec<_> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        let shown = |byte: &u8| if byte.is_ascii_graphic() || *byte == b' ' { char::from(*byte) } else { '.' };
        let ascii: String = bytes.iter().map(shown).collect();
        let spans = vec![
            Span::styled(format!("{:06x}  ", place * PER_ROW), theme.faint()),
            Span::raw(format!("{:width$}  ", hex.join(" "), width = PER_ROW * 3 - 1)),
            Span::styled(ascii, theme.faint()),
        ];
        frame.render_widget(Line::from(spans), row);
    }
}

/// How the intervals between samples are distributed: one bar per half octave that occurs.
fn draw_intervals(frame: &mut Frame<'_>, area: Rect, device: &DeviceStatus, model: &Model, theme: Theme) {
    let counts = detail(device, model).map(|detail| detail.intervals.as_slice()).unwrap_or_default();
    let total: u64 = counts.iter().sum();
    let remark = Span::styled(format!("{} of this run, by length", text::count(total)), theme.faint());
    let inner = view::panel(frame, area, "Intervals", remark.into(), theme);
    let highest = counts.iter().copied().max().unwrap_or(0);
    let occurring: Vec<(Duration, u64)> =
        Intervals::bounds().zip(counts.iter().copied()).filter(|(_, count)| *count > 0).collect();
    let first = occurring.len().saturating_sub(usize::from(inner.height));
    // The longest are what matters.
    for ((bound, count), row) in occurring.iter().skip(first).zip(inner.rows()) {
        let room = usize::from(row.width).saturating_sub(24);
        // A single one is visible beside a million.
        let share = (*count as f64).ln_1p() / (highest as f64).ln_1p();
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to room")]
        let bar = ((share * room as f64).round() as usize).max(1);
        let is_gap = device.nominal_hz.is_some_and(|hz| bound.as_secs_f64() * hz > 2.9);
        let style = if is_gap { theme.warning() } else { theme.good() };
        frame.render_widget(
            Line::from(vec![
                Span::styled(format!("{:>9} ", format!("<{}", text::age(*bound).trim())), theme.faint()),
                Span::styled(theme.symbol("▇", "=").repeat(bar), style),
                Span::raw(format!(" {}", text::count(*count))),
            ]),
            row,
        );
    }
}
