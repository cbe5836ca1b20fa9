//! The progress line: the state of the run at a glance.

use std::time::Duration;

use rapid_core::text;
use rapid_status::rates::Rates;
use rapid_status::{DeviceState, PolicyStatus, Snapshot};
use serde::Serialize;

/// Progress as one line, without a line end: time, mask, policy, the episode, rates of streaming devices.
pub(super) fn line(snapshot: &Snapshot, rates: &Rates, elapsed: Duration, duration: Option<Duration>) -> String {
    let of = duration.map(|duration| format!("/{}", text::clock(duration))).unwrap_or_default();
    let mut parts = vec![format!("{}{of}", text::clock(elapsed))];
    parts.push(format!("mask {}", snapshot.mask.hex(snapshot.devices.len())));
    parts.extend(snapshot.policy.as_ref().map(progress));
    // The episode comes before the rates: with many devices the end is cut off.
    if let Some(recording) = &snapshot.recording {
        parts.push(format!(
            "rec {} {} {:.1} MB/s",
            text::clock(recording.elapsed),
            text::size(recording.bytes),
            rates.recorded() / 1e6
        ));
        parts.push(format!("{} dropped", recording.dropped));
        parts.extend(recording.room.map(|left| format!("disk full in {}", text::clock(left))));
    }
    let running = snapshot.devices.iter().filter(|device| snapshot.mask.contains(device.id));
    parts.extend(running.map(|device| {
        let stalled = if device.state == DeviceState::Stalled { " stalled" } else { "" };
        format!("{} {} Hz{stalled}", text::plain(&device.name), text::hertz(rates.samples(device.id)))
    }));
    parts.join("  ")
}

/// Progress as JSON: `{"event":"progress",...}`.
#[derive(Debug, Serialize)]
#[serde(tag = "event", rename = "progress")]
struct Progress<'a> {
    time: String,
    elapsed: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    duration: Option<f64>,
    mask: String,
    devices: Vec<DeviceProgress<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    recording: Option<RecordingProgress>,
    #[serde(skip_serializing_if = "Option::is_none")]
    policy: Option<PolicyProgress<'a>>,
}

#[derive(Debug, Serialize)]
struct DeviceProgress<'a> {
    device: &'a str,
    bit: u8,
    state: DeviceState,
    samples: u64,
    gaps: u64,
    hz: f64,
    /// Since the newest sample was captured; null before the first.
    age_ms: Option<f64>,
}

#[derive(Debug, Serialize)]
struct RecordingProgress {
    seconds: f64,
    messages: u64,
    bytes: u64,
    dropped: u64,
    /// While the disk is nearly full: seconds until the episode is closed.
    #[serde(skip_serializing_if = "Option::is_none")]
    disk_seconds: Option<u64>,
}

/// Progress as one JSON object, without a line end.
pub(super) fn json(
    snapshot: &Snapshot,
    rates: &Rates,
    elapsed: Duration,
    duration: Option<Duration>,
    wall_ns: u64,
) -> serde_json::Result<String> {
    text::json(&Progress {
        time: rapid_core::time::rfc3339(wall_ns),
        elapsed: elapsed.as_secs_f64(),
        duration: duration.map(|duration| duration.as_secs_f64()),
        mask: snapshot.mask.hex(snapshot.devices.len()),
        devices: snapshot
            .devices
            .iter()
            .map(|device| DeviceProgress {
                device: &device.name,
                bit: device.id.bit(),
                state: device.state,
                samples: device.samples,
                gaps: device.gaps,
                hz: thousandths(rates.samples(device.id)),
                age_ms: device.newest.map(|newest| thousandths(snapshot.taken.since(newest).as_secs_f64() * 1e3)),
            })
            .collect(),
        recording: snapshot.recording.as_ref().map(|recording| RecordingProgress {
            seconds: recording.elapsed.as_secs_f64(),
            messages: recording.messages,
            bytes: recording.bytes,
            dropped: recording.dropped,
            disk_seconds: recording.room.map(|left| left.as_secs()),
        }),
        policy: snapshot.policy.as_ref().map(|policy| PolicyProgress::new(policy, snapshot.devices.len())),
    })
}

fn thousandths(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

/// What the policy is doing, in a few words for the progress line.
pub(super) fn progress(policy: &PolicyStatus) -> String {
    let dry = if policy.dry_run { " dry" } else { "" };
    let latency = policy.latency_ms.map(|ms| format!(" {ms:.0} ms")).unwrap_or_default();
    match &policy.hold {
        None => format!("policy{dry} acts{latency}"),
        Some(reason) => format!("policy{dry} holds: {}", text::plain(&reason.to_string())),
    }
}

/// The same as JSON.
#[derive(Debug, Serialize)]
pub(super) struct PolicyProgress<'a> {
    policy: &'a str,
    dry_run: bool,
    /// The mask it observed last, `0x05`.
    mask: String,
    /// Why it does nothing; null while it acts.
    hold: Option<String>,
    latency_ms: Option<f64>,
    chunk_age: Option<u64>,
    actions: u64,
    held: u64,
    chunks: u64,
    late: u64,
    unused: u64,
}

impl<'a> PolicyProgress<'a> {
    pub(super) fn new(policy: &'a PolicyStatus, devices: usize) -> Self {
        Self {
            policy: &policy.name,
            dry_run: policy.dry_run,
            mask: policy.mask.hex(devices),
            hold: policy.hold.as_ref().map(ToString::to_string),
            latency_ms: policy.latency_ms,
            chunk_age: policy.chunk_age,
            actions: policy.actions,
            held: policy.held,
            chunks: policy.chunks,
            late: policy.late,
            unused: policy.unused,
        }
    }
}
