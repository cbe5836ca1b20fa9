//! The links to the page for a phone, the first as a QR code.

use rapid_pictures::qr;
use ratatui::Frame;
use ratatui::layout::{Constraint, Flex, Layout, Rect};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Clear, Paragraph};

use super::model::Model;
use super::theme::{Charset, Theme};

/// Rows of other links, at most.
const OTHERS: usize = 3;
/// Columns and rows of the border.
const BORDER: u16 = 2;

pub(super) fn draw(frame: &mut Frame<'_>, area: Rect, model: &Model, theme: Theme) {
    let Some((first, others)) = model.latest().links.split_first() else { return };
    let code = qr::half_blocks(first).filter(|_| theme.charset == Charset::Unicode).unwrap_or_default();
    let link = Line::raw(theme.safe(first));
    let columns = |lines: &[Line<'_>]| lines.iter().map(Line::width).max().unwrap_or(0) + usize::from(BORDER);
    let code: Vec<_> = code.into_iter().map(|row| Line::styled(row, theme.code())).collect();
    let room = usize::from(area.height.saturating_sub(BORDER)).saturating_sub(1);
    // A part of a code cannot be read.
    let code = if code.len() <= room && columns(&code) <= usize::from(area.width) {
        code
    } else {
        vec![Line::styled("The terminal is too small for the QR code.", theme.faint())]
    };
    let others = others.iter().take(OTHERS.min(room - code.len())).map(|link| Line::raw(theme.safe(link)));
    let lines: Vec<_> = code.into_iter().chain([link]).chain(others).collect();
    let clamp = |size: usize, most: u16| u16::try_from(size).unwrap_or(u16::MAX).min(most);
    let height = clamp(lines.len() + usize::from(BORDER), area.height);
    let width = clamp(columns(&lines), area.width);
    let [middle] = Layout::vertical([Constraint::Length(height)]).flex(Flex::Center).areas(area);
    let [middle] = Layout::horizontal([Constraint::Length(width)]).flex(Flex::Center).areas(middle);
    let block = Block::bordered()
        .border_set(theme.border())
        .border_style(theme.faint())
        .title(Span::styled(" The page for a phone ", theme.title()));
    frame.render_widget(Clear, middle);
    frame.render_widget(Paragraph::new(lines).centered().block(block), middle);
}
