//! What strangers wrote: names a device gives itself, files another user planted.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::fmt::Write;
use std::fs;
use std::os::unix::fs::{PermissionsExt, chown, symlink};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::support::skip::skipped;
use crate::support::{self, Episode, EventMessage, Place, events, executable};

/// A serial number that no registry can name: it moves the cursor, turns the line and ends it.
const CURSED: &str = "\u{1b}[2J\u{1b}]0;owned\u{7}\u{9b}31m\r\nnode = \"x\"\0\u{202e}\u{feff}\u{2028}end";
/// One that a registry can name, and that no shell, rule or format may take for its own.
const AWKWARD: &str = r#"a "b" 'c' %k $env{X} \n `id` $(id) *?[x]| #,= : - é 相"#;

const REGISTRY: &str = r#"
[device.by_port]
vid = "0001"
pid = "0001"
port = "1-1"
node = "camera"
bit = 0
[device.by_serial]
vid = "0002"
pid = "0002"
serial = SERIAL
node = "camera"
bit = 1
[device.any_unit]
vid = "0003"
pid = "0003"
node = "camera"
bit = 2
"#;

fn toml_text(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

/// The registry, and a scenario whose devices have these serial numbers.
fn hostile(place: &Place) -> String {
    let long = "0123456789".repeat(1000);
    let mut scenario = String::new();
    for (name, serial) in [("by_port", CURSED), ("by_serial", AWKWARD), ("any_unit", &long)] {
        let _ = writeln!(scenario, "[[device]]\nname = \"{name}\"\nserial = {}", toml_text(serial));
    }
    let stranger = "[[device]]\nname = \"stranger\"\nlike = \"any_unit\"\npid = \"beef\"\nserial = ";
    let _ = writeln!(scenario, "{stranger}{}", toml_text(CURSED));
    place.write("hostile.toml", &scenario);
    place.write("devices.toml", &REGISTRY.replace("SERIAL", &toml_text(AWKWARD)));
    long
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("UTF-8")
}

/// Nothing in it moves a cursor or reorders a line.
#[track_caller]
fn assert_harmless(text: &str) {
    let unsafe_char = |c: &char| {
        (c.is_control() && *c != '\n') || matches!(c, '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{feff}')
    };
    assert_eq!(text.chars().find(unsafe_char), None, "{text}");
}

#[test]
fn device_names_are_recorded_exactly_and_shown_escaped() {
    let place = Place::new();
    let long = hostile(&place);
    let run = |more: &[&str]| {
        let common = ["--sim", "hostile.toml", "--headless", "--duration", "1s", "--config", "devices.toml"];
        let output = place.command(&[&common[..], more].concat()).env("RAPID_LOG", "trace").output().expect("rapid");
        assert_eq!(output.status.code(), support::recorded_code(&text(&output.stdout)), "{}", text(&output.stderr));
        assert_harmless(&text(&output.stdout));
        assert_harmless(&text(&output.stderr));
        text(&output.stdout)
    };
    let lines = run(&[]);
    assert!(lines.contains(r#"serial a "b" 'c' %k $env{X} \n `id` $(id) *?[x]| #,= : - é 相"#), "{lines}");
    assert!(!lines.lines().any(|line| line.chars().count() > 1200), "a line of thousands of characters");

    let printed = events(&run(&["--json", "--record", "--out", "out"]));
    let serial = |device: &str| {
        let attached = printed.iter().find(|event| event["event"] == "attach" && event["device"] == device);
        attached.unwrap_or_else(|| panic!("{device} was not matched"))["serial"].clone()
    };
    assert_eq!([serial("by_port"), serial("by_serial"), serial("any_unit")], [CURSED, AWKWARD, &long]);
    assert!(printed.iter().any(|event| event["event"] == "unregistered"), "the stranger is reported");

    let file = place.path("out").join(&place.files("out")[0]);
    let episode = Episode::read(&file);
    let serials: serde_json::Value = serde_json::from_str(episode.value("rapid/summary", "serials")).expect("JSON");
    assert_eq!([&serials["by_port"], &serials["by_serial"], &serials["any_unit"]], [CURSED, AWKWARD, &long]);
    for topic in ["by_port", "by_serial", "any_unit"] {
        assert!(episode.topic(&format!("/rapid/camera/{topic}")).count() > 0, "{topic} did not stream");
    }
    for event in episode.topic("/rapid/event") {
        let event: EventMessage = event.decode();
        serde_json::from_str::<serde_json::Value>(&event.json).expect("an event is JSON");
    }
    for arguments in [&["inspect"][..], &["--json", "inspect"]] {
        let output = place.run(&[arguments, &[file.to_str().expect("UTF-8")]].concat());
        assert_harmless(&text(&output.stdout));
    }
}

#[test]
fn the_listing_and_the_artifacts_of_such_devices_are_harmless_too() {
    let place = Place::new();
    hostile(&place);
    let common = ["--config", "devices.toml"];
    let output = place.run(&[&common[..], &["artifacts", "--to", "written"]].concat());
    assert_harmless(&text(&output.stdout));
    assert!(place.path("written/99-rapid.rules").exists());
    for arguments in [&["devices", "--sim", "hostile.toml"][..], &["check"]] {
        for json in [&[][..], &["--json"]] {
            let output = place.run(&[&common[..], json, arguments].concat());
            assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", text(&output.stderr));
            assert_harmless(&text(&output.stdout));
            assert_harmless(&text(&output.stderr));
            for line in text(&output.stdout).lines().filter(|_| !json.is_empty()) {
                serde_json::from_str::<serde_json::Value>(line).expect("JSON");
            }
        }
    }
    // A file's name is a stranger's text as well.
    let output = place.run(&["inspect", "\u{1b}[2J\u{202e}.mcap"]);
    assert_eq!(output.status.code(), Some(2));
    assert_harmless(&text(&output.stderr));
}

/// Another user of this machine.
const NOBODY: u32 = 65_534;

/// A folder everybody may enter, with a copy of the program: the build may lie where only root may go.
struct Shared {
    place: Place,
    program: PathBuf,
}

impl Shared {
    /// `None`, reported, unless we are root: no one else can be two users.
    fn new() -> Option<Self> {
        if !rustix::process::geteuid().is_root() {
            skipped("this needs two users, and only root can be two");
            return None;
        }
        let place = Place::new();
        fs::set_permissions(place.folder.path(), PermissionsExt::from_mode(0o755)).expect("mode");
        let program = place.path("rapid");
        executable::copy(Path::new(env!("CARGO_BIN_EXE_rapid")), &program);
        Some(Self { place, program })
    }

    /// Runs `rapid` as user `nobody`.
    fn as_nobody(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(&self.program);
        command.current_dir(self.place.folder.path()).env("RAPID_INSTANCE", &self.place.instance).args(arguments);
        command.uid(NOBODY).gid(NOBODY).env("HOME", "/nonexistent").env_remove("RAPID_LOG");
        command.env_remove("XDG_CONFIG_HOME").output().expect("rapid runs")
    }
}

fn give(path: &Path, uid: u32, mode: u32) {
    chown(path, Some(uid), Some(uid)).expect("chown");
    fs::set_permissions(path, PermissionsExt::from_mode(mode)).expect("mode");
}

#[test]
fn a_registry_that_others_may_change_is_refused_as_root_and_warned_of_otherwise() {
    let Some(shared) = Shared::new() else { return };
    let place = &shared.place;
    let registry = place.write("devices.toml", rapid_registry::BUILTIN);
    fs::create_dir(place.path("open")).expect("folder");
    let through = place.path("open/devices.toml");
    fs::write(&through, rapid_registry::BUILTIN).expect("write");
    symlink(&registry, place.path("link.toml")).expect("link");
    give(&registry, 0, 0o644);
    let check = |path: &str| place.run(&["check", "--config", path]);
    let fine = |path: &str| {
        assert_eq!(check(path).status.code(), Some(0), "root: {path}");
        let output = shared.as_nobody(&["check", "--config", path]);
        assert!(!text(&output.stdout).contains("other users"), "{}", text(&output.stdout));
    };
    fine("devices.toml");
    fine("link.toml");
    let open = place.path("open");
    for (change, path, printed, fix) in [
        (&registry, "devices.toml", "other users may write to it (mode 0666)", "chmod go-w"),
        (&registry, "link.toml", "other users may write to it (mode 0666)", "chmod go-w"),
        (&open, "open/devices.toml", "other users may write to the folder", "chmod go-w"),
    ] {
        let before = fs::metadata(change).expect("there").permissions().mode();
        give(change, 0, before | 0o022);
        let output = check(path);
        assert_eq!(output.status.code(), Some(2), "root: {path}: {}", text(&output.stdout));
        assert!(
            text(&output.stdout).contains(printed) && text(&output.stdout).contains(fix),
            "{}",
            text(&output.stdout)
        );
        let output = place.run(&["--sim", "--headless", "--duration", "100ms", "--config", path]);
        assert_eq!(output.status.code(), Some(2), "a run as root: {path}");
        let output = shared.as_nobody(&["check", "--config", path]);
        assert_eq!(output.status.code(), Some(0), "user nobody: {path}: {}", text(&output.stderr));
        let reported = text(&output.stdout);
        assert!(reported.contains("warning: ") && reported.contains(printed) && reported.contains(fix), "{reported}");
        give(change, 0, before);
    }
    give(&registry, 12_345, 0o644);
    let output = check("devices.toml");
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stdout).contains("it belongs to user 12345, who could change what root runs"));
    assert!(text(&output.stdout).contains("fix: chown 0 "), "{}", text(&output.stdout));
}

#[test]
fn two_users_on_one_machine_do_not_write_through_each_other() {
    let Some(shared) = Shared::new() else { return };
    let place = &shared.place;
    let registry = place.write("devices.toml", rapid_registry::BUILTIN);
    give(&registry, 0, 0o644);
    let out = place.path("out");
    fs::create_dir(&out).expect("folder");
    give(&out, 0, 0o1777);
    let victim = place.write("victim", "precious");
    give(&victim, NOBODY, 0o666);

    // Root's mask lies where user `nobody` wants to publish.
    let mask = place.mask_file();
    fs::write(&mask, "").expect("plant");
    give(&mask, 0, 0o666);
    let run = ["--sim", "--headless", "--config", "devices.toml", "--duration", "1s", "--record", "--out", "out"];
    let output = shared.as_nobody(&run);
    let printed = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{printed}");
    assert!(printed.contains("it belongs to user 0") && printed.contains("remove it: rm -r /dev/shm/"), "{printed}");
    fs::remove_file(&mask).expect("clean");

    // iceoryx2's folder is root's by now: the bus of another user has a folder of its own, unless someone else made it.
    let output = place.run(&["--sim", "--headless", "--duration", "100ms"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let own = PathBuf::from(format!("/tmp/iceoryx2-{NOBODY}"));
    let _ = fs::remove_dir_all(&own);
    fs::create_dir(&own).expect("plant");
    let output = shared.as_nobody(&run);
    let printed = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{printed}");
    let refused = format!("{}: belongs to user 0; end the programs that use it and remove it", own.display());
    assert!(printed.contains(&refused), "{printed}");
    fs::remove_dir(&own).expect("clean");
    let output = shared.as_nobody(&run);
    let printed = text(&output.stderr);
    assert_eq!(output.status.code(), support::recorded_code(&text(&output.stdout)), "{printed}");
    fs::remove_dir_all(&own).expect("the folder of this user's bus");

    // A link of user `nobody` as the folder of root's episodes.
    let link = place.path("link");
    symlink(&out, &link).expect("link");
    std::os::unix::fs::lchown(&link, Some(NOBODY), None).expect("lchown");
    let mut elsewhere = run;
    elsewhere[8] = "link";
    let output = place.run(&elsewhere);
    let printed = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{printed}");
    assert!(printed.contains("link: a symbolic link of user 65534, which is not followed here"), "{printed}");

    // A pipe and a link under the names that are next.
    let output = place.run(&run);
    assert_eq!(output.status.code(), support::recorded_code(&text(&output.stdout)), "{}", text(&output.stderr));
    let first = place.files("out").remove(0);
    assert!(first.ends_with("_001.mcap"), "{first}");
    let planted = out.join(first.replace("_001.mcap", "_002.mcap.partial"));
    symlink(&victim, &planted).expect("link");
    let output = place.run(&run);
    assert_eq!(output.status.code(), support::recorded_code(&text(&output.stdout)), "{}", text(&output.stderr));
    assert_eq!(fs::read_to_string(&victim).expect("victim"), "precious");
    assert!(place.files("out").iter().any(|name| name.ends_with("_003.mcap")), "{:?}", place.files("out"));
}
