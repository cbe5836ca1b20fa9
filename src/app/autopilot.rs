//! The policy of a run: loaded beside everything else, started when what it requires is there, ended first.
//!
//! Invariant: it never starts without what it requires.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinHandle;
use tokio::time::{Instant, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use super::AppError;
use crate::bus::{Bus, Inbox, TopicId, Writer};
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::policy::bundle::Bundle;
use crate::policy::horizon::WithoutMask;
use crate::policy::library::{Environment, LibraryError};
use crate::policy::live::{Live, LiveOptions};
use crate::policy::model::Model;
use crate::policy::sampler::PolicyError;
use crate::registry::Registry;
use crate::status::{Board, Level, What};

/// What is attached at the start has this long to run.
const SETTLE: Duration = Duration::from_secs(3);
/// How often it is looked whether it does.
const LOOK: Duration = Duration::from_millis(5);

/// The policy of a run.
#[derive(Debug)]
pub struct PolicyOptions {
    /// The policy, which fits the registry.
    pub bundle: Bundle,
    /// What it does without a modality it was not trained to do without.
    pub without_mask: WithoutMask,
    /// Of its noise.
    pub seed: u64,
    /// Nothing moves.
    pub dry_run: bool,
    /// Wait for what is required instead of giving up.
    pub wait: bool,
    /// Steps of denoising instead of the bundle's own.
    pub denoising_steps: Option<usize>,
    /// Library of onnxruntime instead of the one inside.
    pub library: Option<PathBuf>,
}

/// Why a policy cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// onnxruntime.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// The graphs.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

/// The task that loads, starts and ends it.
#[derive(Debug)]
pub(super) struct Autopilot {
    task: Option<JoinHandle<Result<(), AppError>>>,
    stop: CancellationToken,
}

impl Autopilot {
    /// Loads the policy and starts it when everything it requires is there; when it is to be recorded, after
    /// the episode has begun, so that all it saw is in it.
    pub(super) fn launch(
        options: PolicyOptions,
        registry: &Arc<Registry>,
        bus: &Bus,
        board: &Arc<Board>,
        recorded: bool,
    ) -> Result<Self, AppError> {
        let stop = CancellationToken::new();
        let flight = Flight {
            required: required(&options, registry),
            inbox: bus.inbox()?,
            actions: bus.writer(TopicId::Action),
            registry: Arc::clone(registry),
            board: Arc::clone(board),
            stop: stop.clone(),
            recorded,
            options,
        };
        Ok(Self { task: Some(tokio::spawn(flight.run())), stop })
    }

    /// Waits for the end of the policy, whose outcome is taken; for ever if it was taken before.
    pub(super) async fn ended(&mut self) -> Result<(), AppError> {
        let Some(task) = &mut self.task else { return std::future::pending().await };
        let ended = task.await;
        self.task = None;
        ended.unwrap_or(Err(AppError::Panicked("the policy")))
    }

    /// Ends it and waits.
    pub(super) async fn stop(&mut self) -> Result<(), AppError> {
        self.stop.cancel();
        if self.task.is_some() { self.ended().await } else { Ok(()) }
    }
}

/// What must be there: the modalities the bundle requires, and what is moved.
fn required(options: &PolicyOptions, registry: &Registry) -> Vec<(ModalityId, String)> {
    let observed = options.bundle.observations.iter().filter(|observation| observation.required);
    let moved = (!options.dry_run).then_some(&options.bundle.action.actuator);
    let mut names: Vec<&String> = observed.map(|observation| &observation.modality).chain(moved).collect();
    names.sort_unstable();
    names.dedup();
    names.into_iter().filter_map(|name| Some((registry.named(name)?.id, name.clone()))).collect()
}

struct Flight {
    options: PolicyOptions,
    required: Vec<(ModalityId, String)>,
    inbox: Inbox,
    actions: Option<Arc<Writer>>,
    registry: Arc<Registry>,
    board: Arc<Board>,
    stop: CancellationToken,
    recorded: bool,
}

impl Flight {
    async fn run(self) -> Result<(), AppError> {
        let Self { options, required, inbox, actions, registry, board, stop, recorded } = self;
        let bundle = Arc::new(options.bundle);
        let loaded = tokio::task::spawn_blocking({
            let bundle = Arc::clone(&bundle);
            move || -> Result<(Model, String), LoadError> {
                let environment = Environment::open(options.library.as_deref())?;
                let model = Model::load(&bundle, &environment, options.denoising_steps)?;
                Ok((model, environment.origin().to_string()))
            }
        });
        let (model, library) = tokio::select! {
            biased;
            () = stop.cancelled() => return Ok(()),
            loaded = loaded => loaded.map_err(|_| AppError::Panicked("the policy"))??,
        };
        if !settled(&required, &board, &stop, (options.wait, recorded)).await? {
            return Ok(());
        }
        board.announce(What::Policy {
            policy: bundle.name.clone(),
            folder: bundle.folder.clone(),
            hash: bundle.hash.clone(),
            library,
            hz: bundle.control_hz,
            dry_run: options.dry_run,
        });
        let live =
            LiveOptions { bundle, without_mask: options.without_mask, seed: options.seed, dry_run: options.dry_run };
        let live = Live::start(live, model, &registry, inbox, actions, Arc::clone(&board))?;
        let ended = live.ended();
        tokio::select! {
            () = stop.cancelled() => {}
            () = ended.cancelled() => {}
        }
        let ended = tokio::task::spawn_blocking(move || live.stop()).await;
        board.set_policy(None);
        match ended {
            Ok(Ok(())) if stop.is_cancelled() => Ok(()),
            Ok(Err(thread)) => Err(AppError::Panicked(thread)),
            // It ends by itself only when one of its threads is gone.
            Ok(Ok(())) | Err(_) => Err(AppError::Panicked("the policy")),
        }
    }
}

/// Waits until everything required is there; `false` if the run is to end before.
async fn settled(
    required: &[(ModalityId, String)],
    board: &Board,
    stop: &CancellationToken,
    (wait, recorded): (bool, bool),
) -> Result<bool, AppError> {
    let begun = Instant::now();
    let mut look = interval(LOOK);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut told = false;
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return Ok(false),
            _ = look.tick() => {}
        }
        let mask = board.mask();
        let missing = missing(required, mask);
        if missing.is_empty() {
            if !recorded || board.is_recording() {
                return Ok(true);
            }
            continue;
        }
        if begun.elapsed() < SETTLE {
            continue;
        }
        if !wait {
            return Err(AppError::Required(missing.join(", ")));
        }
        if !std::mem::replace(&mut told, true) {
            let text = format!("the policy waits for {}", missing.join(", "));
            board.announce(What::Log { level: Level::Warn, text });
        }
    }
}

fn missing(required: &[(ModalityId, String)], mask: PhysicalMask) -> Vec<&str> {
    required.iter().filter(|(id, _)| !mask.contains(*id)).map(|(_, name)| name.as_str()).collect()
}
