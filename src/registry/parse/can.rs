//! `[device.NAME.can]`.

use crate::registry::section::{Problems, Section};
use crate::registry::spec::{CanAdapter, CanProtocol, CanSpec};

/// Reads the table; `None` if a problem with it was reported.
pub(super) fn can(section: &Section<'_>, problems: &mut Problems<'_>) -> Option<CanSpec> {
    let mut can = CanSpec { adapter: CanAdapter::SocketCan, bitrate: 1_000_000, protocol: CanProtocol::Raw };
    let Some(table) = section.table(problems, "can") else { return Some(can) };
    table.allow(problems, &["adapter", "bitrate"]);
    can.adapter = table.choice(problems, "adapter", &CanAdapter::WORDS).unwrap_or(can.adapter);
    if let Some(bitrate) = table.integer(problems, "bitrate", 10_000..=1_000_000) {
        can.bitrate = u32::try_from(bitrate.value).ok()?;
    }
    Some(can)
}
