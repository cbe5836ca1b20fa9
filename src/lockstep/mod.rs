//! The simulated task stepped by a virtual clock: as fast as the machine computes, the same at every run.
//!
//! What decides is the same code as in a run in real time: hot-plug events of a scenario, the assignment
//! to entries, the slots, the mask, the recorder's session, the policy. What differs is who carries it: one
//! loop instead of threads, and moments that are counted instead of read from a clock.
//!
//! Invariant: a run is a function of its seed and its scenario.

pub mod collect;
pub mod evaluate;

use std::time::Duration;

use crate::bus::TopicId;
use crate::driver::DriverError;
use crate::driver::sim::task::{self, AXES, AXIS_COUNT, STEP_HZ, Shared};
use crate::hotplug::script::Timeline;
use crate::hotplug::{HotplugEvent, Witness};
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::provenance::Negotiated;
use crate::registry::scenario::{Scenario, SimSource, TaskPart};
use crate::registry::{Assigner, Assignment, Attachment, DeviceNode, DeviceSpec, Registry};
use crate::rig::slot::{Effects, Input, Slot};
use crate::sample::{Encoding, Epoch, FLAG_DEVICE_TIME, SampleHeader};
use crate::status::{Event, Provenance, SlotState, What};
use crate::time::{Stamp, nanoseconds};

/// The mask is published this often (paper, appendix "Physical Mask Data Format": 500 Hz).
const MASK_PERIOD: Duration = Duration::from_millis(2);
/// One step of the task.
pub const STEP: Duration = Duration::from_nanos(1_000_000_000 / STEP_HZ as u64);

/// Who sees what a rig sends, in the order of time.
pub trait Taker {
    /// A sample, a publication of the mask, or an action.
    fn take(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8]);
    /// An event.
    fn event(&mut self, event: &Event);
}

/// The rig of one trial.
#[derive(Debug)]
pub struct Lockstep {
    timeline: Timeline,
    assigner: Assigner,
    lanes: Vec<Lane>,
    trial: Shared,
    mask: PhysicalMask,
    mask_sequence: u64,
    now: Stamp,
    payload: Vec<u8>,
}

/// A modality: its slot, and the device that runs in it.
#[derive(Debug)]
struct Lane {
    spec: DeviceSpec,
    slot: Slot<Attachment>,
    running: Option<(Epoch, TaskPart)>,
    sequence: u64,
}

impl Lockstep {
    /// A rig at the moment `begun`, at which `scenario` begins: nothing has been sent yet.
    ///
    /// # Errors
    /// When the scenario is not of the simulated task.
    pub fn new(registry: &Registry, scenario: Scenario, begun: Stamp) -> Result<Self, DriverError> {
        let scene = scenario.devices.iter().find_map(|device| match &device.source {
            SimSource::Task { scene, .. } => Some(Shared::of(scene)),
            _ => None,
        });
        let lane = |spec: &DeviceSpec| Lane {
            spec: spec.clone(),
            slot: Slot::new(registry.rig.cooldown),
            running: None,
            sequence: 0,
        };
        Ok(Self {
            trial: scene.unwrap_or_else(|| Err(DriverError::Fatal("a scenario without the simulated task".into())))?,
            timeline: Timeline::new(scenario, begun),
            assigner: Assigner::new(registry),
            lanes: registry.devices.iter().map(lane).collect(),
            mask: PhysicalMask::EMPTY,
            mask_sequence: 0,
            now: begun,
            payload: Vec::new(),
        })
    }

    /// The trial.
    #[must_use]
    pub const fn trial(&self) -> &Shared {
        &self.trial
    }

    /// The moment it has come to.
    #[must_use]
    pub const fn now(&self) -> Stamp {
        self.now
    }

    /// The mask in force.
    #[must_use]
    pub const fn mask(&self) -> PhysicalMask {
        self.mask
    }

    /// Lets a tenth of a second pass in which the mask is published and cables are plugged and pulled.
    /// What the devices send at its end is sent by [`Self::deliver`].
    pub fn pass(&mut self, taker: &mut dyn Taker) {
        let end = self.now.after(STEP);
        while self.now < end {
            self.now = self.now.after(MASK_PERIOD).min(end);
            self.plug(taker);
            self.publish(taker);
        }
    }

    /// Lets every device that runs send one sample, captured now.
    ///
    /// # Errors
    /// When a picture cannot be made.
    pub fn deliver(&mut self, taker: &mut dyn Taker) -> Result<(), DriverError> {
        self.plug(taker);
        for index in 0..self.lanes.len() {
            let Some(lane) = self.lanes.get_mut(index) else { continue };
            let Some((epoch, part)) = lane.running else { continue };
            self.trial.trial().sample(part, &mut self.payload)?;
            let header = header(lane, epoch, part, self.now);
            lane.sequence += 1;
            let id = lane.spec.id;
            taker.take(TopicId::Modality(id), &header, &self.payload);
            if lane.slot.state() == SlotState::Opening {
                self.apply(id, Input::Started(epoch), taker);
            }
        }
        Ok(())
    }

    /// Tells the arm what to do from now on, as a policy does on the topic of actions at tick `number` of its
    /// control grid.
    pub fn act(&mut self, number: u64, action: [f64; AXES], taker: &mut dyn Taker) {
        self.trial.trial().command(action);
        self.payload.clear();
        self.payload.extend(action.into_iter().flat_map(f64::to_le_bytes));
        let header = SampleHeader {
            seq: number,
            capture_ns: self.now.0,
            recv_ns: self.now.0,
            encoding: Encoding::F64 as u32,
            width: AXIS_COUNT,
            ..SampleHeader::default()
        };
        taker.take(TopicId::Action, &header, &self.payload);
    }

    /// What was plugged and pulled until now, and what slots waited for.
    fn plug(&mut self, taker: &mut dyn Taker) {
        while let Some(event) = self.timeline.next_by(self.now) {
            match event {
                HotplugEvent::Added(attachment) => {
                    if let Assignment::Entry(id) = self.assigner.attach(&attachment) {
                        self.attached(id, attachment, taker);
                    }
                }
                HotplugEvent::Removed { syspath, .. } => {
                    let detached = self.assigner.detach(&syspath);
                    for id in detached.freed {
                        let (device, witness) = (self.name(id), Witness::Script.word().to_owned());
                        taker.event(&self.told(What::Detach { device, bit: id, witness }));
                        self.apply(id, Input::Detached, taker);
                    }
                    for (id, attachment) in detached.assigned {
                        self.attached(id, attachment, taker);
                    }
                }
            }
        }
        let now = self.now;
        let due = |lane: &&Lane| lane.slot.deadline().is_some_and(|deadline| deadline <= now);
        for id in self.lanes.iter().filter(due).map(|lane| lane.spec.id).collect::<Vec<_>>() {
            self.apply(id, Input::Timer, taker);
        }
    }

    fn attached(&mut self, id: ModalityId, attachment: Attachment, taker: &mut dyn Taker) {
        let what = What::Attach {
            device: self.name(id),
            bit: id,
            node: attachment.node.label(),
            unit: attachment.unit.clone(),
            driver: attachment.driver.as_deref().cloned(),
        };
        taker.event(&self.told(what));
        self.apply(id, Input::Attached(attachment), taker);
    }

    fn apply(&mut self, id: ModalityId, input: Input<Attachment>, taker: &mut dyn Taker) {
        let now = self.now;
        let Some(lane) = self.lanes.iter_mut().find(|lane| lane.spec.id == id) else { return };
        let before = lane.slot.state();
        let Effects { stop, start } = lane.slot.apply(input, now);
        if stop.is_some() {
            lane.running = None;
        }
        let opened = start.and_then(|(epoch, attachment)| {
            let DeviceNode::Sim(device) = &attachment.node else { return None };
            let SimSource::Task { part, .. } = device.source else { return None };
            lane.running = Some((epoch, part));
            let (driver, bus) = (attachment.driver.as_deref().cloned(), Some(format!("sim:{}", device.name)));
            let provenance = Provenance {
                epoch,
                node: attachment.node.label(),
                attached: now,
                unit: attachment.unit.clone(),
                negotiated: Negotiated { driver, bus, ..Negotiated::default() },
                latency_ns: nanoseconds(lane.spec.latency),
            };
            Some(What::Opened { device: lane.spec.name.clone(), bit: id, provenance: Box::new(provenance) })
        });
        let (state, present, device) = (lane.slot.state(), lane.slot.is_present(), lane.spec.name.clone());
        let mask = self.mask.with(id, present);
        if mask != self.mask {
            self.mask = mask;
            self.publish(taker);
        }
        if let Some(opened) = opened {
            taker.event(&self.told(opened));
        }
        if state != before {
            let mask = self.mask.hex(self.lanes.len());
            taker.event(&self.told(What::State { device, bit: id, state, mask, detail: String::new() }));
        }
    }

    fn publish(&mut self, taker: &mut dyn Taker) {
        self.mask_sequence += 1;
        let mut payload = [0; 16];
        payload[..8].copy_from_slice(&self.mask.0.to_le_bytes());
        payload[8..].copy_from_slice(&self.mask_sequence.to_le_bytes());
        let header = SampleHeader {
            seq: self.mask_sequence,
            capture_ns: self.now.0,
            recv_ns: self.now.0,
            encoding: Encoding::Mask as u32,
            ..SampleHeader::default()
        };
        taker.take(TopicId::Mask, &header, &payload);
    }

    fn told(&self, what: What) -> Event {
        Event { stamp: self.now, what }
    }

    fn name(&self, id: ModalityId) -> String {
        self.lanes.iter().find(|lane| lane.spec.id == id).map(|lane| lane.spec.name.clone()).unwrap_or_default()
    }
}

fn header(lane: &Lane, epoch: Epoch, part: TaskPart, now: Stamp) -> SampleHeader {
    let (encoding, width, height) = task::layout(part);
    SampleHeader {
        seq: lane.sequence,
        lost: 0,
        capture_ns: now.0,
        recv_ns: now.0,
        id: u32::from(lane.spec.id.bit()),
        epoch: epoch.0,
        encoding: encoding as u32,
        flags: FLAG_DEVICE_TIME,
        width,
        height,
    }
}
