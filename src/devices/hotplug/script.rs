//! A scenario played as hot-plug events.

use std::collections::{HashMap, VecDeque};
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use futures::Stream;
use rapid_core::time::Stamp;
use rapid_registry::device::{Attachment, DeviceNode, Unit};
use rapid_registry::scenario::{Scenario, ScenarioAction, ScenarioDevice, ScenarioEvent};
use rapid_registry::simulation::{self, SimDevice};
use tokio::sync::mpsc;
use tokio::time::{Instant, Sleep, sleep_until};

use super::{HotplugError, HotplugEvent, UnplugSource};

/// Plays a [`Scenario`] on tokio's clock, from the moment it is created.
#[derive(Debug)]
pub struct Script {
    timeline: Timeline,
    begin: Instant,
    timer: Pin<Box<Sleep>>,
    /// Names of devices that a person plugs in, or unplugs.
    requests: Option<mpsc::UnboundedReceiver<String>>,
}

impl Script {
    /// Starts: devices plugged in at the start are reported at once.
    pub fn new(scenario: Scenario) -> Self {
        let begin = Instant::now();
        let timer = Box::pin(sleep_until(begin));
        Self { timeline: Timeline::new(scenario, Stamp::now()), begin, timer, requests: None }
    }

    /// Likewise; besides, each device named by `requests` is unplugged, or plugged in again, at once.
    pub fn with_requests(scenario: Scenario, requests: mpsc::UnboundedReceiver<String>) -> Self {
        Self { requests: Some(requests), ..Self::new(scenario) }
    }

    /// Carries out what was requested so far.
    fn toggle_requested(&mut self, context: &mut Context<'_>) {
        while let Some(requests) = &mut self.requests {
            match requests.poll_recv(context) {
                Poll::Ready(Some(name)) => self.timeline.toggle(&name, Stamp::now()),
                Poll::Ready(None) => self.requests = None,
                Poll::Pending => return,
            }
        }
    }
}

/// The events of a [`Scenario`] in order, for a caller that keeps the time.
#[derive(Debug)]
pub struct Timeline {
    devices: Vec<ScenarioDevice>,
    plugged: HashMap<String, (PathBuf, Arc<SimDevice>)>,
    /// The counter of an unplugged device: it continues when the device is plugged in again.
    sequences: HashMap<String, u32>,
    events: Vec<ScenarioEvent>,
    next: usize,
    /// When the current round of events began, relative to the scenario's beginning.
    round: Duration,
    repeat: Option<Duration>,
    begun: Stamp,
    queue: VecDeque<HotplugEvent>,
}

impl Timeline {
    /// The scenario's beginning, at `begun`: the first events report what is plugged in then.
    pub fn new(scenario: Scenario, begun: Stamp) -> Self {
        let mut timeline = Self {
            devices: scenario.devices,
            plugged: HashMap::new(),
            sequences: HashMap::new(),
            events: scenario.events,
            next: 0,
            round: Duration::ZERO,
            repeat: scenario.repeat,
            begun,
            queue: VecDeque::new(),
        };
        for device in timeline.devices.iter().filter(|d| d.plugged).map(|d| d.name.clone()).collect::<Vec<_>>() {
            timeline.plug(&device, None);
        }
        timeline
    }

    /// Adds an event at the moment `at`, after those that are due by then. Only for a scenario that does not repeat.
    pub fn schedule(&mut self, at: Stamp, device: &str, action: ScenarioAction) {
        let event = ScenarioEvent { at: at.since(self.begun), device: device.to_owned(), action };
        let left = self.events.get(self.next..).unwrap_or_default();
        let place = self.next + left.partition_point(|other| other.at <= event.at);
        self.events.insert(place, event);
    }

    /// The next event that has happened by `now`, which may be in the past.
    pub fn next_by(&mut self, now: Stamp) -> Option<HotplugEvent> {
        loop {
            if let Some(event) = self.queue.pop_front() {
                return Some(event);
            }
            if self.begun.after(self.due()?) > now {
                return None;
            }
            let event = self.events.get(self.next)?.clone();
            self.next += 1;
            self.play(&event, now);
        }
    }

    fn play(&mut self, event: &ScenarioEvent, now: Stamp) {
        match &event.action {
            ScenarioAction::Plug { port } => self.plug(&event.device, port.as_deref()),
            ScenarioAction::Unplug => self.unplug(&event.device, now),
            ScenarioAction::Silence => self.set_silent(&event.device, true),
            ScenarioAction::Resume => self.set_silent(&event.device, false),
        }
    }

    fn plug(&mut self, name: &str, port: Option<&str>) {
        let Some(device) = self.devices.iter_mut().find(|device| device.name == name) else { return };
        if self.plugged.contains_key(name) {
            return;
        }
        if let Some(port) = port {
            port.clone_into(&mut device.usb.port);
        }
        let (attachment, sim) = attachment(device, self.begun);
        sim.sequence.store(self.sequences.get(name).copied().unwrap_or(0), Ordering::Relaxed);
        self.plugged.insert(name.to_owned(), (attachment.syspath.clone(), sim));
        self.queue.push_back(HotplugEvent::Added(attachment));
    }

    fn unplug(&mut self, name: &str, now: Stamp) {
        let Some((syspath, sim)) = self.plugged.remove(name) else { return };
        sim.unplug();
        self.sequences.insert(name.to_owned(), sim.sequence.load(Ordering::Relaxed));
        self.queue.push_back(HotplugEvent::Removed { syspath, noticed: now, source: UnplugSource::Scenario });
    }

    /// Unplugs a device, or plugs it in where it was last.
    fn toggle(&mut self, name: &str, now: Stamp) {
        if self.plugged.contains_key(name) {
            self.unplug(name, now);
        } else if self.devices.iter().any(|device| device.name == name) {
            self.plug(name, None);
        } else {
            tracing::warn!(device = name, "the scenario has no device of this name");
        }
    }

    fn set_silent(&self, name: &str, silent: bool) {
        if let Some((_, sim)) = self.plugged.get(name) {
            sim.set_silent(silent);
        }
    }

    /// When the next event is due, relative to the beginning; `None` when the scenario has ended.
    fn due(&mut self) -> Option<Duration> {
        if self.next == self.events.len() {
            let repeat = self.repeat.filter(|_| !self.events.is_empty())?;
            self.round += repeat;
            self.next = 0;
        }
        Some(self.round + self.events.get(self.next)?.at)
    }
}

/// The devices plugged in when a scenario begins.
pub fn attached(scenario: &Scenario) -> Vec<Attachment> {
    let begun = Stamp::now();
    scenario.devices.iter().filter(|device| device.plugged).map(|device| attachment(device, begun).0).collect()
}

/// The attachment of a device plugged in now, and its cable.
fn attachment(device: &ScenarioDevice, begun: Stamp) -> (Attachment, Arc<SimDevice>) {
    let sim = Arc::new(SimDevice::new(&device.name, device.source.clone(), begun).with_faults(device.faults));
    // The streams of a camera are at one port.
    let syspath = PathBuf::from("/sim").join(&device.usb.port).join(&device.name);
    let unit = device.lan.clone().map_or_else(|| Unit::Usb(device.usb.clone()), Unit::Lan);
    let node = DeviceNode::Sim(Arc::clone(&sim));
    (Attachment { syspath, node, unit, driver: Some(Box::new(simulation::driver())), formats: Vec::new() }, sim)
}

impl Stream for Script {
    type Item = Result<HotplugEvent, HotplugError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.toggle_requested(context);
        loop {
            if let Some(event) = self.timeline.queue.pop_front() {
                return Poll::Ready(Some(Ok(event)));
            }
            // The stream of a finished scenario stays open without events, like that of a machine whose devices do not
            // change.
            let Some(due) = self.timeline.due() else { return Poll::Pending };
            let due = self.begin + due;
            self.timer.as_mut().reset(due);
            ready!(self.timer.as_mut().poll(context));
            let event = self.timeline.events[self.timeline.next].clone();
            self.timeline.next += 1;
            self.timeline.play(&event, Stamp::now());
        }
    }
}

#[cfg(test)]
mod tests {
    use rapid_registry::device::UsbIdentity;
    use rapid_registry::simulation::{SimFaults, SimSource};

    use super::*;
    use futures::StreamExt;

    fn device(name: &str, port: &str, plugged: bool) -> ScenarioDevice {
        ScenarioDevice {
            name: name.into(),
            usb: UsbIdentity { vid: 1, pid: 2, serial: None, port: port.into(), ..UsbIdentity::default() },
            lan: None,
            source: SimSource::Serial { channels: 1, hz: 100, seed: 1 },
            plugged,
            faults: SimFaults::default(),
        }
    }

    fn event(at: u64, device: &str, action: ScenarioAction) -> ScenarioEvent {
        ScenarioEvent { at: Duration::from_millis(at), device: device.into(), action }
    }

    fn word(event: &HotplugEvent) -> String {
        match event {
            HotplugEvent::Added(attachment) => format!("+{}", attachment.unit.place()),
            HotplugEvent::Removed { syspath, .. } => format!("-{}", syspath.display()),
        }
    }

    #[tokio::test(start_paused = true)]
    async fn requests_unplug_and_plug_in_between_the_events_of_the_scenario() {
        let (sender, requested) = mpsc::unbounded_channel();
        let devices = vec![device("a", "1-1", true), device("b", "1-2", false)];
        let events = vec![event(100, "a", ScenarioAction::Unplug)];
        let mut script = Script::with_requests(Scenario { devices, events, repeat: None }, requested);
        assert_eq!(word(&script.next().await.expect("open").expect("an event")), "+1-1");
        for (name, expected) in [("b", "+1-2"), ("b", "-/sim/1-2/b"), ("a", "-/sim/1-1/a"), ("a", "+1-1")] {
            sender.send(name.to_owned()).expect("it listens");
            assert_eq!(word(&script.next().await.expect("open").expect("an event")), expected);
        }
        sender.send("nosuch".to_owned()).expect("it listens");
        drop(sender);
        assert_eq!(
            word(&script.next().await.expect("open").expect("an event")),
            "-/sim/1-1/a",
            "the scenario continues"
        );
    }

    #[tokio::test(start_paused = true)]
    async fn events_come_in_order_at_their_times_and_repeat() {
        let begin = Instant::now();
        let mut script = Script::new(Scenario {
            devices: vec![device("a", "1-1", true), device("b", "1-2", false)],
            events: vec![
                event(100, "a", ScenarioAction::Unplug),
                event(100, "b", ScenarioAction::Plug { port: None }),
                event(300, "a", ScenarioAction::Plug { port: Some("1-3".into()) }),
                event(350, "b", ScenarioAction::Unplug),
            ],
            repeat: Some(Duration::from_secs(1)),
        });
        let mut got = Vec::new();
        for _ in 0..7 {
            let event = script.next().await.expect("endless").expect("no error");
            got.push(format!("{}@{}", word(&event), begin.elapsed().as_millis()));
        }
        assert_eq!(
            got,
            ["+1-1@0", "-/sim/1-1/a@100", "+1-2@100", "+1-3@300", "-/sim/1-2/b@350", "-/sim/1-3/a@1100", "+1-2@1100"]
        );
    }

    #[tokio::test(start_paused = true)]
    async fn an_unplugged_simulated_device_falls_silent_at_once() {
        let mut script = Script::new(Scenario {
            devices: vec![device("a", "1-1", true)],
            events: vec![event(5, "a", ScenarioAction::Silence), event(10, "a", ScenarioAction::Unplug)],
            repeat: None,
        });
        let Some(Ok(HotplugEvent::Added(attachment))) = script.next().await else { panic!("no device") };
        let DeviceNode::Sim(sim) = attachment.node else { panic!("not simulated") };
        assert!(!sim.is_silent() && !sim.is_unplugged());
        assert!(matches!(script.next().await, Some(Ok(HotplugEvent::Removed { .. }))));
        assert!(sim.is_silent() && sim.is_unplugged());
    }
}
