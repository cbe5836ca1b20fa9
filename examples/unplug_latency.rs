//! Our own share of the time from an unplug to its bit: from the moment the witness reports it to
//! the bytes in the mask's file, over simulated unplugs. What the kernel takes before that is measured
//! on the virtual bench.
//!
//! `cargo run --release --example unplug_latency [UNPLUGS] [--json]`

use std::io::Write;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use futures::Stream;
use rapid::rig::Rig;
use rapid::rig::presence::{Claim, Presence, read_mask};
use rapid_bus::{Bus, TopicId};
use rapid_core::time::Stamp;
use rapid_devices::hotplug::script::Script;
use rapid_devices::hotplug::{HotplugError, HotplugEvent};
use rapid_registry::Registry;
use rapid_registry::scenario::{Scenario, ScenarioAction, ScenarioEvent};
use rapid_status::Board;
use tokio_util::sync::CancellationToken;

/// From one unplug to the next; the device comes back in between.
const ROUND: Duration = Duration::from_millis(100);
const PLUGGED: Duration = Duration::from_millis(50);

type Failure = Box<dyn std::error::Error>;

/// Reports when a removal passes on its way to the rig.
struct Tap {
    script: Script,
    removals: Sender<Stamp>,
}

impl Stream for Tap {
    type Item = Result<HotplugEvent, HotplugError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let polled = Pin::new(&mut self.script).poll_next(context);
        if let Poll::Ready(Some(Ok(HotplugEvent::Removed { noticed, .. }))) = &polled {
            // There is no receiver any more when the last one has been measured.
            let _ = self.removals.send(*noticed);
        }
        polled
    }
}

fn main() -> Result<(), Failure> {
    let (flags, numbers): (Vec<String>, Vec<String>) = std::env::args().skip(1).partition(|word| word.starts_with('-'));
    let json = match &flags[..] {
        [] => false,
        [flag] if flag == "--json" => true,
        _ => return Err("usage: unplug_latency [UNPLUGS] [--json]".into()),
    };
    let unplugs: usize = numbers.first().map_or(Ok(200), |number| number.parse())?;
    let mut registry = Registry::builtin();
    registry.rig.cooldown = Duration::ZERO;
    let mut scenario = Scenario::demo(&registry);
    let device = scenario.devices.last().ok_or("the demo has no devices")?.name.clone();
    let event = |at, action| ScenarioEvent { at, device: device.clone(), action };
    scenario.events =
        vec![event(PLUGGED, ScenarioAction::Unplug), event(PLUGGED + ROUND / 10, ScenarioAction::Plug { port: None })];
    scenario.repeat = Some(ROUND);
    let bit = registry.devices.iter().find(|spec| spec.name == device).ok_or("the device has no entry")?.id;

    let instance = format!("latency{}", std::process::id());
    let path = PathBuf::from(format!("/dev/shm/rapid_{instance}"));
    let board = Arc::new(Board::new(&registry));
    let bus = Bus::open(&registry, Some(&instance))?;
    let writer = bus.writer(TopicId::Mask).ok_or("the bus has no mask")?;
    let presence =
        Presence::start(Claim::new(&path, u8::try_from(registry.devices.len())?)?, writer, Arc::clone(&board))?;
    let (removals, removed) = channel();
    let stop = CancellationToken::new();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let mut rig = Rig::new(&registry, &bus, presence, board);
    let running = runtime.spawn({
        let stop = stop.clone();
        async move {
            let tap = Tap { script: Script::new(scenario), removals };
            let (_commands, asked) = tokio::sync::mpsc::channel(1);
            rig.run(Box::pin(tap), asked, stop).await
        }
    });

    let mut taken = Vec::with_capacity(unplugs);
    let mut skipped = 0_u32;
    while taken.len() < unplugs {
        let begun = Instant::now();
        while !read_mask(&path).is_ok_and(|record| record.mask.contains(bit)) {
            if begun.elapsed() > Duration::from_secs(10) {
                return Err("the device does not come back".into());
            }
            std::thread::sleep(Duration::from_micros(200));
        }
        while removed.try_recv().is_ok() {}
        // Looked at without a pause: what is measured must not be our own sleep.
        let cleared = loop {
            if !read_mask(&path)?.mask.contains(bit) {
                break Stamp::now();
            }
        };
        match removed.try_recv() {
            Ok(witnessed) => taken.push(cleared.since(witnessed)),
            // The stream was the first witness: there is no removal to measure from.
            Err(_) => skipped += 1,
        }
    }
    stop.cancel();
    runtime.block_on(running)??;
    taken.sort_unstable();
    let at = |percent: usize| taken.get((taken.len() - 1) * percent / 100).copied().unwrap_or_default();
    if json {
        let note = format!("first witness received -> bytes in the mask's file, {} simulated unplugs", taken.len());
        for (name, percent, target) in [("p50", 50, None), ("p99", 99, Some(1000.0)), ("max", 100, None)] {
            let micros = at(percent).as_secs_f64() * 1e6;
            let figure = serde_json::json!({
                "name": format!("own_unplug_to_bit_{name}"), "unit": "us", "value": (micros * 10.0).round() / 10.0,
                "baseline": null, "target": target, "note": note,
            });
            writeln!(std::io::stdout(), "{figure}")?;
        }
        return Ok(());
    }
    writeln!(
        std::io::stdout(),
        "witness -> mask file over {} unplugs ({skipped} more were seen by the stream first): p50 {:?}  p99 {:?}  max {:?}",
        taken.len(),
        at(50),
        at(99),
        at(100),
    )?;
    Ok(())
}
