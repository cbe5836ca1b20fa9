//! Whether computing chunks leaks memory: in a separate process, which does nothing else.
//!
//! Sources: proc(5), `/proc/PID/status` (`RssAnon`) and `/proc/PID/smaps_rollup` (`Pss_Anon`): heap, stacks and other
//! memory not backed by a file, including onnxruntime's.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use rapid_policy::bundle::Bundle;
use rapid_policy::model::Model;
use rapid_policy::onnxruntime::Environment;
use rapid_policy::sampler::Computing;
use serde::{Deserialize, Serialize};

use crate::figure::Figure;
use crate::process::Running;
use crate::{Bench, Failure, policy};

/// Chunks until memory has reached its working size.
const WARM_UP: usize = 200;
const LIMIT: Duration = Duration::from_secs(1800);

/// A child's report on its memory.
#[derive(Debug, Default, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Memory {
    /// `RssAnon` after the warm-up and at the end, KiB.
    rss: [f64; 2],
    /// `Pss_Anon`, likewise.
    pss: [f64; 2],
    /// The largest growth at any check in between, KiB.
    most: f64,
}

/// Memory growth over many chunks.
pub(crate) fn figure(bench: &Bench) -> Result<Figure, Failure> {
    let chunks = bench.choose(10_000, 300);
    bench.progress(&format!("policy: the memory of {chunks} chunks"));
    let mut command = Command::new(std::env::current_exe()?);
    command.arg("chunks").arg(&bench.bundle).arg(chunks.to_string());
    let usage = Running::start(&mut command)?.finish(LIMIT, || {})?;
    let Memory { rss: [before, after], pss: [pss_before, pss_after], most } = serde_json::from_str(&usage.output)?;
    let note = format!(
        "anonymous memory, resident, of a process that computes {chunks} chunks after {WARM_UP} of warm-up: {before:.0} and \
         {after:.0} KiB, at most {most:.0} more in between; proportional share: {pss_before:.0} and {pss_after:.0}. The least block of \
         glibc, 32 bytes, kept of each of 10,000 chunks would be 312 KiB"
    );
    Ok(Figure::new("policy/growth of memory over the chunks", "KiB", Some(after - before)).target("< 64").note(note))
}

/// Computes chunks.
pub(crate) fn grown(folder: &Path, chunks: usize) -> Result<Memory, Failure> {
    let bundle = Bundle::load(folder)?;
    let mut model = Model::load(&bundle, &Environment::open(None)?, Computing::default())?;
    let mut request = policy::request(&bundle)?;
    let mut chunk = vec![0.0; model.chunk_len()];
    let mut memory = Memory::default();
    for number in 0..WARM_UP + chunks {
        if number == WARM_UP {
            memory = Memory { rss: [resident()?; 2], pss: [proportional()?; 2], most: 0.0 };
        } else if number > WARM_UP && number.is_multiple_of(100) {
            memory.most = memory.most.max(resident()? - memory.rss[0]);
        }
        request.seed = number as u64;
        model.answer(&request, &mut chunk)?;
    }
    memory.rss[1] = resident()?;
    memory.pss[1] = proportional()?;
    Ok(memory)
}

/// Anonymous memory of this process, KiB.
pub(crate) fn resident() -> Result<f64, Failure> {
    kibibytes("/proc/self/status", "RssAnon:")
}

fn proportional() -> Result<f64, Failure> {
    kibibytes("/proc/self/smaps_rollup", "Pss_Anon:")
}

fn kibibytes(file: &str, field: &str) -> Result<f64, Failure> {
    let text = std::fs::read_to_string(file)?;
    let number = text.lines().find_map(|line| line.strip_prefix(field)?.split_whitespace().next());
    Ok(number.ok_or_else(|| format!("{file} has no {field}"))?.parse()?)
}
