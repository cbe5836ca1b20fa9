//! The bus and the memory it lives in: what is there too little of, what others do to it, what stays behind.
//!
//! Tests with a `/dev/shm` of their own mount one in a namespace of their own, which needs root.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::fs::File;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use crate::support::skip::skipped;
use crate::support::{self, Episode, Place, Running, python, until};
use rustix::process::Signal;

const RECORD: [&str; 6] = ["--sim", "--headless", "--json", "--record", "--out", "out"];
const RUN: [&str; 5] = ["--sim", "--headless", "--json", "--duration", "300ms"];
const RECORDING: &str = "\"event\":\"recording\"";
/// Where iceoryx2 keeps what is not memory.
const FOLDER: &str = "/tmp/iceoryx2";

/// `rapid ARGUMENTS` after `first` has been run in the same shell.
pub(crate) fn after(place: &Place, first: &str, arguments: &[&str]) -> Command {
    let plain = place.command(arguments);
    let mut command = Command::new("sh");
    command.args(["-c", &format!("{first}\nexec \"$@\""), "sh"]).arg(plain.get_program()).args(plain.get_args());
    for (name, value) in plain.get_envs() {
        match value {
            Some(value) => command.env(name, value),
            None => command.env_remove(name),
        };
    }
    command.current_dir(place.folder.path()).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// The same in a namespace of mounts of its own.
fn apart(place: &Place, first: &str, arguments: &[&str]) -> Command {
    let shell = after(place, first, arguments);
    let mut command = Command::new("unshare");
    command.args(["-m", "--propagation", "private"]).arg(shell.get_program()).args(shell.get_args());
    for (name, value) in shell.get_envs() {
        match value {
            Some(value) => command.env(name, value),
            None => command.env_remove(name),
        };
    }
    command.current_dir(place.folder.path()).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// The same with a `/dev/shm` of `size`.
fn in_memory_of(place: &Place, size: &str, arguments: &[&str]) -> Command {
    apart(place, &format!("mount -t tmpfs -o size={size} tmpfs /dev/shm"), arguments)
}

fn may_mount() -> bool {
    let tried = Command::new("unshare").args(["-m", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]).output();
    let may = tried.is_ok_and(|tried| tried.status.success());
    if !may {
        skipped("a /dev/shm of its own needs root");
    }
    may
}

fn printed(output: &Output) -> String {
    let errors = String::from_utf8_lossy(&output.stderr);
    errors.lines().rfind(|line| line.starts_with("error: ")).unwrap_or_default().to_owned()
}

/// Everything of the bus of this place.
fn files(place: &Place) -> Vec<PathBuf> {
    let prefix = format!("iox2_{}_", place.instance);
    let ours = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(&prefix));
    let list = |folder: &Path| -> Vec<PathBuf> {
        std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
    };
    let folder = Path::new(FOLDER);
    let nodes = list(&folder.join("nodes")).into_iter().filter(|path| path.is_dir());
    let folders = ["/dev/shm".into(), folder.into(), folder.join("services"), folder.join("nodes")];
    folders.into_iter().chain(nodes).flat_map(|folder: PathBuf| list(&folder)).filter(ours).collect()
}

fn whole_episode(place: &Place) -> Episode {
    let files = place.files("out");
    let [file] = files.as_slice() else { panic!("{files:?}") };
    Episode::read(&place.path("out").join(file))
}

#[test]
fn nothing_on_the_bus_is_writable_by_others_and_nothing_stays_whatever_the_umask() {
    for umask in ["000", "022", "077"] {
        let place = Place::new();
        let command = after(&place, &format!("umask {umask}"), &["--sim", "--headless", "--json"]);
        let running = place.start_as(command, "\"mask\":\"0x07\"");
        // A program that takes part makes files, too.
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/subscribe.py");
        let mut program = Command::new(python());
        program.arg(script).args(["/rapid/camera/wrist", "100000"]).env("RAPID_INSTANCE", &place.instance);
        let mut program = program.stdout(Stdio::null()).spawn().expect("python");
        let nodes = || files(&place).iter().filter(|path| path.to_string_lossy().ends_with(".node_monitor")).count();
        until("a subscriber", || nodes() == 2);
        let all = files(&place);
        assert!(all.len() > 20, "{all:?}");
        let folders = [FOLDER, "/tmp/iceoryx2/nodes", "/tmp/iceoryx2/services"].map(PathBuf::from);
        for path in all.iter().chain(&folders) {
            let mode = std::fs::symlink_metadata(path).expect("it is in use").permissions().mode();
            assert_eq!(mode & 0o022, 0, "umask {umask}: {} has mode {mode:o}", path.display());
        }
        // What it made belongs to no process once it is gone.
        program.kill().expect("python");
        program.wait().expect("python");
        running.signal(Signal::INT);
        let (code, output, errors) = running.end();
        assert_eq!(code, support::recorded_code(&output), "{errors}");
        assert_eq!(files(&place), [] as [PathBuf; 0], "umask {umask}");
    }
}

#[test]
fn too_little_memory_at_the_start_is_an_error_with_numbers_and_fix() {
    if !may_mount() {
        return;
    }
    for size in ["64k", "1m", "2m", "8m", "60m"] {
        let place = Place::new();
        let ended = in_memory_of(&place, size, &RECORD).output().expect("a shell");
        let error = printed(&ended);
        assert_eq!(ended.status.code(), Some(1), "{size}: {ended:?}");
        for wanted in ["/dev/shm: ", " free of ", " are needed", "sudo mount -o remount,size="] {
            assert!(error.contains(wanted), "{size}: {error}");
        }
        assert_eq!(place.files("out"), [] as [String; 0], "{size}: nothing was recorded");
    }
}

/// Runs a program among the mounts of a run.
fn enter(running: &Running, place: &Place, program: &Command) -> Output {
    let mut command = Command::new("nsenter");
    command.args(["-m", "-t", &running.pid().to_string()]).arg(program.get_program()).args(program.get_args());
    command.env("RAPID_INSTANCE", &place.instance).output().expect("nsenter")
}

/// A run can be stopped whatever is full, damaged or gone.
#[test]
fn an_order_needs_no_memory_no_disk_and_no_bus() {
    if !may_mount() {
        return;
    }
    let place = Place::new();
    // The program itself may lie below /tmp: its folder is put back.
    let folder = Path::new(env!("CARGO_BIN_EXE_rapid")).parent().expect("a folder").display();
    let full = format!(
        "exec 3<'{folder}' && mount -t tmpfs -o size=90m tmpfs /dev/shm && mount -t tmpfs -o size=4m tmpfs /tmp && \
         mkdir -p '{folder}' && mount --no-canonicalize --bind /proc/self/fd/3 '{folder}'"
    );
    let running = place.start_as(apart(&place, &full, &["--sim", "--headless", "--json"]), "\"mask\":\"0x07\"");
    let of = |path: &str| PathBuf::from(format!("/proc/{}/root{path}", running.pid()));
    for folder in ["/dev/shm", "/tmp"] {
        fill_up(&mut File::create(of(folder).join("fill")).expect("the run's memory"));
    }
    let order = |word: &str| enter(&running, &place, &place.command(&[word]));
    let look = |what: &str| {
        let (disarm, arm) = (order("disarm"), order("arm"));
        assert_eq!(disarm.status.code(), Some(0), "{what}: {disarm:?}");
        assert!(String::from_utf8_lossy(&disarm.stdout).contains("disarmed"), "{what}: {disarm:?}");
        assert_eq!(arm.status.code(), Some(3), "{what}: {arm:?}");
        assert!(printed(&arm).contains("no actuator is plugged in"), "{what}: {arm:?}");
    };
    look("full");
    for folder in ["/tmp/iceoryx2/services", "/tmp/iceoryx2/nodes"] {
        std::fs::remove_dir_all(of(folder)).expect("the bus's folder");
    }
    look("the bus is damaged");
    running.signal(Signal::INT);
    running.end();
    let none = place.command(&["disarm"]).output().expect("rapid");
    assert_eq!(none.status.code(), Some(3), "{none:?}");
    assert!(printed(&none).contains("no rapid of instance"), "{none:?}");
}

/// Fills the memory that a run sees, to the last byte.
fn fill(running: &Running) -> PathBuf {
    let path = PathBuf::from(format!("/proc/{}/root/dev/shm/fill", running.pid()));
    fill_up(&mut File::create(&path).expect("the run's memory"));
    path
}

fn fill_up(file: &mut File) {
    for size in [1 << 20, 4096, 1] {
        while file.write_all(&vec![1; size]).is_ok() {}
    }
}

#[test]
fn memory_filled_by_another_program_does_not_end_a_run() {
    if !may_mount() {
        return;
    }
    let place = Place::new();
    let arguments: Vec<&str> = RECORD.iter().copied().chain(["--duration", "3s"]).collect();
    let running = place.start_as(in_memory_of(&place, "90m", &arguments), RECORDING);
    fill(&running);
    // A subscriber that comes finds no room: it gets an error.
    let enter = |program: &mut Command| enter(&running, &place, program);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/subscribe.py");
    enter(Command::new(python()).arg(script).args(["/rapid/camera/wrist", "5", "2"]));
    let (code, output, errors) = running.end();
    // A busy machine may make a BAD episode of it, which is not an error of the bus.
    assert!(matches!(code, Some(0 | 4)), "{code:?}: {errors}{output}");
    let reported = support::events(&output);
    let ended = reported.iter().find(|event| event["event"] == "episode").expect("the end of the episode");
    assert_eq!((&ended["error"], &ended["dropped"]), (&serde_json::Value::Null, &serde_json::json!(0)), "{ended}");
    assert!(whole_episode(&place).topic("/rapid/camera/wrist").count() > 0, "{output}");
}

/// A run that another program takes memory from dies. Its episode is as after any other death: the motors, too, are stopped
/// as in `tests/guard.rs`.
#[test]
fn a_run_whose_memory_another_program_truncates_dies_and_its_episode_is_recovered() {
    for suffix in ["data", "connection", "dynamic", "event_mgmt"] {
        let place = Place::new();
        let running = place.start(&RECORD, RECORDING);
        let mask = place.published();
        let [partial] = &place.files("out")[..] else { panic!("{:?}", place.files("out")) };
        let partial = place.path("out").join(partial);
        let written = || support::last_written(&partial, "/rapid/mask").map_or(0, |mask| mask.sequence.into());
        until("a file with this mask", || written() >= mask);
        running.signal(Signal::STOP);
        for path in files(&place).iter().filter(|path| path.extension().is_some_and(|found| found == suffix)) {
            File::options().write(true).truncate(true).open(path).expect("a file in use");
        }
        running.signal(Signal::CONT);
        assert_eq!(running.died_of(), Some(Signal::BUS.as_raw()), "{suffix}");
        let recovered = place.run(&["recover", "out"]);
        assert_eq!(recovered.status.code(), Some(0), "{suffix}: {recovered:?}");
        let last = whole_episode(&place).topic("/rapid/mask").map(|mask| u64::from(mask.sequence)).max();
        assert!(
            last >= Some(mask),
            "{suffix}: mask {mask} was in the file, and {last:?} is the last of the repaired one"
        );
        // What is left in shared memory does not hinder the next run, and is removed by it.
        let next = place.run(&RUN);
        assert_eq!(next.status.code(), Some(0), "{suffix}: {next:?}");
        assert_eq!(files(&place), [] as [PathBuf; 0], "{suffix}");
    }
}

#[test]
fn a_run_outlasts_the_removal_of_its_files_and_recreates_the_mask() {
    let place = Place::new();
    let running = place.start_as(after(&place, "exec 2>log", &RECORD), RECORDING);
    std::fs::remove_file(place.mask_file()).expect("the mask");
    let dynamic = files(&place).into_iter().find(|path| path.extension().is_some_and(|found| found == "dynamic"));
    std::fs::remove_file(dynamic.expect("a file of the bus")).expect("a file of the bus");
    let log = || std::fs::read_to_string(place.path("log")).expect("standard error");
    let recreated = format!("{}: removed or replaced during the run; created again", place.mask_file().display());
    until("the mask", || log().contains(&recreated) && place.mask_file().exists());
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, support::recorded_code(&output), "{errors}");
    assert_eq!((files(&place), place.mask_file().exists()), (Vec::new(), false));
}

/// `rapid ARGUMENTS` after `first` has changed mounts of its own.
fn among_mounts(place: &Place, first: &str, arguments: &[&str]) -> Output {
    apart(place, first, arguments).output().expect("unshare")
}

#[test]
fn a_missing_mount_is_named_with_the_fix() {
    const NO_MEMORY: &str = "mkdir dev && mount -t tmpfs tmpfs dev && cp -a /dev/null /dev/zero /dev/urandom dev && \
                             mount --move dev /dev";
    if !may_mount() {
        return;
    }
    for (first, wanted) in [
        (NO_MEMORY, ["/dev/shm: there is no shared memory; ", "sudo mount -t tmpfs"]),
        ("mount -t tmpfs -o ro tmpfs /dev/shm", ["/dev/shm: it is mounted read-only; ", "sudo mount -o remount,rw"]),
        ("mount -t tmpfs tmpfs /proc", ["/proc: it is not mounted", "sudo mount -t proc"]),
    ] {
        let place = Place::new();
        let ended = among_mounts(&place, first, &RUN);
        let error = printed(&ended);
        assert_eq!(ended.status.code(), Some(1), "{first}: {ended:?}");
        assert!(wanted.iter().all(|wanted| error.contains(wanted)), "{first}: {ended:?}");
    }
}

#[test]
fn a_run_that_finds_no_udev_reports_it() {
    if !may_mount() {
        return;
    }
    let place = Place::new();
    place.write("devices.toml", include_str!("../../devices.toml"));
    let run = &["--headless", "--duration", "100ms"][..];
    let ended = among_mounts(&place, "mount -t tmpfs tmpfs /run", run);
    let errors = String::from_utf8_lossy(&ended.stderr);
    let warned = |errors: &str| errors.contains("no udev runs here (/run/udev/control is missing)");
    assert!(warned(&errors) && errors.contains("start systemd-udevd"), "{errors}");
    let there = "mount -t tmpfs tmpfs /run && mkdir /run/udev && : > /run/udev/control";
    let errors = String::from_utf8_lossy(&among_mounts(&place, there, run).stderr).into_owned();
    assert!(!warned(&errors), "{errors}");
}

#[test]
fn a_limit_of_the_process_is_named_and_a_start_that_fails_leaves_nothing() {
    let limits = (24..120).step_by(4).map(|count| (format!("ulimit -n {count}"), "limit of"));
    let limits = limits.chain([
        ("ulimit -v 400000".to_owned(), "address space is limited to"),
        ("ulimit -f 100".to_owned(), "files are limited to"),
    ]);
    let mut refused = 0;
    for (limit, wanted) in limits {
        let place = Place::new();
        let ended = after(&place, &limit, &["--sim", "--headless", "--duration", "100ms"]).output().expect("a shell");
        assert_eq!(ended.status.signal(), None, "{limit}: {ended:?}");
        let error = printed(&ended);
        if limit.starts_with("ulimit -f") {
            assert!(error.contains(wanted) && error.contains("LimitFSIZE="), "{limit}: {error}");
        }
        if error.contains("topic ") || error.contains("shared-memory") {
            refused += 1;
            assert!(error.contains(wanted), "{limit}: {error}");
        }
        assert_eq!(files(&place), [] as [PathBuf; 0], "{limit}: {error}");
    }
    assert!(refused > 0, "no limit was met while the bus was opened");
}
