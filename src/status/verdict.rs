//! The verdict on an episode: a word, a sentence for everything that speaks against it, and which of the
//! registered sensors took part.
//!
//! Invariant: there is no verdict by default. GOOD is a result of `record::verdict`.

use serde::{Deserialize, Serialize};

/// What an episode is worth, as far as its data say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum Grade {
    /// Nothing speaks against it.
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

/// The verdict on one episode. As JSON:
/// `{"verdict":"SUSPECT","reasons":["..."],"sensors":{"registered":3,"recorded":2,"without":["tactile_tip"]}}`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Verdict {
    /// The word.
    #[serde(rename = "verdict")]
    pub grade: Grade,
    /// Why it is not GOOD, the gravest first: sentences for people, each with modality, figure and
    /// limit. Empty exactly if it is GOOD.
    pub reasons: Vec<String>,
    /// Which sensors took part; unknown (`null`) where the file does not state which were registered.
    pub sensors: Option<Sensors>,
}

impl Verdict {
    /// The reasons in one line; empty for a good episode.
    #[must_use]
    pub fn why(&self) -> String {
        self.reasons.join("; ")
    }

    /// Has it the same word for the same reasons?
    #[must_use]
    pub fn says_as(&self, other: &Self) -> bool {
        (self.grade, &self.reasons) == (other.grade, &other.reasons)
    }

    /// `2 of 3 sensors, without tactile_tip`; empty if unknown.
    #[must_use]
    pub fn sensors(&self) -> String {
        self.sensors.as_ref().map(ToString::to_string).unwrap_or_default()
    }
}

/// How many of the registered sensors have a sample in an episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sensors {
    /// Entries of the registry.
    pub registered: usize,
    /// Those of them with at least one sample.
    pub recorded: usize,
    /// The names of the others, in the order of their bits.
    pub without: Vec<String>,
}

impl std::fmt::Display for Sensors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { registered, recorded, without } = self;
        write!(f, "{recorded} of {registered} sensor{}", if *registered == 1 { "" } else { "s" })?;
        if without.is_empty() { Ok(()) } else { write!(f, ", without {}", without.join(", ")) }
    }
}
