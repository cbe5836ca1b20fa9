//! The policy panel: what the policy observed, its latency, and its action or the reason of a hold.
//!
//! Invariant: values that change while the policy acts keep their columns.

use rapid_core::modality::ModalityId;
use rapid_core::text;
use rapid_status::PolicyStatus;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::model::Model;
use super::theme::{Edge, Theme};
use super::view;

/// Longest name of an axis and longest unit, columns.
const NAME: usize = 12;
const UNIT: usize = 6;
/// Columns of a value: `-12.345`.
const VALUE: usize = 7;
/// Space between two axes.
const GAP: usize = 2;
/// From this many modalities on, the mask that the policy observed is shown only as a number.
const MANY: usize = 24;

/// Rows of the panel without its rule; one row is a summary, three and more show everything.
pub(super) fn rows(policy: &PolicyStatus, width: u16, most: u16, theme: Theme) -> u16 {
    if most < 3 {
        return most.min(1);
    }
    let rows = Arrangement::new(policy, usize::from(width.saturating_sub(2)), theme).rows();
    u16::try_from(rows.saturating_add(2)).unwrap_or(most).min(most)
}

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, rows: u16, model: &Model, theme: Theme) {
    let Some(policy) = &model.shown().policy else { return };
    let name = theme.safe(&policy.name);
    let name = text::cut(&name, usize::from(area.width / 2), theme.ellipsis()).into_owned();
    let mut remark = Line::default();
    if policy.dry_run {
        remark.push_span(Span::styled(format!("{} dry run", theme.symbol("▲", "!")), theme.warning()));
        remark.push_span(Span::raw("  "));
    }
    remark.push_span(Span::raw(name));
    let inner = view::panel(frame, area, "Policy", remark, theme);
    let width = usize::from(inner.width);
    let lines = if rows < 3 {
        vec![short(policy, width, theme)]
    } else {
        let mut lines = vec![first(policy, width, theme), second(policy, model, theme)];
        lines.extend(action(policy, width, usize::from(rows) - 2, theme));
        lines
    };
    for (line, row) in lines.into_iter().zip(inner.rows()) {
        frame.render_widget(line, row);
    }
}

/// Whether it acts, or why it holds; in at most `columns`.
fn state(policy: &PolicyStatus, columns: usize, theme: Theme) -> Span<'static> {
    match &policy.hold {
        None => Span::styled(format!("{} acting", theme.symbol("►", ">")), theme.good()),
        Some(hold) => {
            let head = format!("{} holds: {}", theme.symbol("▲", "!"), theme.safe(&hold.reason));
            let tail = hold.device.as_ref().map(|device| format!(": {}", theme.safe(device))).unwrap_or_default();
            Span::styled(shortened(&head, &tail, columns, theme), theme.warning())
        }
    }
}

/// Both in at most `columns`; `tail`, which names the device, goes last.
fn shortened(head: &str, tail: &str, columns: usize, theme: Theme) -> String {
    let whole = format!("{head}{tail}");
    match columns.checked_sub(text::width(tail)).filter(|room| *room > columns / 2) {
        Some(room) if text::width(&whole) > columns => format!("{}{tail}", text::cut(head, room, theme.ellipsis())),
        _ => text::cut(&whole, columns, theme.ellipsis()).into_owned(),
    }
}

/// A summary in one line: the reason of a hold, or latency and action.
fn short(policy: &PolicyStatus, width: usize, theme: Theme) -> Line<'static> {
    let mut line = Line::from(state(policy, width, theme));
    if policy.hold.is_some() {
        return line;
    }
    line.spans.extend([Span::raw(" "), Span::raw(latency(policy, theme)), Span::raw("   ")]);
    let axes = Arrangement::new(policy, width.saturating_sub(line.width()), theme).row(Style::new());
    line.spans.extend(axes.spans);
    line
}

/// The state at the left; at the right the counters that fit.
fn first(policy: &PolicyStatus, width: usize, theme: Theme) -> Line<'static> {
    let state = state(policy, width, theme);
    let counts = [
        ("chunks", policy.chunks, Style::new()),
        ("late", policy.late, Style::new()),
        ("unused", policy.unused, if policy.unused > 0 { theme.warning() } else { Style::new() }),
        ("actions", policy.actions, Style::new()),
        ("held", policy.held, Style::new()),
    ];
    let mut room = width.saturating_sub(state.width());
    let mut right = Vec::new();
    for (what, count, style) in counts.into_iter().rev() {
        let count = [Span::styled(format!("   {what} "), theme.faint()), Span::styled(count.to_string(), style)];
        let Some(left) = room.checked_sub(count.iter().map(Span::width).sum()) else { break };
        room = left;
        right.splice(0..0, count);
    }
    let mut line = Line::from(vec![state, Span::raw(" ".repeat(room))]);
    line.spans.extend(right);
    line
}

/// From the observation to the chunk, in ten columns.
fn latency(policy: &PolicyStatus, theme: Theme) -> String {
    let number = policy.latency_ms.map_or(theme.symbol("–", "-").to_owned(), |ms| {
        if ms < 99_999.0 { format!("{ms:.1}") } else { format!("{ms:.0e}") }
    });
    format!("{number:>7} ms")
}

/// The mask that the newest chunk was computed with, its latency and its age.
fn second(policy: &PolicyStatus, model: &Model, theme: Theme) -> Line<'static> {
    let devices = &model.shown().devices;
    let mut line =
        Line::from(vec![Span::styled("saw mask ", theme.faint()), Span::raw(policy.mask.hex(devices.len()))]);
    if devices.len() < MANY {
        line.push_span(Span::raw(" "));
        line.spans.extend(devices.iter().map(|device| bit(policy, device.id, theme)));
    }
    let age = policy.chunk_age.map_or(theme.symbol("–", "-").to_owned(), |ticks| ticks.to_string());
    line.spans.extend([
        Span::styled("   chunk ", theme.faint()),
        Span::raw(latency(policy, theme)),
        Span::styled("   age ", theme.faint()),
        Span::raw(format!("{age:>3} ticks")),
    ]);
    line
}

fn bit(policy: &PolicyStatus, id: ModalityId, theme: Theme) -> Span<'static> {
    let present = policy.mask.contains(id);
    let symbol = if present { theme.symbol("■", "#") } else { theme.symbol("□", ".") };
    Span::styled(symbol, theme.mask_cell(present, Edge::None))
}

/// The newest action, faint while it is not executed.
fn action(policy: &PolicyStatus, width: usize, rows: usize, theme: Theme) -> Vec<Line<'static>> {
    if policy.action.is_empty() {
        return vec![Line::styled("no action yet", theme.faint())];
    }
    Arrangement::new(policy, width, theme).lines(rows, if policy.hold.is_some() { theme.faint() } else { Style::new() })
}

type Axis = (String, f64, String);

/// How the axes of an action are arranged: all in a row where they fit, otherwise in columns of equal width.
#[derive(Debug, Clone, Copy)]
struct Arrangement<'a> {
    axes: &'a [Axis],
    width: usize,
    /// Columns of name and unit, and axes in a row; none where all are in one row.
    grid: Option<(usize, usize, usize)>,
    theme: Theme,
}

impl<'a> Arrangement<'a> {
    fn new(policy: &'a PolicyStatus, width: usize, theme: Theme) -> Self {
        let axes = policy.action.as_slice();
        let mut arranged = Self { axes, width, grid: None, theme };
        let together: usize = axes.iter().map(|axis| arranged.columns(axis) + GAP).sum();
        if together > width + GAP {
            let name = axes.iter().map(|axis| arranged.name(axis)).max().unwrap_or(0);
            let unit = axes.iter().map(|axis| arranged.unit(axis)).max().unwrap_or(0);
            arranged.grid = Some((name, unit, ((width + GAP) / (cell(name, unit) + GAP)).max(1)));
        }
        arranged
    }

    fn rows(self) -> usize {
        self.grid.map_or(1, |(.., per_row)| self.axes.len().div_ceil(per_row)).max(1)
    }

    fn name(self, (name, ..): &Axis) -> usize {
        text::width(&self.theme.safe(name)).min(NAME)
    }

    fn unit(self, (.., unit): &Axis) -> usize {
        text::width(&self.theme.safe(measure(unit))).min(UNIT)
    }

    fn columns(self, axis: &Axis) -> usize {
        cell(self.name(axis), self.unit(axis))
    }

    /// At most `rows` lines, with the number of axes that do not fit.
    fn lines(self, rows: usize, style: Style) -> Vec<Line<'static>> {
        match self.grid {
            Some((name, unit, per_row)) if rows > 1 => {
                let fits = per_row * rows;
                let spare = self.width.saturating_sub(per_row * (cell(name, unit) + GAP));
                let left = self.axes.len().saturating_sub(fits);
                // Without space for the number of the rest, it replaces the last axis.
                let shown = if left > 0 && text::width(&more(left)) > spare { fits - 1 } else { fits };
                let shown = self.axes.get(..shown).unwrap_or(self.axes);
                let mut lines: Vec<Line<'static>> = shown
                    .chunks(per_row)
                    .map(|row| row.iter().flat_map(|axis| self.axis(axis, name, unit, style)).collect())
                    .collect();
                self.rest(&mut lines, shown.len());
                lines
            }
            _ => vec![self.row(style)],
        }
    }

    /// As many as fit in one row.
    fn row(self, style: Style) -> Line<'static> {
        let mut line = Line::default();
        for (index, axis) in self.axes.iter().enumerate() {
            let behind = self.axes.len() - index - 1;
            let rest = if behind > 0 { GAP + text::width(&more(behind)) } else { 0 };
            let all_behind: usize = self.axes.iter().skip(index).map(|axis| self.columns(axis) + GAP).sum();
            let fits =
                line.width() + self.columns(axis) + rest <= self.width || line.width() + all_behind <= self.width + GAP;
            if !fits {
                let mut lines = vec![line];
                self.rest(&mut lines, index);
                return lines.pop().unwrap_or_default();
            }
            line.spans.extend(self.axis(axis, self.name(axis), self.unit(axis), style));
        }
        line
    }

    fn rest(self, lines: &mut [Line<'static>], shown: usize) {
        let left = self.axes.len() - shown;
        if let Some(last) = lines.last_mut().filter(|_| left > 0) {
            last.push_span(Span::styled(more(left), self.theme.faint()));
        }
    }

    fn axis(self, (name, number, unit): &Axis, columns: usize, of_unit: usize, style: Style) -> [Span<'static>; 3] {
        let Self { theme, .. } = self;
        let unit = if of_unit > 0 { format!(" {}", theme.column(measure(unit), of_unit)) } else { String::new() };
        [
            Span::styled(format!("{} ", theme.column(name, columns)), theme.faint()),
            Span::styled(format!("{:>VALUE$}", value(*number)), style),
            Span::styled(format!("{unit}{:GAP$}", ""), theme.faint()),
        ]
    }
}

/// Columns of an axis: name, value, unit.
const fn cell(name: usize, unit: usize) -> usize {
    name + 1 + VALUE + if unit > 0 { 1 + unit } else { 0 }
}

fn more(axes: usize) -> String {
    format!("{axes} more")
}

/// A dimensionless number has the unit 1, which is not shown.
fn measure(unit: &str) -> &str {
    if unit == "1" { "" } else { unit }
}

/// A value in at most [`VALUE`] columns, with as many decimals as there is room for, three at most.
fn value(value: f64) -> String {
    let size = value.abs();
    // A value shown as zero has no sign, which would flicker around zero.
    let value = if size < 0.0005 { 0.0 } else { value };
    match size {
        size if size < 99.9995 => format!("{value:.3}"),
        size if size < 999.995 => format!("{value:.2}"),
        size if size < 9999.95 => format!("{value:.1}"),
        size if size < 99_999.5 => format!("{value:.0}"),
        size if size.is_finite() => format!("{value:.0e}"),
        _ => value.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_value_has_as_many_decimals_as_fit() {
        let table = [
            (0.0, "0.000"),
            (-0.000_4, "0.000"),
            (-0.000_5, "-0.001"),
            (12.345_6, "12.346"),
            (-99.999_4, "-99.999"),
            (-99.999_9, "-100.00"),
            (1234.56, "1234.6"),
            (-12_345.6, "-12346"),
            (1e6, "1e6"),
            (f64::MIN, "-2e308"),
            (f64::NAN, "NaN"),
            (f64::NEG_INFINITY, "-inf"),
        ];
        for (number, text) in table {
            assert_eq!(value(number), text);
        }
    }

    proptest! {
        #[test]
        fn every_value_fits_its_column(number in any::<f64>()) {
            prop_assert!(value(number).len() <= VALUE, "{}", value(number));
        }
    }
}
