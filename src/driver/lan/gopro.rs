//! GoPro cameras over USB: the camera is a network adapter with an HTTP server behind it.
//!
//! The requests are those of Open GoPro (gopro.github.io/OpenGoPro, HTTP, version 2.0): wired control on,
//! clock set, then every 3 s a keep-alive and a look at the camera's state, which is the sample, in JSON:
//! `{"recording":bool,"busy":bool,"battery_percent":n,"card_free_kb":n,"remaining_s":n}`, null where the
//! camera does not say. With an episode the shutter is started and stopped; which clip it made is written
//! beside the episode, and the clip is fetched if the entry says so (`clip`).
//!
//! The camera gives itself 172.2X.1YZ.51 and its host an address in the same network, XYZ being the last
//! digits of its serial number.
//!
//! Invariant: a task speaks with the camera; whoever reads or tells it something never waits for it.
//! Invariant: what goes wrong with a clip is said, and changes nothing of the episode.

mod clip;

use std::collections::VecDeque;
use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, sleep};
use tokio_util::task::AbortOnDropHandle;

use self::clip::Clip;
use super::http;
use super::place::{Place, Server};
use crate::driver::{DriverError, Reading};
use crate::sample::Encoding;
use crate::time::Stamp;

/// The camera switches itself off when it hears nothing for longer than this (Open GoPro, "keep alive").
const KEEP_ALIVE: Duration = Duration::from_secs(3);
/// The camera answers within a tenth of a second, while it encodes too.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
/// The state is 5 KB of numbers.
const LARGEST_ANSWER: usize = 256 << 10;
/// The host asks the camera for its address (DHCP), which takes a moment after the plug.
const ADDRESS_LIMIT: Duration = Duration::from_secs(8);
const LOOK_FOR_ADDRESS: Duration = Duration::from_millis(200);
/// The clip is in the camera's list a moment after it was stopped, usually within 1.5 s.
const CLIP_IS_LISTED_WITHIN: Duration = Duration::from_secs(4);
const LOOK_FOR_CLIP: Duration = Duration::from_millis(100);
/// An answer that did not come is asked for again.
const TRIES: u32 = 2;

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Gopro {
    states: mpsc::Receiver<Result<State, DriverError>>,
    orders: mpsc::Sender<Order>,
    task: AbortOnDropHandle<()>,
    model: Option<String>,
    payload: Vec<u8>,
}

#[derive(Debug)]
enum Order {
    /// An episode that will be this file.
    Start(PathBuf),
    Stop,
}

/// What the camera says of itself.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
struct State {
    recording: bool,
    busy: bool,
    battery_percent: Option<u64>,
    card_free_kb: Option<u64>,
    remaining_s: Option<u64>,
    #[serde(skip)]
    asked: Stamp,
}

impl Gopro {
    pub(super) async fn open(name: &str, place: &Place, port: u16, download: bool) -> Result<Self, DriverError> {
        let place = match place.peer() {
            Some(_) => place.clone(),
            None => place.at(address(place).await?.into()),
        };
        let server = place.server(port)?;
        ask(&server, "/gopro/camera/control/wired_usb?p=1").await?;
        let info = ask(&server, "/gopro/camera/info").await?;
        if let Err(error) = ask(&server, &clock()).await {
            tracing::warn!(device = name, %error, "the camera's clock is not set");
        }
        let newest = newest(&server).await.ok();
        let (tell, states) = mpsc::channel(4);
        let (orders, asked) = mpsc::channel(4);
        let camera = Camera {
            name: name.to_owned(),
            server,
            download,
            newest,
            states: tell,
            episode: None,
            pending: VecDeque::new(),
            fetching: None,
        };
        let task = AbortOnDropHandle::new(tokio::spawn(camera.run(asked)));
        Ok(Self { states, orders, task, model: model(&info), payload: Vec::new() })
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
    pub(super) fn record(&mut self, episode: Option<PathBuf>) -> Result<(), DriverError> {
        let order = episode.map_or(Order::Stop, Order::Start);
        self.orders.try_send(order).map_err(|_| DriverError::Retry("the camera does not answer".to_owned()))
    }

    /// Stops the shutter, if it is ours, and notes the clip.
    pub(super) async fn close(self) {
        let Self { orders, task, states, .. } = self;
        let _ = orders.send(Order::Stop).await;
        drop((orders, states));
        // Who gives this up leaves the task its time: the camera is not to record on.
        let _ = task.detach().await;
    }

    pub(super) fn card(&self) -> Option<String> {
        self.model.clone()
    }
}

/// What the task owns.
#[derive(Debug)]
struct Camera {
    name: String,
    server: Server,
    download: bool,
    /// The newest clip, as far as is known: folder and file.
    newest: Option<(String, String)>,
    states: mpsc::Sender<Result<State, DriverError>>,
    /// The episode in progress, for which the shutter was started.
    episode: Option<PathBuf>,
    /// Clips that are still to be fetched.
    pending: VecDeque<Clip>,
    fetching: Option<AbortOnDropHandle<Result<(), String>>>,
}

impl Camera {
    async fn run(mut self, mut orders: mpsc::Receiver<Order>) {
        let mut beat = interval(KEEP_ALIVE);
        beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                biased;
                order = orders.recv() => match order {
                    Some(Order::Start(episode)) => self.start(episode).await,
                    Some(Order::Stop) => self.stop().await,
                    None => return,
                },
                _ = beat.tick() => {
                    let state = self.look().await;
                    let is_over = state.is_err();
                    if !self.states.is_closed() && self.states.try_send(state).is_err() {
                        tracing::debug!(device = self.name, "a state that nobody read");
                    }
                    if is_over {
                        return;
                    }
                }
                fetched = fetched(&mut self.fetching) => {
                    self.fetching = None;
                    if let Some(clip) = self.pending.pop_front()
                        && let Err(reason) = fetched
                    {
                        tracing::error!(device = self.name, %reason, "{} stays on the camera: {}", clip.file, clip.url(&self.server));
                    }
                    self.fetch();
                }
            }
        }
    }

    async fn look(&self) -> Result<State, DriverError> {
        ask(&self.server, "/gopro/camera/keep_alive").await?;
        let asked = Stamp::now();
        let answer = ask(&self.server, "/gopro/camera/state").await?;
        state(&answer, asked).ok_or_else(|| self.server.place.lost("its state is not what a GoPro says"))
    }

    async fn start(&mut self, episode: PathBuf) {
        // The camera reads one card: the clip in progress comes first.
        self.fetching = None;
        let started = ask(&self.server, "/gopro/camera/shutter/start").await;
        // It may record already: its connection was lost in the middle of the episode.
        let records = started.is_ok() || self.look().await.is_ok_and(|state| state.recording);
        if records {
            self.episode = Some(episode);
        } else if let Err(error) = started {
            tracing::error!(device = self.name, %error, "the camera does not record this episode");
            self.fetch();
        }
    }

    async fn stop(&mut self) {
        let Some(episode) = self.episode.take() else { return };
        if let Err(error) = ask(&self.server, "/gopro/camera/shutter/stop").await {
            tracing::error!(device = self.name, %error, "the camera may record on: stop it by hand");
            return;
        }
        match self.note(episode).await {
            Ok(clip) => {
                self.newest = Some((clip.folder.clone(), clip.file.clone()));
                tracing::info!(
                    device = self.name,
                    clip = clip.file,
                    folder = clip.folder,
                    size = clip.size,
                    "recorded"
                );
                if self.download {
                    self.pending.push_back(clip);
                }
            }
            Err(reason) => {
                tracing::error!(device = self.name, %reason, "which clip belongs to the episode is not known");
            }
        }
        self.fetch();
    }

    /// Writes beside the episode which clip belongs to it.
    async fn note(&self, episode: PathBuf) -> Result<Clip, String> {
        let (folder, file) = self.made().await?;
        let mut clip = Clip::new(folder, file, episode, &self.name);
        let info = ask(&self.server, &format!("/gopro/media/info?path={}/{}", clip.folder, clip.file)).await;
        clip.size = info.ok().and_then(|info| clip::size(&info));
        let (noted, url) = (clip.clone(), clip.url(&self.server));
        let written = tokio::task::spawn_blocking(move || noted.note(&url)).await;
        written.map_err(|error| error.to_string())?.map_err(|error| error.to_string())?;
        Ok(clip)
    }

    /// The clip that was just made: another than was the newest before.
    async fn made(&self) -> Result<(String, String), String> {
        let looks = CLIP_IS_LISTED_WITHIN.as_millis() / LOOK_FOR_CLIP.as_millis();
        for _ in 0..looks {
            match newest(&self.server).await {
                Ok(clip) if self.newest.as_ref() != Some(&clip) => return Ok(clip),
                Ok(_) => {}
                Err(reason) => tracing::debug!(device = self.name, %reason, "the newest clip is not known yet"),
            }
            sleep(LOOK_FOR_CLIP).await;
        }
        Err(format!("it names no new clip within {} s", CLIP_IS_LISTED_WITHIN.as_secs()))
    }

    /// Goes on with the clips that are to be fetched.
    fn fetch(&mut self) {
        if self.fetching.is_some() || self.episode.is_some() {
            return;
        }
        if let Some(clip) = self.pending.front() {
            let fetching = clip::fetch(clip.clone(), self.server.clone());
            self.fetching = Some(AbortOnDropHandle::new(tokio::spawn(fetching)));
        }
    }
}

async fn fetched(fetching: &mut Option<AbortOnDropHandle<Result<(), String>>>) -> Result<(), String> {
    match fetching {
        Some(fetching) => fetching.await.map_err(|error| error.to_string())?,
        None => std::future::pending().await,
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

/// Folder and file of the newest clip on the card.
async fn newest(server: &Server) -> Result<(String, String), String> {
    let answer = ask(server, "/gopro/media/last_captured").await.map_err(|error| error.to_string())?;
    clip::named(&answer)
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
        "it has no address in 172.20.0.0/14 by DHCP: let the system configure the interface, or write host = the camera's \
         address",
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

/// The request that sets the camera's clock, to the second, to the local time.
fn clock() -> String {
    // SAFETY: all zeroes are a valid time.
    let mut local: libc::tm = unsafe { std::mem::zeroed() };
    // SAFETY: null asks for the time alone.
    let now = unsafe { libc::time(std::ptr::null_mut()) };
    // SAFETY: both pointers are to locals. Without time zones on the machine it is UTC.
    unsafe { libc::localtime_r(&raw const now, &raw mut local) };
    format!(
        "/gopro/camera/set_date_time?date={:04}_{:02}_{:02}&time={:02}_{:02}_{:02}&tzone={}&dst={}",
        local.tm_year + 1900,
        local.tm_mon + 1,
        local.tm_mday,
        local.tm_hour,
        local.tm_min,
        local.tm_sec,
        // The zone without daylight saving, which is told apart.
        local.tm_gmtoff / 60 - if local.tm_isdst > 0 { 60 } else { 0 },
        i32::from(local.tm_isdst > 0),
    )
}

/// The model and firmware, as `/gopro/camera/info` tells them.
fn model(info: &[u8]) -> Option<String> {
    let info: serde_json::Value = serde_json::from_slice(info).ok()?;
    // Older firmware wraps it.
    let info = info.get("info").unwrap_or(&info);
    let text = |key: &str| Some(info.get(key)?.as_str()?.chars().take(64).collect::<String>());
    let model = text("model_name")?;
    Some(text("firmware_version").map_or_else(|| model.clone(), |firmware| format!("{model}, firmware {firmware}")))
}

/// The state, whose parts have numbers (Open GoPro, "Camera State", status ids).
fn state(answer: &[u8], asked: Stamp) -> Option<State> {
    const BUSY: &str = "8";
    const ENCODING: &str = "10";
    const REMAINING_VIDEO_S: &str = "35";
    const CARD_FREE_KB: &str = "54";
    const BATTERY_PERCENT: &str = "70";
    let answer: serde_json::Value = serde_json::from_slice(answer).ok()?;
    let status = answer.get("status")?.as_object()?;
    let number = |id: &str| status.get(id)?.as_u64();
    Some(State {
        recording: number(ENCODING)? != 0,
        busy: number(BUSY).is_some_and(|busy| busy != 0),
        battery_percent: number(BATTERY_PERCENT),
        card_free_kb: number(CARD_FREE_KB),
        remaining_s: number(REMAINING_VIDEO_S),
        asked,
    })
}

#[doc(hidden)]
pub(super) fn fuzz(answer: &[u8]) {
    let _ = (state(answer, Stamp::default()), model(answer), clip::size(answer));
    if let Ok((folder, file)) = clip::named(answer) {
        let clip = Clip::new(folder, file, PathBuf::from("/a/b.mcap"), "gopro");
        assert_eq!(clip.target().parent(), Some(std::path::Path::new("/a")), "a clip leaves its folder");
        assert!(clip.folder.bytes().chain(clip.file.bytes()).all(|byte| byte.is_ascii_graphic() && byte != b'/'));
    }
}

#[cfg(test)]
mod tests;
