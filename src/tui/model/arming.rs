//! Arming the actuator, which asks first, and disarming it, which does not.

use std::time::Duration;

use super::{Effect, Model, Quit};
use crate::action::Order;
use crate::time::Stamp;

/// How long after the question an arm may be confirmed.
const CONFIRM_WITHIN: Duration = Duration::from_secs(2);

impl Model {
    /// Asks first: something is going to move.
    pub(super) fn ask_to_arm(&mut self) {
        self.arming = Some(self.latest.taken);
        self.say("ctrl-y within 2 s lets the actuator move, any other key does not");
    }

    /// The key that confirms is none that pasted text contains, nor what a key that is held down repeats.
    pub(super) fn arm(&mut self, asked: Option<Stamp>) -> Effect {
        let in_time = asked.is_some_and(|asked| self.latest.taken.since(asked) <= CONFIRM_WITHIN);
        self.say(if in_time { "arming the actuator" } else { "not armed: a first, then ctrl-y within 2 s" });
        if in_time { Effect::Order(Order::Arm) } else { Effect::None }
    }

    /// Closes whatever is open, as Esc does elsewhere.
    pub(super) fn disarm(&mut self, is_escape: bool) -> Effect {
        (self.help, self.dropping) = (false, None);
        if self.quit == Quit::Asked {
            self.quit = Quit::No;
        }
        if is_escape {
            self.scroll = 0;
        } else {
            self.say("disarming the actuator");
        }
        Effect::Order(Order::Disarm)
    }
}
