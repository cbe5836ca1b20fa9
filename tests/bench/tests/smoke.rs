//! Every section of `make bench` measures: each is run as shortly as it can be, of the debug build.
//!
//! `deaf` is not run again: `tests/vbench/tests/guest/deaf_child.rs` computes its figures from the same scenario. `frame` is left out:
//! in a debug build on a busy machine the cameras of its full load send nothing in the time that a short run has.

use std::path::Path;
use std::process::Command;

/// What `rapid-bench --smoke` prints of these sections, which must measure.
fn measured(sections: &[&str]) -> Vec<serde_json::Value> {
    let program = Path::new(env!("CARGO_BIN_EXE_rapid-bench"));
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).expect("the workspace");
    let output = Command::new(program)
        .args(["--smoke", "--json", "--only"])
        .args(sections)
        .current_dir(root)
        .output()
        .expect("it starts");
    let (printed, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{errors}\n{printed}");
    let figures: Vec<serde_json::Value> =
        printed.lines().map(|line| serde_json::from_str(line).expect("a figure a line")).collect();
    for figure in figures.iter().filter(|figure| figure["value"].is_null()) {
        println!("{}: {}", figure["name"], figure["note"]);
        assert_eq!(figure["absent"], true, "{figure}");
    }
    figures
}

#[test]
// Minutes of an unoptimised program.
#[ignore = "run by make test-all"]
fn every_section_that_needs_no_guest_measures() {
    let sections = [
        "start", "infer", "sync", "picture", "policy", "control", "motors", "safety", "disarm", "can", "eval",
        "replug", "unplug", "mask", "screen", "many", "load", "write", "export",
    ];
    let figures = measured(&sections);
    for section in sections {
        let prefix = if section == "unplug" { "own_unplug_to_bit".to_owned() } else { format!("{section}/") };
        let own = figures.iter().any(|figure| figure["name"].as_str().is_some_and(|name| name.starts_with(&prefix)));
        assert!(own, "{section} gave no figure");
    }
}

#[test]
// Its guests are emulated machines.
#[ignore = "run by make test-all"]
fn the_sections_on_the_virtual_bench_measure() {
    measured(&["cycles", "sweep"]);
}

#[test]
fn a_section_that_measures_nothing_fails_with_its_reason() {
    let output = Command::new(env!("CARGO_BIN_EXE_rapid-bench"))
        .args(["--smoke", "--json", "--only", "policy", "--bundle", "/no/such/policy"])
        .output()
        .expect("it starts");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{errors}");
    assert!(errors.contains("not measured:") && errors.contains("policy/all: "), "{errors}");
}

#[test]
fn every_section_is_run_by_a_test() {
    let help = Command::new(env!("CARGO_BIN_EXE_rapid-bench")).arg("--help").output().expect("it starts");
    let help = String::from_utf8_lossy(&help.stdout);
    let (_, values) = help.split_once("[possible values: ").expect("the sections");
    let (values, _) = values.split_once(']').expect("their end");
    let source = include_str!("smoke.rs");
    // They take minutes, and tests of their own run what they measure.
    let long = ["capture", "deaf", "frame"];
    for section in values.split(',').map(str::trim).filter(|section| !long.contains(section)) {
        assert!(source.contains(&format!("\"{section}\"")), "no test runs section {section}");
    }
}
