//! The system's loader: libraries by name or out of memory, and what is missing when one cannot be loaded.
//!
//! onnxruntime needs the C++ library. The machine's own is taken where there is one, so that its updates count; else
//! that which the program carries, packed by `build.rs`. glibc knows a loaded library by its name inside the file
//! (`DT_SONAME`), so that onnxruntime finds it under any name.
//!
//! Invariant: what is loaded here stays loaded.

use std::ffi::CStr;
use std::fs::File;
use std::io;
use std::os::fd::IntoRawFd as _;

use rustix::fs::{MemfdFlags, memfd_create};
use rustix::io::Errno;

use super::Cause;

/// The packed C++ library; empty in a build without.
static LIBSTDCXX: &[u8] = include_bytes!(env!("RAPID_LIBSTDCXX"));
const LIBSTDCXX_NAME: &CStr = c"libstdc++.so.6";
/// Begins the name of a library that was unpacked into memory.
const MEMORY: &str = "/proc/self/fd/";

/// Debian's packages, by the beginning of a library's name. Ubuntu's are called the same.
const PACKAGES: [(&str, &str); 8] = [
    ("libstdc++.so.", "libstdc++6"),
    ("libgcc_s.so.", "libgcc-s1"),
    ("libc.so.", "libc6"),
    ("libm.so.", "libc6"),
    ("libdl.so.", "libc6"),
    ("librt.so.", "libc6"),
    ("libpthread.so.", "libc6"),
    ("ld-linux", "libc6"),
];

pub(super) fn load_libstdcxx() -> Result<(), Cause> {
    load_one_of(LIBSTDCXX_NAME, LIBSTDCXX)
}

/// The library `name` of the machine, or if that cannot be loaded the packed one.
fn load_one_of(name: &CStr, packed: &[u8]) -> Result<(), Cause> {
    let load = |path: &CStr| load(path, libc::RTLD_NOW | libc::RTLD_GLOBAL);
    let Err(missing) = load(name) else { return Ok(()) };
    if packed.is_empty() {
        return Err(missing);
    }
    let memory = unpack(c"libstdc++.so", packed).map_err(Cause::Memory)?;
    // Never closed: the loader knows what it has loaded by this name too, and would take the next memory with the
    // same number for it.
    let path = format!("{MEMORY}{}\0", memory.into_raw_fd());
    // No NUL but the last is in it.
    CStr::from_bytes_with_nul(path.as_bytes()).map_or(Err(missing), load)
}

/// Loads onnxruntime as `ort` does it after this, with the reason when that cannot be done.
pub(super) fn load_onnxruntime(path: &CStr) -> Result<(), Cause> {
    load(path, libc::RTLD_LAZY | libc::RTLD_LOCAL)
}

/// Loads a library, by its path or by its name alone.
fn load(path: &CStr, flags: libc::c_int) -> Result<(), Cause> {
    // SAFETY: the path ends with NUL. What runs at loading is the code of a library that was named for this or is
    // part of the system, as for any library that the program is linked with. The handle is not closed.
    let handle = unsafe { libc::dlopen(path.as_ptr(), flags) };
    if !handle.is_null() {
        return Ok(());
    }
    // SAFETY: dlerror(3) has no arguments; what it gives is null, or text of this thread up to its next call.
    let text = unsafe {
        let text = libc::dlerror();
        if text.is_null() { c"without a reason" } else { CStr::from_ptr(text) }
    };
    Err(cause(&text.to_string_lossy()))
}

/// What the loader's text means.
fn cause(text: &str) -> Cause {
    let Some((library, _)) = text.split_once(": cannot open shared object file") else {
        return Cause::Unloadable(text.to_owned());
    };
    if library.starts_with(MEMORY) {
        return Cause::Memory(io::Error::other("/proc is not mounted"));
    }
    let package = PACKAGES.iter().find(|(name, _)| library.starts_with(name)).map(|(_, package)| *package);
    Cause::Needs { library: library.to_owned(), package }
}

/// Memory with a descriptor, and the library in it.
pub(super) fn unpack(name: &CStr, packed: &[u8]) -> io::Result<File> {
    // Sealed against being run as a program, which it is not: a kernel that allows no programs in
    // such memory (sysctl vm.memfd_noexec) still allows this. Kernels before 6.3 know neither.
    let memory = match memfd_create(name, MemfdFlags::CLOEXEC | MemfdFlags::NOEXEC_SEAL) {
        Err(Errno::INVAL) => memfd_create(name, MemfdFlags::CLOEXEC),
        other => other,
    }?;
    let mut memory = File::from(memory);
    zstd::stream::copy_decode(packed, &mut memory)?;
    Ok(memory)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_library_is_named_with_its_package() {
        let shown = |text: &str| cause(text).to_string();
        let none = ": cannot open shared object file: No such file or directory";
        assert_eq!(
            shown(&format!("libstdc++.so.6{none}")),
            "it needs libstdc++.so.6, which this machine does not have: apt install libstdc++6 on Debian and Ubuntu"
        );
        assert_eq!(
            shown(&format!("libcudart.so.12{none}")),
            "it needs libcudart.so.12, which this machine does not have"
        );
        assert!(shown(&format!("/proc/self/fd/9{none}")).contains("/proc is not mounted"));
        assert_eq!(shown("x.so: invalid ELF header"), "it cannot be loaded: x.so: invalid ELF header");
    }

    #[test]
    fn the_packed_library_is_loaded_where_the_machine_has_none() {
        assert!(!LIBSTDCXX.is_empty(), "built on a machine without libstdc++.so.6");
        load_one_of(c"librapid-has-no-such.so.6", LIBSTDCXX).unwrap();
        let missing = load_one_of(c"librapid-has-no-such.so.6", &[]).unwrap_err();
        assert!(missing.to_string().contains("it needs librapid-has-no-such.so.6"), "{missing}");
    }
}
