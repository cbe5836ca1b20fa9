//! Capture times that somebody else states: a program, or another computer. They are untrusted.
//!
//! 1. A time that cannot be one (in the future, older than [`OLDEST`], or before that of an earlier sample) makes its sample
//!    damaged: nothing says when it was captured. Its stamp is an estimate, by the delay of the sample before it, so that it
//!    has a place in a recording.
//! 2. Older means late or damaged, never better: up to [`OLDEST`] a sample keeps its capture time, and is late.
//! 3. One bad time decides for one sample.
//!
//! Invariant: pure. Stamps do not go back, and are later than `now` by no more than the time may be wrong.

use std::fmt;
use std::time::Duration;

use crate::time::Stamp;

/// A sample that claims to be older than this is not believed: nothing takes that long, but a clock of another origin looks
/// like this.
pub const OLDEST: Duration = Duration::from_secs(10);

/// Judges the capture times of one source, one after another.
#[derive(Debug, Clone, Default)]
pub struct CaptureTimes {
    /// The newest capture time that was believed, and how long that sample took.
    believed: Stamp,
    delay: Duration,
    /// The newest stamp that was passed on.
    newest: Stamp,
}

/// When a sample was captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Captured {
    /// The moment, or an estimate if that is not known.
    pub at: Stamp,
    /// Why the time that was stated is not believed: the sample is damaged.
    pub doubt: Option<Doubt>,
}

/// Why a capture time is not believed, and by how far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Doubt {
    /// It is in the future.
    Future(Duration),
    /// It is older than [`OLDEST`].
    Old(Duration),
    /// It is before one that was believed.
    Back(Duration),
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Future(by) => write!(f, "{by:?} in the future"),
            Self::Old(age) => write!(f, "{age:?} old"),
            Self::Back(by) => write!(f, "{by:?} before the one before"),
        }
    }
}

impl CaptureTimes {
    /// Takes the `stated` capture time of a sample that arrived `now`. It may be wrong by `uncertainty`, either way.
    pub fn judge(&mut self, stated: Stamp, uncertainty: Duration, now: Stamp) -> Captured {
        let age = now.since(stated);
        let doubt = if stated > now.after(uncertainty) {
            Some(Doubt::Future(stated.since(now)))
        } else if age > OLDEST {
            Some(Doubt::Old(age))
        } else if stated.after(uncertainty) < self.believed {
            Some(Doubt::Back(self.believed.since(stated)))
        } else {
            None
        };
        if doubt.is_some() {
            self.newest = self.newest.max(now.before(self.delay));
        } else {
            (self.believed, self.delay) = (self.believed.max(stated), age);
            // An estimate before it may be later than it, by as much as the delay varies.
            let after = self.newest.after(Duration::from_nanos(1)).min(now.after(uncertainty)).max(self.newest);
            self.newest = if stated < self.newest { after } else { stated };
        }
        Captured { at: self.newest, doubt }
    }

    /// The stamp of a sample that arrived `now`, if its source does not know when it was captured.
    pub fn unknown(&mut self, now: Stamp) -> Stamp {
        self.newest = self.newest.max(now);
        self.newest
    }
}

#[cfg(test)]
mod tests;
