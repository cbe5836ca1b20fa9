//! A GoPro on the network: a server on 127.0.0.1 that answers as one does, in front of the real binary.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::io::Write;
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use crate::support::lan::{RIG, RUN, Server, free_ports, request, stop, wait_for};
use crate::support::{Place, until};
use serde_json::Value;

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
fn a_gopro_is_attached_while_it_answers() {
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
    let reported = stop(running);
    assert!(!gopro.recording.load(Ordering::Relaxed), "the camera records on");
    let files = place.files("out");
    let episode = files
        .iter()
        .find(|name| std::path::Path::new(name).extension().is_some_and(|extension| extension == "mcap"))
        .expect("an episode");
    let stem = episode.trim_end_matches(".mcap");
    let note = std::fs::read_to_string(place.path("out").join(format!("{stem}.gopro.clip.json")));
    let note: Value =
        serde_json::from_str(&note.unwrap_or_else(|_| panic!("no note in {files:?}: {reported:#?}"))).expect("JSON");
    assert_eq!((note["folder"].as_str(), note["file"].as_str()), (Some("100GOPRO"), Some("GX010001.MP4")));
    assert_eq!(note["size"].as_u64(), Some(Gopro::CLIP));
}
