//! Cameras that send pictures over HTTP, one after another (`multipart/x-mixed-replace`).
//!
//! A picture's time is the moment its body began to arrive: the closest known to its capture.
//!
//! What servers get wrong is tolerated where it is clear what they mean: a boundary that is not announced is found in the
//! body, and a redirect within the camera is followed once. What they answer otherwise is asked for again later: a camera
//! that is starting answers with errors too. A picture of another size or kind is one damaged sample; only if nothing
//! else comes is it the reason to end ([`Mismatch`]).

use std::fmt;
use std::time::Duration;

use hyper::StatusCode;
use hyper::Uri;
use hyper::body::{Buf, Bytes};
use hyper::header::{CONTENT_TYPE, LOCATION};
use rapid_core::sample::{Encoding, FLAG_ERROR};
use rapid_core::time::Stamp;
use rapid_registry::LanPicture;
use tokio::time::{Instant, timeout_at};

use super::address::Server;
use super::http::{self, Reply};
use super::multipart::{Cut, Multipart, Sniffed, boundary, sniff};
use super::{PATIENCE, jpeg};
use crate::driver::{DriverError, Reading};

const HEAD_LIMIT: Duration = Duration::from_secs(5);
/// A device that sends only pictures that do not fit its entry for this long does not fit it.
const LASTING: Duration = Duration::from_secs(5);
/// Characters of a server's header that are shown.
const SHOWN: usize = 200;

#[derive(Debug)]
pub(super) struct Camera {
    name: String,
    server: Server,
    reply: Reply,
    parser: Multipart,
    /// Bytes not yet parsed, and when they arrived.
    chunk: Bytes,
    arrived: Stamp,
    /// When the picture in progress began to arrive.
    begun: Stamp,
    /// When the newest picture was complete.
    newest: Instant,
    picture: LanPicture,
    mismatch: Mismatch,
    lost: u64,
}

impl Camera {
    pub(super) async fn open(
        name: &str,
        server: Server,
        path: &str,
        picture: LanPicture,
        max_bytes: usize,
    ) -> Result<Self, DriverError> {
        let page = Page { name, path };
        let (reply, page_path) = page.request(&server).await?;
        let page = Page { name, path: &page_path };
        let (reply, parser, chunk) = page.accept(reply, max_bytes).await?;
        Ok(Self {
            name: name.to_owned(),
            server,
            reply,
            parser,
            chunk,
            arrived: Stamp::now(),
            begun: Stamp::now(),
            newest: Instant::now(),
            picture,
            mismatch: Mismatch::default(),
            lost: 0,
        })
    }

    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        while !self.parse()? {
            let patience = self.newest + PATIENCE;
            // If the future is dropped, the bytes stay with the connection.
            let Ok(chunk) = timeout_at(patience, self.reply.next()).await else {
                return Err(self.server.place.lost(format_args!("no picture for {} s", PATIENCE.as_secs())));
            };
            let Some(chunk) = chunk? else { return Err(self.server.place.lost("the camera ended the stream")) };
            (self.chunk, self.arrived) = (chunk, Stamp::now());
        }
        self.newest = Instant::now();
        let bytes = self.parser.part();
        let flags = self.mismatch.flags(bytes, &self.name, self.picture, self.newest)?;
        Ok(Reading {
            bytes,
            encoding: Encoding::Mjpeg,
            captured: self.begun,
            flags,
            width: self.picture.width,
            height: self.picture.height,
            lost: std::mem::take(&mut self.lost),
        })
    }

    /// Parses received bytes, up to the end of a picture.
    fn parse(&mut self) -> Result<bool, DriverError> {
        while !self.chunk.is_empty() {
            let (taken, cut) = self.parser.feed(&self.chunk);
            self.chunk.advance(taken);
            match cut {
                Cut::Open => {}
                Cut::Head => self.begun = self.arrived,
                Cut::Part if self.parser.part().is_empty() => {}
                Cut::Part => return Ok(true),
                Cut::Malformed => self.lost += 1,
                Cut::End => return Err(self.server.place.lost("the camera ended the stream")),
            }
        }
        Ok(false)
    }
}

/// Whether pictures are what their entry says. One that is not is damaged; if only such pictures come for [`LASTING`],
/// the entry or the device is to be changed.
#[derive(Debug, Default)]
pub(super) struct Mismatch {
    /// Since when only such pictures have come.
    since: Option<Instant>,
    /// There was one that fits.
    has_fitted: bool,
}

impl Mismatch {
    /// The flags of a picture that was complete `now`.
    ///
    /// # Errors
    /// When only pictures that do not fit have come for too long. If some did fit, the device has changed while it was
    /// read and is opened again, otherwise it has failed.
    pub(super) fn flags(
        &mut self,
        bytes: &[u8],
        name: &str,
        requested: LanPicture,
        now: Instant,
    ) -> Result<u32, DriverError> {
        let is_jpeg = bytes.starts_with(&jpeg::START);
        let size = jpeg::size(bytes);
        if is_jpeg && size.is_none_or(|size| size == (requested.width, requested.height)) {
            (self.since, self.has_fitted) = (None, true);
            return Ok(0);
        }
        if now.duration_since(*self.since.get_or_insert(now)) < LASTING {
            return Ok(FLAG_ERROR);
        }
        let text = match size {
            Some((width, height)) => format!(
                "its pictures are {width}x{height}: write width = {width} and height = {height} in [device.{name}.lan], \
                 or set the device to {}x{}",
                requested.width, requested.height
            ),
            None => "what it sends is not JPEG: set it to JPEG".to_owned(),
        };
        Err(if self.has_fitted { DriverError::Retry(text) } else { DriverError::Fatal(text) })
    }
}

/// What an entry asks its camera for.
#[derive(Debug, Clone, Copy)]
struct Page<'a> {
    name: &'a str,
    path: &'a str,
}

impl Page<'_> {
    /// The camera's answer, and the path that it is the answer to: a redirect within the camera is followed once.
    async fn request(&self, server: &Server) -> Result<(Reply, String), DriverError> {
        let reply = http::get(server, self.path, 0, HEAD_LIMIT).await?;
        let Some(to) = redirect(&reply) else { return Ok((reply, self.path.to_owned())) };
        let to = Target::new(&to, server, self.path).ok_or_else(|| self.redirected(&to, "which is no address"))?;
        let Target::Here(path) = to else { return Err(self.redirected(&to, "which is elsewhere")) };
        let reply = http::get(server, &path, 0, HEAD_LIMIT).await?;
        match redirect(&reply) {
            None => Ok((reply, path)),
            Some(further) => Err(self.redirected(&path, format_args!("and from there to {}", shown(&further)))),
        }
    }

    fn redirected(&self, to: &(impl fmt::Display + ?Sized), why: impl fmt::Display) -> DriverError {
        let Self { name, path } = self;
        let to = to.to_string();
        let to = shown(&to);
        DriverError::Retry(format!(
            "the camera redirects {path} to {to:?}, {why}: write where its pictures are as host, port and path in \
             [device.{name}.lan]"
        ))
    }

    /// The parser of an answer that is a stream of pictures, and its first bytes if they were needed to find that out.
    async fn accept(&self, mut reply: Reply, max_bytes: usize) -> Result<(Reply, Multipart, Bytes), DriverError> {
        let Self { name, path } = self;
        let refused = |text: String| Err(DriverError::Retry(text));
        match reply.status {
            status if status.is_success() => {}
            StatusCode::NOT_FOUND => {
                return refused(format!("the camera has nothing at {path}: correct path in [device.{name}.lan]"));
            }
            status @ (StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN) => {
                return refused(format!("the camera refuses {path} ({status}): let it be seen without a password"));
            }
            status => return refused(format!("the camera answers {status} to {path}")),
        }
        let content = shown(reply.header(CONTENT_TYPE).unwrap_or_default()).to_owned();
        if let Some(parser) = boundary(&content).and_then(|boundary| Multipart::new(boundary, max_bytes)) {
            return Ok((reply, parser, Bytes::new()));
        }
        let kind = content.split(['/', ';']).next().unwrap_or_default().to_ascii_lowercase();
        if matches!(kind.as_str(), "image" | "text" | "video" | "audio") {
            let is = if kind == "image" { "one picture" } else { "no stream of pictures" };
            return refused(format!(
                "{path} is {content}, {is}: write the path of a stream (multipart/x-mixed-replace) in \
                 [device.{name}.lan]"
            ));
        }
        let (found, begun) = find_boundary(&mut reply).await?;
        if let Some(parser) = found.and_then(|boundary| Multipart::new(&boundary, max_bytes)) {
            return Ok((reply, parser, begun));
        }
        let content = if content.is_empty() { "without a Content-Type" } else { content.as_str() };
        refused(format!(
            "{path} ({content}) does not begin with a boundary (--name): it is no stream of pictures; correct path in \
             [device.{name}.lan]"
        ))
    }
}

/// The boundary with which the body begins, and the bytes read so far.
async fn find_boundary(reply: &mut Reply) -> Result<(Option<String>, Bytes), DriverError> {
    let ends = Instant::now() + HEAD_LIMIT;
    let mut begun = Vec::new();
    loop {
        match sniff(&begun) {
            Sniffed::Boundary(boundary) => return Ok((Some(boundary), begun.into())),
            Sniffed::Nothing => return Ok((None, begun.into())),
            Sniffed::Open => {}
        }
        match timeout_at(ends, reply.next()).await {
            Ok(Ok(Some(bytes))) => begun.extend_from_slice(&bytes),
            Ok(Err(error)) => return Err(error),
            Ok(Ok(None)) | Err(_) => return Ok((None, begun.into())),
        }
    }
}

/// Where an answer redirects to.
fn redirect(reply: &Reply) -> Option<String> {
    reply.status.is_redirection().then(|| reply.header(LOCATION).unwrap_or_default().to_owned())
}

/// The target of a redirect.
#[derive(Debug, PartialEq, Eq)]
enum Target {
    /// A path of the same server.
    Here(String),
    /// Another server.
    Elsewhere(String),
}

impl Target {
    /// The target of `location`, as an answer of `server` to `path` (RFC 9110, 10.2.2); `None` if it is none.
    fn new(location: &str, server: &Server, path: &str) -> Option<Self> {
        let location = location.split('#').next().unwrap_or_default();
        let absolute = if location.starts_with("//") { format!("http:{location}") } else { location.to_owned() };
        if !absolute.contains("://") {
            let folder = path.rsplit_once('/').map_or("", |(folder, _)| folder);
            let path = match absolute.as_bytes() {
                [] => return None,
                [b'/', ..] => absolute,
                [b'?', ..] => format!("{}{absolute}", path.split('?').next().unwrap_or_default()),
                _ => format!("{folder}/{absolute}"),
            };
            return path.parse::<Uri>().is_ok().then_some(Self::Here(path));
        }
        let uri: Uri = absolute.parse().ok()?;
        let host = uri.host()?.trim_start_matches('[').trim_end_matches(']');
        let is_here = host.parse().is_ok_and(|host: std::net::IpAddr| server.place.means(host));
        let is_here = is_here && uri.scheme_str() == Some("http");
        if is_here && uri.port_u16().unwrap_or(80) == server.address.port() {
            return Some(Self::Here(uri.path_and_query().map_or("/", |path| path.as_str()).to_owned()));
        }
        Some(Self::Elsewhere(absolute))
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self::Here(to) | Self::Elsewhere(to)) = self;
        f.write_str(to)
    }
}

/// What is shown of a header: a boundary has 70 characters, a header any number.
fn shown(header: &str) -> &str {
    let end = header.char_indices().nth(SHOWN).map_or(header.len(), |(at, _)| at);
    header.get(..end).unwrap_or_default()
}

#[cfg(test)]
mod tests;
