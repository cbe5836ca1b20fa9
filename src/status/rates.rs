//! Rates: samples and bytes per second, from successive snapshots.
//!
//! Invariant: pure; time comes only from the snapshots.

use std::collections::VecDeque;
use std::time::Duration;

use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::time::Stamp;

use super::{DeviceStatus, Snapshot};

/// Rates are means over this time.
const WINDOW: Duration = Duration::from_secs(2);
/// Minimum interval between measurements: snapshots in between are ignored.
const STEP: Duration = Duration::from_millis(250);

/// The counters of the last two seconds.
#[derive(Debug, Default)]
pub struct Rates {
    window: VecDeque<Point>,
}

#[derive(Debug)]
struct Point {
    taken: Stamp,
    publications: u64,
    /// Payload bytes of all devices.
    delivered: u64,
    recorded: Option<(std::path::PathBuf, u64)>,
    streams: [Stream; MAX_MODALITIES],
}

#[derive(Debug, Clone, Copy, Default)]
struct Stream {
    samples: u64,
    newest: Stamp,
    /// When the count last changed.
    changed: Stamp,
}

impl Rates {
    /// Takes a snapshot into account. True when the rates may have changed: four times a second.
    pub fn update(&mut self, snapshot: &Snapshot) -> bool {
        if self.window.back().is_some_and(|last| snapshot.taken.since(last.taken) < STEP) {
            return false;
        }
        let mut streams = [Stream::default(); MAX_MODALITIES];
        for device in &snapshot.devices {
            let before = self.window.back().and_then(|last| last.streams.get(device.id.index())).copied();
            if let Some(stream) = streams.get_mut(device.id.index()) {
                *stream = Stream::new(device, snapshot.taken, before);
            }
        }
        let recorded = snapshot.recording.as_ref().map(|recording| (recording.file.clone(), recording.bytes));
        self.window.push_back(Point {
            taken: snapshot.taken,
            publications: snapshot.mask_sequence,
            delivered: snapshot.devices.iter().fold(0, |sum, device| sum.saturating_add(device.bytes)),
            recorded,
            streams,
        });
        // One measurement at or beyond the window's edge is kept, so that the window is never shorter than full.
        while self.window.get(1).is_some_and(|second| snapshot.taken.since(second.taken) >= WINDOW) {
            self.window.pop_front();
        }
        true
    }

    /// Samples per second of a modality, 0 if none arrived.
    pub fn samples(&self, id: ModalityId) -> f64 {
        let index = id.index();
        // A stream that began within the window is counted from its start.
        let begun = self.window.iter().find(|point| point.streams.get(index).is_some_and(|stream| stream.samples > 0));
        let (Some(first), Some(last)) = (begun, self.window.back()) else { return 0.0 };
        let (Some(a), Some(b)) = (first.streams.get(index), last.streams.get(index)) else { return 0.0 };
        let count = b.samples.saturating_sub(a.samples);
        if count == 0 {
            return 0.0;
        }
        // Between capture times a regular stream is counted exactly; between snapshots the count is off by up to one.
        // But a stream that has stopped must not keep its rate.
        let captured = b.newest.since(a.newest);
        let period = captured / u32::try_from(count).unwrap_or(u32::MAX);
        let stopped = last.taken.since(b.changed) > STEP + period * 3;
        let regular = !captured.is_zero() && !stopped;
        per_second(count, if regular { captured } else { last.taken.since(first.taken) })
    }

    /// Publications of the mask per second.
    pub fn publications(&self) -> f64 {
        let Some((first, last)) = self.ends() else { return 0.0 };
        per_second(last.publications.saturating_sub(first.publications), last.taken.since(first.taken))
    }

    /// Payload bytes per second that all devices deliver.
    pub fn delivered(&self) -> f64 {
        let Some((first, last)) = self.ends() else { return 0.0 };
        per_second(last.delivered.saturating_sub(first.delivered), last.taken.since(first.taken))
    }

    /// Payload bytes per second written to the episode in progress.
    pub fn recorded(&self) -> f64 {
        let Some(last) = self.window.back() else { return 0.0 };
        let Some((file, bytes)) = &last.recorded else { return 0.0 };
        let begun = self.window.iter().find_map(|point| {
            point.recorded.as_ref().filter(|(other, _)| other == file).map(|(_, bytes)| (point.taken, *bytes))
        });
        let Some((taken, before)) = begun else { return 0.0 };
        per_second(bytes.saturating_sub(before), last.taken.since(taken))
    }

    fn ends(&self) -> Option<(&Point, &Point)> {
        self.window.front().zip(self.window.back())
    }
}

impl Stream {
    fn new(device: &DeviceStatus, taken: Stamp, before: Option<Self>) -> Self {
        let changed = before.filter(|before| before.samples == device.samples).map_or(taken, |before| before.changed);
        Self { samples: device.samples, newest: device.newest.unwrap_or_default(), changed }
    }
}

fn per_second(count: u64, over: Duration) -> f64 {
    if over.is_zero() { 0.0 } else { count as f64 / over.as_secs_f64() }
}

#[cfg(test)]
mod tests {
    use rapid_core::mask::PhysicalMask;
    use rapid_core::sample::Epoch;

    use super::*;
    use crate::{DeviceState, RecordingStatus};

    const MS: u64 = 1_000_000;

    fn at(ms: u64, samples: u64, newest_ms: u64, recorded: Option<u64>) -> Snapshot {
        Snapshot {
            rig: "rig".to_owned(),
            taken: Stamp(ms * MS),
            uptime: Duration::from_millis(ms),
            mask: PhysicalMask(1),
            mask_sequence: ms / 2,
            stops: Vec::new(),
            details: Vec::new(),
            previews: Vec::new(),
            unregistered: Vec::new(),
            registry_answer: None,
            devices: vec![DeviceStatus {
                name: "cam".to_owned(),
                id: id(),
                topic: "/cam".to_owned(),
                state: DeviceState::Streaming,
                epoch: Epoch(1),
                detail: String::new(),
                nominal_hz: None,
                samples,
                gaps: 0,
                bytes: 0,
                newest: (samples > 0).then_some(Stamp(newest_ms * MS)),
            }],
            not_started: None,
            policy: None,
            recording: recorded.map(|bytes| RecordingStatus {
                file: "a.mcap".into(),
                elapsed: Duration::ZERO,
                messages: 0,
                bytes,
                dropped: 0,
                room: None,
                outlook: crate::Outlook::default(),
            }),
            last_episode: None,
            last_verdict: None,
            session: None,
            disk_free: None,
            links: Vec::new(),
            simulated: false,
            log: Vec::new(),
        }
    }

    fn id() -> ModalityId {
        ModalityId::new(0).unwrap()
    }

    #[test]
    fn the_rate_of_a_regular_stream_is_exact_at_any_moment() {
        let mut rates = Rates::default();
        // 30 Hz, checked every 67 ms.
        for tick in 0..60_u64 {
            let now = 10_000 + tick * 67;
            let samples = now * 30 / 1000;
            rates.update(&at(now, samples, samples * 1000 / 30, None));
            if tick > 8 {
                assert!((rates.samples(id()) - 30.0).abs() < 0.1, "{}", rates.samples(id()));
            }
        }
        assert!((rates.publications() - 500.0).abs() < 1.0);
    }

    #[test]
    fn the_rate_of_a_stopped_stream_fades_to_zero() {
        let mut rates = Rates::default();
        for now in (10_000_u64..20_000).step_by(250) {
            let end = now.min(12_000);
            rates.update(&at(now, end / 10, end, None));
            if now == 12_000 {
                assert!((rates.samples(id()) - 100.0).abs() < 0.1);
            }
            if now == 13_000 {
                assert!((rates.samples(id()) - 50.0).abs() < 0.1);
            }
        }
        assert!(rates.samples(id()).abs() < f64::EPSILON);
    }

    #[test]
    fn the_first_samples_have_a_rate_and_bytes_count_from_the_episode_start() {
        let mut rates = Rates::default();
        rates.update(&at(10_000, 0, 0, None));
        rates.update(&at(10_250, 2, 10_190, None));
        rates.update(&at(10_500, 5, 10_490, Some(1000)));
        assert!((rates.samples(id()) - 10.0).abs() < 0.1);
        assert!(rates.recorded().abs() < f64::EPSILON);
        rates.update(&at(11_000, 10, 10_990, Some(3000)));
        assert!((rates.recorded() - 4000.0).abs() < 0.1);
        rates.update(&at(11_500, 15, 11_490, None));
        assert!(rates.recorded().abs() < f64::EPSILON);
    }
}
