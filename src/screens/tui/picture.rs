//! Pictures in the terminal: by its graphics protocol where it has one, otherwise as half blocks, or as characters where
//! there are no colours.
//!
//! Invariant: what a terminal can show follows from the environment and from the size of its window, so that the first frame
//! waits for no answer. Only one that calls itself kitty is asked for its version, because an old one would show boxes.

#[cfg(feature = "graphics")]
mod graphics;

use std::ops::Range;

use rapid_core::modality::ModalityId;
use rapid_pictures::pixels::{self, Pixels};
use rapid_status::palette::Palette;
use rapid_status::preview::Preview;
use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::{Rect, Size};
use ratatui::style::{Color, Style};
use ratatui::text::Line;

use super::theme::Theme;

/// Longest side of a picture that is kept, in pixels: more than a terminal shows, and quick to scale.
const LARGEST: usize = 640;
/// From dark to light.
const RAMP: &[u8] = b" .:-=+*#%@";

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Picture {
    device: ModalityId,
    seq: u64,
    width: usize,
    height: usize,
    /// Red, green, blue, row by row.
    rgb: Vec<u8>,
}

impl Picture {
    /// Decodes a preview; `None` if it is not a picture.
    ///
    /// # Errors
    /// When it is damaged: why.
    pub(super) fn decode(preview: &Preview) -> Option<Result<Self, String>> {
        if !preview.is_picture() {
            return None;
        }
        let Preview { encoding, width, height, .. } = *preview;
        let mut pixels = Pixels::default();
        let decoded = pixels.decode(&pixels::Picture { encoding, width, height, bytes: &preview.payload });
        let of = |[height, width]: [usize; 2]| Self::thinned(preview, [height, width], pixels.values());
        Some(decoded.map(of).map_err(|error| error.to_string()))
    }

    /// Every n-th pixel, so that no side is longer than [`LARGEST`].
    fn thinned(preview: &Preview, [height, width]: [usize; 2], values: &[u8]) -> Self {
        let step = width.max(height).div_ceil(LARGEST).max(1);
        let (width, height, rgb) = pixels::every(step, [height, width], values);
        Self { device: preview.device, seq: preview.seq, width, height, rgb }
    }

    /// Width, height and every n-th pixel, so that none of its sides is shorter than those of `sides`, nor much longer than
    /// twice the larger.
    fn scaled_down(&self, [width, height]: [usize; 2]) -> (usize, usize, Vec<u8>) {
        let step = (self.width / (2 * width).max(1)).min(self.height / (2 * height).max(1)).max(1);
        pixels::every(step, [self.height, self.width], &self.rgb)
    }

    /// Brightness, 0 to 1, at a place given by shares of width and height.
    fn brightness(&self, x: f64, y: f64) -> f64 {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the picture")]
        let at = |share: f64, side: usize| ((share * side as f64) as usize).min(side.saturating_sub(1));
        let place = (at(y, self.height) * self.width + at(x, self.width)) * pixels::CHANNELS;
        let sum: u32 =
            self.rgb.get(place..place + pixels::CHANNELS).unwrap_or_default().iter().map(|v| u32::from(*v)).sum();
        f64::from(sum) / (255.0 * pixels::CHANNELS as f64)
    }
}

/// How a terminal shows pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Protocol {
    /// Half blocks in two colours, two pixels to a cell.
    Blocks,
    /// Kitty's graphics protocol, with placeholders among the text.
    Kitty,
    /// iTerm2's inline images.
    Iterm2,
    /// DEC's sixels.
    Sixel,
}

/// Where pictures are drawn, and the last one as the terminal takes it.
#[derive(Default)]
pub struct Canvas {
    /// `None`: as characters.
    protocol: Option<Protocol>,
    /// By a graphics protocol.
    #[cfg(feature = "graphics")]
    encoder: Option<graphics::Encoder>,
    last: Option<(Key, Encoded)>,
    /// Where this frame, and the one before it, have a picture.
    drawn: [Option<Rect>; 2],
}

/// What a drawn picture depends on.
type Key = (ModalityId, u64, Size);

/// A picture as it is written to the terminal.
enum Encoded {
    Blocks(Blocks),
    #[cfg(feature = "graphics")]
    Graphics(graphics::Graphics),
}

impl std::fmt::Debug for Canvas {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Canvas").field("protocol", &self.protocol).finish_non_exhaustive()
    }
}

impl Canvas {
    /// For the terminal of this environment, with cells of `cell` pixels if it reports them.
    ///
    /// `RAPID_PICTURES` chooses: `kitty`, `iterm2`, `sixel`, `blocks` or `text`.
    ///
    /// Kitty's pictures need a terminal that has them among text (kitty 0.28 or newer), which `places_pictures_in_text` finds
    /// out.
    pub fn detect(
        variable: impl Fn(&str) -> Option<String>,
        cell: Option<(u16, u16)>,
        places_pictures_in_text: impl FnOnce() -> bool,
    ) -> Self {
        let set = |name: &str| variable(name).filter(|value| !value.is_empty());
        let is =
            |name: &str, words: &[&str]| set(name).is_some_and(|value| words.iter().any(|word| value.contains(word)));
        let wanted = set("RAPID_PICTURES").unwrap_or_default();
        let in_multiplexer = set("TMUX").is_some() || is("TERM", &["screen", "tmux"]);
        let protocol = match wanted.as_str() {
            "text" => return Self::default(),
            "kitty" => Protocol::Kitty,
            "iterm2" => Protocol::Iterm2,
            "sixel" => Protocol::Sixel,
            "blocks" => Protocol::Blocks,
            // A multiplexer passes graphics on only where it is set up for them.
            _ if in_multiplexer => Protocol::Blocks,
            _ if set("KITTY_WINDOW_ID").is_some() || is("TERM", &["kitty", "ghostty"]) => {
                // Not needed where it reports no size.
                if cfg!(feature = "graphics") && cell.is_some() && places_pictures_in_text() {
                    Protocol::Kitty
                } else {
                    Protocol::Blocks
                }
            }
            _ if is("TERM_PROGRAM", &["iTerm", "WezTerm"])
                || is("LC_TERMINAL", &["iTerm"])
                || set("KONSOLE_VERSION").is_some() =>
            {
                Protocol::Iterm2
            }
            _ if is("TERM", &["foot", "mlterm", "sixel", "yaft", "contour"]) => Protocol::Sixel,
            _ => Protocol::Blocks,
        };
        // The kernel's console has 16 colours.
        if protocol == Protocol::Blocks && is("TERM", &["linux", "dumb", "vt"]) && wanted.is_empty() {
            return Self::default();
        }
        Self {
            protocol: Some(if cell.is_some() && cfg!(feature = "graphics") { protocol } else { Protocol::Blocks }),
            #[cfg(feature = "graphics")]
            encoder: cell.and_then(|cell| graphics::Encoder::new(protocol, cell)),
            ..Self::default()
        }
    }

    pub(super) fn begin_frame(&mut self) {
        self.drawn = [None, self.drawn[0]];
    }

    /// Whether a picture of the frame before would stay on the screen: this one has none there, and by these protocols some
    /// terminals (Konsole) keep a picture beneath the text that is written over it.
    pub(super) fn leaves_a_trace(&self) -> bool {
        let [now, before] = self.drawn;
        before.is_some() && before != now && matches!(self.protocol, Some(Protocol::Sixel | Protocol::Iterm2))
    }

    /// Draws a picture as large as it fits, in its proportions.
    pub(super) fn draw(&mut self, frame: &mut Frame<'_>, area: Rect, picture: &Picture, theme: Theme) {
        if area.is_empty() {
            return;
        }
        let Some(protocol) = self.protocol.filter(|_| theme.palette == Palette::Ansi) else {
            return as_text(frame, area, picture);
        };
        let size = Size::new(area.width, area.height);
        let key = (picture.device, picture.seq, size);
        if self.last.as_ref().is_none_or(|(last, _)| *last != key) {
            self.last = self.encode(protocol, picture, size).map(|encoded| (key, encoded));
        }
        match &self.last {
            Some((_, Encoded::Blocks(blocks))) => blocks.draw(frame.buffer_mut(), area),
            #[cfg(feature = "graphics")]
            Some((_, Encoded::Graphics(graphics))) => graphics.draw(frame, area),
            None => return as_text(frame, area, picture),
        }
        self.drawn[0] = Some(area);
    }

    /// `None` if it cannot be encoded.
    #[cfg_attr(not(feature = "graphics"), expect(clippy::unused_self, reason = "half blocks need no encoder"))]
    fn encode(&self, protocol: Protocol, picture: &Picture, size: Size) -> Option<Encoded> {
        match protocol {
            Protocol::Blocks => Some(Encoded::Blocks(Blocks::new(picture, size))),
            #[cfg(feature = "graphics")]
            _ => self.encoder.as_ref()?.encode(picture, size).map(Encoded::Graphics),
            #[cfg(not(feature = "graphics"))]
            _ => None,
        }
    }
}

/// A picture in half blocks.
struct Blocks {
    width: usize,
    /// Row by row, the colours of both pixels of each cell; none below an odd number of rows.
    cells: Vec<(Color, Option<Color>)>,
}

impl Blocks {
    /// As large as it fits into `size`, in its proportions: a pixel is as high as it is wide.
    fn new(picture: &Picture, size: Size) -> Self {
        let (columns, rows) = (usize::from(size.width), 2 * usize::from(size.height));
        let (width, height) = (picture.width.max(1), picture.height.max(1));
        // The side that the area limits is filled, the other one follows.
        let (columns, rows) = if columns * height <= rows * width {
            (columns, (columns * height).div_euclid(width).max(1))
        } else {
            ((rows * width).div_euclid(height).max(1), rows)
        };
        let (width, height, rgb) = picture.scaled_down([columns, rows]);
        let pixel = |column: usize, row: usize| {
            let [xs, ys] = [(column, columns, width), (row, rows, height)].map(|(at, of, side)| {
                let first = (at * side / of).min(side.saturating_sub(1));
                first..((at + 1) * side).div_ceil(of).clamp(first + 1, side.max(first + 1))
            });
            mean(&rgb, width, xs, ys)
        };
        let cell = |row: usize, column: usize| (pixel(column, row), (row + 1 < rows).then(|| pixel(column, row + 1)));
        let cells = (0..rows).step_by(2).flat_map(|row| (0..columns).map(move |column| (row, column)));
        Self { width: columns, cells: cells.map(|(row, column)| cell(row, column)).collect() }
    }

    fn draw(&self, buffer: &mut Buffer, area: Rect) {
        for (row, cells) in area.rows().zip(self.cells.chunks(self.width.max(1))) {
            for (position, (upper, lower)) in row.positions().zip(cells) {
                if let Some(cell) = buffer.cell_mut(position) {
                    let style = Style::reset().fg(*upper);
                    cell.set_symbol("▀").set_style(lower.map_or(style, |lower| style.bg(lower)));
                }
            }
        }
    }
}

/// The mean colour of a part of a picture.
fn mean(rgb: &[u8], width: usize, xs: Range<usize>, ys: Range<usize>) -> Color {
    let mut sums = [0; pixels::CHANNELS];
    let mut count = 0;
    for y in ys {
        let row = rgb.get((y * width + xs.start) * pixels::CHANNELS..(y * width + xs.end) * pixels::CHANNELS);
        for pixel in row.unwrap_or_default().chunks_exact(pixels::CHANNELS) {
            sums.iter_mut().zip(pixel).for_each(|(sum, value)| *sum += usize::from(*value));
            count += 1;
        }
    }
    // Means of bytes.
    let [red, green, blue] = sums.map(|sum| u8::try_from(sum / count.max(1)).unwrap_or(u8::MAX));
    Color::Rgb(red, green, blue)
}

/// A character per cell, by brightness.
fn as_text(frame: &mut Frame<'_>, area: Rect, picture: &Picture) {
    // A cell is twice as high as it is wide.
    let scale =
        (f64::from(area.width) / picture.width as f64).min(f64::from(area.height) * 2.0 / picture.height as f64);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most the area")]
    let (columns, rows) = ((picture.width as f64 * scale) as usize, (picture.height as f64 * scale / 2.0) as usize);
    for (place, row) in area.rows().take(rows).enumerate() {
        let symbol = |column: usize| {
            let share = |at: usize, of: usize| (at as f64 + 0.5) / of as f64;
            let brightness = picture.brightness(share(column, columns), share(place, rows));
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 9")]
            RAMP.get((brightness * (RAMP.len() as f64 - 0.01)) as usize).copied().map_or(' ', char::from)
        };
        frame.render_widget(Line::raw((0..columns).map(symbol).collect::<String>()), row);
    }
}

#[cfg(test)]
mod tests {
    use rapid_core::sample::Encoding;

    use super::*;

    fn grey(width: u32, height: u32, shade: impl Fn(u32, u32) -> u8) -> Preview {
        let payload: Vec<u8> =
            (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| shade(x, y)).collect();
        let bytes = payload.len();
        Preview { encoding: Encoding::Grey, width, height, bytes, payload: payload.into(), ..crate::literal::preview() }
    }

    #[test]
    fn a_large_picture_is_thinned_and_a_damaged_one_is_an_error() {
        let large = Picture::decode(&grey(1300, 700, |x, _| if x < 650 { 0 } else { 255 })).unwrap().unwrap();
        assert_eq!((large.width, large.height, large.rgb.len()), (434, 234, 434 * 234 * 3));
        assert!(large.brightness(0.2, 0.5) < 0.1 && large.brightness(0.8, 0.5) > 0.9);
        let mut short = grey(8, 8, |_, _| 0);
        short.payload = short.payload[1..].into();
        assert!(Picture::decode(&short).unwrap().is_err());
        assert!(Picture::decode(&crate::literal::preview()).is_none());
        let numbers = Preview { encoding: Encoding::F64, width: 3, ..crate::literal::preview() };
        assert!(Picture::decode(&numbers).is_none(), "the width of numbers is their count");
    }

    #[test]
    fn the_environment_decides_how_pictures_are_drawn() {
        let detected = |environment: &[(&str, &str)], cell| {
            let canvas = Canvas::detect(
                |name| environment.iter().find(|(key, _)| *key == name).map(|(_, value)| (*value).to_owned()),
                cell,
                || true,
            );
            canvas.protocol
        };
        let cell = Some((8, 16));
        for (environment, cell, expected) in [
            (&[("TERM", "xterm-256color")][..], cell, Some(Protocol::Blocks)),
            (&[("TERM", "xterm-kitty")], cell, Some(Protocol::Kitty)),
            (&[("TERM", "xterm-256color"), ("KONSOLE_VERSION", "221203")], cell, Some(Protocol::Iterm2)),
            (&[("TERM", "xterm-kitty")], None, Some(Protocol::Blocks)),
            (&[("TERM", "xterm-kitty"), ("TMUX", "/tmp/x")], cell, Some(Protocol::Blocks)),
            (&[("TERM", "xterm-256color"), ("LC_TERMINAL", "iTerm2")], cell, Some(Protocol::Iterm2)),
            (&[("TERM", "foot")], cell, Some(Protocol::Sixel)),
            (&[("TERM", "linux")], cell, None),
            (&[("TERM", "linux"), ("RAPID_PICTURES", "blocks")], cell, Some(Protocol::Blocks)),
            (&[("TERM", "foot"), ("RAPID_PICTURES", "text")], cell, None),
        ] {
            assert_eq!(detected(environment, cell), expected, "{environment:?} {cell:?}");
        }
    }

    #[test]
    fn half_blocks_keep_the_proportions_and_the_mean_colours() {
        // White above, black below; the right half is as bright as the mean of stripes of 0 and 200.
        let shade = |x: u32, y: u32| match (x < 16, y < 8) {
            (false, _) => 200 * u8::try_from(x / 4 % 2).unwrap(),
            (true, true) => 255,
            (true, false) => 0,
        };
        let picture = Picture::decode(&grey(32, 16, shade)).unwrap().unwrap();
        let rgb = |value| Color::Rgb(value, value, value);
        for (area, columns, rows) in [((8, 9), 8, 4), ((20, 2), 8, 4), ((4, 4), 4, 2), ((2, 4), 2, 1), ((1, 1), 1, 1)] {
            let blocks = Blocks::new(&picture, Size::from(area));
            assert_eq!((blocks.width, blocks.cells.len()), (columns, columns * usize::div_ceil(rows, 2)), "{area:?}");
            assert!(blocks.cells.iter().all(|(_, lower)| lower.is_some() == (rows > 1)), "{area:?}");
        }
        let Blocks { width, cells } = Blocks::new(&picture, Size::new(4, 2));
        assert_eq!(
            (width, cells),
            (
                4,
                vec![
                    (rgb(255), Some(rgb(0))),
                    (rgb(255), Some(rgb(0))),
                    (rgb(100), Some(rgb(100))),
                    (rgb(100), Some(rgb(100)))
                ]
            )
        );
        // Enlarged: a pixel is repeated.
        let small = Picture::decode(&grey(2, 1, |x, _| if x == 0 { 9 } else { 90 })).unwrap().unwrap();
        let Blocks { width, cells } = Blocks::new(&small, Size::new(4, 1));
        assert_eq!(
            (width, &cells[..2], &cells[2..]),
            (4, &[(rgb(9), Some(rgb(9))); 2][..], &[(rgb(90), Some(rgb(90))); 2][..])
        );
        // An odd number of rows ends with an upper half.
        let square = Picture::decode(&grey(3, 3, |_, _| 7)).unwrap().unwrap();
        assert_eq!(Blocks::new(&square, Size::new(3, 9)).cells[3..], [(rgb(7), None); 3]);
    }

    #[test]
    fn a_picture_that_is_no_longer_there_is_cleared_where_text_does_not_cover_it() {
        use ratatui::Terminal;
        use ratatui::backend::TestBackend;
        let picture = Picture::decode(&grey(8, 8, |x, _| if x < 4 { 0 } else { 255 })).unwrap().unwrap();
        for (protocol, stays) in
            [("sixel", true), ("iterm2", true), ("kitty", false), ("blocks", false), ("text", false)]
        {
            let wanted = |name: &str| (name == "RAPID_PICTURES").then(|| protocol.to_owned());
            let mut canvas = Canvas::detect(wanted, Some((8, 16)), || false);
            let mut terminal = Terminal::new(TestBackend::new(20, 10)).unwrap();
            let places = [None, Some(0), Some(0), Some(2), None, None];
            let traces = places.map(|x| {
                canvas.begin_frame();
                let draw = |frame: &mut Frame<'_>| {
                    if let Some(x) = x {
                        canvas.draw(frame, Rect::new(x, 0, 10, 5), &picture, Theme::detect(Palette::Ansi, |_| None));
                    }
                };
                terminal.draw(draw).unwrap();
                canvas.leaves_a_trace()
            });
            assert_eq!(traces, [false, false, false, stays, stays, false], "{protocol}");
        }
    }
}
