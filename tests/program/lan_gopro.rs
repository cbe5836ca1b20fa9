//! A GoPro on the network: a server on 127.0.0.1 that answers as one does, in front of the real binary.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::io::Write;
use std::net::TcpStream;
use std::process::{Child, Command};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use crate::support::lan::{RIG, RUN, Server, free_ports, request, stop, wait_for};
use crate::support::{self, Episode, Place, until};
use serde_json::Value;

/// A GoPro without a lens.
#[derive(Default)]
struct Gopro {
    asked: Mutex<Vec<String>>,
    recording: AtomicBool,
    /// The card is full: it answers so to the order to record.
    refuses: AtomicBool,
    clips: AtomicU32,
    /// What sends its preview, if it was asked for one.
    preview: Mutex<Option<Child>>,
}

impl Drop for Gopro {
    fn drop(&mut self) {
        self.end_preview();
    }
}

impl Gopro {
    const CLIP: u64 = 3 << 20;

    /// Sends moving pictures to this port of the machine, as the camera does: H.264 in packets of 7 x 188 bytes.
    fn begin_preview(&self, port: &str) {
        let mut preview = self.preview.lock().expect("no panic");
        if preview.as_mut().is_some_and(|child| child.try_wait().is_ok_and(|ended| ended.is_none())) {
            return;
        }
        let to = format!("udp://127.0.0.1:{port}?pkt_size=1316");
        let source = ["-re", "-f", "lavfi", "-i", "testsrc=size=848x480:rate=30"];
        let coded = ["-c:v", "libx264", "-preset", "ultrafast", "-tune", "zerolatency", "-g", "15", "-f", "mpegts"];
        let ffmpeg = Command::new("ffmpeg").args(["-loglevel", "error"]).args(source).args(coded).arg(to).spawn();
        *preview = Some(ffmpeg.expect("ffmpeg: make setup installs it"));
    }

    fn end_preview(&self) {
        if let Some(mut child) = self.preview.lock().expect("no panic").take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }

    fn answer(&self, mut stream: TcpStream) {
        let Some(path) = request(&mut stream) else { return };
        self.asked.lock().expect("no panic").push(path.clone());
        let recording = || self.recording.load(Ordering::Relaxed);
        let body = match path.split('?').next().unwrap_or_default() {
            "/gopro/camera/info" => br#"{"model_name":"HERO11 Black","firmware_version":"H22.01"}"#.to_vec(),
            "/gopro/camera/state" => {
                format!(r#"{{"status":{{"8":0,"10":{},"70":90}}}}"#, u8::from(recording())).into_bytes()
            }
            "/gopro/camera/shutter/start" if self.refuses.load(Ordering::Relaxed) => {
                let _ = stream.write_all(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n");
                return;
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
            "/gopro/camera/stream/start" => {
                self.begin_preview(path.split_once("port=").expect("a port").1);
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

/// Waits until the camera's own recording was reported so.
fn wait_for_clip(running: &support::Running, word: &str) {
    until(word, || running.reported().iter().any(|event| event["event"] == "clip" && event["state"] == word));
}

/// The verdict when it ends, and that of the file.
fn verdict_at_the_end(place: &Place, running: support::Running) -> (Value, Value) {
    // Long enough to be an episode.
    let begun = place.published();
    until("half a second", || place.published() > begun + 300);
    let ended = stop(running).into_iter().find(|event| event["event"] == "episode").expect("an episode");
    let file = ended["file"].as_str().expect("a file").to_owned();
    let inspected = place.run(&["--json", "inspect", &file]);
    (ended, serde_json::from_slice(&inspected.stdout).expect("JSON"))
}

#[test]
fn an_episode_that_a_gopro_did_not_record_as_asked_is_not_good() {
    for refuses in [true, false] {
        let (place, [port]) = (Place::new(), free_ports());
        place.write("devices.toml", &gopro_entry(port, ""));
        let (gopro, _server) = gopro_at(port);
        gopro.refuses.store(refuses, Ordering::Relaxed);
        let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
        wait_for(&running, "gopro", "streaming", 1);
        wait_for_clip(&running, "asked");
        if refuses {
            wait_for_clip(&running, "refused");
        } else {
            wait_for_clip(&running, "recording");
            // Its battery is empty, or someone presses the button.
            gopro.recording.store(false, Ordering::Relaxed);
            gopro.clips.fetch_add(1, Ordering::Relaxed);
            wait_for_clip(&running, "stopped");
        }
        let (ended, inspected) = verdict_at_the_end(&place, running);
        let (grade, words) = if refuses {
            ("BAD", "gopro: recorded nothing by itself; it refused ")
        } else {
            ("SUSPECT", ", stopped 1 time")
        };
        let is_it =
            |reason: &Value| reason.as_str().is_some_and(|text| text.starts_with("gopro: ") && text.contains(words));
        assert!(ended["reasons"].as_array().is_some_and(|all| all.iter().any(is_it)), "{words:?} in {ended}");
        assert!(ended["verdict"] == grade || ended["verdict"] == "BAD", "{ended}");
        assert_eq!((&inspected["verdict"], &inspected["reasons"]), (&ended["verdict"], &ended["reasons"]));
        assert_eq!(refuses, !place.files("out").iter().any(|name| name.ends_with("gopro.clip.json")));
    }
}

/// Pictures of a small preview.
const PREVIEW: &str = "stream = \"preview\"\nwidth = 424\nheight = 240\nfps = 30";

/// Bytes of some dozen of them.
const PICTURES: u64 = 200_000;

fn size_of_files(folder: &std::path::Path) -> u64 {
    let files = std::fs::read_dir(folder).map(|files| files.flatten().collect::<Vec<_>>()).unwrap_or_default();
    files.iter().filter_map(|file| file.metadata().ok()).map(|metadata| metadata.len()).sum()
}

/// Processes of this name whose parent is `rapid`.
fn decoders(pid: u32) -> Vec<u32> {
    let processes = std::fs::read_dir("/proc").expect("/proc").flatten();
    let of = |name: String| -> Option<u32> {
        let stat = std::fs::read_to_string(format!("/proc/{name}/stat")).ok()?;
        let (number, rest) = stat.split_once(" (")?;
        let (comm, rest) = rest.rsplit_once(") ")?;
        let parent: u32 = rest.split(' ').nth(1)?.parse().ok()?;
        (comm == "ffmpeg" && parent == pid).then(|| number.parse().ok())?
    };
    processes.filter_map(|entry| of(entry.file_name().to_string_lossy().into_owned())).collect()
}

#[test]
fn the_preview_of_a_gopro_is_recorded_and_its_decoder_is_started_again() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &gopro_entry(port, PREVIEW));
    let (gopro, _server) = gopro_at(port);
    let running = place.start(&[&RUN[..], &["--record", "--out", "out"]].concat(), "begin");
    wait_for(&running, "gopro", "streaming", 1);
    until("the shutter", || gopro.recording.load(Ordering::Relaxed));
    // The decoder is killed, and later the camera stops sending: the clip is recorded on, and pictures return.
    let out = place.path("out");
    let grown = |by: u64| {
        let size = || size_of_files(&out);
        let before = size();
        until("pictures in the file", || size() > before + by);
    };
    grown(PICTURES);
    let first = decoders(running.pid());
    assert_eq!(first.len(), 1, "{first:?}");
    for decoder in &first {
        let pid = rustix::process::Pid::from_raw(i32::try_from(*decoder).expect("a pid")).expect("a pid");
        rustix::process::kill_process(pid, rustix::process::Signal::KILL).expect("killed");
    }
    until("another decoder", || decoders(running.pid()).iter().any(|pid| !first.contains(pid)));
    wait_for(&running, "gopro", "streaming", 2);
    grown(PICTURES);
    gopro.end_preview();
    wait_for(&running, "gopro", "stalled", 2);
    wait_for(&running, "gopro", "streaming", 3);
    assert!(gopro.recording.load(Ordering::Relaxed), "the clip was ended");
    let pid = running.pid();
    stop(running);
    assert_eq!(decoders(pid), [0; 0], "a decoder is left behind");

    let files = place.files("out");
    let file = files.iter().find(|name| name.ends_with("mcap")).expect("an episode");
    let episode = Episode::read(&place.path("out").join(file));
    let pictures: Vec<Vec<u8>> = episode.topic("/rapid/lan/gopro").map(support::Message::payload).collect();
    assert!(pictures.len() > 20, "{}", pictures.len());
    let different: std::collections::BTreeSet<&Vec<u8>> = pictures.iter().collect();
    assert!(different.len() + 2 >= pictures.len(), "{} of {}: a picture was doubled", different.len(), pictures.len());
    // Each is whole, in the size that the entry declares (ITU-T T.81: SOF0 has height and width).
    for picture in &pictures {
        assert!(picture.starts_with(&[0xff, 0xd8]) && picture.ends_with(&[0xff, 0xd9]));
        let frame = picture.windows(2).position(|pair| pair == [0xff, 0xc0]).expect("a frame");
        assert_eq!(picture[frame + 5..frame + 9], [0, 240, 1, 168]);
    }
    let asked = gopro.asked.lock().expect("no panic").clone();
    assert!(asked.iter().any(|path| path == "/gopro/camera/shutter/stop"), "{asked:?}");
}

#[test]
fn without_its_decoder_a_gopro_still_records_clips() {
    let (place, [port]) = (Place::new(), free_ports());
    place.write("devices.toml", &gopro_entry(port, PREVIEW));
    let (gopro, _server) = gopro_at(port);
    let options = [&RUN[..], &["--record", "--out", "out"]].concat();
    let mut command = place.command(&options);
    let errors = std::fs::File::create(place.path("errors.txt")).expect("a file");
    command.env("PATH", "/nowhere").stderr(errors);
    let running = place.start_as(command, "begin");
    until("the shutter", || gopro.recording.load(Ordering::Relaxed));
    let reported = stop(running);
    let logged = std::fs::read_to_string(place.path("errors.txt")).expect("errors");
    assert_eq!(logged.matches("there is no program ffmpeg; install it").count(), 1, "{logged}");
    assert!(!gopro.recording.load(Ordering::Relaxed), "the camera records on");
    assert!(reported.iter().all(|event| event["state"] != "streaming"), "there are no pictures: {reported:#?}");
    assert!(place.files("out").iter().any(|name| name.ends_with("gopro.clip.json")));
}
