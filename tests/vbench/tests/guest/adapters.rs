//! `rapid` with CAN adapters of every kind at once: a motor behind one serial line, a raw bus behind another, and one that is full.

use serde_json::Value;
use vbench::check::{ended, ended_with, episode, play};
use vbench::emu::can::adapter::Protocol;
use vbench::emu::can::bus::FLOOD_ID;
use vbench::emu::spec::DeviceSpec;
use vbench::entries::{can, registry};
use vbench::outcome::Outcome;
use vbench::proto;
use vbench::recording::{Recording, falls, holes};
use vbench::rhythm::Rhythm;
use vbench::scenario::Scenario;

const FULL: &str = "/rapid/bus";
const SLCAN: &str = "/rapid/slcan";
/// Bytes of a recorded frame, and where its identifier and data are: README, "Motors".
const RECORD: usize = 24;
const MOTOR: &str = r#"adapter = "damiao"
protocol = "damiao"
motors = [{ name = "joint", slave = 0x05, master = 0x15, type = "DM4310", mode = "position", position = [-1.0, 1.0] }]"#;

const SCRIPT: &str = r#"
"${usbemu[@]}" --watch-mask >$out/mask.jsonl &
watcher=$!
rapid_start --headless --record --out $out/rec --config /tmp/bench/devices.toml --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
emu plug 0 1 2
# A bus is quiet until a program sends.
wait_for 30 test -e /sys/class/net/can0 || fail 'no interface'
emu flood 0 50
emu flood 1 50
for device in bus slcan damiao; do
  wait_for 60 states 1 $device streaming || fail "$device does not stream"
done
"${rapid[@]}" arm || fail 'rapid takes no order'
wait_for 30 logged motor_enabled '"device":2' || fail 'the motor is not enabled'
sleep 2
mark full
emu flood 0 8000
emu flood 1 200
sleep 3
emu flood 0 0
emu flood 1 0
emu_done 20
mark quiet
sleep 3
rapid_stop
kill $watcher
emu_quit
exit 0
"#;

fn printed(outcome: &Outcome, word: &str) -> u64 {
    let line = outcome.emu.iter().find(|line| line["action"] == "say" && line["word"] == word);
    line.and_then(|line| line["mono_ns"].as_u64()).unwrap_or_else(|| panic!("no word {word}"))
}

#[test]
fn a_full_bus_is_recorded_and_disturbs_no_other_device() {
    if crate::lacks_virtual_time() {
        return;
    }
    let adapter = |protocol, serial| DeviceSpec::can(protocol).serial(serial);
    let outcome = play(
        Scenario::new("adapters")
            .device(adapter(Protocol::GsUsb, "CAN1"))
            .device(adapter(Protocol::Slcan, "CAN2"))
            .device(adapter(Protocol::Damiao, "CAN3").motor(0x05, 0x15, "DM4310"))
            .registry(&registry(&[
                can("bus", FULL, 0, "1d50:606f", "CAN1", "protocol = \"raw\""),
                can("slcan", SLCAN, 1, "ad50:60c4", "CAN2", "adapter = \"slcan\"\nprotocol = \"raw\""),
                can("damiao", "/rapid/damiao", 2, "2e88:4603", "CAN3", MOTOR),
            ]))
            .script(SCRIPT),
    );
    // After the floods their buses are quiet for 3 s.
    ended_with(&outcome, |reason| {
        reason.starts_with("slcan: no sample for 3.0 s") || reason.starts_with("bus: no sample for 3.0 s")
    });
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    let episode = episode(&outcome);

    // Each frame that a bus had is in the file, once and in order; what is not is counted as lost.
    for (number, device, topic) in [(0, "bus", FULL), (1, "slcan", SLCAN)] {
        let numbers = flood(&episode, topic);
        let lost = lost(&outcome, device);
        println!("{device}: {} frames recorded, {lost} lost", numbers.len());
        assert!(numbers.windows(2).all(|pair| pair[0] < pair[1]), "{device}: frames twice, or in another order");
        let missing: u64 = holes(numbers.clone()).iter().map(|(from, to)| to - from - 1).sum();
        assert_eq!(missing, lost, "{device}: a silent loss");
        let mut ends = outcome.emu.iter().filter(|line| line["action"] == "flood_end" && line["device"] == number);
        let sent = ends.next_back().and_then(|end| end["sent"].as_u64()).expect("what the bus carried");
        assert!(numbers.last().is_some_and(|last| *last < sent), "{device}: frames that were not sent: {sent}");
    }
    let ends: Vec<&Value> = outcome.emu.iter().filter(|line| line["action"] == "flood_end").collect();
    ends.iter().for_each(|end| println!("{end}"));
    // 8,000 and 200 frames a second for 3 s, and none of them is lost.
    let (full, slow) = (flood(&episode, FULL).len(), flood(&episode, SLCAN).len());
    assert!(full >= 23_900 && slow >= 595, "{full} and {slow} frames: {ends:?}");
    assert_eq!((lost(&outcome, "bus"), lost(&outcome, "slcan")), (0, 0));

    // The others continue, and the mask as well.
    let edges = episode.mask_edges();
    for bit in 0..3 {
        assert_eq!(falls(&edges, bit), Vec::<u64>::new(), "bit {bit}");
    }
    let faults: Vec<&Value> =
        outcome.rapid.iter().filter(|line| line["event"] == "actuator" && line["arming"] == "faulted").collect();
    assert!(faults.is_empty(), "{faults:?}");
    let rhythm =
        Rhythm::between(&outcome, printed(&outcome, "full"), printed(&outcome, "quiet")).expect("a sampled mask");
    println!("{rhythm:?}");
    assert!(rhythm.longest_ms < 3.0, "published every 2 ms, seen every 0.5: {rhythm:?}");
    assert!(rhythm.publications > 0 && rhythm.silent_tenths == 0, "{rhythm:?}");
    let rows = episode.rows("/rapid/damiao");
    assert!(!rows.is_empty() && rows.iter().all(|row| row.len() == 6), "{} rows of the motor", rows.len());
    let off = |line: &&Value| line["action"] == "motor_disabled" && line["device"] == 2;
    assert!(outcome.emu.iter().any(|line| off(&line)), "the motor got no command to turn off");
}

#[test]
fn an_interface_that_is_set_down_stays_down_until_it_is_set_up() {
    let script = r#"
rapid_start --headless --config /tmp/bench/devices.toml --json
emu plug 0
wait_for 30 test -e /sys/class/net/can0 || fail 'no interface'
emu flood 0 50
wait_for 60 states 1 bus streaming || fail 'it does not stream'
ip link set can0 down
await_rapid 20 'used again once it is up' || fail 'it is not reported'
ip link show can0 >$out/down
ip link set can0 up
wait_for 60 states 2 bus streaming || fail 'it does not stream again'
rapid_stop
emu_quit
exit 0
"#;
    let outcome = play(
        Scenario::new("set-down")
            .device(DeviceSpec::can(Protocol::GsUsb).serial("CAN1"))
            .registry(&registry(&[can("bus", FULL, 0, "1d50:606f", "CAN1", "protocol = \"raw\"")]))
            .script(script),
    );
    ended(&outcome);
    let down = outcome.file("down");
    assert!(down.contains("can0") && !down.contains("UP"), "{down}");
}

/// What a device has lost by `rapid`'s count.
fn lost(outcome: &Outcome, device: &str) -> u64 {
    let summary = outcome.rapid.iter().rev().find(|line| line["devices"].is_array()).expect("a summary");
    let own = summary["devices"].as_array().and_then(|all| all.iter().find(|one| one["device"] == device));
    own.and_then(|own| own["gaps"].as_u64()).unwrap_or_else(|| panic!("{summary}"))
}

/// The numbers of the generated frames of the last flood, which begin at 0.
fn flood(episode: &Recording, topic: &str) -> Vec<u64> {
    let mut numbers = Vec::new();
    for message in episode.topic(topic) {
        let batch = proto::bytes(&message.data, 2);
        assert!(!batch.is_empty() && batch.len().is_multiple_of(RECORD), "{} bytes", batch.len());
        for record in batch.chunks_exact(RECORD) {
            let word = |at: usize| u32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]]);
            if word(8) != u32::from(FLOOD_ID) {
                continue;
            }
            if word(16) == 0 {
                numbers.clear();
            }
            numbers.push(u64::from(word(16)));
        }
    }
    numbers
}
