//! Runs the hooks of one attached device, in the order of the device's events.
//!
//! 1. `on_attach` when it is attached.
//! 2. `on_record_start` when an episode begins, at once if one is in progress; `on_record_stop` when
//!    that episode is finished, the device is removed, or the run ends.
//! 3. `on_detach` when it was removed and the program that reads it has ended. Not at the end of the run: the device
//!    stays plugged in.
//!
//! Invariant: only the next runner of the same entry and, at the very end, the run wait for a runner.
//! Invariant: the hooks of an entry run one at a time, each for [`HOOK_LIMIT`] at most.
//! Invariant: each `on_record_start` is followed by one `on_record_stop`, unless the run ends in a hurry.

use std::sync::Arc;

use rapid_devices::driver::process::Launch;
use rapid_registry::device::Attachment;
use rapid_registry::{DeviceSpec, Hook};
use rapid_status::{Episode, EpisodeWatch, Level};
use tokio::sync::Mutex;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;

use super::output::Output;
use super::programs::{BusNames, Environment, HOOK_LIMIT, MARGIN, Programs, TERM_LIMIT, environment};
use super::worker::describe;

/// Serialises the runners of an entry.
#[derive(Debug)]
pub(super) struct HookQueue {
    programs: Programs,
    spec: Arc<DeviceSpec>,
    bus: BusNames,
    /// Locked while a program reads the device.
    node: Option<Arc<Mutex<()>>>,
    turn: Arc<Mutex<()>>,
    /// Notified when the device is removed.
    gone: CancellationToken,
}

impl HookQueue {
    pub(super) fn new(
        programs: &Programs,
        spec: &Arc<DeviceSpec>,
        bus: BusNames,
        node: Option<Arc<Mutex<()>>>,
    ) -> Self {
        let (programs, spec) = (programs.clone(), Arc::clone(spec));
        Self { programs, spec, bus, node, turn: Arc::default(), gone: CancellationToken::new() }
    }

    /// A device of the entry was attached.
    pub(super) fn attached(&mut self, attachment: &Attachment, episode: &EpisodeWatch) {
        if self.spec.hooks.is_empty() || attachment.node.is_recording() {
            return;
        }
        self.removed();
        self.gone = CancellationToken::new();
        let runner = HookRunner {
            environment: environment(&self.spec, attachment, &self.spec.topic, &self.bus),
            programs: self.programs.clone(),
            spec: Arc::clone(&self.spec),
            node: self.node.clone(),
            gone: self.gone.clone(),
            episode: episode.clone(),
        };
        self.programs.tasks.spawn(runner.run_all(Arc::clone(&self.turn)));
    }

    pub(super) fn removed(&self) {
        self.gone.cancel();
    }
}

#[derive(Debug)]
struct HookRunner {
    programs: Programs,
    spec: Arc<DeviceSpec>,
    environment: Environment,
    node: Option<Arc<Mutex<()>>>,
    gone: CancellationToken,
    episode: EpisodeWatch,
}

impl HookRunner {
    async fn run_all(mut self, turn: Arc<Mutex<()>>) {
        let turn = turn.lock_owned().await;
        // Plugged and unplugged before its hooks could start: neither hook is run.
        if self.gone.is_cancelled() || self.programs.closing.is_cancelled() {
            return;
        }
        let spec = Arc::clone(&self.spec);
        self.run("on_attach", spec.hooks.attach.as_ref(), None).await;
        while let Some(episode) = self.begun().await {
            self.run("on_record_start", spec.hooks.record_start.as_ref(), Some(&episode)).await;
            self.over(&episode).await;
            if spec.hooks.record_stop.is_some() {
                let ended = self.ended(&episode).await;
                self.run("on_record_stop", spec.hooks.record_stop.as_ref(), Some(&ended)).await;
            }
        }
        if self.gone.is_cancelled() {
            if let Some(node) = &self.node {
                // A successor need not wait for this runner.
                drop(timeout(TERM_LIMIT + MARGIN, node.lock()).await);
            }
            self.run("on_detach", spec.hooks.detach.as_ref(), None).await;
        }
        drop(turn);
    }

    /// Waits for an episode; `None` when this device will get none.
    async fn begun(&mut self) -> Option<Arc<Episode>> {
        let begun = async {
            let begun = self.episode.wait_for(Option::is_some).await.ok().and_then(|episode| episode.clone());
            match begun {
                Some(episode) => Some(episode),
                // No recorder exists any more.
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            () = self.gone.cancelled() => None,
            () = self.programs.closing.cancelled() => None,
            episode = begun => episode,
        }
    }

    /// Waits until this episode is over for this device.
    async fn over(&mut self, episode: &Arc<Episode>) {
        let other = |now: &Option<Arc<Episode>>| now.as_ref().is_none_or(|now| !Arc::ptr_eq(now, episode));
        tokio::select! {
            biased;
            () = self.gone.cancelled() => {}
            _ = self.episode.wait_for(other) => {}
            () = self.programs.closing.cancelled() => {}
        }
    }

    /// The finished episode; for a device that was removed earlier, the episode in progress.
    async fn ended(&self, episode: &Episode) -> Episode {
        let file = tokio::select! {
            biased;
            file = episode.ended() => file,
            () = self.gone.cancelled() => &episode.file,
            // The disk is slow, or the recorder has failed.
            () = sleep(HOOK_LIMIT) => &episode.file,
        };
        Episode::new(file)
    }

    /// Runs a hook to its end. Failures are reported and have no other effect.
    async fn run(&self, key: &str, hook: Option<&Hook>, episode: Option<&Episode>) {
        let Some(hook) = hook else { return };
        if let Err(reason) = self.run_hook(key, hook, episode).await {
            Output::new(&self.spec.name, Some(key), &self.programs).note(Level::Error, &reason);
        }
    }

    async fn run_hook(&self, key: &str, hook: &Hook, episode: Option<&Episode>) -> Result<(), String> {
        let Programs { spawner, hurry, .. } = &self.programs;
        if hurry.is_cancelled() {
            return Err("not run, as the run was interrupted twice".to_owned());
        }
        let mut env = self.environment.clone();
        if let Some(episode) = episode {
            env.push(("RAPID_EPISODE", Some(episode.file.clone().into())));
            env.push(("SESSION_ID", Some(episode.id().into())));
            env.push(("OUTPUT_DIR", Some(episode.folder().into())));
        }
        let launch = Launch { program: hook.program.clone(), args: hook.args.clone(), env };
        let mut child = spawner.spawn(launch).await.map_err(|error| error.to_string())?;
        tracing::debug!(device = %self.spec.name, hook = key, process = child.id(), "started");
        let mut output = Output::new(&self.spec.name, Some(key), &self.programs);
        let ended = tokio::select! {
            biased;
            () = child.ended() => Ok(()),
            () = hurry.cancelled() => Err("killed, as the run was interrupted twice".to_owned()),
            () = sleep(HOOK_LIMIT) => Err(format!("did not end within {} s and was killed", HOOK_LIMIT.as_secs())),
            () = output.follow(&child.stdout, &child.stderr) => Ok(()),
        };
        if ended.is_err() {
            child.kill();
            child.ended().await;
        }
        output.finish(&child.stdout, &child.stderr);
        let status = child.reap().map_err(|error| format!("its process cannot be reaped: {error}"))?;
        ended?;
        if status.success() { Ok(()) } else { Err(describe(status)) }
    }
}
