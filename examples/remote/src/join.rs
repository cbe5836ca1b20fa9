//! `join`: the sensors of other computers for the `rapid` on this one, on a port of 127.0.0.1 ([`rapid_core::remote`]).
//!
//! Invariant: a connection exists while its sensor is present; samples and the frames between them have the clock of the
//! moment they are sent at.
//! Invariant: the capture times on a connection increase, and none is later than the moment it is sent at.

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use rapid_core::remote::{HEAD, Head, Kind, LONGEST_REQUEST, requested};
use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::OwnedWriteHalf;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};
use zenoh::Session;
use zenoh::bytes::ZBytes;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::SampleKind;

use crate::cli::Join;
use crate::clock::Estimate;
use crate::hosts::Hosts;
use crate::queue::Queue;
use crate::{Fault, asked_to_end, link, wire};

/// How often a connection looks whether its sensor is present.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Looks between two frames that only report that it is present.
const ALIVE_LOOKS: u32 = 5;
/// Between exchanges with a host: the first ones, and those after them.
const FIRST: (usize, Duration) = (16, Duration::from_millis(50));
const EXCHANGE_EVERY: Duration = Duration::from_millis(250);
/// An answer that takes longer bounds nothing.
const ANSWER_LIMIT: Duration = Duration::from_secs(1);
/// A reader that takes nothing for this long has ended.
const WRITE_LIMIT: Duration = Duration::from_secs(2);
/// Samples that may wait for the reader.
const WAITING: usize = 256;
/// Bytes of them, at most.
const WAITING_BYTES: usize = 64 << 20;
/// Samples that are not pictures are reported to their sender together.
const NUMBERS: u64 = 16;
/// Connections at once: more than a rig has sensors, twice.
const MOST: usize = 160;
/// The largest sample: the largest `max_bytes` of an entry.
const LARGEST: usize = 256 << 20;

/// The newest sample of a connection.
#[derive(Debug, Default)]
struct Last {
    seq: u64,
    capture_ns: u64,
    is_picture: bool,
}

/// Runs until it is asked to end.
pub async fn run(options: Join) -> Result<(), Fault> {
    if options.connect.is_empty() && options.network.router.is_none() && options.network.zenoh.is_none() {
        return Err(
            "nothing to join: write --connect tcp/ADDRESS:7447 with the computer that serves, or --router".into()
        );
    }
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, options.port)).await.map_err(|error| {
        format!("port {} of 127.0.0.1: {error}: end the other program, or write --port", options.port)
    })?;
    let session = link::open(&options.network, &[], &options.connect).await?;
    let hosts = Arc::new(Hosts::new(Duration::from_millis(options.lease)));
    let states = Arc::clone(&hosts);
    let _states = session
        .declare_subscriber(wire::ALL_STATES)
        .callback(move |sample| {
            let names = wire::read_state(&sample.payload().to_bytes());
            if let Some((host, names)) = wire::host_of(sample.key_expr().as_str()).zip(names) {
                states.state(host, names, Stamp::now());
            }
        })
        .await?;
    let tokens = Arc::clone(&hosts);
    let _tokens = session
        .liveliness()
        .declare_subscriber(wire::ALL_ALIVE)
        .history(true)
        .callback(move |sample| {
            if let (SampleKind::Delete, Some(host)) = (sample.kind(), wire::host_of(sample.key_expr().as_str())) {
                tokens.gone(host);
            }
        })
        .await?;
    tracing::info!("offers the sensors of other computers on port {} of 127.0.0.1", options.port);
    let connections = Arc::new(AtomicUsize::new(0));
    let accept = async {
        loop {
            match listener.accept().await {
                Ok((stream, _)) => {
                    let (session, hosts, count) = (session.clone(), Arc::clone(&hosts), Arc::clone(&connections));
                    tokio::spawn(async move {
                        if count.fetch_add(1, Ordering::Relaxed) < MOST
                            && let Err(fault) = answer(stream, &session, &hosts).await
                        {
                            tracing::debug!("a connection ended: {fault}");
                        }
                        count.fetch_sub(1, Ordering::Relaxed);
                    });
                }
                // Without descriptors: until others are closed.
                Err(error) => {
                    tracing::warn!("port {}: {error}", options.port);
                    sleep(EXCHANGE_EVERY).await;
                }
            }
        }
    };
    tokio::select! {
        ended = asked_to_end() => ended?,
        () = accept => {}
        () = look(&hosts) => {}
        () = exchange(&session, &hosts) => {}
    }
    session.close().await?;
    Ok(())
}

async fn look(hosts: &Hosts) {
    let mut look = interval(LOOK_EVERY);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        look.tick().await;
        hosts.look(Stamp::now());
    }
}

/// Exchanges messages with every host that is present.
async fn exchange(session: &Session, hosts: &Arc<Hosts>) {
    let mut due = std::collections::HashMap::new();
    loop {
        let now = Stamp::now();
        for (host, exchanges) in hosts.present() {
            let every = if exchanges < FIRST.0 { FIRST.1 } else { EXCHANGE_EVERY };
            let asked = due.entry(host.clone()).or_insert(Stamp::default());
            if now.since(*asked) < every {
                continue;
            }
            *asked = now;
            let (session, hosts) = (session.clone(), Arc::clone(hosts));
            tokio::spawn(async move {
                if let Err(fault) = ask(&session, &hosts, &host).await {
                    tracing::debug!("the clock of {host}: {fault}");
                }
            });
        }
        sleep(LOOK_EVERY).await;
    }
}

async fn ask(session: &Session, hosts: &Hosts, host: &str) -> Result<(), Fault> {
    let sent = Stamp::now();
    let answers = session
        .get(wire::key(host, "clock"))
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .express(true)
        .timeout(ANSWER_LIMIT)
        .await?;
    let answer = answers.recv_async().await?;
    let received = Stamp::now();
    let sample = answer.into_result().map_err(|error| format!("{error:?}"))?;
    if let Some(there) = wire::read_number(&sample.payload().to_bytes()) {
        hosts.exchange(host, sent, there, received);
    }
    Ok(())
}

/// Answers one connection.
async fn answer(mut stream: TcpStream, session: &Session, hosts: &Hosts) -> Result<(), Fault> {
    stream.set_nodelay(true)?;
    let line = timeout(WRITE_LIMIT, line(&mut stream)).await??;
    let (mut reader, mut writer) = stream.into_split();
    let Some((host, device)) = requested(&line) else {
        return refuse(&mut writer, "what came is not a request of rapid").await;
    };
    if let Err(absent) = hosts.sensor(host, device, Stamp::now()) {
        return refuse(&mut writer, &format!("{device} of {host}: {absent}")).await;
    }
    let queue = Arc::new(Queue::new(WAITING, WAITING_BYTES));
    let arrivals = Arc::clone(&queue);
    let _subscriber = session
        .declare_subscriber(wire::sample_key(host, device))
        .callback(move |sample| {
            let payload = sample.payload();
            // What no entry can take is not kept.
            if payload.len() <= HEAD + LARGEST {
                arrivals.push(payload.clone(), payload.len());
            }
        })
        .await?;
    let mut look = interval(LOOK_EVERY);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let taken = session
        .declare_publisher(wire::taken_key(host, device))
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .express(true)
        .await?;
    let (mut looks, mut last, mut reported) = (0, Last::default(), 0);
    let mut rest = [0; 16];
    loop {
        tokio::select! {
            // What the reader gets first is that the sensor is present, and the clock.
            biased;
            // The reader sends nothing more: this is its end.
            _ = reader.read(&mut rest) => return Ok(()),
            _ = look.tick() => {
                let Ok(clock) = hosts.sensor(host, device, Stamp::now()) else { return Ok(()) };
                if looks % ALIVE_LOOKS == 0 {
                    let Estimate { offset_ns, uncertainty_ns } = clock;
                    let head = Head { offset_ns, uncertainty_ns, ..Head::default() };
                    timeout(WRITE_LIMIT, writer.write_all(&head.bytes())).await??;
                }
                looks = looks.wrapping_add(1);
            }
            payload = queue.next() => {
                let now = Stamp::now();
                let Ok(clock) = hosts.sensor(host, device, now) else { return Ok(()) };
                timeout(WRITE_LIMIT, pass_on(&mut writer, &payload, clock, now, &mut last)).await??;
                if last.seq.abs_diff(reported) >= if last.is_picture { 1 } else { NUMBERS } {
                    reported = last.seq;
                    taken.put(&reported.to_le_bytes()[..]).await?;
                }
            }
        }
    }
}

/// The line of a request, without its end.
async fn line(stream: &mut TcpStream) -> Result<Vec<u8>, Fault> {
    let mut line = Vec::with_capacity(LONGEST_REQUEST);
    while line.len() < LONGEST_REQUEST {
        match stream.read_u8().await? {
            b'\n' => return Ok(line),
            byte => line.push(byte),
        }
    }
    Err("a request is too long".into())
}

async fn refuse(writer: &mut OwnedWriteHalf, reason: &str) -> Result<(), Fault> {
    let length = u32::try_from(reason.len())?;
    writer.write_all(&Head { kind: Kind::Refused, length, ..Head::default() }.bytes()).await?;
    writer.write_all(reason.as_bytes()).await?;
    Ok(())
}

/// Writes a sample with its capture time on this clock.
async fn pass_on(
    writer: &mut OwnedWriteHalf,
    frame: &ZBytes,
    clock: Estimate,
    now: Stamp,
    last: &mut Last,
) -> Result<(), Fault> {
    let frame = frame.to_bytes();
    let Some((head, payload)) = frame.split_first_chunk::<HEAD>() else { return Ok(()) };
    let head = match Head::read(head, LARGEST) {
        Ok(head) if head.kind == Kind::Sample && usize::try_from(head.length) == Ok(payload.len()) => head,
        Ok(_) => return Ok(()),
        Err(error) => {
            tracing::debug!("a sample is dropped: {error}");
            return Ok(());
        }
    };
    let Estimate { offset_ns, uncertainty_ns } = clock;
    let capture_ns = clock.here(head.capture_ns).min(now.0).max(last.capture_ns.saturating_add(1));
    let is_picture = matches!(head.encoding, Some(Encoding::Mjpeg | Encoding::Yuyv | Encoding::Grey | Encoding::Depth));
    *last = Last { seq: head.seq, capture_ns, is_picture };
    writer.write_all(&Head { capture_ns, offset_ns, uncertainty_ns, ..head }.bytes()).await?;
    writer.write_all(payload).await?;
    Ok(())
}
