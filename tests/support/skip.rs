//! A test, or a part of one, that cannot be made on this machine.
//!
//! To the test harness such a test has passed, and what it printed is not shown. `scripts/skips.sh` lists at the end of
//! `make test` what is reported here, and fails in CI if `tests/may-skip.txt` does not permit it.

use std::io::Write as _;

/// The file to which skipped tests are appended, one a line.
const LIST: &str = "RAPID_SKIPPED";

/// Reports that the test of this thread is skipped, and why.
///
/// # Panics
///
/// If the list cannot be written: a skip that nobody sees is a failure.
#[allow(clippy::print_stdout, clippy::expect_used, reason = "only tests call it")]
pub(crate) fn skipped(reason: &str) {
    let thread = std::thread::current();
    let line = format!("{}: {}\n", thread.name().unwrap_or("?"), reason.replace('\n', " "));
    print!("skipped: {line}");
    let Some(list) = std::env::var_os(LIST).filter(|list| !list.is_empty()) else { return };
    let list = std::fs::File::options().append(true).create(true).open(list);
    // In one write: other tests append at the same time.
    list.expect(LIST).write_all(line.as_bytes()).expect(LIST);
}
