//! The link that leads to an address: which interface, and is it up?
//!
//! The interface is that of the most special route (`/proc/net/route`, `/proc/net/ipv6_route`), its state
//! the one of RFC 2863 that the kernel keeps in `/sys/class/net/NAME/operstate`. An address of our own, and
//! one to which no route leads, has no link that could go down.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::path::Path;

/// See the module's comment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Link(Option<String>);

impl Link {
    /// The link that leads to this address now.
    pub(super) fn to(address: IpAddr) -> Self {
        let table = match address {
            IpAddr::V4(_) => "/proc/net/route",
            IpAddr::V6(_) => "/proc/net/ipv6_route",
        };
        let table = std::fs::read_to_string(table).unwrap_or_default();
        let interface = match address {
            _ if address.is_loopback() => None,
            IpAddr::V4(address) => route(&table, address),
            IpAddr::V6(address) => route_v6(&table, address),
        };
        Self(interface.filter(|name| *name != "lo").map(str::to_owned))
    }

    /// Is it down, or gone?
    pub(super) fn is_down(&self) -> bool {
        let Some(name) = &self.0 else { return false };
        let state = std::fs::read_to_string(Path::new("/sys/class/net").join(name).join("operstate"));
        state.map_or(true, |state| is_down(state.trim()))
    }
}

/// `unknown` is what drivers say that do not watch their carrier: loopback, some USB adapters.
fn is_down(state: &str) -> bool {
    matches!(state, "down" | "lowerlayerdown" | "notpresent" | "dormant")
}

/// The interface of the route with the longest mask: lines of name, destination, gateway, flags, three
/// counts, mask, in hexadecimal of the machine's byte order.
fn route(table: &str, address: Ipv4Addr) -> Option<&str> {
    let number = |text: &str| u32::from_str_radix(text, 16).ok().map(u32::from_be);
    let fitting = table.lines().skip(1).filter_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [name, destination, _, _, _, _, _, mask, ..] = fields.as_slice() else { return None };
        let (destination, mask) = (number(destination)?, number(mask)?);
        (u32::from(address) & mask == destination).then_some((mask, *name))
    });
    fitting.max_by_key(|(mask, _)| *mask).map(|(_, name)| name)
}

/// The same for IPv6: destination, its length in hexadecimal, ..., name.
fn route_v6(table: &str, address: Ipv6Addr) -> Option<&str> {
    let fitting = table.lines().filter_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [destination, length, .., name] = fields.as_slice() else { return None };
        let (destination, length) =
            (u128::from_str_radix(destination, 16).ok()?, u32::from_str_radix(length, 16).ok()?);
        let mask = u128::MAX.checked_shl(128_u32.checked_sub(length)?).unwrap_or(0);
        // The table ends in a route to nowhere, on `lo`.
        (u128::from(address) & mask == destination && *name != "lo").then_some((length, *name))
    });
    fitting.max_by_key(|(length, _)| *length).map(|(_, name)| name)
}

#[cfg(test)]
mod tests {
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
            assert_eq!(route(V4, address.into()), Some(expected), "{address:?}");
        }
        assert_eq!(route("", [1, 2, 3, 4].into()), None);
        assert_eq!(route_v6(V6, "fd00::7".parse().expect("an address")), Some("eth0"));
        assert_eq!(route_v6(V6, "2001:db8::7".parse().expect("an address")), None);
    }

    #[test]
    fn our_own_address_has_no_link_that_goes_down() {
        assert_eq!(Link::to([127, 0, 0, 1].into()), Link(None));
        assert!(!Link::to([127, 0, 0, 1].into()).is_down());
        assert!(Link(Some("no-such-interface".to_owned())).is_down());
        assert!(!Link(Some("lo".to_owned())).is_down(), "what does not watch its carrier is up");
    }
}
