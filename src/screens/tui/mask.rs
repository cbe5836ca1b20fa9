//! The mask panel: one cell per modality, filled while its bit is set.

use rapid_core::text;
use rapid_status::DeviceStatus;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::model::Model;
use super::theme::{Edge, Theme};
use super::view;

/// Longest name in a cell, columns.
const NAME: usize = 16;

/// How the cells are arranged: as much of each as fits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Plan {
    density: Density,
    per_row: usize,
    rows: u16,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Density {
    /// Bit and name, the name in this many columns.
    Named(usize),
    /// Bit alone.
    Numbered,
    /// A symbol alone.
    Dots,
}

impl Density {
    /// Columns of a cell with the space after it.
    fn cell(self) -> usize {
        match self {
            // Space, symbol, space, two digits, space, name, space.
            Self::Named(name) => name + 8,
            Self::Numbered => 4,
            Self::Dots => 1,
        }
    }

    /// The most cells in a row of `width` columns. A mask is read in bytes: without names, as many
    /// whole groups of eight as fit.
    fn per_row(self, width: usize) -> usize {
        let whole = match self {
            Self::Named(_) => return (width + 1) / self.cell(),
            Self::Numbered => (width + 1) / (8 * self.cell()) * 8,
            Self::Dots => (width + 1) / 9 * 8,
        };
        if whole > 0 { whole } else { width / self.cell() }
    }

    /// Space between the cell at `column` of a row and the next.
    fn gap(self, column: usize) -> &'static str {
        match self {
            Self::Dots if column % 8 != 7 => "",
            _ => " ",
        }
    }
}

impl Plan {
    /// The most detailed arrangement in at most `rows` rows.
    pub(super) fn new(model: &Model, width: u16, rows: u16) -> Self {
        let devices = &model.shown().devices;
        let width = usize::from(width.saturating_sub(2));
        let rows = usize::from(rows.clamp(1, 6));
        let name = devices.iter().map(|device| text::width(&device.name)).max().unwrap_or(0).clamp(1, NAME);
        // Names in more than three rows are hard to read.
        let names = Self::fit(Density::Named(name), devices.len(), width);
        if usize::from(names.rows) <= rows.min(3) {
            return names;
        }
        let numbers = Self::fit(Density::Numbered, devices.len(), width);
        if usize::from(numbers.rows) <= rows {
            return numbers;
        }
        Self::fit(Density::Dots, devices.len(), width)
    }

    fn fit(density: Density, devices: usize, width: usize) -> Self {
        let most = density.per_row(width).max(1);
        let rows = devices.div_ceil(most).max(1);
        // Rows of equal length, in whole groups of eight.
        let even = devices.div_ceil(rows).next_multiple_of(8).min(most).max(1);
        let per_row = if matches!(density, Density::Named(_)) { most } else { even };
        Self { density, per_row, rows: u16::try_from(rows).unwrap_or(u16::MAX) }
    }

    pub(super) fn rows(self) -> u16 {
        self.rows
    }
}

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, plan: &Plan, model: &Model, theme: Theme) {
    let snapshot = model.shown();
    let online = format!("{} of {} present", snapshot.mask.online_count(), snapshot.devices.len());
    let inner = view::panel(frame, area, "Mask", Span::styled(online, theme.faint()).into(), theme);
    for (row, devices) in inner.rows().zip(snapshot.devices.chunks(plan.per_row)) {
        let mut spans = Vec::with_capacity(devices.len() * 2);
        for (column, device) in devices.iter().enumerate() {
            spans.push(cell(device, plan.density, model, theme));
            spans.push(Span::raw(plan.density.gap(column)));
        }
        frame.render_widget(Line::from(spans), row);
    }
}

fn cell(device: &DeviceStatus, density: Density, model: &Model, theme: Theme) -> Span<'static> {
    let present = model.shown().mask.contains(device.id);
    let edge = model.edge(device.id);
    let symbol = match (present, edge) {
        (true, Edge::None) => theme.symbol("■", "#"),
        (false, Edge::None) => theme.symbol("□", "."),
        (true, Edge::Recent) => theme.symbol("▲", "^"),
        (false, Edge::Recent) => theme.symbol("▼", "v"),
    };
    let bit = device.id.bit();
    let content = match density {
        Density::Named(name) => format!(" {symbol} {bit:>2} {} ", theme.column(&device.name, name)),
        Density::Numbered => format!("{symbol}{bit:>2}"),
        Density::Dots => symbol.to_owned(),
    };
    Span::styled(content, theme.mask_cell(present, edge))
}
