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
