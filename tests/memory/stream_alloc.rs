//! The path of a sample does not allocate once it has warmed up.
//!
//! Seen twice, because `rig::stream` is private:
//!
//! 1. On one thread, by public parts: `Driver::read` of a simulated device, header, `Writer::publish`
//!    (loan, one copy, send, notify), `Inbox::wait` and `Inbox::drain`. That is what a stream does
//!    between two samples, without its `select!`, timer and counters. No allocation.
//! 2. The rig as it is: `Rig::run` on a multi-thread runtime, the `mask` thread at 500 Hz, and an
//!    inbox as the recorder has. Every thread of the process counts. Beside the samples the rig writes
//!    the mask's JSON file once a second, which allocates, and each thread keeps the memory of its
//!    first loan. So samples are counted in stretches much shorter than a second: a stretch without
//!    a JSON file and without a thread's first sample has none.

use std::net::{SocketAddr, UdpSocket};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::Poll;
use std::time::Duration;

use futures::poll;
use rapid::alignment::Alignment;
use rapid::rig::Rig;
use rapid::rig::presence::{Claim, Presence};
use rapid_bus::{Bus, Inbox, TopicId};
use rapid_core::mask::{Bits, PhysicalMask};
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;
use rapid_devices::driver::Driver;
use rapid_devices::hotplug::script::Script;
use rapid_registry::Registry;
use rapid_registry::device::{DeviceNode, LastReceived};
use rapid_registry::scenario::Scenario;
use rapid_registry::simulation::SimDevice;
use rapid_status::Board;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::skip::skipped;
use crate::{COUNT, COUNTING, alone, own_allocations};

/// What a device sends has the size the registry lets it have: a picture, and a vector of numbers.
const REGISTRY: &str = r#"
[device.cam]
vid = "1209"
pid = "0001"
node = "camera"
bit = 0
[device.cam.camera]
width = 320
height = 240
fps = 500

[device.state]
vid = "1209"
pid = "0002"
node = "serial"
bit = 1
[device.state.tty]
baud = 115200
parse = "csv"
channels = 8
"#;

const SCENARIO: &str = r#"
[[device]]
name = "cam"
hz = 500

[[device]]
name = "state"
hz = 1000
"#;

/// Threads of the rig's runtime.
const WORKERS: usize = 2;
const WARM_UP: usize = 200;
const SAMPLES: usize = 1000;
/// Samples of a stretch: at 1,500 a second, some 13 ms.
const STRETCH: usize = 20;
/// How often the rig writes its JSON file.
const JSON_PERIOD: Duration = Duration::from_secs(1);

#[test]
fn a_sample_does_not_allocate() {
    let _alone = alone();
    let registry = Registry::parse(REGISTRY, None).unwrap().registry;
    let scenario = Scenario::parse(SCENARIO, None, &registry).unwrap();
    for device in 0..registry.devices.len() {
        one_thread(&registry, &scenario, device);
    }
    whole_rig(&registry, scenario);
}

fn one_thread(registry: &Registry, scenario: &Scenario, device: usize) {
    let instance = format!("alloc{device}-{}", std::process::id());
    let bus = Bus::open(registry, Some(&instance)).unwrap();
    let inbox = bus.inbox().unwrap();
    let spec = &registry.devices[device];
    let writer = bus.writer(TopicId::Modality(spec.id)).unwrap();
    let source = scenario.devices[device].source.clone();
    // A paused clock continues by itself whenever nothing is ready: the device delivers as it is read.
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build().unwrap();
    let allocated = runtime.block_on(async {
        let node = DeviceNode::Sim(Arc::new(SimDevice::new(&spec.name, source, Stamp::now())));
        let mut driver = Driver::open(spec, &node).await.unwrap();
        let (mut bytes, mut before) = (0, 0);
        for seq in 0..WARM_UP + SAMPLES {
            if seq == WARM_UP {
                before = own_allocations();
            }
            let reading = driver.read().await.unwrap();
            let header = SampleHeader {
                seq: seq as u64,
                lost: 0,
                capture_ns: reading.captured.0,
                recv_ns: Stamp::now().0,
                id: u32::from(spec.id.bit()),
                epoch: 1,
                encoding: reading.encoding as u32,
                flags: reading.flags,
                width: reading.width,
                height: reading.height,
            };
            writer.publish(header, reading.bytes).unwrap();
            inbox.wait(Duration::from_millis(20)).unwrap();
            let mut taken = 0;
            inbox
                .drain(&mut |topic, header, payload| {
                    assert!(topic == TopicId::Modality(spec.id) && header.seq == seq as u64);
                    assert!(payload == reading.bytes);
                    bytes += payload.len();
                    taken += 1;
                })
                .unwrap();
            assert!(taken == 1);
        }
        assert!(bytes > SAMPLES * 8);
        own_allocations() - before
    });
    assert_eq!(allocated, 0, "{}: allocations for {SAMPLES} samples", spec.name);
    drop((inbox, writer, bus));
}

#[test]
fn a_packet_of_the_network_does_not_allocate() {
    let _alone = alone();
    let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let text = format!(
        "[device.lidar]\nnode = \"lan\"\nbit = 0\n[device.lidar.lan]\nprotocol = \"udp\"\nhost = \"127.0.0.1\"\nport = {port}\n"
    );
    let registry = Registry::parse(&text, None).unwrap().registry;
    let address = SocketAddr::from(([127, 0, 0, 1], port));
    // Behind an adapter, whose link is watched, and found by its address.
    for node in [DeviceNode::Lan { address, last_received: LastReceived::default() }, DeviceNode::Net("lo".to_owned())]
    {
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let allocated = runtime.block_on(async {
            let mut driver = match Driver::open(&registry.devices[0], &node).await {
                Ok(driver) => driver,
                // Only root may bind a socket to an interface.
                Err(error) => {
                    skipped(&format!("for {}: {error}", node.label()));
                    return 0;
                }
            };
            let mut before = 0;
            for number in 0..WARM_UP + SAMPLES {
                if number == WARM_UP {
                    before = own_allocations();
                }
                let mut read = pin!(driver.read());
                // It waits before the packet is there: that is when the link is looked at, too.
                while poll!(read.as_mut()).is_pending() {
                    sender.send_to(&[7; 1206], address).unwrap();
                    tokio::task::yield_now().await;
                    if let Poll::Ready(reading) = poll!(read.as_mut()) {
                        assert_eq!(reading.unwrap().bytes.len(), 1206);
                        break;
                    }
                }
            }
            own_allocations() - before
        });
        assert_eq!(allocated, 0, "{}: allocations for {SAMPLES} packets", node.label());
    }
}

#[test]
fn an_observation_does_not_allocate() {
    let _alone = alone();
    let text = format!("[rig]\nobservation_hz = 1000\n{REGISTRY}");
    let registry = Registry::parse(&text, None).unwrap().registry;
    let instance = format!("alloc-align-{}", std::process::id());
    let bus = Bus::open(&registry, Some(&instance)).unwrap();
    let writer = |topic| bus.writer(topic).unwrap();
    let (state, mask) = (writer(TopicId::Modality(registry.devices[1].id)), writer(TopicId::Mask));
    let board = Arc::new(Board::new(&registry));
    let alignment = Alignment::new(&registry, bus.queues().unwrap(), writer(TopicId::Observation), board);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let stop = CancellationToken::new();
    let mut observations = bus.queues().unwrap();
    observations.add(bus.observations().unwrap().unwrap());
    let feed = async {
        let (mut before, mut observed) = (0, 0);
        // Until there were so many observations: how long that takes depends on the machine.
        for seq in 0.. {
            let warm = observed >= WARM_UP;
            observations.drain(&mut |topic, _, _| observed += usize::from(topic == TopicId::Observation)).unwrap();
            if !warm && observed >= WARM_UP {
                before = own_allocations();
            } else if observed >= WARM_UP + SAMPLES {
                break;
            }
            let now = Stamp::now().0;
            let header = SampleHeader { seq, capture_ns: now, recv_ns: now, epoch: 1, ..SampleHeader::default() };
            state.publish(header, &[1; 64]).unwrap();
            mask.publish(header, &Bits::from(PhysicalMask(2 + seq % 2)).payload(seq)).unwrap();
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let allocated = own_allocations() - before;
        stop.cancel();
        allocated
    };
    let (published, allocated) = runtime.block_on(async { tokio::join!(alignment.run(stop.clone()), feed) });
    assert_eq!(allocated, 0, "allocations for {published} observations");
    drop((state, mask, observations));
}

fn whole_rig(registry: &Registry, scenario: Scenario) {
    let instance = format!("alloc-rig-{}", std::process::id());
    let folder = tempfile::tempdir().unwrap();
    let bus = Bus::open(registry, Some(&instance)).unwrap();
    let board = Arc::new(Board::new(registry));
    let claim = Claim::new(&folder.path().join("mask"), 2).unwrap();
    let presence = Presence::start(claim, bus.writer(TopicId::Mask).unwrap(), Arc::clone(&board)).unwrap();
    let inbox = bus.inbox().unwrap();
    let mut rig = Rig::new(registry, &bus, presence, board);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(WORKERS).enable_all().build().unwrap();
    let stop = CancellationToken::new();
    let (commands, asked) = mpsc::channel(1);
    let task = runtime.spawn({
        let stop = stop.clone();
        async move {
            rig.run(Box::pin(Script::new(scenario)), asked, stop).await.unwrap();
        }
    });

    let mut counts = [0; 3];
    while counts[0] < WARM_UP || counts[1] < WARM_UP {
        take(&inbox, &mut counts);
    }
    let begun = Stamp::now();
    let mut counts = [0; 3];
    let (mut stretches, mut noisy) = (0, 0);
    // A file may fall between two stretches or be cut by their border, and a worker may have had no
    // sample while it was warming up.
    let files = || Stamp::now().since(begun).as_secs() / JSON_PERIOD.as_secs() + 1;
    let allowed = || 2 * files() + WORKERS as u64;
    // On a slow machine more files fall into as many samples: then it takes more of them to judge.
    while counts[0] < SAMPLES || counts[1] < SAMPLES || stretches <= 2 * allowed() {
        assert!(files() < 600, "{stretches} stretches in ten minutes are too few to judge");
        let end = counts[0] + counts[1] + STRETCH;
        COUNT.store(0, Ordering::Relaxed);
        COUNTING.store(true, Ordering::Relaxed);
        while counts[0] + counts[1] < end {
            take(&inbox, &mut counts);
        }
        COUNTING.store(false, Ordering::Relaxed);
        stretches += 1;
        noisy += u64::from(COUNT.load(Ordering::Relaxed) > 0);
    }
    let (files, allowed) = (files(), allowed());
    stop.cancel();
    runtime.block_on(task).unwrap();
    drop((commands, inbox, bus));

    assert!(noisy <= allowed, "{noisy} of {stretches} stretches allocated, with {files} JSON files");
    assert!(counts[2] > 0, "no mask came");
}

fn take(inbox: &Inbox, counts: &mut [usize; 3]) {
    inbox.wait(Duration::from_millis(20)).unwrap();
    inbox
        .drain(&mut |topic, _, _| match topic {
            TopicId::Modality(id) => counts[id.index()] += 1,
            TopicId::Mask => counts[2] += 1,
            TopicId::Action | TopicId::Observation => {}
        })
        .unwrap();
}
