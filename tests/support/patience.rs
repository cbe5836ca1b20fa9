//! How long a test waits.

use std::time::Duration;

/// How long a test waits for a condition before it gives up. Not a requirement: a slow machine only makes the test
/// slow.
pub(crate) const PATIENCE: Duration = Duration::from_mins(3);
