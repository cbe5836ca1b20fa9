//! The files of a bus: which exist, which are in use, and their removal.
//!
//! iceoryx2 0.10 keeps a bus in `/dev/shm` and in a folder of its own. It releases the resources of a killed process
//! node by node, reading the files of both: a damaged file stays for ever, makes every start fail, or blocks it for
//! ever. Here no file is read before removal: its name shows its owner, and a lock whether that process lives.
//!
//! Names, below a prefix that ends in `_`: `<hash>_<port>.data`, `<hash>_<sender>_<receiver>.connection`,
//! `<hash>_<port>.event_mgmt` and `<hash>_<service>.dynamic` in `/dev/shm`; `<port>.event`,
//! `services/<hash>.service`, `nodes/<node>.node_monitor*` and `nodes/<node>/*` in the folder. A hash has 40
//! digits; nodes and ports are numbers with the process id in their third 32 bits.
//!
//! Invariant: no file is removed that a living process may use. A file is unused when its name refers only to processes
//! without a node, or when the bus has no node at all.
//! Invariant: a lock file of this process is never opened: closing it would give up the lock.

use std::collections::BTreeSet;
use std::fs::{File, FileType, Metadata, Permissions};
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::fs::{Mode, OFlags};
use rustix::process::{Flock, FlockType, fcntl_getlk};
use rustix::time::{ClockId, clock_gettime};

use super::{BusError, space};

/// The first 8 bytes of each file of iceoryx2 0.10.0 in shared memory: major, minor and patch, 16 bits each.
const VERSION: u64 = 10 << 16;
/// Suffix of the name of the segment in which iceoryx2 0.10.0 counts nodes: version and number, 16 bytes. The hash is
/// that of its type's name.
const COUNTER: &str = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt";
/// A key of every service's file.
const SERVICE_KEY: &str = "messaging_pattern";
/// Interval of checks whether a file has been filled.
const LOOK: Duration = Duration::from_millis(20);
/// A process has files in the folder of its node after this time, in seconds. Until then the folder may belong to one in
/// another namespace of process ids, which looks dead from here.
const FILLED_WITHIN: u64 = 10;
/// Permissions of group and others.
const OTHERS: u32 = 0o077;

/// The files of one bus.
#[derive(Debug, Clone)]
pub(super) struct Files {
    prefix: String,
    root: PathBuf,
}

/// The purpose of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Use {
    /// Ports of the processes with these ids.
    Ports(Vec<u32>),
    /// The node with this number.
    Node(u128),
    /// The bus as a whole.
    Common,
}

#[derive(Debug)]
struct Entry {
    path: PathBuf,
    used: Use,
}

impl Files {
    pub(super) const fn new(prefix: String, root: PathBuf) -> Self {
        Self { prefix, root }
    }

    /// Removes files that no process uses, and restricts the permissions of the rest. Waits up to `patience` in total
    /// for files that other processes have created but not filled.
    ///
    /// # Errors
    /// When an unused file cannot be removed, or a damaged file may be in use.
    pub(super) fn clear(&self, patience: Duration) -> Result<(), BusError> {
        let until = Instant::now() + patience;
        // First the files, then the processes: a process that starts meanwhile has created none of these files.
        let entries = self.entries();
        let living = self.living(&entries);
        for Entry { path, used } in entries {
            let dead = living.is_empty()
                || matches!(&used, Use::Ports(owners) if !owners.iter().any(|owner| living.contains(owner)));
            match std::fs::symlink_metadata(&path) {
                Ok(there) if !is_ours(&there) => {}
                Ok(there) if dead => remove(&path, &there)?,
                Ok(there) => {
                    narrow(&path, &there);
                    usable(&path, &used, until)?;
                }
                Err(_) => {}
            }
        }
        Ok(())
    }

    /// Creates the file in which other programs count their nodes, for its owner alone: if they created it, everybody
    /// could write to it. They work without it if it cannot be created.
    pub(super) fn make_counter(&self) {
        let path = Path::new(space::PLACE).join(format!("{}{COUNTER}", self.prefix));
        // A process that finds the file with this mode waits.
        let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let Ok(file) = rustix::fs::open(&path, flags, Mode::WUSR).map(File::from) else { return };
        let mut content = [0; 16];
        content[..8].copy_from_slice(&VERSION.to_le_bytes());
        let made = (&file).write_all(&content).and_then(|()| file.set_permissions(Permissions::from_mode(0o600)));
        if made.is_err() {
            let _ = std::fs::remove_file(&path);
        }
    }

    /// A file that iceoryx2 cannot read, if there is one.
    pub(super) fn unreadable(&self) -> Option<BusError> {
        self.entries().into_iter().find_map(|Entry { path, used }| {
            let suffix = path.extension().and_then(|suffix| suffix.to_str());
            let kind = std::fs::symlink_metadata(&path).ok()?.file_type();
            if !is_kind_of(&used, suffix, kind) {
                return Some(strange(path));
            }
            let what = match suffix? {
                "data" | "connection" | "dynamic" | "event_mgmt" => {
                    let is_whole = head(&path)?.first_chunk().copied().is_some_and(is_head);
                    (!is_whole).then_some("another version of iceoryx2 made it, or it is damaged")
                }
                "service" => {
                    let readable = String::from_utf8(head(&path)?).is_ok_and(|text| text.contains(SERVICE_KEY));
                    (!readable).then_some("it is damaged")
                }
                _ => None,
            };
            Some(BusError::Damaged { what: what?.to_owned(), path })
        })
    }

    /// Removes what dead processes left of other buses. A bus with no node in our folder may have its nodes elsewhere.
    pub(super) fn clear_others(&self) {
        let monitors = std::fs::read_dir(self.root.join("nodes")).into_iter().flatten().flatten();
        let prefixes = monitors.filter_map(|entry| prefix_of(entry.file_name().to_str()?).map(str::to_owned));
        for prefix in prefixes.filter(|prefix| *prefix != self.prefix).collect::<BTreeSet<_>>() {
            let other = Self { prefix, root: self.root.clone() };
            // First the files, then the live processes, as above.
            let entries = other.entries();
            if !other.living(&entries).is_empty() {
                continue;
            }
            for Entry { path, .. } in entries {
                if let Some(there) = std::fs::symlink_metadata(&path).ok().filter(is_ours) {
                    // That instance's next start reports what cannot be removed.
                    let _ = remove(&path, &there);
                }
            }
        }
        self.clear_empty();
    }

    /// Removes the empty folders of nodes of dead processes, of whichever bus: one was killed when it had just made its
    /// folder, or had emptied it.
    fn clear_empty(&self) {
        let abandoned = |name: &str| number(name).filter(|node| is_abandoned(*node)).map(Use::Node);
        for Entry { path, .. } in list(&self.root.join("nodes"), abandoned) {
            // Refused if it is not empty or not ours.
            let _ = std::fs::remove_dir(path);
        }
    }

    fn entries(&self) -> Vec<Entry> {
        let nodes = self.root.join("nodes");
        let in_memory = list(Path::new(space::PLACE), |name| in_memory(name.strip_prefix(&self.prefix)?));
        let sockets = list(&self.root, |name| socket(name.strip_prefix(&self.prefix)?));
        let services = list(&self.root.join("services"), |name| {
            let hash = name.strip_prefix(&self.prefix)?.strip_suffix(".service")?;
            is_hash(hash).then_some(Use::Common)
        });
        let monitors = list(&nodes, |name| monitor(name.strip_prefix(&self.prefix)?));
        let known: BTreeSet<u128> = monitors.iter().filter_map(Entry::node).collect();
        let folders = list(&nodes, |name| {
            let node = number(name)?;
            (known.contains(&node) || self.is_our_folder(&nodes.join(name))).then_some(Use::Node(node))
        });
        [in_memory, sockets, services, monitors, folders].into_iter().flatten().collect()
    }

    /// Whether all files of a node in this folder belong to this bus. Folders carry no prefix.
    fn is_our_folder(&self, folder: &Path) -> bool {
        let ours = |name: &str| {
            let rest = name.strip_prefix(&self.prefix)?;
            let (stem, _) = rest.split_once('.')?;
            (stem == "node" || is_hash(stem) || number(stem).is_some()).then_some(())
        };
        let Ok(files) = std::fs::read_dir(folder) else { return false };
        let mut names = files.flatten().map(|file| file.file_name()).peekable();
        names.peek().is_some() && names.all(|name| name.to_str().and_then(ours).is_some())
    }

    /// Processes with a node on this bus.
    fn living(&self, entries: &[Entry]) -> BTreeSet<u32> {
        let nodes: BTreeSet<u128> = entries.iter().filter_map(Entry::node).collect();
        nodes.into_iter().filter(|node| self.lives(*node)).map(process).collect()
    }

    fn lives(&self, node: u128) -> bool {
        let nodes = self.root.join("nodes");
        let lock = nodes.join(format!("{}{node}.node_monitor", self.prefix));
        if process(node) == std::process::id() {
            return std::fs::symlink_metadata(&lock).is_ok_and(|lock| is_locked_by_us(lock.ino()));
        }
        let flags = OFlags::RDWR | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
        let asked = Flock::from(FlockType::WriteLock);
        let locked = rustix::fs::open(&lock, flags, Mode::empty()).is_ok_and(|lock| {
            // Its holder may be in another namespace of process ids.
            matches!(fcntl_getlk(lock, &asked), Ok(Some(_)))
        });
        // A process that is starting has not locked yet; in other cases the lock may have been replaced.
        locked || has_lived_since(node)
    }
}

impl Entry {
    const fn node(&self) -> Option<u128> {
        match self.used {
            Use::Node(node) => Some(node),
            Use::Ports(_) | Use::Common => None,
        }
    }
}

fn list(folder: &Path, used: impl Fn(&str) -> Option<Use>) -> Vec<Entry> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| Some(Entry { used: used(entry.file_name().to_str()?)?, path: entry.path() })).collect()
}

fn in_memory(name: &str) -> Option<Use> {
    let (_, rest) = name.split_once('_').filter(|(hash, _)| is_hash(hash))?;
    let (ports, suffix) = rest.split_once('.')?;
    // A segment that grows has a number after its port's number.
    let owners: Vec<u32> = ports.split('_').filter_map(number).map(process).collect();
    let of_ports = matches!(suffix, "data" | "connection" | "event_mgmt") && !owners.is_empty();
    Some(if of_ports { Use::Ports(owners) } else { Use::Common })
}

fn socket(name: &str) -> Option<Use> {
    Some(Use::Ports(vec![process(number(name.strip_suffix(".event")?)?)]))
}

fn monitor(name: &str) -> Option<Use> {
    let (node, suffix) = name.split_once('.')?;
    suffix.starts_with("node_monitor").then_some(Use::Node(number(node)?))
}

/// The prefix of the bus to which this node file belongs.
fn prefix_of(name: &str) -> Option<&str> {
    let (node, _) = name.split_once(".node_monitor")?;
    let at = node.rfind('_')? + 1;
    number(node.get(at..)?)?;
    node.get(..at).filter(|prefix| prefix.starts_with("iox2_"))
}

fn is_hash(text: &str) -> bool {
    text.len() == 40 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// The number of a node or port: it contains at least the process id.
fn number(text: &str) -> Option<u128> {
    text.parse().ok().filter(|number| process(*number) != 0)
}

/// The process id in a node or port number, see `UniqueSystemId` of iceoryx2.
#[expect(clippy::cast_possible_truncation, reason = "the third 32 bits")]
const fn process(number: u128) -> u32 {
    (number >> 64) as u32
}

/// Whether the process that created this node lives. A later process with the same id started after the node's creation
/// time, which is in the lowest 32 bits, in seconds of `CLOCK_MONOTONIC`.
fn has_lived_since(node: u128) -> bool {
    let Some(begun) = begin(process(node)) else { return false };
    // A process's start time includes the time that the machine was suspended.
    let suspended = seconds(ClockId::Boottime).saturating_sub(seconds(ClockId::Monotonic));
    begun <= created(node) + suspended
}

/// Whether the process that created this node is dead, in whichever namespace it was: see [`FILLED_WITHIN`].
fn is_abandoned(node: u128) -> bool {
    // One of the future was created before the machine was started.
    let age = seconds(ClockId::Monotonic).checked_sub(created(node));
    !has_lived_since(node) && age.is_none_or(|age| age > FILLED_WITHIN)
}

#[expect(clippy::cast_possible_truncation, reason = "the lowest 32 bits")]
fn created(node: u128) -> u64 {
    u64::from(node as u32)
}

fn seconds(clock: ClockId) -> u64 {
    clock_gettime(clock).tv_sec.unsigned_abs()
}

/// Start time of a process in seconds since the machine was booted, see proc(5).
fn begin(process: u32) -> Option<u64> {
    let about = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The name, in brackets, may contain anything.
    let ticks: u64 = about.rsplit_once(')')?.1.split_whitespace().nth(19)?.parse().ok()?;
    // SAFETY: returns a number.
    let a_second = unsafe { libc::sysconf(libc::_SC_CLK_TCK) };
    ticks.checked_div(u64::try_from(a_second).ok()?)
}

/// Whether this process holds a lock of the file with this inode number, as listed in proc(5). True if unknown.
fn is_locked_by_us(inode: u64) -> bool {
    let Ok(locks) = std::fs::read_to_string("/proc/locks") else { return true };
    let (process, file) = (std::process::id().to_string(), format!(":{inode}"));
    locks.lines().any(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        words.get(4) == Some(&process.as_str()) && words.get(5).is_some_and(|place| place.ends_with(&file))
    })
}

fn is_ours(there: &Metadata) -> bool {
    there.uid() == rustix::process::geteuid().as_raw()
}

fn remove(path: &Path, there: &Metadata) -> Result<(), BusError> {
    let removed = if there.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    match removed {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            let what = format!("an earlier run left it, and it cannot be removed: {error}");
            Err(BusError::Damaged { path: path.to_owned(), what })
        }
        _ => Ok(()),
    }
}

/// iceoryx2 creates some files writable by everybody.
fn narrow(path: &Path, there: &Metadata) {
    let mode = there.permissions().mode();
    if there.is_file() && mode & OTHERS != 0 {
        let _ = std::fs::set_permissions(path, Permissions::from_mode(mode & !OTHERS));
    }
}

/// Fails where iceoryx2 would wait without end: the file is not of the expected kind, or stays empty.
fn usable(path: &Path, used: &Use, until: Instant) -> Result<(), BusError> {
    let suffix = path.extension().and_then(|suffix| suffix.to_str());
    let may_be_empty = matches!(used, Use::Node(_)) || suffix == Some("event");
    loop {
        let Ok(there) = std::fs::symlink_metadata(path) else { return Ok(()) };
        let kind = there.file_type();
        if !is_kind_of(used, suffix, kind) {
            return Err(strange(path.to_owned()));
        }
        if kind.is_dir() {
            let mut files = std::fs::read_dir(path).into_iter().flatten().flatten();
            let other = files.find(|file| file.file_type().is_ok_and(|kind| !kind.is_file()));
            return other.map_or(Ok(()), |other| Err(strange(other.path())));
        }
        if may_be_empty || there.len() > 0 {
            return Ok(());
        }
        if Instant::now() >= until {
            return Err(BusError::Damaged { path: path.to_owned(), what: "it is empty".to_owned() });
        }
        std::thread::sleep(LOOK);
    }
}

/// Whether a file of this use and suffix has the kind that iceoryx2 creates.
fn is_kind_of(used: &Use, suffix: Option<&str>, kind: FileType) -> bool {
    match (used, suffix) {
        (Use::Node(_), None) => kind.is_dir(),
        (_, Some("event")) => kind.is_socket(),
        _ => kind.is_file(),
    }
}

fn strange(path: PathBuf) -> BusError {
    BusError::Damaged { path, what: "it is no file of iceoryx2".to_owned() }
}

/// Whether these are the first bytes of a file in shared memory.
fn is_head(bytes: [u8; 8]) -> bool {
    u64::from_le_bytes(bytes) == VERSION
}

/// The first bytes of a file, if it may be read.
fn head(path: &Path) -> Option<Vec<u8>> {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
    let file = File::from(rustix::fs::open(path, flags, Mode::empty()).ok()?);
    let mut bytes = Vec::new();
    file.take(1 << 16).read_to_end(&mut bytes).ok()?;
    Some(bytes)
}

#[cfg(test)]
mod tests;
