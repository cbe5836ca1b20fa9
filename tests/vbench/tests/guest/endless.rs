//! The bench against itself: a guest in which a program computes for ever. Its virtual time stands still, so that no limit inside comes.

use std::fs;
use std::time::Duration;

use vbench::guest::GuestError;
use vbench::scenario::{Scenario, ScenarioError};

#[test]
fn a_guest_that_computes_for_ever_is_ended_and_leaves_no_process() {
    if crate::lacks_virtual_time() {
        return;
    }
    // On a busy machine it is ended while it boots, which is as good.
    let endless = Scenario::new("endless").script("while :; do :; done").wall(Duration::from_secs(10));
    match endless.run() {
        Err(ScenarioError::Guest(GuestError::Unfinished { .. })) => {}
        other => panic!("{other:?}"),
    }
    let left: Vec<String> = processes().filter(|line| line.contains("/vbench-endless-")).collect();
    assert_eq!(left, Vec::<String>::new());
    let name = format!("vbench-endless-{}-", std::process::id());
    for share in fs::read_dir(std::env::temp_dir()).expect("the folder").flatten() {
        if share.file_name().to_string_lossy().starts_with(&name) {
            fs::remove_dir_all(share.path()).expect("kept for who looks for the reason");
        }
    }
}

/// The command lines and open files of all processes.
fn processes() -> impl Iterator<Item = String> {
    let all = fs::read_dir("/proc").expect("/proc").flatten().map(|entry| entry.path());
    all.filter_map(|process| {
        let line = fs::read_to_string(process.join("cmdline")).ok()?;
        let files = fs::read_dir(process.join("fd")).into_iter().flatten().flatten();
        let files = files.filter_map(|file| fs::read_link(file.path()).ok()).map(|path| path.display().to_string());
        Some(files.fold(line, |line, file| line + " " + &file))
    })
}
