//! The difference, as data: a text, what is changed in it, and what a run makes of that.

use super::*;
use crate::spec::LanFind;

const RIG: &str = r#"
[rig]
name = "bench"
cooldown = "1s"
memory_budget = "256MiB"

[device.cam]
vid = "1209"
pid = "0001"
serial = "A"
node = "camera"
bit = 0

[device.tof]
vid = "1209"
pid = "0002"
node = "serial"
bit = 2
tty = { channels = 1 }

[module.soft_tip]
slot = "tip"
"#;

fn parsed(text: &str) -> Registry {
    Registry::parse(text, None).unwrap_or_else(|wrong| panic!("{wrong}\n{text}")).registry
}

fn with(entry: &str) -> String {
    format!("{RIG}\n{entry}\n")
}

fn spare(keys: &str) -> String {
    with(&format!("[device.spare]\nvid = \"1209\"\npid = \"0003\"\n{keys}"))
}

#[test]
fn a_motor_is_not_mounted_otherwise_under_a_running_arm() {
    let arm = "[device.arm]\nvid = \"1d50\"\npid = \"606f\"\nnode = \"can\"\nbit = 0\n[device.arm.can]\nprotocol = \"damiao\"\n\
               motors = [{ name = \"lift\", slave = 1, type = \"DM4310\", kp = 20, kd = 1, position = [-1, 1] }]\n";
    let running = parsed(arm);
    for keys in ["zero = 0.5", "reversed = true"] {
        let now = parsed(&arm.replace("kd = 1", &format!("kd = 1, {keys}")));
        for (was, is) in [(&running, &now), (&now, &running)] {
            let found = Difference::between(was, is);
            let [why] = found.needs_restart.as_slice() else { panic!("{keys}: {found:?}") };
            assert!(why.starts_with("[device.arm]: format changed"), "{why}");
        }
    }
    // As much as without the keys.
    let same = parsed(&arm.replace("kd = 1", "kd = 1, zero = 0, reversed = false"));
    assert_eq!(Difference::between(&running, &same), Difference::default());
}

#[test]
fn only_an_added_entry_at_a_free_bit_is_taken_over() {
    let camera = "node = \"camera\"\n";
    for (case, text, bits, reasons) in [
        ("nothing", RIG.to_owned(), &[][..], &[][..]),
        ("a comment", format!("# text\n{RIG}"), &[], &[]),
        ("above", spare(&format!("{camera}bit = 7")), &[7], &[]),
        ("between", spare(&format!("{camera}bit = 1")), &[1], &[]),
        ("no bit is written", spare(camera), &[1], &[]),
        ("a serial line", spare("node = \"serial\"\nbit = 3\ntty = { channels = 2 }"), &[3], &[]),
        (
            "two",
            format!(
                "{}\n[device.b]\nvid = \"1209\"\npid = \"0004\"\nnode = \"camera\"\nbit = 1",
                spare("node = \"camera\"\nbit = 9")
            ),
            &[1, 9],
            &[],
        ),
        (
            "removed",
            RIG.split("[device.tof]").next().unwrap_or_default().to_owned() + "[module.soft_tip]\nslot = \"tip\"\n",
            &[],
            &["[device.tof]: it is removed"],
        ),
        (
            "renamed",
            RIG.replace("device.tof", "device.range"),
            &[],
            &["[device.tof]: it is removed", "renamed to range?", "[device.range]: its bit 2 is that of [device.tof]"],
        ),
        ("another bit", RIG.replace("bit = 2", "bit = 5"), &[], &["[device.tof]: its bit 2 is now 5"]),
        ("another serial number", RIG.replace("\"A\"", "\"B\""), &[], &["[device.cam]: identity changed"]),
        ("another format", RIG.replace("channels = 1", "channels = 2"), &[], &["[device.tof]: format", "changed"]),
        ("another topic", RIG.replace("bit = 2", "bit = 2\ntopic = \"/x\""), &[], &["[device.tof]: topic changed"]),
        (
            "another limit",
            RIG.replace("bit = 2", "bit = 2\nverdict = { gap = \"off\" }"),
            &[],
            &["[device.tof]: verdict changed"],
        ),
        ("a slot", RIG.replace("bit = 2", "bit = 2\nslot = \"tip\""), &[], &["[device.tof]: slot changed"]),
        (
            "hooks",
            RIG.replace("bit = 2", "bit = 2\non_attach = [\"/bin/true\"]"),
            &[],
            &["[device.tof]: hooks changed"],
        ),
        ("the rig", RIG.replace("\"1s\"", "\"2s\"").replace("bench", "bank"), &[], &["[rig]: name, cooldown changed"]),
        ("an expectation", RIG.replace("cooldown", "expect = [\"cam\"]\ncooldown"), &[], &["[rig]: expect changed"]),
        ("an export", with("[export]\nstate = [\"tof\"]"), &[], &["[export]: it changed"]),
        ("a module", RIG.replace("soft_tip", "hard_tip"), &[], &["[module]: soft_tip removed"]),
        ("a new module", with("[module.hard]\nslot = \"front\""), &[], &[]),
        (
            "its program",
            spare("node = \"/bin/true\"\nbit = 3\nprocess = { kind = \"bytes\" }"),
            &[],
            &["[device.spare]: its program"],
        ),
        (
            "its hooks",
            spare(&format!("{camera}bit = 3\non_attach = [\"/bin/true\"]")),
            &[],
            &["[device.spare]: its hooks"],
        ),
        (
            "the unit of another",
            with(
                "[device.spare]\nvid = \"1209\"\npid = \"0002\"\nserial = \"X\"\nnode = \"serial\"\nbit = 3\ntty = { channels = 1 }",
            ),
            &[],
            &["[device.spare]: it would take a unit that may be attached as [device.tof]"],
        ),
        (
            "another unit of a model",
            with("[device.spare]\nvid = \"1209\"\npid = \"0001\"\nserial = \"X\"\nnode = \"camera\"\nbit = 3"),
            &[3],
            &[],
        ),
        ("another budget", RIG.replace("256MiB", "1000MiB"), &[], &["[rig]: memory_budget changed"]),
        // The cameras share what the budget leaves.
        (
            "an entry that takes the memory of others",
            spare(&format!("{camera}bit = 3\nmax_bytes = \"4MB\"\ndepth = 20")),
            &[3],
            &["[device.cam]: its depth 60 is now"],
        ),
    ] {
        let Difference { added, modules, needs_restart } = Difference::between(&parsed(RIG), &parsed(&text));
        let mountable = match case {
            "a module" => vec!["hard_tip"],
            "a new module" => vec!["hard"],
            _ => Vec::new(),
        };
        assert_eq!(modules, mountable, "{case}");
        assert_eq!(added.iter().map(|device| device.id.bit()).collect::<Vec<_>>(), bits, "{case}: {needs_restart:?}");
        let lines = needs_restart.join("\n");
        assert_eq!(needs_restart.is_empty(), reasons.is_empty(), "{case}: {lines}");
        for reason in reasons {
            assert!(lines.contains(reason), "{case}: {reason:?} is not in {lines}");
        }
    }
}

#[test]
fn what_is_on_the_network_is_taken_over_and_what_is_on_a_can_bus_is_not() {
    let at_an_address = "node = \"lan\"\nbit = 3\n[device.spare.lan]\nprotocol = \"mjpeg\"\nhost = \"192.168.1.9\"";
    let behind_an_adapter = "node = \"lan\"\nbit = 3\n[device.spare.lan]\nprotocol = \"gopro\"";
    for (text, refusal) in [
        (with(&format!("[device.spare]\n{at_an_address}")), None),
        (spare(behind_an_adapter), None),
        (spare("node = \"can\"\nbit = 3"), Some("[device.spare]: its interface is brought up at the start")),
    ] {
        let Difference { added, needs_restart, .. } = Difference::between(&parsed(RIG), &parsed(&text));
        assert_eq!(added.len(), usize::from(refusal.is_none()), "{text}: {needs_restart:?}");
        assert_eq!(needs_restart.first().map(String::as_str), refusal, "{text}");
    }
}

#[test]
fn an_announced_device_is_taken_over_unless_two_entries_may_mean_it() {
    let entry = |name: &str, bit: u8, keys: &str| {
        format!("\n[device.{name}]\nnode = \"lan\"\nbit = {bit}\n[device.{name}.lan]\nprotocol = \"mjpeg\"\n{keys}\n")
    };
    let service = "mdns = \"_cam._tcp\"";
    let (one, two) = (format!("{service}\ninstance = \"one\""), format!("{service}\ninstance = \"two\""));
    for (first, second, is_taken) in [
        (one.as_str(), two.as_str(), true),
        (one.as_str(), service, false),
        (service, two.as_str(), false),
        (service, "mdns = \"_other._tcp\"", true),
    ] {
        let running = parsed(&with(&entry("here", 4, first)));
        let new = parsed(&with(&[entry("here", 4, first), entry("spare", 5, second)].concat()));
        let Difference { added, needs_restart, .. } = Difference::between(&running, &new);
        assert_eq!(added.len(), usize::from(is_taken), "{first} and {second}: {needs_restart:?}");
        let words = "[device.spare]: a device of its service may belong to [device.here]";
        assert_eq!(needs_restart.iter().any(|line| line.starts_with(words)), !is_taken, "{needs_restart:?}");
        // An instance helps where the entry of the run has one: that entry stays as it is.
        let advice =
            if first == one { "; write another `instance` in [device.spare.lan], or restart" } else { "for; restart" };
        assert!(is_taken || needs_restart[0].contains(advice), "{needs_restart:?}");
    }
    // A file with the same instance in two entries is refused; what a run takes over does not depend on that.
    let text = [entry("here", 4, &one), entry("spare", 5, &two)].concat();
    let running = parsed(&with(&entry("here", 4, &one)));
    for (instance, is_taken) in [("two", true), ("one", false), ("ONE", false)] {
        let mut new = parsed(&with(&text));
        for device in new.devices.iter_mut().filter(|device| device.name == "spare") {
            if let NodeSpec::Lan(lan) = &mut device.node {
                lan.find = LanFind::Mdns { service: "_CAM._tcp".to_owned(), instance: Some(instance.to_owned()) };
            }
        }
        let Difference { added, needs_restart, .. } = Difference::between(&running, &new);
        assert_eq!(added.len(), usize::from(is_taken), "{instance}: {needs_restart:?}");
    }
}
