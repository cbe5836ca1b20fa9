//! The part of HTTP/1.1 that a camera's server uses: GET, one answer per connection, open-ended ranges.
//!
//! Invariant: no request causes a panic; invalid ones are answered with 400.

use serde_json::Value;

/// Maximum length of a request.
const LONGEST: usize = 8 * 1024;

/// A request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request {
    /// Path with its query.
    pub target: String,
    /// First requested byte.
    pub from: u64,
}

impl Request {
    /// Path without its query.
    pub fn path(&self) -> &str {
        self.target.split('?').next().unwrap_or_default()
    }

    /// A value of the query.
    pub fn query(&self, key: &str) -> Option<&str> {
        let pairs = self.target.split_once('?')?.1.split('&');
        pairs.filter_map(|pair| pair.split_once('=')).find(|(found, _)| *found == key).map(|(_, value)| value)
    }
}

/// The data received so far.
#[derive(Debug, PartialEq, Eq)]
pub enum Inbox {
    /// An incomplete request.
    Partial,
    /// Not a request.
    Bad,
    /// A request.
    Whole(Request),
}

/// Parses the bytes of a connection.
pub fn read(bytes: &[u8]) -> Inbox {
    let Some(end) = bytes.windows(4).position(|four| four == b"\r\n\r\n") else {
        return if bytes.len() > LONGEST { Inbox::Bad } else { Inbox::Partial };
    };
    let text = String::from_utf8_lossy(&bytes[..end]);
    let mut lines = text.split("\r\n");
    let mut words = lines.next().unwrap_or_default().split(' ');
    let (Some("GET"), Some(target), Some("HTTP/1.0" | "HTTP/1.1"), None) =
        (words.next(), words.next(), words.next(), words.next())
    else {
        return Inbox::Bad;
    };
    let range = lines.filter_map(|line| line.split_once(':')).find(|(name, _)| name.eq_ignore_ascii_case("range"));
    let from = range.and_then(|(_, value)| value.trim().strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok());
    Inbox::Whole(Request { target: target.into(), from: from.unwrap_or_default() })
}

/// An answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reply {
    /// Status code.
    pub status: u16,
    /// Its body.
    pub body: Body,
}

/// The body of an answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Body {
    /// JSON text.
    Json(String),
    /// A clip, from a byte on.
    Clip {
        /// Its number.
        number: u32,
        /// First byte.
        from: u64,
        /// Bytes of the whole clip.
        size: u64,
    },
}

impl Reply {
    /// An answer in JSON.
    pub fn json(status: u16, value: &Value) -> Self {
        Self { status, body: Body::Json(value.to_string()) }
    }

    /// The header before the body.
    pub fn head(&self) -> String {
        let reason = match self.status {
            200 => "OK",
            206 => "Partial Content",
            400 => "Bad Request",
            404 => "Not Found",
            416 => "Range Not Satisfiable",
            _ => "Error",
        };
        let (kind, length, range) = match self.body {
            Body::Json(ref text) => ("application/json", text.len() as u64, String::new()),
            Body::Clip { from, size, .. } if self.status == 206 => {
                let last = size.saturating_sub(1);
                ("video/mp4", size - from, format!("Content-Range: bytes {from}-{last}/{size}\r\n"))
            }
            Body::Clip { from, size, .. } => ("video/mp4", size - from, String::new()),
        };
        format!(
            "HTTP/1.1 {} {reason}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n{range}Connection: close\r\n\r\n",
            self.status
        )
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn reads_a_request() {
        let text = b"GET /a/b?x=1&y=two HTTP/1.1\r\nHost: camera\r\nrange: bytes=100-\r\n\r\n";
        let Inbox::Whole(request) = read(text) else { panic!("not read") };
        assert_eq!((request.path(), request.query("y"), request.query("z")), ("/a/b", Some("two"), None));
        assert_eq!(request.from, 100);
        assert_eq!(read(&text[..text.len() - 1]), Inbox::Partial);
        for bad in ["POST / HTTP/1.1\r\n\r\n", "GET /\r\n\r\n", "GET / HTTP/1.1 more\r\n\r\n", "\r\n\r\n"] {
            assert_eq!(read(bad.as_bytes()), Inbox::Bad, "{bad:?}");
        }
        assert_eq!(read(&[b'a'; LONGEST + 1]), Inbox::Bad);
    }

    #[test]
    fn a_part_of_a_clip_is_named() {
        let head = Reply { status: 206, body: Body::Clip { number: 1, from: 10, size: 100 } }.head();
        assert!(
            head.contains("Content-Length: 90\r\n") && head.contains("Content-Range: bytes 10-99/100\r\n"),
            "{head}"
        );
    }

    proptest! {
        #[test]
        fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _read = read(&[&b"GET "[..], &bytes, b"\r\n\r\n"].concat());
        }
    }
}
