//! The list of skipped tests at the end of `make test`: `scripts/skips.sh`, and what reports to it.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::path::Path;
use std::process::Command;

use crate::support::Place;
use crate::support::skip::skipped;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// What the script prints about `skipped` where `permitted` may be, and its exit code.
fn listed(skipped: &str, permitted: &str, ci: Option<&str>) -> (String, Option<i32>) {
    let place = Place::new();
    let (skipped, permitted) = (place.write("skipped", skipped), place.write("may-skip.txt", permitted));
    let mut script = Command::new(Path::new(ROOT).join("scripts/skips.sh"));
    script.arg(skipped).env("MAY_SKIP", permitted).env_remove("CI");
    if let Some(ci) = ci {
        script.env("CI", ci);
    }
    let output = script.output().expect("bash");
    (String::from_utf8_lossy(&output.stdout).into_owned(), output.status.code())
}

#[test]
fn a_skip_that_is_not_permitted_is_named_and_fails_only_in_ci() {
    let skipped = "rig::a: no root\nbus::b::c: no network: none\nrig::a: no root\nmodels.test_d.D.test: no program\n";
    let permitted = "# Why\n\nrig::*  users\nmodels.test_d.D.test  no program is built\n";
    let lines = "3 tests were skipped:\n    bus::b::c: no network: none (not permitted by tests/may-skip.txt)\n    \
        models.test_d.D.test: no program\n    rig::a: no root\n";
    for (ci, code) in [(Some("true"), 1), (Some("false"), 0), (None, 0)] {
        assert_eq!(listed(skipped, permitted, ci), (lines.to_owned(), Some(code)), "{ci:?}");
    }
    let all = format!("{permitted}bus::b::c  a machine without a network\n");
    assert_eq!(listed(skipped, &all, Some("true")).1, Some(0));
    // A permission is for whole names.
    assert_eq!(listed("rig::ab: why\n", "rig::a  users\n", Some("true")).1, Some(1));
    assert_eq!(
        listed("rig::a: why\n", "rig::a  users\n", Some("true")),
        ("1 test was skipped:\n    rig::a: why\n".to_owned(), Some(0))
    );
    assert_eq!(listed("", permitted, Some("true")), ("No test was skipped.\n".to_owned(), Some(0)));
}

#[test]
fn a_list_that_is_not_there_is_an_error() {
    let output = Command::new(Path::new(ROOT).join("scripts/skips.sh")).arg("/nowhere/skipped").output().expect("bash");
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn a_test_that_is_skipped_is_reported_by_its_name() {
    let place = Place::new();
    let list = place.write("skipped", "other: one\n");
    let output = Command::new(std::env::current_exe().expect("this test"))
        .args(["--exact", "skips::one_that_is_skipped", "--ignored"])
        .env("RAPID_SKIPPED", &list)
        .output()
        .expect("runs");
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && printed.contains("1 passed"), "{printed}");
    let reported = std::fs::read_to_string(list).expect("the list");
    assert_eq!(reported, "other: one\nskips::one_that_is_skipped: neither this nor that\n");
}

#[test]
#[ignore = "run by a_test_that_is_skipped_is_reported_by_its_name"]
fn one_that_is_skipped() {
    skipped("neither this\nnor that");
}

#[test]
fn every_permission_is_for_a_test_that_there_is() {
    let permitted = std::fs::read_to_string(Path::new(ROOT).join("tests/may-skip.txt")).expect("the list");
    for line in permitted.lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
        let (name, reason) = line.split_once(char::is_whitespace).expect("a name and a reason");
        let test = name.rsplit("::").next().expect("a name");
        let found =
            Command::new("grep").args(["-rqw", &format!("fn {test}"), "src", "tests"]).current_dir(ROOT).status();
        assert!(found.expect("grep").success() && !reason.trim().is_empty(), "{line}");
    }
}
