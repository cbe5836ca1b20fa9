//! The decisions of a rig without any I/O: the lifecycles of devices, their assignment to entries, and the mask.
//!
//! [`Core::step`] takes one input and the time, and lists the effects. The caller carries them out in order: the live
//! rig (`owner`) with tasks and shared memory, the lockstep rig with a virtual clock.
//!
//! Invariant: no clock, no I/O, no lock: the same inputs give the same effects.
//! Invariant: a step that changes the mask, or what is plugged in, has [`Effect::Publish`] as its first effect, once, with
//! both after the whole step: no effect that allocates or locks precedes it.
//! Invariant: a bit is set only while its device is attached and a stream of its newest epoch runs.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::mask::{Bits, PhysicalMask};
use rapid_core::modality::ModalityId;
use rapid_core::provenance::UnplugSource;
use rapid_core::sample::Epoch;
use rapid_core::time::Stamp;
use rapid_devices::hotplug::HotplugEvent;
use rapid_registry::device::{Attachment, Unit};
use rapid_registry::{Assigner, Assignment, DeviceSpec, Registry};
use rapid_status::DeviceState;

use super::lifecycle::{self, End, Lifecycle};

/// What happens to a rig.
#[derive(Debug, Clone, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "plugs are rare")]
pub enum Input {
    /// A device was plugged in or removed.
    Hotplug(HotplugEvent),
    /// The stream of this epoch reports an event; an older epoch has no effect.
    Stream {
        /// Modality of the stream.
        id: ModalityId,
        /// Incarnation of the stream.
        epoch: Epoch,
        /// The report.
        event: StreamEvent,
    },
    /// A user requests a restart of a failed device.
    Restart(ModalityId),
    /// An entry is added, whose name and bit no other has.
    Register(Arc<DeviceSpec>),
    /// Time passed; see [`Core::deadline`].
    Timer,
}

/// What a stream reports about its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StreamEvent {
    /// The device is opened once its network link is up.
    LinkDown,
    /// The device is open.
    Opened,
    /// The first sample was published.
    Started,
    /// Samples have stopped.
    Stalled,
    /// Samples arrive again.
    Resumed,
    /// The stream ended.
    Ended(End),
}

/// An action for the caller.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect {
    /// Publish these. Always the first effect of a step.
    Publish(Bits),
    /// Report that no entry uses this device.
    Unused {
        /// The device.
        unit: Unit,
        /// Why, for people.
        reason: String,
    },
    /// Log that a device in use has another node, which no entry reads.
    WrongNode {
        /// Why, for people.
        reason: String,
    },
    /// An effect on one modality.
    Device(ModalityId, DeviceEffect),
}

/// An action for one modality.
#[derive(Debug, Clone, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "plugs are rare")]
pub enum DeviceEffect {
    /// Ask the running stream to end; do not wait for it.
    Stop,
    /// The previous stream no longer counts: it was asked to stop, or has ended.
    Ended,
    /// Announce that [`Core::attached`] is present.
    AnnounceAttach,
    /// Announce that the device is gone; once until the next announced attachment.
    AnnounceDetach(UnplugSource),
    /// Hot-plug attached a device: start its hooks.
    Plugged,
    /// Hot-plug removed the device: end its hooks.
    Unplugged,
    /// Start a stream.
    Start(Epoch, Attachment),
    /// Report a new state of the device.
    State(Transition),
}

/// How the state of a device changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transition {
    /// State before.
    pub from: DeviceState,
    /// State now.
    pub to: DeviceState,
    /// Time until the next start, in [`DeviceState::Backoff`].
    pub wait: Option<Duration>,
    /// The source that noticed the removal, in [`DeviceState::Absent`].
    pub source: Option<UnplugSource>,
}

/// See the module's comment.
#[derive(Debug, Clone)]
pub struct Core {
    modalities: Vec<ModalityState>,
    assigner: Assigner,
    mask: PhysicalMask,
    cooldown: Duration,
}

#[derive(Debug, Clone)]
struct ModalityState {
    id: ModalityId,
    lifecycle: Lifecycle<Attachment>,
    /// When the newest device was attached.
    attached_at: Stamp,
    /// A removal was announced, with no attachment since.
    is_announced_gone: bool,
}

impl ModalityState {
    fn new(id: ModalityId, cooldown: Duration) -> Self {
        Self { id, lifecycle: Lifecycle::new(cooldown), attached_at: Stamp::default(), is_announced_gone: false }
    }
}

impl Core {
    /// A core with nothing attached.
    pub fn new(registry: &Registry) -> Self {
        let cooldown = registry.rig.cooldown;
        Self {
            modalities: registry.devices.iter().map(|device| ModalityState::new(device.id, cooldown)).collect(),
            assigner: Assigner::new(registry),
            mask: PhysicalMask::EMPTY,
            cooldown,
        }
    }

    /// Takes one input at `now` and appends the effects, in order, to `effects`, which is empty.
    pub fn step(&mut self, input: Input, now: Stamp, effects: &mut Vec<Effect>) {
        let before = self.bits();
        match input {
            Input::Hotplug(HotplugEvent::Added(attachment)) => self.added(attachment, now, effects),
            Input::Hotplug(HotplugEvent::Removed { syspath, source, .. }) => {
                self.removed(&syspath, source, now, effects);
            }
            Input::Stream { id, epoch, event } if self.is_current(id, epoch) => {
                self.stream(id, epoch, event, now, effects);
            }
            Input::Stream { .. } => {}
            Input::Restart(id) => self.apply(id, lifecycle::Input::Restart, None, now, effects),
            Input::Register(device) => self.register(&device, now, effects),
            Input::Timer => {
                for index in 0..self.modalities.len() {
                    let due = |modality: &&ModalityState| {
                        modality.lifecycle.deadline().is_some_and(|deadline| deadline <= now)
                    };
                    if let Some(id) = self.modalities.get(index).filter(due).map(|modality| modality.id) {
                        self.apply(id, lifecycle::Input::Timer, None, now, effects);
                    }
                }
            }
        }
        let bits = self.bits();
        if bits != before {
            effects.insert(0, Effect::Publish(bits));
        }
    }

    /// The mask in force.
    pub const fn mask(&self) -> PhysicalMask {
        self.mask
    }

    /// The mask in force, and what is plugged in.
    pub fn bits(&self) -> Bits {
        let is_plugged =
            |modality: &&ModalityState| modality.lifecycle.attached().is_some() && !modality.is_announced_gone;
        let plugged =
            self.modalities.iter().filter(is_plugged).fold(self.mask, |all, modality| all.with(modality.id, true));
        Bits { mask: self.mask, plugged }
    }

    /// When [`Input::Timer`] is due, if no other input comes before.
    pub fn deadline(&self) -> Option<Stamp> {
        self.modalities.iter().filter_map(|modality| modality.lifecycle.deadline()).min()
    }

    /// Whether this stream runs now. Reports of any other stream have no effect.
    pub fn is_current(&self, id: ModalityId, epoch: Epoch) -> bool {
        self.modality(id).is_some_and(|modality| modality.lifecycle.is_current(epoch))
    }

    /// State and newest epoch of a modality; absent if there is no such modality.
    pub fn state(&self, id: ModalityId) -> (DeviceState, Epoch) {
        self.modality(id).map_or((DeviceState::Absent, Epoch(0)), |modality| {
            (modality.lifecycle.state(), modality.lifecycle.epoch())
        })
    }

    /// The device that is attached as this modality.
    pub fn attached(&self, id: ModalityId) -> Option<&Attachment> {
        self.modality(id)?.lifecycle.attached()
    }

    /// When the newest device of this modality was attached.
    pub fn attached_at(&self, id: ModalityId) -> Stamp {
        self.modality(id).map(|modality| modality.attached_at).unwrap_or_default()
    }

    /// Every attached node, in the order in which they were attached.
    pub fn nodes(&self) -> impl Iterator<Item = &Attachment> {
        self.assigner.nodes()
    }

    fn register(&mut self, device: &DeviceSpec, now: Stamp, effects: &mut Vec<Effect>) {
        if self.modality(device.id).is_some() {
            return;
        }
        let at = self.modalities.partition_point(|modality| modality.id < device.id);
        self.modalities.insert(at, ModalityState::new(device.id, self.cooldown));
        for (id, attachment) in self.assigner.add(device) {
            self.attach(id, attachment, now, effects);
        }
    }

    fn added(&mut self, attachment: Attachment, now: Stamp, effects: &mut Vec<Effect>) {
        if self.assigner.replaces(&attachment) {
            self.removed(&attachment.syspath, UnplugSource::Enumeration, now, effects);
        }
        match self.assigner.attach(&attachment) {
            Assignment::Entry(id) => self.attach(id, attachment, now, effects),
            Assignment::Waiting { reason } | Assignment::Unregistered { reason } => {
                effects.push(Effect::Unused { unit: attachment.unit, reason });
            }
            Assignment::WrongNode { reason } => effects.push(Effect::WrongNode { reason }),
        }
    }

    fn removed(&mut self, syspath: &Path, source: UnplugSource, now: Stamp, effects: &mut Vec<Effect>) {
        let detached = self.assigner.detach(syspath);
        for id in detached.freed {
            self.announce_detach(id, source, effects);
            self.apply(id, lifecycle::Input::Detached, Some(source), now, effects);
            effects.push(Effect::Device(id, DeviceEffect::Unplugged));
        }
        for (id, attachment) in detached.assigned {
            self.attach(id, attachment, now, effects);
        }
    }

    /// The assigner gave this device to `id`: no other one is ever attached to its lifecycle. A repeated report is the same
    /// attachment.
    fn attach(&mut self, id: ModalityId, attachment: Attachment, now: Stamp, effects: &mut Vec<Effect>) {
        let Some(modality) =
            self.modality_mut(id).filter(|modality| modality.lifecycle.attached() != Some(&attachment))
        else {
            return;
        };
        modality.attached_at = now;
        modality.is_announced_gone = false;
        effects.push(Effect::Device(id, DeviceEffect::AnnounceAttach));
        effects.push(Effect::Device(id, DeviceEffect::Plugged));
        self.apply(id, lifecycle::Input::Attached(attachment), None, now, effects);
    }

    fn stream(&mut self, id: ModalityId, epoch: Epoch, event: StreamEvent, now: Stamp, effects: &mut Vec<Effect>) {
        let mut source = None;
        let input = match event {
            StreamEvent::LinkDown => return self.announce_detach(id, UnplugSource::Link, effects),
            // A removal that hot-plug did not report: the link is up again, or the device never left.
            StreamEvent::Opened => {
                if let Some(modality) = self.modality_mut(id)
                    && std::mem::take(&mut modality.is_announced_gone)
                {
                    effects.push(Effect::Device(id, DeviceEffect::AnnounceAttach));
                }
                return;
            }
            StreamEvent::Started => lifecycle::Input::Started(epoch),
            StreamEvent::Stalled => lifecycle::Input::Stalled(epoch),
            StreamEvent::Resumed => lifecycle::Input::Resumed(epoch),
            StreamEvent::Ended(end) => {
                source = match end {
                    End::Gone => Some(UnplugSource::Stream),
                    End::LinkDown => Some(UnplugSource::Link),
                    End::Retry | End::Fatal => None,
                };
                if let Some(source) = source {
                    self.announce_detach(id, source, effects);
                }
                lifecycle::Input::Ended(epoch, end)
            }
        };
        self.apply(id, input, source, now, effects);
    }

    /// Announces which source noticed a removal, unless it was already announced.
    fn announce_detach(&mut self, id: ModalityId, source: UnplugSource, effects: &mut Vec<Effect>) {
        if let Some(modality) = self.modality_mut(id)
            && !std::mem::replace(&mut modality.is_announced_gone, true)
        {
            effects.push(Effect::Device(id, DeviceEffect::AnnounceDetach(source)));
        }
    }

    fn apply(
        &mut self,
        id: ModalityId,
        input: lifecycle::Input<Attachment>,
        source: Option<UnplugSource>,
        now: Stamp,
        effects: &mut Vec<Effect>,
    ) {
        let Some(modality) = self.modalities.iter_mut().find(|modality| modality.id == id) else { return };
        let (from, epoch) = (modality.lifecycle.state(), modality.lifecycle.epoch());
        let ran = modality.lifecycle.is_current(epoch);
        let lifecycle::Effects { stop, start } = modality.lifecycle.apply(input, now);
        self.mask = self.mask.with(id, modality.lifecycle.is_present());
        let mut push = |effect| effects.push(Effect::Device(id, effect));
        if stop.is_some() {
            push(DeviceEffect::Stop);
        }
        if ran && !modality.lifecycle.is_current(epoch) {
            push(DeviceEffect::Ended);
        }
        let to = modality.lifecycle.state();
        let is_changed = to != from || start.is_some();
        if let Some((epoch, attachment)) = start {
            push(DeviceEffect::Start(epoch, attachment));
        }
        if is_changed {
            let wait = modality
                .lifecycle
                .deadline()
                .filter(|_| to == DeviceState::Backoff)
                .map(|deadline| deadline.since(now));
            let source = source.filter(|_| to == DeviceState::Absent);
            push(DeviceEffect::State(Transition { from, to, wait, source }));
        }
    }

    fn modality(&self, id: ModalityId) -> Option<&ModalityState> {
        self.modalities.iter().find(|modality| modality.id == id)
    }

    fn modality_mut(&mut self, id: ModalityId) -> Option<&mut ModalityState> {
        self.modalities.iter_mut().find(|modality| modality.id == id)
    }
}

#[cfg(test)]
mod tests;
