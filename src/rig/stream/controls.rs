//! The commands of an actuator: where to move, and whether it may.
//!
//! Actions come from the bus, orders from the run's [`Permission`].
//!
//! Invariant: commands given before the device was present do not apply to it.
//! Invariant: a run that arms its actuator does so once, when the device is first present, and not at all after any
//! other order, whatever its origin and whether or not the device was present.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::Duration;

use rapid_bus::{Actions, watch};
use rapid_core::action::{ActionSource, MAX_ACTION};
use rapid_core::permission::{Attended, Permission};
use rapid_devices::driver::DriverError;
use tokio::io::unix::AsyncFd;
use tokio::time::{Interval, MissedTickBehavior, interval};

use super::source::SampleSource;

#[derive(Debug, Clone)]
pub(in crate::rig) struct Controls {
    actions: Arc<Actions>,
    permission: Arc<Permission>,
}

/// The longest time that an action without a notification waits.
const LOOK: Duration = Duration::from_millis(10);

/// The controls of a device that is present and does not take its orders and actions itself.
#[derive(Debug)]
pub(super) struct Controlled {
    actions: Arc<Actions>,
    orders: Arc<Attended>,
    bells: [Option<AsyncFd<OwnedFd>>; 2],
    look: Interval,
    action: [f64; MAX_ACTION],
}

impl Controls {
    pub(in crate::rig) fn new(actions: Arc<Actions>) -> Self {
        Self { actions, permission: Arc::default() }
    }

    /// Sets whose orders it carries out from now on.
    pub(in crate::rig) fn obey(&mut self, permission: &Arc<Permission>) {
        self.permission = Arc::clone(permission);
    }

    /// Called when its device is present. `None` if the device takes its orders and actions itself.
    ///
    /// # Errors
    /// When it cannot be armed.
    pub(super) fn begin(&self, source: &mut SampleSource) -> Result<Option<Controlled>, DriverError> {
        self.actions.discard();
        let orders = Arc::new(self.permission.attend());
        let actions = Arc::clone(&self.actions);
        let takes_itself = source.attend(&orders, &(actions as Arc<dyn ActionSource>));
        if let Some(blocked) = orders.arm_at_first_plug(|order| source.order(order))? {
            tracing::warn!("not armed at the start: {blocked}");
        }
        if takes_itself {
            return Ok(None);
        }
        let actions = Arc::clone(&self.actions);
        let bells = [orders.bell().descriptor(), actions.bell()].map(|bell| bell.and_then(watch));
        let mut look = interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Ok(Some(Controlled { actions, orders, bells, look, action: [0.0; MAX_ACTION] }))
    }
}

/// Returns when an event is signalled. The caller then has to clear it.
async fn rings(bell: Option<&AsyncFd<OwnedFd>>) {
    let Some(bell) = bell else { return std::future::pending().await };
    match bell.readable().await {
        Ok(mut ready) => ready.clear_ready(),
        Err(_) => std::future::pending().await,
    }
}

impl Controlled {
    /// Returns when an order or an action may have arrived. Cancel-safe.
    pub(super) async fn changed(&mut self) {
        let [orders, actions] = &self.bells;
        tokio::select! {
            () = rings(orders.as_ref()) => {}
            () = rings(actions.as_ref()) => {}
            _ = self.look.tick() => {}
        }
    }

    /// Passes the device the orders since the last call.
    ///
    /// # Errors
    /// When it does not accept one.
    pub(super) fn pass_on_orders(&mut self, source: &mut SampleSource) -> Result<(), DriverError> {
        self.orders.take_pending().try_for_each(|order| source.order(order))
    }

    /// Passes the device the newest action since the last call, if any.
    ///
    /// # Errors
    /// When it does not accept the action, or the action must not be followed.
    pub(super) fn pass_on_action(&mut self, source: &mut SampleSource) -> Result<(), DriverError> {
        match self.actions.newest(&mut self.action) {
            Ok(Some((target, _))) => source.command(target),
            Ok(None) => Ok(()),
            Err(refused) => Err(DriverError::Retry(refused.to_string())),
        }
    }
}
