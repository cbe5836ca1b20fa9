//! A reference-counted value behind a lock, whose memory is reused.
//!
//! Freed memory is kept on its thread for the next value of the same layout. One call loans and sends a sample on one
//! thread: after its first sample a thread allocates no more.
//!
//! Why not an `Arc`: iceoryx2 makes one such value for every loan, and drops it when the sample is sent. With an
//! `Arc<ReentrantMutex<T>>` that is an allocation for every sample of every topic, and the path of a sample has none
//! (docs/architecture.md). `cargo test --test memory a_sample_does_not_allocate` counts them: to measure the difference, put
//! an `Arc` here and run it.
//!
//! Why not a pool of `Arc`s: iceoryx2's trait does not require `T: 'static`. A `thread_local` cannot have its type, nor
//! can `Any` hide it; memory without a type is what is left, and that needs `unsafe`.
//!
//! Invariant: a value is dropped with its last handle, and its memory is released after that.

use std::alloc::{Layout, alloc, dealloc, handle_alloc_error};
use std::cell::RefCell;
use std::fmt;
use std::marker::PhantomData;
use std::ops::Deref;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicUsize, Ordering, fence};

use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_cal::arc_sync_policy::{ArcSyncPolicy, ArcSyncPolicyCreationError, LockGuard};
use parking_lot::{ReentrantMutex, ReentrantMutexGuard};

/// Maximum number of memory blocks kept per thread. One is in use while a sample is sent.
const SPARE: usize = 4;
/// Larger blocks are not kept: the objects made for every sample are smaller.
const SPARE_BYTES: usize = 512;

pub(super) struct Shared<T>(NonNull<Inner<T>>, PhantomData<Inner<T>>);

struct Inner<T> {
    handles: AtomicUsize,
    // Reentrant, because iceoryx2's own lock may be.
    value: ReentrantMutex<T>,
}

// SAFETY: the value is reached only through the lock, by one thread at a time, and is dropped by one thread.
unsafe impl<T: Send> Send for Shared<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for Shared<T> {}

impl<T> Shared<T> {
    const LAYOUT: Layout = Layout::new::<Inner<T>>();

    fn with(value: T) -> Self {
        let memory = spare::allocate(Self::LAYOUT).cast::<Inner<T>>();
        // SAFETY: the memory has the layout of `Inner<T>` and no other owner.
        unsafe { memory.write(Inner { handles: AtomicUsize::new(1), value: ReentrantMutex::new(value) }) };
        Self(memory, PhantomData)
    }

    fn inner(&self) -> &Inner<T> {
        // SAFETY: written by `with`, and valid as long as a handle exists.
        unsafe { self.0.as_ref() }
    }
}

impl<T> Clone for Shared<T> {
    fn clone(&self) -> Self {
        // A clone is made from a handle, so nothing can be dropped meanwhile. A count that wraps would need more
        // handles than fit in memory, unless they are leaked: then the process ends.
        if self.inner().handles.fetch_add(1, Ordering::Relaxed) > usize::MAX / 2 {
            std::process::abort();
        }
        Self(self.0, PhantomData)
    }
}

impl<T> Drop for Shared<T> {
    fn drop(&mut self) {
        if self.inner().handles.fetch_sub(1, Ordering::Release) != 1 {
            return;
        }
        // Every use of the value through other handles happens before its drop.
        fence(Ordering::Acquire);
        // SAFETY: this was the last handle, and `with` wrote the value.
        unsafe { self.0.drop_in_place() };
        // SAFETY: the memory was allocated with this layout and holds no value any more.
        unsafe { spare::give(self.0.cast(), Self::LAYOUT) };
    }
}

impl<T: fmt::Debug> fmt::Debug for Shared<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner().value.fmt(f)
    }
}

impl<T: Send + Abandonable> Abandonable for Shared<T> {
    unsafe fn abandon_in_place(this: NonNull<Self>) {
        // SAFETY: the caller guarantees that `this` is valid and not used again.
        let this = unsafe { this.read() };
        if this.inner().handles.load(Ordering::Acquire) == 1 {
            let value = this.inner().value.data_ptr();
            // SAFETY: this is the only handle; the value's memory is never used again.
            unsafe { T::abandon_in_place(NonNull::new_unchecked(value)) };
            std::mem::forget(this);
        }
    }
}

pub(super) struct Guard<'a, T>(ReentrantMutexGuard<'a, T>);

impl<T> Deref for Guard<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

impl<'a, T: Send + Abandonable> LockGuard<'a, T> for Guard<'a, T> {}

impl<T: Send + fmt::Debug + Abandonable> ArcSyncPolicy<T> for Shared<T> {
    type LockGuard<'a>
        = Guard<'a, T>
    where
        T: 'a;

    fn new(value: T) -> Result<Self, ArcSyncPolicyCreationError> {
        Ok(Self::with(value))
    }

    fn lock(&self) -> Guard<'_, T> {
        Guard(self.inner().value.lock())
    }
}

/// Memory kept for reuse, per thread.
mod spare {
    use super::{Layout, NonNull, RefCell, SPARE, SPARE_BYTES, alloc, dealloc, handle_alloc_error};

    type Piece = (NonNull<u8>, Layout);

    struct Spare([Option<Piece>; SPARE]);

    thread_local! {
        static PIECES: RefCell<Spare> = const { RefCell::new(Spare([None; SPARE])) };
    }

    impl Drop for Spare {
        fn drop(&mut self) {
            for (memory, layout) in self.0.iter_mut().filter_map(Option::take) {
                // SAFETY: `give`'s caller guarantees that it was allocated with this layout and is not used.
                unsafe { dealloc(memory.as_ptr(), layout) };
            }
        }
    }

    /// Uninitialised memory of `layout`, whose size is not 0.
    pub(super) fn allocate(layout: Layout) -> NonNull<u8> {
        let fitting = |piece: &&mut Option<Piece>| piece.is_some_and(|(_, kept)| kept == layout);
        // At the end of a thread the kept blocks may be gone already.
        let kept = PIECES.try_with(|pieces| Some(pieces.borrow_mut().0.iter_mut().find(fitting)?.take()?.0));
        kept.ok().flatten().unwrap_or_else(|| {
            // SAFETY: the size is not 0: every `Inner` holds a count.
            NonNull::new(unsafe { alloc(layout) }).unwrap_or_else(|| handle_alloc_error(layout))
        })
    }

    /// Keeps or frees memory.
    ///
    /// # Safety
    /// It was allocated with `layout` and is no longer used.
    pub(super) unsafe fn give(memory: NonNull<u8>, layout: Layout) {
        let kept = layout.size() <= SPARE_BYTES
            && PIECES.try_with(|pieces| match pieces.borrow_mut().0.iter_mut().find(|piece| piece.is_none()) {
                Some(place) => {
                    *place = Some((memory, layout));
                    true
                }
                None => false,
            }) == Ok(true);
        if !kept {
            // SAFETY: guaranteed by the caller.
            unsafe { dealloc(memory.as_ptr(), layout) };
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::thread;

    use super::*;

    #[derive(Debug)]
    struct Noted {
        drops: Arc<AtomicUsize>,
        content: [u64; 8],
    }

    impl Noted {
        fn new(dropped: &Arc<AtomicUsize>) -> Self {
            Self { drops: Arc::clone(dropped), content: [7; 8] }
        }
    }

    impl Drop for Noted {
        fn drop(&mut self) {
            self.drops.fetch_add(1, Ordering::Relaxed);
        }
    }

    impl Abandonable for Noted {
        unsafe fn abandon_in_place(_: NonNull<Self>) {}
    }

    #[test]
    fn the_value_is_dropped_with_its_last_handle_and_its_memory_is_reused() {
        let dropped = Arc::new(AtomicUsize::new(0));
        let first = Shared::with(Noted::new(&dropped));
        let place = first.0;
        let second = first.clone();
        drop(first);
        assert_eq!(dropped.load(Ordering::Relaxed), 0);
        assert_eq!(second.lock().content, [7; 8]);
        drop(second);
        assert_eq!(dropped.load(Ordering::Relaxed), 1);
        assert_eq!(Shared::with(Noted::new(&dropped)).0, place);
        // More at once than are kept, then all dropped.
        let many: Vec<_> = (0..3 * SPARE).map(|_| Shared::with(Noted::new(&dropped))).collect();
        drop(many);
        assert_eq!(dropped.load(Ordering::Relaxed), 2 + 3 * SPARE);
    }

    #[test]
    fn the_lock_is_exclusive_between_threads_and_reentrant_within_one() {
        #[derive(Debug)]
        struct Count {
            so_far: std::cell::Cell<u64>,
        }
        impl Abandonable for Count {
            unsafe fn abandon_in_place(_: NonNull<Self>) {}
        }
        let count = Shared::with(Count { so_far: std::cell::Cell::new(0) });
        thread::scope(|scope| {
            for _ in 0..4 {
                let count = count.clone();
                scope.spawn(move || {
                    for _ in 0..10_000 {
                        let outer = count.lock();
                        count.lock().so_far.set(outer.so_far.get() + 1);
                        drop(count.clone());
                    }
                });
            }
        });
        assert_eq!(count.lock().so_far.get(), 40_000);
    }

    #[test]
    fn an_abandoned_value_is_not_dropped() {
        let dropped = Arc::new(AtomicUsize::new(0));
        let shared = Shared::with(Noted::new(&dropped));
        let other = shared.clone();
        shared.abandon();
        assert_eq!(other.lock().content, [7; 8]);
        other.abandon();
        assert_eq!(dropped.load(Ordering::Relaxed), 0);
    }
}
