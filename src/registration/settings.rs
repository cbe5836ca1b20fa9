//! Settings for the entry of a connected unit, as the unit suggests them.

use rapid_devices::driver::camera::{CameraInfo, Rate, Rates, Size};
use rapid_registry::PixelFormat;
use rapid_registry::device::DeviceNode;
use rapid_registry::edit::Setting;
use rapid_registry::simulation::SimSource;

/// Settings that the device itself suggests.
pub fn suggested(node: &DeviceNode, camera: Option<&CameraInfo>) -> Vec<(String, Setting)> {
    match (node, camera) {
        (DeviceNode::Sim(device), _) => match device.source {
            SimSource::Camera { width, height, fps, .. } => camera_settings(width, height, fps, "MJPG"),
            SimSource::Depth { width, height, fps, .. } => camera_settings(width, height, fps, "Z16"),
            SimSource::Serial { channels, .. } => serial_settings("csv", channels),
            _ => Vec::new(),
        },
        (DeviceNode::Video(_), Some(camera)) => best(camera)
            .map_or_else(Vec::new, |(width, height, fps, format)| camera_settings(width, height, fps, format)),
        _ => Vec::new(),
    }
}

fn camera_settings(width: u32, height: u32, fps: u32, format: &str) -> Vec<(String, Setting)> {
    let whole = |key: &str, value: u32| (format!("camera.{key}"), Setting::Whole(value.into()));
    vec![
        whole("width", width),
        whole("height", height),
        whole("fps", fps),
        ("camera.format".to_owned(), Setting::Text(format.to_owned())),
    ]
}

fn serial_settings(parse: &str, channels: usize) -> Vec<(String, Setting)> {
    let channels = i64::try_from(channels).unwrap_or(i64::MAX);
    vec![
        ("tty.parse".to_owned(), Setting::Text(parse.to_owned())),
        ("tty.channels".to_owned(), Setting::Whole(channels)),
    ]
}

/// A mode that suits most rigs: compressed pictures if possible, a size near 640x480, a rate near 30 Hz.
fn best(camera: &CameraInfo) -> Option<(u32, u32, u32, &'static str)> {
    let order = |fourcc: &str| PixelFormat::WORDS.iter().position(|(word, _)| *word == fourcc);
    let size = |size: &Size| match *size {
        Size::One { width, height } => (width, height),
        Size::Range { smallest, largest } => {
            (640.clamp(smallest.0, largest.0.max(smallest.0)), 480.clamp(smallest.1, largest.1.max(smallest.1)))
        }
    };
    let modes = camera.modes.iter().filter_map(|mode| Some((order(&mode.fourcc)?, size(&mode.size), &mode.rates)));
    let far = |(width, height): (u32, u32)| (u64::from(width) * u64::from(height)).abs_diff(640 * 480);
    let (format, (width, height), rates) = modes.min_by_key(|(order, size, _)| (*order, far(*size)))?;
    Some((width, height, fps(rates), PixelFormat::WORDS.get(format)?.0))
}

/// The integer rate nearest to 30 Hz.
fn fps(rates: &Rates) -> u32 {
    const PREFERRED: u32 = 30;
    let near =
        |rate: &Rate| (1..=1000).min_by_key(|fps| (f64::from(*fps) - rate.hz()).abs().to_bits()).unwrap_or(PREFERRED);
    match rates {
        Rates::List(rates) => rates.iter().map(near).min_by_key(|fps| fps.abs_diff(PREFERRED)).unwrap_or(PREFERRED),
        Rates::Range { slowest, fastest } => PREFERRED.clamp(near(slowest), near(fastest).max(near(slowest))),
    }
}

/// Settings to parse the lines of a serial device: all comma-separated numbers, or all JSON; `None` if
/// neither.
pub fn lines_look_like(lines: &[Vec<u8>]) -> Option<Vec<(String, Setting)>> {
    // The start of the first line may be missing.
    let whole: Vec<&str> = lines.iter().skip(1).filter_map(|line| std::str::from_utf8(line).ok()).collect();
    let first = whole.first()?;
    let same = |count: &dyn Fn(&str) -> Option<usize>| {
        let channels = count(first)?;
        whole.iter().all(|line| count(line) == Some(channels)).then_some(channels)
    };
    let csv = |line: &str| {
        let numbers: Result<Vec<f64>, _> = line.split(',').map(|part| part.trim().parse::<f64>()).collect();
        numbers.ok().map(|numbers| numbers.len())
    };
    let json = |line: &str| match serde_json::from_str::<serde_json::Value>(line).ok()? {
        serde_json::Value::Array(values) => Some(values.len()),
        serde_json::Value::Object(values) => Some(values.values().filter(|value| value.is_number()).count()),
        _ => None,
    };
    let channels = |found: Option<usize>| found.filter(|channels| (1..=1024).contains(channels));
    if let Some(channels) = channels(same(&csv)) {
        return Some(serial_settings("csv", channels));
    }
    channels(same(&json)).map(|channels| serial_settings("json", channels))
}

#[cfg(test)]
mod tests;
