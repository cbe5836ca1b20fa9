//! Names the commit of a release, which an episode's metadata states.

use std::path::Path;
use std::process::Command;

/// The repository, from here.
const GIT: &str = "../../.git";

/// A source archive has no commit. Builds for development have none either: each commit would rebuild them.
fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // Asked for here and not found by git itself: the archive may lie in somebody else's repository.
    if std::env::var("PROFILE").as_deref() != Ok("release") || !Path::new(GIT).exists() {
        return;
    }
    let ask = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
        Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
    };
    // It grows whenever another commit is checked out or made.
    if let Some(log) = ask(&["rev-parse", "--git-path", "logs/HEAD"]).filter(|log| Path::new(log).exists()) {
        println!("cargo::rerun-if-changed={log}");
    }
    if let Some(commit) = ask(&["rev-parse", "HEAD"]) {
        println!("cargo::rustc-env=RAPID_COMMIT={commit}");
    }
}
