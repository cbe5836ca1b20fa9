//! A bus of motors: its state as samples, and its commands.
//!
//! Thread `control` owns the adapter. It keeps the beat of the motors and runs [`MotorBus`], which decides;
//! here, on the runtime, is only who reads its samples and passes on what it is told.
//!
//! Invariant: whatever ends the driver, the motors are told to turn off: see `beat`.

mod beat;

use std::sync::Arc;
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

use tokio::sync::mpsc;

use super::link::Link;
use crate::action::{ActuatorNotice, Order};
use crate::control::motors::SAMPLE_VALUES;
use crate::driver::{DriverError, Reading, unblock};
use crate::panics::CONTROL_THREAD;
use crate::provenance::{Format, Negotiated};
use crate::registry::{CanSpec, DamiaoSpec, DeviceNode, MAX_MOTORS};
use crate::sample::{Encoding, FLAG_DEVICE_TIME};
use crate::time::Stamp;
pub use beat::Punctuality;
use beat::{Beat, Ending, Request, Sample, Target};

/// Samples that may wait to be read, a second of them at 200 Hz.
const SAMPLES: usize = 256;
/// Notices that may wait; they are read every few milliseconds.
const NOTICES: usize = 64;
/// Requests that may wait; they are taken every cycle.
const REQUESTS: usize = 64;

/// See the module's comment.
#[derive(Debug)]
pub struct Motors {
    description: String,
    hz: u32,
    axes: usize,
    samples: mpsc::Receiver<Sample>,
    notices: mpsc::Receiver<ActuatorNotice>,
    requests: SyncSender<Request>,
    ending: Arc<Ending>,
    thread: Option<JoinHandle<()>>,
    payload: [u8; MAX_MOTORS * SAMPLE_VALUES * 8],
}

impl Motors {
    /// Opens the adapter of an entry at its node and starts to ask its motors. None moves.
    ///
    /// # Errors
    /// When the adapter cannot be opened, or the system gives no thread.
    pub async fn open(spec: &CanSpec, motors: &DamiaoSpec, node: &DeviceNode) -> Result<Self, DriverError> {
        let (can, node, motors) = (spec.clone(), node.clone(), motors.clone());
        unblock(move || Self::start(Link::open(&can, &node).map_err(super::link::LinkError::into_driver)?, &motors))
            .await
    }

    /// Starts the thread over an open adapter.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(link: Link, spec: &DamiaoSpec) -> Result<Self, DriverError> {
        let description = format!("{}, {} motors at {} Hz", link.description(), spec.motors.len(), spec.hz);
        let (told, samples) = mpsc::channel(SAMPLES);
        let (tell, notices) = mpsc::channel(NOTICES);
        let (requests, asked) = sync_channel(REQUESTS);
        let ending = Arc::<Ending>::default();
        let beat = Beat::new(link, spec, asked, told, tell, Arc::clone(&ending));
        let thread = std::thread::Builder::new().name(CONTROL_THREAD.to_owned()).spawn(move || beat.run());
        let thread = thread.map_err(|error| DriverError::Retry(format!("no thread for the motors: {error}")))?;
        Ok(Self {
            description,
            hz: spec.hz,
            axes: spec.motors.len(),
            samples,
            notices,
            requests,
            ending,
            thread: Some(thread),
            payload: [0; MAX_MOTORS * SAMPLE_VALUES * 8],
        })
    }

    /// The next state of all motors. Cancel-safe.
    ///
    /// # Errors
    /// When the adapter is gone or cannot be used any more.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let Some(sample) = self.samples.recv().await else { return Err(self.ending.reason()) };
        let values = sample.values.get(..self.axes * SAMPLE_VALUES).unwrap_or_default();
        for (place, value) in self.payload.chunks_exact_mut(8).zip(values) {
            place.copy_from_slice(&value.to_le_bytes());
        }
        Ok(Reading {
            bytes: self.payload.get(..values.len() * 8).unwrap_or_default(),
            encoding: Encoding::F64,
            captured: sample.captured,
            flags: FLAG_DEVICE_TIME,
            width: u32::try_from(values.len()).unwrap_or(u32::MAX),
            height: 0,
            lost: sample.lost,
        })
    }

    /// Where the motors are to go: a number each, rad or rad/s, as of `tick`.
    ///
    /// # Errors
    /// When there are not as many numbers as motors, or thread `control` does not take it.
    pub fn command(&mut self, target: &[f64], tick: Stamp) -> Result<(), DriverError> {
        if target.len() != self.axes {
            return Err(DriverError::Retry(format!("it takes {} numbers, not {}", self.axes, target.len())));
        }
        self.ask(Request::Target(Target::new(target, tick)))
    }

    /// Lets the motors move, or stops them.
    ///
    /// # Errors
    /// When thread `control` does not take it.
    pub fn order(&mut self, order: Order) -> Result<(), DriverError> {
        self.ask(Request::Order(order))
    }

    /// What happened since the last call.
    pub fn take_notice(&mut self) -> Option<ActuatorNotice> {
        self.notices.try_recv().ok()
    }

    /// Turns the motors off and waits for that.
    pub async fn close(mut self) {
        let _ = unblock(move || {
            self.stop();
            Ok(())
        })
        .await;
    }

    /// Turns the motors off, waits for that, and says how well they were driven; `None` if the thread
    /// panicked. Blocks as dropping does.
    #[must_use]
    pub fn finish(mut self) -> Option<Punctuality> {
        self.stop();
        self.ending.punctuality.get().cloned()
    }

    /// What was opened, for people.
    #[must_use]
    pub fn description(&self) -> &str {
        &self.description
    }

    /// What was agreed.
    #[must_use]
    pub fn negotiated(&self) -> Negotiated {
        let channels = self.axes * SAMPLE_VALUES;
        let format = Some(Format::Messages { baud: None, channels, hz: Some(f64::from(self.hz)) });
        Negotiated { card: Some(self.description.clone()), format, ..Negotiated::default() }
    }

    fn ask(&self, request: Request) -> Result<(), DriverError> {
        self.requests.try_send(request).map_err(|error| match error {
            TrySendError::Full(_) => DriverError::Retry("thread `control` is behind".to_owned()),
            TrySendError::Disconnected(_) => self.ending.reason(),
        })
    }

    fn stop(&mut self) {
        self.ending.ask();
        if let Some(thread) = self.thread.take() {
            // Its panic has been told by the channel that it closed.
            let _ = thread.join();
        }
    }
}

impl Drop for Motors {
    /// Blocks for the cycle that is under way and for the frames that turn the motors off: some 20 ms.
    fn drop(&mut self) {
        self.stop();
    }
}
