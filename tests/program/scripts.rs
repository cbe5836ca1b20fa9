//! What `make test` calls, `scripts/tests.sh` within `scripts/leftovers.sh`, with small programs in place of the tests: no
//! failure and no line of a test gets lost, and a signal leaves nothing running. Scripts that tests write, and the one that
//! makes the root of a guest.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::process::{Command, Stdio};

use rustix::process::{Pid, Signal, kill_process, test_kill_process};

use crate::support::{Place, executable, until, wait_for};

/// Test programs: those that tests.sh runs in a way of their own, and any other.
const PROGRAMS: [&str; 6] = ["guest", "memory", "program", "rapid", "rapid_bus", "other"];
/// What runs: the programs, and the three that tests.sh calls besides.
const STEPS: [&str; 9] =
    ["guest", "memory", "program", "rapid", "rapid_bus", "other", "setup.sh", "models-tests.sh", "cargo"];
/// It says that it runs, and its name, for which a step may be exchanged.
const PASSES: &str = "echo \"$(basename \"$0\") runs\"\n";

/// `scripts/tests.sh` among programs that pass.
fn prepared() -> Place {
    let place = Place::new();
    for name in ["tests.sh", "leftovers.sh"] {
        let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts").join(name));
        script(&place, name, &text.expect("the script"));
    }
    let root = place.folder.path().display();
    let built = PROGRAMS.map(|name| {
        script(&place, &file(name), PASSES);
        let program = format!("\"profile\":{{\"test\":true}},\"executable\":\"{root}/{}\"", file(name));
        format!("echo '{{\"manifest_path\":\"{root}/Cargo.toml\",{program}}}'\n")
    });
    script(&place, "cargo", &built.concat());
    for name in ["setup.sh", "models-tests.sh", "skips.sh"] {
        script(&place, name, PASSES);
    }
    script(&place, "sudo", "exit 1\n");
    place
}

/// An executable in the folder of `place`.
fn script(place: &Place, name: &str, text: &str) {
    executable::script(&place.path(name), &format!("#!/bin/bash\n{text}"));
}

/// A script of `place`. `sudo` would ask for a password.
fn command(place: &Place, name: &str) -> Command {
    let path = format!("{}:{}", place.folder.path().display(), std::env::var("PATH").unwrap_or_default());
    let mut command = Command::new(place.path(name));
    command.env("PATH", path);
    command
}

/// The file of a step.
fn file(step: &str) -> String {
    if PROGRAMS.contains(&step) { format!("deps/{step}-1f") } else { step.to_owned() }
}

#[test]
fn a_failure_of_any_test_program_is_that_of_make_test_and_no_line_is_lost() {
    for failing in [None, Some("skips.sh")].into_iter().chain(PROGRAMS.map(Some)) {
        let place = prepared();
        if let Some(failing) = failing {
            script(&place, &file(failing), &format!("{PASSES}exit 101\n"));
        }
        let mut tests = command(&place, "tests.sh");
        let output = tests.arg(place.path("cargo")).arg("test").output().expect("bash");
        let printed = String::from_utf8_lossy(&output.stdout);
        assert_eq!(output.status.code(), Some(i32::from(failing.is_some())), "{failing:?}: {printed}");
        for name in PROGRAMS {
            // With the folder: the name of one begins with that of another.
            let line = |end: &str| printed.lines().filter(|line| line.ends_with(end)).count();
            assert_eq!(
                printed.lines().filter(|line| *line == format!("{name}-1f runs")).count(),
                1,
                "{failing:?}: {printed}"
            );
            let failures = usize::from(failing == Some(name));
            assert_eq!(line(&format!("/{name}-1f failed")), failures, "{failing:?}: {printed}");
        }
        assert_eq!(printed.matches("models-tests.sh runs").count(), 1, "{failing:?}: {printed}");
    }
}

#[test]
fn what_is_not_built_is_an_error_before_any_test() {
    for (step, text) in [("cargo", "exit 101\n"), ("setup.sh", "exit 1\n"), ("cargo", "true\n")] {
        let place = prepared();
        script(&place, step, text);
        let output = command(&place, "tests.sh").arg(place.path("cargo")).arg("test").output().expect("bash");
        let printed = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.code() == Some(1) && !printed.contains("1f runs"), "{step} {text}: {printed}");
    }
}

/// A folder of so many files that those who list it are not read to the end.
#[test]
fn what_is_left_behind_is_a_failure_and_hides_no_other() {
    let place = prepared();
    for (code, expected) in [(0, 1), (3, 3)] {
        let left = format!("mkdir $TMPDIR/left; touch $TMPDIR/left/{{1..9999}}; exit {code}");
        let mut leftovers = command(&place, "leftovers.sh");
        let output = leftovers.args(["bash", "-c", &left]).output().expect("bash");
        let printed = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(expected) && printed.contains("/left/"), "{:?}: {printed}", output.status);
    }
}

#[test]
fn a_signal_ends_all_that_make_test_runs() {
    // For whoever may be asked for a password the guest is built in the foreground.
    let is_root = rustix::process::geteuid().is_root();
    for step in STEPS.into_iter().filter(|step| is_root || *step != "setup.sh") {
        let place = prepared();
        script(&place, &file(step), "echo \"$$\" >running\nmv running runs\nexec sleep 600\n");
        let mut tests = command(&place, "leftovers.sh");
        let tests = tests.args(["tests.sh", "cargo", "test"].map(|name| place.path(name)));
        let tests =
            tests.current_dir(place.folder.path()).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut tests = tests.spawn().expect("bash");
        let running =
            wait_for(step, || Pid::from_raw(std::fs::read_to_string(place.path("runs")).ok()?.trim().parse().ok()?));
        let script = Pid::from_child(&tests);
        kill_process(script, Signal::TERM).expect("a signal");
        assert_eq!(tests.wait().expect("ends").code(), Some(143), "{step}");
        until(step, || test_kill_process(running).is_err());
    }
}

/// With a file written by the test itself, some of these are refused as "Text file busy".
#[test]
fn a_script_can_be_run_at_once_while_other_tests_start_programs() {
    let place = Place::new();
    let run = |name: usize| {
        for count in 0..40 {
            let path = place.path(&format!("{name}-{count}"));
            executable::script(&path, "#!/bin/sh\nexit 7\n");
            let status = Command::new(&path).status().expect("it runs");
            assert_eq!(status.code(), Some(7));
        }
    };
    std::thread::scope(|scope| {
        for name in 0..4 {
            scope.spawn(move || run(name));
        }
    });
}

/// The owner of all files of a guest is whoever built it. A program with the bit would run as that user, and a guest that an
/// ordinary user built could not mount anything.
#[test]
fn no_program_of_a_guest_runs_as_another_user_than_the_one_who_starts_it() {
    let place = Place::new();
    let pack = "mkdir -p tree/usr/bin tree/usr/sbin tree/tmp && cd tree && touch usr/bin/mount usr/bin/wall usr/bin/true && \
        chmod 4755 usr/bin/mount && chmod 2755 usr/bin/wall && chmod 755 usr/bin/true && chmod 1777 tmp && \
        tar -cf ../rootfs.tar .";
    let packed = Command::new("bash").args(["-ec", pack]).current_dir(place.folder.path()).status().expect("bash");
    assert!(packed.success());
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vbench/image/uml/root.sh");
    let made = Command::new(root).arg(place.folder.path()).status().expect("root.sh");
    assert!(made.success());
    for (file, mode) in [("usr/bin/mount", 0o755), ("usr/bin/wall", 0o755), ("usr/bin/true", 0o755), ("tmp", 0o1777)] {
        let found = std::fs::metadata(place.path("root").join(file)).expect(file).mode() & 0o7777;
        assert_eq!(found, mode, "{file}: {found:o}");
    }
}
