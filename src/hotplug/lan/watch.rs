//! One entry that is looked for: from what is received of its device to the events of its life.
//!
//! Nothing on a network reports that a cable was pulled. What was received from within the lease is
//! there; what was not is gone, unless there was better evidence before: a goodbye, or the link.
//!
//! The interface that leads to an address is that of the most special route (`/proc/net/route`, `/proc/net/ipv6_route`),
//! its state the one of RFC 2863 that the kernel keeps in `/sys/class/net/NAME/operstate`. An address of our own, and
//! one to which no route leads, has no link that could go down.
//!
//! Invariant: a lease is pure; each change is reported once, arrivals and departures in turn.

use std::cmp::Reverse;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::sync::mpsc;

use super::super::{HotplugEvent, UnplugSource};
use crate::registry::{Attachment, DeviceNode, LanIdentity, LastReceived, Unit};
use crate::time::Stamp;

/// How often leases and links are looked at: a link that is down is seen this late.
pub(super) const LOOK_EVERY: Duration = Duration::from_millis(100);

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Watch {
    pub(super) entry: String,
    pub(super) length: Duration,
    /// How much longer the lease is until the driver has received from the device.
    grace: Duration,
    lease: Lease,
    /// What the driver receives.
    pub(super) last_received: LastReceived,
    pub(super) link: Link,
    /// Where the device is, while it is there.
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
            link: Link::default(),
            address: None,
            events,
        }
    }

    /// Its driver alone can receive from it, and may be started this much later.
    pub(super) const fn waits(mut self, grace: Duration) -> Self {
        self.grace = grace;
        self
    }

    pub(super) const fn is_there(&self) -> bool {
        self.lease.is_there()
    }

    /// Has the driver received from it within this time?
    pub(super) fn is_sending(&self, within: Duration, now: Stamp) -> bool {
        self.is_there() && now.since(self.last_received.at()) < within
    }

    /// It was received from at this address.
    pub(super) async fn found(&mut self, address: SocketAddr, instance: Option<&str>, when: Stamp) {
        let came = self.lease.received(when) == Some(Change::Came);
        if !self.is_there() || (!came && self.address == Some(address)) {
            return;
        }
        // Found at another address, it is reported again: the rig sees that the unit at its path is another.
        self.address = Some(address);
        self.last_received = LastReceived::default();
        self.link = Link::to(address);
        let unit = LanIdentity {
            entry: self.entry.clone(),
            address: address.to_string(),
            instance: instance.map(str::to_owned),
        };
        let node = DeviceNode::Lan { address, last_received: self.last_received.clone() };
        let attachment = Attachment { syspath: self.syspath(), node, unit: Unit::Lan(unit), driver: None };
        self.notify(HotplugEvent::Added(attachment)).await;
    }

    /// It is known to be gone.
    pub(super) async fn gone(&mut self, source: UnplugSource, now: Stamp) {
        let change = self.lease.end(now);
        self.went(change, source, now).await;
    }

    /// It is announced, which holds the lease.
    pub(super) fn renew(&mut self, now: Stamp) {
        if self.is_there() {
            self.lease.received(now);
        }
    }

    /// Looks at the link and the lease.
    pub(super) async fn look(&mut self, now: Stamp) {
        if !self.is_there() {
            return;
        }
        let received = self.last_received.at();
        self.lease.received(received);
        if self.link.is_down() {
            return self.gone(UnplugSource::Link, now).await;
        }
        let grace = if received == Stamp::default() { self.grace } else { Duration::ZERO };
        let change = self.lease.look(now.before(grace));
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

/// A change that was noticed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Change {
    /// It is there.
    Came,
    /// It is not there any more.
    Went,
}

/// See the module's comment.
#[derive(Debug, Clone, Copy)]
struct Lease {
    length: Duration,
    /// When it was last received from, while it is there.
    received: Option<Stamp>,
    /// What is older than this is no evidence: it was reported gone after that.
    gone: Stamp,
}

impl Lease {
    fn new(length: Duration) -> Self {
        Self { length, received: None, gone: Stamp::default() }
    }

    const fn is_there(&self) -> bool {
        self.received.is_some()
    }

    /// Something of it was received at `when`.
    fn received(&mut self, when: Stamp) -> Option<Change> {
        let came = self.received.is_none();
        if came && when < self.gone {
            return None;
        }
        self.received = self.received.max(Some(when));
        came.then_some(Change::Came)
    }

    /// When the lease ends if nothing more is received; never while it is not there.
    fn ends(&self) -> Option<Stamp> {
        Some(self.received?.after(self.length))
    }

    /// Is the lease over?
    fn look(&mut self, now: Stamp) -> Option<Change> {
        if self.ends()? > now { None } else { self.end(now) }
    }

    /// It is known to be gone.
    fn end(&mut self, now: Stamp) -> Option<Change> {
        self.received.take()?;
        self.gone = now;
        Some(Change::Went)
    }
}

/// A route that means that there is none (`RTF_REJECT` of `linux/route.h`).
const REJECT: u32 = 0x0200;
const INTERFACES: &str = "/sys/class/net";

/// See the module's comment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Link(Option<String>);

impl Link {
    /// The link that leads to this address now.
    pub(super) fn to(address: SocketAddr) -> Self {
        let table = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
        let interface = match address {
            _ if address.ip().is_loopback() => None,
            // There is such a network on every interface.
            SocketAddr::V6(v6) if v6.ip().is_unicast_link_local() => interface(Path::new(INTERFACES), v6.scope_id()),
            _ => match address.ip().to_canonical() {
                IpAddr::V4(address) => route(&table("/proc/net/route"), address),
                IpAddr::V6(address) => route_v6(&table("/proc/net/ipv6_route"), address),
            },
        };
        Self(interface.filter(|name| name != "lo"))
    }

    /// Is it down, or gone?
    pub(super) fn is_down(&self) -> bool {
        let Some(name) = &self.0 else { return false };
        let state = std::fs::read_to_string(Path::new(INTERFACES).join(name).join("operstate"));
        state.map_or(true, |state| is_down(state.trim()))
    }
}

#[cfg(test)]
impl Link {
    /// One whose state is in a file of this folder.
    pub(super) fn of(folder: &Path) -> Self {
        Self(Some(folder.display().to_string()))
    }
}

/// `unknown` is the answer of drivers that do not watch their carrier: loopback, some USB adapters.
fn is_down(state: &str) -> bool {
    matches!(state, "down" | "lowerlayerdown" | "notpresent" | "dormant")
}

/// The interface of this number, of those in a folder like `/sys/class/net`.
fn interface(folder: &Path, number: u32) -> Option<String> {
    let is_it = |name: &String| {
        let own = std::fs::read_to_string(folder.join(name).join("ifindex"));
        own.is_ok_and(|own| own.trim().parse() == Ok(number))
    };
    let names = std::fs::read_dir(folder).ok()?.flatten();
    names.filter_map(|entry| entry.file_name().into_string().ok()).find(is_it)
}

/// The interface of the route with the longest mask, of several that with the lowest metric, as the kernel chooses:
/// lines of name, destination, gateway, flags, two counts, metric, mask; numbers in hexadecimal, addresses of the
/// machine's byte order, but for the counts and the metric. `*` leads nowhere.
fn route(table: &str, address: Ipv4Addr) -> Option<String> {
    let number = |text: &str| u32::from_str_radix(text, 16).ok();
    let fitting = table.lines().skip(1).filter_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [name, destination, _, flags, _, _, metric, mask, ..] = fields.as_slice() else { return None };
        let (destination, mask) = (u32::from_be(number(destination)?), u32::from_be(number(mask)?));
        let leads = u32::from(address) & mask == destination && *name != "*" && number(flags)? & REJECT == 0;
        leads.then_some(((mask, Reverse(metric.parse::<u32>().ok()?)), *name))
    });
    fitting.max_by_key(|(rank, _)| *rank).map(|(_, name)| name.to_owned())
}

/// The same for IPv6: destination, its length, source, its length, gateway, metric, two counts, flags, name; all numbers
/// in hexadecimal.
fn route_v6(table: &str, address: Ipv6Addr) -> Option<String> {
    let number = |text: &str| u32::from_str_radix(text, 16).ok();
    let fitting = table.lines().filter_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [destination, length, _, _, _, metric, _, _, flags, name] = fields.as_slice() else { return None };
        let (destination, length) = (u128::from_str_radix(destination, 16).ok()?, number(length)?);
        let mask = u128::MAX.checked_shl(128_u32.checked_sub(length)?).unwrap_or(0);
        // The table ends in a route to nowhere, on `lo`.
        let leads = u128::from(address) & mask == destination && *name != "lo" && number(flags)? & REJECT == 0;
        leads.then_some(((length, Reverse(number(metric)?)), *name))
    });
    fitting.max_by_key(|(rank, _)| *rank).map(|(_, name)| name.to_owned())
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod link_tests {
    use super::*;

    const V4: &str = "Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT\n\
        wlan0\t00000000\t010200C0\t0003\t0\t0\t600\t00000000\t0\t0\t0\n\
        eth0\t000200C0\t00000000\t0001\t0\t0\t100\t00FFFFFF\t0\t0\t0\n\
        usb0\t006A18AC\t00000000\t0001\t0\t0\t100\t00FFFFFF\t0\t0\t0\nbroken\n";
    const V6: &str = "fd000000000000000000000000000000 40 00000000000000000000000000000000 00 \
        00000000000000000000000000000000 00000100 00000001 00000000 00000001     eth0\n\
        00000000000000000000000000000000 00 00000000000000000000000000000000 00 \
        00000000000000000000000000000000 ffffffff 00000001 00000000 00200200       lo\n";

    #[test]
    #[cfg(target_endian = "little")]
    fn the_most_special_route_leads_to_an_address() {
        for (address, expected) in
            [([192, 0, 2, 7], "eth0"), ([172, 24, 106, 51], "usb0"), ([8, 8, 8, 8], "wlan0"), ([192, 0, 3, 7], "wlan0")]
        {
            assert_eq!(route(V4, address.into()).as_deref(), Some(expected), "{address:?}");
        }
        assert_eq!(route("", [1, 2, 3, 4].into()), None);
        assert_eq!(route_v6(V6, "fd00::7".parse().expect("an address")).as_deref(), Some("eth0"));
        assert_eq!(route_v6(V6, "2001:db8::7".parse().expect("an address")), None);
    }

    #[test]
    #[cfg(target_endian = "little")]
    fn of_equal_routes_the_one_with_the_lowest_metric_leads() {
        let head = "Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\n";
        let line = |name: &str, flags: &str, metric: u32| {
            format!("{name}\t000200C0\t00000000\t{flags}\t0\t0\t{metric}\t00FFFFFF\t0\t0\t0\n")
        };
        let (eth, wlan) = (line("eth0", "0001", 100), line("wlan0", "0001", 600));
        let (nowhere, refused) = (line("*", "0200", 0), line("eth9", "0201", 1));
        for table in [[&eth, &wlan, &nowhere, &refused], [&refused, &nowhere, &wlan, &eth]] {
            let table = format!("{head}{}", table.map(String::as_str).concat());
            assert_eq!(route(&table, [192, 0, 2, 7].into()).as_deref(), Some("eth0"), "{table}");
        }
        let v6 = |name: &str, metric: &str, flags: &str| {
            let zero = "00000000000000000000000000000000";
            format!("fd000000000000000000000000000000 40 {zero} 00 {zero} {metric} 00000001 00000000 {flags} {name}\n")
        };
        let (eth, wlan) = (v6("eth0", "00000100", "00000001"), v6("wlan0", "00000400", "00000001"));
        let refused = v6("eth9", "00000001", "00000201");
        for table in [[&eth, &wlan, &refused], [&refused, &wlan, &eth]] {
            let address = "fd00::7".parse().expect("an address");
            assert_eq!(route_v6(&table.map(String::as_str).concat(), address).as_deref(), Some("eth0"), "{table:?}");
        }
    }

    #[test]
    fn a_link_local_address_is_behind_the_interface_it_names() {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, number) in [("eth0", "2\n"), ("usb0", "7\n"), ("odd", "x")] {
            std::fs::create_dir(folder.path().join(name)).expect("a folder");
            std::fs::write(folder.path().join(name).join("ifindex"), number).expect("written");
        }
        assert_eq!(interface(folder.path(), 7).as_deref(), Some("usb0"));
        assert_eq!(interface(folder.path(), 0), None);
    }

    #[test]
    fn our_own_address_has_no_link_that_goes_down() {
        assert_eq!(Link::to(([127, 0, 0, 1], 80).into()), Link(None));
        assert!(!Link::to(([127, 0, 0, 1], 80).into()).is_down());
        assert!(Link(Some("no-such-interface".to_owned())).is_down());
        assert!(!Link(Some("lo".to_owned())).is_down(), "what does not watch its carrier is up");
    }
}
