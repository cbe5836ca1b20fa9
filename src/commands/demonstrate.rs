//! `rapid --sim task --expert --record`: demonstrations of the simulated task, recorded faster than real
//! time.

use std::io::{self, Write};
use std::sync::Arc;
use std::time::Instant;

use rapid_core::text;
use rapid_episode::record::EpisodeRequest;
use rapid_registry::Registry;
use rapid_registry::simulation::task::Texture;
use rapid_status::{Board, Grade};
use serde_json::json;

use super::Format;
use super::progress::Bar;
use crate::lockstep::STEP;
use crate::lockstep::TrialError;
use crate::lockstep::collect;

/// Why not all demonstrations were recorded.
#[derive(Debug, thiserror::Error)]
pub enum DemonstrateError {
    /// A demonstration.
    #[error(transparent)]
    Collect(#[from] TrialError),
    /// An episode's file is incomplete.
    #[error("{0}")]
    Episode(String),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// Records `count` demonstrations on the rig of `registry` from seed `first` on, half of them of each texture and of each
/// size, and lists them. Stops between two of them when `stop` returns true.
///
/// # Errors
/// When one cannot be recorded; those before it are complete.
pub fn run(
    registry: Registry,
    request: &EpisodeRequest,
    (first, count): (u64, usize),
    format: Format,
    stop: &dyn Fn() -> bool,
    out: &mut dyn Write,
) -> Result<(), DemonstrateError> {
    let registry = Arc::new(registry);
    let board = Arc::new(Board::new(&registry));
    let begun = Instant::now();
    let bar = Bar::new("episodes", count, format == Format::Text);
    let (mut done, mut steps, mut triangular, mut good) = (0, 0, 0, 0);
    for seed in collect::seeds(first, count) {
        if stop() {
            break;
        }
        bar.at(done);
        let demonstration = collect::demonstrate(&registry, &board, request, seed)?;
        if let Some(error) = demonstration.report.error {
            return Err(DemonstrateError::Episode(error));
        }
        done += 1;
        steps += demonstration.steps;
        triangular += usize::from(demonstration.texture == Texture::Triangular);
        good += usize::from(demonstration.report.verdict.grade == Grade::Good);
        if format == Format::Json {
            let report = &demonstration.report;
            let line = json!({"event": "demonstration", "seed": seed, "texture": demonstration.texture.word(),
                "size": demonstration.size.word(), "steps": demonstration.steps,
                "file": report.file.to_string_lossy(), "verdict": report.verdict.grade});
            writeln!(out, "{line}")?;
        }
    }
    drop(bar);
    if format == Format::Text {
        let (recorded, taken) = (STEP * steps, begun.elapsed());
        let times = recorded.as_secs_f64() / taken.as_secs_f64().max(1e-9);
        let folder = text::plain(&request.out.to_string_lossy()).into_owned();
        writeln!(
            out,
            "{} in {folder}: {triangular} triangular, {} hexagonal, {good} GOOD; {steps} steps, {} of \
             robot time in {:.1} s ({times:.0} times real time)",
            text::counted(done as u64, "demonstration"),
            done - triangular,
            text::clock(recorded),
            taken.as_secs_f64(),
        )?;
    }
    Ok(())
}
