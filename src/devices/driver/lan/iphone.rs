//! Phones that run aod321/iPhoneVIO: the phone connects to this program and sends pictures with the pose of its camera.
//!
//! One entry produces one kind of sample. For `image`, each sample is the received picture with a comment inserted
//! after its first two bytes: `{"pose":[16 values],"device_time":s,"wall_clock":s}`, so that no measurement of the
//! phone is lost. For `pose`, each sample is the 16 values. The phone makes one connection, so both at once are not
//! available.
//!
//! A sample's time is the phone's own, converted to our clock by the smallest delay seen ([`Clock`]).
//!
//! A measurement at the phone's time `d` arrives here at `a`, after some delay. The least `a - d` of the last seconds
//! is the difference of the clocks plus the shortest delay, which on a local network is a few milliseconds; a longer
//! delay, of any length, is thus recognised as delay and does not shift the time. If the phone's clock goes backwards,
//! or is further ahead than any delay explains, a new session has begun.
//!
//! Invariant: a stamp is never later than the arrival.
//! Invariant: only the entry's phone is accepted; a new connection from it replaces the old one, which may be dead
//! without a report.

pub(super) mod packet;

use std::io::{self, Write as _};
use std::time::Duration;

use rapid_core::sample::{Encoding, FLAG_DEVICE_TIME};
use rapid_core::time::Stamp;
use rapid_registry::{LanPicture, PhoneStream};
use tokio::io::AsyncReadExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Instant;

use self::packet::{Cut, FRAME_HEAD, Frame, Packets};
use super::address::DeviceAddress;
use super::mjpeg::Mismatch;
use super::{PATIENCE, jpeg};
use crate::driver::{DriverError, Reading};

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
    clock: Clock,
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
            clock: Clock::default(),
            newest: Instant::now(),
        });
        Ok(())
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

/// The minimum is taken over this long, twice: clocks drift apart by at most some 50 us a second.
const WINDOW: Duration = Duration::from_secs(5);
/// A capture time this far ahead of what the shortest delay permits belongs to another clock: a new session began.
const LEAP_NS: i128 = 1_000_000_000;

#[derive(Debug, Default)]
struct Clock {
    /// The least differences of this window and of the previous one, ns.
    now: Option<i128>,
    before: Option<i128>,
    since: Stamp,
    /// The phone's newest time, ns.
    newest: i128,
}

impl Clock {
    /// The moment on our clock at which the phone's clock showed `device` s.
    fn stamp(&mut self, device: f64, arrived: Stamp) -> Stamp {
        // Beyond 100 years it is not a clock.
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
    fn a_delayed_frame_keeps_its_capture_time() {
        let late = errors(&[5, 5, 5, 40, 200, 5, 90], 0);
        assert!(late.iter().all(|error| (error - 5_000_000).abs() < 1000), "{late:?}");
        // The first frames are late: the estimate improves with the first frame that is not.
        let first = errors(&[30, 5, 30], 0);
        assert!(first[0] > 29_000_000 && first[2] < 5_100_000, "{first:?}");
    }

    #[test]
    fn samples_after_a_stall_keep_their_age() {
        // The network stalls for four seconds, and then delivers everything at once.
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
    fn any_device_time_is_survived_and_no_stamp_is_later_than_the_arrival() {
        let mut clock = Clock::default();
        for device in [f64::NAN, f64::INFINITY, -1.0, 1e300, 0.0, 12.0, 0.0, 3e9, 5.0] {
            assert!(clock.stamp(device, Stamp(9_000_000_000)) <= Stamp(9_000_000_000), "{device}");
        }
        // A new session began: its first frame is stamped with its arrival.
        clock.stamp(100.0, Stamp(10_000_000_000));
        assert_eq!(clock.stamp(5.0, Stamp(11_000_000_000)), Stamp(11_000_000_000));
        // Here too; its clock is far ahead.
        assert_eq!(clock.stamp(500.0, Stamp(12_000_000_000)), Stamp(12_000_000_000));
    }
}
