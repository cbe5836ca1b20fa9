//! The link of a network adapter: whether a cable, or the device, is at its other end.
//!
//! The adapter itself stays plugged in when that goes, so nobody else tells of it.

use std::fs;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

use tokio::time::{Interval, MissedTickBehavior, interval};

use crate::registry::DeviceNode;

/// How often it is looked at.
const EVERY: Duration = Duration::from_millis(100);

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Carrier {
    /// Of an adapter: `1` with a link (Documentation/ABI/testing/sysfs-class-net, `carrier`).
    file: Option<PathBuf>,
    /// Adapters that never tell are believed to have one.
    was_up: bool,
    beat: Interval,
}

impl Carrier {
    /// That of the adapter at `node`, if it is one.
    pub(super) fn of(node: &DeviceNode) -> Self {
        let file = match node {
            DeviceNode::Net(interface) => Some(PathBuf::from("/sys/class/net").join(interface).join("carrier")),
            _ => None,
        };
        Self::watching(file)
    }

    fn watching(file: Option<PathBuf>) -> Self {
        let mut beat = interval(EVERY);
        beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Self { file, was_up: false, beat }
    }

    /// Is it known to be down?
    pub(super) fn is_down(&self) -> bool {
        self.file.as_ref().is_some_and(|file| matches!(fs::read(file).as_deref(), Ok([b'0', ..])))
    }

    /// Waits until it is up, or the adapter is gone. Cancel-safe.
    pub(super) async fn up(&mut self) {
        let Some(file) = &self.file else { return };
        loop {
            self.beat.tick().await;
            match fs::read(file) {
                Ok(told) if told.starts_with(b"1") => return,
                Err(error) if error.kind() == io::ErrorKind::NotFound => return,
                // Of an interface that is down nothing is known.
                _ => {}
            }
        }
    }

    /// Waits until it is lost, after it was there. Cancel-safe.
    pub(super) async fn lost(&mut self) {
        let Some(file) = &self.file else { return std::future::pending().await };
        loop {
            self.beat.tick().await;
            match fs::read(file).ok().as_deref() {
                Some([b'1', ..]) => self.was_up = true,
                Some([b'0', ..]) if self.was_up => return,
                // An interface that is down or gone has none to tell of; the latter is told by others.
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::time::timeout;

    use super::*;

    #[tokio::test]
    async fn a_link_that_is_down_is_waited_for() {
        let file = tempfile::NamedTempFile::new().expect("file");
        fs::write(file.path(), "0\n").expect("written");
        let mut carrier = Carrier::watching(Some(file.path().to_owned()));
        assert!(carrier.is_down());
        assert!(timeout(Duration::from_millis(350), carrier.up()).await.is_err(), "it is down");
        fs::write(file.path(), "1\n").expect("written");
        carrier.up().await;
        assert!(!carrier.is_down());
        // The adapter is unplugged meanwhile.
        fs::write(file.path(), "0\n").expect("written");
        file.close().expect("removed");
        carrier.up().await;
        assert!(!carrier.is_down() && !Carrier::watching(None).is_down());
    }

    #[tokio::test]
    async fn only_a_link_that_was_there_is_lost() {
        let file = tempfile::NamedTempFile::new().expect("file");
        fs::write(file.path(), "0\n").expect("written");
        let mut carrier = Carrier::watching(Some(file.path().to_owned()));
        assert!(timeout(Duration::from_millis(350), carrier.lost()).await.is_err(), "it never was there");
        fs::write(file.path(), "1\n").expect("written");
        assert!(timeout(Duration::from_millis(350), carrier.lost()).await.is_err(), "it is there");
        fs::write(file.path(), "0\n").expect("written");
        carrier.lost().await;
        assert!(timeout(Duration::from_millis(350), Carrier::watching(None).lost()).await.is_err());
    }
}
