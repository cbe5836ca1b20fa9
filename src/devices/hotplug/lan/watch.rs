//! One entry that is searched for: from what is received of its device to the events of its life.
//!
//! Nothing on a network reports that a cable was pulled. A device from which something was received within the lease is
//! present; otherwise it is gone, unless better evidence came before: a goodbye, or the link.
//!
//! Invariant: a lease is pure; each change is reported once, arrivals and departures alternating.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::device::{Attachment, DeviceNode, LanIdentity, LastReceived, Unit};
use tokio::sync::mpsc;

use super::super::{HotplugEvent, UnplugSource};
use crate::link::{LinkState, NetworkLink};

#[derive(Debug)]
pub(super) struct Watch {
    pub(super) entry: String,
    pub(super) length: Duration,
    /// Extension of the lease until the driver has received from the device.
    grace: Duration,
    lease: Lease,
    pub(super) last_received: LastReceived,
    pub(super) link: NetworkLink,
    /// The address of the device, while it is present.
    pub(super) address: Option<SocketAddr>,
    events: mpsc::Sender<HotplugEvent>,
}

impl Watch {
    pub(super) fn new(entry: &str, length: Duration, events: mpsc::Sender<HotplugEvent>) -> Self {
        Self {
            entry: entry.to_owned(),
            length,
            grace: Duration::ZERO,
            lease: Lease::new(length),
            last_received: LastReceived::default(),
            link: NetworkLink::default(),
            address: None,
            events,
        }
    }

    /// For a device that only its driver can receive from, and whose driver may start this much later.
    pub(super) const fn waits(mut self, grace: Duration) -> Self {
        self.grace = grace;
        self
    }

    pub(super) const fn is_there(&self) -> bool {
        self.lease.is_there()
    }

    /// Whether the driver has received from the device within this time.
    pub(super) fn is_sending(&self, within: Duration, now: Stamp) -> bool {
        self.is_there() && now.since(self.last_received.at()) < within
    }

    /// Something was received from the device at this address.
    pub(super) async fn found(&mut self, address: SocketAddr, instance: Option<&str>, when: Stamp) {
        let came = self.lease.received(when) == Some(Change::Came);
        if !self.is_there() || (!came && self.address == Some(address)) {
            return;
        }
        // A new address is reported again, so that the rig sees another unit at its path.
        self.address = Some(address);
        self.last_received = LastReceived::default();
        self.link = NetworkLink::to(address);
        let unit = LanIdentity {
            entry: self.entry.clone(),
            address: address.to_string(),
            instance: instance.map(str::to_owned),
        };
        let node = DeviceNode::Lan { address, last_received: self.last_received.clone() };
        let attachment =
            Attachment { syspath: self.syspath(), node, unit: Unit::Lan(unit), driver: None, formats: Vec::new() };
        self.notify(HotplugEvent::Added(attachment)).await;
    }

    /// The device is known to be gone.
    pub(super) async fn gone(&mut self, source: UnplugSource, now: Stamp) {
        let change = self.lease.end(now);
        self.went(change, source, now).await;
    }

    /// The device announced itself, which renews the lease.
    pub(super) fn renew(&mut self, now: Stamp) {
        if self.is_there() {
            self.lease.received(now);
        }
    }

    /// Checks the link and the lease.
    pub(super) async fn check(&mut self, now: Stamp) {
        if !self.is_there() {
            return;
        }
        let received = self.last_received.at();
        self.lease.received(received);
        if self.link.state() != LinkState::Up {
            return self.gone(UnplugSource::Link, now).await;
        }
        let grace = if received == Stamp::default() { self.grace } else { Duration::ZERO };
        let change = self.lease.check(now.before(grace));
        self.went(change, UnplugSource::Lease, now).await;
    }

    async fn went(&mut self, change: Option<Change>, source: UnplugSource, now: Stamp) {
        if change == Some(Change::Went) {
            self.address = None;
            let removed = HotplugEvent::Removed { syspath: self.syspath(), noticed: now, source };
            self.notify(removed).await;
        }
    }

    async fn notify(&self, event: HotplugEvent) {
        // The rig reads until it ends, and so does this.
        let _ = self.events.send(event).await;
    }

    #[cfg(test)]
    pub(super) fn lead_over(&mut self, link: NetworkLink) {
        self.link = link;
    }

    fn syspath(&self) -> PathBuf {
        PathBuf::from("/lan").join(&self.entry)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Change {
    Came,
    Went,
}

#[derive(Debug, Clone, Copy)]
struct Lease {
    length: Duration,
    /// When something was last received from the device, while it is present.
    received: Option<Stamp>,
    /// Anything older is not evidence: the device was reported gone after it.
    gone: Stamp,
}

impl Lease {
    fn new(length: Duration) -> Self {
        Self { length, received: None, gone: Stamp::default() }
    }

    const fn is_there(&self) -> bool {
        self.received.is_some()
    }

    /// Something was received from the device at `when`.
    fn received(&mut self, when: Stamp) -> Option<Change> {
        let came = self.received.is_none();
        if came && when < self.gone {
            return None;
        }
        self.received = self.received.max(Some(when));
        came.then_some(Change::Came)
    }

    /// When the lease ends if nothing more is received; `None` while the device is absent.
    fn ends(&self) -> Option<Stamp> {
        Some(self.received?.after(self.length))
    }

    /// Checks whether the lease is over.
    fn check(&mut self, now: Stamp) -> Option<Change> {
        if self.ends()? > now { None } else { self.end(now) }
    }

    /// The device is known to be gone.
    fn end(&mut self, now: Stamp) -> Option<Change> {
        self.received.take()?;
        self.gone = now;
        Some(Change::Went)
    }
}

#[cfg(test)]
mod tests;
