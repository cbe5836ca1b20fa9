//! A bell: wakes a thread or a task that waits for its descriptor to be readable.
//!
//! Invariant: ringing and silencing neither wait nor allocate.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::event::{EventfdFlags, eventfd};

/// See the module's comment. Where the system has no descriptor left it is mute: a thread that waits also looks by the
/// clock.
#[derive(Debug)]
pub struct Bell(Option<OwnedFd>);

impl Bell {
    /// Wakes who waits, now or the next time.
    pub fn ring(&self) {
        if let Some(descriptor) = &self.0 {
            // Fails only if it was rung 2^64 - 2 times and still rings.
            let _ = rustix::io::write(descriptor, &1_u64.to_ne_bytes());
        }
    }

    /// It rings no more until it is rung again. Call it before looking at what it was rung for.
    pub fn silence(&self) {
        if let Some(descriptor) = &self.0 {
            let _ = rustix::io::read(descriptor, &mut [0; 8]);
        }
    }

    /// Readable while it rings.
    #[must_use]
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.0.as_ref().map(AsFd::as_fd)
    }
}

impl Default for Bell {
    fn default() -> Self {
        Self(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK).ok())
    }
}
