//! Inspecting what the recorder wrote: whole, cut, flipped, and a literal report on the screen.

use proptest::prelude::*;
use rapid_core::mask::{PhysicalMask, SizedMask};
use rapid_status::palette::Palette;
use rapid_status::{Chunk, EventKind, Grade, Hold, Sensors};

use super::*;
use crate::effort::{cases, every};
use crate::record::tests::Bench;
use crate::testing;

fn inspection(bytes: &[u8]) -> Option<Inspection> {
    match inspect_from(bytes, bytes.len() as u64, Path::new("x.mcap"), crate::boot_id()) {
        Err(ReadError::NotMcap(_)) => None,
        read => Some(read.unwrap()),
    }
}

async fn episode() -> (Bench, PathBuf) {
    let mut bench = Bench::new();
    let (file, _) = bench.one_second().await;
    bench.until_file(&file).await;
    (bench, file)
}

#[tokio::test]
async fn a_finished_episode_is_reported_as_recorded() {
    let (_bench, file) = episode().await;
    let report = inspect(&file).unwrap();
    assert_eq!((report.end, report.unread_bytes, report.damaged_chunks), (FileEnd::Finished, 0, 0));
    assert_eq!(
        (report.rig.as_str(), report.task.as_str(), report.tags["finger"].as_str()),
        ("bench", "place block", "soft")
    );
    assert_eq!((report.seconds, report.frames, report.dropped), (1.0, 30, Some(1)));
    assert_eq!((report.lost, report.damaged), (Some(7), Some(1)));
    let names: Vec<_> = report.modalities.iter().map(|m| (m.bit, m.name.as_str())).collect();
    assert_eq!(names, [(0, "cam_wrist"), (1, "tof"), (5, "never"), (7, "raw")]);
    let [cam, tof, never, raw] = report.modalities.as_slice() else { unreachable!() };

    // The camera is away from 300 to 600 ms of the script, which begins a little after the episode.
    let [first, second] = cam.present.as_slice() else { panic!("{:?}", cam.present) };
    assert!((second.0 - first.1 - 0.3).abs() < 1e-6 && first.0.abs() < 1e-9 && (second.1 - 1.0).abs() < 1e-9);
    assert!((cam.presence.unwrap() - 0.7).abs() < 1e-6);
    // The absence is neither a gap nor a loss of rate.
    assert!((0.02..0.1).contains(&cam.topic.longest_gap), "{}", cam.topic.longest_gap);
    assert!((30.0..36.0).contains(&cam.topic.hz), "{}", cam.topic.hz);
    assert_eq!(report.recorded_verdict.as_ref(), report.verdict.verdict(), "the recorder has the same");
    assert!(report.verdict.reasons().iter().any(|reason| reason.starts_with("tof: 7 of ")), "{:?}", report.verdict);
    let frame = report.topics.iter().find(|topic| topic.topic == "/rapid/frame").unwrap();
    assert_eq!((frame.messages, frame.lateness), (30, None));
    assert_eq!(cam.topic.lateness, Some(Lateness { p50: 5.0, p99: 5.0, max: 5.0 }));
    assert!(cam.frames_valid > 10 && cam.frames_valid + cam.frames_stale < 25);
    assert_eq!((tof.topic.missing, tof.presence), (8, Some(1.0)));
    assert!((90.0..101.0).contains(&tof.topic.hz), "{}", tof.topic.hz);
    assert_eq!((never.topic.messages, never.presence, never.topic.lateness), (0, Some(0.0), None));
    assert!(raw.frames_stale > 10 && raw.frames_valid > 0);
    let masks: Vec<_> = report.mask.iter().map(|edge| edge.mask.as_str()).collect();
    assert_eq!(masks, ["0x03", "0x83", "0x82", "0x83"]);
    // The recorder's own lines about losses come when they come.
    let announced = report.events.iter().filter(|event| !event.text.contains("lost"));
    let kinds: Vec<_> = announced.take(3).map(|event| event.kind.as_str()).collect();
    assert_eq!(kinds, ["recording", "attach", "log"]);
    assert!(report.topics.iter().all(|topic| topic.missing == 0), "{:?}", report.topics);
    let together: u64 =
        report.topics.iter().chain(report.modalities.iter().map(|m| &m.topic)).map(|t| t.messages).sum();
    assert_eq!(together, report.messages);
    let shown = render(&report, 80, Palette::Ansi);
    assert!(shown.contains("\x1b[32m█") && shown.contains("   0 %") && !shown.contains("-0 %"), "{shown}");
    assert!(render(&report, 80, Palette::Plain).lines().all(|line| line.chars().count() <= 80));
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!((&json["end"], &json["modalities"][1]["missing"]), (&"finished".into(), &8.into()));
}

#[tokio::test]
async fn numbers_that_are_not_finite_are_damaged_in_files_without_the_flag() {
    for (bad, every, damaged) in
        [(f64::NAN, 1, 50), (f64::INFINITY, 10, 5), (f64::NEG_INFINITY, 10, 5), (1e39, 1, 50), (1e38, 1, 0)]
    {
        let numbers = move |n: u64| [n as f64, if n.is_multiple_of(every) { bad } else { 0.0 }];
        let mut bench = Bench::new();
        let file = bench.half_a_second_of(numbers).await;
        let report = inspect(&file).unwrap();
        let tof = report.modalities.iter().find(|modality| modality.name == "tof").unwrap();
        assert_eq!(tof.quality.unwrap().damaged, damaged, "{bad}");
        assert_eq!(report.damaged, Some(damaged), "{bad}");
        let reason = format!("tof: {damaged} of 50 samples damaged (limit 5 %)");
        assert_eq!(report.verdict.reasons().contains(&reason.as_str()), damaged > 2, "{bad}: {:?}", report.verdict);
    }
}

#[tokio::test]
async fn a_truncated_or_damaged_file_is_read_up_to_the_damage() {
    let (_bench, file) = episode().await;
    let bytes = std::fs::read(&file).unwrap();
    let whole = inspection(&bytes).unwrap();
    assert!(bytes.len() > 20_000);
    let mut before = 0;
    for cut in (0..bytes.len()).step_by(61 * every(5)) {
        let Some(report) = inspection(&bytes[..cut]) else {
            assert!(cut < mcap::MAGIC.len());
            continue;
        };
        assert_ne!(report.end, FileEnd::Finished, "cut at {cut}");
        assert!((before..=whole.messages).contains(&report.messages), "cut at {cut}");
        before = report.messages;
        assert!(!render(&report, 80, Palette::Ansi).is_empty());
    }
    assert_eq!(before, whole.messages);
    let mut noticed = 0;
    for at in (0..bytes.len()).step_by(37 * every(5)) {
        let mut flipped = bytes.clone();
        flipped[at] ^= 1 << (at % 8);
        if let Some(report) = inspection(&flipped) {
            noticed += usize::from(report.damaged_chunks > 0 || report.end != FileEnd::Finished);
            assert!(!render(&report, 80, Palette::Plain).is_empty());
        }
    }
    // Whatever lies in a chunk is under its CRC, and chunks are most of the file.
    assert!(noticed * 37 * every(5) > bytes.len() / 2, "{noticed}");
}

#[test]
fn any_damaged_file_has_a_report() {
    let config = ProptestConfig { cases: cases(300), failure_persistence: None, ..ProptestConfig::default() };
    for bytes in testing::layouts().map(testing::episode) {
        proptest!(config.clone(), |(mutations in testing::mutations())| {
            if let Some(report) = inspect_bytes(&testing::mutated(&bytes, &mutations)) {
                prop_assert!(!render(&report, 80, Palette::Plain).is_empty());
            }
        });
    }
}

#[tokio::test]
async fn a_policy_is_reported_with_its_bundle_and_its_holds() {
    let mut bench = Bench::new();
    let announced = EventKind::Policy {
        policy: "tactile-id".to_owned(),
        folder: "models/tactile-id".into(),
        hash: "0123456789abcdef".to_owned(),
        library: "1.22.0".to_owned(),
        hz: 10.0,
        dry_run: false,
    };
    let chunk = |latency_ms, skipped| {
        EventKind::Chunk(Box::new(Chunk {
            tick: 1,
            observed_ns: 0,
            mask: SizedMask { mask: PhysicalMask(3), devices: 2 },
            seed: 0,
            latency_ms,
            used: true,
            skipped,
            samples: Vec::new(),
            actions: vec![0.5; 4],
        }))
    };
    // Announced before the episode: its name and hash are still in the metadata.
    let file = bench
        .half_a_second(
            vec![announced],
            vec![
                EventKind::Hold(Hold { device: Some("arm".to_owned()), reason: "missing".to_owned() }),
                chunk(30.0, 0),
                chunk(50.0, 2),
                EventKind::Act { tick: 3 },
            ],
        )
        .await;
    let report = inspect(&file).unwrap();
    let policy = report.policy.as_ref().unwrap();
    assert_eq!((policy.name.as_str(), policy.hash.as_str(), policy.dry_run), ("tactile-id", "0123456789abcdef", false));
    assert_eq!((policy.chunks, policy.late_chunks), (2, 1));
    assert_eq!(policy.latency, Some(Lateness { p50: 30.0, p99: 30.0, max: 50.0 }));
    let [hold] = policy.holds.as_slice() else { panic!("{:?}", policy.holds) };
    assert_eq!((hold.reason.as_str(), hold.count), ("missing: arm", 1));
    assert!((0.0..0.5).contains(&hold.seconds), "{}", hold.seconds);
    let shown = render(&report, 80, Palette::Plain);
    assert!(shown.contains("tactile-id  hash 0123456789ab  2 chunks  1 late  latency 30.0/30.0/50.0 ms"), "{shown}");
    assert!(shown.contains("s in 1 hold: missing: arm\n") && !shown.contains("chunk of tick"), "{shown}");
    assert_eq!(serde_json::to_value(&report).unwrap()["policy"]["hash"], "0123456789abcdef");

    // A killed run leaves what stands at the beginning.
    let bytes = std::fs::read(&file).unwrap();
    let summary = bytes.windows(13).position(|window| window == b"rapid/summary").unwrap();
    let cut = inspection(&bytes[..summary]).unwrap();
    assert_eq!(cut.recorded_verdict, None);
    assert_eq!(cut.policy.map(|policy| policy.name), Some("tactile-id".to_owned()));

    let (_bench, file) = episode().await;
    assert_eq!(inspect(&file).unwrap().policy, None);
}

#[test]
fn chunks_of_other_writers_are_opened_and_their_damage_survived() {
    for compression in [Some(mcap::Compression::Zstd), Some(mcap::Compression::Lz4), None] {
        let mut file = std::io::Cursor::new(Vec::new());
        let options = mcap::WriteOptions::new().compression(compression);
        let mut writer = mcap::Writer::with_options(&mut file, options).unwrap();
        let channel = writer.add_channel(0, "/other", "json", &BTreeMap::new()).unwrap();
        for n in 0..50_u32 {
            let log_time = u64::from(n) * 10_000_000;
            let header = mcap::records::MessageHeader {
                channel_id: channel,
                sequence: n,
                log_time,
                publish_time: log_time + 2_000_000,
            };
            writer.write_to_known_channel(&header, b"{}").unwrap();
        }
        writer.finish().unwrap();
        drop(writer);
        let bytes = file.into_inner();
        let report = inspection(&bytes).unwrap();
        assert_eq!((report.end, report.messages, report.topics.len()), (FileEnd::Finished, 50, 1), "{compression:?}");
        assert!((report.topics[0].hz - 100.0).abs() < 1e-6 && (report.seconds - 0.49).abs() < 1e-9);
        for at in 0..bytes.len() {
            for bit in 0..8 {
                let mut flipped = bytes.clone();
                flipped[at] ^= 1 << bit;
                inspection(&flipped);
            }
        }
    }
}

#[test]
fn other_files_are_reported_as_not_mcap() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.mcap");
    assert!(matches!(inspect(&path), Err(ReadError::Io { .. })));
    assert!(inspect(folder.path()).unwrap_err().to_string().contains(": not a file"));
    let pipe = folder.path().join("pipe");
    rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, 0o600.into(), 0).unwrap();
    assert!(matches!(inspect(&pipe), Err(ReadError::NotFile(_))));
    std::fs::write(&path, "no").unwrap();
    let error = inspect(&path).unwrap_err();
    assert!(error.to_string().ends_with("x.mcap: not an MCAP file"));
}

#[test]
#[allow(clippy::too_many_lines, reason = "a report has that many fields")]
fn the_report_on_a_screen() {
    let topic = |topic: &str, messages, missing, lateness| TopicReport {
        topic: topic.to_owned(),
        messages,
        hz: messages as f64 / 10.0,
        missing,
        longest_gap: 0.0667,
        lateness,
    };
    let late = Some(Lateness { p50: 12.3, p99: 40.0, max: 41.5 });
    let report = Inspection {
        file: PathBuf::from("/data/20261121_place-block_001.mcap"),
        bytes: 7_400_000,
        end: FileEnd::Torn,
        verdict: Judgement::Episode(suspect()),
        recorded_verdict: None,
        unread_bytes: 512,
        damaged_chunks: 0,
        left_out: LeftOut::default(),
        ordered_messages: 0,
        recovered: BTreeMap::new(),
        software: "rapid 0.1.0".to_owned(),
        commit: String::new(),
        host: "rig-7".to_owned(),
        kernel: "6.1.0".to_owned(),
        rig: "bench".to_owned(),
        task: "place \x1b[31mblock".to_owned(),
        tags: BTreeMap::from([("finger".to_owned(), "soft".to_owned())]),
        modules: Vec::new(),
        present_at_begin: None,
        begin_ns: 0,
        seconds: 10.0,
        messages: 5300,
        dropped: None,
        lost: Some(3),
        damaged: None,
        frames: 300,
        skew: Some(Spread { p50: 4.0, p95: 11.5, p99: 14.0, max: 15.25 }),
        modalities: vec![
            ModalityReport {
                name: "cam_wrist".to_owned(),
                bit: 0,
                topic: topic("/rapid/cam", 200, 3, late),
                presence: Some(0.7),
                present: vec![(0.0, 3.2), (6.2, 10.0)],
                frames_valid: 209,
                frames_stale: 1,
                quality: Some(quality()),
            },
            ModalityReport {
                name: "tof".to_owned(),
                bit: 1,
                topic: topic("/rapid/tof", 0, 0, None),
                presence: Some(0.0),
                present: Vec::new(),
                frames_valid: 0,
                frames_stale: 0,
                quality: None,
            },
        ],
        units: BTreeMap::from([(
            "cam_wrist".to_owned(),
            vec![
                serde_json::json!({"epoch": 1, "from_s": -2.0, "to_s": 3.2, "vid": "046d", "pid": "0825", "serial": "A\u{1b}7"}),
                serde_json::json!({"epoch": 2, "from_s": 6.2, "to_s": null, "vid": "046d", "pid": "0825", "serial": "B"}),
            ],
        )]),
        policy: Some(PolicyReport {
            name: "tactile\x1b[2J-id".to_owned(),
            hash: "0123456789abcdef0123".to_owned(),
            dry_run: true,
            chunks: 96,
            late_chunks: 1,
            latency: late,
            holds: vec![
                HoldReport {
                    reason: "a modality that the policy requires is missing: arm".to_owned(),
                    count: 2,
                    seconds: 2.94,
                },
                HoldReport { reason: "the next actions are still being computed".to_owned(), count: 1, seconds: 0.2 },
            ],
        }),
        topics: vec![topic("/rapid/mask", 5000, 0, late)],
        mask: Vec::new(),
        events: vec![
            EventReport {
                at: 3.1,
                kind: "chunk".to_owned(),
                device: String::new(),
                text: "chunk of tick 31".to_owned(),
            },
            EventReport {
                at: 3.2,
                kind: "detach".to_owned(),
                device: "cam_wrist".to_owned(),
                text: "cam_wrist detached (stream)".to_owned(),
            },
        ],
    };
    insta::assert_snapshot!(render(&report, 60, Palette::Plain));
}

#[tokio::test]
async fn a_folder_is_listed_with_one_line_per_episode() {
    let (bench, file) = episode().await;
    let folder = file.parent().unwrap();
    std::fs::write(folder.join("20231114_t_001.mcap"), "no").unwrap();
    std::fs::write(folder.join("notes.txt"), "no episode").unwrap();
    let whole = std::fs::read(&file).unwrap();
    std::fs::write(folder.join("99990101_t_001.mcap.partial"), &whole[..whole.len() / 2]).unwrap();
    // What is named twice is listed once.
    let files = episodes(&[folder.to_owned(), file.clone(), folder.join(".")]).unwrap();
    let names: Vec<_> = files.iter().map(|file| file.file_name().unwrap().to_str().unwrap()).collect();
    let name = file.file_name().unwrap().to_str().unwrap();
    assert_eq!(names, ["20231114_t_001.mcap", name, "99990101_t_001.mcap.partial"]);

    let lines: Vec<_> = files
        .iter()
        .map(|file| render_list(&list(file), &file.file_name().unwrap().to_string_lossy(), 30, Palette::Plain))
        .collect();
    assert!(
        lines[0].starts_with("?        20231114_t_001.mcap") && lines[0].ends_with("not an MCAP file"),
        "{lines:?}"
    );
    assert!(lines[1].starts_with(&format!("BAD      {name}")) && lines[1].contains(" 1.0 s "), "{lines:?}");
    assert!(lines[1].contains("tof: 7 of ") && lines[1].ends_with(" (and 3 more)"), "{lines:?}");
    assert!(
        !lines[2].starts_with("GOOD") && lines[2].contains("not whole") || lines[2].starts_with("BAD"),
        "{lines:?}"
    );
    let json = serde_json::to_value(list(&files[1])).unwrap();
    assert_eq!((&json["verdict"], &json["end"], json.get("error")), (&"BAD".into(), &"finished".into(), None));
    let json = serde_json::to_value(list(&files[0])).unwrap();
    let why = "not an MCAP file";
    assert_eq!((&json["verdict"], &json["error"]), (&serde_json::Value::Null, &why.into()));
    assert_eq!(json["reasons"], serde_json::json!([why]));
    assert!(matches!(episodes(&[folder.join("none")]).map(|files| files.len()), Ok(1)), "reported when it is read");
    drop(bench);
}

fn suspect() -> Verdict {
    Verdict {
        grade: Grade::Suspect,
        reasons: vec!["the file is not whole: its last record is cut".to_owned()],
        sensors: Some(Sensors { registered: 2, recorded: 1, without: vec!["tof".to_owned()], away: Vec::new() }),
        replay_of: Vec::new(),
    }
}

/// What was measured of a modality, for a report on a screen.
fn quality() -> Quality {
    Quality {
        samples: 200,
        bytes: 7_000_000,
        dropped: 3,
        presence: Some(0.7),
        present: 7.0,
        plugged: 7.0,
        hz: Some(28.6),
        nominal_hz: Some(30.0),
        longest_gap: 0.0667,
        frames_present: 210,
        frames_valid: 209,
        ..Quality::default()
    }
}
