//! Orders of other programs: to the actuator (`rapid arm`, `rapid disarm`), and requests to the session (`rapid episode`,
//! `rapid session`) and about the registry (`rapid reload`).
//!
//! What stops motion within the run, and every order to the actuator, is [`rapid_core::permission`]'s.
//!
//! They come over a socket of the abstract namespace, which needs neither a disk nor shared memory: a run can be
//! stopped while /dev/shm, /tmp and the disk are full and its bus is damaged. [`receive`] is the run's side, [`give`]
//! that of the sender.
//!
//! The name is `rapid/USER/INSTANCE/PROCESS`, numbers except for the instance, which is `-` where there is none
//! (unix(7)). Any user can create a socket of that name: the peer is identified by the kernel (`SO_PEERCRED`). An order
//! is one line, `arm NS` or `disarm NS` with the time at which it was given (`CLOCK_MONOTONIC`, ns); the answer is one
//! line, `done` or the reason of the refusal, and the connection is closed. A request is one line of JSON, a
//! [`SessionRequest`](rapid_status::session::SessionRequest) or a
//! [`RegistryRequest`](rapid_status::RegistryRequest); so is its [`Answer`], which comes when what was requested is done:
//! when the file of an episode is closed, or when one has begun. A screen sends `attach`, and the connection becomes its
//! link ([`rapid_status::attach`]).
//!
//! Invariant: orders of this user and of root are accepted, those of members of a group if the run was started so
//! (`--group-control`), and of no one else. They are given to a run of this user, or else to one whose group the sender
//! is a member of, or by root to anyone's.
//! Invariant: an arm counts only while its sender waits for the answer, and within a second: see
//! [`Permission`](rapid_core::permission::Permission). A disarm counts however late it arrives.

pub mod give;
pub mod receive;

use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::SocketAddr;

use rapid_core::action::Order;
use rapid_core::time::Stamp;
use serde::{Deserialize, Serialize};

/// Longest line: a text of 2000 bytes, each of them escaped.
const LONGEST: usize = 16_384;
/// Longest answer to a request: the episodes of a session with their notes.
const LONGEST_ANSWER: u64 = 1 << 24;
/// The answer to an order that was carried out.
const DONE: &str = "done";

/// What the names of all runs of an instance have in common, except for the user.
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
        // An emergency stop is never sent to another program as more than a disarm.
        Order::Disarm | Order::Emergency(_) => "disarm",
    };
    format!("{word} {}\n", given.0)
}

/// The answer to a request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Answer {
    /// Whether it was carried out.
    pub ok: bool,
    /// What was done, or why not.
    pub text: String,
}

/// The order in a line, without its end.
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
