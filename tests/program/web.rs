//! `rapid --web`: the page does what keys do, for those whom it is for, and costs the recording nothing. The client shares no
//! code with the server. What a browser makes of it is tested by `make fleet-test`.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt as _;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use serde_json::{Value, json};

use crate::support::{PATIENCE, Place, Running, events, logged, until};

/// A port that is free: the kernel chooses it.
const ANY: &str = "127.0.0.1:0";
const RUN: [&str; 7] = ["--sim", "--headless", "--json", "--out", "out", "--web", ANY];

struct Answer {
    status: u16,
    head: String,
    body: Vec<u8>,
}

impl Answer {
    fn text(&self) -> &str {
        std::str::from_utf8(&self.body).expect("text")
    }

    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.text()))
    }

    fn header(&self, name: &str) -> Option<&str> {
        let lines = self.head.lines().filter_map(|line| line.split_once(": "));
        lines.into_iter().find(|(other, _)| other.eq_ignore_ascii_case(name)).map(|(_, value)| value)
    }
}

/// A client of one run.
struct Client {
    address: String,
    /// Headers of each request.
    headers: String,
}

impl Client {
    fn of(running: &Running) -> Self {
        let (address, _) = link(running);
        Self { headers: format!("Host: {address}\r\nOrigin: http://{address}\r\n"), address }
    }

    fn with(&self, headers: &str) -> Self {
        Self { address: self.address.clone(), headers: headers.to_owned() }
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.address).expect("a connection");
        stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
        stream
    }

    fn send(&self, line: &str, body: &str) -> TcpStream {
        let mut stream = self.connect();
        let (headers, length) = (&self.headers, body.len());
        write!(stream, "{line} HTTP/1.1\r\n{headers}Content-Length: {length}\r\nConnection: close\r\n\r\n{body}")
            .expect("sent");
        stream
    }

    fn request(&self, line: &str, body: &str) -> Answer {
        let mut bytes = Vec::new();
        self.send(line, body).read_to_end(&mut bytes).expect("an answer");
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").expect("a head");
        let head = String::from_utf8(bytes[..end].to_vec()).expect("text");
        let status = head.split(' ').nth(1).and_then(|word| word.parse().ok()).expect("a status");
        Answer { status, head, body: bytes[end + 4..].to_vec() }
    }

    fn get(&self, path: &str) -> Answer {
        self.request(&format!("GET {path}"), "")
    }

    /// Requests something of the session; returns what was done, which was not refused.
    fn done(&self, request: &Value) -> String {
        let answer = self.request("POST /do", &request.to_string());
        assert_eq!(answer.status, 200, "{request}: {}", answer.text());
        let answer = answer.json();
        assert_eq!(answer["refused"], false, "{request}: {answer}");
        answer["text"].as_str().expect("a text").to_owned()
    }

    fn events(&self) -> Events {
        Events { stream: self.send("GET /events", ""), text: String::new(), view: Value::Null }
    }
}

/// The events of a page.
struct Events {
    stream: TcpStream,
    text: String,
    view: Value,
}

impl Events {
    /// Reads until the newest view is so.
    fn until(&mut self, what: &str, holds: impl Fn(&Value) -> bool) -> &Value {
        let begun = Instant::now();
        while !holds(&self.view) {
            assert!(begun.elapsed() < PATIENCE, "{what}: not met in time: {}", self.view);
            let mut bytes = [0; 4096];
            let count = self.stream.read(&mut bytes).expect("events");
            assert!(count > 0, "{what}: the connection has ended: {}", self.text);
            self.text.push_str(&String::from_utf8_lossy(&bytes[..count]));
            while let Some((event, rest)) = self.text.split_once("\n\n") {
                if let Some((_, view)) = event.split_once("event: view\ndata: ") {
                    self.view = serde_json::from_str(view.lines().next().expect("a line")).expect("JSON");
                }
                self.text = rest.to_owned();
            }
        }
        &self.view
    }
}

/// Address and token of the first link.
fn link(running: &Running) -> (String, String) {
    let begin = running.reported().into_iter().find(|event| event["event"] == "begin").expect("the beginning");
    let link = begin["links"][0].as_str().expect("a link").to_owned();
    let (address, token) = link.strip_prefix("http://").and_then(|link| link.split_once('/')).expect("an address");
    (address.to_owned(), token.trim_start_matches('#').to_owned())
}

fn start(place: &Place, options: &[&str]) -> Running {
    place.start(&[&RUN[..], options].concat(), "\"event\":\"begin\"")
}

fn end(running: Running) -> String {
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, Some(0), "{output}{errors}");
    output
}

fn file_of(view: &Value) -> String {
    view["about"]["file"].as_str().expect("an episode").to_owned()
}

#[test]
fn the_page_does_what_keys_do() {
    let place = Place::lenient();
    let running = start(&place, &["--task", "pour tea", "--foxglove", ANY]);
    let client = Client::of(&running);
    let mut page = client.events();
    let view = page.until("every device streams", |view| {
        view["bits"]
            .as_array()
            .is_some_and(|bits| bits.iter().all(|bit| bit["is_set"] == true && bit["hz"].as_f64() > Some(1.0)))
    });
    let named: Vec<_> = view["bits"].as_array().expect("bits").iter().map(|bit| (&bit["bit"], &bit["name"])).collect();
    assert_eq!(
        named,
        [(&json!(0), &json!("cam_wrist")), (&json!(1), &json!("tactile_tip")), (&json!(2), &json!("motor_state"))]
    );
    assert_eq!((&view["phase"], &view["recording"]), (&json!("idle"), &Value::Null));

    let begun = client.done(&json!({ "do": "start" }));
    assert!(begun.contains("pour-tea_001.mcap"), "{begun}");
    let view = page.until("it records", |view| view["recording"]["time"].as_str() > Some("00:00"));
    assert_eq!((&view["phase"], &view["recording"]["verdict"]), (&json!("recording"), &json!("GOOD")));
    assert!(view["current"].as_str().expect("an episode").ends_with("pour-tea_001.mcap"), "{view}");
    client.done(&json!({ "do": "mark" }));
    // What the session refuses is reported, and no error of the page.
    let again = client.request("POST /do", r#"{"do":"start"}"#);
    assert_eq!((again.status, &again.json()["refused"]), (200, &json!(true)));
    client.done(&json!({ "do": "stop" }));
    let first = file_of(page.until("it has ended", |view| view["about"]["verdict"] == "GOOD"));
    assert_eq!(page.view["session"]["verdicts"], json!([1, 0, 0]));
    client.done(&json!({ "do": "label", "episode": first, "label": "success" }));
    page.until("it is labelled", |view| view["about"]["label"] == "success");

    // A second one is discarded while it is recorded, by its name; and is taken back.
    client.done(&json!({ "do": "start" }));
    let second = page.until("it records", |view| view["phase"] == "recording")["current"].clone();
    // It is what is shown, and what a label is about.
    assert_eq!(page.view["about"]["file"], second);
    client.done(&json!({ "do": "label", "episode": second, "label": "failure" }));
    page.until("it is labelled", |view| view["about"]["label"] == "failure");
    client.done(&json!({ "do": "discard", "episode": second }));
    page.until("it is in the trash", |view| view["session"]["discarded"] == 1 && view["phase"] == "idle");
    assert_eq!(file_of(&page.view), first);
    let files = || place.episodes("out").into_iter().filter(|name| !name.starts_with('.')).collect::<Vec<_>>();
    until("only the first is left", || files() == [first.clone()]);
    // The press arrives again: nothing else is discarded.
    let again = client.request("POST /do", &json!({ "do": "discard", "episode": second }).to_string());
    assert_eq!(again.json()["refused"], true, "{}", again.text());
    client.done(&json!({ "do": "undo" }));
    page.until("it is back", |view| view["session"]["discarded"] == 0);
    until("both are there", || files().len() == 2);

    // With connections open the run ends at once, and they end with it.
    let output = end(running);
    assert!(!events(&output).iter().any(|event| event["event"] == "error"), "{output}");
    let mut rest = Vec::new();
    page.stream.read_to_end(&mut rest).expect("the end of the connection");
    let listed = place.run(&["list", "--json", "out", "--label", "success"]).stdout;
    let listed = String::from_utf8_lossy(&listed).into_owned();
    assert!(listed.contains("pour-tea_001.mcap") && !listed.contains("pour-tea_002.mcap"), "{listed}");
}

#[test]
fn pictures_are_small_and_as_old_as_they_are() {
    let place = Place::lenient();
    let running = start(&place, &[]);
    let client = Client::of(&running);
    let mut picture = client.get("/picture/0");
    until("a picture", || {
        picture = client.get("/picture/0");
        picture.status == 200
    });
    assert_eq!((&picture.body[..2], picture.header("content-type")), (&b"\xff\xd8"[..], Some("image/jpeg")));
    let age: u64 = picture.header("x-age-ms").and_then(|age| age.parse().ok()).expect("an age");
    assert!(Duration::from_millis(age) < PATIENCE, "{age}");
    // There is none after the newest, and then there is.
    let seq = picture.header("x-seq").expect("a number").to_owned();
    let mut next = client.get(&format!("/picture/0?after={seq}"));
    until("the next picture", || {
        let is_next = next.status == 200 && next.header("x-seq") != Some(&*seq);
        if !is_next {
            next = client.get(&format!("/picture/0?after={seq}"));
        }
        is_next
    });
    // Numbers, a bit without an entry, and what is not a path of a picture.
    for path in ["/picture/2", "/picture/63", "/picture/64", "/picture/-1", "/picture/", "/picture/0/0", "/pictures"] {
        assert_eq!(client.get(path).status, 404, "{path}");
    }
    end(running);
}

#[test]
fn the_page_is_whole_and_loads_nothing_from_elsewhere() {
    let place = Place::new();
    let running = start(&place, &[]);
    let client = Client::of(&running);
    for (path, kind) in [("/", "text/html"), ("/page.css", "text/css"), ("/page.js", "text/javascript")] {
        let answer = client.get(path);
        assert_eq!(answer.status, 200, "{path}");
        assert!(answer.header("content-type").is_some_and(|of| of.starts_with(kind)), "{path}: {}", answer.head);
        let policy = answer.header("content-security-policy").expect("a policy");
        assert!(policy.starts_with("default-src 'none'") && !policy.contains("unsafe"), "{policy}");
        assert_eq!(answer.header("x-content-type-options"), Some("nosniff"));
        assert!(!answer.text().contains("://"), "{path} names another place");
    }
    // The methods are those of the table, and nothing else is there.
    for (line, status) in
        [("POST /", 405), ("DELETE /events", 405), ("GET /do", 405), ("GET /enter", 405), ("GET /x", 404)]
    {
        assert_eq!(client.request(line, "").status, status, "{line}");
    }
    end(running);
}

#[test]
fn pages_of_other_sites_and_other_names_are_refused() {
    let place = Place::new();
    let running = start(&place, &[]);
    let client = Client::of(&running);
    let own = format!("Host: {}\r\n", client.address);
    let start = r#"{"do":"start"}"#;
    for (headers, status) in [
        ("Host: evil.example\r\nOrigin: http://evil.example\r\n".to_owned(), 421),
        (format!("{own}Origin: http://evil.example\r\n"), 403),
        (format!("{own}Origin: null\r\n"), 403),
        (own.clone(), 403),
        (format!("{own}Origin: http://{}\r\nSec-Fetch-Site: cross-site\r\n", client.address), 403),
        (String::new(), 421),
    ] {
        assert_eq!(client.with(&headers).request("POST /do", start).status, status, "{headers}");
        // Nor may it read.
        let of_other = headers.replace(&format!("Origin: http://{}\r\n", client.address), "");
        let read = if status == 421 || headers.contains("cross-site") { status } else { 200 };
        assert_eq!(client.with(&of_other).get("/picture/9").status, if read == 200 { 404 } else { read }, "{of_other}");
    }
    // What the page does not offer, and what is not a request.
    for (body, status) in [
        (r#"{"do":"end_session"}"#, 403),
        (r#"{"do":"discard"}"#, 403),
        (r#"{"do":"arm"}"#, 400),
        (r#"{"do":"mark","x":1}"#, 400),
        ("", 400),
        ("\u{0}[[[[", 400),
        (&"x".repeat(10_000), 413),
    ] {
        assert_eq!(client.request("POST /do", body).status, status, "{body:.40}");
    }
    let output = end(running);
    assert!(!output.contains("\"event\":\"recording\""), "{output}");
    assert_eq!(place.episodes("out"), [""; 0]);
}

#[test]
fn without_the_token_there_is_nothing_but_the_page() {
    let place = Place::lenient();
    let with_token = ["--record", "--web-token", "page.token"];
    let running = start(&place, &with_token);
    let (_, token) = link(&running);
    let client = Client::of(&running);
    let mode = std::fs::metadata(place.path("page.token")).expect("the file").permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    let wrong = format!(
        "{}Cookie: rapid-{}=AAAAAAAAAAAAAAAAAAAAAA\r\n",
        client.headers,
        client.address.rsplit_once(':').expect("a port").1
    );
    for client in [&client, &client.with(&wrong)] {
        assert_eq!(client.get("/").status, 200);
        for line in ["GET /events", "GET /picture/0", "GET /x"] {
            assert_eq!(client.request(line, "").status, 401, "{line}");
        }
        assert_eq!(client.request("POST /do", r#"{"do":"stop"}"#).status, 401);
        for shown in ["", "AAAAAAAAAAAAAAAAAAAAAA"] {
            let answer = client.request("POST /enter", shown);
            assert_eq!((answer.status, answer.header("set-cookie")), (401, None));
            assert!(answer.text().contains("QR code"), "{}", answer.text());
        }
    }
    let entered = client.request("POST /enter", &token);
    let cookie = entered.header("set-cookie").expect("a cookie");
    assert!(cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"), "{cookie}");
    let cookie = cookie.split(';').next().expect("a pair").to_owned();
    let client = client.with(&format!("{}Cookie: a=b; {cookie}\r\n", client.headers));
    assert_eq!(client.request("POST /enter", "").status, 204);
    client.events().until("it records", |view| view["recording"]["time"].as_str() > Some("00:00"));
    client.done(&json!({ "do": "mark" }));
    // The token is where it is needed, and in no log and no episode.
    let log = place.run(&["logs"]).stdout;
    let log = String::from_utf8_lossy(&log).into_owned();
    assert!(
        log.contains("page: http://") && log.contains("requested {\"do\":\"mark\"") && !log.contains(&token),
        "{log}"
    );
    let output = end(running);
    assert_eq!(output.matches(&token).count(), 1, "{output}");
    let episode = std::fs::read(place.path("out").join(&place.episodes("out")[0])).expect("the episode");
    assert!(!episode.windows(token.len()).any(|bytes| bytes == token.as_bytes()));
    // The link remains valid.
    let running = start(&place, &with_token[1..]);
    assert_eq!(link(&running).1, token);
    end(running);
    // A file that others may read is refused.
    std::fs::set_permissions(place.path("page.token"), std::fs::Permissions::from_mode(0o644)).expect("permissions");
    let refused = place.run(&[&RUN[..], &with_token[1..]].concat());
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("chmod 600 page.token"));
}

/// A client that has shown this token.
fn entered(client: &Client, token: &str) -> Client {
    let entered = client.request("POST /enter", token);
    let cookie = entered.header("set-cookie").expect("a cookie").split(';').next().expect("a pair").to_owned();
    client.with(&format!("{}Cookie: {cookie}\r\n", client.headers))
}

#[test]
fn those_without_the_token_keep_the_operator_neither_out_nor_from_the_page() {
    let place = Place::lenient();
    let running = start(&place, &["--web-token", "page.token"]);
    let (_, token) = link(&running);
    let client = Client::of(&running);
    // They say nothing, begin a request, or ask again and again.
    let strangers = |count: usize| -> Vec<_> {
        let stranger = |number: usize| {
            let mut stream = client.connect();
            let said: &[u8] =
                [&b""[..], b"GET /events HT", b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n"][number % 3];
            // It may have given way already.
            let _ = stream.write_all(said);
            stream
        };
        (0..count).map(stranger).collect()
    };
    let before = strangers(64);
    let operator = entered(&client, &token);
    let mut page = operator.events();
    page.until("the page is shown", |view| view["phase"].is_string());
    let after = strangers(64);
    operator.done(&json!({ "do": "start" }));
    page.until("the page continues", |view| view["phase"] == "recording");
    operator.done(&json!({ "do": "stop" }));
    drop((before, after));
    end(running);
}

#[test]
fn a_removed_token_locks_out_at_once_and_a_new_one_lets_in() {
    let place = Place::lenient();
    let running = start(&place, &["--web-token", "page.token"]);
    let (_, first) = link(&running);
    let client = Client::of(&running);
    let phone = entered(&client, &first);
    let page = phone.events();
    phone.done(&json!({ "do": "start" }));
    std::fs::remove_file(place.path("page.token")).expect("it is removed");
    let refused = |client: &Client| {
        for line in ["GET /events", "GET /picture/0", "POST /do", "POST /enter"] {
            // Not to its end: events that are not refused have none.
            let mut answer = [0; 12];
            client.send(line, &first).read_exact(&mut answer).expect("an answer");
            assert_eq!(answer, *b"HTTP/1.1 401", "{line}");
        }
    };
    refused(&phone);
    // The stream that was open ends.
    let mut rest = Vec::new();
    let mut stream = page.stream;
    stream.read_to_end(&mut rest).expect("its end");
    // Another token takes its place, with which a phone enters again.
    let kept = || std::fs::read_to_string(place.path("page.token")).unwrap_or_default().trim_end().to_owned();
    until("there is a new token", || kept().len() == 22);
    let second = kept();
    assert_ne!(first, second);
    let phone_again = entered(&client, &second);
    phone_again.events().until("it is shown", |view| view["phase"] == "recording");
    refused(&phone);
    // So does one that the user writes.
    let third = "A".repeat(30);
    std::fs::write(place.path("page.token"), &third).expect("it is written");
    refused(&phone_again);
    entered(&client, &third).done(&json!({ "do": "stop" }));
    until("the log says so", || {
        let log = String::from_utf8_lossy(&place.run(&["logs"]).stdout).into_owned();
        log.matches("the file of --web-token has another token").count() >= 2 && !log.contains(&second)
    });
    end(running);
}

#[test]
fn an_address_of_the_network_needs_a_token_that_is_new_each_time() {
    let place = Place::new();
    let options = ["--sim", "--headless", "--json", "--out", "out", "--web", "0.0.0.0:0"];
    let mut tokens = Vec::new();
    for _ in 0..2 {
        let running = place.start(&options, "\"event\":\"begin\"");
        let (address, token) = link(&running);
        let port = address.rsplit_once(':').expect("a port").1;
        let client = Client { address: format!("127.0.0.1:{port}"), headers: format!("Host: {address}\r\n") };
        assert_eq!((client.get("/").status, client.get("/events").status), (200, 401));
        let log = place.run(&["logs"]).stdout;
        assert!(String::from_utf8_lossy(&log).contains("can be reached from other machines"));
        tokens.push(token);
        end(running);
    }
    assert!(tokens[0] != tokens[1] && tokens.iter().all(|token| token.len() == 22), "{tokens:?}");
}

#[test]
fn clients_that_stick_send_garbage_or_are_many_cost_the_recording_nothing() {
    let place = Place::lenient();
    let running = start(&place, &["--record"]);
    let client = Client::of(&running);
    let mut page = client.events();
    page.until("it records", |view| view["phase"] == "recording");
    // They connect, and say nothing, or begin a request, or never read.
    let silent: Vec<_> = (0..10).map(|_| client.connect()).collect();
    let slow: Vec<_> = (0..10)
        .map(|_| {
            let mut stream = client.connect();
            stream.write_all(b"GET /events HTTP/1.1\r\nHost: ").expect("sent");
            stream
        })
        .collect();
    let deaf: Vec<_> = (0..6).map(|_| client.send("GET /events", "")).collect();
    for garbage in [
        &b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"[..],
        b"GET\r\n\r\n",
        b"\0\0\0\0\r\n\r\n",
        &[0xff; 16_000].repeat(3),
        &b"GET / HTTP/1.1\r\nA: b\r\n".repeat(3000),
    ] {
        let mut stream = client.connect();
        // It may be refused before it is whole.
        let _ = stream.write_all(garbage);
        let mut rest = Vec::new();
        let _ = stream.read_to_end(&mut rest);
        assert!(!String::from_utf8_lossy(&rest).starts_with("HTTP/1.1 2"), "{garbage:.20?}");
    }
    // Who comes when pages have all places finds none, and hears so.
    let mut many = Vec::new();
    until("a connection is refused", || {
        many.push(client.send("GET /events", ""));
        let mut stream = client.connect();
        stream.set_read_timeout(Some(Duration::from_millis(100))).expect("a timeout");
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).is_ok() && answer == *b"HTTP/1.1 503"
    });
    // The page that was there continues.
    page.until("a second later", |view| view["recording"]["time"].as_str() > Some("00:02"));
    // Those that say nothing are left, whoever they are.
    for mut stream in silent.into_iter().chain(slow) {
        let mut rest = Vec::new();
        match stream.read_to_end(&mut rest) {
            Ok(_) => assert!(!String::from_utf8_lossy(&rest).starts_with("HTTP/1.1 2")),
            Err(error) => assert_eq!(error.kind(), ErrorKind::ConnectionReset),
        }
    }
    drop((many, deaf));
    until("there is a place again", || {
        let mut stream = client.send("GET /", "");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).is_ok_and(|_| answer.starts_with("HTTP/1.1 200"))
    });
    let output = end(running);
    let episode = events(&output).into_iter().find(|event| event["event"] == "episode").expect("an episode");
    assert_eq!((&episode["verdict"], &episode["dropped"]), (&json!("GOOD"), &json!(0)), "{episode}");
}

#[test]
fn a_port_in_use_is_an_error_with_a_fix_and_a_panic_ends_no_run() {
    let place = Place::lenient();
    let order = place.path("strike");
    let mut command = place.command(&[&RUN[..], &["--record"]].concat());
    command.env("RAPID_FAULT", format!("web:{}", order.display()));
    let running = place.start_as(command, "\"event\":\"recording\"");
    let (address, _) = link(&running);
    let other = Place::new();
    let refused = other.run(&["--sim", "--headless", "--web", &address]);
    let errors = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{errors}");
    assert!(
        errors.contains(&format!("--web {address}")) && errors.contains("another program listens there"),
        "{errors}"
    );
    assert!(errors.contains("name another port"), "{errors}");

    let mut page = Client::of(&running).events();
    page.until("it records", |view| view["recording"]["time"].as_str() > Some("00:00"));
    std::fs::write(&order, "").expect("the order");
    let mut rest = Vec::new();
    let _ = page.stream.read_to_end(&mut rest);
    until("it is reported", || !logged(&running.reported(), "page: its thread panicked").is_empty());
    let output = end(running);
    let episode = events(&output).into_iter().find(|event| event["event"] == "episode").expect("an episode");
    assert_eq!(episode["verdict"], "GOOD", "{episode}");
}
