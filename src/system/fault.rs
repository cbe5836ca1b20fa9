//! Injected faults: how a test of the binary examines the effects of a panic.
//!
//! `RAPID_FAULT=PLACE:FILE` makes the thread or task PLACE panic as soon as FILE exists. `RAPID_FAULT=disk:FILE` lets no
//! change of a folder succeed while FILE exists, as on a full disk; a test in the process itself says which
//! ([`fail_changes`]).
//!
//! Invariant: there are no faults in a release build: all of this needs debug assertions.

#[cfg(debug_assertions)]
mod order {
    use std::io;
    use std::path::{Path, PathBuf};
    use std::sync::{LazyLock, Mutex, PoisonError};

    /// A folder, how many changes of it succeed from now on, and how many fail after those.
    pub(super) type Failing = (PathBuf, u64, u64);

    static FAILING: Mutex<Vec<Failing>> = Mutex::new(Vec::new());

    /// Which changes of a folder fail; instead of what was said about it before, of which this is left.
    pub(super) fn fail(failing: Failing) -> (u64, u64) {
        let mut all = FAILING.lock().unwrap_or_else(PoisonError::into_inner);
        let before = all.extract_if(.., |(folder, ..)| *folder == failing.0).last();
        all.push(failing);
        before.map_or((0, 0), |(_, succeed, fail)| (succeed, fail))
    }

    /// An error, if the next change of `folder` is to fail.
    pub(super) fn change(folder: &Path) -> io::Result<()> {
        let full = || io::Error::from(io::ErrorKind::StorageFull);
        if ORDER.as_ref().is_some_and(|(place, file)| place == "disk" && file.exists()) {
            return Err(full());
        }
        let mut all = FAILING.lock().unwrap_or_else(PoisonError::into_inner);
        match all.iter_mut().find(|(failing, ..)| folder.starts_with(failing)) {
            Some((_, succeed @ 1.., _)) => *succeed -= 1,
            Some((_, _, fail @ 1..)) => {
                *fail -= 1;
                return Err(full());
            }
            _ => {}
        }
        Ok(())
    }

    static ORDER: LazyLock<Option<(String, PathBuf)>> = LazyLock::new(|| {
        let order = std::env::var("RAPID_FAULT").ok()?;
        let (place, file) = order.split_once(':')?;
        Some((place.to_owned(), PathBuf::from(file)))
    });

    /// Whether a fault is configured for this place.
    pub(super) fn is_for(place: &str) -> bool {
        ORDER.as_ref().is_some_and(|(ordered, _)| ordered == place)
    }

    /// Panics, if the fault is due.
    pub(super) fn strike(place: &str) {
        let due = ORDER.as_ref().is_some_and(|(ordered, file)| ordered == place && file.exists());
        assert!(!due, "fault ordered for {place}");
    }
}

/// Panics if a fault is configured for `place`.
#[inline]
pub fn point(place: &str) {
    #[cfg(debug_assertions)]
    order::strike(place);
    #[cfg(not(debug_assertions))]
    let _ = place;
}

/// For tests: of the changes of `folder` and of the folders in it, `succeed` more do, and the `fail` after them do not.
/// Returns what is left of the last call.
#[cfg(debug_assertions)]
pub fn fail_changes(folder: &std::path::Path, succeed: u64, fail: u64) -> (u64, u64) {
    order::fail((folder.to_owned(), succeed, fail))
}

/// An error, if a change of `folder` is to fail.
#[inline]
pub(crate) fn change(folder: &std::path::Path) -> std::io::Result<()> {
    #[cfg(debug_assertions)]
    order::change(folder)?;
    let _ = folder;
    Ok(())
}

/// As [`point`], for a task: a future that never ends, to be awaited together with the task's work.
pub async fn strike(place: &str) -> ! {
    #[cfg(debug_assertions)]
    if order::is_for(place) {
        let mut looks = tokio::time::interval(std::time::Duration::from_millis(1));
        loop {
            looks.tick().await;
            order::strike(place);
        }
    }
    let _ = place;
    std::future::pending().await
}
