//! The registry against files: each in `registry/invalid` is refused with exactly the text beside
//! it (`NAME.expected`), each in `registry/valid` is accepted; and no text at all makes it panic.

#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::interlock::StopKind;
use rapid_core::modality::ModalityKind;
use rapid_core::points::PacketFormat;
use rapid_registry::scenario::Scenario;
use rapid_registry::system_files::{SystemFileKind, system_files};
use rapid_registry::{
    BUILTIN, Bound, BrakeSpec, CanAdapter, CanProtocol, DeviceSpec, Form, Framing, Hook, InputSpec, JointsSpec,
    LanFind, LanPicture, LanProtocol, LineOff, Loaded, ModuleSpec, MotionSpec, MotorKind, MotorMode, Mounting,
    NodeSpec, Opens, POOL_SPARE, Parse, PhoneStream, PointsSpec, PoseLayout, PoseSpec, Probe, Quantity, Registry, Stop,
    StopSpec, VerdictSpec, WatchSpec,
};

use crate::support::mistakes;
use proptest::prelude::*;

fn files(folder: &str) -> Vec<PathBuf> {
    mistakes::files(&format!("registry/{folder}"), "toml")
}

fn valid(name: &str) -> Loaded {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/registry/valid/{name}.toml"));
    Registry::parse(&mistakes::read(&path), None).unwrap()
}

#[test]
fn every_mistake_is_reported_in_full() {
    mistakes::check("registry/invalid", "toml", 322, |text| {
        let errors = Registry::parse(text, Some(Path::new("devices.toml"))).err()?;
        Some((errors.to_string(), errors.diagnostics))
    });
}

#[test]
fn a_motor_may_report_its_limits_as_far_as_it_counts() {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/registry/invalid/motor_zero_puts_limits_out_of_reach.toml");
    let text = mistakes::read(&path);
    for (was, is) in [
        ("zero = 12", "zero = 11.5"),
        // Its limits are from 10 to 13 rad of the motor in one direction, and from 11 to 14 rad in the other.
        ("position = [-1, 2]", "position = [-0.5, 2]"),
        // A motor that was set to count farther.
        ("position = [-1, 2]", "position = [-20, 20]"),
    ] {
        let text = text.replace(was, is);
        assert!(Registry::parse(&text, None).is_ok(), "{text}");
    }
    assert!(Registry::parse(&text.replace("reversed = true", "reversed = false"), None).is_err());
}

#[test]
fn motors_that_keep_moving_long_after_a_kill_cause_a_warning() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/registry/valid/can.toml");
    let text = mistakes::read(&path);
    for (timeout, is_warned) in [("200ms", false), ("500ms", false), ("501ms", true), ("10s", true)] {
        let text = text.replace("timeout = \"200ms\"", &format!("timeout = \"{timeout}\""));
        let warnings = Registry::parse(&text, None).unwrap().warnings;
        let is_of_it = |warning: &rapid_registry::Diagnostic| {
            warning.message.starts_with(&format!("timeout = {timeout}: ")) && warning.to_string().contains("500ms")
        };
        assert_eq!(warnings.iter().any(is_of_it), is_warned, "{timeout}: {warnings:?}");
    }
}

#[test]
fn valid_registries_are_accepted() {
    for path in files("valid") {
        let text = std::fs::read_to_string(&path).unwrap();
        let loaded = Registry::parse(&text, Some(&path)).unwrap_or_else(|errors| panic!("{errors}"));
        let devices = &loaded.registry.devices;
        assert!(devices.is_sorted_by_key(|device| device.id), "{}", path.display());
        assert_eq!(devices.iter().map(|device| device.id).collect::<BTreeSet<_>>().len(), devices.len());
        assert_eq!(loaded.registry.path.as_deref(), Some(path.as_path()));
        assert_eq!(loaded.registry.text, text);
    }
}

#[test]
fn defaults_match_the_documentation() {
    let Loaded { registry, warnings } = valid("minimal");
    let device = &registry.devices[0];
    assert_eq!((device.topic.as_str(), device.depth, device.max_bytes), ("/rapid/camera/cam", 60, 640 * 480 * 2));
    assert_eq!(device.stall_after.as_millis(), 500);
    assert_eq!(device.verdict, VerdictSpec::defaults(ModalityKind::Image, device.stall_after, Some(30.0)));
    assert_eq!((registry.rig.name.as_str(), registry.rig.observation_hz), ("rig", 30.0));
    assert_eq!(registry.rig.sync_window.as_millis(), 25);
    assert_eq!((registry.rig.cooldown.as_secs(), registry.rig.memory_budget), (2, 512 << 20));
    assert_eq!(
        warnings[0].to_string(),
        "devices.toml:1:9: [device.cam] no bit given, it gets bit 0: another entry above it would move it\n    \
         fix: pin it with bit = 0; a policy is trained on bit positions"
    );
}

#[test]
fn the_columns_of_an_export_are_parsed_and_its_numbers_have_names() {
    let Loaded { registry, warnings } = valid("export");
    assert_eq!(warnings, []);
    assert_eq!(registry.export.state, ["arm.position", "tracker", "counter"]);
    assert_eq!(registry.export.action, ["/action.x", "arm.1-1"]);
    let names = |registry: &Registry, at: usize| registry.devices[at].form.as_ref().map(Form::names);
    let wanted = |names: &[&str]| Some(names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>());
    assert_eq!(names(&registry, 0), wanted(&["hip.position", "hip.velocity", "knee.position", "knee.velocity"]));
    assert_eq!(names(&registry, 1), wanted(&["x", "y", "z", "qx", "qy", "qz", "qw"]));
    let none = valid("minimal").registry;
    assert_eq!((none.export.state.len(), none.export.action.len(), names(&none, 0)), (0, 0, None));
    // In every registry as many names as numbers, none twice.
    for path in files("valid") {
        let loaded = Registry::parse(&mistakes::read(&path), Some(&path)).unwrap();
        for form in loaded.registry.devices.iter().filter_map(|device| device.form.as_ref()) {
            let names = form.names();
            assert_eq!(names.len(), form.numbers(), "{}", path.display());
            assert_eq!(names.iter().collect::<BTreeSet<_>>().len(), names.len(), "{names:?}");
        }
    }
}

#[test]
fn the_old_name_of_the_table_of_a_serial_line_causes_a_warning() {
    let (present, old) = (valid("tty"), valid("old_serial_table"));
    assert_eq!((present.warnings.as_slice(), &present.registry.devices), (&[][..], &old.registry.devices));
    let [warning] = old.warnings.as_slice() else { panic!("one warning: {:?}", old.warnings) };
    assert_eq!(
        warning.to_string(),
        "devices.toml:8:1: [device.tof] [device.tof.serial] is now called [device.tof.tty]; the old name is accepted \
         until the next release\n    fix: write [device.tof.tty]; `rapid register` renames it when it next writes this file"
    );
}

#[test]
fn modules_are_parsed_and_mounted_by_name() {
    let modules = valid("modules").registry.modules;
    let [get, soft, pinch, angled] = modules.as_slice() else { panic!("four modules") };
    assert_eq!((get.mount.to_string().as_str(), get.devices.as_slice()), ("tip", &["tactile_tip".to_owned()][..]));
    assert_eq!(soft.tags[1], ("material".to_owned(), "tpu".to_owned()));
    assert_eq!((pinch.devices.len(), pinch.tags.len()), (0, 0));
    let place =
        |module: &ModuleSpec| module.transforms.first().map(|place| (place.sensor.clone(), place.parent.clone()));
    let names = |sensor: &str, parent: &str| Some((sensor.to_owned(), parent.to_owned()));
    assert_eq!([place(get), place(angled)], [names("tactile_tip", "gripper"), names("cam_wrist", "flange")]);
    let length: f64 = angled.transforms[0].rotation.iter().map(|part| part * part).sum();
    assert!((length - 1.0).abs() < 1e-12, "of calibrations, which are rounded");
    let mounted = |names: &[&str]| {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        rapid_registry::mounted(&modules, &names).map(|found| found.len()).map_err(|error| error.to_string())
    };
    assert_eq!(mounted(&["soft_tip", "pinch", "pinch"]), Ok(2));
    assert!(mounted(&["soft_tpi"]).unwrap_err().contains("did you mean \"soft_tip\"?"));
    assert!(mounted(&["soft_tip", "get"]).unwrap_err().contains("both sit in the slot tip"));
}

#[test]
fn a_program_and_its_settings_are_parsed() {
    let Loaded { registry, warnings } = valid("process");
    assert_eq!(warnings, []);
    let [_, counter, leds, digit] = registry.devices.as_slice() else { panic!("four devices") };
    let NodeSpec::Process(process) = &counter.node else { panic!("a program") };
    assert_eq!((process.program.to_str(), process.args.join(" ")), (Some("/bin/sh"), "-c exec publisher".to_owned()));
    assert_eq!((process.opens, process.kind, process.shape.as_slice()), (Opens::Tty, ModalityKind::Scalars, &[3][..]));
    assert_eq!((counter.topic.as_str(), counter.max_bytes, counter.depth), ("/rapid/process/counter", 24, 2048));
    assert_eq!((counter.stall_after.as_millis(), leds.stall_after.as_millis()), (500, 2000), "the heartbeat");
    let NodeSpec::Process(process) = &leds.node else { panic!("a program") };
    assert_eq!((process.opens, process.kind, process.shape.as_slice()), (Opens::Usb, ModalityKind::Bytes, &[][..]));
    assert_eq!((leds.max_bytes, leds.depth, leds.modality().shape), (64 << 10, 60, vec![]));
    assert_eq!(digit.modality().shape, [240, 320]);
    assert_eq!((digit.max_bytes, digit.depth), (320 * 240 * 2, 60));
}

#[test]
fn hooks_are_parsed_and_one_of_them_may_be_the_node() {
    let Loaded { registry, warnings } = valid("hooks");
    assert_eq!(warnings, []);
    let [cam, imu] = registry.devices.as_slice() else { panic!("two devices") };
    let printed = |device: &DeviceSpec| -> Vec<(&str, String)> {
        let text = |hook: &Hook| format!("{} {:?}", hook.program.display(), hook.args);
        device.hooks.all().map(|(key, hook)| (key, text(hook))).collect()
    };
    let of_cam = [
        ("on_attach", r#"/bin/sh ["-c", "exit"]"#.to_owned()),
        ("on_detach", "/bin/sh []".to_owned()),
        ("on_record_start", r#"/bin/sh ["", "a b"]"#.to_owned()),
        ("on_record_stop", r#"/bin/sh ["$HOME; no shell reads this"]"#.to_owned()),
    ];
    assert_eq!(printed(cam), of_cam);
    assert_eq!(printed(imu), [("on_detach", "/bin/sh []".to_owned())]);
    let NodeSpec::Process(process) = &imu.node else { panic!("a program") };
    assert_eq!((process.program.to_str(), process.args.join(" ")), (Some("/bin/sh"), "-c exit".to_owned()));
}

#[test]
fn devices_on_the_network_are_parsed() {
    let Loaded { registry, warnings } = valid("lan");
    assert_eq!(warnings, []);
    let lan = |name: &str| match &registry.named(name).unwrap().node {
        NodeSpec::Lan(lan) => lan.clone(),
        node => panic!("{node:?}"),
    };
    let picture = |width, height, fps| LanPicture { width, height, fps };
    let host = |text: &str| text.parse().unwrap();
    let fixed = |text: &str, probe, port| LanFind::Host { host: host(text), probe, port };
    assert_eq!(lan("cam_lan").find, fixed("192.168.1.7", Probe::Tcp, 8081));
    let path = "/video?size=1".to_owned();
    let protocol = LanProtocol::Mjpeg { port: Some(8081), path, picture: picture(1280, 720, 25) };
    assert_eq!(lan("cam_lan").protocol, protocol);
    assert_eq!(lan("lidar").find, fixed("192.168.1.201", Probe::Udp, 2368));
    assert_eq!((lan("lidar").lease.as_secs(), lan("gopro").lease.as_secs()), (1, 3));
    assert_eq!(lan("lidar_asked").find, fixed("fd00::7", Probe::Http, 80));
    assert_eq!(
        lan("gopro").protocol,
        LanProtocol::Gopro { port: 8080, download: true, reserve: Some(3 << 30), preview: None }
    );
    assert_eq!(lan("gopro").find, LanFind::Adapter { host: None });
    assert_eq!(lan("cam_behind_adapter").find, LanFind::Adapter { host: Some(host("10.0.0.2")) });
    let instance = Some("iPhone 15-iPhoneVIO".to_owned());
    assert_eq!(lan("phone").find, LanFind::Mdns { service: "_iphonevio._tcp".to_owned(), instance });
    let protocol = LanProtocol::Iphone { port: 5556, stream: PhoneStream::Pose, picture: picture(1920, 1440, 30) };
    assert_eq!(lan("phone_pose").protocol, protocol);
    let cam_far = lan("cam_far");
    assert_eq!(cam_far.request().as_deref(), Some("rapid-remote-1 robot-b cam_wrist\n"));
    assert_eq!((cam_far.find, cam_far.lease.as_millis()), (fixed("127.0.0.1", Probe::Remote, 7448), 1000));
    assert_eq!(lan("state_far").request().as_deref(), Some("rapid-remote-1 robot-b state_far\n"));
    assert_eq!(lan("state_far").find, fixed("127.0.0.1", Probe::Remote, 7449));
    let far = |name: &str| registry.named(name).unwrap().clone();
    assert_eq!((far("cam_far").modality().shape, far("cam_far").max_bytes), (vec![240, 320], 2 * 320 * 240));
    assert_eq!((far("state_far").modality().shape, far("state_far").max_bytes), (vec![7], 56));
    assert_eq!((far("scan_far").modality().kind, far("scan_far").depth), (ModalityKind::Bytes, 60));
    assert_eq!(far("depth_far").modality().kind, ModalityKind::Depth);
    // Half of the usual window.
    let limits = |name: &str| (far(name).verdict.suspect.uncertain, far(name).verdict.bad.uncertain);
    assert_eq!(limits("cam_far"), (Some(Duration::from_micros(12_500)), None));
    assert_eq!(limits("scan_far"), (Some(Duration::from_millis(30)), Some(Duration::from_secs(1))));
    assert_eq!([limits("phone"), limits("phone_pose")], [(Some(Duration::from_micros(12_500)), None); 2]);
    assert_eq!(limits("lidar"), (None, None));
    let modality = |name: &str| registry.named(name).unwrap().modality();
    assert_eq!((modality("phone").kind, modality("phone").shape), (ModalityKind::Image, vec![1440, 1920]));
    assert_eq!((modality("phone_pose").kind, modality("phone_pose").shape), (ModalityKind::Scalars, vec![16]));
    assert_eq!((modality("lidar").kind, modality("gopro").kind), (ModalityKind::Bytes, ModalityKind::Bytes));
    let stall = |name: &str| registry.named(name).unwrap().stall_after.as_millis();
    assert_eq!((stall("cam_lan"), stall("lidar"), stall("gopro")), (500, 500, 10_000));
}

#[test]
fn every_key_is_parsed() {
    let Loaded { registry, warnings } = valid("every_key");
    assert_eq!(warnings[0].message, "port has no effect beside a serial number: the unit is recognised in every port");
    let [tof, cam] = registry.devices.as_slice() else { panic!("two devices") };
    assert_eq!((cam.id.bit(), cam.topic.as_str(), cam.depth, cam.max_bytes), (63, "/a/b-c_d", 100, 1 << 20));
    assert_eq!((cam.latency.as_micros(), tof.latency.as_micros()), (36_500, 0));
    assert_eq!(cam.identity.serial(), Some("with \"quotes\" and spaces"));
    assert_eq!(cam.identity.usb().unwrap().port.as_deref(), Some("1-2.3"));
    let NodeSpec::Camera(camera) = &cam.node else { panic!("a camera") };
    assert_eq!((camera.width, camera.height, camera.fps), (1, 2, 1000));
    assert_eq!(camera.controls, [("gain".to_owned(), -3)]);
    let NodeSpec::Serial(serial) = &tof.node else { panic!("a serial line") };
    assert_eq!((serial.baud, serial.framing, serial.parse, serial.channels), (9600, Framing::Cobs, Parse::Raw, 0));
    assert_eq!((tof.max_bytes, tof.depth), (4096, 2048));
    assert_eq!(registry.rig.sync_window.as_micros(), 12_500);
}

#[test]
fn what_numbers_mean_is_written_or_follows_from_the_device() {
    use Quantity::{Effort, Other, Position, Velocity};
    let Loaded { registry, warnings } = valid("forms");
    assert_eq!(warnings, []);
    let form = |name: &str| registry.named(name).unwrap().form.clone().unwrap();
    let pose = |layout, parent: &str| Form::Pose(PoseSpec { layout, parent: parent.to_owned() });
    assert_eq!(form("tracker"), pose(PoseLayout::Quaternion, "world"));
    assert_eq!(form("phone"), pose(PoseLayout::Columns, "arkit"));
    assert_eq!(form("marker"), pose(PoseLayout::Rows, "camera"));
    let joints = |names: &[&str], quantities: &[Quantity]| {
        let names = names.iter().map(|name| (*name).to_owned()).collect();
        Form::Joints(JointsSpec { names, quantities: quantities.to_vec(), tip: None })
    };
    assert_eq!(form("fingers"), joints(&["left", "right"], &[Position, Other, Effort]));
    assert_eq!(form("encoder"), joints(&["gripper"], &[Position]));
    let points = |format, frame: &str| Form::Points(PointsSpec { format, frame: frame.to_owned() });
    assert_eq!(form("lidar"), points(PacketFormat::Velodyne, "lidar"));
    assert_eq!(form("scanner"), points(PacketFormat::Livox, "base"));
    let Form::Calibration(camera) = form("cam") else { panic!("a calibration") };
    assert_eq!((camera.width, camera.height, camera.model.as_str()), (640, 480, "rational_polynomial"));
    assert_eq!((camera.distortion.len(), camera.intrinsics[0], camera.intrinsics[5]), (8, 600.5, 240.0));
    let Loaded { registry, .. } = valid("can");
    let motors = registry.devices.iter().find_map(|device| device.form.clone());
    let Some(Form::Joints(JointsSpec { names, quantities, tip: None })) = motors else {
        panic!("motors are joints: {motors:?}")
    };
    assert_eq!((names.len(), quantities), (4, vec![Position, Velocity, Effort, Other, Other, Other]));
    let Loaded { registry, .. } = valid("lan");
    assert_eq!(registry.named("phone_pose").unwrap().form, Some(pose(PoseLayout::Columns, "world")));
    assert_eq!(registry.named("phone").unwrap().form, None, "pictures");
}

#[test]
fn the_actions_of_an_arm_are_poses_of_its_tip() {
    let Loaded { registry, warnings } = valid("effector");
    assert_eq!(warnings, []);
    let arm = registry.named("arm").expect("an arm");
    let action = arm.action.as_ref().expect("actions");
    assert_eq!(action.names, ["x", "y", "z", "qx", "qy", "qz", "qw", "grip"]);
    assert_eq!(action.units, ["m", "m", "m", "1", "1", "1", "1", "1"]);
    assert_eq!(action.min, [-1.0, -1.0, 0.0, -1.0, -1.0, -1.0, -1.0, 0.0]);
    assert_eq!(action.max, [1.0; 8]);
    // Six numbers of each of the six motors, and the pose with the opening.
    assert_eq!((arm.modality().kind, arm.modality().shape), (ModalityKind::Scalars, vec![44]));
    let Some(Form::Joints(JointsSpec { names, tip: Some(tip), .. })) = &arm.form else { panic!("{:?}", arm.form) };
    assert_eq!((names.len(), tip.parent.as_str(), tip.has_opening), (6, "base", true));
}

#[test]
fn the_streams_of_a_camera_are_entries_of_their_own() {
    let Loaded { registry, warnings } = valid("streams");
    assert_eq!(warnings, []);
    let entry = |name: &str| registry.named(name).unwrap();
    let (colour, depth, infrared) = (entry("d435"), entry("d435_depth"), entry("d435_infrared"));
    assert_eq!([colour, depth, infrared].map(|device| device.id.bit()), [0, 1, 2]);
    assert_eq!(depth.topic, "/rapid/camera/d435/depth");
    assert_eq!(infrared.topic, "/infrared");
    assert_eq!((depth.modality().kind, depth.modality().shape), (ModalityKind::Depth, vec![480, 848]));
    assert_eq!(infrared.modality().kind, ModalityKind::Image);
    assert_eq!(depth.max_bytes, 2 * 848 * 480);
    let NodeSpec::Camera(camera) = &depth.node else { panic!("a camera") };
    assert_eq!(camera.depth_unit_um, 100);
    assert!([colour, depth, infrared].iter().all(|device| registry.shares_unit(device)));
    assert!(depth.identity == colour.identity && entry("other_depth").identity == entry("other").identity);
    assert!(depth.identity != entry("other_depth").identity);
}

#[test]
fn a_bus_and_its_motors_are_parsed() {
    let Loaded { registry, warnings } = valid("can");
    assert_eq!(warnings, []);
    let [bus, line, hand] = registry.devices.as_slice() else { panic!("three devices") };
    let [raw, slcan, motors] = [bus, line, hand].map(|device| {
        let NodeSpec::Can(can) = &device.node else { panic!("a CAN adapter") };
        can
    });
    assert_eq!((raw.adapter, raw.bitrate, &raw.protocol), (CanAdapter::SocketCan, 1_000_000, &CanProtocol::Raw));
    assert_eq!((slcan.adapter, slcan.bitrate, &slcan.protocol), (CanAdapter::Slcan, 250_000, &CanProtocol::Raw));
    assert_eq!((bus.modality().kind, bus.modality().shape, bus.max_bytes), (ModalityKind::Bytes, vec![], 128 * 24));
    assert_eq!((bus.topic.as_str(), bus.action.as_ref()), ("/rapid/can/bus", None));

    assert_eq!((hand.modality().kind, hand.modality().shape, hand.max_bytes), (ModalityKind::Scalars, vec![24], 192));
    let CanProtocol::Damiao(damiao) = &motors.protocol else { panic!("motors") };
    let ms = std::time::Duration::from_millis;
    assert_eq!((damiao.hz, damiao.deadman), (500, Some(ms(80))));
    assert_eq!((damiao.disable_after, damiao.timeout, damiao.silent_after), (Some(ms(2000)), ms(200), ms(20)));
    let [gripper, roll, wheel, thumb] = damiao.motors.as_slice() else { panic!("four motors") };
    assert_eq!((gripper.slave, gripper.master, gripper.kind), (5, 0x15, MotorKind::Dmh3510));
    assert_eq!((gripper.mode, gripper.position), (MotorMode::Mit { kp: 0.8, kd: 0.05 }, [-1.5, 0.25]));
    // What is not written is a tenth of the motor's torque, and slow.
    assert_eq!((gripper.velocity, gripper.torque, gripper.slew), (2.0, 0.1, 2.0));
    assert_eq!([gripper, wheel, thumb].map(|motor| motor.mounting), [Mounting::default(); 3]);
    assert_eq!((roll.mounting, roll.position), (Mounting { zero: -0.75, reversed: true }, [-3.0, 3.0]));
    assert_eq!((gripper.max_mos, gripper.max_rotor), (80.0, 80.0));
    assert_eq!((roll.slave, roll.master, roll.mode), (6, 0, MotorMode::PositionVelocity));
    assert_eq!((roll.velocity, roll.slew, thumb.torque), (10.0, 4.0, 3.0));
    assert_eq!((roll.max_mos, roll.max_rotor), (70.0, 90.0));
    assert_eq!((wheel.master, wheel.mode, wheel.slew), (0x7fe, MotorMode::Velocity, 20.0));
    assert_eq!((gripper.watch, gripper.stop), (WatchSpec::default(), StopSpec::default()));
    // Its frames have none for damping.
    let undamped = StopSpec { other_fault: Stop::Hold, ..StopSpec::default() };
    assert_eq!((roll.watch, roll.stop), (WatchSpec { lag: 0.5, ..WatchSpec::default() }, undamped));
    assert_eq!((&roll.brake, &wheel.brake), (&None, &None));
    let brake = BrakeSpec {
        chip: "/dev/gpiochip1".into(),
        line: 3,
        released_high: false,
        engages_in: ms(30),
        releases_in: ms(100),
    };
    assert_eq!(thumb.brake, Some(brake));
    let kept =
        StopSpec { own_fault: Stop::Hold, other_fault: Stop::Limp, emergency: Stop::Damp, hold_for: Some(ms(5000)) };
    assert_eq!((thumb.watch.margin, thumb.watch.blocked_after, thumb.stop), (0.05, None, kept));
    let started = MotionSpec { acceleration: 8.0, soft_start: ms(250), first_target: 0.2 };
    assert_eq!((roll.motion, thumb.motion), (MotionSpec::of_slew(4.0), started));
    let axes = hand.action.as_ref().unwrap();
    assert_eq!(
        (axes.names.join(" "), axes.units.join(" ")),
        ("gripper wrist.roll wheel thumb".into(), "rad rad rad/s rad".into())
    );
    assert_eq!((axes.min.as_slice(), axes.max.as_slice()), (&[-1.5, -3.0, -2.0, 0.0][..], &[0.25, 3.0, 2.0, 1.0][..]));
}

#[test]
fn emergency_stops_and_enabling_switches_are_parsed() {
    let Loaded { registry, warnings } = valid("stops");
    assert_eq!(warnings, []);
    let [pendant, pedal, panel, door, wrist] = registry.stops.as_slice() else { panic!("five stops") };
    assert_eq!((pendant.name.as_str(), pendant.kind, pedal.kind), ("pendant", StopKind::Emergency, StopKind::Enabling));
    assert!(registry.stops.iter().all(|stop| stop.actuators == ["arm"]), "the default is all");
    let InputSpec::Serial(line) = &pendant.input else { panic!("a serial port") };
    assert_eq!((line.baud, line.on.as_str(), &line.off), (9600, "RUN", &LineOff::Line("STOP".into())));
    assert_eq!((line.path.to_str(), line.silence.unwrap().as_millis()), (Some("/dev/serial/by-id/usb-pendant"), 150));
    // A switch is held, an emergency stop is not pressed, unless configured otherwise.
    let keys = [pedal, panel].map(|stop| {
        let InputSpec::Key(key) = &stop.input else { panic!("a key") };
        (key.device.as_str(), key.number, key.on_while_pressed)
    });
    assert_eq!(keys, [("PCsensor FootSwitch Keyboard", 48, true), ("/dev/input/by-id/panel", 0x120, true)]);
    let InputSpec::Gpio(gpio) = &door.input else { panic!("a line of a chip") };
    assert_eq!((gpio.chip.to_str(), gpio.line, gpio.on_while_high), (Some("/dev/gpiochip0"), 17, false));
    let InputSpec::Field(field) = &wrist.input else { panic!("a number") };
    assert_eq!((field.device.as_str(), field.index, field.silence.as_millis()), ("buttons", 1, 200));
    assert!(field.on.holds(-0.6) && !field.on.holds(-0.5) && !field.on.holds(f64::NAN));
    let NodeSpec::Can(can) = &registry.named("arm").unwrap().node else { panic!("a CAN adapter") };
    let CanProtocol::Damiao(damiao) = &can.protocol else { panic!("motors") };
    assert_eq!(damiao.motors[0].stop, StopSpec { emergency: Stop::Hold, ..StopSpec::default() });
}

#[test]
fn buttons_are_parsed() {
    let Loaded { registry, warnings } = valid("buttons");
    assert_eq!(warnings, []);
    let [left, right, go, lever, remote, panel, thumb, index] = registry.buttons.as_slice() else { panic!("eight") };
    assert_eq!(
        [left.press, left.hold, left.double].map(Option::unwrap).map(|action| action.to_string()),
        ["toggle", "discard", "redo"]
    );
    assert_eq!((left.hold_after.as_millis(), lever.hold_after.as_millis(), lever.press), (1000, 500, None));
    let keys = [left, right].map(|button| {
        let InputSpec::Key(key) = &button.input else { panic!("a key") };
        (key.number, key.on_while_pressed, key.grab)
    });
    assert_eq!(keys, [(183, true, true), (184, true, false)]);
    let lines = [go, lever, remote].map(|button| {
        let InputSpec::Serial(line) = &button.input else { panic!("a serial port") };
        (line.baud, line.on.as_str(), line.off.clone(), line.silence.map(|silence| silence.as_millis()))
    });
    assert_eq!(lines[0], (9600, "go", LineOff::AtOnce, None));
    assert_eq!(lines[1], (9600, "down", LineOff::Line("up".into()), None));
    assert_eq!(lines[2], (115_200, "1", LineOff::Line("0".into()), Some(1000)));
    let InputSpec::Gpio(gpio) = &panel.input else { panic!("a line of a chip") };
    assert_eq!((gpio.line, gpio.on_while_high), (17, false));
    let fields = [thumb, index].map(|button| {
        let InputSpec::Field(field) = &button.input else { panic!("a number") };
        (field.index, field.on, field.off, field.silence.as_millis())
    });
    assert_eq!(fields[0], (1, Bound::Above(0.8), Some(Bound::Below(0.6)), 2000));
    assert_eq!(fields[1], (0, Bound::Below(0.0), None, 500));
}

#[test]
fn stops_that_stop_nothing_cause_a_warning() {
    let stop = "[stop.key]\nkind = \"emergency\"\nkey = { device = \"pad\", code = \"KEY_B\" }\n";
    for (name, words) in [("minimal", "the rig has no actuator"), ("actuator", "[device.arm] is moved by a program")] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/registry/valid/{name}.toml"));
        let warnings = Registry::parse(&format!("{}{stop}", mistakes::read(&path)), None).unwrap().warnings;
        assert!(warnings.iter().any(|warning| warning.message.contains(words)), "{warnings:?}");
    }
}

#[test]
fn limits_of_the_verdict_are_the_defaults_then_the_rigs_then_the_devices() {
    let registry = valid("verdict").registry;
    let of = |name: &str| registry.named(name).unwrap().verdict;
    let ms = |ms| Some(std::time::Duration::from_millis(ms));
    let (cam, screen, imu) = (of("cam"), of("static_screen"), of("imu"));
    // The device's own limit for SUSPECT moved the one for BAD along.
    assert_eq!((cam.suspect.lost, cam.bad.lost), (Some(0.1), Some(0.1)));
    assert_eq!((screen.suspect.lost, screen.bad.lost), (Some(0.02), Some(0.05)));
    assert_eq!((cam.suspect.late, cam.bad.late), (Some(0.03), None));
    assert_eq!((screen.suspect.late, screen.bad.late), (None, None));
    assert_eq!((cam.suspect.dropped, cam.bad.dropped), (Some(0.0), Some(0.01)));
    assert_eq!((cam.suspect.gap, cam.bad.gap, cam.hz), (ms(700), ms(7000), Some(15.0)));
    assert_eq!((screen.suspect.gap, screen.bad.gap, screen.hz), (ms(2000), ms(5000), Some(30.0)));
    assert_eq!((cam.suspect.frozen, cam.bad.frozen, cam.compares()), (ms(1000), ms(2000), true));
    assert_eq!((screen.suspect.frozen, screen.bad.frozen, screen.compares()), (None, None, false));
    // Equal numbers are not a fault unless the device's own table makes them one.
    assert_eq!((imu.suspect.frozen, imu.bad.frozen, imu.compares()), (None, ms(5000), true));
    assert_eq!((imu.suspect.rate, imu.bad.rate, imu.hz), (Some(0.9), Some(0.8), Some(200.0)));
}

#[test]
fn missing_bits_are_the_lowest_free_in_the_order_of_the_file() {
    let Loaded { registry, warnings } = valid("bits_filled_in");
    let bits: Vec<_> = registry.devices.iter().map(|device| (device.name.as_str(), device.id.bit())).collect();
    assert_eq!(bits, [("pinned", 0), ("z_first", 1), ("a_last", 2)]);
    let warned: Vec<_> = warnings.iter().map(|warning| warning.entry.as_deref().unwrap()).collect();
    assert_eq!(warned, ["device.z_first", "device.a_last"]);
}

#[test]
fn default_depths_shrink_to_the_budget_and_explicit_ones_do_not() {
    let Loaded { registry, warnings } = valid("depths_within_budget");
    assert_eq!(warnings[0].message, "depth lowered from 60 to 38 to keep all topics within memory_budget = 144MiB");
    assert_eq!(warnings.len(), 1);
    let depths: Vec<_> = registry.devices.iter().map(|device| device.depth).collect();
    let total: usize = registry.devices.iter().map(|device| (device.depth + POOL_SPARE) * device.max_bytes).sum();
    assert_eq!(depths, [38, 20]);
    assert!(total <= 144 << 20, "{total}");
}

#[test]
fn a_composite_device_may_have_an_entry_for_each_node() {
    let registry = valid("composite_device").registry;
    assert_eq!(registry.devices[0].identity, registry.devices[1].identity);
    let NodeSpec::Serial(serial) = &registry.devices[1].node else { panic!("a serial line") };
    assert_eq!((serial.framing, serial.parse, serial.channels), (Framing::Fixed(12), Parse::F32le, 3));
}

#[test]
fn files_of_editors_of_other_systems_are_accepted() {
    let text = "\u{feff}[device.cam]\r\nvid = \"046d\"\r\npid = \"0825\"\r\nnode = \"camera\"\r\n";
    assert_eq!(Registry::parse(text, None).unwrap().registry.devices[0].name, "cam");
    let errors = Registry::parse(&format!("{text}tpoic = \"/ü\" # ü\r\n"), None).unwrap_err();
    assert_eq!(
        errors.to_string(),
        "devices.toml:5:1: [device.cam] unknown key \"tpoic\"\n    fix: did you mean \"topic\"?"
    );
}

/// A valid or nearly valid file with some bytes replaced, removed, doubled.
fn mutated() -> impl Strategy<Value = String> {
    let sources: Vec<String> = files("valid")
        .iter()
        .chain(&files("invalid"))
        .map(|path| std::fs::read_to_string(path).unwrap())
        .filter(|text| !text.is_empty())
        .collect();
    let edit = (any::<prop::sample::Index>(), 0_usize..12, "[ -~\\n\"\\[\\]=.]{0,6}|\\PC{0,2}|-?[0-9]{1,25}");
    (prop::sample::select(sources), prop::collection::vec(edit, 1..6)).prop_map(|(mut text, edits)| {
        for (place, length, new) in edits {
            let mut chars: Vec<char> = text.chars().collect();
            let at = place.index(chars.len() + 1);
            let end = (at + length).min(chars.len());
            chars.splice(at..end, new.chars());
            text = chars.into_iter().collect();
        }
        text
    })
}

/// Every diagnostic of a text has a place in it and a fix; whatever is accepted is consistent.
fn check_any(text: &str) {
    match Registry::parse(text, None) {
        Ok(loaded) => {
            let devices = &loaded.registry.devices;
            assert!((1..=64).contains(&devices.len()));
            for set in [
                devices.iter().map(|device| device.id.to_string()).collect::<BTreeSet<_>>(),
                devices.iter().map(|device| device.topic.clone()).collect(),
                devices.iter().map(|device| device.name.clone()).collect(),
            ] {
                assert_eq!(set.len(), devices.len());
            }
            let total: u64 = devices.iter().map(|device| device.max_bytes as u64 * device.depth as u64).sum();
            assert!(total <= loaded.registry.rig.memory_budget);
            let files = system_files(&loaded.registry);
            let descriptors = files.iter().filter(|file| file.kind == SystemFileKind::Descriptor).count();
            assert_eq!(descriptors, devices.len());
            let paths: BTreeSet<_> = files.iter().map(|file| &file.path).collect();
            assert_eq!(paths.len(), files.len(), "no file replaces another");
            let demo = Scenario::demo(&loaded.registry);
            assert_eq!(demo.devices.len(), devices.len());
        }
        Err(errors) => {
            assert!(!errors.diagnostics.is_empty());
            for diagnostic in &errors.diagnostics {
                assert!(diagnostic.line <= text.split('\n').count(), "{diagnostic:?}");
                assert!(diagnostic.fix.is_some(), "{diagnostic:?}");
                assert!(!diagnostic.to_string().chars().any(|c| c.is_control() && c != '\n'), "{diagnostic:?}");
            }
        }
    }
}

proptest! {
    #[test]
    fn no_text_causes_a_panic(text in any::<String>()) {
        check_any(&text);
        let _ = Scenario::parse(&text, None, &Registry::builtin());
    }

    #[test]
    fn no_damaged_file_causes_a_panic(text in mutated()) {
        check_any(&text);
    }

    #[test]
    fn no_value_causes_a_panic(key in "[a-z_.]{1,12}", value in "[-0-9a-zA-Z_.\"'\\[\\]{}=, ]{0,30}") {
        check_any(&format!("{BUILTIN}\n{key} = {value}\n[device.x]\n{key} = {value}\n"));
        let text = format!("repeat = {value}\n[[device]]\n{key} = {value}\n[[event]]\n{key} = {value}\n");
        let _ = Scenario::parse(&text, None, &Registry::builtin());
    }
}

/// Of the damaged files few are accepted: these are all.
#[test]
fn what_is_accepted_is_consistent() {
    let valid = files("valid");
    assert!(!valid.is_empty());
    for path in valid {
        check_any(&std::fs::read_to_string(path).unwrap());
    }
}

#[test]
fn deep_and_wide_texts_are_survived() {
    for text in [
        "a.".repeat(400_000),
        format!("[{}a]", "a.".repeat(400_000)),
        format!("a = {}", "[".repeat(900_000)),
        format!("a = {}", "{a=".repeat(300_000)),
        "[device.x]\n".repeat(90_000),
        (0..60_000).map(|number| format!("k{number} = 1")).collect::<Vec<_>>().join("\n"),
        format!("[device.x]\nserial = \"{}\"", "x".repeat(1 << 20)),
    ] {
        check_any(&text);
    }
}
