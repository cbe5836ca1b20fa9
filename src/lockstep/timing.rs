//! When the sensors of a trial capture, and when their samples arrive, as on a rig whose devices share no clock.
//!
//! Every sensor samples once per step, at its own offset in the step (phase); the sample arrives some time later
//! (latency). The control grid begins as in real time: when the last sensor's first sample has arrived, and not before
//! [`FIRST_TICK_AFTER`] its capture.
//!
//! Invariant: pure; a function of the seed and of which sensors are present.

use std::time::Duration;

use rapid_core::random::Random;
use rapid_policy::pilot::FIRST_TICK_AFTER;
use rapid_registry::Registry;
use rapid_registry::scenario::Scenario;

use super::STEP;

/// The random stream of a trial's seed that determines the timings.
const TIMING: u64 = 0x7469_6d69_6e67;
/// Time from the capture of a sample to its arrival, microseconds: a serial line with its USB adapter takes a few
/// milliseconds, a camera with exposure and transfer a few tens.
const LATENCY_US: (u64, u64) = (5_000, 50_000);

/// The timing of one sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Timing {
    /// Time from a tick of the control grid to the next capture, below [`STEP`].
    pub phase: Duration,
    /// Time from a capture to the sample's arrival.
    pub latency: Duration,
}

impl Timing {
    /// Captures at the ticks and arrives at once, as in a demonstration.
    pub const LOCKED: Self = Self { phase: Duration::ZERO, latency: Duration::ZERO };

    /// The timing of each device in trial `seed`; `scenario` lists the devices plugged in at the start.
    pub fn of_trial(seed: u64, registry: &Registry, scenario: &Scenario) -> Vec<Self> {
        let plugged = |name: &str| scenario.devices.iter().any(|device| device.name == name && device.plugged);
        let there: Vec<bool> = registry.devices.iter().map(|device| plugged(&device.name)).collect();
        Self::draw(seed, &there)
    }

    /// The timing of each sensor of trial `seed`. `there` states which of them are plugged in when the policy begins:
    /// the control grid waits for these.
    pub fn draw(seed: u64, there: &[bool]) -> Vec<Self> {
        let mut random = Random::new(seed, TIMING);
        let step = micros(STEP);
        let mut below = |end: i64| i64::try_from(random.below(end.unsigned_abs())).unwrap_or(0);
        let (low, high) = (LATENCY_US.0.cast_signed(), LATENCY_US.1.cast_signed());
        // Times relative to the start of the policy, microseconds.
        let drawn: Vec<(i64, i64)> = there.iter().map(|_| (below(step), low + below(high - low))).collect();
        let begins = drawn.iter().zip(there).filter(|(_, there)| **there);
        let begins = begins.map(|((seen, latency), _)| (*seen).max(seen - latency + micros(FIRST_TICK_AFTER)));
        let begin = begins.max().unwrap_or(0);
        let timing = |(seen, latency): (i64, i64)| Self {
            phase: Duration::from_micros((seen - latency - begin).rem_euclid(step).unsigned_abs()),
            latency: Duration::from_micros(latency.unsigned_abs()),
        };
        drawn.into_iter().map(timing).collect()
    }
}

fn micros(duration: Duration) -> i64 {
    i64::try_from(duration.as_micros()).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Age at a tick of the newest sample that has arrived.
    fn age(timing: Timing) -> Duration {
        let newest = STEP.saturating_sub(timing.phase);
        if newest >= timing.latency { newest } else { newest + STEP }
    }

    #[test]
    fn every_phase_and_latency_occurs_and_the_last_sample_seen_is_as_fresh_as_possible() {
        let mut tenths = [[0; 10]; 3];
        let (mut fastest, mut slowest) = (Duration::MAX, Duration::ZERO);
        for seed in 0..2000 {
            let drawn = Timing::draw(seed, &[true; 3]);
            assert_eq!(drawn, Timing::draw(seed, &[true; 3]), "seed {seed}");
            for (timing, tenths) in drawn.iter().zip(&mut tenths) {
                assert!(timing.phase < STEP && (5..=50).contains(&timing.latency.as_millis()), "{timing:?}");
                assert!(age(*timing) <= STEP + timing.latency.max(FIRST_TICK_AFTER), "seed {seed}: {timing:?}");
                tenths[usize::try_from(timing.phase.as_millis() / 10).unwrap()] += 1;
                (fastest, slowest) = (fastest.min(timing.latency), slowest.max(timing.latency));
            }
            let last = drawn.iter().any(|timing| age(*timing) == timing.latency.max(FIRST_TICK_AFTER));
            assert!(last, "seed {seed}: the grid waits for a sample that is seen: {drawn:?}");
        }
        assert!(tenths.iter().flatten().all(|count| *count > 20), "{tenths:?}");
        assert!(fastest < Duration::from_millis(6) && slowest > Duration::from_millis(49), "{fastest:?} {slowest:?}");
    }

    #[test]
    fn nothing_waits_for_an_absent_sensor() {
        for seed in 0..500 {
            let drawn = Timing::draw(seed, &[true, false, false]);
            assert_eq!(age(drawn[0]), drawn[0].latency.max(FIRST_TICK_AFTER), "seed {seed}");
        }
    }
}
