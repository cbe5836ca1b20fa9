//! Stage trials: reports how each trial of the simulated task ended that a policy acted in.

use std::sync::Arc;
use std::time::Duration;

use rapid_registry::simulation::task::{Ended, Outcome, SharedTrial};
use rapid_status::{Board, EventKind, Level};
use tokio::time::{MissedTickBehavior, interval};

use super::stage::Stage;

/// How often it looks: a trial takes ten seconds and more.
const LOOK: Duration = Duration::from_millis(100);

pub(super) fn start(trial: SharedTrial, board: Arc<Board>) -> Stage {
    Stage::start("the trials", |stop| async move {
        let mut look = interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut sorted = 0_u64;
        loop {
            tokio::select! {
                biased;
                () = stop.cancelled() => return Ok(()),
                _ = look.tick() => {}
            }
            let ended = trial.lock().ended();
            for trial in ended {
                sorted += u64::from(trial.outcome == Outcome::Success);
                board.announce(EventKind::Log { level: Level::Info, text: report(trial, sorted) });
            }
        }
    })
}

fn report(Ended { seed, outcome, steps }: Ended, sorted: u64) -> String {
    let what = match outcome {
        Outcome::Success => "the block is sorted: it is in the bin of its texture",
        Outcome::WrongBin => "the block is in the wrong bin",
        Outcome::Incomplete => "the block is in neither bin, and time is up",
    };
    format!("trial {seed}: {what}, after {steps} steps; {sorted} sorted so far; the next block is on the table")
}
