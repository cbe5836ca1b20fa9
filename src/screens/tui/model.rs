//! The model: the state of the screen between frames.
//!
//! Snapshots and keys come in as [`Msg`], requests to the rest of the program go out as [`Effect`]; the
//! views only read.
//!
//! Invariant: no key deletes anything: discarding moves to the trash, and the end of a session is confirmed by a word.
//! Invariant: pure: no clock, no terminal, no channel; time comes from the snapshots.

mod prompt;
mod seen;

use std::time::Duration;

use crossterm::event::{KeyEvent, KeyEventKind, KeyModifiers};
use rapid_core::action::Order;
use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::time::{Stamp, Zone};
use rapid_status::preview::Preview;
use rapid_status::rates::Rates;
use rapid_status::session::{Label, PRESS_AGAIN, SessionRequest};
use rapid_status::{Command, DeviceState, DeviceStatus, Grade, Snapshot};

use super::history::{Bit, Cell, History};
use super::keys::{self, Act};
use super::lidar::Sweep;
use super::link::LinkState;
use super::log_view::LogView;
use super::picture::Picture;
use super::theme::Edge;
use super::tour::Tour;
use super::view::Target;
use super::{help, view};
use prompt::{Naming, Prompt, Question};
use seen::Seen;

/// How long a changed bit is highlighted.
const EDGE_SHOWN: Duration = Duration::from_secs(1);
/// How long the answer to a key stays in the footer.
const NOTICE_SHOWN: Duration = Duration::from_secs(4);

/// Something that happened.
#[derive(Debug)]
pub enum Msg {
    /// A newer snapshot.
    Snapshot(Box<Snapshot>),
    /// A key.
    Key(KeyEvent),
    /// Text that was pasted: an answer to a question, and otherwise no request.
    Paste(String),
    /// The size of the terminal, columns and rows.
    Size(u16, u16),
    /// A click.
    Click(Target),
    /// The wheel over a part of the screen, upwards or down.
    Wheel(Option<Target>, bool),
    /// A command could not be sent because the program is busy.
    Refused,
    /// The actuator was not armed, and why.
    NotArmed(String),
    /// What was requested was not done, and why.
    Failed(String),
}

/// Late frames after which a line counts as slow: more than two seconds of them.
const TOO_LATE: u8 = 20;

/// Shown instead of a request by a screen that makes none.
const READ_ONLY: &str = "read-only: `rapid monitor` without --read-only controls the run";

/// A request of the model to the rest of the program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Effect {
    /// Nothing beyond showing the model.
    None,
    /// Send this command.
    Send(Command),
    /// Give this order to the actuator.
    Order(Order),
    /// Disarm the actuator, then end the program.
    Leave,
}

/// What fills the screen between header and footer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Page {
    /// The rig: mask, devices, recording, log.
    #[default]
    Rig,
    /// The selected device.
    Device,
    /// The log.
    Log,
    /// The episodes of the session.
    Episodes,
}

/// What lies over the page, until a key closes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Overlay {
    /// This page of the help, from 1.
    Help(usize),
    /// The link to the page for a phone.
    Link,
}

/// Whether the user asked to quit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Quit {
    /// No.
    #[default]
    No,
    /// Yes, while an episode is being recorded: the next request counts.
    Asked,
    /// Yes; the program is ending.
    Ending,
}

/// Measured figures of one device, refreshed a few times a second so that they can be read.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Reading {
    /// Samples per second.
    pub hz: f64,
    /// Age of the newest sample.
    pub age: Option<Duration>,
}

/// Figures of the whole rig, refreshed at the same rate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Totals {
    /// Publications of the mask per second.
    pub publications: f64,
    /// Bytes per second written to the episode.
    pub recorded: f64,
    /// Bytes per second that the devices deliver.
    pub delivered: f64,
}

/// The state of the screen.
#[derive(Debug)]
pub struct Model {
    latest: Snapshot,
    frozen: Option<Box<Snapshot>>,
    rates: Rates,
    history: History,
    frozen_history: Option<History>,
    /// What the screen is linked to.
    pub(super) link: LinkState,
    /// In which the times of the log are shown.
    pub(super) zone: Zone,
    /// Devices in trouble come first.
    by_trouble: bool,
    readings: [Reading; MAX_MODALITIES],
    /// Figures of the whole rig.
    pub(super) totals: Totals,
    /// Samples lost by each device when the episode in progress began.
    lost_before: [u64; MAX_MODALITIES],
    edges: [Option<Stamp>; MAX_MODALITIES],
    /// When a device was unplugged, if the screen was open then.
    unplugged: [Option<Stamp>; MAX_MODALITIES],
    /// Row of the selected device.
    pub(super) selected: usize,
    /// What fills the screen.
    pub(super) page: Page,
    /// Row of the selected episode, the newest first.
    pub(super) episode: usize,
    /// Which lines of the log are shown.
    pub(super) log: LogView,
    /// Columns and rows of the terminal.
    pub(super) size: (u16, u16),
    pub(super) pictures: bool,
    /// Frames that the terminal had not taken when the next was due, less those that it had, while a picture is shown.
    late: u8,
    /// When previews of the selected device were last requested.
    looked: Option<Stamp>,
    /// What the previews showed so far.
    seen: Seen,
    naming: Naming,
    /// Leads through the first minute.
    pub(super) tour: Option<Tour>,
    /// What lies over everything else.
    pub(super) overlay: Option<Overlay>,
    /// Whether the user has asked to quit.
    pub(super) quit: Quit,
    /// When the user asked to arm the actuator: the next key confirms or cancels.
    arming: Option<Stamp>,
    /// The text that is being typed.
    prompt: Option<Prompt>,
    /// When a key that begins or ends an episode was last pressed.
    pressed: Option<Stamp>,
    /// No bell is wanted.
    is_silent: bool,
    /// How often the bell was to ring.
    rings: u64,
    notice: Option<Notice>,
}

/// The answer to a key.
#[derive(Debug)]
struct Notice {
    text: String,
    shown: Stamp,
    /// It announces that a recording begins (`true`) or ends, and is obsolete once that is so.
    awaits: Option<bool>,
}

impl Notice {
    fn is_over(&self, now: &Snapshot) -> bool {
        let has_failed = self.awaits == Some(true) && now.not_started.is_some();
        let has_happened = self.awaits.is_some_and(|recording| now.recording.is_some() == recording);
        has_failed || has_happened || now.taken.since(self.shown) > NOTICE_SHOWN
    }
}

impl Model {
    /// A screen that starts with this snapshot.
    pub fn new(snapshot: Snapshot) -> Self {
        let mut rates = Rates::default();
        rates.update(&snapshot);
        let mut model = Self {
            latest: snapshot,
            frozen: None,
            rates,
            history: History::default(),
            frozen_history: None,
            link: LinkState::Own,
            zone: Zone::UTC,
            by_trouble: false,
            readings: [Reading::default(); MAX_MODALITIES],
            totals: Totals::default(),
            lost_before: [0; MAX_MODALITIES],
            edges: [None; MAX_MODALITIES],
            unplugged: [None; MAX_MODALITIES],
            selected: 0,
            page: Page::default(),
            episode: 0,
            log: LogView::default(),
            size: (80, 24),
            pictures: true,
            late: 0,
            looked: None,
            seen: Seen::default(),
            naming: Naming::default(),
            tour: None,
            overlay: None,
            quit: Quit::No,
            arming: None,
            prompt: None,
            pressed: None,
            is_silent: false,
            rings: 0,
            notice: None,
        };
        model.naming.is_new_rig = model.latest.devices.is_empty();
        model.read();
        model
    }

    /// Applies a message.
    pub fn update(&mut self, msg: Msg) -> Effect {
        match msg {
            Msg::Snapshot(snapshot) => {
                self.advance(*snapshot);
                return self.request_previews();
            }
            Msg::Size(columns, rows) => self.size = (columns, rows),
            Msg::Click(target) => self.click(target),
            Msg::Wheel(target, is_up) => self.wheel(target, is_up),
            Msg::Key(key) if key.kind == KeyEventKind::Release => {}
            Msg::Paste(text) => self.paste(&text),
            Msg::Key(key) => {
                let effect = self.key(key);
                return self.permitted(effect);
            }
            Msg::Refused => self.notify("busy: request dropped, try again"),
            Msg::NotArmed(why) => self.notify(&format!("not armed: {why}")),
            Msg::Failed(why) => self.notify(&why),
        }
        Effect::None
    }

    fn advance(&mut self, snapshot: Snapshot) {
        for (bit, edge) in self.edges.iter_mut().enumerate() {
            if (snapshot.mask.0 ^ self.latest.mask.0) >> bit & 1 == 1 {
                *edge = Some(snapshot.taken);
            }
        }
        let file = |snapshot: &Snapshot| snapshot.recording.as_ref().map(|recording| recording.file.clone());
        let begins = file(&snapshot).is_some() && file(&snapshot) != file(&self.latest);
        for device in &snapshot.devices {
            if let Some(lost) = self.lost_before.get_mut(device.id.index()).filter(|_| begins) {
                *lost = device.gaps;
            }
            let before = self.latest.devices.iter().find(|before| before.id == device.id);
            let was_attached = before.is_some_and(|before| before.state != DeviceState::Absent);
            if let Some(unplugged) = self.unplugged.get_mut(device.id.index())
                && device.state == DeviceState::Absent
                && was_attached
            {
                *unplugged = Some(snapshot.taken);
            }
        }
        if calls_attention(&self.latest, &snapshot) && !self.is_silent {
            self.rings += 1;
        }
        let refresh = self.rates.update(&snapshot);
        // Nothing is known of a run while it is not linked.
        if !matches!(self.link, LinkState::Lost { .. }) {
            self.history.update(&snapshot);
        }
        let selected = self.selected_device().map(|device| device.id);
        if self.frozen.is_none() {
            // Other screens look at other devices.
            let own = snapshot.previews.iter().filter(|preview| Some(preview.device) == selected);
            own.for_each(|preview| self.seen.update(preview));
        }
        let marked = self.marked_episode();
        let news = news(&self.latest, &snapshot);
        self.latest = snapshot;
        for text in news {
            self.notify(&text);
        }
        self.ask_for_names();
        if let Some(tour) = &mut self.tour {
            tour.update(&self.latest);
        }
        if refresh && self.frozen.is_none() {
            self.read();
        }
        if self.quit == Quit::Asked && self.latest.recording.is_none() {
            self.quit = Quit::No;
        }
        if self.notice.as_ref().is_some_and(|notice| notice.is_over(&self.latest)) {
            self.notice = None;
        }
        self.select(selected);
        if let Some(session) = self.latest.session.as_ref().filter(|_| marked.is_some()) {
            let place = session.episodes.iter().rev().position(|entry| Some(&entry.file) == marked.as_ref());
            self.episode = place.unwrap_or(self.episode);
        }
        self.keep_in_bounds();
    }

    /// Selects this device, wherever it is listed now.
    fn select(&mut self, id: Option<ModalityId>) {
        let place = self.rows().iter().position(|device| Some(device.id) == id);
        self.selected = place.unwrap_or(self.selected);
    }

    fn toggle_order(&mut self) {
        let selected = self.selected_device().map(|device| device.id);
        self.by_trouble = !self.by_trouble;
        self.select(selected);
        self.notify(if self.by_trouble { "devices in trouble first" } else { "devices by their bits" });
    }

    fn read(&mut self) {
        self.totals = Totals {
            publications: self.rates.publications(),
            recorded: self.rates.recorded(),
            delivered: self.rates.delivered(),
        };
        for device in &self.latest.devices {
            if let Some(reading) = self.readings.get_mut(device.id.index()) {
                let age = device.newest.map(|newest| self.latest.taken.since(newest));
                *reading = Reading { hz: self.rates.samples(device.id), age };
            }
        }
    }

    fn key(&mut self, key: KeyEvent) -> Effect {
        let act = keys::act(key);
        // Only the next key confirms.
        let arming = self.arming.take();
        // The keys that stop motion work everywhere; letters are text while one is typed.
        match act {
            // The run continues without this screen, and so does what moves.
            Some(Act::Interrupt) if self.link != LinkState::Own => return self.ask_to_quit(),
            Some(Act::Interrupt) => {
                // Nothing moves while the user is being asked.
                let effect = self.ask_to_quit();
                return if effect == Effect::None { Effect::Order(Order::Disarm) } else { effect };
            }
            Some(Act::Escape) => return self.disarm(true),
            _ => {}
        }
        if let Some(prompt) = self.prompt.take() {
            return self.type_into(prompt, key);
        }
        match act {
            Some(Act::Disarm) => return self.disarm(false),
            Some(Act::Arm) => return self.arm(arming),
            Some(Act::Quit) => return self.ask_to_quit(),
            None if key.modifiers.intersects(KeyModifiers::CONTROL | KeyModifiers::ALT) => return Effect::None,
            _ => {}
        }
        // Any other key cancels.
        if self.quit == Quit::Asked {
            self.quit = Quit::No;
        }
        if let Some(overlay) = self.overlay.take() {
            // The key that closes it has no other effect.
            if let (Overlay::Help(page @ ..help::PAGES), Some(Act::Help)) = (overlay, act) {
                self.overlay = Some(Overlay::Help(page + 1));
            }
            return Effect::None;
        }
        let effect = act.map_or(Effect::None, |act| self.act(act));
        self.keep_in_bounds();
        effect
    }

    /// Whether the run accepts nothing from this screen.
    pub(super) const fn is_read_only(&self) -> bool {
        matches!(self.link, LinkState::Attached { read_only: true, .. } | LinkState::Lost { read_only: true, .. })
    }

    /// The effect, unless the link does not permit it.
    fn permitted(&mut self, effect: Effect) -> Effect {
        let is_request = matches!(effect, Effect::Send(_) | Effect::Order(_));
        match self.link {
            LinkState::Attached { read_only: true, .. } if is_request => {
                // Esc also closes dialogs.
                if effect != Effect::Order(Order::Disarm) {
                    self.notify(READ_ONLY);
                }
                Effect::None
            }
            LinkState::Lost { runs, .. } if is_request => {
                self.notify(if runs {
                    "not sent: the link to the run is lost, and is being connected again"
                } else {
                    "the run has ended: nothing receives this"
                });
                Effect::None
            }
            _ => effect,
        }
    }

    fn act(&mut self, act: Act) -> Effect {
        let session = |request| Effect::Send(Command::Session(request));
        if self.is_read_only() && act.is_about_the_rig() {
            // Before anything is asked.
            self.notify(READ_ONLY);
            return Effect::None;
        }
        match act {
            Act::Toggle => return self.toggle_recording(),
            Act::Next => return self.once(SessionRequest::Next),
            Act::Redo => return self.once(SessionRequest::Redo),
            Act::Discard => {
                let episode = self.marked_episode();
                return self.once(SessionRequest::Discard { episode });
            }
            Act::Stop => return session(SessionRequest::Stop),
            Act::Undo => return session(SessionRequest::Undo),
            Act::Mark => return session(SessionRequest::Mark { text: String::new() }),
            Act::Success => {
                let episode = self.marked_episode();
                return session(SessionRequest::Label { episode, label: Label::Success, reason: String::new() });
            }
            Act::Failure => self.ask(Question::WhyFailed),
            Act::Note => self.ask(Question::Note),
            Act::Task => self.ask(Question::Task),
            Act::EndSession => self.ask(Question::EndSession),
            Act::Register => self.ask_for_name(),
            Act::Control => self.ask(Question::Control),
            Act::Restart => return self.restart(),
            Act::AskToArm => self.ask_to_arm(),
            Act::Plug => return self.plug(),
            Act::Bell => self.toggle_bell(),
            Act::Order => self.toggle_order(),
            Act::Pause => self.toggle_pause(),
            Act::Help => self.overlay = Some(Overlay::Help(1)),
            Act::Web => self.show_link(),
            Act::Up | Act::Down | Act::First | Act::Last => self.step(act),
            Act::Older | Act::Newer => self.scroll(act, SCROLL_STEP),
            Act::Detail => self.turn_to(Page::Device),
            Act::Log => self.turn_to(Page::Log),
            Act::Episodes => self.turn_to(Page::Episodes),
            Act::Search => self.ask(Question::Search),
            Act::Level => self.log.raise(),
            Act::OneDevice => self.filter_by_device(),
            Act::Wrap => self.log.wraps = !self.log.wraps,
            Act::Group => self.log.groups = !self.log.groups,
            Act::Pictures => self.pictures = !self.pictures,
            // Handled before any other key.
            Act::Arm | Act::Disarm | Act::Escape | Act::Quit | Act::Interrupt => {}
        }
        Effect::None
    }

    /// The episode that is marked on the page of episodes; `None` on any other page, where keys are about the newest.
    pub(super) fn marked_episode(&self) -> Option<String> {
        let session = self.latest.session.as_ref().filter(|_| self.page == Page::Episodes)?;
        session.episodes.iter().rev().nth(self.episode).map(|entry| entry.file.clone())
    }

    /// Opens a page, or returns from it to the rig.
    fn turn_to(&mut self, page: Page) {
        self.page = if self.page == page { Page::Rig } else { page };
        self.looked = None;
    }

    /// Moves the selection of the page, or its text.
    fn step(&mut self, act: Act) {
        let selected = match self.page {
            Page::Rig | Page::Device => &mut self.selected,
            Page::Episodes => &mut self.episode,
            Page::Log => return self.scroll(act, 1),
        };
        *selected = match act {
            Act::Up => selected.saturating_sub(1),
            Act::Down => selected.saturating_add(1),
            Act::First => 0,
            _ => usize::MAX,
        };
        self.looked = None;
    }

    /// Selects a device, or opens the page of what was clicked. It neither begins nor ends anything.
    fn click(&mut self, target: Target) {
        match target {
            Target::Device(row) if row == self.selected => self.turn_to(Page::Device),
            Target::Device(row) => (self.selected, self.looked) = (row, None),
            Target::Detail => self.turn_to(Page::Device),
            Target::Log => self.turn_to(Page::Log),
            Target::Episodes => self.turn_to(Page::Episodes),
            Target::Devices => {}
        }
    }

    fn wheel(&mut self, target: Option<Target>, is_up: bool) {
        match target {
            Some(Target::Log) => self.scroll(if is_up { Act::Older } else { Act::Newer }, WHEEL),
            Some(Target::Device(_) | Target::Devices | Target::Detail) | None => {
                self.step(if is_up { Act::Up } else { Act::Down });
            }
            Some(Target::Episodes) if self.page == Page::Episodes => self.step(if is_up { Act::Up } else { Act::Down }),
            Some(Target::Episodes) => {}
        }
        self.keep_in_bounds();
    }

    fn scroll(&mut self, act: Act, by: usize) {
        let log = self.frozen.as_deref().unwrap_or(&self.latest).log.as_slice();
        match act {
            Act::Up | Act::Older => self.log.older(log, by),
            Act::First => self.log.older(log, usize::MAX - 1),
            Act::Down | Act::Newer => self.log.newer(log, by),
            _ => self.log.follow(),
        }
    }

    /// Shows only the lines about the selected device, or all.
    fn filter_by_device(&mut self) {
        let name = self.selected_device().map(|device| device.name.clone());
        self.log.device = if self.log.device.is_some() { None } else { name };
    }

    fn shows_a_device(&self) -> bool {
        self.page == Page::Device || (self.page == Page::Rig && self.has_column())
    }

    /// A frame is due, and the terminal has taken the one before or not. A line that is too slow for pictures shows none.
    pub(super) fn pace(&mut self, is_taken: bool) {
        let picture = self.selected_device().and_then(|device| self.picture(device.id));
        if is_taken || picture.is_none() || !self.pictures || !self.shows_a_device() {
            self.late = self.late.saturating_sub(1);
            return;
        }
        self.late += 1;
        if self.late == TOO_LATE {
            (self.late, self.pictures) = (0, false);
            self.notify("pictures are off: this line is too slow for them (c shows them)");
        }
    }

    /// Requests previews of the selected device while they are shown.
    fn request_previews(&mut self) -> Effect {
        let is_shown = self.shows_a_device();
        let is_due = self.looked.is_none_or(|looked| self.latest.taken.since(looked) >= LOOK_AGAIN);
        let is_linked = !matches!(self.link, LinkState::Lost { .. });
        let wanted = self.selected_device().filter(|_| is_shown && is_due && is_linked && self.frozen.is_none());
        let Some(id) = wanted.map(|device| device.id) else { return Effect::None };
        self.looked = Some(self.latest.taken);
        Effect::Send(Command::Look(id))
    }

    /// Whether the selected device is shown beside the rig.
    pub(super) fn has_column(&self) -> bool {
        let (columns, rows) = self.size;
        columns >= view::WITH_COLUMN.0 && rows >= view::WITH_COLUMN.1
    }

    /// The newest sample of a device that is looked at.
    pub(super) fn preview(&self, id: ModalityId) -> Option<&Preview> {
        self.shown().previews.iter().find(|preview| preview.device == id).map(|preview| &**preview)
    }

    /// It as a picture, or why it cannot be shown as one; `None` if it is something else.
    pub(super) fn picture(&self, id: ModalityId) -> Option<&Result<Picture, String>> {
        self.seen.picture.as_ref().filter(|_| self.seen.device == Some(id))
    }

    /// Its scan, if it is a LiDAR's.
    pub(super) fn sweep(&self, id: ModalityId) -> Option<&Sweep> {
        self.seen.sweep.as_ref().filter(|_| self.seen.device == Some(id))
    }

    /// The numbers of the last samples that were looked at, with their capture times.
    pub(super) fn numbers(&self, id: ModalityId) -> impl Iterator<Item = &(Stamp, Vec<f64>)> {
        self.seen.numbers.iter().filter(move |_| self.seen.device == Some(id))
    }

    /// Whether a key that begins or ends an episode counts. Each press counts from itself: while a key is held, nothing
    /// happens.
    fn is_new_press(&mut self) -> bool {
        let now = self.latest.taken;
        self.pressed.replace(now).is_none_or(|before| now.since(before) >= PRESS_AGAIN)
    }

    fn once(&mut self, request: SessionRequest) -> Effect {
        if self.is_new_press() { Effect::Send(Command::Session(request)) } else { Effect::None }
    }

    fn ask_to_quit(&mut self) -> Effect {
        if self.quit == Quit::No && self.latest.recording.is_some() && self.link == LinkState::Own {
            self.quit = Quit::Asked;
            return Effect::None;
        }
        self.quit = Quit::Ending;
        Effect::Leave
    }

    fn toggle_recording(&mut self) -> Effect {
        if !self.is_new_press() {
            return Effect::None;
        }
        let begins = self.latest.recording.is_none();
        self.notify(if begins { "starting an episode" } else { "finishing the episode" });
        if let Some(notice) = &mut self.notice {
            notice.awaits = Some(begins);
        }
        Effect::Send(Command::Session(SessionRequest::Toggle))
    }

    fn restart(&mut self) -> Effect {
        let Some(device) = self.selected_device() else { return Effect::None };
        let id = device.id;
        // The view may be paused: the current state counts.
        let Some(now) = self.latest.devices.iter().find(|device| device.id == id) else { return Effect::None };
        if now.state == DeviceState::Failed {
            let text = format!("restarting {}", now.name);
            self.notify(&text);
            return Effect::Send(Command::Restart(id));
        }
        let text = format!("{} has not failed: nothing to restart", now.name);
        self.notify(&text);
        Effect::None
    }

    /// Unplugs the selected device, or plugs it in, if it is a simulated one.
    fn plug(&mut self) -> Effect {
        let Some(device) = self.selected_device() else { return Effect::None };
        let name = device.name.clone();
        if !self.latest.simulated {
            self.notify("U unplugs simulated devices only (rapid --sim)");
            return Effect::None;
        }
        let is_plugged = self.latest.devices.iter().any(|now| now.name == name && now.state != DeviceState::Absent);
        self.notify(&if is_plugged { format!("unplugging {name}") } else { format!("plugging {name} in") });
        Effect::Send(Command::Plug(name))
    }

    fn show_link(&mut self) {
        if self.latest.links.is_empty() {
            self.notify("this run has no page: rapid --web 0.0.0.0 serves one");
        } else {
            self.overlay = Some(Overlay::Link);
        }
    }

    fn toggle_bell(&mut self) {
        self.is_silent = !self.is_silent;
        self.notify(if self.is_silent { "bell off" } else { "bell on" });
    }

    /// How often the bell was to ring since the screen began.
    pub fn rings(&self) -> u64 {
        self.rings
    }

    fn toggle_pause(&mut self) {
        if self.frozen.take().is_some() {
            self.frozen_history = None;
            self.read();
        } else {
            self.frozen = Some(Box::new(self.latest.clone()));
            self.frozen_history = Some(self.history.clone());
        }
    }

    fn notify(&mut self, text: &str) {
        self.notice = Some(Notice { text: text.to_owned(), shown: self.latest.taken, awaits: None });
    }

    fn keep_in_bounds(&mut self) {
        self.selected = self.selected.min(self.shown().devices.len().saturating_sub(1));
        let episodes = self.latest.session.as_ref().map_or(0, |session| session.episodes.len());
        self.episode = self.episode.min(episodes.saturating_sub(1));
    }

    /// The snapshot to show: the newest, or that of the moment the view was paused.
    pub fn shown(&self) -> &Snapshot {
        self.frozen.as_deref().unwrap_or(&self.latest)
    }

    /// The newest snapshot, paused or not.
    pub const fn latest(&self) -> &Snapshot {
        &self.latest
    }

    /// Is the view paused?
    pub fn is_paused(&self) -> bool {
        self.frozen.is_some()
    }

    /// Is an episode being recorded now, paused or not?
    pub fn is_recording(&self) -> bool {
        self.latest.recording.is_some()
    }

    /// The devices in the order in which they are listed.
    pub fn rows(&self) -> Vec<&DeviceStatus> {
        let mut rows: Vec<&DeviceStatus> = self.shown().devices.iter().collect();
        if self.by_trouble {
            rows.sort_by_key(|device| self.trouble(device));
        }
        rows
    }

    /// How urgent a device is, the lowest first.
    fn trouble(&self, device: &DeviceStatus) -> u8 {
        let outlook = self.shown().recording.as_ref().and_then(|recording| recording.outlook.finding(&device.name));
        match (outlook.map(|finding| finding.grade), device.state) {
            (Some(Grade::Bad), _) => 0,
            (_, DeviceState::Failed) => 1,
            (Some(Grade::Suspect), _) => 2,
            (_, DeviceState::Stalled) => 3,
            (_, DeviceState::Backoff) => 4,
            (_, DeviceState::Absent) => 5,
            (_, DeviceState::Opening) => 6,
            (_, DeviceState::Streaming) => 7,
        }
    }

    /// The last minute of a device in so many cells.
    pub(super) fn strip(&self, id: ModalityId, columns: usize) -> Vec<Cell> {
        self.frozen_history.as_ref().unwrap_or(&self.history).strip(id, columns)
    }

    /// The last five minutes of a bit in so many cells.
    pub(super) fn bits(&self, id: ModalityId, columns: usize) -> Vec<Bit> {
        self.frozen_history.as_ref().unwrap_or(&self.history).bits(id, columns)
    }

    /// Figures of a device.
    pub fn reading(&self, id: ModalityId) -> Reading {
        self.readings.get(id.index()).copied().unwrap_or_default()
    }

    /// How long there is disk space at the rate at which the devices deliver now; `None` if unknown, or longer than anyone plans
    /// for: most devices are out then.
    pub fn disk_left(&self) -> Option<Duration> {
        const A_MONTH: Duration = Duration::from_hours(30 * 24);
        let rate = self.totals.delivered.max(self.totals.recorded);
        let free = self.latest.disk_free.filter(|_| rate >= 1.0)?;
        Duration::try_from_secs_f64(free as f64 / rate).ok().filter(|left| *left < A_MONTH)
    }

    /// Has the bit of `id` just changed?
    pub fn edge(&self, id: ModalityId) -> Edge {
        let changed = self.edges.get(id.index()).copied().flatten();
        match changed {
            Some(changed) if changed <= self.shown().taken && self.shown().taken.since(changed) < EDGE_SHOWN => {
                Edge::Recent
            }
            _ => Edge::None,
        }
    }

    /// How long a device has been unplugged; `None` if it is not, or was never seen plugged in.
    pub fn unplugged_for(&self, device: &DeviceStatus) -> Option<Duration> {
        let unplugged = self.unplugged.get(device.id.index()).copied().flatten()?;
        let shown = self.shown().taken;
        (device.state == DeviceState::Absent && unplugged <= shown).then(|| shown.since(unplugged))
    }

    /// Samples that a device lost: in the episode in progress or, without one, in the run.
    pub(super) fn lost(&self, device: &DeviceStatus) -> u64 {
        let before = self.lost_before.get(device.id.index()).filter(|_| self.shown().recording.is_some());
        device.gaps.saturating_sub(before.copied().unwrap_or(0))
    }

    /// The selected device.
    pub fn selected_device(&self) -> Option<&DeviceStatus> {
        self.rows().get(self.selected).copied()
    }

    /// The answer to the last key, while it is fresh.
    pub fn notice(&self) -> Option<&str> {
        self.notice.as_ref().map(|notice| notice.text.as_str())
    }
}

/// Previews are requested anew after this time, well before the run stops them.
const LOOK_AGAIN: Duration = Duration::from_millis(500);
/// Lines by which the wheel scrolls the log.
const WHEEL: usize = 3;
/// Lines by which a page key scrolls the log.
const SCROLL_STEP: usize = 5;

/// Answers to requests that are new in `after`.
fn news(before: &Snapshot, after: &Snapshot) -> Vec<String> {
    let of_session = |snapshot: &Snapshot| snapshot.session.as_ref().and_then(|session| session.answer.clone());
    let pairs =
        [(of_session(before), of_session(after)), (before.registry_answer.clone(), after.registry_answer.clone())];
    pairs.into_iter().filter(|(before, after)| before != after).filter_map(|(_, after)| Some(after?.text)).collect()
}

/// Whether an episode began or ended between two snapshots, or a device that sent samples no longer does.
fn calls_attention(before: &Snapshot, after: &Snapshot) -> bool {
    let is_lost = |device: &DeviceStatus| {
        let now = after.devices.iter().find(|now| now.id == device.id);
        device.state == DeviceState::Streaming && now.is_none_or(|now| now.state != DeviceState::Streaming)
    };
    before.recording.is_some() != after.recording.is_some() || before.devices.iter().any(is_lost)
}

/// How long after the question an arm may be confirmed.
const CONFIRM_WITHIN: Duration = Duration::from_secs(2);

impl Model {
    /// Asks for confirmation: the actuator is about to move.
    fn ask_to_arm(&mut self) {
        self.arming = Some(self.latest.taken);
        self.notify("ctrl-y within 2 s arms the actuator, any other key cancels");
    }

    /// The confirming key occurs neither in pasted text nor in the repeats of a held key.
    fn arm(&mut self, asked: Option<Stamp>) -> Effect {
        let in_time = asked.is_some_and(|asked| self.latest.taken.since(asked) <= CONFIRM_WITHIN);
        self.notify(if in_time { "arming the actuator" } else { "not armed: a first, then ctrl-y within 2 s" });
        if in_time { Effect::Order(Order::Arm) } else { Effect::None }
    }

    /// Disarms, and closes any open dialog, as Esc usually does.
    fn disarm(&mut self, is_escape: bool) -> Effect {
        let (overlay, prompt) = (self.overlay.take(), self.prompt.take());
        let mut is_open = overlay.is_some() || prompt.is_some();
        if self.quit == Quit::Asked {
            (self.quit, is_open) = (Quit::No, true);
        }
        if is_escape {
            if prompt.is_some_and(|prompt| prompt.is_search()) || !is_open {
                self.log.search.clear();
            }
            // A dialog is closed before its page is left.
            if !is_open {
                self.log.follow();
                self.page = Page::Rig;
            }
        } else {
            self.notify(if self.is_read_only() { READ_ONLY } else { "disarming the actuator" });
        }
        Effect::Order(Order::Disarm)
    }
}

#[cfg(test)]
mod tests;
