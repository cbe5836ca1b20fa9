//! Headless output: state changes as lines or JSON objects, progress, and a summary at the end.
//!
//! Invariant: it only reads the board; a slow or vanished reader of the output holds up nothing else, and missed events
//! are counted.

mod line;
mod progress;
mod totals;

use std::io::{self, Write};
use std::sync::Arc;
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::{Stamp, WallClock};
use rapid_system::outlet::Outlet;
use tokio::sync::broadcast;
use tokio::sync::broadcast::error::{RecvError, TryRecvError};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use rapid_status::palette::Palette;
use rapid_status::rates::Rates;
use rapid_status::{Board, Event, EventKind, Snapshot};
use totals::RunTotals;

/// Maximum backlog of output; beyond it events wait, and are eventually missed.
const DEPTH: usize = 1024;
/// Interval at which progress is checked, and rewritten on a terminal.
const LOOK: Duration = Duration::from_millis(250);
/// Interval of separate progress lines where progress cannot be rewritten.
const PROGRESS_LINE: Duration = Duration::from_secs(10);
/// How long a reader may take for the remaining output at the end.
const LAST: Duration = Duration::from_secs(5);
/// Returns to the start of the line and erases it.
pub const ERASE_LINE: &str = "\r\x1b[K";

/// Options of the output.
#[derive(Debug, Clone, Copy, Default)]
pub struct HeadlessOptions {
    /// One JSON object per line instead of text.
    pub json: bool,
    /// Colours, in text.
    pub palette: Palette,
    /// Text goes to a terminal: progress is rewritten in place, and not a line every ten seconds.
    pub in_place: bool,
    /// The planned duration of the run; only shown. This module does not end the run.
    pub duration: Option<Duration>,
}

/// Prints events to `out`, the process's standard output, until `shutdown`; then the remaining announced events and the
/// summary.
///
/// `events` are those of the board, from the moment when they were subscribed to. Cancel `shutdown` when everything else has
/// ended, so that the last episode is in the summary. The future ends early, with `Ok`, when the reader of
/// the output is gone (a closed pipe or terminal).
///
/// # Errors
/// When the output cannot be written.
pub fn run(
    board: Arc<Board>,
    events: broadcast::Receiver<Event>,
    shutdown: CancellationToken,
    options: HeadlessOptions,
    out: impl Write + Send + 'static,
) -> impl Future<Output = io::Result<()>> + Send {
    let printer = Printer::new(&board.snapshot(), options);
    async move {
        let outlet = Outlet::new("output", DEPTH, out)?;
        match printer.run(&board, events, &shutdown, outlet).await {
            Err(error) if is_gone(&error) => Ok(()),
            outcome => outcome,
        }
    }
}

/// Whether the reader is gone: a closed pipe or terminal.
fn is_gone(error: &io::Error) -> bool {
    let errno = rustix::io::Errno::from_io_error(error);
    matches!(errno, Some(rustix::io::Errno::PIPE | rustix::io::Errno::IO)) || error.kind() == io::ErrorKind::BrokenPipe
}

/// Turns events and snapshots into pieces of output.
struct Printer {
    options: HeadlessOptions,
    columns: line::Columns,
    wall: WallClock,
    began: Stamp,
    rates: Rates,
    totals: RunTotals,
    /// The terminal shows a progress line without a line end.
    pending: bool,
    last_line: Stamp,
}

impl Printer {
    fn new(snapshot: &Snapshot, options: HeadlessOptions) -> Self {
        let name = snapshot.devices.iter().map(|device| text::width(&device.name)).max().unwrap_or(0);
        Self {
            options,
            columns: line::Columns { name: name.clamp(8, 28), palette: options.palette },
            wall: WallClock::now(),
            began: snapshot.taken,
            rates: Rates::default(),
            totals: RunTotals::new(snapshot),
            pending: false,
            last_line: snapshot.taken,
        }
    }

    async fn run(
        mut self,
        board: &Board,
        mut events: broadcast::Receiver<Event>,
        shutdown: &CancellationToken,
        outlet: Outlet,
    ) -> io::Result<()> {
        let mut looks = tokio::time::interval(LOOK);
        let mut rest = String::new();
        let _ = outlet.send(self.opening(&board.snapshot())?.into_bytes()).await;
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let piece = tokio::select! {
                biased;
                () = shutdown.cancelled() => break,
                () = outlet.closed() => return outlet.finish(LAST).await,
                event = events.recv() => match event {
                    Ok(event) => Some(self.event(&event)?).filter(|piece| !piece.is_empty()),
                    Err(RecvError::Lagged(missed)) => Some(self.missed(missed, &board.snapshot())),
                    // The board, which this task holds, keeps the channel open.
                    Err(RecvError::Closed) => break,
                },
                _ = looks.tick() => self.progress(&board.snapshot())?.filter(|_| outlet.is_idle()),
            };
            let Some(piece) = piece else { continue };
            tokio::select! {
                biased;
                () = shutdown.cancelled() => {
                    // Kept in `rest`, where it waits for space.
                    rest = piece;
                    break;
                }
                _ = outlet.send(piece.clone().into_bytes()) => {}
            }
        }
        loop {
            match events.try_recv() {
                Ok(event) => rest.push_str(&self.event(&event)?),
                Err(TryRecvError::Lagged(missed)) => rest.push_str(&self.missed(missed, &board.snapshot())),
                Err(TryRecvError::Empty | TryRecvError::Closed) => break,
            }
        }
        rest.push_str(&self.summary(&board.snapshot())?);
        let _ = tokio::time::timeout(LAST, outlet.send(rest.into_bytes())).await;
        outlet.finish(LAST).await
    }

    /// The start of the output: the rig, its modalities and its page.
    fn opening(&mut self, snapshot: &Snapshot) -> io::Result<String> {
        let wall_ns = self.wall.wall_ns(snapshot.taken);
        if self.options.json {
            return Ok(self.whole_line(&line::begin_json(snapshot, wall_ns)?));
        }
        let begin = self.columns.begin(snapshot, wall_ns);
        let links = self.columns.links(&snapshot.links, self.options.in_place);
        Ok([begin].iter().chain(&links).map(|line| self.whole_line(line)).collect())
    }

    fn event(&mut self, event: &Event) -> io::Result<String> {
        self.totals.count(event);
        let wall_ns = self.wall.wall_ns(event.stamp);
        let line = match &event.what {
            _ if self.options.json => line::json(event, wall_ns)?,
            // Chunks arrive continuously; progress shows their rate.
            EventKind::Chunk(chunk) if chunk.skipped == 0 => return Ok(String::new()),
            EventKind::Clock { .. } => return Ok(String::new()),
            _ => self.columns.line(event, wall_ns),
        };
        Ok(self.whole_line(&line))
    }

    fn missed(&mut self, missed: u64, now: &Snapshot) -> String {
        self.totals.miss(missed);
        self.totals.agree(now);
        let line = if self.options.json {
            let time = rapid_core::time::rfc3339(self.wall.wall_ns(now.taken));
            serde_json::json!({ "event": "missed", "count": missed, "time": time }).to_string()
        } else {
            let time = rapid_core::time::time_of_day(self.wall.wall_ns(now.taken));
            let palette = self.columns.palette;
            format!(
                "{}  {}",
                palette.faint(&time),
                palette.warn(&format!("{} missed: output was behind", text::counted(missed, "event")))
            )
        };
        self.whole_line(&line)
    }

    fn progress(&mut self, snapshot: &Snapshot) -> io::Result<Option<String>> {
        self.rates.update(snapshot);
        let elapsed = snapshot.taken.since(self.began);
        if !self.options.in_place {
            if snapshot.taken.since(self.last_line) < PROGRESS_LINE {
                return Ok(None);
            }
            self.last_line = snapshot.taken;
        }
        if self.options.json {
            let wall_ns = self.wall.wall_ns(snapshot.taken);
            let line = progress::json(snapshot, &self.rates, elapsed, self.options.duration, wall_ns)?;
            return Ok(Some(self.whole_line(&line)));
        }
        let line = progress::line(snapshot, &self.rates, elapsed, self.options.duration);
        if !self.options.in_place {
            return Ok(Some(self.whole_line(&line)));
        }
        self.pending = true;
        // The last column stays empty: a full line would wrap and could not be rewritten.
        let line = text::cut(&line, terminal_columns().saturating_sub(1), "~").into_owned();
        Ok(Some(format!("{ERASE_LINE}{}", self.columns.palette.faint(&line))))
    }

    fn summary(&mut self, end: &Snapshot) -> io::Result<String> {
        let totals = std::mem::replace(&mut self.totals, RunTotals::new(end));
        let summary = totals.summary(end);
        let text = if self.options.json {
            text::json(&summary)?
        } else {
            summary.text(self.columns.name, self.columns.palette)
        };
        Ok(self.whole_line(&text))
    }

    /// `line` with a line end, replacing the progress line if there is one.
    fn whole_line(&mut self, line: &str) -> String {
        let erase = if std::mem::take(&mut self.pending) { ERASE_LINE } else { "" };
        format!("{erase}{line}\n")
    }
}

/// Width of the terminal at standard output, 80 if unknown.
fn terminal_columns() -> usize {
    match rustix::termios::tcgetwinsize(io::stdout()) {
        Ok(size) if size.ws_col > 0 => usize::from(size.ws_col),
        _ => 80,
    }
}

#[cfg(test)]
mod tests;
