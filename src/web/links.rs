//! The links to the page: one for each address by which others may reach it.

use std::net::{IpAddr, SocketAddr};

use super::token::Token;

/// Beginnings of the names of interfaces that no phone reaches: of containers, virtual machines and bridges.
const INNER: [&str; 8] = ["docker", "br-", "veth", "virbr", "lxc", "cni", "podman", "tun"];

/// The links to a server at `address`, the likeliest first. The token is behind the `#`, which no browser sends.
pub(super) fn links(address: SocketAddr, token: Option<&Token>) -> Vec<String> {
    let own: Vec<_> = if address.ip().is_unspecified() {
        // Without a list of them the machine's own address is left.
        if_addrs::get_if_addrs().unwrap_or_default().into_iter().map(|own| (own.name.clone(), own.ip())).collect()
    } else {
        Vec::new()
    };
    let reached = reached(address.ip(), own);
    let fragment = token.map(|token| format!("#{}", token.text())).unwrap_or_default();
    reached.into_iter().map(|ip| format!("http://{}/{fragment}", SocketAddr::new(ip, address.port()))).collect()
}

/// Which of the machine's addresses a server at `ip` is reached by.
fn reached(ip: IpAddr, own: Vec<(String, IpAddr)>) -> Vec<IpAddr> {
    if !ip.is_unspecified() {
        return vec![ip];
    }
    let is_inner = |name: &str| INNER.iter().any(|inner| name.starts_with(inner));
    // Link-local addresses of IPv6 need the name of an interface of the other side.
    let is_usable = |own: &IpAddr| match own {
        IpAddr::V4(own) => !own.is_loopback(),
        IpAddr::V6(own) => ip.is_ipv6() && !own.is_loopback() && !own.is_unicast_link_local(),
    };
    let mut usable: Vec<_> = own.into_iter().filter(|(_, own)| is_usable(own)).collect();
    // Phones are in the wireless network.
    let rank = |(name, ip): &(String, IpAddr)| (is_inner(name), ip.is_ipv6(), !name.starts_with("wl"));
    usable.sort_by_key(rank);
    let loopback = if ip.is_ipv4() { IpAddr::from([127, 0, 0, 1]) } else { IpAddr::from([0, 0, 0, 0, 0, 0, 0, 1]) };
    let mut addresses: Vec<_> = usable.into_iter().map(|(_, ip)| ip).collect();
    if addresses.is_empty() {
        addresses.push(loopback);
    }
    addresses
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_address_that_a_phone_reaches_comes_first() {
        let own = [
            ("lo", "127.0.0.1"),
            ("docker0", "172.17.0.1"),
            ("enp3s0", "10.0.0.7"),
            ("wlp2s0", "192.168.1.7"),
            ("wlp2s0", "fe80::1"),
            ("wlp2s0", "2001:db8::7"),
        ];
        let own = || own.iter().map(|(name, ip)| ((*name).to_owned(), ip.parse().unwrap())).collect::<Vec<_>>();
        let found =
            |ip: &str, own| reached(ip.parse().unwrap(), own).iter().map(ToString::to_string).collect::<Vec<_>>();
        assert_eq!(found("0.0.0.0", own()), ["192.168.1.7", "10.0.0.7", "172.17.0.1"]);
        assert_eq!(found("::", own()), ["192.168.1.7", "10.0.0.7", "2001:db8::7", "172.17.0.1"]);
        assert_eq!(found("10.0.0.7", own()), ["10.0.0.7"]);
        assert_eq!(found("0.0.0.0", Vec::new()), ["127.0.0.1"]);
    }

    #[test]
    fn a_link_has_the_token_behind_its_mark() {
        let token = Token::random().unwrap();
        let at = |text: &str, token| links(text.parse().unwrap(), token);
        assert_eq!(at("127.0.0.1:8766", None), ["http://127.0.0.1:8766/"]);
        assert_eq!(at("[::1]:8766", Some(&token)), [format!("http://[::1]:8766/#{}", token.text())]);
    }
}
