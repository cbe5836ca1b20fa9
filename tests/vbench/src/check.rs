//! Assertions shared by scenarios.
//!
//! Invariant: a failed check panics and prints the value found, as `assert!` does; it is never merely reported.

use std::io::{self, Write};
use std::ops::{RangeBounds, RangeInclusive};
use std::sync::OnceLock;

use serde_json::Value;

use crate::guest::Image;
use crate::outcome::Outcome;
use crate::recording::{Edge, Recording, missing, rises};
use crate::scenario::Scenario;

/// Plays a scenario; problems of the bench itself end the test with a message that names the fix.
pub fn play(scenario: Scenario) -> Outcome {
    let name = scenario.name().to_owned();
    let outcome = scenario.run().unwrap_or_else(|error| panic!("{error}"));
    // Past the capture of the test's output: what takes long is known from every run.
    let _shown = writeln!(
        io::stderr(),
        "guest {name}: {:.0} s for {:.2} s of its own",
        outcome.wall.as_secs_f64(),
        outcome.inside.as_secs_f64()
    );
    outcome
}

/// Plays a scenario in which `rapid` records to the end, without an error on any side.
pub fn recorded(scenario: Scenario) -> Outcome {
    recorded_with(scenario, |_| false)
}

/// As [`recorded`], but these reasons against the episode are expected.
pub fn recorded_with(scenario: Scenario, is_expected: impl Fn(&str) -> bool) -> Outcome {
    let outcome = play(scenario);
    ended_with(&outcome, is_expected);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    assert!(outcome.rapid.iter().any(|line| line["event"] == "episode"), "no episode was announced");
    outcome
}

/// The guest's script and `rapid` ended without an error, and no episode has a reason against it that is not
/// of the machine (`of_the_machine`). The exit code reports a BAD one.
pub fn ended(outcome: &Outcome) {
    ended_with(outcome, |_| false);
}

/// As [`ended`], but these reasons against an episode are expected.
pub fn ended_with(outcome: &Outcome, is_expected: impl Fn(&str) -> bool) {
    assert_eq!(outcome.code, 0, "the guest's script: {}", outcome.log);
    let episodes: Vec<&Value> = outcome.rapid.iter().filter(|line| line["event"] == "episode").collect();
    for episode in &episodes {
        let others: Vec<&str> =
            unexpected(outcome, episode).into_iter().filter(|reason| !is_expected(reason)).collect();
        assert!(others.is_empty(), "reasons against the episode: {others:?}: {episode}");
        let is_judged = episode["reasons"].as_array().is_some_and(|reasons| !reasons.is_empty());
        assert!(is_judged || episode["verdict"] == "GOOD", "a verdict without a reason: {episode}");
    }
    let is_bad = episodes.iter().any(|line| line["verdict"] == "BAD");
    assert_eq!(outcome.rapid_code, Some(if is_bad { 4 } else { 0 }), "rapid's exit code: {}", outcome.log);
}

/// The reasons against an episode in this line, but for those of the machine.
pub fn unexpected<'a>(outcome: &Outcome, episode: &'a Value) -> Vec<&'a str> {
    let reasons = episode["reasons"].as_array().expect("reasons").iter().filter_map(Value::as_str);
    reasons.filter(|reason| !of_the_machine(outcome, reason)).collect()
}

/// Asserts how long it takes from one moment to another, ms: in virtual time it is the same in each run, but for the poll of a
/// shell and the ticks of the kernel (10 ms) that it begins or ends with. Where processors are emulated only the order counts.
pub fn takes(outcome: &Outcome, what: &str, from_ns: u64, until_ns: u64, expected: RangeInclusive<f64>) {
    let ms = (i128::from(until_ns) - i128::from(from_ns)) as f64 / 1e6;
    println!("{}: {what}: {ms:.3} ms", outcome.name());
    let is_so = if outcome.is_virtual { expected.contains(&ms) } else { ms >= 0.0 };
    assert!(is_so, "{what}: {ms:.3} ms instead of {expected:?}");
}

/// The only episode; there must be exactly one.
pub fn episode(outcome: &Outcome) -> Recording {
    outcome.episode().unwrap_or_else(|error| panic!("{error}"))
}

/// Frames in this span are present and whole, and each number occurs once. The emulator numbers only what it sends, so
/// a missing number was lost after it and must be among those that `rapid` reports. `uvcvideo` copies pictures on
/// several threads, and on a busy machine may deliver two of them in reverse order.
pub fn assert_whole(episode: &Recording, topic: &str, span: impl RangeBounds<u64> + Clone) {
    let frames = episode.frames(topic);
    let damaged =
        frames.iter().filter(|frame| span.contains(&frame.log_time)).filter(|frame| frame.id.is_none() || !frame.whole);
    assert_eq!(damaged.count(), 0, "{topic}: damaged frames");
    assert_accounted(episode, topic, episode.numbers(topic, span));
}

/// These numbers of a topic are present once each. In virtual time none is missing; where processors are emulated, `rapid` has
/// reported at least as many losses as are missing: on a machine that is too busy samples are lost, but never silently.
pub fn assert_accounted(episode: &Recording, topic: &str, numbers: Vec<u64>) {
    let (count, reported) = (numbers.len(), episode.reported_lost(topic));
    let missing = missing(numbers);
    println!("{topic}: {count} samples, {missing} missing, {reported} reported as lost in the whole episode");
    assert!(count > 0, "{topic}: no sample");
    let expected = if is_in_virtual_time() { 0 } else { reported };
    assert!(missing <= expected, "{topic}: {missing} of {count} samples are missing, {reported} are reported as lost");
}

/// Whether the guests of this process run in virtual time.
fn is_in_virtual_time() -> bool {
    static IS: OnceLock<bool> = OnceLock::new();
    *IS.get_or_init(|| Image::locate().is_ok_and(|guest| guest.is_virtual()))
}

/// The lines of a serial device that sends the emulator's four numbers, the first of which is a counter.
pub fn assert_lines(episode: &Recording, topic: &str) {
    let numbers = episode.rows(topic).iter().map(|row| row[0] as u64).collect();
    assert_accounted(episode, topic, numbers);
}

/// Whether an emulated processor that has others beside it is to blame for this reason of a verdict; no limit turns it off.
fn of_the_machine(outcome: &Outcome, reason: &str) -> bool {
    !outcome.is_virtual
        && ["publications of the mask are not in the file", "events are not in the file", "valid"]
            .iter()
            .any(|known| reason.contains(known))
}

/// When the first sample of a topic after this moment was taken.
pub fn first_sample(episode: &Recording, topic: &str, after: u64) -> u64 {
    let times = episode.topic(topic).map(|message| message.log_time).filter(|time| *time > after);
    times.min().unwrap_or_else(|| panic!("{topic}: no sample"))
}

/// Times after `after` at which `bit` rose.
pub fn rises_after(edges: &[Edge], bit: u32, after: u64) -> Vec<u64> {
    rises(edges, bit).into_iter().filter(|time| *time > after).collect()
}

/// The only time; there must be exactly one.
pub fn only(times: &[u64]) -> u64 {
    assert_eq!(times.len(), 1, "expected one edge");
    times[0]
}

/// From one time to a later one, ms.
pub fn ms(later: u64, earlier: u64) -> u64 {
    later.saturating_sub(earlier) / 1_000_000
}
