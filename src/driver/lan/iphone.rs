//! Phones that run aod321/iPhoneVIO: the phone connects to us and sends pictures with the pose of its
//! camera.
//!
//! One entry gives one kind of sample. Of `image`, each sample is the picture as it came with a comment
//! behind its first two bytes: `{"pose":[16 numbers],"device_time":s,"wall_clock":s}`, so that nothing the
//! phone measured is lost. Of `pose`, each sample is the 16 numbers. The phone makes one connection, so
//! both at once are not to be had.
//!
//! A sample's time is the phone's own, brought to our clock by the least delay that was seen
//! ([`Clock`]).
//!
//! Invariant: only the phone that is meant is listened to; a new connection of its takes the place of the
//! old one, which may be dead without anybody having said so.

mod clock;
pub(super) mod packet;

use std::io::{self, Write as _};

use tokio::io::AsyncReadExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Instant;

use self::clock::Clock;
use self::packet::{Cut, FRAME_HEAD, Frame, Packets};
use super::mjpeg::check_size;
use super::place::Place;
use super::{PATIENCE, jpeg};
use crate::driver::{DriverError, Reading};
use crate::registry::{LanPicture, PhoneStream};
use crate::sample::{Encoding, FLAG_DEVICE_TIME, FLAG_ERROR};
use crate::time::Stamp;

/// Bytes taken from the kernel at once.
const INBOX: usize = 64 << 10;
/// A picture that is not the sample has room for this much, or a byte a pixel.
const LARGEST_UNSEEN: usize = 64 << 10;
/// Of what a phone says of its session, so much is logged.
const LONGEST_SESSION: usize = 500;
/// The comment at its longest: 18 numbers, the longest of which take 330 digits.
const COMMENT: usize = 2 << 10;

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Phone {
    name: String,
    place: Place,
    listener: TcpListener,
    connection: Option<Connection>,
    stream: PhoneStream,
    picture: LanPicture,
    max_bytes: usize,
    output: Vec<u8>,
    lost: u64,
}

#[derive(Debug)]
struct Connection {
    stream: TcpStream,
    packets: Packets,
    inbox: Box<[u8]>,
    /// `inbox[taken..filled]` is still to be looked at.
    taken: usize,
    filled: usize,
    arrived: Stamp,
    clock: Clock,
    /// When the newest frame was complete, or the phone connected.
    newest: Instant,
}

impl Phone {
    pub(super) fn open(
        name: &str,
        place: Place,
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
        let captured = match &mut self.connection {
            Some(connection) => {
                connection.newest = Instant::now();
                connection.clock.stamp(frame.device_time, arrived)
            }
            None => arrived,
        };
        let picture = self.connection.as_ref().map_or(&[][..], |connection| connection.packets.payload());
        let mut flags = FLAG_DEVICE_TIME;
        self.output.clear();
        if self.stream == PhoneStream::Pose {
            self.output.extend(frame.pose.iter().flat_map(|value| f64::from(*value).to_le_bytes()));
            let lost = std::mem::take(&mut self.lost);
            let (bytes, width) = (self.output.as_slice(), 16);
            return Ok(Reading { bytes, encoding: Encoding::F64, captured, flags, width, height: 0, lost });
        }
        if let Some(size) = jpeg::size(picture) {
            check_size(&self.name, size, self.picture)?;
        }
        if !annotate(picture, &frame, &mut self.output) {
            flags |= FLAG_ERROR;
        }
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

    /// Looks at what came, up to the end of a frame.
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
                        session = crate::text::plain(&text).as_ref(),
                        "a phone connected"
                    );
                }
                Cut::Malformed => self.lost += 1,
            }
        }
        None
    }

    /// Waits for bytes, or for a connection. Cancel-safe: both are.
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
                self.place.heard();
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
        self.place.heard();
        let largest = match self.stream {
            PhoneStream::Image => self.max_bytes.saturating_sub(COMMENT),
            // The picture is let go, but comes before that.
            PhoneStream::Pose => LARGEST_UNSEEN.max((self.picture.width * self.picture.height) as usize),
        };
        self.connection = Some(Connection {
            stream,
            packets: Packets::new(largest),
            inbox: vec![0; INBOX.max(FRAME_HEAD)].into_boxed_slice(),
            taken: 0,
            filled: 0,
            arrived: Stamp::now(),
            clock: Clock::default(),
            newest: Instant::now(),
        });
        Ok(())
    }
}

/// The picture with what the phone measured as a comment (JPEG, ITU-T T.81 B.2.4.5: marker FFFE, length of
/// what follows it as big-endian u16 with its own two bytes). Is it a picture?
fn annotate(picture: &[u8], frame: &Frame, output: &mut Vec<u8>) -> bool {
    let Some(rest) = picture.strip_prefix(&jpeg::START) else {
        output.extend_from_slice(picture);
        return false;
    };
    output.extend_from_slice(&jpeg::START);
    output.extend_from_slice(&[0xff, 0xfe, 0, 0]);
    let at = output.len();
    // A Vec takes every write.
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

/// JSON has no word for what is no number.
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
