//! Time from `rapid disarm` until the last motor is off.
//!
//! The rig, the thread for orders and thread `control` are those of a run; the motors are those of the virtual bench,
//! behind Damiao's adapter on a pseudo-terminal. Time starts before the command's process does.

use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rapid::orders::receive::Orders;
use rapid::rig::Rig;
use rapid::rig::presence::{Claim, Presence};
use rapid_bus::{Bus, TopicId};
use rapid_core::permission::Permission;
use rapid_core::time::Stamp;
use rapid_devices::hotplug::{HotplugEvent, HotplugStream};
use rapid_registry::Registry;
use rapid_registry::device::{Attachment, DeviceNode, UsbIdentity};
use rapid_status::Board;
use tokio_util::sync::CancellationToken;

use crate::figure::Figure;
use crate::motors::adapter::Adapter;
use crate::stats::Sorted;
use crate::{Bench, Failure, LIMIT};

const AXES: u16 = 6;

/// An arm of six motors, as in `devices.toml`.
pub(crate) fn registry() -> Result<Registry, Failure> {
    let motors: Vec<String> = (1..=AXES)
        .map(|id| {
            format!("{{ name = \"m{id}\", slave = {id}, type = \"DM4310\", kp = 20, kd = 1, position = [-1, 1] }}")
        })
        .collect();
    let text = format!(
        "[rig]\nname = \"disarm\"\n[device.arm]\nvid = \"2e88\"\npid = \"4603\"\nnode = \"can\"\nbit = 0\n\
         [device.arm.can]\nadapter = \"damiao\"\nprotocol = \"damiao\"\ntimeout = \"500ms\"\nsilent_after = \"400ms\"\n\
         motors = [{}]\n",
        motors.join(", ")
    );
    Ok(Registry::parse(&text, None)?.registry)
}

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let count = if bench.smoke { 2 } else { bench.choose(200, 20) };
    let (registry, instance) = (registry()?, format!("disarm-{}", std::process::id()));
    let adapter = Adapter::plug(AXES);
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let bus = Bus::open(&registry, Some(&instance))?;
    let board = Arc::new(Board::new(&registry));
    let claim = Claim::new(&bench.scratch.path().join("mask"), u8::try_from(registry.devices.len())?)?;
    let mask = bus.writer(TopicId::Mask).ok_or("the bus has no mask")?;
    let presence = Presence::start(claim, mask, Arc::clone(&board))?;
    let permission = Arc::new(Permission::new(false));
    let (session, _requests) = tokio::sync::mpsc::channel(1);
    let orders = Orders::receive(Some(&instance), None, Arc::clone(&permission), session)?;
    let mut rig = Rig::new(&registry, &bus, presence, board).obeying(&permission);
    let node = DeviceNode::Tty(adapter.path.clone());
    let unit = UsbIdentity { vid: 0x2e88, pid: 0x4603, port: "1-1".to_owned(), ..UsbIdentity::default() };
    let stop = CancellationToken::new();
    let running = runtime.spawn({
        let stop = stop.clone();
        async move {
            let syspath = "/sys/bench/1-1".into();
            let plugged = Attachment { syspath, node, unit: unit.into(), driver: None, formats: Vec::new() };
            let plugs = futures::stream::iter([Ok(HotplugEvent::Added(plugged))]);
            let plugs: HotplugStream = Box::pin(futures::StreamExt::chain(plugs, futures::stream::pending()));
            let (_commands, asked) = tokio::sync::mpsc::channel(1);
            rig.run(plugs, asked, stop).await
        }
    });
    bench.progress(&format!("disarm: {count} times"));
    let measured = disarms(bench, &adapter, &instance, count);
    stop.cancel();
    runtime.block_on(running)??;
    drop((orders, bus));
    let (off, alone) = measured?;
    let note = format!(
        "{count} times, {AXES} motors that hold; from before the command's process is started. Baseline: `rapid --version`, \
         start to end, right after each"
    );
    let figure = |name: &str, share| {
        Figure::new(format!("disarm/to the last motor off, {name}"), "ms", off.quantile(share))
            .baseline(alone.quantile(share))
    };
    Ok(vec![figure("p50", 0.5).note(note), figure("p99", 0.99).target("< 30"), figure("max", 1.0)])
}

/// The duration of each disarm, and of the program alone, ms.
fn disarms(bench: &Bench, adapter: &Adapter, instance: &str, count: usize) -> Result<(Sorted, Sorted), Failure> {
    let rapid = |arguments: &[&str]| {
        Command::new(&bench.rapid).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).status()
    };
    let (mut off, mut alone) = (Vec::new(), Vec::new());
    for _ in 0..count {
        let begun = Stamp::now();
        until("they are armed", || {
            // Orders are refused until the motors have been found.
            let all = |action| (1..=AXES).all(|motor| adapter.reported_at(motor, action, begun).is_some());
            let enabled = all("motor_enabled");
            Ok(enabled || rapid(&["arm", "--instance", instance])?.success() && all("motor_enabled"))
        })?;
        // Commands are being sent.
        std::thread::sleep(Duration::from_millis(30));
        let begun = Stamp::now();
        if !rapid(&["disarm", "--instance", instance])?.success() {
            return Err("`rapid disarm` failed".into());
        }
        let last =
            || (1..=AXES).map(|motor| adapter.reported_at(motor, "motor_disabled", begun)).collect::<Option<Vec<_>>>();
        until("they are off", || Ok(last().is_some()))?;
        let last = last().and_then(|all| all.into_iter().max()).ok_or("a motor is on")?;
        off.push(last.since(begun).as_secs_f64() * 1e3);
        let begun = Instant::now();
        rapid(&["--version"])?;
        alone.push(begun.elapsed().as_secs_f64() * 1e3);
    }
    Ok((Sorted::new(off), Sorted::new(alone)))
}

fn until(what: &str, mut done: impl FnMut() -> Result<bool, Failure>) -> Result<(), Failure> {
    let begun = Instant::now();
    while !done()? {
        if begun.elapsed() > LIMIT {
            return Err(format!("it does not come to it that {what}").into());
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(())
}
