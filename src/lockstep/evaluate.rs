//! Closed-loop trials of a policy on the simulated task, with a sensor that is unplugged.
//!
//! The policy is queried at a tick and its answer is available at the next one, as in real time, where a chunk takes a
//! tenth of a tick. In every trial the sensors have a different phase and latency ([`Timing`]).

use std::time::Duration;

use serde::Serialize;

use super::timing::Timing;
use super::{Lockstep, STEP, Taker, TrialError};
use crate::bus::TopicId;
use crate::mask::PhysicalMask;
use crate::policy::bundle::Bundle;
use crate::policy::horizon::{Counts, WithoutMask};
use crate::policy::model::{AnswerError, Model};
use crate::policy::pilot::Pilot;
use crate::policy::request::Request;
use crate::random::Random;
use crate::record::stepped::Stepped;
use crate::record::{EpisodeReport, EpisodeRequest, RecordError};
use crate::registry::scenario::{Scenario, ScenarioAction, ScenarioEvent};
use crate::registry::{Registry, task};
use crate::sample::SampleHeader;
use crate::simulation::task::{AXES, Outcome, Texture};
use crate::status::Event;
use crate::time::Stamp;

/// The random stream of a trial's seed that determines when cables are unplugged.
const WINDOWS: u64 = 0x7769_6e64_6f77;
/// The device that is unplugged.
const PULLED: &str = task::PARTS[1].0;
/// Steps in which all devices are plugged in and observed, before the policy begins.
const SETTLE: u32 = 3;

/// The sensor conditions (paper, table "Hot-plug robustness", and one more).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Condition {
    /// Nothing.
    Full,
    /// The tactile sensor is absent.
    NoTactile,
    /// It is unplugged at a step of 30 to 74: the block is touched at 35 to 45, and the paths to the bins separate at
    /// 60 to 70.
    HotUnplug,
    /// It is unplugged at a step of 10 to 29 and plugged in again 15 to 29 steps later.
    HotReplug,
    /// The wrist camera is absent: nothing shows the block's position. Not in the paper's table.
    NoWrist,
}

impl Condition {
    /// All of them, in the order of the paper's table.
    pub const ALL: [Self; 5] = [Self::Full, Self::NoTactile, Self::HotUnplug, Self::HotReplug, Self::NoWrist];

    /// Its word on the command line.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::NoTactile => "no-tactile",
            Self::HotUnplug => "hot-unplug",
            Self::HotReplug => "hot-replug",
            Self::NoWrist => "no-wrist",
        }
    }

    /// The steps at which the sensor is unplugged and plugged in again in trial `seed`.
    pub fn windows(self, seed: u64) -> (Option<u32>, Option<u32>) {
        let mut random = Random::new(seed, WINDOWS);
        let mut step = |low: u32, high: u32| low + u32::try_from(random.below(u64::from(high - low))).unwrap_or(0);
        match self {
            Self::Full | Self::NoTactile | Self::NoWrist => (None, None),
            Self::HotUnplug => (Some(step(30, 75)), None),
            Self::HotReplug => {
                let out = step(10, 30);
                (Some(out), Some(out + step(15, 30)))
            }
        }
    }

    fn scenario(self, registry: &Registry, seed: u64) -> Scenario {
        let mut scenario = Scenario::task(registry, seed);
        let away = match self {
            Self::NoTactile => Some(PULLED),
            Self::NoWrist => Some(task::PARTS[0].0),
            Self::Full | Self::HotUnplug | Self::HotReplug => None,
        };
        for device in scenario.devices.iter_mut().filter(|device| Some(device.name.as_str()) == away) {
            device.plugged = false;
        }
        let (out, back) = self.windows(seed);
        // Between two ticks, so that at the tick of that step the bit is clear.
        let at = |step: u32| STEP * (SETTLE + step - 1) + STEP / 2;
        let event = |step, action| ScenarioEvent { at: at(step), device: PULLED.to_owned(), action };
        scenario.events.extend(out.map(|step| event(step, ScenarioAction::Unplug)));
        scenario.events.extend(back.map(|step| event(step, ScenarioAction::Plug { port: None })));
        scenario
    }
}

/// Which sensors a run requires.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Configuration {
    /// Those that are present.
    Dynamic,
    /// Those present at the start: a sensor that is missing later ends the run, as with a configuration file and a
    /// driver that raises an exception.
    Static,
}

/// The result of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// All sensors were present.
    Normal,
    /// It continued without one.
    Degraded,
    /// It was aborted.
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
            Spectator { pilot: Pilot::new(self.bundle, self.registry, WithoutMask::Hold, seed), recorder };
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
        let launched = rig.mask();
        let (mut status, mut failure) = (Status::Normal, None);
        let mut tick = 0;
        while !rig.trial().lock().world.is_done() {
            rig.deliver(&mut witness)?;
            if self.configuration == Configuration::Static && missing(launched, rig.mask()) {
                status = Status::Crash;
                break;
            }
            if missing(everything(self.registry), rig.mask()) {
                status = Status::Degraded;
            }
            let answer = witness.pilot.look(tick, rig.now(), rig.now()).then(|| {
                witness.pilot.fill(tick, rig.now(), &mut request);
                self.model.answer(&request, &mut chunk)
            });
            let action = witness.pilot.step(tick).action.and_then(axes);
            if let Some(action) = action {
                rig.act(tick, action, &mut witness);
            }
            rig.step(0.0, &mut witness)?;
            let skipped = take(answer, &mut witness.pilot, request.tick, &chunk, &mut failure);
            if let Some(recorder) = &mut witness.recorder {
                if let Some(skipped) = skipped {
                    let (devices, latency_ms) = (self.registry.devices.len(), STEP.as_secs_f64() * 1e3);
                    let what = request.answered(self.bundle, devices, latency_ms, Ok(skipped), &chunk);
                    recorder.event(&Event { stamp: rig.now(), what });
                }
                recorder.advance(rig.now());
            }
            tick += 1;
        }
        let report = witness.recorder.as_mut().and_then(|recorder| recorder.finish(rig.now()));
        let trial = rig.trial().lock();
        let (unplugged_at, plugged_at) = condition.windows(seed);
        let trial = Trial {
            seed,
            condition,
            triangular: trial.world.texture == Texture::Triangular,
            unplugged_at,
            plugged_at,
            outcome: trial.world.outcome(),
            status,
            steps: trial.world.steps(),
            counts: witness.pilot.queue.counts(),
            failure,
        };
        Ok((trial, report))
    }
}

/// Passes the answer to the pilot. Returns how many actions of a chunk came too late; `None` without a chunk.
fn take(
    answer: Option<Result<(), AnswerError>>,
    pilot: &mut Pilot,
    asked: u64,
    chunk: &[f32],
    failure: &mut Option<String>,
) -> Option<u64> {
    match answer? {
        Ok(()) => {
            let taken = pilot.queue.take(asked, chunk);
            if let Err(refused) = &taken {
                *failure = Some(refused.to_string());
            }
            // An unused chunk was computed nevertheless, and may have been the first with a picture.
            Some(taken.unwrap_or(0))
        }
        Err(error) => {
            pilot.queue.failed(asked);
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

/// Receivers of the rig's samples: the policy, and the recorder if there is one.
struct Spectator<'a> {
    pilot: Pilot,
    recorder: Option<&'a mut Stepped>,
}

impl Taker for Spectator<'_> {
    fn take(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8]) {
        if let Some(recorder) = &mut self.recorder {
            recorder.take(topic, header, payload);
        }
        self.pilot.take(topic, header, payload);
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
            assert!(out.is_some_and(|out| (30..75).contains(&out)) && back.is_none());
            let (Some(out), Some(back)) = Condition::HotReplug.windows(seed) else { panic!("none") };
            assert!((10..30).contains(&out) && (15..30).contains(&(back - out)), "{out} {back}");
        }
    }
}
