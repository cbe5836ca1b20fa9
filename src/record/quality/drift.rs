//! Whether a device's stamps run at the pace of this machine's clock.
//!
//! A sample cannot arrive sooner than it was captured plus the shortest way to us. That shortest
//! lateness is a property of the device; if it changes over an episode, its clock runs fast or slow.
//!
//! Invariant: memory is fixed, however long an episode is.

/// Parts an episode is divided into; the oldest two by two become one when there are more.
const CELLS: usize = 16;
/// Length of a part at the beginning.
const FIRST_WIDTH_NS: u64 = 250_000_000;
/// Fewer samples may all have been delayed.
const LEAST_SAMPLES: u64 = 10;

#[derive(Debug, Clone, Copy)]
struct Cell {
    samples: u64,
    least_ns: i64,
}

impl Cell {
    const EMPTY: Self = Self { samples: 0, least_ns: i64::MAX };

    fn with(self, other: Self) -> Self {
        Self { samples: self.samples + other.samples, least_ns: self.least_ns.min(other.least_ns) }
    }
}

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Drift {
    width_ns: u64,
    cells: [Cell; CELLS],
}

impl Drift {
    pub(super) fn new() -> Self {
        Self { width_ns: FIRST_WIDTH_NS, cells: [Cell::EMPTY; CELLS] }
    }

    /// Takes the lateness of a sample received `since_begin_ns` after the beginning.
    pub(super) fn push(&mut self, since_begin_ns: u64, lateness_ns: i64) {
        // At most 36 times: by then a part is as long as time itself.
        while since_begin_ns / self.width_ns >= CELLS as u64 {
            self.fold();
        }
        let index = usize::try_from(since_begin_ns / self.width_ns).unwrap_or(CELLS - 1);
        if let Some(cell) = self.cells.get_mut(index) {
            *cell = cell.with(Cell { samples: 1, least_ns: lateness_ns });
        }
    }

    fn fold(&mut self) {
        for index in 0..CELLS {
            let at = |index: usize| self.cells.get(index).copied().unwrap_or(Cell::EMPTY);
            let folded = at(2 * index).with(at(2 * index + 1));
            if let Some(cell) = self.cells.get_mut(index) {
                *cell = folded;
            }
        }
        self.width_ns = self.width_ns.saturating_mul(2);
    }

    /// By how much the shortest lateness grew from the first quarter of the samples' time to the
    /// last, ns; `None` when there are too few to say.
    pub(super) fn over_the_episode(&self) -> Option<i64> {
        let holds = |cell: &Cell| cell.samples > 0;
        let first = self.cells.iter().position(holds)?;
        let last = self.cells.iter().rposition(holds)?;
        let cells = self.cells.get(first..=last)?;
        let quarter = cells.len() / 4;
        if quarter == 0 {
            return None;
        }
        let sum = |cells: &[Cell]| cells.iter().copied().fold(Cell::EMPTY, Cell::with);
        let (begin, end) = (sum(cells.get(..quarter)?), sum(cells.get(cells.len() - quarter..)?));
        (begin.samples.min(end.samples) >= LEAST_SAMPLES).then(|| end.least_ns.saturating_sub(begin.least_ns))
    }
}
