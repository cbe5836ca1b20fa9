//! What the pictures of cameras take of a USB bus, and which settings fit.

use std::fmt;

use rapid_registry::{CameraSpec, PixelFormat};

/// Most payload of the isochronous transfers of one high-speed bus, bytes per second: 80 % of 480 Mbit/s
/// (USB 2.0, 5.6.4), with 38 bytes of overhead per transaction of 1024 (5.6.3).
const HIGH_SPEED: f64 = 0.8 * 60e6 * 1024.0 / 1062.0;
/// For one endpoint: three transactions of 1024 bytes in each of 8000 microframes (5.6.3).
const ONE_ENDPOINT: f64 = 3.0 * 1024.0 * 8000.0;
/// For a full-speed bus, and for one endpoint: 1023 bytes per millisecond (5.6.3).
const FULL_SPEED: f64 = 1023.0 * 1000.0;
/// For a bus of 5 Gbit/s: 500 MB/s remain after its encoding, 80 % of them for payload.
const SUPER_SPEED: f64 = 0.8 * 500e6;

/// Rates and sizes that cameras usually offer, largest first.
const RATES: [u32; 7] = [60, 30, 25, 20, 15, 10, 5];
const SIZES: [(u32, u32); 6] = [(1920, 1080), (1280, 720), (800, 600), (640, 480), (352, 288), (320, 240)];

/// A camera and its configured format.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct CameraLoad {
    pub(super) name: String,
    pub(super) camera: CameraSpec,
    /// Largest picture of a compressed format, bytes.
    pub(super) max_bytes: usize,
}

impl CameraLoad {
    /// Bytes per second; for compressed pictures an upper limit.
    pub(super) fn bytes_per_second(&self) -> f64 {
        self.camera.bytes_per_second(self.max_bytes)
    }

    /// Upper limit of its reservation: one endpoint.
    fn reserves(&self, mbit: f64) -> f64 {
        if self.is_estimated() { self.bytes_per_second().min(endpoint(mbit)) } else { self.bytes_per_second() }
    }

    /// Whether only an upper limit is known.
    pub(super) fn is_estimated(&self) -> bool {
        self.camera.format == PixelFormat::Mjpg
    }

    /// Lowers the rate or, if it is low already, the size by one step; false if there is none.
    fn lower(&mut self) -> bool {
        /// Below this, a smaller picture is better than a lower rate.
        const SLOW: u32 = 15;
        let CameraSpec { width, height, fps, .. } = self.camera;
        let slower = RATES.into_iter().find(|rate| *rate < fps && *rate >= SLOW);
        let pixels = |(width, height): (u32, u32)| u64::from(width) * u64::from(height);
        let smaller = SIZES.into_iter().find(|size| pixels(*size) < pixels((width, height)));
        let slowest = RATES.into_iter().find(|rate| *rate < fps);
        match (slower, smaller, slowest) {
            (Some(rate), ..) | (None, None, Some(rate)) => self.camera.fps = rate,
            (None, Some(size), _) => {
                self.max_bytes = usize::try_from(self.max_bytes as u64 * pixels(size) / pixels((width, height)).max(1))
                    .unwrap_or(self.max_bytes);
                (self.camera.width, self.camera.height) = size;
            }
            (None, None, None) => return false,
        }
        true
    }
}

impl fmt::Display for CameraLoad {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let CameraSpec { width, height, fps, format, .. } = &self.camera;
        write!(f, "[device.{}] {width}x{height}@{fps} {format}", self.name)
    }
}

/// Total payload in bytes per second of the cameras on a bus of this speed.
pub(super) fn budget(mbit: f64) -> f64 {
    match mbit {
        mbit if mbit >= 5000.0 => SUPER_SPEED * (mbit / 5000.0),
        mbit if mbit >= 480.0 => HIGH_SPEED,
        _ => FULL_SPEED,
    }
}

/// The same for one camera.
pub(super) fn endpoint(mbit: f64) -> f64 {
    match mbit {
        mbit if mbit >= 5000.0 => budget(mbit),
        mbit if mbit >= 480.0 => ONE_ENDPOINT,
        _ => FULL_SPEED,
    }
}

/// The part of it that the cameras of one bus of this speed use, bytes per second.
pub(super) fn taken(loads: &[CameraLoad], mbit: f64) -> f64 {
    loads.iter().map(|load| load.reserves(mbit)).sum()
}

/// Settings that fit a bus of this speed: the most demanding camera is reduced first. Only those that
/// change; `None` if nothing fits.
pub(super) fn fitting(loads: &[CameraLoad], mbit: f64) -> Option<Vec<CameraLoad>> {
    let mut tried = loads.to_vec();
    let fits = |loads: &[CameraLoad]| {
        taken(loads, mbit) <= budget(mbit) && loads.iter().all(|load| load.reserves(mbit) <= endpoint(mbit))
    };
    while !fits(&tried) {
        let most = tried.iter_mut().max_by(|a, b| a.bytes_per_second().total_cmp(&b.bytes_per_second()))?;
        if !most.lower() {
            return None;
        }
    }
    Some(tried.into_iter().zip(loads).filter(|(now, load)| now != *load).map(|(now, _)| now).collect())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn load(width: u32, height: u32, fps: u32, format: PixelFormat) -> CameraLoad {
        let camera = CameraSpec { width, height, fps, format, depth_unit_um: 1000, controls: Vec::new() };
        CameraLoad { name: "cam".into(), camera, max_bytes: 2 * (width * height) as usize }
    }

    #[test]
    fn suggested_settings_for_a_bus() {
        use PixelFormat::{Grey, Mjpg, Yuyv};
        let suggested = |loads: &[CameraLoad], mbit: f64| match fitting(loads, mbit) {
            None => "nothing fits".to_owned(),
            Some(lower) => lower.iter().map(ToString::to_string).collect::<Vec<_>>().join(", "),
        };
        for (loads, mbit, expected) in [
            (vec![load(640, 480, 30, Yuyv)], 480.0, ""),
            (vec![load(640, 480, 30, Yuyv); 2], 480.0, ""),
            (
                vec![load(640, 480, 30, Yuyv), load(640, 480, 50, Grey), load(640, 480, 60, Grey)],
                480.0,
                "[device.cam] 640x480@30 GREY",
            ),
            // More than one endpoint can carry, though the bus could.
            (vec![load(1280, 720, 30, Yuyv)], 480.0, "[device.cam] 800x600@15 YUYV"),
            (vec![load(1280, 720, 30, Grey)], 480.0, "[device.cam] 1280x720@25 GREY"),
            // The size of compressed pictures is unknown: they reserve one endpoint at most.
            (vec![load(1920, 1080, 30, Mjpg)], 480.0, ""),
            (vec![load(320, 240, 30, Yuyv)], 12.0, "[device.cam] 320x240@5 YUYV"),
            (vec![load(640, 480, 60, Yuyv); 4], 5000.0, ""),
        ] {
            assert_eq!(suggested(&loads, mbit), expected, "{loads:?} at {mbit}");
        }
    }

    proptest! {
        #[test]
        fn suggested_settings_fit(
            cameras in proptest::collection::vec((1_u32..4000, 1_u32..3000, 1_u32..200, 0_usize..3), 1..6),
            mbit in prop::sample::select(vec![1.5, 12.0, 480.0, 5000.0, 10_000.0]),
        ) {
            let format = |at: usize| PixelFormat::WORDS[at].1;
            let loads: Vec<CameraLoad> = cameras
                .iter()
                .enumerate()
                .map(|(at, (width, height, fps, which))| CameraLoad {
                    name: format!("cam{at}"), ..load(*width, *height, *fps, format(*which))
                })
                .collect();
            if let Some(lower) = fitting(&loads, mbit) {
                let now: Vec<CameraLoad> = loads
                    .iter()
                    .map(|load| lower.iter().find(|lower| lower.name == load.name).unwrap_or(load).clone())
                    .collect();
                prop_assert!(taken(&now, mbit) <= budget(mbit));
            }
        }
    }
}
