//! Sensors of another computer: `rapid-remote` on this one sends their samples, with capture times on this clock
//! ([`rapid_core::remote`]).
//!
//! Invariant: a sample has the format that the entry states: the sender is another program. One whose capture time cannot be
//! one is damaged.
//! Invariant: the connection ends when the sensor is absent there; then, and after a lease without a frame, the device
//! is gone.

use std::time::Duration;

use rapid_core::capture::{CaptureTimes, Captured};
use rapid_core::remote::{FrameError, Frames, Head, Kind, request};
use rapid_core::sample::{Encoding, FLAG_ERROR, FLAG_SAME_NUMBER};
use rapid_core::time::Stamp;
use rapid_registry::{PixelFormat, RemoteSamples};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::{Instant, timeout, timeout_at};

use super::address::Server;
use crate::driver::{ClockOffset, DriverError, Reading};

/// More samples at once are not missing: their numbers began again.
const MOST_MISSING: u64 = 1 << 20;
/// A clock that is known worse is not known.
const LEAST_KNOWN: Duration = Duration::from_secs(1);

pub(super) struct Wanted<'a> {
    pub(super) host: &'a str,
    /// The device there.
    pub(super) device: &'a str,
    pub(super) samples: RemoteSamples,
    pub(super) lease: Duration,
}

#[derive(Debug)]
pub(super) struct Remote {
    name: String,
    server: Server,
    stream: TcpStream,
    frames: Frames,
    samples: RemoteSamples,
    lease: Duration,
    /// When something was last received.
    received: Instant,
    /// The number of the newest sample.
    newest: Option<u64>,
    clock: Option<ClockOffset>,
    times: CaptureTimes,
    /// That a capture time is not believed has been logged.
    has_doubted: bool,
}

impl Remote {
    pub(super) async fn open(
        name: &str,
        server: Server,
        wanted: Wanted<'_>,
        max_bytes: usize,
    ) -> Result<Self, DriverError> {
        let Wanted { host, device, samples, lease } = wanted;
        let mut stream = server.connect().await?;
        let asked = timeout(lease, stream.write_all(request(host, device).as_bytes())).await;
        if !matches!(asked, Ok(Ok(()))) {
            return Err(server.place.lost("rapid-remote does not take the request"));
        }
        let mut remote = Self {
            name: name.to_owned(),
            server,
            stream,
            frames: Frames::new(max_bytes),
            samples,
            lease,
            received: Instant::now(),
            newest: None,
            clock: None,
            times: CaptureTimes::default(),
            has_doubted: false,
        };
        // Its first frame reports that it is present.
        remote.frame().await?;
        Ok(remote)
    }

    pub(super) const fn clock(&self) -> Option<ClockOffset> {
        self.clock
    }

    /// The next sample. Cancel-safe: what has been received stays with the frame.
    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let (head, encoding) = loop {
            let head = self.frame().await?;
            if let (Kind::Sample, Some(encoding)) = (head.kind, head.encoding) {
                break (head, encoding);
            }
        };
        self.check(&head, encoding)?;
        let missing = self.newest.map_or(0, |newest| head.seq.saturating_sub(newest.saturating_add(1)));
        let again = if self.newest == Some(head.seq) { FLAG_SAME_NUMBER } else { 0 };
        self.newest = Some(head.seq);
        let Head { offset_ns, uncertainty_ns, .. } = head;
        self.clock = Some(ClockOffset { offset_ns, uncertainty_ns });
        let (captured, flags) = self.time(&head);
        Ok(Reading {
            bytes: self.frames.payload(),
            encoding,
            captured,
            flags: flags | again,
            width: head.width,
            height: head.height,
            lost: if missing < MOST_MISSING { missing } else { 0 },
        })
    }

    /// When a sample was captured, and its flags.
    fn time(&mut self, head: &Head) -> (Stamp, u32) {
        let uncertainty = Duration::from_nanos(head.uncertainty_ns).min(LEAST_KNOWN);
        let Captured { at, doubt } = self.times.judge(Stamp(head.capture_ns), uncertainty, Stamp::now());
        let Some(doubt) = doubt else { return (at, head.flags) };
        if !std::mem::replace(&mut self.has_doubted, true) {
            tracing::warn!(device = self.name, "samples are damaged, by a capture time that is {doubt}");
        }
        (at, FLAG_ERROR)
    }

    /// The next frame that is not a refusal.
    async fn frame(&mut self) -> Result<Head, DriverError> {
        loop {
            let ends = self.received + self.lease;
            let Ok(count) = timeout_at(ends, self.stream.read(self.frames.room())).await else {
                return Err(DriverError::Gone);
            };
            let count = match count {
                Ok(0) => return Err(DriverError::Gone),
                Ok(count) => count,
                Err(error) => return Err(self.server.place.lost(format_args!("rapid-remote: {error}"))),
            };
            self.received = Instant::now();
            self.server.place.received();
            match self.frames.filled(count).map_err(|error| self.refuse(&error))? {
                Some(Head { kind: Kind::Refused, .. }) => {
                    tracing::debug!(device = self.name, reason = ?String::from_utf8_lossy(self.frames.payload()), "absent");
                    return Err(DriverError::Gone);
                }
                Some(head) => return Ok(head),
                None => {}
            }
        }
    }

    fn refuse(&self, error: &FrameError) -> DriverError {
        match error {
            FrameError::TooLong { .. } => {
                DriverError::Fatal(format!("{error}: write a larger max_bytes in [device.{}]", self.name))
            }
            FrameError::Foreign | FrameError::Field(..) => {
                DriverError::Fatal(format!("{error}: use the rapid-remote of this version on port {}", self.port()))
            }
        }
    }

    fn port(&self) -> u16 {
        self.server.address.port()
    }

    /// Checks that a sample is of the kind and size that the entry states.
    fn check(&self, head: &Head, encoding: Encoding) -> Result<(), DriverError> {
        let bytes = self.frames.payload().len();
        let table = format_args!("[device.{}.lan]", self.name);
        let wrong = |text: String| Err(DriverError::Fatal(text));
        match (self.samples, format_of(encoding)) {
            (RemoteSamples::Pictures(size, format), Some(sent)) if format == sent => {
                if (head.width, head.height) != (size.width, size.height) {
                    let Head { width, height, .. } = head;
                    return wrong(format!(
                        "its pictures are {width}x{height}: write width = {width} and height = {height} in {table}"
                    ));
                }
                Ok(())
            }
            (RemoteSamples::Pictures(..), Some(PixelFormat::Z16)) => {
                wrong(format!("its pictures are depth images: write kind = \"depth\" in {table}, without a format"))
            }
            (RemoteSamples::Pictures(..), Some(sent)) => {
                wrong(format!("its pictures are {sent}: write kind = \"image\" and format = \"{sent}\" in {table}"))
            }
            (RemoteSamples::Numbers(count), None) if encoding == Encoding::F64 => {
                let sent = bytes / size_of::<f64>();
                if !bytes.is_multiple_of(size_of::<f64>()) || u32::try_from(sent) != Ok(count) {
                    return wrong(format!("its samples have {sent} values: write channels = {sent} in {table}"));
                }
                Ok(())
            }
            (RemoteSamples::Bytes, None) if encoding == Encoding::Bytes => Ok(()),
            (_, sent) => {
                let kind = match (sent, encoding) {
                    (Some(PixelFormat::Z16), _) => "depth",
                    (Some(_), _) => "image",
                    (None, Encoding::F64) => "scalars",
                    (None, _) => "bytes",
                };
                wrong(format!("its samples are of another kind: write kind = \"{kind}\" in {table}"))
            }
        }
    }
}

const fn format_of(encoding: Encoding) -> Option<PixelFormat> {
    match encoding {
        Encoding::Mjpeg => Some(PixelFormat::Mjpg),
        Encoding::Yuyv => Some(PixelFormat::Yuyv),
        Encoding::Grey => Some(PixelFormat::Grey),
        Encoding::Depth => Some(PixelFormat::Z16),
        Encoding::Bytes | Encoding::F64 | Encoding::Mask => None,
    }
}

#[cfg(test)]
mod tests;
