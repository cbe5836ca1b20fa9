//! `[device.NAME.lan]`.

use crate::registry::section::{Problems, Section};
use crate::registry::spec::{LanProtocol, LanSpec};

/// Reads the table; `None` if a problem with it was reported.
pub(super) fn lan(section: &Section<'_>, problems: &mut Problems<'_>) -> Option<LanSpec> {
    let table = section.table(problems, "lan")?;
    table.allow(problems, &["port"]);
    let port = table.integer(problems, "port", 1..=65_535)?;
    Some(LanSpec { protocol: LanProtocol::Udp { port: u16::try_from(port.value).ok()? } })
}
