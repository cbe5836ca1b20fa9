//! Other programs that published on our topics: which, and how many samples.
//!
//! A rig has one publisher per topic. On the topic of a modality or of the mask, samples of another publisher are kept
//! out of the episode ([`rapid_bus::Inbox`]); on `/action`, while a policy runs, they are recorded, because the
//! actuator executes them. Either way the episode is SUSPECT and the program is the reason. A reader of the file knows
//! it from the event `publisher` and from the summary, which counts the samples.

use std::collections::BTreeMap;

use rapid_bus::Foreign;
use rapid_core::text;
use rapid_status::EventKind;
use serde::{Deserialize, Serialize};

/// Key of the metadata record at the end: JSON, a list of [`Publisher`].
pub(super) const KEY: &str = "publishers";
/// Most programs distinguished: a program that is restarted repeatedly must not fill the memory.
const MOST: usize = 64;
/// Characters of a command line that are kept.
const COMMAND: usize = 200;

/// A program that published on one of our topics.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Publisher {
    pub(super) topic: String,
    pub(super) process: u32,
    /// Its command line.
    pub(super) command: String,
    /// Samples it published; 0 if unknown.
    #[serde(default)]
    pub(super) samples: u64,
}

impl Publisher {
    /// Why an episode is SUSPECT.
    pub(super) fn reason(&self) -> String {
        let Self { topic, process, command, samples } = self;
        let count = match samples {
            0 => String::new(),
            1 => ", 1 sample".to_owned(),
            samples => format!(", {samples} samples"),
        };
        format!("another program published on {topic}: process {process} ({command}){count}")
    }
}

/// The foreign publishers of an episode, or of the time without one.
#[derive(Debug, Clone, Default)]
pub(super) struct Publishers(Vec<Publisher>);

impl Publishers {
    /// Counts samples. Returns the event of a program seen for the first time.
    pub(super) fn note(&mut self, seen: Foreign<'_>) -> Option<EventKind> {
        let known = |known: &&mut Publisher| known.process == seen.process && known.topic == seen.topic;
        if let Some(known) = self.0.iter_mut().find(known) {
            known.samples = known.samples.saturating_add(seen.samples);
            return None;
        }
        if self.0.len() == MOST {
            return None;
        }
        let (topic, process, command) = (seen.topic.to_owned(), seen.process, command(seen.process));
        let event = EventKind::Publisher { topic: topic.clone(), process, command: command.clone() };
        self.0.push(Publisher { topic, process, command, samples: seen.samples });
        Some(event)
    }

    /// Takes the event `publisher` of a file, as JSON.
    pub(super) fn event(&mut self, json: &str) {
        if let Ok(publisher) = serde_json::from_str::<Publisher>(json)
            && self.0.len() < MOST
            && !self.0.iter().any(|known| known.process == publisher.process && known.topic == publisher.topic)
        {
            self.0.push(publisher);
        }
    }

    /// Those counted in the summary of a file, otherwise those of its events.
    pub(super) fn or_summed_up(self, summary: &BTreeMap<String, String>) -> Self {
        let counted = summary.get(KEY).and_then(|json| serde_json::from_str(json).ok());
        counted.map_or(self, Self)
    }

    pub(super) fn list(&self) -> &[Publisher] {
        &self.0
    }
}

/// The command line of a process, proc(5), for people.
fn command(process: u32) -> String {
    let words = std::fs::read(format!("/proc/{process}/cmdline")).unwrap_or_default();
    let words = String::from_utf8_lossy(words.strip_suffix(b"\0").unwrap_or(&words)).replace('\0', " ");
    let words: String = text::plain(&words).chars().take(COMMAND).collect();
    if words.is_empty() { "ended".to_owned() } else { words }
}
