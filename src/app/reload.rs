//! Stage registry: takes over entries that are added to `devices.toml` during a run.
//!
//! 1. The file is read and compared with the registry of the run ([`Difference`]); whatever else differs refuses it all.
//! 2. The topics are opened, their memory is reserved, and recorder and synchronisation subscribe: no sample is missed.
//! 3. The board, the recorder, the synchronisation and the rig get the entries, in this order. The rig attaches devices
//!    that are plugged in already; then discovery searches for those that are found on the network.
//!
//! A policy and the interlocks keep the registry that they were started with.
//!
//! Invariant: a request that is refused changes nothing of the run.
//! Invariant: whatever blocks is done where blocking is allowed; mask, rig, streams and recorder wait for none of it.

use std::path::Path;
use std::sync::Arc;

use rapid_bus::{BusError, Extension, Membership, Subscription};
use rapid_core::time::Stamp;
use rapid_episode::record::RecorderAddition;
use rapid_registry::{DeviceSpec, Difference, ModuleSpec, Registry};
use rapid_status::session::Answered;
use rapid_status::{Board, EpisodeWatch, EventKind, Level, RegistryRequest};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::spawn_blocking;

use super::optional::AddedEntry;
use super::requests::Reply;
use super::stage::Stage;
use crate::registration;
use crate::rig::{Addition, RigCommand};

/// The answer when the rest of the run is gone.
const ENDING: &str = "the run is ending";
const UNCHANGED: &str = "nothing was changed";

#[derive(Debug)]
pub(super) struct Reload {
    /// The registry as the run has it: with what the command line changed in it, and with added entries.
    pub(super) registry: Arc<Registry>,
    pub(super) bus: Membership,
    pub(super) board: Arc<Board>,
    pub(super) rig: mpsc::Sender<RigCommand>,
    /// Searches for what is on the network.
    pub(super) discovery: mpsc::UnboundedSender<Vec<Arc<DeviceSpec>>>,
    pub(super) recorder: std::sync::mpsc::Sender<RecorderAddition>,
    pub(super) episode: EpisodeWatch,
    pub(super) alignment: mpsc::UnboundedSender<(Arc<DeviceSpec>, Subscription)>,
    /// Servers that show samples.
    pub(super) servers: Vec<std::sync::mpsc::Sender<AddedEntry>>,
    /// The modules that can be mounted.
    pub(super) modules: watch::Sender<Vec<ModuleSpec>>,
    /// Topics of added entries.
    pub(super) topics: Vec<Extension>,
}

/// The stage, and where it gets its requests.
#[derive(Debug)]
pub(super) struct Reloading {
    pub(super) stage: Stage,
    pub(super) requests: mpsc::UnboundedSender<(RegistryRequest, Reply)>,
}

/// An added entry whose topic is open.
struct Opened {
    device: Arc<DeviceSpec>,
    topic: Extension,
    recorder: Subscription,
    alignment: Subscription,
    /// For each server.
    servers: Vec<Subscription>,
}

impl Reload {
    /// Starts the stage. It must end after all that use the topics, and before the bus is dropped.
    pub(super) fn start(mut self) -> Reloading {
        let (to_registry, mut requests) = mpsc::unbounded_channel::<(RegistryRequest, Reply)>();
        let stage = Stage::start("the registry", |stop| async move {
            loop {
                let (request, reply) = tokio::select! {
                    biased;
                    () = stop.cancelled() => return Ok(()),
                    Some(request) = requests.recv() => request,
                };
                let answer = async {
                    match request {
                        RegistryRequest::Reload => self.reload().await,
                        RegistryRequest::Register { device, name } => self.register(device, name).await,
                    }
                };
                let answer = tokio::select! {
                    biased;
                    // A file that cannot be read at the moment does not hold up the end of the run.
                    () = stop.cancelled() => return Ok(()),
                    answer = answer => answer,
                };
                self.show(&answer);
                // The requester may have ended.
                let _ = reply.map(|reply| reply.send(answer));
            }
        });
        Reloading { stage, requests: to_registry }
    }

    fn show(&self, answer: &Result<String, String>) {
        let (Ok(text) | Err(text)) = answer;
        let text = text.lines().map(str::trim).collect::<Vec<_>>().join("; ");
        if answer.is_err() {
            self.board.announce(EventKind::Log { level: Level::Warn, text: text.clone() });
        }
        self.board.set_registry_answer(Answered { at: Stamp::now(), text, refused: answer.is_err() });
    }

    /// Adds an entry for a connected unit to the file, and takes it over.
    async fn register(&mut self, device: String, name: String) -> Result<String, String> {
        let path = file(&self.registry)?.to_owned();
        if !self.registry.devices.is_empty() && !path.exists() {
            // A new file would give the bits of this run to other devices.
            let gone = format!("{} is gone, and this run uses its entries", path.display());
            return Err(format!("{gone}: put it back, or restart rapid; nothing was written"));
        }
        let (reply, attached) = oneshot::channel();
        self.rig.send(RigCommand::Attached(reply)).await.map_err(|_| ENDING)?;
        let attached = attached.await.map_err(|_| ENDING)?;
        let entry = name.clone();
        let written = blocking(move || registration::register(&path, &attached, &device, &entry)).await?;
        written.map_err(|error| error.to_string())?;
        self.reload().await.map_err(|why| format!("[device.{name}] is in the file, but not in this run: {why}"))
    }

    /// Takes over what was added to the file.
    async fn reload(&mut self) -> Result<String, String> {
        let running = Arc::clone(&self.registry);
        let (registry, added, modules) = blocking(move || changed(&running)).await??;
        if added.is_empty() && modules.is_empty() {
            return Ok("no entry was added, and no other change needs a restart".to_owned());
        }
        let (bus, servers) = (self.bus.clone(), self.servers.len());
        let opened = blocking(move || open(&bus, added, servers)).await?;
        let opened = opened.map_err(|error| format!("{error}; {UNCHANGED}"))?;
        let devices =
            opened.iter().map(|opened| format!("[device.{}] as bit {}", opened.device.name, opened.device.id));
        let names: Vec<_> = devices.chain(modules.iter().map(|name| format!("[module.{name}]"))).collect();
        let names = names.join(", ");
        let episode = if self.episode.borrow().is_some() { "; recorded from the next episode on" } else { "" };
        self.board.announce(EventKind::Log { level: Level::Info, text: format!("registry: added {names}{episode}") });
        // A stage that is gone has ended with the run, or ends it.
        let _ = self.recorder.send(RecorderAddition { registry: Arc::clone(&registry), subscription: None });
        let devices = opened.iter().map(|opened| Arc::clone(&opened.device)).collect();
        for opened in opened {
            self.add(opened, &registry).await?;
        }
        // After the rig has the entries: what is found belongs to one of them.
        let _ = self.discovery.send(devices);
        self.modules.send_replace(registry.modules.clone());
        self.registry = registry;
        Ok(format!("added {names}{episode}"))
    }

    async fn add(&mut self, opened: Opened, registry: &Arc<Registry>) -> Result<(), String> {
        let Opened { device, topic, recorder, alignment, servers } = opened;
        self.board.add(&device);
        // A stage that is gone has ended with the run, or ends it.
        let _ = self.recorder.send(RecorderAddition { registry: Arc::clone(registry), subscription: Some(recorder) });
        let _ = self.alignment.send((Arc::clone(&device), alignment));
        for (server, samples) in self.servers.iter().zip(servers) {
            let _ = server.send((Arc::clone(&device), samples));
        }
        let writer = topic.writer();
        self.topics.push(topic);
        let addition = Addition { device, registry: Arc::clone(registry), writer };
        Ok(self.rig.send(RigCommand::Register(addition)).await.map_err(|_| ENDING)?)
    }
}

async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, String> {
    spawn_blocking(work).await.map_err(|_| format!("reading the registry panicked; please report this; {UNCHANGED}"))
}

fn file(registry: &Registry) -> Result<&Path, String> {
    let why = "this run has the registry that is built in, and no file: start it with --config FILE";
    registry.path.as_deref().ok_or_else(|| why.to_owned())
}

/// The registry of the file, as the run would have it, and the entries and the names of the modules that it has more.
type Changed = (Arc<Registry>, Vec<DeviceSpec>, Vec<String>);

fn changed(running: &Registry) -> Result<Changed, String> {
    let path = file(running)?;
    let mut new = Registry::load(path).map_err(|error| format!("{error}\n{UNCHANGED}"))?.registry;
    // Without what the command line changed.
    let declared = match running.text.as_str() {
        // The run began without a file.
        "" => running.clone(),
        text => Registry::parse(text, Some(path)).map_err(|error| format!("{error}\n{UNCHANGED}"))?.registry,
    };
    let Difference { added, modules, needs_restart } = Difference::between(&declared, &new);
    if !needs_restart.is_empty() {
        let lines: Vec<_> = needs_restart.iter().map(|line| format!("\n  {line}")).collect();
        return Err(format!("{}: restart rapid to apply this; {UNCHANGED}{}", path.display(), lines.concat()));
    }
    new.rig = running.rig.clone();
    Ok((Arc::new(new), added, modules))
}

/// Opens the topics of these entries, or none.
fn open(bus: &Membership, added: Vec<DeviceSpec>, servers: usize) -> Result<Vec<Opened>, BusError> {
    let open = |device: DeviceSpec| {
        let topic = bus.extend(&device)?;
        let (recorder, alignment) = (topic.subscribe()?, topic.subscribe()?);
        let servers = (0..servers).map(|_| topic.subscribe()).collect::<Result<_, _>>()?;
        Ok(Opened { device: Arc::new(device), topic, recorder, alignment, servers })
    };
    added.into_iter().map(open).collect()
}
