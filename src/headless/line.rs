//! How an event is written: a line for people, or a JSON object.

use serde::Serialize;

use super::policy;
use super::style::Palette;
use crate::modality::ModalityId;
use crate::status::{DeviceStatus, Event, Level, Snapshot, What};
use crate::text;
use crate::time::Stamp;

/// An event with its time on the wall clock.
#[derive(Serialize)]
struct Timed<'a> {
    #[serde(flatten)]
    event: &'a Event,
    time: String,
}

/// An event as one JSON object, with `time` as RFC 3339 in UTC; without a line end.
pub(super) fn json(event: &Event, wall_ns: u64) -> serde_json::Result<String> {
    text::json(&Timed { event, time: crate::time::rfc3339(wall_ns) })
}

/// The beginning of a run, as JSON: `{"event":"begin",...}`.
#[derive(Serialize)]
#[serde(tag = "event", rename = "begin")]
struct Begin<'a> {
    stamp: Stamp,
    rig: &'a str,
    devices: Vec<BeginDevice<'a>>,
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
        time: crate::time::rfc3339(wall_ns),
    })
}

/// Columns of the lines for people.
#[derive(Debug, Clone, Copy)]
pub(super) struct Columns {
    /// Of the longest device name.
    pub(super) name: usize,
    /// Colours.
    pub(super) palette: Palette,
}

/// Columns of the word that says what happened.
const WORD: usize = 12;
/// Columns of the rest of a line: a device may give itself a name of many thousand characters.
const REST: usize = 1000;

impl Columns {
    /// The rig and its modalities as a line; without a line end.
    pub(super) fn begin(self, snapshot: &Snapshot, wall_ns: u64) -> String {
        let time = self.palette.faint(&crate::time::time_of_day(wall_ns));
        let names: Vec<_> = snapshot.devices.iter().map(|device| text::plain(&device.name)).collect();
        let rig = self.palette.bold(&text::plain(&snapshot.rig));
        format!("{time}  rig {rig} looks for {}; ctrl-c ends the run", names.join(", "))
    }

    /// An event as a line; without a line end.
    pub(super) fn line(self, event: &Event, wall_ns: u64) -> String {
        let palette = self.palette;
        let (subject, bit, word, rest) = match &event.what {
            What::Attach { device, bit, node, unit, .. } => {
                let serial = unit.serial().map(|serial| format!(" serial {serial}")).unwrap_or_default();
                (device, Some(bit), pad("attached"), format!("{node} {}{serial}", unit.location()))
            }
            What::Opened { device, bit, provenance } => {
                let driver = provenance.negotiated.driver.as_ref();
                let driver = driver.map(|driver| {
                    format!("  driver {} {}", driver.name, driver.version.as_deref().unwrap_or_default())
                });
                let firmware = provenance
                    .unit
                    .usb()
                    .and_then(|usb| usb.firmware.as_deref())
                    .map(|firmware| format!("  firmware {firmware}"));
                let rest =
                    [Some(format!("epoch {}", provenance.epoch.0)), firmware, driver].into_iter().flatten().collect();
                (device, Some(bit), pad("opened"), rest)
            }
            What::Detach { device, bit, witness } => {
                (device, Some(bit), palette.warn(&pad("detached")), format!("told by {witness}"))
            }
            What::State { device, bit, state, mask, detail } => {
                let word = palette.state(*state, &pad(state.word()));
                (device, Some(bit), word, format!("mask {mask}  {detail}"))
            }
            What::Unregistered { device, reason } => {
                (&"usb".to_owned(), None, palette.warn(&pad("unregistered")), format!("{device}   {reason}"))
            }
            What::Recording { file } => {
                (&"episode".to_owned(), None, palette.good(&pad("recording")), file.display().to_string())
            }
            What::Episode { file, seconds, messages, bytes, dropped, error, verdict } => {
                let size = text::size(*bytes);
                let file = file.display();
                let mut rest = format!("{file}  {seconds:.1} s  {messages} messages  {size}  {dropped} dropped");
                // Where an error has made a reason, that says it.
                let why = if verdict.reasons.is_empty() { error.clone().unwrap_or_default() } else { verdict.why() };
                for said in [verdict.sensors(), why] {
                    rest.push_str("  ");
                    rest.push_str(&said);
                }
                (&"episode".to_owned(), None, palette.grade(verdict.grade, &pad(verdict.grade.word())), rest)
            }
            What::Dropped { file, seconds } => {
                let rest = format!("{}  {seconds:.1} s", file.display());
                (&"episode".to_owned(), None, palette.warn(&pad("dropped")), rest)
            }
            What::DiskLow { .. } | What::ClockStep { .. } => {
                let (level, text) = event.what.sentence().unwrap_or((Level::Warn, String::new()));
                let subject = if matches!(event.what, What::DiskLow { .. }) { "disk" } else { "clock" };
                (&subject.to_owned(), None, palette.level(level, &pad(level.word())), text)
            }
            What::Policy { .. } | What::Chunk(_) | What::Hold { .. } | What::Act { .. } | What::PolicyEnd { .. } => {
                let (word, rest) = policy::line(&event.what, palette, pad).unwrap_or_default();
                (&"policy".to_owned(), None, word, rest)
            }
            What::Recovered { text, .. } => (&"episode".to_owned(), None, palette.warn(&pad("repaired")), text.clone()),
            What::Actuator { device, bit, arming, is_problem, text } => {
                let word = pad(arming.word());
                (device, Some(bit), if *is_problem { palette.warn(&word) } else { word }, text.clone())
            }
            What::Stop(stop) => {
                let word = pad(stop.word());
                (&stop.stop, None, if stop.is_problem() { palette.warn(&word) } else { word }, stop.sentence())
            }
            What::Publisher { .. } => {
                let (level, text) = event.what.sentence().unwrap_or((Level::Warn, String::new()));
                (&"bus".to_owned(), None, palette.level(level, &pad(level.word())), text)
            }
            What::Log { level, text } => {
                let word = palette.level(*level, &pad(level.word()));
                (&"log".to_owned(), None, word, text.clone())
            }
        };
        let time = palette.faint(&crate::time::time_of_day(wall_ns));
        let subject = text::left(&text::plain(subject), self.name, "…");
        let rest = text::plain(rest.trim_end());
        let rest = text::cut(&rest, REST, "…");
        let bit = bit.map_or_else(|| " ".repeat(6), |bit| format!("bit {:<2}", bit.bit()));
        format!("{time}  {subject}  {}  {word}  {}", palette.faint(&bit), rest)
    }
}

fn pad(word: &str) -> String {
    format!("{word:WORD$}")
}
