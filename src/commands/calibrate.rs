//! `rapid calibrate latency`: flashes a light in front of a camera and measures how late its pictures
//! show it.
//!
//! The camera is opened as a rig would open it. Light and pictures are on one clock,
//! `CLOCK_MONOTONIC`; what is made of them is `calibration`'s.

mod light;

use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use serde::Serialize;
use tokio::task::JoinHandle;
use tokio::time::{Instant, timeout, timeout_at};

use self::light::{Chosen, Shared};
use super::Format;
use crate::app::signals::Signals;
use crate::calibration::{self, BrightnessError, Estimate, Flip, Refusal, Seen, brightness};
use crate::driver::{Driver, DriverError};
use crate::registry::{Assigner, Assignment, Attachment, DeviceNode, DeviceSpec, NodeSpec, Registry};
use crate::text;

pub use self::light::LightError;

/// A camera that has sent nothing for so long sends nothing.
const PATIENCE: Duration = Duration::from_secs(5);
/// Pictures are looked at for so long after the last change: the longest latency there can be.
const AFTERWARDS: Duration = Duration::from_secs(1);

/// A terminal that takes nothing is left after so long.
const GIVEN_BACK: Duration = Duration::from_secs(1);

/// What to measure, and how.
#[derive(Debug, Clone)]
pub struct LatencyOptions {
    /// The entry; the only camera that is plugged in, if none is named.
    pub device: Option<String>,
    /// How long to flash.
    pub duration: Duration,
    /// An LED instead of the terminal: its name or its folder.
    pub led: Option<PathBuf>,
    /// How late the light itself is, if that is known.
    pub light_delay: Duration,
}

/// Why nothing was measured.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// There is no such entry.
    #[error("--device {name}: no such entry; cameras are {}", listed(.cameras))]
    NoEntry {
        /// What was asked for.
        name: String,
        /// The cameras of the registry.
        cameras: Vec<String>,
    },
    /// It is no camera.
    #[error("[device.{0}] is no camera, and only pictures can show a light")]
    NoCamera(String),
    /// It is not there.
    #[error("[device.{0}] is not plugged in (`rapid devices` lists what is)")]
    NotPlugged(String),
    /// None is there.
    #[error("no camera of the registry is plugged in (`rapid devices` lists what is, and why it is no entry)")]
    NothingPlugged,
    /// It must be said which.
    #[error("several cameras are plugged in: name one of {} with --device", listed(.0))]
    Several(Vec<String>),
    /// There is no light.
    #[error(transparent)]
    Light(#[from] LightError),
    /// The camera cannot be opened or read.
    #[error("[device.{name}] {source}")]
    Camera {
        /// The entry.
        name: String,
        /// Why.
        source: DriverError,
    },
    /// It is open and sends nothing.
    #[error("[device.{0}] sends no picture")]
    Silent(String),
    /// Its pictures cannot be looked at.
    #[error("[device.{name}] {source}")]
    Picture {
        /// The entry.
        name: String,
        /// Why.
        source: BrightnessError,
    },
    /// The pictures do not tell.
    #[error("[device.{name}] {source}")]
    Refused {
        /// The entry.
        name: String,
        /// Why.
        source: Refusal,
    },
    /// The user ended it.
    #[error("interrupted: nothing was measured")]
    Interrupted,
    /// The thread that flashes panicked.
    #[error("the light panicked; please report this")]
    Panicked,
    /// Signals, threads or the output.
    #[error("{0}")]
    Io(#[from] io::Error),
}

impl CalibrateError {
    /// Was it asked for something that cannot be?
    #[must_use]
    pub const fn is_bad_argument(&self) -> bool {
        matches!(
            self,
            Self::NoEntry { .. } | Self::NoCamera(_) | Self::Several(_) | Self::Light(LightError::NoTerminal)
        )
    }
}

fn listed(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}

/// Measures, and writes what came out.
///
/// # Errors
/// When there is no such camera or no light, or the pictures do not follow it.
pub async fn latency(
    registry: &Registry,
    attached: &[Attachment],
    options: &LatencyOptions,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), CalibrateError> {
    let (spec, node) = choose(registry, attached, options.device.as_deref())?;
    let light = Chosen::of(options.led.as_deref())?;
    if let (Chosen::Led(led), Format::Text) = (&light, format) {
        let length = humantime::format_duration(options.duration);
        writeln!(out, "Flashing {} for {length}; ctrl-C ends.", text::plain(&led.to_string_lossy()))?;
    }
    let (flips, seen) = look(spec, node, &light, options.duration).await?;
    let refused = |source| CalibrateError::Refused { name: spec.name.clone(), source };
    let estimate = calibration::estimate(&flips, &seen).map_err(refused)?;
    let result = Measured::new(spec, &light, options.light_delay, estimate);
    match format {
        Format::Json => writeln!(out, "{}", text::json(&result).map_err(io::Error::other)?)?,
        Format::Text => result.print(registry, spec, out)?,
    }
    Ok(())
}

/// The camera that is meant.
fn choose<'a>(
    registry: &'a Registry,
    attached: &'a [Attachment],
    wanted: Option<&str>,
) -> Result<(&'a DeviceSpec, &'a DeviceNode), CalibrateError> {
    let is_camera = |spec: &DeviceSpec| matches!(spec.node, NodeSpec::Camera(_));
    if let Some(name) = wanted {
        let cameras = registry.devices.iter().filter(|spec| is_camera(spec)).map(|spec| spec.name.clone());
        match registry.named(name) {
            None => return Err(CalibrateError::NoEntry { name: name.to_owned(), cameras: cameras.collect() }),
            Some(spec) if !is_camera(spec) => return Err(CalibrateError::NoCamera(name.to_owned())),
            Some(_) => {}
        }
    }
    let mut assigner = Assigner::new(registry);
    let plugged = attached.iter().filter_map(|attachment| match assigner.attach(attachment) {
        Assignment::Entry(id) => Some((registry.device(id)?, &attachment.node)),
        _ => None,
    });
    let meant: Vec<_> =
        plugged.filter(|(spec, _)| is_camera(spec) && wanted.is_none_or(|name| spec.name == name)).collect();
    match (meant.as_slice(), wanted) {
        ([one], _) => Ok(*one),
        ([], Some(name)) => Err(CalibrateError::NotPlugged(name.to_owned())),
        ([], None) => Err(CalibrateError::NothingPlugged),
        (several, _) => Err(CalibrateError::Several(several.iter().map(|(spec, _)| spec.name.clone()).collect())),
    }
}

/// Flashes in front of the camera: how the light changed, and what the pictures showed.
async fn look(
    spec: &DeviceSpec,
    node: &DeviceNode,
    light: &Chosen,
    length: Duration,
) -> Result<(Vec<Flip>, Vec<Seen>), CalibrateError> {
    let mut signals = Signals::listen()?;
    let simulated = if let DeviceNode::Sim(device) = node { Some(Arc::clone(device)) } else { None };
    if let Some(device) = &simulated {
        device.light.switch(device.begun, false);
    }
    let mut camera = tokio::select! {
        () = signals.next() => return Err(CalibrateError::Interrupted),
        camera = Camera::open(spec, node) => camera?,
    };
    let shared = Arc::new(Shared { simulated, ..Shared::default() });
    // However this ends, the light goes back to what it was.
    let _stop = shared.stop.clone().drop_guard();
    let mut playing = {
        let (light, name, shared) = (light.clone(), spec.name.clone(), Arc::clone(&shared));
        tokio::task::spawn_blocking(move || light::play(&light, &name, length, &shared))
    };
    let mut seen = Vec::new();
    let mut played = None;
    let mut until = None;
    loop {
        tokio::select! {
            biased;
            () = signals.next() => return Err(ended(&shared, playing, CalibrateError::Interrupted).await),
            done = &mut playing, if played.is_none() => {
                played = Some(done.map_err(|_| CalibrateError::Panicked)??.ok_or(CalibrateError::Interrupted)?);
                until = Some(Instant::now() + AFTERWARDS);
            }
            picture = camera.next(until) => match picture {
                Ok(Some(picture)) => {
                    shared.brightness.store(whole(picture.brightness), Ordering::Relaxed);
                    seen.push(picture);
                }
                Ok(None) => return Ok((played.unwrap_or_default(), seen)),
                Err(error) => return Err(ended(&shared, playing, error).await),
            },
        }
    }
}

/// `error`, once the light is given back: before, nothing could be read on the terminal.
async fn ended<T>(shared: &Shared, playing: JoinHandle<T>, error: CalibrateError) -> CalibrateError {
    shared.stop.cancel();
    if !playing.is_finished() {
        // A panic there changes nothing here.
        let _ = timeout(GIVEN_BACK, playing).await;
    }
    error
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to what a u8 holds")]
fn whole(brightness: f64) -> u8 {
    brightness.round().clamp(0.0, 255.0) as u8
}

/// A camera that has sent a picture.
struct Camera {
    name: String,
    driver: Driver,
}

impl Camera {
    async fn open(spec: &DeviceSpec, node: &DeviceNode) -> Result<Self, CalibrateError> {
        let name = spec.name.clone();
        let driver =
            Driver::open(spec, node).await.map_err(|source| CalibrateError::Camera { name: name.clone(), source })?;
        let mut camera = Self { name, driver };
        camera.next(None).await?;
        Ok(camera)
    }

    /// The next picture; `None` at the time `until`.
    async fn next(&mut self, until: Option<Instant>) -> Result<Option<Seen>, CalibrateError> {
        let reading = match until {
            Some(until) => match timeout_at(until, self.driver.read()).await {
                Ok(reading) => reading,
                Err(_) => return Ok(None),
            },
            None => {
                timeout(PATIENCE, self.driver.read()).await.map_err(|_| CalibrateError::Silent(self.name.clone()))?
            }
        };
        let reading = reading.map_err(|source| CalibrateError::Camera { name: self.name.clone(), source })?;
        let brightness = brightness(reading.encoding, reading.bytes)
            .map_err(|source| CalibrateError::Picture { name: self.name.clone(), source })?;
        Ok(Some(Seen { at: reading.captured, brightness }))
    }
}

/// What was measured, also as JSON.
#[derive(Debug, Serialize)]
struct Measured {
    device: String,
    #[serde(flatten)]
    estimate: Estimate,
    /// What flashed.
    light: &'static str,
    /// How late the light was said to be; taken off.
    light_delay_ms: f64,
    /// What to write into the entry.
    latency: String,
}

impl Measured {
    fn new(spec: &DeviceSpec, light: &Chosen, delay: Duration, mut estimate: Estimate) -> Self {
        let light_delay_ms = delay.as_secs_f64() * 1e3;
        estimate.latency_ms -= light_delay_ms;
        // The registry takes none below zero.
        let latency = format!("{:.0}ms", estimate.latency_ms.max(0.0).round());
        Self { device: spec.name.clone(), estimate, light: light.name(), light_delay_ms, latency }
    }

    fn print(&self, registry: &Registry, spec: &DeviceSpec, out: &mut dyn Write) -> io::Result<()> {
        let Estimate { latency_ms, uncertainty_ms, correlation, contrast, pictures, flips } = self.estimate;
        writeln!(out, "{}: latency {latency_ms:.1} ms ± {uncertainty_ms:.1} ms (95 %)", self.device)?;
        writeln!(out, "  {pictures} pictures, {flips} changes of the light")?;
        writeln!(out, "  correlation {correlation:.2}, contrast {contrast:.0} of 255")?;
        let delay = self.light_delay_ms;
        let included = match self.light {
            _ if delay > 0.0 => format!("{delay:.1} ms of the light itself (--light-delay) are taken off."),
            "led" => "It includes what the LED takes to light: below 1 ms on a board, a few ms over USB.".to_owned(),
            _ => "It includes what the terminal and its screen take to show a change, often 10\n  to 40 ms. Give that \
                  with --light-delay if you know it; with --led it is not there."
                .to_owned(),
        };
        writeln!(out, "  {included}")?;
        if latency_ms < -uncertainty_ms {
            writeln!(
                out,
                "  Below zero: --light-delay is too long, or the pictures are stamped before they\n  are taken. The \
                 registry takes nothing below zero."
            )?;
        }
        let file = registry.path.as_ref().map_or("devices.toml".to_owned(), |path| path.display().to_string());
        let now = match spec.latency {
            Duration::ZERO => String::new(),
            now => format!("  # instead of {}ms", now.as_secs_f64() * 1e3),
        };
        writeln!(out, "\nIn {}, under [device.{}]:\n", text::plain(&file), self.device)?;
        writeln!(out, "    latency = \"{}\"{now}", self.latency)
    }
}

#[cfg(test)]
mod tests;
