//! Which episode something belongs to.

use std::collections::BTreeMap;

use super::ABOUT;
use super::wire::Fields;

/// Identifies an episode among several in one file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeId(pub(super) [u8; 16]);

impl EpisodeId {
    /// Of an episode that begins now: ns since 1970, and ns of the monotonic clock, whose combination is unique.
    pub(crate) fn new(wall_ns: u64, monotonic_ns: u64) -> Self {
        Self((u128::from(wall_ns) << 64 | u128::from(monotonic_ns)).to_le_bytes())
    }

    /// Of the episode whose metadata [`ABOUT`] are these.
    pub(crate) fn from_metadata(about: &BTreeMap<String, String>) -> Option<Self> {
        let number = |key: &str| about.get(key)?.parse().ok();
        Some(Self::new(number("begin_wall_ns")?, number("begin_monotonic_ns")?))
    }
}

/// The metadata [`ABOUT`], if the content of a metadata record is those.
pub(super) fn about(content: &[u8]) -> Option<BTreeMap<String, String>> {
    let mut fields = Fields(content);
    fields.string().filter(|name| *name == ABOUT)?;
    fields.map()
}
