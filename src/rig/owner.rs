//! The task that carries out the core's decisions: streams, announcements, the published mask.
//!
//! Invariant: the mask is published before any announcement, because announcing allocates and locks.
//! Invariant: this task never waits for a device; a stream is notified to end and then forgotten.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use futures::StreamExt;
use rapid_bus::{Bus, TopicId, Writer};
use rapid_core::action::{ActuatorNotice, Arming};
use rapid_core::clip::ClipNotice;
use rapid_core::mask::SizedMask;
use rapid_core::modality::ModalityId;
use rapid_core::permission::Permission;
use rapid_core::sample::Epoch;
use rapid_core::time::Stamp;
use rapid_devices::driver::{ClockOffset, DriverError};
use rapid_devices::hotplug::HotplugStream;
use rapid_devices::inputs::tap::Tap;
use rapid_registry::candidate::{Candidate, unregistered};
use rapid_registry::device::Attachment;
use rapid_registry::{DeviceSpec, Registry};
use rapid_status::{Board, DeviceState, EpisodeWatch, EventKind, Level, UnregisteredDevice};
use tokio::sync::mpsc;
use tokio::task::{Id, JoinError, JoinSet};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout};
use tokio_util::sync::CancellationToken;

use super::core::{Core, DeviceEffect, Effect, Input, StreamEvent, Transition};
use super::hooks::HookQueue;
use super::lifecycle::End;
use super::presence::{JsonDevice, PERIOD, Presence};
use super::programs::{BusNames, Programs};
use super::stream::{Controls, Ended, Numbers, Report, Reported, Stream};
use super::worker::ProcessSlot;
use super::{Addition, RigCommand, RigError};

/// The JSON file is written this often, and at every change.
const JSON_PERIOD: Duration = Duration::from_secs(1);
/// At the end, streams have this long to close their devices before they are abandoned.
const STOP_LIMIT: Duration = Duration::from_millis(4500);
/// Queue length for reports; a stream reports a few times in its life.
const REPORT_DEPTH: usize = 1024;
/// Capacity for effects without an allocation: far more than one event causes.
const EFFECTS: usize = 64;

/// Executes the rig's core with real devices.
#[derive(Debug)]
pub struct Rig {
    core: Core,
    /// As of the last added entry.
    registry: Arc<Registry>,
    /// Effects of the step in progress; reused, so that a step allocates nothing.
    effects: Vec<Effect>,
    modalities: Vec<Modality>,
    presence: Presence,
    board: Arc<Board>,
    /// The mask's JSON file must be written, once for all changes of one event.
    json_is_stale: bool,
    /// Connected units without an entry must be reported, once nothing else is to be done.
    units_are_stale: bool,
    streams: JoinSet<Ended>,
    /// The stream of each task.
    tasks: HashMap<Id, (ModalityId, Epoch)>,
    reports: mpsc::Sender<Reported>,
    /// The programs, if an entry needs one.
    programs: Option<Programs>,
    /// The episode in progress.
    episode: EpisodeWatch,
    /// Cancelled when devices start being closed.
    ending: CancellationToken,
}

/// State of the live rig for a modality.
#[derive(Debug)]
struct Modality {
    spec: Arc<DeviceSpec>,
    writer: Arc<Writer>,
    numbers: Arc<Numbers>,
    /// Ends the running stream.
    stop: CancellationToken,
    /// Runs its program, if it has one.
    seat: Option<ProcessSlot>,
    /// Runs its hooks, if the rig runs programs at all.
    hooks: Option<HookQueue>,
    /// Its commands, if it is the actuator and no program drives it.
    controls: Option<Controls>,
    /// Emergency stops and enabling switches that are numbers in its samples.
    taps: Arc<[Tap]>,
    /// What the actuator reported last in this epoch.
    arming: Option<Arming>,
    /// The settings agreed with the device, or why it does not run.
    detail: String,
}

impl Rig {
    /// A rig without devices, which publishes through `presence`.
    pub fn new(registry: &Registry, bus: &Bus, presence: Presence, board: Arc<Board>) -> Self {
        let programs = Programs::new(registry, bus, &board);
        let names = BusNames::from_membership(&bus.membership());
        let modality = |spec: &DeviceSpec| {
            let writer = bus.writer(TopicId::Modality(spec.id))?;
            let spec = Arc::new(spec.clone());
            let seat = programs.as_ref().and_then(|programs| ProcessSlot::new(programs, &spec, bus));
            let hooks = programs
                .as_ref()
                .map(|programs| HookQueue::new(programs, &spec, names.clone(), seat.as_ref().map(ProcessSlot::turn)));
            // A program that drives its device subscribes to actions itself.
            let is_driven = spec.action.is_some() && seat.is_none();
            let controls = if is_driven { bus.actions().map(Controls::new) } else { None };
            Some(Modality { seat, hooks, controls, ..Modality::new(spec, writer) })
        };
        Self {
            core: Core::new(registry),
            registry: Arc::new(registry.clone()),
            effects: Vec::with_capacity(EFFECTS),
            // The bus was opened from the same registry: it has a writer for each modality.
            modalities: registry.devices.iter().filter_map(modality).collect(),
            presence,
            board,
            json_is_stale: false,
            units_are_stale: false,
            streams: JoinSet::new(),
            tasks: HashMap::new(),
            reports: mpsc::channel(1).0,
            programs,
            episode: tokio::sync::watch::channel(None).1,
            ending: CancellationToken::new(),
        }
    }

    /// Makes devices and their hooks follow the episodes of this watch.
    #[must_use]
    pub fn following(mut self, episode: EpisodeWatch) -> Self {
        self.episode = episode;
        self
    }

    /// Makes its actuator move as `permission` allows; without this nothing arms it.
    #[must_use]
    pub fn obeying(mut self, permission: &Arc<Permission>) -> Self {
        for controls in self.modalities.iter_mut().filter_map(|modality| modality.controls.as_mut()) {
            controls.obey(permission);
        }
        self
    }

    /// Makes the samples of its devices be checked for these emergency stops, enabling switches and buttons.
    #[must_use]
    pub fn tapped(mut self, taps: &[Tap]) -> Self {
        for modality in &mut self.modalities {
            modality.taps = taps.iter().filter(|tap| tap.device() == modality.spec.name).cloned().collect();
        }
        self
    }

    /// Cancelled by [`Self::run`] before it closes the first device at its end.
    pub fn ending(&self) -> CancellationToken {
        self.ending.clone()
    }

    /// Cancelling it kills the programs that are being ended.
    pub fn hurry(&self) -> CancellationToken {
        self.programs.as_ref().map_or_else(CancellationToken::new, |programs| programs.hurry.clone())
    }

    /// After a run and its episode: waits for the programs of its devices, which were asked to end, and for their
    /// hooks.
    pub async fn programs_ended(&self) {
        if let Some(programs) = &self.programs {
            programs.ended().await;
        }
    }

    /// Runs until `shutdown`, then ends every stream. The mask stays published unchanged until the rig is dropped: the
    /// recording has a mask up to its end.
    ///
    /// # Errors
    /// When hot-plug events can no longer be monitored.
    pub async fn run(
        &mut self,
        mut hotplug: HotplugStream,
        mut commands: mpsc::Receiver<RigCommand>,
        shutdown: CancellationToken,
    ) -> Result<(), RigError> {
        let (reports, mut reported) = mpsc::channel(REPORT_DEPTH);
        self.reports = reports;
        let mut json = interval(JSON_PERIOD);
        json.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let result = loop {
            // A distant time if no device is waited for.
            let deadline = self.core.deadline().unwrap_or_else(|| Stamp::now().after(Duration::from_hours(1)));
            tokio::select! {
                // Shutdown first, then the earliest sources of an unplug, then the rest.
                biased;
                () = shutdown.cancelled() => break Ok(()),
                Some(ended) = self.streams.join_next_with_id(), if !self.streams.is_empty() => {
                    self.reports_so_far(&mut reported);
                    self.stream_ended(ended);
                }
                event = hotplug.next() => match event {
                    Some(Ok(event)) => {
                        self.step(Input::Hotplug(event));
                        self.units_are_stale = true;
                    }
                    Some(Err(error)) => break Err(error.into()),
                    None => break Ok(()),
                },
                Some(reported) = reported.recv() => self.report(reported),
                Some(command) = commands.recv() => match command {
                    RigCommand::Restart(id) => self.step(Input::Restart(id)),
                    RigCommand::Register(addition) => self.register(addition),
                    RigCommand::Attached(reply) => {
                        let _ = reply.send(self.core.nodes().cloned().collect());
                    }
                },
                () = sleep(deadline.since(Stamp::now())) => self.step(Input::Timer),
                _ = json.tick() => self.json_is_stale = true,
                () = std::future::ready(()), if self.units_are_stale => self.show_unregistered(),
                // The mask that it describes is not published yet.
                () = sleep(PERIOD), if self.json_is_stale => {}
            }
            self.json_is_stale = self.json_is_stale && !self.write_json();
        };
        self.ending.cancel();
        self.reports_so_far(&mut reported);
        self.stop_streams().await;
        for modality in &mut self.modalities {
            modality.disarm(&self.board, false);
        }
        result
    }

    /// Takes one step of the core and carries out its effects.
    fn step(&mut self, input: Input) {
        let mut effects = std::mem::take(&mut self.effects);
        self.core.step(input, Stamp::now(), &mut effects);
        for effect in effects.drain(..) {
            match effect {
                Effect::Publish(bits) => self.presence.publish(bits),
                Effect::Unused { unit, reason } => {
                    let serial = unit.serial().unwrap_or("no serial");
                    let device = format!("{} ({serial}) at {}", unit.model(), unit.place());
                    self.board.announce(EventKind::Unregistered { device, reason });
                }
                Effect::WrongNode { reason } => tracing::debug!(%reason, "node not used"),
                Effect::Device(id, effect) => self.carry_out(id, effect),
            }
        }
        self.effects = effects;
    }

    /// Takes over an added entry, and attaches its device if that is plugged in.
    fn register(&mut self, Addition { device, registry, writer }: Addition) {
        let at = self.modalities.partition_point(|modality| modality.spec.id < device.id);
        self.modalities.insert(at, Modality::new(Arc::clone(&device), writer));
        self.registry = registry;
        self.presence.set_devices(self.modalities.len());
        self.json_is_stale = true;
        self.step(Input::Register(device));
        self.units_are_stale = true;
    }

    /// Reports connected units without an entry that a driver could read.
    fn show_unregistered(&mut self) {
        self.units_are_stale = false;
        let attached: Vec<_> = self.core.nodes().cloned().collect();
        let suggested = |unit: &Candidate| {
            let name = unit.suggested_name(Some(&self.registry));
            Some(UnregisteredDevice { device: unit.describe(), node: unit.guess()?.to_owned(), name })
        };
        let units = unregistered(Some(&self.registry), &attached);
        self.board.set_unregistered(units.iter().filter_map(suggested).collect());
    }

    fn carry_out(&mut self, id: ModalityId, effect: DeviceEffect) {
        let Some(modality) = self.modalities.iter_mut().find(|modality| modality.spec.id == id) else { return };
        let device = || modality.spec.name.clone();
        match effect {
            DeviceEffect::Stop => modality.stop.cancel(),
            DeviceEffect::Ended => modality.disarm(&self.board, true),
            DeviceEffect::AnnounceAttach => {
                if let Some(Attachment { node, unit, driver, .. }) = self.core.attached(id) {
                    let (node, unit, driver) = (node.label(), unit.clone(), driver.as_deref().cloned());
                    self.board.announce(EventKind::Attach { device: device(), bit: id, node, unit, driver });
                }
            }
            DeviceEffect::AnnounceDetach(source) => {
                self.board.announce(EventKind::Detach { device: device(), bit: id, source });
            }
            DeviceEffect::Plugged => {
                if let Some((hooks, attachment)) = modality.hooks.as_mut().zip(self.core.attached(id)) {
                    hooks.attached(attachment, &self.episode);
                }
            }
            DeviceEffect::Unplugged => modality.hooks.iter().for_each(HookQueue::removed),
            DeviceEffect::Start(epoch, attachment) => {
                modality.detail = attachment.node.label();
                self.start(id, epoch, attachment);
            }
            DeviceEffect::State(transition) => {
                modality.describe(transition);
                self.show(id);
                self.announce_state(id, transition.to);
                self.json_is_stale = true;
            }
        }
    }

    fn stream_ended(&mut self, ended: Result<(Id, Ended), JoinError>) {
        let (task, Ended { end, reason }) = match ended {
            Ok(ended) => ended,
            Err(error) => {
                let reason = if error.is_panic() {
                    "its reader panicked; please report this".to_owned()
                } else {
                    error.to_string()
                };
                (error.id(), Ended { end: End::Retry, reason })
            }
        };
        let Some((id, epoch)) = self.tasks.remove(&task) else { return };
        let is_current = self.core.is_current(id, epoch);
        if let Some(modality) = self.modality(id).filter(|_| is_current && end != End::Gone) {
            modality.detail = reason;
        }
        self.step(Input::Stream { id, epoch, event: StreamEvent::Ended(end) });
    }

    /// Takes the reports that streams have sent so far; all of them for a stream that has ended.
    fn reports_so_far(&mut self, reports: &mut mpsc::Receiver<Reported>) {
        for _ in 0..reports.len() {
            let Ok(reported) = reports.try_recv() else { return };
            self.report(reported);
        }
    }

    fn report(&mut self, Reported { id, epoch, report }: Reported) {
        // A report may arrive after the end of its stream, whose reason must be kept.
        if !self.core.is_current(id, epoch) {
            return;
        }
        match report {
            Report::Event(event) => return self.step(Input::Stream { id, epoch, event }),
            Report::LinkDown => self.step(Input::Stream { id, epoch, event: StreamEvent::LinkDown }),
            Report::Opened(..) => self.step(Input::Stream { id, epoch, event: StreamEvent::Opened }),
            Report::Silent(_) | Report::Refused(_) | Report::Actuator(_) | Report::Clock(_) | Report::Clip(_) => {}
        }
        let Some(modality) = self.modalities.iter_mut().find(|modality| modality.spec.id == id) else { return };
        let device = modality.spec.name.clone();
        let what = match report {
            Report::Event(_) => return,
            Report::LinkDown => {
                modality.detail = DriverError::Unlinked.to_string();
                let text = format!("{device}: {}; it is opened when that is over", modality.detail);
                EventKind::Log { level: Level::Warn, text }
            }
            Report::Opened(description, provenance) => {
                modality.detail = description;
                EventKind::Opened { device, bit: id, provenance }
            }
            Report::Silent(limit) => {
                let limit = limit.as_secs();
                modality.detail = format!("{}; it has sent nothing for {limit} s", modality.detail);
                EventKind::Log {
                    level: Level::Warn,
                    text: format!("{device}: open, but it has sent nothing for {limit} s"),
                }
            }
            Report::Refused(reason) => EventKind::Log { level: Level::Error, text: format!("{device}: {reason}") },
            Report::Clock(ClockOffset { offset_ns, uncertainty_ns }) => {
                EventKind::Clock { device, bit: id, offset_ns, uncertainty_ns }
            }
            Report::Clip(ClipNotice { state, text }) => EventKind::Clip { device, bit: id, state, text },
            Report::Actuator(ActuatorNotice { arming, text, is_problem }) => {
                modality.detail = format!("{}: {text}", arming.word());
                modality.arming = Some(arming);
                EventKind::Actuator { device, bit: id, arming, is_problem, text }
            }
        };
        self.show(id);
        self.board.announce(what);
    }

    fn start(&mut self, id: ModalityId, epoch: Epoch, attachment: Attachment) {
        let (board, reports, episode) = (Arc::clone(&self.board), self.reports.clone(), self.episode.clone());
        let attached = self.core.attached_at(id);
        let Some(modality) = self.modality(id) else { return };
        modality.stop = CancellationToken::new();
        let stream = Stream {
            spec: Arc::clone(&modality.spec),
            attachment,
            attached,
            epoch,
            writer: Arc::clone(&modality.writer),
            numbers: Arc::clone(&modality.numbers),
            board,
            reports,
            stop: modality.stop.clone(),
            seat: modality.seat.clone(),
            controls: modality.controls.clone(),
            taps: Arc::clone(&modality.taps),
            episode,
        };
        let task = self.streams.spawn(stream.run());
        self.tasks.insert(task.id(), (id, epoch));
    }

    fn show(&self, id: ModalityId) {
        let (state, epoch) = self.core.state(id);
        if let Some(modality) = self.modalities.iter().find(|modality| modality.spec.id == id) {
            self.board.set_device_state(id, state, epoch, &modality.detail);
        }
    }

    fn announce_state(&mut self, id: ModalityId, state: DeviceState) {
        let mask = SizedMask { mask: self.core.mask(), devices: self.modalities.len() };
        let Some(modality) = self.modalities.iter().find(|modality| modality.spec.id == id) else { return };
        let (device, detail) = (modality.spec.name.clone(), modality.detail.clone());
        self.board.announce(EventKind::State { device, bit: id, state, mask, detail });
    }

    /// Writes the JSON file, with mask and sequence of one publication; `false` if the current mask is not published
    /// yet.
    fn write_json(&self) -> bool {
        let device = |modality: &Modality| {
            let Modality { spec, .. } = modality;
            JsonDevice {
                name: spec.name.clone(),
                bit: spec.id,
                online: self.core.mask().contains(spec.id),
                usb_connected: self.core.attached(spec.id).is_some(),
                state: self.core.state(spec.id).0,
            }
        };
        let devices: Vec<_> = self.modalities.iter().map(device).collect();
        self.presence.write_json(self.core.mask(), &devices)
    }

    /// Asks every stream to end and gives them a moment to close their devices.
    async fn stop_streams(&mut self) {
        for modality in &self.modalities {
            modality.stop.cancel();
        }
        let until = Instant::now() + STOP_LIMIT;
        while !self.streams.is_empty() {
            let left = until.saturating_duration_since(Instant::now());
            let Ok(Some(ended)) = timeout(left, self.streams.join_next_with_id()).await else {
                let slow = self.tasks.values().filter_map(|(id, _)| self.name(*id)).collect::<Vec<_>>().join(", ");
                tracing::warn!(devices = %slow, "did not close in time and are abandoned");
                self.streams.detach_all();
                return;
            };
            let task = ended.map_or_else(|error| error.id(), |(task, _)| task);
            self.tasks.remove(&task);
        }
    }

    fn name(&self, id: ModalityId) -> Option<&str> {
        self.modalities.iter().find(|modality| modality.spec.id == id).map(|modality| modality.spec.name.as_str())
    }

    fn modality(&mut self, id: ModalityId) -> Option<&mut Modality> {
        self.modalities.iter_mut().find(|modality| modality.spec.id == id)
    }
}

impl Modality {
    /// Without a program, hooks or actions.
    fn new(spec: Arc<DeviceSpec>, writer: Arc<Writer>) -> Self {
        Self {
            spec,
            writer,
            numbers: Arc::default(),
            stop: CancellationToken::new(),
            seat: None,
            hooks: None,
            controls: None,
            taps: Arc::from([]),
            arming: None,
            detail: String::new(),
        }
    }

    /// The stream has ended, or was asked to. The actuator's last report no longer holds: nothing is sent to it until
    /// the next arm.
    fn disarm(&mut self, board: &Board, is_problem: bool) {
        if self.arming.take().is_some_and(|last| !matches!(last, Arming::Disarmed | Arming::Faulted)) {
            let (device, text) = (self.spec.name.clone(), "disarmed; arm it again to resume".to_owned());
            board.announce(EventKind::Actuator {
                device,
                bit: self.spec.id,
                arming: Arming::Disarmed,
                is_problem,
                text,
            });
        }
    }

    /// Keeps, for people, why the device is in its new state.
    fn describe(&mut self, Transition { from, to, wait, source }: Transition) {
        if let Some(source) = source {
            self.detail = format!("unplugged ({})", source.word());
        }
        if let Some(wait) = wait {
            let reason = if from == DeviceState::Absent { "cooldown" } else { self.detail.as_str() };
            self.detail = format!("{reason}; starts in {:.1} s", wait.as_secs_f64());
        }
        if (from, to) == (DeviceState::Absent, DeviceState::Failed) {
            "attached, but its driver repeatedly reported a disconnection: replug it, or restart it"
                .clone_into(&mut self.detail);
        }
    }
}

#[cfg(test)]
mod tests;
