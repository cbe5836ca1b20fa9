//! How a policy is told of: its events, its part of the progress, and what it came to.

use serde::Serialize;

use super::style::Palette;
use crate::status::{PolicyStatus, What};
use crate::text;

/// Digits by which a bundle is told from another.
const HASH: usize = 12;

/// The word and the rest of a line about an event of a policy; `None` of any other event.
pub(super) fn line(what: &What, palette: Palette, pad: fn(&str) -> String) -> Option<(String, String)> {
    Some(match what {
        What::Policy { policy, hash, hz, library, dry_run, .. } => {
            let word = if *dry_run { palette.warn(&pad("dry run")) } else { palette.good(&pad("loaded")) };
            let hash: String = hash.chars().take(HASH).collect();
            let dry = if *dry_run { "  nothing moves" } else { "" };
            (word, format!("{policy}  {hz} Hz  hash {hash}  onnxruntime {library}{dry}"))
        }
        What::Chunk(chunk) => {
            let rest = format!("tick {}  {:.1} ms  mask {}", chunk.tick, chunk.latency_ms, chunk.mask);
            match chunk.skipped {
                0 => (palette.faint(&pad("chunk")), rest),
                1 => (palette.warn(&pad("late chunk")), format!("{rest}  1 action too late")),
                late => (palette.warn(&pad("late chunk")), format!("{rest}  {late} actions too late")),
            }
        }
        What::Hold { device, reason } if device.is_empty() => (palette.warn(&pad("holds")), reason.clone()),
        What::Hold { device, reason } => (palette.warn(&pad("holds")), format!("{reason}: {device}")),
        What::Act { tick } => (palette.good(&pad("acts")), format!("from tick {tick}")),
        What::PolicyEnd { .. } => (pad("ended"), PolicySum::of(what)?.counts()),
        _ => return None,
    })
}

/// What the policy does now, in a few words for the progress line.
pub(super) fn progress(policy: &PolicyStatus) -> String {
    let dry = if policy.dry_run { " dry" } else { "" };
    let latency = policy.latency_ms.map(|ms| format!(" {ms:.0} ms")).unwrap_or_default();
    match &policy.hold {
        None => format!("policy{dry} acts{latency}"),
        Some(reason) => format!("policy{dry} holds: {}", text::plain(reason)),
    }
}

/// The same as JSON.
#[derive(Debug, Serialize)]
pub(super) struct PolicyProgress<'a> {
    policy: &'a str,
    dry_run: bool,
    /// What it saw last, `0x05`.
    mask: String,
    /// Why it does nothing; null while it acts.
    hold: Option<&'a str>,
    latency_ms: Option<f64>,
    chunk_age: Option<u64>,
    actions: u64,
    held: u64,
    chunks: u64,
    unused: u64,
}

impl<'a> PolicyProgress<'a> {
    pub(super) fn of(policy: &'a PolicyStatus, devices: usize) -> Self {
        Self {
            policy: &policy.name,
            dry_run: policy.dry_run,
            mask: policy.mask.hex(devices),
            hold: policy.hold.as_deref(),
            latency_ms: policy.latency_ms,
            chunk_age: policy.chunk_age,
            actions: policy.actions,
            held: policy.held,
            chunks: policy.chunks,
            unused: policy.unused,
        }
    }
}

/// What a policy came to.
#[derive(Debug, Clone, Serialize)]
pub(super) struct PolicySum {
    /// Ticks with an action.
    actions: u64,
    /// Ticks without.
    held: u64,
    /// Chunks that were used.
    chunks: u64,
    /// Answers that were not used or never came.
    unused: u64,
    latency_p50_ms: f64,
    latency_p99_ms: f64,
}

impl PolicySum {
    /// From the event at its end; `None` of any other event.
    pub(super) fn of(what: &What) -> Option<Self> {
        let &What::PolicyEnd { actions, held, chunks, unused, latency_p50_ms, latency_p99_ms } = what else {
            return None;
        };
        Some(Self { actions, held, chunks, unused, latency_p50_ms, latency_p99_ms })
    }

    /// For people.
    pub(super) fn counts(&self) -> String {
        let Self { actions, held, chunks, unused, latency_p50_ms, latency_p99_ms } = self;
        let counts = format!("{actions} actions  {held} ticks held  {chunks} chunks  {unused} unused");
        // Without a chunk there is nothing to measure.
        if *chunks + *unused == 0 {
            return counts;
        }
        format!("{counts}  latency p50 {latency_p50_ms:.1} ms  p99 {latency_p99_ms:.1} ms")
    }
}
