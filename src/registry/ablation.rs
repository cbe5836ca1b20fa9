//! `ablation.toml`: which configurations of a gripper are compared, and how often.
//!
//! ```toml
//! task = "place block"            # optional: episodes of other tasks do not count
//! episodes = 20                   # of each configuration, default 10
//! tag = "finger"                  # the tag that names the finger, the default
//! fingers = ["rigid", "soft"]
//! modalities = ["vision", "vision+tactile"]
//! [words]                         # optional: the entries that a word of `modalities` stands for
//! vision = ["cam_wrist"]
//! ```
//!
//! Invariant: no text causes a panic; all problems are reported at once.

use std::collections::BTreeMap;
use std::path::Path;

use super::diagnostic::RegistryErrors;
use super::section::{Section, file_label, read, read_file};

/// What is compared.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AblationPlan {
    /// Episodes of other tasks do not count, if given.
    pub task: Option<String>,
    /// Episodes of each configuration.
    pub episodes: usize,
    /// Key of the tag whose value is the finger.
    pub tag: String,
    /// Fingers, by the values of that tag.
    pub fingers: Vec<String>,
    /// Sets of modalities: words separated by `+`.
    pub modalities: Vec<String>,
    /// The entries that a word stands for.
    pub words: BTreeMap<String, Vec<String>>,
}

impl Default for AblationPlan {
    fn default() -> Self {
        Self {
            task: None,
            episodes: 10,
            tag: "finger".to_owned(),
            fingers: Vec::new(),
            modalities: Vec::new(),
            words: BTreeMap::new(),
        }
    }
}

impl AblationPlan {
    /// Reads a plan.
    ///
    /// # Errors
    /// When the file cannot be read or is invalid: then all problems.
    pub fn load(path: &Path) -> Result<Self, RegistryErrors> {
        Self::parse(&read_file(path, "write one, or give --finger and --modality")?, path)
    }

    /// Reads the text of a plan; `path` names it in messages.
    ///
    /// # Errors
    /// All problems of the text.
    pub fn parse(text: &str, path: &Path) -> Result<Self, RegistryErrors> {
        read(&file_label(Some(path), ""), text, |root| Ok(Self::from_section(root)))
    }

    fn from_section(root: &Section<'_>) -> Self {
        root.allow(&["task", "episodes", "tag", "fingers", "modalities", "words"]);
        let task = root.text("task").map(str::to_owned);
        let mut plan = Self { task, ..Self::default() };
        plan.episodes = root.integer("episodes", 1..=1_000_000).unwrap_or(plan.episodes);
        plan.tag = root.text("tag").map_or(plan.tag, str::to_owned);
        for (key, list) in [("fingers", &mut plan.fingers), ("modalities", &mut plan.modalities)] {
            root.need(key, &format!("write {key} = [\"...\", \"...\"]"));
            *list = root.texts(key).unwrap_or_default();
            if root.has(key) && list.is_empty() && root.is_faultless() {
                root.report(key, format!("{key} is empty"), "name at least one");
            }
            if let Some(twice) = list.iter().enumerate().find(|(at, word)| list.iter().take(*at).any(|w| w == *word)) {
                root.report(key, format!("{:?} is listed twice", twice.1), "remove one");
            }
        }
        if let Some(words) = root.table("words") {
            for (_, word, _) in words.fields() {
                if let Some(entries) = words.texts(word) {
                    plan.words.insert(word.to_owned(), entries);
                }
            }
        }
        plan
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_parses_or_all_its_errors_are_reported() {
        let path = Path::new("ablation.toml");
        let text = "task = \"t\"\nepisodes = 3\nfingers = [\"rigid\"]\nmodalities = [\"vision\"]\n[words]\nvision = [\"cam\"]\n";
        let plan = AblationPlan::parse(text, path).unwrap();
        assert_eq!(
            (plan.episodes, plan.tag.as_str(), plan.fingers.as_slice()),
            (3, "finger", &["rigid".to_owned()][..])
        );
        assert_eq!(plan.words["vision"], ["cam"]);
        let wrong = "episodes = 0\nfingers = [\"a\", \"a\"]\nmodality = []\n";
        let errors = AblationPlan::parse(wrong, path).unwrap_err().to_string();
        for expected in ["out of range", "\"a\" is listed twice", "unknown key \"modality\"", "modalities is missing"] {
            assert!(errors.contains(expected), "{errors}");
        }
    }
}
