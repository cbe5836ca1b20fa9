//! Summary of commands to a motor that follow each other without a pause.

use serde_json::{Value, json};

/// A pause longer than this separates two runs of commands.
const ENDS_NS: u64 = 100_000_000;

/// See the module's comment.
#[derive(Clone, Copy, Debug)]
pub struct Run {
    count: u64,
    last_ns: u64,
    longest_gap_ns: u64,
    /// Largest step between two consecutive position commands, rad.
    largest_step: f64,
    position: Option<f64>,
    enabled: bool,
}

impl Run {
    /// Its first command.
    pub fn begin(position: Option<f64>, enabled: bool, now_ns: u64) -> Self {
        Self { count: 1, last_ns: now_ns, longest_gap_ns: 0, largest_step: 0.0, position, enabled }
    }

    /// Another command.
    pub fn take(&mut self, position: Option<f64>, enabled: bool, now_ns: u64) {
        self.count += 1;
        self.longest_gap_ns = self.longest_gap_ns.max(now_ns - self.last_ns);
        if let (Some(last), Some(position)) = (self.position, position) {
            self.largest_step = self.largest_step.max((position - last).abs());
        }
        self.position = position.or(self.position);
        self.enabled |= enabled;
        self.last_ns = now_ns;
    }

    /// When it ends unless another command comes.
    pub fn ends_ns(&self) -> u64 {
        self.last_ns + ENDS_NS
    }

    /// For the log.
    pub fn summary(&self) -> Value {
        json!({
            "count": self.count, "last_mono_ns": self.last_ns, "longest_gap_ns": self.longest_gap_ns,
            "largest_step": self.largest_step, "position": self.position, "enabled": self.enabled,
        })
    }
}
