//! The monitor: a full-screen view of the rig while data is collected.
//!
//! Snapshots, fifteen per second, and the user's keys change the [`model`]; the `view` draws it. Where snapshots come from
//! and requests go is the [`RigLink`]: the board of this process, or a run of another process.
//!
//! Invariant: the terminal is restored to its previous state, however the screen ends.
//! Invariant: a blocked terminal delays nothing: a separate thread writes the frames, and frames are dropped
//! while it is behind.

mod detail;
mod devices;
mod episodes;
pub mod flashlight;
mod footer;
mod header;
mod help;
mod history;
mod keys;
mod lidar;
mod link;
mod log;
mod log_view;
mod mask;
pub mod model;
mod page_link;
pub mod picture;
mod policy;
mod recording;
mod terminal;
pub mod theme;
mod timeline;
mod tour;
pub mod view;

use std::io::{self, Write as _};
use std::sync::Arc;
use std::time::Duration;

use crossterm::event::{Event, EventStream, MouseButton, MouseEvent, MouseEventKind};
use futures::{FutureExt, Stream, StreamExt};
pub use link::{Closed, LinkState, Own, RigLink};
use model::{Model, Msg};
use rapid_core::permission::Permission;
use rapid_core::time::Zone;
use rapid_status::palette::Palette;
use rapid_status::{Board, Command};
use ratatui::layout::Position;
use rustix::process::Signal;
use terminal::Screen;
use theme::Theme;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{Notify, mpsc};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

/// Time between two frames when no key is pressed.
const FRAME: Duration = Duration::from_millis(67);

/// Why there is no screen.
#[derive(Debug, thiserror::Error)]
pub enum TuiError {
    /// Input or output is not a terminal, or it cannot be switched to raw mode.
    #[error(
        "no terminal for the monitor: {0}; without one: `rapid --headless` to run, `rapid logs -f` to follow a run"
    )]
    NoTerminal(#[source] io::Error),
    /// The terminal went away.
    #[error("the terminal is gone: {0}")]
    Gone(#[source] io::Error),
}

/// Width of the terminal in columns, if there is one.
pub fn columns() -> Option<usize> {
    crossterm::terminal::size().ok().map(|(columns, _)| usize::from(columns))
}

/// How a screen is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ScreenOptions {
    /// Times are UTC, and not those of the machine's zone.
    pub utc: bool,
    /// The mouse selects and scrolls; the terminal's own selection of text then needs shift.
    pub mouse: bool,
    /// The screen leads through the first minute.
    pub tour: bool,
}

/// What a click or the wheel means.
fn pointed(mouse: MouseEvent, model: &Model, theme: Theme) -> Option<Msg> {
    let target = view::target(model, model.size, theme, Position::new(mouse.column, mouse.row));
    match mouse.kind {
        MouseEventKind::Down(MouseButton::Left) => target.map(Msg::Click),
        MouseEventKind::ScrollUp => Some(Msg::Wheel(target, true)),
        MouseEventKind::ScrollDown => Some(Msg::Wheel(target, false)),
        _ => None,
    }
}

/// Shows the monitor of a run of this process until `shutdown`.
///
/// A request to quit only sends [`Command::Quit`]; the screen stays until the receiver of the commands
/// cancels `shutdown` or is dropped.
///
/// # Errors
/// When there is no terminal, or it goes away.
pub async fn run(
    board: Arc<Board>,
    commands: mpsc::Sender<Command>,
    permission: Arc<Permission>,
    options: ScreenOptions,
    shutdown: CancellationToken,
) -> Result<(), TuiError> {
    let outcome = show(Own::new(Arc::clone(&board), commands, permission), options, shutdown).await;
    // The terminal shows what was there before: without this line nothing of the run is left on it.
    if let Some(summary) = board.episodes().summary() {
        let _ = writeln!(io::stdout(), "{summary}");
    }
    outcome
}

/// Shows the monitor of whatever is at the other end of `link`, until `shutdown`, or until the link is closed.
///
/// # Errors
/// When there is no terminal, or it goes away.
pub async fn show(mut link: impl RigLink, options: ScreenOptions, shutdown: CancellationToken) -> Result<(), TuiError> {
    let theme = Theme::detect(Palette::for_output(&io::stdout()), |name| std::env::var(name).ok());
    let mut screen = Screen::open(options.mouse).map_err(TuiError::NoTerminal)?;
    let size = crossterm::terminal::size().ok();
    // The size comes with later changes of it.
    let size = futures::stream::iter(size.map(|(columns, rows)| Ok(Event::Resize(columns, rows))));
    let events = terminal::without_answers(size.chain(EventStream::new()));
    let mut continued = signal(SignalKind::from_raw(Signal::CONT.as_raw())).map_err(TuiError::NoTerminal)?;
    let room = screen.room();
    let draw = |model: &Model| {
        if continued.recv().now_or_never().is_some() {
            screen.resume()?;
        }
        screen.draw(model, theme)
    };
    let outcome = drive(&mut link, &shutdown, events, options, &room, draw).await;
    screen.close().await;
    outcome
}

/// The loop itself, with any source of terminal events and any way to draw: one that returns false has drawn nothing, and is
/// repeated when `room` is notified.
async fn drive(
    link: &mut impl RigLink,
    shutdown: &CancellationToken,
    events: impl Stream<Item = io::Result<Event>>,
    options: ScreenOptions,
    room: &Notify,
    mut draw: impl FnMut(&Model) -> io::Result<bool>,
) -> Result<(), TuiError> {
    let mut events = std::pin::pin!(events);
    let mut model = Model::new(link.snapshot());
    model.zone = if options.utc { Zone::UTC } else { Zone::local() };
    model.tour = options.tour.then(tour::Tour::default);
    let theme = Theme::detect(Palette::for_output(&io::stdout()), |name| std::env::var(name).ok());
    let mut frames = tokio::time::interval(FRAME);
    frames.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut is_drawn = true;
    loop {
        model.link = link.state();
        if let Some(answer) = link.answer() {
            drop(model.update(answer));
        }
        let effect = tokio::select! {
            biased;
            () = shutdown.cancelled() => return Ok(()),
            event = events.next() => match event {
                Some(Ok(Event::Key(key))) => model.update(Msg::Key(key)),
                Some(Ok(Event::Mouse(mouse))) => pointed(mouse, &model, theme).map_or(model::Effect::None, |msg| model.update(msg)),
                Some(Ok(Event::Resize(columns, rows))) => model.update(Msg::Size(columns, rows)),
                Some(Ok(Event::Paste(text))) => model.update(Msg::Paste(text)),
                Some(Ok(_)) => model::Effect::None,
                Some(Err(error)) => return Err(TuiError::Gone(error)),
                None => return Err(TuiError::Gone(io::ErrorKind::UnexpectedEof.into())),
            },
            () = room.notified(), if !is_drawn => model::Effect::None,
            _ = frames.tick() => {
                model.pace(is_drawn);
                model.update(Msg::Snapshot(Box::new(link.snapshot())))
            }
        };
        match link.carry_out(effect) {
            Ok(Some(answer)) => drop(model.update(answer)),
            Ok(None) => {}
            Err(Closed) => return Ok(()),
        }
        is_drawn = draw(&model).map_err(TuiError::Gone)?;
    }
}

#[cfg(test)]
mod tests;
