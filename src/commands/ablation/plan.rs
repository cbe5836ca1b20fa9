//! What the words of a plan mean on a rig, and which configuration an episode is of.
//!
//! Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use crate::cli::Count;
use crate::registry::ablation::AblationPlan;
use crate::registry::{DeviceSpec, Mount, NodeSpec, Registry, did_you_mean};
use crate::status::Grade;

/// What a recorded file states about itself, and what it is worth.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Recorded {
    /// The task in the user's words.
    pub(super) task: String,
    /// Tags of the user and of the modules.
    pub(super) tags: BTreeMap<String, String>,
    /// Modalities that were present when it began, if the file states it.
    pub(super) present: Option<BTreeSet<String>>,
    /// The word of its verdict; none if it is not an episode of rapid.
    pub(super) grade: Option<Grade>,
}

/// A word of the plan that means nothing on this rig.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// It is no entry, no module and no part of a name.
    #[error(
        "{word:?} in {modalities:?} means no entry of the registry; {fix}, or say what it means under [words] of an ablation.toml"
    )]
    Word {
        /// The word.
        word: String,
        /// The set it is in.
        modalities: String,
        /// What there is.
        fix: String,
    },
    /// Two sets mean the same entries: no episode can tell them apart.
    #[error("{first:?} and {second:?} mean the same entries ({entries}): no episode can tell them apart")]
    Same {
        /// One.
        first: String,
        /// The other.
        second: String,
        /// What both mean.
        entries: String,
    },
}

/// One configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Configuration {
    /// Value of the finger's tag.
    pub(super) finger: String,
    /// The set, as in the plan.
    pub(super) modalities: String,
    /// Entries that are plugged in for it.
    pub(super) plug: Vec<String>,
    /// Entries of the other sets, which are not.
    pub(super) leave_out: Vec<String>,
}

/// Every configuration of a plan, the fingers outside: changing one takes longest.
pub(super) fn configurations(plan: &AblationPlan, registry: &Registry) -> Result<Vec<Configuration>, PlanError> {
    let mut sets: Vec<(&String, BTreeSet<String>)> = Vec::new();
    for modalities in &plan.modalities {
        let entries = meant(modalities, plan, registry)?;
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

/// The entries that a set means.
fn meant(modalities: &str, plan: &AblationPlan, registry: &Registry) -> Result<BTreeSet<String>, PlanError> {
    let mut entries = BTreeSet::new();
    for word in modalities.split('+').map(str::trim) {
        let found = word_means(word, plan, registry);
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

/// 1. What the plan says it means; 2. the entry of that name; 3. the sensors of the module of that name;
/// 4. the entries with that word in their names, as `tactile` in `tactile_tip`; 5. `vision`: the cameras that
///    do not sit in a fingertip.
fn word_means(word: &str, plan: &AblationPlan, registry: &Registry) -> Vec<String> {
    let names = |is_meant: &dyn Fn(&DeviceSpec) -> bool| -> Vec<String> {
        registry.devices.iter().filter(|device| is_meant(device)).map(|device| device.name.clone()).collect()
    };
    if let Some(said) = plan.words.get(word) {
        return said.clone();
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
pub(super) enum Refused {
    NotOurs,
    Grade,
    Task,
    Finger,
    Sensors,
    Unreadable,
}

impl Refused {
    pub(super) const fn word(self) -> &'static str {
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

/// The configuration that an episode is of, by its place in `wanted`. Sensors that no set of the plan
/// means may be there or not.
pub(super) fn belongs(
    episode: &Recorded,
    plan: &AblationPlan,
    wanted: &[Configuration],
    count: Count,
) -> Result<usize, Refused> {
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
pub(super) fn next_command(
    wanted: &Configuration,
    plan: &AblationPlan,
    registry: &Registry,
    config: Option<&Path>,
    folder: &Path,
) -> String {
    let has_tag = |module: &&crate::registry::ModuleSpec| {
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
        // Its sensors tell, if all of them are plugged in.
        Some(module) if module.devices.iter().all(|device| wanted.plug.contains(device)) => {}
        _ => words.extend(["--tag".to_owned(), format!("{}={}", plan.tag, wanted.finger)]),
    }
    words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ")
}

/// A word as a shell reads it whole.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./=+:,@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', "'\\''"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registry::BUILTIN;

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
    fn words_mean_entries() {
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
            means("vision+force").contains("\"force\" in \"vision+force\" means no entry"),
            "{}",
            means("vision+force")
        );
        assert!(means("cam_wirst").contains("did you mean \"cam_wrist\""));
        assert!(means("soft_tip").contains("means no entry"), "a module without sensors");
        let same = configurations(&plan(&["a"], &["vision", "cam_wrist"]), &registry()).unwrap_err().to_string();
        assert!(same.contains("no episode can tell them apart"), "{same}");
        let mut said = plan(&["a"], &["eyes"]);
        said.words.insert("eyes".into(), vec!["cam_wrist".into(), "nothing".into()]);
        assert!(configurations(&said, &registry()).unwrap_err().to_string().contains("\"nothing\""));
    }

    #[test]
    fn an_episode_is_of_one_configuration_or_none() {
        use Grade::{Bad, Good, Suspect};
        let mut plan = plan(&["rigid", "soft"], &["vision", "vision+tactile"]);
        let wanted = configurations(&plan, &registry()).unwrap();
        assert_eq!(wanted.len(), 4);
        for (said, count, expected) in [
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
            assert_eq!(belongs(&said, &plan, &wanted, count), expected, "{said:?}");
        }
        plan.task = Some("other".into());
        let said = episode("rigid", &["cam_wrist"], Good);
        assert_eq!(belongs(&said, &plan, &wanted, Count::Suspect), Err(Refused::Task));
    }

    #[test]
    fn the_next_command_says_the_finger_unless_its_sensors_do() {
        let mut plan = plan(&["soft", "tactile", "it's"], &["vision", "vision+tactile"]);
        plan.task = Some("place block".into());
        let wanted = configurations(&plan, &registry()).unwrap();
        let said = |at: usize| next_command(&wanted[at], &plan, &registry(), None, Path::new("out"));
        let begin = "rapid --record --out out --task 'place block'";
        assert_eq!(said(0), format!("{begin} --module soft_tip"));
        assert_eq!(said(2), format!("{begin} --tag finger=tactile"));
        assert_eq!(said(3), begin);
        assert_eq!(said(4), format!("{begin} --tag 'finger=it'\\''s'"));
        let config = Some(Path::new("my rig.toml"));
        let said = next_command(&wanted[3], &plan, &registry(), config, Path::new("out"));
        assert_eq!(said, begin.replace("rapid", "rapid --config 'my rig.toml'"));
    }
}
