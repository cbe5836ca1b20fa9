//! `[export]`: which numbers the datasets made of a rig's episodes have.

/// Which numbers a dataset has, in the grammar of [`columns`](crate::columns): `[export]`, or `--state` and
/// `--action` of `rapid export`, whose defaults it has.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ExportSpec {
    /// Of the state; empty: all numbers of all sensors.
    pub state: Vec<String>,
    /// Of the action; empty: the topic of actions.
    pub action: Vec<String>,
}

impl ExportSpec {
    /// This one, where it chooses anything, otherwise `other`.
    #[must_use]
    pub fn or(&self, other: &Self) -> Self {
        let of = |mine: &Vec<String>, other: &Vec<String>| if mine.is_empty() { other.clone() } else { mine.clone() };
        Self { state: of(&self.state, &other.state), action: of(&self.action, &other.action) }
    }
}
