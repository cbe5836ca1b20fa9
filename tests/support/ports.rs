//! Who may open a port that is held.

use std::path::Path;
use std::process::Command;

/// Whether a program without the capability to ignore `TIOCEXCL` may open the port.
pub(crate) fn may_be_opened(path: &Path) -> bool {
    let mut shell = Command::new("setpriv");
    if rustix::process::geteuid().is_root() {
        shell.arg("--bounding-set=-sys_admin");
    }
    shell.args(["sh", "-c", ": <\"$0\""]).arg(path).status().is_ok_and(|status| status.success())
}
