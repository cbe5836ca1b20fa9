//! `protocol = "raw"`: the frames of a bus, unchanged.
//!
//! A sample is a batch of the pending frames, in order, [`CAN_BATCH`] at most. A frame is a record of
//! [`CAN_RECORD`] bytes, little endian:
//!
//! | offset | type | what |
//! |---|---|---|
//! | 0 | u64 | its arrival, ns of `CLOCK_MONOTONIC`; from the kernel where it gives the time |
//! | 8 | u32 | identifier, with the flags of linux/can.h: bit 31 has 29 bits, bit 30 remote, bit 29 error |
//! | 12 | u8 | bytes of data, 0 to 8 |
//! | 13 | 3 | zero |
//! | 16 | 8 | data, zero beyond its length |
//!
//! Of an error frame (bit 29) the identifier and the data describe what happened, as in linux/can/error.h. The
//! sample is stamped with its first frame.
//!
//! On a busy bus frames are collected for `PACE`, to limit the cost per sample; a frame of a quiet bus is delivered
//! at once. Nothing is sent.
//!
//! Invariant: nothing is allocated between two samples.

use std::os::fd::OwnedFd;
use std::time::Duration;

use rapid_core::provenance::{Format, Negotiated};
use rapid_core::sample::{Encoding, FLAG_DEVICE_TIME};
use rapid_core::time::Stamp;
use rapid_registry::device::DeviceNode;
use rapid_registry::{CAN_BATCH, CAN_RECORD, CanSpec};

use super::link::{AsyncLink, Link};
use super::outcome::{LinkError, Received, is_bus_off};
use super::socket::can_id;
use crate::driver::{Agreed, DriverError, Reading, unblock};

/// Time between batches: at 8,000 frames a second a batch has 16.
const PACE: Duration = Duration::from_millis(2);

/// An open bus.
#[derive(Debug)]
pub struct Raw {
    link: AsyncLink,
    waiting: Box<[Received; CAN_BATCH]>,
    payload: Vec<u8>,
    /// When the last batch was taken.
    taken: Stamp,
    /// Why there is no next batch.
    ended: Option<DriverError>,
    pub(in crate::driver) agreed: Agreed,
}

impl Raw {
    /// Opens the adapter of `spec` at its node.
    ///
    /// # Errors
    /// When the adapter is gone or cannot be opened; see [`Link::open`].
    pub async fn open(spec: &CanSpec, node: &DeviceNode) -> Result<Self, DriverError> {
        let format = Format::Messages { baud: Some(spec.bitrate), channels: 0, hz: None };
        let (spec, node) = (spec.clone(), node.clone());
        let link = unblock(move || Link::open(&spec, &node).map_err(LinkError::into_driver)).await?;
        Self::on(link, format)
    }

    /// Reads datagrams of 16 bytes as a bus's frames: for measurements on a kernel that has no CAN.
    ///
    /// # Errors
    /// When the socket cannot be set up.
    #[doc(hidden)]
    pub fn stand_in(socket: OwnedFd) -> Result<Self, DriverError> {
        let link = Link::stand_in(socket).map_err(LinkError::into_driver)?;
        Self::on(link, Format::Messages { baud: None, channels: 0, hz: None })
    }

    fn on(link: Link, format: Format) -> Result<Self, DriverError> {
        let description = format!("{}, frames as they come", link.description());
        Ok(Self {
            link: AsyncLink::new(link).map_err(LinkError::into_driver)?,
            waiting: Box::new([Received::default(); CAN_BATCH]),
            payload: Vec::with_capacity(CAN_BATCH * CAN_RECORD),
            taken: Stamp::default(),
            ended: None,
            agreed: Agreed { description, negotiated: Negotiated { format: Some(format), ..Negotiated::default() } },
        })
    }

    /// The next batch.
    ///
    /// # Errors
    /// [`DriverError::Gone`] when the adapter is; [`DriverError::Retry`] when the bus was left permanently.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        if let Some(error) = self.ended.take() {
            return Err(error);
        }
        let rest = self.taken.after(PACE).since(Stamp::now());
        if !rest.is_zero() {
            tokio::time::sleep(rest).await;
        }
        // Nothing awaits from here on: a dropped future has taken no frame.
        let count = self.link.recv(&mut self.waiting[..]).await.map_err(LinkError::into_driver)?;
        self.taken = Stamp::now();
        let frames = self.waiting.get(..count).unwrap_or_default();
        let link = self.link.get_mut();
        if !link.restarts() && frames.iter().any(|received| is_bus_off(&received.frame)) {
            self.ended = Some(LinkError::BusOff.into_driver());
        }
        let lost = link.take_lost();
        let first = frames.first().map(|received| received.arrival).unwrap_or_default();
        self.payload.clear();
        for received in frames {
            write(received, &mut self.payload);
        }
        Ok(Reading {
            bytes: &self.payload,
            encoding: Encoding::Bytes,
            captured: first.at,
            flags: if first.from_kernel { FLAG_DEVICE_TIME } else { 0 },
            width: 0,
            height: 0,
            lost,
        })
    }
}

/// Appends a frame as [`CAN_RECORD`] bytes.
pub(in crate::driver) fn write(received: &Received, payload: &mut Vec<u8>) {
    let Received { frame, arrival } = received;
    payload.extend_from_slice(&arrival.at.0.to_le_bytes());
    payload.extend_from_slice(&can_id(frame).to_le_bytes());
    payload.extend_from_slice(&[frame.len.min(8), 0, 0, 0]);
    payload.extend_from_slice(&frame.data);
}

#[cfg(test)]
mod tests;
