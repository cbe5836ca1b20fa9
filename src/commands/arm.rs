//! `rapid arm` and `rapid disarm`: leave for the actuator of a running `rapid` to move.

use std::io::{self, Write};

use crate::action::Order;
use crate::orders::give::{GiveError, give};

/// Why an order was not carried out.
#[derive(Debug, thiserror::Error)]
pub enum OrderError {
    /// The run.
    #[error(transparent)]
    Give(#[from] GiveError),
    /// The output.
    #[error(transparent)]
    Output(#[from] io::Error),
}

/// Gives an order. What becomes of it, the run says.
///
/// # Errors
/// When no run is there to take it, or it is refused.
pub fn order(instance: Option<&str>, order: Order, out: &mut dyn Write) -> Result<(), OrderError> {
    give(instance, order)?;
    let what = match order {
        Order::Arm | Order::ArmBack => "the actuator is being armed: what came of it is in the log of the run",
        Order::Disarm | Order::Emergency(_) => "the actuator is disarmed, and stays so until it is armed again",
    };
    Ok(writeln!(out, "{what}")?)
}
