//! Random hot-plug events, stream reports and time against the core; its invariants are checked after each step.
//!
//! A seed determines a whole run. A failing seed is printed with the command that replays it step by step:
//! `RAPID_SEED=17 cargo test --workspace --lib rig::core::tests::simulator -- --nocapture`

use std::path::PathBuf;

use rapid_core::random::Random;
use rapid_registry::device::{DeviceNode, UsbIdentity};

use super::super::*;

const SEEDS: u64 = 1000;
const STEPS: u64 = 1000;
const SECOND: Duration = Duration::from_secs(1);
const HOUR: Duration = Duration::from_hours(1);

/// Entries by serial number, by port, two interchangeable ones, and both nodes of one device; bits with gaps.
const REGISTRY: &str = r#"
    [device.by_serial]
    vid = "0001"
    pid = "0001"
    serial = "A"
    node = "camera"
    bit = 0
    [device.by_port]
    vid = "0001"
    pid = "0001"
    port = "1-9"
    node = "camera"
    bit = 5
    [device.any_low]
    vid = "0002"
    pid = "0002"
    node = "camera"
    bit = 17
    [device.any_high]
    vid = "0002"
    pid = "0002"
    node = "camera"
    bit = 31
    [device.both_camera]
    vid = "0003"
    pid = "0003"
    serial = "C"
    node = "camera"
    bit = 40
    [device.both_tty]
    vid = "0003"
    pid = "0003"
    serial = "C"
    node = "serial"
    bit = 63
    [device.both_tty.tty]
    channels = 1
"#;
/// Indices of the two interchangeable entries.
const POOL: [usize; 2] = [2, 3];
/// Models and serial numbers of the units: three for the two interchangeable entries, one that no entry matches.
const UNITS: [(u16, Option<&str>); 7] =
    [(1, Some("A")), (1, None), (2, None), (2, Some("x")), (2, Some("x")), (3, Some("C")), (9, None)];
/// Hub and port.
const PORTS: [(&str, &str); 5] = [("1", "1-1"), ("1", "1-2"), ("1", "1-9"), ("2", "2-1"), ("2", "2-2")];

/// The accumulated effects on one modality.
#[derive(Debug)]
struct Model {
    id: ModalityId,
    state: DeviceState,
    running: Option<Epoch>,
    newest: Epoch,
    /// The newest announcement was an attachment.
    is_announced: bool,
    is_plugged: bool,
    absent_since: Option<Stamp>,
}

/// What the runs reached, so that they cannot pass by doing nothing.
#[derive(Debug, Default)]
struct Reached {
    starts: u64,
    bits_set: u64,
    bits_cleared: u64,
    failures: u64,
    promotions: u64,
}

struct Storm {
    random: Random,
    now: Stamp,
    core: Core,
    cooldown: Duration,
    effects: Vec<Effect>,
    models: Vec<Model>,
    /// Which unit is in each port.
    ports: [Option<usize>; PORTS.len()],
    /// Events in transit.
    pending: Vec<HotplugEvent>,
    reached: Reached,
    is_shown: bool,
}

#[test]
fn a_million_random_steps_keep_every_invariant() {
    let registry = Registry::parse(REGISTRY, None).expect("a registry").registry;
    let wanted = std::env::var("RAPID_SEED").ok().map(|seed| seed.parse::<u64>().expect("a number in RAPID_SEED"));
    let seeds = wanted.map_or(0..SEEDS, |seed| seed..seed + 1);
    let mut reached = Reached::default();
    for seed in seeds {
        let mut storm = Storm::new(&registry, seed, wanted.is_some());
        if let Err((step, why)) = storm.play() {
            panic!(
                "seed {seed}, step {step}: {why}\nplay it again: RAPID_SEED={seed} cargo test --workspace --lib \
                 rig::core::tests::simulator -- --nocapture"
            );
        }
        reached.add(&storm.reached);
    }
    let Reached { starts, bits_set, bits_cleared, failures, promotions } = reached;
    let least = if wanted.is_some() { 0 } else { SEEDS };
    assert!([starts, bits_set, bits_cleared, failures, promotions].iter().all(|count| *count >= least), "{reached:?}");
}

impl Reached {
    fn add(&mut self, other: &Self) {
        self.starts += other.starts;
        self.bits_set += other.bits_set;
        self.bits_cleared += other.bits_cleared;
        self.failures += other.failures;
        self.promotions += other.promotions;
    }
}

impl Storm {
    fn new(registry: &Registry, seed: u64, is_shown: bool) -> Self {
        let mut registry = registry.clone();
        registry.rig.cooldown = if seed.is_multiple_of(4) { Duration::ZERO } else { 2 * SECOND };
        let model = |id| Model {
            id,
            state: DeviceState::Absent,
            running: None,
            newest: Epoch(0),
            is_announced: false,
            is_plugged: false,
            absent_since: None,
        };
        Self {
            random: Random::new(seed, 0),
            now: Stamp(1_000_000_000_000),
            core: Core::new(&registry),
            cooldown: registry.rig.cooldown,
            effects: Vec::new(),
            models: registry.devices.iter().map(|device| model(device.id)).collect(),
            ports: [None; PORTS.len()],
            pending: Vec::new(),
            reached: Reached::default(),
            is_shown,
        }
    }

    /// The whole run and the calm phase after it; on failure the step and the violation.
    fn play(&mut self) -> Result<(), (u64, String)> {
        for step in 0..STEPS {
            self.pass_time();
            let input = self.draw();
            self.step(&input).map_err(|why| (step, why))?;
        }
        self.calm().map_err(|why| (STEPS, why))
    }

    /// Everything is unplugged; then one device is plugged in as usual.
    fn calm(&mut self) -> Result<(), String> {
        self.step(&Input::Hotplug(removed("/sys", UnplugSource::Enumeration, self.now)))?;
        for model in &self.models {
            let is_empty = model.state == DeviceState::Absent && !model.is_announced && !model.is_plugged;
            ensure(is_empty, || format!("not empty after everything was unplugged: {model:?}"))?;
        }
        ensure(self.core.mask() == PhysicalMask::EMPTY, || "the mask is not empty at the end".to_owned())?;
        self.now = self.now.after(HOUR);
        self.step(&Input::Timer)?;
        ensure(self.effects.is_empty(), || "something starts by itself".to_owned())?;
        for attachment in attachments(0, 0) {
            self.step(&Input::Hotplug(HotplugEvent::Added(attachment)))?;
        }
        let Some(Model { id, running: Some(epoch), .. }) = self.models.first() else {
            return Err("a device is not started after the storm".to_owned());
        };
        let (id, epoch) = (*id, *epoch);
        self.step(&Input::Stream { id, epoch, event: StreamEvent::Opened })?;
        self.step(&Input::Stream { id, epoch, event: StreamEvent::Started })?;
        ensure(self.core.mask() == PhysicalMask::EMPTY.with(id, true), || "its bit is not set".to_owned())
    }

    fn one_in(&mut self, count: u64) -> bool {
        self.random.below(count) == 0
    }

    fn pick(&mut self, count: usize) -> usize {
        usize::try_from(self.random.below(count as u64)).unwrap_or(0)
    }

    /// Time advances evenly, to a deadline, in a jump, or backwards.
    fn pass_time(&mut self) {
        self.now = match self.random.below(100) {
            0..3 => self.now.before(Duration::from_millis(self.random.below(50))),
            3 => self.now.after(HOUR),
            4..10 => self.now.after(self.cooldown),
            10..25 => self.core.deadline().unwrap_or(self.now).max(self.now),
            _ => self.now.after(Duration::from_millis(self.random.below(200))),
        };
    }

    fn draw(&mut self) -> Input {
        let kind = self.random.below(100);
        match kind {
            0..14 => self.plug(),
            14..24 => self.unplug(),
            24..26 => {
                let (hub, _) = PORTS[self.pick(PORTS.len())];
                for (port, unit) in PORTS.iter().zip(&mut self.ports) {
                    *unit = unit.filter(|_| port.0 != hub);
                }
                self.send(removed(&format!("/sys/{hub}"), UnplugSource::Kernel, self.now));
            }
            _ => {}
        }
        if !self.pending.is_empty() && (kind < 26 || self.one_in(4)) {
            // Mostly in order.
            let index = if self.one_in(4) { self.pick(self.pending.len()) } else { 0 };
            return Input::Hotplug(self.pending.remove(index));
        }
        match kind {
            0..80 => self.stream(),
            80..84 => Input::Restart(self.any_id()),
            _ => Input::Timer,
        }
    }

    fn any_id(&mut self) -> ModalityId {
        let index = self.pick(self.models.len() + 1);
        // A modality that no entry has.
        self.models.get(index).map_or(ModalityId::new(50).expect("below 64"), |model| model.id)
    }

    fn plug(&mut self) {
        let (unit, port) = (self.pick(UNITS.len()), self.pick(PORTS.len()));
        // The removals of the unit in that port, and of this unit from its previous port, are missed.
        for (other, plugged) in self.ports.iter_mut().enumerate() {
            *plugged = if other == port { Some(unit) } else { plugged.filter(|plugged| *plugged != unit) };
        }
        for attachment in attachments(unit, port) {
            self.send(HotplugEvent::Added(attachment));
        }
    }

    fn unplug(&mut self) {
        let port = self.pick(PORTS.len());
        self.ports[port] = None;
        let path = format!("/sys/{}/{}", PORTS[port].0, PORTS[port].1);
        let sources = [UnplugSource::Kernel, UnplugSource::Udev, UnplugSource::Enumeration];
        let source = sources[self.pick(sources.len())];
        self.send(removed(&path, source, self.now));
    }

    /// An event may be lost or duplicated.
    fn send(&mut self, event: HotplugEvent) {
        match self.random.below(10) {
            0 => {}
            1 => self.pending.extend([event.clone(), event]),
            _ => self.pending.push(event),
        }
    }

    /// A report of the running stream, or of one that ended long ago.
    fn stream(&mut self) -> Input {
        let id = self.any_id();
        let model = self.models.iter().find(|model| model.id == id);
        let (running, newest) = model.map_or((None, Epoch(1)), |model| (model.running, model.newest));
        let old = Epoch(u32::try_from(self.random.below(u64::from(newest.0) + 2)).unwrap_or(0));
        let epoch = if self.one_in(6) { old } else { running.unwrap_or(old) };
        let event = match self.random.below(16) {
            0..2 => StreamEvent::LinkDown,
            2..4 => StreamEvent::Opened,
            4..8 => StreamEvent::Started,
            8..10 => StreamEvent::Stalled,
            10..12 => StreamEvent::Resumed,
            12 => StreamEvent::Ended(End::Gone),
            13 => StreamEvent::Ended(End::LinkDown),
            14 => StreamEvent::Ended(End::Retry),
            _ => StreamEvent::Ended(if self.one_in(4) { End::Fatal } else { End::Retry }),
        };
        Input::Stream { id, epoch, event }
    }

    fn step(&mut self, input: &Input) -> Result<(), String> {
        let before = self.core.bits();
        self.effects.clear();
        self.core.step(input.clone(), self.now, &mut self.effects);
        if self.is_shown {
            println!("{:?} {input:?}\n    {:?}", self.now, self.effects);
        }
        self.check_input(input, before.mask)?;
        self.check_effects(before)?;
        self.check_state(input)
    }

    /// What this input may change at all. The models still hold the state before the step.
    fn check_input(&self, input: &Input, before: PhysicalMask) -> Result<(), String> {
        let set = self.core.mask().0 & !before.0;
        let mut allowed = 0;
        if let Input::Stream { id, epoch, event } = input {
            let running = self.models.iter().find(|model| model.id == *id).and_then(|model| model.running);
            let is_current = running == Some(*epoch);
            ensure(is_current || self.effects.is_empty(), || format!("{input:?} of no running stream has effects"))?;
            if is_current && *event == StreamEvent::Started {
                allowed = PhysicalMask::EMPTY.with(*id, true).0;
            }
            if is_current && matches!(event, StreamEvent::Ended(_)) {
                ensure(!self.core.mask().contains(*id), || format!("the bit of {id} outlives its stream"))?;
            }
        }
        ensure(set & !allowed == 0, || format!("{input:?} sets bits {set:#x}"))
    }

    /// Checks the effects in order.
    fn check_effects(&mut self, before: Bits) -> Result<(), String> {
        let bits = self.core.bits();
        let publishes = matches!(self.effects.first(), Some(Effect::Publish(published)) if *published == bits);
        ensure(publishes == (bits != before), || format!("{before:?} to {bits:?}, first {:?}", self.effects.first()))?;
        let (mask, before) = (bits.mask, before.mask);
        self.reached.bits_set += u64::from((mask.0 & !before.0).count_ones());
        self.reached.bits_cleared += u64::from((before.0 & !mask.0).count_ones());
        for (index, effect) in self.effects.iter().enumerate() {
            let (id, effect) = match effect {
                Effect::Publish(_) => {
                    ensure(index == 0, || "the mask is published late".to_owned())?;
                    continue;
                }
                Effect::Unused { .. } | Effect::WrongNode { .. } => continue,
                Effect::Device(id, effect) => (*id, effect),
            };
            let Some(model) = self.models.iter_mut().find(|model| model.id == id) else {
                return Err(format!("an effect for {id}, which no entry has"));
            };
            model
                .apply(effect, self.now, self.cooldown)
                .map_err(|why| format!("{why}: effect {index} {effect:?} of {model:?}"))?;
            match effect {
                DeviceEffect::Start(..) => self.reached.starts += 1,
                DeviceEffect::State(Transition { to: DeviceState::Failed, .. }) => self.reached.failures += 1,
                DeviceEffect::Unplugged => {
                    let plugs = |effect: &Effect| matches!(effect, Effect::Device(_, DeviceEffect::Plugged));
                    self.reached.promotions += u64::from(self.effects.iter().any(plugs));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// What holds between two steps.
    fn check_state(&self, input: &Input) -> Result<(), String> {
        for model in &self.models {
            let id = model.id;
            let Some(modality) = self.core.modality(id) else { return Err(format!("no modality {id}")) };
            let attached = modality.lifecycle.attached();
            let (state, epoch) = self.core.state(id);
            ensure(state == model.state, || format!("{id} is {state:?}, announced as {:?}", model.state))?;
            let runs = matches!(state, DeviceState::Opening | DeviceState::Streaming | DeviceState::Stalled);
            ensure(model.running == runs.then_some(epoch), || format!("{id} is {state:?} {epoch:?}, {model:?}"))?;
            let is_present = matches!(state, DeviceState::Streaming | DeviceState::Stalled);
            ensure(self.core.mask().contains(id) == is_present, || format!("the bit of {id}, which is {state:?}"))?;
            ensure(attached.is_some() || state == DeviceState::Absent, || format!("{id} is {state:?}, not attached"))?;
            ensure(attached.is_some() == model.is_plugged, || format!("hooks of {id}: {model:?}"))?;
            ensure(attached.is_some() || !model.is_announced, || format!("{id} was not announced as detached"))?;
            let is_plugged = is_present || model.is_announced;
            ensure(self.core.bits().plugged.contains(id) == is_plugged, || {
                format!("{id} is plugged in or not: {model:?}")
            })?;
            // Every waiting state has a deadline.
            let waits = state == DeviceState::Backoff || state == DeviceState::Absent && attached.is_some();
            let deadline = modality.lifecycle.deadline();
            ensure(waits == deadline.is_some(), || format!("{id} is {state:?} with deadline {deadline:?}"))?;
            let is_due = deadline.is_some_and(|deadline| deadline <= self.now);
            ensure(*input != Input::Timer || !is_due, || format!("the deadline of {id} was ignored"))?;
            if let Input::Hotplug(event) = input {
                self.check_assignment(model, attached, event)?;
            }
        }
        Ok(())
    }

    fn check_assignment(
        &self,
        model: &Model,
        attached: Option<&Attachment>,
        event: &HotplugEvent,
    ) -> Result<(), String> {
        let id = model.id;
        let assigned = self.core.assigner.attached_as(id);
        ensure(attached == assigned, || format!("{id} has {attached:?}, the assigner {assigned:?}"))?;
        let Some(attached) = attached else { return Ok(()) };
        if let HotplugEvent::Removed { syspath, .. } = event {
            ensure(!attached.is_under(syspath), || format!("{id} keeps what was removed: {attached:?}"))?;
        }
        for other in self.models.iter().filter(|other| other.id > id) {
            let Some(second) = self.core.attached(other.id) else { continue };
            ensure(attached.syspath != second.syspath, || format!("{id} and {} share a node", other.id))?;
            let is_pool = POOL.iter().all(|index| [id, other.id].contains(&self.models[*index].id));
            ensure(!is_pool || attached.unit != second.unit, || format!("{id} and {} share a unit", other.id))?;
        }
        Ok(())
    }
}

impl Model {
    fn apply(&mut self, effect: &DeviceEffect, now: Stamp, cooldown: Duration) -> Result<(), String> {
        match effect {
            DeviceEffect::Stop => ensure(self.running.is_some(), || "nothing runs".to_owned()),
            DeviceEffect::Ended => ensure(self.running.take().is_some(), || "nothing ran".to_owned()),
            DeviceEffect::AnnounceAttach => {
                self.is_announced = true;
                Ok(())
            }
            DeviceEffect::AnnounceDetach(_) => {
                ensure(std::mem::take(&mut self.is_announced), || "detached twice".to_owned())
            }
            DeviceEffect::Plugged => {
                self.is_plugged = true;
                Ok(())
            }
            DeviceEffect::Unplugged => {
                ensure(std::mem::take(&mut self.is_plugged), || "its hooks ended twice".to_owned())
            }
            DeviceEffect::Start(epoch, _) => {
                ensure(self.running.is_none(), || "two streams run".to_owned())?;
                ensure(self.is_plugged, || "started without an attachment".to_owned())?;
                ensure(*epoch > self.newest, || "its epoch is not a new one".to_owned())?;
                let ready = self.absent_since.map_or(now, |since| since.after(cooldown));
                ensure(now >= ready, || "started within its cooldown".to_owned())?;
                (self.running, self.newest) = (Some(*epoch), *epoch);
                Ok(())
            }
            DeviceEffect::State(Transition { from, to, wait, source }) => {
                ensure(*from == self.state, || "it was in another state".to_owned())?;
                ensure(wait.is_some() == (*to == DeviceState::Backoff), || "how long it waits".to_owned())?;
                ensure(source.is_some() == (*to == DeviceState::Absent), || "what noticed the removal".to_owned())?;
                if *to == DeviceState::Absent {
                    self.absent_since = Some(now);
                }
                self.state = *to;
                Ok(())
            }
        }
    }
}

fn ensure(holds: bool, why: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(why()) }
}

fn removed(path: &str, source: UnplugSource, noticed: Stamp) -> HotplugEvent {
    HotplugEvent::Removed { syspath: PathBuf::from(path), noticed, source }
}

/// The nodes of a unit in a port: a camera, and for the unit with two nodes a serial line as well.
fn attachments(unit: usize, port: usize) -> Vec<Attachment> {
    let ((model, serial), (hub, port)) = (UNITS[unit], PORTS[port]);
    let usb = UsbIdentity {
        vid: model,
        pid: model,
        serial: serial.map(str::to_owned),
        port: port.to_owned(),
        ..UsbIdentity::default()
    };
    let path = PathBuf::from(format!("/sys/{hub}/{port}"));
    let attachment = |node: DeviceNode, name| Attachment {
        syspath: path.join(name),
        node,
        unit: usb.clone().into(),
        driver: None,
        formats: Vec::new(),
    };
    let mut nodes = vec![attachment(DeviceNode::Video("/dev/video0".into()), "video")];
    if model == 3 {
        nodes.push(attachment(DeviceNode::Tty("/dev/ttyACM0".into()), "tty"));
    }
    nodes
}
