//! The run's side: thread `orders`, which receives orders over the socket.
//!
//! Invariant: it writes to no file and no terminal, and does not wait for a peer: a connection that sends nothing, or
//! does not read its answer, delays no other.

use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

use super::{DONE, LONGEST, address, name, order, this_user};
use crate::action::Order;
use crate::peer::Peer;
use crate::permission::Permission;
use crate::time::Stamp;

/// Connections at a time; beyond that the oldest is closed.
const CONNECTIONS: usize = 16;
/// A connection that has sent no order for this long is closed.
const PATIENCE: Duration = Duration::from_secs(2);

/// Takes orders until it is dropped.
#[derive(Debug)]
pub struct Orders {
    stop: Arc<OwnedFd>,
    thread: Option<JoinHandle<()>>,
}

impl Orders {
    /// Takes orders for the run of `instance` from now on.
    ///
    /// # Errors
    /// When the system provides no socket or no thread.
    pub fn receive(instance: Option<&str>, permission: Arc<Permission>) -> io::Result<Self> {
        let listener = UnixListener::bind_addr(&address(&name(this_user(), instance, std::process::id()))?)?;
        listener.set_nonblocking(true)?;
        let stop = Arc::new(eventfd(0, EventfdFlags::CLOEXEC)?);
        let desk = Desk { listener, stop: Arc::clone(&stop), waiting: Vec::with_capacity(CONNECTIONS), permission };
        let thread = std::thread::Builder::new().name("orders".to_owned()).spawn(move || desk.work())?;
        Ok(Self { stop, thread: Some(thread) })
    }
}

impl Drop for Orders {
    fn drop(&mut self) {
        // An eventfd always has room for a number.
        let _ = rustix::io::write(&self.stop, &1_u64.to_ne_bytes());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A program that is about to give an order.
struct Waiting {
    stream: UnixStream,
    since: Stamp,
    line: Vec<u8>,
}

struct Desk {
    listener: UnixListener,
    stop: Arc<OwnedFd>,
    waiting: Vec<Waiting>,
    permission: Arc<Permission>,
}

impl Desk {
    fn work(mut self) {
        loop {
            let ready = {
                let mut all = vec![PollFd::new(&*self.stop, PollFlags::IN), PollFd::new(&self.listener, PollFlags::IN)];
                all.extend(self.waiting.iter().map(|one| PollFd::new(&one.stream, PollFlags::IN | PollFlags::RDHUP)));
                let limit = Timespec { tv_sec: 1, tv_nsec: 0 };
                let limit = (!self.waiting.is_empty()).then_some(&limit);
                match poll(&mut all, limit) {
                    Ok(_) | Err(rustix::io::Errno::INTR) => {}
                    // Out of memory for the moment; an immediate retry would only add to it.
                    Err(_) => std::thread::sleep(Duration::from_millis(10)),
                }
                all.iter().map(|one| !one.revents().is_empty()).collect::<Vec<_>>()
            };
            if ready.first() == Some(&true) {
                return;
            }
            let now = Stamp::now();
            let mut ready_of = ready.iter().skip(2).copied();
            let permission = &self.permission;
            self.waiting.retain_mut(|one| {
                let stays = !ready_of.next().unwrap_or(false) || one.take(permission);
                stays && now.since(one.since) < PATIENCE
            });
            if ready.get(1) == Some(&true) {
                self.accept(now);
            }
        }
    }

    fn accept(&mut self, now: Stamp) {
        while let Ok((stream, _)) = self.listener.accept() {
            let is_allowed = Peer::of(&stream).is_ok_and(|peer| peer.user == this_user() || peer.user == 0);
            if !is_allowed || stream.set_nonblocking(true).is_err() {
                continue;
            }
            if self.waiting.len() >= CONNECTIONS {
                self.waiting.remove(0);
            }
            let mut one = Waiting { stream, since: now, line: Vec::new() };
            if one.take(&self.permission) {
                self.waiting.push(one);
            }
        }
    }
}

impl Waiting {
    /// Reads what was sent. False when the connection is finished.
    fn take(&mut self, permission: &Permission) -> bool {
        let mut bytes = [0; LONGEST];
        match self.stream.read(&mut bytes) {
            Ok(0) => return false,
            Ok(count) => self.line.extend_from_slice(bytes.get(..count).unwrap_or_default()),
            Err(error) => return matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted),
        }
        let Some(end) = self.line.iter().position(|byte| *byte == b'\n') else { return self.line.len() < LONGEST };
        let line = self.line.get(..end).and_then(|line| str::from_utf8(line).ok());
        let answer = match line.and_then(order) {
            None => "not an order: write `arm NS` or `disarm NS`".to_owned(),
            Some((Order::Disarm | Order::Emergency(_), _)) => {
                permission.disarm(Stamp::now());
                DONE.to_owned()
            }
            // The sender has ended, or no longer waits.
            Some((Order::Arm | Order::ArmBack, _)) if self.is_left() => return false,
            Some((Order::ArmBack, given)) => {
                permission.arm_back(given, Stamp::now()).map_or_else(|void| void.to_string(), |()| DONE.to_owned())
            }
            Some((Order::Arm, given)) => {
                permission.arm(given, Stamp::now()).map_or_else(|void| void.to_string(), |()| DONE.to_owned())
            }
        };
        // There is room for a line, or there is no reader.
        let _ = self.stream.write_all(format!("{answer}\n").as_bytes());
        false
    }

    /// Whether the other end has closed.
    fn is_left(&self) -> bool {
        let mut one = [PollFd::from_borrowed_fd(self.stream.as_fd(), PollFlags::RDHUP)];
        let at_once = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut one, Some(&at_once)).is_err() || one.iter().any(|one| !one.revents().is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::orders::line;

    #[test]
    fn an_arm_of_a_closed_connection_is_ignored_and_a_disarm_is_not() {
        let permission = Arc::new(Permission::default());
        let attended = permission.attend();
        for (order, is_gone, taken) in [
            (Order::Arm, true, &[][..]),
            (Order::Arm, false, &[Order::Arm]),
            (Order::Disarm, true, &[Order::Disarm]),
            (Order::Disarm, false, &[Order::Disarm]),
        ] {
            let (mut giver, stream) = UnixStream::pair().unwrap();
            let mut waiting = Waiting { stream, since: Stamp::now(), line: Vec::new() };
            giver.write_all(line(order, Stamp::now()).as_bytes()).unwrap();
            let giver = (!is_gone).then_some(giver);
            assert!(!waiting.take(&permission));
            assert_eq!(attended.take().collect::<Vec<_>>(), taken, "{order:?}, gone: {is_gone}");
            drop(giver);
        }
    }
}
