//! A queue that never makes its sender wait: the oldest entries are dropped.
//!
//! Invariant: it holds so many entries and so many bytes at most, or the newest one.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use tokio::sync::Notify;

/// See the module's comment.
#[derive(Debug)]
pub struct Queue<T> {
    entries: Mutex<Entries<T>>,
    most: usize,
    most_bytes: usize,
    news: Notify,
}

/// Each with its bytes, and the bytes of all.
#[derive(Debug)]
struct Entries<T> {
    list: VecDeque<(T, usize)>,
    bytes: usize,
}

impl<T> Entries<T> {
    fn pop(&mut self) -> Option<T> {
        let (entry, bytes) = self.list.pop_front()?;
        self.bytes -= bytes;
        Some(entry)
    }
}

impl<T> Queue<T> {
    /// Keeps the newest `most` entries, of `most_bytes` together.
    pub fn new(most: usize, most_bytes: usize) -> Self {
        let entries = Entries { list: VecDeque::with_capacity(most), bytes: 0 };
        Self { entries: Mutex::new(entries), most, most_bytes, news: Notify::new() }
    }

    /// Adds an entry of so many bytes.
    pub fn push(&self, entry: T, bytes: usize) {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        while entries.list.len() >= self.most || entries.bytes.saturating_add(bytes) > self.most_bytes {
            if entries.pop().is_none() {
                break;
            }
        }
        entries.list.push_back((entry, bytes));
        entries.bytes = entries.bytes.saturating_add(bytes);
        drop(entries);
        self.news.notify_one();
    }

    /// The oldest entry. Cancel-safe.
    pub async fn next(&self) -> T {
        loop {
            if let Some(entry) = self.entries.lock().unwrap_or_else(PoisonError::into_inner).pop() {
                return entry;
            }
            self.news.notified().await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_newest_are_kept_in_order() {
        let queue = Queue::new(3, 100);
        for number in 0..10 {
            queue.push(number, 1);
        }
        assert_eq!([queue.next().await, queue.next().await, queue.next().await], [7, 8, 9]);
        // By their bytes, and one that is too large by itself alone.
        for (number, bytes) in [(1, 60), (2, 30), (3, 30)] {
            queue.push(number, bytes);
        }
        assert_eq!([queue.next().await, queue.next().await], [2, 3]);
        queue.push(4, 10);
        queue.push(5, 1000);
        assert_eq!(queue.next().await, 5);
        queue.push(6, 100);
        assert_eq!(queue.next().await, 6);
    }
}
