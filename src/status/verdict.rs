//! The verdict on an episode: a word, and a sentence for everything that speaks against it.

use serde::Serialize;

/// What an episode is worth, as far as its data say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum Grade {
    /// Nothing speaks against it.
    #[default]
    Good,
    /// Look at it before it is used.
    Suspect,
    /// Do not use it.
    Bad,
}

impl Grade {
    /// The word for it, as in JSON.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Good => "GOOD",
            Self::Suspect => "SUSPECT",
            Self::Bad => "BAD",
        }
    }
}

/// The verdict on one episode. As JSON: `{"verdict":"SUSPECT","reasons":["..."]}`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct Verdict {
    /// The word.
    #[serde(rename = "verdict")]
    pub grade: Grade,
    /// Why it is not GOOD, the gravest first: sentences for people, each with modality, figure and
    /// limit.
    pub reasons: Vec<String>,
}

impl Verdict {
    /// The reasons in one line; empty for a good episode.
    #[must_use]
    pub fn why(&self) -> String {
        self.reasons.join("; ")
    }
}
