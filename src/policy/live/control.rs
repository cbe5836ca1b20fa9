//! Thread `grid`: the control grid.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError};
use std::time::Duration;

use hdrhistogram::Histogram;
use tokio_util::sync::CancellationToken;

use super::{Exchange, LONGEST_US, LiveOptions};
use crate::bus::{Inbox, TopicId, Writer};
use crate::fault;
use crate::mask::PhysicalMask;
use crate::policy::horizon::Counts;
use crate::policy::pilot::{FIRST_TICK_AFTER, Pilot};
use crate::registry::Registry;
use crate::sample::{Encoding, SampleHeader};
use crate::status::{Board, Chunk, Level, PolicyStatus, What};
use crate::time::Stamp;

/// The longest time between two looks at the bus, whatever the rate of the grid.
const LOOK: Duration = Duration::from_millis(20);
/// How often the board is told.
const STATUS_EVERY: Duration = Duration::from_millis(200);

/// See the module's comment.
pub(super) struct Control {
    options: LiveOptions,
    pilot: Pilot,
    inbox: Inbox,
    actions: Option<Arc<Writer>>,
    board: Arc<Board>,
    /// How many are registered: digits of the mask.
    devices: usize,
    ask: SyncSender<Exchange>,
    told: Receiver<Exchange>,
    /// Here, unless it is with the policy.
    exchange: Option<Exchange>,
    payload: Vec<u8>,
    action: Vec<f32>,
    latencies: Histogram<u64>,
    last_latency_ms: Option<f64>,
    chunk_age: Option<u64>,
    /// Why nothing is done, as a screen says it.
    hold: Option<String>,
    acting: bool,
    complained: Option<Stamp>,
    reported: Stamp,
}

impl Control {
    pub(super) fn new(
        options: LiveOptions,
        registry: &Registry,
        (inbox, actions, board): (Inbox, Option<Arc<Writer>>, Arc<Board>),
        (ask, told): (SyncSender<Exchange>, Receiver<Exchange>),
        exchange: Exchange,
        latencies: Histogram<u64>,
    ) -> Self {
        let values = options.bundle.action.len();
        Self {
            pilot: Pilot::new(&options.bundle, registry, options.without_mask, options.seed),
            actions: actions.filter(|_| !options.dry_run),
            inbox,
            board,
            devices: registry.devices.len(),
            ask,
            told,
            exchange: Some(exchange),
            payload: Vec::with_capacity(values * size_of::<f64>()),
            action: Vec::with_capacity(values),
            latencies,
            last_latency_ms: None,
            chunk_age: None,
            hold: None,
            acting: false,
            complained: None,
            reported: Stamp(0),
            options,
        }
    }

    /// Keeps the grid until it is stopped, or nobody is left to ask.
    pub(super) fn run(mut self, stop: &CancellationToken) {
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
            // Ticks that have passed altogether are left out: actions are for their moments.
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

    /// Waits until everything present is seen, then says when the grid begins.
    fn first_sight(&mut self, stop: &CancellationToken) -> Option<Stamp> {
        // What came while the policy was loaded and waited is of no interest now, save for the mask.
        self.drain();
        self.pilot.forget();
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
            // Not right before the tick, which is to come on time and looks by itself.
            if at.since(Stamp::now()) > Duration::from_millis(2) {
                self.drain();
                self.report();
            }
        }
    }

    fn drain(&mut self) {
        let Self { inbox, pilot, .. } = self;
        let drained = inbox.drain(&mut |topic, header, payload| match topic {
            TopicId::Modality(id) => pilot.sample(id, header, payload),
            TopicId::Mask => {
                if let Some(mask) = payload.first_chunk() {
                    pilot.mask(PhysicalMask(u64::from_le_bytes(*mask)));
                }
            }
            TopicId::Action => {}
        });
        if let Err(error) = drained {
            self.complain(&format!("policy: {error}"));
        }
    }

    /// Takes the answer, if it has come; says whether there is still somebody to give one.
    fn take_answer(&mut self) -> bool {
        let exchange = match self.told.try_recv() {
            Ok(exchange) => exchange,
            Err(TryRecvError::Empty) => return true,
            // It panicked. What it was asked has gone with it.
            Err(TryRecvError::Disconnected) => return false,
        };
        let request = &exchange.request;
        let latency = exchange.done.since(request.stamp);
        match &exchange.outcome {
            Ok(()) => {
                let answered = self.pilot.answer(request.tick, &exchange.chunk);
                let latency_ms = latency.as_secs_f64() * 1e3;
                self.last_latency_ms = Some(latency_ms);
                let us = u64::try_from(latency.as_micros()).unwrap_or(LONGEST_US);
                self.latencies.saturating_record(us.clamp(1, LONGEST_US));
                // Also of one that is not used: its pictures may have become the reference of all later ones.
                let chunk = Chunk {
                    tick: request.tick,
                    observed_ns: request.stamp.0,
                    mask: request.mask.hex(self.devices),
                    seed: request.seed,
                    latency_ms,
                    used: answered.is_ok(),
                    skipped: answered.unwrap_or(0),
                    samples: request.samples(&self.options.bundle),
                    actions: exchange.chunk.clone(),
                };
                self.board.announce(What::Chunk(Box::new(chunk)));
                if let Err(refused) = answered {
                    self.complain(&format!("policy: not used: {refused}"));
                }
            }
            Err(reason) => {
                self.pilot.failed(request.tick);
                let text = format!("policy: no answer: {reason}");
                self.complain(&text);
            }
        }
        self.exchange = Some(exchange);
        true
    }

    fn tick(&mut self, tick: u64, at: Stamp) {
        self.drain();
        // While a request is with the policy there is none to be made.
        if self.pilot.look(tick, at, Stamp::now())
            && let Some(mut exchange) = self.exchange.take()
        {
            self.pilot.fill(tick, at, &mut exchange.request);
            if self.ask.send(exchange).is_err() {
                self.pilot.failed(tick);
            }
        }
        let step = self.pilot.step(tick);
        self.chunk_age = step.chunk_age_ticks;
        if let Some(reason) = step.hold
            && step.hold_is_news
        {
            let (device, reason) = (step.missing.unwrap_or_default().to_owned(), reason.to_string());
            let colon = if device.is_empty() { "" } else { ": " };
            self.hold = Some(format!("{reason}{colon}{device}"));
            self.board.announce(What::Hold { device, reason });
        }
        if step.hold.is_none() {
            self.hold = None;
        }
        if step.clamped_is_news {
            let text = "policy: an action beyond its limits: the limit is executed".to_owned();
            self.board.announce(What::Log { level: Level::Warn, text });
        }
        let Some(action) = step.action else {
            self.acting = false;
            return;
        };
        self.action.clear();
        self.action.extend_from_slice(action);
        if !std::mem::replace(&mut self.acting, true) {
            self.board.announce(What::Act { tick });
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

    /// Says what is wrong, at most once in five seconds.
    fn complain(&mut self, text: &str) {
        const EVERY: Duration = Duration::from_secs(5);
        let now = Stamp::now();
        if self.complained.is_none_or(|at| now.since(at) >= EVERY) {
            self.complained = Some(now);
            self.board.announce(What::Log { level: Level::Error, text: text.to_owned() });
        }
    }

    fn report(&mut self) {
        let now = Stamp::now();
        if now.since(self.reported) < STATUS_EVERY {
            return;
        }
        self.reported = now;
        let (action, counts) = (&self.options.bundle.action, self.pilot.counts());
        let axes = action.names.iter().zip(&action.units).zip(&self.action);
        self.board.set_policy(Some(PolicyStatus {
            name: self.options.bundle.name.clone(),
            dry_run: self.options.dry_run,
            mask: self.pilot.mask_in_force(),
            latency_ms: self.last_latency_ms,
            chunk_age: self.chunk_age,
            action: axes.map(|((name, unit), value)| (name.clone(), f64::from(*value), unit.clone())).collect(),
            hold: self.hold.clone(),
            actions: counts.actions,
            held: counts.held_ticks,
            chunks: counts.chunks,
            unused: unused(&counts),
        }));
    }

    fn end(self) {
        let counts = self.pilot.counts();
        let quantile = |share| self.latencies.value_at_quantile(share) as f64 / 1e3;
        self.board.announce(What::PolicyEnd {
            actions: counts.actions,
            held: counts.held_ticks,
            chunks: counts.chunks,
            unused: unused(&counts),
            latency_p50_ms: quantile(0.5),
            latency_p99_ms: quantile(0.99),
        });
    }
}

/// Answers that were not used, or never came.
const fn unused(counts: &Counts) -> u64 {
    counts.expired_chunks
        + counts.not_finite_chunks
        + counts.wrong_length_chunks
        + counts.unasked_chunks
        + counts.before_hold_chunks
        + counts.failed_requests
}
