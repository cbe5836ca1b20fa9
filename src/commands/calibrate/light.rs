//! The light a camera looks at while its latency is measured: the terminal, or an LED of this machine.
//!
//! Invariant: terminal and LED are given back as they were found, however this ends.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use crate::calibration::Flip;
use crate::flash;
use crate::registry::scenario::SimDevice;
use crate::time::Stamp;
use crate::tui::flashlight::{self, Flashlight};

/// Where the kernel lists LEDs (Documentation/ABI/testing/sysfs-class-led).
const LEDS: &str = "/sys/class/leds";
/// A signal is noticed, and the line of text renewed, so often.
const LOOK: Duration = Duration::from_millis(50);

/// Why there is no light.
#[derive(Debug, thiserror::Error)]
pub enum LightError {
    /// It was not started on a terminal.
    #[error(
        "there is no terminal to flash: run it in one that the camera looks at, or name an LED of this machine with \
         --led"
    )]
    NoTerminal,
    /// The terminal cannot be taken, or went away.
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
        io::ErrorKind::NotFound => "--led takes a name that stands in /sys/class/leds, or such a folder",
        io::ErrorKind::PermissionDenied => "run it as a user who may write this file",
        _ => "name another LED",
    }
}

/// Which light there is to be.
#[derive(Debug, Clone)]
pub(super) enum Chosen {
    Terminal,
    Led(PathBuf),
}

impl Chosen {
    /// The terminal, or the LED of this name or folder.
    pub(super) fn of(led: Option<&Path>) -> Result<Self, LightError> {
        match led {
            // A name without a folder is joined, an absolute path stands for itself.
            Some(led) if led.components().count() == 1 => Ok(Self::Led(Path::new(LEDS).join(led))),
            Some(led) => Ok(Self::Led(led.to_owned())),
            None if flashlight::is_there() => Ok(Self::Terminal),
            None => Err(LightError::NoTerminal),
        }
    }

    pub(super) const fn name(&self) -> &'static str {
        match self {
            Self::Terminal => "terminal",
            Self::Led(_) => "led",
        }
    }
}

/// What the one who flashes and the one who looks tell each other.
#[derive(Debug, Default)]
pub(super) struct Shared {
    /// Ends the flashing early.
    pub(super) stop: CancellationToken,
    /// Mean brightness of the newest picture.
    pub(super) brightness: AtomicU8,
    /// The simulated camera in front of which the light stands too.
    pub(super) simulated: Option<Arc<SimDevice>>,
}

/// Plays the pattern of [`flash`] for `length`. Returns every change with the moment after it was
/// made; `None` if it was ended early.
///
/// Blocks: for a thread of its own.
pub(super) fn play(
    chosen: &Chosen,
    name: &str,
    length: Duration,
    shared: &Shared,
) -> Result<Option<Vec<Flip>>, LightError> {
    let mut light = Light::open(chosen)?;
    let begun = Stamp::now();
    let end = begun.after(length);
    let mut flips = Vec::new();
    for change in flash::changes().take_while(|change| change.after < length) {
        if wait(&mut light, begun.after(change.after), end, name, shared)? {
            return Ok(None);
        }
        light.switch(change.lit, &line(name, end, shared))?;
        let flip = Flip { at: Stamp::now(), lit: change.lit };
        if let Some(device) = &shared.simulated {
            device.light.switch(flip.at, flip.lit);
        }
        flips.push(flip);
    }
    Ok(if wait(&mut light, end, end, name, shared)? { None } else { Some(flips) })
}

/// Waits until `due`; true if the end was asked for before.
fn wait(light: &mut Light, due: Stamp, end: Stamp, name: &str, shared: &Shared) -> Result<bool, LightError> {
    loop {
        let left = due.since(Stamp::now());
        if left.is_zero() || shared.stop.is_cancelled() {
            return Ok(shared.stop.is_cancelled());
        }
        if light.is_ended_within(left.min(LOOK))? {
            return Ok(true);
        }
        // Drawing must not hold up a change.
        if left > 2 * LOOK {
            light.say(&line(name, end, shared))?;
        }
    }
}

fn line(name: &str, end: Stamp, shared: &Shared) -> String {
    let brightness = shared.brightness.load(Ordering::Relaxed);
    let left = end.since(Stamp::now()).as_secs() + 1;
    format!(" {name} looks at this screen and sees brightness {brightness:>3} of 255   {left} s left   ctrl-C ends")
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

    fn say(&mut self, line: &str) -> Result<(), LightError> {
        match self {
            Self::Terminal(terminal) => terminal.say(line).map_err(LightError::Terminal),
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
    /// Files and what stood in them.
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
        // All triggers stand there, the chosen one in brackets; dark switches it off.
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
            // What cannot be put back now could not be put back later.
            let _ = std::fs::write(file, text);
        }
    }
}
