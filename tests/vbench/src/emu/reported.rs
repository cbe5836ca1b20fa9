//! The events of a device, besides its data.

use serde_json::Value;

/// A log line without its times.
#[derive(Clone, Debug, PartialEq)]
pub struct Reported {
    /// What happened.
    pub action: &'static str,
    /// Details: an object.
    pub fields: Value,
}

impl Reported {
    /// `fields` is an object.
    pub fn new(action: &'static str, fields: Value) -> Self {
        Self { action, fields }
    }
}
