//! A joint with a brake on a line of a USB chip, an emergency stop on another line of it, and an enabling switch on a key:
//! the kernel's own GPIO and input devices.

use serde_json::Value;
use vbench::check::{ms, play, takes};
use vbench::emu::can::adapter::Protocol;
use vbench::emu::spec::DeviceSpec;
use vbench::entries::{can, registry};
use vbench::outcome::Outcome;
use vbench::scenario::Scenario;

const BUS: &str = r#"adapter = "damiao"
protocol = "damiao"
disable_after = "never"
[[device.arm.can.motors]]
name = "joint"
slave = 0x05
master = 0x15
type = "DM4310"
mode = "position"
position = [-1.0, 1.0]
own_fault = "brake"
other_fault = "brake"
emergency = "brake"
brake = { chip = "/dev/brakes", line = 0, released = "high", engages_in = "200ms", releases_in = "50ms" }
"#;

const STOPS: &str = r#"
[stop.door]
kind = "emergency"
gpio = { chip = "/dev/brakes", line = 2, runs_while = "low" }
[stop.pedal]
kind = "enabling"
key = { device = "bench pedal", code = "KEY_B" }
"#;

const SCRIPT: &str = r#"
modprobe -a uinput evdev
mkfifo /tmp/keys
"${usbemu[@]}" --keys 'bench pedal' KEY_B 0<>/tmp/keys >$out/keys 2>&1 &
exec 8>/tmp/keys
wait_for 30 has_line $out/keys ready || fail "no keys: $(cat $out/keys)"
key() { echo "$1 KEY_B" >&8; }
stop_is() { has_line $out/rapid.jsonl '"event":"stop"' "\"stop\":\"$1\"" "\"state\":\"$2\""; }
# What was last reported of them.
inputs() { grep -F '"event":"stop"' $out/rapid.jsonl | tail -n 3; }
# stops N STOP STATE: this state of the stop was reported N times at least.
stops() { has_lines "$1" $out/rapid.jsonl '"event":"stop"' "\"stop\":\"$2\"" "\"state\":\"$3\""; }
# arm WORD: what follows is of this round.
arm() {
  mark $1
  wait_for 30 "${rapid[@]}" arm || fail "$1: $("${rapid[@]}" arm 2>&1)"
  wait_for 30 logged motor_enabled || fail "$1: not enabled"
  wait_for 30 logged gpio '"line":0' '"level":1' || fail "$1: the brake is not released"
  wait_for 30 logged commands_begin || fail "$1: no commands"
  mark $1.armed
}
# Its number is another one after a plug, while the kernel remembers who had its lines.
echo 'SUBSYSTEM=="gpio", KERNEL=="gpiochip*", ATTRS{serial}=="GPIO1", SYMLINK+="brakes"' >/etc/udev/rules.d/90-bench-gpio.rules
udevadm control --reload
emu plug 1
wait_for 30 test -c /dev/brakes || fail 'no GPIO chip'
emu level 1.2 1
rapid_start --headless --config /tmp/bench/devices.toml --json
emu plug 0
wait_for 60 states 1 arm streaming || fail 'the motor does not stream'
wait_for 30 stop_is door stopped || fail "the door is not seen: $(inputs)"
wait_for 30 stop_is pedal stopped || fail "the pedal is not seen: $(inputs)"
"${rapid[@]}" arm >$out/refused 2>&1 && fail 'armed with the door open'
emu level 1.2 0
wait_for 30 stops 1 door runs || fail 'the door is not closed'
"${rapid[@]}" arm >$out/refused.pedal 2>&1 && fail 'armed without the pedal'
key press
wait_for 30 stops 1 pedal runs || fail 'the pedal is not pressed'

# Pushed out of its limits by hand, it is driven back when that is asked for.
emu zero 0.5 1.3
emu_done 10
"${rapid[@]}" arm || fail 'rapid takes no order'
actuator() { has_line $out/rapid.jsonl '"event":"actuator"' "$1"; }
wait_for 30 actuator 'outside its limits' || fail 'armed outside the limits'
mark back
"${rapid[@]}" arm --drive-back || fail 'rapid takes no order'
wait_for 60 actuator 'all joints are within their limits' || fail 'not driven back'
emu ask 0
emu_done 10
"${rapid[@]}" disarm
wait_for 30 actuator 'motors are disabled' || fail 'not disarmed'

arm door
emu level 1.2 1
wait_for 30 logged motor_disabled || fail 'the door stops nothing'
emu level 1.2 0
wait_for 30 stops 2 door runs || fail 'the door is not closed again'

arm pedal
key release
wait_for 30 logged motor_disabled || fail 'the pedal stops nothing'
wait_for 30 logged gpio '"line":0' '"level":0' || fail 'the brake is not engaged after a disarm'
key press
wait_for 30 stops 2 pedal runs || fail 'the pedal is not pressed again'

arm grabbed
node=$(grep -l 'bench pedal' /sys/class/input/event*/device/name)
"${usbemu[@]}" --grab /dev/input/$(basename ${node%/device/name}) >$out/grab 2>&1 &
grab=$!
wait_for 30 has_line $out/grab grabbed || fail "not grabbed: $(cat $out/grab)"
key release
wait_for 30 logged motor_disabled || fail 'a pedal that another program has grabbed stops nothing'
key press
wait_for 30 stops 3 pedal runs || fail 'a grabbed pedal is not seen to be pressed'
kill $grab

# The chip refuses a level, which this kernel does not report to whoever sets it.
undriven() { has_line $out/rapid.log 'the brake cannot be driven' "$1"; }
arm refused
emu mute 1 1
emu level 1.2 1
wait_for 30 undriven 'is high although it was set to low' || fail 'a refused level is not noticed'
sleep 1
logged motor_disabled && fail 'a joint whose brake is still released was disabled'
emu mute 1 0
wait_for 30 logged motor_disabled || fail 'not disabled with the brake engaged'
emu level 1.2 0
wait_for 30 stops 3 door runs || fail 'the door is not closed after a refused level'

arm unplugged
emu unplug 1
wait_for 30 stops 1 door lost || fail 'the chip is not missed'
wait_for 30 undriven 'is not plugged in' || fail 'the brake is not missed'
sleep 1
logged motor_disabled && fail 'a joint whose brake is not known to hold was disabled'
"${rapid[@]}" disarm || fail 'no disarm'
wait_for 30 logged motor_disabled || fail 'not disarmed'
"${rapid[@]}" arm >$out/refused.lost 2>&1 && fail 'armed without the door'
emu plug 1
emu level 1.2 0
wait_for 30 stops 4 door runs || fail 'the chip is not found again'

arm killed
kill -KILL $rapid_pid
mark dead
wait_for 60 logged motor_disabled || fail 'nothing stops a motor without rapid'
wait $rapid_pid
gone() { ! pgrep -x motor-guard >/dev/null; }
wait_for 30 gone || fail 'the guard is left'
emu_done 10
emu_quit
exit 0
"#;

/// The lines of the emulator's log from a word to the next.
fn round<'a>(outcome: &'a Outcome, word: &str) -> &'a [Value] {
    let is_word = |line: &Value| line["action"] == "say";
    let from = outcome.emu.iter().position(|line| is_word(line) && line["word"] == word);
    let lines = &outcome.emu[from.unwrap_or_else(|| panic!("no word {word}")) + 1..];
    &lines[..lines.iter().position(is_word).unwrap_or(lines.len())]
}

/// When a line of these fields was logged, ns.
fn time(lines: &[Value], action: &str, level: Option<u64>) -> Option<u64> {
    let is_it = |line: &&Value| line["action"] == action && level.is_none_or(|level| line["level"] == level);
    lines.iter().find(is_it).and_then(|line| line["mono_ns"].as_u64())
}

#[test]
fn a_brake_is_engaged_before_its_joint_is_released_whatever_stops_it() {
    if crate::lacks_virtual_time() {
        return;
    }
    let text = registry(&[can("arm", "/rapid/arm_state", 0, "2e88:4603", "CAN1", BUS)]) + STOPS;
    let scenario = Scenario::new("brake")
        .spare(DeviceSpec::can(Protocol::Damiao).serial("CAN1").motor(0x05, 0x15, "DM4310"))
        .spare(DeviceSpec::gpio().serial("GPIO1"))
        .registry(&text)
        .file("devices.toml", text);
    let outcome = play(scenario.script(SCRIPT));
    assert_eq!(outcome.code, 0, "the guest's script: {}", outcome.log);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    assert!(outcome.file("refused").contains("emergency stop door is pressed"), "{}", outcome.file("refused"));
    assert!(outcome.file("refused.pedal").contains("enabling switch pedal is released"));
    assert!(outcome.file("refused.lost").contains("emergency stop door is lost"));
    let back = round(&outcome, "back").iter().find(|line| line["action"] == "motor_state");
    let position = back.and_then(|line| line["position"].as_f64()).expect("it was asked");
    assert!((0.9..=1.01).contains(&position), "driven back to {position}, and 1 is its limit");
    for word in ["door", "pedal", "grabbed", "refused", "unplugged", "killed"] {
        let lines = round(&outcome, word);
        let (on, released) = (time(lines, "motor_enabled", None), time(lines, "gpio", Some(1)));
        assert!(on.is_some() && on < released, "{word}: released before the motor is on: {lines:?}");
    }
    let lines = round(&outcome, "door.armed");
    let (engaged, off) = (time(lines, "gpio", Some(0)).unwrap(), time(lines, "motor_disabled", None).unwrap());
    // `engages_in`, counted from the cycle of the control loop that sees it, which may be the second one: its level is read back.
    // That loop takes 5 ms, and a cycle that begins a microsecond early waits for the next.
    takes(&outcome, "brake engaged to motor off", engaged, off, 200.0..=215.0);
    for word in ["pedal", "grabbed"] {
        let lines = round(&outcome, &format!("{word}.armed"));
        assert!(time(lines, "gpio", Some(0)).is_some(), "{word}: {lines:?}");
    }
    let lines = round(&outcome, "refused.armed");
    assert!(time(lines, "gpio", Some(0)) < time(lines, "motor_disabled", None), "disabled before the brake is engaged");
    // The guard holds the line too.
    let killed = [round(&outcome, "killed.armed"), round(&outcome, "dead")].concat();
    let (engaged, off) = (time(&killed, "gpio", Some(0)).unwrap(), time(&killed, "motor_disabled", None).unwrap());
    assert!(engaged < off, "engaged {} ms after the motor was off", ms(engaged, off));
    // The guard holds for `hold_for`, 5 s, whatever has engaged.
    takes(&outcome, "killed: brake engaged to motor off", engaged, off, 5_000.0..=5_010.0);
}
