//! Emergency stops and enabling switches as they were reported last: interlocks write them, an episode takes those of its
//! beginning.

use rapid_core::interlock::InputState;
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

    /// The input at `index` is in this state, `why` if it is lost. Returns what it was noted as.
    pub fn note(&self, index: usize, state: InputState, why: &str) -> Option<StopStatus> {
        let mut noted = None;
        self.0.send_modify(|all| {
            noted = all.get_mut(index).map(|stop| {
                (stop.state, stop.detail) = (state, why.to_owned());
                stop.clone()
            });
        });
        noted
    }
}
