//! The last minute of each device: per second, whether it was present and at which rate.
//!
//! Invariant: pure, and of fixed size: time and counters come from the snapshots alone.

use std::time::Duration;

use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::time::Stamp;
use rapid_status::{DeviceState, DeviceStatus, Snapshot};

/// Seconds that are kept.
pub(super) const SECONDS: usize = 60;
/// Time in a cell.
const CELL: Duration = Duration::from_secs(1);

/// A second of a device, or several: the worst of them. In the order of severity.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Default)]
pub(super) enum Cell {
    /// It was not plugged in, or not yet running, at some moment.
    Absent,
    /// It was present; the share of its nominal rate that arrived, 0 to 1.
    Rate(f32),
    #[default]
    Unknown,
}

/// Seconds of the mask that are kept.
pub(super) const MASK_SECONDS: usize = 300;

/// A bit of the mask during some seconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Bit {
    Unknown,
    Set,
    Clear,
    Edge,
}

/// A second of the mask: the bits that were set all the time, and those that were at some moment.
#[derive(Debug, Clone, Copy, Default)]
struct Second {
    always: u64,
    ever: u64,
}

/// No snapshot was taken in this second: no bit is both always and never set.
const MISSED: Second = Second { always: u64::MAX, ever: 0 };
/// A longer time between two snapshots was not seen.
const UNSEEN: Duration = Duration::from_secs(3);

/// The last minute of all devices, and the last five of the mask.
#[derive(Debug, Clone)]
pub(super) struct History {
    devices: Box<[DeviceHistory]>,
    mask: Box<[Second]>,
    /// The current second of the mask.
    current: Option<Second>,
    /// When the current second began.
    begun: Option<Stamp>,
    /// Whole seconds so far.
    seconds: usize,
}

#[derive(Debug, Clone, Copy)]
struct DeviceHistory {
    cells: [Cell; SECONDS],
    /// Samples when the current second began.
    samples: u64,
    /// It was absent at some moment of the current second.
    was_absent: bool,
    /// The highest rate so far, for a device without a nominal one.
    highest: f64,
}

impl Default for History {
    fn default() -> Self {
        let history = DeviceHistory { cells: [Cell::Unknown; SECONDS], samples: 0, was_absent: false, highest: 0.0 };
        let mask = vec![Second::default(); MASK_SECONDS].into_boxed_slice();
        Self { devices: vec![history; MAX_MODALITIES].into_boxed_slice(), mask, current: None, begun: None, seconds: 0 }
    }
}

impl History {
    pub(super) fn update(&mut self, snapshot: &Snapshot) {
        let begun = *self.begun.get_or_insert(snapshot.taken);
        if snapshot.taken.since(begun) >= UNSEEN {
            self.miss(snapshot.taken.since(begun));
            self.begun = None;
            return self.update(snapshot);
        }
        let elapsed = snapshot.taken.since(begun);
        let is_over = elapsed >= CELL;
        let mask = snapshot.mask.0;
        let current = self.current.get_or_insert(Second { always: mask, ever: mask });
        current.always &= mask;
        current.ever |= mask;
        if is_over && let Some(place) = self.mask.get_mut(self.seconds % MASK_SECONDS) {
            *place = *current;
            // A change between two seconds is one in the next.
            self.current = Some(Second { always: mask, ever: mask });
        }
        for device in &snapshot.devices {
            if let Some(history) = self.devices.get_mut(device.id.index()) {
                history.was_absent |= !device.state.is_present();
                if is_over || elapsed.is_zero() {
                    let cell = history.end(device, elapsed);
                    if is_over && let Some(place) = history.cells.get_mut(self.seconds % SECONDS) {
                        *place = cell;
                    }
                }
            }
        }
        if is_over {
            self.seconds += 1;
            self.begun = Some(snapshot.taken);
        }
    }

    /// Nothing is known of this time.
    fn miss(&mut self, time: Duration) {
        for _ in 0..time.as_secs().min(MASK_SECONDS as u64) {
            if let Some(place) = self.mask.get_mut(self.seconds % MASK_SECONDS) {
                *place = MISSED;
            }
            for history in &mut self.devices {
                if let Some(place) = history.cells.get_mut(self.seconds % SECONDS) {
                    *place = Cell::Unknown;
                }
                history.was_absent = false;
            }
            self.seconds += 1;
        }
        self.current = None;
    }

    /// The last five minutes of a bit in so many cells, the oldest first.
    pub(super) fn bits(&self, id: ModalityId, columns: usize) -> Vec<Bit> {
        let each = MASK_SECONDS.div_ceil(columns.max(1)).max(1);
        let newest = self.seconds.next_multiple_of(each);
        let bit = 1_u64 << id.bit();
        let of = |second: usize| {
            let is_kept = second < self.seconds && second + MASK_SECONDS >= self.seconds;
            self.mask.get(second % MASK_SECONDS).filter(|_| is_kept).map(|second| match second {
                Second { always, ever } if always & !ever & bit != 0 => Bit::Unknown,
                Second { always, .. } if always & bit != 0 => Bit::Set,
                Second { ever, .. } if ever & bit == 0 => Bit::Clear,
                _ => Bit::Edge,
            })
        };
        let cell = |first: usize| {
            let known = (first..first + each).filter_map(of);
            known.reduce(|a, b| if a == b { a } else { Bit::Edge }).unwrap_or(Bit::Unknown)
        };
        let oldest = newest.saturating_sub(each * columns);
        let missing = columns.saturating_sub((newest - oldest) / each);
        std::iter::repeat_n(Bit::Unknown, missing).chain((oldest..newest).step_by(each).map(cell)).collect()
    }

    /// The last minute in so many cells, the oldest first; `columns` divides [`SECONDS`].
    pub(super) fn strip(&self, id: ModalityId, columns: usize) -> Vec<Cell> {
        let Some(history) = self.devices.get(id.index()) else { return Vec::new() };
        let each = SECONDS.checked_div(columns).unwrap_or(SECONDS).max(1);
        // Cells stand for the same seconds until they leave: a strip that is regrouped at each second flickers.
        let newest = self.seconds.next_multiple_of(each);
        let oldest = newest.saturating_sub(SECONDS);
        let cell = |second: usize| {
            let is_kept = second < self.seconds && second + SECONDS >= self.seconds;
            history.cells.get(second % SECONDS).copied().filter(|_| is_kept).unwrap_or_default()
        };
        let worst = |first: usize| {
            let cells = (first..first + each).map(cell);
            cells.reduce(|a, b| if b < a { b } else { a }).unwrap_or_default()
        };
        let missing = columns.saturating_sub((newest - oldest) / each);
        std::iter::repeat_n(Cell::Unknown, missing).chain((oldest..newest).step_by(each).map(worst)).collect()
    }
}

impl DeviceHistory {
    /// The second that ends, of this length; the next one begins.
    fn end(&mut self, device: &DeviceStatus, length: Duration) -> Cell {
        let arrived = device.samples.saturating_sub(self.samples);
        let was_absent = std::mem::replace(&mut self.was_absent, false);
        self.samples = device.samples;
        if was_absent || length.is_zero() {
            return Cell::Absent;
        }
        let hz = arrived as f64 / length.as_secs_f64();
        self.highest = self.highest.max(hz);
        let expected = device.nominal_hz.unwrap_or(self.highest) * length.as_secs_f64();
        if device.state == DeviceState::Stalled && arrived == 0 {
            return Cell::Rate(0.0);
        }
        // A regular device is one sample short where its phase is unlucky.
        #[expect(clippy::cast_possible_truncation, reason = "a share, for a picture")]
        let share = if expected > 0.0 { ((arrived + 1) as f64 / expected).min(1.0) as f32 } else { 1.0 };
        Cell::Rate(share)
    }
}

#[cfg(test)]
mod tests {
    use crate::literal::{device, id, snapshot};
    use rapid_core::mask::PhysicalMask;

    use super::*;

    /// A device of 30 Hz: its state and samples at each tenth of a second.
    fn played(history: &mut History, tenths: impl Iterator<Item = (DeviceState, u64)>) {
        for (tenth, (state, samples)) in tenths.enumerate() {
            let mut cam = device(0, "cam", state, "");
            cam.samples = samples;
            cam.nominal_hz = Some(30.0);
            let mut now = snapshot(vec![cam]);
            now.taken = Stamp(1_000_000_000_000 + tenth as u64 * 100_000_000);
            history.update(&now);
        }
    }

    #[test]
    fn what_was_not_seen_is_unknown_and_no_absence() {
        let mut history = History::default();
        let mut now = snapshot(vec![device(0, "cam", DeviceState::Streaming, "")]);
        now.mask = PhysicalMask(1);
        for ms in (0..=5000).step_by(100).chain((35_000..=40_000).step_by(100)) {
            now.taken = Stamp(1_000_000_000_000 + ms * 1_000_000);
            now.devices[0].samples = ms * 30 / 1000;
            history.update(&now);
        }
        let known = |cell: &Cell| *cell != Cell::Unknown;
        let cells = history.strip(id(0), SECONDS);
        assert!(!cells.contains(&Cell::Absent), "{cells:?}");
        assert_eq!(cells.iter().filter(|cell| known(cell)).count(), 10, "{cells:?}");
        let bits = history.bits(id(0), MASK_SECONDS);
        assert_eq!(bits.iter().filter(|bit| **bit == Bit::Set).count(), 10, "{bits:?}");
        assert!(bits.iter().all(|bit| matches!(bit, Bit::Set | Bit::Unknown)), "{bits:?}");
        assert_eq!(history.seconds, 40);
    }

    #[test]
    fn a_second_shows_the_rate_and_the_slightest_absence() {
        let mut history = History::default();
        let tenths = (0..=50).map(|tenth| match tenth {
            0..=10 => (DeviceState::Streaming, tenth * 3),
            // Half of the rate.
            11..=20 => (DeviceState::Streaming, 30 + (tenth - 10) * 3 / 2),
            // Away for 100 ms.
            25 => (DeviceState::Absent, 60),
            21..=30 => (DeviceState::Streaming, 45 + (tenth - 20) * 3),
            // Silent.
            31..=40 => (DeviceState::Stalled, 75),
            _ => (DeviceState::Streaming, 75 + (tenth - 40) * 3),
        });
        played(&mut history, tenths);
        let strip = history.strip(id(0), 60);
        assert_eq!(strip.len(), 60);
        assert!(strip[..55].iter().all(|cell| *cell == Cell::Unknown), "{strip:?}");
        assert_eq!(strip[55], Cell::Rate(1.0));
        assert!(matches!(strip[56], Cell::Rate(share) if (0.4..0.6).contains(&share)), "{strip:?}");
        assert_eq!(strip[57..], [Cell::Absent, Cell::Rate(0.0), Cell::Rate(1.0)]);
        // In fewer cells, the worst of each; the unfinished group counts.
        assert_eq!(history.strip(id(0), 20)[18..], [Cell::Absent, Cell::Rate(0.0)]);
    }

    #[test]
    fn a_bit_has_its_edges_for_five_minutes() {
        let mut history = History::default();
        // Away from second 20 to 30, and for an instant in second 40.
        let tenths = (0..=1000).map(|tenth| match tenth {
            200..=300 | 405 => (DeviceState::Absent, 0),
            _ => (DeviceState::Streaming, tenth * 3),
        });
        played(&mut history, tenths);
        let bits = history.bits(id(0), MASK_SECONDS);
        assert_eq!(bits.len(), MASK_SECONDS);
        let known = &bits[200..];
        assert!(bits[..200].iter().all(|bit| *bit == Bit::Unknown));
        let edges: Vec<_> = (0..100).filter(|second| known[*second] == Bit::Edge).collect();
        assert_eq!(edges, [19, 30, 40]);
        assert!(known[20..30].iter().all(|bit| *bit == Bit::Clear), "{known:?}");
        assert!(known[..19].iter().chain(&known[41..]).all(|bit| *bit == Bit::Set), "{known:?}");
        let coarse = history.bits(id(0), 60);
        assert_eq!((coarse.len(), coarse[40..].iter().filter(|bit| **bit == Bit::Edge).count()), (60, 3));
        assert!(history.bits(id(1), 60)[40..].iter().all(|bit| *bit == Bit::Clear));
    }

    #[test]
    fn an_old_minute_is_forgotten() {
        let mut history = History::default();
        let absent_first = (0..=1300).map(|tenth| {
            if tenth < 300 { (DeviceState::Absent, 0) } else { (DeviceState::Streaming, (tenth - 300) * 3) }
        });
        played(&mut history, absent_first);
        for columns in [60, 30, 20] {
            assert!(history.strip(id(0), columns).iter().all(|cell| *cell == Cell::Rate(1.0)), "{columns}");
        }
        assert!(history.strip(id(1), 20).iter().all(|cell| *cell == Cell::Unknown));
    }
}
