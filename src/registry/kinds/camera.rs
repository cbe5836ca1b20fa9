//! `node = "camera"`: a V4L2 camera, with its table `[device.NAME.camera]`.

use rapid_core::modality::ModalityKind;
use rapid_core::sample::Encoding;
use serde::Serialize;

use super::lan::LanPicture;
use super::{Kind, NodeSpec, Settings, compressed, serial};
use crate::keys::{About, Key, Own, Words, keys, own, table, text, whole};
use crate::parse::program::Programs;
use crate::section::Section;
use crate::spec::Opens;

pub(crate) const TABLE: Key = table("camera", "A camera.", || About::Table(&[CameraSpec::KEYS]));

/// In um.
const MILLIMETRE: u32 = 1000;

const DISTANCE: Own<u32> = text(distance, "a distance, `\"1um\"` to `\"100mm\"`");
const CONTROLS: Own<Vec<(String, i64)>> =
    own(controls, "a table of whole numbers", r#"{"type": "object", "additionalProperties": {"type": "integer"}}"#);

keys! {
    /// `[device.NAME.camera]`.
    #[derive(Debug, Clone, PartialEq, Eq)]
    pub struct CameraSpec {
        /// Width of an image, pixels.
        width: u32 = whole::<u32>(1, 8192), or 640;
        /// Height of an image, pixels.
        height: u32 = whole::<u32>(1, 8192), or 480;
        /// Images per second.
        fps: u32 = whole::<u32>(1, 1000), or 30;
        /// Pixel format. `Z16` is depth.
        format: PixelFormat = Words(&PixelFormat::WORDS), or PixelFormat::Mjpg;
        /// Of depth: what one count is.
        depth_unit_um "depth_unit": u32 = DISTANCE, usually "`\"1mm\"`", or MILLIMETRE;
        /// V4L2 controls that are set at the start, by the names that `rapid devices` lists.
        controls: Vec<(String, i64)> = CONTROLS, usually "none", or Vec::new();
    }
}

/// Pixel formats that can be requested of a camera, by their V4L2 names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum PixelFormat {
    /// Motion JPEG.
    Mjpg,
    /// YUV 4:2:2 packed.
    Yuyv,
    /// 8-bit luminance.
    Grey,
    /// 16-bit depth.
    Z16,
}

rapid_core::words! {
    /// Every format and its V4L2 name.
    PixelFormat, 4: "MJPG" = Mjpg, "YUYV" = Yuyv, "GREY" = Grey, "Z16" = Z16;
}

impl PixelFormat {
    /// How its pictures are encoded.
    pub const fn encoding(self) -> Encoding {
        match self {
            Self::Mjpg => Encoding::Mjpeg,
            Self::Yuyv => Encoding::Yuyv,
            Self::Grey => Encoding::Grey,
            Self::Z16 => Encoding::Depth,
        }
    }
}

impl CameraSpec {
    /// Bytes per second; for compressed pictures, of at most `max_bytes` each, an upper limit.
    pub fn bytes_per_second(&self, max_bytes: usize) -> f64 {
        let pixels = f64::from(self.width) * f64::from(self.height);
        let picture = self.format.encoding().pixel_bytes().map_or(max_bytes as f64, |bytes| bytes as f64 * pixels);
        picture * f64::from(self.fps)
    }
}

impl Kind for CameraSpec {
    fn modality_kind(&self) -> ModalityKind {
        if self.format == PixelFormat::Z16 { ModalityKind::Depth } else { ModalityKind::Image }
    }

    fn shape(&self) -> Vec<u32> {
        vec![self.height, self.width]
    }

    fn opens(&self) -> Opens {
        Opens::Video
    }

    fn picture(&self) -> Option<LanPicture> {
        Some(LanPicture { width: self.width, height: self.height, fps: self.fps })
    }

    fn format(&self) -> String {
        format!("{}x{}@{} {}", self.width, self.height, self.fps, self.format)
    }

    fn descriptor(&self) -> String {
        let Self { width, height, fps, format, .. } = self;
        format!("    width: {width}\n    height: {height}\n    fps: {fps}\n    format: \"{format}\"\n")
    }

    fn sizes(&self) -> (u64, u64) {
        let pixels = u64::from(self.width) * u64::from(self.height);
        match self.format.encoding().pixel_bytes() {
            Some(bytes) => (bytes as u64 * pixels, bytes as u64 * pixels),
            None => (compressed(2 * pixels), 1024),
        }
    }

    fn bytes_per_second(&self, max_bytes: usize) -> Option<f64> {
        Some(self.bytes_per_second(max_bytes))
    }
}

#[expect(clippy::unnecessary_wraps, reason = "as of every kind")]
pub(crate) fn read(entry: &Section<'_>, _: Programs<'_>) -> Option<Settings> {
    for key in serial::TABLES.iter().filter(|key| entry.is_table(key)) {
        let fix = "remove the table, or write node = \"serial\"";
        entry.report(key, format!("a camera has no table [{}]", entry.child(key)), fix);
    }
    let table = entry.table_or_empty("camera");
    let camera = CameraSpec::read(&table);
    if table.has("depth_unit") && camera.format != PixelFormat::Z16 {
        let message = format!("pictures in {} have no depth", camera.format);
        table.report("depth_unit", message, "remove the key");
    }
    Some((NodeSpec::Camera(camera), None))
}

/// A distance, in um.
fn distance(table: &Section<'_>, key: &str) -> Option<u32> {
    let text = table.text(key)?;
    let number = |unit: &str| text.strip_suffix(unit)?.trim_end().parse::<u32>().ok();
    let um = number("um").or_else(|| number("mm")?.checked_mul(MILLIMETRE));
    um.filter(|um| (1..=100 * MILLIMETRE).contains(um)).or_else(|| {
        let fix = "write a whole number of mm or um, such as \"1mm\" or \"100um\"";
        table.refuse(key, format!("{text:?} is not a distance"), fix)
    })
}

fn controls(table: &Section<'_>, key: &str) -> Option<Vec<(String, i64)>> {
    let controls = table.table(key)?;
    let of = |name: &str| Some((name.to_owned(), controls.integer(name, i64::MIN..=i64::MAX)?));
    Some(controls.fields().into_iter().filter_map(|(_, name, _)| of(name)).collect())
}
