//! The whole owner with scripted hot-plug and simulated devices, under the real runtime.

use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering};
use std::task::{Context, Wake, Waker};

use futures::channel::mpsc::{UnboundedSender, unbounded};
use futures::future::BoxFuture;
use rapid_core::action::Order;
use rapid_core::provenance::UnplugSource;
use rapid_core::sync::WhenStale;
use rapid_devices::hotplug::{HotplugError, HotplugEvent};
use rapid_registry::device::{DeviceNode, UsbIdentity};
use rapid_registry::simulation::{SimDevice, SimSource};
use rapid_registry::{
    ExportSpec, Framing, IdentitySpec, InferenceSpec, LanFind, LanProtocol, LanSpec, NodeSpec, Parse, RigSpec,
    SerialSpec, UsbSpec,
};
use rapid_status::Event;
use tokio::sync::{broadcast, watch};

use super::*;
use crate::patience::PATIENCE;
use crate::rig::presence::{Claim, read_mask};

mod actuator;

const CHANNELS: usize = 2;
/// Two interchangeable entries, `a` and `b`.
fn registry(cooldown: Duration, stall_after: Duration) -> Registry {
    let serial = SerialSpec { baud: 115_200, framing: Framing::Line, parse: Parse::Csv, channels: CHANNELS };
    let device = |(bit, name): (u8, &str)| DeviceSpec {
        name: name.into(),
        id: ModalityId::new(bit).expect("below 64"),
        identity: IdentitySpec::Usb(UsbSpec { vid: 1, pid: 2, serial: None, port: None }),
        node: NodeSpec::Serial(serial.clone()),
        topic: format!("/rapid/serial/{name}"),
        mount: None,
        stall_after,
        max_bytes: 64,
        depth: 16,
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
    Registry {
        inference: InferenceSpec::default(),
        export: ExportSpec::default(),
        rig: RigSpec {
            name: "test".into(),
            observation_hz: 30.0,
            sync_window: Duration::from_millis(25),
            cooldown,
            memory_budget: 1 << 20,
            disk_reserve: None,
            expect: Vec::new(),
        },
        devices: [(0, "a"), (1, "b")].into_iter().map(device).collect(),
        modules: Vec::new(),
        stops: Vec::new(),
        buttons: Vec::new(),
        path: None,
        text: String::new(),
    }
}

#[derive(Clone)]
enum Step {
    /// A unit of the model, which sends this many numbers, is reported as attached at a port.
    Plug(&'static str, usize),
    /// The cable is pulled: the device notices, hot-plug has not reported it yet.
    Pull(&'static str),
    /// Hot-plug reports the removal at a port.
    Removed(&'static str, UnplugSource),
    Silence(&'static str),
    Resume(&'static str),
    Restart(u8),
    /// The operator gives an order.
    Give(Order),
    /// Receives events up to this one.
    Until(&'static str),
    /// The mask that other processes read becomes this.
    Mask(u64),
    /// The units without an entry on the board become those at these ports.
    Unregistered(&'static [&'static str]),
    /// A network adapter is reported as attached; its carrier is in a file of this folder.
    Adapter(PathBuf),
    /// Receives events until a logged one contains this.
    Logged(&'static str),
    /// The adapter's link comes up after this delay.
    Link(PathBuf, Duration),
}
use Step::{Adapter, Give, Link, Logged, Mask, Plug, Pull, Removed, Restart, Resume, Silence, Unregistered, Until};

struct Bench {
    hotplug: UnboundedSender<Result<HotplugEvent, HotplugError>>,
    commands: mpsc::Sender<RigCommand>,
    permission: Arc<Permission>,
    board: Arc<Board>,
    events: broadcast::Receiver<Event>,
    units: HashMap<&'static str, Arc<SimDevice>>,
    path: PathBuf,
    reported: Vec<String>,
}

impl Bench {
    async fn step(&mut self, step: &Step) {
        match step {
            Plug(port, channels) => {
                let source = SimSource::Serial { channels: *channels, hz: 200, seed: 1 };
                let unit = Arc::new(SimDevice::new(port, source, Stamp::now()));
                self.units.insert(port, Arc::clone(&unit));
                let usb = UsbIdentity { vid: 1, pid: 2, serial: None, port: (*port).into(), ..UsbIdentity::default() };
                let syspath = PathBuf::from("/test").join(port);
                self.notify(HotplugEvent::Added(Attachment {
                    syspath,
                    node: DeviceNode::Sim(unit),
                    unit: usb.into(),
                    driver: None,
                    formats: Vec::new(),
                }));
            }
            Pull(port) => self.units[port].unplug(),
            Removed(port, source) => {
                let syspath = PathBuf::from("/test").join(port);
                self.notify(HotplugEvent::Removed { syspath, noticed: Stamp::now(), source: *source });
            }
            Silence(port) => self.units[port].set_silent(true),
            Resume(port) => self.units[port].set_silent(false),
            Restart(bit) => {
                let id = ModalityId::new(*bit).expect("below 64");
                self.commands.send(RigCommand::Restart(id)).await.expect("rig");
            }
            Give(order) => {
                let _ = match order {
                    Order::Arm | Order::ArmBack => self.permission.arm(Stamp::now(), Stamp::now()),
                    Order::Disarm | Order::Emergency(_) => {
                        self.permission.disarm(Stamp::now());
                        Ok(())
                    }
                };
            }
            Until(wanted) => loop {
                let event = timeout(PATIENCE, self.events.recv()).await;
                let event = event.unwrap_or_else(|_| panic!("no {wanted:?} after {:?}", self.reported)).expect("event");
                let Some(word) = word(&event.what) else { continue };
                self.reported.push(word.clone());
                if word == *wanted {
                    return;
                }
            },
            Unregistered(ports) => {
                let begun = Instant::now();
                loop {
                    let units = self.board.snapshot().unregistered;
                    let is_at = |(unit, port): (&rapid_status::UnregisteredDevice, &&str)| {
                        unit.device == format!("0001:0002  port {port}  no serial  (no product name)")
                            && (unit.node.as_str(), unit.name.is_none()) == ("serial", true)
                    };
                    if units.len() == ports.len() && units.iter().zip(*ports).all(is_at) {
                        return;
                    }
                    assert!(begun.elapsed() < PATIENCE, "{units:?} instead of {ports:?}");
                    sleep(Duration::from_millis(1)).await;
                }
            }
            Adapter(folder) => {
                let usb = UsbIdentity { vid: 1, pid: 2, port: "1".into(), ..UsbIdentity::default() };
                self.notify(HotplugEvent::Added(Attachment {
                    syspath: PathBuf::from("/test/1"),
                    node: DeviceNode::Net(folder.display().to_string()),
                    unit: usb.into(),
                    driver: None,
                    formats: Vec::new(),
                }));
            }
            Logged(wanted) => loop {
                let event = timeout(PATIENCE, self.events.recv()).await;
                let event = event.unwrap_or_else(|_| panic!("no {wanted:?} after {:?}", self.reported)).expect("event");
                self.reported.extend(word(&event.what));
                if matches!(&event.what, EventKind::Log { text, .. } if text.contains(wanted)) {
                    return;
                }
            },
            Link(folder, after) => {
                sleep(*after).await;
                std::fs::write(folder.join("carrier"), "1\n").expect("written");
            }
            Mask(wanted) => {
                let begun = Instant::now();
                while !read_mask(&self.path).is_ok_and(|record| record.mask.0 == *wanted) {
                    assert!(begun.elapsed() < PATIENCE, "mask is not {wanted:#x} after {:?}", self.reported);
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
            }
        }
    }

    fn notify(&self, event: HotplugEvent) {
        self.hotplug.unbounded_send(Ok(event)).expect("rig");
    }
}

fn word(what: &EventKind) -> Option<String> {
    match what {
        EventKind::Attach { device, unit, .. } => Some(format!("{device} at {}", unit.place())),
        EventKind::Detach { device, source, .. } => Some(format!("{device} gone {}", source.word())),
        EventKind::State { device, state, .. } => Some(format!("{device} {}", state.word())),
        EventKind::Unregistered { .. } => Some("unused".into()),
        EventKind::Actuator { device, arming, .. } => Some(format!("{device} {}", arming.word())),
        _ => None,
    }
}

async fn reported(cooldown: Duration, stall_after: Duration, steps: &[Step]) -> Vec<String> {
    reported_of(&registry(cooldown, stall_after), false, steps).await
}

/// The reports from these steps to the end of the run, by a rig that is armed at the start or not.
async fn reported_of(registry: &Registry, arm: bool, steps: &[Step]) -> Vec<String> {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let name = format!("owner{}x{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
    let path = PathBuf::from(format!("/dev/shm/rapid_test_mask_{name}"));
    let board = Arc::new(Board::new(registry));
    let bus = Bus::open(registry, Some(&name)).expect("bus");
    let claim = Claim::new(&path, 2).expect("claim");
    let presence = Presence::start(claim, bus.writer(TopicId::Mask).expect("mask"), Arc::clone(&board)).expect("mask");
    let (hotplug, plugged) = unbounded();
    let (commands, asked) = mpsc::channel(4);
    let stop = CancellationToken::new();
    let permission = Arc::new(Permission::new(arm));
    let mut rig = Rig::new(registry, &bus, presence, Arc::clone(&board)).obeying(&permission);
    let mut bench = Bench {
        hotplug,
        commands,
        permission,
        board: Arc::clone(&board),
        events: board.events(),
        units: HashMap::new(),
        path,
        reported: Vec::new(),
    };
    let running = tokio::spawn({
        let stop = stop.clone();
        async move { rig.run(Box::pin(plugged), asked, stop).await }
    });
    for step in steps {
        bench.step(step).await;
    }
    stop.cancel();
    running.await.expect("no panic").expect("no error");
    while let Ok(event) = bench.events.try_recv() {
        bench.reported.extend(word(&event.what));
    }
    bench.reported
}

#[expect(clippy::too_many_lines, reason = "a table")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_first_witness_wins_and_no_replug_is_lost() {
    let up: &[&str] = &["a at 1", "a opening", "a streaming"];
    let table: &[(&str, &[Step], &[&str])] = &[
        (
            "the kernel first, then the stream, then udev",
            &[
                Plug("1", CHANNELS),
                Until("a streaming"),
                Mask(1),
                Removed("1", UnplugSource::Kernel),
                Until("a absent"),
                Mask(0),
                Pull("1"),
                Removed("1", UnplugSource::Udev),
                Plug("1", CHANNELS),
                Until("a streaming"),
                Mask(1),
            ],
            &["a gone kernel", "a absent", "a at 1", "a backoff", "a opening", "a streaming"],
        ),
        (
            "the stream first, then the kernel",
            &[
                Plug("1", CHANNELS),
                Until("a streaming"),
                Pull("1"),
                Until("a absent"),
                Mask(0),
                Removed("1", UnplugSource::Kernel),
                Plug("1", CHANNELS),
                Until("a streaming"),
                Mask(1),
            ],
            &["a gone stream", "a absent", "a at 1", "a backoff", "a opening", "a streaming"],
        ),
        (
            "removal and replug in one breath: the old stream's end is not a second unplug",
            &[
                Plug("1", CHANNELS),
                Until("a streaming"),
                Removed("1", UnplugSource::Enumeration),
                Plug("1", CHANNELS),
                Until("a streaming"),
                Mask(1),
            ],
            &["a gone enumeration", "a absent", "a at 1", "a backoff", "a opening", "a streaming"],
        ),
        (
            "a unit seen in its new port before its old one is empty waits, as do two",
            &[
                Plug("1", CHANNELS),
                Until("a streaming"),
                Plug("2", CHANNELS),
                Until("b streaming"),
                Plug("3", CHANNELS),
                Plug("4", CHANNELS),
                Until("unused"),
                Until("unused"),
                Mask(3),
                Removed("1", UnplugSource::Kernel),
                Until("a streaming"),
                Removed("2", UnplugSource::Kernel),
                Until("b streaming"),
                Mask(3),
            ],
            &[
                "b at 2",
                "b opening",
                "b streaming",
                "unused",
                "unused",
                "a gone kernel",
                "a absent",
                "a at 3",
                "a backoff",
                "a opening",
                "a streaming",
                "b gone kernel",
                "b absent",
                "b at 4",
                "b backoff",
                "b opening",
                "b streaming",
            ],
        ),
        (
            "silence is not a removal",
            &[
                Plug("1", CHANNELS),
                Until("a streaming"),
                Silence("1"),
                Until("a stalled"),
                Mask(1),
                Resume("1"),
                Until("a streaming"),
                Mask(1),
            ],
            &["a stalled", "a streaming"],
        ),
    ];
    for (name, steps, expected) in table {
        let got = reported(Duration::from_millis(100), Duration::from_millis(150), steps).await;
        assert_eq!(got, [up, *expected].concat(), "{name}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn units_without_an_entry_are_on_the_board_while_they_are_plugged_in() {
    let steps = [
        Plug("1", CHANNELS),
        Plug("2", CHANNELS),
        Unregistered(&[]),
        Plug("3", CHANNELS),
        Plug("4", CHANNELS),
        Unregistered(&["3", "4"]),
        Removed("3", UnplugSource::Kernel),
        Unregistered(&["4"]),
        // The other takes the entry that is free.
        Removed("1", UnplugSource::Kernel),
        Unregistered(&[]),
    ];
    reported(Duration::ZERO, Duration::MAX, &steps).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn devices_are_notified_of_the_episode_in_progress() {
    let name = format!("ownere{}", std::process::id());
    let path = PathBuf::from(format!("/dev/shm/rapid_test_mask_{name}"));
    let registry = registry(Duration::from_millis(100), Duration::from_millis(150));
    let board = Arc::new(Board::new(&registry));
    let bus = Bus::open(&registry, Some(&name)).expect("bus");
    let claim = Claim::new(&path, 2).expect("claim");
    let presence = Presence::start(claim, bus.writer(TopicId::Mask).expect("mask"), Arc::clone(&board)).expect("mask");
    let (hotplug, plugged) = unbounded();
    let (commands, asked) = mpsc::channel(4);
    let (notify, episode) = watch::channel(None);
    let stop = CancellationToken::new();
    let mut rig = Rig::new(&registry, &bus, presence, Arc::clone(&board)).following(episode);
    let permission = Arc::default();
    let events = board.events();
    let mut bench =
        Bench { hotplug, commands, permission, board, events, units: HashMap::new(), path, reported: Vec::new() };
    let running = tokio::spawn({
        let stop = stop.clone();
        async move { rig.run(Box::pin(plugged), asked, stop).await }
    });
    let come_to = async |unit: &Arc<SimDevice>, reported: (u32, u32)| {
        let begun = Instant::now();
        while unit.recordings() != reported {
            assert!(begun.elapsed() < PATIENCE, "{:?} instead of {reported:?}", unit.recordings());
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    let begin = |number: u8| {
        let file = PathBuf::from(format!("/episodes/{number}.mcap"));
        notify.send_replace(Some(Arc::new(rapid_status::Episode::new(&file))));
    };

    for step in [Plug("1", CHANNELS), Until("a streaming")] {
        bench.step(&step).await;
    }
    let first = Arc::clone(&bench.units["1"]);
    assert_eq!(first.recordings(), (0, 0), "there is no episode");
    begin(1);
    come_to(&first, (1, 0)).await;
    // A silent device is reported as well.
    first.set_silent(true);
    bench.step(&Until("a stalled")).await;
    notify.send_replace(None);
    come_to(&first, (1, 1)).await;
    begin(2);
    come_to(&first, (2, 1)).await;
    // One is plugged in during the episode, while another is pulled.
    for step in [Plug("2", CHANNELS), Until("b streaming"), Removed("1", UnplugSource::Kernel), Until("a absent")] {
        bench.step(&step).await;
    }
    let second = Arc::clone(&bench.units["2"]);
    come_to(&second, (1, 0)).await;
    come_to(&first, (2, 2)).await;
    // The run ends before its episode does.
    stop.cancel();
    running.await.expect("no panic").expect("no error");
    come_to(&second, (1, 1)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_device_behind_an_adapter_is_not_opened_before_its_cable_is_in() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("carrier"), "0\n").expect("written");
    let mut registry = registry(Duration::from_millis(100), Duration::from_millis(150));
    for device in &mut registry.devices {
        device.node = NodeSpec::Lan(LanSpec {
            protocol: LanProtocol::Udp { port: 2368 },
            find: LanFind::Adapter { host: None },
            lease: Duration::from_secs(3),
        });
    }
    let path = folder.path().to_owned();
    let steps = [
        Adapter(path.clone()),
        Logged("the network link is down"),
        // Several times as long as the first restarts would take.
        Link(path, Duration::from_secs(2)),
        // This machine has no such interface.
        Until("a absent"),
    ];
    assert_eq!(reported_of(&registry, false, &steps).await[..4], ["a at 1", "a opening", "a gone link", "a absent"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_failed_device_is_started_again_by_hand() {
    // It sends three numbers; the entry expects two.
    let steps = [Plug("1", 3), Until("a failed"), Mask(0), Restart(0), Until("a failed"), Restart(1)];
    let got = reported(Duration::from_millis(100), Duration::from_millis(150), &steps).await;
    assert_eq!(got, ["a at 1", "a opening", "a failed", "a opening", "a failed"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_that_panics_is_started_again_and_its_bit_stays_clear() {
    // A time that no clock can hold, which the registry refuses, makes the stream panic once it is open.
    let steps = [Plug("1", CHANNELS), Until("a backoff"), Mask(0), Until("a backoff"), Mask(0)];
    let got = reported(Duration::from_millis(100), Duration::MAX, &steps).await;
    assert_eq!(got, ["a at 1", "a opening", "a backoff", "a opening", "a backoff"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_end_is_announced_before_a_slow_device_has_closed() {
    use rapid_registry::simulation::SimFaults;
    let registry = registry(Duration::ZERO, Duration::from_secs(1));
    let name = format!("ending{}", std::process::id());
    let path = PathBuf::from(format!("/dev/shm/rapid_test_mask_{name}"));
    let board = Arc::new(Board::new(&registry));
    let bus = Bus::open(&registry, Some(&name)).expect("bus");
    let claim = Claim::new(&path, 2).expect("claim");
    let presence = Presence::start(claim, bus.writer(TopicId::Mask).expect("mask"), Arc::clone(&board)).expect("mask");
    let (hotplug, plugged) = unbounded();
    let (_commands, asked) = mpsc::channel(4);
    let mut rig = Rig::new(&registry, &bus, presence, Arc::clone(&board));
    let ending = rig.ending();
    let closes_in = Duration::from_secs(1);
    let faults = SimFaults { close: closes_in, ..SimFaults::default() };
    let source = SimSource::Serial { channels: CHANNELS, hz: 200, seed: 1 };
    let unit = Arc::new(SimDevice::new("1", source, Stamp::now()).with_faults(faults));
    let usb = UsbIdentity { vid: 1, pid: 2, serial: None, port: "1".into(), ..UsbIdentity::default() };
    let syspath = PathBuf::from("/test/1");
    let added = HotplugEvent::Added(Attachment {
        syspath,
        node: DeviceNode::Sim(unit),
        unit: usb.into(),
        driver: None,
        formats: Vec::new(),
    });
    hotplug.unbounded_send(Ok(added)).expect("rig");
    let running = tokio::spawn(async move {
        let ended = rig.run(Box::pin(plugged), asked, CancellationToken::new()).await;
        (ended, Stamp::now())
    });
    let begun = Instant::now();
    while !board.snapshot().mask.contains(registry.devices[0].id) {
        assert!(begun.elapsed() < PATIENCE, "no sample");
        sleep(Duration::from_millis(1)).await;
    }
    assert!(!ending.is_cancelled());
    // Hot-plug events can no longer be monitored: the rig ends by itself.
    drop(hotplug);
    ending.cancelled().await;
    let announced = Stamp::now();
    let (ended, at) = running.await.expect("no panic");
    ended.expect("no error");
    assert!(at.since(announced) >= closes_in / 2, "{:?}", at.since(announced));
}

/// Receives events inside the announcing call, and so sees the state at that moment.
struct Witnessing {
    task: Mutex<BoxFuture<'static, ()>>,
}

impl Wake for Witnessing {
    fn wake(self: Arc<Self>) {
        let waker = Waker::from(Arc::clone(&self));
        let mut task = self.task.lock().expect("no panic");
        let _ = task.as_mut().poll(&mut Context::from_waker(&waker));
    }
}

/// Plugs and unplugs a device repeatedly, and checks what other threads see at each announcement and what the JSON file
/// holds after each change.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_mask_is_published_before_the_announcement_and_its_file_agrees_with_one_publication() {
    const ROUNDS: usize = 60;
    let registry = registry(Duration::ZERO, Duration::from_secs(1));
    let name = format!("order{}", std::process::id());
    let path = PathBuf::from(format!("/dev/shm/rapid_test_mask_{name}"));
    let board = Arc::new(Board::new(&registry));
    let bus = Bus::open(&registry, Some(&name)).expect("bus");
    let inbox = bus.inbox().expect("inbox");
    let claim = Claim::new(&path, 2).expect("claim");
    let presence = Presence::start(claim, bus.writer(TopicId::Mask).expect("mask"), Arc::clone(&board)).expect("mask");
    let wanted = presence.wanted();
    let mut events = board.events();
    let (witnessed, announced) = std::sync::mpsc::channel();
    let watching = async move {
        while let Ok(event) = events.recv().await {
            if let EventKind::Detach { bit, .. } = event.what {
                let _ = witnessed.send(wanted().contains(bit));
            }
        }
    };
    Arc::new(Witnessing { task: Mutex::new(Box::pin(watching)) }).wake();
    let (hotplug, plugged) = unbounded();
    let (_commands, asked) = mpsc::channel(4);
    let stop = CancellationToken::new();
    let mut rig = Rig::new(&registry, &bus, presence, Arc::clone(&board));
    let running = tokio::spawn({
        let stop = stop.clone();
        async move { rig.run(Box::pin(plugged), asked, stop).await }
    });
    let mut published = HashMap::new();
    let mut report = Vec::new();
    for round in 0..ROUNDS {
        let source = SimSource::Serial { channels: CHANNELS, hz: 200, seed: 1 };
        let unit = Arc::new(SimDevice::new("1", source, Stamp::now()));
        let usb = UsbIdentity { vid: 1, pid: 2, serial: None, port: "1".into(), ..UsbIdentity::default() };
        let syspath = PathBuf::from("/test/1");
        for is_there in [true, false] {
            let event = if is_there {
                let (node, unit) = (DeviceNode::Sim(Arc::clone(&unit)), usb.clone().into());
                HotplugEvent::Added(Attachment {
                    syspath: syspath.clone(),
                    node,
                    unit,
                    driver: None,
                    formats: Vec::new(),
                })
            } else {
                HotplugEvent::Removed { syspath: syspath.clone(), noticed: Stamp::now(), source: UnplugSource::Kernel }
            };
            hotplug.unbounded_send(Ok(event)).expect("rig");
            let begun = Instant::now();
            while board.snapshot().mask.contains(registry.devices[0].id) != is_there {
                assert!(begun.elapsed() < PATIENCE, "round {round}: the mask stays");
                sleep(Duration::from_millis(1)).await;
            }
            sleep(Duration::from_millis(1)).await;
            let text = std::fs::read_to_string(crate::rig::presence::json_path(&path)).unwrap_or_default();
            let document: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
            report.extend(document["sequence"].as_u64().zip(document["mask"].as_str().map(str::to_owned)));
        }
        let mut take = |topic: TopicId, header: &rapid_core::sample::SampleHeader, payload: &[u8]| {
            if topic == TopicId::Mask {
                published.insert(header.seq, payload[0]);
            }
        };
        inbox.drain(&mut take).expect("drain");
    }
    stop.cancel();
    running.await.expect("no panic").expect("no error");
    let announced: Vec<bool> = announced.try_iter().collect();
    assert_eq!(announced, [false; ROUNDS], "removals that were announced before the mask are true");
    assert!(report.len() > ROUNDS, "{} documents", report.len());
    for (sequence, mask) in report {
        let was = published.get(&sequence).map(|mask| format!("0x{mask:02x}"));
        assert!(was.is_none_or(|was| was == mask), "publication {sequence} was not of {mask}");
    }
}
