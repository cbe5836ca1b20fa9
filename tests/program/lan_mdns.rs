//! A device on the network that announces itself: a responder of multicast DNS in front of the real binary.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::io::Read;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crate::support::lan::{RIG, RUN, Server, camera, camera_entry, free_ports, life_of, stop, wait_for};
use crate::support::skip::skipped;
use crate::support::{PATIENCE, Place};
use mdns_sd::{ServiceDaemon, ServiceInfo};

/// For trials: nothing but these tests sends to it.
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 42, 99);

/// Announces a service until it is asked to send a goodbye or is killed: a process of its own, so that it can
/// be.
struct Responder(Child);

impl Responder {
    fn start(service: &str, port: u16) -> Self {
        let child = Command::new(std::env::current_exe().expect("this test"))
            .args(["--exact", "lan_mdns::announce_a_service", "--ignored", "--nocapture"])
            .env("ANNOUNCE", format!("{service} {port}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn();
        Self(child.expect("runs"))
    }

    fn say_goodbye(mut self) {
        drop(self.0.stdin.take());
        let _ = self.0.wait();
    }
}

impl Drop for Responder {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
#[ignore = "run by an_announced_device_leaves_by_goodbye_and_by_lease"]
fn announce_a_service() {
    let what = std::env::var("ANNOUNCE").expect("run by the test below");
    let (service, port) = what.split_once(' ').expect("service and port");
    let daemon = ServiceDaemon::new().expect("mDNS");
    let port = port.parse().expect("a port");
    // A host of its own: the goodbye of another test takes its addresses along.
    let host = format!("rapid{}.local.", std::process::id());
    let own = own_address().expect("an address");
    let info = ServiceInfo::new(&format!("{service}.local."), "cam one", &host, own, port, None);
    let info = info.expect("a service");
    let name = info.get_fullname().to_owned();
    daemon.register(info).expect("announced");
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
    let done = daemon.unregister(&name).expect("unannounced");
    let _ = done.recv_timeout(PATIENCE);
}

/// The address from which this machine sends to a multicast group. The only one that is announced: the server listens at no
/// other, and of several, which arrive in packets of their own, one may be left out later, so that the device moves.
fn own_address() -> std::io::Result<IpAddr> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    socket.connect((GROUP, 1))?;
    Ok(socket.local_addr()?.ip())
}

/// Does a packet to a multicast group come back to this machine? Asked of the machine, and of no program for
/// mDNS.
fn multicast_works() -> std::io::Result<()> {
    let listener = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    listener.join_multicast_v4(&GROUP, &Ipv4Addr::UNSPECIFIED)?;
    listener.set_read_timeout(Some(Duration::from_secs(20)))?;
    let sender = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    sender.send_to(b"anybody?", (GROUP, listener.local_addr()?.port()))?;
    let mut datagram = [0; 8];
    listener.recv(&mut datagram)?;
    Ok(())
}

#[test]
fn an_announced_device_leaves_by_goodbye_and_by_lease() {
    if let Err(error) = multicast_works() {
        skipped(&format!("multicast does not work on this machine ({error}), so nothing is found by mDNS"));
        return;
    }
    let (place, [port]) = (Place::new(), free_ports());
    let service = format!("_rt{}._tcp", std::process::id());
    let entry = camera_entry("cam", 0, port).replace("host = \"127.0.0.1\"", &format!("mdns = {service:?}"));
    // The port is the announced one.
    place.write("devices.toml", &format!("{RIG}{}", entry.replace(&format!("port = {port}\n"), "")));
    let anywhere = SocketAddr::from(([0; 4], port));
    let server = Server::start_at(anywhere, camera);
    let responder = Responder::start(&service, port);
    let running = place.start(&RUN, "begin");
    wait_for(&running, "cam", "streaming", 1);
    // A goodbye counts although pictures arrive.
    responder.say_goodbye();
    wait_for(&running, "cam", "by goodbye", 1);
    let responder = Responder::start(&service, port);
    wait_for(&running, "cam", "streaming", 2);
    // Nothing is announced: the cable is pulled.
    drop(responder);
    drop(server);
    wait_for(&running, "cam", "by lease", 1);
    let reported = stop(running);
    let life = life_of(&reported, "cam");
    let gone: Vec<_> = life.iter().filter(|word| word.starts_with("by ")).collect();
    assert_eq!(gone, ["by goodbye", "by lease"], "{life:?}");
    let attached = reported.iter().find(|event| event["event"] == "attach").expect("attached");
    assert_eq!(attached["instance"], "cam one");
}

#[test]
fn an_announced_device_is_found_when_its_entry_comes_later() {
    if let Err(error) = multicast_works() {
        skipped(&format!("multicast does not work on this machine ({error}), so nothing is found by mDNS"));
        return;
    }
    let (place, [port]) = (Place::new(), free_ports());
    let service = format!("_rl{}._tcp", std::process::id());
    let entry = camera_entry("cam", 0, port).replace("host = \"127.0.0.1\"", &format!("mdns = {service:?}"));
    let tof = "[device.tof]\nvid = \"1209\"\npid = \"0001\"\nnode = \"serial\"\nbit = 5\ntty = { channels = 1 }\n";
    place.write("devices.toml", &format!("{RIG}{tof}"));
    let _server = Server::start_at(SocketAddr::from(([0; 4], port)), camera);
    let _responder = Responder::start(&service, port);
    let running = place.start(&RUN, "begin");
    place.write("devices.toml", &format!("{RIG}{tof}{entry}"));
    let output = place.run(&["reload"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    wait_for(&running, "cam", "streaming", 1);
    stop(running);
}
