//! Threads with real-time priority.

use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, getrlimit};
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

/// For thread `mask`, which does almost nothing and comes before all others: above ordinary threads, below the
/// kernel's interrupt threads (50).
pub const MASK_PRIORITY: u8 = 40;
/// For thread `control`, which moves motors.
pub const CONTROL_PRIORITY: u8 = 30;

/// Puts the calling thread under `SCHED_FIFO`.
///
/// # Errors
/// Without `CAP_SYS_NICE` or an `RLIMIT_RTPRIO` of this priority: why, as text for the user.
pub fn use_fifo(priority: u8) -> Result<(), String> {
    let priority = ThreadPriorityValue::try_from(priority)?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(priority), policy)
        .map_err(|error| format!("{error:?}"))
}

/// Keeps every page of this process in memory from its first use on: a periodic thread must not wait for a disk because
/// another program needs memory.
///
/// # Errors
/// Without an unlimited `RLIMIT_MEMLOCK`, as less of it would make later allocations fail: why, as text for the user.
pub fn lock_memory() -> Result<(), String> {
    if let Some(limit) = getrlimit(Resource::Memlock).current {
        return Err(format!("it may lock {} KiB of memory only (`ulimit -l`)", limit >> 10));
    }
    // Not before the first use: most of the space of stacks and buffers is never used.
    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT).map_err(|error| error.to_string())
}
