//! Foxglove: the topics of a running rig over a websocket, as they are recorded.
//!
//! Thread `foxglove` has everything: a subscriber of the bus of its own, the server with its connections, and the
//! encoder, which is that of the recorder ([`rapid_episode::encode`]). Messages and times are those of the episode in
//! progress, byte for byte: the clock comes from the recorder.
//!
//! The protocol is `foxglove.sdk.v1` (<https://github.com/foxglove/ws-protocol>), by the crate `foxglove`.
//!
//! Invariant: nothing else waits for this thread: a client that reads slowly, or not at all, gets the newest of each topic
//! when it reads (`queue`).
//! Invariant: whoever connects holds little: what a client may send and what waits for it is bounded (`connections`), and
//! pages of other sites are refused.
//! Invariant: a turn is short, whatever waits on the bus: on a busy machine the connections would wait for its end, and of all that it
//! sends a client gets the last topics alone.
//! Invariant: whatever ends the thread, the run continues.

mod client;
mod connections;
mod control;
mod pictures;
mod queue;
mod topics;

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use foxglove::Context;
use foxglove::ws_protocol::schema::EncodeError;
use foxglove::ws_protocol::server::ServerInfo;
use foxglove::ws_protocol::server::server_info::Capability;
use tokio::sync::broadcast::{self, error::TryRecvError};
use tokio::sync::{oneshot, watch};
use tokio::task::{JoinHandle as TaskHandle, yield_now};
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::Message;
use tokio_util::sync::CancellationToken;

use client::Audience;
use connections::{Host, Origins};
pub use control::Controls;
use rapid_bus::{BusError, Queues, Subscription};
use rapid_core::time::{Stamp, WallClock};
use rapid_episode::made::Made;
use rapid_registry::{DeviceSpec, Registry};
use rapid_status::{Board, Event, EventKind, Level};
use rapid_system::fault;
use topics::Topics;

/// Port of a Foxglove server, if none is named.
const PORT: u16 = 8765;

/// Time between two looks at the bus, with clients and without.
const TURN: Duration = Duration::from_millis(5);
const IDLE_TURN: Duration = Duration::from_millis(50);
/// Samples of a topic that a turn sends at most: they wait until the connections have their turn.
const IN_A_TURN: usize = 32;
/// A client gets the end of the connection within this time, or it is closed.
const LAST: Duration = Duration::from_millis(500);
/// Shortest time between two lines of the log about what was left out.
const REPORT_EVERY: Duration = Duration::from_secs(5);
/// Niceness: everything else on the machine comes first.
const NICE: i32 = 10;

/// Where the server listens, and what clients may request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoxgloveOptions {
    /// Its address; with port 0 a free one is chosen.
    pub address: SocketAddr,
    /// Clients may begin and end episodes, and arm and disarm.
    pub control: bool,
    /// Pages of browsers that may connect, beside the app's own: `http://localhost:8080`, as browsers send it in `Origin`.
    pub origins: Vec<String>,
}

/// Why there is no server.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The address cannot be listened on.
    #[error("--foxglove {address}: {source}{}", fix(source))]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The error of the system.
        source: io::Error,
    },
    /// The server did not start for another reason.
    #[error("--foxglove: {0}")]
    Server(#[from] EncodeError),
    /// The system provides no thread, or no runtime.
    #[error("--foxglove: {0}")]
    System(#[from] io::Error),
    /// Its subscriber of the bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The thread ended while it started.
    #[error("--foxglove: thread `foxglove` panicked; please report this")]
    Panicked,
}

fn fix(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::AddrInUse => {
            ": another program listens there, perhaps another rapid; end it, or name another port: \
             --foxglove 127.0.0.1:8767"
        }
        io::ErrorKind::AddrNotAvailable => ": this machine has no such address; `ip address` lists those that it has",
        io::ErrorKind::PermissionDenied => ": ports below 1024 are for root; name another",
        _ => "",
    }
}

/// An entry that was added during the run, and its samples.
pub type Addition = (Arc<DeviceSpec>, Subscription);

/// What the server shows.
#[derive(Debug)]
pub struct Feed {
    /// Samples of every topic.
    pub queues: Queues,
    /// Events from now on.
    pub events: broadcast::Receiver<Event>,
    /// The clock of the episode in progress.
    pub clock: watch::Receiver<WallClock>,
    /// What the recorder makes.
    pub made: mpsc::Receiver<Made>,
    /// Entries that are added.
    pub additions: mpsc::Receiver<Addition>,
}

/// A server that listens, and its thread.
#[derive(Debug)]
pub struct FoxgloveServer {
    feed: Option<oneshot::Sender<Feed>>,
    thread: Option<JoinHandle<()>>,
    stop: CancellationToken,
    ended: CancellationToken,
    board: Arc<Board>,
    /// Its address is the one that is listened on.
    options: FoxgloveOptions,
}

impl FoxgloveServer {
    /// Listens for clients. They get the topics of `registry`, and samples from [`Self::feed`] on. With `controls` they
    /// may request something.
    ///
    /// # Errors
    /// When the address is in use or none of this machine, or the system provides no thread.
    pub async fn listen(
        options: FoxgloveOptions,
        registry: Arc<Registry>,
        board: Arc<Board>,
        controls: Option<Controls>,
    ) -> Result<Self, ServerError> {
        let (stop, ended) = (CancellationToken::new(), CancellationToken::new());
        let (feed, first_feed) = oneshot::channel();
        let (listening, listens) = oneshot::channel();
        let (stopped, guard) = (stop.clone(), ended.clone().drop_guard());
        let wanted = options.clone();
        let thread = std::thread::Builder::new().name("foxglove".to_owned()).spawn(move || {
            // Dropped by a panic too.
            let _guard = guard;
            // Only less of the processor is a change that no system refuses.
            let _ = rustix::process::setpriority_process(None, NICE);
            let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
                Ok(runtime) => runtime,
                Err(error) => return drop(listening.send(Err(error.into()))),
            };
            runtime.block_on(async {
                match Server::start(wanted, &registry, controls).await {
                    Ok((server, address)) => {
                        // Without a receiver the run has ended.
                        let _ = listening.send(Ok(address));
                        server.serve(first_feed, stopped).await;
                    }
                    Err(error) => drop(listening.send(Err(error))),
                }
            });
            // A client that does not read must not hold up the end.
            runtime.shutdown_background();
        })?;
        let mut server = Self { feed: Some(feed), thread: Some(thread), stop, ended, board, options };
        server.options.address = listens.await.unwrap_or(Err(ServerError::Panicked))?;
        Ok(server)
    }

    fn announce(&self) {
        let FoxgloveOptions { address, control, .. } = self.options;
        let text = format!("Foxglove: open connection ws://{address}");
        self.board.announce(EventKind::Log { level: Level::Info, text });
        if !address.ip().is_loopback() {
            let moves = if control { ", begins and ends episodes, and arms motors" } else { "" };
            let text = format!(
                "Foxglove: {address} can be reached from other machines: whoever reaches that port sees what the \
                 sensors see{moves}; there is no password. `ssh -L {PORT}:localhost:{PORT}` needs no such address"
            );
            self.board.announce(EventKind::Log { level: Level::Warn, text });
        }
    }

    /// Shows this from now on, and announces it.
    pub fn feed(&mut self, feed: Feed) {
        if let Some(fed) = self.feed.take() {
            // The thread has panicked: that is reported by `run`.
            let _ = fed.send(feed);
        }
        self.announce();
    }

    /// Runs until `stop`; then the subscriber of the bus is closed.
    pub async fn run(mut self, stop: CancellationToken) {
        tokio::select! {
            () = stop.cancelled() => {}
            () = self.ended.cancelled() => {
                let text = "Foxglove: its thread panicked; the run continues without it. Please report this".to_owned();
                self.board.announce(EventKind::Log { level: Level::Error, text });
            }
        }
        self.stop.cancel();
        if let Some(thread) = self.thread.take() {
            // A panic is reported above.
            let _ = tokio::task::spawn_blocking(move || thread.join()).await;
        }
        stop.cancelled().await;
    }
}

impl Drop for FoxgloveServer {
    /// The subscriber of the bus must not outlive the bus.
    fn drop(&mut self) {
        self.stop.cancel();
        self.feed = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The work of the thread.
struct Server {
    audience: Arc<Audience>,
    /// Serves clients, until `closing`.
    connections: TaskHandle<()>,
    closing: CancellationToken,
    topics: Topics,
    reported: Stamp,
}

impl Server {
    async fn start(
        options: FoxgloveOptions,
        registry: &Registry,
        controls: Option<Controls>,
    ) -> Result<(Self, SocketAddr), ServerError> {
        let FoxgloveOptions { address, origins, .. } = options;
        let in_use = |source| ServerError::Listen { address, source };
        let listener = connections::listen(address).await.map_err(in_use)?;
        let bound = listener.local_addr().map_err(in_use)?;
        let context = Context::new();
        let topics = Topics::advertise(&context, registry);
        let machine = rustix::system::uname().nodename().to_string_lossy().into_owned();
        let (audience, closing) = (Arc::new(Audience::default()), CancellationToken::new());
        let host = Host {
            context,
            audience: Arc::clone(&audience),
            greeting: greeting(registry, controls.is_some())?,
            controls,
            origins: Origins { more: origins, machine },
            limit: connections::LIMIT,
        };
        let connections = tokio::spawn(Arc::new(host).serve(listener, closing.clone()));
        Ok((Self { audience, connections, closing, topics, reported: Stamp::now() }, bound))
    }

    /// Serves until `stop`, or until there will be nothing to serve.
    async fn serve(mut self, feed: oneshot::Receiver<Feed>, stop: CancellationToken) {
        let served = async {
            let Ok(mut feed) = feed.await else { return };
            loop {
                if self.turn(&mut feed) {
                    // The connections are others' work on this thread.
                    yield_now().await;
                    continue;
                }
                let is_idle = self.audience.is_empty();
                sleep(if is_idle { IDLE_TURN } else { TURN }).await;
            }
        };
        tokio::select! {
            () = stop.cancelled() => {}
            () = served => {}
        }
        self.closing.cancel();
        // It has also ended if it panicked.
        let _ = timeout(LAST, &mut self.connections).await;
    }

    /// Whether more waits on the bus.
    fn turn(&mut self, feed: &mut Feed) -> bool {
        fault::point("foxglove");
        let Self { topics, .. } = self;
        while let Ok((device, subscription)) = feed.additions.try_recv() {
            feed.queues.add(subscription);
            topics.add(&device);
        }
        let Feed { queues, events, clock, made, .. } = feed;
        // After the capture of whatever is taken below: an episode's clock is in force before it begins.
        let (is_more, drained) = queues.drain_some(IN_A_TURN, &mut |topic, header, payload| {
            topics.send_sample(topic, header, payload, *clock.borrow());
        });
        topics.send_pictures();
        for made in made.try_iter() {
            topics.made(&made);
        }
        topics.send_places(Stamp::now());
        loop {
            match events.try_recv() {
                Ok(event) => topics.event(&event, *clock.borrow()),
                Err(TryRecvError::Lagged(count)) => topics.missed(count),
                Err(TryRecvError::Empty | TryRecvError::Closed) => break,
            }
        }
        self.report(drained.err());
        is_more
    }

    /// Reports what was left out, now and then.
    fn report(&mut self, error: Option<BusError>) {
        let now = Stamp::now();
        if now.since(self.reported) < REPORT_EVERY {
            return;
        }
        self.reported = now;
        let left_out = self.topics.left_out();
        if let Some(left_out) = left_out {
            tracing::info!("Foxglove: {left_out}");
        }
        if let Some(error) = error {
            tracing::warn!(%error, "Foxglove: the bus cannot be read");
        }
    }
}

/// What each client gets first.
fn greeting(registry: &Registry, is_controlled: bool) -> Result<Vec<Message>, EncodeError> {
    let mut info = ServerInfo::new(format!("rapid {}", registry.rig.name)).with_session_id(Stamp::now().0.to_string());
    if is_controlled {
        info = info.with_capabilities([Capability::Services, Capability::Parameters]);
        info = info.with_supported_encodings([control::JSON]);
    }
    let mut greeting = vec![Message::from(&info)];
    if is_controlled {
        greeting.push(Controls::services()?);
    }
    Ok(greeting)
}
