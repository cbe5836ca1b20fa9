//! A bus of motors: its state as samples, and its commands.
//!
//! Thread `control` owns the adapter. It runs the cycles of `MotorBus`, which decides, and waits on the topic of
//! actions itself, or on the targets of thread `effector` if they move an arm by its tip; only its samples are read here,
//! on the runtime.
//!
//! Invariant: whatever ends the driver, the motors are ordered to turn off: see `control_loop`.

mod control_loop;
pub mod effector;
mod powered;
mod statistics;

use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;

use rapid_core::action::{ActionSource, ActuatorNotice, MAX_ACTION, Order};
use rapid_core::permission::Attended;
use rapid_core::provenance::{Format, Negotiated};
use rapid_core::sample::{Encoding, FLAG_DEVICE_TIME};
use rapid_motors::control::motors::SAMPLE_VALUES;
use rapid_motors::kinematics::Arm;
use rapid_registry::device::DeviceNode;
use rapid_registry::{CanSpec, DamiaoSpec};
use rapid_system::panics::CONTROL_THREAD;
use tokio::sync::mpsc;

use super::claim::Claim;
use super::guard::Guard;
use super::link::Link;
use super::outcome::LinkError;
use crate::driver::{Agreed, DriverError, Reading, unblock};
use control_loop::{ControlLoop, Sample, Shared};
use effector::Effector;
use powered::Powered;
pub use statistics::Punctuality;

/// Samples that may wait to be read, a second of them at 200 Hz.
const SAMPLES: usize = 256;
/// Notices that may wait, beside those that thread `control` keeps; they are read every few milliseconds.
const NOTICES: usize = 64;

/// See the module's comment.
#[derive(Debug)]
pub struct Motors {
    pub(in crate::driver) agreed: Agreed,
    axes: usize,
    samples: mpsc::Receiver<Sample>,
    notices: Option<mpsc::Receiver<ActuatorNotice>>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    /// The arm that they move, if actions are poses of its tip.
    effector: Option<Effector>,
    payload: [u8; MAX_ACTION * 8],
}

impl Motors {
    /// Opens the adapter of an entry at its node and starts to query its motors. None moves.
    ///
    /// # Errors
    /// When the adapter cannot be opened, or the system gives no thread.
    pub async fn open(spec: &CanSpec, motors: &DamiaoSpec, node: &DeviceNode) -> Result<Self, DriverError> {
        let (can, node, motors) = (spec.clone(), node.clone(), motors.clone());
        unblock(move || {
            let arm = motors.effector.as_ref().map(|effector| Arm::open(effector, &motors.motors)).transpose();
            let arm = arm.map_err(|error| DriverError::Fatal(error.to_string()))?;
            let claim = match &node {
                // Before the interface is brought up, and the first frame.
                DeviceNode::Net(name) => Some(Claim::acquire(name).map_err(LinkError::into_driver)?),
                _ => None,
            };
            let link = Link::open(&can, &node).map_err(LinkError::into_driver)?;
            let guard = Guard::start(&link, &can, &motors, &node).map_err(|error| {
                tracing::warn!(
                    %error,
                    "the motors have no guard: if rapid is killed, they stop by their own time limit alone"
                );
            });
            Self::begin(Powered::new(link, &motors, guard.ok(), claim), &motors, arm)
        })
        .await
    }

    /// Starts the thread over an open adapter, without a guard.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(link: Link, spec: &DamiaoSpec) -> Result<Self, DriverError> {
        let arm = spec.effector.as_ref().map(|effector| Arm::open(effector, &spec.motors)).transpose();
        let arm = arm.map_err(|error| DriverError::Fatal(error.to_string()))?;
        Self::begin(Powered::new(link, spec, None, None), spec, arm)
    }

    fn begin(powered: io::Result<Powered>, spec: &DamiaoSpec, arm: Option<Arm>) -> Result<Self, DriverError> {
        let powered =
            powered.map_err(|error| DriverError::Retry(format!("no thread for the motors' brakes: {error}")))?;
        let description = format!("{}, {} motors at {} Hz", powered.description(), spec.motors.len(), spec.hz);
        let (reported, samples) = mpsc::channel(SAMPLES);
        let (notify, notices) = mpsc::channel(NOTICES);
        let shared = Arc::<Shared>::default();
        let control_loop = ControlLoop::new(powered, spec, reported, notify, Arc::clone(&shared));
        let thread = std::thread::Builder::new().name(CONTROL_THREAD.to_owned()).spawn(move || control_loop.run());
        let thread = thread.map_err(|error| DriverError::Retry(format!("no thread for the motors: {error}")))?;
        let channels = spec.motors.len() * SAMPLE_VALUES + arm.as_ref().map_or(0, Arm::numbers);
        let format = Format::Messages { baud: None, channels, hz: Some(f64::from(spec.hz)) };
        let negotiated = Negotiated { card: Some(description.clone()), format: Some(format), ..Negotiated::default() };
        Ok(Self {
            agreed: Agreed { description, negotiated },
            axes: spec.motors.len(),
            samples,
            notices: Some(notices),
            shared,
            thread: Some(thread),
            effector: arm.map(|arm| Effector::new(arm, spec.motors.len())),
            payload: [0; MAX_ACTION * 8],
        })
    }

    /// The next state of all motors. Cancel-safe.
    ///
    /// # Errors
    /// When the adapter is gone or cannot be used any more.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let Some(sample) = self.samples.recv().await else { return Err(self.shared.reason()) };
        if self.effector.as_ref().is_some_and(Effector::has_ended) {
            return Err(DriverError::Retry("thread `effector` panicked; please report this".to_owned()));
        }
        let mut values = [0.0; MAX_ACTION];
        let mut count = self.axes * SAMPLE_VALUES;
        if let Some((motors, tip)) = values.split_at_mut_checked(count) {
            motors.copy_from_slice(sample.values.get(..count).unwrap_or_default());
            if let Some(effector) = &self.effector {
                count += effector.update(motors, tip);
            }
        }
        let values = values.get(..count).unwrap_or_default();
        for (place, value) in self.payload.chunks_exact_mut(8).zip(values) {
            place.copy_from_slice(&value.to_le_bytes());
        }
        Ok(Reading {
            bytes: self.payload.get(..values.len() * 8).unwrap_or_default(),
            encoding: Encoding::F64,
            captured: sample.captured,
            flags: if sample.from_kernel { FLAG_DEVICE_TIME } else { 0 },
            width: u32::try_from(values.len()).unwrap_or(u32::MAX),
            height: 0,
            lost: sample.lost,
        })
    }

    /// Carries out these orders from now on. Thread `control` takes them itself: none waits for another thread.
    pub fn attend(&mut self, orders: &Arc<Attended>) {
        // They are the same for as long as the adapter is open.
        let _ = self.shared.attended.set(Arc::clone(orders));
    }

    /// Follows these actions from now on: a number for each motor, rad or rad/s, or poses of the tip of an arm. Thread
    /// `control` waits for them itself.
    pub fn follow(&mut self, actions: Arc<dyn ActionSource>) {
        let actions = match &mut self.effector {
            None => actions,
            Some(effector) => match effector.follow(actions) {
                Ok(targets) => targets,
                Err(error) => return tracing::error!(%error, "no thread `effector`: the arm follows no actions"),
            },
        };
        // As above.
        let _ = self.shared.actions.set(actions);
    }

    /// Lets the motors move with the next cycle, or stops them at once.
    ///
    /// # Errors
    /// When thread `control` has ended.
    pub fn order(&mut self, order: Order) -> Result<(), DriverError> {
        if self.shared.has_ended() || self.samples.is_closed() {
            return Err(self.shared.reason());
        }
        self.shared.orders.give(order);
        Ok(())
    }

    /// What happens from now on; at the first call.
    pub fn notices(&mut self) -> Option<mpsc::Receiver<ActuatorNotice>> {
        self.notices.take()
    }

    /// Turns the motors off and waits until they report it, for a tenth of a second at most.
    pub async fn close(mut self) {
        let _ = unblock(move || {
            self.stop();
            Ok(())
        })
        .await;
    }

    /// Turns the motors off, waits as [`Self::close`] does, and returns how well they were driven; `None` if the thread
    /// panicked. Blocks as dropping does.
    pub fn finish(mut self) -> Option<Punctuality> {
        self.stop();
        self.shared.punctuality.get().cloned()
    }

    fn stop(&mut self) {
        self.shared.ask();
        if let Some(thread) = self.thread.take() {
            // The channel that it closed has reported its panic.
            let _ = thread.join();
        }
    }
}

impl Drop for Motors {
    /// Blocks for the current cycle and until the motors report that they are off: some 20 ms, and a tenth of a second
    /// more if one is silent.
    fn drop(&mut self) {
        self.stop();
    }
}

#[cfg(test)]
mod tests;
