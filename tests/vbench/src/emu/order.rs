//! Orders to a device from the emulator's script: what befalls its bus, its motors or its link.
//!
//! ```text
//! fault N[.ID] CODE   mute N[.ID] 0|1   hot N[.ID] DEGREES   power N[.ID] 0|1   ask N[.ID]
//! flood N HZ          busoff N 0|1      link N 0|1
//! ```
//!
//! `N.ID` is one motor (its slave id, hexadecimal) behind device N, `N` alone all of them.

use std::str::SplitWhitespace;

/// Frames a second the generator can be asked for: a classic bus at 1 Mbit/s carries some 8,000 of eight bytes.
pub const MOST_FRAMES: f64 = 8_000.0;

/// Something that happens to a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Order {
    /// A motor latches this fault (8 to 14); 0 takes it away.
    Fault(u8),
    /// A motor neither hears nor answers, and goes on as it is.
    Mute(bool),
    /// A motor has this temperature, degrees Celsius.
    Hot(u8),
    /// A motor loses or regains its supply: what was not saved is forgotten.
    Power(bool),
    /// A motor tells its state to the log.
    Ask,
    /// So many frames a second appear on the bus.
    Flood(f64),
    /// The adapter goes bus-off, or recovers.
    BusOff(bool),
    /// The network cable behind the adapter is in, or out.
    Link(bool),
}

/// Whom an order is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Target {
    /// Number of the device.
    pub device: usize,
    /// Slave id of the motor; all of them without.
    pub motor: Option<u16>,
}

/// Reads an order whose first word is `name`; `None` when it is none.
pub fn parse(name: &str, words: &mut SplitWhitespace<'_>) -> Option<(Target, Order)> {
    let target = words.next().and_then(target)?;
    let mut flag = || match words.next()? {
        "0" => Some(false),
        "1" => Some(true),
        _ => None,
    };
    let order = match name {
        "mute" => Order::Mute(flag()?),
        "power" => Order::Power(flag()?),
        "busoff" => Order::BusOff(flag()?),
        "link" => Order::Link(flag()?),
        "fault" => {
            let code = u8::from_str_radix(words.next()?, 16).ok();
            Order::Fault(code.filter(|code| *code == 0 || (8..=14).contains(code))?)
        }
        "hot" => Order::Hot(words.next()?.parse().ok()?),
        "flood" => Order::Flood(words.next()?.parse().ok().filter(|hz| (0.0..=MOST_FRAMES).contains(hz))?),
        "ask" => Order::Ask,
        _ => return None,
    };
    Some((target, order))
}

fn target(word: &str) -> Option<Target> {
    let (device, motor) = match word.split_once('.') {
        Some((device, motor)) => (device, Some(u16::from_str_radix(motor, 16).ok()?)),
        None => (word, None),
    };
    Some(Target { device: device.parse().ok()?, motor })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_orders() {
        let all = |device| Target { device, motor: None };
        let cases = [
            ("fault 0.1b d", Some((Target { device: 0, motor: Some(0x1b) }, Order::Fault(13)))),
            ("mute 2 1", Some((all(2), Order::Mute(true)))),
            ("hot 0 95", Some((all(0), Order::Hot(95)))),
            ("power 0 0", Some((all(0), Order::Power(false)))),
            ("ask 1", Some((all(1), Order::Ask))),
            ("flood 0 8000", Some((all(0), Order::Flood(8000.0)))),
            ("busoff 0 1", Some((all(0), Order::BusOff(true)))),
            ("link 3 0", Some((all(3), Order::Link(false)))),
            ("fault 0 3", None),
            ("flood 0 8001", None),
            ("mute 0 2", None),
            ("hot 0", None),
            ("ask x", None),
        ];
        for (line, expected) in cases {
            let mut words = line.split_whitespace();
            let name = words.next().unwrap();
            assert_eq!(parse(name, &mut words), expected, "{line}");
        }
    }
}
