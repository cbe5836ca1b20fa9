//! `rapid arm` and `rapid disarm`: leave for the actuator of a running `rapid` to move.

use std::io::{self, Write};

use crate::action::Order;
use crate::bus::{BusError, give_order};

/// Why an order did not arrive.
#[derive(Debug, thiserror::Error)]
pub enum OrderError {
    /// The bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// Nobody listens.
    #[error("no rapid here has an actuator that is plugged in: start it, plug it in, or name it with --instance")]
    Nobody,
    /// The output.
    #[error(transparent)]
    Output(#[from] io::Error),
}

/// Gives an order. What becomes of it, the run says.
///
/// # Errors
/// When no run with an actuator is there to take it.
pub fn order(instance: Option<&str>, order: Order, out: &mut dyn Write) -> Result<(), OrderError> {
    if !give_order(instance, order)? {
        return Err(OrderError::Nobody);
    }
    let what = match order {
        Order::Arm => "told to arm its actuator",
        Order::Disarm => "told to disarm its actuator",
    };
    Ok(writeln!(out, "rapid was {what}; it says itself what came of it")?)
}
