//! Actions that a test gives, and the targets that come of them.

use std::collections::VecDeque;
use std::os::fd::BorrowedFd;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rapid_core::action::{ActionSource, MAX_ACTION, NoAction};
use rapid_core::time::Stamp;

use super::patience::PATIENCE;

/// Actions in the order in which they are given; without a bell.
#[derive(Debug, Default)]
pub(crate) struct Given(pub(crate) Mutex<VecDeque<Taken>>);

pub(crate) type Taken = Result<(Vec<f64>, Stamp), NoAction>;

impl Given {
    pub(crate) fn add(&self, action: Taken) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push_back(action);
    }
}

impl ActionSource for Given {
    fn bell(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Result<Option<(&'a [f64], Stamp)>, NoAction> {
        let Some(given) = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop_front() else { return Ok(None) };
        let (numbers, tick) = given?;
        action[..numbers.len()].copy_from_slice(&numbers);
        Ok(Some((&action[..numbers.len()], tick)))
    }
}

/// The next target, or why there is none.
pub(crate) fn next(targets: &Arc<dyn ActionSource>) -> Taken {
    let begun = Instant::now();
    loop {
        let mut action = [0.0; MAX_ACTION];
        if let Some((found, tick)) = targets.newest(&mut action)? {
            return Ok((found.to_vec(), tick));
        }
        assert!(begun.elapsed() < PATIENCE, "no target");
        std::thread::sleep(Duration::from_millis(1));
    }
}
