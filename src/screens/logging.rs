//! Logging: where the program's own log lines go.
//!
//! Every line goes to the board, for the screen. Without a full-screen monitor, lines also go to
//! standard error; with one, only the monitor writes to the terminal.
//!
//! `RAPID_LOG` chooses what is logged, in the syntax of `tracing_subscriber::EnvFilter`, for example
//! `RAPID_LOG=debug` or `RAPID_LOG=rapid::rig=trace,warn`. Without it the board receives the lines of
//! [`DEFAULT`], and standard error only warnings and errors: state changes are printed as events already.
//! Panic messages are logged regardless of it.
//!
//! Invariant: logging never waits for standard error: a slow reader loses lines, and their number is reported to it.
//! Invariant: a line has no control characters and no line breaks, and at most [`LONGEST`] characters.

use std::fmt::{Debug, Write as _};
use std::io::{self, IsTerminal, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::realtime_ns;
use rapid_status::palette::Palette;
use rapid_status::{Board, Level};
use rapid_system::outlet::Outlet;
use rapid_system::panics;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Subscriber};
use tracing_subscriber::filter::{EnvFilter, LevelFilter, ParseError};
use tracing_subscriber::layer::{Context, SubscriberExt};
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, Registry};

use crate::headless::ERASE_LINE;

/// What is logged without `RAPID_LOG`. iceoryx2 warns of errors that it then handles; of the Foxglove server only what it
/// drops is of interest, every half minute, and no client that has gone.
pub const DEFAULT: &str =
    "warn,rapid=info,iceoryx2=error,foxglove=off,foxglove::websocket::connected_client::send_lossy=info";
/// Most characters of a line; longer ones are cut.
pub const LONGEST: usize = 2000;

/// Lines that may wait for the reader of standard error.
const DEPTH: usize = 1024;
/// Time for the reader to take the rest at the end.
const LAST: Duration = Duration::from_millis(500);

/// What is written to standard error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stderr {
    /// Nothing: a full-screen monitor has the terminal.
    Nothing,
    /// Lines of text.
    Text,
    /// One JSON object per line: `{"event":"log","level":...,"text":...,"time":...}`.
    Json,
}

/// Why there is no log.
#[derive(Debug, thiserror::Error)]
pub enum LoggingError {
    /// `RAPID_LOG` is not a filter.
    #[error("RAPID_LOG: {0}; for example RAPID_LOG=debug or RAPID_LOG=rapid::rig=trace,warn")]
    Filter(#[from] ParseError),
    /// There is a log already.
    #[error("logging was started twice")]
    Twice(#[from] tracing_subscriber::util::TryInitError),
    /// The system provides no further thread.
    #[error("the thread that writes the log: {0}")]
    Thread(#[from] io::Error),
}

/// Dropping it waits, for a limited time, until standard error has taken what was logged.
#[derive(Debug)]
#[must_use = "dropped at once it waits for nothing"]
pub struct Log(Option<Arc<Outlet>>);

impl Drop for Log {
    fn drop(&mut self) {
        if let Some(outlet) = &self.0 {
            outlet.drain(LAST);
        }
    }
}

/// Where a line that cannot be written is lost: there is no place left to report it, and one that finds no room (another
/// program may have made the terminal non-blocking) is not the end of the log.
struct Lossy<W>(W);

impl<W: Write> Write for Lossy<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let _ = self.0.write_all(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let _ = self.0.flush();
        Ok(())
    }
}

/// The thread that writes the log's lines to `out`.
fn outlet(out: impl Write + Send + 'static) -> io::Result<Arc<Outlet>> {
    Ok(Arc::new(Outlet::new("stderr", DEPTH, Lossy(out))?))
}

/// Sends the program's log to `board` and to standard error. `filter` is the value of `RAPID_LOG`.
///
/// # Errors
/// When the filter is wrong, or when called twice in a process.
pub fn init(board: Arc<Board>, filter: Option<&str>, stderr: Stderr) -> Result<Log, LoggingError> {
    let chosen = filter.filter(|filter| !filter.is_empty());
    let filter = filter_of(chosen.unwrap_or(DEFAULT))?;
    let least = if chosen.is_some() { LevelFilter::TRACE } else { LevelFilter::WARN };
    let outlet = match stderr {
        Stderr::Nothing => None,
        Stderr::Text | Stderr::Json => Some(outlet(io::stderr())?),
    };
    let printed = outlet.clone().map(|outlet| Lines { sink: StderrSink::new(stderr, outlet) }.with_filter(least));
    Registry::default().with(filter).with(Lines { sink: board }).with(printed).try_init()?;
    Ok(Log(outlet))
}

fn filter_of(chosen: &str) -> Result<EnvFilter, ParseError> {
    Ok(EnvFilter::try_new(chosen)?.add_directive(format!("{}=error", panics::TARGET).parse()?))
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct LogLine {
    /// Wall time, ns since 1970.
    wall_ns: u64,
    level: Level,
    text: String,
}

/// Receives formatted lines.
trait Sink: 'static {
    fn write(&self, line: LogLine);
}

impl Sink for Arc<Board> {
    fn write(&self, line: LogLine) {
        self.log(line.level, &line.text);
    }
}

#[derive(Debug)]
struct StderrSink {
    form: Stderr,
    palette: Palette,
    /// Erases a progress line on the same terminal.
    before: &'static str,
    outlet: Arc<Outlet>,
    /// Lines lost for lack of room since the last that was sent.
    lost: AtomicU64,
}

impl StderrSink {
    fn new(form: Stderr, outlet: Arc<Outlet>) -> Self {
        let palette = Palette::for_output(&io::stderr());
        let shared = form == Stderr::Text && io::stderr().is_terminal() && io::stdout().is_terminal();
        Self { form, palette, before: if shared { ERASE_LINE } else { "" }, outlet, lost: AtomicU64::new(0) }
    }

    fn render(&self, line: &LogLine) -> String {
        if self.form == Stderr::Json {
            let time = rapid_core::time::rfc3339(line.wall_ns);
            let object = serde_json::json!({ "event": "log", "level": line.level, "text": line.text, "time": time });
            return format!("{}\n", text::json(&object).unwrap_or_default());
        }
        let time = self.palette.faint(&rapid_core::time::time_of_day(line.wall_ns));
        let level = format!("{:5}", line.level.word());
        format!("{}{time}  {}  {}\n", self.before, self.palette.level(line.level, &level), line.text)
    }
}

impl Sink for StderrSink {
    fn write(&self, line: LogLine) {
        let mut text = self.render(&line);
        let lost = self.lost.swap(0, Ordering::Relaxed);
        if lost > 0 {
            let report = format!("{} of the log lost: their reader was behind", text::counted(lost, "line"));
            text.insert_str(0, &self.render(&LogLine { level: Level::Warn, text: report, ..line }));
        }
        if !self.outlet.try_send(text.into_bytes()) {
            self.lost.fetch_add(lost + 1, Ordering::Relaxed);
        }
    }
}

/// The layer that formats an event, its fields, and the fields of its spans as one line.
struct Lines<S> {
    sink: S,
}

/// Fields of a span, as they appear at the end of a line.
struct SpanFields(String);

impl<S, K> Layer<S> for Lines<K>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    K: Sink,
{
    fn on_new_span(&self, attributes: &Attributes<'_>, id: &Id, context: Context<'_, S>) {
        let Some(span) = context.span(id) else { return };
        let mut fields = Fields::default();
        attributes.record(&mut fields);
        // A second layer of this kind receives the same span: the fields are the same.
        span.extensions_mut().replace(SpanFields(fields.rest));
    }

    fn on_record(&self, id: &Id, values: &Record<'_>, context: Context<'_, S>) {
        let Some(span) = context.span(id) else { return };
        let mut fields = Fields::default();
        values.record(&mut fields);
        if let Some(known) = span.extensions_mut().get_mut::<SpanFields>()
            && !known.0.ends_with(&fields.rest)
        {
            known.0.push_str(&fields.rest);
        }
    }

    fn on_event(&self, event: &Event<'_>, context: Context<'_, S>) {
        let mut fields = Fields::default();
        event.record(&mut fields);
        let mut line = fields.message;
        line.push_str(&fields.rest);
        for span in context.event_scope(event).into_iter().flatten() {
            if let Some(known) = span.extensions().get::<SpanFields>()
                && !line.contains(known.0.as_str())
            {
                line.push_str(&known.0);
            }
        }
        let line: String = text::plain(line.trim()).chars().take(LONGEST).collect();
        self.sink.write(LogLine { wall_ns: realtime_ns(), level: level(*event.metadata().level()), text: line });
    }
}

fn level(level: tracing::Level) -> Level {
    match level {
        tracing::Level::ERROR => Level::Error,
        tracing::Level::WARN => Level::Warn,
        tracing::Level::INFO => Level::Info,
        tracing::Level::DEBUG | tracing::Level::TRACE => Level::Debug,
    }
}

/// Collects the message, and the other fields as ` name=value`.
#[derive(Default)]
struct Fields {
    message: String,
    rest: String,
}

impl Fields {
    fn add(&mut self, field: &Field, value: std::fmt::Arguments<'_>) {
        let written = match field.name() {
            "message" => write!(self.message, "{value}"),
            // iceoryx2 puts a dump of whole objects here.
            "origin" => Ok(()),
            name => write!(self.rest, " {name}={value}"),
        };
        // Only a value whose formatting fails gets here; the rest is still a line.
        if written.is_err() {
            self.rest.push_str(" (unprintable)");
        }
    }
}

impl Visit for Fields {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        self.add(field, format_args!("{value:?}"));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.add(field, format_args!("{value}"));
    }

    fn record_error(&mut self, field: &Field, value: &(dyn std::error::Error + 'static)) {
        self.add(field, format_args!("{value}"));
    }
}

#[cfg(test)]
mod tests;
