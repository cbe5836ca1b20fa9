//! The same chunk in eager PyTorch, computed by `models/torch_latency.py` in the training environment.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

use crate::figure::Figure;
use crate::stats::{Sorted, median};
use crate::{Absent, Bench, Failure};

const SCRIPT: &str = "models/torch_latency.py";
/// The command that creates the environment, with everything that is trained in it.
const REMEDY: &str = "`make train-test` makes it (5 GB)";

/// PyTorch's chunk compared with ours; `own` returns some of our times and the processor time in them, ms. Both are
/// measured alternately, as often as there are runs.
pub(crate) fn figures(bench: &Bench, own: impl FnMut() -> Result<(Vec<f64>, Vec<f64>), Failure>) -> Vec<Figure> {
    const NAME: &str = "policy/PyTorch eager";
    let Some(python) = python() else {
        let absent: Failure = Absent(format!("Python environment of the training: {REMEDY}")).into();
        return vec![Figure::of_failure(NAME, &absent)];
    };
    compare(bench, &python, own).unwrap_or_else(|error| vec![Figure::of_failure(NAME, &error)])
}

/// One chunk in PyTorch, ms: the median of wall time, and of processor time.
struct Eager {
    wall: f64,
    cpu: f64,
    version: String,
}

fn compare(
    bench: &Bench,
    python: &Path,
    mut own: impl FnMut() -> Result<(Vec<f64>, Vec<f64>), Failure>,
) -> Result<Vec<Figure>, Failure> {
    let chunks = bench.choose("200", "20");
    let (mut theirs, mut ours) = (Vec::new(), Vec::new());
    for run in 0..bench.runs {
        bench.progress(&format!("policy: PyTorch, run {} of {}", run + 1, bench.runs));
        theirs.push(eager(bench, python, chunks)?);
        let (wall, cpu) = own()?;
        let p50 = |samples: Vec<f64>| Sorted::new(samples).quantile(0.5).unwrap_or_default();
        ours.push((p50(wall), p50(cpu)));
    }
    let version = theirs.first().map_or("", |eager| &eager.version);
    let note = format!(
        "PyTorch {version}, {chunks} chunks a run, one thread; the same weights, steps and shapes, without pictures to decode. \
         Baseline: the sampler"
    );
    let of = |value: fn((&Eager, &(f64, f64))) -> f64| median(&theirs.iter().zip(&ours).map(value).collect::<Vec<_>>());
    Ok(vec![
        Figure::new("policy/PyTorch eager, p50", "ms", of(|(theirs, _)| theirs.wall))
            .baseline(of(|(_, ours)| ours.0))
            .note(note),
        Figure::new("policy/faster than PyTorch eager", "x", of(|(theirs, ours)| theirs.wall / ours.0))
            .target(">= 2.5")
            .note("the median of the runs, by the clock on the wall"),
        Figure::new("policy/faster than PyTorch eager, cpu", "x", of(|(theirs, ours)| theirs.cpu / ours.1))
            .note("the same by the processor's own time"),
    ])
}

fn eager(bench: &Bench, python: &Path, chunks: &str) -> Result<Eager, Failure> {
    let bundle = std::path::absolute(&bench.bundle)?;
    let mut command = Command::new(python);
    command.arg(SCRIPT).arg(bundle).args(["--json", "--threads", "1", "--chunks", chunks]);
    // As in the training: waiting threads do not spin.
    let output = command.env("OMP_WAIT_POLICY", "PASSIVE").output()?;
    if !output.status.success() {
        return Err(format!("{SCRIPT}: {}", String::from_utf8_lossy(&output.stderr).trim()).into());
    }
    let report: Value = serde_json::from_slice(&output.stdout)?;
    let number = |name: &str| report["ms"]["pytorch_eager"][name].as_f64().ok_or_else(|| format!("no {name}"));
    let version = report["torch"].as_str().unwrap_or("?").to_owned();
    Ok(Eager { wall: number("p50")?, cpu: number("cpu_p50")?, version })
}

/// The environment created by `scripts/train.sh`, if it is complete.
fn python() -> Option<PathBuf> {
    let cache = std::env::var_os("XDG_CACHE_HOME").filter(|path| !path.is_empty()).map(PathBuf::from);
    let cache = cache.or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cache")))?;
    let venv = cache.join("rapid/train-venv");
    let python = venv.join("bin/python");
    (venv.join("stamp").is_file() && python.is_file()).then_some(python)
}
