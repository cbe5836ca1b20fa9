//! The deadman: no action, no motion.
//!
//! Without a fresh action for two action periods, or for the configured time, motors hold. After holding for another
//! configured time, if there is one, they are to be disabled. An action that arrives while they hold moves them again.
//! Two periods count as at least two command cycles plus the transport delay of an action.
//!
//! Invariant: after being armed, and without an action, it returns `Hold` and then perhaps `Disable`, never
//! `Follow`.

use std::time::Duration;

use rapid_core::time::Stamp;

/// Action periods that may pass without an action.
const PERIODS: u32 = 2;
/// Command cycles that may pass without an action, however short the period...
const CYCLES: u32 = 2;
/// ...and the longest transport delay of an action.
const WAY: Duration = Duration::from_millis(20);

/// See the module's comment.
#[derive(Debug, Clone, Copy)]
pub struct Deadman {
    hold_after: Option<Duration>,
    /// The default is no shorter.
    least: Duration,
    disable_after: Option<Duration>,
    /// Tick of the newest action since arming, if any.
    fresh: Option<Stamp>,
    armed: Stamp,
}

/// What to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Continue.
    Follow,
    /// Stay where the last command was.
    Hold,
    /// Turn the motors off.
    Disable,
}

impl Deadman {
    /// `hold_after` of `None` is two periods, `disable_after` of `None` never. `cycle` is the time between two commands.
    pub fn new(hold_after: Option<Duration>, disable_after: Option<Duration>, cycle: Duration) -> Self {
        let least = cycle.saturating_mul(CYCLES).saturating_add(WAY);
        Self { hold_after, least, disable_after, fresh: None, armed: Stamp(0) }
    }

    /// The motors were armed at `now`, and there is no action yet.
    pub const fn arm(&mut self, now: Stamp) {
        self.fresh = None;
        self.armed = now;
    }

    /// An action of this moment arrived.
    pub fn feed(&mut self, fresh: Stamp) {
        self.fresh = self.fresh.max(Some(fresh));
    }

    /// How old an action may be, at this action period.
    pub fn patience(&self, period: Duration) -> Duration {
        self.hold_after.unwrap_or_else(|| period.saturating_mul(PERIODS).max(self.least))
    }

    /// What to do at `now`, at this action period.
    pub fn verdict(&self, now: Stamp, period: Duration) -> Verdict {
        let holds_from = self.fresh.map_or(self.armed, |fresh| fresh.after(self.patience(period)));
        if self.fresh.is_some() && now < holds_from {
            Verdict::Follow
        } else if self.disable_after.is_none_or(|after| now < holds_from.after(after)) {
            Verdict::Hold
        } else {
            Verdict::Disable
        }
    }
}

#[cfg(test)]
mod tests;
