//! A guest in User-Mode Linux: Linux 6.1 as one process of the host, with virtual time (`time-travel=inf-cpu`).
//!
//! The kernel and its programs take turns on one processor by ptrace. The guest's clocks stand still while anything in it computes and
//! jump to the next timer when everything waits, so a scenario takes as long as its computing, and nothing in it is late.
//!
//! Invariant: one guest of this cache per processor, pinned to it: on two, each system call would wake the other one, which takes three times as
//! long. Ahead of other programs where that is allowed: each system call is two switches, and each would wait for others to
//! have had their share.
//! Invariant: a guest that computes for ever, in which virtual time stands still, ends at a limit of the host's time.
//! Invariant: nothing of a guest survives: its programs are processes of the host in the kernel's process group, and one that computes
//! survives the kernel's death. So the group is killed, by `Drop`, or by a shell that notices when this process is gone.

use std::fs::File;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process_group};
use rustix::thread::{CpuSet, sched_getaffinity};

use super::{GuestError, Init, LOOKS_EVERY, Ran, lock, wait};

/// `usbcore.autosuspend=-1`: resuming an emulated camera resets it, which can look like a replug.
const KERNEL_ARGUMENTS: [&str; 16] = [
    "time-travel=inf-cpu",
    "mem=1024M",
    "umid=guest",
    "root=/dev/root",
    "rootfstype=hostfs",
    "ro",
    "init=/usr/sbin/bench-init",
    "con=null",
    "con0=fd:0,fd:1",
    "ssl=null",
    "quiet",
    "loglevel=4",
    "panic=-1",
    "random.trust_cpu=on",
    "usbcore.autosuspend=-1",
    "audit=0",
];

#[derive(Clone, Debug)]
pub(super) struct Uml {
    /// The guest's root folder, which is only read.
    pub(super) root: PathBuf,
    /// The kernel, a program.
    pub(super) kernel: PathBuf,
    /// Its modules: what is mounted as /lib/modules.
    pub(super) modules: PathBuf,
    /// Where the guest's memory is a file.
    pub(super) memory: PathBuf,
}

impl Uml {
    pub(super) fn run(&self, share: &Path, init: Init, limit: Duration) -> Result<Ran, GuestError> {
        // The kernel's command line ends a name there.
        if share.to_string_lossy().contains(char::is_whitespace) {
            return Err(GuestError::Space(share.into()));
        }
        let processor = Processor::take(self.root.parent().unwrap_or(&self.root))?;
        let started = Instant::now();
        let mut machine = Machine::start(self.command(share, init, processor.number)?)?;
        let ended = wait(&mut machine.kernel.0, limit);
        Ok(Ran { wall: started.elapsed(), limit, ended })
    }

    fn command(&self, share: &Path, init: Init, processor: usize) -> Result<Command, GuestError> {
        let console = share.join("console.log");
        let console = File::create(&console).map_err(|error| GuestError::Io(console.clone(), error))?;
        let errors = console.try_clone().map_err(|error| GuestError::Io(share.into(), error))?;
        let mut command = Command::new("taskset");
        command.args(["-c", &processor.to_string()]);
        if may_be_first() {
            command.args(FIRST);
        }
        command
            .arg(&self.kernel)
            .args(KERNEL_ARGUMENTS)
            .arg(format!("rootflags={}", self.root.display()))
            .arg(format!("uml_dir={}", share.display()))
            .arg(format!("bench.share={}", share.display()))
            .arg(format!("bench.modules={}", self.modules.display()))
            .args((init == Init::Systemd).then_some("bench.systemd"))
            .env("TMPDIR", &self.memory)
            .stdin(Stdio::null())
            .stdout(console)
            .stderr(errors);
        Ok(command)
    }
}

/// Round-robin among programs of real-time priority. Not first in, first out: a program that computes for ever would keep its own
/// kernel from being killed.
const FIRST: [&str; 3] = ["chrt", "--rr", "1"];

fn may_be_first() -> bool {
    static MAY: OnceLock<bool> = OnceLock::new();
    *MAY.get_or_init(|| {
        let tried = Command::new(FIRST[0]).args(&FIRST[1..]).arg("true").stderr(Stdio::null()).status();
        tried.is_ok_and(|status| status.success())
    })
}

/// A processor that no other guest of this cache has, whichever process started it.
struct Processor {
    number: usize,
    _lock: File,
}

impl Processor {
    fn take(folder: &Path) -> Result<Self, GuestError> {
        let allowed = sched_getaffinity(None).unwrap_or_default();
        let mut all: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|number| allowed.is_set(*number)).collect();
        if all.is_empty() {
            all.push(0);
        }
        let path = |number: usize| folder.join(format!(".processor-{number}"));
        if let [only] = all[..] {
            return Ok(Self { number: only, _lock: lock(path(only))? });
        }
        loop {
            for &number in &all {
                let path = path(number);
                let file = File::create(&path).map_err(|error| GuestError::Io(path, error))?;
                if file.try_lock().is_ok() {
                    return Ok(Self { number, _lock: file });
                }
            }
            thread::sleep(LOOKS_EVERY);
        }
    }
}

/// The kernel and a shell that kills it when this process is gone. The guard ends first: the number of the group may be another's soon
/// after the kernel has been waited for.
struct Machine {
    _guard: Guard,
    kernel: Group,
}

impl Machine {
    fn start(mut command: Command) -> Result<Self, GuestError> {
        let failed = |name: &'static str| move |error| GuestError::NoProgram(name.into(), error);
        let kernel = Group(command.process_group(0).spawn().map_err(failed("taskset"))?);
        // Its input ends with this process, however that ends.
        let guard = Command::new("sh")
            .args(["-c", "read -r _; kill -KILL -- \"-$0\"", &kernel.0.id().to_string()])
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .map_err(failed("sh"))?;
        Ok(Self { _guard: Guard(guard), kernel })
    }
}

struct Guard(Child);

impl Drop for Guard {
    fn drop(&mut self) {
        let _ended_already = self.0.kill();
        let _reaped = self.0.wait();
    }
}

/// The leader of a process group, of which nothing is left when it is dropped.
struct Group(Child);

impl Drop for Group {
    fn drop(&mut self) {
        if let Some(group) = Pid::from_raw(self.0.id().cast_signed()) {
            let _ended_already = kill_process_group(group, Signal::KILL);
        }
        let _reaped = self.0.wait();
    }
}
