//! What a user sees of real devices: the listing, the installed rules, raw formats recorded, and a
//! wish that a camera cannot fulfil.

use vbench::check::{assert_accounted, assert_lines, ended_with};
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::recording::Picture;
use vbench::scenario::Scenario;

const REGISTRY: &str = r#"
[device.cam_wide]                  # the camera has no such picture size
vid = "0x046d"
pid = "0x0825"
serial = "CAM00A1"
node = "camera"
topic = "/rapid/camera/wide"
bit = 0
[device.cam_wide.camera]
width = 1280
height = 720
fps = 30
format = "MJPG"

[device.cam_raw]
vid = "0x2bc5"
pid = "0x0501"
serial = "YUV1"
node = "camera"
topic = "/rapid/camera/raw"
bit = 1
[device.cam_raw.camera]
width = 320
height = 240
fps = 15
format = "YUYV"
controls = { contrast = 60 }

[device.cam_depth]
vid = "8086"
pid = "0b07"
serial = "Z1"
node = "camera"
topic = "/rapid/camera/depth"
bit = 3
[device.cam_depth.camera]
width = 64
height = 48
fps = 15
format = "Z16"

[device.force]
vid = "0x0403"
pid = "0x6001"
serial_number = "FT1"
node = "serial"
topic = "/rapid/force"
bit = 2
[device.force.tty]
baud = 115200
framing = "line"
parse = "csv"
channels = 4
"#;

const SCRIPT: &str = r#"
emu plug 0 1 2 3 4
wait_for 60 attached 0 1 2 3 4 || fail 'not attached'
wait_for 30 test -e /dev/video4 -a -e /dev/ttyUSB0 -a -e /dev/ttyACM0
udevadm settle
# A camera that is not on USB.
modprobe vivid n_devs=1 node_types=0x1 vid_cap_nr=9 || fail 'no vivid'
wait_for 30 test -e /dev/video9
udevadm settle
config='--config /tmp/bench/devices.toml'
"${rapid[@]}" devices --formats $config >$out/devices.txt || fail 'rapid devices'
"${rapid[@]}" devices --json $config >$out/devices.jsonl || fail 'rapid devices --json'
"${rapid[@]}" artifacts --install $config >$out/install.txt 2>&1 || fail 'rapid artifacts --install'
wait_for 30 test -e /dev/rapid/cam_raw -a -e /dev/rapid/force || fail 'no links'
ls -l /dev/rapid >$out/links
rapid_start --headless --record --out $out/rec $config --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
for device in cam_raw cam_depth force; do
  wait_for 60 states 1 $device streaming || fail "$device does not stream"
done
wait_for 60 states 1 cam_wide failed || fail 'cam_wide does not fail'
"${rapid[@]}" --headless --duration 1s $config >$out/second.txt 2>&1; echo $? >$out/second.rc
# Held by rapid: no other program can stream from it.
"${usbemu[@]}" --read /dev/rapid/cam_raw 1 >$out/held.txt 2>&1
# A screen of another process sets a control while the camera streams, and shows it on the page of the camera.
mkfifo /tmp/keys
exec 6<>/tmp/keys
script -qec "stty rows 40 cols 120; ${rapid[*]} monitor" /dev/null </tmp/keys >$out/screen 2>&1 6>&- &
screen=$!
keys() { printf "$1" >&6; }
in_log() { has_line $out/rapid.jsonl '"event":"log"' "$1"; }
wait_for 60 has_line $out/screen cam_raw || fail 'no screen'
# By bit: cam_raw is the second, whatever is wrong with the others.
keys 'j\r'
wait_for 30 has_line $out/screen contrast || fail 'the page of the camera does not show its controls'
keys 'Cbrightness=-40\r'
wait_for 30 in_log 'cam_raw: brightness is -40' || fail 'brightness is not set'
keys 'Cbrightness=65\r'
wait_for 30 in_log 'cam_raw: brightness is not set' || fail 'brightness 65 is not refused'
keys 'Chue=1\r'
wait_for 30 in_log 'cam_raw: hue is not set' || fail 'hue is not refused'
grep -F 'cam_raw: ' $out/rapid.jsonl >$out/controls.jsonl
keys '\003'
has_left() { ! kill -0 $screen 2>/dev/null; }
wait_for 30 has_left || fail 'the screen does not leave'
sleep 2
rapid_stop
# What was set when the camera was opened, as the camera reports it.
grep -aho '"controls":{[^}]*}' $out/rec/*.mcap >$out/readback
emu unplug 1 2
wait_for 30 detached 1 2
udevadm settle
ls /dev/rapid >$out/left 2>/dev/null
emu_quit
exit 0
"#;

#[test]
fn real_devices_are_listed_linked_and_recorded_and_an_unmet_request_is_reported() {
    let outcome = Scenario::new("commands")
        .device(DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 640, 480, &[30]))
        .device(DeviceSpec::uvc(0x2bc5, 0x0501).serial("YUV1").mode(Format::Yuyv, 320, 240, &[15]))
        .device(DeviceSpec::ftdi(0x0403, 0x6001, 50.0).serial("FT1"))
        .device(DeviceSpec::acm(0x2e8a, 0x000a, 10.0).serial("STRANGER"))
        .device(DeviceSpec::uvc(0x8086, 0x0b07).serial("Z1").mode(Format::Z16, 64, 48, &[15]))
        .registry(REGISTRY)
        .script(SCRIPT)
        .run()
        .unwrap_or_else(|error| panic!("{error}"));
    ended_with(&outcome, |reason| reason.starts_with("cam_wide: plugged in for "));

    let listing = outcome.file("devices.txt");
    println!("{listing}");
    for word in [
        "[device.cam_wide]",
        "[device.cam_raw]",
        "[device.force]",
        "STRANGER",
        "MJPG 640x480",
        "YUYV 320x240",
        "Z16 64x48",
        "Brightness -64..=64 (default 0)",
    ] {
        assert!(listing.contains(word), "{word} not in:\n{listing}");
    }
    let objects: Vec<serde_json::Value> =
        outcome.file("devices.jsonl").lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let entry = |serial: &str| {
        let object = objects.iter().find(|object| object["serial"] == serial);
        object.unwrap_or_else(|| panic!("{serial} not in {objects:?}"))["entry"].clone()
    };
    assert_eq!([entry("CAM00A1"), entry("YUV1"), entry("FT1")], ["cam_wide", "cam_raw", "force"]);
    assert_eq!(entry("STRANGER"), serde_json::Value::Null);
    let onboard: Vec<_> = objects.iter().filter(|object| object["node"] == "/dev/video9").collect();
    assert_eq!(onboard.len(), 1, "{objects:?}");
    assert!(onboard[0]["entry"].is_null() && onboard[0]["reasons"][0].as_str().unwrap().contains("not on USB"));
    let (_, onboard) = listing.split_once("/dev/video9").expect("a camera that is not on USB is listed");
    assert!(onboard.contains("it is not on USB") && onboard.contains("YUYV"), "{listing}");

    // Stable names appear with the rules, and go with the devices.
    println!("{}", outcome.file("links"));
    for link in ["cam_raw -> ../video", "cam_wide -> ../video", "force -> ../ttyUSB0"] {
        assert!(outcome.file("links").contains(link), "{link} not in:\n{}", outcome.file("links"));
    }
    assert_eq!(outcome.file("left").split_whitespace().collect::<Vec<_>>(), ["cam_depth", "cam_wide"]);

    let failed = outcome.rapid.iter().find(|line| line["device"] == "cam_wide" && line["state"] == "failed");
    let detail = failed.expect("cam_wide has failed")["detail"].as_str().unwrap().to_owned();
    println!("{detail}");
    assert!(detail.contains("offers no MJPG 1280x720 at 30 fps; it offers MJPG 640x480"), "{detail}");

    println!("{}", outcome.file("controls.jsonl"));
    println!("{}", outcome.file("readback"));
    assert!(outcome.file("readback").contains("\"contrast\":60"), "{}", outcome.file("readback"));

    // A second rapid on the same rig ends at once and names the first.
    assert_eq!(outcome.file("second.rc").trim(), "1");
    assert!(outcome.file("second.txt").contains("another rapid (pid "), "{}", outcome.file("second.txt"));
    assert!(outcome.file("held.txt").contains("error"), "{}", outcome.file("held.txt"));

    let episode = outcome.episode().unwrap_or_else(|error| panic!("{error}"));
    let number = |picture: Picture<'_>| picture.id.map(|id| u64::from(id.number));
    let pictures: Vec<u64> = episode.pictures("/rapid/camera/raw").filter_map(number).collect();
    assert_eq!(pictures.len(), episode.topic("/rapid/camera/raw").count(), "some pictures carry no number");
    assert_accounted(&episode, "/rapid/camera/raw", pictures);
    assert_lines(&episode, "/rapid/force");
    let depths: Vec<Picture<'_>> = episode.pictures("/rapid/camera/depth").collect();
    assert!(depths.len() > 10, "{}", depths.len());
    assert!(depths.iter().all(|picture| picture.encoding == b"16UC1" && picture.data.len() == 2 * 64 * 48));
    let numbers: Vec<u64> = depths.iter().copied().filter_map(number).collect();
    assert_eq!(numbers.len(), depths.len(), "some have no number");
    assert_accounted(&episode, "/rapid/camera/depth", numbers);
    assert_eq!(episode.topic("/rapid/camera/wide").count(), 0);
}
