//! The preview of a GoPro as pictures: a transport stream with H.264 that the camera sends to a UDP port, decoded by the
//! user's `ffmpeg`.
//!
//! `/gopro/camera/stream/start?port=N` begins it (Open GoPro, HTTP, "Preview Stream"). The packets go to the standard input
//! of `ffmpeg`, whose output is JPEGs in `multipart` form (its muxer `mpjpeg`). Some models end the stream when their shutter
//! starts: without packets for [`SILENT`] it is requested again.
//!
//! A picture's time is the moment its first bytes came from `ffmpeg`; `latency` of the entry is what lies before that.
//!
//! Invariant: without `ffmpeg`, or when it ends, the camera's clips are recorded all the same: only pictures are missing.
//! Invariant: `ffmpeg` ends with this value, or with the program: its input is closed then.

use std::io;
use std::net::SocketAddr;
use std::ops::Range;
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use rapid_registry::{LanPicture, PREVIEW_DECODER as DECODER, own_side};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::UdpSocket;
use tokio::net::unix::pipe;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};
use tokio_util::task::AbortOnDropHandle;

use super::super::address::Server;
use super::super::jpeg;
use super::super::multipart::{Cut, Multipart};
use super::ask;
use crate::driver::{DriverError, Reading};

/// Without a packet for this long the stream is requested again.
const SILENT: Duration = Duration::from_secs(3);
/// A stream that pauses for this long has ended: pictures that the decoder still holds are old by then.
const GAP: Duration = Duration::from_millis(500);
/// Requests without a packet before that is reported.
const TRIES: u32 = 2;
/// Before the decoder is started again.
const PAUSE: Duration = Duration::from_secs(1);
/// A datagram of the stream has seven packets of 188 bytes.
const LARGEST_DATAGRAM: usize = 64 << 10;
/// What is read of the decoder's output at a time.
const PIECE: usize = 64 << 10;
/// Of `mpjpeg`.
const BOUNDARY: &str = "ffmpeg";
const STOP: &str = "/gopro/camera/stream/stop";

#[derive(Debug)]
pub(super) struct Preview {
    /// The output of each decoder that was started.
    outputs: mpsc::Receiver<pipe::Receiver>,
    output: Option<pipe::Receiver>,
    parser: Multipart,
    largest: usize,
    /// What was read, and which part of it is not parsed yet.
    piece: Vec<u8>,
    unparsed: Range<usize>,
    arrived: Stamp,
    /// When the picture in progress began to arrive.
    begun: Stamp,
    picture: LanPicture,
    lost: u64,
    server: Server,
    task: AbortOnDropHandle<()>,
}

impl Preview {
    /// Requests the stream, and decodes it to pictures of this size of at most `largest` bytes.
    pub(super) async fn begin(
        name: &str,
        server: &Server,
        picture: LanPicture,
        largest: usize,
    ) -> Result<Self, DriverError> {
        let address = SocketAddr::new(own_side(Some(server.address.ip())), 0);
        let packets = UdpSocket::bind(address).await;
        let packets = packets.map_err(|error| DriverError::Retry(format!("no port for the preview: {error}")))?;
        let port = packets.local_addr().map_or(0, |address| address.port());
        let (to, outputs) = mpsc::channel(1);
        let stream = Stream { name: name.to_owned(), server: server.clone(), packets, port, picture };
        Ok(Self {
            outputs,
            output: None,
            parser: parser(largest)?,
            largest,
            piece: vec![0; PIECE],
            unparsed: 0..0,
            arrived: Stamp::now(),
            begun: Stamp::now(),
            picture,
            lost: 0,
            server: server.clone(),
            task: AbortOnDropHandle::new(tokio::spawn(stream.supervise(to))),
        })
    }

    /// The next picture. If the future is dropped, nothing is lost.
    ///
    /// # Errors
    /// None that a camera can cause.
    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        while !self.parse() {
            let Some(output) = &mut self.output else {
                self.output = self.outputs.recv().await;
                if self.output.is_none() {
                    // Its task has panicked: there will be no picture.
                    std::future::pending::<()>().await;
                }
                continue;
            };
            if let Ok(count @ 1..) = output.read(&mut self.piece).await {
                (self.unparsed, self.arrived) = (0..count, Stamp::now());
            } else {
                // The decoder has ended, in the middle of a picture perhaps.
                self.output = None;
                self.parser = parser(self.largest)?;
            }
        }
        let LanPicture { width, height, .. } = self.picture;
        let (bytes, captured) = (self.parser.part(), self.begun);
        Ok(Reading {
            bytes,
            encoding: Encoding::Mjpeg,
            captured,
            flags: 0,
            width,
            height,
            lost: std::mem::take(&mut self.lost),
        })
    }

    /// Ends the camera's stream, which would stay directed to a port that is not read any more.
    pub(super) async fn close(self) {
        let Self { server, task, .. } = self;
        drop(task);
        // It ends with the next start too.
        let _ = ask(&server, STOP).await;
    }

    /// Parses what was read, up to the end of a picture.
    fn parse(&mut self) -> bool {
        while let Some(rest) = self.piece.get(self.unparsed.clone()).filter(|rest| !rest.is_empty()) {
            let (taken, cut) = self.parser.feed(rest);
            self.unparsed.start += taken;
            match cut {
                Cut::Head => self.begun = self.arrived,
                Cut::Part if self.parser.part().starts_with(&jpeg::START) => return true,
                Cut::Part | Cut::Malformed => self.lost += 1,
                Cut::Open | Cut::End => {}
            }
        }
        false
    }
}

fn parser(largest: usize) -> Result<Multipart, DriverError> {
    Multipart::new(BOUNDARY, largest).ok_or_else(|| DriverError::Fatal(format!("{BOUNDARY} is not a boundary")))
}

struct Stream {
    name: String,
    server: Server,
    packets: UdpSocket,
    port: u16,
    picture: LanPicture,
}

impl Stream {
    /// Starts the decoder again whenever it ends. Reports each reason once in a row.
    async fn supervise(self, outputs: mpsc::Sender<pipe::Receiver>) {
        let mut reported = String::new();
        while !outputs.is_closed() {
            let reason = match self.start() {
                Ok(decoder) => self.run(decoder, &outputs).await,
                Err(error) if error.kind() == io::ErrorKind::NotFound => format!(
                    "the preview is not decoded: there is no program {DECODER}; install it (sudo apt install {DECODER}). \
                     Clips are recorded without it"
                ),
                Err(error) => format!("the preview is not decoded: {DECODER} does not start: {error}"),
            };
            if reason != reported {
                tracing::warn!(device = self.name, "{reason}");
                reported = reason;
            }
            sleep(PAUSE).await;
        }
    }

    fn start(&self) -> io::Result<Decoder> {
        let LanPicture { width, height, fps } = self.picture;
        // Even times between pictures: none is doubled or left out for the sake of a rate.
        let filter = format!("scale={width}:{height},setpts=N/({fps}*TB)");
        let rate = fps.to_string();
        let input = ["-fflags", "nobuffer+discardcorrupt", "-flags", "low_delay", "-probesize", "100000"];
        let mut child = Command::new(DECODER)
            .args(["-hide_banner", "-loglevel", "error"])
            .args(input)
            .args(["-f", "mpegts", "-i", "pipe:0", "-an", "-vf", &filter, "-r", &rate])
            .args(["-c:v", "mjpeg", "-q:v", "4", "-f", "mpjpeg", "-flush_packets", "1", "pipe:1"])
            // Ctrl-C in the terminal ends the run, which ends it.
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let taken = (child.stdin.take(), child.stdout.take(), child.stderr.take());
        let decoder = Running(child);
        let (Some(input), Some(output), Some(errors)) = taken else {
            return Err(io::Error::other("it has no pipes"));
        };
        Ok(Decoder {
            input: pipe::Sender::from_owned_fd(input.into())?,
            output: pipe::Receiver::from_owned_fd(output.into())?,
            errors: pipe::Receiver::from_owned_fd(errors.into())?,
            _child: decoder,
        })
    }

    /// Runs the decoder until it ends; returns why.
    async fn run(&self, decoder: Decoder, outputs: &mpsc::Sender<pipe::Receiver>) -> String {
        let Decoder { mut input, output, mut errors, _child } = decoder;
        // Without a receiver the driver is being closed.
        let _ = outputs.send(output).await;
        tokio::select! {
            why = last_line(&mut errors) => format!("{DECODER} ended: {why}"),
            error = self.pass(&mut input) => format!("the preview ends: {error}"),
        }
    }

    /// Passes the camera's packets on, and requests them when none come.
    async fn pass(&self, input: &mut pipe::Sender) -> String {
        let mut datagram = vec![0; LARGEST_DATAGRAM];
        // What came while no decoder ran is old.
        while self.packets.try_recv_from(&mut datagram).is_ok() {}
        let path = format!("/gopro/camera/stream/start?port={}", self.port);
        let (mut has_packets, mut tries) = (false, 0);
        loop {
            // A stream that another run did not stop goes to its port, and start is refused.
            let _ = ask(&self.server, STOP).await;
            let started = ask(&self.server, &path).await;
            tries += 1;
            if tries == TRIES {
                let why = started.err().map(|error| format!(": {error}")).unwrap_or_default();
                tracing::warn!(device = self.name, "the camera sends no preview{why}; it is requested again");
            }
            while let Ok(received) =
                timeout(if has_packets { GAP } else { SILENT }, self.packets.recv_from(&mut datagram)).await
            {
                let (count, from) = match received {
                    Ok(received) => received,
                    Err(error) => return error.to_string(),
                };
                if !self.server.place.means(from.ip()) {
                    continue;
                }
                has_packets = true;
                if let Err(error) = input.write_all(datagram.get(..count).unwrap_or_default()).await {
                    return format!("{DECODER} takes no more of it: {error}");
                }
            }
            if has_packets {
                return "the camera sends no more of it".to_owned();
            }
        }
    }
}

/// The last line that a program writes before it ends.
async fn last_line(errors: &mut pipe::Receiver) -> String {
    let mut text = Vec::new();
    let mut piece = [0; 1024];
    while let Ok(count @ 1..) = errors.read(&mut piece).await {
        text.extend_from_slice(piece.get(..count).unwrap_or_default());
        text.drain(..text.len().saturating_sub(piece.len()));
    }
    let text = String::from_utf8_lossy(&text);
    text.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("without a message").to_owned()
}

/// The program and its pipes.
struct Decoder {
    input: pipe::Sender,
    output: pipe::Receiver,
    errors: pipe::Receiver,
    _child: Running,
}

/// Ends when it is dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // Its failure means that it has ended.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
