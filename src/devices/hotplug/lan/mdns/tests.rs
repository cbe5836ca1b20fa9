use rapid_registry::device::{Attachment, DeviceNode, Unit};
use tokio::sync::mpsc;

use super::super::super::HotplugEvent;
use super::*;

const LEASE: Duration = Duration::from_secs(3);

/// The entries of a service, and their reports.
struct Bench {
    service: Service,
    reported: mpsc::Receiver<HotplugEvent>,
    now: Stamp,
}

impl Bench {
    fn new(entries: &[(&str, Option<&str>)]) -> Self {
        let (notify, reported) = mpsc::channel(64);
        let wanted = entries.iter().map(|(entry, instance)| Wanted {
            watch: Watch::new(entry, LEASE, notify.clone()),
            instance: instance.map(str::to_owned),
            port: None,
            current: None,
            since: Stamp::default(),
            asked: None,
        });
        let service = Service {
            domain: "_s._tcp.local.".into(),
            wanted: wanted.collect(),
            known: BTreeMap::new(),
            cut: BTreeMap::new(),
        };
        Self { service, reported, now: Stamp(1_000_000_000_000) }
    }

    async fn announced(&mut self, name: &str, addresses: &[&str]) -> Vec<String> {
        let addresses = addresses.iter().map(|address| address.parse().expect("an address")).collect();
        let found = AnnouncedDevice { name: name.into(), addresses };
        self.service.announced(format!("{name}._s._tcp.local."), found, self.now).await;
        self.reported()
    }

    /// Instance a was announced so long ago: what its driver receives has the machine's time.
    async fn attached(&mut self, ago: Duration) -> Attachment {
        self.now = Stamp::now().before(ago);
        let found = AnnouncedDevice { name: "a".into(), addresses: vec![([127, 0, 0, 1], 5).into()] };
        self.service.announced("a._s._tcp.local.".into(), found, self.now).await;
        let Ok(HotplugEvent::Added(attachment)) = self.reported.try_recv() else { panic!("not reported") };
        attachment
    }

    async fn removed(&mut self, name: &str) -> Vec<String> {
        self.service.removed(&format!("{name}._s._tcp.local."), self.now).await;
        self.reported()
    }

    /// Checks every 100 ms for this long; returns the number of queries and the reports.
    async fn pass(&mut self, ms: u64) -> (usize, Vec<String>) {
        let mut questions = 0;
        for _ in 0..ms / 100 {
            self.now = self.now.after(LOOK_EVERY);
            questions += self.service.check(self.now).await.len();
        }
        (questions, self.reported())
    }

    fn reported(&mut self) -> Vec<String> {
        let mut reported = Vec::new();
        while let Ok(event) = self.reported.try_recv() {
            reported.push(match event {
                HotplugEvent::Added(attachment) => {
                    let (Unit::Lan(lan), DeviceNode::Lan { address, .. }) = (&attachment.unit, &attachment.node) else {
                        panic!("not on the network: {attachment:?}")
                    };
                    assert_eq!(lan.address, address.to_string());
                    format!("+{} {} {address}", lan.entry, lan.instance.as_deref().unwrap_or_default())
                }
                HotplugEvent::Removed { syspath, source, .. } => format!("-{} {}", syspath.display(), source.word()),
            });
        }
        reported
    }
}

#[tokio::test]
async fn an_instance_is_reported_once_and_its_goodbye_immediately() {
    let mut bench = Bench::new(&[("phone", None)]);
    assert_eq!(bench.announced("a", &["127.0.0.1:5"]).await, ["+phone a 127.0.0.1:5"]);
    // More addresses of the same announcement.
    assert!(bench.announced("a", &["127.0.0.2:5", "127.0.0.1:5"]).await.is_empty());
    bench.pass(1000).await;
    assert_eq!(bench.removed("a").await, ["-/lan/phone goodbye"]);
    assert!(bench.removed("a").await.is_empty());
    assert_eq!(bench.announced("a", &["127.0.0.1:5"]).await, ["+phone a 127.0.0.1:5"]);
    // Its address has changed.
    assert_eq!(bench.announced("a", &["127.0.0.9:5"]).await, ["+phone a 127.0.0.9:5"]);
}

#[tokio::test]
async fn announced_instances_are_queried_again_and_silence_ends_the_lease() {
    let mut bench = Bench::new(&[("phone", None)]);
    bench.announced("a", &["127.0.0.1:5"]).await;
    assert_eq!(bench.pass(3000).await, (1, vec![]));
    assert_eq!(bench.pass(9000).await.0, 2, "once a lease and a pause");
    // 12 s: queried at 0.1, 4.1, 8.1; the last lease is over at 11.1.
    assert_eq!(bench.removed("a").await, ["-/lan/phone lease"]);
    // An instance that the library cannot query is not queried.
    bench.announced("b.c", &["127.0.0.1:5"]).await;
    assert_eq!(bench.pass(9000).await, (0, vec![]));
}

/// A library that had to wait for a processor reports late, and then in the lease of the next query: of a silent device that is no
/// goodbye.
#[tokio::test]
async fn a_late_report_of_a_missing_answer_is_no_goodbye() {
    let lease = u64::try_from(LEASE.as_millis()).expect("short");
    for waited in (lease - 100..5 * lease).step_by(100) {
        let mut bench = Bench::new(&[("phone", None)]);
        bench.announced("a", &["127.0.0.1:5"]).await;
        // Queried in the first 100 ms.
        assert!(bench.pass(100 + waited).await.0 >= 1, "{waited} ms after the query");
        assert_eq!(bench.removed("a").await, ["-/lan/phone lease"], "{waited} ms after the query");
    }
}

/// The library reports an instance again when one of its addresses changes, and keeps the end of a query's lease: the driver's
/// reception counts then as well.
#[tokio::test]
async fn a_missing_answer_is_one_whatever_was_announced_since_the_query() {
    let lease = u64::try_from(LEASE.as_millis()).expect("short");
    for (announced, late) in (100..lease).step_by(100).zip([0, 300, 900].into_iter().cycle()) {
        let mut bench = Bench::new(&[("phone", None)]);
        let attachment = bench.attached(3 * LEASE).await;
        assert_eq!(bench.pass(announced).await.0, 1);
        assert!(bench.announced("a", &["127.0.0.1:5", "127.0.0.2:5"]).await.is_empty());
        let DeviceNode::Lan { last_received, .. } = attachment.node else { panic!("not on the network") };
        last_received.now();
        assert_eq!(bench.pass(100 + lease - announced + late).await.0, 0, "announced {announced} ms after the query");
        assert!(bench.removed("a").await.is_empty(), "announced {announced} ms after the query, {late} ms late");
    }
}

#[tokio::test]
async fn a_device_that_sends_keeps_its_entry_although_another_is_announced() {
    let mut bench = Bench::new(&[("phone", None)]);
    let attachment = bench.attached(2 * LEASE).await;
    assert!(bench.announced("b", &["127.0.0.2:5"]).await.is_empty());
    bench.service.wanted[0].asked = Some(bench.now);
    bench.now = bench.now.after(LEASE);
    let DeviceNode::Lan { last_received, .. } = attachment.node else { panic!("not on the network") };
    last_received.now();
    assert!(bench.removed("a").await.is_empty());
    assert!(bench.announced("b", &["127.0.0.2:5", "127.0.0.3:5"]).await.is_empty());
    // Silent for longer than its lease: the other takes its place.
    assert_eq!(bench.pass(12_000).await.1, ["-/lan/phone lease", "+phone b 127.0.0.2:5"]);
}

/// An announcement over one link of several replaces those of the others: the library then names fewer addresses.
#[tokio::test]
async fn a_device_that_sends_keeps_its_address_although_only_another_is_announced() {
    let mut bench = Bench::new(&[("phone", None)]);
    let attachment = bench.attached(2 * LEASE).await;
    let DeviceNode::Lan { last_received, .. } = attachment.node else { panic!("not on the network") };
    last_received.now();
    assert!(bench.announced("a", &["127.0.0.2:5"]).await.is_empty());
    assert!(bench.pass(3000).await.1.is_empty());
    // Silent for longer than its lease: it has moved there.
    assert_eq!(bench.pass(12_000).await.1, ["+phone a 127.0.0.2:5"]);
}

/// One that was queried once, answered and sends data is not queried again: its goodbye is one whenever it comes.
#[tokio::test]
async fn a_goodbye_is_one_before_and_after_the_lease_of_a_query() {
    let lease = u64::try_from(LEASE.as_millis()).expect("short");
    for waited in (0..lease - 100).step_by(100).chain((lease + 1100..5 * lease).step_by(100)) {
        let mut bench = Bench::new(&[("phone", None)]);
        let attachment = bench.attached(10 * LEASE).await;
        assert_eq!(bench.pass(100).await.0, 1);
        bench.now = bench.now.after(Duration::from_millis(waited));
        let DeviceNode::Lan { last_received, .. } = attachment.node else { panic!("not on the network") };
        last_received.now();
        assert_eq!(bench.removed("a").await, ["-/lan/phone goodbye"], "{waited} ms after the query");
    }
}

#[tokio::test]
async fn data_received_by_the_driver_outlasts_a_lost_announcement_and_not_a_goodbye() {
    for goodbye in [false, true] {
        let mut bench = Bench::new(&[("phone", None)]);
        let attachment = bench.attached(Duration::from_secs(10)).await;
        let DeviceNode::Lan { last_received, .. } = attachment.node else { panic!("not on the network") };
        bench.service.wanted[0].asked = Some(bench.now);
        bench.now = bench.now.after(if goodbye { LEASE / 2 } else { LEASE });
        last_received.now();
        if goodbye {
            assert_eq!(bench.removed("a").await, ["-/lan/phone goodbye"]);
            continue;
        }
        assert!(bench.removed("a").await.is_empty());
        assert_eq!(bench.pass(5000).await, (0, vec![]), "nothing can be queried");
        assert_eq!(bench.pass(12_000).await.1, ["-/lan/phone lease"]);
    }
}

#[tokio::test]
async fn each_instance_takes_one_entry_and_a_named_instance_its_own() {
    let mut bench = Bench::new(&[("left", None), ("named", Some("B")), ("right", None)]);
    assert_eq!(bench.announced("b", &["127.0.0.1:2"]).await, ["+named b 127.0.0.1:2"], "not the first free one");
    assert_eq!(bench.announced("a", &["127.0.0.1:1"]).await, ["+left a 127.0.0.1:1"]);
    assert_eq!(bench.removed("b").await, ["-/lan/named goodbye"]);
    let mut bench = Bench::new(&[("named", Some("B")), ("left", None), ("right", None)]);
    assert_eq!(bench.announced("a", &["127.0.0.1:1"]).await, ["+left a 127.0.0.1:1"]);
    assert_eq!(bench.announced("b", &["127.0.0.1:2"]).await, ["+named b 127.0.0.1:2"]);
    assert_eq!(bench.announced("c", &["127.0.0.1:3"]).await, ["+right c 127.0.0.1:3"]);
    assert!(bench.announced("d", &["127.0.0.1:4"]).await.is_empty());
    // A waiting instance takes the place of one that left.
    assert_eq!(bench.removed("a").await, ["-/lan/left goodbye", "+left d 127.0.0.1:4"]);
}

#[tokio::test]
async fn a_link_that_was_down_for_a_moment_brings_its_device_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let state = folder.path().join("carrier");
    let mut bench = Bench::new(&[("phone", None)]);
    bench.announced("a", &["127.0.0.1:5"]).await;
    bench.pass(200).await;
    std::fs::write(&state, "0\n").expect("written");
    bench.service.wanted[0].watch.lead_over(NetworkLink::of_interface(folder.path().to_str().expect("plain text")));
    assert_eq!(bench.pass(1000).await, (0, vec!["-/lan/phone link".to_owned()]));
    // Another instance's announcement is not evidence of this one.
    assert_eq!(bench.announced("b", &["127.0.0.1:6"]).await, ["+phone b 127.0.0.1:6"]);
    assert_eq!(bench.removed("b").await, ["-/lan/phone goodbye"]);
    std::fs::write(&state, "1\n").expect("written");
    // The library reports nothing, because the announcement has not changed. So the device is queried.
    assert_eq!(bench.pass(1000).await, (1, vec!["+phone a 127.0.0.1:5".to_owned()]));
    assert_eq!(bench.removed("a").await, ["-/lan/phone goodbye"]);
}

#[tokio::test]
async fn an_announcement_over_another_link_counts_at_once() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("carrier"), "0\n").expect("written");
    let mut bench = Bench::new(&[("phone", None)]);
    bench.announced("a", &["127.0.0.1:5"]).await;
    bench.service.wanted[0].watch.lead_over(NetworkLink::of_interface(folder.path().to_str().expect("plain text")));
    assert_eq!(bench.pass(500).await.1, ["-/lan/phone link"]);
    assert_eq!(bench.announced("a", &["127.0.0.2:5"]).await, ["+phone a 127.0.0.2:5"]);
}

#[tokio::test]
async fn announcements_change_no_time_of_a_query() {
    let mut bench = Bench::new(&[("left", None), ("right", None)]);
    bench.announced("a", &["127.0.0.1:1"]).await;
    bench.announced("b", &["127.0.0.1:2"]).await;
    assert_eq!(bench.pass(100).await.0, 2);
    // Repeatedly, faster than a lease.
    let mut questions = 0;
    for _ in 0..20 {
        bench.announced("b", &["127.0.0.1:2"]).await;
        questions += bench.pass(200).await.0;
    }
    assert_eq!(questions, 2, "each again after its lease and a pause, and no earlier");
}

#[tokio::test]
async fn a_flood_of_names_is_bounded() {
    let mut bench = Bench::new(&[("phone", Some("never"))]);
    for number in 0..1000 {
        bench.announced(&format!("n{number}"), &["127.0.0.1:1"]).await;
    }
    assert_eq!(bench.service.known.len(), MOST_INSTANCES);
}

#[test]
fn names_are_read_as_dns_writes_them() {
    for (label, name) in [
        ("iPhone-iPhoneVIO", "iPhone-iPhoneVIO"),
        (r"one\. two", "one. two"),
        (r"a\\b", r"a\b"),
        (r"tab\009end", "tab\tend"),
        (r"odd\", "odd"),
        (r"\999", "999"),
        (r"\195\164", "ä"),
        (r"\255", "\u{fffd}"),
    ] {
        assert_eq!(unescaped(label), name, "{label}");
    }
    assert_eq!(unescaped(&"x".repeat(500)).len(), LONGEST_NAME);
}

#[test]
fn the_best_address_is_the_same_each_time() {
    let ip = |text: &str| text.parse::<IpAddr>().expect("an address");
    let all = [
        ("fe80::1", 3),
        ("127.0.0.1", 0),
        ("fd00::2", 0),
        ("192.168.1.9", 0),
        ("192.168.1.7", 0),
        ("0.0.0.0", 0),
        ("224.0.0.1", 0),
    ];
    let found = ordered(all.iter().map(|(text, scope)| (ip(text), *scope)), 80);
    let shown: Vec<_> = found.iter().map(ToString::to_string).collect();
    assert_eq!(shown, ["192.168.1.7:80", "192.168.1.9:80", "[fd00::2]:80", "[fe80::1%3]:80", "127.0.0.1:80"]);
}
