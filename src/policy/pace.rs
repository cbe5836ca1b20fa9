//! Whether chunks of actions are computed fast enough for the rate at which they are executed.
//!
//! A chunk covers the ticks from its observation to its last action. The next observation is sent `n_action_steps` ticks
//! after the one before, or when the answer to that has come, whichever is later.

use std::time::Duration;

use super::bundle::Bundle;

/// The verdict, and the figures it follows from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PaceReport {
    /// The verdict.
    pub verdict: PaceVerdict,
    /// One sentence with the figures and, if one is needed, the fix.
    pub text: String,
}

/// Whether the actions of one chunk last until the next one is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum PaceVerdict {
    /// They do.
    Whole,
    /// The robot pauses between chunks.
    Pauses,
    /// No action of a chunk is left when it has been computed.
    TooSlow,
}

impl PaceReport {
    /// Of a policy whose chunks take `chunk`.
    pub fn new(bundle: &Bundle, chunk: Duration) -> Self {
        let ticks = |count: usize| Duration::from_secs_f64(count as f64 / bundle.control_hz);
        let covered = ticks(bundle.horizon - bundle.action_start);
        let executed = ticks(bundle.n_action_steps);
        let asked = executed.max(chunk);
        let verdict = match () {
            () if chunk >= covered => PaceVerdict::TooSlow,
            () if asked + chunk > covered => PaceVerdict::Pauses,
            () => PaceVerdict::Whole,
        };
        let fix = match verdict {
            // The next chunk is requested when the last action of this one ends: none is computed fast enough.
            PaceVerdict::Pauses if executed >= covered => "a smaller n_action_steps in policy.json",
            _ => "more --threads, fewer --denoising-steps, or --provider cuda",
        };
        let ms = |time: Duration| format!("{:.0} ms", time.as_secs_f64() * 1e3);
        let (taken, covered) = (ms(chunk), ms(covered));
        let figures = format!(
            "a chunk takes {taken}, and its {} actions cover {covered} at {} Hz",
            bundle.horizon - bundle.action_start,
            bundle.control_hz
        );
        let text = match verdict {
            PaceVerdict::Whole => figures,
            PaceVerdict::Pauses => format!("{figures}: the robot pauses between chunks; try {fix}"),
            PaceVerdict::TooSlow => format!("{figures}: none of them would be executed; try {fix}"),
        };
        Self { verdict, text }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::example;

    #[test]
    fn the_verdict_follows_from_horizon_and_rate() {
        let bundle = Bundle::parse(example::POLICY, "policy.json").unwrap();
        let bundle = Bundle { horizon: 16, action_start: 1, n_action_steps: 8, control_hz: 10.0, ..bundle };
        let verdict = |ms| PaceReport::new(&bundle, Duration::from_millis(ms)).verdict;
        // 15 actions cover 1.5 s; a new chunk is requested after 0.8 s.
        assert_eq!([1, 699, 700].map(verdict), [PaceVerdict::Whole; 3]);
        assert_eq!([701, 800, 1499].map(verdict), [PaceVerdict::Pauses; 3]);
        assert_eq!([1500, 9000].map(verdict), [PaceVerdict::TooSlow; 2]);
        let text = |ms| PaceReport::new(&bundle, Duration::from_millis(ms)).text;
        assert_eq!(text(100), "a chunk takes 100 ms, and its 15 actions cover 1500 ms at 10 Hz");
        assert_eq!(
            text(800),
            "a chunk takes 800 ms, and its 15 actions cover 1500 ms at 10 Hz: the robot pauses between chunks; try more \
             --threads, fewer --denoising-steps, or --provider cuda"
        );
        assert_eq!(
            text(1950),
            "a chunk takes 1950 ms, and its 15 actions cover 1500 ms at 10 Hz: none of them would be executed; try more \
             --threads, fewer --denoising-steps, or --provider cuda"
        );
    }

    #[test]
    fn a_chunk_that_is_requested_when_the_last_one_ends_is_never_in_time() {
        let bundle = Bundle::parse(example::POLICY, "policy.json").unwrap();
        let bundle = Bundle { horizon: 16, action_start: 1, n_action_steps: 15, control_hz: 10.0, ..bundle };
        for (ms, verdict, fix) in [
            (1, PaceVerdict::Pauses, "try a smaller n_action_steps in policy.json"),
            (1499, PaceVerdict::Pauses, "try a smaller n_action_steps in policy.json"),
            (1500, PaceVerdict::TooSlow, "try more --threads"),
        ] {
            let pace = PaceReport::new(&bundle, Duration::from_millis(ms));
            assert!(pace.verdict == verdict && pace.text.contains(fix), "{ms} ms: {pace:?}");
        }
    }
}
