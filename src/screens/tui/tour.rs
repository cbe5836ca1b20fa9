//! A tour through the first minute on the simulated rig, of an episode or of a policy: what to press, and what is to be seen.
//!
//! Invariant: a step is over once the rig shows it, whatever was pressed.

use rapid_status::{DeviceState, Snapshot};

/// Snapshots, ten a second: a policy that loses what it requires acts until its next tick.
const SURE: u8 = 10;

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
    /// A policy acts, and is to lose a sensor; for how many snapshots it has acted without one.
    Lose(u8),
    /// It acts without the sensor, which is to be plugged in again.
    Regain,
    Over,
}

impl Tour {
    pub(super) fn update(&mut self, now: &Snapshot) {
        let is_recording = now.recording.is_some();
        let is_absent = now.devices.iter().any(|device| device.state == DeviceState::Absent);
        let is_whole = !is_absent && now.devices.iter().all(|device| device.state == DeviceState::Streaming);
        let acts = now.policy.as_ref().is_some_and(|policy| policy.hold.is_none() && policy.mask == now.mask);
        *self = match *self {
            Self::Begin if now.policy.is_some() => Self::Lose(0),
            Self::Lose(SURE..) => Self::Regain,
            Self::Lose(seen) => Self::Lose(if is_absent && acts { seen + 1 } else { 0 }),
            Self::Regain if is_whole && acts => Self::Over,
            Self::Begin if is_recording => Self::Unplug,
            Self::Unplug | Self::Plug | Self::End if !is_recording && now.last_verdict.is_some() => Self::Over,
            Self::Unplug if is_absent => Self::Plug,
            Self::Plug if is_whole => Self::End,
            step => step,
        };
    }

    /// What to do now, with `selected` the device that the keys are about. The key comes first: the end may be cut.
    pub(super) fn text(self, now: &Snapshot, selected: Option<&str>) -> Option<String> {
        let absent = now.devices.iter().find(|device| device.state == DeviceState::Absent).map(|device| &*device.name);
        let plug = absent.map(|name| if selected == Some(name) { "U".to_owned() } else { format!("select {name}, U") });
        let holds = now.policy.as_ref().is_some_and(|policy| policy.hold.is_some());
        Some(match (self, plug, absent) {
            (Self::Begin, ..) => "1/4 space: an episode begins".to_owned(),
            (Self::Unplug, ..) => "2/4 U: the selected sensor is unplugged; watch its bit of the mask".to_owned(),
            (Self::Plug, Some(plug), _) => {
                format!("3/4 {plug}: plug it in again; its bit is clear, the episode continues")
            }
            (Self::Plug, None, _) => "3/4 it is plugged in, and its bit is set with its first sample".to_owned(),
            (Self::End, ..) => "4/4 space: the episode ends and is judged; the bit is set again".to_owned(),
            (Self::Lose(_), Some(plug), Some(name)) if holds => {
                format!("1/2 {plug}: plug {name} in again, which the policy requires: it holds")
            }
            (Self::Lose(_), ..) if !now.devices.iter().any(|device| device.name == MAY_GO) => {
                "1/2 select a sensor that the policy may lose, U: unplug it".to_owned()
            }
            (Self::Lose(_), ..) if selected == Some(MAY_GO) => {
                format!("1/2 U: unplug {MAY_GO}, while a policy moves the arm")
            }
            (Self::Lose(_), ..) => {
                format!("1/2 select {MAY_GO} (up, down), U: unplug it, while a policy moves the arm")
            }
            (Self::Regain, Some(plug), Some(name)) => {
                let does = if holds { "holds" } else { "acts" };
                format!("2/2 {plug}: plug {name} in again; its bit is clear, and the policy {does} without it")
            }
            (Self::Regain, ..) => "2/2 it is plugged in, and its bit is set with its first sample".to_owned(),
            (Self::Over, ..) => return None,
        })
    }
}

/// The sensor that the policy of the simulated task was trained to miss.
const MAY_GO: &str = "tactile_tip";

#[cfg(test)]
mod tests {
    use crate::literal::{device, policy, recording, snapshot, three_streaming};
    use rapid_core::mask::PhysicalMask;
    use rapid_status::{Hold, PolicyStatus, Verdict};

    use super::*;

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
        let mut gone = snapshot(vec![device(0, "cam", DeviceState::Absent, "")]);
        gone.recording.clone_from(&now.recording);
        step(&gone, Tour::Plug);
        let mut opening = snapshot(vec![device(0, "cam", DeviceState::Opening, "")]);
        opening.recording.clone_from(&now.recording);
        step(&opening, Tour::Plug);
        step(&now, Tour::End);
        now.recording = None;
        now.last_verdict = Some(Verdict {
            grade: rapid_status::Grade::Good,
            reasons: Vec::new(),
            sensors: None,
            replay_of: Vec::new(),
        });
        step(&now, Tour::Over);
        // With a policy.
        let mut tour = Tour::default();
        let mut step = |mask: u64, holds: bool, is_there: bool, expected| {
            let state = if is_there { DeviceState::Streaming } else { DeviceState::Absent };
            let mut now = snapshot(vec![device(0, "cam", state, "")]);
            now.mask = PhysicalMask(mask);
            let hold = holds.then(|| Hold { device: None, reason: "late".to_owned() });
            now.policy = Some(PolicyStatus { mask: PhysicalMask(0b101), hold, ..policy() });
            tour.update(&now);
            assert_eq!(tour, expected);
        };
        step(0b111, false, true, Tour::Lose(0));
        step(0b101, true, false, Tour::Lose(0));
        step(0b001, false, false, Tour::Lose(0));
        // It requires the sensor, and acts until its next tick.
        step(0b101, false, false, Tour::Lose(1));
        step(0b101, true, false, Tour::Lose(0));
        (1..=SURE).for_each(|seen| step(0b101, false, false, Tour::Lose(seen)));
        step(0b101, false, false, Tour::Regain);
        step(0b111, false, true, Tour::Regain);
        step(0b101, false, true, Tour::Over);
        // An episode that ends early ends the tour as well.
        let mut early = Tour::Unplug;
        early.update(&now);
        assert_eq!((early, early.text(&now, None)), (Tour::Over, None));
    }

    #[test]
    fn the_device_that_is_missing_is_named() {
        let mut now = three_streaming();
        now.devices[1].name = "tactile_tip".into();
        let text = |tour: Tour, now: &Snapshot, selected| tour.text(now, selected).unwrap();
        assert_eq!(
            text(Tour::Lose(0), &now, Some("cam_wrist")).split(':').next(),
            Some("1/2 select tactile_tip (up, down), U")
        );
        assert_eq!(text(Tour::Lose(0), &now, Some("tactile_tip")).split(':').next(), Some("1/2 U"));
        now.devices[2].state = DeviceState::Absent;
        now.devices[2].name = "arm".into();
        assert!(text(Tour::Plug, &now, Some("cam_wrist")).starts_with("3/4 select arm, U: plug it in again"));
        assert!(text(Tour::Plug, &now, Some("arm")).starts_with("3/4 U: plug it in again"));
        let hold = Some(Hold { device: Some("arm".into()), reason: "missing".into() });
        now.policy = Some(PolicyStatus { hold, ..policy() });
        assert!(
            text(Tour::Lose(0), &now, Some("arm")).starts_with("1/2 U: plug arm in again, which the policy requires")
        );
        for tour in [Tour::Begin, Tour::Unplug, Tour::Plug, Tour::End, Tour::Lose(0), Tour::Regain] {
            let text = text(tour, &now, Some("cam_wrist"));
            // What to press is seen on the narrowest screen too.
            assert!(text.split_once(':').is_some_and(|(keys, _)| keys.len() < 50), "{text}");
        }
    }
}
