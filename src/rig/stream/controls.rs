//! What an actuator is told: where to go, and whether it may.
//!
//! Actions and the orders of other programs come by the bus, those of this run's own operator from the rig.
//!
//! Invariant: what was said before the device was there is not for it.

use std::sync::Arc;

use tokio::sync::watch;

use super::source::Source;
use crate::action::{MAX_ACTION, Order};
use crate::bus::Actions;
use crate::driver::DriverError;

/// See the module's comment.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Controls {
    actions: Arc<Actions>,
    orders: watch::Receiver<Option<Order>>,
    /// It is to be armed as soon as it is there.
    pub(in crate::rig) arm: bool,
    action: [f64; MAX_ACTION],
}

impl Controls {
    pub(in crate::rig) fn new(actions: Arc<Actions>, orders: watch::Receiver<Option<Order>>, arm: bool) -> Self {
        Self { actions, orders, arm, action: [0.0; MAX_ACTION] }
    }

    /// Its device is there.
    ///
    /// # Errors
    /// When it cannot be armed.
    pub(super) fn begin(&mut self, source: &mut Source) -> Result<(), DriverError> {
        self.orders.mark_unchanged();
        self.actions.discard();
        if self.arm { source.order(Order::Arm) } else { Ok(()) }
    }

    /// Hands the device what came since the last call.
    ///
    /// # Errors
    /// When it does not take it.
    pub(super) fn pass_on(&mut self, source: &mut Source) -> Result<(), DriverError> {
        if self.orders.has_changed().unwrap_or(false)
            && let Some(order) = *self.orders.borrow_and_update()
        {
            source.order(order)?;
        }
        while let Some(order) = self.actions.order() {
            source.order(order)?;
        }
        match self.actions.newest(&mut self.action) {
            Some((target, tick)) => source.command(target, tick),
            None => Ok(()),
        }
    }
}
