//! An arm of six motors behind one adapter, moved by a policy that was trained on handheld demonstrations: its actions are
//! places of the tip. The tactile camera is pulled out and plugged in again while it moves, and `rapid` is killed.

use serde_json::Value;
use vbench::check::{ended, episode, only, play, rises_after, takes};
use vbench::emu::can::adapter::Protocol;
use vbench::emu::feed;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::can;
use vbench::outcome::Outcome;
use vbench::proto;
use vbench::recording::{Message, Recording, falls};
use vbench::scenario::Scenario;

use crate::policy::{CHUNKS, TACTILE, WRIST, bundle, demonstration, pictures};

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
/// The tip follows an action to which it comes so near before the next one, m.
const REACHED: f64 = 0.02;
/// So far apart, at least, are two such actions between which the tip must be seen to go, m: the policy's actions are, within
/// any few of them, and the tip comes much nearer to each.
const APART: f64 = 0.01;

const SCRIPT: &str = r#"
# all ACTION: since the last mark every motor has logged this.
all() { for motor in 1 2 3 4 5 6; do logged $1 "\"motor\":$motor" || return 1; done; }
off() { ordered disabled 1 2 3 4 5 6; }
# moving: every motor follows.
moving() { all commands_begin; }
begin() {
  rapid_start --infer /tmp/bench/bundle --arm --wait --record --out $out/$1 \
    --config /tmp/bench/devices.toml --json
}
emu plug 0 1 2
wait_for 120 attached 0 1 || fail 'not attached'
udevadm settle
"${rapid[@]}" check --config /tmp/bench/devices.toml >$out/check.txt || fail "the registry: $(cat $out/check.txt)"
begin first
await_rapid 180 '"event":"act"' || fail 'the policy does not act'
wait_for 60 moving || fail 'the arm does not move'
await_used 1 0x07
mark killed
date +%s%N >$out/killed
kill -KILL $rapid_pid
wait_for 60 off || fail 'a motor stays on'
wait $rapid_pid
# It disables them for a moment longer, and on a bus that another program commands no motors are moved.
gone() { ! pgrep -x motor-guard >/dev/null; }
wait_for 5 gone || fail 'the guard is left'
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
wait_for 30 off || fail 'a motor stays on at the end'
emu_done 2
emu_quit
exit 0
"#;

#[test]
fn a_policy_moves_an_arm_by_its_tip_without_its_tactile_camera_too() {
    if crate::lacks_virtual_time() {
        return;
    }
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
        let off = off.and_then(|line| line["real_ns"].as_u64()).unwrap_or_else(|| panic!("{name} is not disabled"));
        takes(&outcome, &format!("kill -9 to {name} off"), killed, off, 0.0..=10.0);
    }
    println!("{}", outcome.file("recover.txt"));
    let repaired: Value = serde_json::from_str(&outcome.file("inspect.json")).expect("one object");
    let whole = [&repaired["end"], &repaired["damaged_chunks"], &repaired["recovered"]["lossless"]];
    assert_eq!(whole, [&Value::from("finished"), &Value::from(0), &Value::from("true")], "{repaired}");
    assert_eq!(repaired["verdict"], "SUSPECT", "{repaired}");

    let episode = episode(&outcome);
    let edges = episode.mask_edges();
    let (unplugged, replugged) = (outcome.actions("unplug", 1)[0].real_ns, outcome.actions("plug", 1)[1].real_ns);
    let fell = only(&falls(&edges, TACTILE_BIT));
    let rose = only(&rises_after(&edges, TACTILE_BIT, fell));
    assert!((unplugged..replugged).contains(&fell) && rose > replugged, "{edges:?}");
    for bit in [0, 2] {
        assert!(falls(&edges, bit).is_empty(), "bit {bit} fell: {edges:?}");
    }
    takes(&outcome, "unplug to bit", unplugged, fell, 0.0..=2.5);
    takes(&outcome, "plug to bit", replugged, rose, 590.0..=670.0);

    assert_moved(&episode, &[(0, fell), (fell, rose), (rose, u64::MAX)]);
    // Poses are recorded for viewers, one for each sample.
    let (samples, poses) = (episode.topic(ARM).count(), episode.topic(&format!("{ARM}/pose")).count());
    assert_eq!((samples, poses), (poses, episode.topic(&format!("{ARM}/joints")).count()));
}

/// A place in the frame of the arm, m.
type Place = [f64; 3];

/// An action, and where the tip was when it was nearest to it before the next one.
struct Reached {
    action: Place,
    tip: Place,
}

/// In each of these times the policy acts, and the tip goes where its actions are.
fn assert_moved(episode: &Recording, times: &[(u64, u64)]) {
    let actions = episode.timed_rows("/action");
    assert!(episode.rows(ARM).iter().all(|row| row.len() == TIP + 8), "the pose follows the motors");
    assert!(actions.iter().all(|(_, action)| action.len() == 4), "an action is a place and an opening");
    let actions: Vec<(u64, Place)> =
        actions.iter().map(|(time, action)| (*time, [action[0], action[1], action[2]])).collect();
    let tips = tips(episode);
    for (from, to) in times {
        let acted: Vec<(u64, Place)> =
            actions.iter().filter(|(time, _)| (*from..*to).contains(time)).copied().collect();
        let reached = reached(&acted, &tips);
        let moved = follows(&reached).unwrap_or_else(|why| panic!("{why}; of {} actions", acted.len()));
        println!("{} actions: {moved}", acted.len());
    }
}

/// Where the tip was, by the topic of its pose (`foxglove.PoseInFrame`: the pose is field 3, its position field 1).
fn tips(episode: &Recording) -> Vec<(u64, Place)> {
    let topic = format!("{ARM}/pose");
    let place = |message: &Message| -> Place {
        let position = proto::bytes(proto::bytes(&message.data, 3), 1);
        [1, 2, 3].map(|field| f64::from_bits(proto::number(position, field)))
    };
    episode.topic(&topic).map(|message| (message.log_time, place(message))).collect()
}

/// Of each action but the last where the tip was nearest to it before the next one.
fn reached(actions: &[(u64, Place)], tips: &[(u64, Place)]) -> Vec<Reached> {
    let nearest = |pair: &[(u64, Place)]| {
        let action = pair[0].1;
        let then = tips.iter().filter(|(time, _)| (pair[0].0..pair[1].0).contains(time)).map(|(_, tip)| *tip);
        let tip = then.min_by(|one, other| far(*one, action).total_cmp(&far(*other, action)))?;
        Some(Reached { action, tip })
    };
    actions.windows(2).filter_map(nearest).collect()
}

/// Whether the tip goes from action to action, in words: it comes near to several, and between two that are apart it covers
/// half of the way at least. That holds for a tip that comes within a quarter of the way to both, whenever that is; one that
/// stands still near actions that differ little covers nothing.
fn follows(reached: &[Reached]) -> Result<String, String> {
    let near: Vec<&Reached> = reached.iter().filter(|one| far(one.tip, one.action) < REACHED).collect();
    let distances: Vec<f64> = reached.iter().map(|one| far(one.tip, one.action)).collect();
    let shown = format!("{} of {} reached within {REACHED} m: {distances:.3?}", near.len(), reached.len());
    if near.len() < 2 {
        return Err(format!("the tip does not follow: {shown}"));
    }
    let pairs = near.iter().enumerate().flat_map(|(at, one)| near[at + 1..].iter().map(move |other| (one, other)));
    // How far two actions are apart, and how far the tip went in that direction.
    let ways = pairs.map(|(one, other)| {
        let apart = far(one.action, other.action);
        (apart, along(way(one.tip, other.tip), way(one.action, other.action)) / apart)
    });
    let ways: Vec<(f64, f64)> = ways.filter(|(apart, _)| *apart >= APART).collect();
    let Some((apart, went)) = ways.iter().max_by(|one, other| one.0.total_cmp(&other.0)) else {
        return Err(format!("no two of the actions that are reached are {APART} m apart: {shown}"));
    };
    if !ways.iter().any(|(apart, went)| *went >= apart / 2.0) {
        return Err(format!("the tip does not go from one action to another: {ways:.3?}: {shown}"));
    }
    Ok(format!("{shown}; the tip went {went:.3} m between two that are {apart:.3} m apart"))
}

fn way(from: Place, to: Place) -> Place {
    std::array::from_fn(|axis| to[axis] - from[axis])
}

/// The scalar product.
fn along(one: Place, other: Place) -> f64 {
    one.iter().zip(&other).map(|(one, other)| one * other).sum()
}

fn far(one: Place, other: Place) -> f64 {
    let way = way(one, other);
    along(way, way).sqrt()
}

/// What is found of a tip that is at this place of each action.
fn judged(actions: &[(u64, Place)], place: fn(Place) -> Place) -> Result<String, String> {
    let tips: Vec<(u64, Place)> = actions.iter().map(|(time, action)| (time + 5, place(*action))).collect();
    follows(&reached(actions, &tips))
}

#[test]
fn a_tip_that_stands_still_does_not_follow() {
    let actions: Vec<(u64, Place)> = (0..6).map(|at| (10 * at, [0.1 + 0.006 * at as f64, 0.2, 0.3])).collect();
    assert!(judged(&actions, |action| action).is_ok());
    // Still on its way when the next action comes.
    assert!(judged(&actions, |[x, y, z]| [x - 0.006, y + 0.002, z]).is_ok());
    let still = judged(&actions, |_| [0.115, 0.2, 0.3]);
    assert!(still.as_ref().is_err_and(|why| why.contains("from one action to another")), "{still:?}");
    let repeated: Vec<(u64, Place)> = (0..6).map(|at| (10 * at, [0.1, 0.2, 0.3])).collect();
    let nowhere = judged(&repeated, |_| [0.1, 0.2, 0.3]);
    assert!(nowhere.as_ref().is_err_and(|why| why.contains("apart")), "{nowhere:?}");
    let elsewhere = judged(&actions, |[x, y, z]| [x, y + 0.1, z]);
    assert!(elsewhere.as_ref().is_err_and(|why| why.contains("0 of 5")), "{elsewhere:?}");
}

fn between<'a>(outcome: &'a Outcome, from: &str, to: &str) -> &'a [Value] {
    let place = |word: &str| outcome.emu.iter().position(|line| line["action"] == "say" && line["word"] == word);
    let (from, to) = (place(from).expect("a mark"), place(to).expect("a mark"));
    &outcome.emu[from..to]
}

/// The rig: the cameras of the task, and the arm. Every limit of time is the product's own.
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
        "protocol = \"damiao\"\nmotors = [\n{}\n]\n[device.arm.effector]\nurdf = \"arm.urdf\"\ntip = \"tool\"\n\
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
        .script(&[CHUNKS, SCRIPT].concat());
    bundle(scenario, |policy| {
        for observation in policy["observations"].as_array_mut().expect("observations") {
            if observation["modality"] == "arm" {
                observation["slice"] = vec![TIP, TIP + 4].into();
            }
        }
    })
}
