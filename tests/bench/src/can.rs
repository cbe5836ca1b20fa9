//! A full CAN bus: 8,000 frames a second, received without a loss, and the cost of that.
//!
//! With Damiao's adapter on a pseudo-terminal the frames take the whole path: driver, rig, bus, recorder, file. A
//! kernel without CAN has no interface to bring up: there datagrams of the same size go to the same driver.

use std::fs::File;
use std::io::{self, Write};
use std::net::UdpSocket;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::time::Duration;

use futures::StreamExt;
use rapid_bus::TopicId;
use rapid_core::time::Stamp;
use rapid_devices::driver::can::raw::Raw;
use rapid_devices::hotplug::HotplugEvent;
use rapid_registry::device::{Attachment, DeviceNode, UsbIdentity};
use rapid_registry::{CAN_RECORD, Registry};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use vbench::emu::can::Frame;
use vbench::emu::can::damiao;

use crate::beat::{sleep, sleep_until};
use crate::child::{process_cpu_s, thread_cpu_s};
use crate::figure::Figure;
use crate::frame::play;
use crate::stats::median;
use crate::{Bench, Failure};

/// Approximate capacity of a classic bus at 1 Mbit/s for frames of eight bytes.
const HZ: usize = 8_000;
/// An adapter delivers the frames of a millisecond at once.
const BURST: Duration = Duration::from_millis(1);
const EACH: usize = HZ / 1_000;
/// Time until the line is open, and until the last frame is in the file.
const MARGIN: Duration = Duration::from_millis(700);
const ID: u32 = 0x123;
const REGISTRY: &str = "[rig]\nname = \"can\"\n[device.bus]\nvid = \"1209\"\npid = \"0001\"\nnode = \"can\"\nbit = 0\n\
                        [device.bus.can]\nadapter = \"damiao\"\nprotocol = \"raw\"\n";

/// One run.
#[derive(Clone, Copy)]
struct Run {
    sent: usize,
    /// Frames that did not fit into the line's buffer.
    refused: usize,
    received: usize,
    /// Share of one core, %, without the sending.
    cpu: f64,
}

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let length = bench.length(10, 2);
    let (mut line, mut idle, mut socket, mut bare) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for run in 0..bench.runs {
        bench.progress(&format!("can: run {} of {}, {} s each", run + 1, bench.runs, length.as_secs()));
        line.push(whole(bench, length, true)?);
        idle.push(whole(bench, length, false)?);
        socket.push(datagrams(length, true)?);
        bare.push(datagrams(length, false)?);
    }
    let of = |runs: &[Run], value: fn(&Run) -> f64| median(&runs.iter().map(value).collect::<Vec<_>>());
    let lost = |runs: &[Run]| runs.iter().map(|run| run.sent.saturating_sub(run.received) as f64).sum();
    let refused: usize = line.iter().map(|run| run.refused).sum();
    let sent: usize = line.iter().map(|run| run.sent).sum();
    Ok(vec![
        Figure::new("can/frames lost", "", Some(lost(&line))).target("= 0").note(format!(
            "of {sent}, 8,000 a second in bursts of 8, behind Damiao's adapter on a pseudo-terminal, which had no room for \
             {refused} of them"
        )),
        Figure::new("can/cpu of one core", "%", of(&line, |run| run.cpu)).baseline(of(&idle, |run| run.cpu)).target("< 15").note(
            "from the line to the file: driver, rig, bus, recorder, mask; baseline: the same with a silent bus",
        ),
        Figure::new("can/socket, frames lost", "", Some(lost(&socket))).target("= 0"),
        Figure::new("can/socket, cpu of one core", "%", of(&socket, |run| run.cpu))
            .baseline(of(&bare, |run| run.cpu))
            .target("< 15")
            .note("the driver alone, on datagrams with the kernel's stamps; baseline: a thread that receives them one by one"),
    ])
}

/// The whole path, with the bus full or silent.
fn whole(bench: &Bench, length: Duration, full: bool) -> Result<Run, Failure> {
    let registry = Registry::parse(REGISTRY, None)?.registry;
    let topic = TopicId::Modality(registry.named("bus").ok_or("the registry has no bus")?.id);
    let (adapter, path) = terminal()?;
    let usb = UsbIdentity { vid: 0x1209, pid: 1, port: "9-1".to_owned(), ..UsbIdentity::default() };
    let attachment = Attachment {
        syspath: PathBuf::from("/sys/devices/bench/9-1"),
        node: DeviceNode::Tty(path),
        unit: usb.into(),
        driver: None,
        formats: Vec::new(),
    };
    let plugged = || {
        let events = futures::stream::iter([Ok(HotplugEvent::Added(attachment))]);
        Box::pin(events.chain(futures::stream::pending())) as rapid_devices::hotplug::HotplugStream
    };
    let line = adapter.try_clone()?;
    let sender = std::thread::spawn(move || send(length, full, |bytes| (&line).write(bytes)));
    let passed = play(bench, &registry, plugged, length + 2 * MARGIN)?;
    let (sent, refused, cpu) = sender.join().map_err(|_| "the sender panicked")?;
    // Closed earlier, the line would lose unread data.
    drop(adapter);
    let bytes: usize = passed.iter().filter(|one| one.topic == topic).map(|one| one.bytes).sum();
    Ok(Run { sent, refused, received: bytes / CAN_RECORD, cpu })
}

/// Writes frames as an adapter does. Returns how many there were, how many did not fit, and the share of a core that
/// the rest of this process used meanwhile, %.
fn send(length: Duration, full: bool, mut write: impl FnMut(&[u8]) -> io::Result<usize>) -> (usize, usize, f64) {
    sleep(MARGIN);
    let (mut sent, mut refused, mut waiting) = (0, 0, Vec::new());
    let (begun, cpu, own) = (Stamp::now(), process_cpu_s(), thread_cpu_s());
    let mut due = begun;
    while due.since(begun) < length {
        due = due.after(BURST);
        sleep_until(due);
        if !full {
            continue;
        }
        for number in sent..sent + EACH {
            // The unwritten rest goes first; a frame that does not fit then is lost, as in an adapter.
            let taken = write(&waiting).unwrap_or(0);
            waiting.drain(..taken);
            if waiting.is_empty()
                && let Some(frame) = Frame::new(ID, false, false, 8, &number.to_le_bytes())
            {
                damiao::send_to_host(&frame, &mut waiting);
            } else {
                refused += 1;
            }
            let taken = write(&waiting).unwrap_or(0);
            waiting.drain(..taken);
        }
        sent += EACH;
    }
    let others = (process_cpu_s() - cpu) - (thread_cpu_s() - own);
    (sent, refused, 100.0 * others / Stamp::now().since(begun).as_secs_f64())
}

/// The adapter's end of a line, which never blocks, and the path of the host's end.
fn terminal() -> Result<(File, PathBuf), Failure> {
    let ours = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&ours)?;
    unlockpt(&ours)?;
    let path = PathBuf::from(ptsname(&ours, Vec::new())?.into_string()?);
    rustix::io::ioctl_fionbio(&ours, true)?;
    Ok((File::from(ours), path))
}

/// Datagrams to the driver of a raw bus, or to a bare receive loop.
fn datagrams(length: Duration, driver: bool) -> Result<Run, Failure> {
    let (ours, theirs) = (UdpSocket::bind("127.0.0.1:0")?, UdpSocket::bind("127.0.0.1:0")?);
    ours.connect(theirs.local_addr()?)?;
    theirs.connect(ours.local_addr()?)?;
    let sender = std::thread::spawn(move || {
        sleep(MARGIN);
        let (begun, mut sent) = (Stamp::now(), 0_usize);
        let mut due = begun;
        while due.since(begun) < length {
            due = due.after(BURST);
            sleep_until(due);
            for number in sent..sent + EACH {
                let mut frame = [0; 16];
                frame[..4].copy_from_slice(&ID.to_ne_bytes());
                frame[4] = 8;
                frame[8..].copy_from_slice(&number.to_le_bytes());
                // A datagram that does not fit is counted as not received.
                let _ = theirs.send(&frame);
            }
            sent += EACH;
        }
        sent
    });
    let until = Stamp::now().after(length + 2 * MARGIN);
    let (received, spent) = if driver { by_driver(ours, until)? } else { by_loop(&ours, until)? };
    let sent = sender.join().map_err(|_| "the sender panicked")?;
    Ok(Run { sent, refused: 0, received, cpu: 100.0 * spent / length.as_secs_f64() })
}

/// Frames received and time used for them, s.
fn by_driver(socket: UdpSocket, until: Stamp) -> Result<(usize, f64), Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let mut raw = Raw::stand_in(OwnedFd::from(socket))?;
        let (cpu, mut bytes) = (thread_cpu_s(), 0);
        let end = tokio::time::Instant::now() + until.since(Stamp::now());
        while let Ok(reading) = tokio::time::timeout_at(end, raw.read()).await {
            bytes += reading?.bytes.len();
        }
        Ok((bytes / CAN_RECORD, thread_cpu_s() - cpu))
    })
}

fn by_loop(socket: &UdpSocket, until: Stamp) -> Result<(usize, f64), Failure> {
    socket.set_read_timeout(Some(Duration::from_millis(100)))?;
    let (cpu, mut received) = (thread_cpu_s(), 0);
    while Stamp::now() < until {
        received += usize::from(socket.recv(&mut [0; 17]).is_ok());
    }
    Ok((received, thread_cpu_s() - cpu))
}
