//! Devices that announce a service (mDNS, RFC 6762; DNS-SD, RFC 6763).
//!
//! The library keeps announcements until they expire, by default after two minutes. So a device from which its driver
//! receives nothing is queried again once per lease and a pause (RFC 6762, 10.4), and one that does not answer by the end of the
//! lease after its query is reported as removed. The library reports a missing answer, maybe late, and a goodbye with the same event:
//! a device from which the driver received nothing for a lease is gone by lease; of one that sends, only a report at the end of a
//! query's lease is about a missing answer, and does not count. A goodbye is reported after one second: the library follows RFC
//! 6762, 10.1, which gives another host that time to object. What else the library takes for the end of an announcement (its
//! interface goes away, the machine's clock is set forward, it is not renewed in time) counts as a goodbye. mdns-sd 0.21 cannot
//! query again an instance with a dot in its name: such a device is gone when it sends a goodbye, when its driver receives nothing
//! more, or after two minutes.
//!
//! Invariant: only names and numbers of an announcement are used, each bounded.

use std::collections::BTreeMap;
use std::future::Future;
use std::net::{IpAddr, SocketAddr, SocketAddrV6};
use std::time::Duration;

use mdns_sd::{Receiver, ResolvedService, ScopedIp, ServiceDaemon, ServiceEvent, ServiceInfo};
use rapid_core::time::Stamp;
use rapid_registry::LanSpec;
use tokio::time::{MissedTickBehavior, interval};

use super::super::UnplugSource;
use super::watch::Watch;
use crate::link::{LOOK_EVERY, LinkState, NetworkLink};

/// More devices of one service than a rig has.
const MOST_INSTANCES: usize = 64;
/// Maximum number of addresses of an instance that are used.
const MOST_ADDRESSES: usize = 8;
/// The name of an instance has at most 63 bytes (RFC 6763, 4.1.1).
const LONGEST_NAME: usize = 63;
/// The library reports a missing answer at the end of the lease, at most this much earlier by our clock; earlier only if the
/// announcement itself expires in the lease, which needs a lease of more than 24 s (a fifth of two minutes).
const MARGIN: Duration = Duration::from_millis(100);
/// From the end of a lease to the next query, or a third of the lease if that is shorter. A report that is later, about a device that
/// sends again, is taken for a goodbye.
const PAUSE: Duration = Duration::from_secs(1);
/// The service that the phone app searches for, to know where to connect.
const VIO_SERVER: &str = "_vioserver._tcp.local.";

/// The mDNS thread, which ends when this is dropped.
pub(super) struct Browser {
    daemon: ServiceDaemon,
}

/// An entry that is found by its service.
#[derive(Debug)]
pub(super) struct Wanted {
    watch: Watch,
    /// Only the instance of this name matches.
    instance: Option<String>,
    /// The port at which the device is reached, if not the announced one.
    port: Option<u16>,
    /// The instance that is the entry's device now.
    current: Option<String>,
    /// Since when it is.
    since: Stamp,
    /// When the device was queried again.
    asked: Option<Stamp>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct AnnouncedDevice {
    /// Its own name, without the service's.
    name: String,
    /// At least one; the best first.
    addresses: Vec<SocketAddr>,
}

impl Browser {
    /// `phones` are the local ports that phones connect to; they are announced.
    pub(super) fn open(phones: &[u16]) -> Option<Self> {
        let daemon = match ServiceDaemon::new() {
            Ok(daemon) => daemon,
            Err(error) => {
                tracing::error!(%error, "devices that announce themselves are not found: mDNS is not available");
                return None;
            }
        };
        for port in phones {
            if let Err(error) = announce(&daemon, *port) {
                tracing::error!(%error, port, "phones cannot find this machine");
            }
        }
        Some(Self { daemon })
    }

    /// Tracks the entries of a service.
    pub(super) fn watch(&self, service: &str, wanted: Vec<Wanted>) -> impl Future<Output = ()> + use<> {
        let domain = format!("{service}.local.");
        let daemon = self.daemon.clone();
        async move {
            match daemon.browse(&domain) {
                Ok(events) => {
                    Service { domain, wanted, known: BTreeMap::new(), cut: BTreeMap::new() }.run(&daemon, events).await;
                }
                Err(error) => tracing::error!(%error, service = domain, "devices of this service are not found"),
            }
        }
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // Sends a goodbye for the announced services, without waiting for it.
        let _ = self.daemon.shutdown();
    }
}

impl Wanted {
    pub(super) fn new(watch: Watch, instance: Option<String>, lan: &LanSpec) -> Self {
        Self { watch, instance, port: lan.port(), current: None, since: Stamp::default(), asked: None }
    }
}

/// The entries of one service, and its announced instances.
struct Service {
    domain: String,
    wanted: Vec<Wanted>,
    /// Announced instances, by full name.
    known: BTreeMap<String, AnnouncedDevice>,
    /// Instances whose link went down, with that link: they are reported again when it is up. The library reports
    /// nothing then, because their announcements have not changed.
    cut: BTreeMap<String, NetworkLink>,
}

impl Service {
    async fn run(mut self, daemon: &ServiceDaemon, events: Receiver<ServiceEvent>) {
        let mut look = interval(LOOK_EVERY);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                event = events.recv_async() => match event {
                    Ok(ServiceEvent::ServiceResolved(service)) => {
                        if let Some((full, found)) = found(&service, &self.domain) {
                            self.announced(full, found, Stamp::now()).await;
                        }
                    }
                    Ok(ServiceEvent::ServiceRemoved(_, full)) => self.removed(&full, Stamp::now()).await,
                    Ok(_) => {}
                    Err(_) => {
                        tracing::error!(service = self.domain, "mDNS ended: devices of this service are not found any more");
                        return;
                    }
                },
                _ = look.tick() => for (full, limit) in self.check(Stamp::now()).await {
                    // Refused only while the library is busy; queried again a lease later.
                    let _ = daemon.verify(full, limit);
                },
            }
        }
    }

    async fn announced(&mut self, full: String, found: AnnouncedDevice, now: Stamp) {
        if self.known.len() >= MOST_INSTANCES && !self.known.contains_key(&full) {
            return;
        }
        self.cut.remove(&full);
        self.known.insert(full, found);
        self.assign(now).await;
    }

    /// Assigns the known instances to the entries, one each.
    async fn assign(&mut self, now: Stamp) {
        for index in 0..self.wanted.len() {
            let Some(wanted) = self.wanted.get(index) else { continue };
            // Its announcement expired, but its driver receives from it.
            let is_kept = |full: &String| wanted.watch.is_there() && !self.known.contains_key(full);
            if wanted.current.as_ref().is_some_and(is_kept) {
                continue;
            }
            let full = wanted.current.clone().filter(|full| self.known.contains_key(full)).or_else(|| {
                let is_free = |full: &&String| {
                    !self.cut.contains_key(*full)
                        && !self.wanted.iter().any(|other| other.current.as_ref() == Some(full))
                };
                let names = |wanted: &Wanted, found: &AnnouncedDevice| {
                    wanted.instance.as_ref().is_some_and(|name| name.eq_ignore_ascii_case(&found.name))
                };
                // An instance that another entry names belongs to that entry, even if it is announced first.
                let fits = |found: &AnnouncedDevice| match wanted.instance {
                    Some(_) => names(wanted, found),
                    None => !self.wanted.iter().any(|other| names(other, found)),
                };
                self.known.iter().filter(|(_, found)| fits(found)).map(|(full, _)| full).find(is_free).cloned()
            });
            let Some(found) = full.as_ref().and_then(|full| self.known.get(full)) else { continue };
            let at = |address: &SocketAddr| {
                let mut address = *address;
                address.set_port(wanted.port.unwrap_or(address.port()));
                address
            };
            // Announcements come in parts: an address that is good enough is kept, as is one that the driver receives from.
            let is_good = |kept: &SocketAddr| {
                found.addresses.iter().any(|found| at(found) == *kept)
                    || wanted.watch.is_sending(wanted.watch.length, now)
            };
            let kept = wanted.watch.address.filter(is_good);
            let Some(address) = kept.or_else(|| found.addresses.first().map(at)) else { continue };
            let Some(wanted) = self.wanted.get_mut(index) else { continue };
            // One that is announced again keeps its query: the library may still report that no answer came.
            if wanted.current != full || wanted.watch.address != Some(address) {
                (wanted.since, wanted.asked) = (now, None);
            }
            wanted.current = full;
            wanted.watch.found(address, Some(&found.name), now).await;
        }
    }

    async fn removed(&mut self, full: &str, now: Stamp) {
        self.known.remove(full);
        self.cut.remove(full);
        for wanted in self.wanted.iter_mut().filter(|wanted| wanted.current.as_deref() == Some(full)) {
            let source = wanted.source(now);
            wanted.asked = None;
            // Announcements get lost on wireless links; the driver's reception is better evidence.
            if source == UnplugSource::Lease && wanted.watch.is_sending(wanted.watch.length, now) {
                tracing::debug!(
                    device = wanted.watch.entry,
                    "its announcement expired, but its driver receives from it"
                );
                continue;
            }
            wanted.current = None;
            wanted.watch.gone(source, now).await;
        }
        self.assign(now).await;
    }

    /// Checks leases and links; returns which instances must be queried again, and how long they have.
    async fn check(&mut self, now: Stamp) -> Vec<(String, Duration)> {
        let mut questions = Vec::new();
        for wanted in &mut self.wanted {
            let length = wanted.watch.length;
            let announced = wanted.current.as_ref().and_then(|full| self.known.get_key_value(full));
            if let (Some((full, found)), true) = (announced, wanted.watch.is_there()) {
                let is_due = wanted.asked.is_none_or(|asked| now.since(asked) >= length + pause(length));
                // See the module's comment.
                let can_be_asked = !found.name.contains(['.', '\\']);
                if is_due && can_be_asked && !wanted.watch.is_sending(length, now) {
                    questions.push((full.clone(), length));
                    wanted.asked = Some(now);
                }
                wanted.watch.renew(now);
            }
            wanted.watch.check(now).await;
            if wanted.watch.is_there() {
                continue;
            }
            let Some(full) = wanted.current.take() else { continue };
            if self.known.contains_key(&full) {
                self.cut.insert(full, wanted.watch.link.clone());
            }
        }
        self.cut.retain(|_, link| link.state() != LinkState::Up);
        // Another instance or address may wait for what was kept while the driver received from it.
        self.assign(now).await;
        questions
    }
}

impl Wanted {
    /// The evidence that its device is gone: a missing answer, or a goodbye. See the module's comment.
    fn source(&self, now: Stamp) -> UnplugSource {
        let (lease, received) = (self.watch.length, self.watch.last_received.at());
        let was_silent = now.since(self.since.max(received)) >= lease;
        let is_about_it = |waited: Duration| waited + MARGIN >= lease && waited <= lease + pause(lease);
        if was_silent || self.asked.is_some_and(|asked| is_about_it(now.since(asked))) {
            UnplugSource::Lease
        } else {
            UnplugSource::Goodbye
        }
    }
}

fn pause(lease: Duration) -> Duration {
    PAUSE.min(lease / 3)
}

fn found(service: &ResolvedService, domain: &str) -> Option<(String, AnnouncedDevice)> {
    let name = service.fullname.strip_suffix(domain)?.strip_suffix('.')?;
    let addresses = ordered(service.addresses.iter().filter_map(scoped), service.port);
    (!addresses.is_empty()).then(|| (service.fullname.clone(), AnnouncedDevice { name: unescaped(name), addresses }))
}

/// An address, with the scope that a link-local one needs. Of this computer's own addresses only those announced on it:
/// no other entry has a device there.
fn scoped(ip: &ScopedIp) -> Option<(IpAddr, u32)> {
    let is_own = match ip {
        ScopedIp::V4(v4) => v4.interface_ids().iter().any(|interface| interface.name == "lo"),
        ScopedIp::V6(v6) => v6.scope_id().name == "lo",
        _ => false,
    };
    if ip.is_loopback() && !is_own {
        return None;
    }
    Some(match ip {
        ScopedIp::V6(v6) if v6.addr().is_unicast_link_local() => ((*v6.addr()).into(), v6.scope_id().index),
        ip => (ip.to_ip_addr(), 0),
    })
}

/// Remote addresses before our own, IPv4 first, then those that need no scope, then the rest; in numeric order, so that
/// the choice is the same each time.
fn ordered(addresses: impl Iterator<Item = (IpAddr, u32)>, port: u16) -> Vec<SocketAddr> {
    let mut usable: Vec<_> = addresses.filter(|(ip, _)| !ip.is_unspecified() && !ip.is_multicast()).collect();
    usable.sort_by_key(|(ip, scope)| (ip.is_loopback(), ip.is_ipv6(), *scope, *ip));
    let socket = |(ip, scope)| match ip {
        IpAddr::V4(ip) => (ip, port).into(),
        IpAddr::V6(ip) => SocketAddrV6::new(ip, port, 0, scope).into(),
    };
    usable.into_iter().take(MOST_ADDRESSES).map(socket).collect()
}

/// A label as it is written in DNS: `\.` is a dot, `\065` a byte.
fn unescaped(label: &str) -> String {
    let mut name = Vec::new();
    let mut rest = label.as_bytes();
    while let Some((first, after)) = rest.split_first()
        && name.len() < LONGEST_NAME
    {
        rest = after;
        if *first != b'\\' {
            name.push(*first);
            continue;
        }
        let digits = after.get(..3).and_then(|digits| std::str::from_utf8(digits).ok()?.parse::<u8>().ok());
        if let Some(byte) = digits {
            name.push(byte);
            rest = after.get(3..).unwrap_or_default();
        } else if let Some((escaped, after)) = after.split_first() {
            name.push(*escaped);
            rest = after;
        }
    }
    String::from_utf8_lossy(&name).into_owned()
}

/// Announces to phones where they should connect.
fn announce(daemon: &ServiceDaemon, port: u16) -> mdns_sd::Result<()> {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let legal = |c: &char| c.is_ascii_alphanumeric() || *c == '-';
    let host: String = host.trim().chars().filter(legal).take(LONGEST_NAME).collect();
    let host = if host.is_empty() { "rapid".to_owned() } else { host };
    let (instance, server) = (format!("rapid on {host} {port}"), format!("{host}.local."));
    let info = ServiceInfo::new(VIO_SERVER, &instance, &server, "", port, &[("node_name", "rapid")][..])?;
    daemon.register(info.enable_addr_auto())
}

/// The resulting name is bounded, whatever the label is.
pub(super) fn fuzz(label: &str) {
    assert!(unescaped(label).len() <= 3 * LONGEST_NAME, "a name of an instance is too long");
}

#[cfg(test)]
mod tests;
