//! Inputs that reach far into each reader, made rather than collected.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions};
use rapid_core::mask::{MaskRecord, PhysicalMask};
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;
use rapid_episode::encode;
use rapid_episode::schema::{self, SampleSchema};
use rapid_registry::{BUILTIN, Registry};
use rapid_status::Level;

/// The registries the tests know, good and bad.
#[must_use]
pub fn registries() -> Vec<Vec<u8>> {
    let mut all = files("tests/registry/valid", ".toml");
    all.extend(files("tests/registry/invalid", ".toml"));
    all.push(BUILTIN.as_bytes().to_vec());
    all
}

/// The scenarios the tests know, and one for the registry they are read with here.
#[must_use]
pub fn scenarios() -> Vec<Vec<u8>> {
    let mut all = files("tests/scenarios", ".toml");
    all.push(
        b"repeat = \"10s\"\n[[device]]\nname = \"cam_wrist\"\nserial = \"a\\u0000\\n\"\nport = \"1-2.3\"\n[[device]]\n\
          name = \"twin\"\nlike = \"cam_wrist\"\nvid = \"beef\"\nplugged = false\nhz = 100\nseed = 3\n[[event]]\nat = \"3s\"\n\
          unplug = \"cam_wrist\"\n[[event]]\nat = \"3500ms\"\nplug = \"cam_wrist\"\nport = \"1-4\"\n"
            .to_vec(),
    );
    all
}

/// Durations and sizes.
#[must_use]
pub fn units() -> Vec<Vec<u8>> {
    let all = [
        "25ms",
        "1.5s",
        "2 min",
        "1h 30m0.5s",
        "18446744073709551615s 1000ms",
        "0s",
        "250us",
        "18446744073709551615ns",
        "512MiB",
        "1.5 GiB",
        "4096B",
        "9e9h",
    ];
    all.map(|text| text.as_bytes().to_vec()).to_vec()
}

/// Lines of CAN adapters that use slcan.
#[must_use]
pub fn slcan() -> Vec<Vec<u8>> {
    vec![
        b"\x03\rz\rZ\r\x07t10021133\rT1ABCDEF980123456789ABCDEFFFFF\rr1002\rR000000058\r".to_vec(),
        b"\x00V1013\rN1234\rF00\rt10t7FF0\rgarbage t0018112233445566778\rt00181122334455667788ea5f\r".to_vec(),
    ]
}

/// The line of Damiao's CAN adapter.
#[must_use]
pub fn damiao_serial() -> Vec<Vec<u8>> {
    let message = |kind: u8, format: u8, id: u32| {
        [&[0xaa, kind, format][..], &id.to_le_bytes(), &[0x15, 0x7f, 0xff, 0x7f, 0xf7, 0xff, 0x1c, 0x1a, 0x55]].concat()
    };
    let all = [0, 1, 0x11, 2, 0x12, 3, 0x13, 0xee].map(|kind| message(kind, 8, 0x15)).concat();
    let odd = [message(0x11, 0x48, 0x1234_5678), message(0x11, 0x82, 5), message(0x11, 9, 5)].concat();
    let cut = [&[0xaa, 0x11, 8][..], &message(0x11, 8, 0x15), &[0x55, 0xaa], &message(0x11, 3, 0x16)].concat();
    [all, odd, cut].into_iter().map(|bytes| [vec![4], bytes].concat()).collect()
}

/// Streams of each framing and content.
#[must_use]
pub fn serial() -> Vec<Vec<u8>> {
    let stream =
        |kind: u8, parse: u8, channels: u8, cut: u8, bytes: &[u8]| [&[kind, parse, channels, cut], bytes].concat();
    let cobs = [0, 5, 0x11, 0x22, 0x33, 0x44, 1, 1, 1, 0, 3, 0x3f, 0x80, 1, 0, 0xff, 0];
    vec![
        stream(0, 0, 2, 3, b"tail\n1,2,3\r\n-1e9, nan ,inf\n1,2\n\n0.1,0.2,0.3\n"),
        stream(0, 1, 1, 1, b"\n[1,2]\n{\"a\":1,\"b\":{\"c\":[9]},\"d\":2,\"e\":null}\n[1,2,3]\n"),
        stream(0, 3, 0, 2, &[b"\n", &[b'x'; 300][..], b"\nshort\n"].concat()),
        stream(1, 2, 0, 2, &cobs),
        stream(1, 3, 0, 6, &[&[0, 255][..], &[7; 254], &[2, 9, 0]].concat()),
        stream(2, 2, 1, 4, &[0, 0, 128, 63, 0, 0, 0, 64, 0, 0, 128]),
        stream(2, 0, 0, 1, b"1.5\n2.5\n"),
    ]
}

/// A picture with a frame header and no more.
fn jpeg() -> Vec<u8> {
    let mut bytes = vec![0xff, 0xd8, 0xff, 0xe0, 0, 4, 1, 2, 0xff, 0xff, 0xc0, 0, 11, 8, 0, 120, 0, 160, 1, 1, 0x11, 0];
    bytes.extend([0xff, 0xda, 0, 2, 0xff, 0xd9]);
    bytes
}

fn samples() -> Vec<(SampleSchema, Vec<u8>)> {
    let header = |encoding: Encoding, width, height| SampleHeader {
        seq: 1,
        capture_ns: 1,
        recv_ns: 2,
        encoding: encoding as u32,
        width,
        height,
        ..SampleHeader::default()
    };
    let numbers: Vec<u8> = [1.0_f64, -2.5, f64::NAN].iter().flat_map(|number| number.to_le_bytes()).collect();
    [
        (header(Encoding::Mjpeg, 160, 120), jpeg()),
        (header(Encoding::Yuyv, 4, 2), vec![7; 16]),
        (header(Encoding::Grey, 4, 2), vec![7; 8]),
        (header(Encoding::F64, 3, 0), numbers),
        (header(Encoding::Bytes, 0, 0), b"anything".to_vec()),
    ]
    .into_iter()
    .map(|(header, payload)| {
        let schema = SampleSchema::for_sample(&header, &payload);
        let mut message = Vec::new();
        encode::sample(&mut message, schema, 1_700_000_000_000_000_000, "cam", &header, &payload);
        (schema, message)
    })
    .collect()
}

/// One message of each schema.
#[must_use]
pub fn messages() -> Vec<Vec<u8>> {
    // Rows with padding: width 2, height 2, step 6.
    let padded = b"\x15\x02\0\0\0\x1d\x02\0\0\0\x22\x05mono8\x2d\x06\0\0\0\x32\x0cabcdefghijkl".to_vec();
    samples().into_iter().map(|(_, message)| message).chain([padded]).collect()
}

/// Small episodes: chunked, not chunked, compressed, cut off. Their checksums are left out, so that a
/// changed byte is read rather than refused.
#[must_use]
pub fn episodes() -> Vec<Vec<u8>> {
    let whole = [None, Some(Compression::Lz4), Some(Compression::Zstd)].map(|compression| episode(compression, true));
    let cut = whole[0][..whole[0].len() * 2 / 3].to_vec();
    whole.into_iter().chain([cut, episode(None, false)]).collect()
}

fn episode(compression: Option<Compression>, chunked: bool) -> Vec<u8> {
    let begin = 1_700_000_000_000_000_000_u64;
    let registry = Registry::builtin();
    let options = WriteOptions::new()
        .compression(compression)
        .use_chunks(chunked)
        .chunk_size(Some(2048))
        .calculate_chunk_crcs(false)
        .calculate_data_section_crc(false)
        .calculate_summary_section_crc(false)
        .calculate_attachment_crcs(false)
        .library("rapid/0.1.0");
    let mut file = mcap::Writer::with_options(Cursor::new(Vec::new()), options).expect("a writer to memory");
    let layout: BTreeMap<&str, u8> =
        registry.devices.iter().map(|device| (device.name.as_str(), device.id.bit())).collect();
    let layout = serde_json::to_string(&layout).expect("JSON");
    let metadata = [
        ("layout", layout.as_str()),
        ("registry", BUILTIN),
        ("rig", "r"),
        ("task", "t"),
        ("begin_ns", "1700000000000000000"),
    ];
    let metadata = metadata.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
    file.write_metadata(&Metadata { name: "rapid".to_owned(), metadata }).expect("metadata");
    let mut add = |schema: schema::Schema, topic: &str, messages: Vec<Vec<u8>>| {
        let id = file.add_schema(schema.name, schema::PROTOBUF, schema.data).expect("schema");
        let channel_id = file.add_channel(id, topic, schema::PROTOBUF, &BTreeMap::new()).expect("channel");
        for (sequence, message) in (1_u32..).zip(messages) {
            let log_time = begin + u64::from(sequence) * 1_000_000;
            let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time + 500 };
            file.write_to_known_channel(&header, &message).expect("message");
        }
    };
    let made = |write: &dyn Fn(&mut Vec<u8>)| {
        let mut message = Vec::new();
        write(&mut message);
        message
    };
    let masks = [0_u64, 1, 7, 5].map(|mask| made(&|out| encode::mask(out, begin, PhysicalMask(mask), mask)));
    add(schema::MASK, "/rapid/mask", masks.to_vec());
    let event = r#"{"event":"attach","device":"cam_wrist"}"#;
    let event = encode::EventText { kind: "attach", device: "cam_wrist", text: "here", json: event };
    add(schema::EVENT, "/rapid/event", vec![made(&|out| encode::event(out, begin, &event))]);
    add(schema::LOG, "/rapid/log", vec![made(&|out| encode::log(out, begin, Level::Warn, "line"))]);
    let topics = ["/rapid/camera/wrist", "/a", "/b", "/rapid/serial/motor", "/c"];
    for ((schema, message), topic) in samples().into_iter().zip(topics) {
        add(schema.schema(), topic, vec![message.clone(), message]);
    }
    let summary = [("seconds", "0.004"), ("dropped", "0"), ("lost", "0"), ("damaged", "0")];
    let summary = summary.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
    file.write_metadata(&Metadata { name: "rapid/summary".to_owned(), metadata: summary }).expect("metadata");
    file.finish().expect("an end");
    file.into_inner().into_inner()
}

/// The published mask, with the names of its bits after it.
#[must_use]
pub fn masks() -> Vec<Vec<u8>> {
    let record = |mask: u64, device_count| {
        let record =
            MaskRecord { device_count, generation: 2, mask: PhysicalMask(mask), realtime_ns: Stamp(7).0, sequence: 9 };
        record.to_bytes().to_vec()
    };
    let names = layouts().remove(0);
    vec![record(5, 3), record(u64::MAX, 255), [record(1, 64), names].concat()]
}

/// The JSON file beside the mask.
#[must_use]
pub fn layouts() -> Vec<Vec<u8>> {
    let bit = ModalityId::new(63).map_or(0, ModalityId::bit);
    vec![
        format!(r#"{{"devices":[{{"name":"cam","bit":0,"online":true}},{{"name":"\u001b[2J\u202e","bit":{bit}}}]}}"#)
            .into(),
        br#"{"devices":[{"name":"x","bit":255},{"name":"x","bit":0},{"name":"y","bit":0}],"pid":1}"#.to_vec(),
    ]
}

/// What devices call themselves, and worse.
#[must_use]
pub fn strings() -> Vec<Vec<u8>> {
    let mut all: Vec<Vec<u8>> = [
        "CAM00A1",
        "a b%k$env{X}'#,=",
        "A*",
        "?[x]|y",
        "a\", RUN+=\"reboot",
        "a\\",
        "\\\"",
        "\u{fc}\u{202e}\u{feff}\u{200b}",
        "a\nKERNEL==\"*\", RUN+=\"x\"\n",
        "\r\n\t\0",
        "\u{1b}[2J\u{9b}31m\u{7f}",
        "key: value # comment",
        "- &anchor *alias !tag | > %d",
        "ExecStart=/bin/sh\n[Service]",
        "${HOME} `id` $(id) ; rm -rf",
        " ",
        "x ",
        "相机手腕",
    ]
    .map(|text| text.as_bytes().to_vec())
    .to_vec();
    all.push(b"\xff\xfe latin \xfc".to_vec());
    all.push(vec![b'x'; 126]);
    all.push(b"0123456789".repeat(1000));
    all
}

/// Files of the repository below `folder` that end so, in the order of their names.
pub(crate) fn files(folder: &str, end: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(folder);
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut paths: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
    paths.retain(|path| path.to_string_lossy().ends_with(end));
    paths.sort();
    paths.iter().map(|path| std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))).collect()
}
