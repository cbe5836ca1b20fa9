//! The simulated task stepped by a virtual clock: as fast as the machine computes, with the same result in every run.
//!
//! The decisions are made by the same code as in real time: hot-plug events of a scenario, the assignment to entries,
//! the slots, the mask, the recorder's session, the policy. The execution differs: one loop instead of threads, and
//! times that are computed instead of read from a clock.
//!
//! Invariant: a run is a function of its seed and its scenario.

pub mod collect;
pub mod evaluate;
pub mod timing;

use std::collections::VecDeque;
use std::time::Duration;

use rapid_bus::TopicId;
use rapid_core::mask::{PhysicalMask, SizedMask};
use rapid_core::modality::ModalityId;
use rapid_core::provenance::Negotiated;
use rapid_core::sample::{Encoding, Epoch, FLAG_DEVICE_TIME, SampleHeader};
use rapid_core::time::{Stamp, nanoseconds};
use rapid_devices::driver::DriverError;
use rapid_devices::hotplug::script::Timeline;
use rapid_episode::record::RecordError;
use rapid_episode::record::stepped::Taker;
use rapid_registry::device::{Attachment, DeviceNode};
use rapid_registry::scenario::{Scenario, ScenarioAction};
use rapid_registry::simulation::task::{self, AXES, AXIS_COUNT, STEP_HZ, SharedTrial};
use rapid_registry::simulation::{SimSource, TaskPart};
use rapid_registry::{DeviceSpec, Registry};
use rapid_status::{DeviceState, Event, EventKind, Provenance};

use crate::rig::core::{Core, DeviceEffect, Effect, Input, StreamEvent};
use timing::Timing;

/// Publication period of the mask (paper, appendix "Physical Mask Data Format": 500 Hz).
const MASK_PERIOD: Duration = Duration::from_millis(2);
/// One step of the task.
pub const STEP: Duration = Duration::from_nanos(1_000_000_000 / STEP_HZ as u64);

/// Why a trial cannot be run, or no demonstration was recorded.
#[derive(Debug, thiserror::Error)]
pub enum TrialError {
    /// The simulation.
    #[error(transparent)]
    Simulation(#[from] DriverError),
    /// The recorder.
    #[error(transparent)]
    Record(#[from] RecordError),
}

/// The rig of one trial.
#[derive(Debug)]
pub struct Lockstep {
    timeline: Timeline,
    core: Core,
    stepped: Vec<SteppedDevice>,
    trial: SharedTrial,
    mask_sequence: u64,
    now: Stamp,
    /// When the current step began; `None` until the first.
    stepping: Option<Stamp>,
    payload: Vec<u8>,
}

/// A modality: the device that runs in its slot.
#[derive(Debug)]
struct SteppedDevice {
    spec: DeviceSpec,
    running: Option<(Epoch, TaskPart)>,
    sequence: u64,
    latency: Duration,
    /// Time of its next capture, plugged in or not.
    due: Stamp,
    /// Captured samples not yet delivered, oldest first.
    transit: VecDeque<Captured>,
}

/// A sample in transit.
#[derive(Debug)]
struct Captured {
    epoch: Epoch,
    part: TaskPart,
    at: Stamp,
    payload: Vec<u8>,
}

impl Lockstep {
    /// A rig at the time `begun`, at which `scenario` begins: nothing has been sent yet. `timings` has the timings of
    /// the devices in the order of the registry; a device without one is [locked](Timing::LOCKED) to the steps.
    ///
    /// # Errors
    /// When the scenario does not belong to the simulated task.
    pub fn new(registry: &Registry, scenario: Scenario, begun: Stamp, timings: &[Timing]) -> Result<Self, DriverError> {
        let trial = scenario.devices.iter().find_map(|device| match &device.source {
            SimSource::Task { trial, .. } => Some(trial.clone()),
            _ => None,
        });
        let timings = timings.iter().copied().chain(std::iter::repeat(Timing::LOCKED));
        let device = |(spec, timing): (&DeviceSpec, Timing)| SteppedDevice {
            spec: spec.clone(),
            running: None,
            sequence: 0,
            latency: timing.latency,
            due: begun.after(timing.phase),
            transit: VecDeque::new(),
        };
        Ok(Self {
            trial: trial.ok_or_else(|| DriverError::Fatal("a scenario without the simulated task".into()))?,
            timeline: Timeline::new(scenario, begun),
            core: Core::new(registry),
            stepped: registry.devices.iter().zip(timings).map(device).collect(),
            mask_sequence: 0,
            now: begun,
            stepping: None,
            payload: Vec::new(),
        })
    }

    /// The trial.
    pub const fn trial(&self) -> &SharedTrial {
        &self.trial
    }

    /// The current virtual time.
    pub const fn now(&self) -> Stamp {
        self.now
    }

    /// The mask in force.
    pub const fn mask(&self) -> PhysicalMask {
        self.core.mask()
    }

    /// Advances a tenth of a second in which nothing moves, the mask is published, and cables are plugged and
    /// unplugged. Captures and deliveries at its end are left to [`Self::deliver`].
    ///
    /// # Errors
    /// When a picture cannot be encoded.
    pub fn rest(&mut self, taker: &mut dyn Taker) -> Result<(), DriverError> {
        let end = self.now.after(STEP);
        let mut publish = self.now;
        while self.now < end {
            if publish <= self.now {
                publish = publish.after(MASK_PERIOD);
            }
            let moments = self.stepped.iter().flat_map(SteppedDevice::moments);
            self.now = moments.fold(publish.min(end), Stamp::min).max(self.now);
            self.plug(taker);
            if publish <= self.now {
                self.publish(taker);
            }
            if self.now < end {
                self.sense(taker)?;
            }
        }
        Ok(())
    }

    /// Moves the arm for one step and advances a tenth of a second; captures during it show the arm on its way.
    ///
    /// # Errors
    /// When a picture cannot be encoded.
    pub fn step(&mut self, shake: f64, taker: &mut dyn Taker) -> Result<(), DriverError> {
        self.trial.lock().step(shake);
        self.stepping = Some(self.now);
        self.rest(taker)
    }

    /// Schedules a plug or an unplug half a step from now: between two ticks, so that the next one sees it.
    pub fn schedule(&mut self, device: &str, action: ScenarioAction) {
        self.timeline.schedule(self.now.after(STEP / 2), device, action);
    }

    /// Applies the plugs and unplugs due now, and lets every running device send the samples captured or delivered now.
    ///
    /// # Errors
    /// When a picture cannot be encoded.
    pub fn deliver(&mut self, taker: &mut dyn Taker) -> Result<(), DriverError> {
        self.plug(taker);
        self.sense(taker)
    }

    /// Takes the captures that are due, and delivers the samples whose latency has passed.
    fn sense(&mut self, taker: &mut dyn Taker) -> Result<(), DriverError> {
        let Self { stepped, trial, now, stepping, .. } = self;
        let (now, stepping) = (*now, *stepping);
        for device in &mut *stepped {
            while device.due <= now {
                let at = device.due;
                device.due = at.after(STEP);
                let Some((epoch, part)) = device.running else { continue };
                let share = stepping.map_or(1.0, |begun| at.since(begun).as_secs_f64() / STEP.as_secs_f64());
                let mut payload = Vec::new();
                trial.lock().sample_part_way(part, share, &mut payload)?;
                device.transit.push_back(Captured { epoch, part, at, payload });
            }
        }
        for index in 0..self.stepped.len() {
            while let Some(device) = self.stepped.get_mut(index) {
                let Some(sample) = device.seen_by(now) else { break };
                let header = header(device, &sample);
                device.sequence += 1;
                let id = device.spec.id;
                taker.receive(TopicId::Modality(id), &header, &sample.payload);
                if self.core.state(id).0 == DeviceState::Opening {
                    self.apply(Input::Stream { id, epoch: sample.epoch, event: StreamEvent::Started }, taker);
                }
            }
        }
        Ok(())
    }

    /// Gives the arm its action from now on, as a policy does on the topic of actions at tick `number` of its control
    /// grid.
    pub fn act(&mut self, number: u64, action: [f64; AXES], taker: &mut dyn Taker) {
        self.trial.lock().command(action);
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
        taker.receive(TopicId::Action, &header, &self.payload);
    }

    /// Applies the plugs and unplugs up to now, and the deadlines that have passed.
    fn plug(&mut self, taker: &mut dyn Taker) {
        while let Some(event) = self.timeline.next_by(self.now) {
            self.apply(Input::Hotplug(event), taker);
        }
        self.apply(Input::Timer, taker);
    }

    /// Runs one step of the core and carries out its effects.
    fn apply(&mut self, input: Input, taker: &mut dyn Taker) {
        let mut effects = Vec::new();
        self.core.step(input, self.now, &mut effects);
        for effect in effects {
            match effect {
                Effect::Publish(_) => self.publish(taker),
                Effect::Device(id, effect) => {
                    if let Some(what) = self.carry_out(id, effect) {
                        taker.event(&Event { stamp: self.now, what });
                    }
                }
                Effect::Unused { .. } | Effect::WrongNode { .. } => {}
            }
        }
    }

    /// Carries out one effect and returns the event to announce.
    fn carry_out(&mut self, id: ModalityId, effect: DeviceEffect) -> Option<EventKind> {
        let devices = self.stepped.len();
        let stepped = self.stepped.iter_mut().find(|stepped| stepped.spec.id == id)?;
        let (device, bit) = (stepped.spec.name.clone(), id);
        Some(match effect {
            DeviceEffect::Stop => {
                stepped.running = None;
                stepped.transit.clear();
                return None;
            }
            DeviceEffect::Start(epoch, attachment) => {
                let provenance = Box::new(stepped.start(epoch, &attachment, self.core.attached_at(id))?);
                EventKind::Opened { device, bit, provenance }
            }
            DeviceEffect::AnnounceAttach => {
                let Attachment { node, unit, driver, .. } = self.core.attached(id)?;
                EventKind::Attach {
                    device,
                    bit,
                    node: node.label(),
                    unit: unit.clone(),
                    driver: driver.as_deref().cloned(),
                }
            }
            DeviceEffect::AnnounceDetach(source) => EventKind::Detach { device, bit, source },
            DeviceEffect::State(transition) => {
                let mask = SizedMask { mask: self.core.mask(), devices };
                EventKind::State { device, bit, state: transition.to, mask, detail: String::new() }
            }
            DeviceEffect::Ended | DeviceEffect::Plugged | DeviceEffect::Unplugged => return None,
        })
    }

    fn publish(&mut self, taker: &mut dyn Taker) {
        self.mask_sequence += 1;
        let payload = self.core.bits().payload(self.mask_sequence);
        let header = SampleHeader {
            seq: self.mask_sequence,
            capture_ns: self.now.0,
            recv_ns: self.now.0,
            encoding: Encoding::Mask as u32,
            ..SampleHeader::default()
        };
        taker.receive(TopicId::Mask, &header, &payload);
    }
}

impl SteppedDevice {
    /// Opens the attached part of the simulated task; `None` for a device of another kind.
    fn start(&mut self, epoch: Epoch, attachment: &Attachment, attached: Stamp) -> Option<Provenance> {
        let DeviceNode::Sim(device) = &attachment.node else { return None };
        let SimSource::Task { part, .. } = device.source else { return None };
        self.running = Some((epoch, part));
        let (driver, bus) = (attachment.driver.as_deref().cloned(), Some(format!("sim:{}", device.name)));
        Some(Provenance {
            epoch,
            node: attachment.node.label(),
            attached,
            unit: attachment.unit.clone(),
            negotiated: Negotiated { driver, bus, ..Negotiated::default() },
            latency_ns: nanoseconds(self.spec.latency),
        })
    }

    /// The times of its next capture and next delivery.
    fn moments(&self) -> impl Iterator<Item = Stamp> {
        let seen = self.transit.front().map(|sample| sample.at.after(self.latency));
        std::iter::once(self.due).chain(seen)
    }

    /// The oldest sample in transit that is delivered by `now`.
    fn seen_by(&mut self, now: Stamp) -> Option<Captured> {
        let seen = self.transit.front().is_some_and(|sample| sample.at.after(self.latency) <= now);
        if seen { self.transit.pop_front() } else { None }
    }
}

fn header(device: &SteppedDevice, sample: &Captured) -> SampleHeader {
    let (encoding, width, height) = task::layout(sample.part);
    SampleHeader {
        seq: device.sequence,
        lost: 0,
        capture_ns: sample.at.0,
        recv_ns: sample.at.after(device.latency).0,
        id: u32::from(device.spec.id.bit()),
        epoch: sample.epoch.0,
        encoding: encoding as u32,
        flags: FLAG_DEVICE_TIME,
        width,
        height,
    }
}
