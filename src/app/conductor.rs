//! The conductor: carries out what the user, the command line and the clock request, until one of them ends the run.
//!
//! Invariant: what concerns episodes is decided by the session ([`Collection`]), and nothing of it here.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::sample::Epoch;
use rapid_core::time::Stamp;
use rapid_episode::record::RecordError;
use rapid_status::{Board, DeviceState, DeviceStatus, EpisodeReport, EventKind, Level};
use rapid_system::fault;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};
use tokio_util::sync::CancellationToken;

use super::collection::Collection;
use super::settling::has_settled;
use super::stage::Stage;
use super::{AppError, Request, Running, Screen};

/// Interval at which devices that are still opening are looked for.
const SETTLE_LOOK: Duration = Duration::from_millis(20);

/// If no device is plugged in, this is reported after this time.
const NONE_AFTER: Duration = Duration::from_secs(3);

/// Carries out requests, from the first sample to the request to end.
pub(super) struct Conductor {
    pub(super) board: Arc<Board>,
    pub(super) collection: Collection,
    pub(super) record: bool,
    /// The run is for one episode, and not for a session of several.
    pub(super) is_single: bool,
    pub(super) duration: Option<Duration>,
    /// An episode is still to begin, as soon as every device delivers samples.
    pub(super) begin_episode: bool,
    /// The policy is loaded, if there is one: the run's time begins.
    pub(super) loaded: CancellationToken,
}

impl Conductor {
    /// Returns when the run is to end, with the reason if it is an error.
    pub(super) async fn conduct(&mut self, running: &mut Running) -> Result<(), AppError> {
        let mut begun = Instant::now();
        let mut is_loaded = self.loaded.is_cancelled();
        let mut look = interval(SETTLE_LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let length = self.duration.filter(|_| !self.record);
        let mut has_looked = false;
        // How the output ended, once it has no reader.
        let mut output = Ok(());
        loop {
            let due = self.collection.due();
            let end = length.map(|length| begun + length);
            tokio::select! {
                biased;
                () = running.signals.next() => return output,
                // The outcome is taken during the shutdown.
                () = running.streaming.ending.cancelled() => return output,
                () = running.streaming.closed.cancelled() => return output,
                () = running.mask_ended.cancelled() => return Err(AppError::Panicked("thread `mask`")),
                // It ends without a request only when it cannot continue.
                outcome = policy_ended(&mut running.inference) => return outcome,
                outcome = running.screen.outcome() => match outcome {
                    Err(panicked @ AppError::Panicked(_)) => return Err(panicked),
                    // An episode is worth more than its log lines: the run continues without them.
                    outcome if self.record && running.kind != Screen::Monitor => output = outcome,
                    outcome => return outcome,
                },
                // Before requests: the end of the last episode is handled before the next one begins.
                end = self.collection.ended() => if self.episode_ended(end, running.kind).await? { return output },
                Some(request) = running.requests.recv() => {
                    // A slow disk takes time to close a file: a signal does not wait for it. The recorder still carries
                    // out the request, and its end is taken during the shutdown.
                    tokio::select! {
                        biased;
                        () = running.signals.next() => return output,
                        carried_out = self.carry_out(request, running.kind) => if carried_out?.is_break() { return output },
                    }
                }
                // Nothing else depends on it: an episode and a policy continue, and the run ends as one that failed.
                outcome = running.synchronisation.outcome() => {
                    output = outcome.and(Err(AppError::Panicked("the synchronisation")));
                    let text = "the synchronisation panicked: no more observations are published".to_owned();
                    self.board.announce(EventKind::Log { level: Level::Error, text });
                }
                // After the end of its episode, which explains more.
                outcome = running.recording.outcome() => return outcome.and(Err(AppError::Panicked("the recorder"))),
                never = fault::strike("main") => never,
                () = self.loaded.cancelled(), if !is_loaded => (is_loaded, begun) = (true, Instant::now()),
                _ = look.tick(), if is_loaded && self.begin_episode => {
                    if has_settled(&self.board, begun.elapsed()) {
                        self.begin_episode = false;
                        if self.begin_first(running.kind).await? {
                            return output;
                        }
                    }
                }
                () = reached(due) => {
                    let begun = self.collection.tick().await;
                    self.tolerate(begun, running.kind)?;
                }
                () = sleep_until(end.unwrap_or(begun)), if is_loaded && end.is_some() => return output,
                () = sleep_until(begun + NONE_AFTER), if is_loaded && !has_looked => {
                    has_looked = true;
                    self.warn_if_none();
                }
            }
        }
    }

    /// Begins the episode that the command line asked for. True if there is nothing to record: the session has what `--goal`
    /// wants, and without a monitor it stays so.
    async fn begin_first(&mut self, screen: Screen) -> Result<bool, AppError> {
        if !self.collection.was_complete() {
            self.collection.start().await?;
            return Ok(false);
        }
        let text = "the session in this folder has as many episodes as --goal wants: none begins by itself".to_owned();
        self.board.announce(EventKind::Log { level: Level::Warn, text });
        Ok(screen != Screen::Monitor)
    }

    async fn carry_out(&mut self, request: Request, screen: Screen) -> Result<ControlFlow<()>, AppError> {
        match request {
            Request::Session(request, at, reply) => {
                // Also the one that waits for all devices to deliver is begun, or called off.
                self.begin_episode &= !request.is_about_recording();
                let begun = self.collection.request(&request, at, reply).await;
                self.tolerate(begun, screen)?;
            }
            Request::Quit => return Ok(ControlFlow::Break(())),
        }
        Ok(ControlFlow::Continue(()))
    }

    /// A run that waits for its first device looks like one that works. Unplugged devices are reported by events.
    fn warn_if_none(&self) {
        let devices = self.board.snapshot().devices;
        let never = |device: &DeviceStatus| device.state == DeviceState::Absent && device.epoch == Epoch::default();
        if !devices.is_empty() && devices.iter().all(never) {
            let text = "no device of the registry is plugged in; `rapid devices` lists what is, and which entry it is";
            self.board.announce(EventKind::Log { level: Level::Warn, text: text.to_owned() });
        }
    }

    /// In the monitor, a full disk is no reason to exit: it is reported and can be fixed. A run that is to record by
    /// itself ends.
    fn tolerate(&self, begun: Result<(), RecordError>, screen: Screen) -> Result<(), AppError> {
        match begun {
            Err(error) if self.record && screen != Screen::Monitor => Err(error.into()),
            Err(error) => {
                tracing::error!(%error, "the episode was not begun");
                Ok(())
            }
            Ok(()) => Ok(()),
        }
    }

    /// Ends the episode in progress, if there is one; an error if its file is not whole.
    pub(super) async fn finish_episode(&mut self) -> Result<(), AppError> {
        self.collection.finish_episode().await.map_or(Ok(()), whole)
    }

    /// True when what the run was for has been recorded.
    async fn episode_ended(&mut self, end: EpisodeReport, screen: Screen) -> Result<bool, AppError> {
        let begun = self.collection.note_end(&end).await;
        if !self.record {
            self.tolerate(begun, screen)?;
            return Ok(false);
        }
        whole(end)?;
        self.tolerate(begun, screen)?;
        // The first episode was requested on the command line; if a duration was given too, it was the whole run.
        let is_single = self.is_single && self.duration.is_some();
        Ok(is_single || (screen != Screen::Monitor && self.collection.is_complete()))
    }
}

/// An error if the file of the episode is not whole.
fn whole(EpisodeReport { file, error, .. }: EpisodeReport) -> Result<(), AppError> {
    match error {
        Some(reason) => Err(AppError::Episode { file, reason }),
        None => Ok(()),
    }
}

/// Waits until then, if it is a time.
pub(super) async fn reached(due: Option<Stamp>) {
    match due {
        Some(due) => tokio::time::sleep(due.since(Stamp::now())).await,
        None => std::future::pending().await,
    }
}

/// Waits for the end of the policy, if there is one, and takes its outcome.
async fn policy_ended(inference: &mut Option<Stage>) -> Result<(), AppError> {
    match inference {
        Some(inference) => inference.outcome().await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests;
