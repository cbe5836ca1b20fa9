//! A scenario as data, and its outcome.
//!
//! Devices, a registry and a timeline become a guest script; after the boot the outcome contains the output of the
//! emulator, `rapid` and the kernel, and the recorded files.
//!
//! Invariant: the timeline's clock starts when `rapid` records and all of `streaming` stream, not after a fixed delay.
//! Invariant: an outcome dropped by a failing assertion prints the logs and keeps its folder.

use std::fmt::Write as _;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::emu::spec::DeviceSpec;
use crate::entries::without_limits_of_time;
use crate::guest::{GuestError, Image, Init};
use crate::outcome::Outcome;
use crate::programs::{self, ProgramError};

const WORDS: &str = include_str!("../guest/bench.sh");
/// A script that has not ended by then hangs. Those that take minutes on an idle machine have taken more than ten on a busy
/// one.
const WATCHDOG: Duration = Duration::from_mins(30);
/// The longest that a guest in virtual time may take of the host's time. Those of `make test` take 3 to 30 s of a processor, and on a
/// machine whose processors have ten other programs each, without a priority, ten times as long.
const WALL: Duration = Duration::from_mins(15);
/// Time limit per condition, s.
const READY_WITHIN_S: u32 = 60;

/// Why a scenario gave no outcome.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The guest could not be run.
    #[error(transparent)]
    Guest(#[from] GuestError),
    /// A program is missing.
    #[error(transparent)]
    Program(#[from] ProgramError),
    /// The share could not be prepared.
    #[error("{0}: {1}")]
    Share(PathBuf, #[source] std::io::Error),
}

/// A scenario to be played in the guest.
#[derive(Clone, Debug)]
pub struct Scenario {
    name: String,
    devices: Vec<(DeviceSpec, bool)>,
    registry: String,
    files: Vec<(String, Vec<u8>)>,
    play: Play,
    timeline: Vec<Step>,
    until: Vec<String>,
    watch_mask: bool,
    examples: Vec<&'static str>,
    systemd: bool,
    emulated: bool,
    limit: Duration,
    wall: Duration,
}

#[derive(Clone, Debug)]
enum Step {
    /// A command of the emulator, ms after the start of the timeline or the last condition.
    At(u64, String),
    /// The timeline waits for a condition, and its clock starts again.
    When(String),
}

#[derive(Clone, Debug)]
enum Play {
    /// The words of `guest/bench.sh`, without `rapid`.
    Script(String),
    /// `rapid` records.
    Record { seconds: u32, streaming: Vec<String> },
}

impl Scenario {
    /// An empty scenario. Its name becomes part of the folder's name.
    pub fn new(name: &str) -> Self {
        Self {
            name: name.into(),
            devices: Vec::new(),
            registry: String::new(),
            files: Vec::new(),
            play: Play::Script(String::new()),
            timeline: Vec::new(),
            until: Vec::new(),
            watch_mask: false,
            examples: Vec::new(),
            systemd: false,
            emulated: false,
            limit: WATCHDOG,
            wall: WALL,
        }
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Adds a device that is plugged from the start. Devices are numbered in the order they are added.
    #[must_use]
    pub fn device(mut self, spec: DeviceSpec) -> Self {
        self.devices.push((spec, true));
        self
    }

    /// Adds a device that only the timeline plugs in.
    #[must_use]
    pub fn spare(mut self, spec: DeviceSpec) -> Self {
        self.devices.push((spec, false));
        self
    }

    /// The text of `devices.toml`.
    #[must_use]
    pub fn registry(mut self, toml: &str) -> Self {
        self.registry = toml.into();
        self
    }

    /// Runs this script (bash with the functions of `guest/bench.sh`). Devices are defined but not plugged in. With a
    /// registry, `"${rapid[@]}"` is available.
    #[must_use]
    pub fn script(mut self, script: &str) -> Self {
        self.play = Play::Script(script.into());
        self
    }

    /// Makes `rapid` record; the timeline starts when these registry entries stream, and the recording ends `seconds`
    /// after that or the last [`Scenario::when`], or once all conditions of [`Scenario::until`] are met, if that is later.
    #[must_use]
    pub fn record(mut self, seconds: u32, streaming: &[&str]) -> Self {
        self.play = Play::Record { seconds, streaming: streaming.iter().map(ToString::to_string).collect() };
        self
    }

    /// Sends the emulator a command at this time of the timeline. Times must not decrease.
    #[must_use]
    pub fn at(mut self, ms: u64, command: &str) -> Self {
        self.timeline.push(Step::At(ms, command.into()));
        self
    }

    /// The timeline waits until this condition, in the functions of `guest/bench.sh`, is met; what follows is timed from then on.
    #[must_use]
    pub fn when(mut self, condition: &str) -> Self {
        self.timeline.push(Step::When(condition.into()));
        self
    }

    /// The recording does not end before this condition, in the functions of `guest/bench.sh`, is met.
    #[must_use]
    pub fn until(mut self, condition: &str) -> Self {
        self.until.push(condition.into());
        self
    }

    /// Samples the mask in shared memory as well, into `mask.jsonl`.
    #[must_use]
    pub fn watch_mask(mut self) -> Self {
        self.watch_mask = true;
        self
    }

    /// Puts this example beside `devices.toml`.
    #[must_use]
    pub fn example(mut self, name: &'static str) -> Self {
        self.examples.push(name);
        self
    }

    /// Boots with systemd as PID 1; the script runs as a service, after `multi-user.target`.
    #[must_use]
    pub fn systemd(mut self) -> Self {
        self.systemd = true;
        self
    }

    /// Runs on the emulated machine, whose time is the host's: for figures.
    #[must_use]
    pub fn emulated(mut self) -> Self {
        self.emulated = true;
        self
    }

    /// Puts a file beside `devices.toml`, in `/tmp/bench`; the name may have folders.
    #[must_use]
    pub fn file(mut self, name: &str, contents: impl Into<Vec<u8>>) -> Self {
        self.files.push((name.into(), contents.into()));
        self
    }

    /// The least time that the guest's script has, for one that runs for longer than `WATCHDOG`.
    #[must_use]
    pub fn limit(mut self, limit: Duration) -> Self {
        self.limit = self.limit.max(limit);
        self
    }

    /// The longest that a guest in virtual time may take of the host's time, instead of a quarter of an hour.
    #[must_use]
    pub fn wall(mut self, wall: Duration) -> Self {
        self.wall = wall;
        self
    }

    /// Boots a guest and plays the scenario.
    pub fn run(self) -> Result<Outcome, ScenarioError> {
        let image = if self.emulated { Image::emulated()? } else { Image::locate()? };
        let usbemu = programs::usbemu()?;
        let rapid = match self.play {
            Play::Script(_) if self.registry.is_empty() => None,
            Play::Script(_) | Play::Record { .. } => Some(programs::rapid()?),
        };
        let share = fresh_folder(&self.name)?;
        let inside = share.join("in");
        let install = |program: &Path| programs::install(program, &inside, &image);
        let usbemu = install(&usbemu)?;
        let rapid = rapid.as_deref().map(install).transpose()?.unwrap_or_default();
        let write = |name: &str, contents: &[u8]| {
            let path = inside.join(name);
            let written = fs::create_dir_all(path.parent().unwrap_or(&path)).and_then(|()| fs::write(&path, contents));
            written.map_err(|error| ScenarioError::Share(path, error))
        };
        for name in &self.examples {
            let words = install(&programs::example(name)?)?;
            // It may have to be run through a loader; a registry names one file.
            write(name, format!("#!/bin/sh\nexec {} \"$@\"\n", self::words(&words)).as_bytes())?;
            let path = inside.join(name);
            fs::set_permissions(&path, PermissionsExt::from_mode(0o755))
                .map_err(|error| ScenarioError::Share(path, error))?;
        }
        write("bench.sh", WORDS.as_bytes())?;
        write("devices.toml", self.registry_on(image.is_virtual()).as_bytes())?;
        self.files.iter().try_for_each(|(name, contents)| write(name, contents))?;
        write("run.sh", self.guest_script(&usbemu, &rapid).as_bytes())?;
        let init = if self.systemd { Init::Systemd } else { Init::Script };
        let boot = image
            .run(&share, init, self.limit, self.wall)
            .inspect_err(|_| eprintln!("vbench: the share is kept in {}", share.display()))?;
        Ok(Outcome::collect(self.name, share, boot))
    }

    /// The registry, on a machine that is in time for everything or on one that may not be: there no episode is judged by it.
    fn registry_on(&self, is_virtual: bool) -> String {
        let is_judged = is_virtual || self.registry.is_empty() || self.registry.contains("[verdict]");
        if is_judged { self.registry.clone() } else { format!("{}\n{}", self.registry, without_limits_of_time()) }
    }

    /// The script the guest runs.
    fn guest_script(&self, usbemu: &[String], rapid: &[String]) -> String {
        let mut script = format!("usbemu=({})\nrapid=({})\n. ./bench.sh\n", words(usbemu), words(rapid));
        let specs: Vec<String> = self.devices.iter().map(|(spec, _)| spec.to_string()).collect();
        let mut line = |text: String| {
            script.push_str(&text);
            script.push('\n');
        };
        line(format!("emu_start {}", words(&specs)));
        match &self.play {
            Play::Script(text) => line(text.clone()),
            Play::Record { seconds, streaming } => {
                for (index, port) in self.plugged() {
                    line(format!(
                        "emu plug {index}; wait_for {READY_WITHIN_S} attached {port} || fail 'device {index} did not attach'"
                    ));
                }
                line("udevadm settle".into());
                if self.watch_mask {
                    line("\"${usbemu[@]}\" --watch-mask >$out/mask.jsonl & watch_pid=$!".into());
                }
                line("rapid_start --headless --record --out $out/rec --config /tmp/bench/devices.toml --json".into());
                line(format!("await_rapid {READY_WITHIN_S} '\"event\":\"recording\"' || fail 'not recording'"));
                for device in streaming {
                    line(format!(
                        "await_rapid {READY_WITHIN_S} '\"event\":\"state\"' '\"device\":\"{device}\"' '\"state\":\"streaming\"' \
                         || fail '{device} does not stream'"
                    ));
                }
                line("emu t0".into());
                let done = format!("emu_done {}", seconds + READY_WITHIN_S);
                let wait = |condition: &str| {
                    let why = words(&[format!("never met: {condition}")]);
                    format!("wait_for {READY_WITHIN_S} {condition} || fail {why}")
                };
                for step in &self.timeline {
                    line(match step {
                        Step::At(ms, command) => format!("emu at {ms} {command}"),
                        Step::When(condition) => format!("{done}\n{}\nemu t0", wait(condition)),
                    });
                }
                line(format!("emu at {}", u64::from(*seconds) * 1_000));
                // The emulator runs for as long as the timeline.
                line(done);
                self.until.iter().for_each(|condition| line(wait(condition)));
                // Also records some samples of devices that returned at the last moment.
                line("sleep 1\nrapid_stop\nemu_quit".into());
                if self.watch_mask {
                    line("kill $watch_pid".into());
                }
                line("exit 0".into());
            }
        }
        script
    }

    /// Devices plugged from the start, with their ports.
    fn plugged(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let all = self.devices.iter().enumerate().filter(|(_, (_, plugged))| *plugged);
        all.map(|(index, (spec, _))| (index, spec.port.map_or(index, usize::from)))
    }
}

fn words(all: &[String]) -> String {
    let mut quoted = String::new();
    for word in all {
        let _infallible = write!(quoted, "'{}' ", word.replace('\'', r"'\''"));
    }
    quoted
}

fn fresh_folder(name: &str) -> Result<PathBuf, ScenarioError> {
    let base = std::env::temp_dir();
    let path = (0..)
        .map(|number| base.join(format!("vbench-{name}-{}-{number}", std::process::id())))
        .find(|path: &PathBuf| !Path::exists(path))
        .expect("one of endless names is free");
    // The guest's ordinary users run programs from it.
    let open = |path: &Path| {
        fs::create_dir_all(path).and_then(|()| fs::set_permissions(path, PermissionsExt::from_mode(0o755)))
    };
    for folder in [path.clone(), path.join("in"), path.join("out")] {
        open(&folder).map_err(|error| ScenarioError::Share(folder, error))?;
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_timeline_follows_readiness() {
        let script = Scenario::new("x")
            .device(DeviceSpec::acm(0x2e8a, 0xa, 100.0).serial("it's").port(3))
            .spare(DeviceSpec::uvc(0x046d, 0x0825))
            .record(20, &["cam"])
            .at(5000, "plug 1")
            .when("states 1 cam streaming")
            .at(700, "unplug 1")
            .until("is streaming published cam")
            .guest_script(&["usbemu".into()], &["rapid".into()]);
        assert!(script.contains(r"serial=it'\''s"));
        assert!(script.contains("emu plug 0; wait_for 60 attached 3"));
        assert!(!script.contains("emu plug 1;"));
        let place = |text: &str| script.find(text).unwrap();
        assert!(place("--record") < place("\"streaming\"") && place("\"streaming\"") < place("emu t0"));
        assert!(place("emu t0") < place("emu at 5000 plug 1") && place("emu at 5000 plug 1") < place("emu at 20000"));
        assert!(place("emu at 5000 plug 1") < place("states 1 cam streaming"), "{script}");
        let again = script.rfind("emu t0").unwrap();
        assert!(place("states 1 cam streaming") < again && again < place("emu at 700 unplug 1"), "{script}");
        assert!(place("emu at 700 unplug 1") < place("emu at 20000"), "{script}");
        assert!(place("emu at 20000") < place("is streaming published cam"), "{script}");
        assert!(place("is streaming published cam") < place("rapid_stop"), "{script}");
    }
}
