//! The task that owns all slots.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures::StreamExt;
use tokio::sync::mpsc;
use tokio::task::{Id, JoinError, JoinSet};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout};
use tokio_util::sync::CancellationToken;

use super::attendant::Post;
use super::presence::{PERIOD, Presence};
use super::programs::Programs;
use super::slot::{Effects, End, Input, Slot};
use super::stream::{Controls, Numbers, Reported, Stream};
use super::worker::Seat;
use super::{RigCommand, RigError};
use crate::action::Arming;
use crate::bus::{Bus, TopicId, Writer};
use crate::hotplug::{HotplugEvent, HotplugStream, Witness};
use crate::interlocks::tap::Tap;
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::registry::{Assigner, Assignment, Attachment, DeviceSpec, Registry};
use crate::sample::Epoch;
use crate::status::{Board, EpisodeWatch, SlotState, What};
use crate::time::Stamp;

/// The JSON file is written this often, and at every change.
const JSON_PERIOD: Duration = Duration::from_secs(1);
/// At the end, streams have this long to close their devices before they are abandoned.
const STOP_LIMIT: Duration = Duration::from_millis(4500);
/// Reports that may wait; streams report a few times in their life.
const REPORT_DEPTH: usize = 1024;

/// Owner of every device's life and of the mask.
#[derive(Debug)]
pub struct Rig {
    modalities: Vec<Modality>,
    assigner: Assigner,
    presence: Presence,
    board: Arc<Board>,
    mask: PhysicalMask,
    /// The mask's JSON file is to be written, once for everything that one event changes.
    json_is_stale: bool,
    streams: JoinSet<(End, String)>,
    /// Which stream a task is.
    tasks: HashMap<Id, (ModalityId, Epoch)>,
    reports: mpsc::Sender<Reported>,
    /// The programs, if an entry needs one.
    programs: Option<Programs>,
    /// The episode in progress.
    episode: EpisodeWatch,
    /// Cancelled when devices begin to be closed.
    ending: CancellationToken,
}

/// A slot and what belongs to it.
#[derive(Debug)]
struct Modality {
    spec: Arc<DeviceSpec>,
    slot: Slot<Attachment>,
    writer: Arc<Writer>,
    numbers: Arc<Numbers>,
    /// When the newest device was attached.
    attached: Stamp,
    /// Tells the running stream to end.
    stop: CancellationToken,
    /// Where its program works, if it has one.
    seat: Option<Seat>,
    /// Where its hooks are run, if a program is run at all.
    post: Option<Post>,
    /// What it is told, if it is the actuator and no program reads it.
    controls: Option<Controls>,
    /// Emergency stops and enabling switches that are numbers of its samples.
    taps: Arc<[Tap]>,
    /// What the actuator said last in this epoch.
    arming: Option<Arming>,
    /// A removal was told and no attachment after it.
    was_told_gone: bool,
    /// What was agreed with the device, or why it does not run.
    detail: String,
}

impl Rig {
    /// A rig with every slot empty, which publishes through `presence`.
    #[must_use]
    pub fn new(registry: &Registry, bus: &Bus, presence: Presence, board: Arc<Board>) -> Self {
        let programs = Programs::new(registry, bus, &board);
        let prefix = bus.membership().prefix();
        let modality = |spec: &DeviceSpec| {
            let writer = bus.writer(TopicId::Modality(spec.id))?;
            let spec = Arc::new(spec.clone());
            let seat = programs.as_ref().and_then(|programs| Seat::new(programs, &spec, bus));
            let post = programs
                .as_ref()
                .map(|programs| Post::new(programs, &spec, prefix.clone(), seat.as_ref().map(Seat::turn)));
            Some(Modality {
                slot: Slot::new(registry.rig.cooldown),
                writer,
                numbers: Arc::default(),
                attached: Stamp::default(),
                stop: CancellationToken::new(),
                // A program that moves its device listens itself.
                controls: spec
                    .action
                    .as_ref()
                    .filter(|_| seat.is_none())
                    .and_then(|_| Some(Controls::new(bus.actions()?))),
                taps: Arc::from([]),
                arming: None,
                was_told_gone: false,
                seat,
                post,
                spec,
                detail: String::new(),
            })
        };
        Self {
            // The bus was opened from the same registry: it has a writer for each of them.
            modalities: registry.devices.iter().filter_map(modality).collect(),
            assigner: Assigner::new(registry),
            presence,
            board,
            mask: PhysicalMask::EMPTY,
            json_is_stale: false,
            streams: JoinSet::new(),
            tasks: HashMap::new(),
            reports: mpsc::channel(1).0,
            programs,
            episode: tokio::sync::watch::channel(None).1,
            ending: CancellationToken::new(),
        }
    }

    /// Runs until `shutdown`, then ends every stream. The mask stays published, as it was, until
    /// the rig is dropped: what is recorded to the end has its mask beside it.
    ///
    /// # Errors
    /// When plugging can no longer be watched.
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
            let deadline = self.next_deadline();
            tokio::select! {
                // Shutdown first, then the earliest witnesses of an unplug, then the rest.
                biased;
                () = shutdown.cancelled() => break Ok(()),
                Some(ended) = self.streams.join_next_with_id(), if !self.streams.is_empty() => {
                    self.reports_so_far(&mut reported);
                    self.stream_ended(ended);
                }
                event = hotplug.next() => match event {
                    Some(Ok(event)) => self.hotplug(event),
                    Some(Err(error)) => break Err(error.into()),
                    None => break Ok(()),
                },
                Some((id, epoch, report)) = reported.recv() => self.report(id, epoch, report),
                Some(command) = commands.recv() => match command {
                    RigCommand::Restart(id) => self.apply(id, Input::Restart),
                },
                () = sleep(deadline.since(Stamp::now())) => self.deadlines_passed(),
                _ = json.tick() => self.json_is_stale = true,
                // The mask it belongs to is not published yet.
                () = sleep(PERIOD), if self.json_is_stale => {}
            }
            self.json_is_stale = self.json_is_stale && !self.write_json();
        };
        self.ending.cancel();
        self.reports_so_far(&mut reported);
        self.stop_streams().await;
        for id in self.modalities.iter().map(|modality| modality.spec.id).collect::<Vec<_>>() {
            self.lay_down(id, false);
        }
        result
    }

    fn hotplug(&mut self, event: HotplugEvent) {
        match event {
            HotplugEvent::Added(attachment) => {
                if self.assigner.replaces(&attachment) {
                    self.removed(&attachment.syspath, Witness::Enumeration);
                }
                match self.assigner.attach(&attachment) {
                    Assignment::Entry(id) => self.attached(id, attachment),
                    Assignment::Waiting { reason } | Assignment::Unregistered { reason } => {
                        let unit = &attachment.unit;
                        let serial = unit.serial().unwrap_or("no serial");
                        let device = format!("{} ({serial}) at {}", unit.model(), unit.place());
                        self.board.announce(What::Unregistered { device, reason });
                    }
                    Assignment::WrongNode { reason } => tracing::debug!(%reason, "node not used"),
                }
            }
            HotplugEvent::Removed { syspath, witness, .. } => self.removed(&syspath, witness),
        }
    }

    fn attached(&mut self, id: ModalityId, attachment: Attachment) {
        let Some(modality) = self.modality(id) else { return };
        if modality.slot.attached() == Some(&attachment) {
            return;
        }
        modality.attached = Stamp::now();
        self.tell_attach(id, &attachment);
        self.attend(id, &attachment);
        self.apply(id, Input::Attached(attachment));
    }

    fn removed(&mut self, syspath: &Path, witness: Witness) {
        let detached = self.assigner.detach(syspath);
        for id in detached.freed {
            self.set_bit(id, false);
            self.tell_detach(id, witness.word());
            self.apply(id, Input::Detached);
            self.dismiss(id);
        }
        for (id, attachment) in detached.assigned {
            self.attached(id, attachment);
        }
    }

    fn stream_ended(&mut self, ended: Result<(Id, (End, String)), JoinError>) {
        let (task, end, reason) = match ended {
            Ok((task, (end, reason))) => (task, end, reason),
            Err(error) if error.is_panic() => {
                (error.id(), End::Retry, "its reader panicked; please report this".to_owned())
            }
            Err(error) => (error.id(), End::Retry, error.to_string()),
        };
        let Some((id, epoch)) = self.tasks.remove(&task) else { return };
        let Some(modality) = self.modality(id).filter(|modality| modality.slot.is_current(epoch)) else { return };
        if let End::Retry | End::Fatal = end {
            modality.detail.clone_from(&reason);
        }
        // Whatever ended it, nothing of it comes any more.
        self.set_bit(id, false);
        match end {
            End::Gone => self.tell_detach(id, "stream"),
            End::Unlinked => {
                self.tell_detach(id, Witness::Link.word());
                self.modality(id).into_iter().for_each(|modality| modality.detail.clone_from(&reason));
            }
            End::Retry | End::Fatal => {}
        }
        self.apply(id, Input::Ended(epoch, end));
    }

    fn deadlines_passed(&mut self) {
        let now = Stamp::now();
        let due = |modality: &&Modality| modality.slot.deadline().is_some_and(|deadline| deadline <= now);
        for id in self.modalities.iter().filter(due).map(|modality| modality.spec.id).collect::<Vec<_>>() {
            self.apply(id, Input::Timer);
        }
    }

    /// The next moment a slot wants to be woken; far away if none does.
    fn next_deadline(&self) -> Stamp {
        let deadlines = self.modalities.iter().filter_map(|modality| modality.slot.deadline());
        deadlines.min().unwrap_or_else(|| Stamp::now().after(Duration::from_hours(1)))
    }

    /// Publishes the mask with this bit, if that changes it. Comes before everything else that an unplug brings with it:
    /// what is announced allocates and locks.
    fn set_bit(&mut self, id: ModalityId, present: bool) {
        let mask = self.mask.with(id, present);
        if mask != self.mask {
            self.mask = mask;
            self.presence.publish(mask);
        }
    }

    /// Applies an input to a slot, does what it says, and publishes the mask if it changed.
    fn apply(&mut self, id: ModalityId, input: Input<Attachment>) {
        let now = Stamp::now();
        let Some(modality) = self.modality(id) else { return };
        let (before, epoch) = (modality.slot.state(), modality.slot.epoch());
        let ran = modality.slot.is_current(epoch);
        let Effects { stop, start } = modality.slot.apply(input, now);
        let (state, present) = (modality.slot.state(), modality.slot.is_present());
        self.set_bit(id, present);
        let Some(modality) = self.modality(id) else { return };
        if stop.is_some() {
            modality.stop.cancel();
        }
        if ran && !modality.slot.is_current(epoch) {
            self.lay_down(id, true);
        }
        let Some(modality) = self.modality(id) else { return };
        let changed = state != before || start.is_some();
        if changed
            && state == SlotState::Backoff
            && let Some(deadline) = modality.slot.deadline()
        {
            let wait = deadline.since(now).as_secs_f64();
            let reason = if before == SlotState::Absent { "cooldown" } else { modality.detail.as_str() };
            modality.detail = format!("{reason}; starts in {wait:.1} s");
        }
        if changed && state == SlotState::Failed && before == SlotState::Absent {
            "attached, though its driver said again and again that it is gone: replug it, or restart it"
                .clone_into(&mut modality.detail);
        }
        if let Some((epoch, attachment)) = start {
            modality.detail = attachment.node.label();
            self.start(id, epoch, attachment);
        }
        if changed {
            self.show(id);
            self.announce_state(id);
            self.json_is_stale = true;
        }
    }

    fn start(&mut self, id: ModalityId, epoch: Epoch, attachment: Attachment) {
        let (board, reports, episode) = (Arc::clone(&self.board), self.reports.clone(), self.episode.clone());
        let Some(modality) = self.modality(id) else { return };
        modality.stop = CancellationToken::new();
        let stream = Stream {
            spec: Arc::clone(&modality.spec),
            attachment,
            attached: modality.attached,
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

    fn show(&mut self, id: ModalityId) {
        let board = Arc::clone(&self.board);
        let Some(modality) = self.modality(id) else { return };
        board.set_slot(id, modality.slot.state(), modality.slot.epoch(), &modality.detail);
    }

    /// Tells every stream to end and gives them a moment to close their devices.
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

mod programs;
mod report;
#[cfg(test)]
mod tests;
