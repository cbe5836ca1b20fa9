//! Cameras on the network that do what no camera may: servers on 127.0.0.1 beside a good one, in front of the
//! real binary.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use crate::support::lan::{RIG, RUN, Server, camera, camera_entry, free_ports, life, life_of, request, stop, wait_for};
use crate::support::{Episode, Place, until};

/// What a hostile server does with a connection.
type Trick = fn(TcpStream);

fn begin(stream: &mut TcpStream) {
    request(stream);
    let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=f\r\n\r\n");
}

/// Sends the same for as long as someone takes it.
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
fn a_hostile_server_affects_no_other_device() {
    let (place, ports) = (Place::new(), free_ports::<7>());
    let mut text = format!("{RIG}{}", camera_entry("good", 0, ports[0]));
    for (bit, port) in (1..).zip(&ports[1..]) {
        text.push_str(&camera_entry(&format!("bad{bit}"), bit, *port));
    }
    place.write("devices.toml", &text);
    let _good = Server::start(ports[0], camera);
    let bad: Vec<Server> =
        ports[1..].iter().zip(TRICKS).map(|(port, (_, trick))| Server::start(*port, trick)).collect();
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    wait_for(&running, "good", "streaming", 1);
    for (bit, (trick, _)) in (1..).zip(TRICKS) {
        // Opened and given up, or refused: never a sample, never the end of the run.
        until(trick, || life(&running, &format!("bad{bit}")).iter().any(|word| word == "opening"));
    }
    // What sends without end is given up, and is tried again.
    for (server, (trick, _)) in bad.iter().zip(TRICKS).take(4) {
        until(trick, || server.connections() > 2);
    }
    let memory = resident(running.pid());
    let reported = stop(running);
    assert!(memory < 512 << 20, "{memory} bytes");
    for bit in 1..=6 {
        let device = format!("bad{bit}");
        // "A wrong length" sends one part of ten bytes: no picture, but a sample, marked as damaged.
        let life = life_of(&reported, &device);
        assert!(bit == 2 || !life.contains(&"streaming".to_owned()), "{device}: {life:?}");
    }
    assert_eq!(life_of(&reported, "good"), ["opening", "streaming"], "the good one noticed");
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
