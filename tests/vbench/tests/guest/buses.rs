//! The bench against itself: CAN adapters and their motors, a network adapter and what is behind it, as the guest sees them.

use std::time::Duration;

use serde_json::Value;
use vbench::check::play;
use vbench::emu::can::adapter::Protocol;
use vbench::emu::lan::gopro;
use vbench::emu::spec::DeviceSpec;
use vbench::outcome::Outcome;
use vbench::scenario::Scenario;

/// What a motor with slave id 5 answers that rests at its zero, 30 degrees warm.
const RESTING: &str = "015#057fff7ff7ff1e1e";

fn json(outcome: &Outcome, name: &str) -> Value {
    let text = outcome.file(name);
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{name}: {error}: {text}"))
}

/// Times (ns of the guest's CLOCK_MONOTONIC) at which the first device logged `action`.
fn reported(outcome: &Outcome, action: &str) -> Vec<u64> {
    outcome.actions(action, 0).iter().map(|moment| moment.mono_ns).collect()
}

#[test]
fn motors_answer_through_every_adapter() {
    let script = r#"
emu plug 0 1 2
wait_for 60 attached 0 1 2 || fail 'not attached'
slcan=/dev/serial/by-id/usb-Bench_Virtual_slcan_CAN2-if00
damiao=/dev/serial/by-id/usb-Bench_Virtual_damiao_CAN3-if00
wait_for 30 test -e /sys/class/net/can0 -a -e $slcan -a -e $damiao || fail 'no interface or no line'
udevadm settle
can() { "${usbemu[@]}" --can can0 "$@"; }
state() { ip -details link show can0 | sed -n 's/.* state \([A-Z-]*\) .*restart-ms.*/\1/p; s/.*can state \([A-Z-]*\) .*/\1/p' | head -n 1; }
can_up can0
udevadm info --query=property --path=/sys/class/net/can0 >$out/can0
# A zero, a parameter, enable, go to 1 rad, at 1 rad, disable, another motor, an unused id.
can 005#7fff7ff0000007ff 7ff#0500331600000000 005#fffffffffffffffc 005#8a3c7ff0520007ff >$out/answers
sleep 1
can 7ff#0500cc0000000000 005#fffffffffffffffd 006#7fff7ff0000007ff 007#7fff7ff0000007ff >>$out/answers
emu fault 0.5 d
emu hot 0.6 95
emu_done 5
can 7ff#0500cc0000000000 7ff#0600cc0000000000 >$out/faults
emu mute 0.5 1
emu fault 0.5 0
emu_done 5
can 7ff#0500cc0000000000 >>$out/faults
emu mute 0.5 0
emu busoff 0 1
wait_for 10 is BUS-OFF state || ip -details link show can0
state >$out/states
emu busoff 0 0
wait_for 10 is ERROR-ACTIVE state || ip -details link show can0
state >>$out/states
emu flood 0 500
"${usbemu[@]}" --can-count can0 500 >$out/flood.json
emu flood 0 8000
"${usbemu[@]}" --can-count can0 4000 >$out/full.json
emu flood 0 0

# A time-out of 500 ms, enabled, and commands every 5 ms when the cable goes.
can 7ff#0500550910270000 005#fffffffffffffffb 005#fffffffffffffffc >$out/before
"${usbemu[@]}" --can-stream can0 005#8a3c7ff0520007ff 5000 >$out/stream.json &
stream_pid=$!
sleep 1
emu unplug 0
wait $stream_pid
wait_for 10 has_line $out/emu.jsonl motor_timeout || fail 'the motor did not give up'
emu plug 0
wait_for 30 test -e /sys/class/net/can0 || fail 'can0 did not come back'
udevadm settle
can_up can0
can 7ff#0500cc0000000000 >$out/after

stty -F $slcan raw -echo
exec 5<>$slcan
printf 'C\rS8\rO\rt00587FFF7FF0000007FF\r' >&5
timeout 10 head -c 27 <&5 | tr '\r' ';' >$out/slcan
exec 5>&-
stty -F $damiao raw -echo
exec 5<>$damiao
printf '\x55\xaa\x1e\x03\x01\0\0\0\x0a\0\0\0\0\x05\0\0\0\0\x08\0\0\x7f\xff\x7f\xf0\0\0\x07\xff\0' >&5
timeout 10 head -c 16 <&5 | od -An -tx1 >$out/damiao
exec 5>&-
emu_quit
exit 0
"#;
    let adapter = |protocol, serial| DeviceSpec::can(protocol).serial(serial).motor(0x05, 0x15, "DMH3510");
    let outcome = play(
        Scenario::new("can")
            .device(adapter(Protocol::GsUsb, "CAN1").motor(0x06, 0x16, "DM4310"))
            .device(adapter(Protocol::Slcan, "CAN2"))
            .device(adapter(Protocol::Damiao, "CAN3"))
            .script(script),
    );
    assert_eq!(outcome.code, 0, "{}", outcome.log);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    let properties = outcome.file("can0");
    for line in ["ID_SERIAL_SHORT=CAN1", "ID_VENDOR_ID=1d50", "ID_MODEL_ID=606f", "ID_NET_DRIVER=gs_usb"] {
        assert!(properties.lines().any(|found| found == line), "{line} not in:\n{properties}");
    }

    let answers = outcome.file("answers");
    let answers: Vec<&str> = answers.lines().collect();
    assert_eq!(answers[..2], [RESTING, "015#0500331600008c43"], "rest and VMAX of 280 rad/s");
    assert!(answers[2].starts_with("015#15"), "{answers:?}: enabled");
    let position = |answer: &str| u16::from_str_radix(&answer[6..10], 16).unwrap();
    assert!(position(answers[4]).abs_diff(0x8a3c) <= 2, "{answers:?}: 1 rad is 8a3c");
    assert!(answers[5].starts_with("015#05") && answers[6].starts_with("016#06"), "{answers:?}");
    assert_eq!(answers[7], "-", "no motor has this id");
    let faults = outcome.file("faults");
    let faults: Vec<&str> = faults.lines().collect();
    assert!(faults[0].starts_with("015#d5"), "{faults:?}");
    assert!(faults[1].starts_with("016#06") && faults[1].ends_with("5f5f"), "{faults:?}: 95 degrees");
    assert_eq!(faults[2], "-", "a muted motor");
    assert_eq!(outcome.file("states"), "BUS-OFF\nERROR-ACTIVE\n");

    let flood = json(&outcome, "flood.json");
    assert_eq!((&flood["came"], &flood["lost"]), (&500.into(), &0.into()));
    println!("500 frames/s: {flood}; as fast as it goes: {}", json(&outcome, "full.json"));

    // The motor outlived its adapter's cable by its own time-out, and remembers why.
    let stream = json(&outcome, "stream.json");
    println!("stream: {stream}");
    assert!(stream["received"].as_u64().unwrap() > 20, "{stream}");
    let gone = reported(&outcome, "gone")[0];
    let gave_up = *reported(&outcome, "motor_timeout").first().unwrap();
    let silent_ns = u64::try_from(Duration::from_millis(500).as_nanos()).unwrap();
    let ends: Vec<&Value> = outcome.emu.iter().filter(|line| line["action"] == "commands_end").collect();
    let last = ends.iter().find(|line| line["count"].as_u64().unwrap() > 20).expect("a run of commands");
    let last_ns = last["last_mono_ns"].as_u64().unwrap();
    assert!(gave_up >= last_ns + silent_ns, "it gave up after {} ms", (gave_up - last_ns) / 1_000_000);
    assert!(last_ns <= gone, "commands continued when the adapter was gone");
    assert!(outcome.file("after").starts_with("015#d5"), "{}", outcome.file("after"));

    assert_eq!(outcome.file("slcan"), ";;;z;t0158057FFF7FF7FF1E1E;");
    assert_eq!(outcome.file("damiao").trim(), "aa 11 08 15 00 00 00 05 7f ff 7f f7 ff 1e 1e 55");
}

#[test]
fn a_camera_and_a_lidar_answer_behind_a_network_adapter() {
    let script = r#"
net=enx00005e005300
lan_up() {
  wait_for 60 test -e /sys/class/net/$net || { ip link; fail 'no interface'; }
  wait_for 10 eval 'ip -4 addr show up dev $net | grep -q 172.23.145.50/24' || { ip addr; fail 'no address'; }
}
lan_rule 0 172.23.145.50/24
get() {
  exec 6<>/dev/tcp/172.23.145.51/8080 || return 1
  printf 'GET %s HTTP/1.1\r\nHost: camera\r\n\r\n' "$1" >&6
  timeout 60 cat <&6
  exec 6>&-
}
ok() { get "$1" >/tmp/answer; grep -aq '200 OK' /tmp/answer; }
emu plug 0
lan_up
udevadm info --query=property --path=/sys/class/net/$net >$out/net
wait_for 20 ok /gopro/camera/info || fail 'the camera does not answer'
cp /tmp/answer $out/info
for target in '/gopro/camera/control/wired_usb?p=1' /gopro/camera/shutter/start /gopro/camera/shutter/stop; do
  ok "$target" || fail "$target: $(cat /tmp/answer)"
done
wait_for 20 ok /gopro/media/last_captured || fail 'no clip'
cp /tmp/answer $out/last
get /videos/DCIM/100GOPRO/GX010001.MP4 >$out/clip
"${usbemu[@]}" --lidar 2368 600 >$out/lidar.json
cat /sys/class/net/$net/carrier >$out/carrier
emu link 0 0
wait_for 10 is 0 cat /sys/class/net/$net/carrier || fail 'the link is still up'
emu link 0 1
wait_for 10 is 1 cat /sys/class/net/$net/carrier || fail 'the link is still down'
emu unplug 0
wait_for 30 test ! -e /sys/class/net/$net || fail 'the interface is still there'
emu plug 0
lan_up
wait_for 20 ok /gopro/media/list || fail 'the camera does not answer after the plug'
cp /tmp/answer $out/list
emu_quit
exit 0
"#;
    let outcome = play(
        Scenario::new("lan")
            .device(DeviceSpec::ecm().serial("C3441325012345").names("GoPro", "HERO12 Black").gopro(2).lidar(200.0))
            .script(script),
    );
    assert_eq!(outcome.code, 0, "{}", outcome.log);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    let properties = outcome.file("net");
    for line in ["ID_SERIAL_SHORT=C3441325012345", "ID_VENDOR_ID=2672", "ID_NET_DRIVER=cdc_ether"] {
        assert!(properties.lines().any(|found| found == line), "{line} not in:\n{properties}");
    }
    assert!(outcome.file("info").contains(r#""serial_number":"C3441325012345""#), "{}", outcome.file("info"));
    assert!(outcome.file("last").contains(r#""file":"GX010001.MP4""#), "{}", outcome.file("last"));
    assert!(outcome.file("list").contains("GX010001.MP4"), "{}", outcome.file("list"));

    let answer = std::fs::read(outcome.share.join("out/clip")).unwrap();
    let head = answer.windows(4).position(|four| four == b"\r\n\r\n").expect("a head") + 4;
    let mut clip = vec![0; 2_000_000];
    gopro::clip(1, 0, &mut clip);
    assert!(answer[head..] == clip, "{} bytes of the clip", answer.len() - head);

    let lidar = json(&outcome, "lidar.json");
    println!("lidar: {lidar}");
    assert_eq!((&lidar["came"], &lidar["lost"]), (&600.into(), &0.into()));

    let asked: Vec<&str> = outcome.emu.iter().filter_map(|line| line["target"].as_str()).collect();
    let starts = asked.iter().filter(|target| target.ends_with("shutter/start")).count();
    assert_eq!((asked.first(), starts), (Some(&"/gopro/camera/info"), 1), "{asked:?}");
}
