//! A stage of a run: a tokio task that owns the threads that block on its behalf.
//!
//! | stage           | its task                                           | what blocks for it                           |
//! |-----------------|----------------------------------------------------|----------------------------------------------|
//! | discovery       | reads hot-plug events and hands them to streaming  | nothing: netlink and mDNS sockets are polled |
//! | streaming       | the rig: states, mask, a task for each device      | thread `mask`, threads of drivers            |
//! | synchronisation | publishes the observation of each tick             | nothing: it looks at the bus at each tick    |
//! | recording       | waits for its thread and joins it                  | thread `writer`                              |
//! | inference       | loads the policy, starts it and joins its threads  | threads `grid` and `policy`                  |
//! | registry        | takes over entries that are added to the registry  | reads of files, opening of topics            |
//! | Foxglove        | waits for its thread                               | thread `foxglove`                            |
//! | page            | waits for its thread                               | thread `web`                                 |
//!
//! Recording and inference do not wait for the observations of synchronisation: they apply the same rules
//! ([`rapid_core::sync`]) at their own ticks, the recorder once the samples in transit have arrived, the policy on its own
//! grid, and neither loses an observation because another task is late.
//!
//! Invariant: a stage reports once how it ended, whether it was stopped or not; a panic is an end like any other.
//! Invariant: no stage blocks a worker of the runtime: threads are joined where blocking is allowed.

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::AppError;

/// A running stage.
#[derive(Debug)]
pub struct Stage {
    name: &'static str,
    /// Until its outcome is taken.
    task: Option<JoinHandle<Result<(), AppError>>>,
    stop: CancellationToken,
}

impl Stage {
    /// Starts the task, which must end when its token is cancelled.
    pub(super) fn start<F>(name: &'static str, run: impl FnOnce(CancellationToken) -> F) -> Self
    where
        F: Future<Output = Result<(), AppError>> + Send + 'static,
    {
        let stop = CancellationToken::new();
        Self { name, task: Some(tokio::spawn(run(stop.clone()))), stop }
    }

    /// Waits for the end of the task and takes the outcome; never returns if it is taken already. Cancel-safe.
    pub(super) async fn outcome(&mut self) -> Result<(), AppError> {
        let Some(task) = &mut self.task else { return std::future::pending().await };
        let outcome = task.await;
        self.task = None;
        outcome.unwrap_or(Err(AppError::Panicked(self.name)))
    }

    /// Requests the task to end. Does not wait.
    pub(super) fn request_end(&self) {
        self.stop.cancel();
    }

    /// Requests the task to end and waits; `Ok` if its outcome is taken already.
    pub(super) async fn end(&mut self) -> Result<(), AppError> {
        self.request_end();
        if self.task.is_some() { self.outcome().await } else { Ok(()) }
    }
}

/// Joins a thread that is ending, where blocking is allowed.
///
/// # Errors
/// When it panicked: `thread` names it.
pub(super) async fn join(handle: std::thread::JoinHandle<()>, thread: &'static str) -> Result<(), AppError> {
    let joined = tokio::task::spawn_blocking(move || handle.join()).await;
    if let Ok(Ok(())) = joined { Ok(()) } else { Err(AppError::Panicked(thread)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_stage_ends_on_request_and_reports_once() {
        let mut stage = Stage::start("test", |stop| async move {
            stop.cancelled().await;
            Err(AppError::Stuck)
        });
        assert!(matches!(stage.end().await, Err(AppError::Stuck)));
        assert!(stage.end().await.is_ok());
    }

    #[tokio::test]
    async fn a_panic_ends_the_stage_with_an_error_that_names_it() {
        let mut stage = Stage::start("test", |_| async { panic!("ordered") });
        assert!(matches!(stage.outcome().await, Err(AppError::Panicked("test"))));
    }

    #[tokio::test]
    async fn a_panicked_thread_is_named() {
        let thread = std::thread::spawn(|| panic!("ordered"));
        assert!(matches!(join(thread, "thread `test`").await, Err(AppError::Panicked("thread `test`"))));
        join(std::thread::spawn(|| ()), "thread `test`").await.unwrap();
    }
}
