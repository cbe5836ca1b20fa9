//! Pictures in the terminal: by its graphics protocol where it has one, otherwise as half blocks, or as characters where
//! there are no colours.
//!
//! Invariant: what a terminal can show follows from the environment and from the size of its window, so that the first frame
//! waits for no answer. Only one that calls itself kitty is asked for its version, because an old one would show boxes.

use image::imageops::FilterType;
use image::{DynamicImage, RgbImage};
use rapid_core::modality::ModalityId;
use rapid_pictures::pixels::{self, Pixels};
use rapid_status::palette::Palette;
use rapid_status::preview::Preview;
use ratatui::Frame;
use ratatui::layout::{Rect, Size};
use ratatui::text::Line;
use ratatui_image::picker::{Picker, ProtocolType};
use ratatui_image::protocol::Protocol;
use ratatui_image::{FontSize, Image, Resize};

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

    /// Every n-th pixel, so that none of its sides is much longer than the larger of `sides`.
    fn image(&self, [width, height]: [usize; 2]) -> Option<DynamicImage> {
        let step = (self.width / width.max(1)).min(self.height / height.max(1)).max(1);
        let (width, height, rgb) = pixels::every(step, [self.height, self.width], &self.rgb);
        let side = |side: usize| u32::try_from(side).ok();
        Some(DynamicImage::ImageRgb8(RgbImage::from_raw(side(width)?, side(height)?, rgb)?))
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

/// Where pictures are drawn, and the last one as the terminal takes it.
#[derive(Default)]
pub struct Canvas {
    /// `None`: as characters.
    picker: Option<Picker>,
    last: Option<(Key, Protocol)>,
    /// Where this frame, and the one before it, have a picture.
    drawn: [Option<Rect>; 2],
}

/// What a drawn picture depends on.
type Key = (ModalityId, u64, Size);

impl std::fmt::Debug for Canvas {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Canvas")
            .field("protocol", &self.picker.as_ref().map(Picker::protocol_type))
            .finish_non_exhaustive()
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
            "kitty" => ProtocolType::Kitty,
            "iterm2" => ProtocolType::Iterm2,
            "sixel" => ProtocolType::Sixel,
            "blocks" => ProtocolType::Halfblocks,
            // A multiplexer passes graphics on only where it is set up for them.
            _ if in_multiplexer => ProtocolType::Halfblocks,
            _ if set("KITTY_WINDOW_ID").is_some() || is("TERM", &["kitty", "ghostty"]) => {
                // Not needed where it reports no size.
                if cell.is_some() && places_pictures_in_text() { ProtocolType::Kitty } else { ProtocolType::Halfblocks }
            }
            _ if is("TERM_PROGRAM", &["iTerm", "WezTerm"])
                || is("LC_TERMINAL", &["iTerm"])
                || set("KONSOLE_VERSION").is_some() =>
            {
                ProtocolType::Iterm2
            }
            _ if is("TERM", &["foot", "mlterm", "sixel", "yaft", "contour"]) => ProtocolType::Sixel,
            _ => ProtocolType::Halfblocks,
        };
        // The kernel's console has 16 colours.
        if protocol == ProtocolType::Halfblocks && is("TERM", &["linux", "dumb", "vt"]) && wanted.is_empty() {
            return Self::default();
        }
        // A half block is a pixel: nothing larger than what is shown is computed.
        let (width, height) = cell.filter(|_| protocol != ProtocolType::Halfblocks).unwrap_or((1, 2));
        #[expect(deprecated, reason = "the alternative queries the terminal and waits for its answer")]
        let mut picker = Picker::from_fontsize(FontSize { width, height });
        picker.set_protocol_type(if cell.is_some() { protocol } else { ProtocolType::Halfblocks });
        Self { picker: Some(picker), ..Self::default() }
    }

    pub(super) fn begin_frame(&mut self) {
        self.drawn = [None, self.drawn[0]];
    }

    /// Whether a picture of the frame before would stay on the screen: this one has none there, and by these protocols some
    /// terminals (Konsole) keep a picture beneath the text that is written over it.
    pub(super) fn leaves_a_trace(&self) -> bool {
        let [now, before] = self.drawn;
        let stays = |picker: &Picker| matches!(picker.protocol_type(), ProtocolType::Sixel | ProtocolType::Iterm2);
        before.is_some() && before != now && self.picker.as_ref().is_some_and(stays)
    }

    /// Draws a picture as large as it fits, in its proportions.
    pub(super) fn draw(&mut self, frame: &mut Frame<'_>, area: Rect, picture: &Picture, theme: Theme) {
        if area.is_empty() {
            return;
        }
        let Some(picker) = self.picker.as_ref().filter(|_| theme.palette == Palette::Ansi) else {
            return as_text(frame, area, picture);
        };
        let size = Size::new(area.width, area.height);
        let key = (picture.device, picture.seq, size);
        if self.last.as_ref().is_none_or(|(last, _)| *last != key) {
            let FontSize { width, height } = picker.font_size();
            let pixels = [(size.width, width), (size.height, height)]
                .map(|(cells, side)| usize::from(cells) * usize::from(side));
            let scaled = Resize::Scale(Some(FilterType::Triangle));
            let image = picture.image(pixels.map(|side| side * 2));
            let protocol = image.and_then(|image| picker.new_protocol(image, size, scaled).ok());
            self.last = protocol.map(|protocol| (key, protocol));
        }
        match &self.last {
            Some((_, protocol)) => {
                frame.render_widget(Image::new(protocol), area);
                self.drawn[0] = Some(area);
            }
            None => as_text(frame, area, picture),
        }
    }
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
            canvas.picker.map(|picker| picker.protocol_type())
        };
        let cell = Some((8, 16));
        for (environment, cell, expected) in [
            (&[("TERM", "xterm-256color")][..], cell, Some(ProtocolType::Halfblocks)),
            (&[("TERM", "xterm-kitty")], cell, Some(ProtocolType::Kitty)),
            (&[("TERM", "xterm-256color"), ("KONSOLE_VERSION", "221203")], cell, Some(ProtocolType::Iterm2)),
            (&[("TERM", "xterm-kitty")], None, Some(ProtocolType::Halfblocks)),
            (&[("TERM", "xterm-kitty"), ("TMUX", "/tmp/x")], cell, Some(ProtocolType::Halfblocks)),
            (&[("TERM", "xterm-256color"), ("LC_TERMINAL", "iTerm2")], cell, Some(ProtocolType::Iterm2)),
            (&[("TERM", "foot")], cell, Some(ProtocolType::Sixel)),
            (&[("TERM", "linux")], cell, None),
            (&[("TERM", "linux"), ("RAPID_PICTURES", "blocks")], cell, Some(ProtocolType::Halfblocks)),
            (&[("TERM", "foot"), ("RAPID_PICTURES", "text")], cell, None),
        ] {
            assert_eq!(detected(environment, cell), expected, "{environment:?} {cell:?}");
        }
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
