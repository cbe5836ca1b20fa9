//! Threads that keep a beat.

use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

/// Of thread `mask`, which does almost nothing and comes before all others: above ordinary threads, below the
/// kernel's own interrupt threads (50).
pub const MASK_PRIORITY: u8 = 40;
/// Of thread `control`, which moves motors.
pub const CONTROL_PRIORITY: u8 = 30;

/// Puts the calling thread under `SCHED_FIFO`.
///
/// # Errors
/// Without `CAP_SYS_NICE` or an `RLIMIT_RTPRIO` of this priority: why, for people.
pub fn use_fifo(priority: u8) -> Result<(), String> {
    let priority = ThreadPriorityValue::try_from(priority)?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(priority), policy)
        .map_err(|error| format!("{error:?}"))
}
