//! Emergency stops and enabling switches as they were reported last: interlocks write them, an episode takes those of its
//! beginning.

use rapid_registry::Registry;
use tokio::sync::watch;

use super::StopStatus;

/// The inputs of a rig in the order of the registry, each as it was reported last.
pub type States = watch::Receiver<Vec<StopStatus>>;

/// Where the states are put.
#[derive(Debug, Clone)]
pub struct Reported(watch::Sender<Vec<StopStatus>>);

impl Reported {
    /// The inputs of `registry`, none of which has reported.
    pub fn nothing(registry: &Registry) -> Self {
        Self(watch::Sender::new(StopStatus::unreported(registry)))
    }

    /// What is reported from now on.
    pub fn states(&self) -> States {
        self.0.subscribe()
    }

    /// Changes what is reported of the input at `index`. Two reporters do not change it at the same time.
    pub fn update(&self, index: usize, change: impl FnOnce(&mut StopStatus)) {
        self.0.send_modify(|all| {
            if let Some(stop) = all.get_mut(index) {
                change(stop);
            }
        });
    }
}
