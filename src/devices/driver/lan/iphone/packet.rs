//! Parses the phone's messages from the bytes, without I/O.
//!
//! The format is that of aod321/iPhoneVIO (`NetworkClient.swift`): messages with a header of 8 bytes, `u32 payload
//! length, u8 type, 3 reserved`, and the payload, little endian. Type 1 is a frame: `u32 JPEG length, 16 f32 camera
//! pose (4 by 4, column by column), f64 time of the device's own clock, f64 wall clock (s since 1970), JPEG`. Type 0 is
//! the session in JSON, once per connection; 2 and 3 are commands of a teleoperator and reachability, which are
//! ignored.
//!
//! Invariant: memory is bounded by the largest picture permitted, whatever the input.
//! Invariant: frames cause no allocation once the largest one has been seen.

/// Header of a message, bytes.
const HEADER: usize = 8;
/// Bytes of a frame before the picture.
pub(in crate::driver::lan) const FRAME_HEAD: usize = 84;
/// The session's JSON is some 300 bytes.
const LARGEST_SESSION: usize = 64 << 10;

const SESSION: u8 = 0;
const FRAME: u8 = 1;

/// Result of feeding bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::driver::lan) enum Cut {
    /// More bytes are needed.
    Open,
    /// A frame is complete; its picture is [`Packets::payload`].
    Frame(Frame),
    /// The session's JSON is complete: [`Packets::payload`].
    Session,
    /// A frame that is too large, or whose lengths are inconsistent.
    Malformed,
}

/// Data sent with a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::driver::lan) struct Frame {
    /// Pose of the camera, 4 by 4, column by column.
    pub(in crate::driver::lan) pose: [f32; 16],
    /// Capture time on the device's own clock, s.
    pub(in crate::driver::lan) device_time: f64,
    /// The same on the phone's wall clock, s since 1970.
    pub(in crate::driver::lan) wall_clock: f64,
}

#[derive(Debug)]
pub(in crate::driver::lan) struct Packets {
    header: [u8; HEADER],
    header_filled: usize,
    payload: Vec<u8>,
    /// Bytes of the payload still to come.
    missing: usize,
    /// Incoming bytes are discarded.
    skips: bool,
    /// The message was handed over; `payload` starts again.
    reported: bool,
    largest_picture: usize,
}

impl Packets {
    pub(in crate::driver::lan) fn new(largest_picture: usize) -> Self {
        Self {
            header: [0; HEADER],
            header_filled: 0,
            payload: Vec::new(),
            missing: 0,
            skips: false,
            reported: false,
            largest_picture,
        }
    }

    /// The picture of the completed frame, or the text of the completed session.
    pub(in crate::driver::lan) fn payload(&self) -> &[u8] {
        let skip = if self.header[4] == FRAME { FRAME_HEAD } else { 0 };
        self.payload.get(skip..).unwrap_or_default()
    }

    /// Consumes bytes up to the end of at most one message.
    pub(in crate::driver::lan) fn feed(&mut self, bytes: &[u8]) -> (usize, Cut) {
        if std::mem::take(&mut self.reported) {
            self.payload.clear();
            self.header_filled = 0;
        }
        let mut taken = 0;
        while let Some(rest) = bytes.get(taken..)
            && !rest.is_empty()
        {
            if self.header_filled < HEADER {
                let count = rest.len().min(HEADER - self.header_filled);
                let (from, to) =
                    (rest.get(..count), self.header.get_mut(self.header_filled..self.header_filled + count));
                if let (Some(from), Some(to)) = (from, to) {
                    to.copy_from_slice(from);
                }
                self.header_filled += count;
                taken += count;
                if self.header_filled == HEADER {
                    let cut = self.begin();
                    if cut != Cut::Open {
                        return (taken, cut);
                    }
                }
                continue;
            }
            let count = rest.len().min(self.missing);
            if !self.skips {
                self.payload.extend_from_slice(rest.get(..count).unwrap_or_default());
            }
            self.missing -= count;
            taken += count;
            if self.missing == 0 {
                let cut = self.complete();
                if cut != Cut::Open {
                    return (taken, cut);
                }
            }
        }
        (taken, Cut::Open)
    }

    /// Starts a message, after its header.
    fn begin(&mut self) -> Cut {
        let [a, b, c, d, kind, ..] = self.header;
        self.missing = u32::from_le_bytes([a, b, c, d]) as usize;
        let most = match kind {
            SESSION => LARGEST_SESSION,
            FRAME => FRAME_HEAD.saturating_add(self.largest_picture),
            _ => 0,
        };
        self.skips = self.missing > most;
        if self.missing == 0 {
            return self.complete();
        }
        if self.skips && kind == FRAME { Cut::Malformed } else { Cut::Open }
    }

    fn complete(&mut self) -> Cut {
        self.reported = true;
        let kind = self.header[4];
        if self.skips {
            // Already reported when it began.
            self.payload.clear();
            self.header_filled = 0;
            self.reported = false;
            return Cut::Open;
        }
        match kind {
            SESSION => Cut::Session,
            FRAME => frame(&self.payload).map_or(Cut::Malformed, Cut::Frame),
            _ => {
                self.header_filled = 0;
                self.reported = false;
                Cut::Open
            }
        }
    }
}

fn frame(payload: &[u8]) -> Option<Frame> {
    let (head, picture) = payload.split_at_checked(FRAME_HEAD)?;
    let (length, rest) = head.split_first_chunk()?;
    // Bytes after the picture do not belong to it.
    if u32::from_le_bytes(*length) as usize != picture.len() {
        return None;
    }
    let (poses, times) = rest.split_at_checked(64)?;
    let mut pose = [0.0; 16];
    for (value, bytes) in pose.iter_mut().zip(poses.as_chunks().0) {
        *value = f32::from_le_bytes(*bytes);
    }
    let [device_time, wall_clock] = times.as_chunks().0 else { return None };
    Some(Frame { pose, device_time: f64::from_le_bytes(*device_time), wall_clock: f64::from_le_bytes(*wall_clock) })
}

#[cfg(test)]
mod tests;
