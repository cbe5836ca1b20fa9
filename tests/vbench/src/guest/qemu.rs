//! A guest in QEMU, with the distribution's own kernel: the second opinion on what User-Mode Linux shows, and what measures real
//! times.
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
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use super::{GuestError, Init, Ran, lock, tail, wait, write};

const QEMU: &str = "qemu-system-x86_64";
/// QEMU is killed when the test that started it ends, however: at the end of the thread that did, which waits for it.
const WITH_ITS_PARENT: [&str; 4] = ["setpriv", "--pdeathsig", "KILL", "--"];
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

#[derive(Clone, Debug)]
pub(super) struct Qemu {
    /// Kernel, initramfs and disk.
    pub(super) directory: PathBuf,
}

impl Qemu {
    pub(super) fn run(&self, share: &Path, init: Init, limit: Duration) -> Result<Ran, GuestError> {
        let _alone = lock(self.directory.with_file_name(".one-guest"))?;
        // Also shows whether there is a QEMU: of what starts it only `setpriv` may then be missing.
        let identity = identity()?;
        let mut qemu = match init {
            Init::Systemd => {
                let mut qemu = self.command(share, "bench.systemd");
                qemu.args(["-serial", "null"]);
                qemu
            }
            Init::Script => {
                let saved = self.saved(identity)?;
                let mut qemu = self.command(share, "");
                qemu.args(["-serial", "stdio", "-incoming"]).arg(format!("exec:cat '{}'", saved.display()));
                qemu
            }
        };
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        write(share.join("now"), &format!("{}.{:09}", now.as_secs(), now.subsec_nanos()))?;
        let started = Instant::now();
        let mut machine = Machine(qemu.stdin(Stdio::piped()).spawn().map_err(not_started)?);
        machine.release(&share.join("now"), limit);
        let ended = wait(&mut machine.0, limit + OVERHEAD);
        Ok(Ran { wall: started.elapsed(), limit: limit + OVERHEAD, ended })
    }

    /// The file of the saved machine with this identity; boots one and saves it if there is none. Requires the lock.
    fn saved(&self, identity: u64) -> Result<PathBuf, GuestError> {
        let path = self.directory.join(format!("saved-{identity:016x}"));
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
        let mut machine = Machine(qemu.spawn().map_err(not_started)?);
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
        let is_complete = wait(&mut machine.0, left).is_some_and(|status| status.success())
            && fs::read(&reports)
                .is_ok_and(|text| String::from_utf8_lossy(&text).contains("Migration status: completed"));
        while is_complete && !saved.is_file() && begun.elapsed() < SAVED_WITHIN {
            thread::sleep(Duration::from_millis(50));
        }
        if !is_complete || !saved.is_file() {
            return Err(GuestError::NotSaved { limit: SAVED_WITHIN, console: tail(&console, 30) });
        }
        fs::rename(&saved, &path).map_err(|error| GuestError::Io(path.clone(), error))?;
        let _gone = fs::remove_dir_all(&share);
        Ok(path)
    }

    /// The machine with its disk and `share`, but for its second serial line.
    fn command(&self, share: &Path, argument: &str) -> Command {
        let [first, options @ ..] = WITH_ITS_PARENT;
        let mut qemu = Command::new(first);
        qemu.args(options)
            .arg(QEMU)
            .args(MACHINE)
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
    let version = Command::new(QEMU).arg("--version").output().map_err(not_found)?;
    let start = Path::new("/proc/sys/kernel/random/boot_id");
    let start = fs::read_to_string(start).map_err(|error| GuestError::Io(start.into(), error))?;
    let mut hasher = DefaultHasher::new();
    (version.stdout, start, MACHINE, KERNEL_ARGUMENTS).hash(&mut hasher);
    Ok(hasher.finish())
}

fn not_found(error: std::io::Error) -> GuestError {
    GuestError::NoProgram(QEMU.into(), error)
}

fn not_started(error: std::io::Error) -> GuestError {
    GuestError::NoProgram(WITH_ITS_PARENT[0].into(), error)
}

/// A running QEMU, killed when it is dropped.
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
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ended_already = self.0.kill();
        let _reaped = self.0.wait();
    }
}
