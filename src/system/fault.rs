//! Injected faults: how a test of the binary examines the effects of a panic.
//!
//! `RAPID_FAULT=PLACE:FILE` makes the thread or task PLACE panic as soon as FILE exists.
//!
//! Invariant: there are no faults in a release build: all of this needs debug assertions.

#[cfg(debug_assertions)]
mod order {
    use std::path::PathBuf;
    use std::sync::LazyLock;

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

/// The same for a task: a future that never ends, to be awaited together with the task's work.
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
