//! Files of killed processes, in every state of damage, and files in use by live processes.

use std::io::{BufRead, BufReader};
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;

use rustix::fs::{CWD, mknodat};

use super::*;
use crate::Bus;
use crate::home::Home;
use crate::patience::PATIENCE;
use crate::tests::registry;

const HASH: &str = "0354a209029e7d094a819e2d4030ea331e6caaf0";
/// A port of process 25769.
const PORT: &str = "475369541183522065285006754738";

#[test]
fn a_file_name_identifies_its_owner() {
    let owner = process(number(PORT).unwrap());
    for (name, used) in [
        (format!("{HASH}_{PORT}.data"), Some(Use::Ports(vec![owner]))),
        (format!("{HASH}_{PORT}__1.data"), Some(Use::Ports(vec![owner]))),
        (format!("{HASH}_{PORT}_{PORT}.connection"), Some(Use::Ports(vec![owner, owner]))),
        (format!("{HASH}_{PORT}.event_mgmt"), Some(Use::Ports(vec![owner]))),
        (format!("{HASH}_{PORT}.dynamic"), Some(Use::Common)),
        (format!("{HASH}_node.0_10_0.global_mgmt"), Some(Use::Common)),
        // Of another instance, whose prefix starts with ours.
        (format!("exp_{HASH}_{PORT}.data"), None),
        (format!("12345_{HASH}_{PORT}.data"), None),
        (String::new(), None),
        (HASH.to_owned(), None),
    ] {
        assert_eq!(in_memory(&name), used, "{name}");
    }
    assert_eq!(socket(&format!("{PORT}.event")), Some(Use::Ports(vec![owner])));
    assert_eq!(socket(&format!("exp_{PORT}.event")), None);
    assert_eq!(monitor(&format!("{PORT}.node_monitor_context")), Some(Use::Node(number(PORT).unwrap())));
    assert_eq!(monitor(&format!("exp_{PORT}.node_monitor")), None);
}

/// Not a test of its own: a process on the bus `RAPID_TEST_BUS`, which stays there or ends.
#[test]
#[ignore = "run by files_of_a_living_process_are_kept_and_damage_to_them_is_reported"]
fn helper() {
    let name = std::env::var("RAPID_TEST_BUS").unwrap();
    let registry = registry(16);
    let opened = Bus::open(&registry, Some(&name)).and_then(|bus| Ok((bus.inbox()?, bus)));
    match opened {
        Ok((inbox, bus)) => {
            if std::env::var_os("RAPID_TEST_STAY").is_some() {
                println!("opened");
                std::thread::sleep(Duration::from_mins(10));
            }
            drop((inbox, bus));
            println!("opened");
        }
        Err(error) => println!("refused: {error}"),
    }
}

fn member(name: &str, stays: bool) -> (Child, String) {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "stale_files::tests::helper", "--ignored", "--nocapture"]).env("RAPID_TEST_BUS", name);
    if stays {
        command.env("RAPID_TEST_STAY", "");
    }
    // The helper must not outlive a failed test.
    // SAFETY: a system call.
    unsafe {
        command.pre_exec(|| Ok(rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::KILL))?))
    };
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let output = BufReader::new(child.stdout.take().unwrap());
    let (notify, reported) = mpsc::channel();
    std::thread::spawn(move || {
        for line in output.lines().map_while(Result::ok) {
            // The test harness prints the test's name before its first line.
            let report = line.find("opened").or_else(|| line.find("refused")).map(|at| line[at..].to_owned());
            let _ = report.map(|report| notify.send(report));
        }
    });
    let report = reported.recv_timeout(PATIENCE).unwrap_or_else(|_| {
        let _ = child.kill();
        format!("nothing, and ended with {:?}", child.wait())
    });
    (child, report)
}

fn killed(name: &str) {
    let (mut child, report) = member(name, true);
    assert_eq!(report, "opened");
    child.kill().unwrap();
    child.wait().unwrap();
}

fn files(name: &str) -> Vec<PathBuf> {
    let files = Files::new(format!("iox2_{name}_"), PathBuf::from("/tmp/iceoryx2"));
    let mut found: Vec<PathBuf> = Vec::new();
    for Entry { path, .. } in files.entries() {
        if path.is_dir() {
            found.extend(std::fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        }
        found.push(path);
    }
    found.sort();
    found
}

/// Kinds of damage to a file.
#[derive(Debug, Clone, Copy)]
enum Damage {
    Empty,
    Random,
    Zeros,
    Folder,
    Fifo,
    Link,
    Gone,
}

impl Damage {
    const ALL: [Self; 7] = [Self::Empty, Self::Random, Self::Zeros, Self::Folder, Self::Fifo, Self::Link, Self::Gone];

    fn apply(self, path: &Path) {
        let there = std::fs::symlink_metadata(path).unwrap();
        remove(path, &there).unwrap();
        self.make(path, &there);
    }

    /// Applies the damage to `path`.
    fn make(self, path: &Path, there: &Metadata) {
        let mode = there.permissions().mode() & 0o777;
        let write = |bytes: &[u8]| {
            let mut file = std::fs::OpenOptions::new().write(true).create_new(true).mode(mode).open(path).unwrap();
            std::io::Write::write_all(&mut file, bytes).unwrap();
        };
        match self {
            Self::Empty => write(&[]),
            Self::Random => {
                write(&[0xa7, 3, 0x5c, 0xff, 0x11, 0x90, 0x42, 7, 0xee, 0x21, 0x83, 0x6d, 9, 0xc4, 0x77, 0x1b]);
            }
            Self::Zeros => write(&vec![0; usize::try_from(there.len()).unwrap()]),
            Self::Folder => std::fs::create_dir(path).unwrap(),
            Self::Fifo => mknodat(CWD, path, rustix::fs::FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap(),
            Self::Link => std::os::unix::fs::symlink("/proc/self/stat", path).unwrap(),
            Self::Gone => {}
        }
    }
}

/// One file of each kind, by the part of its name after the numbers.
fn kinds(name: &str) -> Vec<(String, PathBuf)> {
    let mut kinds: Vec<(String, PathBuf)> = Vec::new();
    for path in files(name) {
        let kind = path.file_name().unwrap().to_str().unwrap();
        let kind = kind.trim_start_matches("iox2_").trim_start_matches(name).to_owned();
        let kind: String = kind.split_once('.').map_or(String::from("folder"), |(_, suffix)| suffix.to_owned());
        if !kinds.iter().any(|(known, _)| *known == kind) {
            kinds.push((kind, path));
        }
    }
    kinds
}

/// A file of this kind that a killed process left behind. Any start of a program on this machine removes such files, also
/// while they are being looked for: then another process is killed.
fn left_behind(name: &str, kind: &str) -> PathBuf {
    const ATTEMPTS: usize = 20;
    let found = (0..ATTEMPTS).find_map(|_| {
        let found = kinds(name).into_iter().find(|(found, _)| found == kind);
        if found.is_none() {
            killed(name);
        }
        found
    });
    found.unwrap_or_else(|| panic!("{ATTEMPTS} killed processes left no {kind} behind")).1
}

/// Serialises the tests: one would clear what another left behind for dead processes.
fn alone() -> std::sync::MutexGuard<'static, ()> {
    static ALONE: std::sync::Mutex<()> = std::sync::Mutex::new(());
    ALONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[test]
fn files_of_killed_processes_are_removed_in_every_state_of_damage() {
    let _alone = alone();
    let name = format!("dead{}", std::process::id());
    killed(&name);
    let all = kinds(&name);
    for wanted in ["data", "connection", "dynamic", "event_mgmt", "event", "service", "details", "port_tag", "folder"] {
        assert!(all.iter().any(|(kind, _)| kind == wanted), "no {wanted} among {all:?}");
    }
    for (kind, _) in &all {
        for damage in Damage::ALL {
            let path = left_behind(&name, kind);
            damage.apply(&path);
            let opened = Home::open(Some(&name), 0);
            assert!(opened.is_ok(), "{kind} {damage:?}: {:?}", opened.err());
            drop(opened);
            assert_eq!(files(&name), [] as [PathBuf; 0], "{kind} {damage:?}");
        }
    }
}

#[test]
fn a_damaged_file_is_found_whatever_the_damage() {
    let _alone = alone();
    let name = format!("found{}", std::process::id());
    killed(&name);
    let all = Files::new(format!("iox2_{name}_"), PathBuf::from("/tmp/iceoryx2"));
    let found = || match all.unreadable() {
        Some(BusError::Damaged { path, .. }) => Some(path),
        other => other.map(|other| panic!("{other}")),
    };
    assert_eq!(found(), None);
    for kind in ["data", "connection", "dynamic", "event_mgmt", "service"] {
        let (_, path) = kinds(&name).into_iter().find(|(found, _)| *found == kind).unwrap();
        for damage in Damage::ALL.into_iter().filter(|damage| !matches!(damage, Damage::Gone)) {
            let there = std::fs::symlink_metadata(&path).unwrap();
            let kept = Kept::aside(&path);
            damage.make(&path, &there);
            assert_eq!(found().as_ref(), Some(&path), "{kind} {damage:?}");
            drop(kept);
        }
    }
    all.clear(Duration::ZERO).unwrap();
}

#[test]
fn a_start_removes_files_of_dead_processes_of_other_instances_and_none_of_living_ones() {
    let _alone = alone();
    for (name, prefix) in [
        (format!("iox2_{PORT}.node_monitor"), Some("iox2_")),
        (format!("iox2_a_b_{PORT}.node_monitor_owner_lock"), Some("iox2_a_b_")),
        (format!("other_{PORT}.node_monitor"), None),
        ("iox2_a_7.node_monitor".to_owned(), None),
        (format!("iox2_a_{PORT}.details"), None),
        (PORT.to_owned(), None),
    ] {
        assert_eq!(prefix_of(&name), prefix, "{name}");
    }
    let [dead, living, new] = ["da", "lb", "nc"].map(|which| format!("oth{which}{}", std::process::id()));
    let (mut stays, report) = member(&living, true);
    assert_eq!(report, "opened");
    killed(&dead);
    let used = files(&living);
    assert!(!files(&dead).is_empty());
    super::super::home::clear_others(Some(&new));
    assert_eq!((files(&dead), files(&living)), (Vec::new(), used));
    stays.kill().unwrap();
    stays.wait().unwrap();
    Files::new(format!("iox2_{living}_"), PathBuf::from("/tmp/iceoryx2")).clear(Duration::ZERO).unwrap();
}

#[test]
fn an_empty_folder_of_a_dead_process_is_removed_and_no_other() {
    let root = tempfile::tempdir().unwrap();
    let nodes = root.path().join("nodes");
    let now = seconds(ClockId::Monotonic);
    // No process has this id.
    let (own, dead) = (std::process::id(), u32::MAX);
    let folder = |process: u32, created: u64| {
        let path = nodes.join(((u128::from(process) << 64) | u128::from(created)).to_string());
        std::fs::create_dir_all(&path).unwrap();
        path
    };
    let gone = [folder(dead, 0), folder(dead, now - FILLED_WITHIN - 1), folder(dead, now + 1000)];
    let (full, foreign) = (folder(dead, 1), nodes.join("notes"));
    std::fs::write(full.join("x"), "").unwrap();
    std::fs::create_dir(&foreign).unwrap();
    // The second may be of a process that is starting in another namespace.
    let stays = [folder(own, now), folder(dead, now), full, foreign];
    Files::new("iox2_test_".to_owned(), root.path().to_owned()).clear_others();
    assert_eq!(gone.map(|folder| folder.exists()), [false; 3]);
    assert_eq!(stays.map(|folder| folder.exists()), [true; 4]);
}

/// A file that is restored on drop.
struct Kept {
    path: PathBuf,
    aside: PathBuf,
}

impl Kept {
    fn aside(path: &Path) -> Self {
        let folder = if path.starts_with(space::PLACE) { space::PLACE } else { "/tmp/iceoryx2" };
        let aside = Path::new(folder).join(format!("rapid_test_aside_{}", std::process::id()));
        std::fs::rename(path, &aside).unwrap();
        Self { path: path.to_owned(), aside }
    }
}

impl Drop for Kept {
    fn drop(&mut self) {
        let _ = std::fs::symlink_metadata(&self.path).map(|there| remove(&self.path, &there));
        let _ = std::fs::rename(&self.aside, &self.path);
    }
}

#[test]
fn files_of_a_living_process_are_kept_and_damage_to_them_is_reported() {
    let name = format!("live{}", std::process::id());
    let (mut first, report) = member(&name, true);
    assert_eq!(report, "opened");
    let used = files(&name);
    let (mut second, report) = member(&name, false);
    second.wait().unwrap();
    assert_eq!((report.as_str(), files(&name)), ("opened", used));
    for (kind, _) in kinds(&name) {
        for damage in Damage::ALL {
            let before = files(&name);
            let (_, path) = kinds(&name).into_iter().find(|(found, _)| *found == kind).unwrap();
            let there = std::fs::symlink_metadata(&path).unwrap();
            let kept = Kept::aside(&path);
            damage.make(&path, &there);
            let (mut second, report) = member(&name, false);
            second.wait().unwrap();
            let named = report.contains("rm -r /dev/shm/iox2_") || report.contains("rm -r /tmp/iceoryx2/");
            // A missing file is not reported by name.
            let missing = matches!(damage, Damage::Gone) && report.contains("end the programs that use the bus");
            assert!(report == "opened" || named || missing, "{kind} {damage:?}: {report}");
            drop(kept);
            if files(&name) == before {
                continue;
            }
            // To iceoryx2, a process without its lock is dead. It ends, and the next one finds everything in order.
            first.kill().unwrap();
            first.wait().unwrap();
            let (next, report) = member(&name, true);
            assert_eq!(report, "opened", "after {kind} {damage:?}");
            first = next;
        }
    }
    first.kill().unwrap();
    first.wait().unwrap();
    Files::new(format!("iox2_{name}_"), PathBuf::from("/tmp/iceoryx2")).clear(Duration::ZERO).unwrap();
    assert_eq!(files(&name), [] as [PathBuf; 0]);
}
