//! `rapid --foxglove` among strangers: what a hundred hostile clients send and do not read costs neither memory nor the
//! recording, nor the client that was there before, and pages of other sites are not let in.

use std::collections::BTreeSet;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::foxglove::{ANY, Client, address, good, start};
use crate::support::{Episode, Place, Running, until};

/// Hostile clients, of five kinds.
const CLIENTS: u64 = 100;
/// What all of them may cost, bytes.
const BOUND: u64 = 100 << 20;
/// What one of them sends before it begins again, bytes: more than a library takes for one message.
const SENT: usize = 24 << 20;

/// A request with these headers.
fn request(address: &str, headers: &str) -> String {
    format!(
        "GET / HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{headers}Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
    )
}

/// The head of a masked frame of a client; the mask is 0, so its bytes follow as they are.
fn head(first: u8, length: usize) -> Vec<u8> {
    [&[first, 0xff][..], &(length as u64).to_be_bytes(), &[0; 4]].concat()
}

/// A connection whose handshake is done, or not even that.
fn greeted(address: &str) -> std::io::Result<TcpStream> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_write_timeout(Some(Duration::from_millis(300)))?;
    stream.set_read_timeout(Some(Duration::from_millis(300)))?;
    stream.write_all(request(address, "").as_bytes())?;
    let mut byte = [0; 12];
    stream.read_exact(&mut byte)?;
    Ok(stream)
}

/// What a client of this kind does until it is closed, or has done enough.
fn attack(kind: u64, address: &str) -> std::io::Result<()> {
    let some = vec![b'['; 64 << 10];
    match kind {
        // Says nothing, or never finishes its request.
        0 => {
            let mut stream = TcpStream::connect(address)?;
            stream.set_read_timeout(Some(Duration::from_millis(300)))?;
            stream.write_all(&request(address, "X: ").as_bytes()[..40])?;
            stream.read_exact(&mut [0])
        }
        // A message that it does not finish.
        1 => {
            let mut stream = greeted(address)?;
            stream.write_all(&head(0x82, 16 << 20))?;
            (0..SENT / some.len()).try_for_each(|_| stream.write_all(&some))?;
            stream.read_exact(&mut [0])
        }
        // Parts of a message, for ever.
        2 => {
            let mut stream = greeted(address)?;
            stream.write_all(&head(0x01, 0))?;
            (0..SENT / some.len()).try_for_each(|_| {
                stream.write_all(&head(0x00, some.len()))?;
                stream.write_all(&some)
            })
        }
        // Subscribes to everything, and requests, and does not read.
        3 => {
            let mut stream = greeted(address)?;
            let list: Vec<_> = (1..60).map(|id| format!("{{\"id\":{id},\"channelId\":{id}}}")).collect();
            let text = format!("{{\"op\":\"subscribe\",\"subscriptions\":[{}]}}", list.join(","));
            stream.write_all(&[head(0x81, text.len()), text.into_bytes()].concat())?;
            let wrong = [head(0x81, 2), b"{}".to_vec()].concat().repeat(1000);
            (0..400).try_for_each(|_| stream.write_all(&wrong))
        }
        // A head without an end.
        _ => {
            let mut stream = TcpStream::connect(address)?;
            stream.set_write_timeout(Some(Duration::from_millis(300)))?;
            stream.write_all(b"GET / HTTP/1.1\r\nX: ")?;
            (0..SENT / some.len()).try_for_each(|_| stream.write_all(&some))
        }
    }
}

/// They attack again and again until this is dropped.
struct Hostile {
    ends: Arc<AtomicBool>,
    attacks: Arc<[AtomicU64; 5]>,
    threads: Vec<JoinHandle<()>>,
}

impl Hostile {
    fn begin(address: &str) -> Self {
        let (ends, attacks) = (Arc::new(AtomicBool::new(false)), Arc::<[AtomicU64; 5]>::default());
        let thread = |number: u64| {
            let (ends, attacks, address) = (Arc::clone(&ends), Arc::clone(&attacks), address.to_owned());
            std::thread::spawn(move || {
                let kind = number % 5;
                while !ends.load(Ordering::Relaxed) {
                    // However it ends.
                    let _ = attack(kind, &address);
                    // What is tested is what they hold, not how much of the processor they take from the run.
                    std::thread::sleep(Duration::from_millis(20));
                    attacks[usize::try_from(kind).expect("small")].fetch_add(1, Ordering::Relaxed);
                }
            })
        };
        let threads = (0..CLIENTS).map(thread).collect();
        Self { ends, attacks, threads }
    }

    fn fewest(&self) -> u64 {
        self.attacks.iter().map(|count| count.load(Ordering::Relaxed)).min().unwrap_or_default()
    }
}

impl Drop for Hostile {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

/// What a process holds in memory of its own, bytes.
fn resident(process: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).expect("its memory");
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:")).expect("a line");
    line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number") << 10
}

/// Whether a client that comes now gets an observation.
fn is_served(address: &str) -> bool {
    let Some(mut client) = Client::try_connect(address, Some("/rapid/observation")) else { return false };
    while client.is_open && client.count("/rapid/observation") == 0 && client.answers.is_empty() {
        client.read_one();
    }
    client.count("/rapid/observation") > 0
}

#[test]
fn a_hundred_hostile_clients_cost_neither_memory_nor_messages() {
    const MASK: &str = "/rapid/mask";
    let place = Place::lenient();
    let running = start(&place, &[]);
    let address = address(&running);
    let before = resident(running.pid());
    let mut honest = Client::connect_for(&address, Some(MASK));
    honest.read_until("masks", |client| client.count(MASK) > 500);
    let hostile = Hostile::begin(&address);
    let bounded = || {
        let more = resident(running.pid()).saturating_sub(before);
        assert!(more < BOUND, "{} MB more", more >> 20);
    };
    honest.read_until("masks among hostile clients", |client| {
        bounded();
        client.count(MASK) > 4000 && hostile.fewest() > 20
    });
    // One that comes now is served, too: sooner or later, as they come all the time.
    let late = std::thread::spawn({
        let address = address.clone();
        move || until("a late client is served", || is_served(&address))
    });
    honest.read_until("masks until then", |_| {
        bounded();
        late.is_finished()
    });
    late.join().expect("it was served");
    drop(hostile);
    let file = good(&place, running);
    honest.read();
    honest.compare(&place, &file);
    // The thread of the server is not urgent, so that on a busy machine clients see less; the recording never does.
    let episode = Episode::read(&place.path(&file));
    let masks: Vec<_> = episode.topic(MASK).collect();
    assert!(masks.windows(2).all(|pair| pair[1].sequence == pair[0].sequence + 1), "a hole in the recording");
}

#[test]
fn the_server_listens_on_its_own_port_alone() {
    let place = Place::lenient();
    let running = start(&place, &[]);
    let folder = std::fs::read_dir(format!("/proc/{}/fd", running.pid())).expect("its descriptors");
    let sockets: BTreeSet<_> = folder
        .filter_map(|entry| std::fs::read_link(entry.ok()?.path()).ok())
        .filter_map(|target| Some(target.to_str()?.strip_prefix("socket:[")?.strip_suffix(']')?.to_owned()))
        .collect();
    let table = std::fs::read_to_string("/proc/net/tcp").expect("the table of connections");
    let listens = table.lines().filter(|line| {
        let words: Vec<_> = line.split_whitespace().collect();
        words.get(3) == Some(&"0A") && words.get(9).is_some_and(|inode| sockets.contains(*inode))
    });
    assert_eq!(listens.count(), 1);
    good_after_a_second(&place, running);
}

fn good_after_a_second(place: &Place, running: Running) {
    let mut client = Client::connect(&address(&running));
    client.read_until("a second", |client| client.count("/rapid/mask") > 500);
    good(place, running);
}

#[test]
fn pages_of_other_sites_are_refused() {
    let place = Place::lenient();
    let running = start(&place, &["--foxglove-control", "--foxglove-origin", "http://localhost:8080/"]);
    let address = address(&running);
    let port = address.rsplit_once(':').expect("a port").1;
    let answered = |host: &str, origin: Option<&str>| {
        let mut stream = TcpStream::connect(&address).expect("a connection");
        let origin = origin.map(|origin| format!("Origin: {origin}\r\n")).unwrap_or_default();
        stream.write_all(request(host, &origin).as_bytes()).expect("it is sent");
        let mut status = [0; 12];
        stream.read_exact(&mut status).expect("an answer");
        String::from_utf8_lossy(&status[9..]).into_owned()
    };
    let [numbers, name] = [&address, &format!("localhost:{port}")];
    for (host, origin, expected) in [
        (numbers, None, "101"),
        (name, None, "101"),
        (numbers, Some("https://app.foxglove.dev"), "101"),
        (name, Some("file://"), "101"),
        (numbers, Some("http://localhost:8080"), "101"),
        (numbers, Some("http://localhost:8081"), "403"),
        (numbers, Some("https://evil.example"), "403"),
        (numbers, Some("https://app.foxglove.dev.evil.example"), "403"),
        (numbers, Some("http://app.foxglove.dev"), "403"),
        (numbers, Some("null"), "403"),
        (numbers, Some(""), "403"),
        // A page of the same port under another name: DNS rebinding.
        (&format!("evil.example:{port}"), Some(&*format!("http://evil.example:{port}")), "403"),
        (&format!("evil.example:{port}"), None, "403"),
        (numbers, Some(&*format!("http://{numbers}")), "403"),
    ] {
        assert_eq!(answered(host, origin), expected, "{host} {origin:?}");
    }
    until("the log names the option", || {
        let log = String::from_utf8_lossy(&place.run(&["logs"]).stdout).into_owned();
        log.contains("--foxglove-origin https://evil.example lets it in")
    });
    good_after_a_second(&place, running);
}

#[test]
fn an_origin_is_a_site_and_nothing_else() {
    let place = Place::new();
    for wrong in ["localhost:8080", "*", "http://", "http://a/b", "ftp://a", "null"] {
        let output = place.run(&["--sim", "--headless", "--foxglove", ANY, "--foxglove-origin", wrong]);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(2) && errors.contains("http://localhost:8080"), "{wrong}: {errors}");
    }
}
