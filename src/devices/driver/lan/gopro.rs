//! GoPro cameras over USB: the camera is a network adapter with an HTTP server behind it.
//!
//! The requests are those of Open GoPro (gopro.github.io/OpenGoPro, HTTP, version 2.0): wired control on, clock set,
//! then every 3 s a keep-alive and a query of the camera's state, which is the sample, in JSON:
//! `{"recording":bool,"busy":bool,"battery_percent":n,"card_free_kb":n,"remaining_s":n}`, null for unknown values. The
//! shutter starts and stops with an episode (`camera`); its clip's name is written beside the episode, and the clip is
//! fetched if the entry requests it (`clip`), by the next run if this one ends before. What the shutter does is reported
//! ([`ClipNotice`]): whether the camera recorded an episode is part of the verdict on it.
//!
//! The camera gives itself 172.2X.1YZ.51 and its host an address in the same network; XYZ are the last digits of its
//! serial number.
//!
//! State that must outlive a connection to a camera, and the run, is in `gopro/SERIAL.json` in the state directory
//! ([`Books`]): that this program started its shutter, for which episode, and which clips must still be fetched. SERIAL
//! is the camera's serial number, or without one the name of its entry. For a clip only the path of its note is stored:
//! if a user moves or removes an episode with its note, its clip is not fetched.
//!
//! Invariant: a task communicates with the camera; readers and senders of requests never wait for it.
//! Invariant: however the connection or the run ends, the camera's next driver knows the shutter started by this
//! program and the clips still to be fetched ([`Books`]).

mod answer;
mod camera;
mod clip;
pub(super) mod preview;

use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::clip::{ClipNotice, ClipState};
use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use rapid_registry::LanPicture;
use rapid_system::folder::{Folder, Links, Missing, Sync, read_text, state_directory};
use serde::{Deserialize, Serialize};
use tokio::sync::{mpsc, watch};
use tokio::time::sleep;
use tokio_util::task::AbortOnDropHandle;

use self::answer::{Name, State};
use self::camera::{Camera, ReportedEpisode, TimeLimits};
use self::clip::Clip;
use self::preview::Preview;
use super::address::{DeviceAddress, Server};
use super::http;
use crate::driver::{DriverError, Reading};

/// The camera answers within a tenth of a second, even while encoding.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
/// The state is 5 KB of numbers.
const LARGEST_ANSWER: usize = 256 << 10;
/// The host requests its address from the camera (DHCP), which takes a moment after the plug.
const ADDRESS_LIMIT: Duration = Duration::from_secs(8);
const LOOK_FOR_ADDRESS: Duration = Duration::from_millis(200);
/// A missing answer is requested again.
const TRIES: u32 = 2;

/// Notices that wait to be read.
const NOTICES: usize = 64;

/// Reports what the camera's own recording does.
#[derive(Debug, Clone)]
struct ClipReports(mpsc::Sender<ClipNotice>);

impl ClipReports {
    fn send(&self, state: ClipState, text: String) {
        // Without room nobody reads them any more.
        let _ = self.0.try_send(ClipNotice { state, text });
    }
}

/// How clips are handled.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clips {
    /// They are fetched after the episode.
    pub(super) download: bool,
    /// `disk_reserve` of the registry, bytes.
    pub(super) reserve: Option<u64>,
}

#[derive(Debug)]
pub(super) struct Gopro {
    states: mpsc::Receiver<Result<State, DriverError>>,
    reported: watch::Sender<ReportedEpisode>,
    clips: ClipReports,
    notices: Option<mpsc::Receiver<ClipNotice>>,
    task: AbortOnDropHandle<()>,
    model: Option<String>,
    payload: Vec<u8>,
    /// Its pictures are the samples, not its states.
    preview: Option<Preview>,
}

impl Gopro {
    /// `preview`: the samples are pictures of this size, of at most so many bytes.
    pub(super) async fn open(
        name: &str,
        place: &DeviceAddress,
        port: u16,
        clips: Clips,
        preview: Option<(LanPicture, usize)>,
    ) -> Result<Self, DriverError> {
        let place = match place.peer() {
            Some(_) => place.clone(),
            None => place.at(address(place).await?.into()),
        };
        let server = place.server(port)?;
        let mut camera = Self::begin(name, server.clone(), clips, state_directory(), TimeLimits::USUAL).await?;
        if let Some((picture, largest)) = preview {
            camera.preview = Some(Preview::begin(name, &server, picture, largest).await?);
        }
        Ok(camera)
    }

    /// `state` is the folder of the books.
    async fn begin(
        name: &str,
        server: Server,
        clips: Clips,
        state: Option<PathBuf>,
        limits: TimeLimits,
    ) -> Result<Self, DriverError> {
        ask(&server, "/gopro/camera/control/wired_usb?p=1").await?;
        let info = ask(&server, "/gopro/camera/info").await?;
        if let Err(error) = ask(&server, &answer::clock()).await {
            tracing::warn!(device = name, %error, "the camera's clock is not set");
        }
        let serial = answer::serial(&info);
        let books = Books::open(state.as_deref(), serial.as_deref().unwrap_or(name)).await;
        let (notify, states) = mpsc::channel(4);
        let (reported, tasks) = watch::channel(None);
        let (sender, notices) = mpsc::channel(NOTICES);
        let reports = ClipReports(sender);
        let camera = Camera::new(name, server, clips, books, notify, reports.clone(), limits).await;
        let task = AbortOnDropHandle::new(tokio::spawn(camera.run(tasks)));
        let (model, payload, notices) = (answer::model(&info), Vec::new(), Some(notices));
        Ok(Self { states, reported, clips: reports, notices, task, model, payload, preview: None })
    }

    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let ended = || Err(DriverError::Retry("the camera's task ended".to_owned()));
        let state = match &mut self.preview {
            None => self.states.recv().await.unwrap_or_else(ended)?,
            Some(preview) => {
                // A state is not a sample then, but that it cannot be had ends the stream.
                let failed = async {
                    loop {
                        if let Err(error) = self.states.recv().await.unwrap_or_else(ended) {
                            break error;
                        }
                    }
                };
                return tokio::select! {
                    biased;
                    error = failed => Err(error),
                    picture = preview.read() => picture,
                };
            }
        };
        self.payload.clear();
        // Writing to a Vec cannot fail.
        let _ = serde_json::to_writer(&mut self.payload, &state);
        Ok(Reading {
            bytes: &self.payload,
            encoding: Encoding::Bytes,
            captured: state.asked,
            flags: 0,
            width: 0,
            height: 0,
            lost: 0,
        })
    }

    /// The episode that will be saved as `episode` begins, or with `None` the one in progress ends.
    pub(super) fn record(&self, episode: Option<PathBuf>) {
        if episode.is_some() {
            self.clips.send(ClipState::Asked, String::new());
        }
        self.reported.send_replace(Some(episode));
    }

    /// What its own recording does; `Some` at the first call only.
    pub(super) fn clips(&mut self) -> Option<mpsc::Receiver<ClipNotice>> {
        self.notices.take()
    }

    /// Stops the shutter, if this program started it, and notes the clip.
    pub(super) async fn close(self) {
        let Self { reported, task, states, preview, .. } = self;
        if let Some(preview) = preview {
            preview.close().await;
        }
        reported.send_replace(Some(None));
        drop((reported, states));
        // If the caller abandons this, the task still runs: the camera must not keep recording.
        let _ = task.detach().await;
    }

    pub(super) fn card(&self) -> Option<String> {
        self.model.clone()
    }
}

async fn ask(server: &Server, path: &str) -> Result<Vec<u8>, DriverError> {
    let mut tries = 1;
    loop {
        match http::text(server, path, LARGEST_ANSWER, ANSWER_LIMIT).await {
            Err(DriverError::Retry(_)) if tries < TRIES => tries += 1,
            outcome => return outcome,
        }
    }
}

/// The camera's address, once the host has one in its network.
async fn address(place: &DeviceAddress) -> Result<Ipv4Addr, DriverError> {
    let looks = ADDRESS_LIMIT.as_millis() / LOOK_FOR_ADDRESS.as_millis();
    for _ in 0..looks {
        if let Some(camera) = place.own_address(is_gopros).map(camera_of) {
            return Ok(camera);
        }
        if place.is_gone() {
            return Err(DriverError::Gone);
        }
        sleep(LOOK_FOR_ADDRESS).await;
    }
    Err(place.lost(
        "no address 172.2X.1YZ.* by DHCP: let the system configure the interface, or write host = the camera's address",
    ))
}

/// 172.2X.1YZ.*
fn is_gopros(own: Ipv4Addr) -> bool {
    matches!(own.octets(), [172, 20..=29, 100..=199, _])
}

fn camera_of(own: Ipv4Addr) -> Ipv4Addr {
    let [a, b, c, _] = own.octets();
    Ipv4Addr::new(a, b, c, 51)
}

/// Parses a camera's answers and a note, for the fuzzer.
#[doc(hidden)]
pub(super) fn fuzz(bytes: &[u8]) {
    let _ = (answer::state(bytes, Stamp::default()), answer::model(bytes), answer::size(bytes));
    assert!(answer::serial(bytes).is_none_or(|serial| !serial.contains('/')), "a serial number leaves its folder");
    let newest = answer::newest(bytes).ok().flatten();
    let newest = newest.map(|name| Clip::new(name, None, PathBuf::from("/a/b.mcap"), "gopro"));
    let text = String::from_utf8_lossy(bytes);
    let noted = Clip::read(std::path::Path::new("/a/b.gopro.clip.json"), &text);
    for clip in newest.into_iter().chain(noted) {
        assert_eq!(clip.target().parent(), Some(std::path::Path::new("/a")), "a clip leaves its folder");
        let name = &clip.name;
        assert!(name.folder.bytes().chain(name.file.bytes()).all(|byte| byte.is_ascii_graphic() && byte != b'/'));
    }
}

/// Some thousands of notes.
const LARGEST: u64 = 1 << 20;

/// A shutter that was started for an episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Shutter {
    /// The path that the episode's file will have.
    episode: PathBuf,
    before: Before,
}

/// The newest clip on the card before the shutter was started; the episode's clip is a different one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Before {
    Nothing,
    Clip(Name),
    /// Unknown, and why: no clip can be identified as the episode's.
    Unknown(String),
}

#[derive(Debug, Default)]
struct Books {
    /// `None` where there is no folder for it.
    file: Option<PathBuf>,
    pages: Pages,
    is_stated: bool,
}

#[derive(Debug, Default, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
struct Pages {
    shutter: Option<Shutter>,
    notes: Vec<PathBuf>,
}

impl Books {
    /// The books of the camera of this name, a plain one, below the state directory.
    async fn open(state: Option<&Path>, name: &str) -> Self {
        let Some(file) = state.map(|state| state.join("gopro").join(format!("{name}.json"))) else {
            return Self::default();
        };
        let path = file.clone();
        let pages = tokio::task::spawn_blocking(move || {
            let text = read_text(&path, LARGEST).ok()?;
            let read = serde_json::from_str(&text);
            read.inspect_err(
                |error| tracing::warn!(%error, "{} was not written by rapid and is replaced", path.display()),
            )
            .ok()
        });
        Self { file: Some(file), pages: pages.await.ok().flatten().unwrap_or_default(), is_stated: false }
    }

    const fn shutter(&self) -> Option<&Shutter> {
        self.pages.shutter.as_ref()
    }

    async fn set_shutter(&mut self, shutter: Option<Shutter>) {
        if self.pages.shutter != shutter {
            self.pages.shutter = shutter;
            self.save().await;
        }
    }

    /// Notes of the clips that must still be fetched.
    fn notes(&self) -> &[PathBuf] {
        &self.pages.notes
    }

    async fn remember(&mut self, note: PathBuf) {
        if !self.pages.notes.contains(&note) {
            self.pages.notes.push(note);
            self.save().await;
        }
    }

    async fn forget(&mut self, note: &Path) {
        let before = self.pages.notes.len();
        self.pages.notes.retain(|kept| kept != note);
        if self.pages.notes.len() != before {
            self.save().await;
        }
    }

    /// Whether they are on the disk, so that another run can continue with them.
    const fn are_kept(&self) -> bool {
        self.file.is_some() && !self.is_stated
    }

    async fn save(&mut self) {
        let Some(file) = self.file.clone() else { return };
        let pages = self.pages.clone();
        let write = move || {
            let text = serde_json::to_vec_pretty(&pages)?;
            let folder = file.parent().unwrap_or(Path::new("."));
            let folder = Folder::open(folder, Links::Own, Missing::All)?;
            let name = file.file_name().unwrap_or_default();
            if pages == Pages::default() {
                let _ = folder.remove(name);
                return Ok(());
            }
            // Without power the camera is lost, too.
            folder.replace(name, &text, 0o600, Sync::Skip)
        };
        let saved = tokio::task::spawn_blocking(write).await.unwrap_or_else(|error| Err(std::io::Error::other(error)));
        if let (Err(error), false) = (&saved, self.is_stated) {
            tracing::warn!(%error, "what the camera still has for us is known to this run alone");
        }
        self.is_stated = saved.is_err();
    }
}

#[cfg(test)]
mod tests;
