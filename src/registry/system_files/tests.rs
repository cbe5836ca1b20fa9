use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use proptest::prelude::*;
use yaml_rust2::{Yaml, YamlLoader};

use rapid_core::modality::ModalityKind;

use super::*;
use crate::{Form, IdentitySpec};

fn text_of(all: &[SystemFile], path: &str) -> String {
    all.iter().find(|file| file.path == Path::new(path)).unwrap().contents.clone()
}

fn rule_lines(rules: &str) -> Vec<&str> {
    rules.lines().filter(|line| !line.is_empty() && !line.starts_with('#')).collect()
}

fn with_serial(serial: &str) -> Registry {
    let mut registry = Registry::builtin();
    let IdentitySpec::Usb(usb) = &mut registry.devices[0].identity else { panic!("a USB device") };
    usb.serial = Some(serial.to_owned());
    registry
}

#[test]
fn the_repository_contains_the_system_files_of_devices_toml() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../udev");
    let all = system_files(&Registry::builtin());
    for file in &all {
        let path = folder.join(&file.path);
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        assert_eq!(found, file.contents, "{}: run `rapid artifacts`", path.display());
    }
    let expected: BTreeSet<_> = all.iter().map(|file| folder.join(&file.path)).collect();
    let here = |dir: &Path| std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()).collect::<Vec<_>>();
    let found: BTreeSet<_> =
        here(&folder).into_iter().chain(here(&folder.join(DESCRIPTORS))).filter(|path| path.is_file()).collect();
    assert_eq!(found, expected);
}

/// The panels of a tree, in order.
fn leaves(layout: &serde_json::Value) -> Vec<&str> {
    match layout.as_str() {
        Some(id) => vec![id],
        None => ["first", "second"].iter().flat_map(|half| leaves(&layout[half])).collect(),
    }
}

/// Registries whose samples have a meaning, an arm with a description, and a camera with depth.
const FORMS: &str = include_str!("../../../tests/registry/valid/forms.toml");
const EFFECTOR: &str = include_str!("../../../tests/registry/valid/effector.toml");
const STREAMS: &str = include_str!("../../../tests/registry/valid/streams.toml");

/// The panels of the layout of a registry in a file of this name, by id.
fn panels_of(text: &str, file: Option<&Path>) -> serde_json::Value {
    let layout: serde_json::Value =
        serde_json::from_str(&layout::layout(&Registry::parse(text, file).unwrap().registry)).unwrap();
    layout["configById"].clone()
}

#[test]
fn the_layout_shows_what_samples_mean() {
    let panels = panels_of(FORMS, None);
    let paths = |name: &str| -> serde_json::Value {
        let paths = panels[&format!("Plot!{name}")]["paths"].as_array().unwrap().iter();
        paths.map(|path| serde_json::json!([path["label"], path["value"]])).collect()
    };
    let finger = |index: usize| format!("/rapid/serial/fingers/joints.joints[{index}].position");
    assert_eq!(paths("fingers"), serde_json::json!([["left", finger(0)], ["right", finger(1)]]));
    let expected = [["gripper", "/rapid/serial/encoder/joints.joints[0].position"]];
    assert_eq!(paths("encoder"), serde_json::json!(expected));
    // A pose is plotted as numbers, and drawn.
    assert_eq!(paths("tracker").as_array().unwrap().len(), 7);
    assert_eq!(panels["Image!cam"]["imageMode"]["calibrationTopic"], "/rapid/camera/cam/calibration");
    let scene = &panels["3D!space"];
    assert_eq!(scene["followTf"], "world", "the frame of the first pose");
    let points = serde_json::json!({
        "visible": true, "decayTime": 0.2, "colorMode": "colormap", "colorField": "intensity", "colorMap": "turbo"
    });
    let shown = serde_json::json!({ "visible": true });
    assert_eq!(
        scene["topics"],
        serde_json::json!({
            "/rapid/serial/tracker/pose": shown, "/rapid/lan/phone/pose": shown, "/rapid/serial/marker/pose": shown,
            "/rapid/lan/lidar/points": points, "/rapid/lan/scanner/points": points,
        })
    );
    assert_eq!(scene["layers"], serde_json::json!({}));
    // Without any of these there is no space to show.
    assert!(panels_of(STREAMS, None).get("3D!space").is_none());
}

#[test]
fn the_layout_draws_an_arm_by_its_description() {
    let panels = panels_of(EFFECTOR, Some(Path::new("/etc/rapid/devices.toml")));
    let scene = &panels["3D!space"];
    assert_eq!(scene["followTf"], "base");
    let shown = serde_json::json!({ "visible": true });
    assert_eq!(scene["topics"], serde_json::json!({ "/rapid/can/arm/pose": shown, "/rapid/can/arm/joints": shown }));
    assert_eq!(
        scene["layers"],
        serde_json::json!({ "arm": {
            "instanceId": "arm", "layerId": "foxglove.Urdf", "label": "arm", "visible": true,
            "sourceType": "filePath", "filePath": "/etc/rapid/arm.urdf",
        } })
    );
    let joints: Vec<_> = panels["Plot!arm"]["paths"].as_array().unwrap().iter().map(|path| &path["label"]).collect();
    assert_eq!(joints, ["waist", "lift", "elbow", "pitch", "roll", "jaw"]);
}

#[test]
fn the_layout_shows_every_device_and_places_every_panel_once() {
    let camera =
        |bit: u8| format!("[device.cam_{bit}]\nvid = \"0001\"\npid = \"{bit:04}\"\nnode = \"camera\"\nbit = {bit}\n");
    let many: String = (0..7).map(camera).collect();
    let registries = [
        Registry::builtin(),
        Registry::task(),
        Registry::parse(&many, None).unwrap().registry,
        Registry::parse(FORMS, None).unwrap().registry,
        Registry::parse(EFFECTOR, None).unwrap().registry,
        Registry::parse(STREAMS, None).unwrap().registry,
        Registry::empty(Path::new("devices.toml")),
    ];
    for registry in &registries {
        let layout: serde_json::Value = serde_json::from_str(&layout::layout(registry)).unwrap();
        let panels = layout["configById"].as_object().unwrap();
        let tabs = panels["Tab!presence"]["tabs"].as_array().unwrap();
        let mut placed = leaves(&layout["layout"]);
        placed.extend(tabs.iter().flat_map(|tab| leaves(&tab["layout"])));
        assert_eq!(placed.iter().copied().collect::<BTreeSet<_>>(), panels.keys().map(String::as_str).collect());
        assert_eq!(placed.len(), panels.len());
        for device in &registry.devices {
            for (tab, topic) in [("Live", "/rapid/observation"), ("Recorded", "/rapid/frame")] {
                let states = panels[&format!("StateTransitions!{tab}")]["paths"].as_array().unwrap();
                for (field, label) in
                    [("present", device.name.clone()), ("plugged", format!("{} plugged in", device.name))]
                {
                    let path = format!("{topic}.modalities[:]{{bit=={}}}.{field}", device.id.bit());
                    assert!(states.iter().any(|state| state["value"] == path && state["label"] == label), "{path}");
                }
            }
            match device.modality().kind {
                ModalityKind::Image | ModalityKind::Depth => {
                    assert_eq!(panels[&format!("Image!{}", device.name)]["imageMode"]["imageTopic"], device.topic);
                }
                ModalityKind::Scalars => {
                    let paths = panels[&format!("Plot!{}", device.name)]["paths"].as_array().unwrap();
                    assert!(!paths.is_empty() && paths.len() <= 16, "{}", device.name);
                    let has_joints = matches!(device.form, Some(Form::Joints(_)));
                    let expected = if has_joints { "/joints.joints[0]." } else { ".values[0]" };
                    let first = paths[0]["value"].as_str().unwrap();
                    assert!(first.starts_with(&format!("{}{expected}", device.topic)), "{first}");
                }
                ModalityKind::Bytes => {}
            }
        }
        assert_eq!(panels.contains_key("Plot!action"), registry.actuator().is_some());
    }
}

#[test]
fn a_unit_is_matched_by_serial_by_port_or_as_the_only_one_of_its_model() {
    let text = r#"
        [device.one]
        vid = "0001"
        pid = "0001"
        port = "1-2.3"
        node = "camera"
        [device.two]
        vid = "0002"
        pid = "0002"
        node = "serial"
        [device.two.tty]
        channels = 1
        [device.three]
        vid = "0003"
        pid = "0003"
        node = "camera"
        [device.four]
        vid = "0003"
        pid = "0003"
        node = "camera"
    "#;
    let registry = Registry::parse(text, None).unwrap().registry;
    let rules = text_of(&system_files(&registry), "99-rapid.rules");
    assert_eq!(
        rule_lines(&rules),
        [
            "SUBSYSTEM==\"video4linux\", ATTR{index}==\"0\", ATTRS{idVendor}==\"0001\", ATTRS{idProduct}==\"0001\", \
             KERNELS==\"1-2.3\", SYMLINK+=\"rapid/one\", GROUP=\"video\", MODE=\"0660\", TAG+=\"uaccess\", \
             RUN{builtin}+=\"uaccess\"",
            "SUBSYSTEM==\"tty\", ATTRS{idVendor}==\"0002\", ATTRS{idProduct}==\"0002\", SYMLINK+=\"rapid/two\", \
             GROUP=\"dialout\", MODE=\"0660\", TAG+=\"uaccess\", RUN{builtin}+=\"uaccess\"",
        ]
    );
    assert_eq!(rules.matches("# No stable name: several entries are of this model").count(), 2);
    let descriptor = text_of(&system_files(&registry), "descriptors/three.yaml");
    assert!(descriptor.contains("\npath: null\n"), "{descriptor}");
}

#[test]
fn a_can_interface_is_brought_up_with_the_bit_rate_of_its_entry() {
    let text = "[device.arm]\nvid = \"1d50\"\npid = \"606f\"\nserial_number = \"A '%k` $x\"\nnode = \"can\"\n\
                [device.arm.can]\nbitrate = 500000\n";
    let all = system_files(&Registry::parse(text, None).unwrap().registry);
    let rules = text_of(&all, "99-rapid.rules");
    assert_eq!(
        rule_lines(&rules),
        ["ACTION==\"add\", SUBSYSTEM==\"net\", ATTR{type}==\"280\", ATTRS{idVendor}==\"1d50\", \
          ATTRS{idProduct}==\"606f\", ATTRS{serial}==\"A '%k` $x\", \
          RUN+=\"/usr/sbin/ip link set dev $name type can restart-ms 100\", \
          RUN+=\"/usr/sbin/ip link set dev $name up type can bitrate 500000\""]
    );
    let unit = text_of(&all, "rapid.service");
    assert_eq!(families(&unit), ["AF_UNIX", "AF_NETLINK", "AF_CAN"], "{unit}");
    // An adapter on a serial line is treated like any other serial line.
    let slcan = format!("{text}adapter = \"slcan\"\n");
    let line = text_of(&system_files(&Registry::parse(&slcan, None).unwrap().registry), "99-rapid.rules");
    assert!(rule_lines(&line)[0].starts_with("SUBSYSTEM==\"tty\"") && !line.contains("RUN+="), "{line}");
}

#[test]
fn the_service_may_open_usb_devices_only_where_a_program_does() {
    let program = "[device.a]\nvid = \"1\"\npid = \"1\"\nnode = \"p\"\n";
    let tty = format!("{program}[device.a.process]\nopens = \"tty\"\n");
    for (text, usb) in [(program, true), (tty.as_str(), false), (crate::BUILTIN, false)] {
        let all = system_files(&Registry::parse(text, None).unwrap().registry);
        let (rules, unit) = (text_of(&all, "99-rapid.rules"), text_of(&all, "rapid.service"));
        let lines: Vec<_> = unit.lines().collect();
        assert_eq!(rules.contains("GROUP=\"plugdev\""), usb, "{rules}");
        assert_eq!(lines.contains(&"DeviceAllow=char-usb_device rw"), usb, "{unit}");
        let groups = lines.iter().find_map(|line| line.strip_prefix("SupplementaryGroups=")).unwrap();
        assert_eq!(groups.split(' ').any(|group| group == "plugdev"), usb, "{unit}");
        let user = format!("--groups {} rapid", groups.replace(' ', ","));
        assert!(lines.iter().any(|line| line.ends_with(&user)), "{unit}");
        assert_eq!(unit.contains("groupadd --system --force plugdev"), usb, "{unit}");
    }
}

#[test]
fn the_service_may_open_keys_and_gpio_chips_only_where_a_stop_or_button_needs_them() {
    let key = "[stop.pedal]\nkind = \"enabling\"\nkey = { device = \"a pedal\", code = \"KEY_B\" }\n";
    let gpio = "[stop.door]\nkind = \"emergency\"\n\
                gpio = { chip = \"/dev/gpiochip3\", line = 1, runs_while = \"low\" }\n";
    let pedal = "[button.pedal]\nkey = { device = \"a pedal\", code = \"KEY_A\" }\npress = \"toggle\"\n";
    let panel = "[button.panel]\ngpio = { chip = \"/dev/gpiochip3\", line = 2, pressed_while = \"low\" }\n\
                 press = \"toggle\"\n";
    for (stops, keys, chips) in [
        ("", false, false),
        (key, true, false),
        (gpio, false, true),
        (&[key, gpio].concat(), true, true),
        (pedal, true, false),
        (panel, false, true),
    ] {
        let text = format!("{}{stops}", crate::BUILTIN);
        let all = system_files(&Registry::parse(&text, None).unwrap().registry);
        let (rules, unit) = (text_of(&all, "99-rapid.rules"), text_of(&all, "rapid.service"));
        assert_eq!(rules.contains("SUBSYSTEM==\"gpio\", KERNEL==\"gpiochip3\", GROUP=\"gpio\""), chips, "{rules}");
        let has = |line: &str| unit.lines().any(|is| is == line);
        assert_eq!((has("DeviceAllow=char-input rw"), has("DeviceAllow=char-gpiochip rw")), (keys, chips), "{unit}");
        let groups = unit.lines().find_map(|line| line.strip_prefix("SupplementaryGroups=")).unwrap();
        for (group, is_needed) in [("input", keys), ("gpio", chips)] {
            assert_eq!(groups.split(' ').any(|is| is == group), is_needed, "{unit}");
            assert_eq!(unit.contains(&format!("groupadd --system --force {group}\n")), is_needed, "{unit}");
        }
        assert!(has(&format!(
            "#   useradd --system --user-group --no-create-home --groups {} rapid",
            groups.replace(' ', ",")
        )));
    }
}

#[test]
fn a_chip_with_several_used_lines_has_one_rule() {
    let motor = |name: &str, slave: u8| {
        format!(
            "{{ name = \"{name}\", slave = {slave}, type = \"DM4310\", kp = 1, kd = 1, position = [0, 1], \
             brake = {{ chip = \"/dev/gpiochip2\", line = {slave}, released = \"high\" }} }}"
        )
    };
    let text = format!(
        "[device.arm]\nvid = \"2e88\"\npid = \"4603\"\nnode = \"can\"\nbit = 0\n[device.arm.can]\n\
         protocol = \"damiao\"\nmotors = [{}, {}]\n[stop.door]\nkind = \"emergency\"\n\
         gpio = {{ chip = \"/dev/gpiochip2\", line = 9, runs_while = \"low\" }}\n",
        motor("lift", 5),
        motor("turn", 6)
    );
    let rules = text_of(&system_files(&Registry::parse(&text, None).unwrap().registry), "99-rapid.rules");
    let rule = "# stop door, brake of lift, brake of turn\nSUBSYSTEM==\"gpio\", KERNEL==\"gpiochip2\"";
    assert!(rules.contains(rule), "{rules}");
    assert_eq!(rules.matches("KERNEL==\"gpiochip2\"").count(), 1, "{rules}");
}

#[test]
fn the_service_may_open_the_chips_of_brakes_and_the_serial_ports_of_the_board_where_they_are_needed() {
    let arm = |brake: &str| {
        format!(
            "[device.arm]\nvid = \"2e88\"\npid = \"4603\"\nnode = \"can\"\nbit = 0\n[device.arm.can]\n\
             protocol = \"damiao\"\nmotors = [{{ name = \"lift\", slave = 5, type = \"DM4310\", kp = 1, kd = 1, \
             position = [0, 1]{brake} }}]\n"
        )
    };
    let brake = ", brake = { chip = \"/dev/gpiochip2\", line = 1, released = \"high\" }";
    let stop =
        |path: &str| format!("[stop.pendant]\nkind = \"emergency\"\nserial = {{ path = \"{path}\", run = \"RUN\" }}\n");
    for (text, chips, uarts) in [
        (arm(""), false, false),
        (arm(brake), true, false),
        (arm("") + &stop("/dev/serial/by-id/usb-pendant"), false, false),
        (arm("") + &stop("/dev/ttyAMA0"), false, true),
        (arm("") + "[button.a]\nserial = { path = \"/dev/ttyS0\", line = \"a\" }\npress = \"mark\"\n", false, true),
    ] {
        let all = system_files(&Registry::parse(&text, None).unwrap().registry);
        let (rules, unit) = (text_of(&all, "99-rapid.rules"), text_of(&all, "rapid.service"));
        let rule = "# brake of lift\nSUBSYSTEM==\"gpio\", KERNEL==\"gpiochip2\", GROUP=\"gpio\"";
        assert_eq!(rules.contains(rule), chips, "{rules}");
        let has = |line: &str| unit.lines().any(|is| is == line);
        let found =
            (has("DeviceAllow=char-gpiochip rw"), has("DeviceAllow=char-ttyAMA rw"), has("DeviceAllow=char-ttyS rw"));
        assert_eq!(found, (chips, uarts, uarts), "{unit}");
    }
}

/// Entries of every kind that differs in its requirements on the service: a name, the entry, and the kinds of
/// sockets it needs besides those of udev and the journal.
const KINDS: &[(&str, &str, &[&str])] = &[
    ("camera", "vid = \"1\"\npid = \"1\"\nnode = \"camera\"", &[]),
    ("serial", "vid = \"2\"\npid = \"1\"\nnode = \"serial\"\n[device.NAME.tty]\nchannels = 1", &[]),
    ("program", "vid = \"3\"\npid = \"1\"\nnode = \"program\"", &[]),
    ("hook", "vid = \"4\"\npid = \"1\"\nnode = \"camera\"\non_attach = [\"/bin/true\"]", &[]),
    ("can", "vid = \"5\"\npid = \"1\"\nnode = \"can\"", &["AF_CAN"]),
    ("slcan", "vid = \"6\"\npid = \"1\"\nnode = \"can\"\n[device.NAME.can]\nadapter = \"slcan\"", &[]),
    ("gopro", "vid = \"7\"\npid = \"1\"\nnode = \"lan\"\n[device.NAME.lan]\nprotocol = \"gopro\"", &["AF_INET"]),
    (
        "adapter6",
        "vid = \"8\"\npid = \"1\"\nnode = \"lan\"\n[device.NAME.lan]\nprotocol = \"mjpeg\"\nhost = \"fd00::8\"",
        &["AF_INET6"],
    ),
    (
        "lidar",
        "node = \"lan\"\n[device.NAME.lan]\nprotocol = \"udp\"\nhost = \"192.168.1.201\"\nport = 2368",
        &["AF_INET"],
    ),
    (
        "web",
        "node = \"lan\"\n[device.NAME.lan]\nprotocol = \"mjpeg\"\nhost = \"192.168.1.7\"\nprobe = \"http\"",
        &["AF_INET"],
    ),
    ("v6", "node = \"lan\"\n[device.NAME.lan]\nprotocol = \"mjpeg\"\nhost = \"fd00::7\"", &["AF_INET6"]),
    (
        "phone",
        "node = \"lan\"\n[device.NAME.lan]\nprotocol = \"iphone\"\nmdns = \"_iphonevio._tcp\"",
        &["AF_INET", "AF_INET6"],
    ),
];

/// A registry of the entries of these kinds.
fn registry_of(kinds: &[&str]) -> Registry {
    let entry = |(name, text, _): &(&str, &str, _)| format!("[device.{name}]\n{}\n", text.replace("NAME", name));
    let wanted = KINDS.iter().filter(|(name, ..)| kinds.contains(name));
    Registry::parse(&wanted.map(entry).collect::<String>(), None).expect("a registry").registry
}

/// The registries whose units differ: each kind alone, the usual rigs, and all kinds at once.
fn rigs() -> Vec<Vec<&'static str>> {
    let mut rigs: Vec<_> = KINDS.iter().map(|(name, ..)| vec![*name]).collect();
    rigs.extend([vec!["camera", "can"], vec!["camera", "lidar"], vec!["camera", "can", "gopro", "phone"]]);
    rigs.push(KINDS.iter().map(|(name, ..)| *name).collect());
    rigs
}

fn families(unit: &str) -> Vec<String> {
    let line = unit.lines().find_map(|line| line.strip_prefix("RestrictAddressFamilies=")).expect("the setting");
    line.split(' ').map(str::to_owned).collect()
}

#[test]
fn the_service_may_open_the_kinds_of_sockets_that_its_entries_need_and_no_others() {
    for rig in rigs() {
        let unit = text_of(&system_files(&registry_of(&rig)), "rapid.service");
        let needed = KINDS.iter().filter(|(name, ..)| rig.contains(name)).flat_map(|(.., needed)| *needed);
        let expected: BTreeSet<&str> = needed.copied().chain(["AF_UNIX", "AF_NETLINK"]).collect();
        let found = families(&unit);
        assert_eq!(found.iter().map(String::as_str).collect::<BTreeSet<_>>(), expected, "{rig:?}");
        assert_eq!(found.len(), expected.len(), "{rig:?}: {found:?}");
        let is_network = expected.iter().any(|family| family.starts_with("AF_INET"));
        assert_eq!(unit.contains("\nIPAddressDeny=any\n"), !is_network, "{rig:?}: {unit}");
        // Interpreters generate code at run time; rapid itself does not.
        let has_programs = rig.iter().any(|kind| ["program", "hook"].contains(kind));
        assert_eq!(unit.contains("\nMemoryDenyWriteExecute=yes\n"), !has_programs, "{rig:?}: {unit}");
    }
}

/// By `systemd-analyze security`: 0 is the best, 10 the worst. Only reads the unit; systemd need not run.
#[test]
fn the_exposure_of_every_unit_is_2_or_better() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("rapid.service");
    for rig in rigs() {
        std::fs::write(&path, text_of(&system_files(&registry_of(&rig)), "rapid.service")).expect("written");
        let judged = Command::new("systemd-analyze")
            .args(["security", "--no-pager", "--offline=true", "--threshold=20"])
            .arg(&path)
            .output()
            .expect("systemd-analyze is missing: run `make setup`");
        let report = String::from_utf8_lossy(&judged.stdout);
        let overall = report.lines().find_map(|line| line.split_once("Overall exposure level for rapid.service: "));
        println!("exposure {} of {rig:?}", overall.map_or("?", |(_, figure)| figure));
        let complaints: Vec<_> = report.lines().filter(|line| line.starts_with('\u{2717}')).collect();
        let errors = String::from_utf8_lossy(&judged.stderr);
        assert!(judged.status.success() && overall.is_some(), "{rig:?}: {errors}{complaints:#?}");
        // An unknown setting or a misspelt value would only cause a warning.
        assert_eq!(errors, "", "{rig:?}");
    }
}

#[test]
fn files_of_the_service_are_readable_by_its_group_and_by_no_one_else() {
    for rig in rigs() {
        let unit = text_of(&system_files(&registry_of(&rig)), "rapid.service");
        for setting in ["UMask=0027", "StateDirectoryMode=0750", "User=rapid"] {
            assert!(unit.lines().any(|line| line == setting), "{setting} not in {unit}");
        }
        assert!(unit.contains("--user-group"), "the user's group is named after it: {unit}");
    }
}

#[test]
fn a_serial_number_that_no_rule_can_match_gets_a_comment() {
    let rules = text_of(&system_files(&with_serial("a\", RUN+=\"reboot")), "99-rapid.rules");
    assert_eq!(rule_lines(&rules).len(), 2);
    assert!(rules.contains("# No stable name: its serial number contains characters"));
    assert!(!rules.contains("reboot"));
}

fn strings<'y>(yaml: &'y Yaml, keys: &[&str]) -> Option<&'y str> {
    keys.iter().fold(yaml, |yaml, key| &yaml[*key]).as_str()
}

/// Shell glob of the three characters that are escaped here (`[x]`) against a text.
fn matches_exactly(pattern: &str, text: &str) -> bool {
    let mut literal = String::new();
    let mut rest = pattern;
    while let Some(c) = rest.chars().next() {
        let bracket = rest.strip_prefix('[').and_then(|after| Some((after.chars().next()?, after.get(1..2)?)));
        if let Some((inner, "]")) = bracket {
            literal.push(inner);
            rest = &rest[3..];
        } else {
            assert!(!"*?[".contains(c), "an open glob in {pattern:?}");
            literal.push(c);
            rest = &rest[c.len_utf8()..];
        }
    }
    literal == text
}

proptest! {
    #[test]
    fn no_serial_number_adds_a_line_or_matches_another(
        serial in prop_oneof![any::<String>(), "[ -~]{1,20}", "[*?\\[\\]a\"|\\\\]{1,8}"],
    ) {
        let all = system_files(&with_serial(&serial));
        let rules = text_of(&all, "99-rapid.rules");
        let lines = rule_lines(&rules);
        prop_assert_eq!(rules.lines().filter(|line| line.starts_with("# cam_wrist")).count(), 1);
        prop_assert!(lines.len() == 3 || lines.len() == 2);
        if lines.len() == 3 {
            let after = lines[0].split_once("ATTRS{serial}==\"").unwrap().1;
            let pattern = after.split_once("\", SYMLINK+=\"rapid/cam_wrist\", GROUP").unwrap().0;
            prop_assert!(!pattern.contains('"'));
            prop_assert!(matches_exactly(pattern, &serial));
        } else {
            prop_assert!(rules.contains("# No stable name"));
        }
        let descriptor = YamlLoader::load_from_str(&text_of(&all, "descriptors/cam_wrist.yaml")).unwrap();
        let [yaml] = descriptor.as_slice() else { panic!("one document") };
        prop_assert_eq!(strings(yaml, &["identity", "serial"]), Some(serial.as_str()));
        prop_assert_eq!(strings(yaml, &["identity", "vid"]), Some("046d"));
        prop_assert_eq!(strings(yaml, &["module"]), Some("cam_wrist"));
        prop_assert_eq!(strings(yaml, &["topic"]), Some("/rapid/camera/wrist"));
        prop_assert_eq!(strings(yaml, &["slot"]), Some("top"));
        prop_assert_eq!(yaml["bit"].as_i64(), Some(0));
        prop_assert_eq!(yaml["sensors"][0]["width"].as_i64(), Some(640));
    }
}
