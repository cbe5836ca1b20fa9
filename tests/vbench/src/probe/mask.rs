//! Watches `/dev/shm/rapid_hardware_mask` and prints each change, with the time first seen, and publication timing.
//!
//! Layout, little endian: bytes "RAPD", u8 version, u8 count, u16 write generation (odd while being written) at 6,
//! u64 mask at 8, u64 CLOCK_REALTIME ns at 16, u64 sequence at 24.
//! Invariant: reads only; a record that changed while being read is read again.

use std::fs::File;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use serde_json::json;

use crate::emu::log::{Log, Moment};

/// Where the mask is published.
pub const MASK_PATH: &str = "/dev/shm/rapid_hardware_mask";
const RECORD: usize = 32;
/// Polling interval. The mask is published every 2 ms.
const INTERVAL: Duration = Duration::from_micros(500);
/// A thread on each processor wakes this often.
const WAKES_EVERY: Duration = Duration::from_millis(10);
/// Length of the window summarised by a `beat` line.
const WINDOW_NS: u64 = 100_000_000;
/// Reads between two checks that the file has not been replaced.
const LOOKS_PER_CHECK: u32 = 100;

/// One reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// Bit per modality.
    pub mask: u64,
    /// CLOCK_REALTIME of the publication, ns.
    pub published_ns: u64,
    /// Publications so far.
    pub sequence: u64,
}

/// A record, unless the bytes are not one.
pub fn parse(bytes: &[u8; RECORD]) -> Option<Record> {
    let word = |at: usize| bytes[at..at + 8].try_into().map(u64::from_le_bytes).ok();
    (&bytes[..4] == b"RAPD").then_some(Record { mask: word(8)?, published_ns: word(16)?, sequence: word(24)? })
}

/// Prints `mask` lines (and `mask_gone`, `mask_seen` as the file disappears and appears) until `limit` has passed.
pub fn watch(path: &Path, limit: Option<Duration>, log: &Log) {
    let processors = Processors::start();
    let started = Instant::now();
    let running = || limit.is_none_or(|limit| started.elapsed() < limit);
    while running() {
        let Ok(file) = File::open(path) else {
            thread::sleep(INTERVAL * 10);
            continue;
        };
        log.write("mask_seen", Moment::now(), json!({}));
        follow(&file, &processors, running, log);
        log.write("mask_gone", Moment::now(), json!({}));
    }
}

fn follow(file: &File, processors: &Processors, running: impl Fn() -> bool, log: &Log) {
    let mut last: Option<Record> = None;
    let mut looks = 0u32;
    let mut beat = Beat { woken: processors.woken(), ..Beat::default() };
    while running() {
        if let Some(record) = read(file) {
            beat.look(record.sequence, Moment::now(), processors, log);
            if last.is_none_or(|last| last.mask != record.mask) {
                let fields = json!({
                    "mask": format!("{:#04x}", record.mask),
                    "previous": last.map(|last| format!("{:#04x}", last.mask)),
                    "sequence": record.sequence,
                    "published_ns": record.published_ns,
                });
                log.write("mask", Moment::now(), fields);
            }
            last = Some(record);
        }
        looks += 1;
        if looks.is_multiple_of(LOOKS_PER_CHECK) && file.metadata().is_ok_and(|meta| meta.nlink() == 0) {
            return;
        }
        thread::sleep(INTERVAL);
    }
}

/// A thread on each processor that only wakes: a processor of an emulated machine can stand still while another runs, and
/// with it whatever should have run there.
struct Processors(Vec<Arc<AtomicU64>>);

impl Processors {
    fn start() -> Self {
        let own = sched_getaffinity(None).unwrap_or_default();
        let processors = (0..CpuSet::MAX_CPU).filter(|processor| own.is_set(*processor));
        let start = |processor| {
            let woken = Arc::new(AtomicU64::new(0));
            let of_thread = Arc::clone(&woken);
            thread::spawn(move || {
                let mut only = CpuSet::new();
                only.set(processor);
                while sched_setaffinity(None, &only).is_ok() {
                    thread::sleep(WAKES_EVERY);
                    of_thread.fetch_add(1, Ordering::Relaxed);
                }
            });
            woken
        };
        Self(processors.map(start).collect())
    }

    /// How often each has woken so far.
    fn woken(&self) -> Vec<u64> {
        self.0.iter().map(|woken| woken.load(Ordering::Relaxed)).collect()
    }
}

/// The progress of the sequence, one `beat` line per window: reads and publications in it, the longest silence of the
/// mask that ended in it, the longest pause between two reads, which is the sampler's own, and how often the processor
/// that stood still for longest woke.
#[derive(Default)]
struct Beat {
    begun_ns: u64,
    looks: u64,
    publications: u64,
    longest_ns: u64,
    pause_ns: u64,
    /// Last sequence seen, and when it was new.
    last: Option<(u64, u64)>,
    looked_ns: u64,
    /// How often each processor had woken when the window began.
    woken: Vec<u64>,
}

impl Beat {
    fn look(&mut self, sequence: u64, now: Moment, processors: &Processors, log: &Log) {
        let now_ns = now.mono_ns;
        match self.last {
            None => {
                self.last = Some((sequence, now_ns));
                self.begun_ns = now_ns;
            }
            Some((before, seen_ns)) if before != sequence => {
                self.publications += sequence.wrapping_sub(before);
                self.longest_ns = self.longest_ns.max(now_ns - seen_ns);
                self.last = Some((sequence, now_ns));
            }
            Some(_) => {}
        }
        if self.looked_ns > 0 {
            self.pause_ns = self.pause_ns.max(now_ns - self.looked_ns);
        }
        self.looked_ns = now_ns;
        self.looks += 1;
        if now_ns - self.begun_ns >= WINDOW_NS {
            let woken = processors.woken();
            let fields = json!({
                "from_ns": self.begun_ns,
                "looks": self.looks,
                "publications": self.publications,
                "longest_ns": self.longest_ns,
                "pause_ns": self.pause_ns,
                "woken": woken.iter().zip(&self.woken).map(|(now, before)| now - before).min(),
            });
            log.write("beat", now, fields);
            *self = Self { begun_ns: now_ns, last: self.last, looked_ns: now_ns, woken, ..Self::default() };
        }
    }
}

fn read(file: &File) -> Option<Record> {
    let mut bytes = [0; RECORD];
    file.read_exact_at(&mut bytes, 0).ok()?;
    let mut again = [0; 2];
    file.read_exact_at(&mut again, 6).ok()?;
    let torn = bytes[6] & 1 == 1 || bytes[6..8] != again;
    (!torn).then(|| parse(&bytes)).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_the_published_layout() {
        let mut bytes = [0; RECORD];
        bytes[..4].copy_from_slice(b"RAPD");
        bytes[8] = 5;
        bytes[16..24].copy_from_slice(&7u64.to_le_bytes());
        bytes[24] = 9;
        assert_eq!(parse(&bytes), Some(Record { mask: 5, published_ns: 7, sequence: 9 }));
        bytes[0] = b'X';
        assert_eq!(parse(&bytes), None);
    }
}
