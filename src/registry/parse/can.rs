//! `[device.NAME.can]`.

use super::motors;
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{CanAdapter, CanProtocol, CanSpec, SLCAN_BITRATES};

const KEYS: [&str; 9] =
    ["adapter", "bitrate", "protocol", "hz", "deadman", "disable_after", "timeout", "silent_after", "motors"];
/// Keys that only a bus of motors has.
const OF_MOTORS: [&str; 6] = ["motors", "hz", "deadman", "disable_after", "timeout", "silent_after"];

/// What can be on a bus, by the word for it.
const PROTOCOLS: [(&str, Protocol); 2] = [("raw", Protocol::Raw), ("damiao", Protocol::Damiao)];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Protocol {
    Raw,
    Damiao,
}

/// Reads the table; `None` if a problem with it was reported.
pub(super) fn can(section: &Section<'_>, problems: &mut Problems<'_>) -> Option<CanSpec> {
    for key in ["camera", "serial", "lan"].into_iter().filter(|key| section.is_table(key)) {
        let message = format!("a CAN adapter has no table [{}]", section.child(key));
        section.report(problems, key, message, format!("write its settings into [{}]", section.child("can")));
    }
    let default = CanSpec { adapter: CanAdapter::SocketCan, bitrate: 1_000_000, protocol: CanProtocol::Raw };
    if !section.has("can") {
        return Some(default);
    }
    let table = section.table(problems, "can")?;
    table.allow(problems, &KEYS);
    let adapter = table.choice(problems, "adapter", &CanAdapter::WORDS).unwrap_or(default.adapter);
    let bitrate = table
        .integer(problems, "bitrate", 10_000..=1_000_000)
        .and_then(|bitrate| u32::try_from(bitrate.value).ok())
        .unwrap_or(default.bitrate);
    check_bitrate(&table, adapter, bitrate, problems);
    let wished = table.choice(problems, "protocol", &PROTOCOLS);
    let protocol = match wished.unwrap_or(Protocol::Raw) {
        Protocol::Damiao => CanProtocol::Damiao(motors::damiao(&table, problems)?),
        Protocol::Raw => {
            // A word that is none has been reported; what it was to be is not known.
            if wished.is_some() || !table.has("protocol") {
                no_motors(&table, problems);
            }
            CanProtocol::Raw
        }
    };
    Some(CanSpec { adapter, bitrate, protocol })
}

fn no_motors(table: &Section<'_>, problems: &mut Problems<'_>) {
    if let Some(key) = OF_MOTORS.into_iter().find(|key| table.has(key)) {
        let message = format!("a bus whose frames are recorded as they are has no {key}");
        table.report(problems, key, message, "write protocol = \"damiao\" for a bus of motors, or remove it");
    }
}

fn check_bitrate(table: &Section<'_>, adapter: CanAdapter, bitrate: u32, problems: &mut Problems<'_>) {
    let (message, fix) = match adapter {
        CanAdapter::Slcan if !SLCAN_BITRATES.contains(&bitrate) => {
            let known: Vec<String> = SLCAN_BITRATES.iter().map(ToString::to_string).collect();
            (format!("slcan has no name for {bitrate} bits a second"), format!("write one of: {}", known.join(", ")))
        }
        CanAdapter::Damiao if bitrate != 1_000_000 => (
            "rapid does not set the bit rate of Damiao's adapter".to_owned(),
            "remove bitrate; the adapter is set up with its maker's program, and its motors talk at 1000000".to_owned(),
        ),
        _ => return,
    };
    table.report(problems, "bitrate", message, fix);
}
