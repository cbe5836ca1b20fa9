//! A queue that never makes its sender wait: the oldest entries are dropped.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use tokio::sync::Notify;

/// See the module's comment.
#[derive(Debug)]
pub struct Queue<T> {
    entries: Mutex<VecDeque<T>>,
    most: usize,
    news: Notify,
}

impl<T> Queue<T> {
    /// Keeps the newest `most` entries.
    pub fn new(most: usize) -> Self {
        Self { entries: Mutex::new(VecDeque::with_capacity(most)), most, news: Notify::new() }
    }

    /// Adds an entry.
    pub fn push(&self, entry: T) {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        if entries.len() >= self.most {
            entries.pop_front();
        }
        entries.push_back(entry);
        drop(entries);
        self.news.notify_one();
    }

    /// The oldest entry. Cancel-safe.
    pub async fn next(&self) -> T {
        loop {
            if let Some(entry) = self.entries.lock().unwrap_or_else(PoisonError::into_inner).pop_front() {
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
        let queue = Queue::new(3);
        for number in 0..10 {
            queue.push(number);
        }
        assert_eq!([queue.next().await, queue.next().await, queue.next().await], [7, 8, 9]);
    }
}
