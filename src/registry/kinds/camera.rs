//! `node = "camera"`: a V4L2 camera, with its table `[device.NAME.camera]`.

use rapid_core::sample::Encoding;
use serde::Serialize;

use crate::keys::{Own, Words, keys, own, text, whole};
use crate::section::Section;

/// In um.
const MILLIMETRE: u32 = 1000;

const DISTANCE: Own<u32> = text(distance, "a distance, `\"1um\"` to `\"100mm\"`");
const CONTROLS: Own<Vec<(String, i64)>> =
    own(controls, "a table of whole numbers", r#"{"type": "object", "additionalProperties": {"type": "integer"}}"#);

keys! {
    /// `[device.NAME.camera]`.
    #[derive(Debug, Clone, PartialEq, Eq)]
    pub struct CameraSpec {
        /// Width of a picture, pixels.
        width: u32 = whole::<u32>(1, 8192), or 640;
        /// Height of a picture, pixels.
        height: u32 = whole::<u32>(1, 8192), or 480;
        /// Pictures a second.
        fps: u32 = whole::<u32>(1, 1000), or 30;
        /// Pixel format. `Z16` is distances.
        format: PixelFormat = Words(&PixelFormat::WORDS), or PixelFormat::Mjpg;
        /// Of distances: what one count is, um.
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
    /// 16-bit distances.
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
    /// Reads the table of an entry.
    pub(crate) fn of(entry: &Section<'_>, others: &[&str]) -> Self {
        for key in others.iter().filter(|key| entry.is_table(key)) {
            let fix = "remove the table, or write node = \"serial\"";
            entry.report(key, format!("a camera has no table [{}]", entry.child(key)), fix);
        }
        let table = entry.table_or_empty("camera");
        let camera = Self::read(&table);
        if table.has("depth_unit") && camera.format != PixelFormat::Z16 {
            let message = format!("pictures in {} have no distances", camera.format);
            table.report("depth_unit", message, "remove the key");
        }
        camera
    }
}

/// A distance, in um.
fn distance(table: &Section<'_>, key: &str) -> Option<u32> {
    let text = table.text(key)?;
    let number = |unit: &str| text.strip_suffix(unit)?.trim_end().parse::<u32>().ok();
    let um = number("um").or_else(|| number("mm")?.checked_mul(MILLIMETRE));
    um.filter(|um| (1..=100 * MILLIMETRE).contains(um)).or_else(|| {
        let fix = "write a whole number of mm or um, such as \"1mm\" or \"100um\"";
        table.refuse(key, format!("{text:?} is no distance"), fix)
    })
}

fn controls(table: &Section<'_>, key: &str) -> Option<Vec<(String, i64)>> {
    let controls = table.table(key)?;
    let of = |name: &str| Some((name.to_owned(), controls.integer(name, i64::MIN..=i64::MAX)?));
    Some(controls.fields().into_iter().filter_map(|(_, name, _)| of(name)).collect())
}
