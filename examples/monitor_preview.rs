//! The monitor on a board that only this program writes: for looking at the screen.
//!
//! `cargo run --example monitor_preview [DEVICES]` shows up to 64 devices (default 6) that come, go,
//! stall and fail; space starts and ends a pretended episode. With `--headless` or `--json` behind
//! it, the same is printed for 40 seconds.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::mask::{PhysicalMask, SizedMask};
use rapid_core::modality::ModalityId;
use rapid_core::sample::Epoch;
use rapid_core::sync::WhenStale;
use rapid_core::time::Stamp;
use rapid_registry::{
    CameraSpec, DeviceSpec, ExportSpec, IdentitySpec, InferenceSpec, NodeSpec, PixelFormat, Registry, RigSpec, UsbSpec,
};
use rapid_screens::headless::{self, HeadlessOptions};
use rapid_screens::tui::{self, ScreenOptions};
use rapid_status::session::SessionRequest;
use rapid_status::{Board, Command, DeviceState, EventKind, Level, Outlook, RecordingStatus};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

const NAMES: [&str; 6] = ["cam_wrist", "cam_top", "tof", "gripper", "tactile_left", "tactile_right"];

#[tokio::main]
async fn main() -> Result<(), tui::TuiError> {
    let count = std::env::args().nth(1).and_then(|count| count.parse().ok()).unwrap_or(6_u8).clamp(1, 64);
    let board = Arc::new(Board::new(&registry(count)));
    let (sender, commands) = mpsc::channel(8);
    let shutdown = CancellationToken::new();
    let rig = tokio::spawn(pretend(Arc::clone(&board), count, commands, shutdown.clone()));
    let form = std::env::args().nth(2);
    let outcome = match form {
        Some(form) => {
            let duration = Duration::from_secs(40);
            let json = form == "--json";
            let options = HeadlessOptions { json, duration: Some(duration), ..Default::default() };
            let output =
                headless::run(Arc::clone(&board), board.events(), shutdown.clone(), options, std::io::stdout());
            // It stands in for the end of the run; when the output ended before, there is nothing to end.
            let end = async {
                tokio::time::sleep(duration).await;
                shutdown.cancel();
            };
            tokio::select! {
                biased;
                outcome = output => outcome.map_err(tui::TuiError::Gone),
                () = async { end.await; std::future::pending().await } => Ok(()),
            }
        }
        None => tui::run(board, sender, Arc::default(), ScreenOptions::default(), shutdown.clone()).await,
    };
    shutdown.cancel();
    // It ends by the token.
    let _ = rig.await;
    outcome
}

fn registry(count: u8) -> Registry {
    let device = |bit: u8| {
        let name = NAMES.get(usize::from(bit)).map_or_else(|| format!("sensor_{bit}"), |name| (*name).to_owned());
        Some(DeviceSpec {
            topic: format!("/rapid/{name}"),
            name,
            id: ModalityId::new(bit)?,
            identity: IdentitySpec::Usb(UsbSpec { vid: 0x046d, pid: 0x0825, serial: None, port: None }),
            node: NodeSpec::Camera(CameraSpec {
                width: 640,
                height: 480,
                fps: 30,
                format: PixelFormat::Mjpg,
                depth_unit_um: 1000,
                controls: Vec::new(),
            }),
            mount: None,
            stall_after: Duration::from_millis(500),
            max_bytes: 1 << 20,
            depth: 8,
            when_stale: WhenStale::Hold,
            verdict: rapid_registry::VerdictSpec::defaults(
                rapid_core::modality::ModalityKind::Image,
                std::time::Duration::from_millis(500),
                None,
            ),
            latency: Duration::ZERO,
            form: None,
            action: None,
            hooks: rapid_registry::Hooks::default(),
        })
    };
    Registry {
        inference: InferenceSpec::default(),
        export: ExportSpec::default(),
        rig: RigSpec {
            name: "bench-1".to_owned(),
            observation_hz: 30.0,
            sync_window: Duration::from_millis(25),
            cooldown: Duration::from_secs(2),
            memory_budget: 1 << 29,
            disk_reserve: None,
            expect: Vec::new(),
        },
        devices: (0..count).filter_map(device).collect(),
        modules: Vec::new(),
        stops: Vec::new(),
        buttons: Vec::new(),
        path: None,
        text: String::new(),
    }
}

async fn pretend(board: Arc<Board>, count: u8, mut commands: mpsc::Receiver<Command>, shutdown: CancellationToken) {
    let begun = Stamp::now();
    let mut states = vec![DeviceState::Absent; usize::from(count)];
    let mut sequence = 0;
    let mut episode: Option<(Stamp, PathBuf, u64)> = None;
    let mut beat = tokio::time::interval(Duration::from_millis(10));
    loop {
        tokio::select! {
            () = shutdown.cancelled() => return,
            Some(command) = commands.recv() => match command {
                Command::Quit => shutdown.cancel(),
                Command::Session(SessionRequest::Toggle) => match episode.take() {
                    Some((_, file, _)) => {
                        report(&board, Level::Info, &format!("episode {} finished", file.display()));
                        board.set_last_episode(file, pretended());
                    }
                    None => episode = Some((Stamp::now(), "episodes/2026-01-01_place-block_001.mcap".into(), 0)),
                },
                // Its episodes and its registry have no file, and its devices no cable.
                Command::Session(_)
                | Command::Plug(_)
                | Command::Reload
                | Command::Register { .. }
                | Command::Control { .. }
                | Command::Look(_) => {}
                Command::Restart(id) => states[id.index()] = DeviceState::Absent,
            },
            _ = beat.tick() => {}
        }
        let now = Stamp::now();
        let elapsed = now.since(begun).as_millis();
        sequence += 5;
        let mut mask = PhysicalMask::EMPTY;
        for (index, before) in states.iter_mut().enumerate() {
            let bit = u8::try_from(index).unwrap_or(0);
            let Some(id) = ModalityId::new(bit) else { continue };
            let state = script(u64::try_from(elapsed).unwrap_or(0), u64::from(bit));
            if state != *before {
                *before = state;
                board.set_device_state(id, state, Epoch(1), detail(state));
                board.announce(EventKind::State {
                    device: NAMES.get(index).copied().unwrap_or("sensor").to_owned(),
                    bit: id,
                    state,
                    mask: SizedMask { mask: board.snapshot().mask, devices: usize::from(count) },
                    detail: detail(state).to_owned(),
                });
                let level = if state == DeviceState::Failed { Level::Error } else { Level::Info };
                report(&board, level, &format!("bit {bit} is {state:?}, {}", detail(state)));
            }
            if state == DeviceState::Streaming && sequence % (5 * (1 + u64::from(bit) % 4)) == 0 {
                board.counters(id).count(30_000, now, u64::from(sequence % 5000 == 0));
                if let Some((_, _, messages)) = &mut episode {
                    *messages += 1;
                }
            }
            mask = mask.with(id, matches!(state, DeviceState::Streaming | DeviceState::Stalled));
        }
        board.set_mask(mask, sequence);
        board.set_recording(episode.as_ref().map(|(start, file, messages)| RecordingStatus {
            file: file.clone(),
            elapsed: now.since(*start),
            messages: *messages,
            bytes: messages * 30_000,
            dropped: messages / 2000,
            room: None,
            outlook: Outlook::default(),
        }));
    }
}

/// Each device goes through a life of its own, 40 s long.
fn script(elapsed_ms: u64, bit: u64) -> DeviceState {
    match (elapsed_ms + bit * 6500) % 40_000 {
        0..2_000 => DeviceState::Opening,
        2_000..28_000 => DeviceState::Streaming,
        28_000..30_000 => DeviceState::Stalled,
        30_000..33_000 => DeviceState::Absent,
        33_000..36_000 => DeviceState::Backoff,
        _ => DeviceState::Failed,
    }
}

fn detail(state: DeviceState) -> &'static str {
    match state {
        DeviceState::Streaming | DeviceState::Opening => "/dev/video0 MJPG 640x480@30",
        DeviceState::Stalled => "no sample for 500 ms",
        DeviceState::Backoff => "again in 2 s: device busy",
        DeviceState::Failed => "/dev/video0: permission denied, is the user in group video?",
        DeviceState::Absent => "",
    }
}

fn report(board: &Board, level: Level, text: &str) {
    board.log(level, text);
}

/// The verdict on an episode that was never recorded.
fn pretended() -> rapid_status::Verdict {
    rapid_status::Verdict {
        grade: rapid_status::Grade::Good,
        reasons: Vec::new(),
        sensors: None,
        replay_of: Vec::new(),
    }
}
