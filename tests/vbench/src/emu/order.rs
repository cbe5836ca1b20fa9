//! Orders to a device from the emulator's script: events of its bus, its motors or its link.
//!
//! ```text
//! fault N[.ID] CODE   mute N[.ID] 0|1   hot N[.ID] DEGREES   power N[.ID] 0|1   ask N[.ID]
//! flood N HZ          busoff N 0|1      link N 0|1
//! load N[.ID] NM [lever]      friction N[.ID] NM NMS     inertia N[.ID] KGM2     ends N[.ID] LOW HIGH
//! zero N[.ID] RAD             freeze N[.ID] 0|1          block N[.ID] 0|1
//! level N.LINE 0|1
//! ```
//!
//! `N.ID` is one motor (its slave id, hexadecimal) behind device N, `N` alone all of them. The first order of the
//! second group that concerns a body gives the motor one: from then on it moves by torque instead of a fixed lag.

use std::str::SplitWhitespace;

/// Maximum rate of generated frames per second: a classic bus at 1 Mbit/s carries some 8,000 of eight bytes.
pub const MOST_FRAMES: f64 = 8_000.0;

/// The smallest inertia, kg m²: a lighter joint would move too far in one step of the simulation.
pub const LEAST_INERTIA: f64 = 0.001;

/// An event of a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Order {
    /// A motor latches this fault (8 to 14); 0 clears it.
    Fault(u8),
    /// A motor neither receives nor answers, and continues its motion; a GPIO chip refuses what is written.
    Mute(bool),
    /// A motor has this temperature, degrees Celsius.
    Hot(u8),
    /// A motor loses or regains its supply: unsaved settings are lost.
    Power(bool),
    /// A motor writes its state to the log.
    Ask,
    /// A torque pulls the joint towards negative angles, Nm.
    Load {
        /// Nm.
        torque: f64,
        /// It is a weight on a lever that is horizontal at angle 0: it varies with the cosine.
        is_lever: bool,
    },
    /// The joint has this friction: Nm at any speed, and Nm s/rad.
    Friction([f64; 2]),
    /// The joint has this inertia, kg m².
    Inertia(f64),
    /// The joint ends at these angles, rad.
    Ends([f64; 2]),
    /// The motor's reported position shifts by this much, rad: its zero moves.
    Zero(f64),
    /// The encoder is stuck: the reported position stays, and the motor's own loops work with it.
    Freeze(bool),
    /// The joint does not turn, whatever the torque.
    Block(bool),
    /// This many frames per second appear on the bus.
    Flood(f64),
    /// The adapter goes bus-off, or recovers.
    BusOff(bool),
    /// A line of a GPIO chip is pulled low, or released.
    Level(bool),
    /// The network cable behind the adapter is plugged in or unplugged.
    Link(bool),
}

/// The target of an order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Target {
    /// Number of the device.
    pub device: usize,
    /// Slave id of the motor; `None` for all of them.
    pub motor: Option<u16>,
}

/// Parses an order whose first word is `name`; `None` if it is not an order.
pub fn parse(name: &str, words: &mut SplitWhitespace<'_>) -> Option<(Target, Order)> {
    let target = words.next().and_then(target)?;
    if let Some(order) = physical(name, words) {
        return Some((target, order));
    }
    let mut flag = || flag(words.next()?);
    let order = match name {
        "mute" => Order::Mute(flag()?),
        "power" => Order::Power(flag()?),
        "busoff" => Order::BusOff(flag()?),
        "link" => Order::Link(flag()?),
        "level" => Order::Level(flag()?),
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

/// Parses an order about a motor's load.
fn physical(name: &str, words: &mut SplitWhitespace<'_>) -> Option<Order> {
    let mut number = |lowest: f64| {
        let number = words.next()?.parse::<f64>().ok()?;
        (number.is_finite() && number >= lowest).then_some(number)
    };
    let any = f64::NEG_INFINITY;
    Some(match name {
        "load" => {
            let torque = number(any)?;
            Order::Load {
                torque,
                is_lever: words.next().map(|word| word == "lever").map_or(Some(false), |is| is.then_some(true))?,
            }
        }
        "friction" => Order::Friction([number(0.0)?, number(0.0)?]),
        "inertia" => Order::Inertia(number(LEAST_INERTIA)?),
        "ends" => {
            let low = number(any)?;
            Order::Ends([low, number(low)?])
        }
        "zero" => Order::Zero(number(any)?),
        "freeze" => Order::Freeze(flag(words.next()?)?),
        "block" => Order::Block(flag(words.next()?)?),
        _ => return None,
    })
}

fn flag(word: &str) -> Option<bool> {
    match word {
        "0" => Some(false),
        "1" => Some(true),
        _ => None,
    }
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
        let one = |motor| Target { device: 0, motor: Some(motor) };
        let cases = [
            ("fault 0.1b d", Some((Target { device: 0, motor: Some(0x1b) }, Order::Fault(13)))),
            ("mute 2 1", Some((all(2), Order::Mute(true)))),
            ("hot 0 95", Some((all(0), Order::Hot(95)))),
            ("power 0 0", Some((all(0), Order::Power(false)))),
            ("ask 1", Some((all(1), Order::Ask))),
            ("flood 0 8000", Some((all(0), Order::Flood(8000.0)))),
            ("busoff 0 1", Some((all(0), Order::BusOff(true)))),
            ("link 3 0", Some((all(3), Order::Link(false)))),
            ("level 0.2 1", Some((one(2), Order::Level(true)))),
            ("load 0.1 1.5", Some((one(1), Order::Load { torque: 1.5, is_lever: false }))),
            ("load 0.1 -2 lever", Some((one(1), Order::Load { torque: -2.0, is_lever: true }))),
            ("friction 0 0.1 0.02", Some((all(0), Order::Friction([0.1, 0.02])))),
            ("inertia 0 0.05", Some((all(0), Order::Inertia(0.05)))),
            ("ends 0 -1 1.5", Some((all(0), Order::Ends([-1.0, 1.5])))),
            ("zero 0.2 -0.225", Some((one(2), Order::Zero(-0.225)))),
            ("freeze 0 1", Some((all(0), Order::Freeze(true)))),
            ("block 0 0", Some((all(0), Order::Block(false)))),
            ("load 0", None),
            ("load 0 1 2", None),
            ("load 0 nan", None),
            ("friction 0 0.1", None),
            ("friction 0 -1 0", None),
            ("inertia 0 0", None),
            ("ends 0 1 0", None),
            ("freeze 0 2", None),
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
