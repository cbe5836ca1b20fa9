//! An arm of six motors behind one adapter, moved by a policy that was trained on demonstrations by hand: its actions are
//! places of the tip. The tactile camera is pulled out and plugged in again while it moves, and `rapid` is killed.

use serde_json::Value;
use vbench::check::{ended, episode, ms, only, play, rises_after};
use vbench::emu::can::adapter::Protocol;
use vbench::emu::feed;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::can;
use vbench::outcome::Outcome;
use vbench::recording::{Recording, falls};
use vbench::scenario::Scenario;

use crate::policy::{
    ACTION_STEPS, CHUNKS, CONTROL_HZ, OLDEST_OBSERVATION_MS, TACTILE, WRIST, bundle, demonstration, pictures,
};

const CAMERAS: &str = include_str!("../../../../src/registry/task_cameras.toml");
/// The arm of the unit tests, beside its table: straight up it has no way anywhere, so that its motors' zeros are a pose with
/// the tool downwards.
const URDF: &str = include_str!("../../../arm/arm.urdf");
const ZEROS: [(&str, &str); 4] = [
    ("<origin xyz=\"-0.2 0 0\" rpy=\"0 0 0\"/>", "<origin xyz=\"-0.2 -0.9 0\" rpy=\"0 0 1.5707963267948966\"/>"),
    ("<child link=\"upper\"/>", "<child link=\"upper\"/><origin xyz=\"0 0 0\" rpy=\"0 0.8 0\"/>"),
    ("<origin xyz=\"0 0 0.75\" rpy=\"0 0 0\"/>", "<origin xyz=\"0 0 0.85\" rpy=\"0 1.2 0\"/>"),
    ("<origin xyz=\"0 0 0.65\" rpy=\"0 0 0\"/>", "<origin xyz=\"0 0 0.75\" rpy=\"0 1.1415926535897932 0\"/>"),
];
const ARM: &str = "/rapid/can/arm";
const MOTORS: [&str; 6] = ["waist", "lift", "elbow", "pitch", "roll", "jaw"];
/// Numbers of a motor, and of all of them.
const OF_A_MOTOR: usize = 6;
const TIP: usize = OF_A_MOTOR * MOTORS.len();
const TACTILE_BIT: u32 = 1;
const DENOISING_STEPS: &str = "2";

const SCRIPT: &str = r#"
# all ACTION: since the last mark every motor has logged this.
all() { for motor in 1 2 3 4 5 6; do logged $1 "\"motor\":$motor" || return 1; done; }
# moving: every motor follows. Motors that an emulated processor answered too late are armed again, as a user would; not for ever.
moving() {
  all commands_begin && return
  if [[ $(grep -F '"event":"actuator"' $out/rapid.jsonl | tail -n 1) == *'"arming":"faulted"'* ]]; then
    [ "$(wc -l <$out/armed)" -ge 8 ] || { echo again >>$out/armed; "${rapid[@]}" arm; }
  fi
  sleep 2
  return 1
}
begin() {
  rapid_start --infer /tmp/bench/bundle --arm --wait --denoising-steps $(cat /tmp/bench/steps) --record --out $out/$1 \
    --config /tmp/bench/devices.toml --json
}
touch $out/armed
emu plug 0 1 2
wait_for 120 attached 0 1 || fail 'not attached'
udevadm settle
"${rapid[@]}" check --config /tmp/bench/devices.toml >$out/check.txt || fail "the registry: $(cat $out/check.txt)"
begin first
await_rapid 180 '"event":"act"' || fail 'the policy does not act'
wait_for 60 moving || fail 'the arm does not move'
await_used 1 0x07
mark killed
awk '{ printf "%.0f\n", $1 * 1e9 }' /proc/uptime >$out/killed
kill -KILL $rapid_pid
wait_for 60 all motor_disabled || fail 'a motor stays on'
wait $rapid_pid
"${rapid[@]}" recover $out/first >$out/recover.txt 2>&1 || fail "not repaired: $(cat $out/recover.txt)"
"${rapid[@]}" inspect --json $out/first/*.mcap >$out/inspect.json
mark again
begin rec
await_rapid 180 '"event":"act"' || fail 'the policy does not act again'
wait_for 60 moving || fail 'the arm does not move again'
await_used 2 0x07
emu unplug 1
await_used 2 0x05
seen=$(used 0x07)
emu plug 1
await_used $((seen + 2)) 0x07
mark end
rapid_stop
wait_for 30 all motor_disabled || fail 'a motor stays on at the end'
emu_done 2
emu_quit
exit 0
"#;

#[test]
fn a_policy_moves_an_arm_by_its_tip_without_its_tactile_camera_too() {
    let demonstration = demonstration();
    let outcome = play(scenario(&demonstration));
    ended(&outcome);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());

    // Killed: every motor is off before its own time limit, and the episode is whole after its repair.
    let killed = outcome.file("killed").trim().parse::<u64>().expect("a time");
    let lines = between(&outcome, "killed", "again");
    assert!(lines.iter().all(|line| line["action"] != "motor_timeout"), "a motor timed out by itself");
    for (motor, name) in (1_u64..).zip(MOTORS) {
        let off = lines.iter().find(|line| line["action"] == "motor_disabled" && line["motor"] == motor);
        let off = off.and_then(|line| line["mono_ns"].as_u64()).unwrap_or_else(|| panic!("{name} is not disabled"));
        println!("{name}: off {} ms after the kill", ms(off, killed));
    }
    println!("{}armed again: {} times", outcome.file("recover.txt"), outcome.file("armed").lines().count());
    let repaired: Value = serde_json::from_str(&outcome.file("inspect.json")).expect("one object");
    assert_eq!((&repaired["verdict"], &repaired["end"]), (&"SUSPECT".into(), &"finished".into()), "{repaired}");

    let episode = episode(&outcome);
    let edges = episode.mask_edges();
    let (unplugged, replugged) = (outcome.actions("unplug", 1)[0].real_ns, outcome.actions("plug", 1)[1].real_ns);
    let fell = only(&falls(&edges, TACTILE_BIT));
    let rose = only(&rises_after(&edges, TACTILE_BIT, fell));
    assert!((unplugged..replugged).contains(&fell) && rose > replugged, "{edges:?}");
    for bit in [0, 2] {
        assert!(falls(&edges, bit).is_empty(), "bit {bit} fell: {edges:?}");
    }
    println!("bit cleared {} ms after the unplug, set {} ms after the plug", ms(fell, unplugged), ms(rose, replugged));

    assert_moved(&episode, &[(0, fell), (fell, rose), (rose, u64::MAX)]);
    // Poses are recorded for viewers, one for each sample.
    let (samples, poses) = (episode.topic(ARM).count(), episode.topic(&format!("{ARM}/pose")).count());
    assert_eq!((samples, poses), (poses, episode.topic(&format!("{ARM}/joints")).count()));
}

/// In each of these times the policy acts and the tip follows its actions.
fn assert_moved(episode: &Recording, times: &[(u64, u64)]) {
    let actions: Vec<(u64, Vec<f64>)> = episode.timed_rows("/action");
    let tips: Vec<(u64, Vec<f64>)> = episode.timed_rows(ARM);
    assert!(tips.iter().all(|(_, row)| row.len() == TIP + 8), "the pose follows the motors");
    assert!(actions.iter().all(|(_, action)| action.len() == 4), "an action is a place and an opening");
    for (from, to) in times {
        let of = |rows: &[(u64, Vec<f64>)]| -> Vec<(u64, Vec<f64>)> {
            rows.iter().filter(|(time, _)| (*from..*to).contains(time)).cloned().collect()
        };
        let (actions, tips) = (of(&actions), of(&tips));
        let far = |one: &[f64], other: &[f64]| {
            one.iter().zip(other).take(3).map(|(one, other)| (one - other).powi(2)).sum::<f64>().sqrt()
        };
        // How near the tip came to each action before the next one.
        let reached: Vec<f64> = actions
            .windows(2)
            .filter_map(|pair| {
                let before = tips.iter().filter(|(time, _)| (pair[0].0..pair[1].0).contains(time));
                before.map(|(_, row)| far(&row[TIP..], &pair[0].1)).min_by(f64::total_cmp)
            })
            .collect();
        let near = reached.iter().filter(|distance| **distance < 0.02).count();
        println!("{} actions, {near} of {} reached within 2 cm: {reached:.3?}", actions.len(), reached.len());
        assert!(near >= 2, "the tip does not follow: {reached:?}");
    }
}

fn between<'a>(outcome: &'a Outcome, from: &str, to: &str) -> &'a [Value] {
    let place = |word: &str| outcome.emu.iter().position(|line| line["action"] == "say" && line["word"] == word);
    let (from, to) = (place(from).expect("a mark"), place(to).expect("a mark"));
    &outcome.emu[from..to]
}

/// The rig: the cameras of the task, and the arm. An emulated processor is late now and then: time limits are wide.
fn registry() -> String {
    let motor = |(at, name): (usize, &&str)| {
        let (slave, master) = (at + 1, at + 0x11);
        format!(
            "{{ name = \"{name}\", slave = {slave}, master = {master}, type = \"DM4310\", mode = \"position\", \
             position = [-2.4, 2.4], slew = 2.0, first_target = 3, other_fault = \"limp\" }}"
        )
    };
    let motors: Vec<_> = MOTORS.iter().enumerate().map(motor).collect();
    let bus = format!(
        "protocol = \"damiao\"\nhz = 50\ndeadman = \"10s\"\ndisable_after = \"never\"\ntimeout = \"6s\"\n\
         silent_after = \"3s\"\nmotors = [\n{}\n]\n[device.arm.effector]\nurdf = \"arm.urdf\"\ntip = \"tool\"\n\
         rotation = [0, 1, 0, 0]\nyaw = \"free\"\ngripper = \"jaw\"\nclosed = 0.0\nopen = 1.2\n\
         min = [-1.1, -1.0, 0.03]\nmax = [1.0, 1.0, 0.9]",
        motors.join(",\n")
    );
    let rig = "[rig]\nname = \"arm\"\nobservation_hz = 10\nsync_window = \"50ms\"\n";
    [rig, &can("arm", ARM, 2, "1d50:606f", "CAN1", &bus), CAMERAS].concat()
}

fn scenario(demonstration: &Recording) -> Scenario {
    let camera = |pid, serial| DeviceSpec::uvc(0x1209, pid).serial(serial).mode(Format::Mjpg, 96, 96, &[10]);
    let adapter = DeviceSpec::can(Protocol::GsUsb).serial("CAN1");
    let adapter =
        (1_u16..).zip(MOTORS).fold(adapter, |adapter, (slave, _)| adapter.motor(slave, slave + 0x10, "DM4310"));
    let urdf = ZEROS.iter().fold(URDF.to_owned(), |text, (from, to)| {
        assert!(text.contains(from), "{from}");
        text.replacen(from, to, 1)
    });
    let scenario = Scenario::new("arm")
        .device(camera(0x7a01, "WRIST").feed("/tmp/bench/wrist"))
        .device(camera(0x7a02, "TACTILE").feed("/tmp/bench/tactile"))
        .device(adapter)
        .registry(&registry())
        .file("arm.urdf", urdf)
        .file("wrist", feed::pack(pictures(demonstration, WRIST)))
        .file("tactile", feed::pack(pictures(demonstration, TACTILE)))
        .file("steps", DENOISING_STEPS)
        .script(&[CHUNKS, SCRIPT].concat());
    bundle(scenario, |policy| {
        policy["control_hz"] = CONTROL_HZ.into();
        policy["n_action_steps"] = ACTION_STEPS.into();
        policy["max_observation_age_ms"] = OLDEST_OBSERVATION_MS.into();
        for observation in policy["observations"].as_array_mut().expect("observations") {
            if observation["modality"] == "arm" {
                observation["slice"] = vec![TIP, TIP + 4].into();
            }
        }
    })
}
