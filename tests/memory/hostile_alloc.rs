//! Files of a few hundred kB that expand to very many small records: what is kept of them and what is done for them is
//! bounded by the size of the file, and whatever is not judged is a reason.

use rapid_episode::record::inspect::{Inspection, inspect_bytes};
use rapid_episode::recover::recover_bytes;
use rapid_status::Grade;

use crate::{alone, measured};

const MAGIC: &[u8] = b"\x89MCAP0\r\n";
/// Bytes of the records of a chunk: held as they are and decompressed, where a vector that grows takes twice as much.
const CHUNK: usize = 4 << 20;
/// Most that may be held: a chunk decompressed, and what is kept of an episode.
const MOST: usize = 3 * CHUNK + (96 << 20);

fn text(text: &str) -> Vec<u8> {
    [&u32::try_from(text.len()).unwrap().to_le_bytes(), text.as_bytes()].concat()
}

fn map(pairs: &[(&str, &str)]) -> Vec<u8> {
    let pairs: Vec<u8> = pairs.iter().flat_map(|(key, value)| [text(key), text(value)].concat()).collect();
    [&u32::try_from(pairs.len()).unwrap().to_le_bytes()[..], &pairs].concat()
}

fn record(opcode: u8, content: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(content.len() as u64).to_le_bytes(), content].concat()
}

fn channel(id: u16, topic: &str, metadata: &[u8]) -> Vec<u8> {
    record(0x04, &[&id.to_le_bytes()[..], &[0; 2], &text(topic), &text("protobuf"), metadata].concat())
}

fn message(id: u16, sequence: u32, time: u64, data: &[u8]) -> Vec<u8> {
    let times = [time.to_le_bytes(), time.to_le_bytes()].concat();
    record(0x05, &[&id.to_le_bytes()[..], &sequence.to_le_bytes(), &times, data].concat())
}

fn chunk(records: &[u8]) -> Vec<u8> {
    let packed = zstd::encode_all(records, 1).unwrap();
    let head = [&[0; 16][..], &(records.len() as u64).to_le_bytes(), &crc32fast::hash(records).to_le_bytes()].concat();
    record(0x06, &[&head[..], &text("zstd"), &(packed.len() as u64).to_le_bytes(), &packed].concat())
}

/// The beginning of an episode with `cameras`.
fn beginning(cameras: usize) -> Vec<u8> {
    let camera = |n: usize| {
        format!(
            "[device.c{n}]\nvid = \"1209\"\npid = \"0001\"\nserial_number = \"{n}\"\nnode = \"camera\"\nbit = {n}\n\
             [device.c{n}.camera]\nwidth = 640\nheight = 480\nfps = 30\n"
        )
    };
    let registry: String = (0..cameras).map(camera).collect();
    let about = [
        ("begin_wall_ns", "1700000000000000000"),
        ("observation_hz", "30"),
        ("registry", &registry),
        ("sync_window_ns", "25000000"),
    ];
    let header = [text(""), text("rapid/0.1.0")].concat();
    [MAGIC, &record(0x01, &header), &record(0x0c, &[text("rapid"), map(&about)].concat())].concat()
}

/// Records, of `one` and a number, that fill a chunk.
fn many(mut one: impl FnMut(u32) -> Vec<u8>) -> Vec<u8> {
    let mut records = Vec::new();
    for number in 0.. {
        if records.len() >= CHUNK {
            break;
        }
        records.extend(one(number));
    }
    records
}

/// `chunks` times a chunk of messages on the topic, all of the same time: as often as that a chunk is not a repetition.
fn messages(topic: &str, chunks: usize, mut data: impl FnMut(u32) -> Vec<u8>) -> Vec<u8> {
    let packed = chunk(&many(|number| message(1, 0, 0, &data(number))));
    [beginning(1), chunk(&channel(1, topic, &map(&[]))), packed.repeat(chunks)].concat()
}

/// An event of this kind with `json`.
fn event(kind: &str, json: &str) -> Vec<u8> {
    let field = |number: u8, bytes: &[u8]| {
        let (low, middle) = (0x80 | bytes.len() & 0x7f, 0x80 | bytes.len() >> 7 & 0x7f);
        let length = [low, middle, bytes.len() >> 14].map(|byte| u8::try_from(byte).unwrap());
        [&[number << 3 | 2][..], &length, bytes].concat()
    };
    [field(2, kind.as_bytes()), field(4, json.as_bytes()), field(5, json.as_bytes())].concat()
}

fn files() -> Vec<(&'static str, Vec<u8>)> {
    let mask = |number: u32| [&[0x11][..], &u64::from(number % 2).to_le_bytes()].concat();
    let long = "x".repeat(1 << 20);
    let list = format!("{{\"reason\": [{}0]}}", "0,".repeat(1 << 19));
    let wide: Vec<u8> = (0..4096).flat_map(|n| [text(&format!("{n}")), text("")].concat()).collect();
    let wide = [&u32::try_from(wide.len()).unwrap().to_le_bytes()[..], &wide].concat();
    let definitions = |number: u32| channel(u16::try_from(number).unwrap_or(0), "/a", &wide);
    let metadata = |number: u32| record(0x0c, &[text(&format!("m{number}")), wide.clone()].concat());
    let pictures: Vec<u8> = (0..14_u8)
        .flat_map(|n| {
            let size = [0x80, 0x80, 0x80, 0x04];
            let picture = message(u16::from(n) + 1, 0, 0, &[&[0x12][..], &size, &vec![n; 8 << 20]].concat());
            let bit = n.to_string();
            let defined = channel(u16::from(n) + 1, "/c", &map(&[("modality", &format!("c{n}")), ("bit", &bit)]));
            chunk(&[defined, picture].concat())
        })
        .collect();
    vec![
        ("masks", messages("/rapid/mask", 200, mask)),
        ("frames", messages("/rapid/frame", 60, |_| Vec::new())),
        ("plugs", messages("/rapid/event", 40, |number| event(["attach", "detach"][number as usize % 2], "c0"))),
        ("events", messages("/rapid/event", 20, |_| event("x", &long))),
        ("holds", messages("/rapid/event", 20, |_| event("hold", &list))),
        ("opened", messages("/rapid/event", 20, |_| event("opened", &long))),
        ("latencies", messages("/rapid/event", 60, |_| event("chunk", "{\"latency_ms\": 1}"))),
        ("channels", [beginning(1), chunk(&many(definitions)).repeat(20)].concat()),
        ("metadata", [beginning(1), chunk(&many(metadata)).repeat(20)].concat()),
        ("pictures", [beginning(14), pictures].concat()),
    ]
}

#[test]
fn memory_and_work_for_a_file_are_bounded_by_its_size() {
    let _alone = alone();
    let mut wrong = Vec::new();
    for (name, bytes) in files() {
        let (found, peak): (Option<Inspection>, usize) = measured(|| inspect_bytes(&bytes));
        let found = found.unwrap();
        // Each record of a compressed chunk is worth 400 bytes, of which there are 256 MiB and 200 for each of the file.
        let allowed = ((256 << 20) + 200 * bytes.len() as u64) / 400;
        println!(
            "{name}: {} kB, {} messages, {} left out, {} MiB held: {:?}",
            bytes.len() >> 10,
            found.messages,
            found.left_out.swollen_chunks,
            peak >> 20,
            found.verdict.reasons()
        );
        if peak > MOST || found.messages > allowed {
            wrong.push(format!("{name}: {} messages of {allowed}, {} MiB held", found.messages, peak >> 20));
        }
        assert_ne!(found.verdict.grade(), Some(Grade::Good), "{name}");
        let (whole, peak) = measured(|| recover_bytes(&bytes));
        let whole = whole.unwrap_or_default().len();
        println!("{name}: repaired {} MiB, {} MiB held", whole >> 20, peak >> 20);
        // A vector that grows is there twice.
        if peak > MOST + 3 * whole {
            wrong.push(format!("{name}: {} MiB held for a repair of {} MiB", peak >> 20, whole >> 20));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
