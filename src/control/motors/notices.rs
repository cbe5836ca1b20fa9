//! The notices of a bus of motors on their way to whoever shows them.

use std::collections::VecDeque;

use super::notice::Notice;

/// Notices that wait to be taken. The oldest are lost where there is no room, for nothing here
/// allocates.
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

    pub(super) fn tell(&mut self, notice: Notice) {
        if self.waiting.len() >= Self::ROOM {
            self.waiting.pop_front();
            self.lost += 1;
        }
        self.waiting.push_back(notice);
    }

    pub(super) fn take(&mut self) -> Option<Notice> {
        self.waiting.pop_front()
    }

    pub(super) const fn lost(&self) -> u64 {
        self.lost
    }
}
