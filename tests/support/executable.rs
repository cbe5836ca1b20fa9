//! Programs that tests make and run. Another process writes them: a child that a test beside this one starts inherits what is
//! open for writing here until it becomes a program of its own, and a file that is open for writing cannot be run.

#![allow(dead_code, reason = "each test program uses its own part of this module")]
#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

/// A script, in a folder that is made if it is missing.
///
/// # Panics
/// If it cannot be written.
pub(crate) fn script(path: &Path, text: &str) {
    let mut shell = Command::new("/bin/sh")
        .args(["-c", "mkdir -p \"${1%/*}\" && cat >\"$1\" && chmod 755 \"$1\"", "sh"])
        .arg(path)
        .stdin(Stdio::piped())
        .spawn()
        .expect("a shell");
    // Dropped at once, so that the shell reads an end.
    let written = shell.stdin.take().map(|mut input| input.write_all(text.as_bytes()));
    assert!(matches!(written, Some(Ok(()))) && shell.wait().is_ok_and(|status| status.success()), "{}", path.display());
}

/// A copy of a program.
///
/// # Panics
/// If it cannot be written.
pub(crate) fn copy(program: &Path, path: &Path) {
    let status = Command::new("cp").arg(program).arg(path).status();
    assert!(status.is_ok_and(|status| status.success()), "{}", path.display());
}
