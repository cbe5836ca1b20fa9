//! Many unplugs and replugs, some faster than the cooldown: what `rapid` says at the end is what is plugged, what it recorded
//! is what happened, and it holds no more than before.

use std::fmt::Write;
use std::time::Duration;

use vbench::check::{episode, ms, recorded};
use vbench::emu::log::Moment;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::{camera, registry, scalars};
use vbench::outcome::{Outcome, json_lines};
use vbench::recording::{Edge, falls, rises};
use vbench::scenario::Scenario;

/// `rig.cooldown` unless a registry says otherwise.
const COOLDOWN_NS: u64 = 2_000_000_000;
/// A device that stays for this long is seen: its cooldown is over, its node made, its first sample come.
const SEEN_MS: u64 = 5_000;
const SEEN_NS: u64 = SEEN_MS * 1_000_000;
/// Cycles of one device in each half.
const CYCLES: u64 = 10;
/// Of each half, this cycle is a bounce after which the device stays; of the first, this one rests for longer than the cooldown.
const BOUNCED: u64 = 7;
const RESTED: u64 = 3;
const SEED: u64 = 0x5eed_2026;

/// 60 cycles over three devices in two halves after a warm-up; two of the devices end plugged, one unplugged.
#[test]
fn sixty_cycles_leave_the_truth_and_nothing_else() {
    let mut random = Random(SEED);
    let halves = [half(&mut random, Some(RESTED)), half(&mut random, None)];
    let script = SCRIPT.replace("FIRST_HALF", &halves[0]).replace("SECOND_HALF", &halves[1]);
    let small = |serial| DeviceSpec::uvc(0x046d, 0x0825).serial(serial).mode(Format::Mjpg, 320, 240, &[30]);
    let outcome = recorded(
        Scenario::new("endurance")
            .device(small("CAM00A1"))
            .device(small("CAM00B2"))
            .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1"))
            .registry(&registry(&[
                camera("cam_wrist", "/rapid/camera/wrist", 0, Some("CAM00A1"), (320, 240)),
                camera("cam_side", "/rapid/camera/side", 1, Some("CAM00B2"), (320, 240)),
                scalars("tof", "/rapid/tof", 2, "2e8a:000a", "TOF1"),
            ]))
            .script(&script)
            .limit(Duration::from_secs(240)),
    );

    let said: serde_json::Value = serde_json::from_str(&outcome.file("mask.json")).expect("rapid mask --json");
    println!("{said}");
    assert_eq!(said["mask"], "0x05");
    let online: Vec<_> = said["devices"].as_array().unwrap().iter().map(|device| device["online"] == true).collect();
    assert_eq!(online, [true, false, true]);
    assert_eq!(outcome.file("states").split_whitespace().collect::<Vec<_>>(), ["streaming", "absent", "streaming"]);

    let edges = episode(&outcome).mask_edges();
    let mut cycles = 0;
    for (device, bit) in [(0, 0), (1, 1), (2, 2)] {
        cycles += assert_true_edges(&outcome, &edges, device, bit);
    }
    assert!(cycles >= 60, "only {cycles} cycles");
    // Nothing but plugs and unplugs happened: no device was given up or found silent.
    for name in ["cam_wrist", "cam_side", "tof"] {
        assert!(!outcome.states(name).contains(&"failed"), "{name}: {:?}", outcome.states(name));
    }
    assert_flat(&outcome);
}

const SCRIPT: &str = r#"
# All that threads of a pool may still do ends some seconds after the last opening.
settle() { wait_for 60 is 0x05 published mask || fail "the mask is $(published mask)"; }
rapid_start --headless --record --duration 10m --out $out/rec --config /tmp/bench/devices.toml --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
wait_for 30 test -e /dev/shm/rapid_hardware_mask.json
sample idle
threads=$(held task)
emu plug 0 1 2
wait_for 60 is 0x07 published mask || fail "the mask is $(published mask)"
emu unplug 1
emu unplug 0
emu sleep 300
emu plug 0
emu unplug 2
emu sleep 2500
emu plug 2
emu_done 30
settle
sample warm
FIRST_HALF
settle
sample half
SECOND_HALF
settle
"${rapid[@]}" mask --json >$out/mask.json
for device in cam_wrist cam_side tof; do published $device; done >$out/states
wait_for 60 is $threads held task || echo "bench: $(held task) threads instead of $threads"
sample end
rapid_stop
emu_quit
exit 0
"#;

/// The emulator's commands of one half, by time. Devices 0 and 2 start and end plugged, device 1 unplugged.
fn half(random: &mut Random, rested: Option<u64>) -> String {
    let mut actions = Vec::new();
    for device in 0..3 {
        let mut at = random.between(100, 600);
        for cycle in 0..CYCLES {
            let rests = rested == Some(cycle);
            let out_ms = if rests { 2_300 } else { random.between(60, 700) };
            let in_ms = if rests || cycle == BOUNCED { SEEN_MS } else { 0 } + random.between(100, 600);
            if device == 1 {
                actions.extend([(at + out_ms, "plug", device), (at + out_ms + in_ms, "unplug", device)]);
            } else {
                actions.extend([(at, "unplug", device), (at + out_ms, "plug", device)]);
            }
            at += out_ms + in_ms;
        }
    }
    actions.sort_unstable();
    let mut text = String::new();
    let mut now = 0;
    for (at, action, device) in actions {
        // What takes longer than planned delays all that follows and shortens no stay.
        writeln!(text, "emu sleep {}\nemu {action} {device}", at - now).expect("writing to a string cannot fail");
        now = at;
    }
    text + "emu_done 120"
}

/// The mask's edges of one device agree with what was done to it; the number of its cycles.
fn assert_true_edges(outcome: &Outcome, edges: &[Edge], device: usize, bit: u32) -> usize {
    let real = |moments: Vec<Moment>| moments.iter().map(|moment| moment.real_ns).collect::<Vec<_>>();
    let (plugs, unplugs) = (real(outcome.actions("plug", device)), real(outcome.actions("unplug", device)));
    // The emulator pulls at its end what is still plugged, after the recording.
    let stays: Vec<(u64, u64)> = plugs.iter().copied().zip(unplugs.iter().copied().chain([u64::MAX])).collect();
    let (up, down) = (rises(edges, bit), falls(edges, bit));
    let mut used = None;
    let mut quick_returns = 0;
    for (place, rise) in up.iter().enumerate() {
        let stay = stays.iter().rposition(|(plug, _)| plug <= rise).expect("a rise before any plug");
        assert!(used.is_none_or(|used| used < stay), "device {device}: bit rose twice in one stay");
        used = Some(stay);
        let Some(fall) = down.get(place) else { continue };
        assert!(
            *fall >= stays[stay].1,
            "device {device}: the bit fell {} ms before the unplug",
            ms(stays[stay].1, *fall)
        );
        // A returned device waits for the end of the cooldown. Removals that came and went unnoticed start none.
        if let Some(next) = up.get(place + 1) {
            assert!(next - fall >= COOLDOWN_NS, "device {device}: back after {} ms", ms(*next, *fall));
        }
    }
    for (place, (plug, unplug)) in stays.iter().enumerate() {
        if unplug.saturating_sub(*plug) < SEEN_NS {
            continue;
        }
        assert!(
            up.iter().any(|rise| (*plug..*unplug).contains(rise)),
            "device {device}: a stay of {} ms was not seen",
            ms(*unplug, *plug)
        );
        quick_returns += usize::from(place > 0 && plug - stays[place - 1].1 < COOLDOWN_NS);
    }
    println!(
        "device {device}: {} plugs, {} rises, {} falls, {quick_returns} quick returns that stayed",
        plugs.len(),
        up.len(),
        down.len()
    );
    assert!(quick_returns >= 2, "device {device}: the timeline has no quick return that stays");
    plugs.len()
}

/// At the end `rapid` holds as many descriptors and files as after the warm-up, and as many threads as before any device came:
/// a pool's threads end when they have been idle, which the script waits for.
///
/// Memory has no such zero: allocators keep what they had, the file's index grows with the recording. What may not be is growth
/// with every cycle, so the second half is held against the first: at most half as much again, and 256 KiB that one reading
/// differs from another. Losing 17 KiB a cycle (a buffer, a thread) would show; 5 KiB a cycle are measured, most of it the index.
fn assert_flat(outcome: &Outcome) {
    let samples = json_lines(&outcome.file("samples.jsonl"));
    samples.iter().for_each(|sample| println!("{sample}"));
    let [idle, warm, half, end] = &samples[..] else { panic!("{} samples", samples.len()) };
    assert_eq!(warm["fds"], end["fds"], "descriptors");
    assert_eq!(idle["threads"], end["threads"], "threads");
    assert_eq!(warm["files"], end["files"], "files in shared memory");
    let anonymous = |sample: &serde_json::Value| sample["anon"].as_i64().expect("KiB");
    let (first, second) = (anonymous(half) - anonymous(warm), anonymous(end) - anonymous(half));
    println!("own memory grew by {first} KiB in the first half, {second} KiB in the second");
    assert!(
        second <= first.max(0) / 2 + 256,
        "memory grew by {first} KiB in the first half, {second} KiB in the second"
    );
}

/// xorshift64*: the same timeline each time.
struct Random(u64);

impl Random {
    fn between(&mut self, low: u64, high: u64) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        low + (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) % (high - low)
    }
}
