use super::*;

fn parse(text: &str) -> Result<Scenario, String> {
    Scenario::parse(text, None, &Registry::builtin()).map_err(|errors| errors.to_string())
}

fn event(milliseconds: u64, device: &str, action: ScenarioAction) -> ScenarioEvent {
    ScenarioEvent { at: Duration::from_millis(milliseconds), device: device.to_owned(), action }
}

#[test]
fn without_devices_every_entry_is_plugged() {
    let scenario = parse("").unwrap();
    assert_eq!(scenario.events, []);
    assert_eq!(scenario.repeat, None);
    let devices: Vec<_> = scenario
        .devices
        .iter()
        .map(|d| (d.name.as_str(), d.usb.serial.as_deref().unwrap(), d.usb.port.as_str(), d.plugged))
        .collect();
    assert_eq!(
        devices,
        [
            ("cam_wrist", "CAM00A1", "9-1", true),
            ("tactile_tip", "TAC00B1", "9-2", true),
            ("motor_state", "MOT00C1", "9-3", true),
        ]
    );
    assert_eq!(scenario.devices[1].source, SimSource::Camera { width: 320, height: 240, fps: 30, seed: 1, bytes: 0 });
    assert_eq!(scenario.devices[2].source, SimSource::Serial { channels: 3, hz: 100, seed: 2 });
}

#[test]
fn the_demo_unplugs_the_second_camera_repeatedly() {
    let demo = Scenario::demo(&Registry::builtin());
    let plug = ScenarioAction::Plug { port: None };
    assert_eq!(demo.events, [event(3000, "tactile_tip", ScenarioAction::Unplug), event(6000, "tactile_tip", plug)]);
    assert_eq!(demo.repeat, Some(Duration::from_secs(12)));
    assert_eq!(demo.devices.len(), 3);
}

#[test]
fn events_are_ordered_by_time_and_then_by_the_file() {
    let scenario = parse(
        r#"
        repeat = "12s"
        [[event]]
        at = "6s"
        plug = "cam_wrist"
        port = "1-4"
        [[event]]
        at = "500ms"
        silence = "motor_state"
        [[event]]
        at = "3s"
        unplug = "cam_wrist"
        [[event]]
        at = "3s"
        resume = "motor_state"
        "#,
    )
    .unwrap();
    assert_eq!(
        scenario.events,
        [
            event(500, "motor_state", ScenarioAction::Silence),
            event(3000, "cam_wrist", ScenarioAction::Unplug),
            event(3000, "motor_state", ScenarioAction::Resume),
            event(6000, "cam_wrist", ScenarioAction::Plug { port: Some("1-4".to_owned()) }),
        ]
    );
}

#[test]
fn two_units_of_one_model_without_serial_numbers_are_accepted() {
    let scenario = parse(
        r#"
        [[device]]
        name = "cam_wrist"
        serial = ""
        port = "1-2"
        [[device]]
        name = "twin"
        like = "cam_wrist"
        serial = ""
        port = "1-3"
        seed = 9
        hz = 60
        bytes = "60kB"
        plugged = false
        [[event]]
        at = "1s"
        plug = "twin"
        "#,
    )
    .unwrap();
    let [one, two] = scenario.devices.as_slice() else { panic!("two devices") };
    assert_eq!((one.usb.vid, one.usb.pid, &one.usb.serial), (two.usb.vid, two.usb.pid, &two.usb.serial));
    assert_eq!((one.usb.port.as_str(), two.usb.port.as_str()), ("1-2", "1-3"));
    assert_eq!(two.source, SimSource::Camera { width: 640, height: 480, fps: 60, seed: 9, bytes: 60_000 });
    assert!(one.plugged && !two.plugged);
}

#[test]
fn faults_are_those_of_the_device_above() {
    let scenario = parse(
        r#"
        [[device]]
        name = "cam_wrist"
        [device.fault]
        freeze_at = "3s"
        truncate_every = 10
        clock_ppm = -20
        latency = "35ms"
        close = "2s"
        [[device]]
        name = "motor_state"
        "#,
    )
    .unwrap();
    let expected = SimFaults {
        freeze_at: Some(Duration::from_secs(3)),
        truncate_every: Some(10),
        clock_ppm: -20,
        latency: Duration::from_millis(35),
        close: Duration::from_secs(2),
        ..SimFaults::default()
    };
    assert_eq!(scenario.devices[0].faults, expected);
    assert_eq!(scenario.devices[1].faults, SimFaults::default());
}

#[test]
fn all_errors_are_reported_with_their_position() {
    for (text, expected) in [
        (
            "[[event]]\nat = \"1s\"\nunplug = \"tactile_tp\"\n[[event]]\nat = 3\nunplug = \"cam_wrist\"\n",
            "scenario:3:10: [event 1] \"tactile_tp\" is not a device of this scenario\n    \
             fix: did you mean \"tactile_tip\"?\n\
             scenario:5:6: [event 2] at has no unit\n    \
             fix: write 0s to 168h with a unit (us, ms, s, min, h), for example at = \"25ms\"",
        ),
        (
            "[[device]]\nname = \"cam_wrst\"\n",
            "scenario:2:8: [device 1] \"cam_wrst\" is not in the registry\n    fix: did you mean \"cam_wrist\"?",
        ),
        (
            "[[event]]\nat = \"1s\"\nplug = \"cam_wrist\"\n",
            "scenario:3:8: [event 1] cam_wrist is already plugged at 1s\n    \
             fix: unplug it before, or write plugged = false at its [[device]]",
        ),
        (
            "repeat = \"2s\"\n[[event]]\nat = \"1s\"\nunplug = \"cam_wrist\"\n",
            "scenario:4:10: [event 1] with repeat cam_wrist must end as it began: plugged\n    \
             fix: add the event that undoes this one",
        ),
        (
            "[[event]]\nat = \"1s\"\nplug = \"cam_wrist\"\nunplug = \"cam_wrist\"\n",
            "scenario:1:1: [event 1] plug and unplug in one event\n    \
             fix: write exactly one of plug, unplug, silence, resume",
        ),
        (
            "[[event]]\nat = \"1s\"\nunplug = \"cam_wrist\"\n[[event]]\nat = \"2s\"\nplug = \"cam_wrist\"\nport = \"9-2\"\n",
            "scenario:6:8: [event 2] port 9-2 is taken by tactile_tip at 2s\n    fix: name another port",
        ),
        (
            "[[device]]\nname = \"cam_wrist\"\nport = \"1-1\"\n[[device]]\nname = \"tactile_tip\"\nport = \"1-1\"\n",
            "scenario:6:8: [device 2] port 1-1 is already used by the device on line 1\n    \
             fix: give each device a separate port: port = \"1-4\"",
        ),
        (
            "[device]\nname = \"cam_wrist\"\nspeed = 1\n",
            "scenario:1:1: device must be a list of tables, but is a table\n    \
             fix: write [[device]] with two brackets",
        ),
        (
            "[[device]]\nname = \"cam_wrist\"\n[device.fault]\nfreez_at = \"1s\"\nlose_every = 1\n",
            "scenario:4:1: [device 1.fault] unknown key \"freez_at\"\n    fix: did you mean \"freeze_at\"?\n\
             scenario:5:14: [device 1.fault] lose_every = 1 is out of range\n    \
             fix: write a whole number from 2 to 1000000, without quotes",
        ),
    ] {
        assert_eq!(parse(text).unwrap_err(), expected);
    }
}
