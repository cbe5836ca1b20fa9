//! Emergency stops and enabling switches as they were reported last: interlocks write them, an episode takes those of its
//! beginning.

use rapid_registry::Registry;
use tokio::sync::watch;

use super::StopStatus;

/// The inputs of a rig in the order of the registry, each as it was reported last.
pub type States = watch::Receiver<Vec<StopStatus>>;

/// Where the states of the inputs of `registry` are put, and read.
pub fn states(registry: &Registry) -> (watch::Sender<Vec<StopStatus>>, States) {
    watch::channel(StopStatus::unreported(registry))
}
