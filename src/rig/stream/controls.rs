//! What an actuator is ordered: where to go, and whether it may.
//!
//! Actions come by the bus, orders from the run's [`Permission`].
//!
//! Invariant: what was given before the device was there is not for it.
//! Invariant: a run that is to arm its actuator does so once, when the device is there for the first time, and
//! not at all after another order, whatever its origin and whether or not the device was there.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::unix::AsyncFd;
use tokio::time::{Interval, MissedTickBehavior, interval};

use super::source::Source;
use crate::action::{ActionSource, MAX_ACTION, Order};
use crate::bus::{Actions, watch};
use crate::driver::DriverError;
use crate::permission::{Attended, Permission};

/// See the module's comment.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Controls {
    actions: Arc<Actions>,
    permission: Arc<Permission>,
}

/// The longest that an action of a program that does not notify waits.
const LOOK: Duration = Duration::from_millis(10);

/// The controls of a device that is there, and does not take its orders and actions itself.
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

    /// Whose orders it carries out from now on.
    pub(in crate::rig) fn obey(&mut self, permission: &Arc<Permission>) {
        self.permission = Arc::clone(permission);
    }

    /// Its device is there. `None` if it takes its orders and actions itself.
    ///
    /// # Errors
    /// When it cannot be armed.
    pub(super) fn begin(&self, source: &mut Source) -> Result<Option<Controlled>, DriverError> {
        self.actions.discard();
        let orders = Arc::new(self.permission.attend());
        let actions = Arc::clone(&self.actions);
        let takes_itself = source.attend(&orders, &(actions as Arc<dyn ActionSource>));
        match orders.is_to_be_armed() {
            Ok(true) => source.order(Order::Arm).inspect_err(|_| orders.was_not_armed())?,
            Ok(false) => {}
            Err(blocked) => tracing::warn!("not armed at the start: {blocked}"),
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

/// Returns when a bell rings. It is to be silenced then.
async fn rings(bell: Option<&AsyncFd<OwnedFd>>) {
    let Some(bell) = bell else { return std::future::pending().await };
    match bell.readable().await {
        Ok(mut ready) => ready.clear_ready(),
        Err(_) => std::future::pending().await,
    }
}

impl Controlled {
    /// Returns when an order or an action may have come. Cancel-safe.
    pub(super) async fn changed(&mut self) {
        let [orders, actions] = &self.bells;
        tokio::select! {
            () = rings(orders.as_ref()) => {}
            () = rings(actions.as_ref()) => {}
            _ = self.look.tick() => {}
        }
    }

    /// Hands the device the orders that came since the last call.
    ///
    /// # Errors
    /// When it does not take one.
    pub(super) fn pass_on_orders(&mut self, source: &mut Source) -> Result<(), DriverError> {
        self.orders.take().try_for_each(|order| source.order(order))
    }

    /// Hands the device the newest action that came since the last call, if any did.
    ///
    /// # Errors
    /// When it does not take it, or what came is not to be followed.
    pub(super) fn pass_on_action(&mut self, source: &mut Source) -> Result<(), DriverError> {
        match self.actions.newest(&mut self.action) {
            Ok(Some((target, _))) => source.command(target),
            Ok(None) => Ok(()),
            Err(refused) => Err(DriverError::Retry(refused.to_string())),
        }
    }
}
