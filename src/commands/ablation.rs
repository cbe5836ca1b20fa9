//! `rapid ablation`: which configurations of a gripper are still to be recorded.
//!
//! The plan says fingers and sets of modalities; what has been recorded, the episodes say themselves.

mod plan;

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde_json::json;

use self::plan::{Configuration, Recorded, Refused, configurations, next_command};
use super::{Format, episodes};
use crate::cli::AblationArgs;
use crate::record::inspect::{self, InspectError, Inspection};
use crate::registry::ablation::AblationPlan;
use crate::registry::{Registry, RegistryErrors};
use crate::text;

pub use plan::PlanError;

/// Why there is no list.
#[derive(Debug, thiserror::Error)]
pub enum AblationError {
    /// The file of the plan is wrong.
    #[error("{0}")]
    File(#[from] RegistryErrors),
    /// The plan does not go with the registry.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// There is no plan.
    #[error("no plan: say --finger A,B and --modality X,X+Y, or write an ablation.toml (see --help)")]
    NoPlan,
    /// The episodes cannot be listed.
    #[error(transparent)]
    Episodes(#[from] InspectError),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

impl AblationError {
    /// Was it asked for something that cannot be?
    #[must_use]
    pub const fn is_bad_argument(&self) -> bool {
        matches!(self, Self::File(_) | Self::Plan(_) | Self::NoPlan)
    }
}

/// Lists the configurations of the plan with the episodes recorded of each, and says what is next, with the
/// registry by the name it was given here.
///
/// # Errors
/// When there is no plan, it does not go with the registry, or the episodes cannot be listed.
pub fn ablation(
    registry: &Registry,
    config: Option<&Path>,
    args: &AblationArgs,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), AblationError> {
    let plan = plan_of(args)?;
    let wanted = configurations(&plan, registry)?;
    let (recorded, unreadable) = recorded(&args.folder)?;
    let mut counts = vec![0_usize; wanted.len()];
    let mut not_counted: BTreeMap<&str, usize> = BTreeMap::new();
    for episode in &recorded {
        match plan::belongs(episode, &plan, &wanted, args.count) {
            Ok(at) => counts.iter_mut().skip(at).take(1).for_each(|count| *count += 1),
            Err(refused) => *not_counted.entry(refused.word()).or_default() += 1,
        }
    }
    if unreadable > 0 {
        not_counted.insert(Refused::Unreadable.word(), unreadable);
    }
    let next = wanted.iter().zip(&counts).find(|(_, count)| **count < plan.episodes).map(|(wanted, _)| wanted);
    let command = next.map(|next| next_command(next, &plan, registry, config, &args.folder));
    match format {
        Format::Json => write_json(&plan, &wanted, &counts, &not_counted, next.zip(command.as_deref()), out)?,
        Format::Text => {
            write_text(&plan, &wanted, &counts, &not_counted, out)?;
            match next.zip(command) {
                None => writeln!(out, "Everything is recorded.")?,
                Some((next, command)) => {
                    writeln!(out, "Next: {} with {}", next.finger, next.modalities)?;
                    writeln!(out, "  plug in    {}", listed(&next.plug))?;
                    writeln!(out, "  leave out  {}", listed(&next.leave_out))?;
                    writeln!(out, "  {command}")?;
                }
            }
        }
    }
    Ok(())
}

fn listed(names: &[String]) -> String {
    if names.is_empty() { "nothing".to_owned() } else { names.join(", ") }
}

fn plan_of(args: &AblationArgs) -> Result<AblationPlan, AblationError> {
    let usual = Path::new("ablation.toml");
    let mut plan = match &args.plan {
        Some(path) => AblationPlan::load(path)?,
        None if args.finger.is_empty() && args.modality.is_empty() && usual.exists() => AblationPlan::load(usual)?,
        None => AblationPlan::default(),
    };
    if !args.finger.is_empty() {
        plan.fingers.clone_from(&args.finger);
    }
    if !args.modality.is_empty() {
        plan.modalities.clone_from(&args.modality);
    }
    plan.episodes = args.episodes.unwrap_or(plan.episodes);
    plan.task = args.task.clone().or(plan.task);
    if plan.fingers.is_empty() || plan.modalities.is_empty() { Err(AblationError::NoPlan) } else { Ok(plan) }
}

/// What the episodes of a folder are, and how many files cannot be read.
fn recorded(folder: &Path) -> Result<(Vec<Recorded>, usize), InspectError> {
    if !folder.exists() {
        return Ok((Vec::new(), 0));
    }
    let files: Vec<PathBuf> = inspect::episodes(&[folder.to_owned()])?;
    let mut unreadable = 0;
    let mut found = Vec::new();
    episodes::each(&files, inspect::inspect, |_, inspected| {
        match inspected {
            Ok(episode) => found.push(of(episode)),
            Err(_) => unreadable += 1,
        }
        Ok::<_, InspectError>(())
    })?;
    Ok((found, unreadable))
}

fn of(episode: Inspection) -> Recorded {
    let Inspection { task, tags, present_at_begin, verdict, .. } = episode;
    Recorded { task, tags, present: present_at_begin, grade: verdict.grade() }
}

fn write_text(
    plan: &AblationPlan,
    wanted: &[Configuration],
    counts: &[usize],
    not_counted: &BTreeMap<&str, usize>,
    out: &mut dyn Write,
) -> io::Result<()> {
    let widest = |word: fn(&Configuration) -> &str, title: &str| {
        wanted.iter().map(|wanted| text::width(word(wanted))).max().unwrap_or(0).max(title.len()).min(40)
    };
    let (finger, modalities) =
        (widest(|wanted| &wanted.finger, &plan.tag), widest(|wanted| &wanted.modalities, "modalities"));
    let cell = |word: &str, columns| text::left(&text::plain(word), columns, "...");
    writeln!(out, "{}  {}  episodes", cell(&plan.tag, finger), cell("modalities", modalities))?;
    for (wanted, count) in wanted.iter().zip(counts) {
        let missing = plan.episodes.saturating_sub(*count);
        let state = if missing == 0 { "done".to_owned() } else { format!("{missing} to record") };
        let (finger, modalities) = (cell(&wanted.finger, finger), cell(&wanted.modalities, modalities));
        writeln!(out, "{finger}  {modalities}  {count:>3} of {}  {state}", plan.episodes)?;
    }
    let done = counts.iter().filter(|count| **count >= plan.episodes).count();
    let missing: usize = counts.iter().map(|count| plan.episodes.saturating_sub(*count)).sum();
    writeln!(out, "{done} of {} configurations done, {missing} episodes to record", wanted.len())?;
    for (why, count) in not_counted {
        writeln!(out, "not counted: {count} {why}")?;
    }
    Ok(())
}

fn write_json(
    plan: &AblationPlan,
    wanted: &[Configuration],
    counts: &[usize],
    not_counted: &BTreeMap<&str, usize>,
    next: Option<(&Configuration, &str)>,
    out: &mut dyn Write,
) -> io::Result<()> {
    let mut line = |value: serde_json::Value| writeln!(out, "{}", text::json(&value).map_err(io::Error::from)?);
    for (wanted, count) in wanted.iter().zip(counts) {
        line(json!({
            "event": "configuration", "tag": plan.tag, "finger": wanted.finger, "modalities": wanted.modalities,
            "plug": wanted.plug, "leave_out": wanted.leave_out, "episodes": count, "wanted": plan.episodes,
            "done": *count >= plan.episodes,
        }))?;
    }
    line(json!({ "event": "not_counted", "episodes": not_counted }))?;
    match next {
        None => line(json!({ "event": "done" })),
        Some((next, command)) => line(json!({
            "event": "next", "finger": next.finger, "modalities": next.modalities, "plug": next.plug,
            "leave_out": next.leave_out, "command": command,
        })),
    }
}
