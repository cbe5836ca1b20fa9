//! The rigs of the simulated task, with an arm and in a hand: their registries, and the devices plugged in when a trial begins.

use super::scenario::{Scenario, ScenarioDevice};
use super::spec::Registry;
use crate::simulation::task::SharedTrial;
use crate::simulation::{SimSource, TaskPart};

const TEXT: &str = concat!(include_str!("task.toml"), include_str!("task_cameras.toml"));
const HANDHELD: &str = concat!(include_str!("task_handheld.toml"), include_str!("task_cameras.toml"));
/// The module of the handheld rig that has no sensor: it is named.
pub const HANDHELD_MODULE: &str = "handheld_adapter";

/// The entries of the registry with the part of the task that each of them is.
pub const PARTS: [(&str, TaskPart); 5] = [
    ("cam_wrist", TaskPart::Wrist),
    ("tactile_tip", TaskPart::Tactile),
    ("arm", TaskPart::Arm),
    ("phone", TaskPart::Phone),
    ("gripper", TaskPart::Gripper),
];

impl Registry {
    /// The registry of the simulated task.
    ///
    /// # Panics
    /// Never: the text is part of the program, and a test parses it.
    #[expect(clippy::expect_used, reason = "a text fixed at build time, parsed by a test")]
    pub fn task() -> Self {
        Self::parse(TEXT, None).expect("the registry of the simulated task is valid").registry
    }

    /// The registry of the simulated task with the gripper in a hand, in place of the arm.
    ///
    /// # Panics
    /// Never: as [`Self::task`].
    #[expect(clippy::expect_used, reason = "a text fixed at build time, parsed by a test")]
    pub fn task_handheld() -> Self {
        Self::parse(HANDHELD, None).expect("the registry of the handheld task is valid").registry
    }
}

impl Scenario {
    /// Trial `seed` of the simulated task, for [`Registry::task`]: everything is plugged in, and stays plugged in.
    pub fn task(registry: &Registry, seed: u64) -> Self {
        let trial = SharedTrial::new(seed);
        let device = |device: ScenarioDevice| {
            let (_, part) = PARTS.into_iter().find(|(name, _)| *name == device.name)?;
            Some(ScenarioDevice { source: SimSource::Task { part, trial: trial.clone() }, ..device })
        };
        let devices = Self::quiet(registry).devices.into_iter().filter_map(device).collect();
        Self { devices, events: Vec::new(), repeat: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rig_of_the_task_has_its_parts_and_one_actuator() {
        let registry = Registry::task();
        assert!(registry.devices.iter().all(|device| PARTS.iter().any(|(name, _)| *name == device.name)));
        assert_eq!(registry.devices.len(), 3);
        let (device, action) = registry.actuator().unwrap();
        assert_eq!((device.name.as_str(), action.names.len()), ("arm", 4));
        assert_eq!(Scenario::task(&registry, 7).devices.len(), 3);
        let handheld = Registry::task_handheld();
        assert!(handheld.actuator().is_none());
        assert_eq!(Scenario::task(&handheld, 7).devices.len(), 4);
        assert_eq!(handheld.modules.first().map(|module| module.name.as_str()), Some(HANDHELD_MODULE));
    }
}
