//! `[export]`: which numbers the data sets made of a rig's episodes have.

/// `[export]`: the defaults of `--state` and `--action` of `rapid export`, in the grammar of
/// [`columns`](crate::registry::columns).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ExportSpec {
    /// Of the state; empty: all numbers of all sensors.
    pub state: Vec<String>,
    /// Of the action; empty: the topic of actions.
    pub action: Vec<String>,
}
