//! `rapid ablation`: which configurations of a gripper are still to be recorded.
//!
//! The plan names fingers and sets of modalities; the episodes contain what has been recorded. The meaning of the words
//! on a rig, and the configuration an episode belongs to, follow from both without I/O.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use rapid_core::text;
use rapid_episode::record::inspect::{self, Inspection, ReadError};
use rapid_registry::ablation::AblationPlan;
use rapid_registry::{DeviceSpec, Mount, NodeSpec, Registry, RegistryErrors, did_you_mean};
use rapid_status::Grade;
use serde_json::json;

use super::{Format, progress};
use crate::cli::{AblationArgs, Count};

/// Why no list is printed.
#[derive(Debug, thiserror::Error)]
pub enum AblationError {
    /// The file of the plan is invalid.
    #[error("{0}")]
    File(#[from] RegistryErrors),
    /// The plan does not match the registry.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// There is no plan.
    #[error("no plan: give --finger A,B and --modality X,X+Y, or write an ablation.toml (see --help)")]
    NoPlan,
    /// The episodes cannot be listed.
    #[error(transparent)]
    Episodes(#[from] ReadError),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

impl AblationError {
    /// Whether the arguments or the plan are at fault.
    pub const fn is_bad_argument(&self) -> bool {
        matches!(self, Self::File(_) | Self::Plan(_) | Self::NoPlan)
    }
}

/// Lists the configurations of the plan with the episodes recorded of each, and the command that records the
/// next; `config` is the registry's path if it was given.
///
/// # Errors
/// When there is no plan, it does not match the registry, or the episodes cannot be listed.
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
        match belongs(episode, &plan, &wanted, args.count) {
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

/// The episodes of a folder, and the number of unreadable files.
fn recorded(folder: &Path) -> Result<(Vec<Recorded>, usize), ReadError> {
    if !folder.exists() {
        return Ok((Vec::new(), 0));
    }
    let files: Vec<PathBuf> = inspect::episodes(&[folder.to_owned()])?;
    let mut unreadable = 0;
    let mut found = Vec::new();
    progress::each(&files, inspect::inspect, |_, inspected| {
        match inspected {
            Ok(episode) => found.push(recorded_from(episode)),
            Err(_) => unreadable += 1,
        }
        Ok::<_, ReadError>(())
    })?;
    Ok((found, unreadable))
}

fn recorded_from(episode: Inspection) -> Recorded {
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
    let missing = text::counted(missing as u64, "episode");
    writeln!(out, "{done} of {} done, {missing} to record", text::counted(wanted.len() as u64, "configuration"))?;
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

/// The metadata of a recorded file, and its verdict.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Recorded {
    /// The task, as given by the user.
    task: String,
    /// Tags of the user and of the modules.
    tags: BTreeMap<String, String>,
    /// Modalities that were present when it started, if the file contains them.
    present: Option<BTreeSet<String>>,
    /// Its verdict; none if it is not an episode of rapid.
    grade: Option<Grade>,
}

/// A word of the plan without a meaning on this rig.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// It is neither an entry, nor a module, nor a part of a name.
    #[error(
        "{word:?} in {modalities:?} matches no entry of the registry; {fix}, or define it under [words] of an ablation.toml"
    )]
    Word {
        /// The word.
        word: String,
        /// The set it is in.
        modalities: String,
        /// Known words, or the most similar one.
        fix: String,
    },
    /// Two sets select the same entries: no episode can distinguish them.
    #[error("{first:?} and {second:?} select the same entries ({entries}): no episode can distinguish them")]
    Same {
        /// One.
        first: String,
        /// The other.
        second: String,
        /// The entries of both.
        entries: String,
    },
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Configuration {
    /// Value of the finger's tag.
    finger: String,
    /// The set, as in the plan.
    modalities: String,
    /// Entries that are plugged in for it.
    plug: Vec<String>,
    /// Entries of the other sets, which stay unplugged.
    leave_out: Vec<String>,
}

/// Every configuration of a plan, ordered by finger first: changing one takes longest.
fn configurations(plan: &AblationPlan, registry: &Registry) -> Result<Vec<Configuration>, PlanError> {
    let mut sets: Vec<(&String, BTreeSet<String>)> = Vec::new();
    for modalities in &plan.modalities {
        let entries = entries_of(modalities, plan, registry)?;
        if let Some((first, _)) = sets.iter().find(|(_, other)| *other == entries) {
            let (first, second) = ((*first).clone(), modalities.clone());
            let entries = entries.into_iter().collect::<Vec<_>>().join(", ");
            return Err(PlanError::Same { first, second, entries });
        }
        sets.push((modalities, entries));
    }
    let all: BTreeSet<String> = sets.iter().flat_map(|(_, set)| set.clone()).collect();
    let of = |finger: &String, (modalities, set): &(&String, BTreeSet<String>)| Configuration {
        finger: finger.clone(),
        modalities: (*modalities).clone(),
        plug: set.iter().cloned().collect(),
        leave_out: all.difference(set).cloned().collect(),
    };
    Ok(plan.fingers.iter().flat_map(|finger| sets.iter().map(move |set| of(finger, set))).collect())
}

/// The entries that a set selects.
fn entries_of(modalities: &str, plan: &AblationPlan, registry: &Registry) -> Result<BTreeSet<String>, PlanError> {
    let mut entries = BTreeSet::new();
    for word in modalities.split('+').map(str::trim) {
        let found = entries_of_word(word, plan, registry);
        let unknown = found.iter().find(|name| registry.named(name).is_none());
        if found.is_empty() || unknown.is_some() {
            let mut known: Vec<&str> = registry.devices.iter().map(|device| device.name.as_str()).collect();
            known.extend(registry.modules.iter().map(|module| module.name.as_str()));
            let word = unknown.cloned().unwrap_or_else(|| word.to_owned());
            let fix = did_you_mean(&word, &known, "entries and modules are");
            return Err(PlanError::Word { word, modalities: modalities.to_owned(), fix });
        }
        entries.extend(found);
    }
    Ok(entries)
}

/// 1. The definition in the plan; 2. the entry of that name; 3. the sensors of the module of that name;
/// 4. the entries with that word in their names, as `tactile` in `tactile_tip`; 5. `vision`: the cameras that
///    are not in a fingertip.
fn entries_of_word(word: &str, plan: &AblationPlan, registry: &Registry) -> Vec<String> {
    let names = |is_meant: &dyn Fn(&DeviceSpec) -> bool| -> Vec<String> {
        registry.devices.iter().filter(|device| is_meant(device)).map(|device| device.name.clone()).collect()
    };
    if let Some(entries) = plan.words.get(word) {
        return entries.clone();
    }
    if registry.named(word).is_some() {
        return vec![word.to_owned()];
    }
    if let Some(module) = registry.modules.iter().find(|module| module.name == word && !module.devices.is_empty()) {
        return module.devices.clone();
    }
    let found = names(&|device| device.name.split('_').any(|part| part == word));
    if !found.is_empty() || word != "vision" {
        return found;
    }
    let slot = |device: &DeviceSpec| {
        let module = registry.modules.iter().find(|module| module.devices.contains(&device.name));
        device.mount.or_else(|| module.map(|module| module.mount))
    };
    names(&|device| matches!(device.node, NodeSpec::Camera(_)) && slot(device) != Some(Mount::Tip))
}

/// Why an episode counts for no configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Refused {
    NotOurs,
    Grade,
    Task,
    Finger,
    Sensors,
    Unreadable,
}

impl Refused {
    const fn word(self) -> &'static str {
        match self {
            Self::NotOurs => "not of rapid",
            Self::Grade => "of a verdict that does not count",
            Self::Task => "of another task",
            Self::Finger => "of no finger of the plan",
            Self::Sensors => "with other sensors",
            Self::Unreadable => "that cannot be read",
        }
    }
}

/// The configuration that an episode belongs to, as an index into `wanted`. Sensors in no set of the plan may
/// be present or not.
fn belongs(episode: &Recorded, plan: &AblationPlan, wanted: &[Configuration], count: Count) -> Result<usize, Refused> {
    let grade = episode.grade.ok_or(Refused::NotOurs)?;
    let counts = match count {
        Count::Good => grade == Grade::Good,
        Count::Suspect => grade != Grade::Bad,
        Count::Any => true,
    };
    if !counts {
        return Err(Refused::Grade);
    }
    if plan.task.as_ref().is_some_and(|task| *task != episode.task) {
        return Err(Refused::Task);
    }
    let finger = episode.tags.get(&plan.tag).filter(|finger| plan.fingers.contains(finger)).ok_or(Refused::Finger)?;
    let present = episode.present.as_ref().ok_or(Refused::Sensors)?;
    let is_it = |wanted: &Configuration| {
        wanted.finger == *finger
            && wanted.plug.iter().all(|name| present.contains(name))
            && !wanted.leave_out.iter().any(|name| present.contains(name))
    };
    wanted.iter().position(is_it).ok_or(Refused::Sensors)
}

/// The command that records an episode of a configuration.
fn next_command(
    wanted: &Configuration,
    plan: &AblationPlan,
    registry: &Registry,
    config: Option<&Path>,
    folder: &Path,
) -> String {
    let has_tag = |module: &&rapid_registry::ModuleSpec| {
        module.tags.iter().any(|(key, value)| *key == plan.tag && *value == wanted.finger)
    };
    let mut words = vec!["rapid".to_owned()];
    if let Some(config) = config {
        words.extend(["--config".to_owned(), config.display().to_string()]);
    }
    words.extend(["--record".to_owned(), "--out".to_owned(), folder.display().to_string()]);
    if let Some(task) = &plan.task {
        words.extend(["--task".to_owned(), task.clone()]);
    }
    match registry.modules.iter().find(has_tag) {
        Some(module) if module.devices.is_empty() => words.extend(["--module".to_owned(), module.name.clone()]),
        // The presence of all its sensors identifies it.
        Some(module) if module.devices.iter().all(|device| wanted.plug.contains(device)) => {}
        _ => words.extend(["--tag".to_owned(), format!("{}={}", plan.tag, wanted.finger)]),
    }
    words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ")
}

/// A word, quoted for a shell.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./=+:,@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', "'\\''"))
}

#[cfg(test)]
mod tests {
    use rapid_registry::BUILTIN;

    use super::*;

    fn registry() -> Registry {
        let modules = "\n[module.get]\nslot = \"tip\"\ntags = [\"finger=tactile\"]\ndevices = [\"tactile_tip\"]\n\
            [module.soft_tip]\nslot = \"tip\"\ntags = [\"finger=soft\"]\n";
        Registry::parse(&format!("{BUILTIN}{modules}"), None).unwrap().registry
    }

    fn plan(fingers: &[&str], modalities: &[&str]) -> AblationPlan {
        let owned = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect();
        AblationPlan { fingers: owned(fingers), modalities: owned(modalities), ..AblationPlan::default() }
    }

    fn episode(finger: &str, present: &[&str], grade: Grade) -> Recorded {
        Recorded {
            task: "t".into(),
            tags: [("finger".to_owned(), finger.to_owned())].into(),
            present: Some(present.iter().map(|name| (*name).to_owned()).collect()),
            grade: Some(grade),
        }
    }

    #[test]
    fn words_select_entries() {
        let means = |words: &str| {
            let found = configurations(&plan(&["a"], &[words]), &registry()).map(|found| found[0].plug.join(" "));
            found.unwrap_or_else(|error| error.to_string())
        };
        for (words, expected) in [
            ("vision", "cam_wrist"),
            ("vision+tactile", "cam_wrist tactile_tip"),
            ("vision+motor", "cam_wrist motor_state"),
            ("get", "tactile_tip"),
            ("cam_wrist + motor_state", "cam_wrist motor_state"),
        ] {
            assert_eq!(means(words), expected, "{words}");
        }
        assert!(
            means("vision+force").contains("\"force\" in \"vision+force\" matches no entry"),
            "{}",
            means("vision+force")
        );
        assert!(means("cam_wirst").contains("did you mean \"cam_wrist\""));
        assert!(means("soft_tip").contains("matches no entry"), "a module without sensors");
        let same = configurations(&plan(&["a"], &["vision", "cam_wrist"]), &registry()).unwrap_err().to_string();
        assert!(same.contains("no episode can distinguish them"), "{same}");
        let mut defined = plan(&["a"], &["eyes"]);
        defined.words.insert("eyes".into(), vec!["cam_wrist".into(), "nothing".into()]);
        assert!(configurations(&defined, &registry()).unwrap_err().to_string().contains("\"nothing\""));
    }

    #[test]
    fn an_episode_belongs_to_one_configuration_or_none() {
        use Grade::{Bad, Good, Suspect};
        let mut plan = plan(&["rigid", "soft"], &["vision", "vision+tactile"]);
        let wanted = configurations(&plan, &registry()).unwrap();
        assert_eq!(wanted.len(), 4);
        for (episode, count, expected) in [
            (episode("rigid", &["cam_wrist"], Good), Count::Suspect, Ok(0)),
            (episode("rigid", &["cam_wrist", "motor_state"], Good), Count::Suspect, Ok(0)),
            (episode("soft", &["cam_wrist", "tactile_tip"], Suspect), Count::Suspect, Ok(3)),
            (episode("soft", &["cam_wrist", "tactile_tip"], Suspect), Count::Good, Err(Refused::Grade)),
            (episode("soft", &["cam_wrist"], Bad), Count::Suspect, Err(Refused::Grade)),
            (episode("soft", &["cam_wrist"], Bad), Count::Any, Ok(2)),
            (episode("hard", &["cam_wrist"], Good), Count::Suspect, Err(Refused::Finger)),
            (episode("soft", &["tactile_tip"], Good), Count::Suspect, Err(Refused::Sensors)),
            (Recorded { grade: None, ..episode("soft", &["cam_wrist"], Good) }, Count::Any, Err(Refused::NotOurs)),
            (Recorded { present: None, ..episode("soft", &[], Good) }, Count::Suspect, Err(Refused::Sensors)),
        ] {
            assert_eq!(belongs(&episode, &plan, &wanted, count), expected, "{episode:?}");
        }
        plan.task = Some("other".into());
        let other = episode("rigid", &["cam_wrist"], Good);
        assert_eq!(belongs(&other, &plan, &wanted, Count::Suspect), Err(Refused::Task));
    }

    #[test]
    fn the_next_command_names_the_finger_unless_its_sensors_identify_it() {
        let mut plan = plan(&["soft", "tactile", "it's"], &["vision", "vision+tactile"]);
        plan.task = Some("place block".into());
        let wanted = configurations(&plan, &registry()).unwrap();
        let command = |at: usize| next_command(&wanted[at], &plan, &registry(), None, Path::new("out"));
        let begin = "rapid --record --out out --task 'place block'";
        assert_eq!(command(0), format!("{begin} --module soft_tip"));
        assert_eq!(command(2), format!("{begin} --tag finger=tactile"));
        assert_eq!(command(3), begin);
        assert_eq!(command(4), format!("{begin} --tag 'finger=it'\\''s'"));
        let config = Some(Path::new("my rig.toml"));
        let with_config = next_command(&wanted[3], &plan, &registry(), config, Path::new("out"));
        assert_eq!(with_config, begin.replace("rapid", "rapid --config 'my rig.toml'"));
    }
}
