//! `rapid calibrate latency`: flashes a light in front of a camera and measures the latency of its pictures.
//!
//! The camera is opened as a rig would open it. Light and pictures are on one clock, `CLOCK_MONOTONIC`;
//! `calibration` computes the estimate. The light is the terminal, or an LED of this machine.
//!
//! Invariant: terminal and LED are restored to their previous state, however this ends.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_devices::calibration::{self, Estimate, Flip, Seen, brightness};
use rapid_devices::driver::Driver;
use rapid_devices::flash;
use rapid_registry::device::{Attachment, DeviceNode};
use rapid_registry::simulation::SimDevice;
use rapid_registry::units::show_duration;
use rapid_registry::{Assigner, Assignment, DeviceSpec, NodeSpec, Registry};
use rapid_screens::tui::flashlight::{self, Flashlight};
use serde::Serialize;
use tokio::task::JoinHandle;
use tokio::time::{Instant, timeout, timeout_at};
use tokio_util::sync::CancellationToken;

use super::{Format, json_line};
use crate::app::signals::Signals;
use crate::cli::LatencyArgs;

/// A camera that has sent nothing for this long is considered silent.
const SILENCE: Duration = Duration::from_secs(5);
/// Pictures are read for this long after the last change: the longest latency that can be measured.
const LONGEST_LATENCY: Duration = Duration::from_secs(1);

/// A blocked terminal is abandoned after this long.
const RESTORE_TIMEOUT: Duration = Duration::from_secs(1);

/// Why nothing was measured.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// There is no such entry.
    #[error("--device {name}: no such entry; cameras are {}", listed(.cameras))]
    NoEntry {
        /// The requested name.
        name: String,
        /// The cameras of the registry.
        cameras: Vec<String>,
    },
    /// It is not a camera.
    #[error("[device.{0}] is not a camera, and only pictures can show a light")]
    NoCamera(String),
    /// It is not plugged in.
    #[error("[device.{0}] is not plugged in (`rapid devices` lists connected devices)")]
    NotPlugged(String),
    /// No camera is plugged in.
    #[error(
        "no camera of the registry is plugged in (`rapid devices` lists connected devices, and why they match no entry)"
    )]
    NothingPlugged,
    /// Several cameras match.
    #[error("several cameras are plugged in: name one of {} with --device", listed(.0))]
    Several(Vec<String>),
    /// There is no light.
    #[error(transparent)]
    Light(#[from] LightError),
    /// The camera cannot be opened or read, its pictures cannot be decoded, or they give no estimate.
    #[error("[device.{name}] {source}")]
    Camera {
        /// The entry.
        name: String,
        /// Why.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// It is open and sends nothing.
    #[error("[device.{0}] sends no picture")]
    Silent(String),
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
    /// Whether the arguments are at fault.
    pub const fn is_bad_argument(&self) -> bool {
        matches!(
            self,
            Self::NoEntry { .. } | Self::NoCamera(_) | Self::Several(_) | Self::Light(LightError::NoTerminal)
        )
    }
}

fn in_camera<E: Into<Box<dyn std::error::Error + Send + Sync>>>(name: &str) -> impl FnOnce(E) -> CalibrateError {
    let name = name.to_owned();
    move |source| CalibrateError::Camera { name, source: source.into() }
}

fn listed(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}

/// Measures, and writes the result.
///
/// # Errors
/// When there is no such camera or no light, or the pictures do not follow it.
pub async fn latency(
    registry: &Registry,
    attached: &[Attachment],
    args: &LatencyArgs,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), CalibrateError> {
    let (spec, node) = choose(registry, attached, args.device.as_deref())?;
    let light = Chosen::from_option(args.led.as_deref())?;
    if let (Chosen::Led(led), Format::Text) = (&light, format) {
        let length = show_duration(args.duration);
        writeln!(out, "Flashing {} for {length}; ctrl-C ends.", text::plain(&led.to_string_lossy()))?;
    }
    let (flips, seen) = observe(spec, node, &light, args.duration).await?;
    let estimate = calibration::estimate(&flips, &seen).map_err(in_camera(&spec.name))?;
    let result = Measured::new(spec, &light, args.light_delay, estimate);
    match format {
        Format::Json => writeln!(out, "{}", json_line("calibrated", &result)?)?,
        Format::Text => result.print(registry, spec, out)?,
    }
    Ok(())
}

/// The camera to measure.
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

/// Flashes in front of the camera; returns the changes of the light and the brightness of the pictures.
async fn observe(
    spec: &DeviceSpec,
    node: &DeviceNode,
    light: &Chosen,
    length: Duration,
) -> Result<(Vec<Flip>, Vec<Seen>), CalibrateError> {
    let mut signals = Signals::listen()?;
    let simulated = if let DeviceNode::Sim(device) = node { Some(Arc::clone(device)) } else { None };
    if let Some(device) = &simulated {
        device.light.install();
    }
    let mut camera = tokio::select! {
        () = signals.next() => return Err(CalibrateError::Interrupted),
        camera = Camera::open(spec, node) => camera?,
    };
    let shared = Arc::new(Shared { simulated, ..Shared::default() });
    // However this ends, the light is restored.
    let _stop = shared.stop.clone().drop_guard();
    let mut playing = {
        let (light, name, shared) = (light.clone(), spec.name.clone(), Arc::clone(&shared));
        tokio::task::spawn_blocking(move || play(&light, &name, length, &shared))
    };
    let mut seen = Vec::new();
    let mut played = None;
    let mut until = None;
    loop {
        tokio::select! {
            biased;
            () = signals.next() => return Err(after_restoring(&shared, playing, CalibrateError::Interrupted).await),
            done = &mut playing, if played.is_none() => {
                played = Some(done.map_err(|_| CalibrateError::Panicked)??.ok_or(CalibrateError::Interrupted)?);
                until = Some(Instant::now() + LONGEST_LATENCY);
            }
            picture = camera.next(until) => match picture {
                Ok(Some(picture)) => {
                    shared.brightness.store(whole(picture.brightness), Ordering::Relaxed);
                    seen.push(picture);
                }
                Ok(None) => return Ok((played.unwrap_or_default(), seen)),
                Err(error) => return Err(after_restoring(&shared, playing, error).await),
            },
        }
    }
}

/// `error`, once the light is restored: before, nothing could be read on the terminal.
async fn after_restoring<T>(shared: &Shared, playing: JoinHandle<T>, error: CalibrateError) -> CalibrateError {
    shared.stop.cancel();
    if !playing.is_finished() {
        // A panic there is not reported: `error` is.
        let _ = timeout(RESTORE_TIMEOUT, playing).await;
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
        let driver = Driver::open(spec, node).await.map_err(in_camera(&name))?;
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
                timeout(SILENCE, self.driver.read()).await.map_err(|_| CalibrateError::Silent(self.name.clone()))?
            }
        };
        let reading = reading.map_err(in_camera(&self.name))?;
        let brightness = brightness(reading.encoding, reading.bytes).map_err(in_camera(&self.name))?;
        Ok(Some(Seen { at: reading.captured, brightness }))
    }
}

/// The result, also as JSON.
#[derive(Debug, Serialize)]
struct Measured {
    device: String,
    #[serde(flatten)]
    estimate: Estimate,
    light: &'static str,
    /// Declared latency of the light, subtracted from the result.
    light_delay_ms: f64,
    /// The value for the entry.
    latency: String,
}

impl Measured {
    fn new(spec: &DeviceSpec, light: &Chosen, delay: Duration, mut estimate: Estimate) -> Self {
        let light_delay_ms = delay.as_secs_f64() * 1e3;
        estimate.latency_ms -= light_delay_ms;
        // The registry accepts no negative latency.
        let latency = format!("{:.0}ms", estimate.latency_ms.max(0.0).round());
        Self {
            device: spec.name.clone(),
            estimate,
            light: if matches!(light, Chosen::Led(_)) { "led" } else { "terminal" },
            light_delay_ms,
            latency,
        }
    }

    fn print(&self, registry: &Registry, spec: &DeviceSpec, out: &mut dyn Write) -> io::Result<()> {
        let Estimate { latency_ms, uncertainty_ms, correlation, contrast, pictures, flips } = self.estimate;
        writeln!(out, "{}: latency {latency_ms:.1} ms ± {uncertainty_ms:.1} ms (95 %)", self.device)?;
        writeln!(out, "  {pictures} pictures, {flips} changes of the light")?;
        writeln!(out, "  correlation {correlation:.2}, contrast {contrast:.0} of 255")?;
        let delay = self.light_delay_ms;
        let included = match self.light {
            _ if delay > 0.0 => format!("{delay:.1} ms of the light itself (--light-delay) are subtracted."),
            "led" => "It includes the latency of the LED: below 1 ms on a board, a few ms over USB.".to_owned(),
            _ => "It includes the latency of the terminal and its screen, often 10 to 40 ms. Give it\n  with --light-delay if you \
                  know it, or avoid it with --led."
                .to_owned(),
        };
        writeln!(out, "  {included}")?;
        if latency_ms < -uncertainty_ms {
            writeln!(
                out,
                "  Below zero: --light-delay is too long, or the pictures are stamped before they\n  are captured. The \
                 registry accepts no negative latency."
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

/// Where the kernel lists LEDs (Documentation/ABI/testing/sysfs-class-led).
const LEDS: &str = "/sys/class/leds";
/// Interval at which a stop is checked for and the line of text updated.
const POLL: Duration = Duration::from_millis(50);

/// Why there is no light.
#[derive(Debug, thiserror::Error)]
pub enum LightError {
    /// There is no terminal.
    #[error(
        "there is no terminal to flash: run it in one in front of the camera, or name an LED of this machine with --led"
    )]
    NoTerminal,
    /// The terminal cannot be used, or was closed.
    #[error("the terminal: {0}")]
    Terminal(#[source] io::Error),
    /// The LED cannot be switched.
    #[error("{}: {source}: {}", .file.display(), led_fix(.source))]
    Led {
        /// Its file.
        file: PathBuf,
        /// Why.
        source: io::Error,
    },
}

fn led_fix(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::NotFound => "--led takes a name in /sys/class/leds, or the path of such a folder",
        io::ErrorKind::PermissionDenied => "run it as a user with permission to write this file",
        _ => "name another LED",
    }
}

/// Which light is used.
#[derive(Debug, Clone)]
enum Chosen {
    Terminal,
    Led(PathBuf),
}

impl Chosen {
    /// The terminal, or the LED of this name or folder.
    fn from_option(led: Option<&Path>) -> Result<Self, LightError> {
        match led {
            // A single name is an LED of the kernel's list, anything else a path.
            Some(led) if led.components().count() == 1 => Ok(Self::Led(Path::new(LEDS).join(led))),
            Some(led) => Ok(Self::Led(led.to_owned())),
            None if flashlight::is_available() => Ok(Self::Terminal),
            None => Err(LightError::NoTerminal),
        }
    }
}

/// State shared by the thread that flashes and the task that reads the camera.
#[derive(Debug, Default)]
struct Shared {
    /// Ends the flashing early.
    stop: CancellationToken,
    /// Mean brightness of the newest picture.
    brightness: AtomicU8,
    /// The simulated camera, which the light also illuminates.
    simulated: Option<Arc<SimDevice>>,
}

/// Plays the pattern of [`flash`] for `length`. Returns every change with the time right after it; `None` if
/// it was ended early.
///
/// Blocks: run it on its own thread.
fn play(chosen: &Chosen, name: &str, length: Duration, shared: &Shared) -> Result<Option<Vec<Flip>>, LightError> {
    let mut light = Light::open(chosen)?;
    let begun = Stamp::now();
    let end = begun.after(length);
    let mut flips = Vec::new();
    for change in flash::changes().take_while(|change| change.after < length) {
        if wait(&mut light, begun.after(change.after), end, name, shared)? {
            return Ok(None);
        }
        light.switch(change.lit, &line(name, end, shared))?;
        let at = shared.simulated.as_ref().map_or_else(Stamp::now, |device| device.light.switch(change.lit));
        flips.push(Flip { at, lit: change.lit });
    }
    Ok(if wait(&mut light, end, end, name, shared)? { None } else { Some(flips) })
}

/// Waits until `due`; true if it was ended before.
fn wait(light: &mut Light, due: Stamp, end: Stamp, name: &str, shared: &Shared) -> Result<bool, LightError> {
    loop {
        let left = due.since(Stamp::now());
        if left.is_zero() || shared.stop.is_cancelled() {
            return Ok(shared.stop.is_cancelled());
        }
        if light.is_ended_within(left.min(POLL))? {
            return Ok(true);
        }
        // Drawing must not delay a change.
        if left > 2 * POLL {
            light.caption(&line(name, end, shared))?;
        }
    }
}

fn line(name: &str, end: Stamp, shared: &Shared) -> String {
    let brightness = shared.brightness.load(Ordering::Relaxed);
    let left = end.since(Stamp::now()).as_secs() + 1;
    format!(" {name} is watching this screen: brightness {brightness:>3} of 255   {left} s left   ctrl-C ends")
}

enum Light {
    Terminal(Flashlight),
    Led(Led),
}

impl Light {
    fn open(chosen: &Chosen) -> Result<Self, LightError> {
        match chosen {
            Chosen::Terminal => Ok(Self::Terminal(Flashlight::open().map_err(LightError::Terminal)?)),
            Chosen::Led(folder) => Ok(Self::Led(Led::open(folder)?)),
        }
    }

    fn switch(&mut self, lit: bool, line: &str) -> Result<(), LightError> {
        match self {
            Self::Terminal(terminal) => terminal.switch(lit, line).map_err(LightError::Terminal),
            Self::Led(led) => led.switch(lit),
        }
    }

    fn caption(&mut self, line: &str) -> Result<(), LightError> {
        match self {
            Self::Terminal(terminal) => terminal.caption(line).map_err(LightError::Terminal),
            Self::Led(_) => Ok(()),
        }
    }

    fn is_ended_within(&mut self, wait: Duration) -> Result<bool, LightError> {
        match self {
            Self::Terminal(terminal) => terminal.is_ended_within(wait).map_err(LightError::Terminal),
            Self::Led(_) => {
                std::thread::sleep(wait);
                Ok(false)
            }
        }
    }
}

/// An LED of the kernel.
struct Led {
    brightness: PathBuf,
    lit: String,
    /// Files and their previous contents.
    before: Vec<(PathBuf, String)>,
}

impl Led {
    fn open(folder: &Path) -> Result<Self, LightError> {
        let brightness = folder.join("brightness");
        let read = |file: &Path| std::fs::read_to_string(file).map(|text| text.trim().to_owned());
        let failed = |file: &Path| {
            let file = file.to_owned();
            move |source| LightError::Led { file, source }
        };
        let mut before = vec![(brightness.clone(), read(&brightness).map_err(failed(&brightness))?)];
        let trigger = folder.join("trigger");
        // The file lists all triggers, the active one in brackets; writing brightness 0 deactivates it.
        let chosen = read(&trigger).ok().and_then(|all| Some(all.split_once('[')?.1.split_once(']')?.0.to_owned()));
        before.extend(chosen.filter(|chosen| chosen != "none").map(|chosen| (trigger, chosen)));
        let lit = read(&folder.join("max_brightness")).unwrap_or_else(|_| "1".to_owned());
        let mut led = Self { brightness, lit, before };
        led.switch(false)?;
        Ok(led)
    }

    fn switch(&mut self, lit: bool) -> Result<(), LightError> {
        std::fs::write(&self.brightness, if lit { &self.lit } else { "0" })
            .map_err(|source| LightError::Led { file: self.brightness.clone(), source })
    }
}

impl Drop for Led {
    fn drop(&mut self) {
        for (file, text) in &self.before {
            // There is no later opportunity to restore it.
            let _ = std::fs::write(file, text);
        }
    }
}

#[cfg(test)]
mod tests;
