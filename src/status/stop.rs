//! What is shown and recorded of emergency stops and enabling switches.

use serde::Serialize;

use crate::interlock::{InputState, StopKind};

/// An emergency stop or an enabling switch, as it is now.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct StopStatus {
    /// Its name.
    pub stop: String,
    /// What it is.
    pub kind: StopKind,
    /// What its input says.
    pub state: InputState,
    /// Why it is lost; otherwise empty.
    pub detail: String,
}

impl StopStatus {
    /// Somebody should look after it: a switch that is released is in order.
    #[must_use]
    pub fn is_problem(&self) -> bool {
        match self.kind {
            StopKind::Emergency => self.state != InputState::Runs,
            StopKind::Enabling => self.state == InputState::Lost,
        }
    }

    /// What it is doing, in one word.
    #[must_use]
    pub const fn word(&self) -> &'static str {
        self.kind.word(self.state)
    }

    /// For people.
    #[must_use]
    pub fn sentence(&self) -> String {
        let (kind, name, word) = (self.kind.label(), &self.stop, self.word());
        let rest = match self.state {
            InputState::Lost => format!(" ({})", self.detail),
            InputState::Runs => ": nothing moves before the next arm".to_owned(),
            InputState::Stopped => String::new(),
        };
        format!("{kind} {name} {word}{rest}")
    }
}
