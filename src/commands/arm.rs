//! `rapid arm` and `rapid disarm`: enable or disable the actuator of a running `rapid`.

use std::io::{self, Write};

use rapid_core::action::Order;

use crate::orders::give::{GiveError, give};

/// Why an order was not carried out.
#[derive(Debug, thiserror::Error)]
pub enum OrderError {
    /// The run does not answer, or refuses.
    #[error(transparent)]
    Give(#[from] GiveError),
    /// The output.
    #[error(transparent)]
    Output(#[from] io::Error),
}

/// Gives an order; its result is in the log of the run.
///
/// # Errors
/// When no run accepts orders, or it is refused.
pub fn order(instance: Option<&str>, order: Order, out: &mut dyn Write) -> Result<(), OrderError> {
    give(instance, order)?;
    let what = match order {
        Order::Arm | Order::ArmBack => "the actuator is being armed: the result is in the log of the run",
        Order::Disarm | Order::Emergency(_) => "the actuator is disarmed until it is armed again",
    };
    Ok(writeln!(out, "{what}")?)
}
