//! Devices whose names were made to be taken for something else: they register, match, stream and are
//! recorded by exactly these names, and udev learns nothing from them but a link.

use vbench::check::ended;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::outcome::Outcome;
use vbench::scenario::Scenario;

/// A rule can match it exactly.
const GLOBS: &str = "a b%k*?[x]$env{X}'#,= ;$(id)`id`";
/// Written into a rule as it stands, it would be three more keys.
const RULE: &str = "x\", RUN+=\"/bin/touch /tmp/owned\", SYMLINK+=\"rapid/evil";
/// No registry can name it.
const LINES: &str = "one\nKERNEL==\"*\", SYMLINK+=\"rapid/evil\"\n\u{1b}[2J\\";
/// No rule can match it exactly, for not every udev reads other bytes than ASCII alike.
const FOREIGN: &str = "相机 é\u{202e}";
/// What no terminal should be sent.
const NAMES: [&str; 2] = ["\u{1b}]0;owned\u{7}%s%n", "Wrist\n\u{202e}\u{9b}31m \"';\\ product"];

const SCRIPT: &str = r#"
emu plug 0 1 2 3
wait_for 60 attached 0 1 2 3 || fail 'not attached'
wait_for 30 test -e /dev/video4 -a -e /dev/ttyACM0
udevadm settle
for port in 1 2 3 4; do cat /sys/bus/usb/devices/1-$port/serial >$out/serial$port; done
config='--config /tmp/bench/devices.toml'
"${rapid[@]}" check $config >$out/check.txt 2>&1 || fail 'rapid check'
"${rapid[@]}" devices $config >$out/devices.txt || fail 'rapid devices'
"${rapid[@]}" devices --json $config >$out/devices.jsonl || fail 'rapid devices --json'
ls /dev >$out/before
"${rapid[@]}" artifacts --install $config >$out/install.txt 2>&1 || fail 'rapid artifacts --install'
wait_for 30 test -e /dev/rapid/globs || fail 'no link'
udevadm settle
ls /dev >$out/after
ls -l /dev/rapid >$out/links
cp /etc/udev/rules.d/99-rapid.rules $out/rules
udevadm verify /etc/udev/rules.d/99-rapid.rules >$out/verify 2>&1; echo $? >$out/verify.rc
for node in class/video4linux/video0 class/video4linux/video2 class/tty/ttyACM0; do
  udevadm test --action=add /sys/$node 2>&1 | grep 99-rapid
done >$out/test
rapid_start --headless --record --out $out/rec $config --json
for device in globs rule lines foreign; do
  await_rapid 60 '"event":"state"' "\"device\":\"$device\"" '"state":"streaming"' || fail "$device does not stream"
done
sleep 2
rapid_stop
test ! -e /tmp/owned || fail 'a command of a device was run'
emu unplug 0
wait_for 30 detached 0
udevadm settle
ls /dev/rapid >$out/left 2>/dev/null
emu_quit
exit 0
"#;

fn registry() -> String {
    let camera = |name: &str, bit: u32, pid: u32, unit: String| {
        format!(
            "[device.{name}]\nvid = \"046d\"\npid = \"{pid:04x}\"\n{unit}\nnode = \"camera\"\nbit = {bit}\n\
             [device.{name}.camera]\nwidth = 320\nheight = 240\nfps = 15\nformat = \"MJPG\"\n"
        )
    };
    // TOML's basic strings escape as JSON's do.
    let serial = |text: &str| format!("serial = {}", serde_json::Value::from(text));
    let tty = "[device.lines]\nvid = \"2e8a\"\npid = \"000a\"\nport = \"1-3\"\nnode = \"serial\"\nbit = 2\n\
               [device.lines.tty]\nbaud = 115200\nframing = \"line\"\nparse = \"csv\"\nchannels = 4\n";
    // Two of one model: only the serial number distinguishes them.
    camera("globs", 0, 0x0825, serial(GLOBS))
        + &camera("rule", 1, 0x0825, serial(RULE))
        + tty
        + &camera("foreign", 3, 0x0826, serial(FOREIGN))
}

#[test]
fn names_supplied_by_devices_are_treated_only_as_names() {
    let camera = |pid, serial: &str| {
        DeviceSpec::uvc(0x046d, pid).serial(serial).names(NAMES[0], NAMES[1]).mode(Format::Mjpg, 320, 240, &[15])
    };
    let outcome = Scenario::new("strings")
        .device(camera(0x0825, GLOBS))
        .device(camera(0x0825, RULE))
        .device(DeviceSpec::acm(0x2e8a, 0x000a, 50.0).serial(LINES).names(NAMES[0], NAMES[1]))
        .device(camera(0x0826, FOREIGN))
        .registry(&registry())
        .script(SCRIPT)
        .run()
        .unwrap_or_else(|error| panic!("{error}"));
    ended(&outcome);

    // The kernel passes on the device's text, with a newline after it.
    for (port, serial) in [(1, GLOBS), (2, RULE), (3, LINES), (4, FOREIGN)] {
        assert_eq!(outcome.file(&format!("serial{port}")), format!("{serial}\n"), "the bench gave another serial");
    }

    listing(&outcome);
    artifacts(&outcome);
    recorded(&outcome);
}

fn listing(outcome: &Outcome) {
    println!("{}", outcome.file("devices.txt"));
    for name in ["check.txt", "devices.txt", "devices.jsonl", "install.txt"] {
        let text = outcome.file(name);
        let moves = |c: char| (c.is_control() && c != '\n') || matches!(c, '\u{202a}'..='\u{202e}');
        assert!(!text.contains(moves), "{name} moves the cursor: {text:?}");
    }
    let objects: Vec<serde_json::Value> =
        outcome.file("devices.jsonl").lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    for (serial, entry) in [(GLOBS, "globs"), (RULE, "rule"), (LINES, "lines"), (FOREIGN, "foreign")] {
        let object = objects.iter().find(|object| object["serial"] == serial);
        let object = object.unwrap_or_else(|| panic!("{serial:?} not in {objects:?}"));
        assert_eq!(object["entry"], entry);
        assert_eq!(object["product"], NAMES[1]);
    }
}

fn artifacts(outcome: &Outcome) {
    let rules = outcome.file("rules");
    println!("{rules}\n{}\n{}", outcome.file("links"), outcome.file("test"));
    let lines: Vec<&str> = rules.lines().filter(|line| !line.is_empty() && !line.starts_with('#')).collect();
    // `globs` by its serial number, `lines` by its port; the other two cannot be matched exactly.
    assert_eq!(lines.len(), 2, "{rules}");
    assert_eq!(rules.matches("# No stable name: ").count(), 2, "{rules}");
    let links: Vec<String> = outcome
        .file("links")
        .lines()
        .filter_map(|line| Some(line.split_once(" -> ")?.0.split_whitespace().next_back()?.to_owned()))
        .collect();
    assert_eq!(links, ["globs", "lines"], "{}", outcome.file("links"));
    assert!(outcome.file("links").contains("globs -> ../video0"), "the link leads to another unit");
    assert!(outcome.file("links").contains("lines -> ../ttyACM0"), "the link leads to another unit");
    assert_eq!(outcome.file("left").trim(), "lines", "a link outlived its device");

    // Besides the folder of the links nothing came into being.
    let new = |text: String| -> Vec<String> { text.lines().map(str::to_owned).collect() };
    let before = new(outcome.file("before"));
    let came: Vec<String> = new(outcome.file("after")).into_iter().filter(|name| !before.contains(name)).collect();
    assert!(came.iter().all(|name| name == "rapid"), "{came:?}");

    // udev reads the file without a complaint; `udevadm verify` is there from systemd 254.
    let complaints: Vec<String> = outcome
        .file("test")
        .lines()
        .filter(|line| line.to_lowercase().contains("invalid") || line.contains("ignoring") || line.contains("nknown"))
        .map(str::to_owned)
        .collect();
    assert_eq!(complaints, Vec::<String>::new());
    assert!(outcome.file("test").contains("99-rapid.rules"), "udev did not read the rules: {}", outcome.file("test"));
    match outcome.file("verify.rc").trim() {
        "0" => println!("udevadm verify has no complaint"),
        _ => assert!(outcome.file("verify").contains("Unknown command verb"), "{}", outcome.file("verify")),
    }
}

fn recorded(outcome: &Outcome) {
    let episode = outcome.episode().unwrap_or_else(|error| panic!("{error}"));
    for (topic, entry) in
        [("camera/globs", GLOBS), ("camera/rule", RULE), ("serial/lines", LINES), ("camera/foreign", FOREIGN)]
    {
        let count = episode.topic(&format!("/rapid/{topic}")).count();
        println!("{topic}: {count} samples of {entry:?}");
        assert!(count > 0, "{topic}: no sample");
    }
    let bytes = std::fs::read(&episode.path).expect("the episode");
    let summary = mcap::Summary::read(&bytes).expect("an index").expect("a finished file has a summary");
    let metadata: Vec<_> =
        summary.metadata_indexes.iter().map(|index| mcap::read::metadata(&bytes, index).expect("metadata")).collect();
    let serials =
        metadata.iter().rev().find_map(|record| record.metadata.get("serials")).expect("serials are recorded");
    let serials: serde_json::Value = serde_json::from_str(serials).expect("JSON");
    for (entry, serial) in [("globs", GLOBS), ("rule", RULE), ("lines", LINES), ("foreign", FOREIGN)] {
        assert_eq!(serials[entry], serial, "{serials}");
    }
}
