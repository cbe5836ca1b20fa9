//! Signals that end a run.

use tokio::signal::unix::{Signal, SignalKind, signal};

/// SIGINT, SIGTERM, SIGQUIT, and SIGHUP for a terminal that was closed: all of them end the run.
///
/// Two that would end the process immediately are handled: SIGPIPE by Rust's runtime, and SIGXFSZ here, so that a write
/// beyond the limit for files (`ulimit -f`) is an error like any other.
pub(crate) struct Signals {
    ends: [Signal; 4],
    _too_large: Signal,
    received: u32,
}

impl Signals {
    pub(crate) fn listen() -> std::io::Result<Self> {
        Ok(Self {
            ends: [
                signal(SignalKind::interrupt())?,
                signal(SignalKind::terminate())?,
                signal(SignalKind::quit())?,
                signal(SignalKind::hangup())?,
            ],
            _too_large: signal(SignalKind::from_raw(libc::SIGXFSZ))?,
            received: 0,
        })
    }

    pub(crate) async fn next(&mut self) {
        let [interrupt, terminate, quit, hangup] = &mut self.ends;
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
            _ = quit.recv() => {}
            _ = hangup.recv() => {}
        }
        self.received += 1;
    }

    /// Waits for the second of the run: the first only requests the end, which may be in progress anyway.
    pub(super) async fn second(&mut self) {
        while self.received < 2 {
            self.next().await;
        }
    }
}
