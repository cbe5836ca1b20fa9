//! `[export]`: which numbers the datasets made of a rig's episodes have.

use crate::keys::{Own, keys, texts};
use crate::section::Section;

const COLUMNS: Own<Vec<String>> = texts(columns, "a list of columns");

keys! {
    /// Which values a dataset has, in the grammar of [`columns`](crate::columns): `[export]`, or `--state` and
    /// `--action` of `rapid export`, whose defaults it has.
    #[derive(Debug, Clone, Default, PartialEq, Eq)]
    pub struct ExportSpec {
        /// Columns of the state.
        state: Vec<String> = COLUMNS, usually "all values of all sensors", or Vec::new();
        /// Columns of the action.
        action: Vec<String> = COLUMNS, usually "the topic of actions", or Vec::new();
    }
}

impl ExportSpec {
    /// This one, where it chooses anything, otherwise `other`.
    #[must_use]
    pub fn or(&self, other: &Self) -> Self {
        let of = |mine: &Vec<String>, other: &Vec<String>| if mine.is_empty() { other.clone() } else { mine.clone() };
        Self { state: of(&self.state, &other.state), action: of(&self.action, &other.action) }
    }
}

fn columns(table: &Section<'_>, key: &str) -> Option<Vec<String>> {
    let columns = table.texts(key)?;
    if columns.is_empty() {
        table.report(key, format!("{key} is an empty list"), "name columns, or remove the key");
    }
    Some(columns)
}
