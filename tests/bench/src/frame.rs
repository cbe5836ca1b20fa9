//! How long a picture takes from the driver to the recorder.

use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rapid::rig::Rig;
use rapid::rig::presence::{Claim, Presence};
use rapid_bus::{Bus, Inbox, TopicId};
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;
use rapid_devices::hotplug::HotplugStream;
use rapid_devices::hotplug::script::Script;
use rapid_episode::record::{EpisodeRequest, Recorder, RecorderConfig, Source};
use rapid_registry::Registry;
use rapid_status::Board;
use tokio_util::sync::CancellationToken;

use crate::beat::sleep_until;
use crate::feed::{self, Feed};
use crate::figure::Figure;
use crate::stats::{Sorted, median};
use crate::{Bench, Failure};

/// Time between two pictures of one camera.
const PERIOD: Duration = Duration::from_micros(16_667);
/// Samples before this time are left out: threads and memory settle.
const WARM_UP: Duration = Duration::from_millis(500);

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    // Longer than the warm-up, and than the start on a busy machine.
    let length = bench.length(10, 2).max(Duration::from_secs(2));
    let (mut alone, mut bare, mut loaded) = (Vec::new(), Vec::new(), Vec::new());
    for run in 0..bench.runs {
        bench.progress(&format!("frame: run {} of {}", run + 1, bench.runs));
        alone.push(one_camera(bench, length)?);
        bare.push(bare_hop(length)?);
        loaded.push(full_load(bench, length)?);
    }
    let of =
        |share: f64, runs: &[Sorted]| median(&runs.iter().filter_map(|run| run.quantile(share)).collect::<Vec<_>>());
    let count = alone.iter().map(Sorted::len).sum::<usize>();
    let note = format!(
        "{count} pictures of 60 kB at 60 Hz, from the stamp at the dequeue over copy, bus and wake-up to `Source::drain` of a \
         recording writer; baseline: one copy and an eventfd between two threads"
    );
    Ok(vec![
        Figure::new("frame/one camera, p50", "us", of(0.5, &alone)).baseline(of(0.5, &bare)).target("< 200").note(note),
        Figure::new("frame/one camera, p99", "us", of(0.99, &alone)).baseline(of(0.99, &bare)),
        Figure::new("frame/full load, p50", "us", of(0.5, &loaded))
            .target("< 200")
            .note("four cameras, state and mask through the rig's own tasks"),
        Figure::new("frame/full load, p99", "us", of(0.99, &loaded)),
    ])
}

/// A sample on its way.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Passed {
    /// Its topic.
    pub topic: TopicId,
    /// Its header.
    pub header: SampleHeader,
    /// Size of its payload in bytes.
    pub bytes: usize,
    /// When it was passed to the recorder.
    pub handed: Stamp,
    /// When the recorder had written it.
    pub written: Stamp,
}

/// All samples that passed.
pub(crate) type Log = Arc<Mutex<Vec<Passed>>>;

/// The recorder's inbox, which also records when a sample passes.
pub(crate) struct Noting {
    inbox: Inbox,
    log: Log,
}

impl Source for Noting {
    fn wait(&mut self, timeout: Duration) -> Result<(), String> {
        Source::wait(&mut self.inbox, timeout)
    }

    fn drain(&mut self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String> {
        let log = &self.log;
        Source::drain(&mut self.inbox, &mut |topic, header, payload| {
            let handed = Stamp::now();
            take(topic, header, payload);
            let passed = Passed { topic, header: *header, bytes: payload.len(), handed, written: Stamp::now() };
            log.lock().unwrap_or_else(PoisonError::into_inner).push(passed);
        })
    }
}

/// A bus with a recorder that writes published samples to a file.
pub(crate) struct Recording {
    /// The bus.
    pub bus: Bus,
    /// The samples that passed.
    pub log: Log,
    /// The board for its reports.
    pub board: Arc<Board>,
    recorder: Recorder,
    _out: tempfile::TempDir,
}

impl Recording {
    /// Opens the bus and starts an episode.
    pub(crate) fn begin(
        bench: &Bench,
        registry: &Registry,
        runtime: &tokio::runtime::Runtime,
    ) -> Result<Self, Failure> {
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let instance = format!("bench{}x{number}", std::process::id());
        let bus = Bus::open(registry, Some(&instance))?;
        let log: Log = Arc::new(Mutex::new(Vec::with_capacity(1 << 18)));
        let board = Arc::new(Board::new(registry));
        let source = Noting { inbox: bus.inbox()?, log: Arc::clone(&log) };
        let config = RecorderConfig::new(Arc::new(registry.clone()), Arc::clone(&board));
        let mut recorder = Recorder::spawn(source, config)?;
        let out = tempfile::Builder::new().prefix("frame").tempdir_in(bench.scratch.path())?;
        let request =
            EpisodeRequest { out: out.path().to_owned(), task: "frame".to_owned(), ..EpisodeRequest::default() };
        runtime.block_on(recorder.start(request))?;
        Ok(Self { bus, log, board, recorder, _out: out })
    }

    /// Ends the episode; returns all samples that passed.
    pub(crate) fn end(mut self, runtime: &tokio::runtime::Runtime) -> Result<Vec<Passed>, Failure> {
        let report = runtime.block_on(self.recorder.stop()).ok_or("no episode was recorded")?;
        if let Some(error) = report.error {
            return Err(error.into());
        }
        drop((self.recorder, self.bus));
        Ok(std::mem::take(&mut self.log.lock().unwrap_or_else(PoisonError::into_inner)))
    }
}

/// Runs the rig on a scenario for some time, recorded.
pub(crate) fn play(
    bench: &Bench,
    registry: &Registry,
    script: impl FnOnce() -> HotplugStream,
    length: Duration,
) -> Result<Vec<Passed>, Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().thread_name("worker").build()?;
    let recording = Recording::begin(bench, registry, &runtime)?;
    let mask = recording.bus.writer(TopicId::Mask).ok_or("the bus has no mask")?;
    let claim = Claim::new(&bench.scratch.path().join("mask"), u8::try_from(registry.devices.len())?)?;
    let presence = Presence::start(claim, mask, Arc::clone(&recording.board))?;
    let mut rig = Rig::new(registry, &recording.bus, presence, Arc::clone(&recording.board));
    let stop = CancellationToken::new();
    runtime.block_on(async {
        let running = {
            let (stop, script) = (stop.clone(), script());
            let (_commands, asked) = tokio::sync::mpsc::channel(1);
            tokio::spawn(async move { rig.run(script, asked, stop).await })
        };
        tokio::time::sleep(length).await;
        stop.cancel();
        running.await
    })??;
    recording.end(&runtime)
}

/// Time from the driver to the recorder, us, of the pictures among `passed`.
fn delays(passed: &[Passed], pictures: impl Fn(TopicId) -> bool) -> Sorted {
    let begin = passed.first().map_or(Stamp::default(), |first| first.handed.after(WARM_UP));
    let pictures = passed.iter().filter(|one| pictures(one.topic) && one.handed > begin);
    Sorted::new(pictures.map(|one| one.handed.since(Stamp(one.header.recv_ns)).as_secs_f64() * 1e6))
}

fn one_camera(bench: &Bench, length: Duration) -> Result<Sorted, Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let (registry, _) = feed::rig()?;
    let feed = Feed::full_load()?;
    let recording = Recording::begin(bench, &registry, &runtime)?;
    let lane = &feed.lanes[0];
    let writer = recording.bus.writer(lane.topic).ok_or("the bus lacks a camera")?;
    let begun = Stamp::now();
    let mut due = begun;
    let mut seq = 0;
    while due.since(begun) < length {
        due = due.after(PERIOD);
        sleep_until(due);
        let now = Stamp::now().0;
        let header = SampleHeader { seq, capture_ns: now, recv_ns: now, ..lane.header };
        writer.publish(header, &lane.payloads[usize::try_from(seq)? % lane.payloads.len()])?;
        seq += 1;
    }
    drop(writer);
    Ok(delays(&recording.end(&runtime)?, |_| true))
}

fn full_load(bench: &Bench, length: Duration) -> Result<Sorted, Failure> {
    let (registry, scenario) = feed::rig()?;
    let passed = play(bench, &registry, move || Box::pin(Script::new(scenario)), WARM_UP + length)?;
    let state = registry.named("state").map(|spec| TopicId::Modality(spec.id));
    Ok(delays(&passed, |topic| topic != TopicId::Mask && Some(topic) != state))
}

/// One copy into shared memory, and an eventfd.
fn bare_hop(length: Duration) -> Result<Sorted, Failure> {
    let feed = Feed::full_load()?;
    let lane = &feed.lanes[0];
    let shared = Arc::new((Mutex::new(vec![0_u8; 1 << 20]), AtomicU64::new(0)));
    let event = Arc::new(rustix::event::eventfd(0, rustix::event::EventfdFlags::CLOEXEC)?);
    let consumer = std::thread::spawn({
        let (shared, event) = (Arc::clone(&shared), Arc::clone(&event));
        move || -> io::Result<Vec<f64>> {
            let mut taken = Vec::new();
            loop {
                rustix::io::read(&*event, &mut [0; 8])?;
                let now = Stamp::now();
                match shared.1.load(Ordering::Acquire) {
                    0 => return Ok(taken),
                    stamp => taken.push(now.since(Stamp(stamp)).as_secs_f64() * 1e6),
                }
            }
        }
    });
    let begun = Stamp::now();
    let mut due = begun;
    for payload in lane.payloads.iter().cycle() {
        if due.since(begun) >= length {
            break;
        }
        due = due.after(PERIOD);
        sleep_until(due);
        let now = Stamp::now().0;
        if let Some(place) = shared.0.lock().unwrap_or_else(PoisonError::into_inner).get_mut(..payload.len()) {
            place.copy_from_slice(payload);
        }
        shared.1.store(now, Ordering::Release);
        rustix::io::write(&*event, &1_u64.to_ne_bytes())?;
    }
    shared.1.store(0, Ordering::Release);
    rustix::io::write(&*event, &1_u64.to_ne_bytes())?;
    let taken = consumer.join().map_err(|_| "the consumer panicked")??;
    Ok(Sorted::new(taken))
}
