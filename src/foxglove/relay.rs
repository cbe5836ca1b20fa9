//! Between each client and the server of the crate `foxglove`: what waits for a client that reads slowly.
//!
//! The crate has one queue for a client, in which a picture waits behind everything that came before it, and does not
//! report how full the queue is. So the crate listens on a loopback port of its own, and here is what listens for clients:
//! whatever the crate sends is read at once, and waits here, by topic.
//!
//! Invariant: of a topic that a client subscribes to, no more than [`TOPIC_BYTES`] wait for it, or one message that is
//! larger; the oldest are left out. So a picture of half of that or more waits alone until a newer one replaces it, and a
//! topic of small messages is complete unless its client stays behind for as long as these take to be as many.
//! Invariant: what is not a message of a topic (channels, answers of services) is never left out: a client that leaves more
//! than [`OTHER_BYTES`] of it unread is disconnected, and so is one for which more than [`CLIENT_BYTES`] wait altogether.
//! Invariant: a connection without a handshake ends after [`LIMIT`], and so does one whose server has ended.

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::net::SocketAddr;
use std::pin::pin;
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::Stamp;
use rustix::net::sockopt::{
    set_socket_keepalive, set_socket_send_buffer_size, set_tcp_keepcnt, set_tcp_keepidle, set_tcp_keepintvl,
};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;

use super::{IDLE_TURN, REPORT_EVERY};

/// What waits of one topic for one client: three seconds of the mask, the newest picture of most cameras.
const TOPIC_BYTES: usize = 64 << 10;
/// What waits for one client that belongs to no topic, with [`FRAME_COST`].
const OTHER_BYTES: usize = 16 << 20;
/// What waits for one client altogether, with [`FRAME_COST`]: a picture of each of many cameras.
const CLIENT_BYTES: usize = 64 << 20;
/// What a frame that waits costs beyond its bytes, at most: its places in the queues, and the allocator's own.
const FRAME_COST: usize = 256;
/// What the kernel holds of one connection, beyond what waits here: it is sent whatever its age.
const KERNEL_BYTES: usize = 256 << 10;
/// What is read at a time, at least.
const READ_BYTES: usize = 64 << 10;
/// Connections at a time: more are closed at once.
const CONNECTIONS: usize = 32;
/// Time for a client's handshake, and for what it has not read yet when the server has ended.
pub(super) const LIMIT: Duration = Duration::from_secs(10);
/// A client's machine that is silent for this long is asked whether it is there, and after so many times without an answer
/// the connection ends.
const SILENCE: Duration = Duration::from_secs(30);
const PROBE_EVERY: Duration = Duration::from_secs(5);
const PROBES: u32 = 6;

/// A listener for clients.
///
/// # Errors
/// When the address is in use or none of this machine.
pub(super) async fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let listener = TcpListener::bind(address).await?;
    // Its connections inherit them.
    set_socket_send_buffer_size(&listener, KERNEL_BYTES)?;
    set_socket_keepalive(&listener, true)?;
    set_tcp_keepidle(&listener, SILENCE)?;
    set_tcp_keepintvl(&listener, PROBE_EVERY)?;
    set_tcp_keepcnt(&listener, PROBES)?;
    Ok(listener)
}

/// Connects clients to `server` until `stop`; then until the last connection has ended. `limit` is [`LIMIT`].
pub(super) async fn serve(listener: TcpListener, server: SocketAddr, limit: Duration, stop: CancellationToken) {
    let mut relays = JoinSet::new();
    loop {
        tokio::select! {
            () = stop.cancelled() => break,
            Some(_) = relays.join_next() => {}
            accepted = listener.accept() => match accepted {
                Ok((client, address)) if relays.len() < CONNECTIONS => {
                    relays.spawn(async move {
                        if let Err(error) = relay(client, address, server, limit).await {
                            tracing::info!(%error, "Foxglove: the connection of client {address} has ended");
                        }
                    });
                }
                Ok((_, address)) => tracing::info!("Foxglove: {CONNECTIONS} connections at a time: {address} is refused"),
                // The process has no descriptor left: others may end soon.
                Err(_) => sleep(IDLE_TURN).await,
            },
        }
    }
    drop(listener);
    while relays.join_next().await.is_some() {}
}

/// One client, until it or the server ends the connection, or a limit does.
async fn relay(client: TcpStream, address: SocketAddr, server: SocketAddr, limit: Duration) -> io::Result<()> {
    client.set_nodelay(true)?;
    let connected = timeout(limit, TcpStream::connect(server)).await.unwrap_or_else(|elapsed| Err(elapsed.into()));
    let server = connected.inspect_err(|error| {
        tracing::warn!(
            %error,
            "Foxglove: client {address} is closed: no connection to {server}, where the library listens on this \
             machine; a service with IPAddressDeny= needs IPAddressAllow=localhost, whatever the address of --foxglove"
        );
    })?;
    let mut waiting = Waiting::default();
    let ended = exchange(client, address, server, limit, &mut waiting).await;
    waiting.report(address);
    ended
}

async fn exchange(
    client: TcpStream,
    address: SocketAddr,
    server: TcpStream,
    limit: Duration,
    waiting: &mut Waiting,
) -> io::Result<()> {
    let (mut requests, mut replies) = client.into_split();
    let (mut sent, mut asked) = server.into_split();
    // When the client has closed its half, so is the server's.
    let mut forward = pin!(async move { tokio::io::copy(&mut requests, &mut asked).await });
    let mut overdue = pin!(sleep(limit));
    let mut frames = Frames::default();
    let (mut pending, mut written) = (Vec::new(), 0);
    let (mut is_asked, mut is_fed, mut reported) = (true, true, Stamp::now());
    while is_fed || written < pending.len() {
        frames.received.reserve(READ_BYTES);
        tokio::select! {
            // First: nothing is left out for a client whose connection takes it.
            biased;
            count = replies.write(&pending[written..]), if written < pending.len() => written += count?,
            count = sent.read_buf(&mut frames.received), if is_fed => {
                is_fed = count.is_ok_and(|count| count > 0);
                if !is_fed {
                    overdue.as_mut().reset(Instant::now() + limit);
                }
                while let Some((topic, frame)) = frames.next() {
                    waiting.push(topic, frame)?;
                }
            }
            // An error ends the requests alone: what still waits is sent, unless that fails too.
            _ = &mut forward, if is_asked => is_asked = false,
            () = &mut overdue, if !is_fed || frames.stage == Stage::Response => {
                let why = if is_fed { "no handshake" } else { "the server has ended, and the rest is not read" };
                return Err(io::Error::new(io::ErrorKind::TimedOut, why));
            }
        }
        if written == pending.len()
            && let Some(frame) = waiting.pop()
        {
            (pending, written) = (frame, 0);
        }
        if Stamp::now().since(reported) >= REPORT_EVERY {
            reported = Stamp::now();
            waiting.report(address);
        }
    }
    Ok(())
}

/// The number that a client gave to its subscription of a topic, of a frame with a message for it. `None` is every other
/// frame.
type Topic = Option<u32>;

/// What was received from the server, until it is whole.
#[derive(Debug, Default)]
struct Frames {
    received: Vec<u8>,
    stage: Stage,
}

#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// The response to the client's request comes first.
    #[default]
    Response,
    /// Then frames (RFC 6455, section 5.2).
    Frames,
    /// Or why there are none.
    Refusal,
}

impl Frames {
    /// Takes the next frame off, or the response.
    fn next(&mut self) -> Option<(Topic, Vec<u8>)> {
        /// Begins the response to a client that gets frames.
        const UPGRADED: &[u8] = b"HTTP/1.1 101 ";
        let (topic, length) = match self.stage {
            Stage::Response => {
                let end = self.received.windows(4).position(|four| four == b"\r\n\r\n")?;
                self.stage = if self.received.starts_with(UPGRADED) { Stage::Frames } else { Stage::Refusal };
                (None, end + 4)
            }
            Stage::Frames => frame(&self.received)?,
            Stage::Refusal => (None, Some(self.received.len()).filter(|length| *length > 0)?),
        };
        // Copied: what waits must hold no more memory than it has bytes.
        let frame = self.received.get(..length)?.to_vec();
        self.received.drain(..length);
        Some((topic, frame))
    }
}

/// The first frame of these bytes: its topic and length. `None` if it is not whole. A server's frames are not masked, and the
/// crate sends each message in one.
fn frame(bytes: &[u8]) -> Option<(Topic, usize)> {
    /// The last frame of a binary message, and messages of topics among these: then the subscription.
    const BINARY: u8 = 0x82;
    const MESSAGE_DATA: u8 = 1;
    let (begin, length) = match bytes {
        [_, 126, rest @ ..] => (4, u64::from(u16::from_be_bytes(*rest.first_chunk()?))),
        [_, 127, rest @ ..] => (10, u64::from_be_bytes(*rest.first_chunk()?)),
        [_, length, ..] => (2, u64::from(*length)),
        _ => return None,
    };
    let end = usize::try_from(length).ok()?.checked_add(begin)?;
    let topic = match (bytes.first()?, bytes.get(begin..end)?) {
        (&BINARY, [MESSAGE_DATA, rest @ ..]) => rest.first_chunk().map(|id| u32::from_le_bytes(*id)),
        _ => None,
    };
    Some((topic, end))
}

/// What waits for a client.
#[derive(Debug, Default)]
struct Waiting {
    topics: BTreeMap<Topic, Track>,
    /// Bytes of all frames, each with [`FRAME_COST`].
    cost: usize,
    /// Frames that have come.
    count: u64,
    /// Frames that were left out, and not reported yet.
    left_out: u64,
}

/// Of one topic: bytes, and frames with their numbers, the oldest first; never empty.
#[derive(Debug, Default)]
struct Track {
    bytes: usize,
    frames: VecDeque<(u64, Vec<u8>)>,
}

impl Waiting {
    /// Adds a frame, and leaves out older ones of its topic that are too much with it.
    ///
    /// # Errors
    /// When there is too much that is never left out, or too much altogether. The client has to be disconnected then.
    fn push(&mut self, topic: Topic, frame: Vec<u8>) -> io::Result<()> {
        let track = self.topics.entry(topic).or_default();
        while topic.is_some() && track.bytes + frame.len() > TOPIC_BYTES {
            let Some((_, oldest)) = track.frames.pop_front() else { break };
            track.bytes -= oldest.len();
            self.cost -= oldest.len() + FRAME_COST;
            self.left_out += 1;
        }
        track.bytes += frame.len();
        self.cost += frame.len() + FRAME_COST;
        track.frames.push_back((self.count, frame));
        self.count += 1;
        if topic.is_none() && track.bytes + track.frames.len() * FRAME_COST > OTHER_BYTES {
            return Err(io::Error::other("it sends requests and does not read the answers"));
        }
        if self.cost > CLIENT_BYTES {
            return Err(io::Error::other("it subscribes to more than it reads"));
        }
        Ok(())
    }

    /// Reports what was left out since the last report.
    fn report(&mut self, address: SocketAddr) {
        let left_out = std::mem::take(&mut self.left_out);
        if left_out > 0 {
            let which = text::counted(left_out, "message");
            tracing::info!("Foxglove: client {address} reads slowly: {which} left out for newer ones");
        }
    }

    /// Takes the oldest frame.
    fn pop(&mut self) -> Option<Vec<u8>> {
        let oldest = |(topic, track): (&Topic, &Track)| Some((track.frames.front()?.0, *topic));
        let (_, topic) = self.topics.iter().filter_map(oldest).min()?;
        let track = self.topics.get_mut(&topic)?;
        let (_, frame) = track.frames.pop_front()?;
        track.bytes -= frame.len();
        self.cost -= frame.len() + FRAME_COST;
        if track.frames.is_empty() {
            self.topics.remove(&topic);
        }
        Some(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame of the server with a message of this topic, or with text, and so many bytes of content.
    fn frame_of(topic: Topic, content: &[u8]) -> Vec<u8> {
        let payload = match topic {
            Some(topic) => [&[1][..], &topic.to_le_bytes(), &[0; 8], content].concat(),
            None => content.to_vec(),
        };
        let kind = if topic.is_some() { 0x82 } else { 0x81 };
        let head = match payload.len() {
            length @ ..126 => vec![kind, u8::try_from(length).unwrap()],
            length @ ..65_536 => [&[kind, 126][..], &u16::try_from(length).unwrap().to_be_bytes()].concat(),
            length => [&[kind, 127][..], &u64::try_from(length).unwrap().to_be_bytes()].concat(),
        };
        [head, payload].concat()
    }

    #[test]
    fn frames_are_found_however_they_come() {
        let response = b"HTTP/1.1 101 Switching Protocols\r\nconnection: Upgrade\r\n\r\n".to_vec();
        let mut expected = vec![(None, response)];
        for length in [0, 112, 113, 300, 70_000] {
            expected.extend([Some(7), None].map(|topic| (topic, frame_of(topic, &vec![5; length]))));
        }
        expected.push((None, vec![0x88, 0]));
        let all: Vec<u8> = expected.iter().flat_map(|(_, frame)| frame.clone()).collect();
        for size in [1, 2, 7, 1000, all.len()] {
            let (mut frames, mut found) = (Frames::default(), Vec::new());
            for part in all.chunks(size) {
                frames.received.extend_from_slice(part);
                found.extend(std::iter::from_fn(|| frames.next()));
            }
            assert!(found == expected && frames.received.is_empty(), "{size} bytes at a time");
        }
        let received = b"HTTP/1.1 400 Bad Request\r\n\r\nMissing".to_vec();
        let mut refused = Frames { received, ..Frames::default() };
        let parts: Vec<_> = std::iter::from_fn(|| refused.next()).collect();
        assert_eq!(parts, [(None, b"HTTP/1.1 400 Bad Request\r\n\r\n".to_vec()), (None, b"Missing".to_vec())]);
    }

    #[test]
    fn the_newest_picture_waits_and_every_small_message() {
        let mut waiting = Waiting::default();
        let (mut expected, mut left_out) = (Vec::new(), 0);
        for number in 0_u32..1000 {
            let small = frame_of(Some(1), &number.to_le_bytes());
            let other = frame_of(None, &number.to_le_bytes());
            for (topic, frame) in [(Some(1), &small), (None, &other)] {
                waiting.push(topic, frame.clone()).unwrap();
                expected.push(frame.clone());
            }
            for camera in [2, 3] {
                let picture = frame_of(Some(camera), &number.to_le_bytes().repeat(10_000));
                waiting.push(Some(camera), picture.clone()).unwrap();
                if number == 999 {
                    expected.push(picture);
                } else {
                    left_out += 1;
                }
            }
        }
        assert_eq!(waiting.left_out, left_out);
        let popped: Vec<_> = std::iter::from_fn(|| waiting.pop()).collect();
        assert!(popped == expected, "{} frames", popped.len());
        assert!(waiting.topics.is_empty() && waiting.cost == 0);
    }

    #[test]
    fn what_waits_is_bounded() {
        let mut waiting = Waiting::default();
        let frame = frame_of(Some(1), &[0; 1000]);
        let most = TOPIC_BYTES / frame.len();
        for _ in 0..3 * most {
            waiting.push(Some(1), frame.clone()).unwrap();
        }
        assert_eq!(std::iter::from_fn(|| waiting.pop()).count(), most);
        let answer = frame_of(None, &vec![0; 1 << 20]);
        let fits = (0..100).take_while(|_| waiting.push(None, answer.clone()).is_ok()).count();
        assert_eq!(fits, 15, "their heads count too");
    }

    #[test]
    fn neither_many_subscriptions_nor_tiny_frames_get_around_the_limits() {
        let fits = |frames: &mut dyn Iterator<Item = (Topic, Vec<u8>)>| {
            let mut waiting = Waiting::default();
            frames.take_while(|(topic, frame)| waiting.push(*topic, frame.clone()).is_ok()).count()
        };
        let picture = frame_of(Some(0), &vec![0; 200_000]);
        let pictures = fits(&mut (0..10_000).map(|id| (Some(id), picture.clone())));
        assert_eq!(pictures, CLIENT_BYTES / (picture.len() + FRAME_COST));
        let message = frame_of(Some(0), &[]);
        let messages = fits(&mut (0..1_000_000).map(|id| (Some(id), message.clone())));
        assert_eq!(messages, CLIENT_BYTES / (message.len() + FRAME_COST));
        let pongs = fits(&mut std::iter::repeat_n((None, vec![0x8a, 0]), 1_000_000));
        assert_eq!(pongs, OTHER_BYTES / (2 + FRAME_COST));
    }

    /// Of a test whose clock is moved.
    const HOUR: Duration = Duration::from_hours(1);

    /// A client, the server's end of its connection, and the relay between them.
    async fn connected() -> (TcpStream, TcpStream, tokio::task::JoinHandle<io::Result<()>>) {
        let front = listen(([127, 0, 0, 1], 0).into()).await.unwrap();
        let back = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let client = TcpStream::connect(front.local_addr().unwrap()).await.unwrap();
        let (accepted, address) = front.accept().await.unwrap();
        let relay = tokio::spawn(relay(accepted, address, back.local_addr().unwrap(), HOUR));
        let (server, _) = back.accept().await.unwrap();
        (client, server, relay)
    }

    #[tokio::test]
    async fn a_connection_without_a_handshake_ends_and_no_other() {
        let (mut client, mut server, relay) = connected().await;
        let greeting = b"HTTP/1.1 101 Switching Protocols\r\n\r\n";
        server.write_all(greeting).await.unwrap();
        client.read_exact(&mut vec![0; greeting.len()]).await.unwrap();
        let (silent, _server, silent_relay) = connected().await;
        // From here on the clock moves to the next limit whenever nothing else happens.
        tokio::time::pause();
        let error = silent_relay.await.unwrap().unwrap_err();
        assert_eq!((error.kind(), error.to_string().as_str()), (io::ErrorKind::TimedOut, "no handshake"));
        drop(silent);
        tokio::time::advance(2 * HOUR).await;
        let frame = frame_of(Some(1), &[7]);
        server.write_all(&frame).await.unwrap();
        let mut received = vec![0; frame.len()];
        client.read_exact(&mut received).await.unwrap();
        assert_eq!(received, frame);
        drop(server);
        relay.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn a_client_that_does_not_read_the_rest_is_closed() {
        let (client, mut server, relay) = connected().await;
        let picture = frame_of(Some(1), &vec![0; 16 << 20]);
        server.write_all(&[&b"HTTP/1.1 101 Switching Protocols\r\n\r\n"[..], &picture].concat()).await.unwrap();
        drop(server);
        tokio::time::pause();
        assert_eq!(relay.await.unwrap().unwrap_err().kind(), io::ErrorKind::TimedOut);
        drop(client);
    }
}
