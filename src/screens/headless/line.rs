//! Formats events: as a line for people, or as a JSON object.

use rapid_core::modality::ModalityId;
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_pictures::qr;
use rapid_status::palette::Palette;
use rapid_status::{DeviceStatus, Event, EventKind, Snapshot};
use serde::Serialize;

/// An event with its time on the wall clock.
#[derive(Serialize)]
struct Timed<'a> {
    #[serde(flatten)]
    event: &'a Event,
    time: String,
}

/// An event as one JSON object, with `time` as RFC 3339 in UTC; without a line end.
pub(super) fn json(event: &Event, wall_ns: u64) -> serde_json::Result<String> {
    text::json(&Timed { event, time: rapid_core::time::rfc3339(wall_ns) })
}

/// The beginning of a run, as JSON: `{"event":"begin",...}`.
#[derive(Serialize)]
#[serde(tag = "event", rename = "begin")]
struct Begin<'a> {
    stamp: Stamp,
    rig: &'a str,
    devices: Vec<BeginDevice<'a>>,
    /// To the page of the run.
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    links: &'a [String],
    time: String,
}

#[derive(Serialize)]
struct BeginDevice<'a> {
    device: &'a str,
    bit: ModalityId,
    topic: &'a str,
}

/// The rig and its modalities as one JSON object, without a line end.
pub(super) fn begin_json(snapshot: &Snapshot, wall_ns: u64) -> serde_json::Result<String> {
    fn device(device: &DeviceStatus) -> BeginDevice<'_> {
        BeginDevice { device: &device.name, bit: device.id, topic: &device.topic }
    }
    text::json(&Begin {
        stamp: snapshot.taken,
        rig: &snapshot.rig,
        devices: snapshot.devices.iter().map(device).collect(),
        links: &snapshot.links,
        time: rapid_core::time::rfc3339(wall_ns),
    })
}

/// Columns of the lines for people.
#[derive(Debug, Clone, Copy)]
pub(super) struct Columns {
    /// Columns for the longest device name.
    pub(super) name: usize,
    pub(super) palette: Palette,
}

/// Columns for the word that names the event.
const WORD: usize = 12;
/// Maximum columns of the rest of a line: a device may have a name of many thousand characters.
const REST: usize = 1000;

impl Columns {
    /// The rig and its modalities as a line; without a line end.
    pub(super) fn begin(self, snapshot: &Snapshot, wall_ns: u64) -> String {
        let time = self.palette.faint(&rapid_core::time::time_of_day(wall_ns));
        let names: Vec<_> = snapshot.devices.iter().map(|device| text::plain(&device.name)).collect();
        let rig = self.palette.bold(&text::plain(&snapshot.rig));
        format!("{time}  rig {rig} looks for {}; ctrl-c ends the run", names.join(", "))
    }

    /// The links to the page of the run, as lines; with `code` the first also as a QR code.
    pub(super) fn links(self, links: &[String], code: bool) -> Vec<String> {
        let code = links.first().filter(|_| code).and_then(|link| qr::half_blocks(link)).unwrap_or_default();
        let code = code.iter().map(|row| self.palette.code(row));
        links.iter().map(|link| format!("page: {link}")).chain(code).collect()
    }

    /// An event as a line; without a line end.
    pub(super) fn line(self, event: &Event, wall_ns: u64) -> String {
        let palette = self.palette;
        let described = event.what.describe();
        let word = format!("{:WORD$}", described.word);
        let word = match &event.what {
            EventKind::State { state, .. } => palette.state(*state, &word),
            EventKind::Episode(end) => palette.grade(end.verdict.grade, &word),
            EventKind::Recording { .. } | EventKind::Act { .. } | EventKind::Policy { dry_run: false, .. } => {
                palette.good(&word)
            }
            EventKind::Unregistered { .. } | EventKind::Discarded { .. } | EventKind::Policy { .. } => {
                palette.warn(&word)
            }
            _ => palette.level(described.level, &word),
        };
        let time = palette.faint(&rapid_core::time::time_of_day(wall_ns));
        let subject = text::left(&text::plain(&described.subject), self.name, "…");
        let rest = text::plain(described.detail());
        let rest = text::cut(&rest, REST, "…");
        let bit = described.bit.map_or_else(|| " ".repeat(6), |bit| format!("bit {:<2}", bit.bit()));
        format!("{time}  {subject}  {}  {word}  {rest}", palette.faint(&bit))
    }
}
