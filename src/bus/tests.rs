use super::*;
use crate::modality::ModalityId;
use crate::registry::{DeviceSpec, IdentitySpec, NodeSpec, Parse, RigSpec, SerialSpec, WhenStale};
use std::time::Duration;

fn registry(depth: usize) -> Registry {
    let id = ModalityId::new(3).expect("below 64");
    Registry {
        rig: RigSpec {
            name: "test".into(),
            observation_hz: 30.0,
            sync_window: Duration::from_millis(25),
            cooldown: Duration::from_secs(2),
            memory_budget: 1 << 20,
        },
        devices: vec![DeviceSpec {
            name: "motor".into(),
            id,
            identity: IdentitySpec { vid: 1, pid: 2, serial: None, port: None },
            node: NodeSpec::Serial(SerialSpec {
                baud: 115_200,
                framing: crate::registry::Framing::Line,
                parse: Parse::Csv,
                channels: 3,
            }),
            topic: "/rapid/serial/motor".into(),
            mount: None,
            stall_after: Duration::from_millis(500),
            max_bytes: 64,
            depth,
            when_stale: WhenStale::Hold,
        }],
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
    inbox.wait(Duration::from_secs(5)).expect("wait");
    let mut seen = Vec::new();
    inbox.drain(&mut |id, header, bytes| seen.push((id, *header, bytes.to_vec()))).expect("drain");
    assert_eq!(seen, [(TopicId::Modality(device.id), header, b"abc".to_vec())]);
    assert_eq!(sequences(&inbox), []);
}

#[test]
fn a_slow_consumer_loses_the_oldest_and_sees_the_hole() {
    let (registry, bus) = open("b", 16);
    let inbox = bus.inbox().expect("inbox");
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    for seq in 0..100 {
        writer.publish(SampleHeader { seq, ..SampleHeader::default() }, &[1]).expect("publish");
    }
    let got: Vec<u64> = sequences(&inbox).into_iter().map(|(_, seq, _)| seq).collect();
    assert_eq!(got, (84..100).collect::<Vec<_>>());
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
fn an_oversized_sample_is_refused_by_name() {
    let (registry, bus) = open("d", 16);
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    let error = writer.publish(SampleHeader::default(), &[0; 65]).expect_err("too large");
    assert_eq!(
        error.to_string(),
        "a sample of 65 bytes does not fit topic /rapid/serial/motor (at most 64); raise max_bytes of the device"
    );
}

#[test]
fn a_consumer_that_comes_later_gets_what_is_published_from_then_on() {
    let (registry, bus) = open("e", 16);
    let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).expect("writer");
    writer.publish(SampleHeader { seq: 0, ..SampleHeader::default() }, &[1]).expect("publish");
    let inbox = bus.inbox().expect("inbox");
    writer.publish(SampleHeader { seq: 1, ..SampleHeader::default() }, &[1]).expect("publish");
    let got: Vec<u64> = sequences(&inbox).into_iter().map(|(_, seq, _)| seq).collect();
    assert_eq!(got, [1]);
}

#[test]
fn a_topic_filled_faster_than_it_is_emptied_does_not_hold_the_consumer() {
    let (registry, bus) = open("f", 16);
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
