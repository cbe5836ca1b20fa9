//! The conductor: does what the user, the command line and the clock ask for, until one of them asks
//! for the end.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{broadcast, mpsc};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};
use tokio_util::sync::CancellationToken;

use super::{AppError, Running, Screen, screen_ended};
use crate::fault;
use crate::record::{EpisodeRequest, Recorder};
use crate::rig::RigCommand;
use crate::status::{Board, Command, Event, SlotState, What};

/// An episode asked for at the start begins when every attached device delivers, at the latest
/// after this time.
const SETTLE_LIMIT: Duration = Duration::from_secs(3);
/// Devices that are attached at the start are known after this time.
const SETTLE_LEAST: Duration = Duration::from_millis(100);
/// How often it is looked whether they deliver.
const SETTLE_LOOK: Duration = Duration::from_millis(20);

/// Does what the user asks for, from the first sample to the order to end.
pub(super) struct Conductor {
    pub(super) board: Arc<Board>,
    pub(super) events: broadcast::Receiver<Event>,
    pub(super) recorder: Recorder,
    pub(super) writer_ended: CancellationToken,
    pub(super) rig_commands: mpsc::Sender<RigCommand>,
    pub(super) episode: EpisodeRequest,
    pub(super) record: bool,
    pub(super) duration: Option<Duration>,
    pub(super) recording: bool,
}

impl Conductor {
    /// Returns when the run is to end, and why if it is an error.
    pub(super) async fn conduct(&mut self, running: &mut Running) -> Result<(), AppError> {
        let begun = Instant::now();
        let mut look = interval(SETTLE_LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let end = match (self.record, self.duration) {
            (false, Some(duration)) => Some(begun + duration),
            _ => None,
        };
        let mut begin_episode = self.record;
        // Nobody reads the output any more, and how that came.
        let mut output = Ok(());
        loop {
            tokio::select! {
                biased;
                () = running.signals.next() => return output,
                // Its outcome is taken when everything is taken down.
                () = running.rig_ended.cancelled() => return output,
                () = running.mask_ended.cancelled() => return Err(AppError::Panicked("thread `mask`")),
                outcome = screen_ended(&mut running.screen) => match outcome {
                    Err(panicked @ AppError::Panicked(_)) => return Err(panicked),
                    // An episode is worth more than its log lines, and goes on without.
                    outcome if self.record && running.kind != Screen::Monitor => output = outcome,
                    outcome => return outcome,
                },
                Some(command) = running.asked.recv() => match command {
                    Command::ToggleRecording => self.toggle().await?,
                    // A rig that is so far behind will not get to it in time either.
                    Command::Restart(id) => { let _ = self.rig_commands.try_send(RigCommand::Restart(id)); }
                    Command::Quit => return output,
                },
                event = self.events.recv() => {
                    if self.episode_ended(event)? { return output; }
                }
                // After the events: what became of its episode says more.
                () = self.writer_ended.cancelled() => return Err(AppError::Panicked("thread `writer`")),
                never = fault::strike("main") => never,
                _ = look.tick(), if begin_episode => {
                    if self.has_settled(begun) {
                        begin_episode = false;
                        self.start().await?;
                    }
                }
                () = sleep_until(end.unwrap_or(begun)), if end.is_some() => return output,
            }
        }
    }

    /// Has every device that is attached delivered its first sample?
    fn has_settled(&self, begun: Instant) -> bool {
        let waited = begun.elapsed();
        let opening = self.board.snapshot().devices.iter().any(|device| device.state == SlotState::Opening);
        waited >= SETTLE_LIMIT || (waited >= SETTLE_LEAST && !opening)
    }

    async fn toggle(&mut self) -> Result<(), AppError> {
        if self.recording {
            // What became of it is announced as an event and shown by the screen.
            let _ = self.recorder.stop().await;
            self.recording = false;
            return Ok(());
        }
        match self.start().await {
            Err(AppError::Record(error)) => {
                // In the monitor, a full disk is no reason to leave: it is said and can be mended.
                tracing::error!(%error, "the episode was not begun");
                Ok(())
            }
            outcome => outcome,
        }
    }

    async fn start(&mut self) -> Result<(), AppError> {
        self.recorder.start(self.episode.clone()).await?;
        self.recording = true;
        Ok(())
    }

    /// Ends the episode in progress, if there is one; an error if its file is not whole.
    pub(super) async fn finish_episode(&mut self) -> Result<(), AppError> {
        if !std::mem::take(&mut self.recording) {
            return Ok(());
        }
        if let Ok(report) = self.recorder.stop().await {
            return match report.error {
                Some(reason) => Err(AppError::Episode { file: report.file, reason }),
                None => Ok(()),
            };
        }
        // It ended by itself while the run did: how, is among the events that nobody took.
        while let Ok(event) = self.events.try_recv() {
            if let What::Episode { file, error: Some(reason), .. } = event.what {
                return Err(AppError::Episode { file, reason });
            }
        }
        Ok(())
    }

    /// True when the episode the run was for has ended.
    fn episode_ended(&mut self, event: Result<Event, broadcast::error::RecvError>) -> Result<bool, AppError> {
        let Ok(Event { what: What::Episode { file, error, .. }, .. }) = event else { return Ok(false) };
        self.recording = false;
        if !self.record {
            return Ok(false);
        }
        match error {
            Some(reason) => Err(AppError::Episode { file, reason }),
            // The first episode was asked for on the command line; with a duration it was all.
            None => Ok(self.duration.is_some()),
        }
    }
}
