//! What scenarios assert alike.
//!
//! Invariant: a failed check panics with what was found, as `assert!` does; nothing is merely reported.

use std::ops::RangeBounds;

use crate::outcome::Outcome;
use crate::recording::{Edge, Recording, holes, rises};
use crate::scenario::Scenario;

/// The bench's own troubles end a test with a sentence that says what to do.
pub fn play(scenario: Scenario) -> Outcome {
    let outcome = scenario.run().unwrap_or_else(|error| panic!("{error}"));
    println!("{:.1} s wall", outcome.wall.as_secs_f64());
    outcome
}

/// Plays a scenario in which `rapid` records to its end without an error on any side.
pub fn recorded(scenario: Scenario) -> Outcome {
    let outcome = play(scenario);
    assert_eq!(outcome.code, 0, "the guest's script");
    assert_eq!(outcome.rapid_code, Some(0), "rapid's exit code");
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    assert!(outcome.rapid.iter().any(|line| line["event"] == "episode"), "no episode was announced");
    outcome
}

/// The one episode there must be.
pub fn episode(outcome: &Outcome) -> Recording {
    outcome.episode().unwrap_or_else(|error| panic!("{error}"))
}

/// Frames in this span are there, whole, and without a hole in their numbers.
pub fn assert_whole(episode: &Recording, topic: &str, span: impl RangeBounds<u64> + Clone) {
    let frames = episode.frames(topic);
    let damaged =
        frames.iter().filter(|frame| span.contains(&frame.log_time)).filter(|frame| frame.id.is_none() || !frame.whole);
    assert_eq!(damaged.count(), 0, "{topic}: damaged frames");
    let numbers = episode.numbers(topic, span);
    println!("{topic}: {} frames", numbers.len());
    assert!(numbers.len() > 10, "{topic}: only {} frames", numbers.len());
    assert_eq!(holes(numbers), [], "{topic}: a hole in the frame numbers");
}

/// Times after `after` at which `bit` rose.
pub fn rises_after(edges: &[Edge], bit: u32, after: u64) -> Vec<u64> {
    rises(edges, bit).into_iter().filter(|time| *time > after).collect()
}

/// The one time there must be.
pub fn only(times: &[u64]) -> u64 {
    assert_eq!(times.len(), 1, "expected one edge");
    times[0]
}

/// From one time to a later one, ms.
pub fn ms(later: u64, earlier: u64) -> u64 {
    later.saturating_sub(earlier) / 1_000_000
}
