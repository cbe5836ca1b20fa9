//! Space in shared memory: this program reserves each segment when it creates it.
//!
//! iceoryx2 0.10 creates a segment with the C library's `ftruncate`, which reserves nothing on tmpfs: the first write
//! to a page without space ends the process with SIGBUS at any later time. The [`ftruncate`] here replaces that
//! function in this program, and is all that reserves those segments. The standard library and rustix do not use it.
//!
//! What another program of this user takes away later is not survived: it truncates a segment, and the process dies.
//! So it is with a segment of another program, which is not reserved, once it cannot get a page. Motors are then stopped
//! by their guard, and the episode is repaired.
//!
//! Invariant: a segment on tmpfs that this program created, at the start or for a later subscriber, has all its pages;
//! otherwise it was not created, and iceoryx2 reports it.

use std::sync::atomic::{AtomicI32, Ordering};

use libc::{c_int, off_t};
use rustix::process::{Resource, getrlimit};

use super::BusError;

/// Where Linux keeps POSIX shared memory, see `shm_overview(7)`.
pub(super) const PLACE: &str = "/dev/shm";
/// The type of tmpfs in `statfs(2)`.
const TMPFS_MAGIC: i64 = 0x0102_1994;
/// Upper bound for iceoryx2's own bookkeeping of one topic or node, in bytes.
pub(super) const BOOKS: u64 = 128 << 10;

/// Why a segment was not created, as an `errno`, until it is queried; 0 if all were created.
static REFUSED: AtomicI32 = AtomicI32::new(0);

/// Fails if fewer than `need` bytes are free.
pub(super) fn check(need: u64) -> Result<(), BusError> {
    match space() {
        Some((size, free)) if free < need => Err(BusError::Room { need, free, size }),
        _ => Ok(()),
    }
}

/// The error of a segment that could not be created since the last call.
pub(super) fn lacking() -> Option<BusError> {
    match REFUSED.swap(0, Ordering::Relaxed) {
        0 => return None,
        libc::EFBIG => return Some(BusError::FileSize { limit: getrlimit(Resource::Fsize).current.unwrap_or(0) }),
        _ => {}
    }
    let (size, free) = space()?;
    Some(BusError::Room { need: free + BOOKS, free, size })
}

/// Bytes of a page.
pub(super) fn page() -> usize {
    // SAFETY: returns a number.
    usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) }).unwrap_or(4096)
}

/// Size and free bytes of the file system; `None` if the system does not limit it.
fn space() -> Option<(u64, u64)> {
    let space = rustix::fs::statvfs(PLACE).ok()?;
    let bytes = |blocks: u64| blocks.saturating_mul(space.f_frsize);
    (space.f_blocks > 0).then(|| (bytes(space.f_blocks), bytes(space.f_bavail)))
}

/// The size in MiB at which `need` bytes are free.
pub(super) const fn mebibytes(size: u64, free: u64, need: u64) -> u64 {
    size.saturating_add(need.saturating_sub(free)).div_ceil(1 << 20) + 64
}

/// `ftruncate(2)`, which on tmpfs fails with `ENOSPC` if there is no space for the whole file.
///
/// # Safety
/// As for the C library's function: every descriptor and length is allowed.
// SAFETY: signature and contract are those of the C library's function of this name.
#[unsafe(no_mangle)]
unsafe extern "C" fn ftruncate(descriptor: c_int, length: off_t) -> c_int {
    if length > 0 && is_on_tmpfs(descriptor) {
        // SAFETY: takes numbers only.
        while unsafe { libc::fallocate(descriptor, 0, 0, length) } != 0 {
            match std::io::Error::last_os_error().raw_os_error() {
                Some(libc::EINTR) => {}
                // No means to reserve: not Linux's own tmpfs.
                Some(libc::EOPNOTSUPP | libc::ENOSYS) => break,
                // The caller reads `errno`.
                refused => {
                    REFUSED.store(refused.unwrap_or(libc::ENOSPC), Ordering::Relaxed);
                    return -1;
                }
            }
        }
    }
    // SAFETY: takes numbers only.
    let done = unsafe { libc::syscall(libc::SYS_ftruncate, descriptor, length) };
    if done == 0 { 0 } else { -1 }
}

fn is_on_tmpfs(descriptor: c_int) -> bool {
    let mut about = std::mem::MaybeUninit::<libc::statfs>::uninit();
    // SAFETY: the kernel writes the whole struct or fails; it is read only if it did not.
    unsafe { libc::fstatfs(descriptor, about.as_mut_ptr()) == 0 && about.assume_init().f_type == TMPFS_MAGIC }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_suggested_mount_size_has_enough_room() {
        assert_eq!(mebibytes(64 << 20, 10 << 20, 74 << 20), 128 + 64);
        assert_eq!(mebibytes(64 << 20, 10 << 20, 0), 64 + 64);
    }

    #[test]
    fn missing_memory_is_an_error_with_its_fix() {
        assert!(check(0).is_ok());
        if space().is_none() {
            crate::skip::skipped(&format!("{PLACE} has no limit"));
            return;
        }
        let error = check(1 << 50).unwrap_err().to_string();
        assert!(error.starts_with("/dev/shm: ") && error.contains("mount -o remount,size="), "{error}");
    }
}
