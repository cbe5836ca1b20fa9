//! `serve`: the sensors of the `rapid` on this computer on the network.
//!
//! Invariant: a slow network makes a thread here wait, and never the bus: meanwhile the oldest samples of its topic are
//! dropped. What the kernel would keep for a connection is more than a picture is worth, so that only a few samples are
//! ever between here and the other computer, which reports what it has.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use rapid_core::modality::ModalityKind;
use rapid_registry::{DeviceSpec, Registry};
use rapid_core::remote::{HEAD, Head, Kind, is_name};
use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait as _};

use crate::bus::{self, Place, Running};
use crate::cli::Serve;
use crate::{Fault, asked_to_end, link, wire};

/// Between two states that are the same.
const STATE_EVERY: Duration = Duration::from_millis(50);
/// Pictures that may wait: what is newer is worth more.
const PICTURES: usize = 2;
/// Samples on their way, pictures and others: those of a round of 100 ms at 40 Hz, or at 2.5 kHz.
const PICTURES_OUT: usize = 4;
const OTHERS_OUT: usize = 256;
/// The other computer may have begun again: it is not waited for longer.
const TAKEN_LIMIT: Duration = Duration::from_secs(1);
/// Between two looks at what was taken.
const LOOK: Duration = Duration::from_millis(1);
/// Where the other computer is waited for.
const LISTEN: &str = "tcp/[::]:7447";

/// Runs until it is asked to end.
pub async fn run(options: Serve) -> Result<(), Fault> {
    let name = options.name.map_or_else(host_name, Ok)?;
    if !is_name(&name) {
        return Err(format!("--name {name:?}: write letters, digits, `_` and `-`").into());
    }
    let devices = devices(&options.config, &options.devices)?;
    let mut listen = options.listen;
    if listen.is_empty() && options.network.router.is_none() && options.network.zenoh.is_none() {
        listen.push(LISTEN.to_owned());
    }
    let session = link::open(&options.network, &listen, &[]).await?;
    let clock = wire::key(&name, "clock");
    let answer = clock.clone();
    let _clock = session
        .declare_queryable(clock)
        .callback(move |query| {
            // Read as late as possible: whatever comes after is part of the way back.
            if let Err(error) = query.reply(&answer, &Stamp::now().0.to_le_bytes()[..]).wait() {
                tracing::debug!("clock: {error}");
            }
        })
        .await?;
    let (place, running) = (Place { instance: options.instance }, Running::default());
    for device in &devices {
        read(&session, &name, device, &place, &running)?;
    }
    follow(&session, &name, devices, place, running)?;
    let _alive = session.liveliness().declare_token(wire::key(&name, "alive")).await?;
    let at: Vec<&str> = listen.iter().chain(&options.network.router).map(String::as_str).collect();
    tracing::info!("serves the sensors of {name} at {}", at.join(", "));
    asked_to_end().await?;
    session.close().await?;
    Ok(())
}

fn host_name() -> Result<String, Fault> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname")?;
    Ok(name.trim().split('.').next().unwrap_or_default().to_owned())
}

/// The devices of the registry, or those of them that are named.
fn devices(config: &Path, named: &[String]) -> Result<Vec<DeviceSpec>, Fault> {
    let registry = Registry::load(config).map_err(|errors| errors.to_string())?.registry;
    if let Some(unknown) = named.iter().find(|name| registry.named(name).is_none()) {
        return Err(format!("--device {unknown:?}: {} has no [device.{unknown}]", config.display()).into());
    }
    let mut devices = registry.devices;
    devices.retain(|device| named.is_empty() || named.contains(&device.name));
    Ok(devices)
}

/// Starts the thread that sends the samples of a device.
fn read(session: &Session, host: &str, device: &DeviceSpec, place: &Place, running: &Running) -> Result<(), Fault> {
    let publisher = session
        .declare_publisher(wire::sample_key(host, &device.name))
        .congestion_control(CongestionControl::Block)
        .priority(Priority::Data)
        .wait()?;
    let taken = Arc::new(AtomicU64::new(0));
    let reported = Arc::clone(&taken);
    session
        .declare_subscriber(wire::taken_key(host, &device.name))
        .callback(move |sample| {
            if let Some(number) = wire::read_number(&sample.payload().to_bytes()) {
                reported.store(number, Ordering::Relaxed);
            }
        })
        .background()
        .wait()?;
    let (name, topic, place, running) = (device.name.clone(), device.topic.clone(), place.clone(), running.clone());
    let (depth, out) = match device.modality().kind {
        ModalityKind::Image | ModalityKind::Depth => (PICTURES, PICTURES_OUT),
        ModalityKind::Scalars | ModalityKind::Bytes => (device.depth, OTHERS_OUT),
    };
    // Samples on their way that are not reported yet, by number.
    let mut on_the_way = VecDeque::new();
    let mut frame = Vec::new();
    let work = move || {
        bus::read(&place, &running, &topic, depth, |header, payload| {
            let Ok(length) = u32::try_from(payload.len()) else { return };
            // Nothing reads it there.
            if !publisher.matching_status().wait().is_ok_and(|status| status.matching()) {
                on_the_way.clear();
                return;
            }
            let since = Instant::now();
            loop {
                let newest = taken.load(Ordering::Relaxed);
                on_the_way.retain(|number| *number > newest);
                if on_the_way.len() < out {
                    break;
                }
                if since.elapsed() >= TAKEN_LIMIT {
                    on_the_way.clear();
                    break;
                }
                std::thread::sleep(LOOK);
            }
            on_the_way.push_back(header.seq);
            let head = Head {
                kind: Kind::Sample,
                length,
                encoding: Encoding::from_raw(header.encoding),
                seq: header.seq,
                capture_ns: header.capture_ns,
                flags: header.flags,
                width: header.width,
                height: header.height,
                ..Head::default()
            };
            frame.clear();
            frame.extend_from_slice(&head.bytes());
            frame.extend_from_slice(payload);
            debug_assert_eq!(frame.len(), HEAD + payload.len());
            if let Err(error) = publisher.put(&frame[..]).wait() {
                tracing::debug!("{name}: {error}");
            }
        });
    };
    std::thread::Builder::new().name(format!("read {}", device.name)).spawn(work)?;
    Ok(())
}

/// Starts the thread that sends which sensors are present.
fn follow(
    session: &Session,
    host: &str,
    devices: Vec<DeviceSpec>,
    place: Place,
    running: Running,
) -> Result<(), Fault> {
    let publisher = session
        .declare_publisher(wire::key(host, "state"))
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .express(true)
        .wait()?;
    let (mut sent, mut at) = (None, Instant::now());
    let work = move || {
        bus::follow_mask(&place, &running, |mask| {
            if sent == Some(mask) && at.elapsed() < STATE_EVERY {
                return;
            }
            if sent != Some(mask) {
                tracing::debug!(?mask, "mask");
            }
            (sent, at) = (Some(mask), Instant::now());
            let present = devices.iter().filter(|device| mask.is_some_and(|mask| mask.contains(device.id)));
            let state = wire::state(present.map(|device| device.name.as_str()));
            if let Err(error) = publisher.put(state).wait() {
                tracing::debug!("state: {error}");
            }
        });
    };
    std::thread::Builder::new().name("mask".to_owned()).spawn(work)?;
    Ok(())
}
