use rapid_core::mask::PhysicalMask;
use rapid_status::session::{Answered, EpisodeEntry, Label, SessionRequest, SessionStatus};
use rapid_status::{Grade, Level, UnregisteredDevice};

use crate::literal::{TAKEN, every_state, id, line, recording, three_streaming};
use crossterm::event::KeyCode;

use super::*;

fn press(code: KeyCode) -> Msg {
    Msg::Key(KeyEvent::new(code, KeyModifiers::NONE))
}

fn control(letter: char) -> Msg {
    Msg::Key(KeyEvent::new(KeyCode::Char(letter), KeyModifiers::CONTROL))
}

fn repeated(code: KeyCode) -> Msg {
    Msg::Key(KeyEvent::new_with_kind(code, KeyModifiers::NONE, KeyEventKind::Repeat))
}

fn released(code: KeyCode) -> Msg {
    Msg::Key(KeyEvent::new_with_kind(code, KeyModifiers::NONE, KeyEventKind::Release))
}

fn after(snapshot: &Snapshot, ms: u64) -> Msg {
    let mut later = snapshot.clone();
    later.taken = Stamp(TAKEN.0 + ms * 1_000_000);
    Msg::Snapshot(Box::new(later))
}

#[test]
fn keys_become_commands() {
    let quit = Effect::Leave;
    let toggle = Effect::Send(Command::Session(SessionRequest::Toggle));
    let restart = Effect::Send(Command::Restart(id(4)));
    let table: Vec<(&str, bool, Vec<Msg>, Effect)> = vec![
        ("space", false, vec![press(KeyCode::Char(' '))], toggle.clone()),
        ("space held down", false, vec![repeated(KeyCode::Char(' '))], Effect::None),
        ("a key let go", false, vec![released(KeyCode::Char('q'))], Effect::None),
        ("quit when idle", false, vec![press(KeyCode::Char('q'))], quit.clone()),
        ("ctrl-c when idle", false, vec![control('c')], quit.clone()),
        ("ctrl-q is not q", false, vec![control('q')], Effect::None),
        ("quit while recording asks", true, vec![press(KeyCode::Char('q'))], Effect::None),
        ("quit twice", true, vec![press(KeyCode::Char('q')), press(KeyCode::Char('q'))], quit.clone()),
        (
            "quit, another key, quit asks again",
            true,
            vec![press(KeyCode::Char('q')), press(KeyCode::Down), press(KeyCode::Char('q'))],
            Effect::None,
        ),
        ("restart of what streams", false, vec![press(KeyCode::Char('r'))], Effect::None),
        (
            "restart of what failed",
            false,
            vec![
                press(KeyCode::Down),
                press(KeyCode::Down),
                press(KeyCode::Down),
                press(KeyCode::Char('j')),
                press(KeyCode::Char('r')),
            ],
            restart,
        ),
        ("a key that closes the help", false, vec![press(KeyCode::Char('?')), press(KeyCode::Char(' '))], Effect::None),
        ("quit from the help", false, vec![press(KeyCode::Char('?')), press(KeyCode::Char('q'))], quit),
        (
            "space after the help",
            false,
            vec![
                press(KeyCode::Char('?')),
                press(KeyCode::Char('?')),
                press(KeyCode::Char('?')),
                press(KeyCode::Char(' ')),
            ],
            toggle,
        ),
    ];
    for (what, is_recording, msgs, expected) in table {
        let mut snapshot = every_state();
        snapshot.recording = is_recording.then(|| recording(0));
        let mut model = Model::new(snapshot);
        let effects: Vec<_> = msgs.into_iter().map(|msg| model.update(msg)).collect();
        assert_eq!(effects.last(), Some(&expected), "{what}");
        let others = effects.iter().rev().skip(1);
        assert!(others.into_iter().all(|effect| *effect == Effect::None), "{what}");
    }
}

#[test]
fn keys_that_stop_motion_work_at_any_moment() {
    let questions: [(&str, Vec<Msg>); 6] = [
        ("nothing", vec![]),
        ("the help", vec![press(KeyCode::Char('?'))]),
        ("leaving", vec![press(KeyCode::Char('q'))]),
        ("dropping", vec![press(KeyCode::Char('x'))]),
        ("arming", vec![press(KeyCode::Char('a'))]),
        ("a paused view", vec![press(KeyCode::Char('p'))]),
    ];
    for (question, asked) in questions {
        let shifted = Msg::Key(KeyEvent::new(KeyCode::Char('D'), KeyModifiers::SHIFT));
        let keys = [
            press(KeyCode::Char('d')),
            press(KeyCode::Char('D')),
            shifted,
            control('d'),
            press(KeyCode::Esc),
            control('c'),
        ];
        for key in keys {
            let mut snapshot = three_streaming();
            snapshot.recording = Some(recording(0));
            let mut model = Model::new(snapshot);
            for msg in &asked {
                let Msg::Key(key) = msg else { unreachable!() };
                model.update(Msg::Key(*key));
            }
            let what = format!("{key:?} while {question} is asked");
            let effect = model.update(key);
            // Ctrl-C confirms the question whether to leave.
            let leaves = question == "leaving" && what.contains("'c'");
            assert_eq!(effect, if leaves { Effect::Leave } else { Effect::Order(Order::Disarm) }, "{what}");
            assert!(model.overlay.is_none() || what.contains("'c'"), "{what}");
            // The next key does not answer the question.
            assert_eq!(model.update(control('y')), Effect::None, "{what}");
        }
    }
}

/// Keys with their times, ms.
type Keys = Vec<(u64, Msg)>;

#[test]
fn only_two_different_keys_within_two_seconds_arm() {
    let a = || press(KeyCode::Char('a'));
    let arm = Effect::Order(Order::Arm);
    let repeated_y = Msg::Key(KeyEvent::new_with_kind(KeyCode::Char('y'), KeyModifiers::CONTROL, KeyEventKind::Repeat));
    let table: Vec<(&str, Keys, &Effect)> = vec![
        ("a, ctrl-y", vec![(0, a()), (300, control('y'))], &arm),
        ("a, a, ctrl-y", vec![(0, a()), (100, a()), (300, control('y'))], &arm),
        ("a twice", vec![(0, a()), (300, a())], &Effect::None),
        (
            "a held down, as a terminal without repeat events reports it",
            (0..50).map(|at| (30 * at, a())).collect(),
            &Effect::None,
        ),
        ("pasted text", "aay ay\nay".chars().map(|letter| (0, press(KeyCode::Char(letter)))).collect(), &Effect::None),
        ("ctrl-y alone", vec![(0, control('y'))], &Effect::None),
        ("ctrl-y held down", vec![(0, a()), (300, repeated_y)], &Effect::None),
        ("too late", vec![(0, a()), (2_100, control('y'))], &Effect::None),
        ("another key between", vec![(0, a()), (200, press(KeyCode::Down)), (300, control('y'))], &Effect::None),
        ("a question between", vec![(0, a()), (200, press(KeyCode::Char('?'))), (300, control('y'))], &Effect::None),
    ];
    for (what, keys, expected) in table {
        let mut model = Model::new(three_streaming());
        let mut last = Effect::None;
        for (at, key) in keys {
            model.update(after(&three_streaming(), at));
            last = model.update(key);
        }
        assert_eq!(last, *expected, "{what}");
    }
}

#[test]
fn the_question_is_withdrawn_when_the_episode_ends_by_itself() {
    let mut snapshot = three_streaming();
    snapshot.recording = Some(recording(0));
    let mut model = Model::new(snapshot);
    model.update(press(KeyCode::Char('q')));
    assert_eq!(model.quit, Quit::Asked);
    model.update(after(&three_streaming(), 100));
    assert_eq!(model.quit, Quit::No);
}

#[test]
fn the_selection_stays_within_the_devices() {
    let mut model = Model::new(three_streaming());
    model.update(press(KeyCode::Up));
    assert_eq!(model.selected, 0);
    model.update(press(KeyCode::End));
    assert_eq!(model.selected, 2);
    model.update(press(KeyCode::Down));
    assert_eq!(model.selected, 2);
    let mut empty = three_streaming();
    empty.devices.clear();
    let mut model = Model::new(empty);
    model.update(press(KeyCode::Down));
    assert_eq!(model.selected_device(), None);
    assert_eq!(model.update(press(KeyCode::Char('r'))), Effect::None);
}

#[test]
fn a_paused_view_is_frozen_but_commands_use_current_state() {
    let mut model = Model::new(every_state());
    model.update(press(KeyCode::Char('p')));
    let mut later = every_state();
    later.mask = PhysicalMask(0);
    later.recording = Some(recording(0));
    model.update(after(&later, 100));
    assert_eq!(model.shown().mask, every_state().mask);
    assert_eq!(model.edge(id(0)), Edge::None);
    // The question knows about the episode that began meanwhile.
    assert!(model.is_recording());
    assert_eq!(model.update(press(KeyCode::Char('q'))), Effect::None);
    model.update(press(KeyCode::Char('p')));
    assert!(!model.is_paused());
    assert_eq!(model.shown().mask, PhysicalMask(0));
    assert_eq!(model.edge(id(0)), Edge::Recent);
}

#[test]
fn a_log_scrolled_back_stays_where_it_is_when_lines_come() {
    let mut snapshot = three_streaming();
    let tick = |second| line(second, Level::Info, if second % 2 == 0 { "tick" } else { "tock" });
    snapshot.log = (0..50).map(tick).collect();
    let mut model = Model::new(snapshot.clone());
    model.update(press(KeyCode::Char('g')));
    let below = |model: &Model| model.log.below(&model.shown().log);
    model.update(press(KeyCode::PageUp));
    assert_eq!(below(&model), SCROLL_STEP);
    // Two lines are added, the two oldest are removed.
    snapshot.log.drain(..2);
    snapshot.log.extend((50..52).map(tick));
    model.update(after(&snapshot, 100));
    assert_eq!(below(&model), SCROLL_STEP + 2);
    model.update(press(KeyCode::Esc));
    assert_eq!(below(&model), 0);
    model.update(after(&snapshot, 200));
    assert_eq!(below(&model), 0);
    for _ in 0..30 {
        model.update(press(KeyCode::PageUp));
    }
    assert_eq!(below(&model), 49);
}

#[test]
fn an_answer_fades() {
    let mut model = Model::new(three_streaming());
    model.update(press(KeyCode::Char('r')));
    assert_eq!(model.notice(), Some("cam_wrist has not failed: nothing to restart"));
    model.update(after(&three_streaming(), 3_900));
    assert!(model.notice().is_some());
    model.update(after(&three_streaming(), 4_100));
    assert_eq!(model.notice(), None);
}

#[test]
fn a_held_space_bar_begins_one_episode_and_a_second_press_ends_it() {
    let space = || press(KeyCode::Char(' '));
    let toggled = Effect::Send(Command::Session(SessionRequest::Toggle));
    let mut model = Model::new(three_streaming());
    let mut presses = |times: &[u64], recording: bool| {
        let mut snapshot = three_streaming();
        snapshot.recording = recording.then(|| crate::literal::recording(0));
        let effect = |ms: &u64| {
            model.update(after(&snapshot, *ms));
            model.update(space())
        };
        times.iter().map(effect).filter(|effect| *effect == toggled).count()
    };
    // The repeats of a key that is held for two seconds.
    let held: Vec<u64> = std::iter::once(0).chain((500..2_500).step_by(33)).collect();
    assert_eq!(presses(&held[..1], false), 1);
    assert_eq!(presses(&[300], true), 0, "a second press that is too soon");
    assert_eq!(presses(&held[1..], true), 0, "after 200 ms, then every 33");
    assert_eq!(presses(&[2_900], true), 1);
}

#[test]
fn an_announcement_ends_with_what_it_announces() {
    let mut recording = three_streaming();
    recording.recording = Some(crate::literal::recording(0));
    let mut failed = three_streaming();
    failed.not_started = Some("the disk is full".to_owned());
    for (before, then) in
        [(three_streaming(), recording.clone()), (recording, three_streaming()), (three_streaming(), failed)]
    {
        let mut model = Model::new(before.clone());
        model.update(press(KeyCode::Char(' ')));
        assert!(model.notice().is_some());
        model.update(after(&before, 100));
        assert!(model.notice().is_some());
        model.update(after(&then, 200));
        assert_eq!(model.notice(), None);
    }
}

#[test]
fn the_bell_rings_at_begin_end_and_each_loss_unless_it_is_off() {
    let quiet = three_streaming();
    let mut recording = quiet.clone();
    recording.recording = Some(crate::literal::recording(0));
    for lost in
        [DeviceState::Absent, DeviceState::Stalled, DeviceState::Backoff, DeviceState::Failed, DeviceState::Opening]
    {
        let mut without = recording.clone();
        without.devices[1].state = lost;
        let mut model = Model::new(quiet.clone());
        // Still, begins, loses a device, which stays away and returns, and ends.
        let heard = [&quiet, &recording, &without, &without, &recording, &quiet].map(|snapshot| {
            model.update(after(snapshot, 100));
            model.rings()
        });
        assert_eq!(heard, [0, 1, 2, 2, 2, 3], "{lost:?}");
    }
    let mut model = Model::new(quiet.clone());
    model.update(press(KeyCode::Char('b')));
    assert_eq!(model.notice(), Some("bell off"));
    model.update(after(&recording, 100));
    assert_eq!(model.rings(), 0);
    model.update(press(KeyCode::Char('b')));
    model.update(after(&quiet, 100));
    assert_eq!(model.rings(), 1);
}

#[test]
fn a_key_unplugs_simulated_devices_and_no_others() {
    let mut model = Model::new(three_streaming());
    assert_eq!(model.update(press(KeyCode::Char('U'))), Effect::None);
    assert!(model.notice().is_some_and(|notice| notice.contains("--sim")));
    let mut simulated = three_streaming();
    simulated.simulated = true;
    let mut model = Model::new(simulated.clone());
    model.update(press(KeyCode::Down));
    let name = simulated.devices[1].name.clone();
    assert_eq!(model.update(press(KeyCode::Char('U'))), Effect::Send(Command::Plug(name.clone())));
    assert_eq!(model.notice(), Some(format!("unplugging {name}").as_str()));
    assert_eq!(model.update(repeated(KeyCode::Char('U'))), Effect::None);
    simulated.devices[1].state = DeviceState::Absent;
    model.update(after(&simulated, 100));
    assert_eq!(model.update(press(KeyCode::Char('U'))), Effect::Send(Command::Plug(name.clone())));
    assert_eq!(model.notice(), Some(format!("plugging {name} in").as_str()));
}

fn typed(model: &mut Model, text: &str) {
    for c in text.chars() {
        assert_eq!(model.update(press(KeyCode::Char(c))), Effect::None, "{c}");
    }
}

#[test]
fn a_text_is_typed_and_sent_by_enter_and_escape_disarms_and_closes_it() {
    let episode = || Some("a.mcap".to_owned());
    let note =
        |text: &str| Effect::Send(Command::Session(SessionRequest::Note { episode: episode(), text: text.to_owned() }));
    let mut now = three_streaming();
    let mut model = Model::new(now.clone());
    typed(&mut model, "n");
    assert_eq!((model.prompt(), model.notice()), (None, Some("this session has no episode")));
    let mut session = SessionStatus::default();
    session.episodes.push(EpisodeEntry::begin("a.mcap".to_owned(), String::new()));
    now.session = Some(session.clone());
    model.update(after(&now, 100));
    typed(&mut model, "nquick dxE");
    assert_eq!(model.prompt(), Some(("a.mcap, note: ".to_owned(), "quick dxE")));
    // Another episode begins: the note is about the one that it was begun for.
    session.episodes.push(EpisodeEntry::begin("b.mcap".to_owned(), String::new()));
    now.session = Some(session.clone());
    model.update(after(&now, 200));
    model.update(press(KeyCode::Backspace));
    assert_eq!(model.update(press(KeyCode::Enter)), note("quick dx"));
    assert_eq!(model.prompt(), None);
    // One that is discarded is no longer the newest.
    session.episodes[1].discarded = true;
    now.session = Some(session);
    model.update(after(&now, 300));
    // It is empty again, and an empty one removes the note.
    typed(&mut model, "n");
    assert_eq!(model.update(press(KeyCode::Enter)), note(""));
    // Pasted text is an answer, and without a question no request.
    assert_eq!(model.update(Msg::Paste("nq".to_owned())), Effect::None);
    assert_eq!(model.prompt(), None);
    typed(&mut model, "n");
    model.update(Msg::Paste("two\nlines\x1b\n".to_owned()));
    assert_eq!(model.update(press(KeyCode::Enter)), note("two lines"));
    typed(&mut model, "-slipped");
    let label = SessionRequest::Label { episode: episode(), label: Label::Failure, reason: "slipped".to_owned() };
    assert_eq!(model.update(press(KeyCode::Enter)), Effect::Send(Command::Session(label)));
    typed(&mut model, "nhalf");
    assert_eq!(model.update(press(KeyCode::Esc)), Effect::Order(Order::Disarm));
    assert_eq!(model.prompt(), None);
    assert_eq!(model.update(press(KeyCode::Enter)), Effect::None);
}

#[test]
fn the_end_of_a_session_is_confirmed_by_a_word() {
    for (word, expected) in [("end", Effect::Send(Command::Session(SessionRequest::EndSession))), ("", Effect::None)] {
        let mut model = Model::new(three_streaming());
        typed(&mut model, "E");
        typed(&mut model, word);
        assert_eq!(model.update(press(KeyCode::Enter)), expected);
    }
}

#[test]
fn the_answer_to_a_request_is_shown_whoever_made_it() {
    let mut model = Model::new(three_streaming());
    let mut answered = three_streaming();
    let answer = Answered { at: TAKEN, text: "a_003.mcap is back".to_owned(), refused: false };
    answered.session = Some(SessionStatus { answer: Some(answer), ..SessionStatus::default() });
    model.update(after(&answered, 100));
    assert_eq!(model.notice(), Some("a_003.mcap is back"));
    // Only when it is new.
    model.update(after(&answered, 4_300));
    model.update(after(&answered, 4_400));
    assert_eq!(model.notice(), None);
}

#[test]
fn devices_in_trouble_come_first_by_a_key_and_the_selection_stays_on_its_device() {
    let mut model = Model::new(every_state());
    let name = |model: &Model| model.selected_device().map(|device| device.name.clone());
    model.update(press(KeyCode::Down));
    let selected = name(&model);
    let by_bit: Vec<_> = model.rows().iter().map(|device| device.id.bit()).collect();
    assert!(by_bit.is_sorted());
    model.update(press(KeyCode::Char('o')));
    let states: Vec<_> = model.rows().iter().map(|device| device.state).collect();
    assert_eq!(states.first(), Some(&DeviceState::Failed), "{states:?}");
    assert_eq!(states.last(), Some(&DeviceState::Streaming), "{states:?}");
    assert_eq!(name(&model), selected);
    // The state of another device changes, and with it the order.
    let mut changed = every_state();
    let failed = changed.devices.iter_mut().find(|device| device.state == DeviceState::Failed).unwrap();
    failed.state = DeviceState::Streaming;
    model.update(after(&changed, 100));
    assert_eq!(name(&model), selected);
    assert_ne!(model.rows()[0].state, DeviceState::Failed);
    model.update(press(KeyCode::Char('o')));
    assert_eq!(model.rows().iter().map(|device| device.id.bit()).collect::<Vec<_>>(), by_bit);
}

#[test]
fn previews_are_requested_while_they_are_shown_and_never_else() {
    let cam = three_streaming();
    let look = Effect::Send(Command::Look(id(0)));
    let mut model = Model::new(cam.clone());
    assert_eq!(model.update(after(&cam, 100)), Effect::None);
    model.update(press(KeyCode::Enter));
    assert_eq!(model.update(after(&cam, 200)), look);
    assert_eq!(model.update(after(&cam, 300)), Effect::None, "not at every frame");
    assert_eq!(model.update(after(&cam, 800)), look);
    model.update(press(KeyCode::Down));
    assert_eq!(model.update(after(&cam, 900)), Effect::Send(Command::Look(id(1))), "the other device at once");
    model.link = LinkState::Lost { since: TAKEN, read_only: false, runs: false };
    assert_eq!(model.update(after(&cam, 2_000)), Effect::None);
    model.link = LinkState::Attached { process: 1, read_only: true };
    assert_eq!(model.update(after(&cam, 2_100)), Effect::Send(Command::Look(id(1))), "looking changes nothing");
    model.update(press(KeyCode::Enter));
    assert_eq!(model.update(after(&cam, 4_000)), Effect::None);
    // Beside the rig, where there is room.
    model.update(Msg::Size(200, 60));
    assert_eq!(model.update(after(&cam, 5_000)), Effect::Send(Command::Look(id(1))));
}

#[test]
fn what_is_attached_ends_nothing_and_read_only_changes_nothing() {
    let mut recording_now = three_streaming();
    recording_now.recording = Some(recording(0));
    recording_now.simulated = true;
    let keys = || {
        let letters = "xuis+rUdD".chars().map(KeyCode::Char);
        letters.chain([KeyCode::Left, KeyCode::Right, KeyCode::Esc, KeyCode::Char(' ')])
    };
    for read_only in [false, true] {
        let mut model = Model::new(recording_now.clone());
        model.link = LinkState::Attached { process: 1, read_only };
        let effects: Vec<_> =
            keys().map(|code| model.update(press(code))).filter(|effect| *effect != Effect::None).collect();
        assert_eq!(effects.is_empty(), read_only, "{effects:?}");
        assert!(model.notice().is_some());
        // Without a question although an episode is recorded, and without a disarm.
        assert_eq!(model.update(control('c')), Effect::Leave);
        let mut model = Model::new(recording_now.clone());
        model.link = LinkState::Attached { process: 1, read_only };
        assert_eq!(model.update(press(KeyCode::Char('q'))), Effect::Leave);
    }
    let mut model = Model::new(recording_now.clone());
    model.link = LinkState::Lost { since: TAKEN, read_only: false, runs: false };
    for code in keys() {
        assert_eq!(model.update(press(code)), Effect::None, "{code:?}");
    }
    assert_eq!(model.notice(), Some("the run has ended: nothing receives this"));
}

#[test]
fn pages_open_and_close_by_the_same_key_and_esc_returns() {
    let mut model = Model::new(three_streaming());
    for (code, page) in
        [(KeyCode::Enter, Page::Device), (KeyCode::Char('l'), Page::Log), (KeyCode::Char('e'), Page::Episodes)]
    {
        model.update(press(code));
        assert_eq!(model.page, page);
        model.update(press(code));
        assert_eq!(model.page, Page::Rig);
        model.update(press(code));
        assert_eq!(model.update(press(KeyCode::Esc)), Effect::Order(Order::Disarm));
        assert_eq!(model.page, Page::Rig);
    }
}

#[test]
fn a_search_narrows_the_log_while_it_is_typed() {
    let mut snapshot = three_streaming();
    snapshot.log = vec![line(0, Level::Info, "cam one"), line(1, Level::Info, "tof two")];
    let mut model = Model::new(snapshot);
    model.update(press(KeyCode::Char('/')));
    for (letter, shown) in [('t', 1), ('x', 0)] {
        // `x` is text here and discards nothing.
        assert_eq!(model.update(press(KeyCode::Char(letter))), Effect::None);
        assert_eq!(model.log.entries(&model.shown().log).len(), shown, "{letter}");
    }
    model.update(press(KeyCode::Backspace));
    model.update(press(KeyCode::Enter));
    assert_eq!((model.prompt(), model.log.search.as_str()), (None, "t"));
    model.update(press(KeyCode::Esc));
    assert_eq!(model.log.search, "");
}

#[test]
fn the_mouse_selects_and_opens_and_begins_nothing() {
    let mut model = Model::new(three_streaming());
    assert_eq!(model.update(Msg::Click(Target::Device(2))), Effect::None);
    assert_eq!((model.selected, model.page), (2, Page::Rig));
    model.update(Msg::Click(Target::Device(2)));
    assert_eq!(model.page, Page::Device);
    model.update(Msg::Wheel(Some(Target::Detail), true));
    assert_eq!(model.selected, 1);
    model.update(Msg::Click(Target::Log));
    assert_eq!(model.page, Page::Log);
}

fn unregistered(name: Option<&str>) -> UnregisteredDevice {
    let (device, name) = (format!("046d:0825 {}", name.unwrap_or("unknown")), name.map(str::to_owned));
    UnregisteredDevice { device, node: "camera".to_owned(), name }
}

#[test]
fn in_a_new_rig_the_name_of_each_device_is_asked_for_once() {
    let mut plugged = three_streaming();
    plugged.devices.clear();
    let mut model = Model::new(plugged.clone());
    model.update(after(&plugged, 100));
    assert_eq!(model.prompt(), None);
    plugged.unregistered = vec![unregistered(Some("webcam")), unregistered(None)];
    model.update(after(&plugged, 200));
    assert_eq!(model.prompt(), Some(("name of the camera 046d:0825 webcam (empty: none): ".to_owned(), "webcam")));
    // What is typed is not asked for again by the next snapshot.
    model.update(press(KeyCode::Char('w')));
    model.update(press(KeyCode::Char('2')));
    model.update(after(&plugged, 300));
    let register = Command::Register { device: "046d:0825 webcam".to_owned(), name: "w2".to_owned() };
    assert_eq!(model.update(press(KeyCode::Enter)), Effect::Send(register));
    plugged.unregistered.remove(0);
    model.update(after(&plugged, 400));
    assert_eq!(model.prompt(), Some(("name of the camera 046d:0825 unknown (empty: none): ".to_owned(), "")));
    assert_eq!(model.update(press(KeyCode::Enter)), Effect::None, "none");
    model.update(after(&plugged, 500));
    assert_eq!(model.prompt(), None, "it is not asked about again");
    model.update(press(KeyCode::Char('N')));
    assert!(model.prompt().is_some(), "but on request");
}

#[test]
fn in_a_rig_with_entries_nothing_is_asked_by_itself() {
    let mut plugged = three_streaming();
    let mut model = Model::new(plugged.clone());
    plugged.unregistered = vec![unregistered(Some("webcam"))];
    model.update(after(&plugged, 100));
    assert_eq!(model.prompt(), None);
    model.update(press(KeyCode::Char('N')));
    assert!(model.prompt().is_some());
    model.update(press(KeyCode::Esc));
    plugged.registry_answer =
        Some(Answered { at: TAKEN, text: "added [device.webcam] as bit 3".to_owned(), refused: false });
    plugged.unregistered.clear();
    model.update(after(&plugged, 200));
    assert_eq!(model.notice(), Some("added [device.webcam] as bit 3"));
    model.update(press(KeyCode::Char('N')));
    assert_eq!(model.notice(), Some("no device without an entry is plugged in"));
}

#[test]
fn losses_are_those_of_the_episode_in_progress() {
    let mut now = three_streaming();
    now.devices[0].gaps = 5;
    let mut model = Model::new(now.clone());
    let lost = |model: &Model| model.lost(&model.shown().devices[0]);
    assert_eq!(lost(&model), 5, "of the run");
    now.recording = Some(recording(0));
    model.update(after(&now, 100));
    assert_eq!(lost(&model), 0);
    now.devices[0].gaps = 7;
    model.update(after(&now, 200));
    assert_eq!(lost(&model), 2, "of the episode");
    now.recording = None;
    model.update(after(&now, 300));
    assert_eq!(lost(&model), 7);
}

#[test]
fn on_the_page_of_episodes_keys_are_about_the_marked_one() {
    let file = |number: u8| format!("{number:03}.mcap");
    let entry =
        |number: u8| EpisodeEntry { verdict: Some(Grade::Good), ..EpisodeEntry::begin(file(number), String::new()) };
    let with = |count: u8| {
        let mut snapshot = three_streaming();
        snapshot.session =
            Some(SessionStatus { episodes: (1..=count).map(entry).collect(), ..SessionStatus::default() });
        snapshot
    };
    let mut model = Model::new(with(3));
    let sent = |request| Effect::Send(Command::Session(request));
    let label = |episode| sent(SessionRequest::Label { episode, label: Label::Success, reason: String::new() });
    assert_eq!(model.update(press(KeyCode::Char('+'))), label(None), "elsewhere it is the newest");
    model.update(press(KeyCode::Char('e')));
    model.update(press(KeyCode::Down));
    assert_eq!(model.update(press(KeyCode::Char('+'))), label(Some(file(2))));
    // Another episode begins: the mark stays on its episode.
    model.update(Msg::Snapshot(Box::new(with(4))));
    let discard = sent(SessionRequest::Discard { episode: Some(file(2)) });
    assert_eq!(model.update(press(KeyCode::Char('x'))), discard);
    model.update(press(KeyCode::Char('n')));
    assert_eq!(model.prompt().unwrap().0, "002.mcap, note: ");
    model.update(press(KeyCode::Char('a')));
    let note = sent(SessionRequest::Note { episode: Some(file(2)), text: "a".to_owned() });
    assert_eq!(model.update(press(KeyCode::Enter)), note);
    // Esc closes what is open before it leaves the page, whose mark the next key is about.
    for opens in ["n", "-", "?"] {
        typed(&mut model, opens);
        assert_eq!(model.update(press(KeyCode::Esc)), Effect::Order(Order::Disarm));
        assert_eq!((model.prompt(), model.overlay, model.page), (None, None, Page::Episodes), "{opens}");
        let undo = sent(SessionRequest::Label { episode: Some(file(2)), label: Label::Success, reason: String::new() });
        assert_eq!(model.update(press(KeyCode::Char('+'))), undo);
    }
    model.update(press(KeyCode::Esc));
    assert_eq!(model.page, Page::Rig);
}

#[test]
fn what_other_screens_look_at_takes_nothing_from_the_plot_of_this_one() {
    let mut now = three_streaming();
    let mut model = Model::new(now.clone());
    model.update(press(KeyCode::Enter));
    for step in 0..5_u8 {
        let preview = |bit: u8| {
            let payload: Vec<u8> = f64::from(step).to_le_bytes().to_vec();
            let (seq, bytes) = (u64::from(step), payload.len());
            let captured = Stamp(TAKEN.0 + u64::from(step));
            let encoding = rapid_core::sample::Encoding::F64;
            std::sync::Arc::new(Preview {
                device: id(bit),
                seq,
                captured,
                encoding,
                width: 1,
                height: 1,
                bytes,
                payload: payload.into(),
            })
        };
        now.previews = vec![preview(0), preview(1), preview(2)];
        model.update(after(&now, u64::from(step) * 100));
    }
    assert_eq!(model.numbers(id(0)).count(), 5);
    assert_eq!(model.numbers(id(1)).count(), 0);
}

#[test]
fn a_line_that_is_too_slow_for_pictures_shows_none() {
    let mut now = three_streaming();
    let payload: Vec<u8> = vec![7; 16];
    now.previews = vec![std::sync::Arc::new(Preview {
        device: id(0),
        encoding: rapid_core::sample::Encoding::Grey,
        width: 4,
        height: 4,
        bytes: payload.len(),
        payload: payload.into(),
        ..crate::literal::preview()
    })];
    let mut model = Model::new(now.clone());
    // The rig alone is small: whatever the line does, there is nothing to leave out.
    (0..100).for_each(|_| model.pace(false));
    assert!(model.pictures);
    model.update(press(KeyCode::Enter));
    model.update(after(&now, 100));
    assert!(model.picture(id(0)).is_some());
    // Now and then a frame is late on any line.
    for _ in 0..100 {
        model.pace(false);
        model.pace(true);
    }
    assert!(model.pictures);
    (1..TOO_LATE).for_each(|_| model.pace(false));
    assert!(model.pictures);
    model.pace(false);
    assert!(!model.pictures && model.notice().is_some_and(|notice| notice.contains("too slow")));
    model.update(press(KeyCode::Char('c')));
    assert!(model.pictures, "who wants them has them");
}
