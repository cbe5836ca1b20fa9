use std::net::Ipv4Addr as Address;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use rapid_registry::device::{DeviceNode, LastReceived};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;

use super::answer::Name;
use super::clip::Failure;
use super::*;
use crate::patience::PATIENCE;

/// A camera that has a clip and interrupts it this many times; with counts of requests.
async fn camera(clip: Vec<u8>, breaks: usize) -> (Server, Arc<AtomicUsize>) {
    let listener = TcpListener::bind((Address::LOCALHOST, 0)).await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let asked = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&asked);
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            let mut request = vec![0; 4096];
            let length = stream.read(&mut request).await.unwrap_or(0);
            let request = String::from_utf8_lossy(&request[..length]).to_lowercase();
            let from = request.split("range: bytes=").nth(1).and_then(|rest| rest.split('-').next()?.parse().ok());
            let rest = &clip[from.unwrap_or(0).min(clip.len())..];
            let status = match from {
                Some(from) => {
                    let (last, whole) = (clip.len().saturating_sub(1), clip.len());
                    format!("206 Partial Content\r\nContent-Range: bytes {from}-{last}/{whole}")
                }
                None => "200 OK".to_owned(),
            };
            let head = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\n\r\n", rest.len());
            let is_broken = count.fetch_add(1, Ordering::Relaxed) < breaks;
            let sent = if is_broken { &rest[..rest.len() / 2] } else { rest };
            let _ = stream.write_all(head.as_bytes()).await;
            let _ = stream.write_all(sent).await;
        }
    });
    let place = DeviceAddress::new(&DeviceNode::Lan { address, last_received: LastReceived::default() }, None)
        .expect("a place");
    (place.server(address.port()).expect("a server"), asked)
}

fn named(number: usize) -> Name {
    Name { folder: "100GOPRO".into(), file: format!("GX01{number:04}.MP4") }
}

fn clip_in(folder: &Path) -> Clip {
    Clip::new(named(1), None, folder.join("ep_001.mcap"), "gopro")
}

#[tokio::test]
async fn an_interrupted_download_of_a_clip_is_resumed() {
    let folder = tempfile::tempdir().expect("a folder");
    let bytes: Vec<u8> = (0..3_u32 << 20).map(|index| index.to_le_bytes()[1]).collect();
    let (server, asked) = camera(bytes.clone(), 2).await;
    let clip = clip_in(folder.path());
    clip::fetch(clip.clone(), server.clone(), None).await.expect("fetched");
    assert!(std::fs::read(clip.target()).expect("the clip") == bytes, "the clip is another");
    assert_eq!(asked.load(Ordering::Relaxed), 3);
    let files: Vec<_> =
        std::fs::read_dir(folder.path()).expect("a folder").flatten().map(|file| file.file_name()).collect();
    assert_eq!(files, ["ep_001.gopro.GX010001.MP4"], "nothing is left over");
    // An existing clip is not requested again.
    clip::fetch(clip, server, None).await.expect("there");
    assert_eq!(asked.load(Ordering::Relaxed), 3);
}

#[tokio::test]
async fn a_camera_that_keeps_aborting_is_abandoned_and_partial_data_kept() {
    let (server, _) = camera(vec![7], usize::MAX).await;
    let folder = tempfile::tempdir().expect("a folder");
    let failed = clip::fetch(clip_in(folder.path()), server, None).await.expect_err("half of one byte never comes");
    assert!(matches!(failed, Failure::Stays(_)), "{failed:?}");
    assert!(folder.path().join("ep_001.gopro.GX010001.MP4.partial").exists());
    assert!(!folder.path().join("ep_001.gopro.GX010001.MP4").exists());
}

#[test]
fn a_note_records_the_clip_location() {
    let folder = tempfile::tempdir().expect("a folder");
    clip_in(folder.path()).note("http://172.24.106.51:8080/videos/DCIM/100GOPRO/GX010001.MP4").expect("written");
    let note = std::fs::read_to_string(folder.path().join("ep_001.gopro.clip.json")).expect("a note");
    let note: serde_json::Value = serde_json::from_str(&note).expect("JSON");
    assert_eq!((note["file"].as_str(), note["size"].as_u64()), (Some("GX010001.MP4"), None));
}

#[test]
fn the_camera_is_in_the_network_of_its_host() {
    for (own, camera) in [
        ([172, 24, 106, 52], Some([172, 24, 106, 51])),
        ([172, 20, 100, 1], Some([172, 20, 100, 51])),
        ([172, 19, 100, 1], None),
        ([172, 24, 99, 1], None),
        ([10, 24, 106, 52], None),
    ] {
        let own = Ipv4Addr::from(own);
        assert_eq!(is_gopros(own).then(|| camera_of(own).octets()), camera, "{own}");
    }
}

#[test]
fn the_state_is_read_by_number() {
    let answer = br#"{"status":{"8":0,"10":1,"35":3600,"54":1000,"70":87},"settings":{}}"#;
    let state = answer::state(answer, Stamp(1)).expect("a state");
    assert_eq!(
        serde_json::to_string(&state).expect("JSON"),
        r#"{"recording":true,"busy":false,"battery_percent":87,"card_free_kb":1000,"remaining_s":3600}"#
    );
    for answer in ["", "[]", "{}", r#"{"status":{}}"#, r#"{"status":{"10":"yes"}}"#] {
        assert_eq!(answer::state(answer.as_bytes(), Stamp(1)), None, "{answer}");
    }
}

#[test]
fn a_model_is_read_from_either_firmware() {
    let plain = br#"{"model_name":"HERO11 Black","firmware_version":"H22.01.01.20.00"}"#;
    let wrapped = br#"{"info":{"model_name":"HERO9 Black"}}"#;
    assert_eq!(answer::model(plain).as_deref(), Some("HERO11 Black, firmware H22.01.01.20.00"));
    assert_eq!(answer::model(wrapped).as_deref(), Some("HERO9 Black"));
    assert_eq!(answer::model(b"[]"), None);
}

#[test]
fn the_clock_is_set_to_the_second() {
    let request = answer::clock();
    let digits = request.chars().filter(char::is_ascii_digit).count();
    assert!(request.starts_with("/gopro/camera/set_date_time?date=20") && digits >= 16, "{request}");
}

#[test]
fn a_clip_is_accepted_only_under_a_plain_name() {
    let newest = |text: &str| answer::newest(text.as_bytes());
    assert_eq!(newest(r#"{"folder":"100GOPRO","file":"GX010001.MP4"}"#), Ok(Some(named(1))));
    for none in ["{}", r#"{"folder":"","file":""}"#] {
        assert_eq!(newest(none), Ok(None), "{none}");
    }
    assert_eq!(clip_in(Path::new("/out")).target(), PathBuf::from("/out/ep_001.gopro.GX010001.MP4"));
    for text in [
        r#"{"folder":"100GOPRO","file":"../../etc/passwd"}"#,
        r#"{"folder":"..","file":"GX010001.MP4"}"#,
        r#"{"folder":"100GOPRO","file":".hidden"}"#,
        r#"{"folder":"100GOPRO","file":"a\nb"}"#,
        r#"{"folder":"100GOPRO","file":""}"#,
        r#"{"folder":"100GOPRO"}"#,
        "[]",
        "nothing",
    ] {
        assert!(newest(text).is_err(), "{text}");
    }
    assert_eq!(answer::size(br#"{"s":"1234"}"#), Some(1234));
    assert_eq!(answer::size(br#"{"s":1234}"#), Some(1234));
    assert_eq!(answer::size(br#"{"s":-1}"#), None);
    assert_eq!(answer::serial(br#"{"info":{"serial_number":"C344"}}"#).as_deref(), Some("C344"));
    assert_eq!(answer::serial(br#"{"serial_number":"../C344"}"#), None);
}

#[test]
fn a_note_is_read_back_and_no_other_file_is_taken_for_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let clip = Clip::new(named(1), Some(7), folder.path().join("ep_001.mcap"), "gopro");
    clip.note("http://172.24.106.51:8080/x").expect("written");
    assert_eq!(Clip::of_note(&clip.note_path()), Some(clip.clone()));
    let note = std::fs::read_to_string(clip.note_path()).expect("a note");
    let read = |path: &str, note: &str| Clip::read(Path::new(path), note);
    assert!(read("/a/b.gopro.clip.json", &note).is_some());
    for path in ["/a/b.other.clip.json", "/a/.gopro.clip.json", "/a/b.gopro.clip.json.old", "/"] {
        assert_eq!(read(path, &note), None, "{path}");
    }
    assert_eq!(read("/a/b.gopro.clip.json", &note.replace("GX010001.MP4", "../GX010001.MP4")), None);
    assert_eq!(read("/a/b.gopro.clip.json", &note.replace("\"gopro\"", "\"../gopro\"")), None);
}

/// A camera whose clips are listed, and whose answers are lost, as the test chooses.
#[derive(Default)]
struct Fake {
    asked: Mutex<Vec<String>>,
    recording: AtomicBool,
    /// Clips that were made, and how many of them are listed.
    made: AtomicUsize,
    listed: AtomicUsize,
    /// A clip is listed as soon as it is made.
    lists: AtomicBool,
    /// It does not record: it refuses the order, or accepts it only.
    refuses: AtomicBool,
    pretends: AtomicBool,
    /// Requests that contain this word get no answer.
    deaf: Mutex<Option<&'static str>>,
}

const CLIP: &[u8] = b"moving pictures";

impl Fake {
    async fn start() -> (Arc<Self>, Server) {
        let listener = TcpListener::bind((Address::LOCALHOST, 0)).await.expect("a port");
        let address = listener.local_addr().expect("an address");
        let fake = Arc::new(Self { lists: true.into(), ..Self::default() });
        let camera = Arc::clone(&fake);
        tokio::spawn(async move {
            while let Ok((mut stream, _)) = listener.accept().await {
                let mut request = vec![0; 4096];
                let length = stream.read(&mut request).await.unwrap_or(0);
                let request = String::from_utf8_lossy(&request[..length]);
                let path = request.split(' ').nth(1).unwrap_or_default().to_owned();
                let Some((status, body)) = camera.answer(&path) else { continue };
                let head = format!("HTTP/1.1 {status} X\r\nContent-Length: {}\r\n\r\n", body.len());
                let _ = stream.write_all(&[head.as_bytes(), &body].concat()).await;
            }
        });
        let place = DeviceAddress::new(&DeviceNode::Lan { address, last_received: LastReceived::default() }, None)
            .expect("a place");
        (fake, place.server(address.port()).expect("a server"))
    }

    fn answer(&self, path: &str) -> Option<(u16, Vec<u8>)> {
        self.asked.lock().expect("no panic").push(path.to_owned());
        if self.deaf.lock().expect("no panic").is_some_and(|word| path.contains(word)) {
            return None;
        }
        let body = match path.split('?').next().unwrap_or_default() {
            "/gopro/camera/info" => br#"{"model_name":"HERO","serial_number":"C344"}"#.to_vec(),
            "/gopro/camera/state" => {
                format!(r#"{{"status":{{"10":{}}}}}"#, u8::from(self.recording.load(Ordering::Relaxed))).into_bytes()
            }
            "/gopro/camera/shutter/start" if self.refuses.load(Ordering::Relaxed) => return Some((403, Vec::new())),
            "/gopro/camera/shutter/start" if self.pretends.load(Ordering::Relaxed) => Vec::new(),
            "/gopro/camera/shutter/start" => {
                self.recording.store(true, Ordering::Relaxed);
                Vec::new()
            }
            "/gopro/camera/shutter/stop" => {
                if self.recording.swap(false, Ordering::Relaxed) {
                    self.made();
                }
                Vec::new()
            }
            "/gopro/media/last_captured" => match self.listed.load(Ordering::Relaxed) {
                0 => return Some((404, Vec::new())),
                number => serde_json::to_vec(&named(number)).expect("JSON"),
            },
            "/gopro/media/info" => format!(r#"{{"s":"{}"}}"#, CLIP.len()).into_bytes(),
            path if path.starts_with("/videos/") => CLIP.to_vec(),
            _ => Vec::new(),
        };
        Some((200, body))
    }

    /// A clip was made, by anyone.
    fn made(&self) {
        let made = self.made.fetch_add(1, Ordering::Relaxed) + 1;
        if self.lists.load(Ordering::Relaxed) {
            self.listed.store(made, Ordering::Relaxed);
        }
    }

    fn list(&self) {
        self.listed.store(self.made.load(Ordering::Relaxed), Ordering::Relaxed);
    }

    fn is_recording(&self) -> bool {
        self.recording.load(Ordering::Relaxed)
    }

    fn ignore_requests(&self, word: Option<&'static str>) {
        *self.deaf.lock().expect("no panic") = word;
    }

    fn asked(&self, word: &str) -> usize {
        self.asked.lock().expect("no panic").iter().filter(|path| path.contains(word)).count()
    }
}

const QUICK: TimeLimits = TimeLimits {
    keep_alive: Duration::from_millis(50),
    listed_within: Duration::from_millis(300),
    listed_at_the_latest: Duration::from_secs(30),
};

/// A driver, with a task that reads its samples.
struct Bench {
    folder: tempfile::TempDir,
    fake: Arc<Fake>,
    server: Server,
    gopro: Option<Gopro>,
    download: bool,
    /// What was reported of its own recording.
    reported: Vec<ClipState>,
    clips: Option<mpsc::Receiver<ClipNotice>>,
}

impl Bench {
    async fn new(download: bool) -> Self {
        let (fake, server) = Fake::start().await;
        let folder = tempfile::tempdir().expect("a folder");
        let mut bench = Self { folder, fake, server, gopro: None, download, reported: Vec::new(), clips: None };
        bench.open().await;
        bench
    }

    /// Connects; if already connected, the old connection is lost.
    async fn open(&mut self) {
        self.gopro = None;
        let state = Some(self.folder.path().join("state"));
        let gopro =
            Gopro::begin("gopro", self.server.clone(), Clips { download: self.download, reserve: None }, state, QUICK)
                .await;
        let mut gopro = gopro.expect("open");
        self.clips = gopro.clips();
        self.gopro = Some(gopro);
    }

    async fn close(&mut self) {
        self.gopro.take().expect("open").close().await;
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn record(&self, episode: Option<&str>) {
        let episode = episode.map(|name| self.path(&format!("{name}.mcap")));
        self.gopro.as_ref().expect("open").record(episode);
    }

    /// The clip that an episode's note names.
    fn clip_of(&self, episode: &str) -> Option<String> {
        let clip = Clip::of_note(&self.path(&format!("{episode}.gopro.clip.json")))?;
        Some(clip.name.file)
    }

    fn books(&self) -> String {
        std::fs::read_to_string(self.path("state/gopro/C344.json")).unwrap_or_default()
    }

    async fn until(&mut self, what: &str, is_so: impl Fn(&Self) -> bool) {
        let begun = Instant::now();
        while !is_so(self) {
            let asked = self.fake.asked.lock().expect("no panic").clone();
            assert!(begun.elapsed() < PATIENCE, "{what}: {asked:?}; {}", self.books());
            if let Some(gopro) = &mut self.gopro {
                let _ = tokio::time::timeout(Duration::from_millis(10), gopro.read()).await;
            }
            while let Some(Ok(clip)) = self.clips.as_mut().map(mpsc::Receiver::try_recv) {
                self.reported.push(clip.state);
            }
            sleep(Duration::from_millis(5)).await;
        }
    }

    async fn keep_alives(&mut self, count: usize) {
        let looks = self.fake.asked("/state") + count;
        self.until("keep-alives", |bench| bench.fake.asked("/state") >= looks).await;
    }
}

#[tokio::test]
async fn each_episode_has_the_clip_that_was_made_for_it_or_none() {
    let mut bench = Bench::new(false).await;
    bench.record(Some("one"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    bench.record(None);
    bench.until("a note", |bench| bench.clip_of("one").is_some()).await;
    assert_eq!(bench.clip_of("one").as_deref(), Some("GX010001.MP4"));

    // The shutter is pressed by hand between two episodes: that clip belongs to none.
    bench.fake.made();
    bench.record(Some("two"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    bench.fake.lists.store(false, Ordering::Relaxed);
    bench.record(None);
    bench.until("stopped", |bench| !bench.fake.is_recording()).await;
    // Longer than a clip usually takes to be listed.
    bench.until("given up for now", |bench| bench.fake.asked("last_captured") > 6).await;
    bench.keep_alives(3).await;
    assert_eq!(bench.clip_of("two"), None, "its clip is not listed");
    bench.fake.list();
    bench.until("a note", |bench| bench.clip_of("two").is_some()).await;
    assert_eq!(bench.clip_of("two").as_deref(), Some("GX010003.MP4"));
}

#[tokio::test]
async fn a_clip_listed_during_the_next_episode_is_not_assigned_to_it() {
    let mut bench = Bench::new(false).await;
    bench.fake.lists.store(false, Ordering::Relaxed);
    bench.record(Some("one"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    bench.record(None);
    bench.until("stopped", |bench| !bench.fake.is_recording()).await;
    bench.record(Some("two"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    // The first episode's clip, during the second.
    bench.fake.list();
    bench.keep_alives(2).await;
    bench.record(None);
    bench.until("stopped", |bench| !bench.fake.is_recording()).await;
    bench.keep_alives(2).await;
    bench.close().await;
    assert_eq!((bench.clip_of("one"), bench.clip_of("two")), (None, None));
}

#[tokio::test]
async fn without_an_answer_before_the_shutter_an_episode_gets_no_clip() {
    let mut bench = Bench::new(false).await;
    bench.fake.made();
    bench.fake.ignore_requests(Some("last_captured"));
    bench.record(Some("one"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    bench.fake.ignore_requests(None);
    bench.record(None);
    bench.until("stopped", |bench| !bench.fake.is_recording()).await;
    bench.close().await;
    assert_eq!(bench.clip_of("one"), None);
}

#[tokio::test]
async fn a_shutter_that_does_not_answer_is_asked_again() {
    let mut bench = Bench::new(false).await;
    bench.fake.ignore_requests(Some("shutter"));
    bench.record(Some("one"));
    bench.until("asked twice", |bench| bench.fake.asked("shutter/start") >= 2 * TRIES as usize).await;
    bench.fake.ignore_requests(None);
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    bench.fake.ignore_requests(Some("shutter"));
    bench.record(None);
    bench.until("asked twice", |bench| bench.fake.asked("shutter/stop") >= 2 * TRIES as usize).await;
    bench.fake.ignore_requests(None);
    bench.until("a note", |bench| bench.clip_of("one").is_some()).await;
}

#[tokio::test]
async fn a_refused_shutter_is_reported_and_asked_again_until_it_runs() {
    for pretends in [false, true] {
        let mut bench = Bench::new(false).await;
        let refuse = |bench: &Bench, refuses: bool| {
            let how = if pretends { &bench.fake.pretends } else { &bench.fake.refuses };
            how.store(refuses, Ordering::Relaxed);
        };
        refuse(&bench, true);
        bench.record(Some("one"));
        let is = |state: ClipState| move |bench: &Bench| bench.reported.last() == Some(&state);
        bench.until("refused", is(ClipState::Refused)).await;
        assert_eq!(bench.reported[..2], [ClipState::Asked, ClipState::Refused]);
        bench.until("asked again", |bench| bench.fake.asked("shutter/start") >= 3).await;
        refuse(&bench, false);
        bench.until("recording", is(ClipState::Recording)).await;
        assert!(bench.fake.is_recording());
        // An episode of its own begins anew.
        bench.record(Some("two"));
        bench.until("recording", |bench| bench.reported.ends_with(&[ClipState::Asked, ClipState::Recording])).await;
    }
}

#[tokio::test]
async fn a_shutter_that_stops_by_itself_is_reported_and_started_again_and_both_clips_are_noted() {
    let mut bench = Bench::new(false).await;
    bench.record(Some("one"));
    bench.until("recording", |bench| bench.reported == [ClipState::Asked, ClipState::Recording]).await;
    // The battery was changed, the card was full for a moment, a person pressed the button.
    bench.fake.recording.store(false, Ordering::Relaxed);
    bench.fake.made();
    bench.until("recording again", |bench| bench.reported.len() == 4).await;
    assert_eq!(bench.reported[2..], [ClipState::Stopped, ClipState::Recording]);
    assert!(bench.fake.is_recording());
    bench.record(None);
    let second = bench.path("one.gopro.GX010002.MP4.clip.json");
    bench.until("the second note", |_| second.exists()).await;
    assert_eq!(bench.clip_of("one").as_deref(), Some("GX010001.MP4"));
    let clip = Clip::of_note(&second).expect("a note");
    assert_eq!((clip.name, clip.episode), (named(2), bench.path("one.mcap")));
    bench.close().await;
}

#[tokio::test]
async fn an_episode_that_ends_while_the_connection_is_lost_ends_the_clip_too() {
    let mut bench = Bench::new(false).await;
    bench.record(Some("one"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    // The new connection is not informed of an episode.
    bench.open().await;
    bench.until("a note", |bench| bench.clip_of("one").is_some()).await;
    assert!(!bench.fake.is_recording());

    // An episode that continues is reported again, and its shutter is left alone.
    bench.record(Some("two"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    let stops = bench.fake.asked("shutter/stop");
    bench.open().await;
    bench.record(Some("two"));
    bench.keep_alives(3).await;
    assert_eq!((bench.fake.asked("shutter/stop"), bench.fake.is_recording()), (stops, true));
    bench.close().await;
    assert_eq!(bench.clip_of("two").as_deref(), Some("GX010002.MP4"));

    // If it was stopped by hand meanwhile, its clip may no longer be the newest.
    bench.open().await;
    bench.record(Some("three"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    bench.gopro = None;
    bench.fake.recording.store(false, Ordering::Relaxed);
    bench.fake.made();
    bench.open().await;
    bench.until("seen to", |bench| bench.books().is_empty()).await;
    assert_eq!(bench.clip_of("three"), None);
}

#[tokio::test]
async fn the_next_run_fetches_remaining_clips() {
    let mut bench = Bench::new(true).await;
    bench.fake.ignore_requests(Some("/videos/"));
    bench.record(Some("one"));
    bench.until("recording", |bench| bench.fake.is_recording()).await;
    bench.close().await;
    assert!(bench.books().contains("one.gopro.clip.json"), "{}", bench.books());
    // A note that was moved away with its episode.
    let books = bench.books().replace("\"notes\": [", "\"notes\": [\"/nowhere/x.gopro.clip.json\",");
    std::fs::write(bench.path("state/gopro/C344.json"), books).expect("written");
    bench.fake.ignore_requests(None);
    bench.open().await;
    let target = bench.path("one.gopro.GX010001.MP4");
    bench.until("the clip", |_| target.exists()).await;
    assert_eq!(std::fs::read(&target).expect("the clip"), CLIP);
    bench.until("forgotten", |bench| bench.books().is_empty()).await;
}

/// Fetches from a server that answers this, with part of the clip already on the disk.
async fn fetched(head: &'static str, size: Option<u64>, there: &[u8]) -> (Result<(), Failure>, Vec<u8>) {
    let listener = TcpListener::bind((Address::LOCALHOST, 0)).await.expect("a port");
    let address = listener.local_addr().expect("an address");
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            let mut request = vec![0; 4096];
            let length = stream.read(&mut request).await.unwrap_or(0);
            let is_rest = String::from_utf8_lossy(&request[..length]).to_lowercase().contains("range:");
            let whole = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n", CLIP.len());
            let answer = if is_rest { head.as_bytes().to_vec() } else { [whole.as_bytes(), CLIP].concat() };
            let _ = stream.write_all(&answer).await;
        }
    });
    let place = DeviceAddress::new(&DeviceNode::Lan { address, last_received: LastReceived::default() }, None)
        .expect("a place");
    let server = place.server(address.port()).expect("a server");
    let folder = tempfile::tempdir().expect("a folder");
    let clip = Clip::new(named(1), size, folder.path().join("ep_001.mcap"), "gopro");
    let part = clip.target().with_extension("MP4.partial");
    std::fs::write(&part, there).expect("written");
    let fetched = clip::fetch(clip.clone(), server, None).await;
    (fetched, std::fs::read(clip.target()).or_else(|_| std::fs::read(part)).unwrap_or_default())
}

#[tokio::test]
async fn a_mismatched_partial_file_is_restarted() {
    let long = [7; 100];
    for (head, size, there) in [
        // At another offset than requested, or with no offset given.
        (
            "HTTP/1.1 206 X\r\nContent-Range: bytes 2-14/15\r\nContent-Length: 13\r\n\r\nving pictures",
            None,
            &b"mov"[..],
        ),
        ("HTTP/1.1 206 X\r\nContent-Length: 12\r\n\r\ning pictures", None, &b"mov"[..]),
        ("HTTP/1.1 416 X\r\nContent-Length: 0\r\n\r\n", None, &long[..]),
        ("HTTP/1.1 416 X\r\nContent-Length: 0\r\n\r\n", Some(CLIP.len() as u64), &long[..]),
        // It is complete.
        ("HTTP/1.1 416 X\r\nContent-Length: 0\r\n\r\n", Some(CLIP.len() as u64), CLIP),
        ("HTTP/1.1 206 X\r\nContent-Range: bytes 3-14/15\r\nContent-Length: 12\r\n\r\ning pictures", None, &b"mov"[..]),
    ] {
        let (outcome, bytes) = fetched(head, size, there).await;
        assert_eq!((outcome, bytes.as_slice()), (Ok(()), CLIP), "{head:?}");
    }
}

#[tokio::test]
async fn no_number_from_a_server_breaks_the_download() {
    let huge = "HTTP/1.1 206 X\r\nContent-Range: bytes 3-9/*\r\nContent-Length: 18446744073709551614\r\n\r\nx";
    let (outcome, there) = fetched(huge, None, b"mov").await;
    assert!(matches!(outcome, Err(Failure::Stays(_))), "{outcome:?}");
    assert_eq!(there, b"mov");
    let (outcome, _) = fetched("HTTP/1.1 404 X\r\nContent-Length: 0\r\n\r\n", None, b"mov").await;
    assert!(matches!(outcome, Err(Failure::Lost(_))), "{outcome:?}");
}

#[tokio::test]
async fn a_clip_is_fetched_by_one_task_at_a_time() {
    let (server, asked) = camera(CLIP.to_vec(), 0).await;
    let folder = tempfile::tempdir().expect("a folder");
    let clip = clip_in(folder.path());
    let held = std::fs::File::create(clip.target().with_extension("MP4.partial")).expect("a file");
    rustix::fs::flock(&held, rustix::fs::FlockOperation::LockExclusive).expect("held");
    let failed = clip::fetch(clip.clone(), server.clone(), None).await.expect_err("held by another");
    assert!(matches!(failed, Failure::Stays(_)), "{failed:?}");
    assert_eq!(asked.load(Ordering::Relaxed), 0);
    drop(held);
    clip::fetch(clip, server, None).await.expect("fetched");
}

#[tokio::test]
async fn a_clip_leaves_the_reserved_disk_space_free() {
    let (server, _) = camera(CLIP.to_vec(), 0).await;
    let folder = tempfile::tempdir().expect("a folder");
    let clip = clip_in(folder.path());
    // More than any disk has.
    let failed = clip::fetch(clip.clone(), server.clone(), Some(1 << 62)).await.expect_err("no room");
    let Failure::Stays(reason) = failed else { panic!("{failed:?}") };
    assert!(reason.contains("kept for episodes (disk_reserve under [rig])"), "{reason}");
    assert!(!clip.target().exists());
    clip::fetch(clip.clone(), server, Some(0)).await.expect("room enough");
    assert_eq!(std::fs::read(clip.target()).expect("the clip"), CLIP);
}
