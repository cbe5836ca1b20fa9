//! A client as the topics see it: what it subscribes to, what waits for it, and what it requests.
//!
//! Invariant: what waits for all clients together is bounded ([`ALL_BYTES`]): beyond it, the one for which most waits is
//! disconnected. It is the one that does not read: for one that does, next to nothing waits.
//! Invariant: [`SUBSCRIBERS`] subscribe at a time. One that has not read for [`STUCK`] gives way to a new one.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use foxglove::ws_protocol::client::{ClientMessage, Subscription};
use foxglove::ws_protocol::server::advertise::advertise_channels;
use foxglove::ws_protocol::server::{MessageData, Status, Unadvertise};
use foxglove::{ChannelId, Context, FoxgloveError, Metadata, RawChannel, Sink, SinkId};
use rapid_core::text;
use tokio::sync::Notify;
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::Message;

use super::control::Controls;
use super::queue::{CLIENT_BYTES, Waiting};

/// What waits for all clients together, as [`Waiting::cost`] counts it.
const ALL_BYTES: usize = CLIENT_BYTES;
/// Clients that may subscribe at a time: they hold memory.
const SUBSCRIBERS: usize = 8;
/// A subscriber that has not taken anything that waits for it for so long gives way to another one.
const STUCK: Duration = Duration::from_secs(15);
/// Time in which a new client keeps its place whatever it shows: its handshake, and its first subscription.
const GRACE: Duration = Duration::from_secs(2);
/// Requests of one client that wait for their answers, at most.
const IN_PROGRESS: usize = 4;
/// Channels in one message to a client, at most.
const CHANNELS: usize = 100;

/// All clients.
#[derive(Default)]
pub(super) struct Audience {
    pub(super) clients: Mutex<Vec<Arc<Client>>>,
    /// What waits for them, as [`Waiting::cost`] counts it.
    waiting: AtomicUsize,
}

/// See the module's comment.
pub(super) struct Client {
    pub(super) address: SocketAddr,
    since: Instant,
    sink: SinkId,
    context: Weak<Context>,
    audience: Weak<Audience>,
    state: Mutex<State>,
    /// Something waits, or the connection has to end.
    pub(super) news: Notify,
    in_progress: AtomicUsize,
}

#[derive(Debug)]
struct State {
    /// It has finished its handshake.
    is_greeted: bool,
    channels: BTreeSet<u64>,
    /// By channel.
    subscriptions: BTreeMap<u64, u32>,
    waiting: Waiting,
    /// When something was last taken, or began to wait.
    taken: Instant,
    /// Since when it has sent a part of a message, and not the rest.
    partial: Option<Instant>,
    /// Why the connection has to end.
    end: Option<&'static str>,
}

/// The lock, whoever panicked with it: nothing is half done.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Audience {
    pub(super) fn is_empty(&self) -> bool {
        lock(&self.clients).is_empty()
    }

    /// A client that has just connected. It is forgotten by [`Self::remove`].
    pub(super) fn add(self: &Arc<Self>, address: SocketAddr, context: &Arc<Context>) -> Arc<Client> {
        let now = Instant::now();
        let (channels, subscriptions, waiting) = Default::default();
        let state = State { is_greeted: false, channels, subscriptions, waiting, taken: now, partial: None, end: None };
        let client = Arc::new(Client {
            address,
            since: now,
            sink: SinkId::next(),
            context: Arc::downgrade(context),
            audience: Arc::downgrade(self),
            state: Mutex::new(state),
            news: Notify::new(),
            in_progress: AtomicUsize::new(0),
        });
        lock(&self.clients).push(Arc::clone(&client));
        client
    }

    pub(super) fn remove(&self, client: &Arc<Client>) {
        lock(&self.clients).retain(|other| !Arc::ptr_eq(other, client));
        client.forget("it has ended");
        if let Some(context) = client.context.upgrade() {
            context.remove_sink(client.sink);
        }
    }

    /// Makes place for one more connection: one that has shown nothing for [`GRACE`] gives way, or else one that watches
    /// nothing, the oldest first. Whether there is one.
    pub(super) fn give_way(&self) -> bool {
        let clients = lock(&self.clients).clone();
        let old = || clients.iter().filter(|client| client.since.elapsed() > GRACE && client.end().is_none());
        let silent = old().find(|client| !client.lock().is_greeted);
        let idle = || old().find(|client| !client.is_subscriber());
        let found = silent.or_else(idle);
        if let Some(client) = found {
            client.forget("another one needs its place");
        }
        found.is_some()
    }

    /// Those that subscribe to something.
    pub(super) fn subscribers(&self) -> Vec<Arc<Client>> {
        let mut clients = lock(&self.clients).clone();
        clients.retain(|client| client.is_subscriber());
        clients
    }

    /// Whether one more client may subscribe: then a place is free, or was taken from one that does not read.
    fn has_place(&self) -> bool {
        let subscribers = self.subscribers();
        let stuck = || subscribers.iter().find(|client| client.lock().is_stuck());
        if subscribers.len() < SUBSCRIBERS {
            return true;
        }
        stuck().inspect(|stuck| stuck.forget("it does not read, and another one needs its place")).is_some()
    }

    /// Disconnects the client for which most waits, until what waits for all is little enough.
    fn relieve(&self) {
        while self.waiting.load(Ordering::Relaxed) > ALL_BYTES {
            let clients = lock(&self.clients).clone();
            let Some(client) = clients.iter().max_by_key(|client| client.lock().waiting.cost) else { return };
            if client.lock().waiting.cost == 0 {
                return;
            }
            client.forget("it does not read what it asked for");
        }
    }
}

impl State {
    fn is_stuck(&self) -> bool {
        self.waiting.cost > 0 && self.taken.elapsed() > STUCK
    }
}

impl Client {
    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    fn is_subscriber(&self) -> bool {
        !self.lock().subscriptions.is_empty()
    }

    /// Why the connection has to end, if it has to.
    pub(super) fn end(&self) -> Option<&'static str> {
        self.lock().end
    }

    /// Whether it has finished its handshake.
    pub(super) fn is_greeted(&self) -> bool {
        self.lock().is_greeted
    }

    /// Returns when the connection has to end.
    pub(super) async fn has_ended(&self) {
        while self.end().is_none() {
            self.news.notified().await;
        }
    }

    /// The handshake is done: it gets `greeting`, and then the channels.
    pub(super) fn greet(self: &Arc<Self>, greeting: impl IntoIterator<Item = Message>) {
        self.lock().is_greeted = true;
        greeting.into_iter().for_each(|message| self.push(None, message));
        if let Some(context) = self.context.upgrade() {
            context.add_sink(Arc::<Self>::clone(self));
        }
    }

    /// Ends its connection, and frees what waits for it. Not its place among the sinks: a sink is called with the lock of
    /// these.
    fn forget(&self, why: &'static str) {
        let freed = {
            let mut state = self.lock();
            state.end.get_or_insert(why);
            state.subscriptions.clear();
            std::mem::take(&mut state.waiting).cost
        };
        self.count(freed, 0);
        self.news.notify_one();
    }

    /// What waits has changed.
    fn count(&self, before: usize, now: usize) {
        if let Some(audience) = self.audience.upgrade() {
            audience.waiting.fetch_add(now, Ordering::Relaxed);
            audience.waiting.fetch_sub(before, Ordering::Relaxed);
        }
    }

    fn push(&self, topic: Option<u32>, message: Message) {
        let (before, now, pushed) = {
            let mut state = self.lock();
            if state.end.is_some() {
                return;
            }
            let before = state.waiting.cost;
            if before == 0 {
                state.taken = Instant::now();
            }
            let pushed = state.waiting.push(topic, message);
            (before, state.waiting.cost, pushed)
        };
        self.count(before, now);
        match pushed {
            Ok(()) => self.news.notify_one(),
            Err(why) => self.forget(why),
        }
        if now > before
            && let Some(audience) = self.audience.upgrade()
        {
            audience.relieve();
        }
    }

    /// Takes what has waited longest.
    pub(super) fn pop(&self) -> Option<Message> {
        let (before, now, message) = {
            let mut state = self.lock();
            let before = state.waiting.cost;
            let message = state.waiting.pop()?;
            state.taken = Instant::now();
            (before, state.waiting.cost, message)
        };
        self.count(before, now);
        Some(message)
    }

    /// Bytes have come, or a whole message.
    pub(super) fn heard(&self, is_whole: bool) {
        let mut state = self.lock();
        if is_whole {
            state.partial = None;
        } else {
            state.partial.get_or_insert_with(Instant::now);
        }
    }

    /// Whether it has sent a part of a message for longer than `limit`, and not the rest.
    pub(super) fn is_overdue(&self, limit: Duration) -> bool {
        self.lock().partial.is_some_and(|since| since.elapsed() > limit)
    }

    /// Reports what was left out since the last report.
    pub(super) fn report(&self) {
        let left_out = std::mem::take(&mut self.lock().waiting.left_out);
        if left_out > 0 {
            let which = text::counted(left_out, "message");
            tracing::info!("Foxglove: client {} reads slowly: {which} left out for newer ones", self.address);
        }
    }

    fn refuse(&self, why: impl Into<String>) {
        self.push(None, Message::from(&Status::error(why)));
    }

    /// Does what the client requests.
    pub(super) fn obey(self: &Arc<Self>, request: &Message, controls: Option<&Controls>) {
        match ClientMessage::try_from(request) {
            Ok(ClientMessage::Subscribe(wanted)) => self.subscribe(&wanted.subscriptions),
            Ok(ClientMessage::Unsubscribe(unwanted)) => self.unsubscribe(&unwanted.subscription_ids),
            Ok(
                request @ (ClientMessage::ServiceCallRequest(_)
                | ClientMessage::GetParameters(_)
                | ClientMessage::SetParameters(_)),
            ) => self.request(request.into_owned(), controls),
            // Parameters are not reported when they change.
            Ok(ClientMessage::SubscribeParameterUpdates(_) | ClientMessage::UnsubscribeParameterUpdates(_)) => {}
            Ok(_) => {
                self.refuse("rapid offers no such thing: topics, and with --foxglove-control services and parameters");
            }
            Err(error) => self.refuse(format!("Invalid message: {error}")),
        }
    }

    fn subscribe(&self, wanted: &[Subscription]) {
        let (Some(audience), Some(context)) = (self.audience.upgrade(), self.context.upgrade()) else { return };
        if self.lock().subscriptions.is_empty() && !audience.has_place() {
            return self.refuse(format!("rapid serves {SUBSCRIBERS} clients at a time: close one, and try again"));
        }
        for Subscription { id, channel_id } in wanted {
            let is_new = {
                let mut state = self.lock();
                let is_used = state.subscriptions.contains_key(channel_id);
                let is_new = !is_used && !state.subscriptions.values().any(|other| other == id);
                is_new && state.channels.contains(channel_id) && state.subscriptions.insert(*channel_id, *id).is_none()
            };
            if is_new {
                context.subscribe_channels(self.sink, &[ChannelId::new(*channel_id)]);
            } else {
                self.refuse(format!("there is no channel {channel_id}, or it, or subscription {id}, is in use"));
            }
        }
    }

    fn unsubscribe(&self, unwanted: &[u32]) {
        let Some(context) = self.context.upgrade() else { return };
        for id in unwanted {
            let (channel, before, now) = {
                let mut state = self.lock();
                let channel = state.subscriptions.iter().find_map(|(channel, other)| (other == id).then_some(*channel));
                let Some(channel) = channel else { continue };
                state.subscriptions.remove(&channel);
                let before = state.waiting.cost;
                state.waiting.forget(*id);
                (channel, before, state.waiting.cost)
            };
            self.count(before, now);
            context.unsubscribe_channels(self.sink, &[ChannelId::new(channel)]);
        }
    }

    /// Requests something of the run; the answer comes later.
    fn request(self: &Arc<Self>, request: ClientMessage<'static>, controls: Option<&Controls>) {
        let Some(controls) = controls.cloned() else {
            return self.refuse("clients may watch only: this run has no --foxglove-control");
        };
        if self.in_progress.load(Ordering::Relaxed) >= IN_PROGRESS {
            return self.refuse(format!("{IN_PROGRESS} requests wait for their answers: this one was not carried out"));
        }
        self.in_progress.fetch_add(1, Ordering::Relaxed);
        let client = Arc::clone(self);
        tokio::spawn(async move {
            if let Some(answer) = controls.answer(request).await {
                client.push(None, answer);
            }
            client.in_progress.fetch_sub(1, Ordering::Relaxed);
        });
    }
}

impl Sink for Client {
    fn id(&self) -> SinkId {
        self.sink
    }

    fn log(&self, channel: &RawChannel, message: &[u8], metadata: &Metadata) -> Result<(), FoxgloveError> {
        let topic = self.lock().subscriptions.get(&channel.id().into()).copied();
        if let Some(topic) = topic {
            self.push(Some(topic), Message::from(&MessageData::new(topic, metadata.log_time, message)));
        }
        Ok(())
    }

    fn add_channels(&self, channels: &[&Arc<RawChannel>]) -> Option<Vec<ChannelId>> {
        self.lock().channels.extend(channels.iter().map(|channel| u64::from(channel.id())));
        for channels in channels.chunks(CHANNELS) {
            self.push(None, Message::from(&advertise_channels(channels.iter().copied())));
        }
        None
    }

    fn remove_channel(&self, channel: &RawChannel) {
        let id = channel.id().into();
        {
            let mut state = self.lock();
            state.channels.remove(&id);
            state.subscriptions.remove(&id);
        }
        self.push(None, Message::from(&Unadvertise::new([id])));
    }

    fn auto_subscribe(&self) -> bool {
        false
    }
}
