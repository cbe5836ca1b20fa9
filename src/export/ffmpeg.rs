//! The user's `ffmpeg`, which encodes and decodes the videos of a dataset.
//!
//! Pictures go through its pipes as red, green, blue; a video is its standard input or output, a file that is open
//! already, so that no file has a name which ffmpeg chose, and one that was left behind writes to nothing that matters.
//!
//! Invariant: no wait is endless: each ends with the process, with `stop`, or after [`PATIENCE`] without any progress.
//! Invariant: a process does not outlive its [`Running`]: it leads a group that is killed. When this program is killed, the
//! pipe ends, and ffmpeg with it.
//! Invariant: a video is complete once it was read back: one frame for each row, at its time.

use std::ffi::OsStr;
use std::fs::File;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rapid_core::text;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::{Errno, ioctl_fionbio, read};
use rustix::process::{Pid, PidfdFlags, Signal, kill_process_group, pidfd_open};

use super::owned::COMMENT;
use super::picture::{Codec, Shape};

/// How long ffmpeg may take nothing, give nothing and not end: an encoder takes seconds for a large picture.
const PATIENCE: Duration = Duration::from_mins(5);
/// How soon a wait notices `stop`.
const NOTICE: Timespec = Timespec { tv_sec: 0, tv_nsec: 50_000_000 };
/// Bytes of its messages that are kept: the last ones.
const MESSAGES: usize = 1000;
/// Bytes of a pipe: a picture goes through it in few steps. As many as a user without privileges may have.
const PIPE: usize = 1 << 20;

/// Why there is no video, or no picture of one.
#[derive(Debug, thiserror::Error)]
pub enum FfmpegError {
    /// It cannot be started.
    #[error(
        "{}: {source}; videos are made by ffmpeg: `apt install ffmpeg`, or name it with --ffmpeg; --pictures jpeg needs none",
        program.display()
    )]
    Missing {
        /// The program.
        program: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// It was built without the encoder.
    #[error(
        "{} has no encoder {encoder}: use one that has it (`apt install ffmpeg`) with --ffmpeg, or --pictures {other}",
        program.display()
    )]
    Encoder {
        /// The program.
        program: PathBuf,
        /// The encoder.
        encoder: &'static str,
        /// Other forms of pictures.
        other: &'static str,
    },
    /// It ended otherwise than it should have.
    #[error("{}: {what}{}", program.display(), after_colon(messages))]
    Failed {
        /// The program.
        program: PathBuf,
        /// What happened.
        what: String,
        /// The end of what it printed to standard error.
        messages: String,
    },
    /// A pipe, or a file of its.
    #[error("{}: {source}", program.display())]
    Io {
        /// The program.
        program: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The user asked for the end.
    #[error("interrupted")]
    Interrupted,
}

fn after_colon(messages: &str) -> String {
    if messages.is_empty() { String::new() } else { format!(": {messages}") }
}

/// A program that can encode.
#[derive(Debug, Clone)]
pub struct Ffmpeg {
    program: PathBuf,
    codec: Codec,
    patience: Duration,
}

/// Whether to end.
pub(super) type Stop<'a> = &'a dyn Fn() -> bool;

impl Ffmpeg {
    /// The program at this path or, without one, on the PATH, if it has the encoder.
    ///
    /// # Errors
    /// When it does not exist, or cannot encode.
    pub fn find(program: Option<&Path>, codec: Codec, stop: &dyn Fn() -> bool) -> Result<Self, FfmpegError> {
        let program = program.unwrap_or(Path::new("ffmpeg")).to_owned();
        let found = Self { program, codec, patience: PATIENCE };
        let mut running = found.start(&["-hide_banner", "-encoders"], Stdio::null(), Stdio::piped())?;
        let mut list = Vec::new();
        let mut part = [0; 4096];
        loop {
            match running.read(&mut part, stop)? {
                0 => break,
                count => list.extend_from_slice(part.get(..count).unwrap_or_default()),
            }
        }
        running.end(stop)?;
        let has = String::from_utf8_lossy(&list).split_whitespace().any(|word| word == codec.encoder());
        let other = match codec {
            Codec::Av1 => "h264",
            Codec::H264 => "av1",
        };
        let encoder = codec.encoder();
        if has { Ok(found) } else { Err(FfmpegError::Encoder { program: found.program, encoder, other }) }
    }

    /// Encodes pictures of this shape, red, green, blue, which are written to it, into `file`.
    pub(super) fn encode(&self, shape: Shape, fps: u32, file: File) -> Result<Running, FfmpegError> {
        let (size, fps) = (format!("{}x{}", shape.width, shape.height), fps.to_string());
        let raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", &size, "-framerate", &fps, "-i", "pipe:0"];
        // By it a video without facts is known again as one of this program.
        let comment = format!("comment={COMMENT}");
        let end = ["-metadata", &comment, "-pix_fmt", "yuv420p", "-f", "mp4", "-y", "file:/dev/stdout"];
        self.start(&[&raw, self.codec.options(), &end].concat(), Stdio::piped(), file.into())
    }

    /// Decodes `file`; the pictures are read from it, each as one that was written to [`Self::encode`].
    pub(super) fn decode(&self, file: File) -> Result<Running, FfmpegError> {
        let words = ["-i", "file:/dev/stdin", "-map", "0:v:0", "-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"];
        self.start(&words, file.into(), Stdio::piped())
    }

    /// Reads all of `file` without decoding it. It has to have this many frames, one after the other.
    pub(super) fn check(&self, file: File, frames: usize, fps: u32, stop: Stop<'_>) -> Result<(), FfmpegError> {
        // By its own times: a video that begins late is not moved to 0.
        let words = ["-copyts", "-i", "file:/dev/stdin", "-map", "0:v:0", "-c", "copy", "-f", "framecrc", "pipe:1"];
        let mut running = self.start(&words, file.into(), Stdio::piped())?;
        let mut packets = Packets { fps, ..Packets::default() };
        let mut part = [0; 4096];
        loop {
            match running.read(&mut part, stop)? {
                0 => break,
                count => packets.feed(part.get(..count).unwrap_or_default()),
            }
        }
        let messages = running.end(stop)?;
        let failed = |what| FfmpegError::Failed { program: self.program.clone(), what, messages };
        match packets.wrong {
            _ if packets.count != frames => {
                let (found, expected) = (text::counted(packets.count as u64, "frame"), frames);
                Err(failed(format!("the video has {found}, and the episode {expected}")))
            }
            Some(line) => Err(failed(format!("frame {} of the video is not at its time: {line}", packets.first_wrong))),
            None => Ok(()),
        }
    }

    fn start(&self, words: &[&str], stdin: Stdio, stdout: Stdio) -> Result<Running, FfmpegError> {
        let missing = |source| FfmpegError::Missing { program: self.program.clone(), source };
        let mut command = Command::new(&self.program);
        command.args(["-nostdin", "-v", "error"].map(OsStr::new)).args(words);
        // The library of AV1 has a log of its own: errors alone.
        command.env("SVT_LOG", "1").env("AV_LOG_FORCE_NOCOLOR", "1");
        // A group of its own: an interrupt at the terminal is for this program, which ends it.
        let mut child =
            command.process_group(0).stdin(stdin).stdout(stdout).stderr(Stdio::piped()).spawn().map_err(missing)?;
        let stdin: Option<OwnedFd> = child.stdin.take().map(Into::into);
        let stdout: Option<OwnedFd> = child.stdout.take().map(Into::into);
        let stderr: Option<OwnedFd> = child.stderr.take().map(Into::into);
        let process = Pid::from_child(&child);
        let ended = pidfd_open(process, PidfdFlags::NONBLOCK).map_err(|error| missing(error.into()));
        let mut running = Running {
            program: self.program.clone(),
            patience: self.patience,
            child,
            ended: None,
            stdin,
            stdout,
            stderr,
            messages: Vec::new(),
            status: None,
        };
        running.ended = Some(ended?);
        running.prepare().map_err(|source| running.io(source))?;
        Ok(running)
    }
}

/// What is waited for.
#[derive(Debug, Clone, Copy)]
enum End {
    Stdin,
    Stdout,
    Process,
}

/// A process of ffmpeg. Dropped before its end, it is killed.
#[derive(Debug)]
pub(super) struct Running {
    program: PathBuf,
    patience: Duration,
    child: Child,
    /// Readable once it has ended.
    ended: Option<OwnedFd>,
    stdin: Option<OwnedFd>,
    stdout: Option<OwnedFd>,
    stderr: Option<OwnedFd>,
    messages: Vec<u8>,
    status: Option<ExitStatus>,
}

impl Running {
    fn prepare(&mut self) -> io::Result<()> {
        for pipe in [&self.stdin, &self.stdout, &self.stderr].into_iter().flatten() {
            ioctl_fionbio(pipe, true)?;
        }
        for pipe in [&self.stdin, &self.stdout].into_iter().flatten() {
            // A user may have too many pipes for it: it is slower then.
            let _ = rustix::pipe::fcntl_setpipe_size(pipe, PIPE);
        }
        Ok(())
    }

    /// Writes all of `bytes` to it.
    ///
    /// # Errors
    /// When it ends before, or `stop` is set.
    pub(super) fn write(&mut self, mut bytes: &[u8], stop: Stop<'_>) -> Result<(), FfmpegError> {
        while !bytes.is_empty() {
            let Some(stdin) = &self.stdin else { return Err(self.failed("it reads nothing".to_owned())) };
            match rustix::io::write(stdin, bytes) {
                Ok(count) => bytes = bytes.get(count..).unwrap_or_default(),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => self.wait(End::Stdin, stop)?,
                Err(Errno::PIPE) => {
                    self.end(stop)?;
                    return Err(self.failed("it ended before the last picture".to_owned()));
                }
                Err(error) => return Err(self.io(error.into())),
            }
        }
        Ok(())
    }

    /// Reads what it gives, as far as there is room; 0 at the end.
    ///
    /// # Errors
    /// When `stop` is set.
    pub(super) fn read(&mut self, into: &mut [u8], stop: Stop<'_>) -> Result<usize, FfmpegError> {
        let mut filled = 0;
        while filled < into.len() {
            let Some(stdout) = &self.stdout else { break };
            match read(stdout, into.get_mut(filled..).unwrap_or_default()) {
                Ok(0) => break,
                Ok(count) => filled += count,
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => self.wait(End::Stdout, stop)?,
                Err(error) => return Err(self.io(error.into())),
            }
        }
        Ok(filled)
    }

    /// Waits for its end after the last picture; returns its messages.
    ///
    /// # Errors
    /// When it failed, or `stop` is set.
    pub(super) fn end(&mut self, stop: Stop<'_>) -> Result<String, FfmpegError> {
        self.stdin = None;
        if self.status.is_none() {
            self.wait(End::Process, stop)?;
            let status = self.child.wait().map_err(|error| self.io(error))?;
            self.status = Some(status);
            self.collect();
        }
        match self.status {
            Some(status) if !status.success() => Err(self.failed(status.to_string())),
            _ => Ok(self.messages()),
        }
    }

    /// Waits until one of its ends is ready, and collects its messages meanwhile.
    fn wait(&mut self, end: End, stop: Stop<'_>) -> Result<(), FfmpegError> {
        let begun = Instant::now();
        loop {
            let ready = {
                let (awaited, flags) = match end {
                    End::Stdin => (&self.stdin, PollFlags::OUT),
                    End::Stdout => (&self.stdout, PollFlags::IN),
                    End::Process => (&self.ended, PollFlags::IN),
                };
                let messages = self.stderr.iter().map(|end| PollFd::new(end, PollFlags::IN));
                let awaited = awaited.iter().map(|end| PollFd::new(end, flags));
                let mut ends: Vec<PollFd<'_>> = awaited.chain(messages).collect();
                match poll(&mut ends, Some(&NOTICE)) {
                    Ok(_) | Err(Errno::INTR) => {}
                    Err(error) => return Err(self.io(error.into())),
                }
                ends.first().is_some_and(|end| !end.revents().is_empty())
            };
            self.collect();
            if ready {
                return Ok(());
            }
            if stop() {
                return Err(FfmpegError::Interrupted);
            }
            if begun.elapsed() > self.patience {
                let what = format!("no progress for {} s: it was killed", self.patience.as_secs());
                return Err(self.failed(what));
            }
        }
    }

    fn collect(&mut self) {
        let mut part = [0; 1024];
        while let Some(stderr) = &self.stderr {
            match read(stderr.as_fd(), &mut part) {
                Ok(0) => self.stderr = None,
                Ok(count) => self.messages.extend_from_slice(part.get(..count).unwrap_or_default()),
                Err(Errno::INTR) => {}
                Err(_) => break,
            }
            let excess = self.messages.len().saturating_sub(MESSAGES);
            self.messages.drain(..excess);
        }
    }

    fn messages(&self) -> String {
        let messages = String::from_utf8_lossy(&self.messages);
        let lines: Vec<_> = messages.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        text::plain(&lines.join("; ")).into_owned()
    }

    fn failed(&self, what: String) -> FfmpegError {
        FfmpegError::Failed { program: self.program.clone(), what, messages: self.messages() }
    }

    fn io(&self, source: io::Error) -> FfmpegError {
        FfmpegError::Io { program: self.program.clone(), source }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if self.status.is_none() {
            // It was not waited for: no other process can have got its number.
            let _ = kill_process_group(Pid::from_child(&self.child), Signal::KILL);
            let _ = self.child.wait();
        }
    }
}

/// What the muxer `framecrc` prints of a video: `#tb 0: 1/15360`, and a line of each frame:
/// `stream, dts, pts, duration, size, checksum`.
#[derive(Debug, Default)]
struct Packets {
    fps: u32,
    /// Seconds a unit of time: a quotient.
    base: (u128, u128),
    line: Vec<u8>,
    count: usize,
    /// The first frame that is not at its time.
    wrong: Option<String>,
    first_wrong: usize,
}

impl Packets {
    fn feed(&mut self, bytes: &[u8]) {
        for byte in bytes {
            if *byte == b'\n' {
                let line = String::from_utf8_lossy(&std::mem::take(&mut self.line)).into_owned();
                self.take_line(&line);
            } else if self.line.len() < MESSAGES {
                self.line.push(*byte);
            }
        }
    }

    fn take_line(&mut self, line: &str) {
        if let Some(base) = line.strip_prefix("#tb 0:") {
            let parts = base.trim().split_once('/');
            self.base = parts.and_then(|(one, of)| Some((one.parse().ok()?, of.parse().ok()?))).unwrap_or_default();
        } else if !line.starts_with('#') && !line.trim().is_empty() {
            let time: Option<u128> = line.split(',').nth(2).and_then(|pts| pts.trim().parse().ok());
            let (one, of) = self.base;
            let expected = (self.count as u128).checked_mul(of);
            let found = time.and_then(|time| time.checked_mul(one)?.checked_mul(self.fps.into()));
            if (found.is_none() || found != expected || of == 0) && self.wrong.is_none() {
                (self.wrong, self.first_wrong) = (Some(line.trim().to_owned()), self.count);
            }
            self.count += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A script in the place of ffmpeg.
    fn script(folder: &Path, body: &str) -> Ffmpeg {
        let program = folder.join("ffmpeg");
        crate::executable::script(&program, &format!("#!/bin/sh\n{body}\n"));
        Ffmpeg { program, codec: Codec::Av1, patience: PATIENCE }
    }

    const SHAPE: Shape = Shape { height: 480, width: 640, channels: 3 };

    fn file() -> File {
        tempfile::tempfile().unwrap()
    }

    #[test]
    fn a_program_that_is_absent_or_cannot_encode_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let find = |program: &Path| Ffmpeg::find(Some(program), Codec::H264, &|| false).unwrap_err().to_string();
        let absent = find(Path::new("/no/such/ffmpeg"));
        assert!(absent.starts_with("/no/such/ffmpeg: ") && absent.contains("apt install ffmpeg"), "{absent}");
        let other = script(folder.path(), "echo ' V..... libsvtav1 AV1'");
        let refused = find(&other.program);
        assert!(refused.contains("has no encoder libx264") && refused.contains("--pictures av1"), "{refused}");
        assert!(Ffmpeg::find(Some(&other.program), Codec::Av1, &|| false).is_ok());
        let broken = find(&script(folder.path(), "echo no libraries >&2; exit 127").program);
        assert!(broken.ends_with("exit status: 127: no libraries"), "{broken}");
    }

    #[test]
    fn one_that_ends_early_is_an_error_with_its_last_messages() {
        let folder = tempfile::tempdir().unwrap();
        let picture = vec![0; 640 * 480 * 3];
        let write = |body: &str| {
            let mut running = script(folder.path(), body).encode(SHAPE, 30, file()).unwrap();
            let written = (0..100).try_for_each(|_| running.write(&picture, &|| false));
            written.unwrap_err().to_string()
        };
        let failed = write("yes 'a line' | head -n 40000 >&2; echo no space >&2; exit 1");
        assert!(failed.contains("exit status: 1: ") && failed.ends_with("a line; no space"), "{failed}");
        assert!(failed.len() < 2 * MESSAGES, "{}", failed.len());
        let ended = write("head -c 1000 >/dev/null");
        assert!(ended.ends_with("it ended before the last picture"), "{ended}");
    }

    #[test]
    fn one_that_hangs_is_killed_with_what_it_started() {
        let folder = tempfile::tempdir().unwrap();
        let (picture, mark) = (vec![0; 640 * 480 * 3], folder.path().join("pid"));
        let mut ffmpeg = script(folder.path(), &format!("sleep 1000 & echo $! >{}; wait", mark.display()));
        let write = |ffmpeg: &Ffmpeg, stop: Stop<'_>| {
            let mut running = ffmpeg.encode(SHAPE, 30, file()).unwrap();
            (0..100).try_for_each(|_| running.write(&picture, stop)).unwrap_err()
        };
        let started = || std::fs::read_to_string(&mark).is_ok_and(|text| text.ends_with('\n'));
        assert!(matches!(write(&ffmpeg, &started), FfmpegError::Interrupted));
        let process: i32 = std::fs::read_to_string(&mark).unwrap().trim().parse().unwrap();
        let state = || std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
        // Killed and, until its new parent has waited for it, a zombie.
        while !(state().is_empty() || state().contains(") Z ")) {
            std::thread::yield_now();
        }
        ffmpeg.patience = Duration::from_millis(1);
        let text = write(&ffmpeg, &|| false).to_string();
        assert!(text.contains("no progress for 0 s"), "{text}");
    }

    #[test]
    fn each_frame_has_to_be_at_its_time() {
        let packets = |text: &str| {
            let mut packets = Packets { fps: 30, ..Packets::default() };
            text.as_bytes().chunks(7).for_each(|part| packets.feed(part));
            (packets.count, packets.wrong.map(|_| packets.first_wrong))
        };
        let head = "#software: Lavf59.27.100\n#tb 0: 1/15360\n#media_type 0: video\n";
        let line = |pts: u64| format!("0, {pts}, {pts}, 512, 3370, 0x27b1e2a1\n");
        assert_eq!(packets(&[head, &line(0), &line(512), &line(1024)].concat()), (3, None));
        assert_eq!(packets(&[head, &line(0), &line(1024)].concat()), (2, Some(1)));
        assert_eq!(packets(&[head, &line(1), &line(512)].concat()), (2, Some(0)));
        assert_eq!(packets(&line(0)), (1, Some(0)), "without a unit of time");
        assert_eq!(packets(head), (0, None));
        assert_eq!(packets("#tb 0: x\n#tb 0: 1/0\n,,\n,,-1,\n"), (2, Some(0)));
    }
}
