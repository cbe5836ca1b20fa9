//! A node of iceoryx2 on a bus whose files are in order: taking part, and leaving nothing behind.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use iceoryx2::config::Config;
use iceoryx2::prelude::*;
use rustix::fs::{FlockOperation, flock};

use super::error::{addresses, lacking, or_damage};
use super::leftovers::Files;
use super::service::Service;
use super::{BusError, place, room, sigbus};

/// Whoever looks through the files takes milliseconds.
const TURN_LIMIT: Duration = Duration::from_secs(1);
const TURN_LOOK: Duration = Duration::from_millis(5);

/// A node. When it goes, so do the files of the bus that nobody else uses.
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
    /// Takes part in the bus of `instance`, for which `need` bytes of shared memory are to be there.
    ///
    /// # Errors
    /// When what the bus lives in is not ours, is damaged, or has too little room.
    pub(super) fn open(instance: Option<&str>, need: u64) -> Result<Self, BusError> {
        sigbus::install()?;
        let config = config(instance)?;
        // Its path ends in a slash, behind which a link could not be told from what it means.
        let root: PathBuf = PathBuf::from(config.global.root_path().to_string()).components().collect();
        place::check(&root)?;
        place::make(&root)?;
        let prefix = config.global.prefix.to_string();
        let files = Leaving { files: Files::new(prefix.clone(), root.clone()), root };
        // Until the node is there: who looks through the files meanwhile would take its first ones for a dead one's.
        let turn = take_turn(&files.root);
        files.files.clear()?;
        room::check(need)?;
        addresses(need)?;
        let node = NodeBuilder::new()
            .config(&config)
            // Signals belong to the program, not to a library.
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>();
        files.files.make_counter();
        drop(turn);
        let node = node.map_err(|error| {
            let cause = lacking().or_else(|| place::in_the_way(&prefix));
            cause.unwrap_or_else(|| or_damage(BusError::Node(error.to_string()), &files.files))
        })?;
        Ok(Self { node, files })
    }

    pub(super) const fn node(&self) -> &Node<Service> {
        &self.node
    }

    /// `error`, or the damaged file it comes from, or the room that was not there.
    pub(super) fn explain(&self, error: BusError) -> BusError {
        if sigbus::happened() { BusError::Lost } else { or_damage(error, &self.files.files) }
    }

    /// Gives back what programs that were killed held. Blocks for as long as files are looked through.
    pub(super) fn sweep(&self) {
        let _ = self.node.try_cleanup_dead_nodes();
        self.files.clear();
    }
}

impl Leaving {
    /// What cannot be cleared now is reported by the next start.
    fn clear(&self) {
        let _turn = take_turn(&self.root);
        let _ = self.files.clear();
    }
}

impl Drop for Leaving {
    fn drop(&mut self) {
        self.clear();
    }
}

/// Keeps the processes of this program from looking through the files at the same time; `None` where another takes
/// longer than [`TURN_LIMIT`], or there is no folder.
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

/// Begins the names of all files of a bus.
fn config(instance: Option<&str>) -> Result<Config, BusError> {
    let mut config = Config::global_config().clone();
    if let Some(instance) = instance {
        let prefix = format!("iox2_{instance}_");
        config.global.prefix = FileName::new(prefix.as_bytes())
            .map_err(|error| BusError::Node(format!("instance name {instance:?}: {error:?}")))?;
    }
    Ok(config)
}
