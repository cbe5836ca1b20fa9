//! The bench against itself: a guest in which a program computes for ever. Its virtual time stands still, so that no limit inside comes.

use std::fs;
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use vbench::emu::spec::DeviceSpec;
use vbench::guest::GuestError;
use vbench::scenario::{Scenario, ScenarioError};

/// A busy machine takes some of it for the boot.
const WALL: Duration = Duration::from_secs(15);

#[test]
fn a_guest_that_computes_for_ever_is_ended_and_leaves_no_process() {
    if crate::lacks_virtual_time() {
        return;
    }
    let script = "touch /mnt/share/begun\nwhile :; do :; done";
    let device = DeviceSpec::acm(0x2e8a, 0x000a, 100.0);
    match Scenario::new("endless").device(device).script(script).wall(WALL).run() {
        Err(ScenarioError::Guest(GuestError::Unfinished { machine, .. })) => assert_eq!(machine, "killed"),
        other => panic!("{other:?}"),
    }
    // Those that are killed end a moment later.
    let name = format!("vbench-endless-{}-", std::process::id());
    let begun = Instant::now();
    while !processes(&name).is_empty() && begun.elapsed() < Duration::from_mins(1) {
        thread::sleep(Duration::from_millis(50));
    }
    assert_eq!(processes(&name), Vec::<String>::new());

    let folder = fs::read_dir(std::env::temp_dir()).expect("the folder").flatten().map(|entry| entry.path());
    let shares: Vec<PathBuf> = folder.filter(|path| path.to_string_lossy().contains(&name)).collect();
    assert!(shares.iter().any(|share| share.join("begun").exists()), "it was ended before it computed");
    shares.iter().for_each(|share| fs::remove_dir_all(share).expect("our own folder"));
}

/// The command lines and open files of the processes that name this.
fn processes(name: &str) -> Vec<String> {
    let all = fs::read_dir("/proc").expect("/proc").flatten().map(|entry| entry.path());
    let described = all.filter_map(|process| {
        let line = fs::read_to_string(process.join("cmdline")).ok()?;
        let files = fs::read_dir(process.join("fd")).into_iter().flatten().flatten();
        let files = files.filter_map(|file| fs::read_link(file.path()).ok()).map(|path| path.display().to_string());
        Some(files.fold(line, |line, file| line + " " + &file))
    });
    described.filter(|line| line.contains(name)).collect()
}
