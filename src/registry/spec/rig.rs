//! `[rig]`: what all devices have in common.

use std::time::Duration;

use crate::keys::{Own, Real, Size, TEXTS, Time, keys, text};
use crate::section::{Section, of_nothing};

/// Part of file names.
const NAME: Own<String> = text(name, "letters, digits, `-`, `_` and `.`, at most 64");
const MIB: u64 = 1 << 20;

keys! {
    /// The `[rig]` table.
    #[derive(Debug, Clone, PartialEq)]
    pub struct RigSpec {
        /// Name of the rig, in the names of episodes.
        name: String = NAME, or "rig".to_owned();
        /// Rate of the observation grid, Hz.
        observation_hz: f64 = Real(0.1, 1000.0), or 30.0;
        /// Half width of the window in which a sample counts as belonging to a tick (paper, section "Synchronized
        /// Subscriber").
        sync_window: Duration = Time(Duration::from_millis(1), Duration::from_secs(10)), or Duration::from_millis(25);
        /// How long a returned device waits after a removal before it is started.
        cooldown: Duration = Time(Duration::ZERO, Duration::from_mins(1)), or Duration::from_secs(2);
        /// Upper bound of the shared memory that all topics may reserve.
        memory_budget: u64 = Size(MIB, 64 << 30), or 512 * MIB;
        /// Space that recording leaves free on its disk.
        disk_reserve: Option<u64> = Size(0, 1 << 40), usually "the smaller of 1 GiB and a twentieth of the disk";
        /// Names of the entries without whose samples an episode is SUSPECT.
        expect: Vec<String> = TEXTS, or Vec::new();
    }
}

impl Default for RigSpec {
    fn default() -> Self {
        of_nothing(Self::values)
    }
}

fn name(table: &Section<'_>, key: &str) -> Option<String> {
    let name = table.text(key)?;
    let legal = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    if (1..=64).contains(&name.len()) && name.chars().all(legal) && !name.starts_with('.') {
        return Some(name.to_owned());
    }
    let fix = "use letters, digits, `-`, `_` and `.`, at most 64, not beginning with `.`";
    table.refuse(key, format!("rig name {name:?} cannot be part of a file name"), fix)
}
