//! The events of a device, besides what it sends.

use serde_json::Value;

/// A line for the log, without its times.
#[derive(Clone, Debug, PartialEq)]
pub struct Reported {
    /// What happened.
    pub action: &'static str,
    /// More of it: an object.
    pub fields: Value,
}

impl Reported {
    /// `fields` is an object.
    pub fn new(action: &'static str, fields: Value) -> Self {
        Self { action, fields }
    }
}
