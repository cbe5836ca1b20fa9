//! Which unit each modality's samples come from, and which policy is in control: now, and in an episode.
//!
//! An epoch begins when the device is opened and ends when its slot stops running. All of it follows from events, which
//! are in the file too.
//!
//! Invariant: pure: all knowledge comes from events.

use std::collections::BTreeMap;

use rapid_core::time::Stamp;
use rapid_status::{DeviceState, Event, EventKind, Provenance};
use serde::Serialize;
use serde_json::{Value, json};

use super::sources::Epochs;

/// Serial of every device attached, by its modality's name.
type Serials = BTreeMap<String, Option<String>>;

/// A policy at the controls.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct Policy {
    name: String,
    hash: String,
    dry_run: bool,
}

/// One epoch of a modality.
#[derive(Debug, Clone)]
struct Incarnation {
    opened: Stamp,
    ended: Option<Stamp>,
    provenance: Provenance,
}

/// What is attached and running now, recording or not.
#[derive(Debug, Clone, Default)]
pub(super) struct Attached(Units);

impl Attached {
    pub(super) fn apply(&mut self, event: &Event) {
        let Self(units) = self;
        match &event.what {
            EventKind::Detach { device, .. } => drop(units.serials.remove(device)),
            EventKind::State { device, state, .. } if has_ended(*state) => drop(units.epochs.remove(device)),
            EventKind::PolicyEnd { .. } => units.policy = None,
            what => {
                if let EventKind::Opened { device, .. } = what {
                    units.epochs.remove(device);
                }
                units.apply(event);
            }
        }
    }

    /// Is the device of this name plugged in?
    pub(super) fn has(&self, device: &str) -> bool {
        self.0.serials.contains_key(device)
    }
}

/// Every unit and every epoch of an episode, and its policy.
#[derive(Debug, Clone, Default)]
pub(super) struct Units {
    serials: Serials,
    epochs: BTreeMap<String, Vec<Incarnation>>,
    policy: Option<Policy>,
}

impl Units {
    /// Those that are there when an episode begins.
    pub(super) fn new(attached: &Attached) -> Self {
        attached.0.clone()
    }

    pub(super) fn apply(&mut self, event: &Event) {
        match &event.what {
            EventKind::Attach { device, unit, .. } => {
                drop(self.serials.insert(device.clone(), unit.serial().map(str::to_owned)));
            }
            EventKind::Opened { device, provenance, .. } => {
                self.end(device, event.stamp);
                let opened = Incarnation { opened: event.stamp, ended: None, provenance: (**provenance).clone() };
                self.epochs.entry(device.clone()).or_default().push(opened);
            }
            EventKind::State { device, state, .. } if has_ended(*state) => self.end(device, event.stamp),
            EventKind::Policy { policy, hash, dry_run, .. } => {
                self.policy = Some(Policy { name: policy.clone(), hash: hash.clone(), dry_run: *dry_run });
            }
            _ => {}
        }
    }

    fn end(&mut self, device: &str, at: Stamp) {
        if let Some(last) = self.epochs.get_mut(device).and_then(|epochs| epochs.last_mut()) {
            last.ended.get_or_insert(at);
        }
    }

    /// `{modality: serial or null}` of what was attached at some time.
    pub(super) fn serials(&self) -> Value {
        json!(self.serials)
    }

    /// `{name, hash, dry_run}` of the policy that ran at some time, the last if there were several.
    pub(super) fn policy(&self) -> Option<Value> {
        self.policy.as_ref().map(|policy| json!(policy))
    }

    /// `{modality: [epoch, ...]}` in the order of time: each the event `opened` without its
    /// modality, with `from_s` and `to_s` in seconds from `begin`: negative for one that ran before
    /// the episode, null for one that did not end in it.
    pub(super) fn epochs(&self, begin: Stamp) -> Epochs {
        let seconds = |at: Stamp| at.since(begin).as_secs_f64() - begin.since(at).as_secs_f64();
        let one = |epoch: &Incarnation| {
            let mut report = json!(epoch.provenance);
            if let Value::Object(fields) = &mut report {
                fields.insert("from_s".to_owned(), seconds(epoch.opened).into());
                fields.insert("to_s".to_owned(), epoch.ended.map(seconds).into());
            }
            report
        };
        let all = self.epochs.iter();
        all.map(|(device, epochs)| (device.clone(), epochs.iter().map(one).collect())).collect()
    }
}

const fn has_ended(state: DeviceState) -> bool {
    match state {
        DeviceState::Absent | DeviceState::Backoff | DeviceState::Failed => true,
        DeviceState::Opening | DeviceState::Streaming | DeviceState::Stalled => false,
    }
}

#[cfg(test)]
mod tests {
    use rapid_core::mask::SizedMask;
    use rapid_core::modality::ModalityId;
    use rapid_core::provenance::Negotiated;
    use rapid_core::sample::Epoch;
    use rapid_registry::device::UsbIdentity;
    use rapid_status::PolicyEnd;

    use super::*;

    const BEGIN: Stamp = Stamp(10_000_000_000);

    fn unit(serial: &str) -> UsbIdentity {
        UsbIdentity { vid: 0x046d, serial: Some(serial.to_owned()), ..UsbIdentity::default() }
    }

    fn attach(ms: u64, serial: &str) -> Event {
        let bit = ModalityId::new(0).unwrap();
        let what = EventKind::Attach {
            device: "cam".into(),
            bit,
            node: String::new(),
            unit: unit(serial).into(),
            driver: None,
        };
        Event { stamp: Stamp(ms * 1_000_000), what }
    }

    fn open(ms: u64, epoch: u32, serial: &str) -> Event {
        let provenance = Provenance {
            epoch: Epoch(epoch),
            node: "/dev/video0".into(),
            attached: Stamp(ms),
            unit: unit(serial).into(),
            negotiated: Negotiated::default(),
            latency_ns: 0,
        };
        let (bit, provenance) = (ModalityId::new(0).unwrap(), Box::new(provenance));
        Event { stamp: Stamp(ms * 1_000_000), what: EventKind::Opened { device: "cam".into(), bit, provenance } }
    }

    fn state(ms: u64, state: DeviceState) -> Event {
        let bit = ModalityId::new(0).unwrap();
        let what =
            EventKind::State { device: "cam".into(), bit, state, mask: SizedMask::default(), detail: String::new() };
        Event { stamp: Stamp(ms * 1_000_000), what }
    }

    #[test]
    fn each_epoch_of_an_episode_names_its_unit() {
        let mut attached = Attached::default();
        for event in [attach(1_000, "A"), open(8_000, 1, "A"), state(8_100, DeviceState::Streaming)] {
            attached.apply(&event);
        }
        let mut units = Units::new(&attached);
        for event in [
            state(12_000, DeviceState::Absent),
            state(12_001, DeviceState::Backoff),
            attach(13_000, "B"),
            open(15_000, 2, "B"),
            state(15_100, DeviceState::Stalled),
            // The end of the second was not reported: the third implies it.
            open(16_500, 3, "B"),
        ] {
            units.apply(&event);
        }
        let epochs = units.epochs(BEGIN);
        let report: Vec<_> = epochs["cam"]
            .iter()
            .map(|e| (e["epoch"].as_u64(), e["serial"].as_str(), e["from_s"].as_f64(), e["to_s"].as_f64()))
            .collect();
        let expected = [
            (Some(1), Some("A"), Some(-2.0), Some(2.0)),
            (Some(2), Some("B"), Some(5.0), Some(6.5)),
            (Some(3), Some("B"), Some(6.5), None),
        ];
        assert_eq!(report, expected);
        assert_eq!(epochs["cam"][0]["vid"], "046d");
        assert_eq!(units.serials(), json!({"cam": "B"}));
    }

    fn policy(name: &str) -> Event {
        let what = EventKind::Policy {
            policy: name.to_owned(),
            folder: "models/x".into(),
            hash: "ff".to_owned(),
            library: String::new(),
            hz: 10.0,
            dry_run: true,
        };
        Event { stamp: Stamp(0), what }
    }

    #[test]
    fn the_policy_of_an_episode_is_the_one_that_ran_in_it() {
        let end = EventKind::PolicyEnd(PolicyEnd {
            actions: 0,
            held: 0,
            chunks: 0,
            late: 0,
            unused: 0,
            latency_p50_ms: 0.0,
            latency_p99_ms: 0.0,
        });
        let end = Event { stamp: Stamp(0), what: end };
        let mut attached = Attached::default();
        assert_eq!(Units::new(&attached).policy(), None);
        attached.apply(&policy("before"));
        let mut units = Units::new(&attached);
        let reported = |name: &str| Some(json!({"name": name, "hash": "ff", "dry_run": true}));
        assert_eq!(units.policy(), reported("before"));
        // It ran, although it has ended.
        units.apply(&end);
        assert_eq!(units.policy(), reported("before"));
        units.apply(&policy("within"));
        assert_eq!(units.policy(), reported("within"));
        attached.apply(&end);
        assert_eq!(Units::new(&attached).policy(), None, "it ended before the episode");
    }

    #[test]
    fn epochs_that_ended_before_the_episode_are_not_in_it() {
        let mut attached = Attached::default();
        for event in [attach(1_000, "A"), open(2_000, 1, "A"), state(3_000, DeviceState::Failed)] {
            attached.apply(&event);
        }
        let units = Units::new(&attached);
        assert_eq!((units.epochs(BEGIN), units.serials()), (Epochs::new(), json!({"cam": "A"})));
    }
}
