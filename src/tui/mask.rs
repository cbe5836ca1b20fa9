//! The mask panel: one cell a modality, filled while its bit is set.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::model::Model;
use super::theme::{Edge, Theme};
use super::view;
use crate::status::DeviceStatus;
use crate::text;

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
    /// Columns of a cell, and of the space behind it.
    fn cell(self) -> (usize, usize) {
        match self {
            // Space, symbol, space, bit, space, name, space.
            Self::Named(name) => (name + 7, 1),
            Self::Numbered => (4, 1),
            Self::Dots => (1, 0),
        }
    }
}

impl Plan {
    /// The most telling arrangement in at most `rows` rows.
    pub(super) fn new(model: &Model, width: u16, rows: u16) -> Self {
        let devices = &model.shown().devices;
        let width = usize::from(width.saturating_sub(2));
        let rows = usize::from(rows.clamp(1, 6));
        let name = devices.iter().map(|device| text::width(&device.name)).max().unwrap_or(0).clamp(1, NAME);
        let mut plan = None;
        for density in [Density::Named(name), Density::Numbered, Density::Dots] {
            let (cell, gap) = density.cell();
            let per_row = round((width + gap) / (cell + gap), density);
            let needed = devices.len().div_ceil(per_row).max(1);
            plan = Some(Self { density, per_row, rows: u16::try_from(needed.min(rows)).unwrap_or(1) });
            // Names are worth two rows, or three on a high terminal; more of them are a wall of text.
            let worth = if matches!(density, Density::Named(_)) { rows.min(3) } else { rows };
            if needed <= worth {
                break;
            }
        }
        plan.unwrap_or(Self { density: Density::Dots, per_row: 1, rows: 1 })
    }

    pub(super) fn rows(self) -> u16 {
        self.rows
    }
}

/// Rows of a mask are read in bytes: as many whole groups of eight as fit.
fn round(per_row: usize, density: Density) -> usize {
    match density {
        Density::Numbered | Density::Dots if per_row >= 8 => per_row / 8 * 8,
        _ => per_row.max(1),
    }
}

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, plan: &Plan, model: &Model, theme: Theme) {
    let snapshot = model.shown();
    let online = format!("{} of {} present", snapshot.mask.online_count(), snapshot.devices.len());
    let inner = view::panel(frame, area, "Mask", Span::styled(online, theme.faint()).into(), theme);
    for (row, devices) in inner.rows().take(usize::from(plan.rows)).zip(snapshot.devices.chunks(plan.per_row)) {
        let mut spans = Vec::with_capacity(devices.len() * 2);
        for device in devices {
            spans.push(cell(device, plan.density, model, theme));
            spans.push(Span::raw(" ".repeat(plan.density.cell().1)));
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
        Density::Numbered => format!("{symbol}{bit:>2} "),
        Density::Dots => symbol.to_owned(),
    };
    Span::styled(content, theme.mask_cell(present, edge))
}
