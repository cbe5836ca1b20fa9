//! The bare loop: a thread that wakes on absolute deadlines and does nothing else. The machine's own limit.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rapid::rig::presence::PERIOD;
use rapid_core::time::{Stamp, realtime_ns};
use rustix::thread::{ClockId, Timespec, clock_nanosleep_absolute};
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

use crate::child::thread_cpu_s;

/// The priority of `rapid`'s mask thread.
const FIFO_PRIORITY: u8 = 40;

/// Measurements of a loop.
#[derive(Debug, Default)]
pub(crate) struct Beaten {
    /// `CLOCK_REALTIME` of every wake-up, ns.
    stamps: Vec<u64>,
    /// It ran under `SCHED_FIFO`.
    pub(crate) fifo: bool,
    /// Share of a core that it used, %.
    pub(crate) cpu: f64,
}

impl Beaten {
    /// Time between consecutive wake-ups, ms.
    pub(crate) fn intervals(&self) -> impl Iterator<Item = f64> {
        self.stamps.windows(2).map(|pair| pair[1].saturating_sub(pair[0]) as f64 / 1e6)
    }
}

/// A running loop.
#[derive(Debug)]
pub(crate) struct Beat {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Beaten>,
}

impl Beat {
    /// Starts a loop with the mask's period.
    pub(crate) fn start() -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let thread = std::thread::spawn({
            let stop = Arc::clone(&stop);
            move || {
                let fifo = use_fifo();
                let mut stamps = Vec::with_capacity(1 << 16);
                let (begun, cpu) = (Stamp::now(), thread_cpu_s());
                let mut due = begun;
                while !stop.load(Ordering::Relaxed) {
                    due = due.after(PERIOD);
                    sleep_until(due);
                    stamps.push(realtime_ns());
                }
                let cpu = 100.0 * (thread_cpu_s() - cpu) / Stamp::now().since(begun).as_secs_f64().max(0.001);
                Beaten { stamps, fifo, cpu }
            }
        });
        Self { stop, thread }
    }

    /// Ends it.
    pub(crate) fn end(self) -> Beaten {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_default()
    }
}

/// Sleeps until a time of `CLOCK_MONOTONIC`.
pub(crate) fn sleep_until(due: Stamp) {
    let request = Timespec {
        tv_sec: i64::try_from(due.0 / 1_000_000_000).unwrap_or(i64::MAX),
        tv_nsec: i64::try_from(due.0 % 1_000_000_000).unwrap_or_default(),
    };
    // A signal ends a sleep early; then the sleep is repeated.
    while clock_nanosleep_absolute(ClockId::Monotonic, &request).is_err() {}
}

/// Sleeps for a time.
pub(crate) fn sleep(time: Duration) {
    sleep_until(Stamp::now().after(time));
}

/// Gives the calling thread the priority of `rapid`'s mask thread; true if that is permitted.
pub(crate) fn use_fifo() -> bool {
    let Ok(priority) = ThreadPriorityValue::try_from(FIFO_PRIORITY) else { return false };
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(priority), policy).is_ok()
}
