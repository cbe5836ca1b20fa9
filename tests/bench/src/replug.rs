//! Time from a plug to the first recorded sample on the simulated rig: the program's share. The share of the kernel and
//! of a real device before that is measured on the virtual bench.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use futures::Stream;
use rapid_bus::TopicId;
use rapid_core::sample::Epoch;
use rapid_core::time::Stamp;
use rapid_devices::driver::Driver;
use rapid_devices::hotplug::script::Script;
use rapid_devices::hotplug::{HotplugError, HotplugEvent};
use rapid_registry::device::DeviceNode;
use rapid_registry::scenario::{ScenarioAction, ScenarioEvent};
use rapid_registry::simulation::SimDevice;

use crate::feed;
use crate::figure::Figure;
use crate::frame::play;
use crate::stats::Sorted;
use crate::{Bench, Failure};

/// Time from one plug to the next.
const ROUND: Duration = Duration::from_millis(100);
const UNPLUGGED: Duration = Duration::from_millis(50);
/// The device that is unplugged: it needs almost no time to open and send its first sample.
const DEVICE: &str = "state";

/// Reports when a plug event passes on its way to the rig.
struct Tap {
    script: Script,
    plugs: Sender<Stamp>,
}

impl Stream for Tap {
    type Item = Result<HotplugEvent, HotplugError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let polled = Pin::new(&mut self.script).poll_next(context);
        if let Poll::Ready(Some(Ok(HotplugEvent::Added(_)))) = &polled {
            // Read after the run.
            let _ = self.plugs.send(Stamp::now());
        }
        polled
    }
}

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let rounds = bench.choose(200, 20);
    let (mut registry, mut scenario) = feed::rig()?;
    registry.rig.cooldown = Duration::ZERO;
    let bit = registry.named(DEVICE).ok_or("the load has no such device")?.id;
    scenario.devices.retain(|device| device.name == DEVICE);
    let event = |at, action| ScenarioEvent { at, device: DEVICE.to_owned(), action };
    scenario.events = vec![
        event(ROUND - UNPLUGGED, ScenarioAction::Unplug),
        event(ROUND - UNPLUGGED / 10, ScenarioAction::Plug { port: None }),
    ];
    scenario.repeat = Some(ROUND);
    let source = scenario.devices.first().ok_or("the scenario has no such device")?.source.clone();

    let (plugs, plugged) = channel();
    let script =
        move || Box::pin(Tap { script: Script::new(scenario), plugs }) as rapid_devices::hotplug::HotplugStream;
    bench.progress("replug: plugging");
    let passed = play(bench, &registry, script, ROUND * rounds)?;
    let plugged: Vec<Stamp> = plugged.try_iter().collect();
    let mut firsts = Vec::new();
    let mut epoch = None;
    for one in passed.iter().filter(|one| one.topic == TopicId::Modality(bit)) {
        if epoch.replace(Epoch(one.header.epoch)) != Some(Epoch(one.header.epoch)) {
            firsts.push(one.written);
        }
    }
    let delays = Sorted::new(plugged.iter().enumerate().filter_map(|(place, plug)| {
        let next = plugged.get(place + 1).copied().unwrap_or(Stamp(u64::MAX));
        let first = firsts.iter().find(|first| (*plug..next).contains(first))?;
        Some(first.since(*plug).as_secs_f64() * 1e3)
    }));

    bench.progress("replug: the device alone");
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let spec = registry.named(DEVICE).ok_or("the load has no such device")?;
    let alone = runtime.block_on(async {
        let mut alone = Vec::new();
        let begun = Stamp::now();
        for _ in 0..rounds {
            let begin = Instant::now();
            let node = DeviceNode::Sim(Arc::new(SimDevice::new(DEVICE, source.clone(), begun)));
            let mut driver = Driver::open(spec, &node).await?;
            driver.read().await?;
            alone.push(begin.elapsed().as_secs_f64() * 1e3);
        }
        Ok::<_, rapid_devices::driver::DriverError>(Sorted::new(alone))
    })?;
    let note = format!(
        "{} of {} plugs; from the event at the rig's door until the recorder wrote the first sample of a 1 kHz device; \
         cooldown set to 0; baseline: the device itself, opened and read once",
        delays.len(),
        plugged.len()
    );
    let figure = |name: &str, share: f64| {
        Figure::new(format!("replug/first sample recorded, {name}"), "ms", delays.quantile(share))
            .baseline(alone.quantile(share))
    };
    Ok(vec![figure("p50", 0.5).note(note), figure("p99", 0.99), figure("max", 1.0)])
}
