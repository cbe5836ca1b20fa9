//! Buttons on the kernel's own input and GPIO devices: a keyboard of uinput, and a line of a USB chip.

use vbench::check::play;
use vbench::emu::spec::DeviceSpec;
use vbench::scenario::Scenario;

const RIG: &str = r#"
[device.tof]
vid = "1209"
pid = "0001"
node = "serial"
bit = 0
tty = { channels = 2 }
[button.pedal]
key = { device = "bench pedal", code = "KEY_A", grab = true }
press = "toggle"
hold = "discard"
[button.good]
key = { device = "bench pedal", code = "KEY_C", grab = true }
press = "success"
[button.remote]
key = { device = "bench remote", code = "KEY_B" }
press = "mark"
[button.panel]
gpio = { chip = "/dev/panel", line = 2, pressed_while = "high" }
press = "mark"
"#;

const SCRIPT: &str = r#"
modprobe -a uinput evdev
# keys FILE NAME KEY...: an input device, which follows the lines written to the file until it is removed by `unplug`.
mkfifo /tmp/pedal /tmp/remote
exec 8<>/tmp/pedal 9<>/tmp/remote
pedal_plug() {
  : >$out/pedal
  "${usbemu[@]}" --keys 'bench pedal' KEY_A KEY_C </tmp/pedal >$out/pedal 2>&1 8>&- 9>&- &
  pedal=$!
  wait_for 30 has_line $out/pedal ready || fail "no pedal: $(cat $out/pedal)"
}
pedal() { echo "$1 $2" >&8; }
"${usbemu[@]}" --keys 'bench remote' KEY_B </tmp/remote >$out/remote 2>&1 &
wait_for 30 has_line $out/remote ready || fail "no remote: $(cat $out/remote)"
in_log() { has_line $out/rapid.jsonl '"event":"log"' "$1"; }
event_times() { has_lines "$1" $out/rapid.jsonl "\"event\":\"$2\""; }
echo 'SUBSYSTEM=="gpio", KERNEL=="gpiochip*", ATTRS{serial}=="GPIO1", SYMLINK+="panel"' >/etc/udev/rules.d/90-bench-gpio.rules
udevadm control --reload
pedal_plug

# Pressed before the start: nothing, until it is released and pressed again.
pedal press KEY_A
wait_for 30 has_line $out/pedal done || fail 'the pedal is not pressed'
rapid_start --headless --sim /tmp/bench/sim.toml --config /tmp/bench/devices.toml --out $out/rec --json
await_rapid 60 '"event":"state"' '"state":"streaming"' || fail 'no stream'
node_of() { local name; name=$(grep -l "$1" /sys/class/input/event*/device/name); echo /dev/input/$(basename ${name%/device/name}); }
is_read() { [ -n "$(find /proc/$rapid_pid/fd -lname "$(node_of "$1")")" ]; }
wait_for 30 is_read 'bench pedal' || fail 'the pedal is not read'
sleep 1.5
in_log 'pedal: ' && fail "pressed at the start: $(grep -F 'pedal: ' $out/rapid.jsonl)"
timeout 1 "${usbemu[@]}" --grab $(node_of 'bench pedal') >$out/grab 2>&1
has_line $out/grab grabbed && fail 'the pedal is not grabbed'
pedal release KEY_A
sleep 0.2
pedal press KEY_A
sleep 0.1
pedal release KEY_A
wait_for 30 in_log 'pedal: begin episode' || fail 'no episode begins'
wait_for 30 event_times 1 recording || fail 'no episode has begun'

# A device that another program has grabbed is still read.
"${usbemu[@]}" --grab $(node_of 'bench remote') >$out/grabbed 2>&1 &
grab=$!
wait_for 30 has_line $out/grabbed grabbed || fail "not grabbed: $(cat $out/grabbed)"
echo 'press KEY_B' >&9
wait_for 30 in_log 'remote: marked at' || fail 'a grabbed remote is not seen'
echo 'release KEY_B' >&9
kill $grab

# A line of a chip, plugged in late.
emu plug 0
wait_for 30 test -c /dev/panel || fail 'no GPIO chip'
wait_for 30 in_log 'button panel is back' || fail 'the chip is not found'
# A line that nothing pulls low is high, and so pressed when the chip appears: that is not a press.
sleep 0.5
in_log 'panel: marked at' && fail 'a panel that appears pressed is pressed'
emu level 0.2 0
sleep 0.5
emu level 0.2 1
wait_for 30 in_log 'panel: marked at' || fail 'the panel is not seen'

# Unplugged while it is held, and plugged in again: the episode continues.
pedal press KEY_A
sleep 0.2
kill $pedal
wait_for 30 in_log 'button pedal, good is lost' || fail 'the pedal is not missed'
sleep 1.5
in_log 'pedal: discard' && fail 'a lost pedal is held'
pedal_plug
wait_for 30 in_log 'button pedal, good is back' || fail 'the pedal is not found again'
event_times 1 episode && fail 'the episode has ended'
sleep 0.2
pedal press KEY_C
wait_for 30 in_log 'good: label success' || fail 'the second key of the pedal is not seen'
pedal press KEY_A
wait_for 30 in_log 'pedal: discard episode' || fail 'a held pedal is not seen'
wait_for 30 event_times 1 discarded || fail 'it is not discarded'
rapid_stop
emu_quit
exit 0
"#;

#[test]
fn a_pedal_begins_and_discards_episodes_is_grabbed_and_may_be_unplugged() {
    let scenario = Scenario::new("buttons")
        .spare(DeviceSpec::gpio().serial("GPIO1"))
        .registry(RIG)
        .file("devices.toml", RIG.to_owned())
        .file("sim.toml", "[[device]]\nname = \"tof\"\n".to_owned());
    let outcome = play(scenario.script(SCRIPT));
    assert_eq!(outcome.code, 0, "the guest's script: {}", outcome.log);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
}
