//! The task that communicates with a camera: keeps it awake, runs its shutter with the episodes, fetches its clips.
//!
//! The wanted state is the episode in progress, the actual state is the shutter in the [`Books`]. At every change and
//! every keep-alive the actual state is adjusted to the wanted one: a missing answer or a lost connection causes only a
//! delay. A shutter that was refused, or stopped by itself, is started again, less and less often, while the episode lasts.
//!
//! An episode's clip is identified by the clip that was newest before its shutter was started. If that is not known, or
//! clips of ours may not be listed yet, no clip is assigned to the episode.
//!
//! Invariant: a failure with a clip is reported, and changes nothing about the episode.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::time::Duration;

use hyper::StatusCode;
use rapid_core::clip::ClipState;
use rapid_core::time::Stamp;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep};
use tokio_util::task::AbortOnDropHandle;

use super::super::address::Server;
use super::super::http;
use super::answer::{self, Name, State};
use super::clip::{self, Clip, Failure};
use super::{ANSWER_LIMIT, Clips, LARGEST_ANSWER, TRIES, ask};
use super::{Before, Books, ClipReports, Shutter};
use crate::driver::DriverError;

/// The episode in progress, if there is one; `None` until the camera was notified.
pub(super) type ReportedEpisode = Option<Option<PathBuf>>;

#[derive(Debug, Clone, Copy)]
pub(super) struct TimeLimits {
    /// The camera switches itself off when it receives nothing for longer than this (Open GoPro, "keep alive").
    pub(super) keep_alive: Duration,
    /// A stopped clip appears in the camera's list after a moment, usually within 1.5 s.
    pub(super) listed_within: Duration,
    /// After this long it will never be listed.
    pub(super) listed_at_the_latest: Duration,
}

impl TimeLimits {
    pub(super) const USUAL: Self = Self {
        keep_alive: Duration::from_secs(3),
        listed_within: Duration::from_secs(4),
        listed_at_the_latest: Duration::from_mins(1),
    };
}

/// A shutter that was started runs after a moment: looks at the state, and the time between them.
const STARTS: u32 = 5;
const LOOK_FOR_START: Duration = Duration::from_millis(200);
/// So many states in a row must report that the shutter does not run.
const STATES: u32 = 2;
/// The longest time between two tries, in keep-alives.
const LONGEST_PAUSE: u32 = 10;

/// When a shutter that does not run is started again: each time after twice the time.
#[derive(Debug, Clone, Copy)]
struct Retry {
    due: Instant,
    pause: Duration,
    longest: Duration,
}

impl Retry {
    fn new(keep_alive: Duration) -> Self {
        Self { due: Instant::now(), pause: keep_alive, longest: keep_alive * LONGEST_PAUSE }
    }

    fn is_due(&self) -> bool {
        Instant::now() >= self.due
    }

    /// A try begins.
    fn count(&mut self) {
        self.due = Instant::now() + self.pause;
        self.pause = (self.pause * 2).min(self.longest);
    }
}

const LOOK_FOR_CLIP: Duration = Duration::from_millis(100);

#[derive(Debug)]
pub(super) struct Camera {
    name: String,
    server: Server,
    limits: TimeLimits,
    clips: Clips,
    states: mpsc::Sender<Result<State, DriverError>>,
    books: Books,
    /// An earlier connection put the shutter in the books: whether it still runs must be checked.
    is_inherited: bool,
    wanted: ReportedEpisode,
    /// A clip that is not listed yet, and until when to look for it.
    unlisted: Option<(Shutter, Instant)>,
    /// Until then, clips of unknown episodes may appear in the list.
    unclear_until: Option<Instant>,
    /// That it does not stop was reported.
    is_stated: bool,
    clips_report: ClipReports,
    /// It was reported to record the episode in progress.
    is_recording: bool,
    /// States in a row by which the shutter does not run although it was started.
    idle: u32,
    retry: Retry,
    /// Clips that must still be fetched; the first is being fetched.
    pending: VecDeque<Clip>,
    fetching: Option<AbortOnDropHandle<Result<(), Failure>>>,
}

impl Camera {
    pub(super) async fn new(
        name: &str,
        server: Server,
        clips: Clips,
        books: Books,
        states: mpsc::Sender<Result<State, DriverError>>,
        clips_report: ClipReports,
        limits: TimeLimits,
    ) -> Self {
        let mut camera = Self {
            name: name.to_owned(),
            server,
            limits,
            clips,
            states,
            is_inherited: books.shutter().is_some(),
            books,
            wanted: None,
            unlisted: None,
            unclear_until: None,
            is_stated: false,
            clips_report,
            is_recording: false,
            idle: 0,
            retry: Retry::new(limits.keep_alive),
            pending: VecDeque::new(),
            fetching: None,
        };
        if clips.download {
            camera.inherit().await;
        }
        camera
    }

    /// Continues with the clips that an earlier connection or run left to be fetched.
    async fn inherit(&mut self) {
        for note in self.books.notes().to_vec() {
            let path = note.clone();
            let clip = tokio::task::spawn_blocking(move || {
                let clip = Clip::of_note(&path)?;
                Some((clip.target().exists(), clip))
            });
            match clip.await.ok().flatten() {
                Some((false, clip)) => self.pending.push_back(clip),
                Some((true, _)) => self.books.forget(&note).await,
                None => {
                    tracing::warn!(device = self.name, "{} is gone: its clip is not fetched", note.display());
                    self.books.forget(&note).await;
                }
            }
        }
    }

    /// Runs until its owner is dropped, or the camera does not answer.
    pub(super) async fn run(mut self, mut reported: watch::Receiver<ReportedEpisode>) {
        let mut ticks = interval(self.limits.keep_alive);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut is_first = true;
        loop {
            tokio::select! {
                biased;
                changed = reported.changed() => {
                    if changed.is_err() {
                        return;
                    }
                    self.wanted.clone_from(&reported.borrow_and_update());
                    self.is_stated = false;
                    self.is_recording = false;
                    self.retry = Retry::new(self.limits.keep_alive);
                    self.settle().await;
                }
                _ = ticks.tick() => {
                    let state = self.query_state().await;
                    let is_over = state.is_err();
                    let recording = state.as_ref().ok().map(|state| state.recording);
                    if !self.states.is_closed() && self.states.try_send(state).is_err() {
                        tracing::debug!(device = self.name, "a state was not read in time");
                    }
                    if is_over {
                        return;
                    }
                    // The camera is notified of an episode in progress as soon as it is open.
                    if !std::mem::take(&mut is_first) {
                        self.wanted.get_or_insert(None);
                    }
                    if let Some(recording) = recording {
                        self.watch_shutter(recording).await;
                    }
                    self.settle().await;
                }
                fetched = fetched(&mut self.fetching) => {
                    self.fetching = None;
                    self.fetched(fetched).await;
                    self.fetch();
                }
            }
        }
    }

    async fn query_state(&self) -> Result<State, DriverError> {
        ask(&self.server, "/gopro/camera/keep_alive").await?;
        let asked = Stamp::now();
        let answer = ask(&self.server, "/gopro/camera/state").await?;
        answer::state(&answer, asked).ok_or_else(|| self.server.place.lost("its state is not what a GoPro reports"))
    }

    /// Makes the shutter follow the episodes.
    async fn settle(&mut self) {
        let Some(wanted) = self.wanted.clone() else { return };
        if self.is_inherited && !self.has_inherited().await {
            return;
        }
        if let Some(shutter) = self.books.shutter().cloned()
            && wanted.as_ref() != Some(&shutter.episode)
            && !self.stop(shutter).await
        {
            return;
        }
        match wanted {
            Some(episode) if self.books.shutter().is_none() => {
                if self.retry.is_due() {
                    self.start(episode).await;
                }
            }
            Some(_) => {}
            None => {
                self.list().await;
                self.fetch();
            }
        }
    }

    /// Checks whether the shutter of an earlier connection still runs. Returns whether this is known.
    async fn has_inherited(&mut self) -> bool {
        let Ok(state) = self.query_state().await else { return false };
        self.is_inherited = false;
        if state.recording && self.books.shutter().is_some_and(|shutter| self.is_wanted(shutter)) {
            self.confirm();
        }
        if let (Some(shutter), false) = (self.books.shutter().cloned(), state.recording) {
            self.unknown(&shutter, "its recording ended while it was not connected").await;
            if self.is_wanted(&shutter) {
                self.clips_report.send(ClipState::Stopped, "while it was not connected".to_owned());
            }
            self.books.set_shutter(None).await;
        }
        true
    }

    /// Was the shutter started for the episode in progress?
    fn is_wanted(&self, shutter: &Shutter) -> bool {
        self.wanted.as_ref().is_some_and(|wanted| wanted.as_ref() == Some(&shutter.episode))
    }

    /// Compares the shutter that was started for the episode in progress with the camera's state. It takes a moment to
    /// run: only what two states report is believed.
    async fn watch_shutter(&mut self, recording: bool) {
        let Some(shutter) = self.books.shutter().filter(|shutter| self.is_wanted(shutter)).cloned() else { return };
        if self.is_inherited {
            return;
        }
        if recording {
            self.confirm();
            return;
        }
        self.idle += 1;
        if self.idle < STATES {
            return;
        }
        let (state, text) = if std::mem::take(&mut self.is_recording) {
            (ClipState::Stopped, "by itself")
        } else {
            (ClipState::Refused, "it accepted the order and does not record")
        };
        self.clips_report.send(state, text.to_owned());
        self.idle = 0;
        self.books.set_shutter(None).await;
        // The part that it has is a clip of the episode.
        if !matches!(shutter.before, Before::Unknown(_)) {
            self.unlisted = Some((shutter, Instant::now() + self.limits.listed_at_the_latest));
        }
    }

    /// The camera reports that it records the episode in progress.
    fn confirm(&mut self) {
        self.idle = 0;
        self.retry = Retry::new(self.limits.keep_alive);
        if !std::mem::replace(&mut self.is_recording, true) {
            self.clips_report.send(ClipState::Recording, String::new());
        }
    }

    async fn start(&mut self, episode: PathBuf) {
        // The camera reads one card: the clip being recorded has priority.
        self.fetching = None;
        self.list().await;
        if let Some((shutter, _)) = self.unlisted.take() {
            self.unknown(&shutter, "it was not listed when the next episode began").await;
            self.unclear_until = Some(Instant::now() + self.limits.listed_at_the_latest);
        }
        let before = if self.unclear_until.is_some_and(|until| Instant::now() < until) {
            Before::Unknown("clips of episodes before it were not listed yet when it began".to_owned())
        } else {
            match newest(&self.server).await {
                Ok(Some(clip)) => Before::Clip(clip),
                Ok(None) => Before::Nothing,
                Err(reason) => {
                    Before::Unknown(format!("it is not known which clip was the newest before it: {reason}"))
                }
            }
        };
        self.books.set_shutter(Some(Shutter { episode, before })).await;
        self.retry.count();
        self.idle = 0;
        let asked = ask(&self.server, "/gopro/camera/shutter/start").await;
        // Despite an error it may be recording, started by hand.
        for _ in 0..STARTS {
            if self.query_state().await.is_ok_and(|state| state.recording) {
                return self.confirm();
            }
            if asked.is_err() {
                break;
            }
            sleep(LOOK_FOR_START).await;
        }
        // If the order was accepted, the next states tell.
        let Err(error) = asked else { return };
        self.books.set_shutter(None).await;
        self.clips_report.send(ClipState::Refused, error.to_string());
    }

    /// Stops the shutter and notes its clip; `false` if it keeps running.
    async fn stop(&mut self, shutter: Shutter) -> bool {
        if let Err(error) = ask(&self.server, "/gopro/camera/shutter/stop").await
            && !self.query_state().await.is_ok_and(|state| !state.recording)
        {
            if !std::mem::replace(&mut self.is_stated, true) {
                tracing::error!(device = self.name, %error, "the camera is still recording; it is asked again to stop");
            }
            return false;
        }
        self.books.set_shutter(None).await;
        self.is_stated = false;
        if let Before::Unknown(reason) = &shutter.before {
            self.unknown(&shutter, reason).await;
            self.unclear_until = Some(Instant::now() + self.limits.listed_at_the_latest);
            return true;
        }
        let stopped = Instant::now();
        self.unlisted = Some((shutter, stopped + self.limits.listed_at_the_latest));
        loop {
            self.list().await;
            if self.unlisted.is_none() {
                return true;
            }
            if stopped.elapsed() >= self.limits.listed_within {
                tracing::warn!(device = self.name, "it does not list its new clip yet");
                return true;
            }
            sleep(LOOK_FOR_CLIP).await;
        }
    }

    /// Notes the newest clip, once the camera lists it.
    async fn list(&mut self) {
        let Some((shutter, until)) = &self.unlisted else { return };
        match newest(&self.server).await {
            Ok(Some(name)) if shutter.before != Before::Clip(name.clone()) => {
                let episode = shutter.episode.clone();
                self.unlisted = None;
                self.note(name, episode).await;
                return;
            }
            Ok(_) => {}
            Err(reason) => tracing::debug!(device = self.name, %reason, "the newest clip is not known yet"),
        }
        if Instant::now() >= *until
            && let Some((shutter, _)) = self.unlisted.take()
        {
            self.unknown(&shutter, "the camera listed no new one").await;
        }
    }

    /// Writes beside the episode which clip belongs to it.
    async fn note(&mut self, name: Name, episode: PathBuf) {
        let info = ask(&self.server, &format!("/gopro/media/info?path={}/{}", name.folder, name.file)).await;
        let size = info.ok().and_then(|info| answer::size(&info));
        let clip = Clip::new(name, size, episode, &self.name);
        let mut clip = clip;
        clip.is_further = is_further(&clip).await;
        let (noted, url) = (clip.clone(), clip.url(&self.server));
        let (Name { file, folder }, report) = (clip.name.clone(), url.clone());
        let written = tokio::task::spawn_blocking(move || noted.note(&url)).await;
        if let Err(error) = written.unwrap_or_else(|error| Err(std::io::Error::other(error))) {
            let note = clip.note_path();
            tracing::error!(device = self.name, %error, "{} cannot be written: the clip is {report}", note.display());
            return;
        }
        tracing::info!(device = self.name, clip = file, folder, size, "recorded");
        if self.clips.download {
            self.books.remember(clip.note_path()).await;
            self.pending.push_back(clip);
        }
    }

    /// Reports that an episode has no clip.
    async fn unknown(&self, shutter: &Shutter, reason: &str) {
        let newest = newest(&self.server).await.ok().flatten();
        let newest = newest.map(|Name { folder, file }| format!("; the newest on the card is {folder}/{file}"));
        let (episode, newest) = (shutter.episode.display(), newest.unwrap_or_default());
        tracing::error!(device = self.name, "it is not known which clip belongs to {episode}: {reason}{newest}");
    }

    /// Continues fetching clips.
    fn fetch(&mut self) {
        if self.fetching.is_some() || self.wanted != Some(None) || self.books.shutter().is_some() {
            return;
        }
        if let Some(clip) = self.pending.front() {
            let fetching = clip::fetch(clip.clone(), self.server.clone(), self.clips.reserve);
            self.fetching = Some(AbortOnDropHandle::new(tokio::spawn(fetching)));
        }
    }

    async fn fetched(&mut self, fetched: Result<(), Failure>) {
        let Some(clip) = self.pending.pop_front() else { return };
        let url = clip.url(&self.server);
        match fetched {
            Ok(()) => self.books.forget(&clip.note_path()).await,
            Err(Failure::Stays(reason)) => {
                tracing::error!(device = self.name, %reason, "{} stays on the camera: {url}", clip.name.file);
            }
            Err(Failure::Lost(reason)) => {
                tracing::error!(device = self.name, %reason, "{} is not on the camera any more: {url}", clip.name.file);
                self.books.forget(&clip.note_path()).await;
            }
        }
    }
}

impl Drop for Camera {
    /// Reports unfinished work, however the task ends.
    fn drop(&mut self) {
        let then = if self.books.are_kept() { ", and is seen to when the camera is there again" } else { "" };
        for clip in &self.pending {
            let (file, url) = (&clip.name.file, clip.url(&self.server));
            tracing::warn!(device = self.name, "{file} is still on the camera{then}: {url}");
        }
        if let Some((shutter, _)) = &self.unlisted {
            let episode = shutter.episode.display();
            tracing::error!(
                device = self.name,
                "it is not known which clip belongs to {episode}: it was not listed yet"
            );
        }
        if let Some(shutter) = self.books.shutter() {
            tracing::warn!(
                device = self.name,
                "the camera may still be recording, for {}{then}",
                shutter.episode.display()
            );
        }
    }
}

async fn fetched(fetching: &mut Option<AbortOnDropHandle<Result<(), Failure>>>) -> Result<(), Failure> {
    match fetching {
        Some(fetching) => fetching.await.unwrap_or_else(|error| Err(Failure::Stays(error.to_string()))),
        None => std::future::pending().await,
    }
}

/// Does the episode have another clip already? The shutter was started again in it.
async fn is_further(clip: &Clip) -> bool {
    let (note, name) = (clip.note_path(), clip.name.clone());
    let there = tokio::task::spawn_blocking(move || Clip::of_note(&note)).await;
    there.ok().flatten().is_some_and(|there| there.name != name)
}

/// The newest clip on the card; `None` if there is none.
async fn newest(server: &Server) -> Result<Option<Name>, String> {
    let mut tries = 1;
    loop {
        match http::answer(server, "/gopro/media/last_captured", LARGEST_ANSWER, ANSWER_LIMIT).await {
            Ok((StatusCode::NOT_FOUND | StatusCode::NO_CONTENT, _)) => return Ok(None),
            Ok((status, body)) if status.is_success() => return answer::newest(&body),
            Err(DriverError::Retry(_)) if tries < TRIES => tries += 1,
            Ok((status, _)) => return Err(format!("the camera answers {status}")),
            Err(error) => return Err(error.to_string()),
        }
    }
}
