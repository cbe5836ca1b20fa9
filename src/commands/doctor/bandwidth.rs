//! Do the cameras of one bus fit it together?
//!
//! A camera reserves bandwidth when it is started, in isochronous transfers, and one that finds too
//! little left is refused by the kernel. What it will reserve is its own affair: here it is what its
//! pictures take. Of compressed pictures only the most is known.
//!
//! Pure.

use std::fmt;

use crate::registry::{CameraSpec, PixelFormat};

/// Payload that isochronous transfers of one high-speed bus carry at most, bytes a second: 80 % of 480
/// Mbit/s (USB 2.0, 5.6.4), of which 38 bytes a transaction of 1024 are overhead (5.6.3).
const HIGH_SPEED: f64 = 0.8 * 60e6 * 1024.0 / 1062.0;
/// Of one endpoint: three transactions of 1024 bytes in each of 8000 microframes (5.6.3).
const ONE_ENDPOINT: f64 = 3.0 * 1024.0 * 8000.0;
/// Of a full-speed bus, and of one endpoint: 1023 bytes a millisecond (5.6.3).
const FULL_SPEED: f64 = 1023.0 * 1000.0;
/// Of a bus of 5 Gbit/s: 500 MB/s remain of its coding, 80 % of them for payload.
const SUPER_SPEED: f64 = 0.8 * 500e6;

/// Rates and sizes that cameras usually offer, largest first.
const RATES: [u32; 7] = [60, 30, 25, 20, 15, 10, 5];
const SIZES: [(u32, u32); 6] = [(1920, 1080), (1280, 720), (800, 600), (640, 480), (352, 288), (320, 240)];

/// A camera and what it is to send.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Wish {
    /// Entry.
    pub(super) name: String,
    /// Format.
    pub(super) camera: CameraSpec,
    /// Largest picture of a compressed format, bytes.
    pub(super) max_bytes: usize,
}

impl Wish {
    /// Bytes a second; of compressed pictures at the most.
    #[must_use]
    pub(super) fn bytes_per_second(&self) -> f64 {
        let camera = &self.camera;
        let pixels = f64::from(camera.width) * f64::from(camera.height);
        let picture = match camera.format {
            PixelFormat::Yuyv => 2.0 * pixels,
            PixelFormat::Grey => pixels,
            PixelFormat::Mjpg => self.max_bytes as f64,
        };
        picture * f64::from(camera.fps)
    }

    /// What it can reserve at the most: one endpoint.
    fn reserves(&self, mbit: f64) -> f64 {
        if self.is_estimated() { self.bytes_per_second().min(endpoint(mbit)) } else { self.bytes_per_second() }
    }

    /// Only the most is known.
    #[must_use]
    pub(super) fn is_estimated(&self) -> bool {
        self.camera.format == PixelFormat::Mjpg
    }

    /// The next lower rate, or where it is low already the next smaller size.
    fn lower(&mut self) -> bool {
        /// Below, a smaller picture serves better than a slower one.
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

impl fmt::Display for Wish {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let CameraSpec { width, height, fps, format, .. } = &self.camera;
        write!(f, "[device.{}] {width}x{height}@{fps} {format}", self.name)
    }
}

/// Payload a second that cameras on a bus of this speed can have together.
#[must_use]
pub(super) fn budget(mbit: f64) -> f64 {
    match mbit {
        mbit if mbit >= 5000.0 => SUPER_SPEED * (mbit / 5000.0),
        mbit if mbit >= 480.0 => HIGH_SPEED,
        _ => FULL_SPEED,
    }
}

/// And one of them.
#[must_use]
pub(super) fn endpoint(mbit: f64) -> f64 {
    match mbit {
        mbit if mbit >= 5000.0 => budget(mbit),
        mbit if mbit >= 480.0 => ONE_ENDPOINT,
        _ => FULL_SPEED,
    }
}

/// What the cameras of one bus of this speed take of it, bytes a second.
#[must_use]
pub(super) fn taken(wishes: &[Wish], mbit: f64) -> f64 {
    wishes.iter().map(|wish| wish.reserves(mbit)).sum()
}

/// Settings that fit a bus of this speed: the most demanding camera gives way first. Only those that
/// change; `None` if nothing fits.
#[must_use]
pub(super) fn fitting(wishes: &[Wish], mbit: f64) -> Option<Vec<Wish>> {
    let mut tried = wishes.to_vec();
    let fits = |wishes: &[Wish]| {
        taken(wishes, mbit) <= budget(mbit) && wishes.iter().all(|wish| wish.reserves(mbit) <= endpoint(mbit))
    };
    while !fits(&tried) {
        let most = tried.iter_mut().max_by(|a, b| a.bytes_per_second().total_cmp(&b.bytes_per_second()))?;
        if !most.lower() {
            return None;
        }
    }
    Some(tried.into_iter().zip(wishes).filter(|(now, wish)| now != *wish).map(|(now, _)| now).collect())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn wish(width: u32, height: u32, fps: u32, format: PixelFormat) -> Wish {
        let camera = CameraSpec { width, height, fps, format, controls: Vec::new() };
        Wish { name: "cam".into(), camera, max_bytes: 2 * (width * height) as usize }
    }

    #[test]
    fn what_fits_a_bus() {
        use PixelFormat::{Grey, Mjpg, Yuyv};
        let said = |wishes: &[Wish], mbit: f64| match fitting(wishes, mbit) {
            None => "nothing fits".to_owned(),
            Some(lower) => lower.iter().map(ToString::to_string).collect::<Vec<_>>().join(", "),
        };
        for (wishes, mbit, expected) in [
            (vec![wish(640, 480, 30, Yuyv)], 480.0, ""),
            (vec![wish(640, 480, 30, Yuyv); 2], 480.0, ""),
            (
                vec![wish(640, 480, 30, Yuyv), wish(640, 480, 50, Grey), wish(640, 480, 60, Grey)],
                480.0,
                "[device.cam] 640x480@30 GREY",
            ),
            // More than one endpoint carries, though the bus would.
            (vec![wish(1280, 720, 30, Yuyv)], 480.0, "[device.cam] 800x600@15 YUYV"),
            (vec![wish(1280, 720, 30, Grey)], 480.0, "[device.cam] 1280x720@25 GREY"),
            // What a compressed picture takes is not known: it reserves an endpoint at the most.
            (vec![wish(1920, 1080, 30, Mjpg)], 480.0, ""),
            (vec![wish(320, 240, 30, Yuyv)], 12.0, "[device.cam] 320x240@5 YUYV"),
            (vec![wish(640, 480, 60, Yuyv); 4], 5000.0, ""),
        ] {
            assert_eq!(said(&wishes, mbit), expected, "{wishes:?} at {mbit}");
        }
    }

    proptest! {
        #[test]
        fn what_is_said_to_fit_does(
            cameras in proptest::collection::vec((1_u32..4000, 1_u32..3000, 1_u32..200, 0_usize..3), 1..6),
            mbit in prop::sample::select(vec![1.5, 12.0, 480.0, 5000.0, 10_000.0]),
        ) {
            let format = |at: usize| PixelFormat::WORDS[at].1;
            let wishes: Vec<Wish> = cameras
                .iter()
                .enumerate()
                .map(|(at, (width, height, fps, which))| Wish {
                    name: format!("cam{at}"), ..wish(*width, *height, *fps, format(*which))
                })
                .collect();
            if let Some(lower) = fitting(&wishes, mbit) {
                let now: Vec<Wish> = wishes
                    .iter()
                    .map(|wish| lower.iter().find(|lower| lower.name == wish.name).unwrap_or(wish).clone())
                    .collect();
                prop_assert!(taken(&now, mbit) <= budget(mbit));
            }
        }
    }
}
