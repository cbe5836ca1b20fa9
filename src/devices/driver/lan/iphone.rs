//! Phones that run aod321/iPhoneVIO: the phone connects to this program and sends pictures with the pose of its camera.
//!
//! One entry produces one kind of sample. For `image`, each sample is the received picture with a comment inserted
//! after its first two bytes: `{"pose":[16 values],"device_time":s,"wall_clock":s}`, so that no measurement of the
//! phone is lost. For `pose`, each sample is the 16 values. The phone makes one connection, so both at once are not
//! available.
//!
//! A sample's time is the phone's own, converted to our clock ([`clock`]); one whose time cannot be right is damaged.
//!
//! Invariant: a stamp is never later than the arrival.
//! Invariant: only the entry's phone is accepted; a new connection from it replaces the old one, which may be dead
//! without a report.

mod clock;
pub(super) mod packet;

use std::io::{self, Write as _};

use rapid_core::sample::{Encoding, FLAG_DEVICE_TIME, FLAG_ERROR};
use rapid_core::time::Stamp;
use rapid_registry::{LanPicture, PhoneStream};
use tokio::io::AsyncReadExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Instant;

use self::clock::{Captured, PhoneClock};
use self::packet::{Cut, FRAME_HEAD, Frame, Packets};
use super::address::DeviceAddress;
use super::mjpeg::Mismatch;
use super::{PATIENCE, jpeg};
use crate::driver::{ClockOffset, DriverError, Reading};

/// Bytes read from the kernel at once.
const INBOX: usize = 64 << 10;
/// Maximum size of a picture that is not the sample; or a byte per pixel if that is more.
const LARGEST_UNSEEN: usize = 64 << 10;
/// Logged length of a phone's session report.
const LONGEST_SESSION: usize = 500;
/// Maximum length of the comment: 18 values, the longest of which take 330 digits.
const COMMENT: usize = 2 << 10;

#[derive(Debug)]
pub(super) struct Phone {
    name: String,
    place: DeviceAddress,
    listener: TcpListener,
    connection: Option<Connection>,
    stream: PhoneStream,
    picture: LanPicture,
    max_bytes: usize,
    output: Vec<u8>,
    mismatch: Mismatch,
    clock: PhoneClock,
    lost: u64,
}

#[derive(Debug)]
struct Connection {
    stream: TcpStream,
    packets: Packets,
    inbox: Box<[u8]>,
    /// `inbox[taken..filled]` is unprocessed.
    taken: usize,
    filled: usize,
    arrived: Stamp,
    /// When the newest frame was complete, or the phone connected.
    newest: Instant,
}

impl Phone {
    pub(super) fn open(
        name: &str,
        place: DeviceAddress,
        port: u16,
        stream: PhoneStream,
        picture: LanPicture,
        max_bytes: usize,
    ) -> Result<Self, DriverError> {
        let listener = place.listen(port)?;
        Ok(Self {
            name: name.to_owned(),
            place,
            listener,
            connection: None,
            stream,
            picture,
            max_bytes,
            output: Vec::new(),
            mismatch: Mismatch::default(),
            clock: PhoneClock::recall(name),
            lost: 0,
        })
    }

    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let (frame, arrived) = loop {
            if let Some(frame) = self.parse() {
                break frame;
            }
            self.receive().await?;
        };
        if let Some(connection) = &mut self.connection {
            connection.newest = Instant::now();
        }
        let Captured { at: captured, is_damaged } = self.clock.captured(&frame, arrived);
        let picture = self.connection.as_ref().map_or(&[][..], |connection| connection.packets.payload());
        let mut flags = if is_damaged { FLAG_ERROR } else { FLAG_DEVICE_TIME };
        self.output.clear();
        if self.stream == PhoneStream::Pose {
            self.output.extend(frame.pose.iter().flat_map(|value| f64::from(*value).to_le_bytes()));
            let lost = std::mem::take(&mut self.lost);
            let (bytes, width) = (self.output.as_slice(), 16);
            return Ok(Reading { bytes, encoding: Encoding::F64, captured, flags, width, height: 0, lost });
        }
        flags |= self.mismatch.flags(picture, &self.name, self.picture, Instant::now())?;
        annotate(picture, &frame, &mut self.output);
        Ok(Reading {
            bytes: &self.output,
            encoding: Encoding::Mjpeg,
            captured,
            flags,
            width: self.picture.width,
            height: self.picture.height,
            lost: std::mem::take(&mut self.lost),
        })
    }

    /// How the phone's clock is known, once it is.
    pub(super) fn clock(&self) -> Option<ClockOffset> {
        self.clock.offset()
    }

    /// Parses received bytes, up to the end of a frame.
    fn parse(&mut self) -> Option<(Frame, Stamp)> {
        let connection = self.connection.as_mut()?;
        while let Some(bytes) = connection.inbox.get(connection.taken..connection.filled)
            && !bytes.is_empty()
        {
            let (taken, cut) = connection.packets.feed(bytes);
            connection.taken += taken;
            match cut {
                Cut::Open => {}
                Cut::Frame(frame) => return Some((frame, connection.arrived)),
                Cut::Session => {
                    let text = connection.packets.payload();
                    let text = String::from_utf8_lossy(text.get(..LONGEST_SESSION).unwrap_or(text));
                    tracing::info!(
                        device = self.name,
                        session = rapid_core::text::plain(&text).as_ref(),
                        "a phone connected"
                    );
                }
                Cut::Malformed => self.lost += 1,
            }
        }
        None
    }

    /// Waits for bytes or for a connection. Cancel-safe, since both waits are.
    async fn receive(&mut self) -> Result<(), DriverError> {
        let patience = self.connection.as_ref().map(|connection| connection.newest + PATIENCE);
        let silent = async {
            match patience {
                Some(patience) => tokio::time::sleep_until(patience).await,
                None => std::future::pending().await,
            }
        };
        let connection = &mut self.connection;
        let bytes = async {
            match connection {
                Some(connection) => connection.stream.read(&mut connection.inbox).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            accepted = self.listener.accept() => self.accept(accepted),
            count = bytes => self.received(count),
            () = silent => Err(self.place.lost(format_args!("no frame for {} s", PATIENCE.as_secs()))),
        }
    }

    fn received(&mut self, count: io::Result<usize>) -> Result<(), DriverError> {
        let Some(connection) = &mut self.connection else { return Ok(()) };
        match count {
            Ok(0) => Err(self.place.lost("the phone closed the connection")),
            Ok(count) => {
                (connection.taken, connection.filled, connection.arrived) = (0, count, Stamp::now());
                self.place.received();
                Ok(())
            }
            Err(error) => Err(self.place.lost(error)),
        }
    }

    fn accept(&mut self, accepted: io::Result<(TcpStream, std::net::SocketAddr)>) -> Result<(), DriverError> {
        let (stream, from) = accepted.map_err(|error| self.place.lost(error))?;
        if !self.place.means(from.ip()) {
            tracing::debug!(device = self.name, %from, "a stranger connected and was sent away");
            return Ok(());
        }
        self.place.received();
        self.clock.connected();
        let largest = match self.stream {
            PhoneStream::Image => self.max_bytes.saturating_sub(COMMENT),
            // The picture is discarded, but arrives before the pose.
            PhoneStream::Pose => LARGEST_UNSEEN.max((self.picture.width * self.picture.height) as usize),
        };
        self.connection = Some(Connection {
            stream,
            packets: Packets::new(largest),
            inbox: vec![0; INBOX.max(FRAME_HEAD)].into_boxed_slice(),
            taken: 0,
            filled: 0,
            arrived: Stamp::now(),
            newest: Instant::now(),
        });
        Ok(())
    }
}

/// The next connection is another driver's.
impl Drop for Phone {
    fn drop(&mut self) {
        self.clock.keep(&self.name);
    }
}

/// The picture with the phone's measurements as a comment (JPEG, ITU-T T.81 B.2.4.5: marker FFFE, length of the rest as
/// big-endian u16 including its own two bytes). Returns whether it is a picture.
fn annotate(picture: &[u8], frame: &Frame, output: &mut Vec<u8>) -> bool {
    let Some(rest) = picture.strip_prefix(&jpeg::START) else {
        output.extend_from_slice(picture);
        return false;
    };
    output.extend_from_slice(&jpeg::START);
    output.extend_from_slice(&[0xff, 0xfe, 0, 0]);
    let at = output.len();
    // Writing to a Vec cannot fail.
    let _ = output.write_all(b"{\"pose\":[");
    for (index, value) in frame.pose.iter().enumerate() {
        let _ = output.write_all(if index == 0 { b"" } else { b"," });
        number(f64::from(*value), output);
    }
    let _ = output.write_all(b"],\"device_time\":");
    number(frame.device_time, output);
    let _ = output.write_all(b",\"wall_clock\":");
    number(frame.wall_clock, output);
    let _ = output.write_all(b"}");
    let length = u16::try_from(output.len() - at + 2).unwrap_or(u16::MAX).to_be_bytes();
    if let Some(place) = output.get_mut(at - 2..at) {
        place.copy_from_slice(&length);
    }
    output.extend_from_slice(rest);
    true
}

/// JSON cannot express NaN and infinities.
fn number(value: f64, output: &mut Vec<u8>) {
    let _ = if !value.is_finite() {
        output.write_all(b"null")
    } else if value != 0.0 && !(1e-9..1e15).contains(&value.abs()) {
        write!(output, "{value:e}")
    } else {
        write!(output, "{value}")
    };
}

#[cfg(test)]
mod tests;
