//! The deadman: no action, no motion.
//!
//! Without a fresh action for two periods of actions, or as long as is configured, motors hold; after
//! holding for a while longer, if that is configured, they are to be disabled. An action that comes while they hold moves them
//! again. Two periods are never taken for less than two cycles of commands and the time that an action is
//! on its way.
//!
//! Invariant: after being armed, and without an action, it returns `Hold` and then perhaps `Disable`, never
//! `Follow`.

use std::time::Duration;

use crate::time::Stamp;

/// Periods of actions that may pass without one.
const PERIODS: u32 = 2;
/// Cycles of commands that may pass without an action, however quickly the last two came...
const CYCLES: u32 = 2;
/// ...and how long an action may have been on its way when it is looked at.
const WAY: Duration = Duration::from_millis(20);

/// See the module's comment.
#[derive(Debug, Clone, Copy)]
pub struct Deadman {
    hold_after: Option<Duration>,
    /// The default is no shorter.
    least: Duration,
    disable_after: Option<Duration>,
    /// Of the newest action, if any came since arming.
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
    #[must_use]
    pub fn new(hold_after: Option<Duration>, disable_after: Option<Duration>, cycle: Duration) -> Self {
        let least = cycle.saturating_mul(CYCLES).saturating_add(WAY);
        Self { hold_after, least, disable_after, fresh: None, armed: Stamp(0) }
    }

    /// The motors were armed at `now`, and there is no action yet.
    pub const fn arm(&mut self, now: Stamp) {
        self.fresh = None;
        self.armed = now;
    }

    /// There is an action that was fresh at this moment.
    pub fn feed(&mut self, fresh: Stamp) {
        self.fresh = self.fresh.max(Some(fresh));
    }

    /// How old an action may be, with so long between actions.
    #[must_use]
    pub fn patience(&self, period: Duration) -> Duration {
        self.hold_after.unwrap_or_else(|| period.saturating_mul(PERIODS).max(self.least))
    }

    /// What to do at `now`, with so long between actions.
    #[must_use]
    pub fn look(&self, now: Stamp, period: Duration) -> Verdict {
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
