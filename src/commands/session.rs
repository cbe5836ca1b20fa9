//! `rapid episode`, `rapid session` and `rapid reload`: requests to a running `rapid`.

use std::io::{self, Write};

use rapid_core::text;
use rapid_status::RegistryRequest;
use rapid_status::session::{Phase, SessionRequest, SessionStatus};

use super::Format;
use crate::orders::give::{GiveError, request};

/// Why a request was not carried out.
#[derive(Debug, thiserror::Error)]
pub enum RequestError {
    /// The run does not answer, or refuses.
    #[error(transparent)]
    Give(#[from] GiveError),
    /// The answer of the run is not that of this version.
    #[error("the answer of the run is not understood ({0}): run the same version of rapid here and there")]
    Answer(#[from] serde_json::Error),
    /// The output.
    #[error(transparent)]
    Output(#[from] io::Error),
}

/// Makes a request and prints the answer once it is carried out.
///
/// # Errors
/// When no run accepts requests, or it is refused.
pub fn ask(
    instance: Option<&str>,
    wanted: &SessionRequest,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), RequestError> {
    let answer = request(instance, wanted)?;
    match (wanted, format) {
        (SessionRequest::Show, Format::Json) => writeln!(out, "{answer}")?,
        (SessionRequest::Show, Format::Text) => show(&serde_json::from_str(&answer)?, out)?,
        _ => done(&answer, format, out)?,
    }
    Ok(())
}

/// Makes the run take over what was added to its registry.
///
/// # Errors
/// When no run accepts requests, or it takes over nothing because something else was changed.
pub fn reload(instance: Option<&str>, format: Format, out: &mut dyn Write) -> Result<(), RequestError> {
    Ok(done(&request(instance, &RegistryRequest::Reload)?, format, out)?)
}

/// Prints what was done.
pub(super) fn done(answer: &str, format: Format, out: &mut dyn Write) -> io::Result<()> {
    match format {
        Format::Json => writeln!(out, "{}", super::json_line("answer", &serde_json::json!({ "done": answer }))?)?,
        Format::Text => writeln!(out, "{}", text::plain(answer))?,
    }
    Ok(())
}

fn show(session: &SessionStatus, out: &mut dyn Write) -> io::Result<()> {
    let tags: Vec<_> = session.tags.iter().map(|(key, value)| format!("  {key}={value}")).collect();
    writeln!(out, "{}{}", text::plain(&session.task), text::plain(&tags.concat()))?;
    let phase = match session.phase {
        Phase::Idle => "no episode is being recorded",
        Phase::Countdown { .. } => "an episode is about to begin",
        Phase::Recording => "an episode is being recorded",
        Phase::Ending => "an episode is being closed",
        Phase::Reset { .. } => "the scene is being reset; the next episode follows",
    };
    let [good, suspect, bad] = session.verdicts;
    let trash = if session.discarded > 0 { format!(", {} in the trash", session.discarded) } else { String::new() };
    let folder = session.folder.display().to_string();
    writeln!(
        out,
        "counted {}, in {}: {good} GOOD, {suspect} SUSPECT, {bad} BAD{trash}; {phase}",
        session.progress(),
        text::plain(&folder)
    )?;
    for entry in &session.episodes {
        let verdict = entry.verdict.map_or("", rapid_status::Grade::word);
        let seconds = entry.seconds.map(|seconds| format!("{seconds:.1} s")).unwrap_or_default();
        let label = entry.label.map(rapid_status::session::Label::word).unwrap_or_default();
        let discarded = if entry.discarded { "discarded" } else { "" };
        let remarks = [discarded, label, &entry.label_reason, &entry.note, &entry.reasons.join("; ")];
        let remarks: Vec<_> = remarks.into_iter().filter(|text| !text.is_empty()).collect();
        let line = format!("{:40} {verdict:7} {seconds:>9}  {}", entry.file, remarks.join("; "));
        writeln!(out, "{}", text::plain(line.trim_end()))?;
    }
    Ok(())
}
