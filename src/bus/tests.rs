use rapid_core::action::{ActionSource, MAX_ACTION, NoAction};
use rapid_core::modality::ModalityId;
use rapid_core::sample::Encoding;
use rapid_core::sync::WhenStale;
use rapid_registry::{
    DeviceSpec, ExportSpec, IdentitySpec, InferenceSpec, NodeSpec, Parse, RigSpec, SerialSpec, UsbSpec,
};

use super::*;
use crate::patience::PATIENCE;
use std::time::{Duration, Instant};

pub(super) fn registry(depth: usize) -> Registry {
    let id = ModalityId::new(3).expect("below 64");
    Registry {
        inference: InferenceSpec::default(),
        export: ExportSpec::default(),
        rig: RigSpec {
            name: "test".into(),
            observation_hz: 30.0,
            sync_window: Duration::from_millis(25),
            cooldown: Duration::from_secs(2),
            memory_budget: 1 << 20,
            disk_reserve: None,
            expect: Vec::new(),
        },
        devices: vec![DeviceSpec {
            name: "motor".into(),
            id,
            identity: IdentitySpec::Usb(UsbSpec { vid: 1, pid: 2, serial: None, port: None }),
            node: NodeSpec::Serial(SerialSpec {
                baud: 115_200,
                framing: rapid_registry::Framing::Line,
                parse: Parse::Csv,
                channels: 3,
            }),
            topic: "/rapid/serial/motor".into(),
            mount: None,
            stall_after: Duration::from_millis(500),
            max_bytes: 64,
            depth,
            when_stale: WhenStale::Hold,
            latency: Duration::ZERO,
            form: None,
            action: None,
            hooks: rapid_registry::Hooks::default(),
            verdict: rapid_registry::VerdictSpec::defaults(
                rapid_core::modality::ModalityKind::Image,
                Duration::from_millis(500),
                Some(30.0),
            ),
        }],
        modules: Vec::new(),
        stops: Vec::new(),
        buttons: Vec::new(),
        path: None,
        text: String::new(),
    }
}

fn open(name: &str, depth: usize) -> (Registry, Bus) {
    let registry = registry(depth);
    let bus = Bus::open(&registry, Some(&format!("bus{name}{}", std::process::id()))).expect("bus");
    (registry, bus)
}

fn sequences(inbox: &Inbox) -> Vec<(TopicId, u64, Vec<u8>)> {
    let mut got = Vec::new();
    inbox.drain(&mut |id, header, bytes| got.push((id, header.seq, bytes.to_vec()))).expect("drain");
    got
}

#[test]
fn a_sample_arrives_whole_with_its_header_and_wakes_the_consumer() {
    let (registry, bus) = open("a", 16);
    let inbox = bus.inbox().expect("inbox");
    let device = &registry.devices[0];
    let writer = bus.writer(TopicId::Modality(device.id)).expect("writer");
    let header = SampleHeader { seq: 7, capture_ns: 11, id: 3, width: 3, ..SampleHeader::default() };
    writer.publish(header, b"abc").expect("publish");
    let begun = Instant::now();
    inbox.wait(PATIENCE).expect("wait");
    assert!(begun.elapsed() < PATIENCE, "not woken");
    let mut seen = Vec::new();
    inbox.drain(&mut |id, header, bytes| seen.push((id, *header, bytes.to_vec()))).expect("drain");
    assert_eq!(seen, [(TopicId::Modality(device.id), header, b"abc".to_vec())]);
    assert_eq!(sequences(&inbox), []);
}

#[test]
fn a_slow_consumer_loses_the_oldest_samples_and_sees_the_gap() {
    let (registry, bus) = open("b", 16);
    let inbox = bus.inbox().expect("inbox");
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    for seq in 0..100 {
        writer.publish(SampleHeader { seq, ..SampleHeader::default() }, &[1]).expect("publish");
    }
    let got: Vec<u64> = sequences(&inbox).into_iter().map(|(_, seq, _)| seq).collect();
    assert_eq!(got, (84..100).collect::<Vec<_>>());
}

/// Whoever is slow gets some of each topic, in order, and learns that there is more.
#[test]
fn a_consumer_may_take_some_of_each_topic() {
    let (registry, bus) = open("some", 16);
    let inbox = bus.inbox().expect("inbox");
    let topics = [TopicId::Modality(registry.devices[0].id), TopicId::Mask];
    for topic in topics {
        let writer = bus.writer(topic).expect("writer");
        for seq in 0..10 {
            writer.publish(SampleHeader { seq, ..SampleHeader::default() }, &[1; 16]).expect("publish");
        }
    }
    let mut taken: Vec<(TopicId, u64)> = Vec::new();
    for (numbers, is_more) in [(0..4, true), (4..8, true), (8..10, false), (0..0, false)] {
        taken.clear();
        let (more, drained) = inbox.drain_some(4, &mut |id, header, _| taken.push((id, header.seq)));
        drained.expect("drain");
        let expected: Vec<_> = topics.iter().flat_map(|topic| numbers.clone().map(|seq| (*topic, seq))).collect();
        assert_eq!((&taken, more), (&expected, is_more));
    }
}

#[test]
fn a_slow_consumer_does_not_exhaust_the_pool_of_a_fast_one() {
    let (registry, bus) = open("c", 16);
    let slow: Vec<Inbox> = (0..MAX_SUBSCRIBERS - 1).map(|_| bus.inbox().expect("inbox")).collect();
    let fast = bus.inbox().expect("inbox");
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    for seq in 0..1000 {
        writer.publish(SampleHeader { seq, ..SampleHeader::default() }, &[1; 64]).expect("publish");
        assert_eq!(sequences(&fast).len(), 1);
    }
    for inbox in slow {
        assert_eq!(sequences(&inbox).len(), 16);
    }
}

#[test]
fn an_oversized_sample_is_rejected_and_named() {
    let (registry, bus) = open("d", 16);
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    let error = writer.publish(SampleHeader::default(), &[0; 65]).expect_err("too large");
    assert_eq!(
        error.to_string(),
        "a sample of 65 bytes does not fit topic /rapid/serial/motor (at most 64); raise max_bytes of the device"
    );
}

#[test]
fn a_late_consumer_gets_only_what_is_published_from_then_on() {
    let (registry, bus) = open("e", 16);
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    writer.publish(SampleHeader { seq: 0, ..SampleHeader::default() }, &[1]).expect("publish");
    let inbox = bus.inbox().expect("inbox");
    writer.publish(SampleHeader { seq: 1, ..SampleHeader::default() }, &[1]).expect("publish");
    let got: Vec<u64> = sequences(&inbox).into_iter().map(|(_, seq, _)| seq).collect();
    assert_eq!(got, [1]);
}

/// A subscriber of the one device's topic that keeps the samples it receives.
fn holder(registry: &Registry, bus: &Bus) -> iceoryx2::port::subscriber::Subscriber<Service, [u8], Header> {
    let id = TopicId::Modality(registry.devices[0].id);
    let (_, factory) = bus.topics.iter().find(|(spec, _)| spec.id == id).expect("topic");
    factory.subscriber_builder().create().expect("subscriber")
}

#[test]
fn the_pool_suffices_when_every_subscriber_holds_its_maximum() {
    let (registry, bus) = open("f", 16);
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    let subscribers: Vec<_> = (0..MAX_SUBSCRIBERS).map(|_| holder(&registry, &bus)).collect();
    let mut held = Vec::new();
    let mut seq = 0;
    let mut publish = |count: u64| {
        for _ in 0..count {
            writer.publish(SampleHeader { seq, ..SampleHeader::default() }, &[1; 64]).expect("the pool is enough");
            seq += 1;
        }
    };
    // Each holds samples of different moments.
    for subscriber in &subscribers {
        for _ in 0..MAX_BORROWED {
            publish(40);
            held.push(subscriber.receive().expect("receive").expect("sample"));
        }
    }
    let distinct: std::collections::BTreeSet<u64> = held.iter().map(|sample| sample.user_header().seq).collect();
    assert_eq!(distinct.len(), MAX_SUBSCRIBERS * MAX_BORROWED);
    publish(1000);
    drop(held);
    publish(1000);
}

/// Not a test of its own: the process that the next test kills.
#[test]
#[ignore = "run by a_killed_subscriber_that_held_samples_loses_none_and_frees_its_place"]
fn held_samples_helper() {
    let instance = std::env::var("RAPID_TEST_HOLD").expect("the instance");
    let registry = registry(16);
    let bus = Bus::open(&registry, Some(&instance)).expect("bus");
    let subscriber = holder(&registry, &bus);
    let mut held = Vec::new();
    loop {
        held.extend(subscriber.receive().ok().flatten().filter(|_| held.len() < MAX_BORROWED));
        if held.len() == MAX_BORROWED {
            std::fs::write(std::env::temp_dir().join(&instance), "held").expect("a file");
            std::thread::sleep(Duration::from_mins(10));
        }
        std::thread::yield_now();
    }
}

#[test]
fn a_killed_subscriber_that_held_samples_loses_none_and_frees_its_place() {
    let name = format!("busg{}", std::process::id());
    let registry = registry(16);
    let bus = Bus::open(&registry, Some(&name)).expect("bus");
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    let reported = std::env::temp_dir().join(&name);
    for _ in 0..3 {
        let mut process = std::process::Command::new(std::env::current_exe().expect("this test"))
            .args(["--exact", "tests::held_samples_helper", "--ignored", "--nocapture"])
            .env("RAPID_TEST_HOLD", &name)
            .stdout(std::process::Stdio::null())
            .spawn()
            .expect("process");
        while !reported.exists() {
            assert!(process.try_wait().expect("process").is_none(), "the helper ended");
            writer.publish(SampleHeader::default(), &[1; 64]).expect("the pool is enough");
            std::thread::sleep(Duration::from_millis(1));
        }
        process.kill().expect("kill");
        process.wait().expect("killed");
        std::fs::remove_file(&reported).expect("clean");
        for _ in 0..1000 {
            writer.publish(SampleHeader::default(), &[1; 64]).expect("the pool is enough");
        }
    }
    // Creating a node cleans up after dead ones: every subscriber slot is free again.
    let other = Bus::open(&registry, Some(&name));
    drop(other);
    let all: Vec<_> = (0..MAX_SUBSCRIBERS).map(|_| holder(&registry, &bus)).collect();
    writer.publish(SampleHeader { seq: 7, ..SampleHeader::default() }, &[1]).expect("publish");
    for subscriber in &all {
        assert_eq!(subscriber.receive().expect("receive").expect("sample").user_header().seq, 7);
    }
}

#[test]
fn one_subscriber_too_many_gets_an_error_with_the_limit() {
    let (_registry, bus) = open("h", 16);
    let _all: Vec<Inbox> = (0..MAX_SUBSCRIBERS).map(|_| bus.inbox().expect("inbox")).collect();
    let error = bus.inbox().expect_err("too many");
    assert_eq!(error.to_string(), "topic /rapid/serial/motor: 8 programs subscribe already, and no more may; end one");
}

#[test]
fn a_topic_filled_faster_than_it_is_emptied_does_not_trap_the_consumer() {
    let (registry, bus) = open("i", 16);
    let inbox = bus.inbox().expect("inbox");
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    let publish = |seq| writer.publish(SampleHeader { seq, ..SampleHeader::default() }, &[1]).expect("publish");
    publish(0);
    let mut taken = Vec::new();
    inbox
        .drain(&mut |_, header, _| {
            taken.push(header.seq);
            publish(header.seq + 1);
        })
        .expect("drain");
    assert_eq!(taken, (0..16).collect::<Vec<_>>());
    assert_eq!(sequences(&inbox).len(), 1);
}

/// Another publisher on a topic of `bus`, like a program of the same user.
fn stranger(bus: &Bus, id: TopicId) -> iceoryx2::port::publisher::Publisher<Service, [u8], Header> {
    let (_, factory) = bus.topics.iter().find(|(spec, _)| spec.id == id).expect("topic");
    factory.publisher_builder().initial_max_slice_len(64).create().expect("publisher")
}

fn give(stranger: &iceoryx2::port::publisher::Publisher<Service, [u8], Header>, seq: u64) {
    let mut sample = stranger.loan_slice_uninit(8).expect("loan");
    *sample.user_header_mut() = Header(SampleHeader { seq, encoding: Encoding::F64 as u32, ..SampleHeader::default() });
    sample.write_from_slice(&[0; 8]).send().expect("send");
}

fn foreign(inbox: &Inbox) -> Vec<(String, u32, u64)> {
    let mut seen = Vec::new();
    inbox.foreign(&mut |other| seen.push((other.topic.to_owned(), other.process, other.samples)));
    seen
}

#[test]
fn samples_of_a_foreign_publisher_are_counted_by_process_and_not_delivered() {
    let (registry, bus) = open("j", 16);
    let motor = TopicId::Modality(registry.devices[0].id);
    let inbox = bus.inbox().expect("inbox");
    for id in [motor, TopicId::Mask] {
        let (ours, other) = (bus.writer(id).expect("writer"), stranger(&bus, id));
        for seq in 0..3 {
            ours.publish(SampleHeader { seq, ..SampleHeader::default() }, &[1]).expect("publish");
            give(&other, 100 + seq);
        }
        let got: Vec<u64> = sequences(&inbox).into_iter().map(|(_, seq, _)| seq).collect();
        assert_eq!(got, [0, 1, 2], "{id:?}");
        let topic = if id == motor { "/rapid/serial/motor" } else { "/rapid/mask" };
        assert_eq!(foreign(&inbox), [(topic.to_owned(), std::process::id(), 3)]);
        assert_eq!(foreign(&inbox), []);
    }
}

#[test]
fn actions_of_another_program_are_accepted_until_our_policy_publishes() {
    let mut registry = registry(16);
    registry.devices[0].action = Some(rapid_registry::ActionSpec {
        names: vec!["x".into()],
        units: vec!["1".into()],
        min: vec![0.0],
        max: vec![1.0],
    });
    let bus = Bus::open(&registry, Some(&format!("busk{}", std::process::id()))).expect("bus");
    let inbox = bus.inbox().expect("inbox");
    let other = stranger(&bus, TopicId::Action);
    let (actions, mut numbers) = (bus.actions().expect("an actuator"), [0.0; MAX_ACTION]);
    give(&other, 1);
    let encoding = actions.newest(&mut numbers);
    assert_eq!(encoding.map(|action| action.map(|(numbers, _)| numbers.to_vec())), Ok(Some(vec![0.0])));
    let taken = |inbox: &Inbox| sequences(inbox).into_iter().map(|(_, seq, _)| seq).collect::<Vec<_>>();
    assert_eq!((taken(&inbox), foreign(&inbox)), (vec![1], vec![]));
    let ours = bus.writer(TopicId::Action).expect("writer");
    let header = SampleHeader { seq: 2, encoding: Encoding::F64 as u32, ..SampleHeader::default() };
    ours.publish(header, &[0; 8]).expect("publish");
    assert_eq!((taken(&inbox), foreign(&inbox)), (vec![2], vec![]));
    // It is recorded, but moves nothing.
    assert!(matches!(actions.newest(&mut numbers), Ok(Some(_))));
    give(&other, 3);
    assert_eq!(actions.newest(&mut numbers), Err(NoAction::Foreign));
    assert_eq!(actions.newest(&mut numbers), Ok(None));
    let seen = foreign_after(&inbox, &[3]);
    assert_eq!(seen, [("/action".to_owned(), std::process::id(), 1)]);
}

fn foreign_after(inbox: &Inbox, taken: &[u64]) -> Vec<(String, u32, u64)> {
    assert_eq!(sequences(inbox).into_iter().map(|(_, seq, _)| seq).collect::<Vec<_>>(), taken);
    foreign(inbox)
}

#[test]
fn every_segment_has_exactly_its_requested_memory_once_the_bus_is_open() {
    use std::os::unix::fs::MetadataExt;
    let (registry, bus) = open("m", 600);
    let _inboxes: Vec<Inbox> = (0..MAX_SUBSCRIBERS).map(|_| bus.inbox().expect("inbox")).collect();
    // A publisher connects to its subscribers when it publishes.
    for spec in specs(&registry) {
        bus.writer(spec.id).expect("writer").publish(SampleHeader::default(), &[0; 16]).expect("publish");
    }
    let prefix = bus.membership().prefix();
    let mut taken = 0;
    let mut connections = 0;
    for entry in std::fs::read_dir(space::PLACE).expect("shared memory").flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let Ok(about) = entry.metadata() else { continue };
        if name.starts_with(&prefix) {
            assert!(about.blocks() * 512 >= about.len(), "{name}: {} of {} bytes", about.blocks() * 512, about.len());
            taken += about.blocks() * 512;
            connections += usize::from(name.ends_with(".connection"));
        }
    }
    assert_eq!(connections, 2 * MAX_SUBSCRIBERS);
    let asked = specs(&registry).map(|spec| spec.room()).sum::<u64>() + space::BOOKS;
    assert!(taken <= asked, "{taken} bytes, and {asked} were asked for");
}
