//! Parser of `multipart/x-mixed-replace` as cameras send it: extracts the parts from the bytes, without I/O.
//!
//! A part is a line of `--` and the boundary, header lines, an empty line and the body (RFC 2046, 5.1.1). Deviations of
//! cameras are accepted: a boundary announced with its dashes or sent with more of them, lines that end only in a
//! newline, no empty line before a boundary, no `Content-Length`. A `Content-Length` gives the length of the body;
//! without it the body ends at the next boundary.
//!
//! A part with a body or headers that are too large is discarded and counted; parsing resumes at the next boundary.
//!
//! Invariant: memory is bounded by the largest permitted body and [`LONGEST_HEAD`], whatever the input.
//! Invariant: parts cause no allocation once the largest one has been seen.

use memchr::memchr;

/// Header lines of a part, bytes: those of a camera are under 200.
pub(super) const LONGEST_HEAD: usize = 8 << 10;
/// A boundary has 70 characters at most (RFC 2046, 5.1.1).
const LONGEST_BOUNDARY: usize = 70;
/// Maximum bytes of a relevant line: two boundaries leave space for dashes, and for the header that is parsed.
const LONGEST_LINE: usize = 2 * LONGEST_BOUNDARY;

/// Result of feeding bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cut {
    /// More bytes are needed.
    Open,
    /// The headers of a part are complete; its body follows.
    Head,
    /// A part is complete: see [`Multipart::part`].
    Part,
    /// A part was discarded.
    Malformed,
    /// The last part was announced.
    End,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// Lines are skipped up to the boundary.
    Between,
    Head,
    /// This many bytes of the body are still to come.
    Sized(usize),
    /// The body ends at a boundary.
    Unsized,
}

#[derive(Debug)]
pub(super) struct Multipart {
    /// Without its leading dashes.
    boundary: Vec<u8>,
    state: State,
    line: Vec<u8>,
    /// The current line is longer than any relevant one.
    line_is_long: bool,
    head: usize,
    length: Option<usize>,
    body: Vec<u8>,
    /// The part was handed over; `body` starts again.
    reported: bool,
    largest: usize,
}

impl Multipart {
    /// `boundary` as the `Content-Type` announces it; `None` if it is invalid.
    pub(super) fn new(boundary: &str, largest: usize) -> Option<Self> {
        let boundary = boundary.trim_start_matches('-').as_bytes();
        if boundary.is_empty() || boundary.len() > LONGEST_BOUNDARY {
            return None;
        }
        Some(Self {
            boundary: boundary.to_vec(),
            state: State::Between,
            line: Vec::with_capacity(LONGEST_BOUNDARY),
            line_is_long: false,
            head: 0,
            length: None,
            body: Vec::new(),
            reported: false,
            largest,
        })
    }

    /// The body of the completed part.
    pub(super) fn part(&self) -> &[u8] {
        &self.body
    }

    /// Consumes bytes up to the end of at most one part.
    pub(super) fn feed(&mut self, bytes: &[u8]) -> (usize, Cut) {
        if std::mem::take(&mut self.reported) {
            self.body.clear();
        }
        let mut taken = 0;
        while let Some(rest) = bytes.get(taken..)
            && !rest.is_empty()
        {
            let (count, cut) = match self.state {
                State::Sized(missing) => self.take_sized(rest, missing),
                State::Unsized => self.take_unsized(rest),
                State::Between | State::Head => self.take_line(rest),
            };
            taken += count;
            if cut != Cut::Open {
                return (taken, cut);
            }
        }
        (taken, Cut::Open)
    }

    fn take_sized(&mut self, bytes: &[u8], missing: usize) -> (usize, Cut) {
        let count = missing.min(bytes.len());
        self.body.extend_from_slice(bytes.get(..count).unwrap_or_default());
        if count < missing {
            self.state = State::Sized(missing - count);
            return (count, Cut::Open);
        }
        (count, self.complete())
    }

    /// Lines are checked as they arrive: the boundary line was not part of the body.
    fn take_unsized(&mut self, bytes: &[u8]) -> (usize, Cut) {
        let end = memchr(b'\n', bytes).map(|at| at + 1);
        let count = end.unwrap_or(bytes.len());
        // The boundary's own line, and the line end before it, do not belong to the body.
        if self.body.len() + count > self.largest.saturating_add(LONGEST_LINE + b"\r\n".len()) {
            self.body.clear();
            return (0, self.give_up());
        }
        let piece = bytes.get(..count).unwrap_or_default();
        self.remember(piece);
        self.body.extend_from_slice(piece);
        if end.is_none() {
            return (count, Cut::Open);
        }
        let Some(is_last) = self.boundary_line() else {
            self.next_line();
            return (count, Cut::Open);
        };
        let boundary = self.line.len();
        let body = self.body.len().saturating_sub(boundary);
        self.body.truncate(body);
        for end in [b'\n', b'\r'] {
            if self.body.last() == Some(&end) {
                self.body.pop();
            }
        }
        self.next_line();
        let cut = if self.body.len() > self.largest { Cut::Malformed } else { Cut::Part };
        self.reported = true;
        self.begin(is_last);
        (count, cut)
    }

    fn take_line(&mut self, bytes: &[u8]) -> (usize, Cut) {
        let end = memchr(b'\n', bytes).map(|at| at + 1);
        let count = end.unwrap_or(bytes.len());
        if self.state == State::Head {
            self.head += count;
            if self.head > LONGEST_HEAD {
                return (0, self.give_up());
            }
        }
        self.remember(bytes.get(..count).unwrap_or_default());
        if end.is_none() {
            return (count, Cut::Open);
        }
        let cut = match self.state {
            State::Head => self.head_line(),
            _ => match self.boundary_line() {
                Some(true) => Cut::End,
                Some(false) => {
                    self.begin(false);
                    Cut::Open
                }
                None => Cut::Open,
            },
        };
        self.next_line();
        (count, cut)
    }

    fn head_line(&mut self) -> Cut {
        let line = self.line.trim_ascii();
        if line.is_empty() && !self.line_is_long {
            return match self.length {
                Some(length) if length > self.largest => {
                    self.state = State::Between;
                    Cut::Malformed
                }
                Some(0) => self.complete(),
                Some(length) => {
                    self.state = State::Sized(length);
                    Cut::Head
                }
                None => {
                    self.state = State::Unsized;
                    Cut::Head
                }
            };
        }
        // Of a line that is too long only the beginning is kept, or nothing.
        if !self.line_is_long
            && let Some(value) = header(line, b"content-length")
        {
            // A length that is not a number is ignored.
            self.length = std::str::from_utf8(value).ok().and_then(|digits| digits.parse().ok());
        }
        Cut::Open
    }

    fn complete(&mut self) -> Cut {
        self.state = State::Between;
        self.reported = true;
        Cut::Part
    }

    /// Discards the part, perhaps in the middle of a line. None of the bytes that made it too large are consumed: they
    /// may be the boundary of the next part.
    fn give_up(&mut self) -> Cut {
        self.state = State::Between;
        Cut::Malformed
    }

    /// Starts a part, after a boundary.
    fn begin(&mut self, is_last: bool) {
        (self.head, self.length) = (0, None);
        if !self.reported {
            self.body.clear();
        }
        self.state = if is_last { State::Between } else { State::Head };
    }

    /// Whether the line is a boundary, and if so whether it is the last one.
    fn boundary_line(&self) -> Option<bool> {
        if self.line_is_long {
            return None;
        }
        let line = self.line.trim_ascii_end();
        let dashes = line.iter().take_while(|byte| **byte == b'-').count();
        let rest = line.get(dashes..)?.strip_prefix(self.boundary.as_slice())?;
        match rest {
            _ if dashes < 2 => None,
            b"" => Some(false),
            b"--" => Some(true),
            _ => None,
        }
    }

    fn remember(&mut self, piece: &[u8]) {
        if self.line.len() + piece.len() > LONGEST_LINE {
            self.line_is_long = true;
        } else {
            self.line.extend_from_slice(piece);
        }
    }

    fn next_line(&mut self) {
        self.line.clear();
        self.line_is_long = false;
    }
}

/// The value of a header line, if the header has this name.
fn header<'a>(line: &'a [u8], name: &[u8]) -> Option<&'a [u8]> {
    let colon = line.iter().position(|byte| *byte == b':')?;
    let (key, value) = line.split_at(colon);
    key.trim_ascii().eq_ignore_ascii_case(name).then(|| value.get(1..).unwrap_or_default().trim_ascii())
}

/// The boundary that a `Content-Type` announces.
pub(super) fn boundary(content_type: &str) -> Option<&str> {
    let (kind, parameters) = content_type.split_once(';')?;
    if !kind.trim().to_ascii_lowercase().starts_with("multipart/") {
        return None;
    }
    let value = parameters.split(';').find_map(|parameter| {
        let (key, value) = parameter.split_once('=')?;
        key.trim().eq_ignore_ascii_case("boundary").then(|| value.trim().trim_matches('"'))
    })?;
    (!value.is_empty()).then_some(value)
}

/// Result of looking for a boundary that was not announced.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Sniffed {
    /// More bytes are needed.
    Open,
    /// The body begins with it.
    Boundary(String),
    /// The body begins with something else.
    Nothing,
}

/// The boundary in the first line of a body, with or without empty lines before it.
pub(super) fn sniff(begun: &[u8]) -> Sniffed {
    let line = begun.trim_ascii_start();
    let text = line.get(..memchr(b'\n', line).unwrap_or(line.len())).unwrap_or_default();
    let is_boundary = text.iter().zip(b"--").all(|(byte, dash)| byte == dash);
    if !is_boundary || begun.len() - line.len() + text.len() > 2 * LONGEST_LINE {
        return Sniffed::Nothing;
    }
    if text.len() == line.len() {
        return Sniffed::Open;
    }
    match std::str::from_utf8(text).map(|text| text.trim_end().trim_start_matches('-')) {
        Ok("") | Err(_) => Sniffed::Nothing,
        Ok(name) => Sniffed::Boundary(name.to_owned()),
    }
}

#[cfg(test)]
mod tests;
