//! Reports when files of the bus are removed during a run: the run continues with the memory it has mapped, which no
//! other program can reach.

use std::time::Duration;

use rapid_bus::Watchman;
use tokio::time::{MissedTickBehavior, interval};

/// A check takes a system call for each of some dozens of files.
const LOOK: Duration = Duration::from_secs(1);

/// Never ends. Cancel-safe.
pub(super) async fn watch(mut watchman: Watchman) -> ! {
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        looks.tick().await;
        let removed = watchman.removed();
        let Some(first) = removed.first() else { continue };
        let others = match removed.len() - 1 {
            0 => String::new(),
            1 => ", and another file of the bus".to_owned(),
            count => format!(", and {count} other files of the bus"),
        };
        tracing::warn!(
            "{}{others}: removed during the run, which continues; programs that start now may \
             not reach it: end this run with Ctrl-C and start again",
            first.display()
        );
    }
}
