//! Devices at a fixed address: queried once a second.
//!
//! Invariant: a device from which its driver receives is not queried; it may accept only one connection.

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::remote::{HEAD, Head, Kind};
use rapid_core::time::Stamp;
use rapid_registry::device::LastReceived;
use rapid_registry::{Probe, own_side};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpStream, UdpSocket};
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};

use super::super::UnplugSource;
use super::watch::Watch;
use crate::link::LOOK_EVERY;

/// Interval between queries; also the time limit of an answer.
const EVERY: Duration = Duration::from_secs(1);

/// How a device is queried.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Question {
    /// Whether it accepts a TCP connection.
    Tcp,
    /// Whether it answers an HTTP request.
    Http,
    /// Whether its packets arrive.
    Udp,
    /// `rapid-remote` is sent this line.
    Remote(String),
}

impl From<Probe> for Question {
    /// A question to `rapid-remote` needs its line: without one the port alone is tried.
    fn from(probe: Probe) -> Self {
        match probe {
            Probe::Tcp | Probe::Remote => Self::Tcp,
            Probe::Http => Self::Http,
            Probe::Udp => Self::Udp,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Answer {
    Here,
    /// Its address answers, and the port is closed.
    Refused,
    Silence,
}

/// Monitors an entry whose device is at `server` and is queried at `asked`.
pub(super) async fn watch(mut watch: Watch, server: SocketAddr, asked: SocketAddr, question: Question) {
    let question = Arc::new(question);
    // It accepts any number of connections, so that its refusal is one.
    let is_shared = matches!(*question, Question::Remote(_));
    let mut look = interval(LOOK_EVERY);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut answer: Pin<Box<dyn Future<Output = Answer> + Send>> = Box::pin(ask(Arc::clone(&question), asked));
    loop {
        tokio::select! {
            answered = &mut answer => {
                let now = Stamp::now();
                match answered {
                    Answer::Here => watch.found(server, None, now).await,
                    // A server that accepts one connection refuses the next while the driver holds it.
                    Answer::Refused if !is_shared && watch.is_sending(watch.length, now) => {}
                    Answer::Refused => watch.gone(UnplugSource::Lease, now).await,
                    Answer::Silence => {}
                }
                let driver_has_port = *question == Question::Udp && watch.is_there();
                answer = Box::pin(next(watch.last_received.clone(), driver_has_port, Arc::clone(&question), asked));
            }
            _ = look.tick() => watch.check(Stamp::now()).await,
        }
    }
}

/// The next query; none if the driver receives from the device, or holds the port it sends to.
async fn next(
    last_received: LastReceived,
    driver_has_port: bool,
    question: Arc<Question>,
    asked: SocketAddr,
) -> Answer {
    sleep(EVERY).await;
    let is_received = Stamp::now().since(last_received.at()) < EVERY;
    if is_received || driver_has_port { Answer::Silence } else { ask(question, asked).await }
}

async fn ask(question: Arc<Question>, asked: SocketAddr) -> Answer {
    let answer = async {
        match &*question {
            Question::Tcp => TcpStream::connect(asked).await.map(|_| Answer::Here),
            Question::Http => http(asked).await,
            Question::Udp => udp(asked).await,
            Question::Remote(request) => remote(asked, request).await,
        }
    };
    match timeout(EVERY, answer).await {
        Ok(Ok(answer)) => answer,
        Ok(Err(error)) if error.kind() == io::ErrorKind::ConnectionRefused => Answer::Refused,
        Ok(Err(error)) => {
            tracing::debug!(%asked, %error, "no answer");
            Answer::Silence
        }
        Err(_) => Answer::Silence,
    }
}

/// An answer counts whatever its status.
async fn http(asked: SocketAddr) -> io::Result<Answer> {
    const BEGINNING: &[u8] = b"HTTP/1.";
    let mut stream = TcpStream::connect(asked).await?;
    stream.write_all(format!("HEAD / HTTP/1.1\r\nHost: {asked}\r\nConnection: close\r\n\r\n").as_bytes()).await?;
    let mut beginning = [0; BEGINNING.len()];
    stream.read_exact(&mut beginning).await?;
    Ok(if beginning == BEGINNING { Answer::Here } else { Answer::Silence })
}

/// Sends the line and reads the first frame.
async fn remote(asked: SocketAddr, request: &str) -> io::Result<Answer> {
    let mut stream = TcpStream::connect(asked).await?;
    stream.write_all(request.as_bytes()).await?;
    let mut head = [0; HEAD];
    stream.read_exact(&mut head).await?;
    // What follows a sample's head is not read here.
    Ok(match Head::read(&head, usize::MAX) {
        Ok(Head { kind: Kind::Refused, .. }) => Answer::Refused,
        Ok(_) => Answer::Here,
        Err(_) => Answer::Silence,
    })
}

/// Receives a packet of the device at a local port, which is released at once.
async fn udp(asked: SocketAddr) -> io::Result<Answer> {
    let socket = UdpSocket::bind((own_side(Some(asked.ip())), asked.port())).await?;
    loop {
        let (_, from) = socket.recv_from(&mut [0; 1]).await?;
        if from.ip().to_canonical() == asked.ip().to_canonical() {
            return Ok(Answer::Here);
        }
    }
}

#[cfg(test)]
mod tests;
