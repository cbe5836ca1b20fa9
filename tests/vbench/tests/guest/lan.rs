//! `rapid` with devices behind USB network adapters: a GoPro that records by itself, a LiDAR whose packets are recorded.

use serde_json::Value;
use vbench::check::{assert_accounted, ended, episode, play, rises_after, takes};
use vbench::emu::lan::{gopro, lidar};
use vbench::emu::spec::DeviceSpec;
use vbench::entries::{lan, registry};
use vbench::outcome::Outcome;
use vbench::proto;
use vbench::recording::{Recording, falls};
use vbench::scenario::Scenario;

const GOPRO: &str = "/rapid/gopro";
const LIDAR: &str = "/rapid/lidar";

const SCRIPT: &str = r#"
lan_rule 0 172.23.145.50/24
lan_rule 1 192.168.1.100/24
rapid_start --headless --record --out $out/rec --config /tmp/bench/devices.toml --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
emu plug 0 1
wait_for 60 states 1 lidar streaming || fail 'the lidar does not stream'
wait_for 60 states 1 gopro streaming || fail 'the camera does not stream'
wait_for 30 logged http shutter/start || fail 'the shutter was not started'
sleep 4
emu unplug 1
wait_for 30 states 1 lidar absent || fail 'the lidar is still there'
emu plug 1
wait_for 60 states 2 lidar streaming || fail 'the lidar does not stream again'
sleep 2
# The cable behind the adapter, which itself stays: longer than the five times that a device is opened again.
mark down
emu link 1 0
wait_for 20 is 0x01 published mask || fail 'the bit of a device without a cable is still set'
sleep 20
mark up
emu link 1 1
wait_for 60 states 3 lidar streaming || fail 'the lidar does not stream with its cable back'
sleep 2
rapid_stop
case $(cat $out/rapid.rc) in 0|4) ;; *) fail 'rapid ended with an error' ;; esac
cp $out/rapid.jsonl $out/first.jsonl
# The clip is fetched beside its episode, by the next run if the first had no time for it.
clip() { find $out/rec -name '*.MP4' -size 2000000c | grep -q .; }
rapid_start --headless --config /tmp/bench/devices.toml --json
wait_for 60 clip || fail 'the clip was not fetched'
rapid_stop
ls $out/rec >$out/files
emu_quit
exit 0
"#;

#[test]
fn a_camera_records_by_itself_and_a_lidar_is_recorded_whole() {
    let outcome = play(
        Scenario::new("net")
            .device(DeviceSpec::ecm().serial("C3441325012345").names("GoPro", "HERO12 Black").gopro(2))
            .device(DeviceSpec::ecm().serial("VLP16").lidar(200.0))
            .registry(&registry(&[
                lan("gopro", GOPRO, 0, "2672:0059", "C3441325012345", "protocol = \"gopro\"\ndownload = true"),
                lan("lidar", LIDAR, 1, "2672:0059", "VLP16", "protocol = \"udp\"\nport = 2368"),
            ]))
            .script(SCRIPT),
    );
    ended(&outcome);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    let episode = episode(&outcome);
    camera(&outcome);
    packets(&outcome, &episode);
}

/// The camera was set up, recorded as long as the episode, and its clip was named.
fn camera(outcome: &Outcome) {
    let asked: Vec<&str> = outcome.emu.iter().filter_map(|line| line["target"].as_str()).collect();
    let places = |end: &str| -> Vec<usize> {
        (0..).zip(&asked).filter(|(_, target)| target.contains(end)).map(|(place, _)| place).collect()
    };
    let first = |end: &str| *places(end).first().unwrap_or_else(|| panic!("no {end} in {asked:?}"));
    assert_eq!(asked[0], "/gopro/camera/control/wired_usb?p=1");
    assert!(first("set_date_time?date=20") < first("shutter/start"), "{asked:?}");
    assert_eq!((places("shutter/start").len(), places("shutter/stop").len()), (1, 1), "{asked:?}");
    let kept_alive = places("keep_alive").len();
    assert!(kept_alive >= 2, "{kept_alive} keep-alives in {asked:?}");
    let looked = places("last_captured");
    assert!(looked.iter().any(|place| *place > first("shutter/stop")), "{asked:?}");

    let files = outcome.file("files");
    let note = files.lines().find(|name| name.ends_with(".gopro.clip.json")).unwrap_or_else(|| panic!("{files}"));
    let note: Value = serde_json::from_str(&outcome.file(&format!("rec/{note}"))).expect("a note in JSON");
    assert_eq!((&note["file"], &note["size"]), (&"GX010001.MP4".into(), &2_000_000.into()), "{note}");
    println!("the camera was asked {} times: {note}", asked.len());
    let mut sent = vec![0; 2_000_000];
    gopro::clip(1, 0, &mut sent);
    let clip = files.lines().find(|name| name.ends_with(".MP4")).unwrap_or_else(|| panic!("{files}"));
    let fetched = std::fs::read(outcome.share.join("out/rec").join(clip)).expect("the clip");
    assert!(fetched == sent, "{clip}: differs from the clip of the camera");
    assert!(!files.contains(".partial"), "{files}");
}

/// Every packet sent between the first and the last that were recorded is there; the bit follows the adapter.
fn packets(outcome: &Outcome, episode: &Recording) {
    let mut numbers: Vec<(u64, u64)> = Vec::new();
    for message in episode.topic(LIDAR) {
        let packet = proto::bytes(&message.data, 2);
        let number = lidar::number(packet).unwrap_or_else(|| panic!("{} bytes are not a packet", packet.len()));
        numbers.push((message.log_time, number.into()));
    }
    let edges = episode.mask_edges();
    let fell = falls(&edges, 1);
    let pulled = outcome.actions("unplug", 1)[0].real_ns;
    let printed = |word: &str| {
        let line = outcome.emu.iter().find(|line| line["action"] == "say" && line["word"] == word);
        line.and_then(|line| line["real_ns"].as_u64()).unwrap_or_else(|| panic!("no word {word}"))
    };
    let (down, up) = (printed("down"), printed("up"));
    assert_eq!(fell.len(), 2, "the adapter was pulled, and then its cable: {edges:?}");
    takes(outcome, "adapter pulled to bit", pulled, fell[0], 0.0..=2.5);
    takes(outcome, "cable pulled to bit", down, fell[1], 0.0..=130.0);
    assert!(fell[0] >= pulled && fell[1] >= down && fell[1] < up, "{edges:?}");
    let rose = rises_after(&edges, 1, fell[0]);
    assert!(rose.len() == 2 && rose[0] < down && rose[1] >= up, "it rose with each return: {edges:?}");
    assert_eq!(falls(&edges, 0), Vec::<u64>::new(), "the camera's bit");
    let reported = outcome.file("first.jsonl");
    assert!(reported.contains("the network link is down"), "the reason is not reported: {reported}");
    let witness = |event: &&str| event.contains("\"event\":\"detach\"") && event.contains("\"witness\":\"link\"");
    assert_eq!(reported.lines().filter(witness).count(), 1, "the pulled cable has its witness: {reported}");
    let comes = |line: &&str| line.contains("\"event\":\"attach\"") && line.contains("\"bit\":1");
    assert_eq!(reported.lines().filter(comes).count(), 3, "at the start, and with each return: {reported}");
    assert!(!reported.contains("\"state\":\"failed\""), "a cable that is out is not a failure: {reported}");

    // What the adapter sends between the kernel's taking of it and the socket's opening is received by no one: each stay by itself.
    for (from, to) in [(0, pulled), (rose[0], down), (rose[1], u64::MAX)] {
        let stay = numbers.iter().filter(|(time, _)| (from..to).contains(time)).map(|(_, number)| *number);
        assert_accounted(episode, LIDAR, stay.collect());
    }
}
