//! An adapter with motors: however it is dropped, the motors are ordered to turn off.

use std::io;
use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::motors::MotorBus;
use rapid_registry::DamiaoSpec;

use crate::driver::can::brakes::Brakes;
use crate::driver::can::claim::Claim;
use crate::driver::can::guard::Guard;
use crate::driver::can::link::Link;
use crate::driver::can::outcome::LinkError;

/// The least number of times that motors are ordered to turn off, [`AGAIN`] apart: a frame may be lost.
const TURN_OFF: usize = 3;
/// ...and for this long at most, while one that was on has not confirmed that it is off.
const OFF_WITHIN: Duration = Duration::from_millis(100);
/// See [`TURN_OFF`].
const AGAIN: Duration = Duration::from_millis(5);

/// An adapter with motors that may be powered.
#[derive(Debug)]
pub(super) struct Powered {
    pub(super) link: Link,
    pub(super) bus: MotorBus,
    pub(super) brakes: Option<Brakes>,
    pub(super) guard: Option<Guard>,
    /// Until the last frame was sent.
    _claim: Option<Claim>,
}

impl Powered {
    /// Brakes are engaged, and stay so until their motors are on.
    ///
    /// # Errors
    /// When the system gives no thread for them.
    pub(super) fn new(link: Link, spec: &DamiaoSpec, guard: Option<Guard>, claim: Option<Claim>) -> io::Result<Self> {
        let brakes = Brakes::start(spec, guard.as_ref())?;
        Ok(Self { link, bus: MotorBus::new(spec, Stamp::now()), brakes, guard, _claim: claim })
    }

    /// The adapter, for people.
    pub(super) fn description(&self) -> &str {
        self.link.description()
    }
}

impl Drop for Powered {
    fn drop(&mut self) {
        // After a panic the bus may be inconsistent: it still gives its last frames and is fed no more.
        let panics = std::thread::panicking();
        let end = Stamp::now().after(OFF_WITHIN);
        let mut frame = CanFrame::default();
        if let Some(brakes) = &self.brakes {
            brakes.release(0);
        }
        let (mut rounds, mut gone, mut all_off) = (0, false, panics);
        while rounds < TURN_OFF || !(all_off || gone || Stamp::now() >= end) {
            rounds += 1;
            for off in self.bus.stop_frames() {
                // Without the bus there are no motors to stop.
                let _ = self.link.send(&off);
            }
            // Waiting also sends frames for which the adapter had no room.
            let until = Stamp::now().after(AGAIN);
            loop {
                match self.link.recv_until(until, &mut frame) {
                    Ok(Some(arrival)) if !panics => self.bus.feed(&frame, arrival.at),
                    Ok(Some(_)) | Err(LinkError::BusOff | LinkError::Full) => {}
                    Ok(None) => break,
                    Err(_) => {
                        gone = true;
                        break;
                    }
                }
                if Stamp::now() >= until {
                    break;
                }
            }
            all_off = panics || self.bus.still_on().next().is_none();
        }
        // The guard holds brakes until they are engaged.
        drop(self.brakes.take());
        if let Some(guard) = self.guard.take() {
            guard.dismiss();
        }
        if !all_off {
            let motors = self.bus.still_on().collect::<Vec<_>>().join(", ");
            tracing::warn!(
                motors,
                "motors were ordered to turn off and did not confirm it; without commands they stop by their own \
                 time limit"
            );
        }
    }
}
