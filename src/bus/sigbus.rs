//! The last resort where shared memory has no page to write to: segments created by other programs, and files truncated
//! by other programs.
//!
//! The kernel raises SIGBUS. Its handler maps a page of the process's own in place of the missing one, so that the
//! thread continues, and wakes the task that waits in [`lost`]: the run ends in order, with motors disabled and the
//! episode closed.
//!
//! The run ends in the same way when iceoryx2 panics over an overwritten table (`containment`).
//!
//! Invariant: the handler calls only what is safe in a signal handler: system calls and atomics.
//! Invariant: a SIGBUS of any other memory goes to the previous handler; that of the standard library ends the process.

use std::ffi::OsStr;
use std::mem::MaybeUninit;
use std::os::fd::{AsRawFd, IntoRawFd, RawFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::ptr;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

use libc::{c_int, c_void, siginfo_t};
use rustix::event::{EventfdFlags, eventfd};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::stale_files::Files;
use super::{BusError, space};

/// Bytes of a line of `/proc/self/maps` that are examined: its numbers and the path.
const LINE: usize = 320;
/// Bytes read at a time: a signal stack is small.
const PIECE: usize = 512;
/// `si_code` of memory that is mapped and has no page, see `sigaction(2)`.
const BUS_ADRERR: c_int = 2;

static HAPPENED: AtomicBool = AtomicBool::new(false);
static HANDLER: OnceLock<Handler> = OnceLock::new();
/// The path of the file whose page was missing, null-terminated.
static FILE: [AtomicU8; LINE] = [const { AtomicU8::new(0) }; LINE];
/// The bus of this process, which is searched for a damaged file.
static FILES: OnceLock<Files> = OnceLock::new();
static ERROR: OnceLock<PathBuf> = OnceLock::new();

/// The handler's state, created before it is installed.
struct Handler {
    /// Descriptor of `/proc/self/maps`: none may be free when it is needed.
    maps: RawFd,
    wake: RawFd,
    page: usize,
    before: libc::sigaction,
}

/// Whether memory of the bus has been lost.
pub(super) fn happened() -> bool {
    HAPPENED.load(Ordering::Relaxed)
}

/// Sets where to look for a damaged file.
pub(super) fn watch_over(files: Files) {
    // A process of this program uses one bus.
    let _ = FILES.set(files);
}

/// Memory of the bus is present but unusable: ends its use, as if it had been lost.
pub(super) fn damaged() {
    HAPPENED.store(true, Ordering::Relaxed);
    if let Some(handler) = HANDLER.get() {
        handler.wake();
    }
}

/// What has been lost, with the file if it is known.
pub(super) fn error() -> BusError {
    let file = ERROR.get_or_init(|| {
        let bytes = FILE.iter().map(|byte| byte.load(Ordering::Relaxed)).take_while(|byte| *byte != 0);
        let bytes: Vec<u8> = bytes.collect();
        if !bytes.is_empty() {
            let bytes = bytes.strip_suffix(b" (deleted)").unwrap_or(&bytes);
            return Path::new(OsStr::from_bytes(bytes)).to_owned();
        }
        FILES.get().and_then(Files::damaged).unwrap_or_else(|| PathBuf::from(space::PLACE))
    });
    BusError::Lost { file: file.clone() }
}

/// Returns once memory of the bus has been lost; needs tokio's I/O. Cancel-safe.
pub async fn lost() -> BusError {
    let Some(handler) = HANDLER.get() else { return std::future::pending().await };
    // SAFETY: the descriptor is open for as long as the process lives.
    let wake = unsafe { std::os::fd::BorrowedFd::borrow_raw(handler.wake) };
    // A duplicate: a descriptor can be waited for only once at a time.
    let wake = wake.try_clone_to_owned().ok();
    // SAFETY: an owned descriptor stays open and unchanged for as long as it is watched.
    let wake = wake.and_then(|wake| unsafe { AsyncFd::register_with_interest(wake, Interest::READABLE) }.ok());
    let Some(wake) = wake else { return std::future::pending().await };
    while !happened() {
        let Ok(mut ready) = wake.readable().await else { return std::future::pending().await };
        if !happened() {
            ready.clear_ready();
        }
    }
    error()
}

/// Installs the handler, once for the process.
///
/// # Errors
/// When the system has no descriptor for it.
pub(super) fn install() -> Result<(), BusError> {
    if HANDLER.get().is_some() {
        return Ok(());
    }
    let failed = |error: std::io::Error| BusError::Node(format!("/proc/self/maps: {error}"));
    let maps = std::fs::File::open("/proc/self/maps").map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => BusError::NoProc,
        _ => failed(error),
    })?;
    let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK).map_err(|error| failed(error.into()))?;
    // SAFETY: all zeros is the default action, and the kernel writes the whole struct.
    let before = unsafe {
        let mut before = MaybeUninit::<libc::sigaction>::zeroed();
        libc::sigaction(libc::SIGBUS, ptr::null(), before.as_mut_ptr());
        before.assume_init()
    };
    let (maps_number, wake_number) = (maps.as_raw_fd(), wake.as_raw_fd());
    let made = Handler { maps: maps_number, wake: wake_number, page: space::page(), before };
    if HANDLER.set(made).is_err() {
        return Ok(());
    }
    let _ = (maps.into_raw_fd(), wake.into_raw_fd());
    // SAFETY: the handler does only what a signal handler may; its signature is that of SA_SIGINFO.
    unsafe {
        let mut action = MaybeUninit::<libc::sigaction>::zeroed().assume_init();
        action.sa_sigaction = handle as *const () as usize;
        action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
        libc::sigemptyset(&raw mut action.sa_mask);
        libc::sigaction(libc::SIGBUS, &raw const action, ptr::null_mut());
    }
    Ok(())
}

extern "C" fn handle(signal: c_int, info: *mut siginfo_t, context: *mut c_void) {
    let Some(handler) = HANDLER.get() else { return };
    // SAFETY: the thread's own `errno`, which the interrupted code may be about to read.
    let errno = unsafe { *libc::__errno_location() };
    // SAFETY: the kernel gives a valid `info`.
    let (code, address) = unsafe { ((*info).si_code, (*info).si_addr() as usize) };
    if code == BUS_ADRERR && handler.is_of_the_bus(address) && handler.replace(address) {
        HAPPENED.store(true, Ordering::Relaxed);
        handler.wake();
    } else {
        handler.pass_on(signal, info, context);
    }
    // SAFETY: as above.
    unsafe { *libc::__errno_location() = errno };
}

impl Handler {
    fn wake(&self) {
        let one = 1_u64;
        // SAFETY: eight bytes of this stack frame.
        unsafe { libc::write(self.wake, (&raw const one).cast(), size_of::<u64>()) };
    }

    /// Whether this address is in a mapping of a file in shared memory.
    fn is_of_the_bus(&self, address: usize) -> bool {
        let (mut line, mut length, mut at) = ([0; LINE], 0, 0);
        loop {
            let mut piece = [0_u8; PIECE];
            // SAFETY: `piece` has this many bytes.
            let got = unsafe { libc::pread(self.maps, piece.as_mut_ptr().cast(), PIECE, at) };
            let Some(read) = usize::try_from(got).ok().filter(|read| *read > 0) else { return false };
            at += got as libc::off_t;
            for byte in piece.iter().take(read) {
                if *byte == b'\n' {
                    let line = line.get(..length).unwrap_or_default();
                    if covers(line, address) {
                        note(line);
                        return true;
                    }
                    length = 0;
                } else if let Some(place) = line.get_mut(length) {
                    *place = *byte;
                    length += 1;
                }
            }
        }
    }

    /// Maps a page of this process at `address`.
    fn replace(&self, address: usize) -> bool {
        let page = address & !(self.page - 1);
        let protection = libc::PROT_READ | libc::PROT_WRITE;
        let flags = libc::MAP_FIXED | libc::MAP_ANONYMOUS | libc::MAP_PRIVATE;
        // SAFETY: the page is part of a mapping of shared memory, and no access to it succeeds.
        let mapped = unsafe { libc::mmap(page as *mut c_void, self.page, protection, flags, -1, 0) };
        mapped != libc::MAP_FAILED
    }

    /// Does what would have happened without this handler.
    fn pass_on(&self, signal: c_int, info: *mut siginfo_t, context: *mut c_void) {
        match self.before.sa_sigaction {
            libc::SIG_DFL | libc::SIG_IGN => {
                // The instruction is retried and ends the process.
                // SAFETY: allowed in a handler.
                unsafe { libc::signal(signal, libc::SIG_DFL) };
            }
            handler if self.before.sa_flags & libc::SA_SIGINFO != 0 => {
                // SAFETY: with SA_SIGINFO, it is a function of this signature.
                let handler: extern "C" fn(c_int, *mut siginfo_t, *mut c_void) =
                    unsafe { std::mem::transmute(handler) };
                handler(signal, info, context);
            }
            handler => {
                // SAFETY: without SA_SIGINFO, it is a function of this signature.
                let handler: extern "C" fn(c_int) = unsafe { std::mem::transmute(handler) };
                handler(signal);
            }
        }
    }
}

/// Whether `line` of `/proc/self/maps` is a shared mapping of a file in shared memory that contains `address`.
fn covers(line: &[u8], address: usize) -> bool {
    let mut words = line.split(|byte| *byte == b' ').filter(|word| !word.is_empty());
    let (Some(range), Some(permissions)) = (words.next(), words.next()) else { return false };
    let mut ends = range.split(|byte| *byte == b'-').map(hexadecimal);
    let (Some(Some(first)), Some(Some(end))) = (ends.next(), ends.next()) else { return false };
    let shared = permissions.get(3) == Some(&b's');
    // Offset, device and inode come before the path.
    shared && (first..end).contains(&address) && words.nth(3).is_some_and(|path| path.starts_with(b"/dev/shm/"))
}

/// Stores the path of this line, if it is the first.
fn note(line: &[u8]) {
    let path = line.iter().position(|byte| *byte == b'/').and_then(|at| line.get(at..)).unwrap_or_default();
    if !happened() {
        // The last byte stays zero.
        for (place, byte) in FILE.iter().take(LINE - 1).zip(path) {
            place.store(*byte, Ordering::Relaxed);
        }
    }
}

fn hexadecimal(digits: &[u8]) -> Option<usize> {
    digits.iter().try_fold(0_usize, |sum, digit| {
        let digit = char::from(*digit).to_digit(16)?;
        sum.checked_mul(16)?.checked_add(digit as usize)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_shared_mappings_of_shared_memory_belong_to_the_bus() {
        let line = b"7f0000001000-7f0000003000 rw-s 00000000 00:1b 7     /dev/shm/iox2_a.data (deleted)";
        for (address, covered) in [(0xfff, false), (0x1000, true), (0x2fff, true), (0x3000, false)] {
            assert_eq!(covers(line, 0x7f00_0000_0000 + address), covered, "{address:x}");
        }
        for other in [
            &b"7f0000001000-7f0000003000 rw-p 00000000 00:1b 7     /dev/shm/iox2_a.data"[..],
            b"7f0000001000-7f0000003000 rw-s 00000000 00:1b 7     /dev/video0",
            b"7f0000001000-7f0000003000 rw-s 00000000 00:00 0",
            b"7f0000001000 rw-s",
            b"",
        ] {
            assert!(!covers(other, 0x7f00_0000_1000), "{}", String::from_utf8_lossy(other));
        }
    }
    /// Not a test of its own: touches a page that its file no longer has.
    #[test]
    #[ignore = "run by a_lost_page_of_shared_memory_is_replaced_and_any_other_ends_the_process"]
    fn helper() {
        let path = std::env::var("RAPID_TEST_TOUCH").unwrap();
        install().unwrap();
        let file = std::fs::File::options().read(true).write(true).create(true).truncate(false).open(path).unwrap();
        file.set_len(4096).unwrap();
        // SAFETY: a mapping of its own, accessed within its length.
        unsafe {
            let flags = libc::MAP_SHARED;
            let page =
                libc::mmap(ptr::null_mut(), 4096, libc::PROT_READ | libc::PROT_WRITE, flags, file.as_raw_fd(), 0);
            assert_ne!(page, libc::MAP_FAILED);
            file.set_len(0).unwrap();
            page.cast::<u8>().write_volatile(7);
            assert_eq!(page.cast::<u8>().read_volatile(), 7);
        }
        assert!(happened());
    }

    #[test]
    fn a_lost_page_of_shared_memory_is_replaced_and_any_other_ends_the_process() {
        use std::os::unix::process::ExitStatusExt;
        let number = std::process::id();
        for (path, signal) in [
            (format!("/dev/shm/rapid_test_sigbus_{number}"), None),
            (format!("{}/rapid_test_sigbus_{number}", std::env::temp_dir().display()), Some(libc::SIGBUS)),
        ] {
            let ended = std::process::Command::new(std::env::current_exe().unwrap())
                .args(["--exact", "sigbus::tests::helper", "--ignored"])
                .env("RAPID_TEST_TOUCH", &path)
                .output()
                .unwrap();
            std::fs::remove_file(&path).unwrap();
            assert_eq!(
                (ended.status.signal(), ended.status.success()),
                (signal, signal.is_none()),
                "{path}: {ended:?}"
            );
        }
    }
}
