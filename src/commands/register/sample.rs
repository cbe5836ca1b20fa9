//! A look at what a device sends, before it is registered.

use std::path::Path;
use std::time::Duration;

use tokio::time::{Instant, timeout_at};

use super::units::lines_look_like;
use crate::driver::serial::Serial;
use crate::driver::{Driver, DriverError};
use crate::registry::edit::Setting;
use crate::registry::{DeviceNode, DeviceSpec, Framing, NodeSpec, Parse, SerialSpec};
use crate::sample::Encoding;
use crate::text;

/// How long is looked.
const LOOK: Duration = Duration::from_secs(2);
/// A device that takes this long to open does not.
const OPENING: Duration = Duration::from_secs(5);
/// Samples after which enough has been seen.
const ENOUGH: u32 = 200;
/// Lines of a serial device that are looked into.
const LINES: usize = 20;

/// Opens the device as a rig would, reads for up to 2 s and says what came.
pub(super) async fn look(spec: &DeviceSpec, node: &DeviceNode) -> String {
    if let NodeSpec::Process(_) = spec.node {
        return "Test: skipped, the program of the entry reads it; see it run with `rapid --headless`.".to_owned();
    }
    let opened = tokio::time::timeout(OPENING, Driver::open(spec, node)).await;
    let mut driver = match opened.unwrap_or_else(|_| Err(DriverError::Retry("it does not open".to_owned()))) {
        Ok(driver) => driver,
        Err(error) => return format!("Test: {}: {error}", node.label()),
    };
    let description = driver.description();
    let begun = Instant::now();
    let mut seen = Seen::default();
    while seen.samples < ENOUGH {
        match timeout_at(begun + LOOK, driver.read()).await {
            Err(_) => break,
            Ok(Ok(reading)) => seen.take(reading.encoding, reading.bytes, (reading.width, reading.height)),
            Ok(Err(error)) => return format!("Test: {description}: {error}"),
        }
    }
    format!("Test: {description}: {}", seen.told(begun.elapsed()))
}

#[derive(Default)]
struct Seen {
    samples: u32,
    bytes: u64,
    first: String,
}

impl Seen {
    fn take(&mut self, encoding: Encoding, bytes: &[u8], (width, height): (u32, u32)) {
        if self.samples == 0 {
            self.first = match encoding {
                Encoding::F64 => {
                    let (numbers, _) = bytes.as_chunks::<8>();
                    let shown: Vec<_> =
                        numbers.iter().take(6).map(|n| format!("{:.4}", f64::from_le_bytes(*n))).collect();
                    let more = if numbers.len() > shown.len() { ", ..." } else { "" };
                    format!("first values {}{more}", shown.join(", "))
                }
                Encoding::Bytes => {
                    format!("first bytes {:?}", String::from_utf8_lossy(bytes.get(..40).unwrap_or(bytes)))
                }
                _ => format!("{width}x{height} pixels"),
            };
        }
        self.samples += 1;
        self.bytes += bytes.len() as u64;
    }

    fn told(&self, elapsed: Duration) -> String {
        if self.samples == 0 {
            return format!("it sent nothing in {}", text::about(elapsed));
        }
        let hz = f64::from(self.samples) / elapsed.as_secs_f64().max(1e-3);
        let size = text::size(self.bytes / u64::from(self.samples));
        format!("{} samples, {} a second, {size} each, {}", self.samples, text::hertz(hz), self.first)
    }
}

/// Listens to a serial line for up to 2 s: how the lines it sends are to be read, if it sends lines.
pub(super) async fn listen(path: &Path, baud: u32) -> Result<Option<Vec<(String, Setting)>>, DriverError> {
    /// Long enough for a line of a thousand numbers.
    const LONGEST_LINE: usize = 16 << 10;
    let raw = SerialSpec { baud, framing: Framing::Line, parse: Parse::Raw, channels: 0 };
    let opened = tokio::time::timeout(OPENING, Serial::open(&raw, path, LONGEST_LINE)).await;
    let mut driver = opened.unwrap_or_else(|_| Err(DriverError::Retry("it does not open".to_owned())))?;
    let end = Instant::now() + LOOK;
    let mut lines = Vec::new();
    while lines.len() < LINES {
        match timeout_at(end, driver.read()).await {
            Err(_) => break,
            Ok(reading) => lines.push(reading?.bytes.to_vec()),
        }
    }
    Ok(lines_look_like(&lines))
}
