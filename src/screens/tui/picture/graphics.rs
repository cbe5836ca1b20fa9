//! Pictures by the terminal's graphics protocol.

use image::imageops::FilterType;
use image::{DynamicImage, RgbImage};
use ratatui::Frame;
use ratatui::layout::{Rect, Size};
use ratatui_image::picker::{Picker, ProtocolType};
use ratatui_image::{FontSize, Image, Resize};

use super::{Picture, Protocol};

/// A picture as the terminal takes it.
pub(super) struct Graphics(ratatui_image::protocol::Protocol);

impl Graphics {
    /// `picture` as large as it fits into `size` cells, each of `cell` pixels, in its proportions; `None` if it cannot be encoded.
    pub(super) fn new(protocol: Protocol, picture: &Picture, (width, height): (u16, u16), size: Size) -> Option<Self> {
        #[expect(deprecated, reason = "the alternative queries the terminal and waits for its answer")]
        let mut picker = Picker::from_fontsize(FontSize { width, height });
        picker.set_protocol_type(match protocol {
            Protocol::Blocks => ProtocolType::Halfblocks,
            Protocol::Kitty => ProtocolType::Kitty,
            Protocol::Iterm2 => ProtocolType::Iterm2,
            Protocol::Sixel => ProtocolType::Sixel,
        });
        let sides =
            [(size.width, width), (size.height, height)].map(|(cells, side)| usize::from(cells) * usize::from(side));
        let (width, height, rgb) = picture.scaled_down(sides);
        let [width, height] = [width, height].map(u32::try_from);
        let image = DynamicImage::ImageRgb8(RgbImage::from_raw(width.ok()?, height.ok()?, rgb)?);
        picker.new_protocol(image, size, Resize::Scale(Some(FilterType::Triangle))).ok().map(Self)
    }

    pub(super) fn draw(&self, frame: &mut Frame<'_>, area: Rect) {
        frame.render_widget(Image::new(&self.0), area);
    }
}
