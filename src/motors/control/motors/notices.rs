//! The notices of a bus of motors on their way to the display.

use std::collections::VecDeque;
use std::time::Duration;

use rapid_core::time::Stamp;

use super::notice::Notice;

/// Shortest time between notices of a frequent condition.
const SELDOM: Duration = Duration::from_secs(1);

/// A condition that is reported when it begins, at most once per [`SELDOM`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Seldom {
    last: Option<Stamp>,
    is_reported: bool,
}

impl Seldom {
    /// The condition holds at `now`, or not. Is it to be reported?
    pub(super) fn update(&mut self, is: bool, now: Stamp) -> bool {
        self.is_reported &= is;
        let is_due = is && !self.is_reported && self.last.is_none_or(|last| now.since(last) >= SELDOM);
        if is_due {
            *self = Self { last: Some(now), is_reported: true };
        }
        is_due
    }
}

/// Notices that wait to be taken. Without room the oldest are lost: nothing here allocates.
#[derive(Debug)]
pub(super) struct Notices {
    waiting: VecDeque<Notice>,
    lost: u64,
}

impl Notices {
    /// Notices that may wait.
    const ROOM: usize = 64;

    pub(super) fn new() -> Self {
        Self { waiting: VecDeque::with_capacity(Self::ROOM), lost: 0 }
    }

    pub(super) fn notify(&mut self, notice: Notice) {
        if self.waiting.len() >= Self::ROOM {
            self.waiting.pop_front();
            self.lost += 1;
        }
        self.waiting.push_back(notice);
    }

    pub(super) fn pop(&mut self) -> Option<Notice> {
        self.waiting.pop_front()
    }

    pub(super) const fn lost(&self) -> u64 {
        self.lost
    }
}
