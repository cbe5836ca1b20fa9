//! An open episode on a clock of its own: deadlines, losses, edges.

use rapid_core::provenance::UnplugSource;
use rapid_core::text::counted;
use rapid_core::time::WallClock;

use super::super::episode_path::EpisodePath;
use super::super::hole::Hole;
use super::super::mask_history::MaskHistory;
use super::super::open_episode::{Beginning, OpenEpisode};
use super::super::provenance::Attached;
use super::super::streams::Streams;
use super::*;
use crate::ReferenceSample;

/// An open episode of its own clock, one second after the monotonic clock's zero.
fn open(folder: &Path, board: &Arc<Board>, masks: &MaskHistory) -> OpenEpisode {
    open_of(registry(), folder, board, masks, &[])
}

fn open_of(
    registry: Registry,
    folder: &Path,
    board: &Arc<Board>,
    masks: &MaskHistory,
    references: &[ReferenceSample],
) -> OpenEpisode {
    let clock = WallClock::with_offset(i128::from(1_700_000_000 * 1000 * MS));
    let path = EpisodePath::create(
        &EpisodeRequest { out: folder.to_owned(), task: "t".into(), ..EpisodeRequest::default() },
        clock.wall_ns(Stamp(0)),
    )
    .unwrap();
    let beginning = Beginning {
        limit: FileLimit::NONE,
        registry: Arc::new(registry),
        board: Arc::clone(board),
        request: &EpisodeRequest::default(),
        sink: Box::new(path.file.try_clone().unwrap()),
        path,
        attached: &Attached::default(),
        clock,
        begin: Stamp(1000 * MS),
        shown: None,
        references,
    };
    OpenEpisode::begin(beginning, masks).unwrap()
}

fn scalars(seq: u64, capture_ms: u64, recv_ms: u64) -> SampleHeader {
    SampleHeader {
        seq,
        capture_ns: capture_ms * MS,
        recv_ns: recv_ms * MS,
        encoding: Encoding::F64 as u32,
        ..SampleHeader::default()
    }
}

/// The mask of before the beginning that is on its way while the episode begins is not a hole in the file.
#[test]
fn no_mask_is_missing_between_the_one_in_force_and_the_first_of_the_episode() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let mut masks = MaskHistory::new();
    masks.push(&scalars(5, 996, 996), PhysicalMask(0b10), 5);
    let mut open = open(folder.path(), &board, &masks);
    for (sequence, capture) in [(6, 998), (7, 1000), (8, 1002)] {
        open.mask(&scalars(sequence, capture, capture), PhysicalMask(0b10).into(), sequence, None);
    }
    open.end_at(Stamp(1002 * MS));
    let report = open.finish(Stamp(1200 * MS), &masks, None, &[]);
    assert_eq!(report.error, None);
    let read = read(&report.file);
    assert_eq!(read.on(rapid_core::mask::MASK_TOPIC).map(|message| message.1).collect::<Vec<_>>(), [5, 6, 7, 8]);
}

/// Those that the policy has when the episode begins, and those that it takes later.
#[test]
fn references_of_the_policy_are_attached() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let reference = |observation: &str, capture_ms| ReferenceSample {
        observation: observation.to_owned(),
        modality: "tof".to_owned(),
        header: scalars(3, capture_ms, capture_ms),
        payload: 1.5_f64.to_le_bytes().to_vec(),
    };
    let mut taken = vec![reference("known", 500)];
    let masks = MaskHistory::new();
    let mut open = open_of(registry(), folder.path(), &board, &masks, &taken);
    let attached = |path: &Path| -> Vec<String> { read(path).attachments.into_keys().collect() };
    taken.extend([reference("taken_late", 999), reference("of_the_episode", 1001)]);
    open.attach(&taken);
    open.flush();
    let partial: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
    let [partial] = &partial[..] else { panic!("{partial:?}") };
    let written = std::fs::read(partial).unwrap();
    for name in ["reference/known", "reference/taken_late", "reference/of_the_episode"] {
        assert!(
            written.windows(name.len()).any(|window| window == name.as_bytes()),
            "{name}: it would be lost in a kill"
        );
    }
    taken.push(reference("at_the_end", 1050));
    open.attach(&taken);
    open.end_at(Stamp(1100 * MS));
    let report = open.finish(Stamp(1300 * MS), &masks, None, &[]);
    assert_eq!(report.error, None);
    let each_once = ["at_the_end", "known", "of_the_episode", "taken_late"].map(|name| format!("reference/{name}"));
    assert_eq!(attached(&report.file)[1..], each_once);
    let whole = std::fs::read(&report.file).unwrap();
    let summary = mcap::Summary::read(&whole).unwrap().unwrap();
    assert_eq!(summary.attachment_indexes.len(), 5, "with the registry");
    let message = &read(&report.file).attachments["reference/known"];
    assert_eq!(crate::decode("rapid.Scalars", message).unwrap().0, 1.5_f64.to_le_bytes());
}

#[test]
fn late_samples_are_recorded_and_too_late_ones_belong_to_no_frame() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let mut masks = MaskHistory::new();
    masks.push(&scalars(1, 990, 990), PhysicalMask(0b10), 1);
    let mut open = open(folder.path(), &board, &masks);
    let at = |ms: u64| Stamp(ms * MS);
    // Tick 0 is at 1000 ms; its deadline 25 ms + 100 ms later. One sample comes in time, one does not.
    open.sample(id(TOF), &scalars(0, 999, 999), &[0; 8], None);
    open.sample(id(TOF), &scalars(1, 1001, 1126), &[0; 8], None);
    open.sample(id(TOF), &scalars(2, 1010, 1124), &[0; 8], None);
    open.advance(at(1144), &masks);
    assert_eq!(open.status(at(1144)).messages, 3, "two samples and a mask; the frame not before 1145 ms");
    open.advance(at(1145), &masks);
    assert_eq!(open.status(at(1145)).messages, 4);

    open.end_at(at(1100));
    open.end_at(at(1200));
    // Captured before the end and arriving after it; captured at the end.
    open.sample(id(TOF), &scalars(3, 1099, 1190), &[0; 8], None);
    open.sample(id(TOF), &scalars(4, 1100, 1190), &[0; 8], None);
    assert!(!open.is_over(at(1219)) && open.is_over(at(1220)));
    let report = open.finish(at(1220), &masks, None, &[]);
    assert_eq!((report.error, report.messages), (None, 7), "one sample and two frames more");
    assert!((report.seconds - 0.1).abs() < 1e-9);

    let read = read(&report.file);
    assert_eq!(read.on("/rapid/tof").map(|m| m.1).collect::<Vec<_>>(), [1, 2, 3]);
    let chosen: Vec<_> = read
        .on("/rapid/frame")
        .map(|(.., frame)| {
            let list = frame.get_field_by_name("modalities").unwrap();
            let slot = list.as_list().unwrap()[1].as_message().unwrap().clone();
            (number(&slot, "valid"), number(&slot, "seq"), number(&slot, "age_ns"))
        })
        .collect();
    // Ticks at 1000, 1033.3, 1066.7 ms, and none at 1100, the end. The sample of 1001 ms is nearer to
    // the first but came too late for it; the second has one in its window, the third holds it.
    assert_eq!(chosen, [(1, 2, -10_000_000), (1, 2, 23_333_333), (0, 2, 56_666_666)]);
}

#[test]
fn losses_are_announced_once_a_second_and_counted_all() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let mut events = board.events();
    let masks = MaskHistory::new();
    let mut open = open(folder.path(), &board, &masks);
    for n in 0..200 {
        let now = 1000 + n * 10;
        let hole = Hole { after: Stamp((now - 9) * MS), before: Stamp(now * MS), lost: 1, dropped: 2 };
        open.sample(id(TOF), &scalars(n, now, now), &[0; 8], Some(hole));
        open.advance(Stamp(now * MS), &masks);
    }
    // One more, so that a number of hostile size comes to the others.
    let hole = Hole { after: Stamp(1500 * MS), before: Stamp(3000 * MS), lost: 0, dropped: u64::MAX };
    open.sample(id(CAM), &scalars(1, 3000, 3000), &[0; 8], Some(hole));
    assert_eq!(open.status(Stamp(0)).dropped, u64::MAX);
    let report = open.finish(Stamp(3001 * MS), &masks, None, &[]);
    assert_eq!((report.error, report.dropped), (None, u64::MAX));
    let mut answer = Vec::new();
    while let Ok(event) = events.try_recv() {
        if let EventKind::Log { level: Level::Warn, text } = event.what {
            answer.push(text);
        }
    }
    let lost = |count: u64, name: &str| format!("{name}: {} lost on the way to the file", counted(count, "sample"));
    let both = |count, own| format!("{}, {own} samples lost by the device", lost(count, "tof"));
    assert_eq!(answer, [lost(2, "tof"), both(200, 101), lost(u64::MAX, "cam_wrist"), both(196, 98)]);
    let tallies = &read(&report.file).metadata["rapid/summary"]["modalities"];
    let tallies: serde_json::Value = serde_json::from_str(tallies).unwrap();
    assert_eq!((&tallies["tof"]["samples"], &tallies["tof"]["dropped"]), (&200.into(), &398.into()));
    // The hole before the first sample lies before the episode.
    assert_eq!(tallies["tof"]["lost"], 199);
}

#[test]
fn only_the_part_of_a_gap_within_the_episode_counts() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let masks = MaskHistory::new();
    let mut open = open(folder.path(), &board, &masks);
    let hole = |after: u64, before: u64, missing| {
        Some(Hole { after: Stamp(after * MS), before: Stamp(before * MS), lost: 0, dropped: missing })
    };
    // Every 10 ms; the episode begins at 1000 ms: 960 to 990 do not count.
    open.sample(id(TOF), &scalars(9, 1050, 1050), &[0; 8], hole(950, 1050, 9));
    assert_eq!(open.status(Stamp(0)).dropped, 5);
    // As after a disk that stood still beyond the end: what is left is of later moments, and yet 1060
    // to 1090 ms are lost.
    open.end_at(Stamp(1100 * MS));
    open.sample(id(TOF), &scalars(29, 1250, 1250), &[0; 8], hole(1050, 1250, 19));
    assert_eq!(open.status(Stamp(0)).dropped, 9);
    // Neither a hole in another time nor one of no length.
    open.sample(id(TOF), &scalars(40, 1300, 1300), &[0; 8], hole(1250, 1300, 10));
    open.sample(id(TOF), &scalars(50, 1300, 1300), &[0; 8], hole(1300, 1300, 10));
    let report = open.finish(Stamp(1300 * MS), &masks, None, &[]);
    assert_eq!((report.error, report.dropped), (None, 9));
}

#[test]
fn every_frame_waits_for_a_slow_sensor() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let mut masks = MaskHistory::new();
    masks.push(&scalars(1, 990, 990), PhysicalMask(0b10), 1);
    let mut late = registry();
    late.devices[usize::from(TOF)].latency = Duration::from_millis(300);
    let mut open = open_of(late, folder.path(), &board, &masks, &[]);
    let at = |ms: u64| Stamp(ms * MS);
    open.end_at(at(1010));
    // It stands for tick 0, at 1000 ms; and one, captured as late, for a moment after the end.
    open.sample(id(TOF), &scalars(0, 1299, 1420), &[0; 8], None);
    open.sample(id(TOF), &scalars(1, 1310, 1425), &[0; 8], None);
    open.advance(at(1444), &masks);
    assert_eq!(open.status(at(1444)).messages, 2, "a sample and a mask; the frame not before 1445 ms");
    assert!(!open.is_over(at(1429)) && open.is_over(at(1430)));
    open.advance(at(1445), &masks);
    let report = open.finish(at(1445), &masks, None, &[]);
    assert_eq!((report.error.as_deref(), report.messages, report.seconds), (None, 3, 0.01));
    let read = read(&report.file);
    let frame = &read.on("/rapid/frame").next().unwrap().4;
    let slots = frame.get_field_by_name("modalities").unwrap().into_owned();
    let slot = slots.as_list().unwrap()[usize::from(TOF)].as_message().unwrap().clone();
    assert_eq!(["valid", "seq", "age_ns"].map(|field| number(&slot, field)), [1, 0, i128::from(MS)]);
    let sample = read.on("/rapid/tof").next().unwrap();
    assert_eq!(sample.2 - read.on("/rapid/frame").next().unwrap().2, 299 * MS, "the file keeps the capture time");
    let modalities: serde_json::Value = serde_json::from_str(&read.metadata["rapid"]["modalities"]).unwrap();
    assert_eq!(modalities[usize::from(TOF)]["latency_ns"], 300_000_000);
}

/// The state on the board of a device that is plugged in.
fn attach(name: &str, bit: u8) -> EventKind {
    let usb = UsbIdentity { port: "1-3".to_owned(), ..UsbIdentity::default() };
    EventKind::Attach {
        device: name.to_owned(),
        bit: id(bit),
        node: "/dev/video9".to_owned(),
        unit: usb.into(),
        driver: None,
    }
}

#[tokio::test]
async fn a_plugged_device_that_never_sends_is_reported_by_recorder_and_inspect_alike() {
    let silent = "never: plugged in for";
    // In before the episode, in it, and out again in it.
    for (before, missed) in [(true, true), (true, false), (false, false)] {
        let mut bench = Bench::new();
        let begin = Stamp::now().0;
        bench.mask(0b10, 1, begin);
        bench.script.taken().await;
        if before {
            bench.board.announce(attach("never", NEVER));
        }
        let finished = bench.recorder.start(bench.request(Some(Duration::from_millis(500)))).await.unwrap();
        if before && !missed {
            let (device, bit, source) = ("never".to_owned(), id(NEVER), UnplugSource::Kernel);
            bench.board.announce(EventKind::Detach { device, bit, source });
        }
        let t0 = Stamp::now().0;
        for n in 0..45 {
            bench.mask(0b10, n + 2, t0 + n * 10 * MS);
            bench.sample(TOF, 1, n, t0 + n * 10 * MS, 0);
        }
        bench.until_file(&finished).await;
        let answer = inspect::inspect(&finished).unwrap();
        let reasons = answer.verdict.reasons();
        assert_eq!(reasons.iter().any(|reason| reason.starts_with(silent)), missed, "{before}: {reasons:?}");
        assert_eq!(answer.verdict.verdict().unwrap().grade > Grade::Good, missed, "{reasons:?}");
        assert_eq!(answer.verdict.verdict(), answer.recorded_verdict.as_ref());
        let never = answer.modalities.iter().find(|modality| modality.name == "never").unwrap();
        let plugged = never.quality.unwrap().plugged;
        assert!(if missed { (0.49..0.51).contains(&plugged) } else { plugged < 0.4 }, "{plugged}");
    }
}

/// As `registry`, with an actuator.
fn with_actuator() -> Registry {
    let arm = "[device.arm]\nvid = \"0001\"\npid = \"0009\"\nbit = 9\nnode = \"cat\"\n[device.arm.process]\n\
               kind = \"bytes\"\n[device.arm.action]\nnames = [\"x\"]\nunits = [\"m\"]\nmin = [0]\nmax = [1]\n";
    Registry::parse(&format!("{}{arm}", registry().text), None).unwrap().registry
}

/// The one number of an action, by the number of the action.
type Numbered = fn(u64) -> f64;
/// Numbers of actions, and when each arrives, ms.
type Arrivals = &'static [(u64, u64)];

/// An episode of a second, from 1000 ms on, of a sensor without fault, and of those actions that arrive.
fn acted(folder: &Path, actions: Arrivals, numbers: Numbered) -> EpisodeReport {
    let registry = with_actuator();
    let board = Arc::new(Board::new(&registry));
    let mut streams = Streams::new();
    streams.masks.push(&scalars(1, 990, 990), PhysicalMask(0b10), 1);
    let mut open = open_of(registry, folder, &board, &streams.masks, &[]);
    open.end_at(Stamp(2000 * MS));
    for ms in 900..2200 {
        if ms % 10 == 0 {
            let header = scalars(ms / 10, ms, ms);
            streams.receive(Some(&mut open), TopicId::Modality(id(TOF)), &header, &[0; 16]);
        }
        for (number, _) in actions.iter().filter(|(_, at)| *at == ms) {
            streams.receive(
                Some(&mut open),
                TopicId::Action,
                &scalars(*number, ms, ms),
                &numbers(*number).to_le_bytes(),
            );
        }
        open.advance(Stamp(ms * MS), &streams.masks);
    }
    let report = open.finish(Stamp(2200 * MS), &streams.masks, None, &[]);
    assert_eq!((report.error.as_deref(), report.seconds), (None, 1.0));
    report
}

#[test]
fn lost_actions_are_suspect_by_the_recorder_and_by_inspect_with_and_without_its_count() {
    let table: [(&str, Arrivals, Option<u64>); 6] = [
        ("all arrive", &[(7, 1000), (8, 1100), (9, 1900)], None),
        ("one is lost", &[(7, 1000), (9, 1100), (10, 1900)], Some(1)),
        ("two holes", &[(7, 1000), (9, 1100), (12, 1900)], Some(3)),
        ("lost before the episode", &[(3, 910), (7, 990), (8, 1100)], None),
        ("lost after it", &[(7, 1100), (8, 2000), (12, 2100)], None),
        ("a restarted publisher", &[(70, 1100), (0, 1200), (1, 1300)], None),
    ];
    for (what, actions, lost) in table {
        let folder = tempfile::tempdir().unwrap();
        let report = acted(folder.path(), actions, |_| 0.0);
        let within = actions.iter().filter(|(_, at)| (1000..2000).contains(at)).count();
        assert_eq!(read(&report.file).on(rapid_core::action::ACTION_TOPIC).count(), within, "{what}");
        let reasons: Vec<_> = lost
            .map(|lost| {
                format!("{lost} {} not in the file (limit 0)", if lost == 1 { "action is" } else { "actions are" })
            })
            .into_iter()
            .collect();
        let grade = if lost.is_some() { Grade::Suspect } else { Grade::Good };
        assert_eq!((report.verdict.grade, &report.verdict.reasons), (grade, &reasons), "{what}");
        let answer = inspect::inspect(&report.file).unwrap();
        assert_eq!(answer.verdict.verdict(), Some(&report.verdict), "{what}");
        // Without the summary: of a killed run, whose numbers are all there is.
        let bytes = std::fs::read(&report.file).unwrap();
        let summary = bytes.windows(13).position(|window| window == b"rapid/summary").unwrap();
        let killed = folder.path().join("killed.mcap");
        std::fs::write(&killed, &bytes[..summary]).unwrap();
        let answer = inspect::inspect(&killed).unwrap();
        let mut of_actions = answer.verdict.reasons();
        of_actions.retain(|reason| reason.contains("action"));
        assert_eq!(of_actions, reasons, "{what}, killed");
    }
}

#[test]
fn actions_that_are_not_finite_are_suspect_by_the_recorder_and_by_inspect() {
    const ACTIONS: Arrivals = &[(6, 990), (7, 1000), (8, 1100), (9, 1900)];
    let table: [(Numbered, Option<&str>); 3] = [
        (|number| number as f64, None),
        (|number| if number == 6 { f64::NAN } else { 0.0 }, None),
        (|number| if number < 9 { f64::NAN } else { 0.0 }, Some("2 actions")),
    ];
    for (numbers, reason) in table {
        let folder = tempfile::tempdir().unwrap();
        let report = acted(folder.path(), ACTIONS, numbers);
        let reasons: Vec<_> =
            reason.map(|count| format!("{count} with a number that is not finite (limit 0)")).into_iter().collect();
        assert_eq!(report.verdict.reasons, reasons);
        assert_eq!(inspect::inspect(&report.file).unwrap().verdict.verdict(), Some(&report.verdict));
    }
}

#[test]
fn an_episode_in_progress_is_judged_like_a_finished_one() {
    let folder = tempfile::tempdir().unwrap();
    let board = Arc::new(Board::new(&registry()));
    let masks = MaskHistory::new();
    let mut open = open(folder.path(), &board, &masks);
    for n in 0..200 {
        let now = 1000 + n * 10;
        let hole = Hole { after: Stamp((now - 9) * MS), before: Stamp(now * MS), lost: 1, dropped: 0 };
        open.sample(id(TOF), &scalars(n, now, now), &[0; 8], Some(hole));
        open.advance(Stamp(now * MS), &masks);
        if n == 50 {
            open.judge(Stamp(now * MS), &[]);
            assert_eq!(open.status(Stamp(now * MS)).outlook.findings, [], "most of it is still to come");
        }
    }
    let end = Stamp(2990 * MS);
    open.judge(end, &[]);
    let outlook = open.status(end).outlook;
    let report = open.finish(end, &masks, None, &[]);
    assert_eq!((outlook.grade(), report.verdict.grade), (Grade::Bad, Grade::Bad));
    let lost = outlook.finding("tof").expect("a finding").sentence();
    assert!(lost.contains("lost by the device"), "{lost}");
    assert!(report.verdict.reasons.contains(&lost), "{:?}", report.verdict.reasons);
}

/// One picture of sixty, the rest whole: it is in the file, in no frame, and a reason; the recorder and `inspect` agree.
#[test]
fn a_picture_that_is_not_usable_is_in_no_frame_and_a_reason() {
    use rapid_pictures::jpeg::{Values, encode};
    let encoded = |[height, width]: [u16; 2], values| {
        let mut jpeg = Vec::new();
        encode(&vec![90; 3 * usize::from(height) * usize::from(width)], [height, width], values, 90, &mut jpeg)
            .unwrap();
        jpeg
    };
    let grain: Vec<u8> = (0..64_usize * 64).map(|at| u8::try_from(at * at % 251).unwrap()).collect();
    let mut detailed = Vec::new();
    encode(&grain, [64, 64], Values::Grey, 90, &mut detailed).unwrap();
    let lost = [&detailed[..400], &detailed[500..]].concat();
    let zeroed = [&detailed[..400], &[0; 100], &detailed[500..]].concat();
    let whole = "";
    let cut = "1 of 60 samples not whole pictures";
    let other = "1 of 60 samples with a picture of another size or kind";
    let cases: [(&str, Vec<u8>, &str); 8] = [
        ("whole", detailed.clone(), whole),
        ("bytes behind its end", [&detailed[..], b"\r\nseq=7"].concat(), whole),
        ("bytes lost inside", lost, cut),
        ("bytes of zeros inside", zeroed, cut),
        ("without an end", detailed[..detailed.len() - 2].to_vec(), cut),
        ("nothing but markers", b"\xff\xd8\xff\xd9".to_vec(), cut),
        ("another size", encoded([32, 64], Values::Grey), other),
        ("another kind", encoded([64, 64], Values::Rgb), other),
    ];
    for (name, payload, reason) in cases {
        let folder = tempfile::tempdir().unwrap();
        let board = Arc::new(Board::new(&registry()));
        let mut masks = MaskHistory::new();
        masks.push(&scalars(5, 996, 996), PhysicalMask(0b1), 5);
        let mut open = open(folder.path(), &board, &masks);
        for n in 0..60 {
            let at = 1000 + n * 50;
            let header = SampleHeader { encoding: Encoding::Mjpeg as u32, ..scalars(n, at, at + 5) };
            let mut picture = if n == 30 { payload.clone() } else { detailed.clone() };
            if n != 30 {
                // Each differs from the one before, in bytes behind the picture.
                picture.extend(n.to_le_bytes());
            }
            open.sample(id(CAM), &header, &picture, None);
        }
        let now = Stamp(4200 * MS);
        open.end_at(Stamp(3990 * MS));
        open.advance(now, &masks);
        let report = open.finish(now, &masks, None, &[]);
        let found = inspect::inspect(&report.file).unwrap();
        assert_eq!(found.verdict.verdict(), Some(&report.verdict), "{name}");
        let reasons: Vec<_> = report.verdict.reasons.iter().filter(|reason| reason.contains("samples")).collect();
        match reason {
            "" => assert!(reasons.is_empty(), "{name}: {reasons:?}"),
            expected => assert!(reasons.iter().any(|reason| reason.contains(expected)), "{name}: {reasons:?}"),
        }
        let cam = found.modalities.iter().find(|modality| modality.bit == CAM).unwrap();
        let quality = cam.quality.unwrap();
        let damaged = u64::from(!reason.is_empty());
        assert_eq!((quality.samples, quality.damaged), (60, damaged), "{name}");
        // It was captured at a tick, whose window holds no other.
        assert_eq!(cam.frames_stale, damaged, "{name}");
    }
}
