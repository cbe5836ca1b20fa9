//! `rapid` with motors behind a CAN adapter: they move after an arm and at no other time, and each way out disables them.

use serde_json::Value;
use vbench::check::{ended_with, episode, ms, play, takes};
use vbench::emu::can::adapter::Protocol;
use vbench::emu::spec::DeviceSpec;
use vbench::entries::{can, registry};
use vbench::outcome::Outcome;
use vbench::recording::{falls, rises};
use vbench::scenario::Scenario;

const ARM: &str = "/rapid/arm_state";
/// Every limit of time is the product's own.
const BUS: &str = r#"protocol = "damiao"
motors = [
    { name = "shoulder", slave = 0x05, master = 0x15, type = "DMH3510", mode = "position", position = [-1.0, 1.0], slew = 2.0, first_target = 2, other_fault = "limp" },
    { name = "gripper", slave = 0x06, master = 0x16, type = "DM4310", mode = "position", position = [-1.0, 1.0], slew = 2.0, first_target = 2, other_fault = "limp" },
]"#;

const SCRIPT: &str = r#"
arm() { "${rapid[@]}" arm || fail 'rapid takes no order'; }
# both ACTION: since the last mark both motors have logged this.
both() { logged $1 '"motor":5' && logged $1 '"motor":6'; }
actuator() { has_line $out/rapid.jsonl '"event":"actuator"' "\"arming\":\"$1\""; }
# following: both are enabled and get commands.
following() { ordered enabled 5 6 && both commands_begin; }
# again WORD: marks, arms, and waits until both follow.
again() {
  sleep 1
  mark $1
  arm
  wait_for 5 following || fail "they do not follow: $1"
  sleep 1
  following || fail "they no longer follow: $1"
}

rapid_start --headless --record --arm --out $out/rec --config /tmp/bench/devices.toml --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
# Remembered, though nothing is there that could move: it outweighs --arm.
"${rapid[@]}" disarm || fail 'no disarm without an actuator'
emu plug 0
wait_for 60 states 1 arm streaming || fail 'the motors do not stream'
./publish_action --axes 2 --rate 10 --amplitude 0.5 --period 2 >$out/publish.log 2>&1 &
publisher=$!
sleep 3
again armed
sleep 3
following || fail 'they no longer follow'
mark moving
emu unplug 0
wait_for 20 states 1 arm absent || fail 'still there'
wait_for 20 both motor_timeout || fail 'the motors did not give up'
mark pulled
emu plug 0
wait_for 60 states 2 arm streaming || fail 'the motors do not stream again'
sleep 3
again replugged
mark fault
emu fault 0.5 a
wait_for 20 logged motor_disabled '"motor":6' || fail 'the other motor was not disabled'
wait_for 20 actuator faulted || fail 'the fault is not reported'
sleep 2
again faulted
mark silence
emu mute 0.6 1
wait_for 20 logged motor_disabled '"motor":5' || fail 'silence disables no motor'
sleep 1
emu mute 0.6 0
again answered
mark heat
emu hot 0.6 95
wait_for 20 logged motor_disabled '"motor":5' || fail 'heat disables no motor'
sleep 1
emu hot 0.6 30
again cooled
mark end
rapid_stop
wait_for 20 both commands_end || fail 'the last commands did not end'
kill $publisher
emu_done 5
emu_quit
exit 0
"#;

/// Lines of the emulator's log between two marks.
fn between<'a>(outcome: &'a Outcome, from: &str, to: &str) -> &'a [Value] {
    let place = |word: &str| {
        let place = outcome.emu.iter().position(|line| line["action"] == "say" && line["word"] == word);
        place.unwrap_or_else(|| panic!("no word {word}"))
    };
    let to = if to.is_empty() { outcome.emu.len() } else { place(to) };
    &outcome.emu[place(from)..to]
}

fn actions<'a>(lines: &'a [Value], action: &str) -> Vec<&'a Value> {
    lines.iter().filter(|line| line["action"] == action).collect()
}

#[test]
fn motors_move_after_an_arm_and_at_no_other_time() {
    if crate::lacks_virtual_time() {
        return;
    }
    let adapter = DeviceSpec::can(Protocol::GsUsb).serial("CAN1");
    let outcome = play(
        Scenario::new("motors")
            .device(adapter.motor(0x05, 0x15, "DMH3510").motor(0x06, 0x16, "DM4310"))
            .registry(&registry(&[can("arm", ARM, 0, "1d50:606f", "CAN1", BUS)]))
            .example("publish_action")
            .script(SCRIPT),
    );
    ended_with(&outcome, |reason| reason.starts_with("arm: no sample for 1.1 s"));
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    let log = &outcome.emu[..];

    // The adapter came up by itself, at the bus's rate; the motors' own time limit was set before anything moved.
    assert_eq!(actions(log, "can_up")[0]["bitrate"], 1_000_000);
    let place = |action: &str| log.iter().position(|line| line["action"] == action).unwrap_or(log.len());
    let armed = log.iter().position(|line| line["word"] == "armed").unwrap();
    assert!(place("motor_enabled") > armed && place("commands_begin") > armed, "it moved before the arm");
    let limits = actions(&log[..place("motor_enabled")], "motor_written");
    let limits: Vec<&Value> = limits.into_iter().filter(|line| line["rid"] == 9).collect();
    // A motor that answers late is commanded again.
    let reported: std::collections::BTreeSet<_> = limits.iter().filter_map(|line| line["motor"].as_u64()).collect();
    assert_eq!(reported.len(), 2, "TIMEOUT of both: {limits:?}");
    assert!(limits.iter().all(|line| line["bytes"] == limits[0]["bytes"]), "one TIMEOUT: {limits:?}");

    // It followed the sine, no faster than it may.
    let moving = actions(between(&outcome, "armed", "pulled"), "commands_end");
    let (pulled, gone) = (outcome.actions("unplug", 0)[0], outcome.actions("gone", 0)[0]);
    let commands: u64 = moving.iter().filter_map(|run| run["count"].as_u64()).sum();
    assert!(commands > 400, "{commands} commands");
    for run in moving {
        println!("motor {}: {run}", run["motor"]);
        // 2 rad/s over the longest time in which it received nothing, and two cycles of 10 ms; an action that is not slewed is
        // 0.15 from the one before.
        let silent = run["longest_gap_ns"].as_f64().unwrap() / 1e9;
        assert!(run["largest_step"].as_f64().unwrap() <= 2.0 * (silent + 0.02) + 0.001, "{run}");
        let last = run["last_mono_ns"].as_u64().unwrap();
        assert!(last <= gone.mono_ns, "commands {} ms after the adapter was gone", ms(last, gone.mono_ns));
    }

    // The replug alone enables nothing, though actions continued.
    let replugged = between(&outcome, "pulled", "replugged");
    assert_eq!(actions(replugged, "can_up").len(), 1, "the adapter came up again");
    for action in ["motor_enabled", "commands_begin"] {
        assert_eq!(actions(replugged, action), Vec::<&Value>::new(), "after the replug");
    }
    let episode = episode(&outcome);
    let edges = episode.mask_edges();
    let (fell, rose) = (falls(&edges, 0), rises(&edges, 0));
    assert!(fell[0] >= pulled.real_ns, "the bit fell before the pull");
    takes(&outcome, "unplug to bit", pulled.real_ns, fell[0], 0.0..=2.5);
    assert!(rose.last().is_some_and(|rose| *rose >= outcome.actions("plug", 0)[1].real_ns), "{edges:?}");

    // Each trouble disables both, and nothing enables them before the next arm.
    let troubles = [
        ("fault", "faulted", 0.0..=15.0),
        // `silent_after`, and two cycles.
        ("silence", "answered", 40.0..=55.0),
        ("heat", "cooled", 0.0..=15.0),
    ];
    for (trouble, arm, within) in troubles {
        let lines = between(&outcome, trouble, arm);
        let time = |line: &&Value| line["mono_ns"].as_u64().expect("a time");
        let begun = lines.iter().find(|line| line["action"] == "order").map(|line| time(&line)).expect("an order");
        let off = lines.iter().find(|line| line["action"] == "motor_disabled" && line["motor"] == 5);
        takes(&outcome, &format!("{trouble} of one motor to the other off"), begun, time(&off.expect("off")), within);
        assert_eq!(actions(lines, "motor_enabled"), Vec::<&Value>::new(), "{trouble}");
        for motor in [5, 6] {
            // A silent one receives nothing either, and times out by itself.
            let is_off = |line: &Value| line["action"] == "motor_disabled" || line["action"] == "motor_timeout";
            assert!(
                lines.iter().any(|line| line["motor"] == motor && is_off(line)),
                "{trouble}: motor {motor} stays on"
            );
        }
    }
    let is_faulted = |line: &&Value| line["event"] == "actuator" && line["arming"] == "faulted";
    let faulted: Vec<&str> = outcome.rapid.iter().filter(is_faulted).filter_map(|line| line["text"].as_str()).collect();
    println!("{faulted:#?}");
    for trouble in
        ["shoulder reports over-current:", "gripper does not answer:", "gripper: transistors at 95 °C (limit 80 °C):"]
    {
        let reported = faulted.iter().any(|text| text.contains(trouble) && text.ends_with("all motors are stopped"));
        assert!(reported, "{trouble} is not reported in {faulted:#?}");
    }

    // SIGTERM: both were turned off before the program ended, and no command came after.
    let end = between(&outcome, "end", "");
    for motor in [5, 6] {
        let reported = |action: &str| -> Vec<&Value> {
            actions(end, action).into_iter().filter(|line| line["motor"] == motor).collect()
        };
        let off = reported("motor_disabled").first().and_then(|line| line["mono_ns"].as_u64());
        let off = off.unwrap_or_else(|| panic!("motor {motor} got no command to turn off"));
        assert!(reported("motor_timeout").is_empty(), "motor {motor} timed out by itself");
        let runs = reported("commands_end");
        assert!(!runs.is_empty(), "motor {motor} had commands until the end");
        for run in runs {
            assert!(run["last_mono_ns"].as_u64().unwrap() <= off, "a command after the order to turn off: {run}");
        }
    }

    // Positions are recorded: six numbers a motor, and they moved.
    let rows = episode.rows(ARM);
    assert!(rows.iter().all(|row| row.len() == 12), "six numbers a motor");
    let reach = |axis: usize| rows.iter().map(|row| row[axis]).fold(0.0, |far: f64, position| far.max(position.abs()));
    println!("{} rows, {:.2} and {:.2} rad at the farthest", rows.len(), reach(0), reach(6));
    assert!((0.2..0.6).contains(&reach(0)) && (0.2..0.6).contains(&reach(6)), "half a radian was asked for");
}
