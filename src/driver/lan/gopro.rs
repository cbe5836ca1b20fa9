//! GoPro cameras over USB: the camera is a network adapter with an HTTP server behind it.
//!
//! The requests are those of Open GoPro (gopro.github.io/OpenGoPro, HTTP, version 2.0): wired control on,
//! clock set, then every 3 s a keep-alive and a look at the camera's state, which is the sample, in JSON:
//! `{"recording":bool,"busy":bool,"battery_percent":n,"card_free_kb":n,"remaining_s":n}`, null where the
//! camera does not say. With an episode the shutter is started and stopped (`camera`); which clip it made is written
//! beside the episode, and the clip is fetched if the entry says so (`clip`), by the next run if this one ends before.
//!
//! The camera gives itself 172.2X.1YZ.51 and its host an address in the same network, XYZ being the last
//! digits of its serial number.
//!
//! Invariant: a task speaks with the camera; whoever reads or tells it something never waits for it.
//! Invariant: however the connection or the run ends, the shutter that is ours and the clips that are to be fetched are
//! known to whoever opens the camera next (`books`).

mod answer;
mod books;
mod camera;
mod clip;

use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::sleep;
use tokio_util::task::AbortOnDropHandle;

use self::answer::State;
use self::books::Books;
use self::camera::{Camera, Pace, Told};
use self::clip::Clip;
use super::http;
use super::place::{Place, Server};
use crate::driver::{DriverError, Reading};
use crate::folder::state_directory;
use crate::sample::Encoding;
use crate::time::Stamp;

/// The camera answers within a tenth of a second, while it encodes too.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
/// The state is 5 KB of numbers.
const LARGEST_ANSWER: usize = 256 << 10;
/// The host asks the camera for its address (DHCP), which takes a moment after the plug.
const ADDRESS_LIMIT: Duration = Duration::from_secs(8);
const LOOK_FOR_ADDRESS: Duration = Duration::from_millis(200);
/// An answer that did not come is asked for again.
const TRIES: u32 = 2;

/// What becomes of the clips.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clips {
    /// They are fetched after the episode.
    pub(super) download: bool,
    /// `disk_reserve` of the registry, bytes.
    pub(super) reserve: Option<u64>,
}

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Gopro {
    states: mpsc::Receiver<Result<State, DriverError>>,
    told: watch::Sender<Told>,
    task: AbortOnDropHandle<()>,
    model: Option<String>,
    payload: Vec<u8>,
}

impl Gopro {
    pub(super) async fn open(name: &str, place: &Place, port: u16, clips: Clips) -> Result<Self, DriverError> {
        let place = match place.peer() {
            Some(_) => place.clone(),
            None => place.at(address(place).await?.into()),
        };
        Self::begin(name, place.server(port)?, clips, state_directory(), Pace::USUAL).await
    }

    /// `state` is the folder of the books.
    async fn begin(
        name: &str,
        server: Server,
        clips: Clips,
        state: Option<PathBuf>,
        pace: Pace,
    ) -> Result<Self, DriverError> {
        ask(&server, "/gopro/camera/control/wired_usb?p=1").await?;
        let info = ask(&server, "/gopro/camera/info").await?;
        if let Err(error) = ask(&server, &answer::clock()).await {
            tracing::warn!(device = name, %error, "the camera's clock is not set");
        }
        let serial = answer::serial(&info);
        let books = Books::open(state.as_deref(), serial.as_deref().unwrap_or(name)).await;
        let (tell, states) = mpsc::channel(4);
        let (told, tasks) = watch::channel(None);
        let camera = Camera::new(name, server, clips, books, tell, pace).await;
        let task = AbortOnDropHandle::new(tokio::spawn(camera.run(tasks)));
        Ok(Self { states, told, task, model: answer::model(&info), payload: Vec::new() })
    }

    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let ended = || Err(DriverError::Retry("the camera's task ended".to_owned()));
        let state = self.states.recv().await.unwrap_or_else(ended)?;
        self.payload.clear();
        // A Vec takes every write.
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

    /// The episode that will be `episode` begins, or with `None` the one in progress ends.
    pub(super) fn record(&self, episode: Option<PathBuf>) {
        self.told.send_replace(Some(episode));
    }

    /// Stops the shutter, if it is ours, and notes the clip.
    pub(super) async fn close(self) {
        let Self { told, task, states, .. } = self;
        told.send_replace(Some(None));
        drop((told, states));
        // Who gives this up leaves the task its time: the camera is not to record on.
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
async fn address(place: &Place) -> Result<Ipv4Addr, DriverError> {
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

/// What is read of a camera's answers and of a note, for the fuzzer.
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

#[cfg(test)]
mod tests;
