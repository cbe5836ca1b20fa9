//! The programs a guest runs: found on the host, stripped, and placed where the guest can run them.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use thiserror::Error;

use crate::guest::Image;

/// Why a program cannot be given to the guest.
#[derive(Debug, Error)]
pub enum ProgramError {
    /// It has not been built.
    #[error("no `{name}` binary ({tried}): run `make setup` and build it, or name it in {variable}")]
    Missing {
        /// Its name.
        name: &'static str,
        /// Where it was searched for.
        tried: String,
        /// The variable that overrides the search.
        variable: &'static str,
    },
    /// It or a library it needs could not be copied.
    #[error("copying {0}: {1}")]
    Copy(PathBuf, #[source] io::Error),
    /// Its libraries could not be listed.
    #[error("ldd {0}: {1}")]
    Libraries(PathBuf, String),
}

/// The `rapid` under test: `RAPID_BIN`, else the newer of the workspace's release and debug builds.
pub fn rapid() -> Result<PathBuf, ProgramError> {
    find("rapid", "RAPID_BIN", built("rapid"))
}

/// An example: in `RAPID_EXAMPLES`, else the newer of the workspace's builds.
pub fn example(name: &'static str) -> Result<PathBuf, ProgramError> {
    let folder = std::env::var_os("RAPID_EXAMPLES").map(|folder| PathBuf::from(folder).join(name));
    newest(name, "RAPID_EXAMPLES", folder.map_or_else(|| built(&format!("examples/{name}")), |path| vec![path]))
}

/// Where the workspace's builds of a program may be.
fn built(program: &str) -> Vec<PathBuf> {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap_or(Path::new("."));
    let mut places = vec![workspace.join("target")];
    places.extend(std::env::var_os("CARGO_TARGET_DIR").map(PathBuf::from));
    places.iter().flat_map(|target| ["release", "debug"].map(|profile| target.join(profile).join(program))).collect()
}

/// This crate's own emulator: `USBEMU_BIN`, else beside the running test or tool.
pub fn usbemu() -> Result<PathBuf, ProgramError> {
    let here = std::env::current_exe().unwrap_or_default();
    let candidates = here.ancestors().skip(1).take(2).map(|folder| folder.join("usbemu")).collect();
    find("usbemu", "USBEMU_BIN", candidates)
}

fn find(name: &'static str, variable: &'static str, candidates: Vec<PathBuf>) -> Result<PathBuf, ProgramError> {
    newest(name, variable, std::env::var_os(variable).map_or(candidates, |path| vec![path.into()]))
}

fn newest(name: &'static str, variable: &'static str, candidates: Vec<PathBuf>) -> Result<PathBuf, ProgramError> {
    let changed = |path: &PathBuf| fs::metadata(path).and_then(|meta| meta.modified()).ok();
    let newest = candidates.iter().filter(|path| path.is_file()).max_by_key(|path| changed(path));
    newest.cloned().ok_or_else(|| {
        let tried: Vec<String> = candidates.iter().map(|path| path.display().to_string()).collect();
        ProgramError::Missing { name, tried: tried.join(", "), variable }
    })
}

/// Copies `program` into `share` (`/tmp/bench` in the guest) and returns the command that runs it there.
///
/// If host and guest are the same Debian release, the guest's own libraries are used. Otherwise the host's are copied
/// and its loader is used, because a binary built against a newer glibc does not start on an older one.
pub fn install(program: &Path, share: &Path, guest: &Image) -> Result<Vec<String>, ProgramError> {
    let name = program.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let target = share.join("bin").join(&name);
    let placed = fs::create_dir_all(target.parent().unwrap_or(&target));
    let placed =
        placed.and_then(|()| if guest.is_virtual() { link(program, &target) } else { strip(program, &target) });
    placed.map_err(|error| ProgramError::Copy(program.into(), error))?;
    let inside = format!("/tmp/bench/bin/{name}");
    if host_suite().as_deref() == Some(guest.suite()) {
        return Ok(vec![inside]);
    }
    let loader = copy_libraries(program, &share.join("lib"))?;
    Ok(vec![format!("/tmp/bench/lib/{loader}"), "--library-path".into(), "/tmp/bench/lib".into(), inside])
}

/// For a guest that reads of a program what it uses.
fn link(program: &Path, target: &Path) -> io::Result<()> {
    // Not on another file system.
    fs::hard_link(program, target).or_else(|_| fs::copy(program, target).map(drop))
}

/// For a guest that keeps programs in memory, where debug information would cost start-up time, too. Without `strip` the program is
/// copied unchanged.
fn strip(program: &Path, target: &Path) -> io::Result<()> {
    let stripped = Command::new("strip").arg("-o").arg(target).arg(program).status();
    if stripped.is_ok_and(|status| status.success()) { Ok(()) } else { fs::copy(program, target).map(drop) }
}

fn host_suite() -> Option<String> {
    codename(&fs::read_to_string("/etc/os-release").ok()?)
}

/// Debian's codename in an os-release file; `None` on another distribution.
fn codename(os_release: &str) -> Option<String> {
    let value = |key: &str| {
        os_release
            .lines()
            .find_map(|line| line.strip_prefix(key)?.strip_prefix('='))
            .map(|value| value.trim_matches('"'))
    };
    (value("ID") == Some("debian")).then(|| value("VERSION_CODENAME").map(str::to_owned)).flatten()
}

fn copy_libraries(program: &Path, folder: &Path) -> Result<String, ProgramError> {
    let failed = |why: String| ProgramError::Libraries(program.into(), why);
    let listed = Command::new("ldd").arg(program).output().map_err(|error| failed(error.to_string()))?;
    let text = String::from_utf8_lossy(&listed.stdout);
    let files = libraries(&text);
    fs::create_dir_all(folder).map_err(|error| ProgramError::Copy(folder.into(), error))?;
    for file in &files {
        let name = Path::new(file).file_name().unwrap_or_default();
        fs::copy(file, folder.join(name)).map_err(|error| ProgramError::Copy(file.into(), error))?;
    }
    let loader = files.iter().filter_map(|file| file.rsplit('/').next()).find(|name| name.starts_with("ld-linux"));
    loader.map(str::to_owned).ok_or_else(|| failed(format!("names no loader: {}", text.trim())))
}

/// The files in ldd's output: `name => /path (address)` and, for the loader, `/path (address)`.
fn libraries(ldd: &str) -> Vec<&str> {
    ldd.lines()
        .filter_map(|line| {
            let right = line.split_once("=>").map_or(line, |(_, right)| right);
            right.split_whitespace().next().filter(|word| word.starts_with('/'))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_debian_has_a_codename() {
        assert_eq!(codename("ID=debian\nVERSION_CODENAME=bookworm\n").as_deref(), Some("bookworm"));
        assert_eq!(codename("ID=\"ubuntu\"\nVERSION_CODENAME=noble\n"), None);
    }

    #[test]
    fn ldd_lines_are_read() {
        let text = "\tlinux-vdso.so.1 (0x7ffd)\n\tlibc.so.6 => /lib/x86_64-linux-gnu/libc.so.6 (0x7f)\n\t/lib64/ld-linux-x86-64.so.2 (0x7f)\n";
        assert_eq!(libraries(text), ["/lib/x86_64-linux-gnu/libc.so.6", "/lib64/ld-linux-x86-64.so.2"]);
    }
}
