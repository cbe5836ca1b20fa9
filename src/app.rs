//! The program: starts the stages, runs them, and shuts them down in order.
//!
//! Each stage is a tokio task that owns the threads that block for it (`stage` has the table).
//!
//! Shutdown: the episode ends, the policy holds and actuators are disarmed, the last samples of the episode arrive,
//! streams and observations stop, the recorder finishes its file, the session is saved, the programs of devices are
//! waited for, topics of added entries are closed, the mask is 0 and its files are removed, the screen shows what was recorded and restores the terminal.
//!
//! Invariant: only this module sees every stage.
//! Invariant: whatever ends the run, an episode in progress is finished first.
//! Invariant: an episode ends at the moment its end was requested, however slowly something closes after that.

mod attached;
mod buttons;
mod collection;
mod conductor;
mod controls;
mod discovery;
mod error;
#[cfg(feature = "foxglove")]
mod foxglove;
mod free_space;
#[cfg(feature = "policy")]
mod inference;
mod optional;
mod recording;
mod reload;
mod requests;
mod screen;
mod settling;
pub(crate) mod signals;
mod stage;
mod start;
mod streaming;
mod synchronisation;
mod trials;
mod watchdog;
#[cfg(feature = "web")]
mod web;

use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use rapid_bus::{self, Bus, TopicId};
use rapid_core::interlock::Interlocks;
use rapid_core::mask::MASK_PATH;
use rapid_core::permission::Permission;
use rapid_core::time::Stamp;
use rapid_devices::interlocks::{self, Watched};
use rapid_episode::record::EpisodeRequest;
use rapid_episode::recover::Repairs;
use rapid_registry::Registry;
use rapid_registry::scenario::Scenario;
use rapid_screens::logging::{self, Stderr};
use rapid_screens::tui::ScreenOptions;
use rapid_status::Board;
use rapid_system::panics;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::sync::mpsc;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use crate::orders::receive::{Arrival, Orders};
use crate::rig::presence::{Claim, Presence};
use crate::session::journal::Plan;
use buttons::Buttons;
use conductor::Conductor;
pub use error::AppError;
#[cfg(feature = "foxglove")]
pub use foxglove::FoxgloveOptions;
#[cfg(feature = "policy")]
pub use inference::PolicyOptions;
pub use optional::{Policy, Server};
use requests::Request;
use signals::Signals;
use stage::Stage;
use start::Machine;
use streaming::Streaming;
use watchdog::Watchdog;
#[cfg(feature = "web")]
pub use web::WebOptions;

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
    /// Lines of text.
    Lines,
    /// One JSON object per line.
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

/// What a run is started with.
#[derive(Debug)]
pub struct Options {
    /// The declared devices.
    pub registry: Registry,
    /// Where devices come from.
    pub devices: Devices,
    /// How the run is shown.
    pub screen: Screen,
    /// Options of the monitor.
    pub shown: ScreenOptions,
    /// Folder, modules and duration of each episode.
    pub episode: EpisodeRequest,
    /// What the session is to collect.
    pub plan: Plan,
    /// The policy that moves the actuator, if there is one.
    pub policy: Option<Box<dyn Policy>>,
    /// Begin an episode at the start.
    pub record: bool,
    /// Arm the actuator once, as soon as it is attached.
    pub arm: bool,
    /// How long to record, or to run when nothing is recorded.
    pub duration: Option<Duration>,
    /// Separates this rig from others on the machine.
    pub instance: Option<String>,
    /// Members of this process's group may attach screens and make requests, as this user may.
    pub group_control: bool,
    /// The servers that were requested.
    pub servers: Vec<Box<dyn Server>>,
}

/// Where the mask of an instance is published.
pub fn mask_path(instance: Option<&str>) -> PathBuf {
    match instance {
        None => Path::new(MASK_PATH).to_owned(),
        Some(name) => PathBuf::from(format!("{MASK_PATH}.{name}")),
    }
}

/// Runs the rig until a signal, the user or the duration ends it.
///
/// # Errors
/// When it cannot begin or continue; an episode in progress has been finished by then, or the error
/// gives the reason why it has not.
pub async fn run(options: Options) -> Result<(), AppError> {
    let registry = Arc::new(options.registry.clone());
    let board = Arc::new(Board::new(&registry));
    // Pending lines for standard error are waited for when this is dropped.
    let _log = logging::init(Arc::clone(&board), std::env::var("RAPID_LOG").ok().as_deref(), options.screen.stderr())?;
    if options.screen != Screen::Monitor {
        panics::to_log();
    }
    raise_open_files();
    // Before anything that can fail on a full or damaged machine.
    let Received { permission, orders: _orders, arrivals } =
        receive_orders(&options, interlocks::from_registry(&registry))?;
    let (signals, _fed) = (Signals::listen()?, Watchdog::feed());

    rapid_bus::check_memory()?;
    // A registry has at most 64 devices.
    let count = u8::try_from(registry.devices.len()).unwrap_or(u8::MAX);
    // Before the bus is touched: another run of this instance is an error.
    let claim = Claim::new(&mask_path(options.instance.as_deref()), count)?;
    Bus::clear_others(options.instance.as_deref());
    let bus = Bus::open(&registry, options.instance.as_deref())?;
    let Some(mask_writer) = bus.writer(TopicId::Mask) else { return Err(AppError::Panicked("the bus")) };
    let presence = Presence::start(claim, mask_writer, Arc::clone(&board))?;

    let out = options.episode.out.clone();
    // Without a policy, on order of another program too.
    let may_record = options.record || options.policy.is_none() || options.screen == Screen::Monitor;
    let reserve = registry.rig.disk_reserve;
    let machine = Machine { registry, board: Arc::clone(&board), permission, signals, presence, arrivals };
    let (mut running, mut conductor) = start::start(machine, &bus, options).await?;
    // In the background, and only once a screen shows what it reports: this run does not wait for episodes that an
    // earlier one left unfinished.
    let _repairs = may_record.then(|| {
        let repairs = Repairs::start(out.clone(), reserve, Arc::clone(&board), conductor.collection.examination());
        repairs.inspect_err(|error| tracing::warn!(%error, "unfinished episodes are not repaired")).ok()
    });
    // A panic here ends the run like any other error: the shutdown is carried out in order.
    let conducted = async {
        tokio::select! {
            outcome = conductor.conduct(&mut running) => outcome,
            never = free_space::watch(&out, &board) => never,
        }
    };
    let conducted = AssertUnwindSafe(conducted).catch_unwind().await;
    let outcome = conducted.unwrap_or(Err(AppError::Panicked("the main task")));
    let outcome = finish(running, conductor, outcome).await;
    drop(bus);
    outcome
}

/// Open files of the largest rig: a topic has some twenty in this process, and more with each subscriber.
const OPEN_FILES: u64 = 16_384;

/// 64 devices exceed the limit of 1024 that sessions and units have, and up to the hard limit a process may raise it. No
/// further than needed: programs of devices inherit the limit, and some close every file up to it.
fn raise_open_files() {
    let limit = getrlimit(Resource::Nofile);
    let wanted = limit.maximum.map_or(OPEN_FILES, |maximum| maximum.min(OPEN_FILES));
    let current = limit.current.map(|current| current.max(wanted));
    let _ = setrlimit(Resource::Nofile, Rlimit { current, ..limit });
}

/// What other programs and signals have to say.
struct Received {
    permission: Arc<Permission>,
    /// Ends when this is dropped.
    orders: Orders,
    /// Requests to the session, and screens.
    arrivals: mpsc::Receiver<Arrival>,
}

/// Receives orders of other programs to arm and disarm motors, and their requests to the session; and disarms motors at
/// a signal, regardless of what else the run waits for.
fn receive_orders(options: &Options, interlocks: Interlocks) -> Result<Received, AppError> {
    let permission = Arc::new(Permission::new(options.arm).with_interlocks(interlocks));
    let (run, arrivals) = mpsc::channel(16);
    let group = options.group_control.then(|| rustix::process::getegid().as_raw());
    let orders = Orders::receive(options.instance.as_deref(), group, Arc::clone(&permission), run);
    let orders = orders.map_err(AppError::Orders)?;
    tokio::spawn({
        let (mut signals, permission) = (Signals::listen()?, Arc::clone(&permission));
        async move {
            loop {
                signals.next().await;
                permission.disarm(Stamp::now());
            }
        }
    });
    Ok(Received { permission, orders, arrivals })
}

/// The screen has limits for a reader that does not read. This one is for a screen that is stuck: crossterm 0.29 reads
/// endlessly from a terminal that was hung up at the wrong moment.
const LAST_OUTPUT: Duration = Duration::from_secs(10);
/// Limit for a chunk that is being computed. A chunk may take as long as its actions cover, which is seconds of a large policy
/// or a busy machine; the 30 s in which the service must stop leave a third for the files.
const LAST_CHUNK: Duration = Duration::from_secs(20);
/// Limit for the remaining output after a second signal: enough for the terminal to be restored.
const LAST_OUTPUT_IN_A_HURRY: Duration = Duration::from_secs(1);

/// The stages of a run, and where requests to it come from.
struct Running {
    permission: Arc<Permission>,
    watched: Watched,
    buttons: Buttons,
    discovery: Stage,
    streaming: Streaming,
    synchronisation: Stage,
    recording: Stage,
    inference: Option<Stage>,
    servers: Vec<Stage>,
    trials: Option<Stage>,
    reload: Stage,
    mask_ended: CancellationToken,
    kind: Screen,
    screen: Stage,
    signals: Signals,
    requests: mpsc::UnboundedReceiver<Request>,
}

/// Shuts everything down, in the order of the module's comment. The first error is the run's.
async fn finish(
    mut running: Running,
    mut conductor: Conductor,
    mut outcome: Result<(), AppError>,
) -> Result<(), AppError> {
    // Scripts read lines and JSON, and check the exit code.
    let is_judged = conductor.record && running.kind != Screen::Monitor;
    let mut bad = None;
    // First, all motion ends, whichever program publishes actions. A chunk that is being computed is waited for with
    // the rest.
    running.permission.disarm(Stamp::now());
    running.watched.end();
    running.buttons.end();
    let policy_ended = async {
        match &mut running.inference {
            Some(inference) => timeout(LAST_CHUNK, inference.end()).await.unwrap_or(Err(AppError::Stuck)),
            None => Ok(()),
        }
    };
    let (ended, ()) = tokio::join!(policy_ended, conductor.collection.end_episode());
    keep_first(&mut outcome, ended);
    let hurry = running.streaming.hurry.clone();
    let take_down = async {
        running.streaming.close().await;
        keep_first(&mut outcome, running.synchronisation.end().await);
        let finished = conductor.finish_episode().await;
        keep_first(&mut outcome, running.streaming.end().await);
        keep_first(&mut outcome, finished);
        keep_first(&mut outcome, conductor.collection.close().await);
        bad = conductor.collection.bad();
        // The recorder's thread ends when its handle is dropped: it has nothing left to write.
        drop(conductor);
        keep_first(&mut outcome, running.recording.end().await);
        keep_first(&mut outcome, running.discovery.end().await);
        for server in running.servers.iter_mut().chain(&mut running.trials) {
            // The last events are shown by then. It is no reason for the run to fail.
            let _ = server.end().await;
        }
        keep_first(&mut outcome, running.reload.end().await);
    };
    let mut take_down: Pin<Box<_>> = Box::pin(take_down);
    let twice = tokio::select! {
        biased;
        () = &mut take_down => false,
        () = running.signals.second() => true,
    };
    if twice {
        // Waits of the rig are skipped, but the end of the recorder never.
        hurry.cancel();
        take_down.as_mut().await;
    }
    drop(take_down);
    let limit = if twice { LAST_OUTPUT_IN_A_HURRY } else { LAST_OUTPUT };
    if let Ok(ended) = timeout(limit, running.screen.end()).await {
        keep_first(&mut outcome, ended);
    }
    if twice {
        keep_first(&mut outcome, Err(AppError::InterruptedTwice));
    }
    if let Some((count, file)) = bad.filter(|_| is_judged) {
        keep_first(&mut outcome, Err(AppError::Bad { count, file }));
    }
    outcome
}

fn keep_first(outcome: &mut Result<(), AppError>, next: Result<(), AppError>) {
    if outcome.is_ok() {
        *outcome = next;
    }
}
