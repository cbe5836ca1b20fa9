//! Stage recording: the thread that writes episodes, joined when it ends.

use std::sync::Arc;
use std::sync::mpsc::Sender;

use rapid_bus::Bus;
use rapid_core::time::WallClock;
use rapid_episode::ReferenceSample;
use rapid_episode::made::Shown;
use rapid_episode::record::{Recorder, RecorderAddition, RecorderConfig};
use rapid_registry::Registry;
use rapid_status::stops::States;
use rapid_status::{Board, EpisodeWatch};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::AppError;
use super::stage::{Stage, join};

/// The stage, and what the other stages need of it.
#[derive(Debug)]
pub(super) struct Recording {
    /// It ends when the recorder is dropped.
    pub(super) stage: Stage,
    pub(super) recorder: Recorder,
    /// The episode in progress.
    pub(super) episode: EpisodeWatch,
    /// The clock of the episode in progress.
    pub(super) clock: watch::Receiver<WallClock>,
    /// Receives the modalities that are added.
    pub(super) additions: Sender<RecorderAddition>,
    /// Receives the samples that the policy compares all later ones with.
    pub(super) references: Sender<ReferenceSample>,
    /// Cancelled when the thread has ended: it no longer uses the bus.
    pub(super) ended: CancellationToken,
}

impl Recording {
    /// Starts the thread. An episode records the `stops` at its beginning; what is written is `shown`, if anywhere.
    ///
    /// # Errors
    /// When the bus cannot be read, or the system provides no thread.
    pub(super) fn start(
        registry: &Arc<Registry>,
        bus: &Bus,
        board: &Arc<Board>,
        stops: States,
        shown: Option<Shown>,
    ) -> Result<Self, AppError> {
        let config = RecorderConfig { stops, shown, ..RecorderConfig::new(Arc::clone(registry), Arc::clone(board)) };
        let mut recorder = Recorder::spawn(bus.inbox()?, config)?;
        let (ended, thread) = (recorder.thread_ended(), recorder.hand_over());
        let has_ended = ended.clone();
        let stage = Stage::start("the recorder", |_| async move {
            has_ended.cancelled().await;
            match thread {
                Some(thread) => join(thread, "thread `writer`").await,
                None => Ok(()),
            }
        });
        Ok(Self {
            stage,
            episode: recorder.episode(),
            clock: recorder.clock(),
            additions: recorder.additions(),
            references: recorder.references(),
            ended,
            recorder,
        })
    }
}
