//! Opens a camera and prints what it sends: `camread NODE [WIDTH HEIGHT FPS FORMAT [FRAMES]]`.
//!
//! For a bench with real or emulated cameras. Ends with the number of frames, or with what the driver
//! reports when the camera is unplugged.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::sync::WhenStale;
use rapid_core::time::Stamp;
use rapid_devices::driver::{Driver, DriverError, camera};
use rapid_registry::device::DeviceNode;
use rapid_registry::{CameraSpec, DeviceSpec, IdentitySpec, NodeSpec, PixelFormat, UsbSpec};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut out = std::io::stdout().lock();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let Some(path) = arguments.first().map(PathBuf::from) else {
        writeln!(out, "camread NODE [WIDTH HEIGHT FPS FORMAT [FRAMES]]\ncameras: {:?}", camera::cameras())?;
        return Ok(());
    };
    match camera::query(&path) {
        Ok(info) => writeln!(out, "{info}")?,
        Err(error) => writeln!(out, "query: {error}")?,
    }
    let frames: u64 = arguments.get(5).map_or(Ok(100), |text| text.parse())?;
    let spec = device(&arguments)?;
    let mut driver = Driver::open(&spec, &DeviceNode::Video(path.clone())).await?;
    writeln!(out, "{}", driver.description())?;
    let mut last: Option<Stamp> = None;
    for number in 0..frames {
        let reading = match tokio::time::timeout(Duration::from_secs(2), driver.read()).await {
            Ok(Ok(reading)) => reading,
            Ok(Err(error)) => {
                writeln!(out, "after {number} frames at {} ns: {error}", Stamp::now().0)?;
                return if matches!(error, DriverError::Gone) { Ok(()) } else { Err(error.into()) };
            }
            Err(_) => {
                writeln!(out, "no frame for 2 s, {} there: {}", path.display(), Path::exists(&path))?;
                continue;
            }
        };
        writeln!(
            out,
            "{number} {} bytes, captured {} ns, {} us ago, {} us after the last, flags {}, lost {}",
            reading.bytes.len(),
            reading.captured.0,
            Stamp::now().since(reading.captured).as_micros(),
            last.map_or(0, |last| reading.captured.since(last).as_micros()),
            reading.flags,
            reading.lost,
        )?;
        last = Some(reading.captured);
    }
    writeln!(out, "{frames} frames")?;
    Ok(())
}

fn device(arguments: &[String]) -> Result<DeviceSpec, Box<dyn std::error::Error>> {
    let number = |at: usize, default: u32| arguments.get(at).map_or(Ok(default), |text| text.parse());
    let format = match arguments.get(4).map_or("MJPG", String::as_str) {
        "MJPG" => PixelFormat::Mjpg,
        "YUYV" => PixelFormat::Yuyv,
        "GREY" => PixelFormat::Grey,
        "Z16" => PixelFormat::Z16,
        other => return Err(format!("{other}: the format is MJPG, YUYV, GREY or Z16").into()),
    };
    let camera = CameraSpec {
        width: number(1, 640)?,
        height: number(2, 480)?,
        fps: number(3, 30)?,
        format,
        depth_unit_um: 1000,
        controls: Vec::new(),
    };
    Ok(DeviceSpec {
        name: "camera".to_owned(),
        id: rapid_core::modality::ModalityId::new(0).ok_or("bit")?,
        identity: IdentitySpec::Usb(UsbSpec { vid: 0, pid: 0, serial: None, port: None }),
        node: NodeSpec::Camera(camera),
        topic: "/camera".to_owned(),
        mount: None,
        stall_after: Duration::from_millis(500),
        max_bytes: 4 << 20,
        depth: 4,
        when_stale: WhenStale::Hold,
        latency: Duration::ZERO,
        form: None,
        action: None,
        hooks: rapid_registry::Hooks::default(),
        verdict: rapid_registry::VerdictSpec::defaults(
            rapid_core::modality::ModalityKind::Image,
            Duration::from_millis(500),
            None,
        ),
    })
}
