//! Devices on the network: servers and senders on 127.0.0.1 that behave as cameras, LiDARs, phones and a
//! GoPro do, well or badly, in front of the real binary.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

mod support;

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use mdns_sd::{ServiceDaemon, ServiceEvent, ServiceInfo};
use rapid::driver::sim;
use rapid::registry::scenario::SimSource;
use rustix::process::Signal;
use serde_json::Value;
use support::{Episode, Place, Running, events, until};

const RUN: [&str; 4] = ["--config", "devices.toml", "--headless", "--json"];
const WIDTH: u32 = 64;
const HEIGHT: u32 = 48;

/// A picture of a simulated camera, different for each number.
fn picture(number: u32) -> Vec<u8> {
    let source = SimSource::Camera { width: WIDTH, height: HEIGHT, fps: 30, seed: 7, bytes: 0 };
    sim::frame(&source, number).expect("a picture")
}

/// Ports of this machine that nobody is at.
fn free_ports<const N: usize>() -> [u16; N] {
    let held = [(); N].map(|()| TcpListener::bind("127.0.0.1:0").expect("a port"));
    held.map(|listener| listener.local_addr().expect("an address").port())
}

/// A server whose connections are each given to `answer`, until it is dropped: then all of them end.
struct Server {
    stop: Arc<AtomicBool>,
    connections: Arc<Mutex<Vec<TcpStream>>>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    fn start(port: u16, answer: impl Fn(TcpStream) + Send + Sync + 'static) -> Self {
        Self::start_at(([127, 0, 0, 1], port).into(), answer)
    }

    fn start_at(address: SocketAddr, answer: impl Fn(TcpStream) + Send + Sync + 'static) -> Self {
        let mut listener = None;
        // The port of a server that was just killed may still be in use for a moment.
        until("the port", || {
            listener = TcpListener::bind(address).ok();
            listener.is_some()
        });
        let listener = listener.expect("bound");
        listener.set_nonblocking(true).expect("a socket");
        let (stop, connections) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(Vec::new())));
        let thread = std::thread::spawn({
            let (stop, connections, answer) = (Arc::clone(&stop), Arc::clone(&connections), Arc::new(answer));
            move || {
                while !stop.load(Ordering::Relaxed) {
                    let Ok((stream, _)) = listener.accept() else {
                        std::thread::sleep(Duration::from_millis(5));
                        continue;
                    };
                    stream.set_nonblocking(false).expect("a socket");
                    connections.lock().expect("no panic").push(stream.try_clone().expect("a socket"));
                    let answer = Arc::clone(&answer);
                    std::thread::spawn(move || answer(stream));
                }
            }
        });
        Self { stop, connections, thread: Some(thread) }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        for connection in self.connections.lock().expect("no panic").drain(..) {
            let _ = connection.shutdown(std::net::Shutdown::Both);
        }
    }
}

/// The path of a request, which is read to its end; `None` of a connection without one.
fn request(stream: &mut TcpStream) -> Option<String> {
    let mut text = Vec::new();
    while !text.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).ok()?;
        text.push(byte[0]);
    }
    let text = String::from_utf8(text).expect("ASCII");
    Some(text.lines().next()?.split(' ').nth(1)?.to_owned())
}

/// A camera that sends pictures 50 times a second, the boundary as most of them write it.
fn camera(mut stream: TcpStream) {
    if request(&mut stream).is_none() {
        return;
    }
    let mut send = |bytes: &[u8]| stream.write_all(bytes).is_ok();
    if !send(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=--frame\r\n\r\n") {
        return;
    }
    for number in 0.. {
        let picture = picture(number);
        let head = format!("--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", picture.len());
        if !(send(head.as_bytes()) && send(&picture) && send(b"\r\n")) {
            return;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn camera_entry(name: &str, bit: u32, port: u16) -> String {
    format!(
        "[device.{name}]\nnode = \"lan\"\nbit = {bit}\n[device.{name}.lan]\nprotocol = \"mjpeg\"\nhost = \"127.0.0.1\"\n\
         port = {port}\npath = \"/video\"\nwidth = {WIDTH}\nheight = {HEIGHT}\nfps = 50\n"
    )
}

const RIG: &str = "[rig]\ncooldown = \"100ms\"\n";

/// What was told of a device: its states, and who told of its removals.
fn life(running: &Running, device: &str) -> Vec<String> {
    life_of(&events(&running.output()), device)
}

fn life_of(told: &[Value], device: &str) -> Vec<String> {
    let of = told.iter().filter(|event| event["device"] == device);
    of.filter_map(|event| match event["event"].as_str()? {
        "state" => event["state"].as_str().map(str::to_owned),
        "detach" => Some(format!("by {}", event["witness"].as_str()?)),
        _ => None,
    })
    .collect()
}

fn wait_for(running: &Running, device: &str, word: &str, times: usize) {
    until(&format!("{device} {word} {times} times"), || {
        // The last line may be half written.
        let whole: String = running.output().split_inclusive('\n').filter(|line| line.ends_with('\n')).collect();
        life_of(&events(&whole), device).iter().filter(|told| *told == word).count() >= times
    });
}

fn stop(running: Running) -> Vec<Value> {
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, Some(0), "{errors}");
    events(&output)
}

#[test]
fn a_camera_appears_is_recorded_is_killed_and_comes_back() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &format!("{RIG}{}", camera_entry("cam", 0, port)));
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    let first = Server::start(port, camera);
    wait_for(&running, "cam", "streaming", 1);
    drop(first);
    wait_for(&running, "cam", "by lease", 1);
    let _second = Server::start(port, camera);
    wait_for(&running, "cam", "streaming", 2);
    let told = stop(running);
    let life = life_of(&told, "cam");
    assert_eq!(life.iter().filter(|word| *word == "by lease").count(), 1, "{life:?}");
    let gone = told.iter().position(|event| event["event"] == "detach").expect("gone");
    assert_eq!(told[gone + 1]["mask"], "0x00");
    // The bit was cleared when the connection ended, before the lease did.
    let backoff = told.iter().find(|event| event["state"] == "backoff").expect("its connection ended");
    assert_eq!(backoff["mask"], "0x00");

    let files = place.files("out");
    let episode = Episode::read(&place.path("out").join(&files[0]));
    let edges: Vec<u64> = episode.mask_edges().iter().map(|(_, mask)| *mask).collect();
    assert_eq!(edges, [0, 1, 0, 1]);
    let pictures: Vec<Vec<u8>> = episode.topic("/rapid/lan/cam").map(support::Message::payload).collect();
    assert_eq!(pictures[0], picture(0), "the picture is as the camera sent it");
}

#[test]
fn packets_are_samples_as_they_came() {
    let (place, [port]) = (Place::new(), free_ports());
    let entry = format!(
        "{RIG}[device.lidar]\nnode = \"lan\"\nbit = 0\nmax_bytes = \"1KiB\"\n[device.lidar.lan]\nprotocol = \"udp\"\n\
         host = \"127.0.0.1\"\nport = {port}\nlease = \"1s\"\n"
    );
    place.write("devices.toml", &entry);
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    let sends = Arc::new(AtomicBool::new(true));
    let sender = std::thread::spawn({
        let sends = Arc::clone(&sends);
        move || {
            let socket = UdpSocket::bind("127.0.0.1:0").expect("a port");
            let stranger = UdpSocket::bind("127.0.0.9:0").expect("a port");
            let mut number = 0_u32;
            while sends.load(Ordering::Relaxed) {
                let mut packet = number.to_le_bytes().to_vec();
                // Each tenth is larger than the entry permits.
                packet.resize(if number % 10 == 9 { 1025 } else { 1000 }, 7);
                let _ = socket.send_to(&packet, ("127.0.0.1", port));
                let _ = stranger.send_to(b"not mine", ("127.0.0.1", port));
                number += 1;
                std::thread::sleep(Duration::from_millis(2));
            }
        }
    });
    wait_for(&running, "lidar", "streaming", 1);
    // A second of packets.
    std::thread::sleep(Duration::from_secs(1));
    sends.store(false, Ordering::Relaxed);
    sender.join().expect("no panic");
    wait_for(&running, "lidar", "by lease", 1);
    let told = stop(running);
    let lost = told.last().expect("a summary")["devices"][0].clone();
    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    let samples: Vec<Vec<u8>> = episode.topic("/rapid/lan/lidar").map(support::Message::payload).collect();
    assert!(samples.len() > 20, "{}", samples.len());
    assert!(samples.iter().all(|packet| packet.len() == 1000 && packet[4..].iter().all(|byte| *byte == 7)));
    let numbers: Vec<u32> =
        samples.iter().map(|packet| u32::from_le_bytes([packet[0], packet[1], packet[2], packet[3]])).collect();
    assert!(numbers.windows(2).all(|pair| pair[0] < pair[1] && pair[1] % 10 != 9), "{numbers:?}");
    assert!(lost["gaps"].as_u64().is_some_and(|gaps| gaps > 0), "what was too large is lost: {lost}");
}

/// A phone: connects, says its session, sends frames; connects again when that ends.
fn phone(port: u16, sends: &AtomicBool) {
    while sends.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(20));
        let Ok(mut stream) = TcpStream::connect(("127.0.0.1", port)) else { continue };
        let mut send = |kind: u8, payload: &[u8]| {
            let length = u32::try_from(payload.len()).expect("short").to_le_bytes();
            stream.write_all(&[&length[..], &[kind, 0, 0, 0], payload].concat()).is_ok()
        };
        let begun = Instant::now();
        let mut number = 0;
        let mut goes = send(0, br#"{"sessionId":"s","deviceModel":"iPhone"}"#);
        while goes && sends.load(Ordering::Relaxed) {
            let picture = picture(number);
            let mut frame = u32::try_from(picture.len()).expect("short").to_le_bytes().to_vec();
            frame.extend((0_u8..16).flat_map(|index| (f32::from(index) / 2.0).to_le_bytes()));
            frame.extend(begun.elapsed().as_secs_f64().to_le_bytes());
            frame.extend(1.7e9_f64.to_le_bytes());
            frame.extend(picture);
            goes = send(3, b"{}") && send(1, &frame);
            number += 1;
            std::thread::sleep(Duration::from_millis(30));
        }
    }
}

#[test]
fn a_phone_connects_and_sends_pictures_with_poses() {
    for stream in ["image", "pose"] {
        let (place, [port, probe]) = (Place::new(), free_ports());
        let entry = format!(
            "{RIG}[device.phone]\nnode = \"lan\"\nbit = 0\n[device.phone.lan]\nprotocol = \"iphone\"\n\
             host = \"127.0.0.1\"\nport = {port}\nprobe_port = {probe}\nstream = {stream:?}\n\
             width = {WIDTH}\nheight = {HEIGHT}\n"
        );
        place.write("devices.toml", &entry);
        let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
        let listener = Server::start(probe, drop);
        let sends = Arc::new(AtomicBool::new(true));
        let sender = std::thread::spawn({
            let sends = Arc::clone(&sends);
            move || phone(port, &sends)
        });
        wait_for(&running, "phone", "streaming", 1);
        sends.store(false, Ordering::Relaxed);
        drop(listener);
        sender.join().expect("no panic");
        wait_for(&running, "phone", "by lease", 1);
        stop(running);
        let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
        let first = episode.topic("/rapid/lan/phone").next().expect("a sample").payload();
        if stream == "pose" {
            let numbers: Vec<f64> = first.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
            assert_eq!(numbers, (0..16).map(|index| f64::from(index) / 2.0).collect::<Vec<_>>());
        } else {
            let length = usize::from(u16::from_be_bytes([first[4], first[5]]));
            let told: Value = serde_json::from_slice(&first[6..4 + length]).expect("a comment in JSON");
            assert_eq!((told["pose"][3].as_f64(), told["wall_clock"].as_f64()), (Some(1.5), Some(1.7e9)));
            assert_eq!([&first[..2], &first[4 + length..]].concat(), picture(0), "the picture is as it was");
        }
    }
}

/// A GoPro without a lens.
#[derive(Default)]
struct Gopro {
    asked: Mutex<Vec<String>>,
    recording: AtomicBool,
    clips: AtomicU32,
}

impl Gopro {
    const CLIP: u64 = 3 << 20;

    fn answer(&self, mut stream: TcpStream) {
        let Some(path) = request(&mut stream) else { return };
        self.asked.lock().expect("no panic").push(path.clone());
        let recording = || self.recording.load(Ordering::Relaxed);
        let body = match path.split('?').next().unwrap_or_default() {
            "/gopro/camera/info" => br#"{"model_name":"HERO11 Black","firmware_version":"H22.01"}"#.to_vec(),
            "/gopro/camera/state" => {
                format!(r#"{{"status":{{"8":0,"10":{},"70":90}}}}"#, u8::from(recording())).into_bytes()
            }
            "/gopro/camera/shutter/start" => {
                self.recording.store(true, Ordering::Relaxed);
                b"{}".to_vec()
            }
            "/gopro/camera/shutter/stop" => {
                self.recording.store(false, Ordering::Relaxed);
                self.clips.fetch_add(1, Ordering::Relaxed);
                b"{}".to_vec()
            }
            "/gopro/media/last_captured" => {
                let number = self.clips.load(Ordering::Relaxed);
                format!(r#"{{"folder":"100GOPRO","file":"GX01000{number}.MP4"}}"#).into_bytes()
            }
            "/gopro/media/info" => format!(r#"{{"s":"{}"}}"#, Self::CLIP).into_bytes(),
            _ => b"{}".to_vec(),
        };
        let head = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n", body.len());
        let _ = stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(&body));
    }
}

/// An entry of a GoPro that is at this port.
fn gopro_entry(port: u16, more: &str) -> String {
    format!(
        "{RIG}[device.gopro]\nnode = \"lan\"\nbit = 0\n[device.gopro.lan]\nprotocol = \"gopro\"\nhost = \"127.0.0.1\"\n\
         port = {port}\n{more}\n"
    )
}

fn gopro_at(port: u16) -> (Arc<Gopro>, Server) {
    let gopro = Arc::new(Gopro::default());
    let server = Server::start(port, {
        let gopro = Arc::clone(&gopro);
        move |stream| gopro.answer(stream)
    });
    (gopro, server)
}

#[test]
fn a_gopro_is_there_while_it_answers() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &gopro_entry(port, ""));
    let running = place.start(&RUN, "begin");
    let (gopro, server) = gopro_at(port);
    wait_for(&running, "gopro", "streaming", 1);
    drop(server);
    wait_for(&running, "gopro", "by lease", 1);
    stop(running);
    let asked = gopro.asked.lock().expect("no panic").clone();
    for request in ["/gopro/camera/control/wired_usb?p=1", "/gopro/camera/keep_alive"] {
        assert!(asked.iter().any(|path| path == request), "{asked:?}");
    }
    assert!(asked.iter().any(|path| path.starts_with("/gopro/camera/set_date_time?date=20")), "{asked:?}");
    assert!(!asked.iter().any(|path| path.contains("shutter")), "nothing was recorded: {asked:?}");
}

#[test]
fn a_gopro_records_with_the_episode_and_its_clip_is_noted_beside_it() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &gopro_entry(port, ""));
    let (gopro, _server) = gopro_at(port);
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    wait_for(&running, "gopro", "streaming", 1);
    until("the shutter", || gopro.recording.load(Ordering::Relaxed));
    let told = stop(running);
    assert!(!gopro.recording.load(Ordering::Relaxed), "the camera records on");
    let files = place.files("out");
    let episode = files
        .iter()
        .find(|name| std::path::Path::new(name).extension().is_some_and(|extension| extension == "mcap"))
        .expect("an episode");
    let stem = episode.trim_end_matches(".mcap");
    let note = std::fs::read_to_string(place.path("out").join(format!("{stem}.gopro.clip.json")));
    let note: Value =
        serde_json::from_str(&note.unwrap_or_else(|_| panic!("no note in {files:?}: {told:#?}"))).expect("JSON");
    assert_eq!((note["folder"].as_str(), note["file"].as_str()), (Some("100GOPRO"), Some("GX010001.MP4")));
    assert_eq!(note["size"].as_u64(), Some(Gopro::CLIP));
}

/// What a hostile server does with a connection.
type Trick = fn(TcpStream);

fn begin(stream: &mut TcpStream) {
    request(stream);
    let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=f\r\n\r\n");
}

/// Sends the same for as long as somebody takes it.
fn without_end(mut stream: TcpStream, bytes: &[u8]) {
    while stream.write_all(bytes).is_ok() {}
}

const TRICKS: [(&str, Trick); 6] = [
    ("a header without end", |mut stream| {
        request(&mut stream);
        without_end(
            stream,
            b"X-Header: yyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyy\r\n",
        );
    }),
    ("a wrong length", |mut stream| {
        begin(&mut stream);
        let _ = stream.write_all(b"--f\r\nContent-Length: 10\r\n\r\n");
        without_end(stream, &[7; 4096]);
    }),
    ("a huge picture", |mut stream| {
        begin(&mut stream);
        let _ = stream.write_all(b"--f\r\nContent-Length: 4000000000\r\n\r\n");
        without_end(stream, &[7; 4096]);
    }),
    ("a picture without end", |mut stream| {
        begin(&mut stream);
        let _ = stream.write_all(b"--f\r\n\r\n");
        without_end(stream, &[7; 4096]);
    }),
    ("a slow loris", |mut stream| {
        request(&mut stream);
        for byte in b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace".iter().cycle() {
            if stream.write_all(&[*byte]).is_err() {
                return;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }),
    ("silence", |mut stream| {
        let _ = stream.read_to_end(&mut Vec::new());
    }),
];

#[test]
fn a_hostile_server_costs_nobody_else_anything() {
    let (place, ports) = (Place::new(), free_ports::<7>());
    let mut text = format!("{RIG}{}", camera_entry("good", 0, ports[0]));
    for (bit, port) in (1..).zip(&ports[1..]) {
        text.push_str(&camera_entry(&format!("bad{bit}"), bit, *port));
    }
    place.write("devices.toml", &text);
    let _good = Server::start(ports[0], camera);
    let _bad: Vec<Server> =
        ports[1..].iter().zip(TRICKS).map(|(port, (_, trick))| Server::start(*port, trick)).collect();
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    wait_for(&running, "good", "streaming", 1);
    for (bit, (trick, _)) in (1..).zip(TRICKS) {
        // Opened and given up, or refused: never a sample, never the end of the run.
        until(trick, || life(&running, &format!("bad{bit}")).iter().any(|word| word == "opening"));
    }
    std::thread::sleep(Duration::from_secs(8));
    let memory = resident(running.pid());
    let told = stop(running);
    assert!(memory < 512 << 20, "{memory} bytes");
    for bit in 1..=6 {
        let device = format!("bad{bit}");
        // "A wrong length" sends one part of ten bytes, which is no picture.
        let life = life_of(&told, &device);
        assert!(bit == 2 || !life.contains(&"streaming".to_owned()), "{device}: {life:?}");
    }
    assert_eq!(life_of(&told, "good"), ["opening", "streaming"], "the good one noticed");
    let episode = Episode::read(&place.path("out").join(&place.files("out")[0]));
    let masks: Vec<u32> = episode.topic("/rapid/mask").map(|message| message.sequence).collect();
    assert!(masks.windows(2).all(|pair| pair[1] == pair[0] + 1), "a hole in the mask");
}

/// Bytes of memory a process has.
fn resident(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("its status");
    let line = status.lines().find(|line| line.starts_with("VmRSS")).expect("its memory");
    line.split_whitespace().nth(1).and_then(|kb| kb.parse::<u64>().ok()).expect("a number") << 10
}

#[test]
fn a_picture_of_another_size_is_said_with_the_fix() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &format!("{RIG}{}", camera_entry("cam", 0, port)).replace("width = 64", "width = 640"));
    let _server = Server::start(port, camera);
    let running = place.start(&RUN, "begin");
    wait_for(&running, "cam", "failed", 1);
    let told = stop(running);
    let failed = told.iter().find(|event| event["state"] == "failed").expect("failed");
    let detail = failed["detail"].as_str().expect("why");
    assert!(detail.contains("64x48") && detail.contains("[device.cam.lan]"), "{detail}");
}

#[test]
fn entries_on_the_network_are_simulated_like_any_other() {
    let place = Place::new();
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/registry/valid/lan.toml"));
    place.write("devices.toml", &text.expect("a registry"));
    place.write("sim.toml", "[[event]]\nat = \"1h\"\nunplug = \"lidar\"\n");
    let running = place.start(&[&["--sim", "sim.toml"], &RUN[..]].concat(), "begin");
    for device in ["cam_lan", "lidar", "lidar_asked", "gopro", "cam_behind_adapter", "phone", "phone_pose"] {
        wait_for(&running, device, "streaming", 1);
    }
    stop(running);
}

/// Announces a service until it is told to say goodbye or is killed: a process of its own, so that it can
/// be.
struct Responder(Child);

impl Responder {
    fn start(service: &str, port: u16) -> Self {
        let child = Command::new(std::env::current_exe().expect("this test"))
            .args(["--exact", "announce_a_service", "--ignored", "--nocapture"])
            .env("ANNOUNCE", format!("{service} {port}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn();
        Self(child.expect("runs"))
    }

    fn say_goodbye(mut self) {
        drop(self.0.stdin.take());
        let _ = self.0.wait();
    }
}

impl Drop for Responder {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
#[ignore = "a part of the test below, in a process of its own"]
fn announce_a_service() {
    let Ok(what) = std::env::var("ANNOUNCE") else { return };
    let (service, port) = what.split_once(' ').expect("service and port");
    let daemon = ServiceDaemon::new().expect("mDNS");
    let port = port.parse().expect("a port");
    let info = ServiceInfo::new(&format!("{service}.local."), "cam one", "rapid-test.local.", "", port, None);
    let info = info.expect("a service").enable_addr_auto();
    let name = info.get_fullname().to_owned();
    daemon.register(info).expect("announced");
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
    let done = daemon.unregister(&name).expect("unannounced");
    let _ = done.recv_timeout(Duration::from_secs(5));
}

/// Does multicast reach from one process of this machine to another?
fn can_be_heard(service: &str) -> bool {
    let daemon = ServiceDaemon::new().expect("mDNS");
    let events = daemon.browse(&format!("{service}.local.")).expect("browsing");
    let begun = Instant::now();
    let mut heard = false;
    while !heard && begun.elapsed() < Duration::from_secs(15) {
        let event = events.recv_timeout(Duration::from_millis(100));
        heard = matches!(event, Ok(ServiceEvent::ServiceResolved(_)));
    }
    let _ = daemon.shutdown();
    heard
}

#[test]
fn a_device_that_announces_itself_comes_and_goes_by_goodbye_and_by_lease() {
    let (place, [port]) = (Place::new(), free_ports());
    let service = format!("_rt{}._tcp", std::process::id());
    let entry = camera_entry("cam", 0, port).replace("host = \"127.0.0.1\"", &format!("mdns = {service:?}"));
    // The port is the announced one.
    place.write("devices.toml", &format!("{RIG}{}", entry.replace(&format!("port = {port}\n"), "")));
    let anywhere = SocketAddr::from(([0; 4], port));
    let server = Server::start_at(anywhere, camera);
    let responder = Responder::start(&service, port);
    if !can_be_heard(&service) {
        eprintln!("multicast does not work on this machine: nothing is found by mDNS, and nothing is tested");
        return;
    }
    let running = place.start(&RUN, "begin");
    wait_for(&running, "cam", "streaming", 1);
    // A goodbye counts although pictures arrive.
    responder.say_goodbye();
    wait_for(&running, "cam", "by goodbye", 1);
    let responder = Responder::start(&service, port);
    wait_for(&running, "cam", "streaming", 2);
    // Nobody says anything: the cable is pulled.
    drop(responder);
    drop(server);
    wait_for(&running, "cam", "by lease", 1);
    let told = stop(running);
    let life = life_of(&told, "cam");
    let gone: Vec<_> = life.iter().filter(|word| word.starts_with("by ")).collect();
    assert_eq!(gone, ["by goodbye", "by lease"], "{life:?}");
    let attached = told.iter().find(|event| event["event"] == "attach").expect("attached");
    assert_eq!(attached["instance"], "cam one");
}
