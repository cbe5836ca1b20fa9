mod pages;
mod policy;

use std::time::Duration;

use rapid_core::interlock::{InputState, StopKind};
use rapid_core::time::Stamp;
use rapid_status::session::{EpisodeEntry, Label, Phase, SessionRequest, SessionStatus};

use crate::literal::{TAKEN, board, device, every_state, line, recording, sixty_four, snapshot, three_streaming};
use crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use insta::assert_snapshot;
use rapid_status::{
    DeviceState, Finding, Grade, Level, Outlook, RecordingStatus, Sensors, Snapshot, StopStatus, Verdict,
};
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::style::{Color, Modifier, Style};

use super::*;
use picture::Canvas;
use theme::Charset;

const THEME: Theme = Theme { palette: Palette::Ansi, charset: Charset::Unicode };
const ASCII: Theme = Theme { palette: Palette::Plain, charset: Charset::Ascii };

fn press(code: KeyCode) -> Msg {
    Msg::Key(KeyEvent::new(code, KeyModifiers::NONE))
}

/// The model after two seconds in which every running device sent 30 samples a second.
fn measured(end: &Snapshot) -> Model {
    let at = |ms: u64| {
        let before = Duration::from_millis(2000 - ms);
        let mut then = end.clone();
        then.taken = end.taken.before(before);
        then.mask_sequence = end.mask_sequence - (2000 - ms) / 2;
        for device in &mut then.devices {
            device.samples = device.samples.saturating_sub((2000 - ms) * 30 / 1000);
            device.newest = device.newest.map(|newest| newest.before(before));
        }
        if let Some(recording) = &mut then.recording {
            recording.bytes -= (2000 - ms) * 6_000;
        }
        then
    };
    let mut model = Model::new(at(0));
    for ms in [500, 1000, 1500, 2000] {
        model.update(Msg::Snapshot(Box::new(at(ms))));
    }
    model
}

fn draw(model: &Model, (width, height): (u16, u16), theme: Theme) -> TestBackend {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| view::draw(frame, model, theme, &mut Canvas::default())).unwrap();
    terminal.backend().clone()
}

/// The style at the first occurrence of `text`.
fn style_of(buffer: &Buffer, text: &str) -> Style {
    let wanted: Vec<String> = text.chars().map(String::from).collect();
    let columns = usize::from(buffer.area.width);
    let at = buffer.content.chunks(columns).find_map(|row| {
        let symbols: Vec<&str> = row.iter().map(ratatui::buffer::Cell::symbol).collect();
        let start = symbols.windows(wanted.len()).position(|window| window == wanted)?;
        row.get(start).map(ratatui::buffer::Cell::style)
    });
    at.unwrap_or_else(|| panic!("{text:?} is not on the screen"))
}

#[test]
fn an_empty_rig() {
    assert_snapshot!(draw(&Model::new(snapshot(Vec::new())), (80, 24), THEME));
}

#[test]
fn three_devices_stream() {
    let mut end = three_streaming();
    end.last_episode = Some("episodes/2023-11-14_place-block_006.mcap".into());
    let sensors = Some(Sensors { registered: 3, recorded: 3, without: Vec::new(), away: Vec::new() });
    end.last_verdict = Some(Verdict { grade: Grade::Good, reasons: Vec::new(), sensors, replay_of: Vec::new() });
    end.log = vec![line(0, Level::Info, "cam_wrist is streaming"), line(1, Level::Info, "tof is streaming")];
    assert_snapshot!("three_80x24", draw(&measured(&end), (80, 24), THEME));
    assert_snapshot!("three_120x40", draw(&measured(&end), (120, 40), THEME));
}

#[test]
fn the_last_verdict_is_shown_with_its_file_and_the_reasons_that_fit() {
    let mut end = three_streaming();
    end.last_episode = Some("episodes/2023-11-14_place-block_006.mcap".into());
    for (grade, colour) in [(Grade::Suspect, Color::Yellow), (Grade::Bad, Color::Red)] {
        end.last_verdict = Some(Verdict {
            grade,
            reasons: vec![
                "cam_wrist: frozen for 5.0 s: 151 samples byte for byte the same (limit 2.0 s)".to_owned(),
                "tof: 3 of 213 samples lost by the device (limit 1 %)".to_owned(),
            ],
            sensors: Some(Sensors { registered: 3, recorded: 2, without: vec!["tof".to_owned()], away: Vec::new() }),
            replay_of: Vec::new(),
        });
        let screen = draw(&measured(&end), (80, 24), THEME);
        assert_eq!(style_of(screen.buffer(), grade.word()).fg, Some(colour));
        assert_eq!(style_of(screen.buffer(), "cam_wrist: fro").fg, Some(colour));
    }
    assert_snapshot!("verdict_80x24", draw(&measured(&end), (80, 24), ASCII));
    assert_snapshot!("verdict_60x12", draw(&measured(&end), (60, 12), THEME));
}

fn entry(number: usize, verdict: Option<Grade>) -> EpisodeEntry {
    let file = format!("20231114_place-block_{number:03}.mcap");
    EpisodeEntry {
        seconds: verdict.map(|_| 29.8),
        verdict,
        sensors: verdict.map(|_| Sensors { registered: 3, recorded: 3, without: Vec::new(), away: Vec::new() }),
        ..EpisodeEntry::begin(file, "2023-11-14T22:13:20.000Z".to_owned())
    }
}

/// Six episodes of twelve wanted, one discarded, one labelled.
fn session() -> SessionStatus {
    let mut episodes: Vec<_> = (1..=7).map(|number| entry(number, Some(Grade::Good))).collect();
    episodes[4].discarded = true;
    episodes[5].label = Some(Label::Failure);
    episodes[5].label_reason = "slipped".to_owned();
    episodes[6].verdict = Some(Grade::Suspect);
    episodes[6].reasons = vec!["tof: 3 of 213 samples lost by the device (limit 1 %)".to_owned()];
    SessionStatus {
        task: "place block".to_owned(),
        tags: vec![("finger".to_owned(), "soft".to_owned())],
        goal: Some(12),
        counted: 6,
        verdicts: [5, 1, 0],
        discarded: 1,
        episodes,
        ..SessionStatus::default()
    }
}

#[test]
fn a_session_is_shown_with_its_goal_its_episodes_and_the_time_on_the_disk() {
    let mut end = three_streaming();
    end.disk_free = Some(500_000_000_000);
    end.session = Some(session());
    assert_snapshot!("session_80x24", draw(&measured(&end), (80, 24), THEME));
    assert_snapshot!("session_120x40", draw(&measured(&end), (120, 40), THEME));
    let until = end.taken.after(Duration::from_millis(2_100));
    for (phase, expected) in [
        (Phase::Countdown { until }, "an episode begins in 00:03; space begins it now"),
        (Phase::Reset { until }, "reset the scene: the next episode begins in 00:03; space begins it now"),
    ] {
        end.session.as_mut().unwrap().phase = phase;
        for size in [(80, 24), (120, 40)] {
            let screen = draw(&measured(&end), size, THEME).to_string();
            assert!(screen.contains(expected) && screen.contains("begin now"), "{screen}");
        }
    }
}

#[test]
fn a_text_that_is_typed_is_shown_with_its_end() {
    let mut now = three_streaming();
    let episodes = vec![EpisodeEntry::begin("a.mcap".to_owned(), String::new())];
    now.session = Some(SessionStatus { episodes, ..SessionStatus::default() });
    let mut model = measured(&now);
    model.update(press(KeyCode::Char('n')));
    for c in "a note that is longer than the sixty columns of the line, öä".chars() {
        model.update(press(KeyCode::Char(c)));
    }
    let screen = draw(&model, (60, 12), THEME).to_string();
    assert!(screen.contains(" a.mcap, note: ") && screen.contains("columns of the line, öä█"), "{screen}");
}

/// A minute in which one camera slows down and recovers, one is unplugged for 8 s, and a device has no nominal rate.
#[test]
fn the_last_minute_of_each_device_is_a_strip() {
    let mut now = three_streaming();
    let end = now.taken;
    let mut counts = [0, 0, 0];
    now.devices[0].nominal_hz = Some(30.0);
    now.devices[1].nominal_hz = Some(30.0);
    now.taken = end.before(Duration::from_mins(1));
    let mut model = Model::new(now.clone());
    for second in 0..=60 {
        let is_away = (40..48).contains(&second);
        let rates = [if second < 20 { 30 } else { (second - 10).min(30) }, if is_away { 0 } else { 30 }, 100];
        for ((device, count), rate) in now.devices.iter_mut().zip(&mut counts).zip(rates) {
            *count += rate;
            device.samples = *count;
        }
        now.devices[1].state = if is_away { DeviceState::Absent } else { DeviceState::Streaming };
        now.taken = end.before(Duration::from_secs(60 - second));
        model.update(Msg::Snapshot(Box::new(now.clone())));
    }
    assert_snapshot!("history_120x40", draw(&model, (120, 40), THEME));
    assert_snapshot!("history_200x60", draw(&model, (200, 60), THEME));
    // A paused view keeps the minute at which it was paused.
    model.update(Msg::Key(KeyEvent::new(KeyCode::Char('p'), KeyModifiers::NONE)));
    let strip = |model: &Model| model.strip(now.devices[0].id, 60);
    let before = strip(&model);
    for second in 1..5 {
        now.taken = end.after(Duration::from_secs(second));
        model.update(Msg::Snapshot(Box::new(now.clone())));
    }
    assert_eq!(strip(&model), before);
    model.update(Msg::Key(KeyEvent::new(KeyCode::Char('p'), KeyModifiers::NONE)));
    assert_ne!(strip(&model), before);
}

#[test]
fn every_state_has_its_word_symbol_and_colour() {
    let model = measured(&every_state());
    let screen = draw(&model, (80, 24), THEME);
    assert_snapshot!("states_80x24", screen);
    assert_snapshot!("states_120x40", draw(&model, (120, 40), THEME));
    let buffer = screen.buffer();
    for (cell, colour, bold) in [
        ("● streaming", Color::Green, false),
        ("○ absent", Color::Red, false),
        ("◐ opening", Color::Yellow, false),
        ("◌ backoff", Color::Yellow, false),
        ("◆ stalled", Color::Magenta, false),
        ("✕ failed", Color::Red, true),
    ] {
        let style = style_of(buffer, cell);
        assert_eq!(style.fg, Some(colour), "{cell}");
        // The first row is selected, and therefore bold whatever its state.
        if cell != "● streaming" {
            assert_eq!(style.add_modifier.contains(Modifier::BOLD), bold, "{cell}");
        }
    }
    assert_eq!(style_of(buffer, "■  0").bg, Some(Color::Green));
    assert_eq!(style_of(buffer, "□  1").bg, Some(Color::Reset));
    assert_eq!(style_of(buffer, "warn ").fg, Some(Color::Yellow));
    assert_eq!(style_of(buffer, "error").fg, Some(Color::Red));
}

#[test]
fn without_colours_and_unicode_states_stay_distinguishable() {
    let mut end = every_state();
    end.devices[1].detail = "Kamera für Überblick 相机".to_owned();
    end.recording = Some(recording(2));
    let screen = draw(&measured(&end), (80, 24), ASCII);
    assert_snapshot!(screen);
    for cell in &screen.buffer().content {
        assert!(cell.symbol().is_ascii(), "{:?}", cell.symbol());
        assert!(cell.fg == Color::Reset && cell.bg == Color::Reset);
    }
    // Filled cells are still filled.
    assert!(style_of(screen.buffer(), "#  0").add_modifier.contains(Modifier::REVERSED));
}

#[test]
fn an_episode_that_loses_samples_is_marked() {
    let mut end = three_streaming();
    end.recording = Some(recording(17));
    let model = measured(&end);
    let screen = draw(&model, (80, 24), THEME);
    assert_snapshot!("recording_80x24", screen);
    assert_snapshot!("recording_120x40", draw(&model, (120, 40), THEME));
    assert_eq!(style_of(screen.buffer(), "▲ dropped 17").fg, Some(Color::Red));
    assert_eq!(style_of(screen.buffer(), "● REC").fg, Some(Color::Red));
}

#[test]
fn a_filling_disk_shows_the_remaining_time() {
    let mut end = three_streaming();
    end.recording = Some(RecordingStatus { room: Some(Duration::from_secs(252)), ..recording(17) });
    let model = measured(&end);
    for (size, theme) in [((80, 24), THEME), ((80, 24), ASCII)] {
        let screen = draw(&model, size, theme).to_string();
        assert!(screen.contains("disk full in 04:12") && screen.contains("dropped 17"), "{screen}");
    }
    assert_eq!(style_of(draw(&model, (80, 24), THEME).buffer(), "▲ disk full in 04:12").fg, Some(Color::Red));
}

#[test]
fn sixty_four_devices_fit_and_scroll() {
    let mut model = measured(&sixty_four());
    assert_snapshot!("sixty_four_80x24", draw(&model, (80, 24), THEME));
    assert_snapshot!("sixty_four_60x12", draw(&model, (60, 12), THEME));
    assert_snapshot!("sixty_four_120x40", draw(&model, (120, 40), THEME));
    for _ in 0..40 {
        model.update(press(KeyCode::Down));
    }
    let screen = draw(&model, (80, 24), THEME).to_string();
    assert!(screen.contains("▸ 40 sensor_40"), "{screen}");
    model.update(press(KeyCode::End));
    let screen = draw(&model, (80, 24), THEME).to_string();
    assert!(screen.contains("▸ 63 sensor_63"), "{screen}");
}

#[test]
fn long_and_foreign_names_keep_the_columns() {
    let mut end = snapshot(vec![
        device(0, "a_name_of_sixty_four_characters_which_is_the_longest_that_is_ok", DeviceState::Streaming, "x"),
        device(1, "相机手腕左侧的相机", DeviceState::Streaming, "/dev/video0 相机手腕左侧的相机手腕左侧的"),
        device(2, "e\u{301}te\u{301}", DeviceState::Absent, "\x1b[2J\x1b[Hhello\r\n\u{202e}reversed"),
    ]);
    end.rig = "a rig whose name is far too long for a header".to_owned();
    end.log = vec![line(0, Level::Warn, &"wörter ".repeat(40)), line(1, Level::Info, "bell\x07 and\ttab")];
    let screen = draw(&measured(&end), (80, 24), THEME);
    assert_snapshot!(screen);
    assert!(screen.buffer().content.iter().all(|cell| !cell.symbol().contains(char::is_control)));
}

#[test]
fn a_small_terminal_shows_the_required_size() {
    let model = measured(&three_streaming());
    assert_snapshot!("too_small", draw(&model, (40, 8), THEME));
    assert_snapshot!("smallest", draw(&model, (60, 12), THEME));
    // Not even that fits; still no panic.
    for size in [(1, 1), (10, 1), (1, 10), (59, 200), (300, 11), (300, 200)] {
        draw(&model, size, THEME);
    }
}

#[test]
fn the_help_lists_every_key() {
    let mut model = measured(&three_streaming());
    model.update(press(KeyCode::Char('?')));
    assert_snapshot!("help_80x24", draw(&model, (80, 24), THEME));
    assert_snapshot!("help_60x12", draw(&model, (60, 12), THEME));
    model.update(press(KeyCode::Char('?')));
    assert_snapshot!("help_screen_80x24", draw(&model, (80, 24), THEME));
}

#[test]
fn the_link_to_the_page_is_a_code_where_there_is_room() {
    let mut snapshot = three_streaming();
    snapshot.links =
        ["192.168.1.20", "10.0.0.7"].map(|ip| format!("http://{ip}:8766/#0123456789abcdefghijkl")).to_vec();
    let mut model = measured(&snapshot);
    model.update(press(KeyCode::Char('W')));
    assert_snapshot!("link_80x24", draw(&model, (80, 24), THEME));
    assert_snapshot!("link_60x12", draw(&model, (60, 12), THEME));
    let shown = |model: &Model, theme| draw(model, (80, 24), theme).to_string();
    let ascii = Theme { charset: Charset::Ascii, ..THEME };
    assert!(shown(&model, ascii).contains("http://192.168.1.20:8766/#"));
    // The key that closes it has no other effect.
    assert_eq!(model.update(press(KeyCode::Char(' '))), model::Effect::None);
    assert!(!shown(&model, THEME).contains("192.168.1.20"));
    // A run without a page says how it gets one.
    let mut without = measured(&three_streaming());
    without.update(press(KeyCode::Char('W')));
    assert!(shown(&without, THEME).contains("rapid --web 0.0.0.0"));
}

#[test]
fn an_edge_is_highlighted_for_a_second() {
    let mut model = measured(&three_streaming());
    let mut later = three_streaming();
    later.mask.0 = 0b110;
    later.taken = Stamp(TAKEN.0 + 100_000_000);
    model.update(Msg::Snapshot(Box::new(later.clone())));
    let screen = draw(&model, (80, 24), THEME);
    assert_eq!(style_of(screen.buffer(), "▼  0").bg, Some(Color::LightRed));
    assert_eq!(style_of(screen.buffer(), "■  1").bg, Some(Color::Green));
    later.taken = Stamp(TAKEN.0 + 1_200_000_000);
    model.update(Msg::Snapshot(Box::new(later)));
    let screen = draw(&model, (80, 24), THEME);
    assert_eq!(style_of(screen.buffer(), "□  0").bg, Some(Color::Reset));
}

#[test]
fn a_number_that_does_not_fit_is_left_out_and_not_cut() {
    let mut end = three_streaming();
    end.devices[0].name = "a_name_of_14_c".to_owned();
    end.devices[0].samples = 123_456;
    let screen = draw(&measured(&end), (60, 12), THEME).to_string();
    assert!(!screen.contains("12345") && !screen.contains("tota"), "{screen}");
    let screen = draw(&measured(&end), (80, 24), THEME).to_string();
    assert!(screen.contains("123456") && screen.contains("total"), "{screen}");
}

#[test]
fn an_absent_device_shows_since_when() {
    let mut end = three_streaming();
    end.devices.push(device(3, "imu", DeviceState::Absent, ""));
    end.devices[3].samples = 0;
    let mut model = measured(&end);
    let mut later = end.clone();
    later.devices[1].state = DeviceState::Absent;
    later.devices[1].detail.clear();
    later.taken = Stamp(TAKEN.0 + 100_000_000);
    model.update(Msg::Snapshot(Box::new(later.clone())));
    later.taken = Stamp(TAKEN.0 + 3_200_000_000);
    model.update(Msg::Snapshot(Box::new(later.clone())));
    model.update(press(KeyCode::Down));
    let screen = draw(&model, (80, 24), THEME).to_string();
    assert!(screen.contains("unplugged 3 s ago · /rapid/cam_top"), "{screen}");
    assert!(screen.contains("not plugged in"), "{screen}");
    // Plugged in and unplugged again: counted from the second unplug.
    later.devices[1].state = DeviceState::Streaming;
    model.update(Msg::Snapshot(Box::new(later.clone())));
    later.devices[1].state = DeviceState::Absent;
    later.taken = Stamp(TAKEN.0 + 70_000_000_000);
    model.update(Msg::Snapshot(Box::new(later.clone())));
    later.taken = Stamp(TAKEN.0 + 200_000_000_000);
    model.update(Msg::Snapshot(Box::new(later)));
    let screen = draw(&model, (80, 24), THEME).to_string();
    assert!(screen.contains("unplugged 2 min ago"), "{screen}");
}

#[test]
fn a_pause_shows_in_the_header_and_a_question_in_the_footer() {
    let mut end = three_streaming();
    end.recording = Some(recording(0));
    let mut model = measured(&end);
    model.update(press(KeyCode::Char('p')));
    model.update(press(KeyCode::Char('q')));
    let screen = draw(&model, (80, 24), THEME).to_string();
    assert!(screen.contains("view paused"), "{screen}");
    assert!(screen.contains("recording: q again to finish the episode and quit"), "{screen}");
}

/// Keys as a terminal sends them; then nothing more.
fn typed(keys: &[KeyCode]) -> impl Stream<Item = io::Result<Event>> + use<> {
    let events: Vec<_> = keys.iter().map(|code| Ok(Event::Key(KeyEvent::new(*code, KeyModifiers::NONE)))).collect();
    futures::stream::iter(events).chain(futures::stream::pending())
}

fn desk(board: &Arc<Board>, commands: &mpsc::Sender<Command>) -> Own {
    Own::new(Arc::clone(board), commands.clone(), Arc::default())
}

#[tokio::test]
async fn keys_become_commands_and_shutdown_ends_the_screen() {
    let board = Arc::new(board(&["cam"]));
    let (sender, mut commands) = mpsc::channel(4);
    let shutdown = CancellationToken::new();
    let end = shutdown.clone();
    let keys = typed(&[KeyCode::Char(' '), KeyCode::Char('q')]);
    let mut desk = desk(&board, &sender);
    let room = Notify::new();
    let screen = drive(&mut desk, &shutdown, keys, ScreenOptions::default(), &room, |_| Ok(true));
    let app = async {
        assert_eq!(commands.recv().await, Some(Command::Session(SessionRequest::Toggle)));
        assert_eq!(commands.recv().await, Some(Command::Quit));
        end.cancel();
    };
    let (outcome, ()) = tokio::join!(screen, app);
    outcome.unwrap();
}

#[tokio::test]
async fn a_busy_program_is_shown_and_a_gone_one_ends_the_screen() {
    let board = Arc::new(board(&["cam"]));
    let (sender, commands) = mpsc::channel(1);
    sender.try_send(Command::Session(SessionRequest::Toggle)).unwrap();
    let shutdown = CancellationToken::new();
    let end = shutdown.clone();
    let mut notice = None;
    drive(
        &mut desk(&board, &sender),
        &shutdown,
        typed(&[KeyCode::Char(' ')]),
        ScreenOptions::default(),
        &Notify::new(),
        |model| {
            if let Some(report) = model.notice() {
                notice = Some(report.to_owned());
                end.cancel();
            }
            Ok(true)
        },
    )
    .await
    .unwrap();
    assert_eq!(notice.as_deref(), Some("busy: request dropped, try again"));

    drop(commands);
    drive(
        &mut desk(&board, &sender),
        &CancellationToken::new(),
        typed(&[KeyCode::Char('q')]),
        ScreenOptions::default(),
        &Notify::new(),
        |_| Ok(true),
    )
    .await
    .unwrap();
}

#[tokio::test(start_paused = true)]
async fn what_a_busy_terminal_did_not_take_is_drawn_when_it_has_room_and_not_a_frame_later() {
    let board = Arc::new(board(&["cam"]));
    let (sender, _commands) = mpsc::channel(1);
    let (shutdown, room) = (CancellationToken::new(), Notify::new());
    let begun = tokio::time::Instant::now();
    let mut drawn = Vec::new();
    drive(&mut desk(&board, &sender), &shutdown, futures::stream::pending(), ScreenOptions::default(), &room, |_| {
        drawn.push(begun.elapsed());
        match drawn.len() {
            2 => room.notify_one(),
            4 => shutdown.cancel(),
            _ => {}
        }
        Ok(drawn.len() != 2)
    })
    .await
    .unwrap();
    // At the first and the second frame, at once again, and not between two frames when nothing is left to draw.
    assert_eq!(drawn, [Duration::ZERO, FRAME, FRAME, 2 * FRAME]);
}

#[tokio::test]
async fn a_terminal_that_goes_away_is_an_error() {
    let board = Arc::new(board(&["cam"]));
    let (sender, _commands) = mpsc::channel(1);
    let hung_up = futures::stream::iter([]);
    let error = drive(
        &mut desk(&board, &sender),
        &CancellationToken::new(),
        hung_up,
        ScreenOptions::default(),
        &Notify::new(),
        |_| Ok(true),
    )
    .await
    .unwrap_err();
    assert!(matches!(error, TuiError::Gone(_)), "{error}");
}

#[tokio::test]
async fn pasted_text_deletes_nothing_whether_the_terminal_marks_it_or_not() {
    let board = Arc::new(board(&["cam"]));
    let key = |letter| Ok(Event::Key(KeyEvent::new(KeyCode::Char(letter), KeyModifiers::NONE)));
    let enter = Ok(Event::Key(KeyEvent::new(KeyCode::Enter, KeyModifiers::NONE)));
    let mut pasted = vec![Ok(Event::Paste("xyxyaa qq".to_owned())), key('x'), key('y'), key('x'), key('x')];
    pasted.extend("The End".chars().map(key));
    pasted.push(enter);
    let (sender, mut commands) = mpsc::channel(16);
    let shutdown = CancellationToken::new();
    // All of it arrives at once, before any frame is due.
    let events = futures::stream::iter(pasted).chain(futures::stream::iter([key('q')]));
    let events = events.chain(futures::stream::pending());
    let end = shutdown.clone();
    let mut desk = desk(&board, &sender);
    let room = Notify::new();
    let screen = drive(&mut desk, &shutdown, events, ScreenOptions::default(), &room, |_| Ok(true));
    let app = async {
        // It is in the trash, once, and can be taken back.
        assert_eq!(commands.recv().await, Some(Command::Session(SessionRequest::Discard { episode: None })));
        assert_eq!(commands.recv().await, Some(Command::Quit), "only what was typed last");
        end.cancel();
    };
    let (outcome, ()) = tokio::join!(screen, app);
    outcome.unwrap();
}

#[test]
fn the_header_shows_the_first_stop_that_prevents_motion() {
    use InputState::{Lost, Runs, Stopped};
    use StopKind::{Emergency, Enabling};
    let stop = |stop: &str, kind, state| StopStatus { stop: stop.into(), kind, state, detail: String::new() };
    let head = |stops: &[StopStatus], theme| {
        let mut snapshot = three_streaming();
        snapshot.stops = stops.to_vec();
        let screen = draw(&Model::new(snapshot), (120, 24), theme);
        let line: String = screen.buffer().content.iter().take(120).map(ratatui::buffer::Cell::symbol).collect();
        (line.trim_end().to_owned(), screen)
    };
    let (pendant, pedal) = (|state| stop("pendant", Emergency, state), |state| stop("pedal", Enabling, state));
    for (stops, end) in [
        (vec![pendant(Runs)], "stop pendant released"),
        (vec![pedal(Runs)], "enable pedal held"),
        (vec![pendant(Runs), pedal(Runs)], "2 stops run"),
        (vec![pendant(Runs), pedal(Stopped)], "enable pedal released"),
        (vec![pedal(Stopped), pendant(Stopped)], "STOP pendant pressed +1"),
        (vec![pedal(Lost), pendant(Lost), pendant(Runs)], "enable pedal lost +1"),
        (vec![stop("an_emergency_stop_of_a_long_name", Emergency, Lost)], "STOP an_emergency_st… lost"),
    ] {
        let (line, _) = head(&stops, THEME);
        assert!(line.ends_with(end), "{line:?} does not end with {end:?}");
    }
    let (_, screen) = head(&[pendant(Stopped)], THEME);
    assert_eq!(style_of(screen.buffer(), "STOP pendant").fg, THEME.alarm().fg);
    // Without a stop nothing is shown.
    assert_eq!(head(&[], THEME).0.matches("stop").count(), 0);
}

#[test]
fn a_start_that_failed_is_explained_until_one_succeeds() {
    let mut end = three_streaming();
    end.not_started = Some("/proc/nope: cannot be created: No such file or directory".to_owned());
    assert_snapshot!(draw(&Model::new(end.clone()), (80, 24), THEME));
    let low = draw(&Model::new(end), (60, 12), ASCII).to_string();
    assert!(low.contains("! not started: /proc/nope: cannot be created"), "{low}");
}

#[test]
fn a_terminal_that_is_too_small_shows_that_it_records() {
    let mut end = three_streaming();
    end.recording = Some(recording(0));
    let size = (view::MINIMUM.0 - 1, view::MINIMUM.1);
    let shown = draw(&Model::new(end.clone()), size, THEME).to_string();
    assert!(shown.contains("● REC ") && shown.contains("too small"), "{shown}");
    // From the minimum on, no figure of the episode is cut.
    for height in [view::MINIMUM.1, 15, 19] {
        let shown = draw(&measured(&end), (view::MINIMUM.0, height), THEME).to_string();
        assert!(shown.contains("dropped 0"), "{height}: {shown}");
    }
}

#[test]
fn what_is_recorded_is_shown_while_the_view_is_paused() {
    let mut model = Model::new(three_streaming());
    model.update(press(KeyCode::Char('p')));
    let mut recorded = three_streaming();
    recorded.recording = Some(recording(0));
    model.update(Msg::Snapshot(Box::new(recorded)));
    let shown = draw(&model, (80, 24), THEME).to_string();
    assert!(shown.contains("view paused") && shown.contains("messages"), "{shown}");
    assert!(!shown.contains("starts an episode"), "{shown}");
}

#[test]
fn what_spoils_an_episode_is_shown_while_it_can_be_fixed() {
    let finding = |grade, modality: &str, text: &str| Finding {
        grade,
        modality: Some(modality.to_owned()),
        text: text.to_owned(),
    };
    let mut end = three_streaming();
    let lost = finding(Grade::Bad, "tof", "210 of 2100 samples lost by the device (limit 5 %)");
    let still =
        finding(Grade::Suspect, "cam_top", "frozen for 8.0 s: 240 samples byte for byte the same (limit 1.0 s)");
    end.recording = Some(RecordingStatus { outlook: Outlook { findings: vec![lost, still] }, ..recording(0) });
    assert_snapshot!(draw(&measured(&end), (120, 40), THEME));
    let shown = draw(&measured(&end), (80, 24), THEME);
    assert_eq!(style_of(shown.buffer(), "would be BAD").fg, Some(Color::Red));
    assert!(draw(&measured(&end), (60, 12), ASCII).to_string().contains("would be BAD  * REC"));
}
