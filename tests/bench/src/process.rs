//! Child processes: starts, monitors and ends them; their cost as accounted by the kernel.
//!
//! Sources: proc(5), `/proc/PID/stat` fields 14 and 15 (user and system time in ticks of 10 ms),
//! `/proc/PID/task/TID/schedstat` (ns on a processor), `status` (`VmHWM`, `voluntary_ctxt_switches`).
//!
//! Invariant: a child never outlives its handle: dropping it kills the child.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process, waitid};

/// Polling interval of a child.
const LOOK: Duration = Duration::from_millis(100);
/// A child that does not end on request is killed after this time.
const END_LIMIT: Duration = Duration::from_mins(1);
/// Length of a tick of `/proc/PID/stat`, s: USER_HZ is 100 on every Linux that `rapid` runs on.
const TICK_S: f64 = 0.01;

/// Resources used by a thread.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct ThreadUse {
    /// Its name.
    pub name: String,
    /// Time on a processor, s.
    pub cpu_s: f64,
    /// Number of voluntary context switches.
    pub sleeps: u64,
    /// Scheduling policy: 0 ordinary, 1 FIFO.
    pub policy: u32,
}

/// Resources used by a process, from start to end.
#[derive(Debug, Clone, Default)]
pub(crate) struct Usage {
    /// User and system time, s.
    pub cpu_s: f64,
    /// Part of it used up to the first check after [`Running::mark`].
    pub cpu_before_mark_s: f64,
    /// Peak of resident memory, bytes.
    pub resident: u64,
    /// Parts of the resident memory at the last check: private, and shared with others through files in memory.
    pub anonymous: u64,
    /// See `anonymous`.
    pub shared: u64,
    /// Threads as last seen, by number.
    pub threads: Vec<ThreadUse>,
    /// Everything it wrote to standard output.
    pub output: String,
    /// It ended with success. Code 4 means a BAD episode, which an episode without a device must be: the section judges
    /// its own measurements.
    pub success: bool,
}

impl Usage {
    /// Threads grouped by name: time and sleeps.
    pub(crate) fn by_name(&self) -> Vec<ThreadUse> {
        let mut names: BTreeMap<&str, ThreadUse> = BTreeMap::new();
        for thread in &self.threads {
            let sum = names.entry(&thread.name).or_default();
            sum.name.clone_from(&thread.name);
            sum.cpu_s += thread.cpu_s;
            sum.sleeps += thread.sleeps;
            sum.policy = sum.policy.max(thread.policy);
        }
        let mut sums: Vec<ThreadUse> = names.into_values().collect();
        sums.sort_by(|a, b| b.cpu_s.total_cmp(&a.cpu_s));
        sums
    }
}

/// A running child.
#[derive(Debug)]
pub(crate) struct Running {
    child: Child,
    pid: Pid,
    lines: Receiver<String>,
    usage: Usage,
    threads: BTreeMap<u32, ThreadUse>,
    looked: Instant,
}

impl Running {
    /// Starts `command`; its standard output is captured, its standard error shown.
    ///
    /// # Errors
    /// When it cannot be started.
    pub(crate) fn start(command: &mut Command) -> io::Result<Self> {
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().map_err(|error| {
            io::Error::new(error.kind(), format!("{}: {error}", command.get_program().to_string_lossy()))
        })?;
        let output = child.stdout.take().ok_or_else(|| io::Error::other("no standard output"))?;
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        let pid = Pid::from_child(&child);
        let (usage, threads) = (Usage::default(), BTreeMap::new());
        Ok(Self { child, pid, lines, usage, threads, looked: Instant::now() })
    }

    /// Waits until the child writes a line for which `wanted` holds.
    ///
    /// # Errors
    /// When it ends or `limit` passes before.
    pub(crate) fn wait_for(&mut self, limit: Duration, wanted: impl Fn(&str) -> bool) -> io::Result<()> {
        let deadline = Instant::now() + limit;
        loop {
            match self.lines.recv_timeout(LOOK) {
                Ok(line) => {
                    let found = wanted(&line);
                    self.take(&line);
                    if found {
                        return Ok(());
                    }
                }
                Err(RecvTimeoutError::Timeout) if Instant::now() < deadline => self.look(),
                Err(_) => {
                    return Err(io::Error::other(format!("the child ended or was silent: {}", self.usage.output)));
                }
            }
        }
    }

    /// Its process.
    pub(crate) fn pid(&self) -> Pid {
        self.pid
    }

    /// Separates the resources used until now from those that follow.
    pub(crate) fn mark(&mut self) {
        self.usage.cpu_before_mark_s = cpu_s(self.pid).unwrap_or_default();
    }

    /// Waits for the child's end, at most `limit`; `progress` is called regularly.
    ///
    /// # Errors
    /// When it does not end in time.
    pub(crate) fn finish(mut self, limit: Duration, mut progress: impl FnMut()) -> io::Result<Usage> {
        let deadline = Instant::now() + limit;
        loop {
            // Not reaped: an ended process still has its times.
            let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
            if waitid(WaitId::Pid(self.pid), options)?.is_some() {
                break;
            }
            if Instant::now() >= deadline {
                return Err(io::Error::other(format!("the child did not end within {limit:?}")));
            }
            self.look();
            progress();
            std::thread::sleep(LOOK);
        }
        self.usage.cpu_s = cpu_s(self.pid).unwrap_or_default();
        self.usage.success = matches!(self.child.wait()?.code(), Some(0 | 4));
        while let Ok(line) = self.lines.recv_timeout(END_LIMIT) {
            self.take(&line);
        }
        self.usage.threads = std::mem::take(&mut self.threads).into_values().collect();
        Ok(std::mem::take(&mut self.usage))
    }

    /// Asks the child to end and waits for it.
    ///
    /// # Errors
    /// When it does not.
    pub(crate) fn stop(mut self) -> io::Result<Usage> {
        self.look();
        kill_process(self.pid, Signal::TERM)?;
        self.finish(END_LIMIT, || {})
    }

    fn take(&mut self, line: &str) {
        self.usage.output.push_str(line);
        self.usage.output.push('\n');
    }

    fn look(&mut self) {
        if self.looked.elapsed() < LOOK {
            return;
        }
        self.looked = Instant::now();
        let pid = self.pid.as_raw_nonzero();
        let proc = format!("/proc/{pid}");
        if let Ok(status) = fs::read_to_string(format!("{proc}/status")) {
            let bytes = |name| field(&status, name).map_or(0, |kilobytes| kilobytes << 10);
            self.usage.resident = self.usage.resident.max(bytes("VmHWM"));
            (self.usage.anonymous, self.usage.shared) = (bytes("RssAnon"), bytes("RssShmem"));
        }
        for entry in fs::read_dir(format!("{proc}/task")).into_iter().flatten().flatten() {
            let Some(number) = entry.file_name().to_str().and_then(|name| name.parse().ok()) else { continue };
            if let Some(thread) = thread_use(&entry.path()) {
                self.threads.insert(number, thread);
            }
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn thread_use(task: &Path) -> Option<ThreadUse> {
    let read = |name: &str| fs::read_to_string(task.join(name)).ok();
    let cpu_ns: u64 = read("schedstat")?.split_whitespace().next()?.parse().ok()?;
    let stat = read("stat")?;
    let policy = stat.rsplit_once(')')?.1.split_whitespace().nth(38)?.parse().ok()?;
    Some(ThreadUse {
        name: read("comm")?.trim().to_owned(),
        cpu_s: cpu_ns as f64 / 1e9,
        sleeps: field(&read("status")?, "voluntary_ctxt_switches")?,
        policy,
    })
}

fn field(status: &str, name: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
    line.split_whitespace().next()?.parse().ok()
}

/// User and system time of a process, s.
pub(crate) fn cpu_s(pid: Pid) -> Option<f64> {
    let stat = fs::read_to_string(format!("/proc/{}/stat", pid.as_raw_nonzero())).ok()?;
    // The second field, the name in parentheses, may contain anything.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let (user, system): (u64, u64) = (fields.next()?.parse().ok()?, fields.next()?.parse().ok()?);
    Some((user + system) as f64 * TICK_S)
}

/// Load average of the last minute, and the share of all processors' time that was not idle in the last `span`, %.
pub(crate) fn host_load(span: Duration) -> Option<(f64, f64)> {
    let average = fs::read_to_string("/proc/loadavg").ok()?.split_whitespace().next()?.parse().ok()?;
    let times = || {
        let stat = fs::read_to_string("/proc/stat").ok()?;
        let ticks: Vec<u64> = stat.lines().next()?.split_whitespace().skip(1).filter_map(|n| n.parse().ok()).collect();
        // Fields 4 and 5 are idle time and time waiting for a disk.
        Some((ticks.iter().take(8).sum::<u64>(), ticks.get(3)? + ticks.get(4)?))
    };
    let (all, idle) = times()?;
    std::thread::sleep(span);
    let (all_after, idle_after) = times()?;
    let idle_share = (idle_after - idle) as f64 / (all_after - all).max(1) as f64;
    Some((average, 100.0 * (1.0 - idle_share)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_child_is_accounted_for() {
        let script = "echo ready; i=0; while [ $i -lt 200000 ]; do i=$((i+1)); done; echo done";
        let mut child = Running::start(Command::new("sh").args(["-c", script])).unwrap();
        child.wait_for(Duration::from_secs(10), |line| line == "ready").unwrap();
        child.mark();
        let usage = child.finish(Duration::from_secs(60), || {}).unwrap();
        assert!(usage.success && usage.output == "ready\ndone\n", "{usage:?}");
        assert!(usage.cpu_s > usage.cpu_before_mark_s, "{usage:?}");
    }

    #[test]
    fn a_child_that_ends_early_is_a_failure() {
        let mut child = Running::start(Command::new("sh").args(["-c", "exit 3"])).unwrap();
        assert!(child.wait_for(Duration::from_secs(10), |_| true).is_err());
        assert!(!child.finish(Duration::from_secs(10), || {}).unwrap().success);
    }

    #[test]
    fn fields_of_status_are_found_by_whole_names() {
        let status = "VmHWMx:\t9 kB\nVmHWM:\t  12 kB\n";
        assert_eq!((field(status, "VmHWM"), field(status, "VmRSS")), (Some(12), None));
    }
}
