//! A progress line on standard error, for work that takes longer than one likes to wait in the dark.

use std::io::{IsTerminal, Write, stderr};
use std::time::{Duration, Instant};

use crate::text;

const EVERY: Duration = Duration::from_millis(100);
const BLOCKS: usize = 20;

/// `label ██████·········· 12/72  0:07 left`, drawn over itself; nothing where nobody looks.
#[derive(Debug)]
pub struct Bar {
    label: &'static str,
    total: usize,
    begun: Instant,
    drawn: Option<Instant>,
    shown: bool,
}

impl Bar {
    /// A line for `total` pieces of work, if `wanted` and standard error is a terminal.
    #[must_use]
    pub fn new(label: &'static str, total: usize, wanted: bool) -> Self {
        Self { label, total, begun: Instant::now(), drawn: None, shown: wanted && stderr().is_terminal() }
    }

    /// `done` pieces are done.
    pub fn at(&mut self, done: usize) {
        if !self.shown || self.drawn.is_some_and(|drawn| drawn.elapsed() < EVERY) {
            return;
        }
        self.drawn = Some(Instant::now());
        let _ = write!(stderr(), "\r\x1b[2K{}", line(self.label, done, self.total, self.begun.elapsed()));
        let _ = stderr().flush();
    }

    /// Clears the line.
    pub fn clear(&mut self) {
        if self.drawn.take().is_some() {
            let _ = write!(stderr(), "\r\x1b[2K");
        }
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.clear();
    }
}

fn line(label: &str, done: usize, total: usize, elapsed: Duration) -> String {
    let full = (BLOCKS * done).checked_div(total).unwrap_or(BLOCKS).min(BLOCKS);
    let bar = "█".repeat(full) + &"·".repeat(BLOCKS - full);
    let left = (done > 0).then(|| elapsed.mul_f64((total.saturating_sub(done)) as f64 / done as f64));
    let left = left.map(|left| format!("  {} left", text::clock(left))).unwrap_or_default();
    format!("{label} {bar} {done}/{total}{left}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_says_how_far_and_how_long() {
        let bar = |done, total| line("trials", done, total, Duration::from_secs(30));
        assert_eq!(bar(0, 4), "trials ···················· 0/4");
        assert_eq!(bar(1, 4), "trials █████··············· 1/4  01:30 left");
        assert_eq!(bar(4, 4), "trials ████████████████████ 4/4  00:00 left");
        assert_eq!(bar(0, 0), "trials ████████████████████ 0/0");
    }
}
