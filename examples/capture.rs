//! Captures the same camera through nokhwa or through the driver of `rapid`, and prints what each of them costs:
//! `capture nokhwa|rapid NODE FRAMES`, of a camera that sends MJPEG of 640x480 at 30 fps.
//!
//! `make bench BENCH="--only capture"` runs both on the virtual bench, whose pictures carry the time at which they were
//! sent. The first line is printed after FRAMES pictures; then the camera is read until it is unplugged, and the last
//! line has the longest time that the caller waited for control to return.

#![expect(clippy::print_stdout, clippy::print_stderr, reason = "a program for the terminal")]

use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use nokhwa::utils::{
    ApiBackend, CameraFormat, CameraIndex, FrameFormat, RequestedFormat, RequestedFormatType, Resolution,
};
use rapid_core::time::Stamp;
use rapid_devices::driver::{Driver, DriverError};
use rapid_registry::Registry;
use rapid_registry::device::DeviceNode;
use rustix::time::{ClockId, clock_gettime};
use serde_json::json;
use tokio::runtime::{Builder, Runtime};
use tokio::time::timeout;

type AnyError = Box<dyn std::error::Error>;

const USAGE: &str = "usage: capture nokhwa|rapid NODE FRAMES";
/// How long the driver of `rapid` is waited for before control is taken back, as a stream of the rig does.
const PATIENCE: Duration = Duration::from_millis(500);
const CAMERA: &str = r#"
rig.name = "capture"
[device.cam]
vid = "0x0001"
pid = "0x0001"
node = "camera"
topic = "/cam"
bit = 0
[device.cam.camera]
width = 640
height = 480
fps = 30
format = "MJPG"
"#;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [reader, node, frames] = &arguments[..] else {
        eprintln!("{USAGE}");
        return ExitCode::from(2);
    };
    match frames.parse().map_err(AnyError::from).and_then(|frames| capture(reader, Path::new(node), frames)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("capture: {error}");
            ExitCode::FAILURE
        }
    }
}

/// One attempt to get a picture.
enum Got {
    /// Bytes handed over, of which the picture are so many; how long ago it was sent; processor time to get it.
    Picture {
        bytes: usize,
        picture: usize,
        late: Duration,
        busy: Duration,
    },
    Nothing,
    Gone(String),
}

enum Reader {
    Nokhwa(nokhwa::Camera),
    Rapid(Box<Driver>, Runtime),
}

impl Reader {
    fn open(name: &str, node: &Path) -> Result<Self, AnyError> {
        if name == "nokhwa" {
            let number = node.to_str().and_then(|node| node.strip_prefix("/dev/video")).ok_or(USAGE)?.parse()?;
            let format = CameraFormat::new(Resolution::new(640, 480), FrameFormat::MJPEG, 30);
            let format = RequestedFormat::with_formats(RequestedFormatType::Exact(format), &[FrameFormat::MJPEG]);
            let index = CameraIndex::Index(number);
            let mut camera = nokhwa::Camera::with_backend(index, format, ApiBackend::Video4Linux)?;
            camera.open_stream()?;
            return Ok(Self::Nokhwa(camera));
        }
        let spec = Registry::parse(CAMERA, None)?.registry.devices.into_iter().next().ok_or("no entry")?;
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let driver = runtime.block_on(Driver::open(&spec, &DeviceNode::Video(node.to_owned())))?;
        Ok(Self::Rapid(Box::new(driver), runtime))
    }

    fn next(&mut self) -> Got {
        let begun = busy();
        match self {
            Self::Nokhwa(camera) => match camera.frame() {
                Ok(frame) => picture(frame.buffer(), begun),
                Err(error) => Got::Gone(error.to_string()),
            },
            Self::Rapid(driver, runtime) => runtime.block_on(async {
                match timeout(PATIENCE, driver.read()).await {
                    Ok(Ok(reading)) => picture(reading.bytes, begun),
                    Ok(Err(DriverError::Retry(_))) | Err(_) => Got::Nothing,
                    Ok(Err(error)) => Got::Gone(error.to_string()),
                }
            }),
        }
    }
}

/// Pictures of the virtual bench begin with a comment, `rapid-vbench NUMBER SENT_NS`.
fn picture(bytes: &[u8], begun: Duration) -> Got {
    let (now, busy) = (Stamp::now(), busy().saturating_sub(begun));
    let comment = String::from_utf8_lossy(bytes.get(6..64).unwrap_or_default()).into_owned();
    let sent = comment.split(|letter: char| !letter.is_ascii_digit()).filter_map(|word| word.parse().ok()).nth(1);
    // End of image, the last two bytes of a JPEG picture.
    let end = bytes.windows(2).rposition(|pair| pair == [0xff, 0xd9]).map_or(0, |at| at + 2);
    Got::Picture { bytes: bytes.len(), picture: end, late: now.since(Stamp(sent.unwrap_or(0))), busy }
}

fn capture(name: &str, node: &Path, frames: usize) -> Result<(), AnyError> {
    let mut reader = Reader::open(name, node)?;
    let (mut late, mut bytes, mut pictures, mut busy) = (Vec::with_capacity(frames), 0, 0, Duration::ZERO);
    while late.len() < frames {
        match reader.next() {
            Got::Picture { bytes: delivered, picture, late: this, busy: spent } => {
                busy += spent;
                late.push(this);
                bytes += delivered;
                pictures += picture;
            }
            Got::Nothing => {}
            Got::Gone(error) => return Err(error.into()),
        }
    }
    late.sort_unstable();
    let us = |duration: Duration| duration.as_micros();
    let (median, p99) = (us(late[frames / 2]), us(late[frames * 99 / 100]));
    println!(
        "{}",
        json!({"frames": frames, "bytes": bytes / frames, "picture": pictures / frames,
            "cpu_us": us(busy) as f64 / frames as f64, "late_p50_us": median, "late_p99_us": p99})
    );
    let mut longest = Duration::ZERO;
    let error = loop {
        let begun = Instant::now();
        let got = reader.next();
        longest = longest.max(begun.elapsed());
        if let Got::Gone(error) = got {
            break error;
        }
    };
    println!("{}", json!({"longest_us": us(longest), "ended_ns": Stamp::now().0, "error": error}));
    Ok(())
}

/// Processor time of this process.
fn busy() -> Duration {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Duration::new(time.tv_sec.unsigned_abs(), u32::try_from(time.tv_nsec).unwrap_or(0))
}
