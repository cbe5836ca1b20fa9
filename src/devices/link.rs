//! Network links: whether an interface of this machine has a carrier.
//!
//! The interface that leads to an address is that of the most specific route (`/proc/net/route`, `/proc/net/ipv6_route`;
//! rules of other tables are not read). A loopback address, and one to which no route leads, has no link that could go
//! down.
//!
//! The state is that of `/sys/class/net/NAME/carrier` (Documentation/ABI/testing/sysfs-class-net), which changes at
//! once; `operstate` follows up to a second later (`linkwatch_schedule_work` of `net/core/link_watch.c`).

use std::cmp::Reverse;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::time::{Interval, MissedTickBehavior, interval};

/// Polling interval of a link: the delay until a lost link is noticed.
pub const LOOK_EVERY: Duration = Duration::from_millis(100);
/// A route that means that there is none (`RTF_REJECT` of `linux/route.h`).
const REJECT: u32 = 0x0200;
const INTERFACES: &str = "/sys/class/net";

/// See the module's comment. The default is a link that cannot go down.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NetworkLink {
    /// The file of its carrier in sysfs.
    carrier: Option<PathBuf>,
}

/// State of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinkState {
    /// It is up, or cannot go down.
    Up,
    /// Nothing is at its other end.
    Down,
    /// The interface is set down, as it is too for a moment while its adapter is being removed.
    Unknown,
    /// There is no such interface any more.
    Gone,
}

impl NetworkLink {
    /// The link of the interface of this name.
    pub fn of_interface(interface: &str) -> Self {
        Self { carrier: Some(Path::new(INTERFACES).join(interface).join("carrier")) }
    }

    /// The link that leads to this address at present.
    pub fn to(address: SocketAddr) -> Self {
        let table = |path: &str| fs::read_to_string(path).unwrap_or_default();
        let interface = match address {
            _ if address.ip().is_loopback() => None,
            // There is such a network on every interface.
            SocketAddr::V6(v6) if v6.ip().is_unicast_link_local() => interface(Path::new(INTERFACES), v6.scope_id()),
            _ => match address.ip().to_canonical() {
                IpAddr::V4(address) => route(&table("/proc/net/route"), address),
                IpAddr::V6(address) => route_v6(&table("/proc/net/ipv6_route"), address),
            },
        };
        interface.filter(|name| name != "lo").map_or_else(Self::default, |name| Self::of_interface(&name))
    }

    /// Its present state.
    pub fn state(&self) -> LinkState {
        let Some(carrier) = &self.carrier else { return LinkState::Up };
        // Into a buffer of its own: it is read between two samples, which do not allocate.
        let mut digit = [0];
        match File::open(carrier).and_then(|mut file| file.read(&mut digit)) {
            Ok(_) if digit == *b"1" => LinkState::Up,
            Ok(_) => LinkState::Down,
            Err(error) if error.kind() == io::ErrorKind::NotFound => LinkState::Gone,
            Err(_) => LinkState::Unknown,
        }
    }

    /// Waits until it is up, or its interface is gone. Cancel-safe.
    pub async fn restored(&self) {
        let mut look = looks();
        while matches!(self.state(), LinkState::Down | LinkState::Unknown) {
            look.tick().await;
        }
    }
}

/// A link that is watched beside a stream: waiting for it again and again costs nothing between two looks.
#[derive(Debug)]
pub struct LinkWatch {
    link: NetworkLink,
    look: Interval,
}

impl LinkWatch {
    /// Watches this link.
    pub fn new(link: NetworkLink) -> Self {
        Self { link, look: looks() }
    }

    /// Waits until it is down. Cancel-safe.
    pub async fn lost(&mut self) {
        if self.link.carrier.is_none() {
            return std::future::pending().await;
        }
        loop {
            self.look.tick().await;
            if self.link.state() == LinkState::Down {
                return;
            }
        }
    }
}

fn looks() -> Interval {
    let mut look = interval(LOOK_EVERY);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    look
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
mod tests {
    use tokio::time::timeout;

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
    fn a_loopback_address_has_no_link_that_goes_down() {
        assert_eq!(NetworkLink::to(([127, 0, 0, 1], 80).into()), NetworkLink::default());
        assert_eq!(NetworkLink::default().state(), LinkState::Up);
        assert_eq!(NetworkLink::of_interface("no-such-interface").state(), LinkState::Gone);
        assert_eq!(NetworkLink::of_interface("lo").state(), LinkState::Up);
    }

    #[tokio::test]
    async fn changes_of_a_link_are_waited_for() {
        let folder = tempfile::tempdir().expect("a folder");
        let report = |carrier: &str| fs::write(folder.path().join("carrier"), carrier).expect("written");
        let link = NetworkLink { carrier: Some(folder.path().join("carrier")) };
        let is_lost = async || timeout(3 * LOOK_EVERY, LinkWatch::new(link.clone()).lost()).await.is_ok();
        let is_restored = async || timeout(3 * LOOK_EVERY, link.restored()).await.is_ok();

        report("0\n");
        assert!(link.state() == LinkState::Down && is_lost().await && !is_restored().await);
        report("1\n");
        assert!(link.state() == LinkState::Up && !is_lost().await && is_restored().await);
        // As of an interface that is set down: the file is there and cannot be read.
        fs::remove_file(folder.path().join("carrier")).expect("removed");
        fs::create_dir(folder.path().join("carrier")).expect("a folder");
        assert!(link.state() == LinkState::Unknown && !is_lost().await && !is_restored().await);
        // The adapter is unplugged meanwhile.
        fs::remove_dir(folder.path().join("carrier")).expect("removed");
        assert!(link.state() == LinkState::Gone && !is_lost().await && is_restored().await);
    }
}
