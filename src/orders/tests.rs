//! Both sides over real sockets.

use std::io::{Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Arc;

use rapid_core::permission::{Attended, Permission};
use rapid_status::RegistryRequest;
use rapid_status::session::SessionRequest;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, listen, socket_with};
use tokio::sync::mpsc::{Receiver, channel};

use super::give::{GiveError, attach, give, request};
use super::receive::{Arrival, Asked, Orders, Wanted};
use super::*;
use Order::{Arm, Disarm};

/// A run's side, under a separate instance.
struct Run {
    instance: String,
    permission: Arc<Permission>,
    requests: Receiver<Arrival>,
    _orders: Orders,
}

fn run(test: &str) -> Run {
    let instance = format!("orders-{test}-{}", std::process::id());
    let permission = Arc::new(Permission::new(false));
    let (arrivals, requests) = channel(2);
    let orders = Orders::receive(Some(&instance), None, Arc::clone(&permission), arrivals).unwrap();
    Run { instance, permission, requests, _orders: orders }
}

impl Run {
    fn connect(&self) -> UnixStream {
        let name = name(this_user(), Some(&self.instance), std::process::id());
        UnixStream::connect_addr(&address(&name).unwrap()).unwrap()
    }

    fn asked(&mut self) -> Asked {
        match self.requests.blocking_recv() {
            Some(Arrival::Asked(asked)) => asked,
            other => panic!("{other:?}"),
        }
    }

    fn give(&self, order: Order) -> Result<(), String> {
        give(Some(&self.instance), order).map_err(|error| error.to_string())
    }
}

fn taken(attended: &Attended) -> Vec<Order> {
    attended.take_pending().collect()
}

/// The answer to these bytes.
fn answered(stream: &mut UnixStream, bytes: &[u8]) -> String {
    stream.write_all(bytes).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[test]
fn an_answered_order_has_been_carried_out() {
    let run = run("a");
    // A disarm needs no actuator, an arm does.
    assert_eq!(run.give(Disarm), Ok(()));
    let refused = run.give(Arm).unwrap_err();
    assert!(refused.contains("no actuator is plugged in"), "{refused}");
    let attended = run.permission.attend();
    assert_eq!(run.give(Arm), Ok(()));
    assert_eq!(taken(&attended), [Arm]);
    assert_eq!(run.give(Disarm), Ok(()));
    assert_eq!(taken(&attended), [Disarm]);
}

#[test]
fn without_a_run_and_after_its_end_there_is_an_error_at_once() {
    let none = give(Some("orders-none"), Disarm).unwrap_err();
    assert!(matches!(none, GiveError::NoRun { .. }) && none.to_string().contains("orders-none"), "{none}");
    let run = run("b");
    let instance = run.instance.clone();
    drop(run);
    assert!(matches!(give(Some(&instance), Disarm), Err(GiveError::NoRun { .. })));
}

#[test]
fn a_socket_that_accepts_nothing_delays_no_order() {
    let run = run("busy");
    let attended = run.permission.attend();
    // As any user can create one: with no room for another connection.
    let process = u32::MAX;
    let address = address(&name(this_user(), Some(&run.instance), process)).unwrap();
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, SocketFlags::NONBLOCK, None).unwrap();
    let bound = SocketAddrUnix::new_abstract_name(address.as_abstract_name().unwrap()).unwrap();
    bind(&socket, &bound).unwrap();
    listen(&socket, 0).unwrap();
    let mut waiting = Vec::new();
    loop {
        let one = socket_with(AddressFamily::UNIX, SocketType::STREAM, SocketFlags::NONBLOCK, None).unwrap();
        if rustix::net::connect(&one, &bound).is_err() {
            break;
        }
        waiting.push(one);
    }
    assert_eq!(run.give(Disarm), Ok(()));
    assert_eq!(taken(&attended), [Disarm]);
    // Alone it is not a run, and that is detected.
    let instance = run.instance.clone();
    drop(run);
    assert!(matches!(give(Some(&instance), Disarm), Err(GiveError::NoRun { .. })));
}

#[test]
fn an_order_without_a_run_lists_those_of_other_instances() {
    let run = run("other");
    let why = give(Some("orders-none-at-all"), Disarm).unwrap_err().to_string();
    let process = std::process::id();
    let meant = format!("process {process} does (`--instance {}`)", run.instance);
    assert!(why.starts_with("no rapid of instance orders-none-at-all runs here for this user, but "), "{why}");
    assert!(why.contains(&meant), "{why}");
}

#[test]
fn an_arm_from_the_past_or_the_future_does_nothing() {
    let run = run("c");
    let attended = run.permission.attend();
    let old = Stamp::now().before(std::time::Duration::from_secs(2));
    let answer = answered(&mut run.connect(), line(Arm, old).as_bytes());
    assert!(answer.contains("the order is 2.0 s old"), "{answer}");
    let early = answered(&mut run.connect(), line(Arm, Stamp(u64::MAX)).as_bytes());
    assert!(early.contains("later time"), "{early}");
    assert_eq!(taken(&attended), []);
    // A disarm counts however old it is, and whether or not its sender waits.
    run.connect().write_all(line(Disarm, Stamp(0)).as_bytes()).unwrap();
    assert_eq!(answered(&mut run.connect(), b"disarm 1\n"), "done\n");
    assert_eq!(taken(&attended), [Disarm]);
}

#[test]
fn an_invalid_order_moves_nothing_and_delays_no_other() {
    let run = run("d");
    let attended = run.permission.attend();
    // More connections than are held, which send nothing, or half a line.
    let mut silent: Vec<_> = (0..40).map(|_| run.connect()).collect();
    for stream in silent.iter_mut().step_by(2) {
        // Those before the last few are closed by now.
        let _ = stream.write_all(b"ar");
    }
    for bytes in [
        &b"arm\n"[..],
        b"arm x\n",
        b"arm -1\n",
        b"ARM 1\n",
        b"arm 1 1\n",
        b"\n",
        b"\xff\xfe\n",
        b"arm 99999999999999999999999\n",
    ] {
        let answer = answered(&mut run.connect(), bytes);
        assert!(answer.contains("not an order"), "{bytes:?}: {answer}");
    }
    // It is closed at once: with unread bytes, which is an error here.
    let mut endless = run.connect();
    let _ = endless.write_all(&vec![b'x'; 4 * LONGEST]).and_then(|()| endless.read_to_string(&mut String::new()));
    assert_eq!(run.give(Disarm), Ok(()));
    assert_eq!(taken(&attended), [Disarm]);
}

#[test]
fn an_unresponsive_socket_is_named_with_its_process() {
    let instance = format!("orders-e-{}", std::process::id());
    let name = name(this_user(), Some(&instance), std::process::id());
    let listener = UnixListener::bind_addr(&address(&name).unwrap()).unwrap();
    let closes = std::thread::spawn(move || drop(listener.accept()));
    let error = give(Some(&instance), Disarm).unwrap_err();
    assert!(error.to_string().contains(&format!("process {} does not answer", std::process::id())), "{error}");
    closes.join().unwrap();
}

#[test]
fn a_request_is_answered_when_the_run_answers_it() {
    let mut run = run("session");
    let note = SessionRequest::Note { episode: None, text: "\"a\nnote\" \u{1b}".repeat(100) };
    let instance = run.instance.clone();
    let sent = note.clone();
    let giver = std::thread::spawn(move || request(Some(&instance), &sent).map_err(|error| error.to_string()));
    let asked = run.asked();
    assert_eq!(asked.request, Wanted::Session(note));
    asked.answer(Ok("noted\nin two lines".to_owned()));
    assert_eq!(giver.join().unwrap(), Ok("noted\nin two lines".to_owned()));
    // An answer longer than a socket holds.
    let instance = run.instance.clone();
    let giver = std::thread::spawn(move || request(Some(&instance), &SessionRequest::Stop).unwrap_err().to_string());
    run.asked().answer(Err("x".repeat(1 << 20)));
    assert!(giver.join().unwrap().len() > 1 << 20);
    // The run ends without an answer.
    let instance = run.instance.clone();
    let giver = std::thread::spawn(move || request(Some(&instance), &SessionRequest::Stop));
    drop(run.asked());
    assert!(matches!(giver.join().unwrap(), Err(GiveError::Unanswered { .. })));
}

#[test]
fn what_is_no_request_is_refused_and_disturbs_nothing() {
    let mut run = run("no-session");
    for text in ["{\n", "{\"do\":\"fly\"}\n", "{\"do\":\"note\"}\n"] {
        let answer = answered(&mut run.connect(), text.as_bytes());
        assert!(answer.starts_with("not a request: "), "{answer}");
    }
    let answer = answered(&mut run.connect(), &vec![b'x'; LONGEST]);
    assert_eq!(answer, "");
    // A requester that has ended is not answered; the request counts.
    let mut gone = run.connect();
    gone.write_all(b"{\"do\":\"stop\"}\n").unwrap();
    drop(gone);
    let asked = run.asked();
    assert_eq!(asked.request, Wanted::Session(SessionRequest::Stop));
    asked.answer(Ok(String::new()));
    let mut about = run.connect();
    about.write_all(b"{\"do\":\"reload\"}\n").unwrap();
    let asked = run.asked();
    assert_eq!(asked.request, Wanted::Registry(RegistryRequest::Reload));
    asked.answer(Ok(String::new()));
    // With its queue full, a run still answers.
    let waiting: Vec<_> = (0..2)
        .map(|_| {
            let mut one = run.connect();
            one.write_all(b"{\"do\":\"stop\"}\n").unwrap();
            one
        })
        .collect();
    let answer = loop {
        let answer = answered(&mut run.connect(), b"{\"do\":\"stop\"}\n");
        if !answer.is_empty() {
            break answer;
        }
    };
    assert!(answer.contains("does not take requests"), "{answer}");
    drop(waiting);
    assert_eq!(run.give(Disarm), Ok(()));
}

#[test]
fn a_screen_is_handed_over_and_does_not_count_as_a_connection() {
    let mut run = run("screen");
    for read_only in [false, true] {
        let (mut link, process) = attach(Some(&run.instance), read_only).unwrap();
        assert_eq!(process, std::process::id());
        let Some(Arrival::Viewer(mut viewer)) = run.requests.blocking_recv() else { panic!("no screen") };
        assert_eq!(viewer.read_only, read_only);
        viewer.stream.set_nonblocking(false).unwrap();
        viewer.stream.write_all(b"hello\n").unwrap();
        drop(viewer);
        let mut received = String::new();
        link.read_to_string(&mut received).unwrap();
        assert_eq!(received, "hello\n");
    }
    assert!(matches!(attach(Some("no-such-rig"), false), Err(GiveError::NoRun { .. })));
}
