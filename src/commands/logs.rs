//! `rapid logs`: the log of a running `rapid`, and what its programs print.

use std::io::{self, Write};

use rapid_core::text;
use rapid_core::time::{Zone, rfc3339};
use rapid_status::palette::Palette;
use rapid_status::{Level, LogLine, PrintedOn, Snapshot};

use super::Format;
use super::monitor::{Connection, MonitorError, Wanted};

/// Why the log is not shown.
#[derive(Debug, thiserror::Error)]
pub enum LogsError {
    /// No run can be reached.
    #[error(transparent)]
    Monitor(#[from] MonitorError),
    /// The run has no device of this name.
    #[error("the run has no device {name:?}{known}")]
    NoDevice {
        /// The name.
        name: String,
        /// The names that it has.
        known: String,
    },
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// What is shown.
#[derive(Debug)]
pub struct LogsOptions {
    /// Only lines about this device.
    pub device: Option<String>,
    /// The least severity.
    pub least: Level,
    /// Continue with new lines until the run ends.
    pub follow: bool,
    /// How times are shown.
    pub zone: Zone,
    /// Lines of text or JSON.
    pub format: Format,
    /// Colours.
    pub palette: Palette,
}

/// Prints the log of the run of `instance`.
///
/// # Errors
/// When there is no such run or device, or the output cannot be written; a closed pipe is no error.
pub fn logs(instance: Option<&str>, options: &LogsOptions, out: &mut dyn Write) -> Result<(), LogsError> {
    let wanted = Wanted { instance: instance.map(str::to_owned), read_only: true };
    let (mut connection, mut snapshot) = Connection::open(&wanted)?;
    check(options, &snapshot)?;
    let mut next = 0;
    loop {
        for line in snapshot.log.iter().filter(|line| line.number >= next && is_shown(line, options)) {
            match print(line, options, out) {
                Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(()),
                outcome => outcome?,
            }
        }
        next = snapshot.log.last().map_or(next, |line| line.number + 1);
        out.flush()?;
        if !options.follow {
            return Ok(());
        }
        match connection.read() {
            Ok(newer) => snapshot = newer,
            // The end of the run is the end of its log.
            Err(_) => return Ok(()),
        }
    }
}

fn check(options: &LogsOptions, snapshot: &Snapshot) -> Result<(), LogsError> {
    let Some(name) = &options.device else { return Ok(()) };
    if snapshot.devices.iter().any(|device| device.name == *name) {
        return Ok(());
    }
    let names: Vec<_> = snapshot.devices.iter().map(|device| text::plain(&device.name).into_owned()).collect();
    let known = if names.is_empty() { String::new() } else { format!(": it has {}", names.join(", ")) };
    Err(LogsError::NoDevice { name: name.clone(), known })
}

fn is_shown(line: &LogLine, options: &LogsOptions) -> bool {
    line.level >= options.least && (options.device.is_none() || line.device == options.device)
}

fn print(line: &LogLine, options: &LogsOptions, out: &mut dyn Write) -> io::Result<()> {
    if options.format == Format::Json {
        let object = serde_json::json!({
            "event": "log",
            "time": rfc3339(line.wall_ns),
            "level": line.level,
            "device": line.device,
            "printed": line.printed,
            "text": line.text,
        });
        return writeln!(out, "{}", text::json(&object)?);
    }
    let word = match line.printed {
        Some(PrintedOn::Stderr) => "stderr",
        Some(PrintedOn::Stdout) => "prints",
        None => line.level.word(),
    };
    let time = options.palette.faint(&options.zone.time_of_day(line.wall_ns));
    let word = options.palette.level(line.level, &format!("{word:6}"));
    writeln!(out, "{time}  {word}  {}", text::plain(&line.text))
}
