//! A policy at the controls of a rig in real time.
//!
//! Thread `grid` keeps the control grid: at each tick it takes what the bus brought, looks, hands a
//! request over when one is due, and publishes the action of the tick. Thread `policy` computes: a chunk may
//! take as long as it takes, and no tick waits for it. One request goes back and forth between them.
//!
//! The grid begins a few milliseconds after the capture of the newest sample that was needed to see everything: the
//! samples of devices that run at the rate of the grid are fresh at each tick.
//!
//! Invariant: between two ticks nothing here allocates, locks or logs; a chunk is told of as an event.
//! Invariant: once the handle is told to stop, nothing more is published.

mod control;

use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use hdrhistogram::Histogram;
use tokio_util::sync::CancellationToken;

use control::Control;

use super::bundle::Bundle;
use super::horizon::WithoutMask;
use super::model::Model;
use super::request::Request;
use crate::bus::{Inbox, Writer};
use crate::fault;
use crate::registry::Registry;
use crate::status::Board;
use crate::time::Stamp;

/// Of the thread that computes, beside 0 of all others.
const NICE: i32 = 5;
/// Latencies up to a minute, in us, to three digits.
const LONGEST_US: u64 = 60_000_000;

/// What a policy is started with.
#[derive(Debug)]
pub struct LiveOptions {
    /// The policy.
    pub bundle: Arc<Bundle>,
    /// What it does without a modality it was not trained to do without.
    pub without_mask: WithoutMask,
    /// Of the noise.
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
    /// Starts both threads. `actions` is where actions are published.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        options: LiveOptions,
        model: Model,
        registry: &Registry,
        inbox: Inbox,
        actions: Option<Arc<Writer>>,
        board: Arc<Board>,
    ) -> io::Result<Self> {
        let (stop, ended) = (CancellationToken::new(), CancellationToken::new());
        let (ask, asked) = sync_channel(1);
        let (tell, told) = sync_channel(1);
        let chunk = vec![0.0; model.chunk_len()];
        let request = Exchange { request: Request::new(&options.bundle), chunk, outcome: Ok(()), done: Stamp(0) };
        let policy =
            std::thread::Builder::new().name("policy".to_owned()).spawn(move || compute(model, &asked, &tell))?;
        let latencies = Histogram::new_with_bounds(1, LONGEST_US, 3).map_err(io::Error::other)?;
        let control = Control::new(options, registry, (inbox, actions, board), (ask, told), request, latencies);
        let (stopped, guard) = (stop.clone(), ended.clone().drop_guard());
        let control = std::thread::Builder::new().name("grid".to_owned()).spawn(move || {
            // Dropped by a panic too.
            let _guard = guard;
            control.run(&stopped);
        })?;
        Ok(Self { stop, ended, control, policy })
    }

    /// Cancelled when the policy no longer runs, whatever ended it.
    #[must_use]
    pub fn ended(&self) -> CancellationToken {
        self.ended.clone()
    }

    /// Ends both threads and waits for them, for a chunk that is being computed too. Says whether one of
    /// them panicked.
    ///
    /// # Errors
    /// The thread that panicked.
    pub fn stop(self) -> Result<(), &'static str> {
        self.stop.cancel();
        let control = self.control.join();
        // The end of the first ends the second: what it waits on is gone.
        let policy = self.policy.join();
        policy.map_err(|_| "the policy")?;
        control.map_err(|_| "the control loop")
    }
}

/// What goes back and forth between the threads.
struct Exchange {
    request: Request,
    chunk: Vec<f32>,
    outcome: Result<(), String>,
    done: Stamp,
}

fn compute(mut model: Model, asked: &Receiver<Exchange>, tell: &SyncSender<Exchange>) {
    // A tick is not to wait until a chunk has had its share of the processor; whoever may not do so computes
    // as important as the rest. Of the calling thread alone, on Linux.
    if let Err(error) = rustix::process::setpriority_process(None, NICE) {
        tracing::debug!(%error, "thread `policy` keeps its priority");
    }
    while let Ok(mut exchange) = asked.recv() {
        fault::point("policy");
        let answer = model.answer(&exchange.request, &mut exchange.chunk);
        exchange.outcome = answer.map_err(|error| error.to_string());
        exchange.done = Stamp::now();
        if tell.send(exchange).is_err() {
            return;
        }
    }
}
