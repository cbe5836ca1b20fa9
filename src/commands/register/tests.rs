//! The dialogue, with answers from a string.

use std::path::PathBuf;
use std::sync::Arc;

use clap::Parser;
use rapid_core::time::Stamp;
use rapid_registry::device::{DeviceNode, Unit, UsbIdentity};
use rapid_registry::simulation::{SimDevice, SimSource};
use rapid_registry::{BUILTIN, Registry};

use super::*;
use crate::cli::{Cli, Command};

fn serial_line(serial: Option<&str>, port: &str) -> Attachment {
    let source = SimSource::Serial { channels: 2, hz: 1000, seed: 1 };
    let node = DeviceNode::Sim(Arc::new(SimDevice::new(port, source, Stamp::now())));
    let product = Some("Force\u{1b}[2J Sensor\n[device.evil]".to_owned());
    let usb = UsbIdentity {
        vid: 0x1209,
        pid: 2,
        serial: serial.map(str::to_owned),
        port: port.into(),
        product,
        ..UsbIdentity::default()
    };
    Attachment {
        syspath: PathBuf::from("/sim").join(port),
        node,
        unit: Unit::Usb(usb),
        driver: None,
        formats: Vec::new(),
    }
}

fn arguments(words: &str) -> RegisterArgs {
    let typed = ["rapid", "register"].into_iter().chain(words.split_whitespace());
    match Cli::try_parse_from(typed).unwrap().command {
        Some(Command::Register(args)) => *args,
        other => panic!("{other:?}"),
    }
}

/// A `devices.toml` in a separate folder.
struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("devices.toml"), BUILTIN).unwrap();
        Self { folder }
    }

    fn text(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("devices.toml")).unwrap()
    }

    fn target(&self) -> Target {
        Target::read(self.folder.path().join("devices.toml")).unwrap()
    }

    /// The printed dialogue, and the result.
    fn register(
        &self,
        words: &str,
        attached: &[Attachment],
        answers: Option<&str>,
    ) -> (String, Result<(), RegisterError>) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let (mut dialogue, mut out) = (Vec::new(), Vec::new());
        let mut input = answers.unwrap_or_default().as_bytes();
        let talk = answers.map(|_| Dialogue { input: &mut input, out: &mut dialogue });
        let (target, args) = (self.target(), arguments(words));
        let work = register(&target, attached, &args, talk, Format::Text, &mut out);
        let done = runtime.block_on(work);
        dialogue.extend(out);
        (String::from_utf8(dialogue).unwrap(), done)
    }
}

#[test]
fn the_dialogue_asks_until_the_answers_make_an_entry() {
    let bench = Bench::new();
    let attached = [serial_line(None, "1-4"), serial_line(None, "1-5")];
    let answers = "7\n2\nBad Name\nmotor_state\nforce\n\nany port\nport\nmiddle\ntip\ny\n";
    let (dialogue, done) = bench.register("", &attached, Some(answers));
    done.unwrap();
    for expected in [
        "  2  1209:0002  port 1-5  no serial",
        "enter a number from 1 to 2",
        "\"Bad Name\" cannot be a modality's name",
        "[device.motor_state] already exists",
        "Identify by port or any [port]: ",
        "one of front, tip, top, bottom, none",
        "Test: ",
        "first values",
    ] {
        assert!(dialogue.contains(expected), "{expected:?} in {dialogue}");
    }
    assert!(!dialogue.contains('\u{1b}'));
    let text = bench.text();
    assert!(text.starts_with(BUILTIN));
    let entry = "\n# Force [2J Sensor [device.evil]\n[device.force]\nvid = \"1209\"\npid = \"0002\"\nport = \"1-5\"\n\
        node = \"serial\"\nslot = \"tip\"\nbit = 3\n\n[device.force.tty]\nparse = \"csv\"\nchannels = 2\n";
    assert_eq!(text.strip_prefix(BUILTIN), Some(entry));
    assert!(bench.folder.path().join("udev/descriptors/force.yaml").exists());
    assert_eq!(Registry::parse(&text, None).unwrap().registry.devices.len(), 4);
}

#[test]
fn without_the_final_confirmation_nothing_is_written() {
    let bench = Bench::new();
    let attached = [serial_line(Some("F1"), "1-4")];
    for (answers, expected) in [("1\nforce\n\n\nn\n", None), ("1\nforce\n", Some("no answer")), ("", Some("no answer"))]
    {
        let (dialogue, done) = bench.register("", &attached, Some(answers));
        match (done, expected) {
            (Ok(()), None) => assert!(dialogue.contains("Nothing was written."), "{dialogue}"),
            (Err(error), Some(expected)) => assert!(error.to_string().contains(expected), "{error}"),
            (done, _) => panic!("{answers:?}: {done:?}"),
        }
        assert_eq!(bench.text(), BUILTIN);
    }
    let (dialogue, done) = bench.register("", &[], Some(""));
    done.unwrap();
    assert!(dialogue.contains("No unregistered device is plugged in"), "{dialogue}");
}

#[test]
fn non_interactive_runs_list_the_missing_fields() {
    let bench = Bench::new();
    let attached = [serial_line(Some("F1"), "1-4"), serial_line(Some("F2"), "1-5")];
    for (words, expected) in [
        ("", "--vid, --pid, --name must be given"),
        ("--vid 1209 --pid 2 --name force", "name one with --serial or --port"),
        ("--vid 1209 --pid 2 --serial F2", "--name must be given"),
        ("--vid 1209 --pid 3 --name force", "--node must be given"),
        ("--vid 1209 --pid 2 --serial F2 --name motor_state", "already defined"),
        ("--vid 1209 --pid 2 --serial F2 --name Force", "\"Force\" cannot be a modality's name"),
        (
            "--vid 046d --pid 0825 --serial CAM00A1 --name other --node camera",
            "same vid, pid and serial number as [device.cam_wrist]",
        ),
        ("--vid 1209 --pid 2 --serial F2 --name force --bit 1", "bit 1 is already taken"),
        ("--vid 1209 --pid 2 --serial F2 --name force --slot middle", "unknown slot \"middle\""),
        ("--vid 1209 --pid 2 --serial F2 --name force --node camrea", "did you mean \"camera\"?"),
        ("--vid 1209 --pid 2 --serial F2 --name force --set tty.baudrate=9600", "unknown key \"baudrate\""),
        ("--vid 1209 --pid 2 --port nonsense --name force --node camera", "is not a USB port path"),
    ] {
        let error = bench.register(words, &attached, None).1.unwrap_err();
        assert!(error.to_string().contains(expected), "{words}: {error}");
        assert!(error.is_bad_argument(), "{words}");
        assert_eq!(bench.text(), BUILTIN, "{words}");
    }
    let words = "--port 1-5 --name force --set stall_after=2s --set latency=3ms --yes";
    bench.register(words, &attached, None).1.unwrap();
    let force = bench.target().registry.unwrap().named("force").unwrap().clone();
    assert_eq!((force.stall_after.as_secs(), force.latency.as_millis(), force.id.bit()), (2, 3, 3));
    assert_eq!(force.identity.usb().and_then(|usb| usb.port.as_deref()), Some("1-5"));
}

#[test]
fn a_file_that_changed_meanwhile_is_not_overwritten() {
    let bench = Bench::new();
    let target = bench.target();
    let other = format!("{BUILTIN}\n# another program's line\n");
    std::fs::write(&target.path, &other).unwrap();
    let args = UnregisterArgs { name: "motor_state".into(), yes: true, dry_run: false };
    let error = unregister(&target, &args, None, Format::Text, &mut Vec::new()).unwrap_err();
    assert!(matches!(error, RegisterError::Write(WriteError::Changed(_))), "{error}");
    assert_eq!(bench.text(), other);
}

#[test]
fn removing_an_entry_never_changes_the_bit_of_another() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("devices.toml");
    let entry = |name: &str, serial: &str| {
        format!("[device.{name}]\nvid = \"1\"\npid = \"2\"\nserial = \"{serial}\"\nnode = \"camera\"\n\n")
    };
    std::fs::write(&path, [entry("a", "A"), entry("b", "B")].concat()).unwrap();
    let take_out = |name: &str| {
        let args = UnregisterArgs { name: name.into(), yes: true, dry_run: false };
        unregister(&Target::read(path.clone()).unwrap(), &args, None, Format::Text, &mut Vec::new())
    };
    let error = take_out("a").unwrap_err().to_string();
    assert!(error.contains("would move [device.b] from bit 1 to bit 0"), "{error}");
    take_out("b").unwrap();
    let error = take_out("a").unwrap_err().to_string();
    assert!(error.contains("no device is registered"), "{error}");
}

#[test]
fn devices_of_rapid_driver_become_entries_or_comments() {
    let bench = Bench::new();
    let foreign = bench.folder.path().join("registry.toml");
    let layout = bench.folder.path().join("mask_layout.toml");
    std::fs::write(
        &foreign,
        "[[device]]\nname = \"Force-L\"\nvid = \"1209\"\npid = \"0002\"\nserial = \"F1\"\n\
         on_attach = \"python3 force.py; \\u001b[2J\\nrm -rf /\"\n\n\
         [[device]]\nname = \"unknown\"\nvid = \"1\"\npid = \"2\"\n\n\
         [[device]]\nname = \"phone\"\nbackend = \"mdns\"\nservice_type = \"_iphonevio._tcp\"\n\n\
         [[device]]\nname = \"radio\"\nbackend = \"mdns\"\nservice_type = \"_radio._tcp\"\n",
    )
    .unwrap();
    std::fs::write(&layout, "device_order = [\"a\", \"b\", \"c\", \"phone\", \"Force-L\", \"unknown\"]\n").unwrap();
    let words = format!("--import {} --layout {}", foreign.display(), layout.display());
    bench.register(&words, &[serial_line(Some("F1"), "1-4")], None).1.unwrap();
    let text = bench.text();
    let added = text.strip_prefix(BUILTIN).unwrap();
    assert!(!added.contains('\u{1b}'));
    for expected in [
        "# rapid_driver called it \"Force-L\".\n# rapid_driver ran on_attach: python3 force.py;  [2J rm -rf /\n[device.force_l]\n",
        "serial = \"F1\"\nnode = \"serial\"\nbit = 4\n",
        "# Not in use: its driver is unknown",
        "# [device.unknown]\n# vid = \"0001\"\n",
        "# bit = 5\n",
        "# Not in use: it is found by mDNS (_radio._tcp), whose protocol is unknown",
        "[device.phone.lan]\nprotocol = \"iphone\"\nmdns = \"_iphonevio._tcp\"\n",
    ] {
        assert!(added.contains(expected), "{expected:?} in {added}");
    }
    let registry = bench.target().registry.unwrap();
    assert_eq!(registry.devices.len(), 5);
    assert_eq!(registry.named("force_l").map(|device| device.id.bit()), Some(4));
    // With the driver given, the others are imported too; the first is already an entry by now.
    let again = bench.register(&format!("--import {} --node camera", foreign.display()), &[], None).1.unwrap_err();
    assert!(again.to_string().contains("already defined"), "{again}");
}
