//! How a picture lies in a buffer, and where in the stream it stands: pure.

use std::time::Duration;

use crate::registry::PixelFormat;
use crate::sample::{Encoding, FLAG_ERROR};
use crate::time::Stamp;

/// How a picture lies in a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    pub(super) format: PixelFormat,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Bytes from one row to the next, padding included.
    pub(super) stride: usize,
}

impl Layout {
    pub(super) const fn encoding(self) -> Encoding {
        match self.format {
            PixelFormat::Mjpg => Encoding::Mjpeg,
            PixelFormat::Yuyv => Encoding::Yuyv,
            PixelFormat::Grey => Encoding::Grey,
        }
    }

    /// Bytes of a row's pixels; 0 where pictures are compressed.
    fn row_bytes(self) -> usize {
        let width = self.width as usize;
        match self.format {
            PixelFormat::Mjpg => 0,
            // Two pixels share their colour: an odd width is rounded up.
            PixelFormat::Yuyv => width.div_ceil(2) * 4,
            PixelFormat::Grey => width,
        }
    }

    /// Bytes of a picture's pixels; 0 where pictures are compressed.
    pub(super) fn picture_bytes(self) -> usize {
        self.row_bytes() * self.height as usize
    }

    /// Do rows end in bytes that are no pixels?
    pub(super) fn is_padded(self) -> bool {
        self.row_bytes() > 0 && self.stride > self.row_bytes()
    }

    /// Is this a whole picture, as far as can be told without decoding it?
    fn is_whole(self, bytes: &[u8]) -> bool {
        match self.format {
            // Start of image marker (ITU-T T.81, table B.1).
            PixelFormat::Mjpg => bytes.starts_with(&[0xff, 0xd8]),
            _ if self.is_padded() => {
                // Some drivers leave the padding of the last row out.
                let most = self.stride * self.height as usize;
                let least = most - (self.stride - self.row_bytes());
                (least..=most).contains(&bytes.len())
            }
            PixelFormat::Yuyv | PixelFormat::Grey => bytes.len() == self.picture_bytes(),
        }
    }

    /// Copies the rows of `bytes` without their padding.
    pub(super) fn compact(self, bytes: &[u8], into: &mut Vec<u8>) {
        compact_rows(bytes, self.stride, self.row_bytes(), self.height as usize, into);
    }
}

/// Copies at most `height` rows of `row` bytes each that lie `stride` bytes apart.
pub(in crate::driver) fn compact_rows(bytes: &[u8], stride: usize, row: usize, height: usize, into: &mut Vec<u8>) {
    into.clear();
    for line in bytes.chunks(stride.max(1)).take(height) {
        into.extend_from_slice(line.get(..row).unwrap_or(line));
    }
}

/// What the kernel says of a filled buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Frame {
    pub(super) sequence: u32,
    pub(super) bytes_used: usize,
    pub(super) is_damaged: bool,
    /// Capture time, if the kernel gives it on the monotonic clock.
    pub(super) stamp: Option<Stamp>,
}

impl Frame {
    pub(super) fn flags(&self, layout: Layout, bytes: &[u8]) -> u32 {
        if self.is_damaged || !layout.is_whole(bytes) { FLAG_ERROR } else { 0 }
    }
}

/// Where in the stream we are.
#[derive(Debug, Default)]
pub(super) struct Progress {
    last_sequence: Option<u32>,
    /// The last capture time passed on.
    last_stamp: Stamp,
    /// The last one of the kernel that was believed.
    last_kernel: Stamp,
    lost: u64,
}

impl Progress {
    /// A picture that is not passed on.
    pub(super) fn skip(&mut self, sequence: u32) {
        self.count(sequence);
        self.lost += 1;
    }

    /// A picture that is passed on; says how many were lost before it.
    pub(super) fn take(&mut self, sequence: u32) -> u64 {
        self.count(sequence);
        std::mem::take(&mut self.lost)
    }

    fn count(&mut self, sequence: u32) {
        if let Some(last) = self.last_sequence {
            let gap = sequence.wrapping_sub(last.wrapping_add(1));
            // A number that stands still or goes back is a driver that does not count.
            if gap < 1 << 31 {
                self.lost += u64::from(gap);
            }
        }
        self.last_sequence = Some(sequence);
    }

    /// The kernel's capture time, if it can be true: not later than now and later than the one of the kernel
    /// before (some cameras' own clocks, which the kernel may translate, jump). Otherwise the moment of arrival.
    /// Capture times passed on always increase: one that would not is moved behind the last and is no longer the kernel's.
    ///
    /// A moment of arrival lies after the capture times of the next pictures where a picture takes longer than the time
    /// between two. It therefore refuses none of the kernel's: the camera is back on them as soon as they pass it.
    pub(super) fn stamp(&mut self, frame: &Frame, arrived: Stamp) -> (Stamp, bool) {
        let kernel = frame.stamp.filter(|stamp| *stamp <= arrived && *stamp > self.last_kernel);
        self.last_kernel = kernel.unwrap_or(self.last_kernel);
        let least = self.last_stamp.after(Duration::from_nanos(1));
        self.last_stamp = kernel.unwrap_or(arrived).max(least);
        (self.last_stamp, kernel == Some(self.last_stamp))
    }
}
