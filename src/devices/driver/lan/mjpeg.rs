//! Cameras that send pictures over HTTP, one after another (`multipart/x-mixed-replace`).
//!
//! A picture's time is the moment its body began to arrive: the closest known to its capture.

use std::time::Duration;

use hyper::StatusCode;
use hyper::body::{Buf, Bytes};
use hyper::header::CONTENT_TYPE;
use rapid_core::sample::{Encoding, FLAG_ERROR};
use rapid_core::time::Stamp;
use rapid_registry::LanPicture;
use tokio::time::{Instant, timeout_at};

use super::address::Server;
use super::http::{self, Reply};
use super::multipart::{Cut, Multipart, boundary};
use super::{PATIENCE, jpeg};
use crate::driver::{DriverError, Reading};

const HEAD_LIMIT: Duration = Duration::from_secs(5);

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
        let reply = http::get(&server, path, 0, HEAD_LIMIT).await?;
        let parser = accept(name, path, &reply, max_bytes)?;
        Ok(Self {
            name: name.to_owned(),
            server,
            reply,
            parser,
            chunk: Bytes::new(),
            arrived: Stamp::now(),
            begun: Stamp::now(),
            newest: Instant::now(),
            picture,
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
        let flags = if bytes.starts_with(&jpeg::START) { 0 } else { FLAG_ERROR };
        if let Some(size) = jpeg::size(bytes) {
            check_size(&self.name, size, self.picture)?;
        }
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

/// Checks that the picture has the size given in the entry.
pub(super) fn check_size(name: &str, (width, height): (u32, u32), requested: LanPicture) -> Result<(), DriverError> {
    if (width, height) == (requested.width, requested.height) {
        return Ok(());
    }
    Err(DriverError::Fatal(format!(
        "its pictures are {width}x{height}: write width = {width} and height = {height} in [device.{name}.lan], or set \
         the camera to {}x{}",
        requested.width, requested.height
    )))
}

/// The parser of an answer that is a stream of pictures.
fn accept(name: &str, path: &str, reply: &Reply, max_bytes: usize) -> Result<Multipart, DriverError> {
    let content = reply.header(CONTENT_TYPE).unwrap_or_default();
    // A boundary has 70 characters; a longer one is truncated for display.
    let content = content.get(..200).unwrap_or(content);
    let fatal = |text: String| Err(DriverError::Fatal(text));
    match reply.status {
        status if status.is_success() => {}
        StatusCode::NOT_FOUND => {
            return fatal(format!("the camera has nothing at {path}: correct path in [device.{name}.lan]"));
        }
        StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => {
            return fatal(format!("the camera refuses {path} ({}): let it be seen without a password", reply.status));
        }
        status => return Err(DriverError::Retry(format!("the camera answers {status} to {path}"))),
    }
    match boundary(content).and_then(|boundary| Multipart::new(boundary, max_bytes)) {
        Some(parser) => Ok(parser),
        None => fatal(format!(
            "{path} is {content:?} and no stream of pictures (multipart/x-mixed-replace): correct path in \
             [device.{name}.lan]"
        )),
    }
}
