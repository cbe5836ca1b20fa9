//! The pages, and the column beside the rig.

use rapid_core::sample::Encoding;
use rapid_status::detail::{Channel, DeviceDetail, Intervals};
use rapid_status::preview::Preview;
use rapid_status::session::Mark;

use crate::literal::id;

use super::*;

/// What is known of a device, with so many intervals around `hz`.
fn detail(bit: u8, channels: Vec<Channel>) -> DeviceDetail {
    let fact = |name: &str, value: &str| (name.to_owned(), value.to_owned());
    let mut intervals = vec![0; Intervals::COUNT];
    (intervals[16], intervals[17], intervals[22]) = (310, 17_500, 2);
    DeviceDetail {
        id: id(bit),
        facts: vec![
            fact("identity", "046d:0825, serial CAM00A1"),
            fact("at", "port 9-1, /dev/video0"),
            fact("driver", "uvcvideo 6.1.0"),
        ],
        channels,
        controls: vec![("exposure".to_owned(), 120)],
        intervals,
    }
}

fn preview(bit: u8, seq: u64, encoding: Encoding, (width, height): (u32, u32), payload: Vec<u8>) -> Arc<Preview> {
    let captured = TAKEN.before(Duration::from_millis(12));
    let bytes = payload.len();
    Arc::new(Preview { device: id(bit), seq, captured, encoding, width, height, bytes, payload: payload.into() })
}

/// Grey, from dark at the left to light at the right, with a bright square in the middle.
fn picture() -> Arc<Preview> {
    let (width, height) = (64, 48);
    let shade = |x: u32, y: u32| {
        if (28..36).contains(&x) && (20..28).contains(&y) { 255 } else { u8::try_from(x * 3).unwrap() }
    };
    let payload = (0..height).flat_map(|y| (0..width).map(move |x| shade(x, y))).collect();
    preview(0, 7, Encoding::Grey, (width, height), payload)
}

fn with(mut snapshot: Snapshot, detail: DeviceDetail, preview: Arc<Preview>) -> Snapshot {
    snapshot.details = vec![detail];
    snapshot.previews = vec![preview];
    snapshot.log = vec![
        line(0, Level::Info, "cam_wrist is streaming"),
        line(1, Level::Warn, "cam_wrist: 3 samples lost"),
        line(2, Level::Warn, "cam_wrist: 4 samples lost"),
        line(3, Level::Info, "tof is streaming"),
    ];
    snapshot
}

/// The model with the page of device `row` open, on a screen of this size.
fn opened(snapshot: &Snapshot, row: usize, (width, height): (u16, u16)) -> Model {
    let mut model = measured(snapshot);
    model.update(Msg::Size(width, height));
    model.selected = row;
    model.update(press(KeyCode::Enter));
    model.update(Msg::Snapshot(Box::new(snapshot.clone())));
    model
}

#[test]
fn a_camera_is_shown_with_its_picture_facts_intervals_and_log() {
    let snapshot = with(three_streaming(), detail(0, Vec::new()), picture());
    assert_snapshot!("camera_80x24", draw(&opened(&snapshot, 0, (80, 24)), (80, 24), THEME));
    let mut model = opened(&snapshot, 0, (120, 40));
    assert_snapshot!("camera_120x40", draw(&model, (120, 40), ASCII));
    model.update(press(KeyCode::Char('c')));
    style_of(draw(&model, (120, 40), THEME).buffer(), "pictures are off (c shows them)");
}

#[test]
fn a_damaged_picture_is_a_sentence() {
    let mut broken = Preview::clone(&picture());
    broken.payload = broken.payload[..100].into();
    let snapshot = with(three_streaming(), detail(0, Vec::new()), Arc::new(broken));
    let screen = draw(&opened(&snapshot, 0, (120, 40)), (120, 40), THEME);
    style_of(screen.buffer(), "100 bytes, where a picture of 64x48 has 3072");
}

#[test]
fn the_room_of_a_wide_screen_is_used() {
    let snapshot = with(three_streaming(), detail(0, Vec::new()), picture());
    let mut model = measured(&snapshot);
    model.update(Msg::Size(200, 60));
    model.update(Msg::Snapshot(Box::new(snapshot.clone())));
    assert_snapshot!("wide_200x60", draw(&model, (200, 60), THEME));
}

#[test]
fn numbers_are_plotted_and_those_with_limits_are_gauges() {
    let numbers = |seq: u64| {
        let at = seq as f64 / 10.0;
        [at.sin(), at.cos() * 2.0].iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>()
    };
    let sample = |seq| preview(2, seq, Encoding::F64, (3, 0), numbers(seq));
    let mut snapshot = with(three_streaming(), detail(2, Vec::new()), sample(0));
    let mut model = opened(&snapshot, 2, (80, 24));
    for seq in 1..100 {
        let mut newer = Preview::clone(&sample(seq));
        newer.captured = snapshot.taken;
        snapshot.previews = vec![Arc::new(newer)];
        model.update(Msg::Snapshot(Box::new(snapshot.clone())));
        snapshot.taken = snapshot.taken.after(Duration::from_millis(50));
    }
    assert_snapshot!("plot_80x24", draw(&model, (80, 24), THEME));
    let channel = |name: &str, limits| Channel { name: name.to_owned(), limits };
    let channels = vec![
        channel("elbow rad", Some([-1.0, 1.0])),
        channel("elbow Nm", Some([-0.5, 0.5])),
        channel("elbow error", None),
    ];
    let payload: Vec<u8> = [0.5_f64, 0.7, 0.0].iter().flat_map(|number| number.to_le_bytes()).collect();
    let snapshot = with(three_streaming(), detail(2, channels), preview(2, 1, Encoding::F64, (3, 0), payload));
    let screen = draw(&opened(&snapshot, 2, (80, 24)), (80, 24), THEME);
    assert_eq!(style_of(screen.buffer(), "0.700").fg, Some(Color::Reset));
    assert_snapshot!("gauges_80x24", screen);
}

#[test]
fn bytes_are_shown_as_bytes_and_a_device_without_samples_says_so() {
    let snapshot = with(
        three_streaming(),
        detail(2, Vec::new()),
        preview(2, 1, Encoding::Bytes, (0, 0), b"$GPGGA,1\r\n".to_vec()),
    );
    style_of(draw(&opened(&snapshot, 2, (80, 24)), (80, 24), THEME).buffer(), "24 47 50 47 47 41 2c 31 0d 0a");
    style_of(draw(&opened(&every_state(), 1, (80, 24)), (80, 24), THEME).buffer(), "no samples arrive");
}

#[test]
fn the_log_has_a_page_with_its_filters() {
    let mut snapshot = with(three_streaming(), detail(0, Vec::new()), picture());
    snapshot.log.push(Arc::new(rapid_status::LogLine {
        printed: Some(rapid_status::PrintedOn::Stderr),
        text: "tof: Traceback (most recent call last), a line that is so long that it does not fit into the width of the screen".to_owned(),
        ..rapid_status::LogLine::clone(&line(4, Level::Info, "tof: x"))
    }));
    let mut model = measured(&snapshot);
    for key in ['l', 'w'] {
        model.update(press(KeyCode::Char(key)));
    }
    assert_snapshot!("log_80x24", draw(&model, (80, 24), THEME));
    for key in ['v', '/', 'l', 'o', 's', 't'] {
        model.update(press(KeyCode::Char(key)));
    }
    model.update(press(KeyCode::Enter));
    assert_snapshot!("log_filtered_80x24", draw(&model, (80, 24), ASCII));
}

#[test]
fn the_episodes_have_a_page_with_every_reason() {
    let mut snapshot = three_streaming();
    let mut session = session();
    session.episodes[6].marks = vec![Mark { at: 3.2, text: "grasped".to_owned() }];
    session.episodes[6].note = "new pads".to_owned();
    session.folder = "episodes".into();
    snapshot.session = Some(session);
    let mut model = measured(&snapshot);
    model.update(press(KeyCode::Char('e')));
    assert_snapshot!("episodes_80x24", draw(&model, (80, 24), THEME));
    model.update(press(KeyCode::Down));
    model.update(press(KeyCode::Down));
    style_of(draw(&model, (80, 24), THEME).buffer(), "discarded; u takes the last one back");
}

#[test]
fn what_is_wrong_has_a_line_below_the_header() {
    let mut snapshot = every_state();
    let mut now = recording(0);
    let text = "lost 10 % (limit 5 %)".to_owned();
    now.outlook = Outlook { findings: vec![Finding { grade: Grade::Bad, modality: Some("imu".to_owned()), text }] };
    snapshot.recording = Some(now);
    let screen = draw(&measured(&snapshot), (120, 40), THEME);
    assert_eq!(style_of(screen.buffer(), "imu: lost 10 % (limit 5 %): the episode would be BAD").fg, Some(Color::Red));
}

#[test]
fn a_click_finds_what_is_drawn_there() {
    let snapshot = with(three_streaming(), detail(0, Vec::new()), picture());
    for size in [(80, 24), (120, 40), (200, 60)] {
        let mut model = measured(&snapshot);
        model.update(Msg::Size(size.0, size.1));
        let screen = draw(&model, size, THEME);
        let columns = usize::from(size.0);
        let place = |text: &str| {
            let rows = screen
                .buffer()
                .content
                .chunks(columns)
                .map(|row| row.iter().map(ratatui::buffer::Cell::symbol).collect::<String>());
            let (y, row) = rows.enumerate().find(|(_, row)| row.contains(text)).unwrap_or_else(|| panic!("{text}"));
            let x = row.split(text).next().unwrap().chars().count();
            Position::new(u16::try_from(x).unwrap(), u16::try_from(y).unwrap())
        };
        let target = |text| view::target(&model, size, THEME, place(text));
        for (row, text) in ["0 cam_wrist ● st", "1 cam_top   ● st", "2 tof       ● st"].into_iter().enumerate() {
            assert_eq!(target(text), Some(view::Target::Device(row)), "{text} {size:?}");
        }
        assert_eq!(target("─ Log"), Some(view::Target::Log), "{size:?}");
        assert_eq!(target("─ Devices"), Some(view::Target::Devices), "{size:?}");
        assert_eq!(view::target(&model, size, THEME, Position::new(1, 0)), None);
    }
}

#[test]
fn what_is_read_only_offers_no_key_that_does_nothing() {
    let mut model = measured(&three_streaming());
    model.link = LinkState::Attached { process: 1, read_only: true };
    assert_snapshot!("read_only_80x24", draw(&model, (80, 24), THEME));
    model.update(press(KeyCode::Char('?')));
    assert_snapshot!("read_only_help_80x24", draw(&model, (80, 24), THEME));
}
