//! Presence: publishes the physical mask for other processes, at 500 Hz and at every change.
//!
//! A thread named `mask` runs on absolute deadlines of 2 ms; it owns the file in shared memory and the mask's topic on
//! the bus. The rig passes it a new mask by an atomic and a wake-up and never waits for it.
//!
//! Invariant: no device, disk or child process can hold up the thread.
//! Invariant: a reader that compares the generation before and after never sees a torn record.
//! Invariant: one publisher per file, ensured by a lock that ends with its process.

mod file;
mod json;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rapid_bus::Writer;
use rapid_core::mask::{Bits, PhysicalMask};
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::{Stamp, realtime_ns};
use rapid_status::Board;
use rapid_system::fault;
use rapid_system::realtime::{MASK_PRIORITY, use_fifo};
use tokio_util::sync::{CancellationToken, DropGuard};

pub use file::{PresenceError, instances, read_mask};
pub use json::{JsonDevice, json_path};

use file::MaskFile;

/// Time between two publications: 500 Hz (paper, section "Physical Mask Generator").
pub const PERIOD: Duration = Duration::from_millis(2);
/// Periods between two checks whether the file still exists: a second.
const LOOK_EVERY: u32 = 500;
/// `SampleHeader::id` of a mask sample: not a modality.
pub const MASK_ID: u32 = u32::MAX;

/// The publisher. Dropping it publishes an empty mask and removes the files.
#[derive(Debug)]
pub struct Presence {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    ended: CancellationToken,
    path: PathBuf,
    json: PathBuf,
    json_failed: AtomicBool,
}

#[derive(Debug)]
struct Shared {
    mask: AtomicU64,
    /// The mask as it was published last.
    published: AtomicU64,
    plugged: AtomicU64,
    /// Number of registered modalities.
    devices: AtomicU8,
    stop: AtomicBool,
}

impl Shared {
    /// What runs is plugged in, also between the two stores of [`Presence::publish`].
    fn bits(&self) -> Bits {
        let mask = self.mask.load(Ordering::Acquire);
        let plugged = self.plugged.load(Ordering::Acquire) | mask;
        Bits { mask: PhysicalMask(mask), plugged: PhysicalMask(plugged) }
    }
}

/// See [`Presence::published`].
#[derive(Debug, Clone)]
pub struct Published(Arc<Shared>);

impl Published {
    /// The mask.
    pub fn mask(&self) -> PhysicalMask {
        PhysicalMask(self.0.published.load(Ordering::Acquire))
    }
}

/// The right to publish the mask of this rig, and so to be its only `rapid`.
#[derive(Debug)]
pub struct Claim {
    path: PathBuf,
    file: MaskFile,
}

impl Claim {
    /// Takes the file at `path`, for a mask of `device_count` devices.
    ///
    /// # Errors
    /// When another live process publishes there (its pid is named), or the file cannot be made.
    pub fn new(path: &Path, device_count: u8) -> Result<Self, PresenceError> {
        Ok(Self { path: path.to_owned(), file: MaskFile::create(path, device_count)? })
    }
}

impl Presence {
    /// Starts publishing an empty mask.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start(claim: Claim, writer: Arc<Writer>, board: Arc<Board>) -> Result<Self, PresenceError> {
        let Claim { path, file } = claim;
        let devices = AtomicU8::new(file.device_count());
        let shared = Arc::new(Shared {
            mask: AtomicU64::new(0),
            published: AtomicU64::new(0),
            plugged: AtomicU64::new(0),
            devices,
            stop: AtomicBool::new(false),
        });
        let ended = CancellationToken::new();
        let heartbeat =
            Heartbeat { _ended: ended.clone().drop_guard(), shared: Arc::clone(&shared), file, writer, board };
        let thread = std::thread::Builder::new()
            .name("mask".to_owned())
            .spawn(move || heartbeat.run())
            .map_err(|error| PresenceError::Io { path: path.clone(), error })?;
        let json = json_path(&path);
        Ok(Self { shared, thread: Some(thread), ended, path, json, json_failed: AtomicBool::new(false) })
    }

    /// Cancelled when the thread has ended; a panic can end it before this is dropped.
    pub fn ended(&self) -> CancellationToken {
        self.ended.clone()
    }

    /// Reads, at any moment, the mask that is published.
    pub fn published(&self) -> Published {
        Published(Arc::clone(&self.shared))
    }

    /// Reads, at any moment, the mask that should be published.
    #[cfg(test)]
    pub(super) fn wanted(&self) -> impl Fn() -> PhysicalMask + Send + use<> {
        let shared = Arc::clone(&self.shared);
        move || PhysicalMask(shared.mask.load(Ordering::Acquire))
    }

    /// Publishes these at once, and then at every period. Does not wait.
    pub fn publish(&self, bits: impl Into<Bits>) {
        let Bits { mask, plugged } = bits.into();
        // In this order: whoever reads the new mask reads what is plugged in with it.
        self.shared.plugged.store(plugged.0, Ordering::Release);
        self.shared.mask.store(mask.0, Ordering::Release);
        if let Some(thread) = &self.thread {
            thread.thread().unpark();
        }
    }

    /// From the next publication on the mask is one of so many devices, at most 64. Does not wait.
    pub fn set_devices(&self, devices: usize) {
        self.shared.devices.store(u8::try_from(devices).unwrap_or(u8::MAX), Ordering::Release);
    }

    /// Writes the whole JSON file, with the sequence of the last publication if that was of `mask`; `false` if `mask`
    /// is not published yet. A failure is logged once until the file can be written again.
    pub fn write_json(&self, mask: PhysicalMask, devices: &[JsonDevice]) -> bool {
        // A panic of the thread has freed the name for another rapid.
        if self.ended.is_cancelled() {
            return true;
        }
        let published = match read_mask(&self.path) {
            Ok(published) if published.mask == mask => published,
            Ok(_) | Err(PresenceError::Starting { .. }) => return false,
            Err(_) => return true,
        };
        let written = json::write(&self.json, mask, published.sequence, devices);
        let failed_before = self.json_failed.swap(written.is_err(), Ordering::Relaxed);
        if let (Err(error), false) = (written, failed_before) {
            tracing::warn!(%error, "the mask's JSON file is not written");
        }
        true
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        self.publish(PhysicalMask::EMPTY);
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            // The thread never waits for anything but its deadline. The holder of `ended` learns of a panic.
            let _ = thread.join();
        }
    }
}

/// The thread's state.
struct Heartbeat {
    /// Dropped even by a panic, and before the file: nothing else writes there once it is gone.
    _ended: DropGuard,
    shared: Arc<Shared>,
    file: MaskFile,
    writer: Arc<Writer>,
    board: Arc<Board>,
}

impl Heartbeat {
    fn run(mut self) {
        match use_fifo(MASK_PRIORITY) {
            Ok(()) => tracing::debug!("thread mask runs under SCHED_FIFO"),
            Err(reason) => tracing::warn!(
                reason,
                "the mask has no real-time priority, so that a busy machine may delay it: run rapid as rapid.service does, \
                 or give the user `rtprio {MASK_PRIORITY}` in /etc/security/limits.conf"
            ),
        }
        let mut due = Stamp::now();
        let mut published = None;
        let (mut failed, mut lost, mut beats) = (false, false, 0_u32);
        loop {
            fault::point("mask");
            let stop = self.shared.stop.load(Ordering::Acquire);
            let bits = self.shared.bits();
            let now = Stamp::now();
            if now < due && published == Some(bits) && !stop {
                std::thread::park_timeout(due.since(now));
                continue;
            }
            beats = (beats + 1) % LOOK_EVERY;
            if beats == 0 {
                lost = self.restore(lost);
            }
            match self.publish(bits, now) {
                Ok(()) => failed = false,
                Err(error) if !failed => {
                    // Once, not 500 times a second.
                    failed = true;
                    tracing::error!(%error, "the physical mask is not published");
                }
                Err(_) => {}
            }
            published = Some(bits);
            if stop {
                return;
            }
            if now >= due {
                due = due.after(PERIOD);
                if due <= now {
                    // Delayed by a period or more: continue from now rather than in a burst.
                    due = now.after(PERIOD);
                }
            }
        }
    }

    /// Creates the file again if it is gone. True while that fails, which is reported once.
    fn restore(&mut self, failed: bool) -> bool {
        match self.file.restore() {
            Ok(false) => false,
            Ok(true) => {
                let path = self.file.path().display();
                tracing::warn!(
                    "{path}: removed or replaced during the run; created again: its readers must open it again"
                );
                false
            }
            Err(error) if !failed => {
                tracing::warn!(%error, "the physical mask was removed during the run, and cannot be created again");
                true
            }
            Err(_) => true,
        }
    }

    fn publish(&mut self, bits: Bits, now: Stamp) -> Result<(), String> {
        let mask = bits.mask;
        self.file.set_device_count(self.shared.devices.load(Ordering::Acquire));
        let sequence = self.file.publish(mask, realtime_ns()).map_err(|error| error.to_string())?;
        self.shared.published.store(mask.0, Ordering::Release);
        self.board.set_mask(mask, sequence);
        let header = SampleHeader {
            seq: sequence,
            capture_ns: now.0,
            recv_ns: now.0,
            id: MASK_ID,
            encoding: Encoding::Mask as u32,
            ..SampleHeader::default()
        };
        self.writer.publish(header, &bits.payload(sequence)).map_err(|error| error.to_string())
    }
}

#[cfg(test)]
mod tests;
