//! Pictures by the terminal's graphics protocol.

use image::imageops::FilterType;
use image::{DynamicImage, RgbImage};
use ratatui::Frame;
use ratatui::layout::{Rect, Size};
use ratatui_image::picker::{Picker, ProtocolType};
use ratatui_image::{FontSize, Image, Resize};

use super::{Picture, Protocol};

/// What encodes pictures for the terminal of this run.
pub(super) struct Encoder(Picker);

impl Encoder {
    /// For a terminal with cells of so many pixels; `None` for half blocks, which are text.
    pub(super) fn new(protocol: Protocol, (width, height): (u16, u16)) -> Option<Self> {
        let protocol = match protocol {
            Protocol::Blocks => return None,
            Protocol::Kitty => ProtocolType::Kitty,
            Protocol::Iterm2 => ProtocolType::Iterm2,
            Protocol::Sixel => ProtocolType::Sixel,
        };
        // In tmux it runs a program, so it is made once.
        #[expect(deprecated, reason = "the alternative queries the terminal and waits for its answer")]
        let mut picker = Picker::from_fontsize(FontSize { width, height });
        picker.set_protocol_type(protocol);
        Some(Self(picker))
    }

    /// `picture` as large as it fits into `size` cells, in its proportions; `None` if it cannot be encoded.
    pub(super) fn encode(&self, picture: &Picture, size: Size) -> Option<Graphics> {
        let FontSize { width, height } = self.0.font_size();
        let sides =
            [(size.width, width), (size.height, height)].map(|(cells, side)| usize::from(cells) * usize::from(side));
        let (width, height, rgb) = picture.scaled_down(sides);
        let [width, height] = [width, height].map(u32::try_from);
        let image = DynamicImage::ImageRgb8(RgbImage::from_raw(width.ok()?, height.ok()?, rgb)?);
        self.0.new_protocol(image, size, Resize::Scale(Some(FilterType::Triangle))).ok().map(Graphics)
    }
}

/// A picture as the terminal takes it.
pub(super) struct Graphics(ratatui_image::protocol::Protocol);

impl Graphics {
    pub(super) fn draw(&self, frame: &mut Frame<'_>, area: Rect) {
        frame.render_widget(Image::new(&self.0), area);
    }
}
