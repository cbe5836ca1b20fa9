//! One master for each bus of motors.
//!
//! A process that drives motors over a network interface holds a socket named after the interface, in the abstract
//! namespace. Like the interface it belongs to a network namespace; it needs no file and ends with the process. Serial
//! lines are opened exclusively.

use std::io::ErrorKind;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};

use rapid_system::peer::Peer;

use super::outcome::LinkError;

/// The motors behind an interface are ours until this is dropped.
#[derive(Debug)]
pub(super) struct Claim(#[expect(dead_code, reason = "it is held")] UnixListener);

impl Claim {
    /// Claims the motors behind the interface `name`.
    ///
    /// # Errors
    /// When another process holds the claim; the text names it.
    pub(super) fn acquire(name: &str) -> Result<Self, LinkError> {
        let refused = |error: std::io::Error| LinkError::Retry(format!("claiming {name}: {error}"));
        let address = SocketAddr::from_abstract_name(format!("rapid/can/{name}")).map_err(refused)?;
        match UnixListener::bind_addr(&address) {
            Ok(listener) => Ok(Self(listener)),
            Err(error) if error.kind() == ErrorKind::AddrInUse => {
                let owner = UnixStream::connect_addr(&address).and_then(|stream| Peer::from_stream(&stream)).ok();
                let process = owner.and_then(|owner| owner.process);
                let who = process.map_or("another process".to_owned(), |process| format!("process {process}"));
                Err(LinkError::Retry(format!("{who} drives the motors behind {name}: end it")))
            }
            Err(error) => Err(refused(error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_master_is_refused_with_the_process_of_the_first() {
        let name = format!("test{}", std::process::id());
        let first = Claim::acquire(&name).unwrap();
        let text = Claim::acquire(&name).unwrap_err().to_string();
        assert_eq!(text, format!("process {} drives the motors behind {name}: end it", std::process::id()));
        drop(first);
        Claim::acquire(&name).unwrap();
    }
}
