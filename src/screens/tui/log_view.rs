//! Which lines of the log are shown: filter, search, grouping of repeats, and how far it is scrolled back.
//!
//! Invariant: pure; a line that arrives while the view is scrolled back moves nothing.

use std::sync::Arc;

use rapid_status::{Level, LogLine};

/// A repeat is grouped with a line at most so many entries before it: two devices in trouble alternate.
const GROUP_WITHIN: usize = 8;
/// Letters at the end of a line that are compared before the whole line is.
const LETTERS: usize = 16;

/// A line, and how often it occurred.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Entry<'a> {
    /// The newest of its kind.
    pub line: &'a LogLine,
    /// How many lines it stands for.
    pub times: usize,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct LogView {
    /// The least severity that is shown.
    pub least: Level,
    /// Only lines about this device.
    pub device: Option<String>,
    /// Only lines that contain this, in any case; empty: all.
    pub search: String,
    /// Long lines continue on the next row.
    pub wraps: bool,
    /// Repeats are one line.
    pub groups: bool,
    /// The newest line that is shown, if the view is scrolled back.
    until: Option<u64>,
}

impl Default for LogView {
    fn default() -> Self {
        Self { least: Level::Info, device: None, search: String::new(), wraps: false, groups: true, until: None }
    }
}

impl LogView {
    pub(super) fn of_device(device: &str) -> Self {
        Self { device: Some(device.to_owned()), ..Self::default() }
    }

    /// Whether a line is shown; `search` is what it must contain, in lower case.
    fn shows(&self, line: &LogLine, search: &str) -> bool {
        let is_of = |device: &String| line.device.as_ref() == Some(device);
        line.level >= self.least
            && self.device.as_ref().is_none_or(is_of)
            && (search.is_empty() || line.text.to_lowercase().contains(search))
    }

    /// What is shown of this log, the oldest first.
    pub(super) fn entries<'a>(&self, log: &'a [Arc<LogLine>]) -> Vec<Entry<'a>> {
        let (search, until) = (self.search.to_lowercase(), self.until.unwrap_or(u64::MAX));
        let is_shown = |line: &&LogLine| line.number <= until && self.shows(line, &search);
        let mut entries: Vec<Entry<'_>> = Vec::with_capacity(log.len());
        for line in log.iter().map(Arc::as_ref).filter(is_shown) {
            let mut entry = Entry { line, times: 1 };
            let from = entries.len().saturating_sub(GROUP_WITHIN);
            let mut last = entries.iter().skip(from);
            if self.groups
                && let Some(place) = last.rposition(|before| is_repeat(before.line, line))
            {
                entry.times += entries.remove(from + place).times;
            }
            entries.push(entry);
        }
        entries
    }

    /// Scrolls towards older lines.
    pub(super) fn older(&mut self, log: &[Arc<LogLine>], by: usize) {
        let entries = self.entries(log);
        let at = entries.len().saturating_sub(1 + by);
        self.until = entries.get(at).map(|entry| entry.line.number);
    }

    /// Scrolls towards newer lines; at the newest the view follows.
    pub(super) fn newer(&mut self, log: &[Arc<LogLine>], by: usize) {
        let Some(until) = self.until else { return };
        let all = Self { until: None, ..self.clone() }.entries(log);
        let at = all.iter().take_while(|entry| entry.line.number <= until).count() + by;
        self.until = if at < all.len() { all.get(at.saturating_sub(1)).map(|entry| entry.line.number) } else { None };
    }

    /// Shows the newest lines again.
    pub(super) fn follow(&mut self) {
        self.until = None;
    }

    /// How many entries are newer than what is shown.
    pub(super) fn below(&self, log: &[Arc<LogLine>]) -> usize {
        let Some(until) = self.until else { return 0 };
        let all = Self { until: None, ..self.clone() }.entries(log);
        all.iter().filter(|entry| entry.line.number > until).count()
    }

    /// The next least severity: all, warnings, errors.
    pub(super) fn raise(&mut self) {
        self.least = match self.least {
            Level::Debug => Level::Info,
            Level::Info => Level::Warn,
            Level::Warn => Level::Error,
            Level::Error => Level::Debug,
        };
    }

    /// What is left out, in words; empty if nothing is.
    pub(super) fn describe(&self) -> String {
        let level = match self.least {
            Level::Debug => Some("all levels"),
            Level::Info => None,
            Level::Warn => Some("warnings and errors"),
            Level::Error => Some("errors"),
        };
        let search = (!self.search.is_empty()).then(|| format!("/{}", self.search));
        level.map(str::to_owned).into_iter().chain(self.device.clone()).chain(search).collect::<Vec<_>>().join(", ")
    }
}

const fn is_number(byte: u8) -> bool {
    byte.is_ascii_digit() || byte == b'.'
}

/// Whether two lines differ only in their numbers. Of a full log this is asked some thousand times a frame: nothing is
/// copied, and the ends are compared first, since many lines of a program differ only there.
fn is_repeat(a: &LogLine, b: &LogLine) -> bool {
    fn ends(line: &LogLine) -> impl Iterator<Item = u8> {
        line.text.bytes().rev().filter(|byte| !is_number(*byte)).take(LETTERS)
    }
    fn words(line: &LogLine) -> impl Iterator<Item = &[u8]> {
        line.text.as_bytes().split(|byte| is_number(*byte)).filter(|word| !word.is_empty())
    }
    (a.level, a.printed) == (b.level, b.printed) && a.device == b.device && ends(a).eq(ends(b)) && words(a).eq(words(b))
}

#[cfg(test)]
mod tests {
    use crate::literal::line;
    use rapid_status::PrintedOn;

    use super::*;

    fn log() -> Vec<Arc<LogLine>> {
        vec![
            line(0, Level::Info, "cam streaming, mask 0x01"),
            line(1, Level::Warn, "imu: 10 samples lost"),
            line(2, Level::Warn, "tof: 3 samples lost"),
            line(3, Level::Warn, "imu: 12 samples lost"),
            line(4, Level::Error, "gripper: permission denied"),
            line(5, Level::Debug, "details"),
            line(6, Level::Warn, "imu: 8 samples lost"),
        ]
    }

    fn shown(view: &LogView, log: &[Arc<LogLine>]) -> Vec<(u64, usize)> {
        view.entries(log).iter().map(|entry| (entry.line.number, entry.times)).collect()
    }

    #[test]
    fn repeats_are_one_line_with_their_number_and_the_newest_text() {
        let mut view = LogView::default();
        assert_eq!(shown(&view, &log()), [(0, 1), (2, 1), (4, 1), (6, 3)]);
        view.groups = false;
        assert_eq!(shown(&view, &log()), [(0, 1), (1, 1), (2, 1), (3, 1), (4, 1), (6, 1)]);
        // Where the numbers are is a difference.
        let apart = [
            line(0, Level::Info, "- step1of 2"),
            line(1, Level::Info, "- stepof 12"),
            line(2, Level::Info, "- step7of 0"),
        ];
        assert_eq!(shown(&LogView::default(), &apart), [(1, 1), (2, 2)]);
        // What a program printed is not what rapid reports.
        let mut mixed = log();
        mixed.push(Arc::new(LogLine { number: 7, printed: Some(PrintedOn::Stderr), ..LogLine::clone(&mixed[6]) }));
        view.groups = true;
        assert_eq!(shown(&view, &mixed).last(), Some(&(7, 1)));
    }

    #[test]
    fn level_device_and_search_narrow_what_is_shown() {
        let view = |change: fn(&mut LogView)| {
            let mut view = LogView { groups: false, ..LogView::default() };
            change(&mut view);
            (view.describe(), shown(&view, &log()).iter().map(|(number, _)| *number).collect::<Vec<_>>())
        };
        assert_eq!(view(|view| view.least = Level::Debug), ("all levels".to_owned(), vec![0, 1, 2, 3, 4, 5, 6]));
        assert_eq!(view(LogView::raise), ("warnings and errors".to_owned(), vec![1, 2, 3, 4, 6]));
        assert_eq!(view(|view| view.device = Some("imu".to_owned())), ("imu".to_owned(), vec![1, 3, 6]));
        assert_eq!(view(|view| view.search = "LOST".to_owned()), ("/LOST".to_owned(), vec![1, 2, 3, 6]));
        let both = |view: &mut LogView| (view.search, view.device) = ("1".to_owned(), Some("imu".to_owned()));
        assert_eq!(view(both), ("imu, /1".to_owned(), vec![1, 3]));
    }

    #[test]
    fn a_view_that_is_scrolled_back_stands_still_and_returns_to_the_end() {
        let mut view = LogView { groups: false, ..LogView::default() };
        let mut log = log();
        view.older(&log, 2);
        let before = shown(&view, &log);
        assert_eq!((before.last(), view.below(&log)), (Some(&(3, 1)), 2));
        log.push(line(7, Level::Info, "new"));
        assert_eq!((shown(&view, &log), view.below(&log)), (before, 3));
        view.newer(&log, 1);
        assert_eq!(shown(&view, &log).last(), Some(&(4, 1)));
        view.newer(&log, 5);
        assert_eq!((shown(&view, &log).last(), view.below(&log)), (Some(&(7, 1)), 0));
        // Further back than the log is long: its first line.
        view.older(&log, 100);
        assert_eq!(shown(&view, &log), [(0, 1)]);
        // Everything that was shown has been dropped.
        assert_eq!(shown(&view, &log[3..]), []);
        view.newer(&log[3..], 1);
        assert_eq!(shown(&view, &log[3..]).len(), 1);
        view.follow();
        assert_eq!(shown(&view, &log).len(), 7);
    }
}
