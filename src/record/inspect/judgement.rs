//! What is to be said of a file: the verdict on an episode, or why there is none.

use serde::{Serialize, Serializer};

use crate::status::{Grade, Sensors, Verdict};

/// Reason of a file that has no verdict.
const NOT_OURS: &str = "not an episode of rapid";

/// What a file is worth. As JSON `verdict`, which is `null` without one, `reasons` and `sensors`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Judgement {
    /// It is an episode.
    Episode(Verdict),
    /// Another program wrote it, or nothing in it is an episode's.
    NotOurs,
    /// It cannot be read, or is no MCAP file; the text says why.
    Unreadable(String),
}

impl Judgement {
    /// The verdict, if there is one.
    #[must_use]
    pub fn verdict(&self) -> Option<&Verdict> {
        match self {
            Self::Episode(verdict) => Some(verdict),
            Self::NotOurs | Self::Unreadable(_) => None,
        }
    }

    /// Its word, if there is one.
    #[must_use]
    pub fn grade(&self) -> Option<Grade> {
        self.verdict().map(|verdict| verdict.grade)
    }

    /// Why it is not GOOD, or has no verdict.
    #[must_use]
    pub fn reasons(&self) -> Vec<&str> {
        match self {
            Self::Episode(verdict) => verdict.reasons.iter().map(String::as_str).collect(),
            Self::NotOurs => vec![NOT_OURS],
            Self::Unreadable(why) => vec![why],
        }
    }
}

impl Serialize for Judgement {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        #[derive(Serialize)]
        struct Json<'a> {
            verdict: Option<Grade>,
            reasons: Vec<&'a str>,
            sensors: Option<&'a Sensors>,
        }
        let sensors = self.verdict().and_then(|verdict| verdict.sensors.as_ref());
        Json { verdict: self.grade(), reasons: self.reasons(), sensors }.serialize(serializer)
    }
}
