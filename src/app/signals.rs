//! Signals that end a run, and one that must not.

use tokio::signal::unix::{Signal, SignalKind, signal};

/// SIGINT, SIGTERM, SIGQUIT, and SIGHUP for a terminal that was closed: all of them end the run.
///
pub(crate) struct Signals {
    ends: [Signal; 4],
    received: u32,
}

/// Makes a write beyond the limit for files (`ulimit -f`) an error like any other, in this process and until it ends: SIGXFSZ
/// would end it. A handler does it, which programs that are started do not inherit. SIGPIPE is Rust's runtime's.
///
/// # Errors
/// When the system provides no means.
pub(crate) fn outlive_large_files() -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
    // The handler stays when what it returns is dropped.
    runtime.block_on(async { signal(SignalKind::from_raw(libc::SIGXFSZ)).map(drop) })
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
