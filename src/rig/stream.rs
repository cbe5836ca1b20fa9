//! A stream: reads one device, from the opening of its node to its end.
//!
//! Invariant: between two samples a stream itself allocates nothing, locks nothing and logs nothing; `bus` documents
//! the cost of publishing.
//! Invariant: a stream that was asked to stop publishes nothing more.

mod controls;
mod source;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rapid_bus::Writer;
use rapid_core::action::ActuatorNotice;
use rapid_core::clip::ClipNotice;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Epoch, SampleHeader, damage};
use rapid_core::time::{Stamp, nanoseconds};
use rapid_devices::driver::{ClockOffset, Driver, DriverError, Reading};
use rapid_devices::inputs::tap::{Tap, lost_at_the_end};
use rapid_registry::device::Attachment;
use rapid_registry::{DeviceSpec, NodeSpec};
use rapid_status::{Board, EpisodeWatch, Provenance};
use rapid_system::fault;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until, timeout};
use tokio_util::sync::CancellationToken;

use super::core::StreamEvent;
use super::lifecycle::End;
use super::worker::ProcessSlot;

/// A device that does not open within this time is retried.
const OPEN_LIMIT: Duration = Duration::from_secs(10);

/// A device that is open and has sent nothing for this long is reported silent, once per epoch. It stays Opening: an
/// event-driven device may send at any time.
const SILENT_AFTER: Duration = Duration::from_secs(2);
/// Cameras and programs always send: one that has sent nothing for this long after opening is reopened. Six of these
/// and the delays between them fit into the minute in which five restarts are allowed.
const START_LIMIT: Duration = Duration::from_secs(5);
/// How often the clock of a phone or of another computer is reported: in each episode that is long enough to be used.
const CLOCK_EVERY: Duration = Duration::from_millis(500);
/// How long the orderly closing of a device may take.
const CLOSE_LIMIT: Duration = Duration::from_secs(4);

use controls::Controlled;
pub(super) use controls::Controls;
use source::SampleSource;

/// Reports of a running stream to the rig.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Report {
    /// The node is opened once its link is up.
    LinkDown,
    /// The node is open, with the settings agreed with the device, for people and for the recording.
    Opened(String, Box<Provenance>),
    /// Open for this long without a sample.
    Silent(Duration),
    /// An event for the core alone.
    Event(StreamEvent),
    /// Samples or actions are lost, or an order is refused, and why; reported once per epoch each.
    Refused(String),
    Actuator(ActuatorNotice),
    /// The clock of the phone, or of the computer that the device is on, with the worst uncertainty since the last report.
    Clock(ClockOffset),
    /// What the device does that records by itself.
    Clip(ClipNotice),
}

/// A report with its sender.
#[derive(Debug)]
pub(super) struct Reported {
    pub(super) id: ModalityId,
    pub(super) epoch: Epoch,
    pub(super) report: Report,
}

#[derive(Debug)]
pub(super) struct Ended {
    pub(super) end: End,
    /// Why, for people.
    pub(super) reason: String,
}

/// Progress of a modality, over all its epochs.
#[derive(Debug, Default)]
pub(super) struct Numbers {
    /// Sequence number of the next sample.
    next: AtomicU64,
    /// Samples that its devices lost.
    lost: AtomicU64,
}

impl Numbers {
    /// `seq` and `lost` of a sample before which the device lost `lost` others. They leave a gap in `seq`, so that
    /// every consumer can see it.
    fn assign(&self, lost: u64) -> (u64, u64) {
        // Only one stream at a time counts here: an older one publishes nothing more.
        let seq = self.next.fetch_add(lost + 1, Ordering::Relaxed) + lost;
        (seq, self.lost.fetch_add(lost, Ordering::Relaxed) + lost)
    }
}

/// Everything a stream needs.
#[derive(Debug)]
pub(super) struct Stream {
    pub(super) spec: Arc<DeviceSpec>,
    pub(super) attachment: Attachment,
    pub(super) attached: Stamp,
    pub(super) epoch: Epoch,
    pub(super) writer: Arc<Writer>,
    pub(super) numbers: Arc<Numbers>,
    pub(super) board: Arc<Board>,
    pub(super) reports: mpsc::Sender<Reported>,
    pub(super) stop: CancellationToken,
    /// Runs the program of the entry, if it has one.
    pub(super) seat: Option<ProcessSlot>,
    /// Orders and actions, if it is the actuator.
    pub(super) controls: Option<Controls>,
    /// Emergency stops and enabling switches that are numbers in its samples.
    pub(super) taps: Arc<[Tap]>,
    /// The episode in progress, for devices that record by themselves.
    pub(super) episode: EpisodeWatch,
}

impl Stream {
    /// Reads the device until it ends or the stream is asked to stop.
    pub(super) async fn run(self) -> Ended {
        // However the stream ends, even by panic, its last values no longer count.
        let _lost = lost_at_the_end(&self.taps);
        let stopped = || Ended { end: End::Gone, reason: "stopped".to_owned() };
        let open = async {
            if let Some(is_up) = Driver::unlinked(&self.spec, &self.attachment.node) {
                self.report(Report::LinkDown).await;
                is_up.await;
            }
            timeout(OPEN_LIMIT, SampleSource::open(&self)).await
        };
        let opened = tokio::select! {
            biased;
            () = self.stop.cancelled() => return stopped(),
            opened = open => opened,
        };
        let mut source = match opened {
            Ok(Ok(source)) => source,
            Ok(Err(error)) => return error.into(),
            Err(_) => return Ended::retry(format!("did not open within {} s", OPEN_LIMIT.as_secs())),
        };
        let mut notices = source.notices();
        let mut clips = source.clips();
        tokio::select! {
            biased;
            () = self.stop.cancelled() => {}
            ended = self.read(&mut source, &mut notices, &mut clips) => {
                // The notices that it sent before it ended.
                self.pass_on_notices(&mut notices).await;
                return ended;
            }
        }
        source.close().await;
        stopped()
    }

    async fn read(
        &self,
        source: &mut SampleSource,
        notices: &mut Notices<ActuatorNotice>,
        clips: &mut Notices<ClipNotice>,
    ) -> Ended {
        self.report(Report::Opened(source.description(), Box::new(self.provenance(source)))).await;
        let patience = source.patience(self.spec.stall_after);
        let mut progress = StreamProgress::default();
        let stall = sleep_until(Instant::now() + self.spec.stall_after);
        tokio::pin!(stall);
        let silent = self.silence();
        tokio::pin!(silent);
        let mut controls = match self.controls.as_ref().map(|controls| controls.begin(source)).transpose() {
            Ok(controls) => controls.flatten(),
            Err(error) => return error.into(),
        };
        // An order that is carried out at once is reported before the first sample.
        self.pass_on_notices(notices).await;
        let mut episode = self.episode.clone();
        if episode.borrow_and_update().is_some() {
            episode.mark_changed();
        }
        let news = changed(episode.clone());
        tokio::pin!(news);
        // The timer is checked when it fires, not reset at every sample.
        let mut newest = Instant::now();
        loop {
            tokio::select! {
                biased;
                reading = source.read() => {
                    let reading = match reading {
                        Ok(reading) => reading,
                        Err(error) => return error.into(),
                    };
                    newest = Instant::now();
                    self.pass_on_sample(&reading, &mut progress).await;
                    if let Some(clock) = source.clock() && let Some(worst) = progress.clock(clock, newest) {
                        self.report(Report::Clock(worst)).await;
                    }
                    // A device that always has something to read never reaches `news`.
                    self.pass_on_episode(source, &mut episode).await;
                }
                () = changed_controls(controls.as_mut()) => {
                    if let Some(controls) = &mut controls {
                        self.pass_on_orders(source, controls, &mut progress).await;
                    }
                }
                notice = next_notice(notices) => self.report(Report::Actuator(notice)).await,
                clip = next_notice(clips) => self.report(Report::Clip(clip)).await,
                () = &mut news => {
                    self.pass_on_episode(source, &mut episode).await;
                    news.set(changed(episode.clone()));
                }
                reason = &mut silent, if progress.pulse == Pulse::Silent => return Ended::retry(reason),
                () = &mut stall => {
                    let due = newest + self.spec.stall_after;
                    if due > Instant::now() {
                        stall.as_mut().reset(due);
                        continue;
                    }
                    // Starting takes longer than continuing: an interpreter has to load its libraries.
                    let least = if progress.pulse == Pulse::Silent { START_LIMIT } else { Duration::ZERO };
                    if patience.is_some_and(|patience| newest.elapsed() >= patience.max(least)) {
                        return Ended::retry(format!("nothing came for {:?}", newest.elapsed()));
                    }
                    if progress.pulse == Pulse::Beating {
                        progress.pulse = Pulse::Stalled;
                        self.report(Report::Event(StreamEvent::Stalled)).await;
                    }
                    stall.as_mut().reset(Instant::now() + self.spec.stall_after);
                }
            }
        }
    }

    /// Publishes a sample, and reports the first one of a stream and the first one after a stall.
    async fn pass_on_sample(&self, reading: &Reading<'_>, progress: &mut StreamProgress) {
        if let Err(reason) = self.publish(reading)
            && !std::mem::replace(&mut progress.has_lost, true)
        {
            self.report(Report::Refused(format!("samples are lost: {reason}"))).await;
        }
        let event = match progress.pulse {
            Pulse::Beating => return,
            Pulse::Silent => StreamEvent::Started,
            Pulse::Stalled => StreamEvent::Resumed,
        };
        progress.pulse = Pulse::Beating;
        self.report(Report::Event(event)).await;
    }

    /// Passes the actuator the orders and the newest action since the last call.
    async fn pass_on_orders(
        &self,
        source: &mut SampleSource,
        controls: &mut Controlled,
        progress: &mut StreamProgress,
    ) {
        if let Err(error) = controls.pass_on_orders(source) {
            self.report(Report::Refused(format!("an order is not carried out: {error}"))).await;
        }
        if let Err(error) = controls.pass_on_action(source)
            && !std::mem::replace(&mut progress.has_refused, true)
        {
            self.report(Report::Refused(format!("it does not move: {error}"))).await;
        }
    }

    /// Notifies the device if the episode in progress has changed.
    async fn pass_on_episode(&self, source: &mut SampleSource, episode: &mut EpisodeWatch) {
        if !episode.has_changed().unwrap_or(false) {
            return;
        }
        let now = episode.borrow_and_update().clone();
        if let Err(error) = source.record(now.as_ref()) {
            let verb = if now.is_some() { "start" } else { "stop" };
            self.report(Report::Refused(format!("it does not {verb} recording: {error}"))).await;
        }
    }

    /// Reports the actuator's pending notices.
    async fn pass_on_notices(&self, notices: &mut Notices<ActuatorNotice>) {
        while let Some(Ok(notice)) = notices.as_mut().map(mpsc::Receiver::try_recv) {
            self.report(Report::Actuator(notice)).await;
        }
    }

    /// Reports that the device sends nothing; returns, with the reason, when it must be reopened.
    async fn silence(&self) -> String {
        let opened = Instant::now();
        let print = SILENT_AFTER.max(self.spec.stall_after);
        let Some(at) = opened.checked_add(print) else { return std::future::pending().await };
        sleep_until(at).await;
        self.report(Report::Silent(print)).await;
        if !matches!(self.spec.node, NodeSpec::Camera(_)) || self.attachment.node.is_recording() {
            return std::future::pending().await;
        }
        let limit = START_LIMIT.max(2 * print);
        sleep_until(opened + limit).await;
        format!("open, but sent nothing for {} s", limit.as_secs())
    }

    fn provenance(&self, source: &SampleSource) -> Provenance {
        let mut negotiated = source.negotiated();
        negotiated.driver = negotiated.driver.or_else(|| self.attachment.driver.as_deref().cloned());
        Provenance {
            epoch: self.epoch,
            node: self.attachment.node.label(),
            attached: self.attached,
            unit: self.attachment.unit.clone(),
            negotiated,
            latency_ns: nanoseconds(self.spec.latency),
        }
    }

    /// One copy, from the driver's buffer into shared memory.
    fn publish(&self, reading: &Reading<'_>) -> Result<(), String> {
        fault::point("stream");
        // First of all, so that an emergency stop takes effect whatever happens to the sample.
        for tap in &*self.taps {
            tap.feed(reading.encoding, reading.bytes);
        }
        let (seq, lost) = self.numbers.assign(reading.lost);
        let header = SampleHeader {
            seq,
            lost,
            capture_ns: reading.captured.0,
            recv_ns: Stamp::now().0,
            id: u32::from(self.spec.id.bit()),
            epoch: self.epoch.0,
            encoding: reading.encoding as u32,
            flags: reading.flags | damage(reading.encoding, reading.bytes),
            width: reading.width,
            height: reading.height,
        };
        let counters = self.board.counters(self.spec.id);
        match self.writer.publish(header, reading.bytes) {
            Ok(()) => {
                counters.count(reading.bytes.len(), reading.captured, reading.lost);
                Ok(())
            }
            Err(error) => {
                counters.lose(reading.lost + 1);
                Err(error.to_string())
            }
        }
    }

    /// The rig reads its reports at once; the channel is full only if the rig has ended.
    async fn report(&self, report: Report) {
        let _ = self.reports.send(Reported { id: self.spec.id, epoch: self.epoch, report }).await;
    }
}

/// What a stream has reported so far.
#[derive(Debug, Default)]
struct StreamProgress {
    pulse: Pulse,
    /// A sample could not be published.
    has_lost: bool,
    /// An action was refused.
    has_refused: bool,
    /// When the clock of the device was last reported, and the worst uncertainty since.
    clock: Option<(Instant, u64)>,
}

impl StreamProgress {
    /// Takes the clock of a sample; returns it when it is to be reported, at first at once.
    fn clock(&mut self, clock: ClockOffset, now: Instant) -> Option<ClockOffset> {
        let worst = self.clock.map_or(0, |(_, worst)| worst).max(clock.uncertainty_ns);
        if let Some((reported, so_far)) = &mut self.clock
            && now.duration_since(*reported) < CLOCK_EVERY
        {
            *so_far = worst;
            return None;
        }
        self.clock = Some((now, 0));
        Some(ClockOffset { uncertainty_ns: worst, ..clock })
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Pulse {
    /// No sample yet.
    #[default]
    Silent,
    Beating,
    Stalled,
}

type Notices<T> = Option<mpsc::Receiver<T>>;

/// The next notice. Never returns if there are none or the sender has ended.
async fn next_notice<T>(notices: &mut Notices<T>) -> T {
    if let Some(notices) = notices
        && let Some(notice) = notices.recv().await
    {
        return notice;
    }
    std::future::pending().await
}

/// Returns when orders or an action must be passed to the device.
async fn changed_controls(controls: Option<&mut Controlled>) {
    match controls {
        Some(controls) => controls.changed().await,
        None => std::future::pending().await,
    }
}

/// Returns when the episode changes.
async fn changed(mut episode: EpisodeWatch) {
    if episode.changed().await.is_err() {
        // No recorder exists any more.
        std::future::pending::<()>().await;
    }
}

impl Ended {
    fn retry(reason: String) -> Self {
        Self { end: End::Retry, reason }
    }
}

impl From<DriverError> for Ended {
    fn from(error: DriverError) -> Self {
        let end = match error {
            DriverError::Gone => End::Gone,
            DriverError::Unlinked => End::LinkDown,
            DriverError::Retry(_) => End::Retry,
            DriverError::Fatal(_) => End::Fatal,
        };
        Self { end, reason: error.to_string() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_lost_by_the_device_leave_a_gap_in_the_sequence() {
        let numbers = Numbers::default();
        assert_eq!([0, 2, 0].map(|lost| numbers.assign(lost)), [(0, 0), (3, 2), (4, 2)]);
    }
}
