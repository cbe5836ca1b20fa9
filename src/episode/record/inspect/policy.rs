//! What a policy did in an episode, by its events.
//!
//! Invariant: memory is bounded: texts are those of events, which are short, and of few reasons.
//! Invariant: no text of a file causes a panic; data in an unexpected format is omitted.

use std::collections::BTreeMap;

use rapid_core::text;
use serde::Serialize;
use serde_json::Value;

use super::super::quality::DurationHistogram;
use super::Lateness;

/// Reasons kept apart; a file may hold any number of them.
const MAX_REASONS: usize = 32;
/// Latencies kept one by one: an hour of chunks at 18 Hz.
const MAX_LATENCIES: usize = 1 << 16;
const OTHER_REASONS: &str = "other reasons";
/// Digits that distinguish a bundle from another.
const HASH: usize = 12;

/// What a policy did in an episode.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct PolicyReport {
    /// What its bundle calls itself; empty if unknown.
    pub name: String,
    /// Names the bundle's contents; empty if unknown.
    pub hash: String,
    /// Its actions were not carried out.
    pub dry_run: bool,
    /// Chunks of actions it gave.
    pub chunks: u64,
    /// Chunks of which some actions came too late.
    pub late_chunks: u64,
    /// From the observation to the chunk; absent without chunks.
    pub latency: Option<Lateness>,
    /// Why it did nothing, the longest first.
    pub holds: Vec<HoldReport>,
}

/// The holds of one reason.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HoldReport {
    /// Why, with the modality whose absence is the reason.
    pub reason: String,
    /// How often.
    pub count: u64,
    /// How long together, seconds.
    pub seconds: f64,
}

/// The events of a policy, one by one.
#[derive(Debug, Default)]
pub(super) struct Gathered {
    /// From the last event `policy`.
    reported: Option<Value>,
    seen: bool,
    late: u64,
    /// From the observation to the chunk, microseconds: of the first [`MAX_LATENCIES`] chunks, and of all.
    latencies: Vec<u32>,
    all_latencies: Option<DurationHistogram>,
    chunks: u64,
    /// How often each reason, and how long together, ns.
    holds: BTreeMap<String, (u64, u64)>,
    /// The hold in force, with its beginning.
    open: Option<(u64, String)>,
}

impl Gathered {
    /// Is an event of this kind a policy's?
    pub(super) fn takes(kind: &str) -> bool {
        matches!(kind, "policy" | "chunk" | "hold" | "act" | "policy_end")
    }

    /// Takes an event of a policy, as JSON.
    pub(super) fn event(&mut self, at_ns: u64, kind: &str, json: &str) {
        let Ok(answer) = serde_json::from_str::<Value>(json) else { return };
        self.seen = true;
        match kind {
            "policy" => self.reported = Some(answer),
            "chunk" => self.chunk(&answer),
            "hold" => {
                self.close(at_ns);
                let text = |key: &str| answer.get(key).and_then(Value::as_str).unwrap_or_default();
                let (reason, device) = (text("reason"), text("device"));
                let reason = if device.is_empty() { reason.to_owned() } else { format!("{reason}: {device}") };
                self.open = Some((at_ns, reason));
            }
            _ => self.close(at_ns),
        }
    }

    fn chunk(&mut self, answer: &Value) {
        let ms = answer.get("latency_ms").and_then(Value::as_f64).unwrap_or(0.0);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
        let us = (ms * 1e3).round() as u32;
        if self.latencies.len() < MAX_LATENCIES {
            self.latencies.push(us);
        }
        self.all_latencies.get_or_insert_with(DurationHistogram::default).push(u64::from(us) * 1000);
        self.chunks += 1;
        self.late += u64::from(answer.get("skipped").and_then(Value::as_u64).is_some_and(|skipped| skipped > 0));
    }

    fn close(&mut self, at_ns: u64) {
        let Some((since, reason)) = self.open.take() else { return };
        let known = self.holds.len() < MAX_REASONS || self.holds.contains_key(&reason);
        let (count, total) = self.holds.entry(if known { reason } else { OTHER_REASONS.to_owned() }).or_default();
        *count += 1;
        *total = total.saturating_add(at_ns.saturating_sub(since));
    }

    /// Exact of as many as are kept one by one, otherwise to one part in a hundred.
    fn latency(&mut self) -> Option<Lateness> {
        if self.chunks > MAX_LATENCIES as u64 {
            return self.all_latencies.as_ref().and_then(Lateness::from_histogram);
        }
        self.latencies.sort_unstable();
        let at = |percent: usize| {
            let last = self.latencies.len().checked_sub(1)?;
            self.latencies.get(last * percent / 100).map(|us| f64::from(*us) / 1e3)
        };
        Some(Lateness { p50: at(50)?, p99: at(99)?, max: at(100)? })
    }

    /// What the policy did until the end of the episode; `None` if there was none. Without events
    /// the metadata records `policy` are used, the best first.
    pub(super) fn report(mut self, end_ns: u64, metadata: [Option<&String>; 2]) -> Option<PolicyReport> {
        self.close(end_ns);
        let mut recorded = metadata.into_iter().flatten().filter_map(|text| serde_json::from_str::<Value>(text).ok());
        let recorded = recorded.find(Value::is_object);
        if !self.seen && recorded.is_none() {
            return None;
        }
        let reported = self.reported.take();
        let of = |event: &str, record: &str| {
            let reported = reported.as_ref().and_then(|reported| reported.get(event));
            reported.or_else(|| recorded.as_ref()?.get(record)).cloned().unwrap_or_default()
        };
        let text = |event, record| of(event, record).as_str().unwrap_or_default().to_owned();
        let latency = self.latency();
        let mut holds: Vec<_> = self
            .holds
            .into_iter()
            .map(|(reason, (count, ns))| HoldReport { reason, count, seconds: ns as f64 / 1e9 })
            .collect();
        holds.sort_by(|a, b| b.seconds.total_cmp(&a.seconds));
        Some(PolicyReport {
            name: text("policy", "name"),
            hash: text("hash", "hash"),
            dry_run: of("dry_run", "dry_run").as_bool().unwrap_or(false),
            chunks: self.chunks,
            late_chunks: self.late,
            latency,
            holds,
        })
    }
}

/// A policy in words, for people; then a line for each reason of its holds.
pub(super) fn words(policy: &PolicyReport) -> (Vec<String>, Vec<String>) {
    let or = |text: &str| if text.is_empty() { "?".to_owned() } else { text.to_owned() };
    let hash: String = policy.hash.chars().take(HASH).collect();
    let mut words = vec![or(&policy.name), format!("hash {}", or(&hash))];
    words.extend(policy.dry_run.then(|| "dry run: nothing moved".to_owned()));
    words.push(text::counted(policy.chunks, "chunk"));
    words.extend((policy.late_chunks > 0).then(|| format!("{} late", policy.late_chunks)));
    words.extend(policy.latency.map(|Lateness { p50, p99, max }| format!("latency {p50:.1}/{p99:.1}/{max:.1} ms")));
    let (mut count, mut seconds) = (0_u64, 0.0);
    for hold in &policy.holds {
        count = count.saturating_add(hold.count);
        seconds += hold.seconds;
    }
    words.push(if count > 0 {
        format!("{}, {seconds:.1} s", text::counted(count, "hold"))
    } else {
        "no holds".to_owned()
    });
    let reasons = policy.holds.iter();
    let reasons =
        reasons.map(|hold| format!("{:.1} s in {}: {}", hold.seconds, text::counted(hold.count, "hold"), hold.reason));
    (words, reasons.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    fn gathered(events: &[(u64, &str, &str)]) -> Gathered {
        let mut gathered = Gathered::default();
        for (at, kind, json) in events {
            assert!(Gathered::takes(kind));
            gathered.event(at * S, kind, json);
        }
        gathered
    }

    #[test]
    fn holds_last_until_the_policy_acts_holds_for_another_reason_or_ends() {
        let gathered = gathered(&[
            (0, "policy", r#"{"policy": "tactile-id", "hash": "0123456789abcdef", "dry_run": true}"#),
            (1, "hold", r#"{"device": "", "reason": "waiting"}"#),
            (2, "chunk", r#"{"latency_ms": 40.0, "skipped": 2}"#),
            (2, "act", r#"{"tick": 20}"#),
            (3, "chunk", r#"{"latency_ms": 30.5, "skipped": 0}"#),
            (5, "hold", r#"{"device": "arm", "reason": "missing"}"#),
            (8, "hold", r#"{"device": "", "reason": "waiting"}"#),
            (9, "act", r#"{"tick": 90}"#),
            (10, "hold", r#"{"device": "arm", "reason": "missing"}"#),
        ]);
        let answer = gathered.report(12 * S, [None, None]).unwrap();
        assert_eq!(
            (answer.name.as_str(), answer.hash.as_str(), answer.dry_run),
            ("tactile-id", "0123456789abcdef", true)
        );
        assert_eq!((answer.chunks, answer.late_chunks), (2, 1));
        assert_eq!(answer.latency, Some(Lateness { p50: 30.5, p99: 30.5, max: 40.0 }));
        let hold = |reason: &str, count, seconds| HoldReport { reason: reason.to_owned(), count, seconds };
        assert_eq!(answer.holds, [hold("missing: arm", 2, 5.0), hold("waiting", 2, 2.0)]);
        let (line, reasons) = words(&answer);
        assert_eq!(
            line.join("  "),
            "tactile-id  hash 0123456789ab  dry run: nothing moved  2 chunks  1 late  latency 30.5/30.5/40.0 ms  4 holds, 7.0 s"
        );
        assert_eq!(reasons, ["5.0 s in 2 holds: missing: arm", "2.0 s in 2 holds: waiting"]);
    }

    #[test]
    fn without_events_the_metadata_are_used() {
        let record = r#"{"name": "tactile-id", "hash": "ff", "dry_run": true}"#.to_owned();
        let answer = gathered(&[(1, "act", "{}")]).report(S, [None, Some(&record)]).unwrap();
        assert_eq!((answer.name.as_str(), answer.hash.as_str(), answer.dry_run), ("tactile-id", "ff", true));
        assert_eq!((answer.chunks, answer.latency, answer.holds.len()), (0, None, 0));
        assert!(Gathered::default().report(S, [Some(&record), None]).is_some());
        assert_eq!(Gathered::default().report(S, [Some(&"7".to_owned()), Some(&"x".to_owned())]), None);
    }

    #[test]
    fn hostile_text_is_survived() {
        let mut gathered = gathered(&[
            (9, "hold", "[]"),
            (3, "act", "{"),
            (2, "act", "7"),
            (1, "chunk", r#"{"latency_ms": -1e300, "skipped": -1}"#),
            (1, "chunk", r#"{"latency_ms": 1e300, "skipped": "x"}"#),
            (1, "policy", r#"{"policy": 7, "hash": []}"#),
        ]);
        for n in 0..100 {
            gathered.event(0, "hold", &format!(r#"{{"reason": "{n}"}}"#));
        }
        let answer = gathered.report(0, [None, None]).unwrap();
        assert_eq!((answer.chunks, answer.holds.len()), (2, MAX_REASONS + 1));
        assert_eq!(words(&answer).0.first().map(String::as_str), Some("?"));
    }
}
