//! A stream: one device being read, from the opening of its node to its end.
//!
//! Invariant: between two samples a stream allocates nothing, locks nothing and logs nothing of its
//! own; what publishing costs is said in `bus`.
//! Invariant: a stream that was told to stop publishes no more.

mod controls;
mod source;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until, timeout};
use tokio_util::sync::CancellationToken;

use super::slot::End;
use super::worker::Seat;
use crate::action::ActuatorNotice;
use crate::bus::Writer;
use crate::driver::{Driver, DriverError, Reading};
use crate::fault;
use crate::interlocks::tap::{Tap, lost_at_the_end};
use crate::registry::{Attachment, DeviceSpec, NodeSpec};
use crate::sample::{Epoch, SampleHeader};
use crate::status::{Board, EpisodeWatch, Provenance};
use crate::time::{Stamp, nanoseconds};

/// A device that does not open within this time is tried again.
const OPEN_LIMIT: Duration = Duration::from_secs(10);

/// A device that is open and has sent nothing for this long is said to be silent, once an epoch. It
/// stays Opening: what sends only when something happens may do so at any time.
const SILENT_AFTER: Duration = Duration::from_secs(2);
/// Cameras and programs always send: one that has sent nothing for this long since it was opened is opened
/// again. Six of these and the delays between them fit into the minute in which five restarts are allowed.
const START_LIMIT: Duration = Duration::from_secs(5);
/// How long a device may take to be closed in order.
const CLOSE_LIMIT: Duration = Duration::from_secs(4);
/// How often the actuator is asked whether it was told something.
const ACTIONS_EVERY: Duration = Duration::from_millis(2);

pub(super) use controls::Controls;
use source::Source;

/// What a stream tells the rig while it runs.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Report {
    /// The node is not opened before its link is up.
    Unlinked,
    /// The node is open; what was agreed with the device, for people and for the recording.
    Opened(String, Box<Provenance>),
    /// Open for so long, and no sample yet.
    Silent(Duration),
    /// The first sample was published.
    Started,
    /// Nothing came for `DeviceSpec::stall_after`.
    Stalled,
    /// Samples come again.
    Resumed,
    /// Samples or actions are lost, and why, told once an epoch each; or an order.
    Refused(String),
    /// What an actuator has to tell.
    Actuator(ActuatorNotice),
}

/// A report with its sender.
pub(super) type Reported = (crate::modality::ModalityId, Epoch, Report);

/// How far a modality has come, over all its epochs.
#[derive(Debug, Default)]
pub(super) struct Numbers {
    /// Sequence number of the next sample.
    next: AtomicU64,
    /// Samples that its devices lost.
    lost: AtomicU64,
}

impl Numbers {
    /// `seq` and `lost` of a sample before which the device lost `lost` others: these leave a hole,
    /// so that every consumer can see it.
    fn take(&self, lost: u64) -> (u64, u64) {
        // One stream at a time counts here: an older one publishes no more.
        let seq = self.next.fetch_add(lost + 1, Ordering::Relaxed) + lost;
        (seq, self.lost.fetch_add(lost, Ordering::Relaxed) + lost)
    }
}

/// Everything a stream needs.
#[derive(Debug)]
pub(super) struct Stream {
    pub(super) spec: Arc<DeviceSpec>,
    pub(super) attachment: Attachment,
    /// When it was attached.
    pub(super) attached: Stamp,
    pub(super) epoch: Epoch,
    pub(super) writer: Arc<Writer>,
    pub(super) numbers: Arc<Numbers>,
    pub(super) board: Arc<Board>,
    pub(super) reports: mpsc::Sender<Reported>,
    pub(super) stop: CancellationToken,
    /// Where the program of the entry works, if it has one.
    pub(super) seat: Option<Seat>,
    /// What it is told, if it is the actuator.
    pub(super) controls: Option<Controls>,
    /// Emergency stops and enabling switches that are numbers of its samples.
    pub(super) taps: Arc<[Tap]>,
    /// The episode in progress, of which devices are told that record by themselves.
    pub(super) episode: EpisodeWatch,
}

impl Stream {
    /// Reads the device until it ends or the stream is told to stop. The reason is for people.
    pub(super) async fn run(self) -> (End, String) {
        // However it ends, a panic included, what its samples said is so no more.
        let _lost = lost_at_the_end(&self.taps);
        let stopped = || (End::Gone, "stopped".to_owned());
        let open = async {
            if let Some(is_over) = Driver::unlinked(&self.spec, &self.attachment.node) {
                self.report(Report::Unlinked).await;
                is_over.await;
            }
            timeout(OPEN_LIMIT, Source::open(&self)).await
        };
        let opened = tokio::select! {
            biased;
            () = self.stop.cancelled() => return stopped(),
            opened = open => opened,
        };
        let mut source = match opened {
            Ok(Ok(source)) => source,
            Ok(Err(error)) => return end(&error),
            Err(_) => return (End::Retry, format!("did not open within {} s", OPEN_LIMIT.as_secs())),
        };
        tokio::select! {
            biased;
            () = self.stop.cancelled() => {}
            end = self.read(&mut source) => {
                // What it said last, before it ended.
                self.pass_on_notices(&mut source).await;
                return end;
            }
        }
        source.close().await;
        stopped()
    }

    async fn read(&self, source: &mut Source) -> (End, String) {
        self.report(Report::Opened(source.description(), Box::new(self.provenance(source)))).await;
        let patience = source.patience(self.spec.stall_after);
        let mut pulse = Pulse::Silent;
        let (mut refused, mut unmoved) = (false, false);
        let stall = sleep_until(Instant::now() + self.spec.stall_after);
        tokio::pin!(stall);
        let silent = self.silence();
        tokio::pin!(silent);
        let mut told = interval(ACTIONS_EVERY);
        told.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut controls = match self.controls.as_ref().map(|controls| controls.begin(source)).transpose() {
            Ok(controls) => controls,
            Err(error) => return end(&error),
        };
        // An order that is carried out at once is told before its first sample.
        self.pass_on_notices(source).await;
        let mut episode = self.episode.clone();
        if episode.borrow_and_update().is_some() {
            episode.mark_changed();
        }
        let news = changed(episode.clone());
        tokio::pin!(news);
        // The timer is looked at when it fires, not set anew at every sample.
        let mut newest = Instant::now();
        loop {
            tokio::select! {
                biased;
                reading = source.read() => {
                    let reading = match reading {
                        Ok(reading) => reading,
                        Err(error) => return end(&error),
                    };
                    newest = Instant::now();
                    if let Err(reason) = self.publish(&reading)
                        && !refused
                    {
                        refused = true;
                        self.report(Report::Refused(format!("samples are lost: {reason}"))).await;
                    }
                    if pulse != Pulse::Beating {
                        let report = if pulse == Pulse::Silent { Report::Started } else { Report::Resumed };
                        pulse = Pulse::Beating;
                        self.report(report).await;
                    }
                    // A device that always has something to read never lets us get to `news`.
                    self.tell(source, &mut episode).await;
                }
                _ = told.tick(), if controls.is_some() => {
                    if let Some(controls) = &mut controls {
                        if let Err(error) = controls.pass_on_orders(source) {
                            self.report(Report::Refused(format!("an order is not carried out: {error}"))).await;
                        }
                        if let Err(error) = controls.pass_on_action(source)
                            && !std::mem::replace(&mut unmoved, true)
                        {
                            self.report(Report::Refused(format!("it does not move: {error}"))).await;
                        }
                    }
                    self.pass_on_notices(source).await;
                }
                () = &mut news => {
                    self.tell(source, &mut episode).await;
                    news.set(changed(episode.clone()));
                }
                reason = &mut silent, if pulse == Pulse::Silent => return (End::Retry, reason),
                () = &mut stall => {
                    let due = newest + self.spec.stall_after;
                    if due > Instant::now() {
                        stall.as_mut().reset(due);
                        continue;
                    }
                    // To begin takes longer than to go on: an interpreter has its libraries to load.
                    let least = if pulse == Pulse::Silent { START_LIMIT } else { Duration::ZERO };
                    if patience.is_some_and(|patience| newest.elapsed() >= patience.max(least)) {
                        return (End::Retry, format!("nothing came for {:?}", newest.elapsed()));
                    }
                    if pulse == Pulse::Beating {
                        pulse = Pulse::Stalled;
                        self.report(Report::Stalled).await;
                    }
                    stall.as_mut().reset(Instant::now() + self.spec.stall_after);
                }
            }
        }
    }

    /// Tells the device what is new of the episode in progress, if anything is.
    async fn tell(&self, source: &mut Source, episode: &mut EpisodeWatch) {
        if !episode.has_changed().unwrap_or(false) {
            return;
        }
        let now = episode.borrow_and_update().clone();
        if let Err(error) = source.record(now.as_ref()) {
            let verb = if now.is_some() { "start" } else { "stop" };
            self.report(Report::Refused(format!("it does not {verb} recording: {error}"))).await;
        }
    }

    /// Reports what the actuator has to tell.
    async fn pass_on_notices(&self, source: &mut Source) {
        while let Some(notice) = source.take_notice() {
            self.report(Report::Actuator(notice)).await;
        }
    }

    /// Says that the device sends nothing; ends, with the reason, when it is to be opened again.
    async fn silence(&self) -> String {
        let opened = Instant::now();
        let say = SILENT_AFTER.max(self.spec.stall_after);
        let Some(at) = opened.checked_add(say) else { return std::future::pending().await };
        sleep_until(at).await;
        self.report(Report::Silent(say)).await;
        if !matches!(self.spec.node, NodeSpec::Camera(_)) || self.attachment.node.is_recording() {
            return std::future::pending().await;
        }
        let limit = START_LIMIT.max(2 * say);
        sleep_until(opened + limit).await;
        format!("open, but sent nothing for {} s", limit.as_secs())
    }

    fn provenance(&self, source: &Source) -> Provenance {
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
        // First of all: whatever becomes of the sample, what it stops is stopped.
        for tap in &*self.taps {
            tap.look(reading.encoding, reading.bytes);
        }
        let (seq, lost) = self.numbers.take(reading.lost);
        let header = SampleHeader {
            seq,
            lost,
            capture_ns: reading.captured.0,
            recv_ns: Stamp::now().0,
            id: u32::from(self.spec.id.bit()),
            epoch: self.epoch.0,
            encoding: reading.encoding as u32,
            flags: reading.flags,
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

    /// The rig reads its reports at once; the channel is full only if it has ended.
    async fn report(&self, report: Report) {
        let _ = self.reports.send((self.spec.id, self.epoch, report)).await;
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Pulse {
    /// No sample yet.
    Silent,
    Beating,
    Stalled,
}

/// Returns when there is news of an episode.
async fn changed(mut episode: EpisodeWatch) {
    if episode.changed().await.is_err() {
        // Nobody records any more.
        std::future::pending::<()>().await;
    }
}

fn end(error: &DriverError) -> (End, String) {
    let how = match error {
        DriverError::Gone => End::Gone,
        DriverError::Unlinked => End::Unlinked,
        DriverError::Retry(_) => End::Retry,
        DriverError::Fatal(_) => End::Fatal,
    };
    (how, error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_device_lost_leaves_a_hole_that_is_its_own() {
        let numbers = Numbers::default();
        assert_eq!([0, 2, 0].map(|lost| numbers.take(lost)), [(0, 0), (3, 2), (4, 2)]);
    }
}
