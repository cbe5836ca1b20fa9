//! `kill -9` and SIGSTOP while `rapid` drives motors behind an adapter of each kind: its guard stops them before the motors'
//! own time limit does.

use serde_json::Value;
use vbench::check::{play, takes};
use vbench::emu::can::adapter::Protocol;
use vbench::emu::spec::DeviceSpec;
use vbench::entries::{can, registry};
use vbench::outcome::Outcome;
use vbench::scenario::Scenario;

/// Every limit of time is the product's own.
fn bus(adapter: &str) -> String {
    format!(
        r#"adapter = "{adapter}"
protocol = "damiao"
disable_after = "never"
motors = [{{ name = "joint", slave = 0x05, master = 0x15, type = "DM4310", mode = "position", position = [-1.0, 1.0], other_fault = "limp" }}]"#
    )
}

const SCRIPT: &str = r#"
for round in 0:socketcan:KILL 1:slcan:KILL 2:damiao:KILL 0:socketcan:STOP; do
  IFS=: read -r device kind signal <<<"$round"
  # One actuator a run: the others are out.
  cp /tmp/bench/devices.$kind.toml /tmp/bench/devices.toml
  rapid_start --headless --config /tmp/bench/devices.toml --json
  emu plug $device
  wait_for 60 states 1 arm streaming || fail "$kind: the motor does not stream"
  mark $kind.$signal
  "${rapid[@]}" arm || fail 'rapid takes no order'
  wait_for 30 logged motor_enabled "\"device\":$device" || fail "$kind: the motor is not enabled"
  wait_for 30 logged commands_begin "\"device\":$device" || fail "$kind: no commands"
  sleep 1
  mark $kind.$signal.killed
  date +%s%N >$out/$kind.$signal
  kill -$signal $rapid_pid
  wait_for 60 logged motor_disabled "\"device\":$device" || fail "$kind: the motor was not disabled"
  emu ask $device
  [ $signal = STOP ] && kill -KILL $rapid_pid
  wait $rapid_pid
  gone() { ! pgrep -x motor-guard >/dev/null; }
  wait_for 30 gone || fail "$kind: its guard is left"
  emu unplug $device
  emu_done 20
done
# Longer than the motor's own limit: it is on its bus without its adapter, too.
sleep 7
emu_quit
exit 0
"#;

/// The lines of the emulator's log about a device, from a word to its next round or the end.
fn round<'a>(outcome: &'a Outcome, device: u64, word: &str) -> Vec<&'a Value> {
    let place = |word: &str| outcome.emu.iter().position(|line| line["action"] == "say" && line["word"] == word);
    let from = place(word).unwrap_or_else(|| panic!("no word {word}"));
    let next = place("socketcan.STOP").filter(|next| device == 0 && *next > from).unwrap_or(outcome.emu.len());
    outcome.emu[from..next].iter().filter(|line| line["device"] == device).collect()
}

#[test]
fn motors_of_a_killed_program_stop_before_their_own_time_limit() {
    if crate::lacks_virtual_time() {
        return;
    }
    let adapter = |protocol, serial| DeviceSpec::can(protocol).serial(serial).motor(0x05, 0x15, "DM4310");
    let kinds = [("socketcan", "1d50:606f", "CAN1"), ("slcan", "ad50:60c4", "CAN2"), ("damiao", "2e88:4603", "CAN3")];
    let mut scenario = Scenario::new("guard")
        .device(adapter(Protocol::GsUsb, "CAN1"))
        .device(adapter(Protocol::Slcan, "CAN2"))
        .device(adapter(Protocol::Damiao, "CAN3"));
    for (kind, model, serial) in kinds {
        let text = registry(&[can("arm", "/rapid/arm_state", 0, model, serial, &bus(kind))]);
        scenario = scenario.registry(&text).file(&format!("devices.{kind}.toml"), text);
    }
    let outcome = play(scenario.script(SCRIPT));
    assert_eq!(outcome.code, 0, "the guest's script: {}", outcome.log);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    for (device, round_of) in [(0, "socketcan.KILL"), (1, "slcan.KILL"), (2, "damiao.KILL"), (0, "socketcan.STOP")] {
        let lines = round(&outcome, device, &format!("{round_of}.killed"));
        let first = |action: &str| lines.iter().find(|line| line["action"] == action);
        let off = first("motor_disabled").and_then(|line| line["real_ns"].as_u64());
        let off = off.unwrap_or_else(|| panic!("{round_of}: not disabled: {lines:?}"));
        assert_eq!(first("motor_timeout"), None, "{round_of}: the motor timed out by itself");
        assert_eq!(first("motor_enabled"), None, "{round_of}: enabled again");
        let state = first("motor_state").unwrap_or_else(|| panic!("{round_of}: {lines:?}"));
        assert_eq!(state["enabled"], false, "{round_of}: {state}");
        let killed = outcome.file(round_of).trim().parse::<u64>().expect("a time");
        // Whoever is dead is noticed at once, whoever hangs by what does not come.
        let expected = if round_of.ends_with("STOP") { 60.0..=110.0 } else { 0.0..=10.0 };
        takes(&outcome, &format!("{round_of} to motor off"), killed, off, expected);
    }
}
