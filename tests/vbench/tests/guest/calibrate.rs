//! `rapid calibrate latency` on real drivers: a camera that looks at a light, and one that does not.

use vbench::emu::spec::{DeviceSpec, Format};
use vbench::scenario::Scenario;

const REGISTRY: &str = r#"
[device.cam_light]
vid = "0x2bc5"
pid = "0x0501"
serial = "YUV1"
node = "camera"
bit = 0
[device.cam_light.camera]
width = 320
height = 240
fps = 15
format = "YUYV"

[device.cam_wall]
vid = "0x046d"
pid = "0x0825"
serial = "CAM00A1"
node = "camera"
bit = 1
[device.cam_wall.camera]
width = 160
height = 120
fps = 30
format = "MJPG"
"#;

// The emulator's camera looks at the LED of this folder as long as it is there.
const SCRIPT: &str = r#"
mkdir /tmp/bench/light
echo 0 >/tmp/bench/light/brightness
emu plug 0 1
wait_for 60 attached 0 1 || fail 'not attached'
wait_for 30 test -e /dev/video2
udevadm settle
calibrate=("${rapid[@]}" calibrate latency --config /tmp/bench/devices.toml --led /tmp/bench/light --duration 10s)
"${calibrate[@]}" --device cam_light --json >$out/light.json 2>$out/light.err; echo $? >$out/light.rc
"${calibrate[@]}" --device cam_wall >$out/wall.txt 2>$out/wall.err; echo $? >$out/wall.rc
emu_quit
exit 0
"#;

#[test]
fn a_camera_that_looks_at_the_light_is_measured_and_another_is_refused() {
    let outcome = Scenario::new("calibrate")
        .device(DeviceSpec::uvc(0x2bc5, 0x0501).serial("YUV1").mode(Format::Yuyv, 320, 240, &[15]))
        .device(DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 160, 120, &[30]))
        .registry(REGISTRY)
        .script(SCRIPT)
        .run()
        .unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(outcome.code, 0, "{}", outcome.log);
    println!("{}{}", outcome.file("light.json"), outcome.file("light.err"));
    assert_eq!(outcome.file("light.rc").trim(), "0", "{}", outcome.file("light.err"));
    let found: serde_json::Value = serde_json::from_str(&outcome.file("light.json")).unwrap();
    let number = |key: &str| found[key].as_f64().unwrap_or_else(|| panic!("no {key}: {found}"));
    // The picture is made at one moment and stamped by the kernel when it arrives, soon after.
    let (latency, uncertainty) = (number("latency_ms"), number("uncertainty_ms"));
    assert!((-uncertainty..=1000.0 / 15.0).contains(&latency), "{found}");
    assert!(uncertainty < 1000.0 / 15.0 / 2.0 && number("correlation") > 0.9, "{found}");

    println!("{}", outcome.file("wall.err"));
    assert_eq!(outcome.file("wall.rc").trim(), "1", "{}", outcome.file("wall.txt"));
    assert!(
        outcome.file("wall.err").contains("error: [device.cam_wall] the pictures "),
        "{}",
        outcome.file("wall.err")
    );
    assert!(!outcome.file("wall.txt").contains("latency ="), "{}", outcome.file("wall.txt"));
}
