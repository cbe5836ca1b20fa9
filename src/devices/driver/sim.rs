//! Simulated devices, plugged in by a scenario.
//!
//! Samples lie on an absolute time grid that starts with the scenario, so nothing drifts. Their bytes are a function of
//! seed and sequence, so a test knows the expected recording. Time is tokio's: under a paused clock a scenario runs as
//! fast as it is read.
//!
//! Invariant: the sequence continues over a replug; skipped numbers are counted in `lost`.

mod joints;
mod pictures;

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::sync::atomic::Ordering;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use rapid_core::modality::ModalityKind;
use rapid_core::provenance::{Format, Negotiated};
use rapid_core::sample::{Encoding, FLAG_DEVICE_TIME};
use rapid_core::sync::Grid;
use rapid_core::time::{Stamp, nanoseconds};
#[cfg(feature = "motors")]
use rapid_motors::control::can::CanFrame;
use rapid_registry::simulation::task::{self, PictureError, SharedTrial};
use rapid_registry::simulation::{self, SimDevice, SimSource, TaskPart};
use rapid_registry::{CAN_RECORD, DeviceSpec, NodeSpec};
use tokio::time::Instant;

use self::joints::Joints;
use self::pictures::{PICTURES, Pictures, encode, fill, write_depth, write_picture};
use super::{Agreed, DriverError, Reading, unblock};
#[cfg(feature = "motors")]
use crate::driver::can::{
    outcome::{Arrival, Received},
    raw,
};

/// Pictures a camera keeps for a late reader, as many as the real driver has buffers.
const CAMERA_BACKLOG: u64 = 4;
/// Time that a serial line buffers for a late reader: the kernel's buffer lasts longer than this.
const SERIAL_BACKLOG: Duration = Duration::from_secs(1);
/// Upper limit for noticing a pulled cable or a silence.
const NOTICE: Duration = Duration::from_millis(10);

/// A running simulated device.
#[derive(Debug)]
pub struct Sim {
    device: Arc<SimDevice>,
    content: Content,
    grid: Grid,
    /// Number of the next sample on the grid, counted from the scenario's beginning.
    next: u64,
    backlog: u64,
    payload: Vec<u8>,
    /// Losses not yet reported.
    owed: u64,
    /// The sample in `payload` must be sent once more, with this stamp.
    again: Option<Stamp>,
    controls: BTreeMap<String, i64>,
    pub(super) agreed: Agreed,
    /// Its motors, if any.
    pub(super) joints: Joints,
    /// It was ordered to record.
    records: bool,
}

#[derive(Debug)]
enum Content {
    Pictures(Pictures),
    Depth { width: u32, height: u32, seed: u64 },
    Values { channels: usize, seed: u64 },
    Records { records: Records, seed: u64 },
    Task { part: TaskPart, trial: SharedTrial },
}

impl From<PictureError> for DriverError {
    fn from(error: PictureError) -> Self {
        Self::Fatal(error.to_string())
    }
}

impl Sim {
    /// Starts the device at the next point of its grid.
    ///
    /// # Errors
    /// When a picture of these dimensions cannot be made, or the device has no samples of its own.
    pub async fn open(device: Arc<SimDevice>) -> Result<Self, DriverError> {
        let (content, rate, backlog) = match device.source {
            SimSource::Camera { width, height, fps, seed, bytes } => {
                let has_light = device.light.is_there();
                let pictures = unblock(move || Pictures::new(width, height, seed, bytes, has_light)).await?;
                (Content::Pictures(pictures), fps, CAMERA_BACKLOG)
            }
            SimSource::Depth { width, height, fps, seed } => {
                (Content::Depth { width, height, seed }, fps, CAMERA_BACKLOG)
            }
            SimSource::Serial { channels, hz, seed } => {
                (Content::Values { channels, seed }, hz, SERIAL_BACKLOG.as_secs() * u64::from(hz.max(1)))
            }
            SimSource::Task { part, ref trial } => {
                let content = Content::Task { part, trial: trial.clone() };
                (content, task::STEP_HZ, CAMERA_BACKLOG)
            }
            SimSource::Process | SimSource::Replay { .. } => {
                return Err(DriverError::Fatal(format!(
                    "{}: no simulator makes samples for this kind of device",
                    device.name
                )));
            }
        };
        let capacity = match &content {
            Content::Pictures(pictures) => pictures.largest(),
            Content::Depth { width, height, .. } => 2 * (width * height) as usize,
            Content::Values { channels, .. } => channels * 8,
            Content::Records { .. } => CAN_RECORD,
            Content::Task { .. } => task::SIDE * task::SIDE * 3,
        };
        let grid = Grid::new(device.begun, rate.max(1).into());
        let next = first_after(grid, stamp_of(Instant::now()));
        let (payload, controls) = (Vec::with_capacity(capacity), BTreeMap::new());
        Ok(Self {
            device,
            content,
            grid,
            next,
            backlog,
            payload,
            owed: 0,
            again: None,
            controls,
            agreed: Agreed::default(),
            joints: Joints::default(),
            records: false,
        })
    }

    /// Configures the device as in `spec`: with the controls that it sets, and no others, for a simulated camera; with
    /// its motors, at their targets; with bytes if it sends those.
    ///
    /// # Errors
    /// When the description of the arm that its motors move does not fit them.
    pub(super) fn with_node(mut self, spec: &NodeSpec) -> Result<Self, DriverError> {
        if let (Some(records), Content::Values { seed, .. }) = (Records::for_node(spec), &self.content) {
            self.content = Content::Records { records, seed: *seed };
            self.payload.reserve(CAN_RECORD);
        }
        if let NodeSpec::Camera(camera) = spec {
            self.controls = camera.controls.iter().cloned().collect();
        }
        if let NodeSpec::Can(can) = spec {
            self.joints = Joints::from_spec(can)?;
        }
        self.agreed = Agreed { description: self.description(), negotiated: self.negotiated() };
        Ok(self)
    }

    /// Sets the action of the arm of the simulated task: one number per axis.
    ///
    /// # Errors
    /// When the device is not an actuator, or takes another number of values.
    pub(super) fn command(&mut self, target: &[f64]) -> Result<(), DriverError> {
        if self.joints.command(target) {
            return Ok(());
        }
        match (&self.content, target.try_into()) {
            (Content::Task { part: TaskPart::Arm, trial }, Ok(target)) => trial.lock().command(target),
            (Content::Task { part: TaskPart::Arm, .. }, Err(_)) => {
                let text = format!("{} takes {} values, not {}", self.device.name, task::AXES, target.len());
                return Err(DriverError::Retry(text));
            }
            _ => return Err(DriverError::Fatal(format!("{} is not an actuator", self.device.name))),
        }
        Ok(())
    }

    /// Orders the device to start or stop recording.
    pub(super) fn record(&mut self, record: bool) {
        if self.records != record {
            self.records = record;
            self.device.record(record);
        }
    }

    /// Ends its recording, which takes as long as the scenario states.
    pub(super) async fn close(mut self) {
        self.record(false);
        tokio::time::sleep(self.device.faults.close).await;
    }

    /// The next sample.
    ///
    /// # Errors
    /// [`DriverError::Gone`] once the cable is pulled.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        if let Some(captured) = self.again.take() {
            return Ok(self.reading(captured, 0));
        }
        let faults = self.device.faults;
        let hits = |every: Option<u64>, point: u64| every.is_some_and(|every| point.is_multiple_of(every));
        loop {
            self.owed += self.next_due().await?;
            if !hits(faults.lose_every, self.next) {
                break;
            }
            self.next += 1;
            self.owed += 1;
        }
        // No await from here on: a future dropped earlier has taken no sample.
        let (lost, point) = (std::mem::take(&mut self.owed), self.next);
        let skipped = u32::try_from(lost).unwrap_or(u32::MAX);
        let sequence = self.device.sequence.fetch_add(skipped.wrapping_add(1), Ordering::AcqRel).wrapping_add(skipped);
        let captured = self.grid.tick(point);
        self.next += 1;
        let elapsed = captured.since(self.device.begun);
        if self.payload.is_empty() || faults.freeze_at.is_none_or(|freeze| elapsed < freeze) {
            match &self.content {
                Content::Pictures(pictures) => {
                    let lit = pictures.shows_light() && self.device.light.was_lit(captured.before(faults.latency));
                    pictures.write(sequence, lit, &mut self.payload);
                }
                Content::Depth { width, height, seed } => {
                    write_depth((*width, *height), *seed, sequence, &mut self.payload);
                }
                Content::Values { channels, seed } => {
                    write_values(*channels, *seed, sequence, &mut self.payload);
                    self.joints.write(&mut self.payload);
                }
                Content::Records { records, seed } => records.write(*seed, sequence, captured, &mut self.payload),
                Content::Task { part, trial } => {
                    let mut trial = trial.lock();
                    trial.advance_to(u32::try_from(point).unwrap_or(u32::MAX));
                    trial.sample(*part, &mut self.payload)?;
                }
            }
        }
        if hits(faults.truncate_every, point) {
            self.payload.truncate(self.payload.len() / 2);
        }
        let error = i128::from(nanoseconds(elapsed)) * i128::from(faults.clock_ppm) / 1_000_000;
        let captured = Stamp(u64::try_from(i128::from(captured.0) + error).unwrap_or(captured.0));
        self.again = hits(faults.duplicate_every, point).then_some(captured);
        Ok(self.reading(captured, lost))
    }

    /// The reading for the sample in `payload`.
    fn reading(&self, captured: Stamp, lost: u64) -> Reading<'_> {
        let (encoding, width, height) = match &self.content {
            Content::Pictures(pictures) => (Encoding::Mjpeg, pictures.width, pictures.height),
            Content::Depth { width, height, .. } => (Encoding::Depth, *width, *height),
            Content::Values { channels, .. } => (Encoding::F64, u32::try_from(*channels).unwrap_or(u32::MAX), 0),
            Content::Records { .. } => (Encoding::Bytes, 0, 0),
            Content::Task { part, .. } => task::layout(*part),
        };
        Reading { bytes: &self.payload, encoding, captured, flags: FLAG_DEVICE_TIME, width, height, lost }
    }

    /// Waits until the next sample is due; returns how many samples the device had to drop before it because they were
    /// not read.
    async fn next_due(&mut self) -> Result<u64, DriverError> {
        loop {
            // Before the cable is checked: a sample stamped now was sent while plugged in.
            let now = Instant::now();
            if self.device.is_unplugged() {
                return Err(DriverError::Gone);
            }
            if self.device.is_silent() {
                // A silent device produces no samples: its sequence stops and nothing is lost.
                self.next = self.next.max(first_after(self.grid, stamp_of(now)));
                tokio::time::sleep_until(now + NOTICE.min(self.grid.tick(1).since(self.grid.tick(0)))).await;
                continue;
            }
            let due = self.grid.tick(self.next);
            // A sample with a long latency becomes available later by that time.
            let now_stamp = stamp_of(now).before(self.device.faults.delay);
            if due <= now_stamp {
                let newest = first_after(self.grid, now_stamp).saturating_sub(1);
                let lost = newest.saturating_sub(self.next).saturating_sub(self.backlog);
                self.next += lost;
                return Ok(lost);
            }
            tokio::time::sleep_until((now + due.since(now_stamp)).min(now + NOTICE)).await;
        }
    }

    /// A description of the device, for people.
    fn description(&self) -> String {
        match self.device.source {
            SimSource::Camera { width, height, fps, .. } => {
                format!("simulated camera, MJPG {width}x{height} at {fps} fps")
            }
            SimSource::Depth { width, height, fps, .. } => {
                format!("simulated camera, Z16 {width}x{height} at {fps} fps")
            }
            SimSource::Serial { channels, hz, .. } => match self.content {
                Content::Records { records, .. } => format!("{} at {hz} Hz", records.describe()),
                _ if self.joints.count() > 0 => format!("simulated motors, {} at {hz} Hz", self.joints.count()),
                _ => format!("simulated serial line, {channels} values at {hz} Hz"),
            },
            SimSource::Task { part: TaskPart::Arm, .. } => "arm of the simulated task".to_owned(),
            SimSource::Task { part: TaskPart::Phone, .. } => "phone of the simulated task".to_owned(),
            SimSource::Task { part: TaskPart::Gripper, .. } => "gripper of the simulated task".to_owned(),
            SimSource::Task { .. } => {
                format!("camera of the simulated task, MJPG {0}x{0} at {1} fps", task::SIDE, task::STEP_HZ)
            }
            SimSource::Process | SimSource::Replay { .. } => String::new(),
        }
    }

    /// The same for the recording.
    fn negotiated(&self) -> Negotiated {
        let format = match self.device.source {
            SimSource::Camera { width, height, fps, .. } => {
                Some(Format::Pictures { fourcc: "MJPG".to_owned(), width, height, fps: Some(fps.into()) })
            }
            SimSource::Depth { width, height, fps, .. } => {
                Some(Format::Pictures { fourcc: "Z16".to_owned(), width, height, fps: Some(fps.into()) })
            }
            SimSource::Serial { channels, hz, .. } => {
                let channels = if matches!(self.content, Content::Records { .. }) { 0 } else { channels };
                Some(Format::Messages { baud: None, channels, hz: Some(hz.into()) })
            }
            SimSource::Task { part, .. } => Some(match part.numbers() {
                Some(count) => {
                    Format::Messages { baud: None, channels: count as usize, hz: Some(task::STEP_HZ.into()) }
                }
                None => Format::Pictures {
                    fourcc: "MJPG".to_owned(),
                    width: task::SIDE_PIXELS,
                    height: task::SIDE_PIXELS,
                    fps: Some(task::STEP_HZ.into()),
                },
            }),
            SimSource::Replay { .. } | SimSource::Process => None,
        };
        let bus = Some(format!("sim:{}", self.device.name));
        let driver = Some(simulation::driver());
        Negotiated { driver, bus, format, controls: self.controls.clone(), ..Negotiated::default() }
    }
}

/// Identifier of all simulated frames.
#[cfg(feature = "motors")]
const ID: u16 = 0x123;

/// Samples of a simulated device that sends raw bytes: frames of a bus, packets, messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Records {
    /// One frame per sample, laid out like those of a real bus.
    #[cfg(feature = "motors")]
    Frames,
    /// One packet or message per sample.
    Packets,
}

impl Records {
    /// The samples of a device of this kind; `None` if it sends pictures or numbers.
    fn for_node(node: &NodeSpec) -> Option<Self> {
        match node {
            _ if node.modality_kind() != ModalityKind::Bytes => None,
            #[cfg(feature = "motors")]
            NodeSpec::Can(_) => Some(Self::Frames),
            _ => Some(Self::Packets),
        }
    }

    /// Writes sample `sequence`, captured at `captured`: the payload, or a frame's data, starts with the number.
    fn write(self, seed: u64, sequence: u32, captured: Stamp, payload: &mut Vec<u8>) {
        payload.clear();
        // The lower half of the seed follows the number: little-endian, as all numbers here.
        let data = (u64::from(sequence) | seed << 32).to_le_bytes();
        match self {
            #[cfg(feature = "motors")]
            Self::Frames => {
                let arrival = Arrival { at: captured, from_kernel: true };
                raw::write(&Received { frame: CanFrame::standard(ID, data), arrival }, payload);
            }
            Self::Packets => payload.extend_from_slice(&data),
        }
    }

    /// For people.
    const fn describe(self) -> &'static str {
        match self {
            #[cfg(feature = "motors")]
            Self::Frames => "simulated bus, frames",
            Self::Packets => "simulated device, packets",
        }
    }
}

/// The first tick later than `now`.
fn first_after(grid: Grid, now: Stamp) -> u64 {
    grid.ticks_before(Stamp(now.0.saturating_add(1)))
}

/// Checks that the scenario's device sends what the registry declares.
///
/// # Errors
/// When kind, picture size or number of channels differ: later stages rely on the registry's layout.
pub(super) fn check(spec: &DeviceSpec, device: &SimDevice) -> Result<(), DriverError> {
    let (sends, requested) = match (&device.source, &spec.node) {
        (
            SimSource::Camera { width, height, .. } | SimSource::Depth { width, height, .. },
            NodeSpec::Camera(camera),
        ) => {
            if (*width, *height) == (camera.width, camera.height) {
                return Ok(());
            }
            (format!("{width}x{height} pictures"), format!("{}x{}", camera.width, camera.height))
        }
        // Bytes have no channels.
        (SimSource::Serial { .. }, node) if node.modality_kind() == ModalityKind::Bytes => return Ok(()),
        (SimSource::Serial { channels, .. }, NodeSpec::Serial(serial)) => {
            if *channels == serial.channels {
                return Ok(());
            }
            (format!("{channels} values"), serial.channels.to_string())
        }
        (SimSource::Serial { channels, .. }, NodeSpec::Can(can)) => {
            if *channels == can.channels() {
                return Ok(());
            }
            (format!("{channels} values"), can.channels().to_string())
        }
        (SimSource::Camera { .. } | SimSource::Depth { .. }, NodeSpec::Serial(_)) => {
            (String::from("pictures"), String::from("a serial line"))
        }
        (SimSource::Camera { .. } | SimSource::Depth { .. }, NodeSpec::Can(_)) => {
            (String::from("pictures"), String::from("a CAN adapter"))
        }
        (SimSource::Serial { .. }, NodeSpec::Camera(_)) => (String::from("numbers"), String::from("a camera")),
        // A simulated replacement of a device on the network may send any amount.
        (SimSource::Task { .. } | SimSource::Process | SimSource::Replay { .. }, _)
        | (_, NodeSpec::Process(_) | NodeSpec::Lan(_)) => return Ok(()),
    };
    Err(DriverError::Fatal(format!(
        "the scenario's device {} sends {sends}, [device.{}] declares {requested}: make them equal",
        device.name, spec.name
    )))
}

/// The bytes a simulated device sends as number `sequence`; `None` for a recording
/// or a program.
pub fn frame(source: &SimSource, sequence: u32) -> Option<Vec<u8>> {
    let mut payload = Vec::new();
    match *source {
        SimSource::Camera { width, height, seed, bytes, .. } => {
            let picture =
                fill(encode(width, height, seed, sequence % PICTURES).ok()?, bytes, seed, sequence % PICTURES);
            write_picture(&picture, seed, sequence, &mut payload);
        }
        SimSource::Depth { width, height, seed, .. } => write_depth((width, height), seed, sequence, &mut payload),
        SimSource::Serial { channels, seed, .. } => write_values(channels, seed, sequence, &mut payload),
        SimSource::Task { .. } | SimSource::Process | SimSource::Replay { .. } => return None,
    }
    Some(payload)
}

/// `channels` numbers as little-endian 64-bit floats: the sequence, then sines that differ by seed
/// and channel.
fn write_values(channels: usize, seed: u64, sequence: u32, payload: &mut Vec<u8>) {
    payload.clear();
    for channel in 0..channels {
        let value = if channel == 0 {
            f64::from(sequence)
        } else {
            let phase = (seed % 1_000) as f64 / 1_000.0 + channel as f64 / 7.0;
            (TAU * (f64::from(sequence % 100_000) / 100.0 + phase)).sin()
        };
        payload.extend_from_slice(&value.to_le_bytes());
    }
}

/// The stamp of a moment on tokio's clock. `std`'s `Instant` is `CLOCK_MONOTONIC` on Linux, so one offset holds for the
/// whole process; with a paused clock, stamps stop and jump with it.
pub(super) fn stamp_of(instant: Instant) -> Stamp {
    static ANCHOR: OnceLock<(std::time::Instant, Stamp)> = OnceLock::new();
    let (origin, stamp) = *ANCHOR.get_or_init(|| (std::time::Instant::now(), Stamp::now()));
    let instant = instant.into_std();
    match instant.checked_duration_since(origin) {
        Some(later) => stamp.after(later),
        None => stamp.before(origin.duration_since(instant)),
    }
}

#[cfg(test)]
mod tests;
