//! Names by which a request may call this machine, and pages of browsers whose requests are answered.
//!
//! A browser on this machine, or in this network, sends requests of whatever page is open in it. A page of another host,
//! whose name resolves to this machine ("DNS rebinding"), names that host in `Host`; a page of another site has another
//! `Origin`. Programs that are no browsers send no `Origin`, and may send any.

use std::net::IpAddr;

/// Whether `host`, of a `Host` header, names this machine: an address, `localhost`, or the name of the `machine`,
/// alone or with `.local`, if that counts here. With any port, as `ssh -L` has another.
pub fn is_own(host: &str, machine: Option<&str>) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    let address = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    let is_name = |own: &str| !own.is_empty() && name.eq_ignore_ascii_case(own);
    let is_machine = machine.is_some_and(|machine| is_name(machine) || is_name(&format!("{machine}.local")));
    address.parse::<IpAddr>().is_ok() || is_name("localhost") || is_machine
}

/// Whether a page of `origin` belongs to `host`, of a `Host` header: whichever of http and https it has.
pub fn is_page_of(origin: &str, host: &str) -> bool {
    origin.split_once("://").is_some_and(|(_, of)| of == host)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_this_machine_are_its_own() {
        for host in ["127.0.0.1:8766", "localhost:9000", "LOCALHOST", "[::1]:8766", "192.168.1.7:8766", "10.0.0.1"] {
            assert!(is_own(host, None) && is_own(host, Some("rig7")), "{host}");
        }
        for host in ["rig7:8766", "rig7.local:8766", "Rig7.local"] {
            assert!(!is_own(host, None) && is_own(host, Some("rig7")) && !is_own(host, Some("rig8")), "{host}");
        }
        for host in ["evil.example", "127.0.0.1.evil.example:8766", "rig7.evil.example", "", ":8766"] {
            assert!(!is_own(host, None) && !is_own(host, Some("rig7")) && !is_own(host, Some("")), "{host}");
        }
    }

    #[test]
    fn a_page_belongs_to_its_host_and_port() {
        assert!(is_page_of("http://127.0.0.1:8766", "127.0.0.1:8766"));
        assert!(is_page_of("https://127.0.0.1:8766", "127.0.0.1:8766"));
        for origin in ["http://evil.example", "http://127.0.0.1:8765", "http://localhost:8766", "null", ""] {
            assert!(!is_page_of(origin, "127.0.0.1:8766"), "{origin}");
        }
    }
}
