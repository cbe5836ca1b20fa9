//! The other end of a local socket: its identity as the kernel reports it (`SO_PEERCRED`, unix(7)), and the state of its
//! process.

use std::io;
use std::mem::size_of;
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;

/// Groups of a process, at most (`NGROUPS_MAX`, linux/limits.h).
const MOST_GROUPS: usize = 65_536;

/// See the module's comment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Peer {
    /// Its process; `None` for one of a process namespace that is not visible from here.
    pub process: Option<u32>,
    /// Its user.
    pub user: u32,
    /// Its primary group.
    pub group: u32,
}

impl Peer {
    /// The process that created the other end of `stream`, or listened there.
    ///
    /// # Errors
    /// When the kernel does not report it.
    pub fn from_stream(stream: &UnixStream) -> io::Result<Self> {
        let mut found = libc::ucred { pid: 0, uid: 0, gid: 0 };
        let mut length = libc::socklen_t::try_from(size_of::<libc::ucred>()).unwrap_or_default();
        // SAFETY: both outlive the call, and `length` is the size of `found`, for which all bytes are valid.
        let outcome = unsafe {
            libc::getsockopt(
                stream.as_raw_fd(),
                libc::SOL_SOCKET,
                libc::SO_PEERCRED,
                (&raw mut found).cast(),
                &raw mut length,
            )
        };
        if outcome != 0 {
            return Err(io::Error::last_os_error());
        }
        Ok(Self { process: u32::try_from(found.pid).ok().filter(|pid| *pid != 0), user: found.uid, group: found.gid })
    }

    /// Whether the process that created the other end of `stream` is a member of `group`, by its primary or another
    /// group (`SO_PEERGROUPS`, since Linux 4.13). No, where the kernel does not report it.
    pub fn is_member(stream: &UnixStream, group: u32) -> bool {
        if Self::from_stream(stream).is_ok_and(|peer| peer.group == group) {
            return true;
        }
        let mut groups = vec![0_u32; MOST_GROUPS];
        let mut length = libc::socklen_t::try_from(size_of::<u32>() * groups.len()).unwrap_or_default();
        // SAFETY: both outlive the call, and `length` is the size of `groups`, for which all bytes are valid.
        let outcome = unsafe {
            libc::getsockopt(
                stream.as_raw_fd(),
                libc::SOL_SOCKET,
                libc::SO_PEERGROUPS,
                groups.as_mut_ptr().cast(),
                &raw mut length,
            )
        };
        let found = usize::try_from(length).unwrap_or_default() / size_of::<u32>();
        outcome == 0 && groups.iter().take(found).any(|found| *found == group)
    }
}

/// What the scheduler has a process as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProcessState {
    /// It runs, or waits.
    Alive,
    /// It was stopped, by a signal or a debugger.
    Stopped,
    /// It does not exist, or is a zombie.
    Ended,
}

impl ProcessState {
    /// The state of `process`, see proc(5).
    pub fn read(process: u32) -> Self {
        let stat = std::fs::read_to_string(format!("/proc/{process}/stat"));
        // The state follows the name in parentheses, which may contain anything.
        match stat.ok().as_deref().and_then(|stat| stat.rsplit_once(") ")?.1.bytes().next()) {
            None | Some(b'Z' | b'X' | b'x') => Self::Ended,
            Some(b'T' | b't') => Self::Stopped,
            Some(_) => Self::Alive,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_other_end_of_a_pair_is_this_process() {
        let (one, _other) = UnixStream::pair().unwrap();
        let (user, group) = (rustix::process::geteuid().as_raw(), rustix::process::getegid().as_raw());
        assert_eq!(Peer::from_stream(&one).unwrap(), Peer { process: Some(std::process::id()), user, group });
        assert!(Peer::is_member(&one, group));
        for other in rustix::process::getgroups().unwrap() {
            assert!(Peer::is_member(&one, other.as_raw()));
        }
        assert!(!Peer::is_member(&one, u32::MAX - 1));
    }
}
