//! Literal snapshots and boards, for tests of screens.
#![allow(dead_code, reason = "each crate of screens uses a part of it")]

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Encoding, Epoch};
use rapid_core::sync::WhenStale;
use rapid_core::time::Stamp;
use rapid_registry::{CameraSpec, DeviceSpec, IdentitySpec, NodeSpec, PixelFormat, Registry, RigSpec, UsbSpec};

use rapid_status::{
    Board, DeviceState, DeviceStatus, Level, LogLine, Outlook, PolicyStatus, RecordingStatus, Snapshot,
};

/// Moment of the snapshots: 754 s after the boot.
pub(crate) const TAKEN: Stamp = Stamp(754_000_000_000);
/// Wall time of the first log line, ns: 2023-11-14 22:13:20 UTC.
pub(crate) const WALL_NS: u64 = 1_700_000_000_000_000_000;

pub(crate) fn id(bit: u8) -> ModalityId {
    ModalityId::new(bit).unwrap()
}

pub(crate) fn device(bit: u8, name: &str, state: DeviceState, detail: &str) -> DeviceStatus {
    let running = state.is_present();
    let age = if state == DeviceState::Stalled { 2345 } else { 12 + u64::from(bit) };
    DeviceStatus {
        name: name.to_owned(),
        id: id(bit),
        topic: format!("/rapid/{name}"),
        state,
        epoch: Epoch(1),
        detail: detail.to_owned(),
        nominal_hz: None,
        samples: if running { 18_000 + u64::from(bit) } else { 0 },
        gaps: 0,
        bytes: if running { 540_000_000 } else { 0 },
        newest: running.then(|| TAKEN.before(Duration::from_millis(age))),
    }
}

/// A snapshot of these devices; the mask follows from their states.
pub(crate) fn snapshot(devices: Vec<DeviceStatus>) -> Snapshot {
    let mask = devices.iter().fold(PhysicalMask::EMPTY, |mask, device| mask.with(device.id, device.state.is_present()));
    Snapshot {
        rig: "bench-1".to_owned(),
        taken: TAKEN,
        uptime: Duration::from_secs(754),
        mask,
        mask_sequence: 377_000,
        devices,
        unregistered: Vec::new(),
        registry_answer: None,
        stops: Vec::new(),
        recording: None,
        not_started: None,
        policy: None,
        last_episode: None,
        last_verdict: None,
        session: None,
        disk_free: None,
        links: Vec::new(),
        simulated: false,
        log: Vec::new(),
        details: Vec::new(),
        previews: Vec::new(),
    }
}

pub(crate) fn three_streaming() -> Snapshot {
    snapshot(vec![
        device(0, "cam_wrist", DeviceState::Streaming, "/dev/video0 MJPG 640x480@30"),
        device(1, "cam_top", DeviceState::Streaming, "/dev/video2 MJPG 640x480@30"),
        device(2, "tof", DeviceState::Streaming, "/dev/ttyACM0 115200 csv 8"),
    ])
}

pub(crate) fn every_state() -> Snapshot {
    let mut snapshot = snapshot(vec![
        device(0, "cam_wrist", DeviceState::Streaming, "/dev/video0 MJPG 640x480@30"),
        device(1, "cam_top", DeviceState::Absent, ""),
        device(2, "tof", DeviceState::Opening, "/dev/ttyACM0"),
        device(3, "imu", DeviceState::Stalled, "no sample for 500 ms"),
        device(4, "gripper", DeviceState::Failed, "/dev/ttyACM1: permission denied, is the user in group dialout?"),
        device(5, "tactile", DeviceState::Backoff, "again in 2 s: device busy"),
    ]);
    snapshot.devices[3].gaps = 3;
    snapshot.log = vec![
        line(0, Level::Info, "cam_wrist is streaming"),
        line(1, Level::Warn, "imu: no sample for 500 ms"),
        line(2, Level::Error, "gripper: permission denied"),
        line(3, Level::Debug, "details"),
    ];
    snapshot
}

pub(crate) fn recording(dropped: u64) -> RecordingStatus {
    RecordingStatus {
        file: PathBuf::from("episodes/2023-11-14_place-block_007.mcap"),
        elapsed: Duration::from_secs(83),
        messages: 48_211,
        bytes: 312_400_000,
        dropped,
        room: None,
        outlook: Outlook::default(),
    }
}

/// A policy that acts on an arm of four axes and observed the first and the third modality.
pub(crate) fn policy() -> PolicyStatus {
    let axis = |name: &str, value: f64, unit: &str| (name.to_owned(), value, unit.to_owned());
    PolicyStatus {
        name: "tactile-id".to_owned(),
        dry_run: false,
        mask: PhysicalMask(0b101),
        latency_ms: Some(34.52),
        chunk_age: Some(3),
        action: vec![axis("x", 0.123_4, "m"), axis("y", -0.021_3, "m"), axis("z", 0.187, "m"), axis("grip", 0.5, "1")],
        hold: None,
        actions: 812,
        held: 14,
        chunks: 104,
        late: 3,
        unused: 0,
    }
}

pub(crate) fn sixty_four() -> Snapshot {
    let state = |bit: u8| match bit % 8 {
        3 => DeviceState::Absent,
        5 => DeviceState::Opening,
        _ => DeviceState::Streaming,
    };
    snapshot((0..64).map(|bit| device(bit, &format!("sensor_{bit}"), state(bit), "/dev/ttyACM0")).collect())
}

/// A line of the log whose number is its second, about the device of its first word.
pub(crate) fn line(second: u64, level: Level, text: &str) -> Arc<LogLine> {
    let device = text.split([':', ' ']).next().filter(|word| word.starts_with(char::is_alphabetic)).map(str::to_owned);
    let (wall_ns, text) = (WALL_NS + second * 1_000_000_000, text.to_owned());
    Arc::new(LogLine { number: second, wall_ns, level, device, printed: None, text })
}

/// A board for devices of these names, at bits 0, 1, ...
pub(crate) fn board(names: &[&str]) -> Board {
    let device = |(bit, name): (usize, &&str)| DeviceSpec {
        name: (*name).to_owned(),
        id: id(u8::try_from(bit).unwrap()),
        identity: IdentitySpec::Usb(UsbSpec { vid: 0x046d, pid: 0x0825, serial: None, port: None }),
        node: NodeSpec::Camera(CameraSpec {
            width: 640,
            height: 480,
            fps: 30,
            format: PixelFormat::Mjpg,
            depth_unit_um: 1000,
            controls: Vec::new(),
        }),
        topic: format!("/rapid/{name}"),
        mount: None,
        stall_after: Duration::from_millis(500),
        max_bytes: 1 << 20,
        depth: 8,
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
    };
    Board::new(&Registry {
        inference: rapid_registry::InferenceSpec::default(),
        export: rapid_registry::ExportSpec::default(),
        rig: RigSpec {
            name: "bench-1".to_owned(),
            observation_hz: 30.0,
            sync_window: Duration::from_millis(25),
            cooldown: Duration::from_secs(2),
            memory_budget: 1 << 29,
            disk_reserve: None,
            expect: Vec::new(),
        },
        devices: names.iter().enumerate().map(device).collect(),
        modules: Vec::new(),
        stops: Vec::new(),
        buttons: Vec::new(),
        path: None,
        text: String::new(),
    })
}

/// A sample without content.
pub(crate) fn preview() -> rapid_status::preview::Preview {
    let device = ModalityId::new(0).unwrap_or_else(|| unreachable!());
    let (captured, encoding, payload) = (Stamp(0), Encoding::Bytes, Arc::from([]));
    rapid_status::preview::Preview { device, seq: 0, captured, encoding, width: 0, height: 0, bytes: 0, payload }
}
