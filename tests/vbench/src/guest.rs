//! The guest: what `image/build.sh` has built, and one run of it.
//!
//! Invariant: a run ends when the guest's script has ended, or after its limit.
//! Invariant: where time is virtual ([`Image::is_virtual`]) a scenario lasts as long, by the guest's clocks, on any machine under
//! any load. Elsewhere processors are emulated and slow: only order and minimum times mean something.

mod qemu;
mod uml;

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};
use std::thread;
use std::time::{Duration, Instant};

use thiserror::Error;

use qemu::Qemu;
use uml::Uml;

const BUILD_SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/image/build.sh");
/// Which kind of guest is run: `uml` or `qemu`.
const BACKEND: &str = "RAPID_VBENCH_BACKEND";
/// Between two looks at a guest that runs.
const LOOKS_EVERY: Duration = Duration::from_millis(20);

/// Why a guest could not be run to its end.
#[derive(Debug, Error)]
pub enum GuestError {
    /// It has not been built for these scripts.
    #[error("{0}")]
    NoImage(String),
    /// The description of what was built lacks something.
    #[error("image/build.sh --check names no {0}")]
    NoPart(&'static str),
    /// A program was not found.
    #[error("{0} does not start: {1}: run `make setup-all`")]
    NoProgram(String, #[source] io::Error),
    /// The name of a guest's share has a space.
    #[error("{0}: a guest takes no folder with a space in its name: set TMPDIR to another one")]
    Space(PathBuf),
    /// A file of the bench could not be read or written.
    #[error("{0}: {1}")]
    Io(PathBuf, #[source] io::Error),
    /// No machine could be saved.
    #[error("the guest was not saved within {limit:?}; console: {console}")]
    NotSaved {
        /// The time limit.
        limit: Duration,
        /// Last lines of its console.
        console: String,
    },
    /// The guest neither finished nor powered off.
    #[error("the guest did not end within {limit:?} ({machine}); console: {console}")]
    Unfinished {
        /// The limit in the host's time.
        limit: Duration,
        /// How its process ended.
        machine: String,
        /// Last lines of its console.
        console: String,
    },
}

/// What runs the guest's script.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Init {
    /// The script is started by process 1.
    Script,
    /// Process 1 is systemd, and the script one of its services.
    Systemd,
}

/// A guest that was built.
#[derive(Clone, Debug)]
pub struct Image {
    suite: String,
    backend: Backend,
}

#[derive(Clone, Debug)]
enum Backend {
    Uml(Uml),
    Qemu(Qemu),
}

/// Results of a run.
#[derive(Clone, Copy, Debug)]
pub struct Boot {
    /// Exit code of the guest's script; 124 if it reached its own time limit.
    pub code: i32,
    /// From the start of the guest to its end, in the host's time.
    pub wall: Duration,
    /// The same by the guest's own clock, without power off.
    pub inside: Duration,
    /// Whether that clock is virtual.
    pub is_virtual: bool,
}

impl Image {
    /// The guest built from the scripts of this checkout: the kind that `RAPID_VBENCH_BACKEND` names, otherwise the usual one.
    pub fn locate() -> Result<Self, GuestError> {
        Self::of_kind(std::env::var(BACKEND).ok().as_deref())
    }

    /// The emulated machine, whose time is the host's: for what measures.
    pub fn emulated() -> Result<Self, GuestError> {
        Self::of_kind(Some("qemu"))
    }

    fn of_kind(kind: Option<&str>) -> Result<Self, GuestError> {
        let script = Path::new(BUILD_SCRIPT);
        let check = Command::new("bash").arg(script).arg("--check").args(kind).output();
        let check = check.map_err(|error| GuestError::Io(script.into(), error))?;
        if !check.status.success() {
            return Err(GuestError::NoImage(String::from_utf8_lossy(&check.stderr).trim().into()));
        }
        let text = String::from_utf8_lossy(&check.stdout);
        let part = |key: &'static str| {
            let line = text.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(' '));
            line.map(str::to_owned).ok_or(GuestError::NoPart(key))
        };
        let backend = match part("backend")?.as_str() {
            "uml" => Backend::Uml(Uml {
                root: part("root")?.into(),
                kernel: part("kernel")?.into(),
                modules: part("modules")?.into(),
                memory: part("memory")?.into(),
            }),
            _ => Backend::Qemu(Qemu { directory: part("directory")?.into() }),
        };
        Ok(Self { suite: part("suite")?, backend })
    }

    /// The Debian release inside.
    pub fn suite(&self) -> &str {
        &self.suite
    }

    /// Whether the guest's time is virtual: it advances only while everything in the guest waits.
    pub fn is_virtual(&self) -> bool {
        matches!(self.backend, Backend::Uml(_))
    }

    /// Runs the guest with `share` as its share, and waits until its script has ended and the machine is off. The script may
    /// take `limit` by the guest's clock. Where that is virtual, the guest is ended after `wall` of the host's time: a limit of a
    /// clock that stands still never comes.
    pub fn run(&self, share: &Path, init: Init, limit: Duration, wall: Duration) -> Result<Boot, GuestError> {
        write(share.join("limit"), &limit.as_secs().max(1).to_string())?;
        let ran = match &self.backend {
            Backend::Uml(uml) => uml.run(share, init, wall)?,
            Backend::Qemu(qemu) => qemu.run(share, init, limit)?,
        };
        let number = |name: &str| fs::read_to_string(share.join(name)).ok();
        let code = number("rc").and_then(|text| text.trim().parse().ok());
        let inside = number("uptime").and_then(|text| text.trim().parse().ok()).unwrap_or_default();
        code.map(|code| Boot {
            code,
            wall: ran.wall,
            inside: Duration::from_secs_f64(inside),
            is_virtual: self.is_virtual(),
        })
        .ok_or_else(|| GuestError::Unfinished {
            limit: ran.limit,
            machine: ran.ended.map_or_else(|| "killed".into(), |status| status.to_string()),
            console: tail(&share.join("console.log"), 30),
        })
    }
}

/// How the process of a guest ran.
struct Ran {
    wall: Duration,
    limit: Duration,
    /// `None` if it was killed at its limit.
    ended: Option<ExitStatus>,
}

/// Waits for the end of a process; `None` if it has not ended by then.
fn wait(child: &mut Child, limit: Duration) -> Option<ExitStatus> {
    let end = Instant::now() + limit;
    while Instant::now() < end {
        if let Ok(Some(status)) = child.try_wait() {
            return Some(status);
        }
        thread::sleep(LOOKS_EVERY);
    }
    None
}

/// A locked file of that name in this folder; the lock ends with the file.
fn lock(path: PathBuf) -> Result<File, GuestError> {
    let file = File::create(&path).and_then(|file| file.lock().map(|()| file));
    file.map_err(|error| GuestError::Io(path, error))
}

fn write(path: PathBuf, text: &str) -> Result<PathBuf, GuestError> {
    fs::write(&path, text).map_err(|error| GuestError::Io(path.clone(), error))?;
    Ok(path)
}

/// The last lines of a file; empty if there is no file.
pub fn tail(path: &Path, lines: usize) -> String {
    let bytes = fs::read(path).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let all: Vec<&str> = text.lines().collect();
    all[all.len().saturating_sub(lines)..].join("\n")
}
