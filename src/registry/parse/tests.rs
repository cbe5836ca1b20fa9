use super::*;

#[test]
fn the_builtin_registry_is_the_demonstration_rig() {
    let loaded = Registry::parse(BUILTIN, None).unwrap();
    assert_eq!(loaded.warnings, []);
    let names: Vec<_> =
        loaded.registry.devices.iter().map(|d| (d.id.bit(), d.name.as_str(), d.topic.as_str())).collect();
    assert_eq!(
        names,
        [
            (0, "cam_wrist", "/rapid/camera/wrist"),
            (1, "tactile_tip", "/rapid/camera/tactile"),
            (2, "motor_state", "/rapid/serial/motor"),
        ]
    );
    assert_eq!(Registry::builtin().rig.name, "bench-1");
}

#[test]
fn a_device_too_slow_for_the_window_gets_a_warning_with_a_fix() {
    let parse = |window: &str, fps: u32, verdict: &str| {
        let text = format!(
            "[rig]\n{window}\n[device.cam]\nvid = \"1209\"\npid = \"0001\"\nserial = \"A\"\nnode = \"camera\"\nbit = 0\n\
             [device.cam.camera]\nwidth = 32\nheight = 24\nfps = {fps}\n{verdict}"
        );
        let loaded = Registry::parse(&text, None).unwrap();
        loaded.warnings.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    let off = "[device.cam.verdict]\nvalid = \"off\"\n";
    for (window, fps, verdict, warned) in [
        ("", 30, "", false),
        ("", 18, "", false),
        ("", 17, "", true),
        ("", 15, "", true),
        ("", 15, off, false),
        ("sync_window = \"34ms\"", 15, "", false),
        ("sync_window = \"10ms\"", 30, "", true),
    ] {
        let warnings = parse(window, fps, verdict);
        assert_eq!(warnings.len(), usize::from(warned), "{window} {fps} {verdict}: {warnings:?}");
    }
    let warning = parse("", 15, "").concat();
    for part in ["15 samples a second", "75 %", "sync_window = 25ms", "sync_window = \"34ms\"", "[device.cam.verdict]"]
    {
        assert!(warning.contains(part), "{part}: {warning}");
    }
}
