//! One entry that is looked for: from what is heard of its device to the events of its life.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use tokio::sync::mpsc;

use super::super::{HotplugEvent, Witness};
use super::lease::{Change, Lease};
use super::link::Link;
use crate::registry::{Attachment, DeviceNode, Heard, LanIdentity, Unit};
use crate::time::Stamp;

/// How often leases and links are looked at: a link that is down is seen this late.
pub(super) const LOOK_EVERY: Duration = Duration::from_millis(100);

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Watch {
    entry: String,
    length: Duration,
    /// How much longer the lease is until the driver has heard of the device.
    grace: Duration,
    lease: Lease,
    /// What the driver hears.
    heard: Heard,
    link: Link,
    /// Where the device is, while it is there.
    address: Option<SocketAddr>,
    events: mpsc::Sender<HotplugEvent>,
}

impl Watch {
    pub(super) fn new(entry: &str, length: Duration, events: mpsc::Sender<HotplugEvent>) -> Self {
        Self {
            entry: entry.to_owned(),
            length,
            grace: Duration::ZERO,
            lease: Lease::new(length),
            heard: Heard::default(),
            link: Link::default(),
            address: None,
            events,
        }
    }

    /// Its driver alone can hear it, and may be started this much later.
    pub(super) const fn waits(mut self, grace: Duration) -> Self {
        self.grace = grace;
        self
    }

    pub(super) fn entry(&self) -> &str {
        &self.entry
    }

    pub(super) const fn length(&self) -> Duration {
        self.length
    }

    /// Where it is, while it is there.
    pub(super) const fn address(&self) -> Option<SocketAddr> {
        self.address
    }

    pub(super) const fn is_there(&self) -> bool {
        self.lease.is_there()
    }

    /// The link that leads, or led, to it.
    pub(super) fn link(&self) -> Link {
        self.link.clone()
    }

    /// What its driver hears.
    pub(super) fn heard(&self) -> Heard {
        self.heard.clone()
    }

    /// Has the driver heard of it within this time?
    pub(super) fn is_sending(&self, within: Duration, now: Stamp) -> bool {
        self.is_there() && now.since(self.heard.at()) < within
    }

    /// It was heard of at this address.
    pub(super) async fn found(&mut self, address: SocketAddr, instance: Option<&str>, when: Stamp) {
        let came = self.lease.heard(when) == Some(Change::Came);
        if !self.is_there() || (!came && self.address == Some(address)) {
            return;
        }
        // Found at another address, it is told anew: the rig sees that the unit at its path is another.
        self.address = Some(address);
        self.heard = Heard::default();
        self.link = Link::to(address);
        let unit = LanIdentity {
            entry: self.entry.clone(),
            address: address.to_string(),
            instance: instance.map(str::to_owned),
        };
        let node = DeviceNode::Lan { address, heard: self.heard.clone() };
        let attachment = Attachment { syspath: self.syspath(), node, unit: Unit::Lan(unit), driver: None };
        self.tell(HotplugEvent::Added(attachment)).await;
    }

    /// It is known to be gone.
    pub(super) async fn gone(&mut self, witness: Witness, now: Stamp) {
        let change = self.lease.end(now);
        self.went(change, witness, now).await;
    }

    /// It is announced, which holds the lease.
    pub(super) fn renew(&mut self, now: Stamp) {
        if self.is_there() {
            self.lease.heard(now);
        }
    }

    /// Looks at the link and the lease.
    pub(super) async fn look(&mut self, now: Stamp) {
        if !self.is_there() {
            return;
        }
        let heard = self.heard.at();
        self.lease.heard(heard);
        if self.link.is_down() {
            return self.gone(Witness::Link, now).await;
        }
        let grace = if heard == Stamp::default() { self.grace } else { Duration::ZERO };
        let change = self.lease.look(now.before(grace));
        self.went(change, Witness::Lease, now).await;
    }

    async fn went(&mut self, change: Option<Change>, witness: Witness, now: Stamp) {
        if change == Some(Change::Went) {
            self.address = None;
            let removed = HotplugEvent::Removed { syspath: self.syspath(), witnessed: now, witness };
            self.tell(removed).await;
        }
    }

    async fn tell(&self, event: HotplugEvent) {
        // The rig reads until it ends, and this with it.
        let _ = self.events.send(event).await;
    }

    #[cfg(test)]
    pub(super) fn lead_over(&mut self, link: Link) {
        self.link = link;
    }

    fn syspath(&self) -> PathBuf {
        PathBuf::from("/lan").join(&self.entry)
    }
}
