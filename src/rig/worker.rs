//! A worker: a program that reads a device, and the samples it publishes.
//!
//! A stream opens a worker as it would a driver. A separate task (`supervisor`) starts, monitors and ends the program; its
//! output goes to the log (`output`); its samples are validated (`intake`) and lent to the stream, which publishes them
//! under the rig's own header.
//!
//! Invariant: only a successor on the same entry waits for a program to end.
//! Invariant: no field of a program's header is passed on unchecked.
//! Invariant: once the stream is asked to stop, no sample of its program counts, however long the program lives.

mod intake;
mod supervisor;

use std::sync::Arc;

use rapid_bus::{Arrivals, Bus, Given, Ingress, Membership};
use rapid_core::sample::Epoch;
use rapid_core::time::Stamp;
use rapid_devices::driver::process::Launch;
use rapid_devices::driver::{DriverError, Reading};
use rapid_registry::device::Attachment;
use rapid_registry::{DeviceSpec, ProcessSpec};
use rapid_status::{Board, EventKind, Level};
use tokio::sync::{Mutex, oneshot};
use tokio::time::timeout;
use tokio_util::sync::{CancellationToken, DropGuard};

use super::programs::{BusNames, Environment, MARGIN, Programs, TERM_LIMIT, environment};
use intake::{Intake, Judged};
use supervisor::Supervisor;
pub(super) use supervisor::describe;

/// A program that is silent for this many heartbeats is started again.
pub(super) const MOST_SILENT_BEATS: u32 = 5;

/// The per-entry state that its successive programs share.
#[derive(Debug, Clone)]
pub(super) struct ProcessSlot {
    programs: Programs,
    membership: Membership,
    ingress: Arc<Ingress>,
    /// Locked while a program of this entry lives.
    turn: Arc<Mutex<()>>,
}

impl ProcessSlot {
    /// The seat of one entry's program; `None` if the entry has none.
    pub(super) fn new(programs: &Programs, spec: &DeviceSpec, bus: &Bus) -> Option<Self> {
        let ingress = bus.ingress(spec.id)?;
        Some(Self { programs: programs.clone(), membership: bus.membership(), ingress, turn: Arc::default() })
    }

    /// Locked while a program of the entry lives.
    pub(super) fn turn(&self) -> Arc<Mutex<()>> {
        Arc::clone(&self.turn)
    }
}

/// A running program, as its stream sees it. Dropping it asks the program to end.
#[derive(Debug)]
pub(super) struct Worker {
    name: String,
    board: Arc<Board>,
    ingress: Arc<Ingress>,
    watch: Arrivals,
    intake: Intake,
    /// The sample that is lent to the stream.
    given: Option<(Given, Judged)>,
    /// Receives how the program ended.
    ended: oneshot::Receiver<String>,
    /// How it ended; samples published before are still to be read.
    reason: Option<String>,
    description: String,
    _stop: DropGuard,
}

impl Worker {
    /// Starts the program of an entry, once its predecessor has ended.
    pub(super) async fn open(
        seat: &ProcessSlot,
        spec: &DeviceSpec,
        process: &ProcessSpec,
        attachment: &Attachment,
        epoch: Epoch,
    ) -> Result<Self, DriverError> {
        let watch = seat.ingress.watch().map_err(|error| DriverError::Retry(error.to_string()))?;
        if seat.turn.try_lock().is_err() {
            let text = format!("{}: waits for its previous process to end", spec.name);
            seat.programs.board.announce(EventKind::Log { level: Level::Info, text });
        }
        let wait = timeout(TERM_LIMIT + MARGIN, Arc::clone(&seat.turn).lock_owned());
        let turn = wait.await.map_err(|_| DriverError::Retry("its previous process has not ended".to_owned()))?;
        // Samples left by the predecessor.
        seat.ingress.clear();

        let stop = CancellationToken::new();
        let (started, has_started) = oneshot::channel();
        let (ending, ended) = oneshot::channel();
        let programs = &seat.programs;
        let supervisor = Supervisor {
            name: spec.name.clone(),
            programs: programs.clone(),
            membership: seat.membership.clone(),
            stop: stop.clone(),
            turn,
            started,
            ended: ending,
        };
        let mut env: Environment =
            environment(spec, attachment, seat.ingress.topic(), &BusNames::from_membership(&seat.membership));
        env.push(("RAPID_EPOCH", Some(epoch.0.to_string().into())));
        let launch = Launch { program: process.program.clone(), args: process.args.clone(), env };
        programs.tasks.spawn(supervisor.keep(launch));
        let stop = stop.drop_guard();
        let pid = has_started.await.unwrap_or_else(|_| Err(DriverError::Retry("its keeper ended".to_owned())))?;
        let program = process.program.file_name().unwrap_or_default().to_string_lossy();
        Ok(Self {
            name: spec.name.clone(),
            board: Arc::clone(&programs.board),
            ingress: Arc::clone(&seat.ingress),
            watch,
            intake: Intake::new(spec.id, epoch, process),
            given: None,
            ended,
            reason: None,
            description: format!("{program}, process {pid}, on {}", attachment.node.label()),
            _stop: stop,
        })
    }

    pub(super) fn description(&self) -> String {
        self.description.clone()
    }

    /// The next valid sample. Cancel-safe.
    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        self.given = None;
        let next = self.next().await?;
        let (given, judged) = self.given.insert(next);
        Ok(Reading {
            bytes: given.bytes(),
            encoding: judged.encoding,
            captured: judged.captured,
            flags: judged.flags,
            width: judged.width,
            height: judged.height,
            lost: judged.lost,
        })
    }

    async fn next(&mut self) -> Result<(Given, Judged), DriverError> {
        loop {
            // A program that publishes faster than this reads must not keep this task from being stopped.
            tokio::task::consume_budget().await;
            let given = self.ingress.receive().map_err(|error| DriverError::Retry(error.to_string()))?;
            if let Some(given) = given {
                let judged = self.intake.judge(given.header(), given.bytes(), Stamp::now());
                if let Some(text) = self.intake.complaint() {
                    let text = format!("{}: {text}", self.name);
                    self.board.announce(EventKind::Log { level: Level::Warn, text });
                }
                if let Some(judged) = judged {
                    return Ok((given, judged));
                }
                continue;
            }
            if let Some(reason) = &self.reason {
                return Err(DriverError::Retry(reason.clone()));
            }
            tokio::select! {
                biased;
                reason = &mut self.ended => {
                    self.reason = Some(reason.unwrap_or_else(|_| "its keeper ended".to_owned()));
                }
                () = self.watch.wait() => {}
            }
        }
    }
}
