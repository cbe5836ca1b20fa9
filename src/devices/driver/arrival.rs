//! Completion times of several messages that arrived in one read of a serial line.
//!
//! Invariant: pure. Stamps increase, and none is later than the read unless the line is faster than USB at full speed.

use std::time::Duration;

use rapid_core::time::Stamp;

/// Transfer time of a byte at full speed of USB, 12 Mbit/s (USB 2.0, section 7.1.11). The baud rate of a CDC-ACM device
/// is not that of any line.
const BYTE_TIME: Duration = Duration::from_nanos(667);

/// When the message before the last `behind` bytes of a read at `arrived` was complete; later than `last`, the stamp of
/// the previous message.
pub(super) fn completed(arrived: Stamp, behind: usize, last: Stamp) -> Stamp {
    let behind = BYTE_TIME.saturating_mul(u32::try_from(behind).unwrap_or(u32::MAX));
    arrived.before(behind).max(last.after(Duration::from_nanos(1)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn messages_of_one_read_have_increasing_times(
            reads in proptest::collection::vec((1u64..50_000_000, proptest::collection::vec(1usize..100, 1..40)), 1..20),
        ) {
            // As on a real line: no byte arrives faster than the line carries it.
            let (mut arrived, mut last) = (Stamp(1_000_000_000), Stamp::default());
            for (pause, lengths) in reads {
                let mut behind: usize = lengths.iter().sum();
                arrived = arrived.after(BYTE_TIME * u32::try_from(behind).unwrap()).after(Duration::from_nanos(pause));
                for length in lengths {
                    behind -= length;
                    let stamp = completed(arrived, behind, last);
                    prop_assert!(stamp > last && stamp <= arrived, "{stamp:?} after {last:?}, read at {arrived:?}");
                    last = stamp;
                }
            }
        }
    }
}
