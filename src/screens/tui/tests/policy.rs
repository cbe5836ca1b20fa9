//! The policy panel: acting, holding, dry, and with more content than fits.

use rapid_status::{Hold, PolicyStatus};

use crate::literal::policy;

use super::*;

const SMALL: (u16, u16) = (60, 12);
const USUAL: (u16, u16) = (80, 24);
const LARGE: (u16, u16) = (120, 40);
const MISSING: &str = "a modality that the policy requires is missing";

fn with(mut end: Snapshot, policy: PolicyStatus) -> Model {
    end.policy = Some(policy);
    measured(&end)
}

fn holding() -> PolicyStatus {
    let hold = Hold { device: Some("arm".to_owned()), reason: MISSING.to_owned() };
    PolicyStatus { hold: Some(hold), unused: 2, chunk_age: None, ..policy() }
}

fn arm(count: usize) -> PolicyStatus {
    let axis = |n: usize| (format!("joint_{n}"), n as f64 * -0.731, "rad".to_owned());
    PolicyStatus { action: (1..=count).map(axis).collect(), ..policy() }
}

#[test]
fn a_policy_that_acts() {
    let mut end = three_streaming();
    end.log = vec![line(0, Level::Info, "policy acts from tick 12")];
    let model = with(end, policy());
    assert_snapshot!("policy_acts_60x12", draw(&model, SMALL, THEME));
    let screen = draw(&model, USUAL, THEME);
    assert_eq!(style_of(screen.buffer(), "► acting").fg, Some(Color::Green));
    assert_snapshot!("policy_acts_80x24", screen);
    assert_snapshot!("policy_acts_120x40", draw(&model, LARGE, THEME));
}

#[test]
fn a_holding_policy_shows_its_reason_with_and_without_colour() {
    let mut end = three_streaming();
    end.recording = Some(recording(0));
    let model = with(end, holding());
    assert_snapshot!("policy_holds_60x12", draw(&model, SMALL, THEME));
    let screen = draw(&model, USUAL, THEME);
    assert_eq!(style_of(screen.buffer(), "▲ holds: a modality").fg, Some(Color::Yellow));
    // It names the device even if the reason does not fit completely.
    assert!(draw(&model, SMALL, THEME).to_string().contains("…: arm"));
    assert!(style_of(screen.buffer(), " 0.123").add_modifier.contains(Modifier::DIM), "is not carried out");
    assert_snapshot!("policy_holds_80x24", screen);
    assert_snapshot!("policy_holds_120x40", draw(&model, LARGE, THEME));
    let screen = draw(&model, USUAL, ASCII);
    assert_snapshot!("policy_holds_ascii_80x24", screen);
    for cell in &screen.buffer().content {
        assert!(cell.symbol().is_ascii() && cell.fg == Color::Reset, "{:?}", cell.symbol());
    }
}

#[test]
fn a_dry_run_is_marked_and_unknown_values_are_dashes() {
    let first = PolicyStatus { dry_run: true, action: Vec::new(), latency_ms: None, ..holding() };
    let model = with(three_streaming(), first);
    let screen = draw(&model, USUAL, THEME);
    assert_eq!(style_of(screen.buffer(), "▲ dry run").fg, Some(Color::Yellow));
    assert_snapshot!("policy_dry_80x24", screen);
    let model = with(three_streaming(), PolicyStatus { dry_run: true, ..policy() });
    assert_snapshot!("policy_dry_60x12", draw(&model, SMALL, ASCII));
}

#[test]
fn long_and_hostile_text_keeps_the_columns() {
    let hostile = "\x1b[2J\x1b[Hgone\r\n\u{202e}reversed";
    let axis = |name: &str, value: f64, unit: &str| (name.to_owned(), value, unit.to_owned());
    let report = PolicyStatus {
        name: format!("{hostile} 相机手腕左侧的相机 a name of a policy that is far too long for a rule"),
        dry_run: true,
        hold: Some(Hold { device: Some("wörter ".repeat(30)), reason: hostile.to_owned() }),
        action: vec![
            axis("a_name_of_an_axis_that_is_long", f64::NAN, "newtons per second"),
            axis(hostile, -1e300, hostile),
            axis("相机手腕左侧的相机", 99_999.4, "µm"),
        ],
        latency_ms: Some(1e9),
        chunk_age: Some(u64::MAX),
        actions: u64::MAX,
        ..policy()
    };
    let acting = with(three_streaming(), PolicyStatus { hold: None, ..report.clone() });
    let model = with(three_streaming(), report);
    for (name, size) in [("60x12", SMALL), ("80x24", USUAL)] {
        let screen = draw(&model, size, THEME);
        assert!(screen.buffer().content.iter().all(|cell| !cell.symbol().contains(char::is_control)));
        assert_snapshot!(format!("policy_hostile_{name}"), screen);
    }
    for size in [(1, 1), (60, 12), (60, 13), (60, 19), (60, 20), (61, 31), (300, 12), (300, 200)] {
        draw(&acting, size, ASCII);
    }
}

#[test]
fn forty_axes_are_shown_as_far_as_they_fit() {
    let model = with(three_streaming(), arm(40));
    for (name, size) in [("60x12", SMALL), ("80x24", USUAL), ("120x40", LARGE)] {
        assert_snapshot!(format!("policy_forty_axes_{name}"), draw(&model, size, THEME));
    }
    let seven = draw(&with(three_streaming(), arm(7)), USUAL, THEME).to_string();
    assert!(seven.contains("joint_7") && !seven.contains("more"), "{seven}");
}

#[test]
fn a_policy_leaves_room_for_sixty_four_devices() {
    let model = with(sixty_four(), arm(7));
    assert_snapshot!("policy_sixty_four_60x12", draw(&model, SMALL, THEME));
    assert_snapshot!("policy_sixty_four_80x24", draw(&model, USUAL, THEME));
    let screen = draw(&model, LARGE, THEME).to_string();
    assert!(screen.contains("sensor_11") && screen.contains("joint_7") && screen.contains("nothing yet"), "{screen}");
}

#[test]
fn values_do_not_jump() {
    let column = |values: [f64; 4]| {
        let mut now = policy();
        for (axis, value) in now.action.iter_mut().zip(values) {
            axis.1 = value;
        }
        now.latency_ms = Some(values[0].abs() * 1000.0);
        let screen = draw(&with(three_streaming(), now), USUAL, THEME).to_string();
        let row = screen.lines().find(|line| line.contains("grip")).unwrap().to_owned();
        ["x ", "y ", "z ", "grip", "m"].map(|word| row.find(word))
    };
    let still = column([0.1, 0.2, 0.3, 0.4]);
    for values in [[-0.1, -99.9, 0.0, 99.99], [1234.5, -123.4, f64::NAN, 1e9], [-0.0, -1e-9, 1e-9, f64::INFINITY]] {
        assert_eq!(column(values), still, "{values:?}");
    }
}
