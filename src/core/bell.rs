//! A bell: wakes a thread or a task that waits for its descriptor to be readable.
//!
//! Invariant: ringing and silencing neither wait nor allocate.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::event::{EventfdFlags, eventfd};

/// See the module's comment. If the system has no descriptor left it never rings: a thread that waits for it must also
/// poll.
#[derive(Debug)]
pub struct Bell(Option<OwnedFd>);

impl Bell {
    /// Wakes the waiter, now or the next time it waits.
    pub fn ring(&self) {
        if let Some(descriptor) = &self.0 {
            // Fails only after 2^64 - 2 rings without a silence, when it still rings.
            let _ = rustix::io::write(descriptor, &1_u64.to_ne_bytes());
        }
    }

    /// It stops ringing until it is rung again. Call it before checking what it was rung for.
    pub fn silence(&self) {
        if let Some(descriptor) = &self.0 {
            let _ = rustix::io::read(descriptor, &mut [0; 8]);
        }
    }

    /// Readable while it rings.
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.0.as_ref().map(AsFd::as_fd)
    }
}

impl Default for Bell {
    fn default() -> Self {
        Self(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK).ok())
    }
}
