//! A tour through the first minute on the simulated rig, of an episode or of a policy: what to press, and what is to be seen.
//!
//! Invariant: a step is over once the rig shows it, whatever was pressed.

use crate::status::{SlotState, Snapshot};

/// Where the tour is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Tour {
    /// An episode is to begin.
    #[default]
    Begin,
    /// A device is to be unplugged while it is recorded.
    Unplug,
    /// It is to be plugged in again.
    Plug,
    /// The episode is to end.
    End,
    /// A policy acts, and is to lose a sensor.
    Lose,
    /// It acts without the sensor, which is to be plugged in again.
    Regain,
    /// It is over.
    Over,
}

impl Tour {
    /// Takes a snapshot into account.
    pub(super) fn update(&mut self, now: &Snapshot) {
        let is_recording = now.recording.is_some();
        let is_absent = now.devices.iter().any(|device| device.state == SlotState::Absent);
        let is_whole = !is_absent && now.devices.iter().all(|device| device.state == SlotState::Streaming);
        let acts = now.policy.as_ref().is_some_and(|policy| policy.hold.is_none() && policy.mask == now.mask);
        *self = match *self {
            Self::Begin if now.policy.is_some() => Self::Lose,
            Self::Lose if is_absent && acts => Self::Regain,
            Self::Regain if is_whole && acts => Self::Over,
            Self::Begin if is_recording => Self::Unplug,
            Self::Unplug | Self::Plug | Self::End if !is_recording && now.last_verdict.is_some() => Self::Over,
            Self::Unplug if is_absent => Self::Plug,
            Self::Plug if is_whole => Self::End,
            step => step,
        };
    }

    /// What to do now.
    pub(super) const fn text(self) -> Option<&'static str> {
        match self {
            Self::Begin => Some("1/4 space: an episode begins"),
            Self::Unplug => Some("2/4 U: the selected sensor is unplugged; watch its bit of the mask"),
            Self::Plug => Some("3/4 the bit is clear, the episode continues. U: plug it in again"),
            Self::End => Some("4/4 the bit is set again. space: the episode ends and is judged"),
            Self::Lose => Some("1/2 a policy moves the arm. down: select tactile_tip; U: it is unplugged"),
            Self::Regain => Some("2/2 its bit is clear, and the policy acts without it. U: plug it in again"),
            Self::Over => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mask::PhysicalMask;
    use crate::status::literal::{device, policy, recording, snapshot, three_streaming};
    use crate::status::{Hold, PolicyStatus, Verdict};

    #[test]
    fn each_step_is_over_when_the_rig_shows_it() {
        let mut tour = Tour::default();
        let mut step = |now: &Snapshot, expected| {
            tour.update(now);
            assert_eq!(tour, expected);
        };
        let mut now = three_streaming();
        step(&now, Tour::Begin);
        now.recording = Some(recording(0));
        step(&now, Tour::Unplug);
        let mut gone = snapshot(vec![device(0, "cam", SlotState::Absent, "")]);
        gone.recording.clone_from(&now.recording);
        step(&gone, Tour::Plug);
        let mut opening = snapshot(vec![device(0, "cam", SlotState::Opening, "")]);
        opening.recording.clone_from(&now.recording);
        step(&opening, Tour::Plug);
        step(&now, Tour::End);
        now.recording = None;
        now.last_verdict = Some(Verdict { grade: crate::status::Grade::Good, reasons: Vec::new(), sensors: None });
        step(&now, Tour::Over);
        // With a policy.
        let mut tour = Tour::default();
        let mut step = |mask: u64, holds: bool, is_there: bool, expected| {
            let state = if is_there { SlotState::Streaming } else { SlotState::Absent };
            let mut now = snapshot(vec![device(0, "cam", state, "")]);
            now.mask = PhysicalMask(mask);
            let hold = holds.then(|| Hold { device: None, reason: "late".to_owned() });
            now.policy = Some(PolicyStatus { mask: PhysicalMask(0b101), hold, ..policy() });
            tour.update(&now);
            assert_eq!(tour, expected);
        };
        step(0b111, false, true, Tour::Lose);
        step(0b101, true, false, Tour::Lose);
        step(0b001, false, false, Tour::Lose);
        step(0b101, false, false, Tour::Regain);
        step(0b111, false, true, Tour::Regain);
        step(0b101, false, true, Tour::Over);
        // An episode that ends early ends the tour as well.
        let mut early = Tour::Unplug;
        early.update(&now);
        assert_eq!((early, early.text()), (Tour::Over, None));
    }
}
