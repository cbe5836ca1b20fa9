//! When a run may begin what needs its sensors: an episode that was requested at the start, or a policy.

use std::time::Duration;

use crate::status::{Board, SlotState};

/// Every attached device delivers by then, or is not waited for.
pub(super) const LIMIT: Duration = Duration::from_secs(3);
/// Devices that are attached at the start are known after this time.
const LEAST: Duration = Duration::from_millis(100);

/// Whether, so long after the start, every attached device has delivered its first sample.
pub(super) fn has_settled(board: &Board, waited: Duration) -> bool {
    let is_opening = || board.snapshot().devices.iter().any(|device| device.state == SlotState::Opening);
    waited >= LIMIT || (waited >= LEAST && !is_opening())
}
