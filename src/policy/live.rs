//! A policy at the controls of a rig in real time.
//!
//! Thread `grid` keeps the control grid: at each tick it takes samples from the bus, observes, hands over a request
//! when one is due, and publishes the action of the tick. Thread `policy` computes chunks: however long one takes, no
//! tick waits for it. One request goes back and forth between them.
//!
//! The grid begins a few milliseconds after the capture of the last sample that completed the first observation:
//! samples of devices that run at the rate of the grid are then fresh at each tick.
//!
//! Invariant: between two ticks nothing here allocates, locks or logs. An answer is taken at a tick: its chunk is announced as
//! an event, and a new reference goes to the recorder.
//! Invariant: once the handle is stopped, nothing more is published.

use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use hdrhistogram::Histogram;
use rapid_bus::{Inbox, Writer};
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;
use rapid_episode::ReferenceSample;
use rapid_registry::Registry;
use rapid_status::{Board, EventKind, Hold, Level, PolicyEnd, PolicyStatus};
use rapid_system::fault;
use tokio_util::sync::CancellationToken;

use super::bundle::Bundle;
use super::horizon::{Counts, WithoutMask};
use super::model::Model;
use super::pilot::{FIRST_TICK_AFTER, Pilot};
use super::request::{Cell, Request};

/// Nice value of the computing thread; all others have 0.
const NICE: i32 = 5;
/// Latencies up to a minute, in us, with three digits.
const LONGEST_US: u64 = 60_000_000;

/// The longest time between two reads of the bus, at any rate of the grid.
const LOOK: Duration = Duration::from_millis(20);
/// How often the board is updated.
const STATUS_EVERY: Duration = Duration::from_millis(200);

/// What a policy is started with.
#[derive(Debug)]
pub struct LiveOptions {
    /// The policy.
    pub bundle: Arc<Bundle>,
    /// What it does without a modality that was always present in training.
    pub without_mask: WithoutMask,
    /// Seed of the noise.
    pub seed: u64,
    /// Nothing is published.
    pub dry_run: bool,
}

/// The two threads.
#[derive(Debug)]
pub struct Live {
    stop: CancellationToken,
    ended: CancellationToken,
    control: JoinHandle<()>,
    policy: JoinHandle<()>,
}

impl Live {
    /// Starts both threads. `actions` is where actions are published, `references` where the samples go that all later ones
    /// are compared with.
    ///
    /// # Errors
    /// When the system provides no thread.
    pub fn start(
        options: LiveOptions,
        model: Model,
        registry: &Registry,
        inbox: Inbox,
        actions: Option<Arc<Writer>>,
        board: Arc<Board>,
        references: Sender<ReferenceSample>,
    ) -> io::Result<Self> {
        let (stop, ended) = (CancellationToken::new(), CancellationToken::new());
        let (requests, received) = sync_channel(1);
        let (answered, answers) = sync_channel(1);
        let chunk = vec![0.0; model.chunk_len()];
        let request = Request::new(&options.bundle);
        let policy = std::thread::Builder::new()
            .name("policy".to_owned())
            .spawn(move || compute(model, &received, &answered))?;
        let values = options.bundle.action.len();
        let mut pilot = Pilot::new(&options.bundle, registry, options.without_mask, options.seed);
        pilot.observer.share(board.walked());
        let control = Control {
            pilot,
            inbox,
            actions: actions.filter(|_| !options.dry_run),
            board,
            references,
            requests,
            answers,
            devices: registry.devices.len(),
            exchange: Some(Exchange { request, chunk, outcome: Ok(()), done: Stamp(0), firsts: Vec::new() }),
            payload: Vec::with_capacity(values * size_of::<f64>()),
            action: Vec::with_capacity(values),
            latencies: Histogram::new_with_bounds(1, LONGEST_US, 3).map_err(io::Error::other)?,
            last_latency_ms: None,
            chunk_age: None,
            hold: None,
            acting: false,
            complained: None,
            reported: Stamp(0),
            options,
        };
        let (stopped, guard) = (stop.clone(), ended.clone().drop_guard());
        let control = std::thread::Builder::new().name("grid".to_owned()).spawn(move || {
            // Dropped by a panic too.
            let _guard = guard;
            control.run(&stopped);
        })?;
        Ok(Self { stop, ended, control, policy })
    }

    /// Cancelled when the policy no longer runs, for any reason.
    pub fn ended(&self) -> CancellationToken {
        self.ended.clone()
    }

    /// Ends both threads and waits for them, including a chunk being computed. A panic of either thread is an error.
    ///
    /// # Errors
    /// The thread that panicked.
    pub fn stop(self) -> Result<(), &'static str> {
        self.stop.cancel();
        let control = self.control.join();
        // The end of the first ends the second, which waits on its channel.
        let policy = self.policy.join();
        policy.map_err(|_| "the policy")?;
        control.map_err(|_| "the control loop")
    }
}

/// The message exchanged between the threads.
struct Exchange {
    request: Request,
    chunk: Vec<f32>,
    outcome: Result<(), String>,
    done: Stamp,
    /// New references: the position of the observation, and the sample.
    firsts: Vec<(usize, Cell)>,
}

fn compute(mut model: Model, requests: &Receiver<Exchange>, answers: &SyncSender<Exchange>) {
    // A tick must not wait until a chunk has used its time slice; without permission for this, the chunk is computed at
    // normal priority. On Linux this affects only the calling thread.
    if let Err(error) = rustix::process::setpriority_process(None, NICE) {
        tracing::debug!(%error, "thread `policy` keeps its priority");
    }
    while let Ok(mut exchange) = requests.recv() {
        fault::point("policy");
        let answer = model.answer(&exchange.request, &mut exchange.chunk);
        exchange.outcome = answer.map_err(|error| error.to_string());
        exchange.firsts.extend(model.take_firsts());
        exchange.done = Stamp::now();
        if answers.send(exchange).is_err() {
            return;
        }
    }
}

/// Thread `grid`: the control grid.
struct Control {
    options: LiveOptions,
    pilot: Pilot,
    inbox: Inbox,
    /// Where actions are published; `None` in a dry run.
    actions: Option<Arc<Writer>>,
    board: Arc<Board>,
    /// Receives the samples that all later ones of an observation are compared with.
    references: Sender<ReferenceSample>,
    requests: SyncSender<Exchange>,
    answers: Receiver<Exchange>,
    /// Number of registered modalities: digits of the mask.
    devices: usize,
    /// `None` while the policy is computing it.
    exchange: Option<Exchange>,
    payload: Vec<u8>,
    action: Vec<f32>,
    latencies: Histogram<u64>,
    last_latency_ms: Option<f64>,
    chunk_age: Option<u64>,
    /// Why no action is executed.
    hold: Option<Hold>,
    acting: bool,
    complained: Option<Stamp>,
    reported: Stamp,
}

impl Control {
    /// Runs the grid until it is stopped, or the thread `policy` has ended.
    fn run(mut self, stop: &CancellationToken) {
        let Some(begin) = self.first_sight(stop) else { return self.end() };
        let period = Duration::from_secs_f64(1.0 / self.options.bundle.control_hz);
        let mut tick: u64 = 0;
        while !stop.is_cancelled() {
            let at = begin.after(period.mul_f64(tick as f64));
            self.sleep_until(at, stop);
            if stop.is_cancelled() {
                break;
            }
            fault::point("grid");
            if !self.take_answer() {
                break;
            }
            self.tick(tick, at);
            // Missed ticks are skipped: actions belong to their ticks.
            let behind = Stamp::now().since(at).as_secs_f64() / period.as_secs_f64();
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a count of ticks, not negative"
            )]
            let skipped = behind as u64;
            tick += 1 + skipped;
        }
        self.end();
    }

    /// Waits until every present device has sent a sample; returns when the grid begins.
    fn first_sight(&mut self, stop: &CancellationToken) -> Option<Stamp> {
        // Samples from before the start are discarded, except for the mask.
        self.drain();
        self.pilot.observer.clear();
        while !stop.is_cancelled() {
            self.drain();
            if let Some(newest) = self.pilot.first_sight() {
                return Some(newest.after(FIRST_TICK_AFTER).max(Stamp::now()));
            }
            let _ = self.inbox.wait(LOOK);
            self.report();
        }
        None
    }

    fn sleep_until(&mut self, at: Stamp, stop: &CancellationToken) {
        loop {
            let left = at.since(Stamp::now());
            if left.is_zero() || stop.is_cancelled() {
                break;
            }
            std::thread::sleep(left.min(LOOK));
            // Not right before the tick, which must be on time and reads by itself.
            if at.since(Stamp::now()) > Duration::from_millis(2) {
                self.drain();
                self.report();
            }
        }
    }

    fn drain(&mut self) {
        let Self { inbox, pilot, .. } = self;
        let drained = inbox.drain(&mut |topic, header, payload| pilot.receive(topic, header, payload));
        if let Err(error) = drained {
            self.complain(&format!("policy: {error}"));
        }
    }

    /// Takes the answer, if it has arrived; returns whether the thread `policy` still runs.
    fn take_answer(&mut self) -> bool {
        let mut exchange = match self.answers.try_recv() {
            Ok(exchange) => exchange,
            Err(TryRecvError::Empty) => return true,
            // It panicked, and its request is lost.
            Err(TryRecvError::Disconnected) => return false,
        };
        for (at, cell) in exchange.firsts.drain(..) {
            let Some(observation) = self.options.bundle.observations.get(at) else { continue };
            // The recorder has ended only when the run ends.
            let _ = self.references.send(cell.into_reference(observation));
        }
        let request = &exchange.request;
        let latency = exchange.done.since(request.stamp);
        match &exchange.outcome {
            Ok(()) => {
                let answered = self.pilot.answer(request, &exchange.chunk);
                let latency_ms = latency.as_secs_f64() * 1e3;
                self.last_latency_ms = Some(latency_ms);
                let us = u64::try_from(latency.as_micros()).unwrap_or(LONGEST_US);
                self.latencies.saturating_record(us.clamp(1, LONGEST_US));
                // Also for an unused chunk: its pictures may have become the reference of all later ones.
                let (bundle, chunk) = (&self.options.bundle, self.pilot.chunk());
                self.board.announce(request.answered(bundle, self.devices, latency_ms, answered, chunk));
                if let Err(refused) = answered {
                    self.complain(&format!("policy: not used: {refused}"));
                }
            }
            Err(reason) => {
                self.pilot.queue.failed(request.tick);
                let text = format!("policy: no answer: {reason}");
                self.complain(&text);
            }
        }
        self.exchange = Some(exchange);
        true
    }

    fn tick(&mut self, tick: u64, at: Stamp) {
        self.drain();
        // While the policy works on a request, no new one is made.
        if self.pilot.observe(tick, at, Stamp::now())
            && let Some(mut exchange) = self.exchange.take()
        {
            self.pilot.fill(tick, at, &mut exchange.request);
            if self.requests.send(exchange).is_err() {
                self.pilot.queue.failed(tick);
            }
        }
        let step = self.pilot.step(tick);
        self.chunk_age = step.chunk_age_ticks;
        if let Some(reason) = step.hold
            && step.hold_is_news
        {
            let hold = Hold { device: step.missing.map(str::to_owned), reason: reason.to_string() };
            self.hold = Some(hold.clone());
            self.board.announce(EventKind::Hold(hold));
        }
        if step.hold.is_none() {
            self.hold = None;
        }
        if step.clamped_is_news {
            let text = "policy: an action beyond its limits: the limit is executed".to_owned();
            self.board.announce(EventKind::Log { level: Level::Warn, text });
        }
        let Some(action) = step.action else {
            self.acting = false;
            return;
        };
        self.action.clear();
        self.action.extend_from_slice(action);
        if !std::mem::replace(&mut self.acting, true) {
            self.board.announce(EventKind::Act { tick });
        }
        self.publish(tick, at);
    }

    fn publish(&mut self, tick: u64, at: Stamp) {
        let Some(writer) = &self.actions else { return };
        self.payload.clear();
        self.payload.extend(self.action.iter().flat_map(|value| f64::from(*value).to_le_bytes()));
        let header = SampleHeader {
            seq: tick,
            capture_ns: at.0,
            recv_ns: Stamp::now().0,
            encoding: Encoding::F64 as u32,
            width: u32::try_from(self.action.len()).unwrap_or(0),
            ..SampleHeader::default()
        };
        if let Err(error) = writer.publish(header, &self.payload) {
            self.complain(&format!("policy: an action is lost: {error}"));
        }
    }

    /// Reports a problem, at most once in five seconds.
    fn complain(&mut self, text: &str) {
        const EVERY: Duration = Duration::from_secs(5);
        let now = Stamp::now();
        if self.complained.is_none_or(|at| now.since(at) >= EVERY) {
            self.complained = Some(now);
            self.board.announce(EventKind::Log { level: Level::Error, text: text.to_owned() });
        }
    }

    fn report(&mut self) {
        let now = Stamp::now();
        if now.since(self.reported) < STATUS_EVERY {
            return;
        }
        self.reported = now;
        let (action, counts) = (&self.options.bundle.action, self.pilot.queue.counts());
        let axes = action.names.iter().zip(&action.units).zip(&self.action);
        self.board.set_policy(Some(PolicyStatus {
            name: self.options.bundle.name.clone(),
            dry_run: self.options.dry_run,
            mask: self.pilot.mask,
            latency_ms: self.last_latency_ms,
            chunk_age: self.chunk_age,
            action: axes.map(|((name, unit), value)| (name.clone(), f64::from(*value), unit.clone())).collect(),
            hold: self.hold.clone(),
            actions: counts.actions,
            held: counts.held_ticks,
            chunks: counts.chunks,
            late: counts.late_chunks,
            unused: unused(&counts),
        }));
    }

    fn end(self) {
        let counts = self.pilot.queue.counts();
        let quantile = |share| self.latencies.value_at_quantile(share) as f64 / 1e3;
        self.board.announce(EventKind::PolicyEnd(PolicyEnd {
            actions: counts.actions,
            held: counts.held_ticks,
            chunks: counts.chunks,
            late: counts.late_chunks,
            unused: unused(&counts),
            latency_p50_ms: quantile(0.5),
            latency_p99_ms: quantile(0.99),
        }));
    }
}

/// Answers that were not used, or never arrived.
const fn unused(counts: &Counts) -> u64 {
    counts.expired_chunks
        + counts.not_finite_chunks
        + counts.no_pose_chunks
        + counts.wrong_length_chunks
        + counts.unasked_chunks
        + counts.before_hold_chunks
        + counts.failed_requests
}
