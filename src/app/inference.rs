//! Stage inference: the policy of a run, loaded in parallel with everything else, started when what it requires is
//! present, ended first.
//!
//! Invariant: it never starts without what it requires.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::Duration;

use rapid_bus::{Inbox, TopicId, Writer};
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_episode::ReferenceSample;
use rapid_policy::live::{Live, LiveOptions};
use rapid_policy::model::Model;
use rapid_policy::onnxruntime::Environment;
use rapid_policy::pace::{PaceReport, PaceVerdict};
use rapid_policy::sampler::Computing;
use rapid_registry::Registry;
use rapid_status::{Board, EpisodeWatch, EventKind, Level};
use tokio::time::{Instant, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use super::AppError;
use super::optional::{Policy, Surroundings};
use super::settling;
use super::stage::Stage;
use crate::rig::presence::Published;

/// Interval at which the mask is checked for that.
const LOOK: Duration = Duration::from_millis(5);

/// The policy of a run.
#[derive(Debug)]
pub struct PolicyOptions {
    /// The policy, checked against the registry, and how it acts.
    pub live: LiveOptions,
    /// Wait for required devices instead of failing.
    pub wait: bool,
    /// How it is computed.
    pub computing: Computing,
    /// Library of onnxruntime instead of the built-in one.
    pub library: Option<PathBuf>,
}

impl Policy for PolicyOptions {
    /// It loads the policy and starts it when everything it requires is present; when it is to be recorded, after the
    /// episode has begun, so that the file holds everything it observed.
    fn start(self: Box<Self>, surroundings: Surroundings<'_>) -> Result<Stage, AppError> {
        let Surroundings { registry, bus, board, loaded, references, mask, episode } = surroundings;
        let flight = Flight {
            required: required(&self, registry),
            inbox: bus.inbox()?,
            actions: bus.writer(TopicId::Action),
            registry: Arc::clone(registry),
            board: Arc::clone(board),
            loaded: loaded.clone(),
            references,
            mask,
            episode,
            options: *self,
        };
        Ok(Stage::start("the policy", |stop| flight.run(stop)))
    }
}

/// What must be present: the modalities the bundle requires, and the actuator.
fn required(options: &PolicyOptions, registry: &Registry) -> Vec<(ModalityId, String)> {
    let observed = options.live.bundle.observations.iter().filter(|observation| observation.required);
    let moved = (!options.live.dry_run).then_some(&options.live.bundle.action.actuator);
    let mut names: Vec<&String> = observed.map(|observation| &observation.modality).chain(moved).collect();
    names.sort_unstable();
    names.dedup();
    names.into_iter().filter_map(|name| Some((registry.named(name)?.id, name.clone()))).collect()
}

/// A policy from its load to its end.
struct Flight {
    options: PolicyOptions,
    required: Vec<(ModalityId, String)>,
    inbox: Inbox,
    actions: Option<Arc<Writer>>,
    registry: Arc<Registry>,
    board: Arc<Board>,
    loaded: CancellationToken,
    references: Sender<ReferenceSample>,
    mask: Published,
    episode: Option<EpisodeWatch>,
}

impl Flight {
    async fn run(mut self, stop: CancellationToken) -> Result<(), AppError> {
        let loaded = tokio::task::spawn_blocking({
            let (bundle, named, computing) =
                (Arc::clone(&self.options.live.bundle), self.options.library.clone(), self.options.computing);
            move || -> Result<(Model, String, Duration), AppError> {
                let environment = Environment::open(named.as_deref()).map_err(AppError::optional)?;
                let mut model = Model::load(&bundle, &environment, computing).map_err(AppError::optional)?;
                let chunk = model.rehearse().map_err(AppError::optional)?;
                Ok((model, environment.origin.to_string(), chunk))
            }
        });
        let (model, library, chunk) = tokio::select! {
            biased;
            () = stop.cancelled() => return Ok(()),
            loaded = loaded => loaded.map_err(|_| AppError::Panicked("the policy"))??,
        };
        self.judge(chunk)?;
        self.loaded.cancel();
        if !self.settled(&stop).await? {
            return Ok(());
        }
        let Self { options: PolicyOptions { live, .. }, inbox, actions, registry, board, references, .. } = self;
        board.announce(live.bundle.begins(library, live.dry_run));
        for (modality, time) in live.bundle.held() {
            let text = format!("policy: while {modality} is absent, its last samples stand in for it, for {time:?}");
            board.announce(EventKind::Log { level: Level::Info, text });
        }
        let live = Live::start(live, model, &registry, inbox, actions, Arc::clone(&board), references)?;
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
            // It ends without a request only when one of its threads has ended.
            Ok(Ok(())) | Err(_) => Err(AppError::Panicked("the policy")),
        }
    }

    /// Whether the time of a chunk suits the rate of its actions.
    fn judge(&self, chunk: Duration) -> Result<(), AppError> {
        let PaceReport { verdict, text } = PaceReport::new(&self.options.live.bundle, chunk);
        match verdict {
            PaceVerdict::Whole => tracing::debug!("{text}"),
            PaceVerdict::Pauses => self.board.announce(EventKind::Log { level: Level::Warn, text }),
            PaceVerdict::TooSlow => return Err(AppError::TooSlow(text)),
        }
        Ok(())
    }

    /// Waits until everything required is present, and the episode has begun if the policy is to be recorded; `false`
    /// if the run is to end before. Unless it is to wait for devices, a missing one is an error after
    /// [`settling::LIMIT`].
    // `&mut`, because the bus reader cannot be shared between threads.
    async fn settled(&mut self, stop: &CancellationToken) -> Result<bool, AppError> {
        let begun = Instant::now();
        let mut look = interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut is_reported = false;
        loop {
            tokio::select! {
                biased;
                () = stop.cancelled() => return Ok(false),
                _ = look.tick() => {}
            }
            let missing = missing(&self.required, self.mask.mask());
            if missing.is_empty() {
                // It does not begin without a sensor that is plugged in and only not open yet.
                if !settling::has_settled(&self.board, begun.elapsed()) {
                    continue;
                }
                if self.episode.as_ref().is_none_or(|episode| episode.borrow().is_some()) {
                    return Ok(true);
                }
                continue;
            }
            if begun.elapsed() < settling::LIMIT {
                continue;
            }
            if !self.options.wait {
                return Err(AppError::Required(missing.join(", ")));
            }
            if !std::mem::replace(&mut is_reported, true) {
                let text = format!("the policy waits for {}", missing.join(", "));
                self.board.announce(EventKind::Log { level: Level::Warn, text });
            }
        }
    }
}

fn missing(required: &[(ModalityId, String)], mask: PhysicalMask) -> Vec<&str> {
    required.iter().filter(|(id, _)| !mask.contains(*id)).map(|(_, name)| name.as_str()).collect()
}
