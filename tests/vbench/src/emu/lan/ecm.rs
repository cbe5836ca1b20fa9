//! A CDC-ECM adapter (named `enx...` by `cdc_ether`): one Ethernet frame is one transfer.
//!
//! The interface gets no address from here: there is no DHCP server behind it; the guest's script sets the address.

use std::net::Ipv4Addr;

use super::gopro::Gopro;
use super::lidar::{self, PORT};
use super::stack::Stack;
use crate::emu::descriptor::{Answer, CS_INTERFACE, Configuration, DeviceClass, Setup};
use crate::emu::function::DATA_IN;
use crate::emu::order::Order;
use crate::emu::pace::Pace;
use crate::emu::reported::Reported;
use crate::emu::talker::Talker;

const DATA_OUT: u8 = 0x02;
const NOTIFY_IN: u8 = 0x83;
/// String descriptor with the host's MAC address.
const MAC_STRING: u8 = 4;
/// Address of a LiDAR without a camera whose network it shares.
const LIDAR_ADDRESS: Ipv4Addr = Ipv4Addr::new(192, 168, 1, 201);

/// The devices behind the adapter.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NetSpec {
    /// A GoPro with clips of this many MB.
    pub gopro: Option<u32>,
    /// A LiDAR that sends this many packets per second.
    pub lidar: Option<f64>,
}

/// The adapter.
#[derive(Debug)]
pub struct Ecm {
    /// The host's address, twelve hexadecimal digits.
    mac: String,
    stack: Stack,
    gopro: Option<Gopro>,
    lidar: Option<Lidar>,
    linked: bool,
    notices: Vec<[u8; 8]>,
    reported: Vec<Reported>,
}

#[derive(Debug)]
struct Lidar {
    hz: f64,
    /// Starts with the first use of the clock.
    pace: Option<Pace>,
}

impl Ecm {
    /// An adapter with these devices; a camera's address follows from its serial. `first` distinguishes adapters.
    pub fn new(net: &NetSpec, serial: &str, first: u32) -> Self {
        let gopro = net.gopro.map(|megabytes| Gopro::new(serial, megabytes));
        let address = gopro.as_ref().map_or(LIDAR_ADDRESS, Gopro::address);
        // udev names an interface by its address only if that is a manufacturer's: this range is for documentation.
        let [.., number] = (first / 1_000_000).to_be_bytes();
        Self {
            mac: format!("00005E0053{number:02X}"),
            stack: Stack::new([0x02, 0, 0x5e, 0, 0x53, number], address),
            gopro,
            lidar: net.lidar.map(|hz| Lidar { hz, pace: None }),
            linked: true,
            notices: Vec::new(),
            reported: Vec::new(),
        }
    }

    fn link(&mut self, linked: bool) {
        const TO_INTERFACE: u8 = 0xa1;
        const NETWORK_CONNECTION: u8 = 0;
        self.linked = linked;
        self.stack.discard();
        self.notices.push([TO_INTERFACE, NETWORK_CONNECTION, u8::from(linked), 0, 0, 0, 0, 0]);
    }
}

impl Talker for Ecm {
    fn class(&self) -> DeviceClass {
        DeviceClass { class: [2, 0, 0], release: 0x0100 }
    }

    fn configuration(&self) -> Vec<u8> {
        Configuration::default()
            .interface(0, 1, [2, 6, 0])
            .push(&[CS_INTERFACE, 0, 0x10, 0x01])
            .push(&[CS_INTERFACE, 6, 0, 1])
            // Ethernet: no statistics, frames of 1514 bytes, no filters.
            .push(&[CS_INTERFACE, 15, MAC_STRING, 0, 0, 0, 0, 0xea, 0x05, 0, 0, 0])
            .push(&[5, NOTIFY_IN, 3, 16, 0, 9])
            .interface(1, 0, [10, 0, 0])
            .setting(1, 1, 2, [10, 0, 0])
            .bulk(DATA_IN)
            .bulk(DATA_OUT)
            .finish()
    }

    fn string(&self, index: u8) -> Option<&str> {
        (index == MAC_STRING).then_some(self.mac.as_str())
    }

    fn control(&mut self, setup: Setup, _data: &[u8], _now_ns: u64) -> Answer {
        if setup.is_in() { Answer::Stall } else { Answer::Done }
    }

    fn receive(&mut self, data: &[u8], _now_ns: u64) {
        if self.linked {
            self.stack.receive(data);
        }
    }

    fn tend(&mut self, now_ns: u64) -> Option<u64> {
        let lidar = self.lidar.as_mut().map(|lidar| {
            let hz = lidar.hz;
            lidar.pace.get_or_insert_with(|| Pace::new(hz, now_ns)).next_ns(now_ns)
        });
        let stack = self.stack.poll(self.gopro.as_mut(), now_ns);
        stack.into_iter().chain(lidar).min()
    }

    fn take(&mut self, endpoint: u8, room: usize, now_ns: u64, out: &mut Vec<u8>) -> bool {
        if endpoint == NOTIFY_IN & 0x0f {
            let Some(notice) = (!self.notices.is_empty()).then(|| self.notices.remove(0)) else { return false };
            out.extend(notice);
            return true;
        }
        if endpoint != DATA_IN & 0x0f || !self.linked {
            return false;
        }
        if self.stack.is_quiet()
            && let Some(number) = self.lidar.as_mut().and_then(|lidar| lidar.pace.as_mut()).and_then(|p| p.beat(now_ns))
        {
            self.stack.broadcast(PORT, &lidar::packet(number, now_ns), now_ns);
        }
        let Some(frame) = self.stack.next_frame().filter(|frame| frame.len() <= room) else { return false };
        out.extend(frame);
        true
    }

    fn discard(&mut self) {
        self.stack.discard();
    }

    fn reset(&mut self) {
        self.stack.hang_up();
        self.notices.clear();
        if !self.linked {
            self.link(false);
        }
    }

    fn apply(&mut self, _motor: Option<u16>, order: Order, _now_ns: u64) -> bool {
        let Order::Link(linked) = order else { return false };
        self.link(linked);
        self.reported.push(Reported::new("link", serde_json::json!({"linked": linked})));
        true
    }

    fn reported(&mut self, reported: &mut Vec<Reported>) {
        reported.append(&mut self.reported);
        if let Some(gopro) = &mut self.gopro {
            reported.extend(gopro.reported());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emu::descriptor::check_configuration;

    fn taken(ecm: &mut Ecm, endpoint: u8, now_ns: u64) -> Vec<Vec<u8>> {
        let mut all = Vec::new();
        loop {
            let mut transfer = Vec::new();
            if !ecm.take(endpoint, 2048, now_ns, &mut transfer) {
                return all;
            }
            all.push(transfer);
        }
    }

    #[test]
    fn its_configuration_adds_up() {
        check_configuration(&Ecm::new(&NetSpec::default(), "", 0).configuration());
    }

    #[test]
    fn each_adapter_has_an_address() {
        assert_eq!(Ecm::new(&NetSpec::default(), "", 3_000_000).string(4), Some("00005E005303"));
    }

    #[test]
    fn packets_are_broadcast_while_the_cable_is_in() {
        let mut ecm = Ecm::new(&NetSpec { gopro: None, lidar: Some(100.0) }, "", 0);
        ecm.tend(0);
        let frames = taken(&mut ecm, 1, 40_000_000);
        assert_eq!(frames.len(), 4);
        assert_eq!((&frames[0][..6], frames[0].len()), (&[0xff; 6][..], 14 + 20 + 8 + lidar::PACKET));
        let counter = |frame: &[u8]| lidar::number(&frame[42..]);
        assert_eq!(frames.iter().map(|frame| counter(frame)).collect::<Vec<_>>(), [Some(0), Some(1), Some(2), Some(3)]);
        assert!(ecm.apply(None, Order::Link(false), 40_000_000));
        assert_eq!(taken(&mut ecm, 1, 60_000_000).len(), 0);
        assert_eq!(taken(&mut ecm, 3, 60_000_000), [[0xa1, 0, 0, 0, 0, 0, 0, 0]]);
        ecm.apply(None, Order::Link(true), 60_000_000);
        assert_eq!(counter(&taken(&mut ecm, 1, 61_000_000)[0]), Some(4), "no number was spent meanwhile");
    }
}
