//! Devices that are spoken with: they take what the host sends and answer, when asked and of their own.
//!
//! Invariant: no clock, no socket, no thread; times come in as ns of CLOCK_MONOTONIC.

use super::descriptor::{Answer, DeviceClass, Setup};
use super::order::Order;
use super::reported::Reported;

/// A device that is spoken with. It exists whether it is plugged or not; `reset` is the plug's going in or out.
pub trait Talker: std::fmt::Debug + Send {
    /// Class codes of the device.
    fn class(&self) -> DeviceClass;

    /// The configuration descriptor.
    fn configuration(&self) -> Vec<u8>;

    /// The text of a string descriptor of its own, from 4 on.
    fn string(&self, index: u8) -> Option<&str>;

    /// Answers a class or vendor request; `data` is its data stage towards the device.
    fn control(&mut self, setup: Setup, data: &[u8], now_ns: u64) -> Answer;

    /// Takes a bulk transfer of the host's.
    fn hear(&mut self, data: &[u8], now_ns: u64);

    /// Lets time pass; when it wants to be called again at the latest.
    fn tend(&mut self, now_ns: u64) -> Option<u64>;

    /// Appends the next transfer (at most `room` bytes) for an endpoint to `out`; false: there is none.
    fn take(&mut self, endpoint: u8, room: usize, now_ns: u64, out: &mut Vec<u8>) -> bool;

    /// Throws away what waits to be taken.
    fn discard(&mut self);

    /// The cable went in or out: the host's side begins again, what lies behind continues.
    fn reset(&mut self);

    /// Something happens to it, or to a motor behind it; false: not to such a device.
    fn befall(&mut self, motor: Option<u16>, order: Order, now_ns: u64) -> bool;

    /// Appends its events since the last call.
    fn reported(&mut self, reported: &mut Vec<Reported>);
}
