//! The limits of the verdict. The reason for every default is given here; `[verdict]` changes it for all devices,
//! `[device.NAME.verdict]` for one.

use std::time::Duration;

use rapid_core::modality::ModalityKind;

/// How many defects an episode may have before it gets a grade: the limits of one grade. A figure beyond its limit
/// leads to the grade; `None` is a check that is off.
///
/// Shares are of the expected samples, `0.0..=1.0`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Samples the device lost before `rapid` received them.
    pub lost: Option<f64>,
    /// Samples lost between the driver and the file.
    pub dropped: Option<f64>,
    /// Samples that the driver reported as damaged, pictures that are not whole or of another size or kind than the
    /// camera's, and samples with a number that is not finite.
    pub damaged: Option<f64>,
    /// Samples with a non-increasing sequence number or capture time.
    pub duplicate: Option<f64>,
    /// Samples that are byte-identical to the one before.
    pub repeated: Option<f64>,
    /// Longest time in which every sample is byte-identical to the one before.
    pub frozen: Option<Duration>,
    /// Samples that came too late for their frame.
    pub late: Option<f64>,
    /// Longest time without a sample while the device was attached.
    pub gap: Option<Duration>,
    /// Longest time in which the device was plugged in and did not run.
    pub opening: Option<Duration>,
    /// Change of the stamps against this machine's clock over the episode, and how far they are in
    /// the future.
    pub clock: Option<Duration>,
    /// How far the capture times may be wrong, of a device of another computer.
    pub uncertain: Option<Duration>,
    /// Time of the episode that a device which records by itself did not record.
    pub clip: Option<Duration>,
    /// Least rate while the device was attached, as a share of the nominal one.
    pub rate: Option<f64>,
    /// Least share of the ticks while the device was attached that have a sample of it in `sync_window`.
    pub valid: Option<f64>,
    /// Least share of the episode in which it was present.
    pub present: Option<f64>,
}

/// Limits for the verdict on a modality.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerdictSpec {
    /// Beyond these the episode is SUSPECT.
    pub suspect: Limits,
    /// Beyond these it is BAD.
    pub bad: Limits,
    /// Nominal samples per second of the device, if known: a camera's `fps`, or `hz`.
    pub hz: Option<f64>,
}

impl VerdictSpec {
    /// The default limits of a modality.
    ///
    /// * lost 1 %, 5 %: one missing picture in a hundred is replaced by a neighbour; other recorders call a
    ///   rig overloaded from some 2 to 5 % on.
    /// * dropped 0, 5 %: this machine could not keep up, which it always should.
    /// * damaged 1 %, 5 %: equivalent to lost. A camera's first picture after a plug often is.
    /// * duplicate 0.1 %, 5 %: a stamp that does not increase puts a sample into the wrong frame.
    /// * repeated 10 %, 60 %: a camera that sends every second picture twice (50 %) runs at half its
    ///   rate; with more than that it has stopped.
    /// * frozen 500 ms, 2 s: a live sensor has noise, and no two pictures of it are equal. Only for
    ///   images: numbers and bytes may well be constant.
    /// * late 1 %, 20 %: they are missing from their frame, although the file has them.
    /// * gap `stall_after`, ten times that: from this length on the monitor shows stalled.
    /// * opening 5 s, off: two of them are the cooldown of a replugged device, and a slow camera takes
    ///   another two. Longer is a node that does not start. How bad that is depends on the task.
    /// * clock 10 ms, 100 ms: less than half the usual window of 25 ms cannot move many samples into
    ///   another frame.
    /// * valid 90 %, 50 %: a policy is trained on the content of the frames, and a tick without a valid sample has
    ///   an old one or none. A device slower than twice `sync_window` misses ticks by its phase alone.
    /// * rate 90 %, 50 %: in poor light cameras expose longer and halve their rate.
    /// * present off: sensors come and go, and the mask says when. See [`Self::of_an_expected_sensor`].
    pub fn defaults(kind: ModalityKind, stall_after: Duration, hz: Option<f64>) -> Self {
        let image = matches!(kind, ModalityKind::Image | ModalityKind::Depth);
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
            uncertain: None,
            clip: None,
            rate: Some(0.9),
            valid: Some(0.9),
            present: None,
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
            uncertain: None,
            clip: None,
            rate: Some(0.5),
            valid: Some(0.5),
            present: None,
        };
        Self { suspect, bad, hz }
    }

    /// Also judges how long it was present, because every episode must have it: beyond 90 % SUSPECT, beyond 50 % BAD.
    #[must_use]
    pub fn of_an_expected_sensor(mut self) -> Self {
        (self.suspect.present, self.bad.present) = (Some(0.9), Some(0.5));
        self
    }

    /// Also judges its own recording: a camera begins within two seconds.
    #[must_use]
    pub fn of_a_recorder(mut self) -> Self {
        self.suspect.clip = Some(Duration::from_secs(2));
        self
    }

    /// Also judges how well the clock of another computer, or of a phone, is known: beyond half of `sync_window` a sample
    /// may belong to another frame.
    #[must_use]
    pub fn of_another_clock(mut self, sync_window: Duration) -> Self {
        self.suspect.uncertain = Some(sync_window / 2);
        self
    }

    /// Whether any check here compares payloads for equality.
    pub fn compares(&self) -> bool {
        [self.suspect, self.bad].iter().any(|limits| limits.frozen.is_some() || limits.repeated.is_some())
    }
}
