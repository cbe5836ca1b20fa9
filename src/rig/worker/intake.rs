//! Validates what a program publishes: its header is untrusted.
//!
//! 1. Modality and epoch must be ours: a sample of an earlier process does not belong to this device.
//! 2. The payload must be what the entry declares, or the sample is refused.
//! 3. A capture time that cannot be one makes the sample damaged ([`rapid_core::capture`]). 0 means that the program does not
//!    know.
//! 4. A gap in `seq` is a loss; a counter that jumps or restarts is not. A number that is repeated shows that nothing is
//!    counted: the sample is passed on, and is a duplicate.
//!
//! Invariant: pure; nothing a program can write makes this panic, or passes a number that our own driver would not have
//! sent.

use std::time::Duration;

use rapid_core::capture::{CaptureTimes, Captured};
use rapid_core::modality::{ModalityId, ModalityKind};
use rapid_core::sample::{Encoding, Epoch, FLAG_DEVICE_TIME, FLAG_ERROR, FLAG_SAME_NUMBER, SampleHeader};
use rapid_core::time::Stamp;
use rapid_registry::ProcessSpec;

/// A larger gap means that the counter was set.
const LARGEST_HOLE: u64 = 1_000_000;

/// The part of a sample that is passed on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Judged {
    pub(super) encoding: Encoding,
    pub(super) captured: Stamp,
    pub(super) flags: u32,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Samples missing before this one.
    pub(super) lost: u64,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
enum Refusal {
    #[error("its samples carry modality {0}, not {1}: a program must send RAPID_BIT as id")]
    Id(u32, u32),
    #[error("its samples carry epoch {0}, not {1}: a program must send RAPID_EPOCH as epoch")]
    Epoch(u32, u32),
    #[error("its samples have encoding {0}, which is none of {1}")]
    Encoding(u32, &'static str),
    #[error("its samples have {0} bytes, not {1}: correct the program or the entry")]
    Size(usize, usize),
    #[error("its pictures are {0}x{1}, not {2}x{3}: correct the program or the entry")]
    Picture(u32, u32, u32, u32),
    #[error("its pictures are not JPEG as they declare")]
    NotJpeg,
}

/// The sample format that the entry declares.
#[derive(Debug, Clone, Copy)]
enum Expected {
    Scalars { channels: u32 },
    Image { width: u32, height: u32 },
    Depth { width: u32, height: u32 },
    Bytes,
}

#[derive(Debug)]
pub(super) struct Intake {
    id: u32,
    epoch: u32,
    expected: Expected,
    last: Option<u64>,
    times: CaptureTimes,
    /// A complaint that has not been fetched, and whether one of its kind came before.
    complaint: Option<String>,
    has_refused: bool,
    has_doubted: bool,
    has_repeated: bool,
}

impl Intake {
    pub(super) fn new(id: ModalityId, epoch: Epoch, process: &ProcessSpec) -> Self {
        let expected = match (process.kind, process.shape.as_slice()) {
            (ModalityKind::Scalars, [channels]) => Expected::Scalars { channels: *channels },
            (ModalityKind::Image, [height, width]) => Expected::Image { width: *width, height: *height },
            (ModalityKind::Depth, [height, width]) => Expected::Depth { width: *width, height: *height },
            _ => Expected::Bytes,
        };
        Self {
            id: u32::from(id.bit()),
            epoch: epoch.0,
            expected,
            last: None,
            times: CaptureTimes::default(),
            complaint: None,
            has_refused: false,
            has_doubted: false,
            has_repeated: false,
        }
    }

    /// `None` if the sample is refused.
    pub(super) fn judge(&mut self, header: &SampleHeader, payload: &[u8], now: Stamp) -> Option<Judged> {
        let (encoding, width, height) = match self.check(header, payload) {
            Ok(checked) => checked,
            Err(refusal) => {
                if !std::mem::replace(&mut self.has_refused, true) {
                    self.complaint = Some(format!("samples are refused: {refusal}"));
                }
                return None;
            }
        };
        let (captured, mut flags) = self.time(header, now);
        if self.last == Some(header.seq) {
            flags |= FLAG_SAME_NUMBER;
            if self.complaint.is_none() && !std::mem::replace(&mut self.has_repeated, true) {
                let seq = header.seq;
                self.complaint = Some(format!(
                    "samples are duplicates, of seq {seq} again: a program must count its samples in seq"
                ));
            }
        }
        let hole = self.last.and_then(|last| header.seq.checked_sub(last)?.checked_sub(1));
        self.last = Some(header.seq);
        let lost = hole.filter(|hole| *hole <= LARGEST_HOLE).unwrap_or(0);
        Some(Judged { encoding, captured, flags, width, height, lost })
    }

    /// When a sample was captured, and its flags.
    fn time(&mut self, header: &SampleHeader, now: Stamp) -> (Stamp, u32) {
        let flags = header.flags & (FLAG_ERROR | FLAG_DEVICE_TIME);
        if header.capture_ns == 0 {
            return (self.times.unknown(now), flags & !FLAG_DEVICE_TIME);
        }
        let Captured { at, doubt } = self.times.judge(Stamp(header.capture_ns), Duration::ZERO, now);
        let Some(doubt) = doubt else { return (at, flags) };
        if !std::mem::replace(&mut self.has_doubted, true) {
            self.complaint = Some(format!(
                "samples are damaged, by a capture time that is {doubt}: send CLOCK_MONOTONIC, or 0 if it is not known"
            ));
        }
        (at, FLAG_ERROR)
    }

    /// A complaint for the user, the first time it occurs.
    pub(super) fn complaint(&mut self) -> Option<String> {
        self.complaint.take()
    }

    fn check(&self, header: &SampleHeader, payload: &[u8]) -> Result<(Encoding, u32, u32), Refusal> {
        if header.id != self.id {
            return Err(Refusal::Id(header.id, self.id));
        }
        if header.epoch != self.epoch {
            return Err(Refusal::Epoch(header.epoch, self.epoch));
        }
        let encoding = Encoding::from_raw(header.encoding);
        match (self.expected, encoding) {
            (Expected::Scalars { channels }, Some(Encoding::F64)) => {
                exact(payload, 8 * u64::from(channels))?;
                Ok((Encoding::F64, channels, 0))
            }
            (
                Expected::Image { width, height },
                Some(encoding @ (Encoding::Mjpeg | Encoding::Yuyv | Encoding::Grey)),
            )
            | (Expected::Depth { width, height }, Some(encoding @ Encoding::Depth)) => {
                let states = (header.width, header.height);
                if states != (width, height) && states != (0, 0) {
                    return Err(Refusal::Picture(states.0, states.1, width, height));
                }
                let pixels = u64::from(width) * u64::from(height);
                match encoding.pixel_bytes() {
                    Some(bytes) => exact(payload, bytes as u64 * pixels)?,
                    // Start of image: ITU-T T.81, B.1.1.3.
                    None if !payload.starts_with(&[0xff, 0xd8]) => return Err(Refusal::NotJpeg),
                    None => {}
                }
                Ok((encoding, width, height))
            }
            (Expected::Bytes, Some(Encoding::Bytes)) => Ok((Encoding::Bytes, 0, 0)),
            (Expected::Scalars { .. }, _) => Err(Refusal::Encoding(header.encoding, "4 (f64)")),
            (Expected::Image { .. }, _) => Err(Refusal::Encoding(header.encoding, "1 (mjpeg), 2 (yuyv), 3 (grey)")),
            (Expected::Depth { .. }, _) => Err(Refusal::Encoding(header.encoding, "6 (depth)")),
            (Expected::Bytes, _) => Err(Refusal::Encoding(header.encoding, "0 (bytes)")),
        }
    }
}

fn exact(payload: &[u8], requested: u64) -> Result<(), Refusal> {
    let requested = usize::try_from(requested).unwrap_or(usize::MAX);
    if payload.len() == requested { Ok(()) } else { Err(Refusal::Size(payload.len(), requested)) }
}

#[cfg(test)]
mod tests;
