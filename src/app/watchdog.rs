//! The watchdog of the service manager (`WatchdogSec=`, systemd.service(5)): it ends and restarts a service that hangs.
//!
//! Invariant: it is fed from the runtime that everything else runs on, not from a separate thread.

use sd_notify::{NotifyState, notify, watchdog_enabled};
use tokio::task::AbortHandle;
use tokio::time::{MissedTickBehavior, interval};

/// The watchdog is fed until this is dropped.
#[derive(Debug)]
pub(super) struct Watchdog(Option<AbortHandle>);

impl Watchdog {
    /// Does nothing where no service manager requests it.
    pub(super) fn feed() -> Self {
        Self(watchdog_enabled().map(|limit| {
            let feeding = tokio::spawn(async move {
                // sd_watchdog_enabled(3) advises half of the limit; with a third, one notification may be late.
                let mut ticks = interval(limit / 3);
                ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
                loop {
                    ticks.tick().await;
                    if let Err(error) = notify(&[NotifyState::Watchdog]) {
                        tracing::warn!(%error, "the watchdog of the service manager cannot be reached");
                    }
                }
            });
            feeding.abort_handle()
        }))
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        if let Some(feeding) = &self.0 {
            feeding.abort();
        }
    }
}
