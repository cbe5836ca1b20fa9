//! The program as one file: in a folder with it and the libraries that it is linked with, and nothing else.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::support::skip::skipped;
use crate::support::{self, Episode, Place, events, executable};

/// What the README names; the loader is part of libc.
const LINKED: [&str; 5] = ["ld-linux", "libc.so", "libgcc_s.so", "libm.so", "libudev.so"];

/// What a glibc has beside libc.so.6 for programs of before 2.34, when these became parts of it: onnxruntime names them.
const PARTS_OF_LIBC: [&str; 3] = ["libdl.so.2", "libpthread.so.0", "librt.so.1"];

/// Where the loader finds what a file is linked with, and what that is linked with.
fn linked_with(file: &Path) -> BTreeSet<PathBuf> {
    let listed = Command::new("ldd").arg(file).output().expect("ldd");
    assert!(listed.status.success(), "{listed:?}");
    let text = String::from_utf8(listed.stdout).expect("text");
    text.split_whitespace().filter(|word| word.starts_with('/')).map(PathBuf::from).collect()
}

/// A folder with the program and what it is linked with, each library at its own path.
fn root(place: &Place) -> PathBuf {
    let root = place.path("root");
    let program = Path::new(env!("CARGO_BIN_EXE_rapid"));
    for folder in ["proc", "dev", "tmp", "data/in/a/folder"] {
        std::fs::create_dir_all(root.join(folder)).expect("folder");
    }
    executable::copy(program, &root.join("rapid"));
    let libraries = linked_with(program);
    let libc = libraries.iter().find(|library| library.ends_with("libc.so.6")).expect("libc").clone();
    let parts = PARTS_OF_LIBC.map(|part| libc.with_file_name(part));
    for library in libraries.into_iter().chain(parts) {
        let to = root.join(library.strip_prefix("/").expect("an absolute path"));
        std::fs::create_dir_all(to.parent().expect("a folder")).expect("folder");
        executable::copy(&library, &to);
    }
    root
}

/// Runs the program in `root` as if that were the whole machine.
fn run_in(root: &Path, arguments: &[&str]) -> Output {
    let script = "mount --rbind /proc \"$0/proc\" && mount --rbind /dev \"$0/dev\" && exec chroot \"$0\" \"$@\"";
    let mut command = Command::new("unshare");
    command.args(["--map-root-user", "--mount", "sh", "-c", script]).arg(root).arg("/rapid").args(arguments);
    command.env_clear().env("PATH", "/usr/sbin:/usr/bin:/sbin:/bin").env("HOME", "/data");
    command.output().expect("unshare")
}

#[test]
fn the_program_links_only_to_libraries_of_every_installation() {
    let program = Path::new(env!("CARGO_BIN_EXE_rapid"));
    for library in linked_with(program) {
        let name = library.file_name().expect("a name").to_string_lossy();
        // What libudev is linked with differs between distributions.
        let udevs = linked_with(program)
            .iter()
            .any(|other| other.to_string_lossy().contains("libudev") && linked_with(other).contains(&library));
        assert!(udevs || LINKED.iter().any(|known| name.starts_with(known)), "{name}");
        assert!(!name.starts_with("libstdc++"), "{name}");
    }
}

#[test]
fn one_file_runs_a_policy_on_a_machine_without_the_c_plus_plus_library() {
    let permitted = Command::new("unshare").args(["--map-root-user", "--mount", "true"]).output();
    if !permitted.as_ref().is_ok_and(|output| output.status.success()) {
        skipped(&format!("no user namespace with mounts is permitted here ({permitted:?})"));
        return;
    }
    let place = Place::new();
    let root = root(&place);
    let run = ["--json", "--instance", &place.instance, "--infer", "--sim", "task"];
    let record = ["--duration", "5s", "--record", "--out", "/data/in/a/folder"];
    let output = run_in(&root, &[&run[..], &record].concat());
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    let printed = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), support::recorded_code(&printed), "{errors}");
    let reported = events(&printed);
    assert!(reported.iter().any(|event| event["event"] == "act"), "{reported:?}");
    let policy = reported.iter().find(|event| event["event"] == "policy").expect("the policy");
    assert_eq!(policy["folder"], "inside rapid");
    assert!(policy["library"].as_str().is_some_and(|library| library.ends_with(" (built in)")), "{policy}");
    let folder = root.join("data/in/a/folder");
    let file = std::fs::read_dir(&folder).expect("the folder").flatten().next().expect("an episode");
    assert!(Episode::read(&file.path()).topic("/action").count() > 0);
}
