//! From the levels of a button to what was done with it.
//!
//! A press is given at once where it cannot become anything else; where a hold or a second press would mean something
//! else, when that is decided. It always carries the moment at which the button was pressed first.
//!
//! Invariant: pure: no clock; time comes with the levels.
//! Invariant: what is pressed when the level becomes known is not a press: it counts after it was released.
//! Invariant: a contact that chatters presses once.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_status::session::PRESS_AGAIN;

/// What is released for less than this was not released. A foot needs twice as long between two presses.
const CHATTER: Duration = Duration::from_millis(30);

/// The kernel releases the keys of a device that is unplugged (`input_unregister_device`), some time before its reader sees
/// it go: a release followed by a loss within this time was not a release.
const UNPLUGGED_WITHIN: Duration = Duration::from_millis(200);

/// What was done with a button.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Gesture {
    Press,
    Hold,
    /// It was pressed twice in a row.
    Double,
}

/// What a button distinguishes.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Rules {
    /// How long a hold is, if there is one.
    pub(super) hold_after: Option<Duration>,
    /// Two presses within [`PRESS_AGAIN`] are one gesture.
    pub(super) has_double: bool,
    /// Presses within [`PRESS_AGAIN`] of the one before do not count: see
    /// [`counts_once`](rapid_status::session::SessionRequest::counts_once).
    pub(super) counts_once: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum State {
    /// Unknown, or pressed since it is known.
    #[default]
    Ignored,
    Released,
    Pressed {
        since: Stamp,
        /// Nothing more follows from it.
        is_done: bool,
    },
    /// Pressed once and released: a second press may follow.
    Clicked {
        since: Stamp,
    },
}

#[derive(Debug, Default)]
pub(super) struct Presses {
    rules: Rules,
    state: State,
    /// When it was released, if that may still be a contact that chatters.
    released: Option<Stamp>,
    /// When it was released last.
    let_go: Option<Stamp>,
    /// When it was pressed last.
    last: Option<Stamp>,
}

impl Presses {
    pub(super) fn new(rules: Rules) -> Self {
        Self { rules, ..Self::default() }
    }

    /// It is pressed, or not, from `at` on. Returns what was done with it, each with the moment of the first press.
    pub(super) fn level(&mut self, is_pressed: bool, at: Stamp) -> Vec<(Gesture, Stamp)> {
        let mut done = self.advance(at);
        if !is_pressed {
            self.let_go = Some(at);
            if matches!(self.state, State::Ignored | State::Pressed { .. }) {
                self.released.get_or_insert(at);
            }
        } else if self.released.take().is_none() {
            done.extend(self.press(at));
        }
        done
    }

    fn press(&mut self, at: Stamp) -> Option<(Gesture, Stamp)> {
        let before = match self.state {
            State::Ignored | State::Pressed { .. } => return None,
            State::Released | State::Clicked { .. } => self.last.replace(at),
        };
        let Rules { hold_after, has_double, counts_once } = self.rules;
        let pressed = |is_done| State::Pressed { since: at, is_done };
        if let State::Clicked { since } = self.state {
            self.state = pressed(true);
            return Some((Gesture::Double, since));
        }
        let is_repeat = counts_once && before.is_some_and(|before| at.since(before) < PRESS_AGAIN);
        let waits = hold_after.is_some() || has_double;
        self.state = pressed(is_repeat || !waits);
        (!is_repeat && !waits).then_some((Gesture::Press, at))
    }

    /// Its level is unknown from `at` on.
    pub(super) fn lose(&mut self, at: Stamp) -> Vec<(Gesture, Stamp)> {
        let mut done = self.advance(at);
        // It was pressed and released before, and not by its loss.
        let is_released = self.let_go.is_none_or(|let_go| at.since(let_go) >= UNPLUGGED_WITHIN);
        if let State::Clicked { since } = self.state
            && is_released
        {
            done.push((Gesture::Press, since));
        }
        (self.state, self.released) = (State::Ignored, None);
        done
    }

    /// What the time until `now` has decided.
    pub(super) fn advance(&mut self, now: Stamp) -> Vec<(Gesture, Stamp)> {
        let Rules { hold_after, has_double, .. } = self.rules;
        let mut done = Vec::new();
        // A release ends a hold when it happened, not when it is certain.
        let held_until = self.released.unwrap_or(now);
        if let State::Pressed { since, is_done: is_done @ false } = &mut self.state {
            let since = *since;
            let gesture = match hold_after {
                Some(hold_after) => (held_until.since(since) >= hold_after).then_some(Gesture::Hold),
                None => (now.since(since) >= PRESS_AGAIN).then_some(Gesture::Press),
            };
            *is_done = gesture.is_some();
            done.extend(gesture.map(|gesture| (gesture, since)));
        }
        if self.released.is_some_and(|released| now.since(released) >= self.settles_in()) {
            self.released = None;
            self.state = match self.state {
                State::Pressed { since, is_done: false } if has_double => State::Clicked { since },
                State::Pressed { since, is_done: false } => {
                    done.push((Gesture::Press, since));
                    State::Released
                }
                State::Clicked { since } => State::Clicked { since },
                State::Pressed { is_done: true, .. } | State::Ignored | State::Released => State::Released,
            };
        }
        if let State::Clicked { since } = self.state
            && now.since(since) >= PRESS_AGAIN
        {
            done.push((Gesture::Press, since));
            self.state = State::Released;
        }
        done
    }

    /// How long a release must last: one that decides that it was not a hold must not be that of an unplugged device.
    fn settles_in(&self) -> Duration {
        match self.state {
            State::Pressed { is_done: false, .. } if !self.rules.has_double => UNPLUGGED_WITHIN,
            _ => CHATTER,
        }
    }

    /// When [`Self::advance`] decides something next, if at all.
    pub(super) fn due(&self) -> Option<Stamp> {
        let decided = match self.state {
            State::Pressed { since, is_done: false } => match self.rules.hold_after {
                Some(hold_after) => self.released.is_none().then(|| since.after(hold_after)),
                None => Some(since.after(PRESS_AGAIN)),
            },
            State::Clicked { since } => Some(since.after(PRESS_AGAIN)),
            State::Ignored | State::Released | State::Pressed { .. } => None,
        };
        let settled = self.released.map(|released| released.after(self.settles_in()));
        decided.into_iter().chain(settled).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A time of the tables, ms.
    fn at(ms: u64) -> Stamp {
        Stamp(1_000_000_000).after(Duration::from_millis(ms))
    }

    /// Plays `script`, which is `+` (pressed), `-` (released) or `?` (lost), each with its time in ms. Returns gestures
    /// with the time of the press and of the decision: `press 100@130`.
    fn play(rules: Rules, script: &str) -> String {
        let mut presses = Presses::new(rules);
        let (mut did, mut last) = (Vec::new(), at(0));
        let mut note = |done: Vec<(Gesture, Stamp)>, now: Stamp| {
            for (gesture, since) in done {
                let word = match gesture {
                    Gesture::Press => "press",
                    Gesture::Hold => "hold",
                    Gesture::Double => "double",
                };
                let ms = |stamp: Stamp| stamp.since(at(0)).as_millis();
                did.push(format!("{word} {}@{}", ms(since), ms(now)));
            }
        };
        let steps = script.split_whitespace().map(|step| (&step[..1], at(step[1..].parse().unwrap())));
        for (what, now) in steps.chain([("end", at(100_000))]) {
            // As the owner does: at each moment that is due.
            while let Some(due) = presses.due().filter(|due| *due <= now) {
                let (before, due) = ((presses.state, presses.released), due.max(last));
                note(presses.advance(due), due);
                assert_ne!((presses.state, presses.released), before, "{script}: nothing was due at {due:?}");
            }
            match what {
                "+" => note(presses.level(true, now), now),
                "-" => note(presses.level(false, now), now),
                "?" => note(presses.lose(now), now),
                _ => {}
            }
            last = now;
        }
        did.join(", ")
    }

    #[test]
    fn a_press_counts_at_once_and_once() {
        let once = Rules { counts_once: true, ..Rules::default() };
        for (script, every, counted) in [
            ("", "", ""),
            ("-0 +100 -200", "press 100@100", "press 100@100"),
            // Held for however long.
            ("-0 +100 +150 +9000", "press 100@100", "press 100@100"),
            // Pressed when it becomes known, at the start and after a loss.
            ("+0 +50 -1000 +1100", "press 1100@1100", "press 1100@1100"),
            ("-0 ?50 +100 -200 +700 -900", "press 700@700", "press 700@700"),
            ("-0 +100 ?150 +160 -300 +700", "press 100@100, press 700@700", "press 100@100, press 700@700"),
            // Chatter at both edges.
            ("-0 +100 -105 +110 -120 +125 -300 +310 -320", "press 100@100", "press 100@100"),
            // Another press after the least time, and before.
            ("-0 +100 -200 +500 -600", "press 100@100, press 500@500", "press 100@100, press 500@500"),
            ("-0 +100 -200 +499 -600", "press 100@100, press 499@499", "press 100@100"),
            // Each press counts from itself.
            ("-0 +100 -150 +400 -450 +700 -750", "press 100@100, press 400@400, press 700@700", "press 100@100"),
            // A line of text is pressed and released at once.
            ("-0 +100 -100 +800 -800", "press 100@100, press 800@800", "press 100@100, press 800@800"),
        ] {
            assert_eq!(play(Rules::default(), script), every, "{script}");
            assert_eq!(play(once, script), counted, "{script}, once");
        }
    }

    #[test]
    fn a_hold_is_no_press_and_two_presses_are_one_gesture() {
        let hold = Rules { hold_after: Some(Duration::from_secs(1)), has_double: false, counts_once: true };
        let double = Rules { hold_after: None, has_double: true, counts_once: true };
        let both = Rules { has_double: true, ..hold };
        for (rules, script, expected) in [
            (hold, "-0 +100 -300", "press 100@500"),
            (hold, "-0 +100 -1099", "press 100@1299"),
            (hold, "-0 +100", "hold 100@1100"),
            (hold, "-0 +100 -5000 +6000 -6100", "hold 100@1100, press 6000@6300"),
            // A contact that chatters ends no hold.
            (hold, "-0 +100 -600 +610 -2000", "hold 100@1100"),
            (hold, "-0 +100 -1090 +1110 -2000", "hold 100@1110"),
            // Lost while it is held: it is unknown for how long.
            (hold, "-0 +100 ?500 -600 +900 -1000", "press 900@1200"),
            (hold, "+0 -3000", ""),
            (hold, "-0 +100 -150 +400 -2000", "press 100@350"),
            // The kernel releases what is unplugged.
            (hold, "-0 +100 -300 ?499", ""),
            (both, "-0 +100 -300 ?499", ""),
            (double, "-0 +100 -150 ?250", ""),
            (double, "-0 +100 -150", "press 100@500"),
            (double, "-0 +100 -9000", "press 100@500"),
            (double, "-0 +100 -150 +499 -600", "double 100@499"),
            (double, "-0 +100 -150 +500 -600", "press 100@500, press 500@900"),
            // The third of three presses.
            (double, "-0 +100 -150 +300 -350 +500 -550", "double 100@300"),
            (double, "-0 +100 -110 +120 -200", "press 100@500"),
            (double, "-0 +100 -150 ?351", "press 100@351"),
            (both, "-0 +100 -150", "press 100@500"),
            (both, "-0 +100 -150 +300 -5000", "double 100@300"),
            (both, "-0 +100 -900", "press 100@930"),
            (both, "-0 +100 -1500 +3000 -3050", "hold 100@1100, press 3000@3400"),
        ] {
            assert_eq!(play(rules, script), expected, "{rules:?}: {script}");
        }
    }
}
