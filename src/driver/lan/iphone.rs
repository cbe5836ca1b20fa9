//! Phones that run aod321/iPhoneVIO: the phone connects to us and sends pictures with the pose of its
//! camera.
//!
//! One entry gives one kind of sample. Of `image`, each sample is the picture as it came with a comment
//! behind its first two bytes: `{"pose":[16 numbers],"device_time":s,"wall_clock":s}`, so that nothing the
//! phone measured is lost. Of `pose`, each sample is the 16 numbers. The phone makes one connection, so
//! both at once are not available.
//!
//! A sample's time is the phone's own, brought to our clock by the least delay that was seen
//! ([`Clock`]).
//!
//! What the phone measured at its time `d` arrives here at `a`, some delay later. The least `a - d` of the
//! last seconds is the difference of the clocks but for the shortest delay, which on a local network is a
//! few milliseconds; a delay that is longer than that is thus seen as a delay and not as time, however long it is.
//! Where the phone's clock goes backwards, or is further ahead than any delay explains, it is another session's.
//!
//! Invariant: a stamp is never later than the arrival.
//! Invariant: only the phone that is meant is listened to; a new connection of its takes the place of the
//! old one, which may be dead without a report.

pub(super) mod packet;

use std::io::{self, Write as _};
use std::time::Duration;

use tokio::io::AsyncReadExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Instant;

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
/// So much of what a phone reports of its session is logged.
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

/// JSON cannot express what is no number.
fn number(value: f64, output: &mut Vec<u8>) {
    let _ = if !value.is_finite() {
        output.write_all(b"null")
    } else if value != 0.0 && !(1e-9..1e15).contains(&value.abs()) {
        write!(output, "{value:e}")
    } else {
        write!(output, "{value}")
    };
}

/// The least difference is looked for over so long, twice: clocks drift apart by some 50 us a second at most.
const WINDOW: Duration = Duration::from_secs(5);
/// A capture time this much before the shortest delay permits is another clock's: a new session began.
const LEAP_NS: i128 = 1_000_000_000;

#[derive(Debug, Default)]
struct Clock {
    /// The least differences of this window and of the one before, ns.
    now: Option<i128>,
    before: Option<i128>,
    since: Stamp,
    /// The phone's newest time, ns.
    newest: i128,
}

impl Clock {
    /// The moment on our clock at which the phone's clock showed `device` s.
    fn stamp(&mut self, device: f64, arrived: Stamp) -> Stamp {
        // Beyond 100 years it is no clock.
        if !(0.0..3.2e9).contains(&device) {
            return arrived;
        }
        #[expect(clippy::cast_possible_truncation, reason = "within the range just checked")]
        let device = (device * 1e9) as i128;
        let difference = i128::from(arrived.0) - device;
        if device < self.newest || self.least().is_some_and(|least| difference < least - LEAP_NS) {
            *self = Self::default();
        }
        self.newest = device;
        if self.now.is_none() || arrived.since(self.since) >= WINDOW {
            (self.before, self.now, self.since) = (self.now, None, arrived);
        }
        self.now = Some(self.now.map_or(difference, |now| now.min(difference)));
        let least = self.least().unwrap_or(difference);
        Stamp(u64::try_from(device + least).unwrap_or(arrived.0)).min(arrived)
    }

    fn least(&self) -> Option<i128> {
        self.now.into_iter().chain(self.before).min()
    }
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod clock_tests {
    use super::*;

    /// Differences between stamp and true capture, for delays in ms at 30 frames a second.
    fn errors(delays: &[u64], drift_ppm: i64) -> Vec<i64> {
        let mut clock = Clock::default();
        let errors = delays.iter().zip(1_u64..).map(|(delay, frame)| {
            let captured = 1_000_000_000 + frame * 33_333_333;
            let device = captured as f64 * (1.0 + drift_ppm as f64 / 1e6) / 1e9 + 77.0;
            let stamp = clock.stamp(device, Stamp(captured + delay * 1_000_000));
            stamp.0.cast_signed() - captured.cast_signed()
        });
        errors.collect()
    }

    #[test]
    fn a_late_frame_is_not_a_later_one() {
        let late = errors(&[5, 5, 5, 40, 200, 5, 90], 0);
        assert!(late.iter().all(|error| (error - 5_000_000).abs() < 1000), "{late:?}");
        // What comes at first is late: better is known with the first that is not.
        let first = errors(&[30, 5, 30], 0);
        assert!(first[0] > 29_000_000 && first[2] < 5_100_000, "{first:?}");
    }

    #[test]
    fn samples_after_a_stall_keep_their_age() {
        // The network stands still for four seconds, and what it held comes at once.
        let stalled = (0..120).map(|frame| 4005 - frame * 1000 / 30);
        let delays: Vec<u64> = [5; 60].into_iter().chain(stalled).chain([5; 30]).collect();
        let errors = errors(&delays, 0);
        let bounds = 4_900_000..40_000_000;
        assert!(errors.iter().all(|error| bounds.contains(error)), "{errors:?}");
    }

    #[test]
    fn a_clock_that_drifts_is_followed() {
        let delays: Vec<u64> = (0..1800).map(|frame| 5 + (frame * 7) % 30).collect();
        for ppm in [-100, 100] {
            let errors = errors(&delays, ppm);
            assert!(errors.iter().skip(30).all(|error| (3_500_000..8_000_000).contains(error)), "{ppm}: {errors:?}");
        }
    }

    #[test]
    fn no_number_breaks_it_and_none_is_later_than_the_arrival() {
        let mut clock = Clock::default();
        for device in [f64::NAN, f64::INFINITY, -1.0, 1e300, 0.0, 12.0, 0.0, 3e9, 5.0] {
            assert!(clock.stamp(device, Stamp(9_000_000_000)) <= Stamp(9_000_000_000), "{device}");
        }
        // A new session began: its first frame stands at its arrival.
        clock.stamp(100.0, Stamp(10_000_000_000));
        assert_eq!(clock.stamp(5.0, Stamp(11_000_000_000)), Stamp(11_000_000_000));
        // So did this one, whose clock is far ahead.
        assert_eq!(clock.stamp(500.0, Stamp(12_000_000_000)), Stamp(12_000_000_000));
    }
}
