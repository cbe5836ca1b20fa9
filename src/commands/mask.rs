//! `rapid mask`: the published mask, once or at each change.
//!
//! Invariant: it only reads published data, so it works beside a running `rapid`, and reports when none
//! is running.

use std::io::{self, Write};
use std::time::Duration;

use rapid_core::mask::{MaskRecord, PhysicalMask};
use rapid_core::text;
use rapid_status::palette::Palette;
use serde::{Deserialize, Serialize};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

/// A record older than this is stale: a running publisher publishes every 2 ms.
pub const STALE_AFTER: Duration = Duration::from_secs(1);
/// Polling period of `--watch`: that of the publisher.
const POLL: Duration = Duration::from_millis(2);

/// Names of bits.
pub type Layout = [(u8, String)];

/// What to print.
#[derive(Debug, Clone, Copy)]
pub struct MaskOptions {
    /// Continue with a line per change.
    pub watch: bool,
    /// JSON objects instead of text.
    pub json: bool,
    /// Colours, in text.
    pub palette: Palette,
}

/// Why the mask cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum MaskError {
    /// No record can be read.
    #[error("{0}")]
    Unreadable(String),
    /// The output cannot be written.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// The names of the bits, from the text of the published JSON file; `None` if it has none.
pub fn layout(json: &str) -> Option<Vec<(u8, String)>> {
    #[derive(Deserialize)]
    struct File {
        devices: Vec<Device>,
    }
    #[derive(Deserialize)]
    struct Device {
        name: String,
        bit: u8,
    }
    let file: File = serde_json::from_str(json).ok()?;
    Some(file.devices.into_iter().map(|device| (device.bit, device.name)).collect())
}

/// The record as text: the mask, its age, and one line per modality. `now_ns` is the current wall time.
pub fn render(record: &MaskRecord, layout: Option<&Layout>, now_ns: u64, palette: Palette) -> String {
    let count = usize::from(record.device_count);
    let head = format!(
        "mask {}  {}  {} of {count} present  sequence {}  {}\n",
        palette.bold(&record.mask.hex(count)),
        record.mask.binary(count),
        record.mask.online_count(),
        record.sequence,
        freshness(record, now_ns, palette),
    );
    let line = |bit: u8| {
        let present = record.mask.0 >> bit & 1 == 1;
        let word = if present { palette.good("present") } else { palette.faint("absent") };
        format!("  bit {bit:>2}  {}  {word}\n", text::left(&name(bit, layout), 20, "…"))
    };
    std::iter::once(head).chain(bits(record, layout).into_iter().map(line)).collect()
}

/// Registered bits in ascending order: those with names, or as many as the record counts.
fn bits(record: &MaskRecord, layout: Option<&Layout>) -> Vec<u8> {
    let mut bits: Vec<u8> = match layout {
        Some(layout) => layout.iter().map(|(bit, _)| *bit).filter(|bit| *bit < 64).collect(),
        None => (0..record.device_count.min(64)).collect(),
    };
    // A set bit is shown even without a name.
    bits.extend((0..64).filter(|bit| record.mask.0 >> bit & 1 == 1));
    bits.sort_unstable();
    bits.dedup();
    bits
}

fn name(bit: u8, layout: Option<&Layout>) -> String {
    let name = layout.into_iter().flatten().find(|(other, _)| *other == bit);
    name.map_or_else(|| "?".to_owned(), |(_, name)| text::plain(name).into_owned())
}

fn freshness(record: &MaskRecord, now_ns: u64, palette: Palette) -> String {
    let age = age(record, now_ns);
    if age > STALE_AFTER {
        return palette.bad(&format!("stale: published {} ago, the publisher is stopped or gone", text::age(age)));
    }
    palette.faint(&format!("{} old", text::age(age)))
}

fn age(record: &MaskRecord, now_ns: u64) -> Duration {
    Duration::from_nanos(now_ns.saturating_sub(record.realtime_ns))
}

/// The record as JSON.
#[derive(Debug, Serialize)]
struct Object<'a> {
    event: &'static str,
    mask: String,
    mask_binary: String,
    device_count: u8,
    online_count: u32,
    sequence: u64,
    /// Wall time of the publication.
    time: String,
    age_ms: f64,
    stale: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    devices: Option<Vec<ObjectDevice<'a>>>,
}

#[derive(Debug, Serialize)]
struct ObjectDevice<'a> {
    name: &'a str,
    bit: u8,
    online: bool,
}

/// The record as one JSON object, without a line end.
///
/// # Errors
/// Never in practice: every part can be serialised.
pub fn render_json(record: &MaskRecord, layout: Option<&Layout>, now_ns: u64) -> serde_json::Result<String> {
    let count = usize::from(record.device_count);
    let online = |bit: u8| bit < 64 && record.mask.0 >> bit & 1 == 1;
    text::json(&Object {
        event: "mask",
        mask: record.mask.hex(count),
        mask_binary: record.mask.binary(count),
        device_count: record.device_count,
        online_count: record.mask.online_count(),
        sequence: record.sequence,
        time: rapid_core::time::rfc3339(record.realtime_ns),
        age_ms: (age(record, now_ns).as_secs_f64() * 1e6).round() / 1e3,
        stale: age(record, now_ns) > STALE_AFTER,
        devices: layout.map(|layout| {
            layout.iter().map(|(bit, name)| ObjectDevice { name, bit: *bit, online: online(*bit) }).collect()
        }),
    })
}

/// Prints the record, and with `watch` each change of the mask until `stop`.
///
/// `read` returns the current record, `names` the layout, `now` the wall time in ns. While watching, a
/// publisher that stops or returns is reported; at the start, a missing one is an error.
///
/// # Errors
/// When there is no record at the start, or the output cannot be written. A closed pipe is not an error.
pub async fn run(
    mut read: impl FnMut() -> Result<MaskRecord, String>,
    names: impl Fn() -> Option<Vec<(u8, String)>>,
    now: impl Fn() -> u64,
    options: MaskOptions,
    stop: CancellationToken,
    mut out: impl Write,
) -> Result<(), MaskError> {
    let show = async {
        let first = read().map_err(MaskError::Unreadable)?;
        let layout = names();
        let text = if options.json {
            render_json(&first, layout.as_deref(), now()).map_err(io::Error::from)? + "\n"
        } else {
            render(&first, layout.as_deref(), now(), options.palette)
        };
        out.write_all(text.as_bytes())?;
        out.flush()?;
        if !options.watch {
            return Ok(());
        }
        let mut last =
            LastMask { mask: first.mask, sequence: first.sequence, alive: age(&first, now()) <= STALE_AFTER };
        let mut poll = tokio::time::interval(POLL);
        poll.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                biased;
                () = stop.cancelled() => return Ok(()),
                _ = poll.tick() => {}
            }
            let Some(change) = last.update(read(), now()) else { continue };
            let line = change.line(&names, now(), options)?;
            out.write_all(line.as_bytes())?;
            out.flush()?;
        }
    };
    match show.await {
        Err(MaskError::Output(error)) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        outcome => outcome,
    }
}

/// The last published state that was read.
struct LastMask {
    mask: PhysicalMask,
    sequence: u64,
    alive: bool,
}

#[derive(Debug)]
enum Change {
    Mask { record: MaskRecord, before: PhysicalMask },
    Back(MaskRecord),
    Gone(String),
}

impl LastMask {
    fn update(&mut self, record: Result<MaskRecord, String>, now_ns: u64) -> Option<Change> {
        let record = match record {
            Ok(record) if age(&record, now_ns) <= STALE_AFTER => record,
            Ok(_) => return self.gone("no publication for 1 s"),
            Err(reason) => return self.gone(&reason),
        };
        let before = self.mask;
        let returned = !std::mem::replace(&mut self.alive, true);
        if record.sequence == self.sequence && !returned {
            return None;
        }
        (self.mask, self.sequence) = (record.mask, record.sequence);
        if returned {
            return Some(Change::Back(record));
        }
        (before != record.mask).then_some(Change::Mask { record, before })
    }

    fn gone(&mut self, reason: &str) -> Option<Change> {
        std::mem::take(&mut self.alive).then(|| Change::Gone(format!("the publisher is gone: {reason}")))
    }
}

impl Change {
    fn line(
        &self,
        names: &impl Fn() -> Option<Vec<(u8, String)>>,
        now_ns: u64,
        options: MaskOptions,
    ) -> io::Result<String> {
        let palette = options.palette;
        match self {
            Self::Mask { record, .. } | Self::Back(record) if options.json => {
                Ok(render_json(record, names().as_deref(), now_ns)? + "\n")
            }
            Self::Gone(reason) if options.json => {
                let gone =
                    serde_json::json!({ "event": "gone", "gone": reason, "time": rapid_core::time::rfc3339(now_ns) });
                Ok(text::json(&gone)? + "\n")
            }
            Self::Mask { record, before } => {
                let layout = names();
                let changed = (0..64_u8).filter(|bit| (record.mask.0 ^ before.0) >> bit & 1 == 1);
                let edges: Vec<_> = changed
                    .map(|bit| match (record.mask.0 >> bit & 1, name(bit, layout.as_deref())) {
                        (1, name) => palette.good(&format!("+{name}")),
                        (_, name) => palette.bad(&format!("-{name}")),
                    })
                    .collect();
                Ok(watched(record, &edges.join(" "), palette))
            }
            Self::Back(record) => Ok(watched(record, &palette.good("the publisher is back"), palette)),
            Self::Gone(reason) => Ok(format!(
                "{}  {}\n",
                palette.faint(&rapid_core::time::time_of_day(now_ns)),
                palette.bad(&text::plain(reason))
            )),
        }
    }
}

fn watched(record: &MaskRecord, remark: &str, palette: Palette) -> String {
    let count = usize::from(record.device_count);
    let time = palette.faint(&rapid_core::time::time_of_day(record.realtime_ns));
    format!("{time}  {}  {}  {remark}\n", record.mask.hex(count), record.mask.binary(count))
}

#[cfg(test)]
mod tests;
