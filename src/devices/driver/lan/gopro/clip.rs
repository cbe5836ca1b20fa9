//! A clip that a camera recorded during an episode: noted beside the episode's file, and fetched.
//!
//! Beside `NAME.mcap` the note is `NAME.DEVICE.clip.json` (of a further clip of the same episode
//! `NAME.DEVICE.FILE.clip.json`) and the clip `NAME.DEVICE.FILE`; while the clip is being
//! fetched its name ends in `.partial`, and a partial file is continued.
//!
//! Invariant: strings from the camera become part of a path only if they are plain names.
//! Invariant: a byte is written at its proper offset or not at all, by one fetch at a time, however often a fetch is
//! started, interrupted and restarted.
//! Invariant: an episode keeps its space on the disk, whatever size the camera reports for the clip.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use hyper::StatusCode;
use hyper::header::{CONTENT_LENGTH, CONTENT_RANGE};
use rapid_system::disk::Disk;
use rustix::fs::FlockOperation;
use rustix::io::Errno;
use tokio::time::timeout;

use super::super::address::Server;
use super::super::http::{self, Reply};
use super::answer::{Name, is_plain};

const HEAD_LIMIT: Duration = Duration::from_secs(5);
/// A camera that sends nothing for this long has stopped.
const SILENCE_LIMIT: Duration = Duration::from_secs(10);
/// A fetch resumes where it stopped; number of attempts without any progress.
const TRIES: u32 = 3;
const PAUSE: Duration = Duration::from_secs(1);
/// Bytes written to the disk at once.
const BLOCK: usize = 1 << 20;
/// A note has a few hundred bytes.
const LARGEST_NOTE: u64 = 64 << 10;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Clip {
    pub(super) name: Name,
    /// Bytes, if the camera reports them.
    pub(super) size: Option<u64>,
    pub(super) episode: PathBuf,
    device: String,
    /// The episode has a clip before it: the shutter was started again.
    pub(super) is_further: bool,
}

/// Why a clip was not fetched.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Failure {
    /// It stays on the camera and may be fetched later.
    Stays(String),
    /// The camera no longer has it.
    Lost(String),
}

impl Clip {
    pub(super) fn new(name: Name, size: Option<u64>, episode: PathBuf, device: &str) -> Self {
        Self { name, size, episode, device: device.to_owned(), is_further: false }
    }

    /// The clip described by the note at this path; `None` if it is not one of our notes.
    pub(super) fn of_note(path: &Path) -> Option<Self> {
        let text = rapid_system::folder::read_text(path, LARGEST_NOTE).ok()?;
        Self::read(path, &text)
    }

    pub(super) fn read(path: &Path, text: &str) -> Option<Self> {
        let written: serde_json::Value = serde_json::from_str(text).ok()?;
        let plain = |key: &str| Some(written.get(key)?.as_str().filter(|name| is_plain(name))?.to_owned());
        let device = plain("device")?;
        let name = Name { folder: plain("folder")?, file: plain("file")? };
        let note = |what: &str| path.file_name()?.to_str()?.strip_suffix(&format!(".{what}.clip.json"));
        let further = note(&format!("{device}.{}", name.file));
        let is_further = further.is_some();
        let stem = further.or_else(|| note(&device))?;
        let episode = path.with_file_name(format!("{stem}.mcap"));
        let size = written.get("size").and_then(serde_json::Value::as_u64);
        (!stem.is_empty()).then_some(Self { name, size, episode, device, is_further })
    }

    fn path(&self) -> String {
        format!("/videos/DCIM/{}/{}", self.name.folder, self.name.file)
    }

    pub(super) fn url(&self, server: &Server) -> String {
        format!("http://{}{}", server.address, self.path())
    }

    fn beside(&self, end: &str) -> PathBuf {
        let stem = self.episode.file_stem().unwrap_or_default().to_string_lossy();
        self.episode.with_file_name(format!("{stem}.{}.{end}", self.device))
    }

    /// Path of the clip.
    pub(super) fn target(&self) -> PathBuf {
        self.beside(&self.name.file)
    }

    pub(super) fn note_path(&self) -> PathBuf {
        if self.is_further { self.beside(&format!("{}.clip.json", self.name.file)) } else { self.beside("clip.json") }
    }

    /// Writes the note.
    pub(super) fn note(&self, url: &str) -> io::Result<()> {
        let Name { folder, file } = &self.name;
        let note = serde_json::json!({
            "device": self.device, "folder": folder, "file": file, "size": self.size, "url": url,
        });
        std::fs::write(self.note_path(), format!("{note:#}\n"))
    }
}

/// Fetches the clip, continuing an earlier attempt. `reserve` is the registry's `disk_reserve`.
pub(super) async fn fetch(clip: Clip, server: Server, reserve: Option<u64>) -> Result<(), Failure> {
    let target = clip.target();
    if target.exists() {
        return Ok(());
    }
    let mut part = target.clone().into_os_string();
    part.push(".partial");
    let part = PathBuf::from(part);
    let mut progress = FetchProgress { device: clip.device.clone(), file: clip.name.file.clone(), reported: 0 };
    let (mut failed, mut furthest) = (0, length(&part));
    loop {
        let attempted = async {
            let part = Part::open(&part, clip.size, reserve).await?;
            attempt(&clip, &server, part, &mut progress).await
        };
        let error = match attempted.await {
            Ok(()) => break,
            Err(Broken::Finally(failure)) => return Err(failure),
            Err(Broken::Off(reason)) => reason,
        };
        let there = length(&part);
        // A download that restarts each time makes no progress.
        failed = if there > furthest { 0 } else { failed + 1 };
        furthest = furthest.max(there);
        if failed == TRIES {
            return Err(Failure::Stays(error));
        }
        tokio::time::sleep(PAUSE).await;
    }
    let renamed = std::fs::rename(&part, &target);
    renamed.map_err(|error| Failure::Stays(format!("{}: {error}", target.display())))?;
    tracing::info!(device = clip.device, "{} fetched: {}", clip.name.file, target.display());
    Ok(())
}

enum Broken {
    /// Retrying may help.
    Off(String),
    Finally(Failure),
}

fn off(error: impl std::fmt::Display) -> Broken {
    Broken::Off(error.to_string())
}

fn stays(reason: impl std::fmt::Display) -> Broken {
    Broken::Finally(Failure::Stays(reason.to_string()))
}

async fn attempt(clip: &Clip, server: &Server, mut part: Part, progress: &mut FetchProgress) -> Result<(), Broken> {
    let mut reply = http::get(server, &clip.path(), part.there, HEAD_LIMIT).await.map_err(off)?;
    match reply.status {
        StatusCode::PARTIAL_CONTENT if begins(&reply) == Some(part.there) => {}
        StatusCode::PARTIAL_CONTENT => {
            part.begin_again()?;
            return Err(off("the camera continued at another byte than requested"));
        }
        // It is complete.
        StatusCode::RANGE_NOT_SATISFIABLE if part.there > 0 && clip.size == Some(part.there) => return Ok(()),
        StatusCode::RANGE_NOT_SATISFIABLE if part.there > 0 => {
            part.begin_again()?;
            return Err(off("more is there than the camera has"));
        }
        status @ (StatusCode::NOT_FOUND | StatusCode::GONE) => {
            return Err(Broken::Finally(Failure::Lost(format!("the camera answers {status}"))));
        }
        status if status.is_success() => part.begin_again()?,
        status => return Err(stays(format_args!("the camera answers {status}"))),
    }
    let from = part.there;
    let whole = match announced(&reply) {
        Some(rest) => {
            Some(from.checked_add(rest).ok_or_else(|| stays("the camera announces more than any disk holds"))?)
        }
        None => clip.size,
    };
    part.has_room(whole.unwrap_or(0).saturating_sub(from))?;
    let mut block = Vec::with_capacity(BLOCK);
    loop {
        let bytes = match timeout(SILENCE_LIMIT, reply.next()).await {
            Ok(Ok(bytes)) => bytes,
            Ok(Err(error)) => return Err(off(error)),
            Err(_) => return Err(off(format_args!("nothing came for {} s", SILENCE_LIMIT.as_secs()))),
        };
        let is_last = bytes.is_none();
        block.extend_from_slice(&bytes.unwrap_or_default());
        if block.len() >= BLOCK || is_last {
            let got = part.there.saturating_add(block.len() as u64);
            if whole.is_some_and(|whole| got > whole) {
                return Err(stays("the camera sends more than it announced"));
            }
            (part, block) = part.write(block, is_last).await?;
            progress.notify(got, whole);
        }
        if is_last {
            break;
        }
    }
    match whole {
        Some(whole) if part.there < whole => {
            Err(off(format_args!("the camera stopped at {} of {whole} bytes", part.there)))
        }
        _ if part.file.metadata().map(|metadata| metadata.len()).ok() != Some(part.there) => {
            part.begin_again()?;
            Err(off("what was written is not what came"))
        }
        _ => Ok(()),
    }
}

/// The partial file of a clip, locked by this fetch until it is dropped.
#[derive(Debug)]
struct Part {
    file: File,
    path: PathBuf,
    /// Bytes fetched so far.
    there: u64,
    /// Space that must stay free on the disk, if the registry requires it.
    reserve: Option<u64>,
}

impl Part {
    /// `size` is the size of the clip, if known: a longer file belongs to another clip.
    async fn open(path: &Path, size: Option<u64>, reserve: Option<u64>) -> Result<Self, Broken> {
        let path = path.to_owned();
        let named = path.display().to_string();
        let open = move || {
            let file = OpenOptions::new().create(true).truncate(false).write(true).open(&path)?;
            // An abandoned fetch may still be writing its last block.
            let locked = rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive);
            // Not every file system supports locks.
            if locked == Err(Errno::WOULDBLOCK) {
                return Err(Errno::WOULDBLOCK.into());
            }
            let there = file.metadata()?.len();
            let mut part = Self { file, path, there, reserve };
            if size.is_some_and(|size| part.there > size) {
                part.truncate()?;
            }
            io::Result::Ok(part)
        };
        match tokio::task::spawn_blocking(open).await.map_err(off)? {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => Err(off("another program is fetching it")),
            opened => opened.map_err(|error| stays(format_args!("{named}: {error}"))),
        }
    }

    fn truncate(&mut self) -> io::Result<()> {
        self.file.set_len(0)?;
        self.there = 0;
        Ok(())
    }

    fn begin_again(&mut self) -> Result<(), Broken> {
        self.truncate().map_err(|error| stays(format_args!("{}: {error}", self.path.display())))
    }

    /// Checks that this many more bytes fit on the disk.
    fn has_room(&self, bytes: u64) -> Result<(), Broken> {
        full(&self.file, bytes, self.reserve).map_or(Ok(()), |full| Err(stays(full)))
    }

    /// Writes the next block and returns it empty.
    async fn write(self, mut block: Vec<u8>, is_last: bool) -> Result<(Self, Vec<u8>), Broken> {
        let named = self.path.display().to_string();
        let write = move || {
            let Self { file, path, there, reserve } = self;
            let bytes = block.len() as u64;
            // Recordings use the same disk.
            if let Some(full) = full(&file, bytes, reserve) {
                return Err(io::Error::other(full));
            }
            file.write_all_at(&block, there)?;
            block.clear();
            if is_last {
                file.sync_all()?;
            }
            Ok((Self { file, path, there: there.saturating_add(bytes), reserve }, block))
        };
        let written = tokio::task::spawn_blocking(write).await.map_err(off)?;
        written.map_err(|error| stays(format_args!("{named}: {error}")))
    }
}

/// Why this many more bytes do not fit on the disk of `file`; `None` if they do, or the file system reports no space.
/// Episodes keep their space: twice the registry's `disk_reserve`, the level at which an episode is warned.
fn full(file: &File, bytes: u64, reserve: Option<u64>) -> Option<String> {
    let disk = Disk::of_file(file).ok().filter(|disk| disk.lacks_room_beside_an_episode(bytes, reserve))?;
    let (wanted, free) = (bytes.div_ceil(1 << 20), disk.free >> 20);
    let kept = disk.reserve(reserve).saturating_mul(2) >> 20;
    Some(format!(
        "{wanted} MB do not fit on the disk: {free} MB are free, and {kept} MB are kept for episodes (disk_reserve under \
         [rig]); remove or move recordings"
    ))
}

fn announced(reply: &Reply) -> Option<u64> {
    reply.header(CONTENT_LENGTH)?.parse().ok()
}

/// The start offset of a part: `bytes 10-99/100` (RFC 9110, 14.4).
fn begins(reply: &Reply) -> Option<u64> {
    reply.header(CONTENT_RANGE)?.trim().strip_prefix("bytes ")?.split_once('-')?.0.trim().parse().ok()
}

fn length(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |metadata| metadata.len())
}

/// Reports progress in steps of a tenth.
#[derive(Debug)]
struct FetchProgress {
    device: String,
    file: String,
    reported: u64,
}

impl FetchProgress {
    fn notify(&mut self, got: u64, whole: Option<u64>) {
        let Some(whole) = whole.filter(|whole| *whole > 0) else { return };
        let tenth = got.saturating_mul(10) / whole;
        if tenth > self.reported {
            self.reported = tenth;
            tracing::info!(device = self.device, "fetching {}: {} %", self.file, tenth * 10);
        }
    }
}
