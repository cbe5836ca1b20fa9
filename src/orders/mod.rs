//! Orders of other programs to the actuator: `rapid arm` and `rapid disarm`.
//!
//! They come over a socket of the abstract namespace, which needs neither a disk nor shared memory: a run can be
//! stopped while /dev/shm, /tmp and the disk are full and its bus is damaged. [`receive`] is the run's side, [`give`]
//! that of whoever gives an order.
//!
//! The name is `rapid/USER/INSTANCE/PROCESS`, numbers but for the instance, which is `-` where there is none (unix(7)).
//! Anyone can make a socket of that name: who is at the other end is what the kernel says (`SO_PEERCRED`). An order is
//! one line, `arm NS` or `disarm NS` with the time at which it was given (`CLOCK_MONOTONIC`, ns); the answer is one line,
//! `done` or why not, and the connection is closed.
//!
//! Invariant: orders of this user and of root are taken, and of no one else; they are given to a run of this user, or by
//! root to anyone's.
//! Invariant: an arm counts only while who gave it waits for the answer, and within a second: see
//! [`Permission`](crate::permission::Permission). A disarm counts however late it comes.

pub mod give;
pub mod receive;

use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::SocketAddr;

use crate::action::Order;
use crate::time::Stamp;

/// Longest line.
const LONGEST: usize = 256;
/// The answer to an order that was carried out.
const DONE: &str = "done";

/// What the names of all runs of an instance have in common, but for the user.
fn instance_part(instance: Option<&str>) -> &str {
    instance.unwrap_or("-")
}

fn name(user: u32, instance: Option<&str>, process: u32) -> String {
    format!("rapid/{user}/{}/{process}", instance_part(instance))
}

fn address(name: &str) -> io::Result<SocketAddr> {
    SocketAddr::from_abstract_name(name)
}

fn this_user() -> u32 {
    rustix::process::geteuid().as_raw()
}

fn line(order: Order, given: Stamp) -> String {
    let word = match order {
        Order::Arm => "arm",
        Order::ArmBack => "arm-back",
        // Of an emergency stop no other program gives more.
        Order::Disarm | Order::Emergency(_) => "disarm",
    };
    format!("{word} {}\n", given.0)
}

/// What a line asks for, without its end.
fn order(line: &str) -> Option<(Order, Stamp)> {
    let (word, given) = line.split_once(' ')?;
    let order = match word {
        "arm" => Order::Arm,
        "arm-back" => Order::ArmBack,
        "disarm" => Order::Disarm,
        _ => return None,
    };
    Some((order, Stamp(given.parse().ok()?)))
}

#[cfg(test)]
mod tests;
