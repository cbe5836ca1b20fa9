//! When a run may begin what needs its sensors: an episode that was requested at the start, or a policy.

use std::time::Duration;

use rapid_status::{Board, DeviceState, DeviceStatus, Snapshot};

/// Every attached device delivers by then, or is not waited for.
pub(super) const LIMIT: Duration = Duration::from_secs(3);
/// Devices that are attached at the start are known after this time.
const LEAST: Duration = Duration::from_millis(100);

/// Whether, so long after the start, every attached device has delivered its first sample and is in the published mask:
/// an episode that begins before that mask has frames without the device.
pub(super) fn has_settled(board: &Board, waited: Duration) -> bool {
    waited >= LIMIT || (waited >= LEAST && is_everything_published(&board.snapshot()))
}

fn is_everything_published(snapshot: &Snapshot) -> bool {
    let published = |device: &DeviceStatus| {
        device.state != DeviceState::Opening && device.state.is_present() == snapshot.mask.contains(device.id)
    };
    snapshot.devices.iter().all(published)
}

#[cfg(test)]
mod tests {
    use crate::literal::{device, id, snapshot};
    use rapid_core::mask::PhysicalMask;

    use super::*;

    #[test]
    fn a_device_is_waited_for_until_the_published_mask_agrees_with_its_state() {
        for (state, without, with) in [
            (DeviceState::Absent, true, false),
            (DeviceState::Opening, false, false),
            (DeviceState::Streaming, false, true),
            (DeviceState::Stalled, false, true),
            (DeviceState::Backoff, true, false),
            (DeviceState::Failed, true, false),
        ] {
            let mut snapshot =
                snapshot(vec![device(0, "tip", DeviceState::Streaming, ""), device(3, "cam", state, "")]);
            for (bit, settled) in [(false, without), (true, with)] {
                snapshot.mask = PhysicalMask(1).with(id(3), bit);
                assert_eq!(is_everything_published(&snapshot), settled, "{state:?}, its bit is {bit}");
            }
        }
    }
}
