//! iceoryx2 panics, in calls and in drops, when another program has damaged its tables. Such panics are contained here
//! and end the run in the same way as lost memory (`sigbus`).
//!
//! Invariant: every call and every drop of iceoryx2 that reads shared memory goes through [`contained`] or [`Guarded`].
//! Invariant: nothing of iceoryx2 is used or dropped once memory of the bus has been lost. Only files are left behind;
//! they are removed like those of a killed process.

use std::mem::ManuallyDrop;
use std::ops::Deref;
use std::panic::{AssertUnwindSafe, catch_unwind};

use super::{BusError, sigbus};

/// The result of `call`, or an error if memory of the bus has been lost before or in it.
pub(super) fn contained<T>(call: impl FnOnce() -> T) -> Result<T, BusError> {
    if sigbus::happened() {
        return Err(sigbus::error());
    }
    // Whatever a panic leaves half done is never used again.
    catch_unwind(AssertUnwindSafe(call)).map_err(|_| {
        sigbus::damaged();
        sigbus::error()
    })
}

/// A port, service or sample of iceoryx2 whose drop contains panics, or is skipped.
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
        // SAFETY: dropped once, here, and not used afterwards.
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

    /// Not a test of its own: its effect on the process is permanent.
    #[test]
    #[ignore = "run by a_panic_in_drop_during_unwinding_is_contained_and_ends_the_use_of_the_bus"]
    fn helper() {
        assert_eq!(contained(|| 7).unwrap(), 7);
        // A panic with two guarded values on the stack would end the process without containment.
        let unwound = catch_unwind(|| {
            let _both = (Guarded::new(Broken), Guarded::new(Broken));
            panic!("something else");
        });
        assert!(unwound.is_err() && sigbus::happened());
        assert!(matches!(contained(|| panic!("it is not called")), Err::<(), _>(BusError::Lost { .. })));
    }

    #[test]
    fn a_panic_in_drop_during_unwinding_is_contained_and_ends_the_use_of_the_bus() {
        let ended = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "containment::tests::helper", "--ignored"])
            .output()
            .unwrap();
        // Of a name that fits no test nothing runs, and nothing fails.
        let passed = String::from_utf8_lossy(&ended.stdout).contains("1 passed");
        assert!(ended.status.success() && passed, "{ended:?}");
    }
}
