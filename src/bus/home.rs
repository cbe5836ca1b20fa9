//! An iceoryx2 node on a bus whose files are in order: joins the bus and leaves no files behind.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use iceoryx2::config::Config;
use iceoryx2::prelude::*;
use rustix::fs::{FlockOperation, flock};

use super::error::{addresses, lacking, or_damage};
use super::service::Service;
use super::stale_files::Files;
use super::{BusError, paths, space};

/// A process that scans the files takes milliseconds.
const TURN_LIMIT: Duration = Duration::from_millis(500);
const TURN_LOOK: Duration = Duration::from_millis(5);
/// How long another process may take to fill a file that it has created.
const FILL_LIMIT: Duration = Duration::from_millis(400);
/// How long iceoryx2 waits for another process to finish creating a resource.
const CREATION_LIMIT: Duration = Duration::from_millis(400);
// Damage is reported within two seconds. Processes waiting for their turn and the rest of the start share that time.
const _: () = assert!(FILL_LIMIT.as_millis() + CREATION_LIMIT.as_millis() < 1000, "damage is reported too late");

/// A node. Dropping it removes the files of the bus that no other process uses.
#[derive(Debug)]
pub(super) struct Home {
    // Declared in the order they must be dropped.
    node: Node<Service>,
    files: Leaving,
}

/// Clears the files when it is dropped.
#[derive(Debug)]
struct Leaving {
    files: Files,
    root: PathBuf,
}

impl Home {
    /// Joins the bus of `instance`, which needs `need` bytes of free shared memory.
    ///
    /// # Errors
    /// When the bus's files belong to another user, are damaged, or have too little space.
    pub(super) fn open(instance: Option<&str>, need: u64) -> Result<Self, BusError> {
        paths::processes()?;
        paths::memory()?;
        let config = config(instance)?;
        let root = root(&config);
        paths::check(&root)?;
        paths::make(&root)?;
        let prefix = config.global.prefix.to_string();
        let files = Leaving { files: Files::new(prefix.clone(), root.clone()), root };
        // Held until the node exists: a scan meanwhile would take its first files for those of a dead process.
        let turn = take_turn(&files.root);
        files.files.clear(FILL_LIMIT)?;
        space::check(need)?;
        addresses(need)?;
        // Signals belong to the program, not to a library.
        let builder = NodeBuilder::new().config(&config).signal_handling_mode(SignalHandlingMode::Disabled);
        let node = builder.create::<Service>();
        files.files.make_counter();
        drop(turn);
        let node = node.map_err(|error| {
            let cause = lacking().or_else(|| paths::in_the_way(&prefix));
            cause.unwrap_or_else(|| or_damage(BusError::Node(error.to_string()), &files.files))
        })?;
        Ok(Self { node, files })
    }

    pub(super) fn node(&self) -> &Node<Service> {
        &self.node
    }

    /// `error`, or its cause: a damaged file or missing space.
    pub(super) fn explain(&self, error: BusError) -> BusError {
        or_damage(error, &self.files.files)
    }

    /// Releases the resources of killed programs. Blocks while it scans the files.
    pub(super) fn sweep(&self) {
        self.node.try_cleanup_dead_nodes();
        self.files.clear();
    }
}

impl Leaving {
    /// The next start reports files that cannot be removed now.
    fn clear(&self) {
        let _turn = take_turn(&self.root);
        let _ = self.files.clear(Duration::ZERO);
    }
}

impl Drop for Leaving {
    fn drop(&mut self) {
        self.clear();
    }
}

/// Removes the files of other instances than `instance` that have no live process. Those that cannot be removed are
/// reported by that instance's next start.
pub(super) fn clear_others(instance: Option<&str>) {
    let Ok(config) = config(instance) else { return };
    let root = root(&config);
    if paths::check(&root).is_ok() {
        let _turn = take_turn(&root);
        Files::new(config.global.prefix.to_string(), root).clear_others();
    }
}

/// The folder of iceoryx2.
fn root(config: &Config) -> PathBuf {
    // Its path ends in a slash, which would hide whether it is a symbolic link.
    PathBuf::from(config.global.root_path().to_string()).components().collect()
}

/// Keeps processes of this program from scanning the files at the same time; `None` if another takes longer than
/// [`TURN_LIMIT`], or there is no folder.
fn take_turn(root: &Path) -> Option<File> {
    let folder = File::open(root).ok()?;
    let until = Instant::now() + TURN_LIMIT;
    while flock(&folder, FlockOperation::NonBlockingLockExclusive).is_err() {
        if Instant::now() >= until {
            return None;
        }
        std::thread::sleep(TURN_LOOK);
    }
    Some(folder)
}

/// Sets the prefix of the names of all files of a bus.
fn config(instance: Option<&str>) -> Result<Config, BusError> {
    let mut config = Config::global_config().clone();
    config.global.creation_timeout = CREATION_LIMIT;
    let own = paths::of_this_user(&root(&config));
    if own != root(&config) {
        let own = iceoryx2::prelude::Path::new(own.as_os_str().as_encoded_bytes());
        let own = own.map_err(|error| BusError::Node(format!("the folder of this user's bus: {error:?}")))?;
        config.global.set_root_path(&own);
    }
    if let Some(instance) = instance {
        let prefix = format!("iox2_{instance}_");
        config.global.prefix = FileName::new(prefix.as_bytes())
            .map_err(|error| BusError::Node(format!("instance name {instance:?}: {error:?}")))?;
    }
    Ok(config)
}
