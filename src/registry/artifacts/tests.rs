use std::collections::BTreeSet;
use std::path::Path;

use proptest::prelude::*;
use yaml_rust2::{Yaml, YamlLoader};

use super::*;
use crate::registry::IdentitySpec;

fn text_of(all: &[Artifact], path: &str) -> String {
    all.iter().find(|artifact| artifact.path == Path::new(path)).unwrap().contents.clone()
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
fn the_repository_holds_what_devices_toml_gives() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("udev");
    let all = artifacts(&Registry::builtin());
    for artifact in &all {
        let path = folder.join(&artifact.path);
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        assert_eq!(found, artifact.contents, "{}: run `rapid artifacts`", path.display());
    }
    let expected: BTreeSet<_> = all.iter().map(|artifact| folder.join(&artifact.path)).collect();
    let here = |dir: &Path| std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()).collect::<Vec<_>>();
    let found: BTreeSet<_> =
        here(&folder).into_iter().chain(here(&folder.join(DESCRIPTORS))).filter(|path| path.is_file()).collect();
    assert_eq!(found, expected);
}

#[test]
fn a_unit_is_named_by_serial_by_port_or_as_the_only_one_of_its_model() {
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
        [device.two.serial]
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
    let rules = text_of(&artifacts(&registry), "99-rapid.rules");
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
    let descriptor = text_of(&artifacts(&registry), "descriptors/three.yaml");
    assert!(descriptor.contains("\npath: null\n"), "{descriptor}");
}

#[test]
fn a_can_interface_is_brought_up_with_the_bit_rate_of_its_entry() {
    let text = "[device.arm]\nvid = \"1d50\"\npid = \"606f\"\nserial_number = \"A '%k` $x\"\nnode = \"can\"\n\
                [device.arm.can]\nbitrate = 500000\n";
    let all = artifacts(&Registry::parse(text, None).unwrap().registry);
    let rules = text_of(&all, "99-rapid.rules");
    assert_eq!(
        rule_lines(&rules),
        ["ACTION==\"add\", SUBSYSTEM==\"net\", ATTR{type}==\"280\", ATTRS{idVendor}==\"1d50\", \
          ATTRS{idProduct}==\"606f\", ATTRS{serial}==\"A '%k` $x\", \
          RUN+=\"/usr/sbin/ip link set dev $name up type can bitrate 500000 restart-ms 100\""]
    );
    let unit = text_of(&all, "rapid.service");
    assert!(unit.contains("\nRestrictAddressFamilies=AF_UNIX AF_NETLINK AF_CAN\n"), "{unit}");
    // An adapter that is a serial line is one like any other.
    let slcan = format!("{text}adapter = \"slcan\"\n");
    let line = text_of(&artifacts(&Registry::parse(&slcan, None).unwrap().registry), "99-rapid.rules");
    assert!(rule_lines(&line)[0].starts_with("SUBSYSTEM==\"tty\"") && !line.contains("RUN+="), "{line}");
}

#[test]
fn the_service_may_open_usb_devices_only_where_a_program_does() {
    let program = "[device.a]\nvid = \"1\"\npid = \"1\"\nnode = \"p\"\n";
    let tty = format!("{program}[device.a.process]\nopens = \"tty\"\n");
    for (text, usb) in [(program, true), (tty.as_str(), false), (crate::registry::BUILTIN, false)] {
        let all = artifacts(&Registry::parse(text, None).unwrap().registry);
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
fn a_serial_number_that_no_rule_can_match_gets_a_comment() {
    let rules = text_of(&artifacts(&with_serial("a\", RUN+=\"reboot")), "99-rapid.rules");
    assert_eq!(rule_lines(&rules).len(), 2);
    assert!(rules.contains("# No stable name: its serial number contains characters"));
    assert!(!rules.contains("reboot"));
}

fn strings<'y>(yaml: &'y Yaml, keys: &[&str]) -> Option<&'y str> {
    keys.iter().fold(yaml, |yaml, key| &yaml[*key]).as_str()
}

/// Shell glob of the three characters we write (`[x]`) against a text.
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
        let all = artifacts(&with_serial(&serial));
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
