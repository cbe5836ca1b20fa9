//! Every target over its seeds, over what once broke it, and over mutations of both: the same ones in
//! every run. `make fuzz` looks further.

use std::path::{Path, PathBuf};

use fuzz::mutate::{Random, mutate};
use fuzz::{TARGETS, Target};
use proptest::prelude::*;

/// How many mutations a target gets: on every machine the same ones. Of those that read a whole episode, or write every file
/// that is made of a registry, one takes as long as several of the others.
fn cases(target: &Target) -> usize {
    match target.name {
        "scenario" => 2000,
        "inspect" => 1200,
        "recover" => 800,
        "replay" | "strings" => 600,
        _ => 3000,
    }
}

fn inputs(target: &Target) -> Vec<(String, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("cases").join(target.name);
    let mut paths: Vec<PathBuf> =
        std::fs::read_dir(&folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
    paths.sort();
    let cases = paths.iter().map(|path| (path.display().to_string(), std::fs::read(path).unwrap()));
    let seeds = (target.seeds)().into_iter().enumerate().map(|(number, seed)| (format!("seed {number}"), seed));
    cases.chain(seeds).collect()
}

/// Runs a target; a panic of it names the input.
fn feed(target: &Target, name: &str, input: &[u8]) {
    if std::panic::catch_unwind(|| (target.run)(input)).is_err() {
        let kept = std::env::temp_dir().join(format!("fuzz-{}-{}", target.name, std::process::id()));
        std::fs::write(&kept, input).unwrap();
        panic!(
            "target {} broke on {name}: kept as {}; `cargo run -p fuzz --bin fuzz run {0} FILE` shows it again",
            target.name,
            kept.display()
        );
    }
}

#[test]
fn no_parser_violates_its_properties() {
    for target in TARGETS {
        let inputs = inputs(target);
        assert!(!inputs.is_empty(), "{} has no seeds", target.name);
        for (name, input) in &inputs {
            feed(target, name, input);
        }
        let mut random = Random(target.name.len() as u64);
        for _ in 0..cases(target) {
            let (name, seed) = &inputs[random.below(inputs.len())];
            let (_, other) = &inputs[random.below(inputs.len())];
            let mutation = mutate(&mut random, seed, other);
            feed(target, &format!("a mutation of {name}"), &mutation);
        }
    }
}

#[test]
fn every_folder_of_cases_belongs_to_a_target() {
    for entry in std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("cases")).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        assert!(name.starts_with('.') || fuzz::target(&name).is_some(), "cases/{name}: no such target");
    }
}

proptest! {
    /// Any text as the serial number of a registered device: in rules, descriptors and unit it is
    /// that and nothing else.
    #[test]
    fn a_serial_number_adds_nothing_but_itself(serial in prop_oneof![any::<String>(), "[ -~]{1,40}", "[*?\\[\\]!^a\"|\\\\$%-]{1,8}"]) {
        fuzz::targets::strings(serial.as_bytes());
    }
}
