//! Serial ports that are held exclusively: by a lock (`flock`), which also binds root, and by `TIOCEXCL`, which also binds
//! programs that ask for no lock (`ioctl_tty(2)`).
//!
//! The kernel ends `TIOCEXCL` at the last close of a port. A pseudo terminal (socat, a simulated adapter) is not closed before
//! its other side is: it would refuse everyone but root once a program has held it. Of one the lock alone is held.

use std::os::fd::AsFd;

use rustix::fs::{FlockOperation, flock, fstat, major};
use rustix::io::Result;
use rustix::termios::{ioctl_tiocexcl, ioctl_tiocnxcl};

/// Major numbers of pseudo terminals (Documentation/admin-guide/devices.txt).
const PSEUDO: std::ops::RangeInclusive<u32> = 136..=143;

/// Holds an open port until it is closed.
///
/// # Errors
/// `EAGAIN` where it is locked, otherwise what the kernel reports.
pub fn hold(port: impl AsFd) -> Result<()> {
    flock(&port, FlockOperation::NonBlockingLockExclusive)?;
    if is_pseudo(&port)? { Ok(()) } else { ioctl_tiocexcl(port) }
}

/// For a port that is held already, by its lock and by `TIOCEXCL`.
///
/// # Errors
/// What the kernel reports.
pub fn release_if_pseudo(port: impl AsFd) -> Result<()> {
    if is_pseudo(&port)? { ioctl_tiocnxcl(port) } else { Ok(()) }
}

fn is_pseudo(port: impl AsFd) -> Result<bool> {
    Ok(PSEUDO.contains(&major(fstat(port)?.st_rdev)))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use rustix::fs::{Mode, OFlags, open};
    use rustix::io::Errno;
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

    use super::*;
    use crate::ports::may_be_opened;

    #[test]
    fn a_pseudo_terminal_can_be_opened_again_once_its_holder_has_closed_it() {
        let ours = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&ours).unwrap();
        unlockpt(&ours).unwrap();
        let path = ptsname(&ours, Vec::new()).unwrap().into_string().unwrap();
        let path = Path::new(&path);
        let opened = || open(path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty()).unwrap();
        let port = opened();
        hold(&port).unwrap();
        assert_eq!(hold(opened()), Err(Errno::AGAIN));
        drop(port);
        assert!(may_be_opened(path));
        hold(opened()).unwrap();

        // As it is without an exception for it.
        let port = opened();
        ioctl_tiocexcl(&port).unwrap();
        drop(port);
        assert!(!may_be_opened(path));
    }
}
