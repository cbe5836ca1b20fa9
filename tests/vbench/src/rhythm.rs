//! The timing of the mask, as recorded by a sampler in the guest.

use serde_json::Value;

use crate::outcome::Outcome;

/// A sampler that read this often in a tenth of a second had a processor.
const OFTEN: u64 = 10;
/// A processor that woke a waiting thread this often in a tenth of a second ran, so the publisher could have run there.
const WOKEN: u64 = 3;

/// The timing of the mask in a span.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rhythm {
    /// Longest time in which a sampler that reads every 0.5 ms saw no new publication, ms.
    pub longest_ms: f64,
    /// Longest pause between two reads of the sampler itself, ms: the guest's processors delay every program like this.
    pub pause_ms: f64,
    /// Publications.
    pub publications: u64,
    /// Tenths of a second in which the sampler read often and every processor ran, and no publication was seen.
    pub silent_tenths: usize,
    /// Tenths of a second in which the sampler or a processor did not run: nothing in the guest could be expected to.
    pub halted_tenths: usize,
}

impl Rhythm {
    /// Between two moments (ns of the guest's CLOCK_MONOTONIC); `None` if the sampler recorded nothing of it.
    pub fn between(outcome: &Outcome, from: u64, until: u64) -> Option<Self> {
        let number = |line: &Value, key: &str| line[key].as_u64().unwrap_or_default();
        // A line belongs to the span in which it ended, and so does the silence in it.
        let inside = |line: &&Value| line["action"] == "beat" && (from..until).contains(&number(line, "mono_ns"));
        let mut rhythm = None;
        for line in outcome.mask.iter().filter(inside) {
            let Self { longest_ms, pause_ms, publications, silent_tenths, halted_tenths } = rhythm.unwrap_or_default();
            let ran = number(line, "looks") >= OFTEN && number(line, "woken") >= WOKEN;
            let is_silent = number(line, "publications") == 0 && ran;
            rhythm = Some(Self {
                longest_ms: longest_ms.max(number(line, "longest_ns") as f64 / 1e6),
                pause_ms: pause_ms.max(number(line, "pause_ns") as f64 / 1e6),
                publications: publications + number(line, "publications"),
                silent_tenths: silent_tenths + usize::from(is_silent),
                halted_tenths: halted_tenths + usize::from(!ran),
            });
        }
        rhythm
    }
}
