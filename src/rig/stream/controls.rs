//! What an actuator is told: where to go, and whether it may.
//!
//! Actions come by the bus, orders from the run's [`Permission`].
//!
//! Invariant: what was given before the device was there is not for it.
//! Invariant: a run that is to arm its actuator does so once, when the device is there for the first time, and
//! not at all after another order, whoever gave it and whether or not the device was there.

use std::sync::Arc;

use super::source::Source;
use crate::action::{MAX_ACTION, Order};
use crate::bus::Actions;
use crate::driver::DriverError;
use crate::permission::{Attended, Permission};

/// See the module's comment.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Controls {
    actions: Arc<Actions>,
    permission: Arc<Permission>,
}

/// The controls of a device that is there.
#[derive(Debug)]
pub(super) struct Controlled {
    actions: Arc<Actions>,
    orders: Arc<Attended>,
    /// The device takes its orders itself.
    takes_orders: bool,
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

    /// Its device is there.
    ///
    /// # Errors
    /// When it cannot be armed.
    pub(super) fn begin(&self, source: &mut Source) -> Result<Controlled, DriverError> {
        self.actions.discard();
        let orders = Arc::new(self.permission.attend());
        let takes_orders = source.attend(&orders);
        match orders.is_to_be_armed() {
            Ok(true) => source.order(Order::Arm).inspect_err(|_| orders.was_not_armed())?,
            Ok(false) => {}
            Err(blocked) => tracing::warn!("not armed at the start: {blocked}"),
        }
        Ok(Controlled { actions: Arc::clone(&self.actions), orders, takes_orders, action: [0.0; MAX_ACTION] })
    }
}

impl Controlled {
    /// Hands the device the orders that came since the last call.
    ///
    /// # Errors
    /// When it does not take one.
    pub(super) fn pass_on_orders(&mut self, source: &mut Source) -> Result<(), DriverError> {
        if self.takes_orders {
            return Ok(());
        }
        self.orders.take().try_for_each(|order| source.order(order))
    }

    /// Hands the device the newest action that came since the last call, if any did.
    ///
    /// # Errors
    /// When it does not take it, or what came is not to be followed.
    pub(super) fn pass_on_action(&mut self, source: &mut Source) -> Result<(), DriverError> {
        match self.actions.newest(&mut self.action) {
            Ok(Some((target, tick))) => source.command(target, tick),
            Ok(None) => Ok(()),
            Err(refused) => Err(DriverError::Retry(refused.to_string())),
        }
    }
}
