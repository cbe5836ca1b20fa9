//! The kernel's buffers, mapped into our memory: queue, dequeue, give back.
//!
//! The v4l crate's streams are not used: dropping one panics when the device answers with anything
//! but ENODEV, and its `next` queues a buffer twice after an interruption.
//!
//! Invariant: at most one buffer is lent; while it is, the kernel does not write into it.

use std::ffi::c_void;
use std::io;
use std::os::fd::{AsRawFd, RawFd};
use std::ptr::NonNull;

use v4l::v4l_sys::{
    V4L2_BUF_FLAG_ERROR, V4L2_BUF_FLAG_TIMESTAMP_MASK, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, v4l2_buffer,
    v4l2_memory_V4L2_MEMORY_MMAP, v4l2_requestbuffers,
};
use v4l::v4l2::{self, vidioc};

use super::layout::Frame;
use super::node::{CAPTURE, Node, Plain as _};
use crate::time::Stamp;

/// One lent, one being filled, two waiting: what a reader may be late by at 30 frames a second is
/// 100 ms.
const BUFFERS: u32 = 4;
const MEMORY: u32 = v4l2_memory_V4L2_MEMORY_MMAP;

/// A streaming node and its buffers.
#[derive(Debug)]
pub(super) struct Ring {
    // Before the node: a mapping is undone before the descriptor closes.
    buffers: Vec<Mapping>,
    node: Node,
    lent: Option<Lent>,
}

#[derive(Debug, Clone, Copy)]
struct Lent {
    index: u32,
    bytes_used: usize,
}

impl Ring {
    /// Asks for buffers, maps them, queues them and starts the stream.
    pub(super) fn start(node: Node) -> io::Result<Self> {
        let mut request =
            v4l2_requestbuffers { count: BUFFERS, type_: CAPTURE, memory: MEMORY, ..v4l2_requestbuffers::zeroed() };
        node.ioctl(vidioc::VIDIOC_REQBUFS, &mut request)?;
        // With one buffer the camera would stop while it is lent.
        if request.count < 2 {
            return Err(io::Error::from(io::ErrorKind::OutOfMemory));
        }
        let mut ring = Self { buffers: Vec::new(), node, lent: None };
        for index in 0..request.count {
            let mut buffer = buffer(index);
            ring.node.ioctl(vidioc::VIDIOC_QUERYBUF, &mut buffer)?;
            ring.buffers.push(Mapping::new(&ring.node, &buffer)?);
            ring.queue(index)?;
        }
        // STREAMON takes the buffer type as an int.
        ring.node.ioctl(vidioc::VIDIOC_STREAMON, &mut CAPTURE.cast_signed())?;
        Ok(ring)
    }

    /// Returns the lent buffer to the kernel.
    pub(super) fn give_back(&mut self) -> io::Result<()> {
        match self.lent.take() {
            Some(lent) => self.queue(lent.index),
            None => Ok(()),
        }
    }

    /// Takes the oldest filled buffer; `WouldBlock` if there is none.
    pub(super) fn dequeue(&mut self) -> io::Result<Frame> {
        self.give_back()?;
        let mut filled = buffer(0);
        self.node.ioctl(vidioc::VIDIOC_DQBUF, &mut filled)?;
        self.lent = Some(Lent { index: filled.index, bytes_used: filled.bytesused as usize });
        let is_monotonic = filled.flags & V4L2_BUF_FLAG_TIMESTAMP_MASK == V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
        let stamp = || {
            let seconds = u64::try_from(filled.timestamp.tv_sec).ok()?;
            let micros = u64::try_from(filled.timestamp.tv_usec).ok()?;
            Some(Stamp(seconds.checked_mul(1_000_000_000)?.checked_add(micros.checked_mul(1_000)?)?))
        };
        Ok(Frame {
            sequence: filled.sequence,
            bytes_used: filled.bytesused as usize,
            is_damaged: filled.flags & V4L2_BUF_FLAG_ERROR != 0,
            stamp: if is_monotonic { stamp() } else { None },
        })
    }

    /// The bytes of the lent buffer, as many as the kernel wrote.
    pub(super) fn lent(&self) -> &[u8] {
        let Some(lent) = self.lent else { return &[] };
        self.buffers.get(lent.index as usize).map_or(&[], |mapping| mapping.bytes(lent.bytes_used))
    }

    pub(super) fn is_gone(&self) -> bool {
        self.node.is_gone()
    }

    fn queue(&self, index: u32) -> io::Result<()> {
        self.node.ioctl(vidioc::VIDIOC_QBUF, &mut buffer(index))
    }
}

impl AsRawFd for Ring {
    fn as_raw_fd(&self) -> RawFd {
        self.node.as_raw_fd()
    }
}

impl Drop for Ring {
    fn drop(&mut self) {
        // Refused by a node whose device is gone; nothing is left to stop then.
        let _ = self.node.ioctl(vidioc::VIDIOC_STREAMOFF, &mut CAPTURE.cast_signed());
    }
}

fn buffer(index: u32) -> v4l2_buffer {
    v4l2_buffer { index, type_: CAPTURE, memory: MEMORY, ..v4l2_buffer::zeroed() }
}

/// A kernel buffer in our address space.
#[derive(Debug)]
struct Mapping {
    start: NonNull<c_void>,
    length: usize,
}

// SAFETY: the mapping is plain memory, owned by this value alone and not tied to a thread.
unsafe impl Send for Mapping {}
// SAFETY: a shared reference only reads the memory; the kernel writes into a buffer only while it is
// queued, and `Ring` hands out bytes only of the one that is not.
unsafe impl Sync for Mapping {}

impl Mapping {
    fn new(node: &Node, buffer: &v4l2_buffer) -> io::Result<Self> {
        let length = buffer.length as usize;
        // SAFETY: for MMAP buffers QUERYBUF fills `offset`, and any bits are a valid integer.
        let offset = unsafe { buffer.m.offset };
        // SAFETY: a new mapping at an address of the kernel's choice touches no memory of ours;
        // the kernel checks length and offset against its buffer.
        let start = unsafe {
            v4l2::mmap(
                std::ptr::null_mut(),
                length,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_SHARED,
                node.as_raw_fd(),
                libc::off_t::from(offset),
            )?
        };
        let start = NonNull::new(start).ok_or_else(|| io::Error::from(io::ErrorKind::OutOfMemory))?;
        Ok(Self { start, length })
    }

    fn bytes(&self, used: usize) -> &[u8] {
        // SAFETY: `start` is a live mapping of `length` bytes until this value is dropped, the
        // slice is no longer, and the kernel does not write into a buffer that is not queued.
        unsafe { std::slice::from_raw_parts(self.start.cast::<u8>().as_ptr(), used.min(self.length)) }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: the mapping is ours, its slices borrow from this value and so are gone.
        let _ = unsafe { v4l2::munmap(self.start.as_ptr(), self.length) };
    }
}
