//! What an actuator is told: where to go, and whether it may.
//!
//! Actions and the orders of other programs come by the bus, those of this run's own operator from the rig.
//!
//! Invariant: what was said before the device was there is not for it.
//! Invariant: a run that is to arm its actuator does so once, when the device is there for the first time, and
//! not at all after another order, whoever gave it and whether or not the device was there.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::source::Source;
use crate::action::{MAX_ACTION, Order, OrderSlot};
use crate::bus::Actions;
use crate::driver::DriverError;

/// See the module's comment.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Controls {
    actions: Arc<Actions>,
    /// From the rig.
    orders: Arc<OrderSlot>,
    /// It is to be armed as soon as it is there.
    arm: Arc<AtomicBool>,
    action: [f64; MAX_ACTION],
}

impl Controls {
    pub(in crate::rig) fn new(actions: Arc<Actions>, orders: Arc<OrderSlot>) -> Self {
        Self { actions, orders, arm: Arc::default(), action: [0.0; MAX_ACTION] }
    }

    /// It is to be armed as soon as it is there, once.
    pub(in crate::rig) fn arm_once(&self, arm: bool) {
        self.arm.store(arm, Ordering::Release);
    }

    /// Its device is there.
    ///
    /// # Errors
    /// When it cannot be armed.
    pub(super) fn begin(&mut self, source: &mut Source) -> Result<(), DriverError> {
        let told = self.orders.take().count() > 0;
        let told = self.actions.discard() || told;
        if !self.arm.swap(false, Ordering::AcqRel) || told {
            return Ok(());
        }
        // An order that was not taken is still to be given.
        source.order(Order::Arm).inspect_err(|_| self.arm.store(true, Ordering::Release))
    }

    /// Hands the device the orders that came since the last call.
    ///
    /// # Errors
    /// When it does not take one.
    pub(super) fn pass_on_orders(&mut self, source: &mut Source) -> Result<(), DriverError> {
        let mut orders = self.orders.take();
        orders.try_for_each(|order| source.order(order))?;
        self.actions.orders(&mut |order| source.order(order))
    }

    /// Hands the device the newest action that came since the last call, if any did.
    ///
    /// # Errors
    /// When it does not take it.
    pub(super) fn pass_on_action(&mut self, source: &mut Source) -> Result<(), DriverError> {
        match self.actions.newest(&mut self.action) {
            Some((target, tick)) => source.command(target, tick),
            None => Ok(()),
        }
    }
}
