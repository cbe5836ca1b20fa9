//! Why the bus cannot be used: the cause behind the error that iceoryx2 reports, with its fix.
//!
//! iceoryx2 0.10 reports most system failures as `InternalError`. The missing resource is found by inspecting the
//! system.

use std::fmt::Debug;
use std::path::PathBuf;

use rapid_core::text;
use rapid_registry::MAX_SUBSCRIBERS;
use rustix::process::{Resource, getrlimit};

use super::space;
use super::stale_files::Files;

/// With fewer free descriptors than this, the failure is attributed to their limit: iceoryx2 closes the descriptors of
/// the failed step before it returns.
const SPARE_DESCRIPTORS: u64 = 16;
/// The same in bytes of address space.
const SPARE_ADDRESSES: u64 = 64 << 20;

/// Why the bus cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// A topic could not be opened.
    #[error("topic {topic}: {reason}")]
    Topic {
        /// The topic.
        topic: String,
        /// What iceoryx2 reports.
        reason: String,
    },
    /// The topic has its maximum number of subscribers.
    #[error("topic {topic}: {MAX_SUBSCRIBERS} programs subscribe already, and no more may; end one")]
    Full {
        /// The topic.
        topic: String,
    },
    /// The bus's files belong to another user.
    #[error(
        "shared-memory bus: {}: {what}; end the programs that use it and remove it (`sudo rm -r {}`), or run rapid as \
         that user", path.display(), path.display()
    )]
    Foreign {
        /// Folder or file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// A file of the bus is damaged, and may be in use.
    #[error(
        "shared-memory bus: {}: {what}; end the programs that use the bus and remove it: rm -r {}",
        path.display(), path.display()
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// The file system of shared memory has too little space.
    #[error(
        "{}: {} free of {}, and {} are needed; enlarge it (`sudo mount -o remount,size={}M {}`), remove what fills it, \
         or lower memory_budget under [rig]",
        space::PLACE, text::size(*free), text::size(*size), text::size(*need), space::mebibytes(*size, *free, *need),
        space::PLACE
    )]
    Room {
        /// Bytes that are needed.
        need: u64,
        /// Bytes that are free.
        free: u64,
        /// Bytes of the file system.
        size: u64,
    },
    /// There is no shared memory, or it cannot be used.
    #[error("{}: {what}; {fix}", space::PLACE)]
    Memory {
        /// What is wrong with it.
        what: String,
        /// What to do.
        fix: &'static str,
    },
    /// `/proc` cannot be read.
    #[error("/proc: it is not mounted, and rapid needs it; mount it: sudo mount -t proc proc /proc")]
    NoProc,
    /// The file size limit of the process is too low.
    #[error(
        "{}: files are limited to {}, and a segment of shared memory is larger; raise the limit (`ulimit -f \
         unlimited`, or LimitFSIZE=infinity in the unit)", space::PLACE, text::size(*limit)
    )]
    FileSize {
        /// The limit in bytes.
        limit: u64,
    },
    /// The process may open no more files.
    #[error(
        "shared-memory bus: the limit of {limit} open files is reached; raise it (`ulimit -n 4096`, or LimitNOFILE= in \
         the unit)"
    )]
    Descriptors {
        /// The limit.
        limit: u64,
    },
    /// The process may map no more memory.
    #[error(
        "shared-memory bus: the address space is limited to {}, of which {} are in use and {} more are needed; raise \
         the limit (`ulimit -v unlimited`, or LimitAS= in the unit)", text::size(*limit), text::size(*used),
        text::size(*need)
    )]
    AddressSpace {
        /// The limit in bytes.
        limit: u64,
        /// Bytes in use.
        used: u64,
        /// Bytes that are needed besides.
        need: u64,
    },
    /// The node could not be created.
    #[error("shared-memory bus: {0}")]
    Node(String),
    /// A sample is larger than the topic allows.
    #[error("a sample of {size} bytes does not fit topic {topic} (at most {max}); raise max_bytes of the device")]
    TooLarge {
        /// The topic.
        topic: String,
        /// Bytes of the sample.
        size: usize,
        /// Bytes allowed.
        max: usize,
    },
    /// A sample could not be sent or received.
    #[error("topic {topic}: {reason}")]
    Transfer {
        /// The topic.
        topic: String,
        /// What iceoryx2 reports.
        reason: String,
    },
}

/// The error of a topic of which iceoryx2 reports `error`.
pub(super) fn topic_error(topic: &str, error: &dyn Debug) -> BusError {
    let reported = format!("{error:?}");
    lacking().unwrap_or_else(|| BusError::Topic { topic: topic.to_owned(), reason: explained(&reported) })
}

/// Replaces `error` with the damaged file that may have caused it, unless it reports a missing resource.
pub(super) fn or_damage(error: BusError, files: &Files) -> BusError {
    match error {
        BusError::Topic { .. } | BusError::Node(_) => files.unreadable().unwrap_or(error),
        other => other,
    }
}

/// The resource that the system lacks, if any.
pub(super) fn lacking() -> Option<BusError> {
    space::lacking().or_else(descriptors).or_else(|| addresses(SPARE_ADDRESSES).err())
}

fn descriptors() -> Option<BusError> {
    let limit = getrlimit(Resource::Nofile).current?;
    let exhausted = match std::fs::read_dir("/proc/self/fd") {
        Ok(open) => open.count() as u64 + SPARE_DESCRIPTORS > limit,
        Err(error) => error.raw_os_error() == Some(rustix::io::Errno::MFILE.raw_os_error()),
    };
    exhausted.then_some(BusError::Descriptors { limit })
}

/// Fails if fewer than `need` bytes of address space are left.
pub(super) fn addresses(need: u64) -> Result<(), BusError> {
    let Some(limit) = getrlimit(Resource::As).current else { return Ok(()) };
    // See proc(5): the first number is the size in pages.
    let sizes = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages: u64 = sizes.split(' ').next().and_then(|pages| pages.parse().ok()).unwrap_or(0);
    let used = pages.saturating_mul(space::page() as u64);
    if used.saturating_add(need) > limit { Err(BusError::AddressSpace { limit, used, need }) } else { Ok(()) }
}

/// What iceoryx2 reports, with cause and fix where they are known.
fn explained(reported: &str) -> String {
    /// Parts of the names of iceoryx2's errors.
    const CAUSES: [(&[&str], &str); 4] = [
        (
            &["Incompatible", "DoesNotSupportRequested", "VersionMismatch"],
            "a program of another version, or with another devices.toml, still uses it: end that program",
        ),
        (&["ExceedsMaxSupported", "ExceedsMaxNumberOf"], "too many programs use it: end one"),
        (
            &["HangsInCreation", "Corrupted"],
            "a file of it is missing or damaged: end the programs that use the bus, and begin again",
        ),
        (&["InsufficientPermissions", "PermissionDenied"], "another user's program uses it: end that program"),
    ];
    let cause = CAUSES.iter().find(|(names, _)| names.iter().any(|name| reported.contains(name)));
    cause.map_or_else(|| reported.to_owned(), |(_, cause)| format!("{cause} ({reported})"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_is_named_only_where_it_is_known() {
        for (reported, cause) in [
            ("PublishSubscribeOpenError(IncompatibleTypes)", "another version"),
            ("PublishSubscribeOpenError(DoesNotSupportRequestedMinBufferSize)", "another version"),
            ("EventOpenError(ExceedsMaxNumberOfNodes)", "too many programs"),
            ("PublishSubscribeOpenError(ServiceInCorruptedState)", "missing or damaged"),
        ] {
            let reason = explained(reported);
            assert!(reason.contains(cause) && reason.contains(reported), "{reason}");
        }
        assert_eq!(explained("UnableToCreateDataSegment"), "UnableToCreateDataSegment");
    }
}
