//! Reads a camera through V4L2 and summarises the frames: proof that the emulator works, independent of `rapid`.

use std::fs::{File, OpenOptions};
use std::io;
use std::ops::ControlFlow;
use std::path::Path;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::ioctl::{Opcode, Setter, Updater, ioctl, opcode};
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use serde_json::{Value, json};
use thiserror::Error;

use super::uevent::Listener;
use crate::clock;
use crate::emu::frame;
use crate::emu::log::{Log, Moment};

const CAPTURE: u32 = 1;
const MMAP: u32 = 1;
const BUFFERS: u32 = 4;

/// `struct v4l2_format` for a capture node.
#[repr(C, align(8))]
#[derive(Clone, Copy, Debug)]
pub struct Format {
    kind: u32,
    _align: u32,
    width: u32,
    height: u32,
    pixel_format: u32,
    _rest: [u32; 47],
}

#[repr(C)]
struct RequestBuffers {
    count: u32,
    kind: u32,
    memory: u32,
    _rest: [u32; 2],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Buffer {
    index: u32,
    kind: u32,
    bytes_used: u32,
    flags: u32,
    field: u32,
    time: [i64; 2],
    timecode: [u32; 4],
    sequence: u32,
    memory: u32,
    offset: u64,
    length: u32,
    _rest: [u32; 2],
}

const GET_FORMAT: Opcode = opcode::read_write::<Format>(b'V', 4);
const REQUEST_BUFFERS: Opcode = opcode::read_write::<RequestBuffers>(b'V', 8);
const QUERY_BUFFER: Opcode = opcode::read_write::<Buffer>(b'V', 9);
const QUEUE: Opcode = opcode::read_write::<Buffer>(b'V', 15);
const DEQUEUE: Opcode = opcode::read_write::<Buffer>(b'V', 17);
const STREAM_ON: Opcode = opcode::write::<u32>(b'V', 18);

const _: () = assert!(size_of::<Format>() == 208 && size_of::<RequestBuffers>() == 20 && size_of::<Buffer>() == 88);

/// Why reading stopped before it was done.
#[derive(Debug, Error)]
pub enum ReadError {
    /// The node could not be opened.
    #[error("opening {0}: {1}")]
    Open(String, #[source] io::Error),
    /// A V4L2 call was refused.
    #[error("{0}: {1}")]
    Call(&'static str, #[source] Errno),
    /// No frame for fifteen seconds.
    #[error("no frame within 15 s, after {0} frames")]
    Silence(u32),
}

/// Captures `count` frames in the node's current format and reports how many were whole, in order, without a gap.
pub fn read(path: &Path, count: u32) -> Result<Value, ReadError> {
    let mut tally = Tally::default();
    let format = capture(path, |bytes| {
        tally.add(bytes);
        if tally.frames < count { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    })?;
    Ok(tally.describe(&format))
}

/// Opens each camera as soon as udev has made it ready, reads one frame, closes it and prints how long the steps took,
/// endlessly. The simplest possible program: it keeps the camera's format, and does nothing else meanwhile.
pub fn first_frames(log: &Log) -> Result<(), ReadError> {
    let receive_error = |error| ReadError::Call("recv from udev", error);
    let mut listener = Listener::open().map_err(receive_error)?;
    loop {
        let (event, reported) = listener.receive().map_err(receive_error)?;
        let Some(node) = event.camera_added() else { continue };
        match first_frame(Path::new(&node)) {
            Ok((streaming, came)) => {
                let fields = json!({"node": node, "reported_ns": reported.mono_ns, "streaming_ns": streaming.mono_ns});
                log.write("first_frame", came, fields);
            }
            Err(error) => log.write("missed", reported, json!({"node": node, "error": error.to_string()})),
        }
    }
}

/// When the camera streamed and when its first frame had arrived.
fn first_frame(node: &Path) -> Result<(Moment, Moment), ReadError> {
    let mut camera = Camera::open(node)?;
    let streaming = Moment::now();
    let mut came = streaming;
    let _one_is_enough = camera.next(0, |_| {
        came = Moment::now();
        ControlFlow::Break(())
    })?;
    Ok((streaming, came))
}

/// Passes each captured frame to `take` until it returns a break, in the node's current format.
pub fn capture(path: &Path, mut take: impl FnMut(&[u8]) -> ControlFlow<()>) -> Result<Format, ReadError> {
    let mut camera = Camera::open(path)?;
    for so_far in 0.. {
        if camera.next(so_far, &mut take)?.is_break() {
            break;
        }
    }
    Ok(camera.format)
}

#[derive(Default)]
struct Tally {
    frames: u32,
    damaged: u32,
    holes: u32,
    repeats: u32,
    bytes: usize,
    first: Option<u32>,
    last: Option<u32>,
    first_sent_ns: u64,
    last_sent_ns: u64,
    latency_ns: u64,
}

impl Tally {
    fn add(&mut self, bytes: &[u8]) {
        let now_ns = clock::mono_ns();
        self.frames += 1;
        self.bytes += bytes.len();
        let identity = frame::identity(bytes).filter(|_| bytes.starts_with(b"RVBF") || frame::is_whole_jpeg(bytes));
        let Some(id) = identity else {
            self.damaged += 1;
            return;
        };
        match self.last {
            Some(last) if id.number <= last => self.repeats += 1,
            Some(last) => self.holes += id.number - last - 1,
            None => {
                self.first = Some(id.number);
                self.first_sent_ns = id.sent_ns;
            }
        }
        self.last = Some(id.number);
        self.last_sent_ns = id.sent_ns;
        self.latency_ns += now_ns.saturating_sub(id.sent_ns);
    }

    fn describe(&self, format: &Format) -> Value {
        json!({
            "format": String::from_utf8_lossy(&format.pixel_format.to_le_bytes()),
            "width": format.width,
            "height": format.height,
            "frames": self.frames,
            "damaged": self.damaged,
            "holes": self.holes,
            "repeats": self.repeats,
            "first": self.first,
            "last": self.last,
            "mean_bytes": self.bytes as u64 / u64::from(self.frames.max(1)),
            "sent_in_ns": self.last_sent_ns - self.first_sent_ns,
            "mean_latency_ms": self.latency_ns as f64 / f64::from(self.frames.max(1)) / 1e6,
        })
    }
}

struct Camera {
    node: File,
    format: Format,
    buffers: Vec<(*mut std::ffi::c_void, usize)>,
}

impl Camera {
    fn open(path: &Path) -> Result<Self, ReadError> {
        let node = OpenOptions::new()
            .read(true)
            .write(true)
            .open(path)
            .map_err(|error| ReadError::Open(path.display().to_string(), error))?;
        let mut format = Format { kind: CAPTURE, _align: 0, width: 0, height: 0, pixel_format: 0, _rest: [0; 47] };
        update::<GET_FORMAT, _>(&node, &mut format).map_err(|e| ReadError::Call("VIDIOC_G_FMT", e))?;
        let mut request = RequestBuffers { count: BUFFERS, kind: CAPTURE, memory: MMAP, _rest: [0; 2] };
        update::<REQUEST_BUFFERS, _>(&node, &mut request).map_err(|e| ReadError::Call("VIDIOC_REQBUFS", e))?;
        let mut camera = Self { node, format, buffers: Vec::new() };
        for index in 0..request.count {
            camera.map(index)?;
        }
        // SAFETY: VIDIOC_STREAMON reads one int, the buffer type.
        unsafe { ioctl(&camera.node, Setter::<STREAM_ON, u32>::new(CAPTURE)) }
            .map_err(|e| ReadError::Call("VIDIOC_STREAMON", e))?;
        Ok(camera)
    }

    fn map(&mut self, index: u32) -> Result<(), ReadError> {
        let mut buffer = Buffer { index, kind: CAPTURE, memory: MMAP, ..Buffer::default() };
        update::<QUERY_BUFFER, _>(&self.node, &mut buffer).map_err(|e| ReadError::Call("VIDIOC_QUERYBUF", e))?;
        let length = buffer.length as usize;
        // SAFETY: a fresh read-only mapping of a driver buffer, at the offset and length the driver just gave.
        let place = unsafe {
            mmap(
                std::ptr::null_mut(),
                length,
                ProtFlags::READ,
                MapFlags::SHARED,
                &self.node,
                buffer.offset & 0xffff_ffff,
            )
        };
        self.buffers.push((place.map_err(|e| ReadError::Call("mmap", e))?, length));
        update::<QUEUE, _>(&self.node, &mut buffer).map_err(|e| ReadError::Call("VIDIOC_QBUF", e))
    }

    fn next(&mut self, so_far: u32, take: impl FnOnce(&[u8]) -> ControlFlow<()>) -> Result<ControlFlow<()>, ReadError> {
        let limit = Timespec { tv_sec: 15, tv_nsec: 0 };
        let ready = poll(&mut [PollFd::new(&self.node, PollFlags::IN)], Some(&limit));
        if ready.map_err(|e| ReadError::Call("poll", e))? == 0 {
            return Err(ReadError::Silence(so_far));
        }
        let mut buffer = Buffer { kind: CAPTURE, memory: MMAP, ..Buffer::default() };
        update::<DEQUEUE, _>(&self.node, &mut buffer).map_err(|e| ReadError::Call("VIDIOC_DQBUF", e))?;
        let (place, length) = self.buffers[buffer.index as usize];
        // SAFETY: the mapping has `length` bytes and lives as long as `self`; the driver does not write a dequeued one.
        let went = take(unsafe { std::slice::from_raw_parts(place.cast(), length.min(buffer.bytes_used as usize)) });
        update::<QUEUE, _>(&self.node, &mut buffer).map_err(|e| ReadError::Call("VIDIOC_QBUF", e))?;
        Ok(went)
    }
}

impl Drop for Camera {
    fn drop(&mut self) {
        for (place, length) in &self.buffers {
            // SAFETY: mapped in `map` with this length, and no slice of it outlives `next`.
            let _unmapped = unsafe { munmap(*place, *length) };
        }
    }
}

fn update<const OPCODE: Opcode, T>(node: &File, value: &mut T) -> Result<(), Errno> {
    // SAFETY: every opcode above is created from the `repr(C)` struct used with it, whose sizes are asserted.
    unsafe { ioctl(node, Updater::<OPCODE, T>::new(value)) }
}
