//! The program: puts the stages together, runs them, and takes them down in order.
//!
//! Taking down: the episode ends, the policy holds and actuators are disarmed, the last samples of the episode arrive,
//! streams stop, the recorder finishes its file, the programs of devices are waited for, the mask is 0 and its files
//! go, the screen shows what was recorded and gives the terminal back.
//!
//! Invariant: only this module sees every stage.
//! Invariant: whatever ends the run, an episode in progress is finished first.
//! Invariant: an episode ends at the moment its end was asked for, whatever closes slowly after that.

mod asked;
mod autopilot;
mod conductor;
mod error;
mod screen;
pub(crate) mod signals;
mod watch;
mod watchdog;

use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use crate::bus::{self, Bus, TopicId};
use crate::driver;
use crate::fault;
use crate::hotplug::HotplugStream;
use crate::hotplug::lan::LanMonitor;
use crate::hotplug::script::Script;
use crate::hotplug::udev::UdevMonitor;
use crate::interlock::Interlocks;
use crate::interlocks::{self, Watched};
use crate::logging::{self, Stderr};
use crate::mask::MASK_PATH;
use crate::orders::receive::Orders;
use crate::panics;
use crate::permission::Permission;
use crate::record::recover::Repairs;
use crate::record::{EpisodeRequest, Recorder, RecorderConfig};
use crate::registry::Registry;
use crate::registry::scenario::Scenario;
use crate::rig::presence::{Claim, Presence};
use crate::rig::{Rig, RigError};
use crate::status::Board;
use crate::time::Stamp;
use asked::Asked;
use autopilot::Autopilot;
pub use autopilot::PolicyOptions;
use conductor::Conductor;
pub use error::AppError;
use signals::Signals;
use watchdog::Watchdog;

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

impl Screen {
    const fn stderr(self) -> Stderr {
        match self {
            Self::Monitor => Stderr::Nothing,
            Self::Lines => Stderr::Text,
            Self::Json => Stderr::Json,
        }
    }
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
    /// The policy at the controls, if one is to be.
    pub policy: Option<PolicyOptions>,
    /// Begin an episode at the start.
    pub record: bool,
    /// Arm the actuator as soon as it is there, once.
    pub arm: bool,
    /// How long to record, or to run when nothing is recorded.
    pub duration: Option<Duration>,
    /// Keeps this rig apart from another on the machine.
    pub instance: Option<String>,
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
    let stderr = options.screen.stderr();
    // Lines still on their way to standard error are waited for when this goes.
    let _log = logging::init(Arc::clone(&board), std::env::var("RAPID_LOG").ok().as_deref(), stderr)?;
    if options.screen != Screen::Monitor {
        panics::to_log();
    }
    // Before anything that a full or damaged machine may refuse.
    let interlocks = interlocks::of(&registry);
    let (permission, _orders) = take_orders(options.instance.as_deref(), options.arm, interlocks)?;
    let (signals, _fed) = (Signals::listen()?, Watchdog::feed());

    bus::check_memory()?;
    // First of all: are we the only one? A registry has at most 64 devices.
    let count = u8::try_from(registry.devices.len()).unwrap_or(u8::MAX);
    let claim = Claim::new(&mask_path(options.instance.as_deref()), count)?;
    Bus::clear_others(options.instance.as_deref());
    let bus = Bus::open(&registry, options.instance.as_deref())?;
    let Some(mask_writer) = bus.writer(TopicId::Mask) else { return Err(AppError::Panicked("the bus")) };
    let presence = Presence::start(claim, mask_writer, Arc::clone(&board))?;
    let mask_ended = presence.ended();
    let recorder = Recorder::spawn(bus.inbox()?, RecorderConfig::new(Arc::clone(&registry), Arc::clone(&board)))?;
    // Before the screen: what fails until here is said on an ordinary terminal.
    let hotplug: HotplugStream = match options.devices {
        Devices::Machine => {
            driver::can::prepare(&registry);
            if !Path::new(UDEV).exists() {
                tracing::warn!("no udev runs here ({UDEV} is missing): USB devices are not seen; start systemd-udevd");
            }
            match LanMonitor::open(&registry) {
                Some(lan) => Box::pin(futures::stream::select(UdevMonitor::open()?, lan)),
                None => Box::pin(UdevMonitor::open()?),
            }
        }
        Devices::Simulated(scenario) => Box::pin(Script::new(scenario)),
    };
    let screen_stop = CancellationToken::new();
    let (commands, from_screen) = mpsc::channel(16);
    let screen = screen::start(options.screen, &board, commands, &permission, screen_stop.clone(), options.duration);

    let rig_stop = CancellationToken::new();
    let (rig_commands, rig_asked) = mpsc::channel(16);
    let asked = asked::sorted(from_screen, rig_commands);
    // To the very end: what is being taken down may still move.
    let watched = Watched::begin(&registry, &permission, &board).map_err(AppError::Interlocks)?;
    let rig = Rig::new(&registry, &bus, presence, Arc::clone(&board)).following(recorder.episode());
    let mut rig = rig.obeying(&permission).tapped(watched.taps());
    let rig_ended = CancellationToken::new();
    let (hurry, rig_ending) = (rig.hurry(), rig.ending());
    let rig = tokio::spawn({
        let (stop, ended) = (rig_stop.clone(), rig_ended.clone().drop_guard());
        async move {
            // Dropped by a panic too.
            let _ended = ended;
            let outcome = tokio::select! {
                outcome = rig.run(hotplug, rig_asked, stop) => outcome,
                never = fault::strike("rig") => never,
            };
            (rig, outcome)
        }
    });
    let autopilot =
        options.policy.map(|policy| Autopilot::launch(policy, &registry, &bus, &board, options.record)).transpose()?;
    let episode = EpisodeRequest { duration: options.duration, ..options.episode };
    // In the background: nothing of this run waits for what an earlier one left behind.
    let may_record = options.record || options.screen == Screen::Monitor;
    let _repairs = may_record.then(|| {
        let repairs = Repairs::start(episode.out.clone(), registry.rig.disk_reserve, Arc::clone(&board));
        repairs.inspect_err(|error| tracing::warn!(%error, "unfinished episodes are not repaired")).ok()
    });
    let mut conductor = Conductor {
        events: board.events(),
        board,
        writer_ended: recorder.ended(),
        recorder,
        episode,
        record: options.record,
        duration: options.duration,
        begin_episode: options.record,
    };
    let (kind, screen) = (options.screen, Some(screen));
    let mut running = Running {
        permission,
        watched,
        rig,
        rig_ending,
        rig_ended,
        rig_stop,
        hurry,
        mask_ended,
        kind,
        screen,
        screen_stop,
        signals,
        asked,
        autopilot,
    };
    // A panic here ends the run like any other: what it leaves is taken down in order.
    let conducted = async {
        tokio::select! {
            outcome = conductor.conduct(&mut running) => outcome,
            never = watch::over(bus.watchman()) => never,
        }
    };
    let conducted = AssertUnwindSafe(conducted).catch_unwind().await;
    let outcome = conducted.unwrap_or(Err(AppError::Panicked("the main task")));
    finish(running, conductor, outcome).await
}

/// Lets other programs, and signals, say whether motors may move, whatever else the run waits for.
fn take_orders(
    instance: Option<&str>,
    arm: bool,
    interlocks: Interlocks,
) -> Result<(Arc<Permission>, Orders), AppError> {
    let permission = Arc::new(Permission::new(arm).with_interlocks(interlocks));
    let orders = Orders::receive(instance, Arc::clone(&permission)).map_err(AppError::Orders)?;
    tokio::spawn({
        let (mut signals, permission) = (Signals::listen()?, Arc::clone(&permission));
        async move {
            loop {
                signals.next().await;
                permission.disarm(Stamp::now());
            }
        }
    });
    Ok((permission, orders))
}

/// Made by udev's daemon when it starts.
const UDEV: &str = "/run/udev/control";
/// The screen has limits of its own for a reader that does not read. This one is for a screen that is
/// stuck: crossterm 0.29 reads without end from a terminal that was hung up at the wrong moment.
const LAST_OUTPUT: Duration = Duration::from_secs(10);
/// A chunk that is being computed has this long; computing one takes a tenth of a second at most.
const LAST_CHUNK: Duration = Duration::from_secs(5);
/// After a second signal, what is still to be shown has this long: enough for a terminal to be given
/// back.
const LAST_OUTPUT_IN_A_HURRY: Duration = Duration::from_secs(1);

/// The tasks of a run, and what can be asked of it from outside.
struct Running {
    permission: Arc<Permission>,
    watched: Watched,
    rig: JoinHandle<(Rig, Result<(), RigError>)>,
    /// The rig ends by itself: it has begun to close its devices.
    rig_ending: CancellationToken,
    rig_ended: CancellationToken,
    rig_stop: CancellationToken,
    hurry: CancellationToken,
    mask_ended: CancellationToken,
    kind: Screen,
    /// Until its outcome was taken.
    screen: Option<screen::ScreenTask>,
    screen_stop: CancellationToken,
    signals: Signals,
    asked: mpsc::UnboundedReceiver<Asked>,
    autopilot: Option<Autopilot>,
}

/// Waits for the end of the policy, if there is one, whose outcome is taken.
async fn policy_ended(autopilot: &mut Option<Autopilot>) -> Result<(), AppError> {
    match autopilot {
        Some(autopilot) => autopilot.ended().await,
        None => std::future::pending().await,
    }
}

/// Takes everything down, in the order of the module's comment. The first error is the run's.
async fn finish(
    mut running: Running,
    mut conductor: Conductor,
    mut outcome: Result<(), AppError>,
) -> Result<(), AppError> {
    // Lines and JSON are read by scripts, which look at the exit code.
    let judged = (conductor.record && running.kind != Screen::Monitor).then(|| Arc::clone(&conductor.board));
    // First of all nothing moves any more, whoever publishes actions. A chunk that is being computed is waited for
    // with the rest.
    running.permission.disarm(Stamp::now());
    running.watched.end();
    let policy_ended = async {
        match &mut running.autopilot {
            Some(autopilot) => timeout(LAST_CHUNK, autopilot.stop()).await.unwrap_or(Err(AppError::Stuck)),
            None => Ok(()),
        }
    };
    let (ended, ()) = tokio::join!(policy_ended, conductor.end_episode());
    keep_first(&mut outcome, ended);
    running.rig_stop.cancel();
    let rig = running.rig;
    let take_down = async {
        let rig = if let Ok((rig, ended)) = rig.await {
            keep_first(&mut outcome, ended.map_err(AppError::from));
            Some(rig)
        } else {
            keep_first(&mut outcome, Err(AppError::Panicked("the rig")));
            None
        };
        keep_first(&mut outcome, conductor.finish_episode().await);
        if let Some(rig) = &rig {
            rig.programs_ended().await;
        }
        // Dropping joins threads: the writer's, which has nothing left to write, and the mask's.
        let dropped = tokio::task::spawn_blocking(move || {
            drop(conductor);
            drop(rig);
        });
        keep_first(&mut outcome, dropped.await.map_err(|_| AppError::Panicked("the recorder")));
    };
    let mut take_down: Pin<Box<_>> = Box::pin(take_down);
    let twice = tokio::select! {
        biased;
        () = &mut take_down => false,
        () = running.signals.second() => true,
    };
    if twice {
        // What the rig waits for is skipped, the recorder's finish never.
        running.hurry.cancel();
        take_down.as_mut().await;
    }
    drop(take_down);
    running.screen_stop.cancel();
    if running.screen.is_some() {
        let limit = if twice { LAST_OUTPUT_IN_A_HURRY } else { LAST_OUTPUT };
        if let Ok(ended) = timeout(limit, screen::ended(&mut running.screen)).await {
            keep_first(&mut outcome, ended);
        }
    }
    if twice {
        keep_first(&mut outcome, Err(AppError::InterruptedTwice));
    }
    if let Some((count, file)) = judged.and_then(|board| board.bad_episodes()) {
        keep_first(&mut outcome, Err(AppError::Bad { count, file }));
    }
    outcome
}

fn keep_first(outcome: &mut Result<(), AppError>, next: Result<(), AppError>) {
    if outcome.is_ok() {
        *outcome = next;
    }
}
