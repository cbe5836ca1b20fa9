//! What is counted of one modality, sample by sample.
//!
//! Invariant: taking a sample neither allocates nor locks nor logs.

use std::hash::{DefaultHasher, Hasher};

use super::drift::Drift;
use super::jpeg;
use super::tally::Tally;

/// What is looked at of a sample.
#[derive(Debug, Clone, Copy)]
pub(in crate::record) struct Seen<'a> {
    /// Its number; of a file only the lower 32 bits.
    pub(in crate::record) seq: u64,
    /// When it was captured, ns on the clock of the episode.
    pub(in crate::record) capture_ns: u64,
    /// When it was received, ns on the same clock.
    pub(in crate::record) recv_ns: u64,
    /// The driver called it damaged.
    pub(in crate::record) flagged: bool,
    /// It is a JPEG picture.
    pub(in crate::record) jpeg: bool,
    /// Its bytes.
    pub(in crate::record) payload: &'a [u8],
    /// They are those of the sample before; `None`: to be found out here, by a hash of each.
    pub(in crate::record) repeated: Option<bool>,
}

/// Counts of samples.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(in crate::record) struct Counts {
    /// In the file.
    pub(in crate::record) samples: u64,
    /// Payload bytes in the file.
    pub(in crate::record) bytes: u64,
    /// Lost by the device before we had them.
    pub(in crate::record) lost: u64,
    /// Lost between the driver and the file.
    pub(in crate::record) dropped: u64,
    /// Called damaged by the driver, or not a whole picture.
    pub(in crate::record) damaged: u64,
    /// Of `damaged`, those that are not a whole picture.
    pub(in crate::record) truncated: u64,
    /// Number or capture time does not go on from the sample before.
    pub(in crate::record) duplicates: u64,
    /// Byte for byte the sample before.
    pub(in crate::record) repeated: u64,
    /// Received after their frame's deadline.
    pub(in crate::record) late: u64,
}

impl Counts {
    /// Samples that should be in the file.
    pub(in crate::record) fn expected(&self) -> u64 {
        self.samples.saturating_add(self.lost).saturating_add(self.dropped)
    }
}

/// A run of samples that are byte for byte the same.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(in crate::record) struct Run {
    /// Repetitions of the first one.
    pub(in crate::record) samples: u64,
    /// From the first one to the last, ns.
    pub(in crate::record) length_ns: u64,
}

/// See the module's comment.
#[derive(Debug)]
pub(in crate::record) struct Meter {
    pub(in crate::record) counts: Counts,
    /// The run that the newest sample belongs to.
    pub(in crate::record) run: Run,
    pub(super) longest_run: Run,
    /// Receipt minus capture.
    pub(super) lateness: Tally,
    /// Furthest capture behind its receipt, ns.
    pub(super) ahead_ns: u64,
    pub(super) drift: Drift,
    /// Distance of a tick to the sample chosen for it.
    pub(super) offset: Tally,
    pub(super) frames_present: u64,
    pub(super) frames_valid: u64,
    pub(super) frames_missed: u64,
    /// Was it present in the newest frame, and did that lack a sample without being the first of a presence?
    was_present: bool,
    lacked: bool,
    /// Latest capture so far; the beginning before the first sample.
    pub(super) latest_ns: u64,
    begin_ns: u64,
    seq: Option<u64>,
    run_began_ns: u64,
    /// Are samples compared with the one before?
    compares: bool,
    /// Length and hash of the bytes of the newest sample, unless whoever brings samples compares them. Samples that are
    /// equal have equal ones; whoever makes two others to have them makes an episode worse, never better.
    newest: Option<(usize, u64)>,
}

impl Meter {
    /// A meter of an episode that begins at `begin_ns`. `compares`: payloads are compared with the
    /// one before.
    pub(super) fn new(begin_ns: u64, compares: bool) -> Self {
        Self {
            counts: Counts::default(),
            run: Run::default(),
            longest_run: Run::default(),
            lateness: Tally::new(),
            ahead_ns: 0,
            drift: Drift::new(),
            offset: Tally::new(),
            frames_present: 0,
            frames_valid: 0,
            frames_missed: 0,
            was_present: false,
            lacked: false,
            latest_ns: begin_ns,
            begin_ns,
            seq: None,
            run_began_ns: begin_ns,
            compares,
            newest: None,
        }
    }

    /// Takes a sample whose frame waits for it until `deadline_ns`. Returns the time since the sample
    /// before it.
    pub(super) fn sample(&mut self, seen: &Seen<'_>, deadline_ns: u64) -> Option<(u64, u64)> {
        let first = self.seq.is_none();
        self.counts.samples += 1;
        self.counts.bytes += seen.payload.len() as u64;
        let truncated = seen.jpeg && !jpeg::is_whole(seen.payload);
        self.counts.truncated += u64::from(truncated);
        self.counts.damaged += u64::from(truncated || seen.flagged);
        // A lower number at a later time is a publisher that began anew.
        let again = self.seq == Some(seen.seq) || (!first && seen.capture_ns <= self.latest_ns);
        self.counts.duplicates += u64::from(again);
        self.seq = Some(seen.seq);
        self.counts.late += u64::from(seen.recv_ns > deadline_ns);
        self.time(seen);
        self.compare(seen);
        let before = self.latest_ns;
        self.latest_ns = before.max(seen.capture_ns);
        (before < seen.capture_ns).then_some((before, seen.capture_ns))
    }

    /// Takes a frame, in the order of time: was it present, and was there a sample in the window?
    pub(super) fn frame(&mut self, present: bool, valid: bool) {
        self.frames_present += u64::from(present);
        self.frames_valid += u64::from(valid);
        // The frame before this one was not the last of a presence.
        self.frames_missed += u64::from(present && self.lacked);
        self.lacked = present && !valid && self.was_present;
        self.was_present = present;
    }

    fn time(&mut self, seen: &Seen<'_>) {
        let lateness = seen.recv_ns.saturating_sub(seen.capture_ns);
        self.lateness.push(lateness);
        let ahead = seen.capture_ns.saturating_sub(seen.recv_ns);
        self.ahead_ns = self.ahead_ns.max(ahead);
        let signed = |ns: u64| i64::try_from(ns).unwrap_or(i64::MAX);
        self.drift.push(seen.recv_ns.saturating_sub(self.begin_ns), signed(lateness).saturating_sub(signed(ahead)));
    }

    fn compare(&mut self, seen: &Seen<'_>) {
        if !self.compares {
            return;
        }
        let repeated = seen.repeated.unwrap_or_else(|| {
            let mut hasher = DefaultHasher::new();
            hasher.write(seen.payload);
            let newest = Some((seen.payload.len(), hasher.finish()));
            std::mem::replace(&mut self.newest, newest) == newest
        });
        if repeated && self.counts.samples > 1 {
            self.counts.repeated += 1;
            self.run.samples += 1;
            self.run.length_ns = seen.capture_ns.saturating_sub(self.run_began_ns);
            if self.run.length_ns >= self.longest_run.length_ns {
                self.longest_run = self.run;
            }
            return;
        }
        self.run = Run::default();
        self.run_began_ns = seen.capture_ns;
    }
}
