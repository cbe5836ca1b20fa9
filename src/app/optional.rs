//! Stages that a build may lack, each a crate with a cargo feature: servers, and the policy.
//!
//! Invariant: the other stages know them by what is here alone.

use std::fmt::Debug;
use std::sync::{Arc, mpsc};

use futures::future::BoxFuture;
use rapid_bus::{Bus, Subscription};
use rapid_core::permission::Permission;
use rapid_core::time::WallClock;
use rapid_episode::ReferenceSample;
use rapid_episode::made::Shown;
use rapid_registry::{DeviceSpec, Registry};
use rapid_status::{Board, EpisodeWatch};
use tokio::sync::mpsc::UnboundedSender;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::AppError;
use super::requests::Request;
use super::stage::Stage;
use crate::rig::presence::Published;

/// The options of a server that shows the run to others, and passes on what they request.
///
/// Invariant: no recording ends because of it: once it listens, its failure is an error of the log.
pub trait Server: Debug + Send {
    /// Listens, before anything of the run is started: a port in use is an error of the start.
    fn listen<'a>(self: Box<Self>, host: &'a Host<'a>) -> BoxFuture<'a, Result<Listening, AppError>>;
}

/// What there is before the stages.
#[derive(Debug)]
pub struct Host<'a> {
    pub(super) registry: &'a Arc<Registry>,
    pub(super) board: &'a Arc<Board>,
    pub(super) permission: &'a Arc<Permission>,
    pub(super) conductor: &'a UnboundedSender<Request>,
}

/// An entry that was added during the run, and its samples.
pub(super) type AddedEntry = (Arc<DeviceSpec>, Subscription);

/// Starts the stage of a server that listens.
pub(super) type StartServer = dyn FnOnce(&Bus, &Board, watch::Receiver<WallClock>) -> Result<Stage, AppError> + Send;

/// A server that shows nothing yet.
pub struct Listening {
    /// Receives what the recorder writes besides samples, if the server shows it.
    pub(super) shown: Option<Shown>,
    /// Receives the entries that are added, if the server shows samples.
    pub(super) additions: Option<mpsc::Sender<AddedEntry>>,
    pub(super) start: Box<StartServer>,
}

/// The policy of a run, and how it acts.
///
/// Invariant: it never starts without what it requires.
pub trait Policy: Debug + Send {
    /// Starts its stage.
    ///
    /// # Errors
    /// When it cannot read the bus.
    fn start(self: Box<Self>, surroundings: Surroundings<'_>) -> Result<Stage, AppError>;
}

/// What a policy is given by other stages.
#[derive(Debug)]
pub struct Surroundings<'a> {
    pub(super) registry: &'a Arc<Registry>,
    pub(super) bus: &'a Bus,
    pub(super) board: &'a Arc<Board>,
    /// Cancelled by it when the policy is loaded.
    pub(super) loaded: &'a CancellationToken,
    /// Receives the samples that all later ones of an observation are compared with.
    pub(super) references: mpsc::Sender<ReferenceSample>,
    pub(super) mask: Published,
    /// The episode that is to hold everything that it observes, if it is to be recorded.
    pub(super) episode: Option<EpisodeWatch>,
}
