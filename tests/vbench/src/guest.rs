//! The guest: its image in the cache, and one boot of it under QEMU.
//!
//! Invariant: one guest at a time per machine, whichever process starts it: two guests sharing the processors under
//! software emulation would distort the timings.
//! Invariant: never KVM, which hangs on some nested hosts; figures stay comparable between machines that have it and not.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use thiserror::Error;

const BUILD_SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/image/build.sh");
/// Added to the script's own limit: boot, copying, power off.
const OVERHEAD: Duration = Duration::from_mins(5);
/// `usbcore.autosuspend=-1`: resuming an emulated camera resets it, which can look like a replug.
const KERNEL_ARGUMENTS: &str = "console=ttyS0 quiet loglevel=4 panic=-1 mitigations=off nokaslr audit=0 \
     random.trust_cpu=on no_timer_check tsc=reliable usbcore.autosuspend=-1";

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

    /// Boots with `share` as the guest's share, and waits until its script has ended and the machine is off.
    pub fn boot(&self, share: &Path, limit: Duration) -> Result<Boot, GuestError> {
        let _alone = self.lock()?;
        let file = |name: &str, text: String| {
            let path = share.join(name);
            fs::write(&path, text).map_err(|e| GuestError::Io(path, e))
        };
        file("limit", limit.as_secs().max(1).to_string())?;
        let started = Instant::now();
        let mut machine = Machine(self.command(share).spawn().map_err(GuestError::NoQemu)?);
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

    fn lock(&self) -> Result<File, GuestError> {
        let path = self.directory.with_file_name(".one-guest");
        let failed = |error| GuestError::Io(path.clone(), error);
        let file = File::create(&path).map_err(failed)?;
        file.lock().map_err(failed)?;
        Ok(file)
    }

    fn command(&self, share: &Path) -> Command {
        let mut qemu = Command::new("qemu-system-x86_64");
        qemu.args([
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
        ])
        .args(["-display", "none", "-vga", "none", "-nodefaults", "-no-user-config", "-no-reboot", "-monitor", "none"])
        .arg("-serial")
        .arg(format!("file:{}", share.join("console.log").display()))
        .arg("-kernel")
        .arg(self.directory.join("vmlinux"))
        .arg("-initrd")
        .arg(self.directory.join("boot.cpio"))
        .args(["-append", KERNEL_ARGUMENTS, "-drive"])
        .arg(format!(
            "file={},format=raw,if=none,id=root,readonly=on,file.locking=off",
            self.directory.join("root.ext4").display()
        ))
        .args(["-device", "virtio-blk-pci,drive=root", "-virtfs"])
        .arg(format!("local,path={},mount_tag=share,security_model=none,id=share", share.display()))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::inherit());
        qemu
    }
}

/// A running QEMU, killed with the process that started it.
struct Machine(Child);

impl Machine {
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
