//! Connections of clients: who is let in, and what each may send and hold.
//!
//! | limit | |
//! |---|---|
//! | connections | [`CONNECTIONS`]; then an old one that has shown nothing gives way, or one that watches nothing |
//! | time for the handshake, and for the rest of a message that has begun | [`LIMIT`] |
//! | size of a message, in however many parts | [`LARGEST_MESSAGE`] |
//! | messages | [`REQUESTS`] |
//! | what waits for a client, and for all | [`super::queue`], [`super::client`] |
//!
//! A page of another site, open in a browser on this machine or in its network, has another `Origin` than the app:
//! [`Origins`]. Programs that are no browsers send none.
//!
//! Invariant: what a client sends costs memory only until its message is whole, and no more than that.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context as Waker, Poll, ready};
use std::time::Duration;

use foxglove::Context;
use futures_util::{SinkExt as _, StreamExt as _};
use rapid_core::site;
use rustix::net::sockopt::{
    set_socket_keepalive, set_socket_send_buffer_size, set_tcp_keepcnt, set_tcp_keepidle, set_tcp_keepintvl,
};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::{interval, sleep, timeout};
use tokio_tungstenite::tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tokio_tungstenite::tungstenite::http::header::{HOST, ORIGIN, SEC_WEBSOCKET_PROTOCOL};
use tokio_tungstenite::tungstenite::http::{HeaderName, HeaderValue, StatusCode};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{WebSocketStream, accept_hdr_async_with_config};
use tokio_util::sync::CancellationToken;

use super::client::{Audience, Client};
use super::control::Controls;
use super::{IDLE_TURN, REPORT_EVERY};

/// The version of the protocol.
const PROTOCOL: &str = "foxglove.sdk.v1";
/// What the kernel holds of one connection, beyond what waits here: it is sent whatever its age.
const KERNEL_BYTES: usize = 256 << 10;
/// What is read at a time, at most.
const READ_BYTES: usize = 8 << 10;
/// The largest message of a client: subscriptions to all channels of a large rig are a quarter of it.
const LARGEST_MESSAGE: usize = 64 << 10;
/// Connections at a time.
const CONNECTIONS: usize = 32;
/// Time for a client's handshake, and for the rest of a message.
pub(super) const LIMIT: Duration = Duration::from_secs(10);
/// Requests of a client within [`LOOK_EVERY`]: more are not read before the next one. The thread has other clients, and the
/// topics.
const REQUESTS: usize = 50;
/// Time between two looks at what a client has not finished.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// A client's machine that is silent for this long is asked whether it is there, and after so many times without an answer
/// the connection ends.
const SILENCE: Duration = Duration::from_secs(30);
const PROBE_EVERY: Duration = Duration::from_secs(5);
const PROBES: u32 = 6;

/// Pages that are let in: the app in a browser, and the app as a program, which shows a file.
const APP: [&str; 2] = ["https://app.foxglove.dev", "file://"];

/// Which pages of browsers are let in.
#[derive(Debug, Clone, Default)]
pub(super) struct Origins {
    /// Beyond [`APP`].
    pub(super) more: Vec<String>,
    /// The name of this machine.
    pub(super) machine: String,
}

impl Origins {
    /// # Errors
    /// Why a request with these headers is refused.
    fn admit(&self, host: Option<&str>, origin: Option<&str>) -> Result<(), String> {
        // A page that another host has under the name of this machine has that as its origin.
        if !host.is_some_and(|host| site::is_own(host, Some(&self.machine))) {
            return Err("connect to the address of this machine, and not to another name".to_owned());
        }
        let Some(origin) = origin else { return Ok(()) };
        if APP.contains(&origin) || self.more.iter().any(|more| more == origin) {
            return Ok(());
        }
        Err(format!("this was requested by a page of {origin}; --foxglove-origin {origin} lets it in"))
    }

    /// Answers a request that may have the protocol.
    #[expect(clippy::result_large_err, reason = "the type is the crate's")]
    fn answer(&self, request: &Request, mut response: Response) -> Result<Response, ErrorResponse> {
        let text = |name: HeaderName| match request.headers().get(name).map(HeaderValue::to_str) {
            None => None,
            // Which no page has.
            Some(text) => Some(text.unwrap_or("?")),
        };
        let refused = |status, why: String| {
            tracing::info!("Foxglove: a connection is refused: {why}");
            let mut refusal = ErrorResponse::new(Some(why));
            *refusal.status_mut() = status;
            Err(refusal)
        };
        if let Err(why) = self.admit(text(HOST), text(ORIGIN)) {
            return refused(StatusCode::FORBIDDEN, why);
        }
        let offered = request.headers().get_all(SEC_WEBSOCKET_PROTOCOL).iter();
        let mut offered = offered.filter_map(|value| value.to_str().ok()).flat_map(|value| value.split(','));
        if !offered.any(|name| name.trim() == PROTOCOL) {
            return refused(StatusCode::BAD_REQUEST, format!("the client does not offer the protocol {PROTOCOL}"));
        }
        response.headers_mut().insert(SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static(PROTOCOL));
        Ok(response)
    }
}

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

/// What every connection has in common.
pub(super) struct Host {
    pub(super) context: Arc<Context>,
    pub(super) audience: Arc<Audience>,
    pub(super) controls: Option<Controls>,
    pub(super) origins: Origins,
    /// What each client gets first.
    pub(super) greeting: Vec<Message>,
    /// [`LIMIT`].
    pub(super) limit: Duration,
}

impl Host {
    /// Serves clients until `stop`; then until each has what waits for it.
    pub(super) async fn serve(self: Arc<Self>, listener: TcpListener, stop: CancellationToken) {
        let mut connections = JoinSet::new();
        loop {
            tokio::select! {
                () = stop.cancelled() => break,
                Some(_) = connections.join_next() => {}
                accepted = listener.accept() => match accepted {
                    Ok((stream, address)) => {
                        // Those that give way have not all noticed.
                        let is_full = connections.len() >= CONNECTIONS;
                        if is_full && (connections.len() >= 2 * CONNECTIONS || !self.audience.give_way()) {
                            continue;
                        }
                        let client = self.audience.add(address, &self.context);
                        connections.spawn(Arc::clone(&self).attend(stream, client, stop.clone()));
                    }
                    // The process has no descriptor left: others may end soon.
                    Err(_) => sleep(IDLE_TURN).await,
                },
            }
        }
        drop(listener);
        while connections.join_next().await.is_some() {}
    }

    async fn attend(self: Arc<Self>, stream: TcpStream, client: Arc<Client>, stop: CancellationToken) {
        let place = Place { host: &self, client: &client };
        let served = self.converse(stream, &client, &stop).await;
        client.report();
        drop(place);
        // Not one line for each that strangers begin.
        if let Err(error) = served
            && client.is_greeted()
        {
            tracing::info!(%error, "Foxglove: the connection of client {} has ended", client.address);
        }
    }

    async fn converse(&self, stream: TcpStream, client: &Arc<Client>, stop: &CancellationToken) -> Result<(), Error> {
        let ended = |why: &str| Error::Io(io::Error::other(why.to_owned()));
        stream.set_nodelay(true)?;
        let stream = Heard { stream, client: Arc::clone(client) };
        #[expect(clippy::result_large_err, reason = "the type is the crate's")]
        let answer = |request: &Request, response: Response| self.origins.answer(request, response);
        let limits = WebSocketConfig::default()
            .read_buffer_size(READ_BYTES)
            // What waits, waits in the client's queue.
            .write_buffer_size(0)
            .max_message_size(Some(LARGEST_MESSAGE))
            .max_frame_size(Some(LARGEST_MESSAGE));
        let socket = tokio::select! {
            socket = timeout(self.limit, accept_hdr_async_with_config(stream, answer, Some(limits))) => {
                socket.map_err(|_| ended("no handshake"))??
            }
            () = client.has_ended() => return Err(ended(client.end().unwrap_or_default())),
            () = stop.cancelled() => return Ok(()),
        };
        tracing::info!("Foxglove: client {} has connected", client.address);
        client.heard(true);
        client.greet(self.greeting.iter().cloned());
        self.exchange(socket, client, stop).await
    }

    /// Until the client ends the connection, or has everything after `stop`.
    async fn exchange(
        &self,
        socket: WebSocketStream<Heard>,
        client: &Arc<Client>,
        stop: &CancellationToken,
    ) -> Result<(), Error> {
        let ended = |why: &str| Error::Io(io::Error::other(why.to_owned()));
        let (mut replies, mut requests) = socket.split();
        let (mut is_pending, mut is_last, mut allowed) = (false, false, REQUESTS);
        let (mut looks, mut reports) = (interval(LOOK_EVERY), interval(REPORT_EVERY));
        loop {
            if let Some(why) = client.end() {
                return Err(ended(why));
            }
            if !is_pending {
                match client.pop() {
                    // It is taken at once: nothing is pending.
                    Some(message) => {
                        replies.feed(message).await?;
                        is_pending = true;
                    }
                    None if is_last => return replies.close().await,
                    None => {}
                }
            }
            tokio::select! {
                // First: nothing is left out for a client whose connection takes it.
                biased;
                flushed = replies.flush(), if is_pending => {
                    flushed?;
                    is_pending = false;
                }
                request = requests.next(), if allowed > 0 => match request {
                    Some(Ok(request)) => {
                        client.heard(true);
                        allowed -= 1;
                        if request.is_text() || request.is_binary() {
                            client.obey(&request, self.controls.as_ref());
                        }
                    }
                    Some(Err(Error::ConnectionClosed)) | None => return Ok(()),
                    Some(Err(error)) => return Err(error),
                },
                () = client.news.notified() => {}
                () = stop.cancelled(), if !is_last => is_last = true,
                _ = looks.tick() => {
                    allowed = REQUESTS;
                    if client.is_overdue(self.limit) {
                        return Err(ended("a message that it does not finish"));
                    }
                }
                _ = reports.tick() => client.report(),
            }
        }
    }
}

/// The place of a connection, which is free again when this is dropped, by a panic too.
struct Place<'a> {
    host: &'a Host,
    client: &'a Arc<Client>,
}

impl Drop for Place<'_> {
    fn drop(&mut self) {
        self.host.audience.remove(self.client);
    }
}

/// A connection that reports what it reads.
struct Heard {
    stream: TcpStream,
    client: Arc<Client>,
}

impl AsyncRead for Heard {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Waker<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = into.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(cx, into))?;
        if into.filled().len() > before {
            self.client.heard(false);
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Heard {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Waker<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Waker<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Waker<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use foxglove::{PartialMetadata, RawChannel, Schema};
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::task::JoinHandle;

    use super::*;

    const REQUEST: &[u8] = b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
        Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
        Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n";
    /// Of a test whose clock is moved.
    const HOUR: Duration = Duration::from_hours(1);

    struct Served {
        address: SocketAddr,
        audience: Arc<Audience>,
        channel: Arc<RawChannel>,
        stop: CancellationToken,
        task: JoinHandle<()>,
    }

    impl Served {
        async fn start() -> Self {
            let (context, audience, stop) = (Context::new(), Arc::new(Audience::default()), CancellationToken::new());
            let schema = Schema::new("Text", "jsonschema", b"{}");
            let channel = context.channel_builder("/a").message_encoding("json").schema(schema).build_raw().unwrap();
            let origins = Origins::default();
            let (greeting, audience_of) = (Vec::new(), Arc::clone(&audience));
            let host = Host { context, audience: audience_of, controls: None, origins, greeting, limit: HOUR };
            let listener = listen(([127, 0, 0, 1], 0).into()).await.unwrap();
            let address = listener.local_addr().unwrap();
            let task = tokio::spawn(Arc::new(host).serve(listener, stop.clone()));
            Self { address, audience, channel, stop, task }
        }

        async fn connect(&self) -> TcpStream {
            let stream = TcpStream::connect(self.address).await.unwrap();
            let own = stream.local_addr().unwrap();
            while !self.audience.clients.lock().unwrap().iter().any(|client| client.address == own) {
                tokio::task::yield_now().await;
            }
            stream
        }

        async fn greeted(&self) -> TcpStream {
            let mut stream = self.connect().await;
            stream.write_all(REQUEST).await.unwrap();
            let mut head = Vec::new();
            while !head.ends_with(b"\r\n\r\n") {
                head.push(stream.read_u8().await.unwrap());
            }
            assert!(head.starts_with(b"HTTP/1.1 101 "), "{}", String::from_utf8_lossy(&head));
            stream
        }

        /// One that subscribes to the channel, and has its first message.
        async fn subscribed(&self) -> TcpStream {
            let mut stream = self.greeted().await;
            let channel = u64::from(self.channel.id());
            let text = format!("{{\"op\":\"subscribe\",\"subscriptions\":[{{\"id\":7,\"channelId\":{channel}}}]}}");
            let length = u8::try_from(text.len()).unwrap();
            assert!(length < 126);
            stream.write_all(&[&[0x81, 0x80 | length, 0, 0, 0, 0], text.as_bytes()].concat()).await.unwrap();
            stream
        }

        async fn subscribers(&self, count: usize) {
            while self.audience.subscribers().len() != count {
                sleep(Duration::from_millis(1)).await;
            }
        }
    }

    /// Whether the server has closed it, after whatever it sent.
    async fn is_closed(stream: &mut TcpStream) -> bool {
        let mut rest = Vec::new();
        timeout(HOUR / 60, stream.read_to_end(&mut rest)).await.is_ok()
    }

    #[tokio::test]
    async fn what_is_not_finished_in_time_ends_and_nothing_else() {
        let served = Served::start().await;
        let (mut silent, mut begun, mut idle) =
            (served.connect().await, served.greeted().await, served.greeted().await);
        begun.write_all(&[0x81, 0xfe, 0x01]).await.unwrap();
        let mut slow = served.connect().await;
        slow.write_all(&REQUEST[..20]).await.unwrap();
        sleep(LOOK_EVERY).await;
        // From here on the clock moves to the next limit whenever nothing else happens.
        tokio::time::pause();
        tokio::time::advance(HOUR + LOOK_EVERY).await;
        for stream in [&mut silent, &mut slow, &mut begun] {
            assert!(is_closed(stream).await);
        }
        assert!(!is_closed(&mut idle).await);
        served.stop.cancel();
        served.task.await.unwrap();
        assert!(is_closed(&mut idle).await);
    }

    #[tokio::test]
    async fn the_oldest_that_shows_nothing_gives_way_and_no_subscriber() {
        let served = Served::start().await;
        let mut subscriber = served.subscribed().await;
        served.subscribers(1).await;
        let mut idle = served.greeted().await;
        let mut silent = Vec::new();
        while silent.len() + 2 < CONNECTIONS {
            silent.push(served.connect().await);
        }
        // None is old enough: the next one is refused.
        let mut refused = TcpStream::connect(served.address).await.unwrap();
        assert!(refused.read_u8().await.is_err());
        tokio::time::pause();
        tokio::time::advance(Duration::from_secs(3)).await;
        let mut new = Vec::new();
        for silent in &mut silent {
            new.push(served.subscribed().await);
            assert!(is_closed(silent).await);
        }
        assert!(!is_closed(&mut subscriber).await && !is_closed(&mut idle).await);
    }

    #[tokio::test]
    async fn a_subscriber_that_does_not_read_gives_way() {
        let served = Served::start().await;
        let mut readers = Vec::new();
        for _ in 0..7 {
            readers.push(served.subscribed().await);
        }
        let mut stuck = served.subscribed().await;
        served.subscribers(8).await;
        let message = vec![b' '; 1 << 20];
        for _ in 0..40 {
            served.channel.log_with_meta(&message, PartialMetadata::with_log_time(1));
            for reader in &mut readers {
                let mut left = message.len();
                while left > 0 {
                    left -= reader.read(&mut vec![0; left]).await.unwrap();
                }
            }
        }
        tokio::time::pause();
        tokio::time::advance(Duration::from_secs(20)).await;
        tokio::time::resume();
        let _ninth = served.subscribed().await;
        assert!(is_closed(&mut stuck).await);
        served.subscribers(8).await;
    }

    #[test]
    fn the_app_is_let_in_and_pages_of_other_sites_are_not() {
        let origins = Origins { more: vec!["http://localhost:8080".to_owned()], machine: "rig7".to_owned() };
        for origin in [None, Some("https://app.foxglove.dev"), Some("file://"), Some("http://localhost:8080")] {
            assert_eq!(origins.admit(Some("rig7.local:8765"), origin), Ok(()), "{origin:?}");
        }
        for origin in ["null", "", "?", "https://evil.example", "http://rig7.local:8765", "http://localhost:8081"] {
            assert!(origins.admit(Some("rig7.local:8765"), Some(origin)).is_err(), "{origin}");
        }
        assert!(origins.admit(Some("evil.example:8765"), None).is_err() && origins.admit(None, None).is_err());
    }
}
