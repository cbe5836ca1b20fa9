//! Message boundaries: which bytes of a stream belong together.
//!
//! Invariant: the messages depend on the bytes alone, not on how they were cut into reads.
//! Invariant: a message longer than the limit is never held, however long it is.

use crate::registry::Framing;

/// What feeding bytes led to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cut {
    /// The message is not complete.
    Open,
    /// `message` is complete; it stays until the next feed.
    Message,
    /// A message ended that was longer than the limit or wrongly stuffed.
    Malformed,
}

/// Cuts a stream of bytes into messages.
#[derive(Debug)]
pub(super) struct Framer {
    framing: Framing,
    limit: usize,
    message: Vec<u8>,
    /// A boundary was seen since the beginning.
    aligned: bool,
    /// The message so far is longer than the limit; its bytes are let go up to the boundary.
    overlong: bool,
    /// The message was handed out: the next byte begins a new one.
    complete: bool,
}

impl Framer {
    pub(super) fn new(framing: Framing, limit: usize) -> Self {
        // COBS adds one byte to each 254 and one more; a line may end in a carriage return.
        let limit = match framing {
            Framing::Line => limit.saturating_add(1),
            Framing::Cobs => limit.saturating_add(limit / 254 + 1),
            Framing::Fixed(length) => length.max(1),
        };
        // Raw messages may be permitted to be large; what they need is reserved as they come.
        let message = Vec::with_capacity(limit.min(1 << 16));
        let aligned = matches!(framing, Framing::Fixed(_));
        Self { framing, limit, message, aligned, overlong: false, complete: false }
    }

    /// Consumes bytes up to the end of a message, and says how many.
    pub(super) fn feed(&mut self, bytes: &[u8]) -> (usize, Cut) {
        if std::mem::take(&mut self.complete) {
            self.message.clear();
        }
        let delimiter = match self.framing {
            Framing::Fixed(_) => return self.fill(bytes),
            Framing::Line => b'\n',
            Framing::Cobs => 0,
        };
        let Some(end) = bytes.iter().position(|&byte| byte == delimiter) else {
            self.take(bytes);
            return (bytes.len(), Cut::Open);
        };
        self.take(&bytes[..end]);
        (end + 1, self.finish())
    }

    /// The message that was completed last.
    pub(super) fn message(&self) -> &[u8] {
        &self.message
    }

    /// Lets the first byte of a complete message go and keeps the rest as the beginning of the next:
    /// how messages of fixed length find their boundary again. Says no for other framings, which
    /// have boundaries of their own.
    pub(super) fn slip(&mut self) -> bool {
        if !matches!(self.framing, Framing::Fixed(_)) || self.message.is_empty() {
            return false;
        }
        self.message.remove(0);
        self.complete = false;
        true
    }

    pub(super) fn description(&self) -> String {
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

    fn take(&mut self, bytes: &[u8]) {
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

    /// At a boundary. An empty message is none: senders repeat boundaries to be sure of one.
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

/// Undoes consistent overhead byte stuffing in place (Cheshire and Baker, 1999): a code byte `n` is
/// followed by `n - 1` bytes and stands for a zero after them, except where `n` is 255 or the
/// message ends. `message` holds no zero. False if a code points beyond the end.
fn unstuff(message: &mut Vec<u8>) -> bool {
    let (mut read, mut written) = (0, 0);
    while let Some(&code) = message.get(read) {
        let run = usize::from(code).saturating_sub(1);
        let (from, to) = (read + 1, read + 1 + run);
        if code == 0 || to > message.len() {
            return false;
        }
        message.copy_within(from..to, written);
        written += run;
        read = to;
        if code != u8::MAX && read < message.len() {
            // `written` is below `read`: the code byte made room.
            message[written] = 0;
            written += 1;
        }
    }
    message.truncate(written);
    true
}

#[cfg(test)]
mod tests;
