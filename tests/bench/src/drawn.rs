//! The monitor drawn in this process: what a frame costs, and whether memory stays flat while it shows a simulated day.
//!
//! Snapshots come from a real board; only their time is simulated, so that a day passes in a minute.

use std::cell::Cell;
use std::io::{self, Write};
use std::process::Command;
use std::rc::Rc;
use std::time::{Duration, Instant};

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Epoch, SampleHeader};
use rapid_core::time::Stamp;
use rapid_registry::Registry;
use rapid_screens::tui::model::{Model, Msg};
use rapid_screens::tui::picture::Canvas;
use rapid_screens::tui::theme::Theme;
use rapid_screens::tui::view;
use rapid_status::palette::Palette;
use rapid_status::{Board, DeviceState, Level, Snapshot};
use ratatui::backend::CrosstermBackend;
use ratatui::buffer::Buffer;
use ratatui::crossterm::event::KeyCode;
use ratatui::layout::Rect;
use ratatui::widgets::Paragraph;
use ratatui::{Terminal, TerminalOptions, Viewport};
use serde::{Deserialize, Serialize};

use crate::feed::{Feed, Lane};
use crate::figure::Figure;
use crate::process::Running;
use crate::pty::SIZE;
use crate::start::ms;
use crate::stats::Sorted;
use crate::{Bench, Failure, heap, many};

/// Devices of the rig.
pub(crate) const DEVICES: usize = 16;
/// Time between two frames of the monitor.
const FRAME: Duration = Duration::from_millis(67);
/// Lines of the log before the first frame: more than the board keeps.
const LOGGED: usize = 2_500;
/// The simulated clock is ahead of the real one by this much: a board drops previews that are too old.
const AHEAD: Duration = Duration::from_secs(3600);
const HOUR: u64 = 3_600;
const DAY: u64 = 24 * HOUR;
/// Simulated seconds between two frames that are drawn, two pictures, two edges of the mask, two keys.
const DRAWN: u64 = 10;
const PICTURE: u64 = 30;
const EDGE: u64 = 60;
const KEY: u64 = 300;
/// Upper limit for a simulated day.
const LIMIT: Duration = Duration::from_secs(1800);

/// A terminal that only counts bytes.
#[derive(Debug, Clone, Default)]
struct Sink(Rc<Cell<u64>>);

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.set(self.0.get() + bytes.len() as u64);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn terminal(sink: &Sink) -> Result<Terminal<CrosstermBackend<Sink>>, Failure> {
    let viewport = Viewport::Fixed(Rect::new(0, 0, SIZE.0, SIZE.1));
    Ok(Terminal::with_options(CrosstermBackend::new(sink.clone()), TerminalOptions { viewport })?)
}

/// A rig on a board, and the monitor that shows it.
struct Monitor {
    board: Board,
    ids: Vec<ModalityId>,
    lanes: Vec<Lane>,
    now: Stamp,
    model: Model,
    terminal: Terminal<CrosstermBackend<Sink>>,
    sink: Sink,
    canvas: Canvas,
    theme: Theme,
}

impl Monitor {
    /// All devices stream, and the log is full.
    fn new() -> Result<Self, Failure> {
        let registry = Registry::parse(&many::registry(DEVICES)?, None)?.registry;
        let ids: Vec<ModalityId> = registry.devices.iter().map(|device| device.id).collect();
        let board = Board::new(&registry);
        for id in &ids {
            board.set_device_state(*id, DeviceState::Streaming, Epoch(1), "/dev/video0 MJPG 640x480@30");
        }
        let now = Stamp::now().after(AHEAD);
        let set = |name: &str| (name == "LC_ALL").then(|| "C.UTF-8".to_owned());
        let (sink, lanes) = (Sink::default(), Feed::full_load()?.lanes.to_vec());
        let (model, terminal) = (Model::new(board.snapshot()), terminal(&sink)?);
        let (canvas, theme) = (Canvas::detect(|_| None, None, || false), Theme::detect(Palette::Ansi, set));
        let mut monitor = Self { board, ids, lanes, now, model, terminal, sink, canvas, theme };
        (0..LOGGED).for_each(|number| monitor.log(number));
        monitor.model.update(Msg::Size(SIZE.0, SIZE.1));
        Ok(monitor)
    }

    /// A line of the log: of each five, three are repeats of few kinds, as in a rig with a loose cable.
    fn log(&self, number: usize) {
        let device = number % DEVICES;
        match number % 5 {
            0 => self.board.log(Level::Info, &format!("d{device} streaming, mask 0x{number:04x}")),
            1 => self.board.log(Level::Info, &format!("d{device}: opened /dev/video{device} with 640x480 at 30 Hz")),
            2 => self.board.log(Level::Error, &format!("d{device}: permission denied, again in {} s", number % 30)),
            _ => self.board.log(Level::Warn, &format!("d{}: {} samples lost", device % 3, number % 100)),
        }
    }

    /// Lets time pass; all devices send samples, and the mask is published.
    fn pass(&mut self, span: Duration, number: u64) {
        self.now = self.now.after(span);
        let mut mask = PhysicalMask::EMPTY;
        for id in &self.ids {
            let is_away = id.index() as u64 == number / EDGE % DEVICES as u64 && number % EDGE < 5;
            let state = if is_away { DeviceState::Absent } else { DeviceState::Streaming };
            self.board.set_device_state(*id, state, Epoch(1), "/dev/video0 MJPG 640x480@30");
            self.board.counters(*id).count(60_000, self.now, 0);
            mask = mask.with(*id, !is_away);
        }
        self.board.set_mask(mask, number * 33);
    }

    /// Sends the next sample of the load's first camera, or of its state, as a preview of the selected device.
    fn preview(&self, is_picture: bool, seq: u64) {
        let lane = if is_picture { self.lanes.first() } else { self.lanes.last() };
        let selected = self.model.selected_device().map(|device| device.id);
        if let (Some(lane), Some(id)) = (lane, selected) {
            let header = SampleHeader { seq, capture_ns: self.now.0, recv_ns: self.now.0, ..lane.header };
            self.board.look(id, self.now);
            self.board.preview(id, &header, &lane.payloads[seq as usize % lane.payloads.len()]);
        }
    }

    fn snapshot(&self) -> Snapshot {
        Snapshot { taken: self.now, ..self.board.snapshot() }
    }

    fn update(&mut self) {
        let snapshot = self.snapshot();
        // Requests to the run: there is none.
        drop(self.model.update(Msg::Snapshot(Box::new(snapshot))));
    }

    fn press(&mut self, key: KeyCode) {
        drop(self.model.update(Msg::Key(key.into())));
    }

    /// Draws, and returns what is drawn.
    fn draw(&mut self) -> io::Result<&Buffer> {
        let (model, theme, canvas) = (&self.model, self.theme, &mut self.canvas);
        Ok(self.terminal.draw(|frame| view::draw(frame, model, theme, canvas))?.buffer)
    }
}

/// A page of the monitor, whose frames are measured.
struct Page {
    name: &'static str,
    key: Option<KeyCode>,
    with_picture: bool,
    target: Option<&'static str>,
}

const PAGES: [Page; 3] = [
    Page { name: "frame", key: None, with_picture: false, target: Some("< 3") },
    Page { name: "frame of the log's page", key: Some(KeyCode::Char('l')), with_picture: false, target: Some("< 3") },
    Page { name: "frame with a picture", key: Some(KeyCode::Enter), with_picture: true, target: None },
];

/// The time of a frame.
pub(crate) fn frames(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let count = if bench.smoke { 20 } else { bench.choose(3_000, 300) };
    let mut figures = Vec::new();
    for page in PAGES {
        bench.progress(&format!("screen: {count} times a {}", page.name));
        figures.extend(page_frames(&page, count)?);
    }
    Ok(figures)
}

fn page_frames(page: &Page, count: u64) -> Result<Vec<Figure>, Failure> {
    let (mut monitor, plain_sink) = (Monitor::new()?, Sink::default());
    let mut plain = terminal(&plain_sink)?;
    if let Some(key) = page.key {
        monitor.press(key);
    }
    let (mut frames, mut paragraphs) = (Vec::new(), Vec::new());
    for number in 0..count {
        monitor.pass(FRAME, number);
        // One line each second.
        if number % 15 == 0 {
            monitor.log(number as usize);
        }
        if page.with_picture {
            monitor.preview(true, number);
        }
        let begun = Instant::now();
        monitor.update();
        let text = monitor.draw()?;
        frames.push(ms(begun));
        let text = lines(text);
        let begun = Instant::now();
        plain.draw(|frame| frame.render_widget(Paragraph::new(text.as_str()), frame.area()))?;
        paragraphs.push(ms(begun));
    }
    let (frames, paragraphs) = (Sorted::new(frames), Sorted::new(paragraphs));
    let ratio = frames.quantile(0.5).zip(paragraphs.quantile(0.5)).map_or(0.0, |(a, b)| a / b);
    let note = format!(
        "{count} frames of {}x{} with {DEVICES} devices and a full log, from the snapshot to {} bytes a frame; baseline: a \
         Paragraph with the same text, {ratio:.1} times as fast",
        SIZE.0,
        SIZE.1,
        monitor.sink.0.get() / count
    );
    let figure = |label: &str, share: f64| {
        let figure = Figure::new(format!("screen/{}, {label}", page.name), "ms", frames.quantile(share))
            .baseline(paragraphs.quantile(share));
        match page.target {
            Some(target) => figure.target(target),
            None => figure,
        }
    };
    Ok(vec![figure("p50", 0.5).note(note), figure("p99", 0.99)])
}

/// The characters of a screen.
fn lines(buffer: &Buffer) -> String {
    let rows = buffer.content().chunks(usize::from(buffer.area.width).max(1));
    rows.map(|row| row.iter().map(ratatui::buffer::Cell::symbol).chain(["\n"]).collect::<String>()).collect()
}

/// What a child reports: its anonymous memory, KiB.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Kept {
    /// After the first time.
    first: f64,
    /// After all of it.
    all: f64,
    /// At most, in between.
    most: f64,
}

/// The growth of memory over a simulated day, in a process of its own.
pub(crate) fn day(bench: &Bench) -> Result<Figure, Failure> {
    // The log is full after 2,000 s, and the history after five minutes.
    let (first, all) = if bench.smoke { (60, 120) } else { bench.choose((HOUR, DAY), (HOUR, 2 * HOUR)) };
    bench.progress(&format!("screen: {all} simulated seconds"));
    let mut command = Command::new(std::env::current_exe()?);
    command.arg("hours").arg(first.to_string()).arg(all.to_string());
    let usage = Running::start(&mut command)?.finish(LIMIT, || {})?;
    let Kept { first: before, all: after, most } = serde_json::from_str(&usage.output)?;
    let note = format!(
        "anonymous memory of a process that shows {all} simulated seconds, a snapshot each: {before:.0} KiB after {first} s, \
         {after:.0} at the end, at most {most:.0}; each minute a device leaves, each second a line is logged and numbers are \
         plotted, each {PICTURE} s there is a picture"
    );
    Ok(Figure::new("screen/memory, the day against its first hour", "", Some(after / before))
        .target("<= 1.05")
        .note(note))
}

/// Shows simulated seconds as fast as possible.
pub(crate) fn kept(first: u64, all: u64) -> Result<Kept, Failure> {
    let mut monitor = Monitor::new()?;
    monitor.press(KeyCode::Enter);
    let mut kept = Kept { first: 0.0, all: 0.0, most: 0.0 };
    for second in 0..all {
        monitor.pass(Duration::from_secs(1), second);
        monitor.log(second as usize);
        monitor.preview(second % PICTURE == 0, second);
        if second % KEY == 0 {
            // The next device, then the log, then the device again.
            monitor.press([KeyCode::Char('j'), KeyCode::Char('l'), KeyCode::Enter][(second / KEY % 3) as usize]);
        }
        monitor.update();
        if second % DRAWN == 0 {
            monitor.draw()?;
            let now = heap::resident()?;
            if second < first { kept.first = now } else { kept.most = kept.most.max(now) }
        }
    }
    kept.all = heap::resident()?;
    Ok(kept)
}
