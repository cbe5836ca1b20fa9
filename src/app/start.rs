//! The start of a run: one stage after another. Each makes its own channels and returns a handle to them.
//!
//! Invariant: whatever fails, what was begun releases the bus before this returns.

use std::sync::Arc;

use rapid_bus::Bus;
use rapid_core::permission::Permission;
use rapid_devices::interlocks::Watched;
use rapid_episode::record::EpisodeRequest;
use rapid_registry::Registry;
use rapid_registry::simulation::SimSource;
use rapid_status::Board;
use rapid_status::stops::Reported;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::buttons::Buttons;
use super::collection::Collection;
use super::conductor::Conductor;
use super::discovery::{self, Discovery};
use super::optional::{Host, Listening, Surroundings};
use super::recording::Recording;
use super::reload::Reload;
use super::requests::{self, Receivers, Request};
use super::screen::{self, Shown};
use super::signals::Signals;
use super::stage::Stage;
use super::streaming::Streaming;
use super::synchronisation::Synchronisation;
use super::{AppError, Devices, Options, Running, Screen, trials};
use crate::orders::receive::Arrival;
use crate::rig::Rig;
use crate::rig::presence::Presence;

/// What there is before the stages.
pub(super) struct Machine {
    pub(super) registry: Arc<Registry>,
    pub(super) board: Arc<Board>,
    pub(super) permission: Arc<Permission>,
    pub(super) signals: Signals,
    pub(super) presence: Presence,
    /// Requests of other programs, and their screens.
    pub(super) arrivals: mpsc::Receiver<Arrival>,
}

/// What is begun first.
struct Front {
    to_conductor: mpsc::UnboundedSender<Request>,
    requests: mpsc::UnboundedReceiver<Request>,
    servers: Vec<Listening>,
    reported: Reported,
    recording: Recording,
}

/// Starts the stages and the screen. The bus must outlive them.
pub(super) async fn start(machine: Machine, bus: &Bus, mut options: Options) -> Result<(Running, Conductor), AppError> {
    let Machine { registry, board, permission, .. } = &machine;
    let (to_conductor, requests) = mpsc::unbounded_channel();
    let host = Host { registry, board, permission, conductor: &to_conductor };
    let mut servers = Vec::new();
    for server in std::mem::take(&mut options.servers) {
        servers.push(server.listen(&host).await?);
    }
    let reported = Reported::nothing(registry);
    let shown = servers.iter().find_map(|server| server.shown.clone());
    let recording = Recording::start(registry, bus, board, reported.states(), shown)?;
    let released = recording.ended.clone();
    let started = stages(machine, bus, options, Front { to_conductor, requests, servers, reported, recording });
    if started.is_err() {
        // The recorder's thread releases the bus before the bus is dropped: no files of it remain.
        released.cancelled().await;
    }
    started
}

fn stages(machine: Machine, bus: &Bus, options: Options, front: Front) -> Result<(Running, Conductor), AppError> {
    let Machine { registry, board, permission, signals, presence, arrivals } = machine;
    let Front { to_conductor, requests, servers, reported, recording } = front;
    let Recording { stage: recording, recorder, episode, clock, additions, references, .. } = recording;
    let is_single = options.is_single();
    let (wanted, is_kept) = (options.wanted(), options.is_kept());
    let modules = watch::Sender::new(registry.modules.clone());
    let collection = Collection::new(recorder, wanted, options.plan, is_kept, &board, modules.subscribe())?;
    let (trials, loaded) = (simulated(&options.devices, &board), until_loaded(options.policy.is_some()));

    // Before the screen: errors up to here appear on an ordinary terminal.
    let synchronisation = Synchronisation::new(&registry, bus, &board)?;
    let discovery = discovery::start(options.devices, &registry, loaded.clone())?;
    let Discovery { stage: discovery, plugged, replugs, additions: to_discovery } = discovery;
    // The inputs report their first state at once.
    let events = board.events();
    // Until the very end: a device that is being closed may still move.
    let watched = Watched::begin(&registry, &permission, &reported, &board).map_err(AppError::Interlocks)?;
    let screen = screen::start(options.screen, &board, events, &permission, options.duration, options.shown);
    let Shown { stage: screen, commands, attached } = screen;
    let surroundings = Surroundings {
        registry: &registry,
        bus,
        board: &board,
        loaded: &loaded,
        references,
        mask: presence.published(),
        episode: options.record.then(|| episode.clone()),
    };
    let inference = options.policy.map(|policy| policy.start(surroundings)).transpose()?;
    let to_servers = servers.iter().filter_map(|server| server.additions.clone()).collect();
    let servers = servers.into_iter().map(|server| (server.start)(bus, &board, clock.clone()));
    let servers = servers.collect::<Result<_, _>>()?;

    // Nothing fails from here on.
    let buttons = Buttons::begin(&registry, &permission, &board, &to_conductor);
    let taps = [watched.taps(), buttons.taps()].concat();
    let mask_ended = presence.ended();
    let rig = Rig::new(&registry, bus, presence, Arc::clone(&board)).following(episode.clone());
    let streaming = Streaming::start(rig.obeying(&permission).tapped(&taps), plugged);
    let reload = Reload {
        registry,
        bus: bus.membership(),
        board: Arc::clone(&board),
        rig: streaming.commands.clone(),
        discovery: to_discovery,
        recorder: additions,
        episode,
        alignment: synchronisation.additions.clone(),
        servers: to_servers,
        modules,
        topics: Vec::new(),
    };
    let reload = reload.start();
    let receivers = Receivers {
        conductor: to_conductor,
        rig: streaming.commands.clone(),
        registry: reload.requests,
        scenario: replugs,
    };
    requests::spawn_router(receivers, commands, arrivals, attached);
    let conductor = Conductor {
        board,
        collection,
        record: options.record,
        is_single,
        duration: options.duration,
        begin_episode: options.record,
        loaded,
    };
    let running = Running {
        permission,
        watched,
        buttons,
        discovery,
        streaming,
        synchronisation: synchronisation.start(),
        recording,
        inference,
        servers,
        trials,
        reload: reload.stage,
        mask_ended,
        kind: options.screen,
        screen,
        signals,
        requests,
    };
    Ok((running, conductor))
}

impl Options {
    /// Whether the run is for one episode, and not for a session of several.
    const fn is_single(&self) -> bool {
        self.plan.goal.is_none() && self.plan.episode_time.is_none() && self.plan.reset_time.is_none()
    }

    /// Each episode. Ending by itself after some time is the run's, unless it has several episodes.
    fn wanted(&self) -> EpisodeRequest {
        let duration = self.plan.episode_time.or(self.duration.filter(|_| self.is_single()));
        EpisodeRequest { duration, ..self.episode.clone() }
    }

    /// Whether the session gets a file even if nothing is requested of it.
    fn is_kept(&self) -> bool {
        !(self.is_single() && self.record && self.screen != Screen::Monitor)
    }
}

/// Cancelled when the policy is loaded; at once if there is none.
fn until_loaded(has_policy: bool) -> CancellationToken {
    let loaded = CancellationToken::new();
    if !has_policy {
        loaded.cancel();
    }
    loaded
}

/// What a run of simulated devices has besides: the board has it, and the trials of the task are reported.
fn simulated(devices: &Devices, board: &Arc<Board>) -> Option<Stage> {
    let Devices::Simulated(scenario) = devices else { return None };
    board.set_simulated();
    let trial = scenario.devices.iter().find_map(|device| match &device.source {
        SimSource::Task { trial, .. } => Some(trial.clone()),
        _ => None,
    });
    Some(trials::start(trial?, Arc::clone(board)))
}
