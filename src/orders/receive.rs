//! The run's side: thread `orders`, which receives orders over the socket.
//!
//! Requests to the session are handed to the run, which answers them, and so are screens that are to be attached.
//!
//! Invariant: it writes to no file and no terminal, and does not wait for a peer: a connection that sends nothing, or
//! does not read its answer, delays no other.

use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use rapid_core::action::Order;
use rapid_core::permission::Permission;
use rapid_core::time::Stamp;
use rapid_status::RegistryRequest;
use rapid_status::attach::ATTACH;
use rapid_status::session::SessionRequest;
use rapid_system::peer::Peer;
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use tokio::sync::mpsc::Sender;
use tokio::sync::mpsc::error::TrySendError;

use super::{Answer, DONE, LONGEST, address, name, order, this_user};

/// Connections at a time; beyond that the oldest is closed.
const CONNECTIONS: usize = 16;
/// A connection that has sent no order for this long is closed.
const PATIENCE: Duration = Duration::from_secs(2);

/// What other programs may request of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Wanted {
    /// Something of the session.
    Session(SessionRequest),
    /// Something about the registry.
    Registry(RegistryRequest),
}

impl Wanted {
    fn read(json: &str) -> Result<Self, serde_json::Error> {
        // The words of the two are different; a mistake is more often made in a request to the session.
        serde_json::from_str(json).map(Self::Registry).or_else(|_| serde_json::from_str(json).map(Self::Session))
    }
}

/// A request of another program.
#[derive(Debug)]
pub struct Asked {
    /// What is requested.
    pub request: Wanted,
    /// When it arrived.
    pub at: Stamp,
    stream: UnixStream,
}

impl Asked {
    /// Answers; waits a little for a requester that does not read.
    pub fn answer(mut self, answer: Result<String, String>) {
        let answer = match answer {
            Ok(text) => Answer { ok: true, text },
            Err(text) => Answer { ok: false, text },
        };
        // The requester may have ended.
        let _ = self.stream.set_nonblocking(false).and_then(|()| self.stream.set_write_timeout(Some(PATIENCE)));
        let _ = serde_json::to_string(&answer).map(|line| self.stream.write_all(format!("{line}\n").as_bytes()));
    }
}

/// A screen of another process.
#[derive(Debug)]
pub struct Viewer {
    /// The link to it.
    pub stream: UnixStream,
    /// It makes no requests.
    pub read_only: bool,
}

/// What the run is to handle.
#[derive(Debug)]
pub enum Arrival {
    /// A request to the session.
    Asked(Asked),
    /// A screen is to be attached.
    Viewer(Viewer),
}

impl Arrival {
    fn refuse(self) {
        let why = "the run does not take requests at the moment";
        match self {
            Self::Asked(asked) => asked.answer(Err(why.to_owned())),
            Self::Viewer(mut viewer) => drop(viewer.stream.write_all(format!("{why}\n").as_bytes())),
        }
    }
}

/// Takes orders until it is dropped.
#[derive(Debug)]
pub struct Orders {
    stop: Arc<OwnedFd>,
    thread: Option<JoinHandle<()>>,
}

impl Orders {
    /// Takes orders for the run of `instance` from now on, and hands over requests to it and screens that are to be attached.
    /// With `group`, members of that group have the same rights as this user.
    ///
    /// # Errors
    /// When the system provides no socket or no thread.
    pub fn receive(
        instance: Option<&str>,
        group: Option<u32>,
        permission: Arc<Permission>,
        run: Sender<Arrival>,
    ) -> io::Result<Self> {
        let listener = UnixListener::bind_addr(&address(&name(this_user(), instance, std::process::id()))?)?;
        listener.set_nonblocking(true)?;
        let stop = Arc::new(eventfd(0, EventfdFlags::CLOEXEC)?);
        let waiting = Vec::with_capacity(CONNECTIONS);
        let desk = Desk { listener, stop: Arc::clone(&stop), waiting, permission, run, group };
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
    run: Sender<Arrival>,
    group: Option<u32>,
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
            for mut one in std::mem::take(&mut self.waiting) {
                let taken =
                    if ready_of.next().unwrap_or(false) { one.receive(&self.permission) } else { Taken::Nothing };
                self.handle(one, taken, now);
            }
            if ready.get(1) == Some(&true) {
                self.accept(now);
            }
        }
    }

    fn accept(&mut self, now: Stamp) {
        while let Ok((stream, _)) = self.listener.accept() {
            let is_member = |group| Peer::is_member(&stream, group);
            let is_allowed = Peer::from_stream(&stream).is_ok_and(|peer| peer.user == this_user() || peer.user == 0)
                || self.group.is_some_and(is_member);
            if !is_allowed || stream.set_nonblocking(true).is_err() {
                continue;
            }
            if self.waiting.len() >= CONNECTIONS {
                self.waiting.remove(0);
            }
            let mut one = Waiting { stream, since: now, line: Vec::new() };
            let taken = one.receive(&self.permission);
            self.handle(one, taken, now);
        }
    }

    fn handle(&mut self, one: Waiting, taken: Taken, now: Stamp) {
        match taken {
            Taken::Nothing if now.since(one.since) < PATIENCE => self.waiting.push(one),
            Taken::Nothing | Taken::All => {}
            Taken::Request(request) => self.hand_over(Arrival::Asked(Asked { request, at: now, stream: one.stream })),
            Taken::Attach { read_only } => self.hand_over(Arrival::Viewer(Viewer { stream: one.stream, read_only })),
        }
    }

    fn hand_over(&self, arrival: Arrival) {
        if let Err(TrySendError::Full(arrival) | TrySendError::Closed(arrival)) = self.run.try_send(arrival) {
            arrival.refuse();
        }
    }
}

/// What a connection has sent.
#[derive(Debug, PartialEq, Eq)]
enum Taken {
    /// No whole line.
    Nothing,
    /// All that it will: it is finished.
    All,
    /// This.
    Request(Wanted),
    /// The wish to be attached as a screen.
    Attach { read_only: bool },
}

impl Waiting {
    /// Reads what was sent, and carries out an order.
    fn receive(&mut self, permission: &Permission) -> Taken {
        let mut bytes = [0; 4096];
        match self.stream.read(&mut bytes) {
            Ok(0) => return Taken::All,
            Ok(count) => self.line.extend_from_slice(bytes.get(..count).unwrap_or_default()),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {
                return Taken::Nothing;
            }
            Err(_) => return Taken::All,
        }
        let Some(end) = self.line.iter().position(|byte| *byte == b'\n') else {
            return if self.line.len() < LONGEST { Taken::Nothing } else { Taken::All };
        };
        let line = self.line.get(..end).and_then(|line| str::from_utf8(line).ok());
        if let Some(json) = line.filter(|line| line.starts_with('{')) {
            match Wanted::read(json) {
                Ok(request) => return Taken::Request(request),
                Err(error) => return self.reply(&format!("not a request: {error}")),
            }
        }
        if let Some(place) = line.and_then(|line| ATTACH.iter().position(|word| *word == line)) {
            return Taken::Attach { read_only: place == 1 };
        }
        let answer = match line.and_then(order) {
            None => "not an order: write `arm NS` or `disarm NS`, or a request as JSON".to_owned(),
            Some((Order::Disarm | Order::Emergency(_), _)) => {
                permission.disarm(Stamp::now());
                DONE.to_owned()
            }
            // The sender has ended, or no longer waits.
            Some((Order::Arm | Order::ArmBack, _)) if self.is_left() => return Taken::All,
            Some((Order::ArmBack, given)) => {
                permission.arm_back(given, Stamp::now()).map_or_else(|void| void.to_string(), |()| DONE.to_owned())
            }
            Some((Order::Arm, given)) => {
                permission.arm(given, Stamp::now()).map_or_else(|void| void.to_string(), |()| DONE.to_owned())
            }
        };
        self.reply(&answer)
    }

    fn reply(&mut self, answer: &str) -> Taken {
        // There is room for a line, or there is no reader.
        let _ = self.stream.write_all(format!("{answer}\n").as_bytes());
        Taken::All
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
            assert_eq!(waiting.receive(&permission), Taken::All);
            assert_eq!(attended.take_pending().collect::<Vec<_>>(), taken, "{order:?}, gone: {is_gone}");
            drop(giver);
        }
    }
}
