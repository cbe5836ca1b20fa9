//! Servers with the habits of real ones, against the driver.

use std::net::SocketAddr;

use rapid_registry::device::{DeviceNode, LastReceived};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;

use super::*;
use crate::driver::lan::address::DeviceAddress;

const SIZE: LanPicture = LanPicture { width: 32, height: 16, fps: 30 };

/// A picture of this size, as far as the driver looks at one.
fn picture(width: u8, height: u8) -> Vec<u8> {
    [&jpeg::START[..], &[0xff, 0xc0, 0, 17, 8, 0, height, 0, width, 3], &[7; 40], &[0xff, 0xd9]].concat()
}

fn fitting() -> Vec<u8> {
    picture(32, 16)
}

fn part(boundary: &str, body: &[u8]) -> Vec<u8> {
    let head = format!("--{boundary}\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", body.len());
    [head.as_bytes(), body, b"\r\n"].concat()
}

fn answer(head: &str, parts: &[Vec<u8>]) -> Vec<u8> {
    [format!("HTTP/1.1 200 OK\r\n{head}\r\n").as_bytes(), &parts.concat()].concat()
}

/// An answer with three pictures, and one in the middle of this kind.
fn with(middle: Vec<u8>) -> Vec<u8> {
    let parts = [fitting(), middle, fitting(), fitting()].map(|body| part("f", &body));
    answer("Content-Type: multipart/x-mixed-replace;boundary=f\r\n", &parts)
}

/// Three pictures under this head.
fn three(head: &str, boundary: &str) -> Vec<u8> {
    answer(head, &[(); 3].map(|()| part(boundary, &fitting())))
}

fn status(status: &str) -> Vec<u8> {
    format!("HTTP/1.1 {status}\r\nContent-Length: 0\r\n\r\n").into_bytes()
}

fn moved(location: &str) -> Vec<u8> {
    format!("HTTP/1.1 302 Found\r\nLocation: {location}\r\nContent-Length: 0\r\n\r\n").into_bytes()
}

/// Answers each request for a path, and keeps the connection open.
async fn server(answer: impl Fn(&str, SocketAddr) -> Vec<u8> + Send + 'static) -> Server {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    tokio::spawn(async move {
        let mut open = Vec::new();
        while let Ok((mut stream, _)) = listener.accept().await {
            let mut request = Vec::new();
            while !request.ends_with(b"\r\n\r\n") {
                let Ok(byte) = stream.read_u8().await else { break };
                request.push(byte);
            }
            let request = String::from_utf8(request).expect("ASCII");
            let path = request.split(' ').nth(1).unwrap_or_default();
            let _ = stream.write_all(&answer(path, address)).await;
            open.push(stream);
        }
    });
    let node = DeviceNode::Lan { address, last_received: LastReceived::default() };
    DeviceAddress::new(&node, None).expect("a place").server(address.port()).expect("a server")
}

/// Whether each of so many pictures is damaged, or why there is none.
async fn pictures(server: Server, path: &str, count: usize) -> Result<Vec<bool>, DriverError> {
    let mut camera = Camera::open("cam", server, path, SIZE, 4096).await?;
    let mut found = Vec::new();
    for _ in 0..count {
        let reading = camera.read().await?;
        assert_eq!((reading.width, reading.height), (SIZE.width, SIZE.height));
        found.push(reading.flags == FLAG_ERROR);
    }
    Ok(found)
}

#[tokio::test]
async fn what_servers_get_wrong_is_tolerated_where_it_is_clear_what_they_mean() {
    const ANNOUNCED: &str = "Content-Type: multipart/x-mixed-replace;boundary=f\r\n";
    const GOOD: &[bool] = &[false, false, false];
    const ONE: &[bool] = &[false, true, false, false];
    type Case = (&'static str, fn() -> Vec<u8>, &'static [bool]);
    let table: [Case; 12] = [
        ("plain", || three(ANNOUNCED, "f"), GOOD),
        ("octet", || three("Content-Type: application/octet-stream\r\n", "ffmpeg"), GOOD),
        ("no content type", || three("", "frame"), GOOD),
        ("no boundary announced", || three("Content-Type: multipart/x-mixed-replace\r\n", "frame"), GOOD),
        ("an empty one announced", || three("Content-Type: multipart/x-mixed-replace; boundary=\r\n", "frame"), GOOD),
        ("empty lines first", || answer("", &[b"\r\n\r\n".to_vec(), three("", "b")[19..].to_vec()]), GOOD),
        ("one of another size", || with(picture(64, 16)), ONE),
        (
            "the first of another size",
            || answer(ANNOUNCED, &[picture(8, 8), fitting()].map(|body| part("f", &body))),
            &[true, false],
        ),
        ("one of another kind", || with(b"\x89PNG\r\n\x1a\n".to_vec()), ONE),
        ("one that is text", || with(b"no signal".to_vec()), ONE),
        ("one that is empty", || with(Vec::new()), GOOD),
        (
            "one after the other of another size",
            || {
                let sizes = [(32, 16), (64, 16), (32, 16), (16, 32), (32, 16)];
                answer(ANNOUNCED, &sizes.map(|(width, height)| part("f", &picture(width, height))))
            },
            &[false, true, false, true, false],
        ),
    ];
    for (what, bytes, expected) in table {
        let server = server(move |_, _| bytes()).await;
        assert_eq!(pictures(server, "/video", expected.len()).await.expect(what), expected, "{what}");
    }
}

#[tokio::test]
async fn what_a_server_answers_instead_is_reported_truly_and_asked_for_again() {
    type Case = (&'static str, fn() -> Vec<u8>, &'static str);
    let table: [Case; 9] = [
        ("404", || status("404 Not Found"), "the camera has nothing at /video: correct path in [device.cam.lan]"),
        ("401", || status("401 Unauthorized"), "the camera refuses /video (401 Unauthorized): let it be seen"),
        ("503", || status("503 Service Unavailable"), "the camera answers 503 Service Unavailable to /video"),
        (
            "one picture",
            || answer("Content-Type: image/jpeg\r\n", &[fitting()]),
            "/video is image/jpeg, one picture: write",
        ),
        ("a page", || answer("Content-Type: text/html\r\n", &[]), "/video is text/html, no stream of pictures: write"),
        (
            "not parts",
            || answer("Content-Type: application/octet-stream\r\n", &[fitting()]),
            "/video (application/octet-stream) does not begin with a boundary",
        ),
        (
            "neither",
            || answer("", &[b"hello\r\n".to_vec()]),
            "/video (without a Content-Type) does not begin with a boundary",
        ),
        ("a boundary without a name", || answer("", &[b"--\r\n".to_vec()]), "does not begin with a boundary"),
        ("a line without end", || answer("", &[vec![b'-'; 4096]]), "does not begin with a boundary"),
    ];
    for (what, bytes, expected) in table {
        let server = server(move |_, _| bytes()).await;
        let error = pictures(server, "/video", 1).await.expect_err(what);
        assert!(matches!(&error, DriverError::Retry(text) if text.contains(expected)), "{what}: {error:?}");
    }
}

#[tokio::test]
async fn a_redirect_within_the_camera_is_followed_once_and_any_other_is_named() {
    let good = "/folder/stream";
    // Where /folder/video redirects to; `HERE` is the server's address. What is reported, unless it is followed.
    let table = [
        ("/folder/stream", None),
        ("stream", None),
        ("http://HERE/folder/stream", None),
        ("//HERE/folder/stream", None),
        ("/folder/stream#top", None),
        ("/folder/video", Some("redirects /folder/video to \"/folder/video\", and from there to /folder/video: write")),
        (
            "http://127.0.0.1:1/stream",
            Some("to \"http://127.0.0.1:1/stream\", which is elsewhere: write where its pictures are"),
        ),
        ("http://192.0.2.7/stream", Some("to \"http://192.0.2.7/stream\", which is elsewhere")),
        ("https://HERE/folder/stream", Some("/folder/stream\", which is elsewhere")),
        ("http://cam.local/stream", Some("to \"http://cam.local/stream\", which is elsewhere")),
        ("", Some("to \"\", which is no address")),
    ];
    for (location, expected) in table {
        let server = server(move |path, address| {
            if path == good {
                three("Content-Type: multipart/x-mixed-replace;boundary=f\r\n", "f")
            } else {
                moved(&location.replace("HERE", &address.to_string()))
            }
        })
        .await;
        match (pictures(server, "/folder/video", 3).await, expected) {
            (Ok(found), None) => assert_eq!(found, [false; 3], "{location}"),
            (Err(DriverError::Retry(text)), Some(expected)) => assert!(text.contains(expected), "{location}: {text}"),
            (other, _) => panic!("{location}: {other:?}"),
        }
    }
}

#[test]
fn only_pictures_that_do_not_fit_for_long_end_the_stream() {
    let second = Duration::from_secs(1);
    let begin = Instant::now();
    let flags =
        |mismatch: &mut Mismatch, bytes: &[u8], at: u32| mismatch.flags(bytes, "cam", SIZE, begin + second * at);
    // One in two fits: for ever.
    let mut mixed = Mismatch::default();
    for at in 0..100 {
        let (bytes, expected) = if at % 2 == 0 { (picture(64, 16), FLAG_ERROR) } else { (fitting(), 0) };
        assert_eq!(flags(&mut mixed, &bytes, at).expect("a picture"), expected);
    }
    // None fits: the entry is wrong.
    let mut never = Mismatch::default();
    for at in 0..5 {
        assert_eq!(flags(&mut never, &picture(64, 16), at).expect("a picture"), FLAG_ERROR);
    }
    let error = flags(&mut never, &picture(64, 16), 5).expect_err("for too long");
    let fix =
        "its pictures are 64x16: write width = 64 and height = 16 in [device.cam.lan], or set the device to 32x16";
    assert!(matches!(&error, DriverError::Fatal(text) if text == fix), "{error:?}");
    // It changed while it was read: it is opened again.
    for (bytes, expected) in [(picture(64, 16), fix), (b"GIF89a".to_vec(), "what it sends is not JPEG: set it to JPEG")]
    {
        let mut changed = Mismatch::default();
        assert_eq!(flags(&mut changed, &fitting(), 0).expect("a picture"), 0);
        assert_eq!(flags(&mut changed, &bytes, 1).expect("a picture"), FLAG_ERROR);
        let error = flags(&mut changed, &bytes, 6).expect_err("for too long");
        assert!(matches!(&error, DriverError::Retry(text) if text == expected), "{error:?}");
    }
}
