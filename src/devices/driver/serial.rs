//! Serial lines: cuts the received bytes into messages and parses the numbers of each message.
//!
//! A malformed message (overlong, badly stuffed, wrong count, not numbers) is skipped and counted in `lost` of the next
//! reading; it never ends the stream. Bytes before the first message boundary after opening are the tail of a message
//! and dropped without being counted. `nan` and `inf` are numbers here and are passed on unchanged:
//! every sample with one of them is damaged ([`rapid_core::sample::damage`]).
//!
//! Invariant: the messages depend only on the bytes, not on how reads divide them.
//! Invariant: memory is bounded by the longest permitted message, whatever the device sends; longer ones are not held, and a
//! well-formed one causes no allocation.
//! Invariant: a stamp is the moment the bytes that completed the message were read; a serial line provides no earlier
//! one. Each of several messages in one read is older than the next by the least time that its bytes take on a line
//! (`arrival`): stamps always increase.

use std::fmt;
use std::os::fd::{AsFd as _, AsRawFd as _, BorrowedFd, FromRawFd as _, IntoRawFd as _, OwnedFd};
use std::path::Path;

use rapid_core::provenance::{Format, Negotiated};
use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use rapid_registry::{Framing, Parse, SerialSpec};
use rapid_system::tty;
use serde::de::{DeserializeSeed, Deserializer, Error as _, IgnoredAny, MapAccess, SeqAccess, Visitor};
use tokio::io::AsyncReadExt as _;
use tokio_serial::{ClearBuffer, SerialPort as _, SerialPortBuilder, SerialStream};

use super::{Agreed, DriverError, Reading, arrival, unblock};

/// Bytes read from the kernel at once.
const INBOX: usize = 4096;
/// Longest message of a text format without many channels.
const SHORT_MESSAGE: usize = 4096;
/// Maximum plausible length of a number in text with its separator, JSON keys included.
const TEXT_PER_CHANNEL: usize = 64;

/// An open serial line.
#[derive(Debug)]
pub struct Serial {
    stream: SerialStream,
    decoder: Decoder,
    inbox: Box<[u8; INBOX]>,
    /// `inbox[taken..filled]` is unprocessed.
    taken: usize,
    filled: usize,
    /// When the bytes in `inbox` arrived.
    arrived: Stamp,
    /// Stamp of the last message.
    stamped: Stamp,
    lost: u64,
    pub(super) agreed: Agreed,
}

impl Serial {
    /// Opens the line at `path` exclusively. `max_bytes` bounds a raw message.
    ///
    /// Opening a USB serial adapter or CDC-ACM device raises DTR, which restarts some boards.
    ///
    /// # Errors
    /// When the line is gone, held by another program, not permitted, or cannot be set up.
    pub async fn open(spec: &SerialSpec, path: &Path, max_bytes: usize) -> Result<Self, DriverError> {
        let decoder = Decoder::new(spec, max_bytes);
        let description = format!("{} at {} baud, {}", path.display(), spec.baud, decoder.description());
        let path = path.to_owned();
        let baud = spec.baud;
        let stream = unblock(move || open_line(&path, baud)).await?;
        let baud = stream.baud_rate().unwrap_or(baud);
        let format = Format::Messages { baud: Some(baud), channels: spec.channels, hz: None };
        Ok(Self {
            stream,
            decoder,
            inbox: Box::new([0; INBOX]),
            taken: 0,
            filled: 0,
            arrived: Stamp::default(),
            stamped: Stamp::default(),
            lost: 0,
            agreed: Agreed { description, negotiated: Negotiated { format: Some(format), ..Negotiated::default() } },
        })
    }

    /// The next message.
    ///
    /// # Errors
    /// [`DriverError::Gone`] when the line hung up.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        while !self.decode() {
            // If the future is dropped, the bytes stay in the kernel or in the inbox.
            let count = self.stream.read(&mut self.inbox[..]).await.map_err(|error| read_error(&error))?;
            if count == 0 {
                return Err(DriverError::Gone);
            }
            self.arrived = Stamp::now();
            (self.taken, self.filled) = (0, count);
        }
        let lost = std::mem::take(&mut self.lost);
        self.stamped = arrival::completed(self.arrived, self.filled - self.taken, self.stamped);
        Ok(self.decoder.reading(self.stamped, lost))
    }

    /// Takes bytes from the inbox until a valid message is complete.
    fn decode(&mut self) -> bool {
        while let Some(bytes) = self.inbox.get(self.taken..self.filled)
            && !bytes.is_empty()
        {
            let (taken, decoded) = self.decoder.feed(bytes);
            self.taken += taken;
            match decoded {
                Decoded::Nothing => {}
                Decoded::Message => return true,
                Decoded::Malformed => self.lost += 1,
            }
        }
        false
    }
}

/// Converts bytes to readings, without I/O.
#[derive(Debug)]
struct Decoder {
    framer: Framer,
    parse: Parse,
    values: Vec<f64>,
    output: Vec<u8>,
    /// `Framing::Fixed` only: the last message was refused, and bytes are dropped one by one until a message fits
    /// again.
    slipping: bool,
}

/// Result of feeding bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Decoded {
    /// More bytes are needed.
    Nothing,
    /// A message can be fetched by `reading`.
    Message,
    /// A message was refused.
    Malformed,
}

impl Decoder {
    fn new(spec: &SerialSpec, max_bytes: usize) -> Self {
        let limit = match (spec.framing, spec.parse) {
            (Framing::Fixed(length), _) => length,
            (_, Parse::Raw) => max_bytes,
            (_, Parse::F32le) => spec.channels * 4,
            (_, Parse::Csv | Parse::Json) => SHORT_MESSAGE.max(spec.channels * TEXT_PER_CHANNEL),
        };
        Self {
            framer: Framer::new(spec.framing, limit),
            parse: spec.parse,
            values: vec![0.0; spec.channels],
            output: Vec::with_capacity(spec.channels * 8),
            slipping: false,
        }
    }

    /// Consumes bytes up to the end of at most one message.
    fn feed(&mut self, bytes: &[u8]) -> (usize, Decoded) {
        let (taken, cut) = self.framer.feed(bytes);
        let decoded = match cut {
            Cut::Open => Decoded::Nothing,
            Cut::Message if self.accepts() => {
                self.slipping = false;
                Decoded::Message
            }
            Cut::Message if self.framer.slip() => {
                let first = !std::mem::replace(&mut self.slipping, true);
                if first { Decoded::Malformed } else { Decoded::Nothing }
            }
            Cut::Message | Cut::Malformed => Decoded::Malformed,
        };
        (taken, decoded)
    }

    fn accepts(&mut self) -> bool {
        if self.parse == Parse::Raw {
            return true;
        }
        if !numbers(self.parse, self.framer.message(), &mut self.values) {
            return false;
        }
        self.output.clear();
        self.output.extend(self.values.iter().flat_map(|value| value.to_le_bytes()));
        true
    }

    fn reading(&self, captured: Stamp, lost: u64) -> Reading<'_> {
        let (bytes, encoding, width) = match self.parse {
            Parse::Raw => (self.framer.message(), Encoding::Bytes, 0),
            _ => (self.output.as_slice(), Encoding::F64, u32::try_from(self.values.len()).unwrap_or(u32::MAX)),
        };
        Reading { bytes, encoding, captured, flags: 0, width, height: 0, lost }
    }

    fn description(&self) -> String {
        let content = match self.parse {
            Parse::Csv => "comma-separated values",
            Parse::Json => "values in JSON",
            Parse::F32le => "32-bit floats",
            Parse::Raw => return format!("bytes in {}", self.framer.description()),
        };
        format!("{} {content} in {}", self.values.len(), self.framer.description())
    }
}

/// Decodes a line that delivers `pieces` one after another: the payloads, and the number of refused messages.
#[doc(hidden)]
pub fn decode<'p>(
    spec: &SerialSpec,
    max_bytes: usize,
    pieces: impl IntoIterator<Item = &'p [u8]>,
) -> (Vec<Vec<u8>>, u64) {
    let mut decoder = Decoder::new(spec, max_bytes);
    let (mut payloads, mut refused) = (Vec::new(), 0);
    for mut piece in pieces {
        while !piece.is_empty() {
            let (taken, outcome) = decoder.feed(piece);
            piece = piece.get(taken..).unwrap_or_default();
            match outcome {
                Decoded::Nothing => {}
                Decoded::Message => payloads.push(decoder.reading(Stamp::default(), 0).bytes.to_vec()),
                Decoded::Malformed => refused += 1,
            }
        }
    }
    (payloads, refused)
}

fn open_line(path: &Path, baud: u32) -> Result<SerialStream, DriverError> {
    let stream = SerialStream::open(&line(path, baud)?).map_err(|error| open_error(path, baud, &error))?;
    // SAFETY: the stream, which outlives the borrowed descriptor, keeps it open.
    held(unsafe { BorrowedFd::borrow_raw(stream.as_raw_fd()) }, path)?;
    // Bytes waiting in the kernel precede this opening.
    let _ = stream.clear(ClearBuffer::Input);
    Ok(stream)
}

/// Opens the line at `path` exclusively, 8 bits without parity, for callers that read and write it themselves. Neither
/// reads nor writes wait.
pub(super) fn open_raw(path: &Path, baud: u32) -> Result<OwnedFd, DriverError> {
    let port = line(path, baud)?.open_native().map_err(|error| open_error(path, baud, &error))?;
    let _ = port.clear(ClearBuffer::All);
    // SAFETY: the port hands over its descriptor and does not close it.
    let fd = unsafe { OwnedFd::from_raw_fd(port.into_raw_fd()) };
    held(fd.as_fd(), path)?;
    rustix::fs::fcntl_setfl(&fd, rustix::fs::OFlags::NONBLOCK)
        .map_err(|error| DriverError::Retry(format!("{}: {error}", path.display())))?;
    Ok(fd)
}

/// See [`tty`]; the crate that opened the line has locked it.
fn held(line: BorrowedFd<'_>, path: &Path) -> Result<(), DriverError> {
    tty::release_if_pseudo(line).map_err(|error| DriverError::Retry(format!("{}: {error}", path.display())))
}

fn line(path: &Path, baud: u32) -> Result<SerialPortBuilder, DriverError> {
    let Some(name) = path.to_str() else {
        return Err(DriverError::Fatal(format!("{}: the path is not UTF-8", path.display())));
    };
    Ok(tokio_serial::new(name, baud).exclusive(true))
}

fn open_error(path: &Path, baud: u32, error: &tokio_serial::Error) -> DriverError {
    let shown = path.display();
    match error.kind() {
        // serialport reports EBUSY, from TIOCEXCL or from its lock, as `NoDevice`.
        tokio_serial::ErrorKind::NoDevice if path.exists() => {
            DriverError::Retry(format!("{shown} is held by another program: end it (`fuser {shown}` names it)"))
        }
        tokio_serial::ErrorKind::NoDevice | tokio_serial::ErrorKind::Io(std::io::ErrorKind::NotFound) => {
            DriverError::Gone
        }
        tokio_serial::ErrorKind::Io(std::io::ErrorKind::PermissionDenied) => DriverError::Fatal(format!(
            "{shown} may not be opened: add the user to group dialout (`sudo usermod -aG dialout $USER`, then log in \
             again) or install the udev rules (`rapid artifacts --install`)"
        )),
        // ENODEV, ENXIO and EIO arrive without their number; check instead whether the node is gone.
        _ if !path.exists() => DriverError::Gone,
        _ => DriverError::Retry(format!("{shown} at {baud} baud: {error}")),
    }
}

/// A line whose device is gone reports EIO, ENODEV or ENXIO.
fn read_error(error: &std::io::Error) -> DriverError {
    const GONE: [i32; 4] = [libc::EIO, libc::ENODEV, libc::ENXIO, libc::EBADF];
    match error.raw_os_error() {
        Some(number) if GONE.contains(&number) => DriverError::Gone,
        _ => DriverError::Retry(format!("reading the line: {error}")),
    }
}

/// Parses exactly `values.len()` numbers from `message`; false if it contains anything else.
fn numbers(parse: Parse, message: &[u8], values: &mut [f64]) -> bool {
    match parse {
        Parse::Csv => csv(message, values),
        Parse::Json => json(message, values),
        Parse::F32le => f32le(message, values),
        Parse::Raw => false,
    }
}

fn csv(message: &[u8], values: &mut [f64]) -> bool {
    let mut fields = message.split(|&byte| byte == b',');
    for value in values {
        let Some(number) = fields.next().and_then(decimal) else { return false };
        *value = number;
    }
    fields.next().is_none()
}

/// A decimal number, optionally surrounded by blanks; `nan`, `inf` and `-inf` included.
fn decimal(field: &[u8]) -> Option<f64> {
    std::str::from_utf8(field.trim_ascii()).ok()?.parse().ok()
}

fn f32le(message: &[u8], values: &mut [f64]) -> bool {
    if message.len() != values.len() * 4 {
        return false;
    }
    for (value, bytes) in values.iter_mut().zip(message.chunks_exact(4)) {
        let mut four = [0; 4];
        four.copy_from_slice(bytes);
        *value = f64::from(f32::from_le_bytes(four));
    }
    true
}

fn json(message: &[u8], values: &mut [f64]) -> bool {
    let requested = values.len();
    let mut sink = Sink { values, count: 0 };
    let mut deserializer = serde_json::Deserializer::from_slice(message);
    let read = deserializer.deserialize_any(Document(&mut sink)).and_then(|()| deserializer.end());
    read.is_ok() && sink.count == requested
}

struct Sink<'a> {
    values: &'a mut [f64],
    count: usize,
}

impl Sink<'_> {
    fn push(&mut self, number: f64) -> bool {
        let Some(place) = self.values.get_mut(self.count) else { return false };
        *place = number;
        self.count += 1;
        true
    }
}

/// An array of numbers, or an object whose numeric values are taken in order; its other values (names, units, nested
/// objects) are skipped.
struct Document<'a, 'b>(&'a mut Sink<'b>);

impl<'de> Visitor<'de> for Document<'_, '_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of numbers or an object")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut array: A) -> Result<(), A::Error> {
        while let Some(element) = array.next_element_seed(Element)? {
            let Some(number) = element else { return Err(A::Error::custom("not a number")) };
            if !self.0.push(number) {
                return Err(A::Error::custom("too many numbers"));
            }
        }
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut object: A) -> Result<(), A::Error> {
        while object.next_key::<IgnoredAny>()?.is_some() {
            if let Some(number) = object.next_value_seed(Element)?
                && !self.0.push(number)
            {
                return Err(A::Error::custom("too many numbers"));
            }
        }
        Ok(())
    }
}

/// Any value: `Some` if it is a number.
struct Element;

impl<'de> DeserializeSeed<'de> for Element {
    type Value = Option<f64>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Element {
    type Value = Option<f64>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any value")
    }

    fn visit_f64<E>(self, number: f64) -> Result<Self::Value, E> {
        Ok(Some(number))
    }

    fn visit_i64<E>(self, number: i64) -> Result<Self::Value, E> {
        Ok(Some(number as f64))
    }

    fn visit_u64<E>(self, number: u64) -> Result<Self::Value, E> {
        Ok(Some(number as f64))
    }

    fn visit_bool<E>(self, _: bool) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_str<E>(self, _: &str) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_unit<E>(self) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut array: A) -> Result<Self::Value, A::Error> {
        while array.next_element::<IgnoredAny>()?.is_some() {}
        Ok(None)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut object: A) -> Result<Self::Value, A::Error> {
        while object.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
        Ok(None)
    }
}

/// Result of feeding bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cut {
    /// The message is not complete.
    Open,
    /// `message` is complete; it stays until the next feed.
    Message,
    /// A message ended that was longer than the limit or wrongly stuffed.
    Malformed,
}

/// Cuts a stream of bytes into messages.
#[derive(Debug)]
struct Framer {
    framing: Framing,
    limit: usize,
    message: Vec<u8>,
    /// A boundary was seen since the beginning.
    aligned: bool,
    /// The message so far is longer than the limit; bytes are dropped up to the boundary.
    overlong: bool,
    /// The message was handed out: the next byte begins a new one.
    complete: bool,
}

impl Framer {
    fn new(framing: Framing, limit: usize) -> Self {
        // COBS adds one byte per 254 and one more; a line may end in a carriage return.
        let limit = match framing {
            Framing::Line => limit.saturating_add(1),
            Framing::Cobs => limit.saturating_add(limit / 254 + 1),
            Framing::Fixed(length) => length.max(1),
        };
        // Raw messages may be large; memory for them is reserved as they arrive.
        let message = Vec::with_capacity(limit.min(1 << 16));
        let aligned = matches!(framing, Framing::Fixed(_));
        Self { framing, limit, message, aligned, overlong: false, complete: false }
    }

    /// Consumes bytes up to the end of a message, and returns their number.
    fn feed(&mut self, bytes: &[u8]) -> (usize, Cut) {
        if std::mem::take(&mut self.complete) {
            self.message.clear();
        }
        let delimiter = match self.framing {
            Framing::Fixed(_) => return self.fill(bytes),
            Framing::Line => b'\n',
            Framing::Cobs => 0,
        };
        let Some(end) = bytes.iter().position(|&byte| byte == delimiter) else {
            self.append(bytes);
            return (bytes.len(), Cut::Open);
        };
        self.append(&bytes[..end]);
        (end + 1, self.finish())
    }

    /// The message that was completed last.
    fn message(&self) -> &[u8] {
        &self.message
    }

    /// Drops the first byte of a complete message and keeps the rest as the start of the next: this is how messages of
    /// fixed length find their boundary again. `false` for other framings, which have explicit boundaries.
    fn slip(&mut self) -> bool {
        if !matches!(self.framing, Framing::Fixed(_)) || self.message.is_empty() {
            return false;
        }
        self.message.remove(0);
        self.complete = false;
        true
    }

    fn description(&self) -> String {
        match self.framing {
            Framing::Line => String::from("lines"),
            Framing::Cobs => String::from("COBS frames"),
            Framing::Fixed(length) => format!("messages of {length} bytes"),
        }
    }

    fn fill(&mut self, bytes: &[u8]) -> (usize, Cut) {
        let count = bytes.len().min(self.limit.saturating_sub(self.message.len()));
        self.message.extend_from_slice(&bytes[..count]);
        self.complete = self.message.len() >= self.limit;
        (count, if self.complete { Cut::Message } else { Cut::Open })
    }

    fn append(&mut self, bytes: &[u8]) {
        if !self.aligned || self.overlong {
            return;
        }
        if self.message.len() + bytes.len() > self.limit {
            self.overlong = true;
            self.message.clear();
            return;
        }
        self.message.extend_from_slice(bytes);
    }

    /// At a boundary. An empty message is ignored: senders repeat boundaries for safety.
    fn finish(&mut self) -> Cut {
        let aligned = std::mem::replace(&mut self.aligned, true);
        let overlong = std::mem::take(&mut self.overlong);
        if !aligned {
            return Cut::Open;
        }
        if overlong {
            return Cut::Malformed;
        }
        if self.framing == Framing::Line && self.message.last() == Some(&b'\r') {
            self.message.pop();
        }
        if self.message.is_empty() {
            return Cut::Open;
        }
        self.complete = true;
        if self.framing == Framing::Cobs && !unstuff(&mut self.message) {
            return Cut::Malformed;
        }
        Cut::Message
    }
}

/// Undoes consistent overhead byte stuffing in place. False if a code points beyond the end.
fn unstuff(message: &mut Vec<u8>) -> bool {
    let length = cobs::decode_in_place(message).ok();
    message.truncate(length.unwrap_or_default());
    length.is_some()
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod parse_tests;

#[cfg(test)]
mod framing_tests;
