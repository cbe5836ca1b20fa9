//! A clip that a camera recorded during an episode: noted beside the episode's file, and fetched.
//!
//! Beside `NAME.mcap` the note is `NAME.DEVICE.clip.json`, the clip `NAME.DEVICE.FILE`; while it is being
//! fetched its name ends in `.partial`, and what is there is gone on with.
//!
//! Invariant: the camera's words become part of a path only if they are plain names.

use std::fs::{File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use hyper::StatusCode;
use hyper::header::CONTENT_LENGTH;
use tokio::time::timeout;

use super::super::http::{self, Reply};
use super::super::place::Server;

const HEAD_LIMIT: Duration = Duration::from_secs(5);
/// A camera that sends nothing for this long has stopped.
const SILENCE_LIMIT: Duration = Duration::from_secs(10);
/// A clip is asked for again where it broke off, so often without any progress.
const TRIES: u32 = 3;
/// Written to the disk at once, bytes.
const BLOCK: usize = 1 << 20;
/// What a clip leaves free on the disk, bytes: episodes need it more.
const RESERVE: u64 = 1 << 30;

/// See the module's comment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Clip {
    pub(super) folder: String,
    pub(super) file: String,
    /// Bytes, if the camera says.
    pub(super) size: Option<u64>,
    episode: PathBuf,
    device: String,
}

impl Clip {
    pub(super) fn new(folder: String, file: String, episode: PathBuf, device: &str) -> Self {
        Self { folder, file, size: None, episode, device: device.to_owned() }
    }

    fn path(&self) -> String {
        format!("/videos/DCIM/{}/{}", self.folder, self.file)
    }

    pub(super) fn url(&self, server: &Server) -> String {
        format!("http://{}{}", server.address, self.path())
    }

    fn beside(&self, end: &str) -> PathBuf {
        let stem = self.episode.file_stem().unwrap_or_default().to_string_lossy();
        self.episode.with_file_name(format!("{stem}.{}.{end}", self.device))
    }

    /// Where the clip goes.
    pub(super) fn target(&self) -> PathBuf {
        self.beside(&self.file)
    }

    /// Writes the note.
    pub(super) fn note(&self, url: &str) -> io::Result<()> {
        let note = serde_json::json!({
            "device": self.device, "folder": self.folder, "file": self.file, "size": self.size, "url": url,
        });
        std::fs::write(self.beside("clip.json"), format!("{note:#}\n"))
    }
}

/// Folder and file, from the camera's answer to `last_captured`.
pub(super) fn named(answer: &[u8]) -> Result<(String, String), String> {
    let answer: serde_json::Value = serde_json::from_slice(answer).map_err(|error| error.to_string())?;
    let name = |key: &str| {
        let name = answer.get(key).and_then(serde_json::Value::as_str).unwrap_or_default();
        if is_plain(name) { Ok(name.to_owned()) } else { Err(format!("{key} {name:?} is no plain name")) }
    };
    Ok((name("folder")?, name("file")?))
}

/// The size that the camera tells of a clip, as text or number.
pub(super) fn size(info: &[u8]) -> Option<u64> {
    let info: serde_json::Value = serde_json::from_slice(info).ok()?;
    let size = info.get("s")?;
    size.as_u64().or_else(|| size.as_str()?.parse().ok())
}

fn is_plain(name: &str) -> bool {
    let legal = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-' | b'.');
    (1..=64).contains(&name.len()) && !name.starts_with('.') && name.bytes().all(legal)
}

/// Fetches the clip, from where an earlier try ended.
pub(super) async fn fetch(clip: Clip, server: Server) -> Result<(), String> {
    let target = clip.target();
    if target.exists() {
        return Ok(());
    }
    let mut part = target.clone().into_os_string();
    part.push(".partial");
    let part = PathBuf::from(part);
    let mut progress = Progress { device: clip.device.clone(), file: clip.file.clone(), told: 0 };
    let mut failed = 0;
    loop {
        let there = length(&part);
        let error = match attempt(&clip, &server, &part, there, &mut progress).await {
            Ok(()) => break,
            Err(Failure::Final(reason)) => return Err(reason),
            Err(Failure::Broke(reason)) => reason,
        };
        failed = if length(&part) > there { 0 } else { failed + 1 };
        if failed == TRIES {
            return Err(error);
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    std::fs::rename(&part, &target).map_err(|error| format!("{}: {error}", target.display()))?;
    tracing::info!(device = clip.device, "{} fetched: {}", clip.file, target.display());
    Ok(())
}

enum Failure {
    /// Asking again may help.
    Broke(String),
    Final(String),
}

async fn attempt(
    clip: &Clip,
    server: &Server,
    part: &Path,
    there: u64,
    progress: &mut Progress,
) -> Result<(), Failure> {
    let broke = |error: &dyn std::fmt::Display| Failure::Broke(error.to_string());
    let mut reply = http::get(server, &clip.path(), there, HEAD_LIMIT).await.map_err(|error| broke(&error))?;
    let from = match reply.status {
        StatusCode::PARTIAL_CONTENT => there,
        // All of it is there.
        StatusCode::RANGE_NOT_SATISFIABLE if there > 0 && clip.size == Some(there) => return Ok(()),
        status if status.is_success() => 0,
        status => return Err(Failure::Final(format!("the camera answers {status}"))),
    };
    let whole = announced(&reply).map(|rest| from + rest).or(clip.size);
    if let (Some(whole), Some(room)) = (whole, room(part))
        && (whole - from).saturating_add(RESERVE) > room
    {
        return Err(Failure::Final(format!("{} MB do not fit on the disk", (whole - from) >> 20)));
    }
    let mut file = open(part, from).map_err(|error| Failure::Final(format!("{}: {error}", part.display())))?;
    let (mut block, mut got) = (Vec::with_capacity(BLOCK), from);
    loop {
        let bytes = match timeout(SILENCE_LIMIT, reply.next()).await {
            Ok(Ok(bytes)) => bytes,
            Ok(Err(error)) => return Err(broke(&error)),
            Err(_) => return Err(Failure::Broke(format!("nothing came for {} s", SILENCE_LIMIT.as_secs()))),
        };
        let is_last = bytes.is_none();
        block.extend_from_slice(&bytes.unwrap_or_default());
        if block.len() >= BLOCK || is_last {
            got += block.len() as u64;
            if whole.is_some_and(|whole| got > whole) {
                return Err(Failure::Final("the camera sends more than it announced".to_owned()));
            }
            let written = tokio::task::spawn_blocking(move || {
                file.write_all(&block)?;
                block.clear();
                if is_last {
                    file.sync_all()?;
                }
                io::Result::Ok((file, block))
            });
            let written = written.await.map_err(|error| broke(&error))?;
            (file, block) = written.map_err(|error| Failure::Final(format!("{}: {error}", part.display())))?;
            progress.tell(got, whole);
        }
        if is_last {
            break;
        }
    }
    match whole {
        Some(whole) if got < whole => Err(Failure::Broke(format!("the camera stopped at {got} of {whole} bytes"))),
        _ => Ok(()),
    }
}

fn announced(reply: &Reply) -> Option<u64> {
    reply.header(CONTENT_LENGTH)?.parse().ok()
}

fn length(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |metadata| metadata.len())
}

/// Bytes that are free where `path` is to be.
fn room(path: &Path) -> Option<u64> {
    let disk = rustix::fs::statvfs(path.parent()?).ok()?;
    disk.f_bavail.checked_mul(disk.f_frsize)
}

fn open(path: &Path, from: u64) -> io::Result<File> {
    let file = OpenOptions::new().create(true).append(true).open(path)?;
    if from == 0 {
        file.set_len(0)?;
    }
    Ok(file)
}

/// Tells every tenth.
#[derive(Debug)]
struct Progress {
    device: String,
    file: String,
    told: u64,
}

impl Progress {
    fn tell(&mut self, got: u64, whole: Option<u64>) {
        let Some(whole) = whole.filter(|whole| *whole > 0) else { return };
        let tenth = got.saturating_mul(10) / whole;
        if tenth > self.told {
            self.told = tenth;
            tracing::info!(device = self.device, "fetching {}: {} %", self.file, tenth * 10);
        }
    }
}
