//! The rig of the simulated task: its registry, and the devices plugged in when a trial begins.

use super::scenario::{Scenario, ScenarioDevice};
use super::spec::Registry;
use crate::simulation::task::SharedTrial;
use crate::simulation::{SimSource, TaskPart};

const TEXT: &str = include_str!("task.toml");

/// The entries of the registry with the part of the task that each of them is.
pub const PARTS: [(&str, TaskPart); 3] =
    [("cam_wrist", TaskPart::Wrist), ("tactile_tip", TaskPart::Tactile), ("arm", TaskPart::Arm)];

impl Registry {
    /// The registry of the simulated task.
    ///
    /// # Panics
    /// Never: the text is part of the program, and a test parses it.
    #[expect(clippy::expect_used, reason = "a text fixed at build time, parsed by a test")]
    pub fn task() -> Self {
        Self::parse(TEXT, None).expect("the registry of the simulated task is valid").registry
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
        assert!(PARTS.iter().all(|(name, _)| registry.named(name).is_some()));
        assert_eq!(registry.devices.len(), PARTS.len());
        let (device, action) = registry.actuator().unwrap();
        assert_eq!((device.name.as_str(), action.names.len()), ("arm", 4));
        assert_eq!(Scenario::task(&registry, 7).devices.len(), PARTS.len());
    }
}
