//! Protocol devices: they receive data from the host and send, on request and by themselves.
//!
//! Invariant: no clock, no socket, no thread; times come in as ns of CLOCK_MONOTONIC.

use super::descriptor::{Answer, DeviceClass, Setup};
use super::order::Order;
use super::reported::Reported;

/// A protocol device. It exists whether it is plugged in or not; `reset` is called at a plug or unplug.
pub trait Talker: std::fmt::Debug + Send {
    /// Class codes of the device.
    fn class(&self) -> DeviceClass;

    /// The configuration descriptor.
    fn configuration(&self) -> Vec<u8>;

    /// The text of its own string descriptor, from index 4 on.
    fn string(&self, index: u8) -> Option<&str>;

    /// Answers a class or vendor request; `data` is its data stage towards the device.
    fn control(&mut self, setup: Setup, data: &[u8], now_ns: u64) -> Answer;

    /// Receives a bulk transfer from the host.
    fn receive(&mut self, data: &[u8], now_ns: u64);

    /// Advances time; returns when it must be called again at the latest.
    fn tend(&mut self, now_ns: u64) -> Option<u64>;

    /// Appends the next transfer (at most `room` bytes) for an endpoint to `out`; false if there is none.
    fn take(&mut self, endpoint: u8, room: usize, now_ns: u64, out: &mut Vec<u8>) -> bool;

    /// Discards data waiting to be taken.
    fn discard(&mut self);

    /// The cable was plugged or unplugged: the host's side restarts, the devices behind it continue.
    fn reset(&mut self);

    /// Applies an order to it, or to a motor behind it; false if it does not support it.
    fn apply(&mut self, motor: Option<u16>, order: Order, now_ns: u64) -> bool;

    /// Appends its events since the last call.
    fn reported(&mut self, reported: &mut Vec<Reported>);
}
