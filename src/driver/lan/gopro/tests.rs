use std::net::Ipv4Addr as Address;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;

use super::*;
use crate::registry::{DeviceNode, Heard};

/// A camera that has a clip, and breaks off in its middle so many times; who is asked how often.
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
            let status = if from.is_some() { "206 Partial Content" } else { "200 OK" };
            let head = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\n\r\n", rest.len());
            let is_broken = count.fetch_add(1, Ordering::Relaxed) < breaks;
            let sent = if is_broken { &rest[..rest.len() / 2] } else { rest };
            let _ = stream.write_all(head.as_bytes()).await;
            let _ = stream.write_all(sent).await;
        }
    });
    let place = Place::new(&DeviceNode::Lan { address, heard: Heard::default() }, None).expect("a place");
    (place.server(address.port()).expect("a server"), asked)
}

fn clip_in(folder: &std::path::Path) -> Clip {
    Clip::new("100GOPRO".into(), "GX010001.MP4".into(), folder.join("ep_001.mcap"), "gopro")
}

#[tokio::test]
async fn a_clip_is_fetched_on_from_where_it_broke_off() {
    let folder = tempfile::tempdir().expect("a folder");
    let bytes: Vec<u8> = (0..3_u32 << 20).map(|index| index.to_le_bytes()[1]).collect();
    let (server, asked) = camera(bytes.clone(), 2).await;
    let clip = clip_in(folder.path());
    clip::fetch(clip.clone(), server.clone()).await.expect("fetched");
    assert!(std::fs::read(clip.target()).expect("the clip") == bytes, "the clip is another");
    assert_eq!(asked.load(Ordering::Relaxed), 3);
    let files: Vec<_> =
        std::fs::read_dir(folder.path()).expect("a folder").flatten().map(|file| file.file_name()).collect();
    assert_eq!(files, ["ep_001.gopro.GX010001.MP4"], "nothing is left over");
    // What is there is not asked for again.
    clip::fetch(clip, server).await.expect("there");
    assert_eq!(asked.load(Ordering::Relaxed), 3);
}

#[tokio::test]
async fn a_camera_that_always_breaks_off_is_given_up_and_what_came_is_kept() {
    let (server, _) = camera(vec![7], usize::MAX).await;
    let folder = tempfile::tempdir().expect("a folder");
    let failed = clip::fetch(clip_in(folder.path()), server).await.expect_err("half of one byte never comes");
    assert!(!failed.is_empty());
    assert!(folder.path().join("ep_001.gopro.GX010001.MP4.partial").exists());
    assert!(!folder.path().join("ep_001.gopro.GX010001.MP4").exists());
}

#[test]
fn a_note_says_where_the_clip_is() {
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
    let state = state(answer, Stamp(1)).expect("a state");
    assert_eq!(
        serde_json::to_string(&state).expect("JSON"),
        r#"{"recording":true,"busy":false,"battery_percent":87,"card_free_kb":1000,"remaining_s":3600}"#
    );
    for answer in ["", "[]", "{}", r#"{"status":{}}"#, r#"{"status":{"10":"yes"}}"#] {
        assert_eq!(super::state(answer.as_bytes(), Stamp(1)), None, "{answer}");
    }
}

#[test]
fn a_model_is_read_of_either_firmware() {
    let plain = br#"{"model_name":"HERO11 Black","firmware_version":"H22.01.01.20.00"}"#;
    let wrapped = br#"{"info":{"model_name":"HERO9 Black"}}"#;
    assert_eq!(model(plain).as_deref(), Some("HERO11 Black, firmware H22.01.01.20.00"));
    assert_eq!(model(wrapped).as_deref(), Some("HERO9 Black"));
    assert_eq!(model(b"[]"), None);
}

#[test]
fn the_clock_is_set_to_the_second() {
    let request = clock();
    let digits = request.chars().filter(char::is_ascii_digit).count();
    assert!(request.starts_with("/gopro/camera/set_date_time?date=20") && digits >= 16, "{request}");
}

#[test]
fn a_clip_is_named_by_plain_words_alone() {
    let clip = |answer: &str| clip::named(answer.as_bytes());
    let good = clip(r#"{"folder":"100GOPRO","file":"GX010001.MP4"}"#).expect("a clip");
    assert_eq!(good, ("100GOPRO".to_owned(), "GX010001.MP4".to_owned()));
    assert_eq!(clip_in(std::path::Path::new("/out")).target(), PathBuf::from("/out/ep_001.gopro.GX010001.MP4"));
    for answer in [
        r#"{"folder":"100GOPRO","file":"../../etc/passwd"}"#,
        r#"{"folder":"..","file":"GX010001.MP4"}"#,
        r#"{"folder":"100GOPRO","file":".hidden"}"#,
        r#"{"folder":"100GOPRO","file":"a\nb"}"#,
        r#"{"folder":"100GOPRO","file":""}"#,
        r#"{"folder":"100GOPRO"}"#,
        "nothing",
    ] {
        assert!(clip(answer).is_err(), "{answer}");
    }
    assert_eq!(clip::size(br#"{"s":"1234"}"#), Some(1234));
    assert_eq!(clip::size(br#"{"s":1234}"#), Some(1234));
    assert_eq!(clip::size(br#"{"s":-1}"#), None);
}
