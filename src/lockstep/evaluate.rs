//! Closed-loop trials of a policy on the simulated task, with a sensor that is unplugged.
//!
//! The policy is queried at a tick and its answer is available at the next one, as in real time, where a chunk takes a
//! tenth of a tick. In every trial the sensors have a different phase and latency ([`Timing`]).

use std::time::Duration;

use rapid_bus::TopicId;
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::random::Random;
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;
use rapid_episode::record::stepped::Stepped;
use rapid_episode::record::{EpisodeRequest, RecordError};
use rapid_policy::bundle::Bundle;
use rapid_policy::horizon::{Counts, WithoutMask};
use rapid_policy::model::{AnswerError, Model};
use rapid_policy::pilot::Pilot;
use rapid_policy::request::Request;
use rapid_registry::scenario::{Scenario, ScenarioAction};
use rapid_registry::simulation::task::{AXES, Outcome, Size, Texture, Touch, UNSEEN_PERIOD};
use rapid_registry::{Registry, task};
use rapid_status::{EpisodeReport, Event};
use serde::Serialize;

use super::timing::Timing;
use super::{Lockstep, STEP, Taker, TrialError};

/// The random stream of a trial's seed that determines when cables are unplugged.
const WINDOWS: u64 = 0x7769_6e64_6f77;
/// The device that is unplugged.
const PULLED: &str = task::PARTS[1].0;
/// Steps in which all devices are plugged in and observed, before the policy begins.
const SETTLE: u32 = 3;
/// Pressure of the gel from which the texture is felt.
const FELT: f64 = 0.2;
/// How far the block is from where it was touched when the ways to the bins have parted, m.
const PARTED: f64 = 0.08;
/// A cable is plugged in again after this many steps at the latest: a policy may never touch the block.
const LONGEST_OUT: u32 = 45;
/// How long a read of the static loop waits for a sample: `async_read(timeout_ms=200)` of LeRobot's cameras, after which it
/// raises `TimeoutError`.
const READ_TIMEOUT: Duration = Duration::from_millis(200);

/// The sensor conditions (paper, table "Hot-plug robustness", and two more).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Condition {
    /// Nothing.
    Full,
    /// The tactile sensor is absent.
    NoTactile,
    /// It is unplugged 3 to 14 steps after the touch: the texture has been felt, and the ways to the bins have rarely parted.
    HotUnplug,
    /// It is unplugged at a step of 10 to 24, and plugged in again 2 to 9 steps after the touch, or 45 later at the latest.
    HotReplug,
    /// It is unplugged at a step of 10 to 24: nearly always before the touch. Not in the paper's table.
    EarlyUnplug,
    /// The wrist camera is absent: nothing shows the block's position. Not in the paper's table.
    NoWrist,
}

/// When a cable is unplugged or plugged in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum When {
    Step(u32),
    /// So many steps after the touch.
    AfterTouch(u32),
}

impl Condition {
    /// All of them, those of the paper's table first.
    pub const ALL: [Self; 6] =
        [Self::Full, Self::NoTactile, Self::HotUnplug, Self::HotReplug, Self::EarlyUnplug, Self::NoWrist];

    /// Its word on the command line.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::NoTactile => "no-tactile",
            Self::HotUnplug => "hot-unplug",
            Self::HotReplug => "hot-replug",
            Self::EarlyUnplug => "early-unplug",
            Self::NoWrist => "no-wrist",
        }
    }

    /// When the sensor is unplugged, and plugged in again, in trial `seed`.
    fn windows(self, seed: u64) -> (Option<When>, Option<When>) {
        let mut random = Random::new(seed, WINDOWS);
        let mut step = |low: u32, high: u32| low + u32::try_from(random.below(u64::from(high - low))).unwrap_or(0);
        match self {
            Self::Full | Self::NoTactile | Self::NoWrist => (None, None),
            Self::HotUnplug => (Some(When::AfterTouch(step(3, 15))), None),
            Self::EarlyUnplug => (Some(When::Step(step(10, 25))), None),
            Self::HotReplug => (Some(When::Step(step(10, 25))), Some(When::AfterTouch(step(2, 10)))),
        }
    }

    fn scenario(self, registry: &Registry, seed: u64) -> Scenario {
        let mut scenario = Scenario::task(registry, seed);
        let away = match self {
            Self::NoTactile => Some(PULLED),
            Self::NoWrist => Some(task::PARTS[0].0),
            Self::Full | Self::HotUnplug | Self::HotReplug | Self::EarlyUnplug => None,
        };
        for device in scenario.devices.iter_mut().filter(|device| Some(device.name.as_str()) == away) {
            device.plugged = false;
        }
        scenario
    }
}

/// The hand at the cable: unplugs and plugs in when the condition requires it, and notes the milestones of the trial.
#[derive(Debug)]
struct Hand {
    out: Option<When>,
    back: Option<When>,
    touched: Option<(u32, [f64; 3])>,
    parted: Option<u32>,
    unplugged: Option<u32>,
    plugged: Option<u32>,
}

impl Hand {
    fn new(condition: Condition, seed: u64) -> Self {
        let (out, back) = condition.windows(seed);
        Self { out, back, touched: None, parted: None, unplugged: None, plugged: None }
    }

    /// At tick `tick` of the control grid; what it does is seen at the next one.
    fn act(&mut self, tick: u32, rig: &mut Lockstep) {
        self.observe(tick, rig);
        let touched = self.touched.map(|(tick, _)| tick);
        let is_due = |when: Option<When>| match when {
            Some(When::Step(step)) => tick + 1 >= step,
            Some(When::AfterTouch(steps)) => touched.is_some_and(|touched| tick + 1 >= touched + steps),
            None => false,
        };
        if self.unplugged.is_none() && is_due(self.out) {
            rig.schedule(PULLED, ScenarioAction::Unplug);
            self.unplugged = Some(tick + 1);
        } else if let (Some(out), Some(_), None) = (self.unplugged, self.back, self.plugged)
            && (is_due(self.back) || tick + 1 >= out + LONGEST_OUT)
        {
            rig.schedule(PULLED, ScenarioAction::Plug { port: None });
            self.plugged = Some(tick + 1);
        }
    }

    fn observe(&mut self, tick: u32, rig: &Lockstep) {
        let trial = rig.trial().lock();
        let world = &trial.world;
        if self.touched.is_none() && world.pressure >= FELT {
            self.touched = Some((tick, world.position));
        }
        if let (Some((_, [x, y, _])), None) = (self.touched, self.parted)
            && world.held
            && (world.position[0] - x).hypot(world.position[1] - y) >= PARTED
        {
            self.parted = Some(tick);
        }
    }
}

/// How sensors are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Configuration {
    /// Those that are present, by the mask.
    Dynamic,
    /// Every sensor that was present at the start is read at every tick by a loop that fails when a read does
    /// (`StaticLoop`). The policy keeps the mask of the start.
    Static,
}

/// The control loop of a fixed list of sensors, as robot-learning software has it: it waits for the next sample of each
/// sensor, and a read without one in time is an error that ends the run.
#[derive(Debug)]
struct StaticLoop {
    sensors: Vec<(ModalityId, String)>,
    newest: Vec<Stamp>,
}

/// A sensor gave no sample in time.
#[derive(Debug, thiserror::Error)]
#[error("{name}: no sample within {READ_TIMEOUT:?}")]
struct ReadError {
    name: String,
}

impl StaticLoop {
    /// A loop that reads these sensors.
    fn new(registry: &Registry, mask: PhysicalMask) -> Self {
        let sensors = registry.devices.iter().filter(|device| mask.contains(device.id));
        let sensors: Vec<_> = sensors.map(|device| (device.id, device.name.clone())).collect();
        Self { newest: vec![Stamp::default(); sensors.len()], sensors }
    }

    fn note_sample(&mut self, topic: TopicId, header: &SampleHeader) {
        for ((id, _), newest) in self.sensors.iter().zip(&mut self.newest) {
            if topic == TopicId::Modality(*id) {
                *newest = Stamp(header.recv_ns);
            }
        }
    }

    /// Reads every sensor at `now`.
    fn read(&self, now: Stamp) -> Result<(), ReadError> {
        let late = self.sensors.iter().zip(&self.newest).find(|(_, newest)| now.since(**newest) > READ_TIMEOUT);
        late.map_or(Ok(()), |((_, name), _)| Err(ReadError { name: name.clone() }))
    }
}

/// The result of a run, read from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// All sensors were present at its end.
    Normal,
    /// One was absent at its end.
    Degraded,
    /// Its loop failed.
    Crash,
}

/// One trial.
#[derive(Debug, Clone, Serialize)]
pub struct Trial {
    /// Its number, which determines everything in it.
    pub seed: u64,
    /// The condition of the sensors.
    pub condition: Condition,
    /// Texture of the block: true if triangular.
    pub triangular: bool,
    /// Size of the block.
    pub size: Size,
    /// Its lattice has the period that no demonstration shows.
    pub unseen_period: bool,
    /// Step at which the texture was first felt.
    pub touched_at: Option<u32>,
    /// Step from which the block was on its way to one of the bins.
    pub parted_at: Option<u32>,
    /// Step at which the sensor was unplugged.
    pub unplugged_at: Option<u32>,
    /// Step at which it was plugged in again.
    pub plugged_at: Option<u32>,
    /// How it ended.
    pub outcome: Outcome,
    /// The status of the run.
    pub status: Status,
    /// Steps of the task.
    pub steps: u32,
    /// What the executor counted.
    pub counts: Counts,
    /// The last failure of the policy.
    pub failure: Option<String>,
}

/// Records the behaviour of a policy.
#[derive(Debug)]
pub struct Recording<'a> {
    /// Writes the file.
    pub recorder: &'a mut Stepped,
    /// Name and folder of the file.
    pub request: &'a EpisodeRequest,
    /// The origin of onnxruntime.
    pub library: &'a str,
    /// The start time of the trial.
    pub begun: Stamp,
}

/// The inputs of a trial.
#[derive(Debug)]
pub struct Bench<'a> {
    /// The policy.
    pub bundle: &'a Bundle,
    /// The rig of the task.
    pub registry: &'a Registry,
    /// Its graphs.
    pub model: &'a mut Model,
    /// Which sensors are required.
    pub configuration: Configuration,
}

impl Bench<'_> {
    /// Runs trial `seed`.
    ///
    /// # Errors
    /// When the simulation fails; mistakes of a policy are part of the result.
    pub fn run(&mut self, condition: Condition, seed: u64) -> Result<Trial, TrialError> {
        self.carry_out(condition, seed, None).map(|(trial, _)| trial)
    }

    /// Runs trial `seed` with sensors locked to the ticks, and records it from the policy's first tick on.
    ///
    /// # Errors
    /// When the simulation fails, or the file cannot be written.
    pub fn record(
        &mut self,
        condition: Condition,
        seed: u64,
        recording: Recording<'_>,
    ) -> Result<(Trial, EpisodeReport), TrialError> {
        let (trial, report) = self.carry_out(condition, seed, Some(recording))?;
        Ok((trial, report.ok_or(RecordError::Idle)?))
    }

    fn carry_out(
        &mut self,
        condition: Condition,
        seed: u64,
        recording: Option<Recording<'_>>,
    ) -> Result<(Trial, Option<EpisodeReport>), TrialError> {
        let begun = recording.as_ref().map_or(Stamp(1_000_000_000), |recording| recording.begun);
        let scenario = condition.scenario(self.registry, seed);
        let timings = if recording.is_some() { Vec::new() } else { Timing::of_trial(seed, self.registry, &scenario) };
        let mut rig = Lockstep::new(self.registry, scenario, begun, &timings)?;
        self.model.reset();
        let (recorder, reported) = match recording {
            Some(Recording { recorder, request, library, .. }) => (Some(recorder), Some((request, library))),
            None => (None, None),
        };
        let mut witness =
            Spectator { pilot: Pilot::new(self.bundle, self.registry, WithoutMask::Hold, seed), recorder, reads: None };
        let mut request = Request::new(self.bundle);
        let mut chunk = vec![0.0; self.model.chunk_len()];
        for _ in 0..SETTLE {
            rig.deliver(&mut witness)?;
            rig.rest(&mut witness)?;
        }
        if let (Some(recorder), Some((request, library))) = (&mut witness.recorder, reported) {
            recorder.begin(request, rig.now())?;
            recorder.event(&Event { stamp: rig.now(), what: self.bundle.begins(library.to_owned(), false) });
        }
        let mut hand = Hand::new(condition, seed);
        if self.configuration == Configuration::Static {
            witness.reads = Some(StaticLoop::new(self.registry, rig.mask()));
        }
        let (mut crash, mut failure) = (None, None);
        let mut tick: u32 = 0;
        while !rig.trial().lock().world.is_done() {
            rig.deliver(&mut witness)?;
            hand.act(tick, &mut rig);
            if let Some(Err(error)) = witness.reads.as_ref().filter(|_| tick > 0).map(|reads| reads.read(rig.now())) {
                crash = Some(error.to_string());
                break;
            }
            let number = u64::from(tick);
            let answer = witness.pilot.observe(number, rig.now(), rig.now()).then(|| {
                witness.pilot.fill(number, rig.now(), &mut request);
                self.model.answer(&request, &mut chunk)
            });
            let action = witness.pilot.step(number).action.and_then(axes);
            if let Some(action) = action {
                rig.act(number, action, &mut witness);
            }
            rig.step(0.0, &mut witness)?;
            let skipped = pass_answer(answer, &mut witness.pilot, &request, &chunk, &mut failure);
            if let Some(recorder) = &mut witness.recorder {
                if let Some(skipped) = skipped {
                    let (devices, latency_ms) = (self.registry.devices.len(), STEP.as_secs_f64() * 1e3);
                    let actions = witness.pilot.chunk();
                    let what = request.answered(self.bundle, devices, latency_ms, Ok(skipped), actions);
                    recorder.event(&Event { stamp: rig.now(), what });
                }
                recorder.advance(rig.now());
            }
            tick += 1;
        }
        let report = witness.recorder.as_mut().and_then(|recorder| recorder.finish(rig.now()));
        let status = match &crash {
            Some(_) => Status::Crash,
            None if missing(everything(self.registry), rig.mask()) => Status::Degraded,
            None => Status::Normal,
        };
        let trial = rig.trial().lock();
        let trial = Trial {
            seed,
            condition,
            triangular: trial.world.texture == Texture::Triangular,
            size: trial.world.size,
            unseen_period: Touch::new(seed).period == UNSEEN_PERIOD,
            touched_at: hand.touched.map(|(tick, _)| tick),
            parted_at: hand.parted,
            unplugged_at: hand.unplugged,
            plugged_at: hand.plugged,
            outcome: trial.world.outcome(),
            status,
            steps: trial.world.steps(),
            counts: witness.pilot.queue.counts(),
            failure: crash.or(failure),
        };
        Ok((trial, report))
    }
}

/// Passes the answer to the pilot. Returns how many actions of a chunk came too late; `None` without a chunk.
fn pass_answer(
    answer: Option<Result<(), AnswerError>>,
    pilot: &mut Pilot,
    asked: &Request,
    chunk: &[f32],
    failure: &mut Option<String>,
) -> Option<u64> {
    match answer? {
        Ok(()) => {
            let taken = pilot.answer(asked, chunk);
            if let Err(refused) = &taken {
                *failure = Some(refused.to_string());
            }
            // An unused chunk was computed nevertheless, and may have been the first with a picture.
            Some(taken.unwrap_or(0))
        }
        Err(error) => {
            pilot.queue.failed(asked.tick);
            *failure = Some(error.to_string());
            None
        }
    }
}

fn everything(registry: &Registry) -> PhysicalMask {
    registry.devices.iter().fold(PhysicalMask::EMPTY, |mask, device| mask.with(device.id, true))
}

fn missing(expected: PhysicalMask, there: PhysicalMask) -> bool {
    expected.0 & !there.0 != 0
}

/// The targets of the arm.
fn axes(action: &[f32]) -> Option<[f64; AXES]> {
    let action: [f32; AXES] = action.try_into().ok()?;
    Some(action.map(f64::from))
}

/// Receivers of the rig's samples: the policy, the recorder if there is one, and the reads of a static loop.
struct Spectator<'a> {
    pilot: Pilot,
    recorder: Option<&'a mut Stepped>,
    /// Of a static configuration.
    reads: Option<StaticLoop>,
}

impl Taker for Spectator<'_> {
    fn receive(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8]) {
        if let Some(recorder) = &mut self.recorder {
            recorder.receive(topic, header, payload);
        }
        if let Some(reads) = &mut self.reads {
            reads.note_sample(topic, header);
            // A fixed list has no mask: the policy does not see a sensor leave.
            if topic == TopicId::Mask {
                return;
            }
        }
        self.pilot.receive(topic, header, payload);
    }

    fn event(&mut self, event: &Event) {
        if let Some(recorder) = &mut self.recorder {
            recorder.event(event);
        }
    }
}

/// 95 % interval of the share `count / total` (Wilson 1927).
pub fn wilson(count: usize, total: usize) -> (f64, f64) {
    const Z: f64 = 1.959_964;
    if total == 0 {
        return (0.0, 1.0);
    }
    let (n, share) = (total as f64, count as f64 / total as f64);
    let middle = share + Z * Z / (2.0 * n);
    let reach = Z * (share * (1.0 - share) / n + Z * Z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + Z * Z / n;
    (((middle - reach) / scale).max(0.0), ((middle + reach) / scale).min(1.0))
}

/// The robot time of a trial's steps.
pub fn robot_time(steps: u64) -> Duration {
    Duration::from_secs_f64(STEP.as_secs_f64() * steps as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::example;
    use rapid_core::mask::Bits;

    #[test]
    fn the_confidence_interval_is_that_of_wilson() {
        let near = |(low, high): (f64, f64), expected: (f64, f64)| {
            assert!((low - expected.0).abs() < 5e-4 && (high - expected.1).abs() < 5e-4, "{low} {high}");
        };
        // Newcombe (1998), table I: 81 of 263, and 0 of 20.
        near(wilson(81, 263), (0.2553, 0.3662));
        near(wilson(0, 20), (0.0, 0.1611));
        near(wilson(20, 20), (0.8389, 1.0));
        near(wilson(0, 0), (0.0, 1.0));
    }

    #[test]
    fn cables_are_unplugged_when_the_condition_holds() {
        for seed in 0..500 {
            assert_eq!(Condition::Full.windows(seed), (None, None));
            let (out, back) = Condition::HotUnplug.windows(seed);
            assert!(matches!(out, Some(When::AfterTouch(3..15))) && back.is_none());
            let (out, back) = Condition::HotReplug.windows(seed);
            assert!(
                matches!((out, back), (Some(When::Step(10..25)), Some(When::AfterTouch(2..10)))),
                "{out:?} {back:?}"
            );
        }
    }

    #[test]
    fn a_static_loop_fails_at_the_sensor_that_gives_no_sample() {
        let registry = Registry::task();
        let mut reads = StaticLoop::new(&registry, PhysicalMask(0b011));
        let sample = |bit: u8, ms: u64| {
            let id = ModalityId::new(bit).expect("a bit");
            (TopicId::Modality(id), SampleHeader { recv_ns: ms * 1_000_000, ..SampleHeader::default() })
        };
        for (bit, ms) in [(0, 100), (1, 100), (0, 200)] {
            let (topic, header) = sample(bit, ms);
            reads.note_sample(topic, &header);
        }
        assert!(reads.read(Stamp(300_000_000)).is_ok());
        let error = reads.read(Stamp(300_000_001)).expect_err("tactile is late").to_string();
        assert_eq!(error, "tactile_tip: no sample within 200ms");
        let (topic, header) = sample(1, 300);
        reads.note_sample(topic, &header);
        assert!(reads.read(Stamp(400_000_000)).is_ok());
    }

    #[test]
    fn the_policy_of_a_static_loop_keeps_the_mask_of_the_start() {
        let registry = Registry::task();
        let bundle = Bundle::parse(example::POLICY, "policy.json").unwrap_or_else(|errors| panic!("{errors}"));
        let (start, later) = (PhysicalMask(0b111), PhysicalMask(0b101));
        for (reads, expected) in [(None, later), (Some(StaticLoop::new(&registry, start)), start)] {
            let pilot = Pilot::new(&bundle, &registry, WithoutMask::Hold, 0);
            let mut spectator = Spectator { pilot, recorder: None, reads: None };
            spectator.receive(TopicId::Mask, &SampleHeader::default(), &Bits::from(start).payload(1));
            spectator.reads = reads;
            spectator.receive(TopicId::Mask, &SampleHeader::default(), &Bits::from(later).payload(2));
            assert_eq!(spectator.pilot.mask, expected);
        }
    }
}
