//! What iceoryx2 does with tables that another program has damaged: it panics, in calls and in drops. Here that is
//! contained, and ends the run as memory that is lost does (`sigbus`).
//!
//! Invariant: every call and every drop of iceoryx2 that reads shared memory goes through [`contained`] or [`Guarded`].
//! Invariant: nothing of iceoryx2 is used or dropped once memory of the bus has been lost. What is left behind by
//! that is files, which are removed as those of a process that was killed.

use std::mem::ManuallyDrop;
use std::ops::Deref;
use std::panic::{AssertUnwindSafe, catch_unwind};

use super::{BusError, sigbus};

/// The result of `call`, or an error if memory of the bus has been lost before or in it.
pub(super) fn contained<T>(call: impl FnOnce() -> T) -> Result<T, BusError> {
    if sigbus::happened() {
        return Err(sigbus::error());
    }
    // What a panic leaves half done is used no more.
    catch_unwind(AssertUnwindSafe(call)).map_err(|_| {
        sigbus::damaged();
        sigbus::error()
    })
}

/// A port, service or sample of iceoryx2: dropped so that no panic comes of it, or not at all.
#[derive(Debug)]
pub(super) struct Guarded<T>(ManuallyDrop<T>);

impl<T> Guarded<T> {
    pub(super) const fn new(value: T) -> Self {
        Self(ManuallyDrop::new(value))
    }
}

impl<T> Deref for Guarded<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

impl<T> Drop for Guarded<T> {
    fn drop(&mut self) {
        // SAFETY: dropped once, here, and not used after it.
        let _ = contained(|| unsafe { ManuallyDrop::drop(&mut self.0) });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Broken;

    impl Drop for Broken {
        fn drop(&mut self) {
            panic!("its table is damaged");
        }
    }

    /// Not a test of its own: what it does to the process stays.
    #[test]
    fn helper() {
        if std::env::var_os("RAPID_TEST_GUARD").is_none() {
            return;
        }
        assert_eq!(contained(|| 7).unwrap(), 7);
        // A panic with two of them on the stack: without containment, it ends the process.
        let unwound = catch_unwind(|| {
            let _both = (Guarded::new(Broken), Guarded::new(Broken));
            panic!("something else");
        });
        assert!(unwound.is_err() && sigbus::happened());
        assert!(matches!(contained(|| panic!("it is not called")), Err::<(), _>(BusError::Lost { .. })));
    }

    #[test]
    fn a_panic_of_a_drop_while_another_unwinds_is_contained_and_ends_the_use_of_the_bus() {
        let ended = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "bus::guard::tests::helper"])
            .env("RAPID_TEST_GUARD", "")
            .output()
            .unwrap();
        assert!(ended.status.success(), "{ended:?}");
    }
}
