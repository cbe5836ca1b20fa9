//! What a screen shows of the one device that it looks at, beyond its row.
//!
//! Invariant: the histogram of intervals is counted without a lock or an allocation; its memory is fixed.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rapid_core::modality::ModalityId;
use rapid_registry::{CanProtocol, DeviceSpec, MOTOR_CHANNELS, NodeSpec};
use serde::{Deserialize, Serialize};

use crate::Provenance;

/// A number in the samples of a device.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Channel {
    /// Its name.
    pub name: String,
    /// Lowest and highest value, where the registry has them.
    pub limits: Option<[f64; 2]>,
}

/// See the module's comment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeviceDetail {
    /// Its bit.
    pub id: ModalityId,
    /// Facts about the entry and the unit: what, and its value.
    pub facts: Vec<(String, String)>,
    /// The numbers of a sample; empty if it has none with names.
    pub channels: Vec<Channel>,
    /// Controls that the driver reported, and their values.
    pub controls: Vec<(String, i64)>,
    /// Intervals between capture times, by [`Intervals::bounds`].
    pub intervals: Vec<u64>,
}

impl DeviceDetail {
    /// Of an entry and, if it was opened, its newest incarnation.
    pub(super) fn new(entry: &StaticDetail, opened: Option<&Provenance>, intervals: Vec<u64>) -> Self {
        let StaticDetail { id, facts, channels } = entry;
        let mut facts = facts.clone();
        let mut controls = Vec::new();
        if let Some(opened) = opened {
            facts.extend(facts_of(opened));
            controls = opened.negotiated.controls.iter().map(|(name, value)| (name.clone(), *value)).collect();
        }
        Self { id: *id, facts, channels: channels.clone(), controls, intervals }
    }
}

fn facts_of(opened: &Provenance) -> Vec<(String, String)> {
    let fact = |name: &str, value: String| (name.to_owned(), value);
    let mut facts = vec![fact("unit", opened.unit.serial().unwrap_or("no serial number").to_owned())];
    facts.push(fact("at", format!("{}, {}", opened.unit.location(), opened.node)));
    if let Some(driver) = &opened.negotiated.driver {
        let version = driver.version.as_ref().map(|version| format!(" {version}")).unwrap_or_default();
        facts.push(fact("driver", format!("{}{version}", driver.name)));
    }
    if let Some(card) = &opened.negotiated.card {
        facts.push(fact("card", card.clone()));
    }
    facts
}

/// What an entry of the registry contributes.
#[derive(Debug, Clone)]
pub(super) struct StaticDetail {
    id: ModalityId,
    facts: Vec<(String, String)>,
    channels: Vec<Channel>,
}

impl StaticDetail {
    pub(super) fn new(device: &DeviceSpec) -> Self {
        let fact = |name: &str, value: String| (name.to_owned(), value);
        let mut facts = vec![fact("target", device.node.format())];
        if let Some(usb) = device.identity.usb() {
            let serial = usb.serial.as_ref().map(|serial| format!(", serial {serial}")).unwrap_or_default();
            let port = usb.port.as_ref().map(|port| format!(", port {port}")).unwrap_or_default();
            facts.push(fact("identity", format!("{:04x}:{:04x}{serial}{port}", usb.vid, usb.pid)));
        }
        facts.extend(device.mount.map(|mount| fact("mount", mount.to_string())));
        facts.push(fact("topic", device.topic.clone()));
        Self { id: device.id, facts, channels: channels(device) }
    }
}

/// Names and limits of the values in a sample: those of motors, or of an actuator that reports what it is sent.
fn channels(device: &DeviceSpec) -> Vec<Channel> {
    if let NodeSpec::Can(can) = &device.node
        && let CanProtocol::Damiao(bus) = &can.protocol
    {
        let parts = ["rad", "rad/s", "Nm", "°C transistors", "°C winding", "error"];
        let channels = bus.motors.iter().flat_map(|motor| {
            let highest = |limit: f64| Some([-limit, limit]);
            let limits = [
                Some(motor.position),
                highest(motor.velocity),
                highest(motor.torque),
                Some([0.0, motor.max_mos]),
                Some([0.0, motor.max_rotor]),
                None,
            ];
            let name = move |unit: &str| format!("{} {unit}", motor.name);
            parts
                .iter()
                .zip(limits)
                .map(move |(unit, limits)| Channel { name: name(unit), limits })
                .take(MOTOR_CHANNELS)
        });
        return channels.collect();
    }
    let names = device.action.as_ref().map(|action| action.names.clone()).unwrap_or_default();
    names.into_iter().map(|name| Channel { name, limits: None }).collect()
}

/// Intervals between the capture times of a device, in half octaves.
#[derive(Debug, Default)]
pub struct Intervals([AtomicU64; Self::COUNT]);

impl Intervals {
    /// Buckets: up to 4 s; a longer interval is an absence.
    pub const COUNT: usize = 32;
    /// The upper bound of the first bucket.
    const FIRST: Duration = Duration::from_micros(90);

    /// The upper bounds of all buckets.
    pub fn bounds() -> impl Iterator<Item = Duration> {
        let half_octave = std::f64::consts::SQRT_2;
        (0..Self::COUNT).map(move |bucket| Self::FIRST.mul_f64(half_octave.powi(i32::try_from(bucket).unwrap_or(0))))
    }

    pub(super) fn count(&self, interval: Duration) {
        let ratio = interval.as_nanos() as f64 / Self::FIRST.as_nanos() as f64;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "saturates; negative ones are in the first bucket"
        )]
        let bucket = (2.0 * ratio.log2()).ceil() as usize;
        if let Some(bucket) = self.0.get(bucket) {
            bucket.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// How many there were of each.
    pub(super) fn counts(&self) -> Vec<u64> {
        self.0.iter().map(|count| count.load(Ordering::Relaxed)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interval_is_in_the_bucket_whose_bound_is_the_next_above_it() {
        let bounds: Vec<_> = Intervals::bounds().collect();
        for (place, bound) in bounds.iter().enumerate() {
            let intervals = Intervals::default();
            intervals.count(bound.mul_f64(0.99));
            intervals.count(bound.mul_f64(0.72));
            assert_eq!(intervals.counts()[place], 2, "{bound:?}: {:?}", intervals.counts());
        }
        let intervals = Intervals::default();
        intervals.count(Duration::ZERO);
        intervals.count(Duration::from_secs(100));
        assert_eq!(intervals.counts().iter().sum::<u64>(), 1, "an absence is not an interval");
        assert!(bounds.last().is_some_and(|last| (Duration::from_secs(4)..Duration::from_secs(5)).contains(last)));
    }
}
