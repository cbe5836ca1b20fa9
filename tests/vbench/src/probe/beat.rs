//! The bare loop: sleeps to absolute deadlines and records when it woke. The best that a publisher with the same period
//! can achieve in this guest.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::time::Duration;

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec};

use crate::clock;

/// Wake-ups recorded between two writes: about a second's.
const PER_WRITE: usize = 512;

/// Writes CLOCK_MONOTONIC to `path`, u64 little endian each, every `period` until it is killed.
pub fn run(period: Duration, path: &Path) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(PER_WRITE * 8, File::create(path)?);
    let period_ns = u64::try_from(period.as_nanos()).unwrap_or(u64::MAX).max(1);
    let mut due_ns = clock::mono_ns();
    loop {
        due_ns += period_ns;
        let due = Timespec { tv_sec: (due_ns / 1_000_000_000) as i64, tv_nsec: (due_ns % 1_000_000_000) as i64 };
        clock_nanosleep_absolute(ClockId::Monotonic, &due)?;
        let now_ns = clock::mono_ns();
        out.write_all(&now_ns.to_le_bytes())?;
        // As in the mask's publisher: after a delay it continues from here rather than in a burst.
        if due_ns + period_ns <= now_ns {
            due_ns = now_ns;
        }
    }
}

/// The moments in such a file.
pub fn read(bytes: &[u8]) -> Vec<u64> {
    bytes.chunks_exact(8).filter_map(|word| word.try_into().map(u64::from_le_bytes).ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_whole_words() {
        assert_eq!(read(&[1, 0, 0, 0, 0, 0, 0, 0, 2, 0]), [1]);
    }
}
