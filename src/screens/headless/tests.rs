use std::sync::Mutex;

use rapid_core::interlock::{InputState, StopKind};
use rapid_core::mask::{PhysicalMask, SizedMask};
use rapid_core::provenance::{KernelDriver, Negotiated, UnplugSource};
use rapid_core::sample::Epoch;
use rapid_registry::device::UsbIdentity;

use crate::literal::{TAKEN, WALL_NS, board, every_state, id, policy, recording, three_streaming};
use rapid_status::{
    Chunk, DeviceState, EpisodeReport, EventKind, Grade, Hold, Level, PolicyEnd, PolicyStatus, Provenance,
    RecordingStatus, Sensors, StopStatus, Verdict,
};
use serde_json::Value;

use super::*;

/// An output that stores the bytes written to it.
#[derive(Clone, Default)]
struct Kept(Arc<Mutex<Vec<u8>>>);

impl Kept {
    fn text(&self) -> String {
        String::from_utf8(self.0.lock().unwrap().clone()).unwrap()
    }
}

impl Write for Kept {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn event(what: EventKind) -> Event {
    Event { stamp: Stamp(0), what }
}

fn state(device: &str, bit: u8, state: DeviceState, detail: &str) -> EventKind {
    EventKind::State {
        device: device.to_owned(),
        bit: id(bit),
        state,
        mask: SizedMask { mask: PhysicalMask(5), devices: 3 },
        detail: detail.to_owned(),
    }
}

fn episode(dropped: u64, error: Option<&str>) -> EventKind {
    EventKind::Episode(EpisodeReport {
        file: if error == Some("disk full") { "out/a.mcap.partial".into() } else { "out/a.mcap".into() },
        seconds: 30.04,
        messages: 1234,
        bytes: 12_345_678,
        dropped,
        error: error.map(str::to_owned),
        verdict: {
            let (grade, reasons) = match (dropped, error) {
                (0, None) => (Grade::Good, Vec::new()),
                (_, None) => {
                    let reason = "cam_wrist: 3 of 900 samples dropped on the way to the file (limit 0 %)";
                    (Grade::Suspect, vec![reason.to_owned()])
                }
                (_, Some(error)) => (Grade::Bad, vec![format!("the file could not be written: {error}")]),
            };
            let sensors =
                Some(Sensors { registered: 3, recorded: 2, without: vec!["tof".to_owned()], away: Vec::new() });
            Verdict { grade, reasons, sensors, replay_of: Vec::new() }
        },
    })
}

fn usb() -> UsbIdentity {
    UsbIdentity {
        vid: 0x046d,
        pid: 0x0825,
        serial: Some("CAM\x1b[2J00".to_owned()),
        port: "1-2.3".to_owned(),
        firmware: Some("4.18".to_owned()),
        ..UsbIdentity::default()
    }
}

fn chunk(skipped: u64) -> EventKind {
    EventKind::Chunk(Box::new(Chunk {
        tick: 40,
        observed_ns: 0,
        mask: SizedMask { mask: PhysicalMask(5), devices: 3 },
        seed: 7,
        latency_ms: 34.52,
        used: true,
        skipped,
        samples: Vec::new(),
        actions: vec![0.5; 4],
    }))
}

fn hold(device: &str, reason: &str) -> EventKind {
    EventKind::Hold(Hold { device: (!device.is_empty()).then(|| device.to_owned()), reason: reason.to_owned() })
}

fn loaded(dry_run: bool) -> EventKind {
    EventKind::Policy {
        policy: "tactile-id".to_owned(),
        folder: "models/tactile-id".into(),
        hash: "0123456789abcdef0123456789abcdef".to_owned(),
        library: "1.22.0".to_owned(),
        hz: 10.0,
        dry_run,
    }
}

fn policy_end(chunks: u64) -> EventKind {
    EventKind::PolicyEnd(PolicyEnd {
        actions: 812,
        held: 14,
        chunks,
        late: 3,
        unused: 0,
        latency_p50_ms: 34.52,
        latency_p99_ms: 48.0,
    })
}

fn stop(kind: StopKind, state: InputState, detail: &str) -> EventKind {
    EventKind::Stop(StopStatus { stop: "pendant".to_owned(), kind, state, detail: detail.to_owned() })
}

fn all_events() -> Vec<EventKind> {
    vec![
        EventKind::Attach {
            device: "cam_wrist".to_owned(),
            bit: id(0),
            node: "/dev/video0".to_owned(),
            unit: usb().into(),
            driver: None,
        },
        EventKind::Opened {
            device: "cam_wrist".to_owned(),
            bit: id(0),
            provenance: Box::new(Provenance {
                epoch: Epoch(3),
                node: "/dev/video0".to_owned(),
                attached: TAKEN,
                unit: usb().into(),
                negotiated: Negotiated {
                    driver: Some(KernelDriver { name: "uvcvideo".to_owned(), version: Some("6.1.0".to_owned()) }),
                    ..Negotiated::default()
                },
                latency_ns: 35_000_000,
            }),
        },
        state("cam_wrist", 0, DeviceState::Streaming, "/dev/video0 MJPG 640x480@30"),
        EventKind::Detach { device: "tof".to_owned(), bit: id(12), source: UnplugSource::Kernel },
        state("tof", 12, DeviceState::Absent, ""),
        EventKind::Unregistered { device: "046d:0825 \nX".to_owned(), reason: "no entry has this serial".to_owned() },
        EventKind::Recording { file: "out/a.mcap".into() },
        episode(0, None),
        episode(3, None),
        episode(3, Some("disk full")),
        episode(0, Some("disk nearly full")),
        EventKind::Discarded { file: "out/a.mcap".into() },
        EventKind::Restored { file: "out/a.mcap".into() },
        EventKind::Mark { text: "grasped".to_owned() },
        EventKind::Mark { text: String::new() },
        EventKind::DiskLow { folder: "out".into(), free: 1_500_000_000, seconds: 252 },
        EventKind::ClockStep { seconds: -3600.0 },
        loaded(false),
        loaded(true),
        hold("", "the next actions are still being computed"),
        EventKind::Act { tick: 12 },
        chunk(0),
        chunk(1),
        chunk(3),
        hold("a\x1b[2Jrm", "a modality that the policy requires is missing"),
        policy_end(104),
        policy_end(0),
        stop(StopKind::Emergency, InputState::Stopped, ""),
        stop(StopKind::Enabling, InputState::Runs, ""),
        stop(StopKind::Enabling, InputState::Lost, "nothing was received for 200ms"),
        EventKind::Log { level: Level::Warn, text: "something".to_owned() },
    ]
}

#[test]
fn lines_for_people_have_their_columns() {
    let columns = line::Columns { name: 9, palette: Palette::Plain };
    let lines: Vec<_> = all_events().into_iter().map(|what| columns.line(&event(what), WALL_NS)).collect();
    insta::assert_snapshot!(lines.join("\n"), @r#"
    22:13:20.000Z  cam_wrist  bit 0   attached      /dev/video0, port 1-2.3, serial CAM [2J00
    22:13:20.000Z  cam_wrist  bit 0   opened        epoch 3: unit CAM [2J00
    22:13:20.000Z  cam_wrist  bit 0   streaming     mask 0x05: /dev/video0 MJPG 640x480@30
    22:13:20.000Z  tof        bit 12  detached      (kernel)
    22:13:20.000Z  tof        bit 12  absent        mask 0x05
    22:13:20.000Z  device             unregistered  046d:0825  X not registered: no entry has this serial
    22:13:20.000Z  episode            recording     out/a.mcap
    22:13:20.000Z  episode            GOOD          out/a.mcap finished, 30.0 s, 1234 messages, 12.3 MB, 0 dropped, 2 of 3 sensors, without tof
    22:13:20.000Z  episode            SUSPECT       out/a.mcap finished, 30.0 s, 1234 messages, 12.3 MB, 3 dropped, 2 of 3 sensors, without tof: cam_wrist: 3 of 900 samples dropped on the way to the file (limit 0 %)
    22:13:20.000Z  episode            BAD           out/a.mcap.partial not whole, 30.0 s, 1234 messages, 12.3 MB, 3 dropped, 2 of 3 sensors, without tof: the file could not be written: disk full
    22:13:20.000Z  episode            BAD           out/a.mcap cut short, 30.0 s, 1234 messages, 12.3 MB, 0 dropped, 2 of 3 sensors, without tof: the file could not be written: disk nearly full
    22:13:20.000Z  episode            discarded     episode out/a.mcap is in the trash
    22:13:20.000Z  episode            restored      episode out/a.mcap is back
    22:13:20.000Z  episode            mark          mark "grasped"
    22:13:20.000Z  episode            mark          mark
    22:13:20.000Z  disk               warn          out: disk nearly full, 1.5 GB free: the episode will be closed in about 4 min
    22:13:20.000Z  clock              warn          the wall clock was set back by 3600.000 s; times of capture stay as they are
    22:13:20.000Z  policy             loaded        tactile-id loaded: 10 Hz, hash 0123456789ab, onnxruntime 1.22.0
    22:13:20.000Z  policy             dry run       tactile-id loaded: 10 Hz, hash 0123456789ab, onnxruntime 1.22.0, dry run: nothing moves
    22:13:20.000Z  policy             holds         the next actions are still being computed
    22:13:20.000Z  policy             acts          from tick 12
    22:13:20.000Z  policy             chunk         tick 40: 34.5 ms, mask 0x05
    22:13:20.000Z  policy             late chunk    tick 40: 34.5 ms, 1 action too late, mask 0x05
    22:13:20.000Z  policy             late chunk    tick 40: 34.5 ms, 3 actions too late, mask 0x05
    22:13:20.000Z  policy             holds         a modality that the policy requires is missing: a [2Jrm
    22:13:20.000Z  policy             ended         812 actions, 14 ticks held, 104 chunks, 3 late, 0 unused, latency p50 34.5 ms p99 48.0 ms
    22:13:20.000Z  policy             ended         812 actions, 14 ticks held, 0 chunks, 3 late, 0 unused
    22:13:20.000Z  pendant            pressed       emergency stop pendant pressed
    22:13:20.000Z  pendant            held          enabling switch pendant held: nothing moves until the actuator is armed again
    22:13:20.000Z  pendant            lost          enabling switch pendant lost (nothing was received for 200ms)
    22:13:20.000Z  log                warn          something
    "#);
}

#[test]
fn colours_follow_the_state_and_nothing_else_is_an_escape() {
    let columns = line::Columns { name: 9, palette: Palette::Ansi };
    let line = columns.line(&event(state("tof", 2, DeviceState::Failed, "a\x1b[31mb")), WALL_NS);
    assert!(line.contains("\x1b[1m\x1b[31mfailed      \x1b[0m"), "{line:?}");
    assert!(line.contains("a [31mb"), "{line:?}");
}

#[test]
fn json_is_the_event_with_its_wall_time() {
    let object: Value =
        serde_json::from_str(&line::json(&event(state("cam_wrist", 0, DeviceState::Streaming, "x")), WALL_NS).unwrap())
            .unwrap();
    let expected = serde_json::json!({
        "event": "state", "device": "cam_wrist", "bit": 0, "state": "streaming", "mask": "0x05", "detail": "x",
        "stamp": 0, "time": "2023-11-14T22:13:20.000Z",
    });
    assert_eq!(object, expected);
    for what in all_events() {
        let text = line::json(&event(what), WALL_NS).unwrap();
        assert!(!text.contains('\n') && !text.contains('\x1b'), "{text}");
        assert!(serde_json::from_str::<Value>(&text).unwrap()["event"].is_string(), "{text}");
    }
}

#[test]
fn the_link_to_the_page_is_printed_and_on_a_terminal_also_as_a_code() {
    let mut snapshot = three_streaming();
    snapshot.links = vec!["http://192.168.1.20:8766/#0123456789abcdefghijkl".to_owned(), "http://10.0.0.7/".to_owned()];
    let opening = |options| Printer::new(&snapshot, options).opening(&snapshot).unwrap();
    let lines = opening(HeadlessOptions::default());
    assert_eq!(
        lines.lines().skip(1).collect::<Vec<_>>(),
        snapshot.links.iter().map(|link| format!("page: {link}")).collect::<Vec<_>>()
    );
    let code = opening(HeadlessOptions { in_place: true, ..HeadlessOptions::default() });
    assert_eq!(code.lines().count(), 3 + 17, "{code}");
    assert!(code.contains("██ ▄▄▄▄▄ █"), "{code}");
    let json: Value =
        serde_json::from_str(&opening(HeadlessOptions { json: true, ..HeadlessOptions::default() })).unwrap();
    assert_eq!(json["links"], serde_json::json!(snapshot.links));
}

#[test]
fn a_run_begins_with_its_modalities() {
    let snapshot = three_streaming();
    let columns = line::Columns { name: 9, palette: Palette::Plain };
    let line = columns.begin(&snapshot, WALL_NS);
    assert_eq!(line, "22:13:20.000Z  rig bench-1 looks for cam_wrist, cam_top, tof; ctrl-c ends the run");
    let object: Value = serde_json::from_str(&line::begin_json(&snapshot, WALL_NS).unwrap()).unwrap();
    assert_eq!((&object["event"], &object["rig"]), (&"begin".into(), &"bench-1".into()));
    assert_eq!((&object["devices"][2]["device"], &object["devices"][2]["bit"]), (&"tof".into(), &2.into()));
}

#[test]
fn progress_shows_the_most_important_first() {
    let mut snapshot = every_state();
    snapshot.recording = Some(recording(2));
    let line = progress::line(&snapshot, &Rates::default(), Duration::from_secs(12), Some(Duration::from_secs(30)));
    insta::assert_snapshot!(line, @r#"00:12/00:30  mask 0x09  rec 01:23 312.4 MB 0.0 MB/s  2 dropped  cam_wrist 0.0 Hz  imu 0.0 Hz stalled"#);
    let json = progress::json(&snapshot, &Rates::default(), Duration::from_secs(12), None, WALL_NS).unwrap();
    let object: Value = serde_json::from_str(&json).unwrap();
    assert_eq!(object["event"], "progress");
    assert_eq!(object["recording"]["dropped"], 2);
    assert_eq!(object["devices"][3]["state"], "stalled");
    assert!(object.get("duration").is_none());
    assert!(object["recording"].get("disk_seconds").is_none());

    snapshot.recording = Some(RecordingStatus { room: Some(Duration::from_secs(252)), ..recording(2) });
    let line = progress::line(&snapshot, &Rates::default(), Duration::from_secs(12), None);
    assert!(line.contains("2 dropped  disk full in 04:12"), "{line}");
    let json = progress::json(&snapshot, &Rates::default(), Duration::from_secs(12), None, WALL_NS).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&json).unwrap()["recording"]["disk_seconds"], 252);
}

#[test]
fn progress_shows_the_policy() {
    let mut snapshot = three_streaming();
    let line = |snapshot: &Snapshot| progress::line(snapshot, &Rates::default(), Duration::from_secs(12), None);
    let json = |snapshot: &Snapshot| -> Value {
        let json = progress::json(snapshot, &Rates::default(), Duration::from_secs(12), None, WALL_NS).unwrap();
        serde_json::from_str::<Value>(&json).unwrap()["policy"].clone()
    };
    assert_eq!(json(&snapshot), Value::Null);
    snapshot.policy = Some(policy());
    assert!(line(&snapshot).starts_with("00:12  mask 0x07  policy acts 35 ms  cam_wrist"), "{}", line(&snapshot));
    let expected = serde_json::json!({
        "policy": "tactile-id", "dry_run": false, "mask": "0x05", "hold": null, "latency_ms": 34.52, "chunk_age": 3,
        "actions": 812, "held": 14, "chunks": 104, "late": 3, "unused": 0,
    });
    assert_eq!(json(&snapshot), expected);
    let hold = Some(Hold { device: Some("a\x1b[2Jrm".to_owned()), reason: "a modality is missing".to_owned() });
    snapshot.policy = Some(PolicyStatus { dry_run: true, hold, latency_ms: None, ..policy() });
    assert!(line(&snapshot).contains("  policy dry holds: a modality is missing: a [2Jrm  "), "{}", line(&snapshot));
    assert_eq!(
        (&json(&snapshot)["hold"], &json(&snapshot)["latency_ms"]),
        (&"a modality is missing: a\x1b[2Jrm".into(), &Value::Null)
    );
}

#[test]
fn the_summary_counts_the_policy() {
    let start = three_streaming();
    let summary = |events: &[EventKind]| {
        let mut totals = RunTotals::new(&start);
        for what in events {
            totals.count(&event(what.clone()));
        }
        totals.summary(&start)
    };
    let whole = summary(&[loaded(true), policy_end(104)]);
    let object = serde_json::to_value(&whole).unwrap();
    let expected = serde_json::json!({
        "policy": "tactile-id", "dry_run": true, "actions": 812, "held": 14, "chunks": 104, "late": 3, "unused": 0,
        "latency_p50_ms": 34.52, "latency_p99_ms": 48.0,
    });
    assert_eq!(object["policy"], expected);
    let text = whole.text(9, Palette::Plain);
    let expected = "policy   tactile-id  dry run  812 actions, 14 ticks held, 104 chunks, 3 late, 0 unused, latency p50 34.5 ms p99 48.0 ms";
    assert!(text.lines().any(|line| line == expected), "{text}");
    for events in [&[][..], &[loaded(false)]] {
        assert_eq!(serde_json::to_value(summary(events)).unwrap().get("policy"), None);
    }
}

#[test]
fn timely_chunks_are_printed_only_as_json() {
    let snapshot = three_streaming();
    let print = |json, what: EventKind| {
        let options = HeadlessOptions { json, ..HeadlessOptions::default() };
        Printer::new(&snapshot, options).event(&event(what)).unwrap()
    };
    assert_eq!(print(false, chunk(0)), "");
    assert!(print(false, chunk(2)).contains("late chunk    tick 40"));
    assert!(print(true, chunk(0)).contains(r#""event":"chunk""#));
}

#[test]
fn the_mean_rate_excludes_the_time_that_closing_takes() {
    let start = three_streaming();
    let at = |ms: u64| Stamp(start.taken.0 + ms * 1_000_000);
    // 20 Hz for 2 s; then closing takes 2 s, after which the device is announced as gone, or the run ends before that.
    for announced in [true, false] {
        let mut totals = RunTotals::new(&start);
        if announced {
            totals.count(&Event { stamp: at(4000), what: state("cam_wrist", 0, DeviceState::Absent, "") });
        }
        // Silence does not count as closing.
        totals.count(&Event { stamp: at(3000), what: state("cam_top", 1, DeviceState::Stalled, "") });
        let mut end = start.clone();
        end.taken = at(4000);
        for device in &mut end.devices {
            device.samples += 40;
            device.newest = Some(at(1950));
        }
        let object = serde_json::to_value(totals.summary(&end)).unwrap();
        assert_eq!((&object["devices"][0]["hz"], &object["devices"][1]["hz"]), (&20.0.into(), &10.0.into()));
        assert_eq!(object["devices"][0]["present"], 1.0);
    }
}

#[test]
fn the_summary_counts_from_its_beginning_and_averages_over_presence() {
    let start = three_streaming();
    let mut totals = RunTotals::new(&start);
    let at = |seconds: u64| Stamp(start.taken.0 + seconds * 1_000_000_000);
    // Present from 0 to 4 s and from 9 s to the end: half of the run.
    for (seconds, to) in
        [(4, DeviceState::Absent), (8, DeviceState::Opening), (9, DeviceState::Streaming), (9, DeviceState::Stalled)]
    {
        totals.count(&Event { stamp: at(seconds), what: state("cam_wrist", 0, to, "") });
    }
    totals.count(&Event { stamp: at(9), what: episode(3, None) });
    let mut end = start.clone();
    end.taken = at(10);
    for device in &mut end.devices {
        device.samples += 150;
        device.gaps += u64::from(device.id.bit());
    }
    let summary = totals.summary(&end);
    let object = serde_json::to_value(&summary).unwrap();
    assert_eq!(object["event"], "summary");
    assert_eq!(object["devices"][0]["samples"], 150);
    assert_eq!(object["devices"][0]["present"], 0.5);
    assert_eq!(object["devices"][0]["hz"], 30.0);
    assert_eq!(object["devices"][1]["hz"], 15.0);
    assert_eq!(object["devices"][2]["gaps"], 2);
    assert_eq!(object["episodes"][0]["file"], "out/a.mcap");
    assert_eq!(object["episodes"][0]["verdict"], "SUSPECT");
    assert_eq!(object["episodes"][0]["reasons"].as_array().map(Vec::len), Some(1));
    insta::assert_snapshot!(summary.text(9, Palette::Plain), @r#"
    modality   bit    samples   mean Hz  present     gaps      bytes
    cam_wrist    0        150      30.0    50.0%        0        0 B
    cam_top      1        150      15.0   100.0%        1        0 B
    tof          2        150      15.0   100.0%        2        0 B
    SUSPECT  out/a.mcap  30.0 s  1234 messages  12.3 MB  3 dropped  2 of 3 sensors, without tof
             cam_wrist: 3 of 900 samples dropped on the way to the file (limit 0 %)
    10.0 s in all
    "#);
}

#[tokio::test]
async fn announcements_before_the_end_are_printed_and_summarized() {
    let board = Arc::new(board(&["cam_wrist", "tof"]));
    let shutdown = CancellationToken::new();
    let kept = Kept::default();
    let options = HeadlessOptions::default();
    let output = run(Arc::clone(&board), board.events(), shutdown.clone(), options, kept.clone());
    // Announced after the call and before the first poll: not lost.
    board.set_device_state(id(0), DeviceState::Streaming, Epoch(1), "");
    board.announce(state("cam_wrist", 0, DeviceState::Streaming, "/dev/video0"));
    board.counters(id(0)).count(100, Stamp::now(), 0);
    board.announce(episode(0, None));
    shutdown.cancel();
    output.await.unwrap();
    let text = kept.text();
    assert!(text.contains("cam_wrist  bit 0   streaming     mask 0x05: /dev/video0\n"), "{text}");
    assert!(
        text.contains("GOOD     out/a.mcap  30.0 s  1234 messages  12.3 MB  0 dropped  2 of 3 sensors, without tof\n"),
        "{text}"
    );
    assert!(text.contains("cam_wrist    0          1"), "{text}");
}

#[tokio::test]
async fn every_json_line_is_an_object_and_missed_events_are_reported() {
    let board = Arc::new(board(&["cam_wrist"]));
    let shutdown = CancellationToken::new();
    let kept = Kept::default();
    let options = HeadlessOptions { json: true, ..HeadlessOptions::default() };
    let output = run(Arc::clone(&board), board.events(), shutdown.clone(), options, kept.clone());
    // More than the board keeps for a slow reader.
    for _ in 0..5000 {
        board.announce(EventKind::Log { level: Level::Info, text: "x".to_owned() });
    }
    shutdown.cancel();
    output.await.unwrap();
    let text = kept.text();
    let objects: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let missed = objects.iter().find(|object| object["event"] == "missed").unwrap();
    let count = missed["count"].as_u64().unwrap();
    let logged = objects.iter().filter(|object| object["event"] == "log").count() as u64;
    assert_eq!(count + logged, 5000);
    let summary = objects.last().unwrap();
    assert_eq!(summary["event"], "summary");
    assert_eq!(summary["missed_events"], count);
}

#[tokio::test]
async fn a_closed_pipe_is_a_clean_end_without_a_shutdown() {
    let board = Arc::new(board(&["cam_wrist"]));
    let (reader, writer) = io::pipe().unwrap();
    drop(reader);
    let output = run(Arc::clone(&board), board.events(), CancellationToken::new(), HeadlessOptions::default(), writer);
    board.announce(EventKind::Log { level: Level::Info, text: "x".to_owned() });
    output.await.unwrap();
}

#[test]
fn progress_in_place_is_erased_before_a_line() {
    let snapshot = three_streaming();
    let options = HeadlessOptions { in_place: true, ..HeadlessOptions::default() };
    let mut printer = Printer::new(&snapshot, options);
    let piece = printer.progress(&snapshot).unwrap().unwrap();
    assert!(piece.starts_with(ERASE_LINE) && !piece.contains('\n'), "{piece:?}");
    let line = printer.event(&event(episode(0, None))).unwrap();
    assert!(line.starts_with(ERASE_LINE) && line.ends_with('\n'), "{line:?}");
    let line = printer.event(&event(episode(0, None))).unwrap();
    assert!(!line.contains(ERASE_LINE), "{line:?}");

    let mut printer = Printer::new(&snapshot, HeadlessOptions::default());
    assert_eq!(printer.progress(&snapshot).unwrap(), None);
    let mut later = snapshot.clone();
    later.taken = later.taken.after(PROGRESS_LINE);
    let piece = printer.progress(&later).unwrap().unwrap();
    assert!(piece.starts_with("00:10  mask 0x07") && piece.ends_with('\n'), "{piece:?}");

    let mut printer = Printer::new(&snapshot, HeadlessOptions { json: true, ..HeadlessOptions::default() });
    let piece = printer.progress(&later).unwrap().unwrap();
    assert!(piece.contains("\"event\":\"progress\"") && piece.ends_with('\n'), "{piece:?}");
}
