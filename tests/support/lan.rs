//! Devices on the network: servers and senders on 127.0.0.1, their registry entries, and a run's reports about them.

#![allow(dead_code, reason = "each test binary uses its own part of this module")]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use rapid_devices::driver::sim;
use rapid_registry::simulation::SimSource;
use rustix::process::Signal;
use serde_json::Value;

use crate::support::{Running, events, recorded_code, until};

/// The arguments of a run.
pub(crate) const RUN: [&str; 4] = ["--config", "devices.toml", "--headless", "--json"];
pub(crate) const WIDTH: u32 = 64;
pub(crate) const HEIGHT: u32 = 48;

/// A picture of a simulated camera, different for each number.
pub(crate) fn picture(number: u32) -> Vec<u8> {
    let source = SimSource::Camera { width: WIDTH, height: HEIGHT, fps: 30, seed: 7, bytes: 0 };
    sim::frame(&source, number).expect("a picture")
}

/// Ports of this machine without a listener.
pub(crate) fn free_ports<const N: usize>() -> [u16; N] {
    let held = [(); N].map(|()| TcpListener::bind("127.0.0.1:0").expect("a port"));
    held.map(|listener| listener.local_addr().expect("an address").port())
}

/// A server that passes each connection to `answer`; dropping it ends all of them.
pub(crate) struct Server {
    stop: Arc<AtomicBool>,
    connections: Arc<Mutex<Vec<TcpStream>>>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    pub(crate) fn start(port: u16, answer: impl Fn(TcpStream) + Send + Sync + 'static) -> Self {
        Self::start_at(([127, 0, 0, 1], port).into(), answer)
    }

    pub(crate) fn start_at(address: SocketAddr, answer: impl Fn(TcpStream) + Send + Sync + 'static) -> Self {
        let mut listener = None;
        // The port of a killed server may still be in use for a moment.
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

    /// How many connections there have been.
    pub(crate) fn connections(&self) -> usize {
        self.connections.lock().expect("no panic").len()
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

/// The path of a request, which is read to its end; `None` for a connection without one.
pub(crate) fn request(stream: &mut TcpStream) -> Option<String> {
    let mut text = Vec::new();
    while !text.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).ok()?;
        text.push(byte[0]);
    }
    let text = String::from_utf8(text).expect("ASCII");
    Some(text.lines().next()?.split(' ').nth(1)?.to_owned())
}

/// A camera that sends 50 pictures per second, with the boundary in its most common form.
pub(crate) fn camera(mut stream: TcpStream) {
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

/// An entry of such a camera.
pub(crate) fn camera_entry(name: &str, bit: u32, port: u16) -> String {
    format!(
        "[device.{name}]\nnode = \"lan\"\nbit = {bit}\n[device.{name}.lan]\nprotocol = \"mjpeg\"\nhost = \"127.0.0.1\"\n\
         port = {port}\npath = \"/video\"\nwidth = {WIDTH}\nheight = {HEIGHT}\nfps = 50\n"
    )
}

pub(crate) const RIG: &str = "[rig]\ncooldown = \"100ms\"\n";

/// A registry with a LiDAR that sends to this port.
pub(crate) fn lidar_rig(port: u16) -> String {
    format!(
        "{RIG}[device.lidar]\nnode = \"lan\"\nbit = 0\n[device.lidar.lan]\nprotocol = \"udp\"\nhost = \"127.0.0.1\"\n\
         port = {port}\nlease = \"1s\"\n[device.lidar.points]\nformat = \"velodyne\"\n"
    )
}

/// A sender of packets to a port of this machine, and a stranger who sends there too.
pub(crate) struct Packets {
    sends: Arc<AtomicBool>,
    sent: Arc<AtomicU32>,
    thread: JoinHandle<()>,
}

impl Packets {
    pub(crate) fn send(port: u16, packet: impl Fn(u32) -> Vec<u8> + Send + 'static) -> Self {
        let (sends, sent) = (Arc::new(AtomicBool::new(true)), Arc::new(AtomicU32::new(0)));
        let thread = std::thread::spawn({
            let (sends, sent) = (Arc::clone(&sends), Arc::clone(&sent));
            move || {
                let socket = UdpSocket::bind("127.0.0.1:0").expect("a port");
                let stranger = UdpSocket::bind("127.0.0.9:0").expect("a port");
                for number in (0..).take_while(|_| sends.load(Ordering::Relaxed)) {
                    let _ = socket.send_to(&packet(number), ("127.0.0.1", port));
                    let _ = stranger.send_to(b"not mine", ("127.0.0.1", port));
                    sent.store(number + 1, Ordering::Relaxed);
                    std::thread::sleep(Duration::from_millis(2));
                }
            }
        });
        Self { sends, sent, thread }
    }

    pub(crate) fn end_after_a_hundred(self) {
        let before = self.sent.load(Ordering::Relaxed);
        until("a hundred packets", || self.sent.load(Ordering::Relaxed) > before + 100);
        self.sends.store(false, Ordering::Relaxed);
        self.thread.join().expect("no panic");
    }
}

/// The reports about a device: its states, and the sources of its removals.
pub(crate) fn life(running: &Running, device: &str) -> Vec<String> {
    life_of(&running.reported(), device)
}

pub(crate) fn life_of(reported: &[Value], device: &str) -> Vec<String> {
    let of = reported.iter().filter(|event| event["device"] == device);
    of.filter_map(|event| match event["event"].as_str()? {
        "state" => event["state"].as_str().map(str::to_owned),
        "detach" => Some(format!("by {}", event["witness"].as_str()?)),
        _ => None,
    })
    .collect()
}

pub(crate) fn wait_for(running: &Running, device: &str, word: &str, times: usize) {
    until(&format!("{device} {word} {times} times"), || {
        life(running, device).iter().filter(|reported| *reported == word).count() >= times
    });
}

/// Ends a run; returns all its events.
pub(crate) fn stop(running: Running) -> Vec<Value> {
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, recorded_code(&output), "{errors}");
    events(&output)
}
