//! The last five minutes of each bit of the mask, a row each.

use rapid_core::text;
use rapid_status::DeviceState;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::history::{Bit, MASK_SECONDS};
use super::model::Model;
use super::theme::Theme;
use super::view;

/// Columns of the longest name.
const NAME: usize = 16;

/// Rows for the panel without its rule, at most `most`; 0 if not all bits fit.
pub(super) fn rows(model: &Model, most: u16) -> u16 {
    u16::try_from(model.shown().devices.len()).ok().filter(|rows| *rows <= most).unwrap_or(0)
}

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let devices = &model.shown().devices;
    let widest = devices.iter().map(|device| text::width(&device.name)).max().unwrap_or(0).min(NAME);
    let columns = usize::from(area.width).saturating_sub(widest + 7).min(MASK_SECONDS);
    let seconds = MASK_SECONDS.div_ceil(columns.max(1));
    let remark = Span::styled(format!("last 5 min, {seconds} s a column"), theme.faint());
    let inner = view::panel(frame, area, "Bits", remark.into(), theme);
    for (device, row) in devices.iter().zip(inner.rows()) {
        let mut spans = vec![
            Span::styled(format!("{:>3} ", device.id.bit()), theme.faint()),
            Span::raw(theme.column(&device.name, widest + 1)),
        ];
        spans.extend(model.bits(device.id, columns).into_iter().map(|bit| match bit {
            Bit::Unknown => Span::raw(" "),
            Bit::Set => Span::styled(theme.symbol("▄", "="), theme.state(DeviceState::Streaming)),
            Bit::Clear => Span::styled(theme.symbol("·", "."), theme.faint()),
            Bit::Edge => Span::styled(theme.symbol("┃", "|"), theme.warning()),
        }));
        frame.render_widget(Line::from(spans), row);
    }
}
