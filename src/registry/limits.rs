//! Limits of the verdict: how much of what can go wrong an episode may have before it is SUSPECT,
//! and how much before it is BAD.
//!
//! Every default has its reason here; `[verdict]` changes it for all devices, `[device.NAME.verdict]`
//! for one.

use std::time::Duration;

use crate::modality::ModalityKind;

/// Limits of one grade. A figure beyond its limit earns the grade; `None` is a check that is off.
///
/// Shares are of the samples that should be there, `0.0..=1.0`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Samples the device lost before `rapid` had them.
    pub lost: Option<f64>,
    /// Samples lost between the driver and the file.
    pub dropped: Option<f64>,
    /// Samples that the driver called damaged, and JPEG pictures without their beginning or end.
    pub damaged: Option<f64>,
    /// Samples whose number or capture time does not go on.
    pub duplicate: Option<f64>,
    /// Samples that are byte for byte the one before.
    pub repeated: Option<f64>,
    /// Longest time in which every sample is byte for byte the one before.
    pub frozen: Option<Duration>,
    /// Samples that came too late for their frame.
    pub late: Option<f64>,
    /// Longest time without a sample while the device was there.
    pub gap: Option<Duration>,
    /// Longest time in which the device was plugged in and did not run.
    pub opening: Option<Duration>,
    /// Change of the stamps against this machine's clock over the episode, and how far they lie in
    /// the future.
    pub clock: Option<Duration>,
    /// Least rate while the device was there, as a share of the nominal one.
    pub rate: Option<f64>,
    /// Least share of the ticks at which the device was there that have a sample of it in `sync_window`.
    pub valid: Option<f64>,
}

/// What the verdict on a modality is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerdictSpec {
    /// Beyond these the episode is SUSPECT.
    pub suspect: Limits,
    /// Beyond these it is BAD.
    pub bad: Limits,
    /// Samples a second the device should send, if anything says so: a camera's `fps`, or `hz`.
    pub hz: Option<f64>,
}

impl VerdictSpec {
    /// The limits of a modality of which the registry says nothing else.
    ///
    /// * lost 1 %, 5 %: one picture in a hundred is a hole that a neighbour fills; from some 2 to 5 %
    ///   on other recorders call a rig overloaded.
    /// * dropped 0, 5 %: this machine could not keep up, which it always should.
    /// * damaged 1 %, 5 %: as good as lost. A camera's first picture after it was plugged in often is.
    /// * duplicate 0.1 %, 5 %: a stamp that does not go on puts a sample into the wrong frame.
    /// * repeated 10 %, 60 %: a camera that sends every second picture twice (50 %) runs at half its
    ///   rate; more than that stands still.
    /// * frozen 500 ms, 2 s: a live sensor has noise, and no two pictures of it are equal. Only of
    ///   images: numbers and bytes may well be constant.
    /// * late 1 %, 20 %: the frame went without them, although the file has them.
    /// * gap `stall_after`, ten times that: longer is what the monitor calls stalled.
    /// * opening 5 s, off: two of them a replugged device is made to wait, and a slow camera takes
    ///   another two. Longer is a node that does not start. How bad that is depends on the task.
    /// * clock 10 ms, 100 ms: less than half the usual window of 25 ms cannot move many samples into
    ///   another frame.
    /// * valid 90 %, 50 %: a policy learns from what the frames hold, and of a tick without a valid sample that is
    ///   an old one or nothing. A device slower than twice `sync_window` misses ticks by its phase alone.
    /// * rate 90 %, 50 %: in poor light cameras expose longer and halve their rate.
    #[must_use]
    pub fn of(kind: ModalityKind, stall_after: Duration, hz: Option<f64>) -> Self {
        let image = kind == ModalityKind::Image;
        let suspect = Limits {
            lost: Some(0.01),
            dropped: Some(0.0),
            damaged: Some(0.01),
            duplicate: Some(0.001),
            repeated: image.then_some(0.1),
            frozen: image.then_some(Duration::from_millis(500)),
            late: Some(0.01),
            gap: Some(stall_after),
            opening: Some(Duration::from_secs(5)),
            clock: Some(Duration::from_millis(10)),
            rate: Some(0.9),
            valid: Some(0.9),
        };
        let bad = Limits {
            lost: Some(0.05),
            dropped: Some(0.05),
            damaged: Some(0.05),
            duplicate: Some(0.05),
            repeated: image.then_some(0.6),
            frozen: image.then_some(Duration::from_secs(2)),
            late: Some(0.2),
            gap: Some(stall_after.saturating_mul(10)),
            opening: None,
            clock: Some(Duration::from_millis(100)),
            rate: Some(0.5),
            valid: Some(0.5),
        };
        Self { suspect, bad, hz }
    }

    /// Does anything here want to know whether two payloads are equal?
    #[must_use]
    pub fn compares(&self) -> bool {
        [self.suspect, self.bad].iter().any(|limits| limits.frozen.is_some() || limits.repeated.is_some())
    }
}
