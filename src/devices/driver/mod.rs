//! Drivers read bytes from a device's node: the edge of the program.
//!
//! A driver is an enum, not a trait object: its [`Reading`] borrows bytes from the kernel's buffer until the next read.
//!
//! Invariant: `read` is cancel-safe: dropping its future loses no sample.
//! Invariant: no driver blocks: blocking calls during opening run on tokio's blocking pool.
//! Invariant: no bytes from a device can make a driver panic.

mod arrival;
pub mod camera;
#[cfg(feature = "motors")]
pub mod can;
#[cfg(any(feature = "lan", feature = "motors"))]
mod datagram;
#[cfg(feature = "lan")]
pub mod lan;
pub mod process;
pub mod replay;
pub mod serial;
pub mod sim;

use std::sync::Arc;

use futures::future::BoxFuture;
use rapid_core::action::{ActionSource, ActuatorNotice, Order};
use rapid_core::clip::ClipNotice;
use rapid_core::permission::Attended;
use rapid_core::provenance::Negotiated;
use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use rapid_registry::device::DeviceNode;
use rapid_registry::simulation::{SimDevice, SimSource};
use rapid_registry::{CanProtocol, DeviceSpec, NodeSpec};
use tokio::sync::mpsc;

#[cfg(feature = "motors")]
use can::{motors::Motors, raw::Raw as RawCan};
#[cfg(feature = "lan")]
use lan::Lan;
use rapid_status::Episode;

/// One sample as received from the device, borrowed until the next read.
#[derive(Debug)]
pub struct Reading<'a> {
    /// Payload.
    pub bytes: &'a [u8],
    /// How the payload is encoded.
    pub encoding: Encoding,
    /// Capture time: the kernel's if available, otherwise the moment of arrival.
    pub captured: Stamp,
    /// `sample::FLAG_*`.
    pub flags: u32,
    /// Image: pixels; numbers: their count; otherwise 0.
    pub width: u32,
    /// Image: pixels, otherwise 0.
    pub height: u32,
    /// Samples the device or kernel reports as lost since the last reading.
    pub lost: u64,
}

/// The clock of another computer, of which the capture times of a device are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClockOffset {
    /// That clock minus this one, ns.
    pub offset_ns: i64,
    /// How far that may be wrong, either way, ns.
    pub uncertainty_ns: u64,
}

/// The settings agreed with a device when it was opened.
#[derive(Debug, Clone, Default)]
pub struct Agreed {
    /// For people.
    pub description: String,
    /// For the recording.
    pub negotiated: Negotiated,
}

/// Why a device cannot be opened or read, classified by the next step.
#[derive(Debug, thiserror::Error)]
pub enum DriverError {
    /// The device is no longer present: wait until it is attached again.
    #[error("unplugged")]
    Gone,
    /// The adapter that leads to the device is present, but its link is down: wait for the link.
    #[error("the network link is down")]
    Unlinked,
    /// Retrying later may help.
    #[error("{0}")]
    Retry(String),
    /// Retrying cannot help until something is changed; the text names it.
    #[error("{0}")]
    Fatal(String),
}

/// An open device.
#[derive(Debug)]
pub enum Driver {
    /// A V4L2 camera.
    #[cfg(feature = "cameras")]
    Camera(Box<camera::Camera>),
    /// A serial line.
    Serial(Box<serial::Serial>),
    /// Motors behind a CAN adapter.
    #[cfg(feature = "motors")]
    Motors(Box<Motors>),
    /// The frames of a CAN bus.
    #[cfg(feature = "motors")]
    Can(Box<RawCan>),
    /// A device on the network.
    #[cfg(feature = "lan")]
    Lan(Box<Lan>),
    /// A device that exists only in a scenario.
    Sim(Box<sim::Sim>),
    /// One topic of a recorded episode.
    Replay(Box<replay::Replay>),
}

/// Ends when the link to a device is up again.
type Unlinked = BoxFuture<'static, ()>;

/// Applies one expression to the driver of any kind.
macro_rules! each {
    ($self:ident, $driver:ident => $what:expr) => {
        match $self {
            #[cfg(feature = "cameras")]
            Driver::Camera($driver) => $what,
            Driver::Serial($driver) => $what,
            #[cfg(feature = "motors")]
            Driver::Motors($driver) => $what,
            #[cfg(feature = "motors")]
            Driver::Can($driver) => $what,
            #[cfg(feature = "lan")]
            Driver::Lan($driver) => $what,
            Driver::Sim($driver) => $what,
            Driver::Replay($driver) => $what,
        }
    };
}

impl Driver {
    /// If the link to the device behind `node` is down, a future that ends when the link is up again: while a cable is
    /// unplugged, repeated opening is useless.
    pub fn unlinked(spec: &DeviceSpec, node: &DeviceNode) -> Option<Unlinked> {
        match (&spec.node, node) {
            #[cfg(feature = "lan")]
            (NodeSpec::Lan(_), node) => Some(Box::pin(Lan::unlinked(node)?)),
            _ => None,
        }
    }

    /// Opens the node of `spec` and starts it.
    ///
    /// # Errors
    /// When the node is gone, cannot be opened, or cannot do what `spec` requests.
    pub async fn open(spec: &DeviceSpec, node: &DeviceNode) -> Result<Self, DriverError> {
        match (&spec.node, node) {
            #[cfg(feature = "cameras")]
            (NodeSpec::Camera(camera), DeviceNode::Video(path)) => {
                Ok(Self::Camera(Box::new(camera::Camera::open(&spec.name, camera, path).await?)))
            }
            (NodeSpec::Serial(serial), DeviceNode::Tty(path)) => {
                Ok(Self::Serial(Box::new(serial::Serial::open(serial, path, spec.max_bytes).await?)))
            }
            #[cfg(feature = "motors")]
            (NodeSpec::Can(can), DeviceNode::Net(_) | DeviceNode::Tty(_)) => match &can.protocol {
                CanProtocol::Damiao(motors) => Ok(Self::Motors(Box::new(Motors::open(can, motors, node).await?))),
                CanProtocol::Raw => Ok(Self::Can(Box::new(RawCan::open(can, node).await?))),
            },
            (_, DeviceNode::Sim(device)) => Self::open_sim(spec, device).await,
            #[cfg(feature = "lan")]
            (NodeSpec::Lan(settings), node @ (DeviceNode::Net(_) | DeviceNode::Lan { .. })) => {
                Ok(Self::Lan(Box::new(Lan::open(spec, settings, node).await?)))
            }
            (_, node) => Err(not_opened(spec, node)),
        }
    }

    async fn open_sim(spec: &DeviceSpec, device: &Arc<SimDevice>) -> Result<Self, DriverError> {
        if let SimSource::Replay { .. } = device.source {
            return Ok(Self::Replay(Box::new(replay::Replay::open(Arc::clone(device)).await?)));
        }
        sim::check(spec, device)?;
        let sim = sim::Sim::open(Arc::clone(device)).await?.with_node(&spec.node)?;
        Ok(Self::Sim(Box::new(sim)))
    }

    /// The next sample. Waits for as long as the device sends nothing.
    ///
    /// # Errors
    /// When the device is gone or cannot be read any more.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        each!(self, driver => driver.read().await)
    }

    /// Commands an actuator that does not receive actions itself ([`Self::attend`]): a target for each axis, in the
    /// order and units of its table of actions.
    ///
    /// # Errors
    /// When the device takes no actions, or different ones.
    pub fn command(&mut self, target: &[f64]) -> Result<(), DriverError> {
        match self {
            #[cfg(feature = "motors")]
            Self::Motors(_) => Ok(()),
            Self::Sim(driver) => driver.command(target),
            _ => Err(DriverError::Fatal("of real devices, only motors behind a CAN adapter take actions".to_owned())),
        }
    }

    /// Lets an actuator move, or stops it. A device that needs no permission accepts the order and does nothing.
    ///
    /// # Errors
    /// When it does not accept orders now.
    pub fn order(&mut self, order: Order) -> Result<(), DriverError> {
        match self {
            #[cfg(feature = "motors")]
            Self::Motors(driver) => driver.order(order),
            Self::Sim(driver) => {
                driver.joints.order(order);
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Makes it carry out these orders and actions from now on. Returns whether it receives them itself; otherwise the
    /// caller passes them to [`Self::order`] and [`Self::command`].
    pub fn attend(&mut self, orders: &Arc<Attended>, actions: &Arc<dyn ActionSource>) -> bool {
        match self {
            #[cfg(feature = "motors")]
            Self::Motors(driver) => {
                driver.attend(orders);
                driver.follow(Arc::clone(actions));
                return true;
            }
            Self::Sim(driver) => driver.joints.name_stops(orders.stops()),
            _ => {}
        }
        false
    }

    /// The events of an actuator; `Some` at the first call only.
    pub fn notices(&mut self) -> Option<mpsc::Receiver<ActuatorNotice>> {
        match self {
            #[cfg(feature = "motors")]
            Self::Motors(driver) => driver.notices(),
            Self::Sim(driver) => Some(driver.joints.notices()),
            _ => None,
        }
    }

    /// What a device that records by itself does; `Some` at the first call only.
    pub fn clips(&mut self) -> Option<mpsc::Receiver<ClipNotice>> {
        match self {
            #[cfg(feature = "lan")]
            Self::Lan(driver) => driver.clips(),
            _ => None,
        }
    }

    /// Notifies a device that records by itself of the episode in progress, or with `None` that there is none: when one
    /// begins or ends, and when the device is opened during one. Returns at once: [`Self::read`] or a task of the
    /// driver's own does the slow work.
    ///
    /// # Errors
    /// When the device cannot do it, for people; it is still read.
    pub fn record(&mut self, episode: Option<&Arc<Episode>>) -> Result<(), DriverError> {
        match self {
            #[cfg(feature = "lan")]
            Self::Lan(driver) => driver.record(episode.map(|episode| episode.file.clone())),
            Self::Sim(driver) => {
                driver.record(episode.is_some());
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// The clock of the computer that the device is on, if that is another one and it has sent a sample.
    pub fn clock(&self) -> Option<ClockOffset> {
        match self {
            #[cfg(feature = "lan")]
            Self::Lan(driver) => driver.clock(),
            _ => None,
        }
    }

    /// Ends in order the device's own activities: the run ends, or the device was unplugged. Abandoned after a moment.
    /// A driver that is only dropped was read to its end or abandoned.
    pub async fn close(self) {
        match self {
            #[cfg(feature = "motors")]
            Self::Motors(driver) => driver.close().await,
            Self::Sim(driver) => driver.close().await,
            #[cfg(feature = "lan")]
            Self::Lan(driver) => driver.close().await,
            _ => {}
        }
    }

    /// The settings agreed with the device: format, rate, driver, for people.
    pub fn description(&self) -> String {
        each!(self, driver => driver.agreed.description.clone())
    }

    /// The settings agreed with the device, for the recording. Includes about the driver only what the open node
    /// reports: a serial line reports nothing.
    pub fn negotiated(&self) -> Negotiated {
        each!(self, driver => driver.agreed.negotiated.clone())
    }
}

/// Why no driver opens this node for `spec`: the program was built without it, or the node is of another kind.
fn not_opened(spec: &DeviceSpec, node: &DeviceNode) -> DriverError {
    let (requested, missing) = match spec.node {
        NodeSpec::Camera(_) => ("camera", (!cfg!(feature = "cameras")).then_some("cameras")),
        NodeSpec::Serial(_) => ("serial line", None),
        NodeSpec::Can(_) => ("CAN adapter", (!cfg!(feature = "motors")).then_some("motors")),
        NodeSpec::Lan(_) => ("network device", (!cfg!(feature = "lan")).then_some("lan")),
        // The rig supervises programs; `process` only starts and ends them.
        NodeSpec::Process(_) => ("program", None),
    };
    if let Some(feature) = missing {
        return DriverError::Fatal(format!("{}, or remove the entry", built_without(feature)));
    }
    let is = match node {
        DeviceNode::Video(_) => "a camera",
        DeviceNode::Tty(_) => "a serial line",
        DeviceNode::Usb(_) => "a USB device",
        DeviceNode::Net(_) => "a network interface",
        DeviceNode::Lan { .. } => "on the network",
        DeviceNode::Sim(_) => "simulated",
    };
    DriverError::Fatal(format!(
        "[device.{}] is a {requested} and {} is {is}: correct `node` or the identity of the entry",
        spec.name,
        node.label()
    ))
}

/// Runs a possibly blocking step of opening a device on tokio's blocking pool.
async fn unblock<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, DriverError> + Send + 'static,
) -> Result<T, DriverError> {
    match tokio::task::spawn_blocking(work).await {
        Ok(result) => result,
        Err(ended) => Err(DriverError::Retry(format!("opening ended early: {ended}"))),
    }
}

/// Why there is no driver: a feature of the build is missing.
fn built_without(feature: &str) -> DriverError {
    DriverError::Fatal(format!(
        "this rapid was built without `{feature}`: build it with `cargo build --release --features {feature}`"
    ))
}
