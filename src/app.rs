//! The program: puts the stages together, runs them, and takes them down in order.
//!
//! Taking down: the episode ends and streams stop, the recorder finishes its file, the mask says 0
//! and its files go, the screen says what was recorded and gives the terminal back.
//!
//! Invariant: only this module sees every stage.
//! Invariant: whatever ends the run, an episode in progress is finished first.

use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{broadcast, mpsc};
use tokio::task::JoinHandle;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};
use tokio_util::sync::CancellationToken;

use crate::bus::{Bus, BusError, TopicId};
use crate::headless::style::ColourChoice;
use crate::headless::{self, HeadlessOptions};
use crate::hotplug::script::Script;
use crate::hotplug::udev::UdevMonitor;
use crate::hotplug::{HotplugError, HotplugStream};
use crate::logging::{self, LoggingError, Stderr};
use crate::mask::MASK_PATH;
use crate::record::{EpisodeRequest, RecordError, Recorder, RecorderConfig};
use crate::registry::Registry;
use crate::registry::scenario::Scenario;
use crate::rig::presence::{Claim, Presence, PresenceError};
use crate::rig::{Rig, RigCommand, RigError};
use crate::status::{Board, Command, Event, SlotState, What};
use crate::tui::{self, TuiError};

/// An episode asked for at the start begins when every attached device delivers, at the latest
/// after this time.
const SETTLE_LIMIT: Duration = Duration::from_secs(3);
/// Devices that are attached at the start are known after this time.
const SETTLE_LEAST: Duration = Duration::from_millis(100);
/// How often it is looked whether they deliver.
const SETTLE_LOOK: Duration = Duration::from_millis(20);

/// Where devices come from.
#[derive(Debug)]
pub enum Devices {
    /// This machine.
    Machine,
    /// A scenario.
    Simulated(Scenario),
}

/// How the run is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Screen {
    /// The full-screen monitor.
    Monitor,
    /// Lines for people.
    Lines,
    /// One JSON object a line.
    Json,
}

/// A run.
#[derive(Debug)]
pub struct Options {
    /// What is registered.
    pub registry: Registry,
    /// Where devices come from.
    pub devices: Devices,
    /// How the run is shown.
    pub screen: Screen,
    /// What an episode is called and where it goes; its duration is that of `duration`.
    pub episode: EpisodeRequest,
    /// Begin an episode at the start.
    pub record: bool,
    /// How long to record, or to run when nothing is recorded.
    pub duration: Option<Duration>,
    /// Keeps this rig apart from another on the machine.
    pub instance: Option<String>,
}

/// Why a run could not begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// The log.
    #[error(transparent)]
    Logging(#[from] LoggingError),
    /// The mask.
    #[error(transparent)]
    Presence(#[from] PresenceError),
    /// The bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// Plugging.
    #[error(transparent)]
    Hotplug(#[from] HotplugError),
    /// The rig.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The recorder.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The monitor.
    #[error(transparent)]
    Tui(#[from] TuiError),
    /// The output of a headless run.
    #[error("output: {0}")]
    Output(std::io::Error),
    /// A thread or signal handler.
    #[error("the system refuses: {0}")]
    System(#[from] std::io::Error),
    /// An episode's file is not whole.
    #[error("{}: {reason}", file.display())]
    Episode {
        /// What there is of it.
        file: PathBuf,
        /// Why.
        reason: String,
    },
    /// A task of ours panicked.
    #[error("{0} panicked; please report this")]
    Panicked(&'static str),
    /// A second signal came while the run was ending.
    #[error("interrupted twice")]
    InterruptedTwice,
}

/// Where the mask of an instance is published.
#[must_use]
pub fn mask_path(instance: Option<&str>) -> PathBuf {
    match instance {
        None => Path::new(MASK_PATH).to_owned(),
        Some(name) => PathBuf::from(format!("{MASK_PATH}.{name}")),
    }
}

/// Runs the rig until a signal, the user or the duration ends it.
///
/// # Errors
/// When it cannot begin or go on; an episode in progress has been finished by then, or the error
/// says why it has not.
pub async fn run(options: Options) -> Result<(), AppError> {
    let registry = Arc::new(options.registry);
    let board = Arc::new(Board::new(&registry));
    let stderr = match options.screen {
        Screen::Monitor => Stderr::Nothing,
        Screen::Lines => Stderr::Text,
        Screen::Json => Stderr::Json,
    };
    logging::init(Arc::clone(&board), std::env::var("RAPID_LOG").ok().as_deref(), stderr)?;
    let signals = Signals::listen()?;

    // First of all: are we the only one? A registry has at most 64 devices.
    let count = u8::try_from(registry.devices.len()).unwrap_or(u8::MAX);
    let claim = Claim::new(&mask_path(options.instance.as_deref()), count)?;
    let bus = Bus::open(&registry, options.instance.as_deref())?;
    let Some(mask_writer) = bus.writer(TopicId::Mask) else { return Err(AppError::Panicked("the bus")) };
    let presence = Presence::start(claim, mask_writer, Arc::clone(&board))?;
    let recorder = Recorder::spawn(bus.inbox()?, RecorderConfig::new(Arc::clone(&registry), Arc::clone(&board)))?;
    let screen_stop = CancellationToken::new();
    let (commands, asked) = mpsc::channel(16);
    let screen = start_screen(&options.screen, &board, commands, screen_stop.clone(), options.duration);

    let hotplug: HotplugStream = match options.devices {
        Devices::Machine => Box::pin(UdevMonitor::open()?),
        Devices::Simulated(scenario) => Box::pin(Script::new(scenario)),
    };
    let rig_stop = CancellationToken::new();
    let (rig_commands, rig_asked) = mpsc::channel(16);
    let mut rig = Rig::new(&registry, &bus, presence, Arc::clone(&board));
    let rig = tokio::spawn({
        let stop = rig_stop.clone();
        async move {
            let outcome = rig.run(hotplug, rig_asked, stop).await;
            (rig, outcome)
        }
    });
    let episode = EpisodeRequest { duration: options.duration, ..options.episode };
    let mut conductor = Conductor {
        events: board.events(),
        board,
        recorder,
        rig_commands,
        episode,
        record: options.record,
        duration: options.duration,
        recording: false,
    };
    let mut running = Running { rig, rig_stop, screen, screen_stop, signals, asked };
    let outcome = conductor.conduct(&mut running).await;
    finish(running, conductor, outcome).await
}

type ScreenTask = JoinHandle<Result<(), AppError>>;

fn start_screen(
    screen: &Screen,
    board: &Arc<Board>,
    commands: mpsc::Sender<Command>,
    stop: CancellationToken,
    duration: Option<Duration>,
) -> ScreenTask {
    let board = Arc::clone(board);
    if *screen == Screen::Monitor {
        return tokio::spawn(async move { Ok(tui::run(board, commands, stop).await?) });
    }
    let options = HeadlessOptions {
        json: *screen == Screen::Json,
        colour: ColourChoice::Auto,
        progress: *screen == Screen::Lines,
        duration,
    };
    let run = headless::run(board, stop, options, std::io::stdout());
    tokio::spawn(async move {
        let outcome = run.await.map_err(AppError::Output);
        // A reader that has gone ends the output, not the recording: nobody asks to quit here.
        drop(commands);
        outcome
    })
}

/// The tasks of a run, and what can be asked of it from outside.
struct Running {
    rig: JoinHandle<(Rig, Result<(), RigError>)>,
    rig_stop: CancellationToken,
    screen: ScreenTask,
    screen_stop: CancellationToken,
    signals: Signals,
    asked: mpsc::Receiver<Command>,
}

/// Does what the user asks for, from the first sample to the order to end.
struct Conductor {
    board: Arc<Board>,
    events: broadcast::Receiver<Event>,
    recorder: Recorder,
    rig_commands: mpsc::Sender<RigCommand>,
    episode: EpisodeRequest,
    record: bool,
    duration: Option<Duration>,
    recording: bool,
}

impl Conductor {
    /// Returns when the run is to end, and why if it is an error.
    async fn conduct(&mut self, running: &mut Running) -> Result<(), AppError> {
        let begun = Instant::now();
        let mut look = interval(SETTLE_LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let end = match (self.record, self.duration) {
            (false, Some(duration)) => Some(begun + duration),
            _ => None,
        };
        let mut begin_episode = self.record;
        loop {
            tokio::select! {
                biased;
                () = running.signals.next() => return Ok(()),
                _ = &mut running.rig, if !running.rig_stop.is_cancelled() => {
                    // Its outcome is taken when everything is taken down.
                    return Ok(());
                }
                outcome = &mut running.screen => {
                    return outcome.unwrap_or(Err(AppError::Panicked("the screen")));
                }
                Some(command) = running.asked.recv() => match command {
                    Command::ToggleRecording => self.toggle().await?,
                    Command::Restart(id) => { let _ = self.rig_commands.send(RigCommand::Restart(id)).await; }
                    Command::Quit => return Ok(()),
                },
                event = self.events.recv() => {
                    if self.episode_ended(event)? { return Ok(()); }
                }
                _ = look.tick(), if begin_episode => {
                    if self.has_settled(begun) {
                        begin_episode = false;
                        self.start().await?;
                    }
                }
                () = sleep_until(end.unwrap_or(begun)), if end.is_some() => return Ok(()),
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

/// Takes everything down, in the order of the module's comment. The first error is the run's.
async fn finish(mut running: Running, conductor: Conductor, mut outcome: Result<(), AppError>) -> Result<(), AppError> {
    let Conductor { recorder, recording, board, .. } = conductor;
    running.rig_stop.cancel();
    let rig = running.rig;
    let take_down = async {
        let rig = match rig.await {
            Ok((rig, ended)) => {
                keep_first(&mut outcome, ended.map_err(AppError::from));
                Some(rig)
            }
            Err(_) => {
                keep_first(&mut outcome, Err(AppError::Panicked("the rig")));
                None
            }
        };
        if recording && let Ok(report) = recorder.stop().await {
            let failed = report.error.map(|reason| AppError::Episode { file: report.file, reason });
            keep_first(&mut outcome, failed.map_or(Ok(()), Err));
        }
        // Dropping joins threads: the writer's, which has nothing left to write, and the mask's.
        let dropped = tokio::task::spawn_blocking(move || {
            drop(recorder);
            drop(rig);
        });
        keep_first(&mut outcome, dropped.await.map_err(|_| AppError::Panicked("the recorder")));
    };
    let mut take_down: Pin<Box<_>> = Box::pin(take_down);
    let twice = tokio::select! {
        biased;
        () = &mut take_down => false,
        () = running.signals.next() => true,
    };
    if twice {
        // The recorder's finish is the one thing that is never skipped.
        take_down.as_mut().await;
    }
    drop(take_down);
    running.screen_stop.cancel();
    if !running.screen.is_finished() {
        let ended = (&mut running.screen).await;
        keep_first(&mut outcome, ended.unwrap_or(Err(AppError::Panicked("the screen"))));
    }
    drop(board);
    if twice { outcome.and(Err(AppError::InterruptedTwice)) } else { outcome }
}

fn keep_first(outcome: &mut Result<(), AppError>, next: Result<(), AppError>) {
    if outcome.is_ok() {
        *outcome = next;
    }
}

/// SIGINT, SIGTERM, and SIGHUP for a terminal that was closed: all of them end the run.
struct Signals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
    hangup: tokio::signal::unix::Signal,
}

impl Signals {
    fn listen() -> std::io::Result<Self> {
        Ok(Self {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
            hangup: signal(SignalKind::hangup())?,
        })
    }

    async fn next(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
            _ = self.hangup.recv() => {}
        }
    }
}
