//! What is known of the other computers.
//!
//! Invariant: a host is present while states arrive: its token falling, or a lease without a state, makes all its sensors
//! absent, and what was known of its clock is forgotten.

use std::collections::{BTreeSet, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rapid_core::time::Stamp;

use crate::clock::{Clock, Estimate};

/// More computers than one rig has.
const MOST: usize = 32;

/// See the module's comment.
#[derive(Debug)]
pub struct Hosts {
    lease: Duration,
    known: Mutex<HashMap<String, Host>>,
}

#[derive(Debug, Default)]
struct Host {
    /// When the last state came, while it is present.
    state: Option<Stamp>,
    sensors: BTreeSet<String>,
    clock: Clock,
}

/// Why a sensor cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Absent {
    /// Nothing comes from the computer.
    #[error("nothing comes from that computer")]
    Host,
    /// Its mask has no bit of it.
    #[error("it is not plugged in there, or has another name there")]
    Sensor,
    /// No exchange yet.
    #[error("its clock is not known yet")]
    Clock,
}

impl Hosts {
    /// A computer from which nothing came for `lease` is absent.
    pub fn new(lease: Duration) -> Self {
        Self { lease, known: Mutex::new(HashMap::new()) }
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<String, Host>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A state of a host came.
    pub fn state(&self, host: &str, sensors: BTreeSet<String>, now: Stamp) {
        let mut known = self.lock();
        if known.len() >= MOST && !known.contains_key(host) {
            // One that is absent makes room.
            let absent = known.iter().find(|(_, entry)| entry.state.is_none()).map(|(name, _)| name.clone());
            let Some(absent) = absent else { return };
            known.remove(&absent);
        }
        let entry = known.entry(host.to_owned()).or_default();
        if entry.sensors != sensors || entry.state.is_none() {
            tracing::info!("{host} has {}", if sensors.is_empty() { "no sensor".to_owned() } else { list(&sensors) });
        }
        (entry.state, entry.sensors) = (Some(now), sensors);
    }

    /// Its token fell.
    pub fn gone(&self, host: &str) {
        if let Some(entry) = self.lock().get_mut(host) {
            entry.end(host, "it ended");
        }
    }

    /// Looks for hosts whose lease is over.
    pub fn look(&self, now: Stamp) {
        for (host, entry) in self.lock().iter_mut() {
            if entry.state.is_some_and(|state| now.since(state) >= self.lease) {
                entry.end(host, "nothing came from it");
            }
        }
    }

    /// The hosts that are present, with the number of exchanges with each.
    pub fn present(&self) -> Vec<(String, usize)> {
        let known = self.lock();
        let present = known.iter().filter(|(_, entry)| entry.state.is_some());
        present.map(|(host, entry)| (host.clone(), entry.clock.exchanges())).collect()
    }

    /// An exchange with a host; see [`Clock::exchange`].
    pub fn exchange(&self, host: &str, sent: Stamp, there: u64, received: Stamp) {
        if let Some(entry) = self.lock().get_mut(host).filter(|entry| entry.state.is_some()) {
            entry.clock.exchange(sent.0, there, received.0);
        }
    }

    /// The clock of a host, if the sensor is present there.
    pub fn sensor(&self, host: &str, device: &str, now: Stamp) -> Result<Estimate, Absent> {
        let known = self.lock();
        let entry = known.get(host).filter(|entry| entry.state.is_some()).ok_or(Absent::Host)?;
        if !entry.sensors.contains(device) {
            return Err(Absent::Sensor);
        }
        entry.clock.estimate(now.0).ok_or(Absent::Clock)
    }
}

impl Host {
    fn end(&mut self, host: &str, why: &str) {
        if self.state.take().is_some() {
            tracing::warn!("{host} is absent: {why}");
        }
        self.sensors.clear();
        self.clock.forget();
    }
}

fn list(sensors: &BTreeSet<String>) -> String {
    sensors.iter().map(String::as_str).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_is_present_while_its_states_arrive() {
        let lease = Duration::from_millis(700);
        let (hosts, at) = (Hosts::new(lease), |ms: u64| Stamp(ms * 1_000_000));
        let cam = || BTreeSet::from(["cam".to_owned()]);
        assert_eq!(hosts.sensor("b", "cam", at(0)), Err(Absent::Host));
        hosts.state("b", cam(), at(0));
        assert_eq!(hosts.sensor("b", "cam", at(0)), Err(Absent::Clock));
        assert_eq!(hosts.sensor("b", "other", at(0)), Err(Absent::Sensor));
        hosts.exchange("b", at(0), 0, at(2));
        assert!(hosts.sensor("b", "cam", at(10)).is_ok());
        hosts.look(at(699));
        assert!(hosts.sensor("b", "cam", at(699)).is_ok());
        hosts.look(at(700));
        assert_eq!(hosts.sensor("b", "cam", at(700)), Err(Absent::Host));
        // An answer that was still in transit is of the clock before.
        hosts.exchange("b", at(600), 0, at(701));
        hosts.state("b", cam(), at(800));
        assert_eq!(hosts.sensor("b", "cam", at(800)), Err(Absent::Clock));
        hosts.gone("b");
        assert_eq!((hosts.sensor("b", "cam", at(800)), hosts.present().len()), (Err(Absent::Host), 0));
    }

    #[test]
    fn names_on_the_network_are_bounded() {
        let hosts = Hosts::new(Duration::from_secs(1));
        for number in 0..1000 {
            hosts.state(&format!("h{number}"), BTreeSet::new(), Stamp(1));
        }
        assert_eq!(hosts.present().len(), MOST);
    }
}
