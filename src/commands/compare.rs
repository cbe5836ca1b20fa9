//! `rapid replay FILE --infer`: a policy compared with a recorded episode.

use std::io::{self, Write};
use std::path::Path;

use rapid_core::text;
use rapid_policy::bundle::{Bundle, BundleErrors};
use rapid_policy::onnxruntime::{Environment, LibraryError};
use rapid_registry::InferenceSpec;

use super::Format;
use super::progress::Bar;
use crate::cli::ReplayArgs;
use crate::compare::{self, Again, Beside, CompareError, Compared, Comparison, Difference, Spread, Watcher};

/// Differences up to this come from the order of floating-point additions, which depends on the machine.
const USUAL_TOLERANCE: f64 = 1e-4;

/// Why there is no comparison, or why it failed.
#[derive(Debug, thiserror::Error)]
pub enum CompareFailure {
    /// The bundle.
    #[error(transparent)]
    Bundle(#[from] BundleErrors),
    /// onnxruntime.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// The comparison.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// A larger difference than allowed.
    #[error("{file}: the actions differ by {found:.3e}, more than --tolerance {tolerance:e}")]
    Beyond {
        /// The episode.
        file: String,
        /// The largest.
        found: f64,
        /// What was allowed.
        tolerance: f64,
    },
    /// A tolerance was given, but there is no difference to compare it with.
    #[error("{file}: {why}, so there is no difference to compare with --tolerance")]
    Incomparable {
        /// The episode.
        file: String,
        /// Why.
        why: &'static str,
    },
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

struct ProgressBar<'a> {
    bar: Option<Bar>,
    wanted: bool,
    stop: &'a dyn Fn() -> bool,
}

impl Watcher for ProgressBar<'_> {
    fn at(&mut self, done: usize, total: usize) -> bool {
        let wanted = self.wanted;
        self.bar.get_or_insert_with(|| Bar::new("comparing", total, wanted)).at(done);
        !(self.stop)()
    }
}

/// Compares, and prints the result. Ends early when `stop` returns true, and prints the result so far.
///
/// # Errors
/// When the policy or the file cannot be used, or the difference is larger than allowed.
pub fn run(
    args: &ReplayArgs,
    format: Format,
    stop: &dyn Fn() -> bool,
    out: &mut dyn Write,
) -> Result<(), CompareFailure> {
    let bundle = Bundle::open(args.infer.as_ref().and_then(Option::as_deref))?;
    let environment = Environment::open(args.inference.ort_lib.as_deref())?;
    let mut progress = ProgressBar { bar: None, wanted: format == Format::Text, stop };
    let compared = compare::compare(
        &args.file,
        &bundle,
        &environment,
        args.inference.computing(InferenceSpec::default()),
        &mut progress,
    )?;
    drop(progress);
    match format {
        Format::Json => writeln!(out, "{}", json(&compared, &bundle, args)?)?,
        Format::Text => print(&compared, &bundle, &args.file, args.tolerance, out)?,
    }
    judge(&compared, args)
}

fn judge(compared: &Compared, args: &ReplayArgs) -> Result<(), CompareFailure> {
    let Some(tolerance) = args.tolerance else { return Ok(()) };
    let file = args.file.display().to_string();
    let Comparison::Again(again) = &compared.comparison else {
        return Err(CompareFailure::Incomparable { file, why: "no policy recorded it" });
    };
    match again.largest() {
        None => Err(CompareFailure::Incomparable { file, why: "none of its chunks could be computed again" }),
        Some(found) if found > tolerance => Err(CompareFailure::Beyond { file, found, tolerance }),
        Some(_) => Ok(()),
    }
}

fn json(compared: &Compared, bundle: &Bundle, args: &ReplayArgs) -> Result<String, io::Error> {
    let mut value = serde_json::to_value(compared)?;
    value["event"] = "comparison".into();
    value["file"] = args.file.display().to_string().into();
    (value["policy"], value["policy_hash"]) = (bundle.name.clone().into(), bundle.hash.clone().into());
    if let Comparison::Again(again) = &compared.comparison {
        let tolerance = args.tolerance.unwrap_or(USUAL_TOLERANCE);
        value["tolerance"] = tolerance.into();
        value["within"] = again.largest().map(|largest| largest <= tolerance).into();
    }
    Ok(text::json(&value)?)
}

fn print(
    compared: &Compared,
    bundle: &Bundle,
    file: &Path,
    tolerance: Option<f64>,
    out: &mut dyn Write,
) -> io::Result<()> {
    let (file, name) = (file.display().to_string(), text::plain(&bundle.name));
    let file = text::plain(&file);
    match &compared.comparison {
        Comparison::Again(again) => {
            let by = compared.recorded_policy.as_deref().unwrap_or("a policy");
            writeln!(out, "{file}: recorded by {}, computed again by {name}\n", text::plain(by))?;
            if compared.recorded_policy_hash.as_ref().is_some_and(|hash| *hash != bundle.hash) {
                writeln!(out, "another policy: the bundle differs from that of the recording\n")?;
            }
            print_again(again, tolerance.unwrap_or(USUAL_TOLERANCE), out)?;
        }
        Comparison::Beside(beside) => {
            writeln!(out, "{file}: a demonstration, compared with {name}\n")?;
            print_beside(beside, bundle, out)?;
        }
    }
    if let Some(damage) = &compared.damage {
        writeln!(out, "\n{}", text::plain(damage))?;
    }
    if compared.interrupted {
        writeln!(out, "\ninterrupted: the above covers a part of the episode")?;
    }
    Ok(())
}

fn print_again(again: &Again, tolerance: f64, out: &mut dyn Write) -> io::Result<()> {
    writeln!(out, "{}, {} computed again", text::counted(again.chunks, "chunk"), again.compared)?;
    let others = [
        (
            again.samples_missing,
            "not compared: some of their samples are not in the file (captured before it started, or lost)",
        ),
        (
            again.reference_unknown,
            "not compared: the first sample of the run, the reference for all others, is neither attached nor known to be \
             in the file",
        ),
        (again.unlike, "not compared: their observations or length differ from this policy's"),
        (again.unreadable, "not compared: their events cannot be read"),
        (again.failed, "not compared: the policy failed"),
    ];
    print_others(&others, again.failure.as_deref(), out)?;
    if again.compared > 0 {
        table(&again.difference, out)?;
    }
    let actions = &again.actions;
    if actions.recorded > 0 {
        let recorded = text::counted(actions.recorded, "action");
        writeln!(out, "\n{recorded}, {} compared with those of the chunks", actions.compared)?;
        print_others(
            &[(actions.without_chunk, "not compared: no chunk in the file is known to be theirs")],
            None,
            out,
        )?;
        if actions.compared > 0 {
            table(&actions.difference, out)?;
        }
    }
    match again.largest() {
        None => writeln!(out, "\nnothing could be compared"),
        Some(largest) if largest <= tolerance => writeln!(out, "\nwithin {tolerance:e}"),
        Some(largest) => writeln!(out, "\nbeyond {tolerance:e}: {largest:.3e}"),
    }
}

fn print_beside(beside: &Beside, bundle: &Bundle, out: &mut dyn Write) -> io::Result<()> {
    let Beside { ticks, compared, recorded, counts, .. } = beside;
    writeln!(
        out,
        "{} at {} Hz, {}, {}; {compared} compared",
        text::counted(*ticks, "tick"),
        text::hertz(bundle.control_hz),
        text::counted(*recorded, "recorded action"),
        text::counted(counts.chunks, "chunk")
    )?;
    print_others(&[(beside.without_recorded, "not compared: no action was recorded then")], None, out)?;
    for (reason, held) in &beside.held {
        writeln!(out, "  {held} not compared: {reason}")?;
    }
    if let Some(failure) = &beside.failure {
        writeln!(out, "    {}", text::plain(failure))?;
    }
    if *compared > 0 { table(&beside.difference, out) } else { writeln!(out, "\nnothing could be compared") }
}

fn print_others(others: &[(u64, &str)], failure: Option<&str>, out: &mut dyn Write) -> io::Result<()> {
    for (count, what) in others.iter().filter(|(count, _)| *count > 0) {
        writeln!(out, "  {count} {what}")?;
    }
    failure.map_or(Ok(()), |failure| writeln!(out, "    {}", text::plain(failure)))
}

fn table(difference: &Difference, out: &mut dyn Write) -> io::Result<()> {
    writeln!(out, "\ndifference        mean       largest    at tick")?;
    let mut line = |name: &str, unit: &str, spread: &Spread| {
        let (name, unit) = (text::left(&text::plain(name), 12, "…"), text::left(&text::plain(unit), 4, "…"));
        writeln!(out, "{name} {unit} {:<10} {:<10} {}", number(spread.mean), number(spread.largest), spread.at_tick)
    };
    for axis in &difference.axes {
        line(&axis.name, &axis.unit, &axis.spread)?;
    }
    line("all", "", &difference.all)
}

/// A value in few characters, whatever its magnitude.
fn number(value: f64) -> String {
    if value == 0.0 {
        "0".to_owned()
    } else if (1e-3..1e4).contains(&value) {
        format!("{value:.4}")
    } else {
        format!("{value:.2e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        for (value, text) in [(0.0, "0"), (0.0123, "0.0123"), (1.19e-7, "1.19e-7"), (f64::INFINITY, "inf")] {
            assert_eq!(number(value), text);
        }
    }
}
