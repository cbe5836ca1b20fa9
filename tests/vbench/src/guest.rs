//! The guest: its image in the cache, and one run of it under QEMU.
//!
//! A boot takes longer than most scenarios. So a machine that has booted is saved once, at the point where it waits for
//! the host and has no share yet, and every scenario continues from there with a share of its own.
//!
//! Invariant: one guest at a time per machine, whichever process starts it: two guests sharing the processors under
//! software emulation would distort the timings.
//! Invariant: a saved machine is resumed only where it was saved: by the same QEMU, before the host restarts. The guest
//! has measured the rate of this host's time stamp counter.
//! Invariant: never KVM, which hangs on some nested hosts; figures stay comparable between machines that have it and not.

use std::fs::{self, File};
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use thiserror::Error;

const BUILD_SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/image/build.sh");
/// Added to the script's own limit: boot, copying, power off.
const OVERHEAD: Duration = Duration::from_mins(5);
/// A boot, and writing the machine's memory to a file.
const SAVED_WITHIN: Duration = Duration::from_mins(5);
/// The last line on the console of a guest that can be saved (`image/guest-init.sh`).
const WAITING: &str = "bench: waiting";
/// `usbcore.autosuspend=-1`: resuming an emulated camera resets it, which can look like a replug.
const KERNEL_ARGUMENTS: &str = "console=ttyS0 quiet loglevel=4 panic=-1 mitigations=off nokaslr audit=0 \
     random.trust_cpu=on no_timer_check tsc=reliable usbcore.autosuspend=-1";

/// The machine; a saved one continues only in the same.
const MACHINE: [&str; 17] = [
    "-M",
    "q35,usb=off,vmport=off",
    "-accel",
    "tcg,thread=multi",
    "-cpu",
    "max",
    "-smp",
    "2",
    "-m",
    "1024",
    "-display",
    "none",
    "-vga",
    "none",
    "-nodefaults",
    "-no-user-config",
    "-no-reboot",
];

/// Why a guest could not be run to its end.
#[derive(Debug, Error)]
pub enum GuestError {
    /// The image has not been built for these scripts.
    #[error("{0}")]
    NoImage(String),
    /// QEMU was not found.
    #[error("qemu-system-x86_64 does not start: {0}: run `make setup`")]
    NoQemu(#[source] io::Error),
    /// A file of the bench could not be read or written.
    #[error("{0}: {1}")]
    Io(PathBuf, #[source] io::Error),
    /// No machine could be saved.
    #[error("the guest was not saved within {SAVED_WITHIN:?}; console: {0}")]
    NotSaved(String),
    /// The guest neither finished nor powered off.
    #[error("the guest did not end within {limit:?} ({qemu}); console: {console}")]
    Unfinished {
        /// The time limit.
        limit: Duration,
        /// How QEMU ended.
        qemu: String,
        /// Last lines of its console.
        console: String,
    },
}

/// A built image.
#[derive(Clone, Debug)]
pub struct Image {
    directory: PathBuf,
    suite: String,
}

/// Results of a boot.
#[derive(Clone, Copy, Debug)]
pub struct Boot {
    /// Exit code of the guest's script; 124 if it reached its own time limit.
    pub code: i32,
    /// From the start of QEMU to its end.
    pub wall: Duration,
}

impl Image {
    /// The image built from the scripts of this checkout.
    pub fn locate() -> Result<Self, GuestError> {
        let script = Path::new(BUILD_SCRIPT);
        let check =
            Command::new("bash").arg(script).arg("--check").output().map_err(|e| GuestError::Io(script.into(), e))?;
        if !check.status.success() {
            return Err(GuestError::NoImage(String::from_utf8_lossy(&check.stderr).trim().into()));
        }
        let directory = PathBuf::from(String::from_utf8_lossy(&check.stdout).trim());
        let manifest = directory.join("manifest");
        let text = fs::read_to_string(&manifest).map_err(|e| GuestError::Io(manifest, e))?;
        let suite = text.lines().find_map(|line| line.strip_prefix("suite ")).unwrap_or_default().into();
        Ok(Self { directory, suite })
    }

    /// The Debian release inside.
    pub fn suite(&self) -> &str {
        &self.suite
    }

    /// Boots with systemd as PID 1 and `share` as the guest's share, and waits until its script has ended and the machine
    /// is off.
    pub fn boot(&self, share: &Path, limit: Duration) -> Result<Boot, GuestError> {
        let _alone = self.lock()?;
        let mut qemu = self.command(share, "bench.systemd");
        qemu.args(["-serial", "null"]);
        Self::run(&mut qemu, share, limit)
    }

    /// Continues the saved machine with `share` as its share; otherwise as [`Image::boot`].
    pub fn resume(&self, share: &Path, limit: Duration) -> Result<Boot, GuestError> {
        let _alone = self.lock()?;
        let saved = self.saved()?;
        let mut qemu = self.command(share, "");
        qemu.args(["-serial", "stdio", "-incoming"]).arg(format!("exec:cat '{}'", saved.display()));
        Self::run(&mut qemu, share, limit)
    }

    fn run(qemu: &mut Command, share: &Path, limit: Duration) -> Result<Boot, GuestError> {
        write(share.join("limit"), &limit.as_secs().max(1).to_string())?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        write(share.join("now"), &format!("{}.{:09}", now.as_secs(), now.subsec_nanos()))?;
        let started = Instant::now();
        let mut machine = Machine(qemu.stdin(Stdio::piped()).spawn().map_err(GuestError::NoQemu)?);
        machine.release(&share.join("now"), limit);
        let ended = machine.wait(limit + OVERHEAD);
        let wall = started.elapsed();
        drop(machine);

        let code = fs::read_to_string(share.join("rc")).ok().and_then(|text| text.trim().parse().ok());
        code.map(|code| Boot { code, wall }).ok_or_else(|| GuestError::Unfinished {
            limit: limit + OVERHEAD,
            qemu: ended.map_or_else(|| "killed".into(), |status| status.to_string()),
            console: tail(&share.join("console.log"), 30),
        })
    }

    /// The file of the saved machine; boots one and saves it if there is none. Requires the lock.
    fn saved(&self) -> Result<PathBuf, GuestError> {
        let path = self.directory.join(format!("saved-{:016x}", identity()?));
        if path.is_file() {
            return Ok(path);
        }
        for old in fs::read_dir(&self.directory).into_iter().flatten().flatten() {
            if old.file_name().to_string_lossy().starts_with("saved-") {
                let _gone = fs::remove_file(old.path());
            }
        }
        let share = path.with_extension("share");
        fs::create_dir_all(&share).map_err(|error| GuestError::Io(share.clone(), error))?;
        let console = share.join("console.log");
        let mut qemu = self.command(&share, "");
        // To a file: the monitor repeats the line with each character of it, which is more than a pipe holds.
        let reports = share.join("monitor.log");
        let monitor = File::create(&reports).map_err(|error| GuestError::Io(reports.clone(), error))?;
        qemu.args(["-serial", "null", "-monitor", "stdio"]).stdin(Stdio::piped()).stdout(monitor);
        let mut machine = Machine(qemu.spawn().map_err(GuestError::NoQemu)?);
        let begun = Instant::now();
        while !fs::read_to_string(&console).unwrap_or_default().contains(WAITING) && begun.elapsed() < SAVED_WITHIN {
            thread::sleep(Duration::from_millis(50));
        }
        // The monitor executes a command after the one before it has ended. The file gets its name when all of it is written,
        // and QEMU reports whether that was all of the machine.
        let (state, saved) = (share.join("state"), share.join("saved"));
        let whole = format!("cat >'{0}' && mv '{0}' '{1}'", state.display(), saved.display());
        let orders = format!("migrate \"exec:{whole}\"\ninfo migrate\nquit\n");
        let _where_qemu_has_ended = machine.0.stdin.as_mut().map(|input| input.write_all(orders.as_bytes()));
        let left = SAVED_WITHIN.saturating_sub(begun.elapsed());
        let is_complete = machine.wait(left).is_some_and(|status| status.success())
            && fs::read(&reports)
                .is_ok_and(|text| String::from_utf8_lossy(&text).contains("Migration status: completed"));
        while is_complete && !saved.is_file() && begun.elapsed() < SAVED_WITHIN {
            thread::sleep(Duration::from_millis(50));
        }
        if !is_complete || !saved.is_file() {
            return Err(GuestError::NotSaved(tail(&console, 30)));
        }
        fs::rename(&saved, &path).map_err(|error| GuestError::Io(path.clone(), error))?;
        let _gone = fs::remove_dir_all(&share);
        Ok(path)
    }

    fn lock(&self) -> Result<File, GuestError> {
        let path = self.directory.with_file_name(".one-guest");
        let failed = |error| GuestError::Io(path.clone(), error);
        let file = File::create(&path).map_err(failed)?;
        file.lock().map_err(failed)?;
        Ok(file)
    }

    /// The machine with its disk and `share`, but for its second serial line.
    fn command(&self, share: &Path, argument: &str) -> Command {
        let mut qemu = Command::new("qemu-system-x86_64");
        qemu.args(MACHINE)
            .arg("-serial")
            .arg(format!("file:{}", share.join("console.log").display()))
            .arg("-kernel")
            .arg(self.directory.join("vmlinux"))
            .arg("-initrd")
            .arg(self.directory.join("boot.cpio"))
            .arg("-append")
            .arg(format!("{KERNEL_ARGUMENTS} {argument}"))
            .arg("-drive")
            .arg(format!(
                "file={},format=raw,if=none,id=root,readonly=on,file.locking=off",
                self.directory.join("root.ext4").display()
            ))
            .args(["-device", "virtio-blk-pci,drive=root", "-virtfs"])
            .arg(format!("local,path={},mount_tag=share,security_model=none,id=share", share.display()))
            .stdout(Stdio::null())
            .stderr(Stdio::inherit());
        qemu
    }
}

/// Changes with whatever a saved machine depends on besides the image: QEMU, the machine, the start of the host.
fn identity() -> Result<u64, GuestError> {
    let version = Command::new("qemu-system-x86_64").arg("--version").output().map_err(GuestError::NoQemu)?;
    let start = Path::new("/proc/sys/kernel/random/boot_id");
    let start = fs::read_to_string(start).map_err(|error| GuestError::Io(start.into(), error))?;
    let mut hasher = DefaultHasher::new();
    (version.stdout, start, MACHINE, KERNEL_ARGUMENTS).hash(&mut hasher);
    Ok(hasher.finish())
}

fn write(path: PathBuf, text: &str) -> Result<PathBuf, GuestError> {
    fs::write(&path, text).map_err(|error| GuestError::Io(path.clone(), error))?;
    Ok(path)
}

/// A running QEMU, killed with the process that started it.
struct Machine(Child);

impl Machine {
    /// Sends lines until the guest has taken the time: QEMU loses a line that comes before it has loaded the machine.
    fn release(&mut self, time: &Path, limit: Duration) {
        let end = Instant::now() + limit;
        while time.exists() && Instant::now() < end && matches!(self.0.try_wait(), Ok(None)) {
            // Where QEMU has ended, its status says why.
            let _written = self.0.stdin.as_mut().map(|input| input.write_all(b"\n"));
            thread::sleep(Duration::from_millis(100));
        }
    }

    fn wait(&mut self, limit: Duration) -> Option<ExitStatus> {
        let end = Instant::now() + limit;
        while Instant::now() < end {
            if let Ok(Some(status)) = self.0.try_wait() {
                return Some(status);
            }
            thread::sleep(Duration::from_millis(50));
        }
        None
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ended_already = self.0.kill();
        let _reaped = self.0.wait();
    }
}

/// The last lines of a file; empty if there is no file.
pub fn tail(path: &Path, lines: usize) -> String {
    let bytes = fs::read(path).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let all: Vec<&str> = text.lines().collect();
    all[all.len().saturating_sub(lines)..].join("\n")
}
